"""Projection onto the data ellipsoids of Algorithm 1, Step 5."""

from __future__ import annotations

import numpy as np

from casa_sara.parallel.serial import SERIAL, Serial
from casa_sara.solver import _kernels as kernels

__all__ = ["ellipsoid_multiplier", "project_ellipsoid"]

TOLERANCE = 1e-10  # relative change of the multiplier that ends Newton's iteration


def ellipsoid_multiplier(dual: np.ndarray, phi_bar: np.ndarray, vis: np.ndarray, precond: np.ndarray, bound: float,
                         multiplier: float = 0.0, comm: Serial = SERIAL) -> float:
    """Lagrange multiplier of the projection onto one data ellipsoid.

    The projection of s = U⁻¹v + Φx̄ in the metric U onto {q : ‖q − y‖ ≤ ε} is

        q − y = U(s − y)/(U + λ),   with λ ≥ 0 the root of n = ‖q − y‖ = ε,

    and λ = 0 where s lies inside.  1/n is concave and increasing in λ, nearly a straight line, so
    Newton's iteration on 1/n − 1/ε converges from any start in a few steps.

    Parameters
    ----------
    dual, phi_bar, vis : complex (M,)
        v, Φx̄ and y of the block, whitened.
    precond : real (M,)
        U > 0.
    bound : float
        ε > 0 in whitened units.
    multiplier : float
        First guess, e.g. that of the iteration before.
    comm : casa_sara.parallel.serial.Serial or MPI
        Whose ranks hold the samples of the block.

    Returns
    -------
    float
        λ.

    Raises
    ------
    RuntimeError
        When the iteration does not settle, which only non-finite data can cause.
    """
    norm_sq, _ = _norms(comm, dual, phi_bar, vis, precond, 0.0)
    if norm_sq <= bound * bound:
        return 0.0
    value = float(multiplier)
    for _ in range(100):
        norm_sq, slope = _norms(comm, dual, phi_bar, vis, precond, value)
        norm = np.sqrt(norm_sq)
        # Newton on 1/n − 1/ε, whose derivative is −n'/n² = slope/n³
        new = max(value + (1 / bound - 1 / norm) * norm**3 / slope, 0.0)
        if abs(new - value) <= TOLERANCE * new:
            return new
        value = new
    raise RuntimeError("the projection onto a data ellipsoid did not converge: are the visibilities finite?")


def _norms(comm, *arguments):
    """n² and −½ d(n²)/dλ of the samples of all ranks."""
    norms = kernels.shifted_norms(*arguments)
    return norms if comm.size == 1 else comm.allreduce(np.array(norms)).tolist()


def project_ellipsoid(point: np.ndarray, centre: np.ndarray, precond: np.ndarray, bound: float) -> np.ndarray:
    """Projection of `point` in the metric U onto the ball {q : ‖q − centre‖ ≤ bound}.

    Parameters
    ----------
    point, centre : complex (M,)
        The point to project, and the centre of the ball.
    precond : real (M,)
        U > 0.
    bound : float
        Radius ε > 0.

    Returns
    -------
    complex (M,)
    """
    zero = np.zeros_like(centre)
    multiplier = ellipsoid_multiplier(zero, point, centre, precond, bound)
    return centre + (point - centre) * (precond / (precond + multiplier))
