"""The small communicator of one process; casa_sara/parallel/mpi.py has that of the ranks of an MPI job.

All that ranks say to each other goes through these two classes.  Their methods are called by every rank in the same
order; `Serial` does what numpy does, at no cost.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt

__all__ = ["SERIAL", "Serial"]

T = TypeVar("T")
Number = TypeVar("Number", int, float)


class Serial:
    """One process.

    Attributes
    ----------
    rank, size : int
        Number of this process, and of all.
    part : (int, int)
        This process's share of the work on images that `images` has made: number and count.
    node_size : int
        How many ranks share the memory of this machine.
    """

    rank: int = 0
    size: int = 1
    part: tuple[int, int] = (0, 1)
    node_size: int = 1

    def allreduce(self, array: np.ndarray) -> np.ndarray:
        """Replace `array` by its sum over the ranks, and return it."""
        return array

    def iallreduce(self, array: np.ndarray) -> Callable[[], np.ndarray]:
        """Begin :meth:`allreduce`, and return a function that waits for its end."""
        return lambda: array

    def total(self, number: Number) -> Number:
        """Return the sum of one number over the ranks."""
        return number

    def largest(self, number: Number) -> Number:
        """Return the largest of the ranks' numbers."""
        return number

    def mean(self, values: np.ndarray, dtype: npt.DTypeLike | None = None) -> Any:
        """Return the mean of the values of all ranks."""
        return np.mean(values, dtype=dtype)

    def median(self, values: np.ndarray) -> Any:
        """Return the median of the values ≥ 0 of all ranks, exactly."""
        return np.median(values)

    def norms(self, norms: np.ndarray) -> np.ndarray:
        """Return the norms of vectors of which the ranks hold the parts whose norms are given."""
        return norms

    def block_sums(self, values: np.ndarray, offsets: np.ndarray) -> np.ndarray:
        """Return the sum of each block's values, (d,)."""
        return np.add.reduceat(values, offsets[:-1], dtype=float)

    def exscan(self, counts: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return how many the ranks before this one have of each kind, and how many all have."""
        return np.zeros_like(counts), counts

    def bcast(self, value: T) -> T:
        """Return rank 0's value."""
        return value

    def bcast_numbers(self, values: list[float]) -> list[float]:
        """Return rank 0's values: a list of numbers, as many on every rank. It takes less time than :meth:`bcast`."""
        return values

    def allgather(self, value: T) -> list[T]:
        """Return the list of the ranks' values, on every rank."""
        return [value]

    def alltoall(self, values: list[T]) -> list[T]:
        """Send values[r] to rank r; return what the ranks have sent to this one."""
        return values

    def gather(self, array: np.ndarray) -> list[Any] | None:
        """Return the list of the ranks' arrays on rank 0, and None on the others."""
        return [array]

    def scatter(self, arrays: list[np.ndarray] | None) -> np.ndarray:
        """Return arrays[r] of rank 0 on rank r; the others give None."""
        assert arrays is not None  # they are rank 0's
        return arrays[0]

    def once(self, function: Callable[..., T], *arguments: Any, **options: Any) -> T:
        """Call the function on rank 0 alone; return what it returns, or raise what it raises, on every rank."""
        return function(*arguments, **options)

    def together(self, function: Callable[..., T], *arguments: Any, **options: Any) -> T:
        """Call the function, which speaks to no rank, on every rank; raise on all what it raises on one."""
        return function(*arguments, **options)

    def same_here(self, value: object) -> int:
        """Return how many ranks of this machine have the same value, with this one."""
        return 1

    def shared_images(self, count: int, shape: tuple[int, ...], dtype: npt.DTypeLike) -> list[np.ndarray]:
        """Return zeroed images, which the ranks of one machine share: each writes its `part`, then all `settle`."""
        return [np.zeros(shape, dtype) for _ in range(count)]

    def shared_slots(self, shape: tuple[int, ...], dtype: npt.DTypeLike) -> list[np.ndarray] | None:
        """Return an image for each rank, in memory that all ranks share; None where they do not."""
        return None

    def own(self, image: np.ndarray) -> np.ndarray:
        """Return an image of `images` as an array that only this rank writes to."""
        return image

    def ask_stop(self, code: int) -> None:
        """Ask the other ranks to stop, each at its next :meth:`stop_asked`; `code`, not 0, says why."""

    def stop_asked(self) -> int:
        """Return the code with which another rank has asked to stop, else 0; raise what another rank has raised."""
        return 0

    def meet(self, meanwhile: Callable[[], Any]) -> None:
        """Wait until all ranks are here, and call `meanwhile` again and again until then."""

    def barrier(self) -> None:
        """Wait until what the ranks of this machine have written can be read."""

    @contextmanager
    def guarded(self) -> Iterator[Serial]:
        """What one rank raises inside, all raise."""
        yield self


SERIAL = Serial()
