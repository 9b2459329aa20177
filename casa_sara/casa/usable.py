"""Which samples of a MeasurementSet can be used, and for what reason the others cannot."""

from __future__ import annotations

import numpy as np

__all__ = ["IN_FLAGS", "SMALLEST", "Usability"]

IN_FLAGS = ("autocorrelation", "flagged row", "flagged")  # what the MeasurementSet itself says of a sample
SMALLEST, LARGEST = 1e-18, 1e18  # of √w·|V|: its square is a number in single precision
LIGHTEST, HEAVIEST = 1e-30, 1e30  # of the weights, in 1/Jy²
SUREST = 1e9  # √w·|V| beyond what any receiver measures
ABOVE_OTHERS = 1e6  # times the median of the same rows and channels: no sky and no receiver
LONGEST_M = 1e9  # of baselines: between antennas on the Earth and in orbit around it


class Usability:
    """What was left out so far, by the first reason that applies.

    Attributes
    ----------
    dropped : dict
        Reason → number of samples.
    strongest : float
        Largest √w·|V| of one correlation among the samples that can be used.
    """

    def __init__(self):
        self.dropped = {}
        self.strongest = 0.0

    def __call__(self, chunk):
        """Return the bool (R, C) of samples to keep of R rows and C channels, and count the others.

        Beside flags, cells that are not there and numbers that are none, these are left out: weights beyond single
        precision or 1e6 times the
        median; data beyond single precision, or 1e9 times their noise and 1e6 times the median (in units of the
        noise); baselines of length 0 between two antennas, which nobody filled in, and of more than 1e9 m.
        """
        ok = np.ones(chunk.flag.shape, dtype=bool)
        weights = chunk.weight if chunk.parallel is chunk.weight else [*chunk.weight, *chunk.parallel]
        self._leave_out(ok, "autocorrelation", (chunk.columns["antenna1"] == chunk.columns["antenna2"])[:, None])
        self._leave_out(ok, "flagged row", chunk.flag_row[:, None])
        for column, rows in chunk.undefined.items():
            self._leave_out(ok, f"undefined {column}", rows[:, None])
        self._leave_out(ok, "flagged", chunk.flag)
        self._leave_out(ok, "non-finite data", ~np.all([np.isfinite(hand) for hand in chunk.vis], axis=0))
        self._leave_out(ok, "non-finite weight", ~np.all([np.isfinite(hand) for hand in weights], axis=0))
        self._leave_out(ok, "non-positive weight", np.any([hand <= 0 for hand in weights], axis=0))
        self._leave_out(ok, "non-finite uvw", ~np.isfinite(chunk.uvw_m).all(axis=0)[:, None])
        self._leave_out(ok, "impossible uvw", _is_impossible(chunk.uvw_m)[:, None])
        self._leave_out(ok, "impossible weight", _is_wild_weight(weights, ok))
        strength = [_strength(vis, weight, ok) for vis, weight in zip(chunk.vis, chunk.weight)]
        self._leave_out(ok, "impossible data", _is_wild_data(strength, ok))
        self.strongest = max([self.strongest, *(hand.max(where=ok, initial=0.0) for hand in strength)])
        return ok

    def merge(self, comm):
        """Add up what all ranks of a communicator have left out."""
        every = comm.gather(self.dropped)
        self.dropped = {reason: sum(one.get(reason, 0) for one in every) for one in every for reason in one}
        self.strongest = comm.largest(self.strongest)

    def _leave_out(self, ok, reason, bad):
        """Take `bad` samples out of `ok` and count them."""
        count = int(np.count_nonzero(ok & bad))
        if count:
            self.dropped[reason] = self.dropped.get(reason, 0) + count
            ok &= ~bad


def _is_impossible(uvw_m):
    """Whether baselines (3, R) have no length, or one that none has; bool (R,)."""
    longest = np.abs(uvw_m).max(axis=0)
    return (longest == 0) | (longest > LONGEST_M)


def _is_wild_weight(weights, ok):
    """Whether a weight is beyond single precision, or far above the others; bool (R, C)."""
    bad = np.zeros(ok.shape, bool)
    for hand in weights:
        bad |= (hand < LIGHTEST) | (hand > HEAVIEST)
        if hand.max(where=ok & ~bad, initial=0.0) > ABOVE_OTHERS * hand.min(where=ok & ~bad, initial=np.inf):
            bad |= hand > ABOVE_OTHERS * np.median(hand[ok & ~bad])
    return bad


def _strength(vis, weight, ok):
    """√w·|V|, float64 (R, C), 0 where the sample is not `ok`."""
    strength = np.zeros(ok.shape)
    np.sqrt(weight, out=strength, where=ok)
    np.multiply(strength, np.hypot(vis.real, vis.imag, where=ok, out=np.zeros(ok.shape)), out=strength, where=ok)
    return strength


def _is_wild_data(strength, ok):
    """Whether a visibility is beyond single precision, or far above its noise and the others; bool (R, C)."""
    bad = np.zeros(ok.shape, bool)
    for hand in strength:
        bad |= hand > LARGEST
        if hand.max() > SUREST:
            bad |= hand > max(SUREST, ABOVE_OTHERS * np.median(hand[ok]))
    return bad
