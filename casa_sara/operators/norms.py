"""Squared norms of operators."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import numpy.typing as npt
from scipy.linalg import eigh_tridiagonal

__all__ = ["power_method"]


def power_method(apply: Callable[[np.ndarray], np.ndarray], shape: tuple[int, ...], dtype: npt.DTypeLike = np.float64,
                 tol: float = 0.01, max_iter: int = 200, seed: int = 0) -> float:
    """Return ‖A‖², from above, given `apply`, which maps an image x to A†A x.

    Lanczos iterations, which need a fraction of the calls of plain powers.  θ, the largest eigenvalue of A†A on the
    Krylov space of a random image, grows towards ‖A‖², and an eigenvalue lies within the residual norm r of it.
    Once r ≤ tol·θ and θ has settled, (1 + tol)·θ bounds ‖A‖² unless the random image lacks the leading eigenvector;
    therefore the larger bound from two images is returned.  It is too high by at most a factor 1 + tol.

    Parameters
    ----------
    apply : callable
        (nx, ny) → (nx, ny), symmetric and positive semi-definite.
    shape : tuple of int
        Of the images.
    dtype : float32 or float64
        Of the images.
    tol : float
        Relative accuracy.
    max_iter : int
        Most calls of `apply` for each random image.
    seed : int
        Of the random images.

    Returns
    -------
    float
        ‖A‖², at most a factor 1 + tol too high.

    Raises
    ------
    RuntimeError
        When `max_iter` calls do not reach `tol`, or `apply` returns values that are not finite.
    """
    rng = np.random.default_rng(seed)
    return max(_lanczos(apply, rng.standard_normal(shape).astype(dtype), tol, max_iter) for _ in range(2))


def _lanczos(apply, vector, tol, max_iter):
    """(1 + tol)·θ from one starting image."""
    vector /= np.linalg.norm(vector)
    previous = np.zeros_like(vector)
    diagonal: list[float] = []
    off_diagonal: list[float] = []
    theta, beta = 0.0, 0.0
    for last in range(max_iter):
        image = apply(vector) - vector.dtype.type(beta) * previous
        diagonal.append(np.vdot(vector, image))
        image -= diagonal[-1] * vector
        beta = float(np.linalg.norm(image))
        if not np.isfinite(beta):
            raise RuntimeError("the operator returned values that are not finite")
        values, vectors = eigh_tridiagonal(diagonal, off_diagonal, select="i", select_range=(last, last))
        theta, change = values[0], values[0] - theta
        residual = beta * abs(vectors[-1, 0])
        if beta == 0 or residual <= tol * theta and change <= 0.1 * tol * theta:
            return float((1 + tol) * theta)
        off_diagonal.append(beta)
        previous, vector = vector, image / vector.dtype.type(beta)
    raise RuntimeError(f"the norm of the operator is not known to {tol:g} after {max_iter} iterations")
