"""The generic core: an augmented-state Kalman filter and the host of the plugins that describe its states.

Conventions, written here once and used everywhere:

- Time is always the leading axis. N samples, n states, m measured components, d axes.
- One step leads *to* sample k; with the known drift u, the noise w ~ N(0, Q) and r ~ N(0, R)::

      x_k = F_k x_{k-1} + u_k + w_k
      z_k = H_k x_k + r_k

- A leading N may be left out of F, Q, H, R: "the same for every sample". That is how the core knows
  that a model is time-invariant.
- y = z - H x is the innovation, S its covariance, K the gain, nis = y' S^-1 y.
- Everything is in SI units, and in degC; `sigma_*` are standard deviations or densities.

The filter's modules know arrays, chunks and blocks, and no sensor; packages beside them are about sensors.

The public names stand in the stub beside this file, each with its module. They are loaded at first use:
importing the package loads no compiled code and no plugin.
"""

from __future__ import annotations

import ast
import sys
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import Any


def names_of_stub(package: str, file: str) -> tuple[Callable[[str], Any], Callable[[], list[str]], list[str]]:
    """Return `__getattr__`, `__dir__` and `__all__` of a package that loads the names of its stub at first use."""
    imports = ast.parse(Path(file).with_suffix(".pyi").read_text()).body
    home = {name.name: node.module for node in imports if isinstance(node, ast.ImportFrom) for name in node.names}

    def load(name: str) -> Any:
        if home.get(name) is None:
            raise AttributeError(f"module '{package}' has no attribute '{name}'")
        value = getattr(import_module(str(home[name])), name)
        setattr(sys.modules[package], name, value)
        return value

    return load, lambda: sorted({*vars(sys.modules[package]), *home}), sorted(home)


__getattr__, __dir__, __all__ = names_of_stub(__name__, __file__)
