"""Errors of the antenna gains, fitted to what an image leaves of the visibilities.

A visibility that the image predicts as m is observed as (1 + g_p)(1 + g_q*)m, where antennas p and q have gain errors
g: to first order it leaves r = (g_p + g_q*)m.  With A_pq = Σ|m|²/σ² and B_pq = Σ rm*/σ² over the samples of a baseline
in one interval, in which the gains stay, least squares have for every antenna

    Σ_q A_pq (g_p + g_q*) = Σ_q B_pq,      that is (D + A) Re g = Re b,  (D − A) Im g = Im b,

with b = Σ_q B_pq, B_qp = B_pq*, and D the diagonal of Σ_q A_pq.  How large the errors are follows from χ² that these
gains explain, Re bᵀ(D + A)⁻¹Re b and Im bᵀ(D − A)⁻¹Im b: noise alone gives one for each parameter, and errors of
variance δ² give δ²·tr(D ± A) more.  The real parts are errors of amplitudes, the imaginary ones of phases, each with a
δ of its own.  Gains are then those of a prior of that variance, with 1/δ² on the diagonal.  The mean of an interval's
gains is zero: a phase that all antennas share is not seen, and an amplitude is the flux of the image.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from casa_sara.data.visibilities import Visibilities
from casa_sara.parallel.numbering import numbered
from casa_sara.parallel.serial import SERIAL, Serial

__all__ = ["AntennaGains", "GainErrors"]

SIGNIFICANT, RATIO = 5.0, 3.0  # from which on gain errors are believed
AT_ONCE = 500_000  # pairs of antennas, of all intervals that are solved together
SAMPLES_AT_ONCE = 1 << 20
MOST_PAIRS = 20_000_000  # of all intervals: shorter ones would take too long
TINY = 1e-6  # of the largest element of D: the ridge where there is no prior
STIFF = 1e6  # times that element: what keeps the mean gain of all antennas at zero


@dataclass
class GainErrors:
    """Gain errors that explain a residual.

    Attributes
    ----------
    interval : str
        How long a gain stays: 'scan' or 'integration'.
    significance : float
        By how many standard deviations the χ² that they explain exceeds what would be explained of anything else. The
        noise is that of what they leave of the baselines' means, where that is more than it should be.
    ratio : float
        χ² that they explain per parameter, over what they leave per degree of freedom (at least 1): about 1 where
        something else is wrong, as emission that the image lacks.
    amplitude, phase : float
        δ of the real parts, relative, and of the imaginary ones, rad.
    factors : complex (R,)
        g_p + g_q* of each row of the MeasurementSets.
    """

    interval: str
    significance: float
    ratio: float
    amplitude: float
    phase: float
    factors: np.ndarray

    @property
    def believed(self) -> bool:
        """Whether they explain more than noise and missing emission would."""
        return self.significance > SIGNIFICANT and self.ratio > RATIO

    @property
    def moved(self) -> float:
        """Rms of |g_p + g_q*|: which part of the model's visibilities such errors change."""
        return float(np.sqrt(2 * (self.amplitude**2 + self.phase**2)))


class AntennaGains:
    """The antennas and intervals of visibilities, whose gain errors can be fitted.

    Parameters
    ----------
    data : Visibilities
        `row` and `rows` are used.
    comm : casa_sara.parallel.serial.Serial or MPI
        Over whose ranks the samples are spread.
    """

    def __init__(self, data: Visibilities, comm: Serial = SERIAL) -> None:
        self._row, self._comm, rows = data.row, comm, data.rows
        count = rows.time.size
        antennas, number = numbered(_columns(np.tile(rows.ms, 2), np.concatenate([rows.antenna1, rows.antenna2])), comm)
        self._first, self._second, self._antennas = number[:count], number[count:], len(antennas)
        self._intervals = {}
        for name, more in (("scan", []), ("integration", [np.round(10 * rows.time).astype(np.int64)])):
            intervals, interval = numbered(_columns(rows.ms, rows.observation, rows.field, rows.spw, rows.scan, *more),
                                           comm)
            if name == "scan" or len(intervals) * self._antennas**2 <= MOST_PAIRS:
                self._intervals[name] = interval, len(intervals)

    def fit(self, predicted: np.ndarray, residual: np.ndarray) -> GainErrors:
        """Return the gain errors that explain a residual, for whichever interval explains more with its parameters.

        Parameters
        ----------
        predicted : complex (M,)
            m/σ of this rank.
        residual : complex (M,)
            r/σ.

        Returns
        -------
        GainErrors
        """
        sums = self._of_rows(predicted, residual)
        fits = [_Fit(name, *interval, self._ends, sums, self._comm) for name, interval in self._intervals.items()]
        return max(fits, key=lambda fit: fit.worth).errors()

    @property
    def _ends(self):
        return self._first, self._second, self._antennas

    def _of_rows(self, predicted, residual):
        """Σ|m|², Re Σrm* and Im Σrm* of every row, float (3, R)."""
        sums = np.zeros((3, self._first.size))
        for start in range(0, predicted.size, SAMPLES_AT_ONCE):
            part = slice(start, start + SAMPLES_AT_ONCE)
            m, row = predicted[part].astype(complex), self._row[part]
            product = residual[part] * m.conj()
            for total, values in zip(sums, (np.square(m.real) + np.square(m.imag), product.real, product.imag)):
                total += np.bincount(row, values, total.size)
        return sums


