"""Threads for compiled kernels that release Python's lock.

Threads of a pool sleep while there is nothing to do; those of an OpenMP runtime spin, and
would take the processor from the next stage.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

__all__ = ["Workers"]


class Workers:
    """A fixed number of threads that share the work of each call."""

    def __init__(self, count: int) -> None:
        self.count = int(count)
        if self.count < 1:
            raise ValueError(f"nthreads={count} must be at least 1")
        self._pool = ThreadPoolExecutor(self.count - 1) if self.count > 1 else None

    def run(self, kernel: Callable[..., object], *args, part: tuple[int, int] = (0, 1)) -> None:
        """Call kernel(*args, worker, count) for each worker, all at once, and wait.

        With part = (p, n) these are workers p·count, p·count + 1, … of n·count: the others are in other processes.
        """
        first, count = part[0] * self.count, part[1] * self.count
        others = [self._pool.submit(kernel, *args, first + worker, count)
                  for worker in range(1, self.count)] if self._pool else []
        kernel(*args, first, count)
        for other in others:
            other.result()
