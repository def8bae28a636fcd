"""Compiled ways of the filter, the same to rounding as `predict` and `correct` of `fusion_core.kalman`.

===================  ==========================================  ========  =============================================
way                  when                                        factor    price
===================  ==========================================  ========  =============================================
`plain`              asked for                                   1         nothing compiled
`loop`               anything varies, or a sample lacks a        over 500  a compilation for each size of group, kept
                     component or is refused                     on plain  for the next time
`single`             one sample in a call, all of it measured    4 on      one compilation, for models of any size
                     and taken, R diagonal                       `loop`
`groups`             always, under `loop` and `lanes`            7         a look for zeros in F and Q, a tenth of the
                                                                           time where they vary
`factored`           P is over 1e12 times R                      0.5       NumPy, for the samples until P is narrow
`steady` + `lanes`   F, Q, H, R the same at every sample, all    8 to 14   a compilation for each size and number of
                     measured                                    on loop   groups side by side; states as lanes
===================  ==========================================  ========  =============================================

Measured with 12 states in six groups, 6 components (`benchmarks/methods.py`). `job` switches within a call.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from functools import cached_property, partial, update_wrapper
from threading import RLock
from typing import Any

LOCK = RLock()
WITH_NUMBA: list[Callable[[], None]] = []
"""Functions that are called once, when numba has been imported: before anything is compiled."""


class Compiled:
    """A function that numba compiles, with what it calls of its module; numba is imported when it is first called."""

    def __init__(self, function: Callable[..., Any], **options: Any) -> None:
        update_wrapper(self, function)
        self.py_func, self.options = function, options

    @cached_property
    def dispatcher(self) -> Any:
        """The function as numba has it."""
        from numba import config, njit

        if "NUMBA_SLP_VECTORIZE" not in os.environ:
            config.SLP_VECTORIZE = 1  # sums that stand side by side become one: dense models take a third less
        while WITH_NUMBA:
            WITH_NUMBA.pop()()
        # nobody asks for the address of a function: without it a sixth less is compiled
        made = njit(self.py_func, cache=True, nogil=True, error_model="numpy", no_cfunc_wrapper=True, **self.options)
        kept: Any = getattr(made, "_cache", None)  # None where NUMBA_DISABLE_JIT is set
        if all(hasattr(kept, name) for name in ("_load_overload", "_guard_against_spurious_io_errors")):
            kept.load_overload = partial(_load, kept)
        return made

    @property
    def together(self) -> Any:
        """The function as numba has it, and so what it calls of its module."""
        names = self.py_func.__globals__
        if isinstance(names.get(self.py_func.__name__), Compiled):  # the first of its module that is called
            with LOCK:  # compiled code calls compiled code
                own = [(name, value) for name, value in names.items() if isinstance(value, Compiled)]
                names.update({name: value.dispatcher for name, value in own if value.py_func.__globals__ is names})
        return self.dispatcher

    def __call__(self, *given: Any, **named: Any) -> Any:
        """Call the function; it is compiled first where it has not been for such arguments."""
        return self.together(*given, **named)


def _load(kept: Any, sig: Any, context: Any) -> Any:
    """Load a function for a signature from numba's cache of it, without all that can be compiled; None if not there.

    All that takes half of numba's start, and numba loads it by itself where it compiles.
    """
    from numba.core.runtime import rtsys

    rtsys.initialize(context)  # memory of arrays
    found: Any = None
    with kept._guard_against_spurious_io_errors():
        found = kept._load_overload(sig, context)
    # two processes that keep a function for different types at one moment may give both the same file
    return found if found is None or found.signature.args == sig else None


compiled = Compiled
inlined = partial(Compiled, forceinline=True, no_cpython_wrapper=True)  # for compiled functions: Python cannot call it
