"""How Numba compiles: kernels, which Python calls, and the functions within them.

The compiled kernels are kept on the disk where Numba keeps them: beside the sources, or in the user's cache where that
folder cannot be written, or in NUMBA_CACHE_DIR.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from numba import njit

__all__ = ["inner", "kernel"]

NOT_FROM_PYTHON = {"no_cpython_wrapper": True, "no_cfunc_wrapper": True}


def kernel(**options: Any) -> Callable:
    """Return a decorator for a function that Python calls: it runs without the GIL, compiled once for all processes.

    Where no folder can be written, every process compiles its own.
    """
    def decorate(function):
        try:
            return njit(nogil=True, cache=True, **options)(function)
        except RuntimeError:  # Numba found no folder
            return njit(nogil=True, **options)(function)

    return decorate


def inner(**options: Any) -> Callable:
    """Return a decorator for a function that only kernels call: no way in from Python has to be compiled."""
    return njit(**NOT_FROM_PYTHON, **options)
