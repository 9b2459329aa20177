"""Algorithm 2 of Dabbech et al. 2018: re-weighted ℓ1 problems, solved one after the other."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from casa_sara.solver.positivity import Release
from casa_sara.solver.record import CONVERGED, DIVERGED, ITERATION_LIMIT, STOPPED_BY_USER, UNFEASIBLE, SolverRecord

__all__ = ["Schedule", "band_noise", "solve"]

SHRINK = 0.95  # of κ with every re-weighting: long steps first, fine ones at the end
RISE = 1.05  # of the residual norm within one interval, from its least
STEADY = 3e-3  # relative change of the residual norm within one interval
FIRST_SCALE, LAST_SCALE = 10.0, 1.5  # α, in units of the noise of each band
RELEASE_SCALE = 4.0  # α from which on the residual shows what positive pixels cannot hold
FIRST_INTERVALS = 2  # of the first problem, whose model starts from nothing
LONGEST = 50  # intervals of the last problem: what still moves then is below what the data can tell
USUAL = 9  # re-weightings that most data need
SLAB = 64  # lines squared at a time
PATIENCE = 300  # iterations that a settled model is given to meet its bounds


@dataclass(frozen=True)
class Schedule:
    """When to re-weight and when to stop.

    Attributes
    ----------
    niter : int
        Most iterations in all.
    nreweights : int
        Most re-weightings.
    reweight_decay : float
        ω, factor on the scale of the weights.
    reweight_tol : float
        ϱ: two re-weighted solutions that differ by less end the re-weighting.
    reltol, final_reltol : float
        Relative change that ends one ℓ1 problem, and the last one.
    interval : int
        Most iterations of one ℓ1 problem before the last.
    """

    niter: int = 100_000
    nreweights: int = 20
    reweight_decay: float = 0.618
    reweight_tol: float = 1e-2
    reltol: float = 3e-4
    final_reltol: float = 3e-4
    interval: int = 30

    @property
    def expected_iterations(self) -> int:
        """A guess of how many iterations it takes, for the progress."""
        return min(self.niter, (self.expected_reweightings + 3) * self.interval)

    @property
    def expected_reweightings(self) -> int:
        """A guess of how many re-weightings it takes."""
        return min(self.nreweights, USUAL)


def band_noise(ppd, bounds, seed=20180404):
    """Standard deviation of the noise in every band of the dictionary, and of a pixel, in the unit of the model.

    One realisation of the noise, weighted by 1/s_m² as the data are, is carried to the image and normalised by
    the peak of the point spread function, Ψ†Φ†Σ⁻¹n / Σ_j σ_j⁻² Σ w; the array of the weights W serves as
    scratch space.

    Parameters
    ----------
    ppd : AdaptivePPD
    bounds : GivenBounds or AdaptiveBounds

    Returns
    -------
    bands : float (number of bands,)
        In the order of `dictionary.bands()`.
    pixel : float
        Of a Dirac coefficient, which is a pixel divided by √(number of bases).
    """
    rng = np.random.default_rng(seed)
    noise = np.empty_like(ppd.vis)
    for j, (a, b) in enumerate(ppd.blocks()):
        noise[a:b] = rng.standard_normal(b - a) + 1j * rng.standard_normal(b - a)
        noise[a:b] *= np.sqrt(bounds.noise_weights[j] * ppd.spread[a:b])
    image = ppd.measurement.adjoint(noise)
    image /= image.dtype.type(bounds.total_weight)
    coefs = ppd.dictionary.analysis(image, ppd.l1_weights)
    bands = [_rms(coefs[band.slice]) for band in ppd.dictionary.bands()]
    return np.maximum(bands, 1e-30), _rms(image) / np.sqrt(ppd.dictionary.n_bases)


def _rms(values):
    slabs = (values[start : start + SLAB] for start in range(0, len(values), SLAB))
    return float(np.sqrt(sum(np.square(slab, dtype=float).sum() for slab in slabs) / values.size))


def solve(ppd, bounds, schedule=Schedule(), progress=lambda ppd, record: None, stopped=lambda: False):
    """Algorithm 2: solve, re-weight, and solve again until nothing changes.

    The weights start at W = ν, the noise of each band relative to that of a pixel (at least 1); those of re-weighting k
    are W = ν α/(α + d̄) with d̄ the root mean square of a coefficient of Ψ†x and its eight neighbours, and
    α = max(10 ω^{k−1}, 1.5) × the noise of the band or of a pixel, whichever is less.  The paper has 1, ω^k × the
    largest coefficient of the basis, and d̄ = |Ψ†x|: docs/decisions.md, "Weights from the noise".

    Parameters
    ----------
    ppd : AdaptivePPD
        The iteration, with its first κ (`threshold`) set.
    bounds : GivenBounds or AdaptiveBounds
    schedule : Schedule
    progress : callable
        Called after every iteration with (ppd, record).
    stopped : callable
        Asked after every iteration; True ends the solution with what there is.

    Returns
    -------
    SolverRecord
    """
    record = SolverRecord()
    bounds.apply_to(ppd)
    _first_weights(ppd, bounds)
    record.bounds.append((0, bounds.l2_bounds.copy()))
    previous, release = ppd.model.copy(), Release()

    def solve_one(k, last):
        return _solve_one(ppd, bounds, schedule, k, last, record, progress, stopped)

    for k in range(schedule.nreweights):
        record.stop_code = solve_one(k, False)
        if record.stop_code != CONVERGED:
            break
        change = _relative(ppd.model, previous)
        scale = FIRST_SCALE * schedule.reweight_decay**k
        released = release.update(ppd, bounds) if scale <= RELEASE_SCALE else 0
        if scale <= LAST_SCALE and change < schedule.reweight_tol and bounds.met_by(ppd) and not released:
            break
        previous[...] = ppd.model
        if scale <= LAST_SCALE:
            bounds.share(ppd)
        _reweight(ppd, bounds, max(scale, LAST_SCALE))
        record.reweightings.append(dict(iteration=ppd.iteration, scale=max(scale, LAST_SCALE), model_change=change,
                                        released=released))
    if record.stop_code in (0, CONVERGED):
        bounds.finish(ppd)
        record.stop_code = solve_one(len(record.reweightings), True)
    if record.stop_code == DIVERGED:
        ppd.model[...] = previous
    return record


def _solve_one(ppd, bounds, schedule, k, last, record, progress, stopped):
    """Algorithm 1 for one set of weights, the k-th; return its stop code."""
    tolerance = schedule.final_reltol if last else schedule.reltol
    start, settled = ppd.iteration, 0
    while True:
        ppd.step()
        record.note(ppd, k)
        if bounds.adapt(ppd):
            record.bounds.append((ppd.iteration, bounds.l2_bounds.copy()))
        progress(ppd, record)
        if not np.isfinite(ppd.rel_change) or not np.isfinite(record.residual_norm[-1]):
            return DIVERGED
        if stopped():
            return STOPPED_BY_USER
        if ppd.iteration >= schedule.niter:
            return ITERATION_LIMIT
        done = ppd.iteration - start
        if done % schedule.interval == 0:
            _damp(ppd, record.residual_norm[-schedule.interval:])
        if not last and done >= (FIRST_INTERVALS if k == 0 else 1) * schedule.interval:
            return CONVERGED
        # the model has settled; the residual and the bounds may need longer, but not for ever
        settled = settled + 1 if ppd.rel_change < tolerance else 0
        steady = not last or _is_steady(record.residual_norm[start:], schedule.interval)
        if done > 1 and settled and steady and bounds.met_by(ppd):
            return CONVERGED
        if settled >= PATIENCE or done >= LONGEST * schedule.interval:
            return CONVERGED if bounds.met_by(ppd) else UNFEASIBLE


def _first_weights(ppd, bounds):
    """W = ν: the noise of every band in units of a pixel's, but at least 1.

    Where the beam spans many pixels, or short baselines abound, the noise lives in the coarse bands; there a
    threshold at the noise of one pixel would let it through.
    """
    if ppd.l1_weights is None:
        ppd.l1_weights = ppd.dictionary.allocate()
    noise, pixel = band_noise(ppd, bounds)
    for band, scale in zip(ppd.dictionary.bands(), _band_scales(noise, pixel)):
        ppd.l1_weights[band.slice] = scale


def _band_scales(noise, pixel):
    """ν of every band."""
    return np.maximum(noise / pixel, 1.0)


def _reweight(ppd, bounds, scale):
    """W = ν α/(α + d̄), α = scale × the noise of the band, or of a pixel where that is less."""
    noise, pixel = band_noise(ppd, bounds)
    ppd.dictionary.reweight(ppd.model, scale * np.minimum(noise, pixel), _band_scales(noise, pixel), ppd.l1_weights)
    ppd.rescale(SHRINK * ppd.threshold)
    bounds.apply_to(ppd)


def _damp(ppd, residual_norms):
    """Halve κ where the residual rises again: the prior moves the image further than the data can follow.

    κ is how far one iteration can move what only the prior knows of; the larger it is, the harder, and the less
    damped, are the constraints of the data.
    """
    if residual_norms[-1] > RISE * min(residual_norms):
        ppd.rescale(0.5 * ppd.threshold)


def _is_steady(residual_norms, interval):
    """Whether the residual has changed by less than `STEADY` within the last interval."""
    recent = residual_norms[-interval:]
    return len(recent) == interval and max(recent) - min(recent) < STEADY * recent[-1]


def _relative(model, previous):
    norm = np.linalg.norm(model)
    return float(np.linalg.norm(model - previous) / norm) if norm > 0 else 0.0