class _Fit:
    """The fit of one length of the intervals, summed over them a few at a time; real and imaginary parts apart."""

    def __init__(self, name, interval, number, ends, sums, comm):
        self.name, self._interval, self._number, self._ends = name, interval, number, ends
        self._sums, self._comm = sums, comm
        self._order = np.argsort(interval, kind="stable")
        self._starts = np.searchsorted(interval[self._order], np.arange(number + 1))
        self._explained, self._parameters = np.zeros(2), np.zeros(2)
        self._trace = self._all = self._means = 0.0
        for _, diagonal, weights, b, chi_sq, means in self._equations():
            ridge = TINY * diagonal.max(initial=0)
            gains = _solved(diagonal, weights, b, (ridge, ridge))
            self._explained += (gains.real * b.real).sum(), (gains.imag * b.imag).sum()
            active = np.count_nonzero(diagonal, axis=1)
            self._parameters += 2 * (np.maximum(active - 1, 0).sum(),)
            self._trace += diagonal.sum()
            self._all += chi_sq
            self._means += 2 * means

    @property
    def worth(self):
        """What the gains explain, less twice their number."""
        return float(self._explained.sum() - 2 * self._parameters.sum())

    def _equations(self):
        """Yield, of some intervals, their slice and D, A (float (t, n, n)), b (complex (t, n)), χ² and number of B."""
        first, second, n = self._ends
        step = max(1, AT_ONCE // n**2)
        for start in range(0, self._number, step):
            stop = min(start + step, self._number)
            rows = self._order[self._starts[start]:self._starts[stop]]
            rows = rows[first[rows] != second[rows]]
            index = ((self._interval[rows] - start) * n + first[rows]) * n + second[rows]
            # of no rows at all bincount makes integers
            power, real, imag = self._comm.allreduce(
                np.array([np.bincount(index, values[rows], (stop - start) * n * n) for values in self._sums], float))
            seen = power > 0
            chi_sq = float(((real[seen] ** 2 + imag[seen] ** 2) / power[seen]).sum())
            weights, products = (values.reshape(-1, n, n) for values in (power, real + 1j * imag))
            weights = weights + weights.transpose(0, 2, 1)
            b = products.sum(axis=2) + products.sum(axis=1).conj()
            yield slice(start, stop), weights.sum(axis=2), weights, b, chi_sq, np.count_nonzero(seen)

    def errors(self):
        """The gains for the variances that follow from what they explain."""
        explained, parameters = float(self._explained.sum()), float(self._parameters.sum())
        noise = max((self._all - explained) / max(self._means - parameters, 1), 1.0)
        significance = (explained / noise - parameters) / np.sqrt(2 * max(parameters, 1))
        variances = np.maximum(self._explained - self._parameters, 0) / max(self._trace, np.finfo(float).tiny)
        factors = np.zeros(self._interval.size, complex)
        ridges = tuple(1 / np.maximum(variances, np.finfo(np.float32).tiny))
        first, second, _ = self._ends
        for part, diagonal, weights, b, *_ in self._equations() if variances.any() else ():
            gains = _solved(diagonal, weights, b, ridges)
            rows = self._order[self._starts[part.start]:self._starts[part.stop]]
            mine = self._interval[rows] - part.start
            factors[rows] = gains[mine, first[rows]] + gains[mine, second[rows]].conj()
        ratio = explained / max(parameters * noise, 1)
        amplitude, phase = np.sqrt(variances).tolist()
        return GainErrors(self.name, float(significance), float(ratio), amplitude, phase, factors)


def _solved(diagonal, weights, b, ridges):
    """g of (D + A + ridge) Re g = Re b, (D − A + ridge) Im g = Im b, Σg = 0 in every interval; complex (t, n)."""
    eye, active = np.eye(diagonal.shape[1]), (diagonal > 0).astype(float)
    common = active[:, :, None] * active[:, None, :] * (STIFF * diagonal.max(axis=1, initial=0))[:, None, None]
    real, imag = (np.linalg.solve((diagonal + max(ridge, np.finfo(float).tiny))[:, :, None] * eye + sign * weights
                                  + common, part[:, :, None])[:, :, 0]
                  for sign, part, ridge in zip((1, -1), (b.real, b.imag), ridges))
    return real + 1j * imag


def _columns(*columns):
    """Return columns side by side, int64 (R, columns)."""
    return np.stack([np.asarray(column, np.int64) for column in columns], axis=1)
