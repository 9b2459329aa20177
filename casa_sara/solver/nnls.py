"""Non-negative least squares, which initialises the ℓ2 bounds (section 3 of the paper) and the model."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from casa_sara.solver import _kernels as kernels
from casa_sara.solver.interfaces import Measurement

__all__ = ["NNLS_ITERATIONS", "NNLSFit", "nnls"]

FIRST_PENALTY = 0.5  # of the brightest pixel of the first gradient step
NNLS_ITERATIONS = 80
FEWEST_ITERATIONS = 10  # even if there is no time
PATH = 0.75  # of the iterations, over which the penalty falls
STEP_NS, EXTRAPOLATE_NS = 2.0, 1.0  # of a pixel on one thread


@dataclass(frozen=True)
class NNLSFit:
    """How :func:`nnls` goes about it.

    Attributes
    ----------
    max_iter : int
        Number of iterations.
    last_penalty : float
        Where t ends, relative to where it starts; it stays there for the last quarter of the iterations.
    reltol : float
        Relative change of the image in one iteration that ends the fit earlier; 0 for never.
    positivity : bool
        x ≥ 0; else only the penalty, by soft thresholds.
    """

    max_iter: int = NNLS_ITERATIONS
    last_penalty: float = 1e-3
    reltol: float = 0.0
    positivity: bool = True


def nnls(measurement: Measurement, vis: np.ndarray, precond: np.ndarray, data_norm_sq: float,
         fit: NNLSFit = NNLSFit(), stopped: Callable[[], bool] = lambda: False,
         support: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Minimise ½‖U^½(y − Φx)‖² + t‖x‖₁ over x ≥ 0 while t falls to almost nothing.

    Non-negative least squares alone fills what the data do not see (the flux beyond the shortest baseline
    above all) with whatever the first steps leave there.  Reached from the sparse side, along a geometrically
    falling penalty t as in the continuation of ℓ1 solvers, the same fit starts from the brightest sources, as
    CLEAN does.  The preconditioner evens the spectrum of Φ†UΦ, so that tens of iterations of FISTA with
    adaptive restart are enough.

    Parameters
    ----------
    measurement : object
        `forward`, `adjoint`, `shape` and `workers`, as of :class:`casa_sara.solver.adaptive_ppd.AdaptivePPD`.
    vis : complex (M,)
        Whitened visibilities y.
    precond : real (M,)
        U > 0.
    data_norm_sq : float
        ‖U^½Φ‖².
    fit : NNLSFit
        Number of iterations, path of t, positivity.
    stopped : callable
        Asked after every iteration from the 10th on; True ends the fit with what there is: the brightest sources.
    support : bool (nx, ny), optional
        x = 0 elsewhere.

    Returns
    -------
    model : real (nx, ny)
    residual : complex (M,)
        y − Φx.

    References
    ----------
    FISTA: Beck & Teboulle 2009; restart: O'Donoghue & Candès 2015; continuation: Hale, Yin & Zhang 2008.
    """
    dtype = vis.real.dtype
    model, momentum = np.zeros(measurement.shape, dtype), np.zeros(measurement.shape, dtype)
    gradient, residual = np.zeros_like(model), np.zeros_like(vis)
    uphill = np.zeros(measurement.shape[0])
    step, t, first, run = dtype.type(1 / data_norm_sq), 1.0, None, measurement.workers.run
    for iteration in range(fit.max_iter):
        measurement.forward(momentum, residual)
        np.subtract(vis, residual, out=residual)
        residual *= precond
        measurement.adjoint(residual, gradient)
        if support is not None:
            gradient *= support  # from 0, without a gradient, no pixel leaves 0
        if first is None:
            first = FIRST_PENALTY * float(step) * float(max(gradient.max(), -gradient.min()))
        penalty = first * fit.last_penalty ** min(iteration / (PATH * fit.max_iter), 1.0) if fit.last_penalty else 0
        run(kernels.nnls_step, model, momentum, gradient, step, dtype.type(penalty), fit.positivity, uphill,
            work_ns=STEP_NS * model.size)
        # momentum that points uphill is dropped
        t = 1.0 if uphill.sum() > 0 else t
        t_next = 0.5 * (1 + np.sqrt(1 + 4 * t * t))
        settled = fit.reltol > 0 and np.linalg.norm(gradient - model) < fit.reltol * np.linalg.norm(gradient)
        run(kernels.extrapolate, model, momentum, gradient, dtype.type((t - 1) / t_next),
            work_ns=EXTRAPOLATE_NS * model.size)
        t = t_next
        if settled or stopped() and iteration + 1 >= FEWEST_ITERATIONS:
            break
    measurement.forward(model, residual)
    np.subtract(vis, residual, out=residual)
    return model, residual
