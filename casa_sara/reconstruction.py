"""From whitened visibilities to a model image: operators, bounds and solver put together, without CASA."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from casa_sara.operators.dictionary import SaraDictionary
from casa_sara.operators.measurement import MeasurementOperator
from casa_sara.operators.norms import power_method
from casa_sara.outliers import find_wild
from casa_sara.solver.adaptive_ppd import AdaptivePPD
from casa_sara.solver.l2_bounds import AdaptiveBounds, GivenBounds, chi_square_bounds
from casa_sara.solver.nnls import nnls
from casa_sara.solver.record import CONVERGED, NOISE_ONLY, SolverRecord
from casa_sara.solver.reweighting import Schedule, solve

__all__ = ["Reconstruction", "reconstruct", "schedule_of"]

STEP_BALANCE = 0.15  # κ in units of the mean brightness Σx²/Σ|x| of the first model
NOISE_ONLY_SNR = 5.0
NOISE_ONLY_RELTOL = 0.1  # what little noise leaves need not settle
ROUNDS = 6  # of leaving out wild samples
DYNAMIC_RANGE = 1e5  # of whitened visibilities: their noise is never taken for less than rms/DYNAMIC_RANGE


@dataclass
class Reconstruction:
    """A solved image.

    Attributes
    ----------
    model : float32 (nx, ny)
        Jy/pixel.
    l2_bounds, residual_norms : float (d,)
        ε_j and μ_j, whitened.
    nnls_norms : float (d,)
        μ_j of the NNLS image, from which adaptive bounds start.
    record : SolverRecord
    data_norm_sq : float
        ‖U^½Φ‖², whitened, 1/Jy².
    threshold : float
        Last κ, Jy/pixel.
    noise_jy_per_beam : float
        Noise of the naturally weighted dirty image for the noise levels found.
    kept : int (M',)
        Samples that were used, numbers into the data given.
    wild : list of dict
        The others, named: see :class:`casa_sara.outliers.WildSamples`.
    """

    model: np.ndarray
    l2_bounds: np.ndarray
    residual_norms: np.ndarray
    nnls_norms: np.ndarray
    record: SolverRecord
    data_norm_sq: float
    threshold: float
    noise_jy_per_beam: float
    kept: np.ndarray
    wild: list[dict]


def reconstruct(data, offsets, density, grid, options, noise=None, startmodel=None,
                progress=lambda ppd, record: None, stopped=lambda: False):
    """Find the SARA image of block-sorted visibilities.

    Parameters
    ----------
    data : Visibilities
        `vis` (Jy), `weight` (inverse variance) and `uvw` are used.
    offsets : int (d + 1,)
        Block j is the slice offsets[j]:offsets[j + 1].
    density : real (M,)
        Sampling density of each sample; U = 1/density is the preconditioner.
    grid : ImageGrid
    options : SolverOptions
    noise : float (d,), optional
        Noise of each block measured from the data, in units of what the weights say; NaN where unknown.
    startmodel : real (nx, ny), optional
        First image, Jy/pixel.
    progress, stopped : callable
        See :func:`casa_sara.solver.reweighting.solve`; `stopped` ends the NNLS fit too, and one iteration follows.

    Returns
    -------
    Reconstruction
    """
    if options.databound == "fixed" and len(options.l2bound) not in (1, len(offsets) - 1):
        raise ValueError(f"l2bound = {list(options.l2bound)}: there are {len(offsets) - 1} blocks; give one noise level "
                         "for all of them, or one for each")
    # images in units of the noise of one sample: every number is near 1
    unit_jy = float(np.mean(data.weight, dtype=float) ** -0.5)
    kept, wild = np.arange(data.size), []
    for _ in range(ROUNDS):
        problem = _Problem.of(data, density, grid, options, unit_jy)
        # positivity and a vanishing sparsity alone: where the bounds start, and the model too
        first, residual = nnls(problem.measurement, problem.vis, problem.precond, problem.data_norm_sq,
                               positivity=options.positivity, stopped=stopped)
        found = find_wild(data, offsets, residual, unit_jy * float(np.abs(first).sum(dtype=float)))
        if found.index.size == 0:
            break
        wild += found.named(data)
        good = np.delete(np.arange(data.size), found.index)
        offsets = np.searchsorted(good, offsets)
        data, density, kept = data.take(good), density[good], kept[good]
    if found.index.size:
        problem = _Problem.of(data, density, grid, options, unit_jy)
        residual = np.delete(residual, found.index)

    data_norm_sq = problem.data_norm_sq
    dictionary = SaraDictionary(grid.shape, options.wavelets, options.wavelevels, nthreads=options.nthreads)
    ppd = AdaptivePPD(problem.measurement, dictionary, problem.vis, offsets, problem.precond, data_norm_sq,
                      options.positivity)
    ppd.unit_jy = unit_jy
    weights = data.weight * np.float32(unit_jy**2)
    nnls_norms = np.array([np.linalg.norm(residual[a:b]) for a, b in ppd.blocks()])
    bounds = _bounds(ppd, nnls_norms, weights, noise, options)
    noise_only = _is_noise_only(ppd, bounds)
    if startmodel is not None:
        first = startmodel / np.float32(unit_jy)
    ppd.start_from(first)
    ppd.rescale(STEP_BALANCE * _mean_brightness(first))
    del first, residual

    schedule = schedule_of(options)
    if noise_only:
        schedule = replace(schedule, final_reltol=max(schedule.final_reltol, NOISE_ONLY_RELTOL))
    record = solve(ppd, bounds, schedule, progress, stopped)
    if record.stop_code == CONVERGED and noise_only:
        record.stop_code = NOISE_ONLY
    ppd.model *= np.float32(unit_jy)
    noise_jy_per_beam = unit_jy * bounds.total_weight**-0.5
    return Reconstruction(ppd.model, bounds.l2_bounds, ppd.residual_norms, nnls_norms, record,
                          data_norm_sq / unit_jy**2, ppd.threshold * unit_jy, noise_jy_per_beam, kept, wild)


@dataclass
class _Problem:
    """Whitened samples y = √w·V, and the operators that belong to them."""

    vis: np.ndarray
    measurement: MeasurementOperator
    precond: np.ndarray
    data_norm_sq: float

    @classmethod
    def of(cls, data, density, grid, options, unit_jy):
        """Whiten the data and build their operator for images in `unit_jy`."""
        sqrt_weight = np.sqrt(data.weight)
        vis = data.vis * sqrt_weight
        sqrt_weight *= np.float32(unit_jy)
        measurement = MeasurementOperator(data.uvw[:2], grid.cell_rad, grid.shape, row_scale=sqrt_weight,
                                          nthreads=options.nthreads)
        precond = _preconditioner(density, options.precondition)
        data_norm_sq = power_method(lambda image: measurement.adjoint(precond * measurement.forward(image)),
                                    grid.shape, dtype=np.float32)
        return cls(vis, measurement, precond, data_norm_sq)


def schedule_of(options):
    """The solver's schedule for these task parameters."""
    return Schedule(options.niter, options.nreweights, options.reweightdecay, options.reweighttol,
                    options.reltol, options.finalreltol)


def _preconditioner(density, wanted):
    """U = 1/density, largest value 1."""
    if not wanted:
        return np.ones(density.size, np.float32)
    precond = 1.0 / np.asarray(density, float)
    return (precond / precond.max()).astype(np.float32)


def _bounds(ppd, nnls_norms, weights, noise, options):
    samples = np.diff(ppd.offsets)
    weight_sums = np.add.reduceat(weights, ppd.offsets[:-1], dtype=float)
    common = dict(samples=samples, weight_sums=weight_sums, n_bases=ppd.dictionary.n_bases, regscale=options.regscale)
    if options.databound == "weights":
        return GivenBounds(chi_square_bounds(samples), **common)
    if options.databound == "fixed":
        return GivenBounds(chi_square_bounds(samples, np.broadcast_to(options.l2bound, samples.shape)), **common)
    # never below the noise that the data show, and from half-way between it and what NNLS leaves
    floor, start = ppd.residual_norms / DYNAMIC_RANGE, nnls_norms
    if noise is not None:
        measured = np.asarray(noise) * np.sqrt(2.0 * samples)
        floor = np.fmax(floor, measured)
        start = np.where(np.isfinite(measured), np.sqrt(nnls_norms * measured), nnls_norms)
    return AdaptiveBounds(start, **common, floor=floor, sample_weights=weights, rel_change=options.boundrelchange,
                          tol=options.boundtol, step=options.boundstep, min_interval=options.boundinterval)


def _is_noise_only(ppd, bounds):
    """Whether the naturally weighted dirty image holds no peak above 5 times its noise."""
    whitening = np.repeat(bounds.noise_weights.astype(np.float32), np.diff(ppd.offsets))
    dirty = ppd.measurement.adjoint(ppd.vis * whitening)
    return bool(np.abs(dirty).max() < NOISE_ONLY_SNR * np.sqrt(bounds.total_weight))


def _mean_brightness(model):
    """Mean brightness of the flux, Σx²/Σ|x|; 1 for an empty image."""
    flux = np.abs(model).sum(dtype=float)
    return float(np.square(model, dtype=float).sum() / flux) if flux > 0 else 1.0
