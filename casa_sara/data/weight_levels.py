"""Weights that fall into levels, with gaps between them where no weight is.

They are counted in tenths of a decade, so what is found depends neither on their order nor on how they are spread over
ranks.
"""

from __future__ import annotations

import math

import numpy as np

from casa_sara.parallel.serial import SERIAL, Serial
from casa_sara.runtime.scratch import slices

__all__ = ["APART", "gaps", "levels"]

APART = 100.0  # between weights of one level and those of the next
FEW = 0.01  # of the weights, which make no level
_TENTHS = 320  # of a decade, from 1 to the lightest, and to the heaviest


def gaps(weight: np.ndarray, factor: float, comm: Serial = SERIAL) -> tuple[np.ndarray, np.ndarray]:
    """Find where no weight is within a factor.

    Parameters
    ----------
    weight : real (M,)
        From 1e-31 to 1e31.
    factor : float
        Least ratio of a weight above a gap and one below it, to a tenth of a decade.
    comm : casa_sara.parallel.serial.Serial or MPI
        Over whose ranks the weights are spread.

    Returns
    -------
    middle : float64 (g,), increasing
    share : float64 (g,)
        Of the weights above each.
    """
    lightest, heaviest = -comm.largest(-weight.min(initial=np.inf)), comm.largest(weight.max(initial=0.0))
    if not heaviest > factor * lightest:
        return np.zeros(0), np.zeros(0)
    counts = comm.allreduce(sum(
        (np.bincount(np.floor(10 * np.log10(weight[some])).astype(int) + _TENTHS, minlength=2 * _TENTHS)
         for some in slices(0, weight.size)), np.zeros(2 * _TENTHS, np.int64)))
    held = np.flatnonzero(counts)
    below = np.flatnonzero(np.diff(held) > 10 * math.log10(factor))
    middle = 10 ** (((held[below] + held[below + 1] + 1) / 2 - _TENTHS) / 10)
    return middle, 1 - np.cumsum(counts)[held[below]] / counts.sum()


def levels(weight: np.ndarray, comm: Serial = SERIAL) -> tuple[np.ndarray, int]:
    """Return the level of each weight, int (M,), from the lightest on, and how many there are.

    Between levels there is a factor of 100 without weights; one that holds 1 % of them at most goes with the next.

    Parameters
    ----------
    weight : real (M,)
        From 1e-31 to 1e31.
    comm : casa_sara.parallel.serial.Serial or MPI
        Over whose ranks the weights are spread.

    Returns
    -------
    level : int (M,)
    count : int
    """
    middle, share = gaps(weight, APART, comm)
    middle = middle[(share > FEW) & (share < 1 - FEW)]
    return np.searchsorted(middle, weight), middle.size + 1
