"""A sum of few plain transforms with factors on pixels and on samples.

What turns the plain transform V_m = Σ_p x_p exp(2πi(u_m l_p + v_m m_p)) into that of a wide field, or of a sky whose
spectrum changes from pixel to pixel, is a factor exp(z c_m s_p) on each term, with z = i or z = 1, a number c_m for
each sample and s_p in [−1, 1] for each pixel.  It is separated by the Chebyshev series (Jacobi and Anger)

    exp(i c s) = J_0(c) + 2 Σ_k i^k J_k(c) T_k(s),      exp(c s) = I_0(c) + 2 Σ_k I_k(c) T_k(s),

with J_k, I_k the Bessel functions and T_k the Chebyshev polynomials: no term is larger than 2 (or 2 I_k), nothing
cancels, and the images T_k(s)·x stay real.  About as many terms are needed as c has radians, and a few more.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.special import iv, jv

from casa_sara.operators._arguments import for_adjoint, for_forward
from casa_sara.runtime import jit

__all__ = ["ModulatedOperator", "bessel_factors", "terms_needed"]

CHUNK = 1 << 16  # samples whose Bessel functions are computed at a time
SMALL = 1e-6  # argument below which three orders are left
MOST = 400  # terms looked at


class ModulatedOperator:
    """r_m · Σ_k t^k B_km Φ(T_k(s)·x), with t = i where `turning` and 1 otherwise, and its adjoint.

    Nothing is allocated by calls with `out`. As of :class:`casa_sara.operators.measurement.MeasurementOperator`, one
    operator serves one thread at a time.

    Parameters
    ----------
    base : object
        The plain Φ: `forward`, `adjoint`, `shape`, `size`, `dtype`, `complex_dtype` and `workers`.
    place : real (nx, ny)
        s, of the base's dtype.
    factors : real (K, M)
        B, of the base's dtype.
    rotation : complex (M,), optional
        r, of the base's complex dtype; ones by default.
    turning : bool
    """

    def __init__(self, base: Any, place: np.ndarray, factors: np.ndarray, rotation: np.ndarray | None = None,
                 turning: bool = False) -> None:
        self.shape, self.size, self.dtype, self.complex_dtype = base.shape, base.size, base.dtype, base.complex_dtype
        self.workers = base.workers
        self._base, self._place, self._factors = base, place, factors
        self._rotation = np.empty(0, self.complex_dtype) if rotation is None else rotation
        self._turns = np.array([1j if turning else 1], self.complex_dtype) ** np.arange(len(factors))
        self._polynomial, self._previous, self._image = (np.empty(self.shape, self.dtype) for _ in range(3))
        self._vis = np.empty(self.size, self.complex_dtype)

    def forward(self, image: np.ndarray, out: np.ndarray | None = None) -> np.ndarray:
        """Return the visibilities, complex (M,), of a real image (nx, ny), in `out` where given.

        Parameters
        ----------
        image : real (nx, ny)
            The image.
        out : array, optional
            Receives the result.

        Returns
        -------
        complex (M,)
        """
        image, out = for_forward(self, image, out)
        run = self.workers.run
        for order, (turn, factor) in enumerate(zip(self._turns, self._factors)):
            run(_advance, order, self._place, self._polynomial, self._previous)
            run(_multiply, self._polynomial, image, self._image)
            self._base.forward(self._image, self._vis)
            run(add_term, order, turn, factor, self._vis, out)
        run(_rotate, self._rotation, out)
        return out

    def adjoint(self, vis: np.ndarray, out: np.ndarray | None = None) -> np.ndarray:
        """Return the real image (nx, ny), the adjoint for real inner products, of complex visibilities (M,).

        Parameters
        ----------
        vis : complex (M,)
            The visibilities.
        out : array, optional
            Receives the result.

        Returns
        -------
        real (nx, ny)
        """
        vis, out = for_adjoint(self, vis, out)
        run = self.workers.run
        for order, (turn, factor) in enumerate(zip(self._turns, self._factors)):
            run(take_term, np.conj(turn), factor, self._rotation, vis, self._vis)
            self._base.adjoint(self._vis, self._image)
            run(_advance, order, self._place, self._polynomial, self._previous)
            run(_add_product, order, self._polynomial, self._image, out)
        return out


def terms_needed(largest: float, eps: float, modified: bool = False) -> int:
    """Return the least number K of terms of exp(i c s), or exp(c s) if `modified`: the rest is < eps for |c| ≤ largest.

    Parameters
    ----------
    largest : float
        Largest |c|.
    eps : float
        Largest rest of the series.
    modified : bool
        Of exp(c s) instead of exp(i c s).

    Returns
    -------
    int
    """
    rest = 2 * (iv if modified else jv)(np.arange(MOST), largest)
    rest = np.cumsum(np.abs(rest)[::-1])[::-1]  # of the orders from k on
    return max(1, int(np.count_nonzero(rest > eps)))


def bessel_factors(argument: np.ndarray, count: int, modified: bool = False,
                   dtype: npt.DTypeLike = np.float32) -> np.ndarray:
    """Return (2 − δ_k0) J_k(c), or I_k(c) if `modified`, for the orders k < count.

    The two highest orders are summed from their power series, the others follow by recurrence downwards, which is
    stable.

    Parameters
    ----------
    argument : float64 (M,)
        c, at most about 20: the power series cancels beyond.
    count : int
        Number of terms.
    modified : bool
        Of exp(c s) instead of exp(i c s).
    dtype : float32 or float64
        Of the result.

    Returns
    -------
    real (count, M)
    """
    sign = 1.0 if modified else -1.0
    out = np.empty((count, argument.size), dtype)
    for start in range(0, argument.size, CHUNK):
        c = argument[start : start + CHUNK]
        small = np.abs(c) < SMALL
        c = np.where(small, SMALL, c)
        after, now = _power_series(count + 1, c, sign), _power_series(count, c, sign)
        for k in range(count, 0, -1):
            after, now = now, 2 * k / c * now + sign * after
            out[k - 1, start : start + c.size] = now * (2 if k > 1 else 1)
        if small.any():
            few = np.array([np.ones(c.size), argument[start : start + CHUNK], argument[start : start + CHUNK] ** 2 / 4])
            rows = out[:, start : start + c.size]
            rows[:3, small] = few[: min(count, 3), small]
    return out


def _power_series(order, c, sign):
    """Σ_j (±1)^j (c/2)^(2j + order) / (j! (j + order)!)."""
    term = np.ones_like(c)
    for factor in range(1, order + 1):
        term *= c / (2 * factor)
    total, square = term.copy(), sign * np.square(c) / 4
    for j in range(1, MOST):
        term = term * square / (j * (j + order))
        total += term
        if np.all(np.abs(term) <= 1e-17 * np.abs(total)):
            break
    return total


_jit = jit.kernel(fastmath={"contract"})


@_jit
def _advance(order, place, polynomial, previous, worker, workers):
    """From T_{k−1}, T_{k−2} to T_k, T_{k−1} for k = order; T_{−1} = T_1."""
    for i in range(len(place) * worker // workers, len(place) * (worker + 1) // workers):
        if order == 0:
            for j in range(place.shape[1]):
                polynomial[i, j] = 1
                previous[i, j] = place[i, j]
        else:
            for j in range(place.shape[1]):
                now = polynomial[i, j]
                polynomial[i, j] = (place[i, j] + place[i, j]) * now - previous[i, j]
                previous[i, j] = now


@_jit
def _multiply(polynomial, image, out, worker, workers):
    for i in range(len(image) * worker // workers, len(image) * (worker + 1) // workers):
        for j in range(image.shape[1]):
            out[i, j] = polynomial[i, j] * image[i, j]


@_jit
def _add_product(order, polynomial, image, out, worker, workers):
    """out += T_k·image, or = for the first."""
    for i in range(len(image) * worker // workers, len(image) * (worker + 1) // workers):
        for j in range(image.shape[1]):
            out[i, j] = image[i, j] if order == 0 else out[i, j] + polynomial[i, j] * image[i, j]


@_jit
def add_term(order, turn, factor, vis, out, worker, workers):
    """out += t^k B_k·vis, or = for the first.

    Parameters
    ----------
    order : int
        k.
    turn : complex
        t^k.
    factor : real (M,)
        B_k.
    vis : complex (M,)
        One transform.
    out : complex (M,)
        The sum so far.
    worker, workers : int
        Number of this thread, and of all.
    """
    for m in range(vis.size * worker // workers, vis.size * (worker + 1) // workers):
        term = turn * (factor[m] * vis[m])
        out[m] = term if order == 0 else out[m] + term


@_jit
def take_term(turn, factor, rotation, vis, out, worker, workers):
    """Adjoint of `add_term` and `_rotate`.

    Parameters
    ----------
    turn : complex
        The conjugate of t^k.
    factor : real (M,)
        B_k.
    rotation : complex (M,) or (0,)
        r; of no samples for ones.
    vis : complex (M,)
        The visibilities.
    out : complex (M,)
        Receives what one transform takes of them.
    worker, workers : int
        Number of this thread, and of all.
    """
    for m in range(vis.size * worker // workers, vis.size * (worker + 1) // workers):
        value = turn * (factor[m] * vis[m])
        out[m] = value * np.conj(rotation[m]) if rotation.size else value


@_jit
def _rotate(rotation, out, worker, workers):
    for m in range(rotation.size * worker // workers, rotation.size * (worker + 1) // workers):
        out[m] *= rotation[m]
