"""Fused runs: the loop over time inside, a lane's state in registers, from the same step function as the scan.

XLA makes several kernels of a time step and passes the state through memory between them. Here the traced step is split
(`split`) into what all lanes share, which is computed once, `ahead` of them, and what each lane does, which one loop does in
registers: on CPUs compiled by LLVM (`llvm`), on a GPU as one kernel (`pallas`). `passage` takes lanes through a whole run by
either; `single_plant` does what a log asks for, one plant's path and the derivatives of its steps.
"""

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache

import jax

SCAN_MESSAGE = "The fused loop does not support %s; the slower scan is used."
"""Said of what is left to XLA."""


class Unsupported(Exception):
    """Something that a fused loop cannot do."""


@contextmanager
def raising_unsupported(what: str = f"compilation with JAX {jax.__version__}") -> Iterator[None]:
    """Around the making of a loop: whatever goes wrong is `Unsupported`, as JAX and LLVM change from version to version."""
    try:
        yield
    except Unsupported:
        raise
    except Exception as error:  # of any kind: imports, tracing, lowering and assemblers have their own
        said = str(error).strip().partition("\n")[0]
        raise Unsupported(f"{what} ({type(error).__name__}: {said:.200})") from error


@cache
def warn_of_scan(why: str) -> None:
    """On stderr, once; for what has no report that could say it."""
    logging.getLogger(__name__).warning(SCAN_MESSAGE, why)
