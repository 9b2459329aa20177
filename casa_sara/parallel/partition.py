"""The division of the work among the ranks: who holds visibilities, and who computes which basis of the dictionary."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from casa_sara.parallel.serial import SERIAL, Serial

__all__ = ["ALONE", "RankAssignment"]


@dataclass(frozen=True)
class RankAssignment:
    """The division of the work among the ranks.

    Attributes
    ----------
    comm : casa_sara.parallel.serial.Serial or MPI
    readers : int
        How many ranks hold visibilities: rank 0 and others, evenly spaced.
    owners : tuple of int, optional
        The rank that each basis of the dictionary belongs to; all to this one where it is None.
    """

    comm: Serial = SERIAL
    readers: int = 1
    owners: tuple[int, ...] | None = None

    @property
    def share(self) -> float:
        """The share of the visibilities that is this rank's."""
        return 0.0 if self.reader(self.comm.rank) is None else 1 / self.readers

    def reader(self, rank: int) -> int | None:
        """Return the number of a rank among those that hold visibilities, None where it holds none."""
        number, rest = divmod(rank * self.readers, self.comm.size)
        return number if rest < self.readers else None

    def wavelets(self, names: tuple[str, ...]) -> tuple[str, ...]:
        """Return this rank's bases, of these."""
        return names if self.owners is None else tuple(name for name, rank in zip(names, self.owners)
                                                       if rank == self.comm.rank)

    def gather_bases(self, coefs: np.ndarray) -> np.ndarray | None:
        """Return the coefficients of all bases in their order, on rank 0; None on the others."""
        if self.owners is None:
            return coefs
        parts = self.comm.gather(coefs)
        if parts is None:
            return None
        whole = np.empty((len(self.owners), *coefs.shape[1:]), coefs.dtype)
        for rank, part in enumerate(parts):
            whole[np.equal(self.owners, rank)] = part
            parts[rank] = None
        return whole

    def scatter_bases(self, whole: np.ndarray | None) -> np.ndarray | None:
        """Return this rank's part of the coefficients of rank 0; the others give None."""
        if self.owners is None:
            return whole
        return self.comm.scatter(None if whole is None
                                 else [whole[np.equal(self.owners, r)] for r in range(self.comm.size)])


ALONE = RankAssignment()
