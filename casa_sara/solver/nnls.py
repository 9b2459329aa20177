"""Non-negative least squares, which initialises the ℓ2 bounds (section 3 of the paper)."""

from __future__ import annotations

import numpy as np

__all__ = ["nnls"]


def nnls(measurement, vis, precond, data_norm_sq, tol=5e-3, max_iter=60, positivity=True):
    """Minimise ½‖U^½(y − Φx)‖² over x ≥ 0 by FISTA with adaptive restart.

    The preconditioner evens the spectrum of Φ†UΦ, so that tens of iterations reach what takes hundreds without.

    Parameters
    ----------
    measurement : object
        `forward`, `adjoint`, `shape`.
    vis : complex (M,)
    precond : real (M,)
    data_norm_sq : float
        ‖U^½Φ‖².
    tol : float
        Stops at this relative change of the image.
    max_iter : int

    Returns
    -------
    model : real (nx, ny)
    residual : complex (M,)
        y − Φx.

    References
    ----------
    Beck & Teboulle 2009; restart of O'Donoghue & Candès 2015.
    """
    dtype = vis.real.dtype
    model, momentum = np.zeros(measurement.shape, dtype), np.zeros(measurement.shape, dtype)
    gradient, residual = np.zeros_like(model), np.zeros_like(vis)
    step, t = dtype.type(1 / data_norm_sq), 1.0
    for _ in range(max_iter):
        measurement.forward(momentum, residual)
        np.subtract(vis, residual, out=residual)
        residual *= precond
        measurement.adjoint(residual, gradient)
        new = momentum + step * gradient
        if positivity:
            np.maximum(new, 0, out=new)
        difference = new - model
        # momentum that points uphill is dropped
        t = 1.0 if np.vdot(momentum - new, difference) > 0 else t
        t_next = 0.5 * (1 + np.sqrt(1 + 4 * t * t))
        momentum = new + dtype.type((t - 1) / t_next) * difference
        model, t = new, t_next
        if np.linalg.norm(difference) <= tol * np.linalg.norm(new):
            break
    measurement.forward(model, residual)
    np.subtract(vis, residual, out=residual)
    return model, residual
