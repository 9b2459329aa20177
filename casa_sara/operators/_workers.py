"""Threads for compiled kernels that release Python's lock.

Threads of a pool sleep while there is nothing to do; those of an OpenMP runtime spin, and
would take the processor from the next stage.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

__all__ = ["Workers"]

LEAST_NS = 5e4  # work that is worth a thread: to wake it and to wait for it takes about as long


class Workers:
    """A fixed number of threads that share the work of each call, or as many of them as it can keep busy."""

    def __init__(self, count: int) -> None:
        self.count = int(count)
        if self.count < 1:
            raise ValueError(f"nthreads={count} must be at least 1")
        self._pool = ThreadPoolExecutor(self.count - 1) if self.count > 1 else None

    def for_work(self, work_ns: float) -> int:
        """Return how many threads are worth while for what takes one of them `work_ns` nanoseconds."""
        return 1 if work_ns < 2 * LEAST_NS else int(min(self.count, work_ns / LEAST_NS))

    def run(self, kernel: Callable[..., object], *args, part: tuple[int, int] = (0, 1),
            work_ns: float = math.inf) -> None:
        """Call kernel(*args, worker, count) for each worker, all at once, and wait.

        With part = (p, n) these are workers p·count, p·count + 1, … of n·count: the others are in other processes.
        `work_ns` is what all takes one thread, roughly: where that is little, `count` is that of :meth:`for_work`.
        """
        here = self.for_work(work_ns / part[1])
        first, count = part[0] * here, part[1] * here
        others = [self._pool.submit(kernel, *args, first + worker, count)
                  for worker in range(1, here)] if self._pool else []
        kernel(*args, first, count)
        for other in others:
            other.result()
