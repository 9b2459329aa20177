"""What the task parameters mean for the solver: schedule, bounds, accuracy of the operator."""

from __future__ import annotations

import numpy as np

from casa_sara.data.visibilities import Visibilities
from casa_sara.operators.measurement import SMALLEST_EPS, choose_eps, eps_of
from casa_sara.options import SolverOptions
from casa_sara.parallel.serial import SERIAL, Serial
from casa_sara.reconstruction.paper_method import PAPER, paper_bounds
from casa_sara.reconstruction.problem import DYNAMIC_RANGE
from casa_sara.solver.adaptive_ppd import AdaptivePPD
from casa_sara.solver.dabbech2018 import PaperBounds, PaperSchedule
from casa_sara.solver.l2_bounds import AdaptiveBounds, GivenBounds, chi_square_bounds
from casa_sara.solver.reweighting import Schedule

__all__ = ["bounds_of", "check_l2bound", "operator_accuracy", "schedule_of"]


def check_l2bound(options: SolverOptions, blocks: int) -> None:
    """Raise ValueError where the noise levels given are not one for all blocks, or one for each.

    Parameters
    ----------
    options : SolverOptions
        Task parameters of the method.
    blocks : int
        d.
    """
    if options.databound == "fixed" and len(options.l2bound) not in (1, blocks):
        raise ValueError(f"l2bound = {list(options.l2bound)}: there are {blocks} blocks; give one noise level "
                         "for all of them, or one for each")


def operator_accuracy(data: Visibilities, offsets: np.ndarray, noise: np.ndarray | None,
                      comm: Serial = SERIAL) -> float:
    """What accuracy the operator needs for these data, by the noise measured in them; the best where that is unknown.

    Parameters
    ----------
    data : Visibilities
        The samples.
    offsets : int (d + 1,)
        Block j is the slice offsets[j]:offsets[j + 1].
    noise : float (d,) or None
        Noise of each block relative to the MS weights.
    comm : casa_sara.parallel.serial.Serial or MPI
        Over whose ranks the samples are spread.

    Returns
    -------
    float
    """
    if noise is None or not np.all(np.asarray(noise) > 0):
        return SMALLEST_EPS[np.dtype(np.float32)]
    if data.scratch.on_disk:
        sums = np.zeros(2)
        for start, stop, one in zip(offsets[:-1], offsets[1:], np.square(noise, dtype=float)):
            for piece in data.scratch.pieces(start, stop):
                weight = data.weight[piece] / one
                sums += np.sum(weight * np.abs(data.vis[piece])), np.sum(weight)
        return eps_of(*sums)
    level = np.repeat(np.asarray(noise, np.float32), np.diff(offsets))
    return choose_eps(data.vis, data.weight / level**2, comm=comm)


def schedule_of(options: SolverOptions) -> Schedule | PaperSchedule:
    """The solver's schedule for these task parameters.

    Parameters
    ----------
    options : SolverOptions
        Task parameters of the method.

    Returns
    -------
    Schedule or PaperSchedule
    """
    if options.method == PAPER:
        return PaperSchedule.of(options)
    return Schedule(options.niter, options.nreweights, options.reweightdecay, options.reweighttol,
                    options.reltol, options.finalreltol, significance=options.significance)


def bounds_of(ppd: AdaptivePPD, nnls_norms: np.ndarray, weight_sums: np.ndarray, noise: np.ndarray | None,
              options: SolverOptions,
              most: float | np.ndarray = np.inf) -> AdaptiveBounds | GivenBounds | PaperBounds:
    """Return the bounds of the blocks as `databound` asks for them.

    Parameters
    ----------
    ppd : AdaptivePPD
        The iteration, before its first step.
    nnls_norms : float (d,)
        Norms of the blocks of the residual of the first image, whitened.
    weight_sums : float (d,)
        Σw of each block, in the unit of the iteration.
    noise : float (d,) or None
        Noise of each block measured in the data, relative to the MS weights.
    options : SolverOptions
        Task parameters of the method.
    most : float (d,)
        Largest weight of each block relative to all others, where bounds adapt.

    Returns
    -------
    AdaptiveBounds, GivenBounds or PaperBounds
    """
    samples = ppd.samples
    if options.method == PAPER:
        return paper_bounds(ppd, nnls_norms, weight_sums, options)
    common = dict(samples=samples, weight_sums=weight_sums, n_bases=ppd.dictionary.n_bases, regscale=options.regscale)
    if options.databound == "weights":
        return GivenBounds(chi_square_bounds(samples), **common)
    if options.databound == "fixed":
        return GivenBounds(chi_square_bounds(samples, np.broadcast_to(options.l2bound, samples.shape)), **common)
    # from what NNLS leaves, never below the noise that the data show
    floor = ppd.residual_norms / DYNAMIC_RANGE
    if noise is not None:
        floor = np.fmax(floor, np.asarray(noise) * np.sqrt(2.0 * samples))
    return AdaptiveBounds(nnls_norms, **common, floor=floor, most=most, rel_change=options.boundrelchange,
                          tol=options.boundtol, step=options.boundstep, min_interval=options.boundinterval)
