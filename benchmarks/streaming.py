"""One sample at a time through checks, epochs, temperature rate, plugins and filter: how long each takes."""

from __future__ import annotations

import gc
import tempfile
import time
from pathlib import Path

import numpy as np
from common import Row, limit, show
from recording import blocks, write_config, write_map

from driftlab.config import load_config
from driftlab.filtering.run import Run
from driftlab.filtering.segment import RunLog
from driftlab.recordings.epochs import epochs
from driftlab.recordings.screening import read
from fusion_core.chunk import Chunk


def rows(samples: int = 4000, rate: float = 100.0) -> list[Row]:
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        config = load_config(write_config(folder / "c.yaml", write_map(folder / "map.onnx"), "10 ms"))
        t, gyro, accel, T = next(blocks(int(60 * rate) + 500 + samples, rate))
        whole = Chunk(t, {"gyro": gyro, "accel": accel, "temperature": T})
        given = [0.0]  # when the sample under way was given

        def one_by_one():
            yield whole.part(0, int(60 * rate) + 10)
            for k in range(int(60 * rate) + 10, len(whole)):
                piece = whole.part(k, k + 1)
                given[0] = time.perf_counter()
                yield piece

        took, log = [], RunLog()
        gc.set_threshold(100_000, 50, 50)  # this, and to freeze what the start has made, as `driftlab live` does
        gc.collect()
        gc.freeze()
        for _ in Run(config, log).over(epochs(read(config, log.faults, stream=one_by_one()), 0.01)):
            took.append(time.perf_counter() - given[0])
        micro = np.array(took[400:]) * 1e6
    return [
        limit("streaming, sample to estimate, median", float(np.median(micro)), "µs", 50),
        limit("streaming, sample to estimate, 99.9th percentile", float(np.percentile(micro, 99.9)), "µs", 200),
    ]


def main() -> None:
    show("Streaming", rows())


if __name__ == "__main__":
    main()
