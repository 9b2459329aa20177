"""Threads for compiled kernels that release Python's lock.

Threads that have nothing to do sleep; those of an OpenMP runtime spin, and would take the processor from the next
stage.  A thread takes some 40 µs to wake, and the thread that calls does what no other has begun by then.
"""

from __future__ import annotations

import math
import threading
import weakref
from collections.abc import Callable
from queue import Empty, SimpleQueue
from typing import Any

__all__ = ["Workers"]

LEAST_NS = 5e4  # work that is worth a thread


class Workers:
    """A fixed number of threads that share the work of each call, or as many of them as it can keep busy.

    Parameters
    ----------
    count : int
        Most threads, that which calls among them.
    work_ns : float
        What a call takes one thread in nanoseconds, roughly, where that is so of every call: there are no more threads
        than are worth while.

    Attributes
    ----------
    count : int
        Threads.
    """

    def __init__(self, count: int, work_ns: float = math.inf) -> None:
        self.count = int(count)
        if self.count < 1:
            raise ValueError(f"nthreads={count} must be at least 1")
        self.count = self.for_work(work_ns)
        self._shares: SimpleQueue[Any] = SimpleQueue()
        for _ in range(1, self.count):
            threading.Thread(target=_work, args=(self._shares,), name="casa_sara worker", daemon=True).start()
        weakref.finalize(self, _dismiss, self._shares, self.count - 1)

    def for_work(self, work_ns: float) -> int:
        """Return how many of the threads are worth while for what takes one of them `work_ns` nanoseconds."""
        return max(int(min(self.count, work_ns / LEAST_NS)), 1)

    def run(self, kernel: Callable[..., object], *args, part: tuple[int, int] = (0, 1),
            work_ns: float = math.inf) -> None:
        """Call kernel(*args, worker, count) for each worker, all at once, and wait.

        With part = (p, n) these are workers p·count, p·count + 1, … of n·count: the others are in other processes.
        `work_ns` is what all takes one thread, roughly: where that is little, `count` is that of :meth:`for_work`.
        """
        here = self.for_work(work_ns / part[1])
        first, count = part[0] * here, part[1] * here
        if here == 1:
            kernel(*args, first, count)
            return
        done: SimpleQueue[BaseException | None] = SimpleQueue()
        for worker in range(first + 1, first + here):
            self._shares.put((kernel, args, worker, count, done))
        _do(kernel, args, first, count, done)
        try:
            while True:
                _do(*self._shares.get_nowait())
        except Empty:
            pass
        errors = [error for error in [done.get() for _ in range(here)] if error is not None]
        if errors:
            raise errors[0]


def _do(kernel, args, worker, count, done):
    """Do a share of a call, and tell the caller."""
    try:
        kernel(*args, worker, count)
    except BaseException as error:
        done.put(error)
    else:
        done.put(None)


def _work(shares):
    """Do what there is to do, until there is None."""
    while (share := shares.get()) is not None:
        _do(*share)
        del share  # an image that nobody else holds must not live until the next call


def _dismiss(shares, count):
    """Let the threads end."""
    for _ in range(count):
        shares.put(None)
