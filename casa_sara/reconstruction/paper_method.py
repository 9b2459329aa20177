"""The differences of ``method='dabbech2018'`` from the usual reconstruction before the first iteration."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from casa_sara.operators.dictionary import SaraDictionary
from casa_sara.operators.norms import power_method
from casa_sara.options import SolverOptions
from casa_sara.reconstruction.problem import Problem, Samples
from casa_sara.solver.adaptive_ppd import AdaptivePPD
from casa_sara.solver.dabbech2018 import PaperBounds, PaperSchedule
from casa_sara.solver.interfaces import Measurement
from casa_sara.solver.l2_bounds import chi_square_bounds
from casa_sara.solver.nnls import NNLSFit, nnls
from casa_sara.solver.paperprior import RELAXATION, PaperPrior

__all__ = ["PAPER", "block_norms", "first_threshold", "paper_bounds", "paper_iteration", "paper_prior"]

PAPER = "dabbech2018"  # the value of the task parameter `method`
ROUNDING = 1e-5  # of ‖y_j‖: no first bound is less, in single precision


def block_norms(problem: Problem, problem_of: Callable[..., Problem], options: SolverOptions,
                stopped: Callable[[], bool]) -> np.ndarray:
    """Norms μ_j^NNLS that non-negative least squares leaves of every block alone (section 3): the first bounds.

    x̃_j = argmin ‖y_j − Φ_j x‖² over x ≥ 0 is fitted without preconditioner, which would change what is least.

    Parameters
    ----------
    problem : Problem
        Of all samples.
    problem_of : callable
        Makes the `Problem` of samples, with `options`.
    options : SolverOptions
        Task parameters of the method.
    stopped : callable
        Ends each fit early when it returns True.

    Returns
    -------
    float (d,)
    """
    schedule, samples, norms = PaperSchedule.of(options), problem.samples, []
    fit = NNLSFit(schedule.nnls_iterations, 0.0, schedule.nnls_reltol, options.positivity)
    plain = replace(options, precondition=False)
    for start, stop in zip(samples.offsets[:-1], samples.offsets[1:]):
        if start == stop:
            norms.append(0.0)
            continue
        chosen = np.arange(start, stop)
        alone = Samples(samples.data.take(chosen), np.array([0, stop - start]), samples.density[chosen])
        block = problem_of(alone, options=plain)
        _, residual = nnls(block.measurement, block.vis, block.precond, block.data_norm_sq, fit, stopped,
                           block.support)
        norms.append(float(np.linalg.norm(residual)))
    return np.array(norms)


def paper_prior(dictionary: SaraDictionary, measurement: Measurement) -> PaperPrior:
    """The prior of the paper on a dictionary.

    Parameters
    ----------
    dictionary : SaraDictionary
        Ψ.
    measurement : Measurement
        Whose threads are used.

    Returns
    -------
    PaperPrior
    """
    return PaperPrior(dictionary, measurement.workers, power_method)


def paper_iteration(problem: Problem, dictionary: SaraDictionary, data_norm_sq: float,
                    positivity: bool) -> AdaptivePPD:
    """Algorithm 1 for a problem, its prior and steps as in the paper.

    Parameters
    ----------
    problem : Problem
        Data and operators.
    dictionary : SaraDictionary
        Ψ.
    data_norm_sq : float
        ‖U^½Φ‖².
    positivity : bool
        x ≥ 0, or only real.

    Returns
    -------
    AdaptivePPD
    """
    prior = paper_prior(dictionary, problem.measurement)
    return AdaptivePPD(problem.measurement, prior, problem.vis, problem.samples.offsets, problem.precond, data_norm_sq,
                       positivity, RELAXATION)


def paper_bounds(ppd: AdaptivePPD, nnls_norms: np.ndarray, weight_sums: np.ndarray,
                 options: SolverOptions) -> PaperBounds:
    """The bounds: adaptive, from NNLS; or fixed, from the MS weights or l2bound, for known noise (section 3).

    Parameters
    ----------
    ppd : AdaptivePPD
        The iteration, whose model is looked at.
    nnls_norms : float (d,)
        μ_j^NNLS.
    weight_sums : float (d,)
        Sum of the weights of each block, in the unit of the model.
    options : SolverOptions
        Task parameters of the method.

    Returns
    -------
    PaperBounds
    """
    samples, adapts = ppd.block_sizes, options.databound == "adapt"
    if adapts:
        start = np.maximum(nnls_norms, ROUNDING * ppd.residual_norms)
    else:
        noise = np.broadcast_to(1.0 if options.databound == "weights" else options.l2bound, samples.shape)
        start = chi_square_bounds(samples, noise)
    return PaperBounds(start, samples, weight_sums, adapts)


def first_threshold(options: SolverOptions, first: np.ndarray) -> float:
    """κ in the unit of an image: a fraction of the brightest pixel of the first, (nx, ny).

    Parameters
    ----------
    options : SolverOptions
        Task parameters of the method.
    first : real (nx, ny)
        The image of the search for wild samples.

    Returns
    -------
    float
    """
    return PaperSchedule.of(options).kappa * (float(np.abs(first).max()) or 1.0)
