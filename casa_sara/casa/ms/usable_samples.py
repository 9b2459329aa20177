"""Which samples of a MeasurementSet are usable, and the reasons why the others are not.

Most is seen of a sample by itself, while it is read. What is out of proportion to the others is told when all have been
read, from what does not depend on their order: it is the same in whatever pieces they are read, and however they are
divided among MeasurementSets and ranks.
"""

from __future__ import annotations

import numpy as np

from casa_sara.data.weight_levels import gaps
from casa_sara.parallel.serial import SERIAL

__all__ = ["IN_FLAGS", "SMALLEST", "Usability"]

IN_FLAGS = ("autocorrelation", "flagged row", "flagged")  # reasons that the flags of the MeasurementSet give
SMALLEST, LARGEST = 1e-18, 1e18  # of √w·|V|: its square is a number in single precision
LIGHTEST, HEAVIEST = 1e-30, 1e30  # of the weights, in 1/Jy²
SUREST = 1e9  # √w·|V| beyond what any receiver measures
ABOVE_OTHERS = 1e6  # times what others have: no sky and no receiver
# of the samples, whose weights others outvote: in any case, and where one antenna has them all
FEW, MINORITY = 0.01, 0.5
LONGEST_M = 1e9  # of baselines: between antennas on the Earth and in orbit around it


class Usability:
    """What was left out so far, by the first reason that applies.

    Attributes
    ----------
    dropped : dict
        Reason → number of samples.
    strongest : float
        Largest √w·|V| of one correlation among the samples that can be used.
    alone : dict
        Correlation → number of samples that are of it alone, because the other one has no weight.
    """

    def __init__(self):
        self.dropped = {}
        self.alone = {}
        self.strongest = 0.0

    def __call__(self, chunk):
        """Return which samples to keep of R rows and C channels, bool (R, C), and count the others.

        Beside flags, cells that are not there and numbers that are none, these are left out: weights and data beyond
        single precision; baselines of length 0 between two antennas, which nobody filled in, and of more than 1e9 m.

        A correlation has no weight where its weight is not a number, 0, negative or below 1e-30 /Jy². Where the other
        one is enough, as for Stokes I, it has none either below 1e-6 of the other's, and what it holds there does not
        matter.

        Returns
        -------
        ok : bool (R, C)
        weighted : list of bool (R, C)
            For each correlation, where it has a weight.
        """
        ok = np.ones(chunk.flag.shape, dtype=bool)
        weighted = _weighted(chunk)
        formed = np.any(weighted, axis=0) if chunk.either else np.all(weighted, axis=0)
        weights = chunk.weight if chunk.weighing is chunk.weight else [*chunk.weight, *chunk.weighing]
        finite = np.all([np.isfinite(vis) | ~there for vis, there in zip(chunk.vis, weighted)], axis=0)
        self._leave_out(ok, "autocorrelation", (chunk.columns["antenna1"] == chunk.columns["antenna2"])[:, None])
        self._leave_out(ok, "flagged row", chunk.flag_row[:, None])
        for column, rows in chunk.undefined.items():
            self._leave_out(ok, f"undefined {column}", rows[:, None])
        self._leave_out(ok, "flagged", chunk.flag)
        self._leave_out(ok, "non-finite data", ~finite)
        self._leave_out(ok, "non-finite weight", np.any([np.isinf(hand) for hand in weights], axis=0))
        self._leave_out(ok, "non-finite weight", ~formed & np.any([np.isnan(hand) for hand in chunk.weight], axis=0))
        self._leave_out(ok, "non-positive weight", ~formed & np.any([hand <= 0 for hand in chunk.weight], axis=0))
        self._leave_out(ok, "non-finite uvw", ~np.isfinite(chunk.uvw_m).all(axis=0)[:, None])
        self._leave_out(ok, "impossible uvw", _is_impossible(chunk.uvw_m)[:, None])
        self._leave_out(ok, "impossible weight", ~formed | np.any([hand > HEAVIEST for hand in weights], axis=0))
        strength = [_strength(vis, weight, ok & there) for vis, weight, there in zip(chunk.vis, chunk.weight, weighted)]
        self._leave_out(ok, "impossible data", np.any([hand > LARGEST for hand in strength], axis=0))
        self.strongest = max([self.strongest, *(hand.max(where=ok, initial=0.0) for hand in strength)])
        return ok, weighted

    def compare(self, data, comm=SERIAL):
        """Return which samples can be used, bool (M,), and count the others: weights and data far above the rest.

        Weights tell what is to be believed. They are wrong where they stand out by a gap, a factor of 1e6 without any
        between, and where those above it are too few to be an observation: 1 % of the samples at most, or fewer than
        half and all of one antenna, unless the whole selection has it. More than these are believed, and what lies
        below such a gap, which hardly counts in an image, has no say in the following.

        Data are wrong above 1e9 times their noise and 1e6 times the median of √w·|V|.

        Parameters
        ----------
        data : Visibilities
            All that has been read.
        comm : casa_sara.parallel.serial.Serial or MPI
            Over whose ranks they are spread.
        """
        ok = np.ones(data.size, bool)
        weight = np.maximum(data.weight, data.imaging_weight)
        lowest, highest = _range_of_weights(weight, data, comm)
        self._leave_out(ok, "impossible weight", weight > highest)
        if comm.largest(self.strongest) > SUREST:
            strength = _strength(data.vis, data.weight, ok)
            median = comm.median(strength[ok & (weight > lowest)])
            self._leave_out(ok, "impossible data", strength > max(SUREST, ABOVE_OTHERS * median))
            self.strongest = strength.max(where=ok, initial=0.0)
        return ok

    def count_alone(self, counts):
        """Count pairs of a correlation and the number of samples that are of it alone."""
        self.alone = _total([self.alone, *({name: count} for name, count in counts if count)])

    def merge(self, comm):
        """Add up the counts of all ranks of a communicator."""
        self.dropped, self.alone = map(_total, zip(*comm.allgather((self.dropped, self.alone))))
        self.strongest = comm.largest(self.strongest)

    def _leave_out(self, ok, reason, bad):
        """Take `bad` samples out of `ok` and count them."""
        count = int(np.count_nonzero(ok & bad))
        if count:
            self.dropped[reason] = self.dropped.get(reason, 0) + count
            ok &= ~bad


