"""The fused backend: one compiled loop over time that keeps a lane's state in registers, made from the step of the scan.

XLA makes several kernels of a time step and passes the state through memory between them. Here the traced step is split
(`dependence`) into what all lanes share, which is computed once, ahead of them (`shared_part`), and what each lane does,
which one loop does in registers: on CPUs compiled by LLVM (`llvm`), on a GPU as one kernel (`pallas`). `lane_simulator`
takes lanes through a whole run by either. `single_plant` does what a log asks for: the trajectory of one plant, and the
derivatives of its steps.
"""

import logging
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import cache
from typing import Any

import jax
import numpy as np

SCAN_MESSAGE = "The fused loop does not support %s; the slower scan is used."
"""Message for the user; takes what is not supported."""


Arrays = list[np.ndarray]
ArrayGroup = Sequence[np.ndarray] | np.ndarray
"""Arrays one by one, or as the rows of one array."""
Leaves = list[Any]
"""Leaves of a tree: numbers or arrays, traced or not."""


class Unsupported(Exception):
    """Something that a fused loop cannot do."""


@contextmanager
def raising_unsupported(task: str = f"compilation with JAX {jax.__version__}") -> Iterator[None]:
    """Turn every error of compiling a loop into `Unsupported`: JAX and LLVM change from version to version."""
    try:
        yield
    except Unsupported:
        raise
    except Exception as error:  # of any kind: imports, tracing, lowering and assemblers have their own
        first_line = str(error).strip().partition("\n")[0]
        raise Unsupported(f"{task} ({type(error).__name__}: {first_line:.200})") from error


@cache
def warn_of_scan(reason: str) -> None:
    """Warn once on stderr that the scan is used; for computations without a report that could say it."""
    logging.getLogger(__name__).warning(SCAN_MESSAGE, reason)
