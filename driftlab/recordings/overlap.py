"""Samples that two recordings have in common, in whatever file, format or time they are.

A stretch of a sensor's noise is a word of bits: whether each sample is above the one before it. Rounding, another
format, a cut or another clock leave the words as they are, and 48 to 64 of such bits do not come twice by chance.
Where two words agree, so must the values that they begin with, within a part of their noise.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from driftlab.recordings.identity import span_of
from fusion_core.chunk import Array, Chunk, Flags
from fusion_core.errors import ConfigError

BITS = 64  # of a word, at most
MAX_WORDS = 200_000  # words of a recording, at most about twice as many: those whose own bits choose them
PLAIN = 0.25  # of the bits: a word with less of either tells of no noise
NEAR = 0.05  # of the step from sample to sample, by which values may differ
ROUNDED = 1e-6  # of a value, by which it may differ
STEPS = 1000  # samples of a chunk that its usual step is taken of
MIN_COMMON = 8  # words in common that count
SMALL = 0.01  # share of the shorter recording that may be in common by some accident
SAME = 0.9  # share from which on two recordings are one
TWICE = "has samples in common with {}, and would count twice; name it once, or give parts that do not overlap"

Words = NDArray[np.uint64]


@dataclass(frozen=True)
class Content:
    """Words of a recording, and the values that they begin with."""

    words: Words  # (K,): each once, in rising order
    values: Array  # (K, d): the sensor's, SI
    step: Array  # (d,): usual step from sample to sample
    sparse: int  # one in so many words is kept

    def thinned(self, sparse: int) -> Content:
        """Return the content with one in so many words."""
        keep = _chosen(self.words, sparse)
        return Content(self.words[keep], self.values[keep], self.step, sparse)

    def share(self, other: Content) -> float:
        """Return the share of the words of the shorter recording that is in both."""
        sparse = max(self.sparse, other.sparse)
        one, two = self.thinned(sparse), other.thinned(sparse)
        _, i, j = np.intersect1d(one.words, two.words, assume_unique=True, return_indices=True)
        if len(i) < MIN_COMMON or one.values.shape[1] != two.values.shape[1]:
            return 0.0
        least = NEAR * np.minimum(one.step, two.step) + ROUNDED * np.abs(one.values[i])
        common = int(np.sum(np.all(np.abs(one.values[i] - two.values[j]) <= least, axis=1)))
        return common / min(len(one.words), len(two.words)) if common >= MIN_COMMON else 0.0


class Contents:
    """The contents of recordings by their names: words of the samples of `channel`, taken while these pass."""

    def __init__(self, channel: str) -> None:
        self.channel, self._of = channel, dict[str, Content]()

    def along(self, name: str, chunks: Iterable[Chunk]) -> Iterator[Chunk]:
        """Pass on the chunks of a recording, and keep its words at its end."""
        words = _WordsOf()
        for chunk in chunks:
            if self.channel in chunk.channels:
                words.take(chunk[self.channel].reshape(len(chunk), -1))
            yield chunk
        self._of[name] = words.content()

    def share(self, one: str, other: str) -> float:
        """Return the share of the samples of the shorter recording that is in both; 0 before these are known.

        Parts of one file are not read for it: equal ones share all, others that overlap some.
        """
        (file, start, stop), (same, begin, end) = span_of(one), span_of(other)
        if file != same:
            return self._of[one].share(self._of[other]) if one in self._of and other in self._of else 0.0
        if (start, stop) == (begin, end):
            return 1.0
        return SAME / 2 if start < end and begin < stop else 0.0

    def check_apart(self, names: Sequence[str]) -> None:
        """Raise ConfigError if two recordings have samples in common."""
        for one, other in combinations(names, 2):
            if self.share(one, other) > SMALL:
                raise ConfigError(f"{other}: {TWICE.format(one)}")


class _WordsOf:
    """Words of the samples of a sensor so far, and the values that they begin with."""

    def __init__(self) -> None:
        self.words: list[Words] = []
        self.values: list[Array] = []
        self.steps: list[Array] = []
        self.sparse = 1
        self.tail: Array | None = None  # rows of which no word is whole yet

    def take(self, x: Array) -> None:
        """Take the next samples (N, d)."""
        x = x if self.tail is None else np.concatenate([self.tail, x])
        long = _rows(x.shape[1])
        self.tail = x[-long:]
        if len(x) <= long:
            return
        self.steps.append(np.median(np.abs(np.diff(x[:STEPS], axis=0)), axis=0))
        new = _words(x, long)
        keep = np.flatnonzero(_chosen(new, self.sparse))
        keep = keep[_noisy(new[keep], long * min(x.shape[1], BITS))]
        self.words.append(new[keep])
        self.values.append(x[keep])
        while sum(map(len, self.words)) > 2 * MAX_WORDS:
            self.sparse *= 2
            chosen = [_chosen(part, self.sparse) for part in self.words]
            self.words = [part[k] for part, k in zip(self.words, chosen, strict=True)]
            self.values = [part[k] for part, k in zip(self.values, chosen, strict=True)]

    def content(self) -> Content:
        """Return the content of all that was taken."""
        if not self.words:
            return Content(np.zeros(0, dtype=np.uint64), np.zeros((0, 1)), np.zeros(1), 1)
        unique, first = np.unique(np.concatenate(self.words), return_index=True)
        return Content(unique, np.concatenate(self.values)[first], np.median(self.steps, axis=0), self.sparse)


def _rows(d: int) -> int:
    """Return the number of rows of d axes in a word: a power of two."""
    return 1 << (max(BITS // d, 1).bit_length() - 1)


def _words(x: Array, long: int) -> Words:
    """Return the word (N - long,) that begins at each row of x (N, d)."""
    d = min(x.shape[1], BITS)
    word: Words = np.zeros(len(x) - 1, dtype=np.uint64)
    for k in range(d):
        word |= (x[1:, k] > x[:-1, k]).astype(np.uint64) << np.uint64(k)
    rows = 1
    while rows < long:
        word = word[:-rows] | word[rows:] << np.uint64(rows * d)
        rows *= 2
    return word


def _noisy(words: Words, bits: int) -> Flags:
    """Return the mask of words with noise in them: some of each bit."""
    ones = words.copy()  # of each pair of bits, each four, each eight
    for shift, mask in ((1, 0x5555555555555555), (2, 0x3333333333333333), (4, 0x0F0F0F0F0F0F0F0F)):
        ones = (ones & np.uint64(mask)) + (ones >> np.uint64(shift) & np.uint64(mask))
    part = (ones * np.uint64(0x0101010101010101) >> np.uint64(56)) / bits
    return np.asarray((part >= PLAIN) & (part <= 1 - PLAIN))


def _chosen(words: Words, sparse: int) -> Flags:
    """Return the mask of words of which one in `sparse`, a power of two, stays: the same in every recording."""
    return np.asarray((words * np.uint64(0x9E3779B97F4A7C15)) >> np.uint64(40) & np.uint64(sparse - 1) == 0)