def _total(counts):
    """Add up dicts of numbers."""
    return {name: sum(one.get(name, 0) for one in counts) for one in counts for name in one}


def _is_impossible(uvw_m):
    """Whether baselines (3, R) have no length, or one that none has; bool (R,)."""
    longest = np.abs(uvw_m).max(axis=0)
    return (longest == 0) | (longest > LONGEST_M)


def _weighted(chunk):
    """Return where each correlation has a weight, a list of bool (R, C)."""
    least = LIGHTEST
    if chunk.either:
        least = np.maximum(np.fmax(*chunk.weight) / ABOVE_OTHERS, LIGHTEST)
    return [hand >= least for hand in chunk.weight]


def _range_of_weights(weight, data, comm):
    """Return the weight above which samples count for the statistics, and the one above which they are impossible."""
    lowest = 0.0
    for middle, share in zip(*gaps(weight, ABOVE_OTHERS, comm)):
        if share <= FEW or share < MINORITY and _share_an_antenna(data, weight > middle, comm):
            return lowest, middle
        lowest = middle
    return lowest, np.inf


def _share_an_antenna(data, chosen, comm):
    """Return whether the chosen samples, bool (M,), are all of one antenna that others are not of."""
    rows = data.rows
    antennas = np.stack([rows.antenna1, rows.antenna2])
    size = 1 + comm.largest(int(antennas.max(initial=0)))

    def common(some):
        return comm.allreduce(np.bincount(antennas[:, some].ravel(), minlength=size)) == comm.total(some.size)

    return bool(np.any(common(np.unique(data.row[chosen])) & ~common(np.arange(rows.row.size))))


def _strength(vis, weight, ok):
    """√w·|V|, float64, 0 where the sample is not `ok`."""
    strength = np.zeros(ok.shape)
    np.sqrt(weight, out=strength, where=ok)
    return np.multiply(strength, np.hypot(vis.real, vis.imag, where=ok, out=np.zeros(ok.shape)), out=strength, where=ok)
