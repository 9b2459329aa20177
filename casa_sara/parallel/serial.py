"""The small communicator of one process; casa_sara/parallel/mpi.py has that of the ranks of an MPI job.

All that ranks say to each other goes through these two classes.  Their methods are called by every rank in the same
order; `Serial` does what numpy does, at no cost.
"""

from __future__ import annotations

from contextlib import contextmanager

import numpy as np

__all__ = ["SERIAL", "Serial"]


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

    rank, size, part, node_size = 0, 1, (0, 1), 1

    def allreduce(self, array):
        """Replace `array` by its sum over the ranks, and return it."""
        return array

    def iallreduce(self, array):
        """Begin :meth:`allreduce`, and return a function that waits for its end."""
        return lambda: array

    def total(self, number):
        """Return the sum of one number over the ranks."""
        return number

    def largest(self, number):
        """Return the largest of the ranks' numbers."""
        return number

    def mean(self, values, dtype=None):
        """Return the mean of the values of all ranks."""
        return np.mean(values, dtype=dtype)

    def median(self, values):
        """Return the median of the values ≥ 0 of all ranks, exactly."""
        return np.median(values)

    def norms(self, norms):
        """Return the norms of vectors of which the ranks hold the parts whose norms are given."""
        return norms

    def block_sums(self, values, offsets):
        """Return the sum of each block's values, (d,)."""
        return np.add.reduceat(values, offsets[:-1], dtype=float)

    def exscan(self, counts):
        """Return how many the ranks before this one have of each kind, and how many all have."""
        return np.zeros_like(counts), counts

    def bcast(self, value):
        """Return rank 0's value."""
        return value

    def bcast_numbers(self, values):
        """Return rank 0's values: a list of numbers, as many on every rank. It takes less time than :meth:`bcast`."""
        return values

    def allgather(self, value):
        """Return the list of the ranks' values, on every rank."""
        return [value]

    def alltoall(self, values):
        """Send values[r] to rank r; return what the ranks have sent to this one."""
        return values

    def gather(self, array):
        """Return the list of the ranks' arrays on rank 0, and None on the others."""
        return [array]

    def scatter(self, arrays):
        """Return arrays[r] of rank 0 on rank r; the others give None."""
        return arrays[0]

    def once(self, function, *arguments, **options):
        """Call the function on rank 0 alone; return what it returns, or raise what it raises, on every rank."""
        return function(*arguments, **options)

    def together(self, function, *arguments, **options):
        """Call the function, which speaks to no rank, on every rank; raise on all what it raises on one."""
        return function(*arguments, **options)

    def same_here(self, value):
        """Return how many ranks of this machine have the same value, with this one."""
        return 1

    def shared_images(self, count, shape, dtype):
        """Return zeroed images, which the ranks of one machine share: each writes its `part`, then all `settle`."""
        return [np.zeros(shape, dtype) for _ in range(count)]

    def shared_slots(self, shape, dtype):
        """Return an image for each rank, in memory that all ranks share; None where they do not."""

    def own(self, image):
        """Return an image of `images` as an array that only this rank writes to."""
        return image

    def barrier(self):
        """Wait until what the ranks of this machine have written can be read."""

    @contextmanager
    def guarded(self):
        """What one rank raises inside, all raise."""
        yield self


SERIAL = Serial()
