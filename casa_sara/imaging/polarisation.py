"""Several Stokes parameters of one image: read once, solved side by side, written as the planes of one image."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial, reduce

import numpy as np

from casa_sara.casa.images.products import write_images, write_products
from casa_sara.casa.ms.weights import dirty_image, sum_of_weights
from casa_sara.casa.runtime import log
from casa_sara.casa.runtime.child_process import waiting_child
from casa_sara.data.noise import noise_from_differences
from casa_sara.data.visibilities import Visibilities
from casa_sara.imaging.continuum import Result, after_iterations, caution, describe, read_data, split
from casa_sara.imaging.data_quality import (
    beyond_baselines,
    check_confined,
    left_outside,
    named_suspects,
    suspects,
    thermal_noise,
)
from casa_sara.imaging.dry_run import forecast_run
from casa_sara.imaging.island_list import list_islands
from casa_sara.imaging.plane_images import point_spread, residual_visibilities
from casa_sara.imaging.run_solver import (
    Preparing,
    Watch,
    checkpoint_of,
    density_of,
    expected_iterations,
    log_end,
    show_progress,
    without_wild,
)
from casa_sara.imaging.time_forecast import Pace
from casa_sara.operators.widefield import WTerm
from casa_sara.options import ImagingRequest
from casa_sara.parallel.partition import ALONE
from casa_sara.parallel.serial import SERIAL, Serial
from casa_sara.reconstruction.compile_cache import kernels_loading
from casa_sara.reconstruction.polarised import StokesProblem, reconstruct_polarised
from casa_sara.reconstruction.problem import Samples
from casa_sara.reconstruction.reconstruct import Control
from casa_sara.reconstruction.settings import operator_accuracy, schedule_of
from casa_sara.runtime.deadline import Deadline
from casa_sara.runtime.scratch import IN_MEMORY
from casa_sara.runtime.signals import stop_on_interrupt
from casa_sara.solver.record import CONVERGED, ITERATION_LIMIT, NOISE_ONLY, STOPPED_BY_USER, TIME_LIMIT

__all__ = ["PolarisedResult", "make_polarised"]


@dataclass
class PolarisedResult:
    """The results of one run, for the return value of the task: of each Stokes parameter, and of all.

    `polarised_above` is the largest |(Q, U, V)| − I of the models in Jy/pixel, None without I.
    """

    data: Visibilities
    planes: dict[str, Result]
    sumwt: list[float]
    forecast: dict
    polarised_above: float | None = None

    @property
    def finished(self) -> bool:
        """Whether a restart has nothing to continue."""
        return all(one.finished for one in self.planes.values())

    def code_of(self, stokes: str) -> int:
        """Return the stop code of one Stokes parameter."""
        solved = self.planes[stokes].reconstruction
        return solved.record.stop_code if solved else ITERATION_LIMIT

    @property
    def stop_code(self) -> int:
        """Of the first Stokes parameter that has not converged, of the first if all have."""
        codes = [self.code_of(stokes) for stokes in self.planes]
        return next((code for code in codes if code not in (CONVERGED, NOISE_ONLY)), codes[0])


def make_polarised(request: ImagingRequest, record: Callable[[PolarisedResult], dict] | None = None,
                   comm: Serial = SERIAL) -> PolarisedResult:
    """Image several Stokes parameters of a selection of MeasurementSets, and write the products.

    Parameters and errors as of :func:`casa_sara.imaging.continuum.make_image`, in one process.
    """
    grid, output, deadline = request.grid, request.output, Deadline(request.limits.maxtime_s)
    forecast, _ = forecast_run(request.selection, grid, request.options, request.limits, comm, output.blocks)
    forecast.require(request.limits.maxmem_gb)
    checkpoint = checkpoint_of(request)
    if output.resume:
        checkpoint.open()
    with waiting_child(write_images) as child:  # it starts while CASA reads
        with kernels_loading(log.info):
            data, plane = read_data(request, ALONE, IN_MEMORY)
        part = split(data, output.blocks)
        parts = [replace(part, data=one, noise=noise_from_differences(one, part.offsets) if number else part.noise)
                 for number, one in enumerate(part.data.of_stokes(k) for k in range(len(grid.stokes)))]
        _check(request, plane, parts)
        watch = Watch(deadline, Pace(len(parts) * expected_iterations(request.options)), checkpoint)
        found = _solve(request, plane, parts, watch)
        result, images, beam = _images(request, plane, parts, found)
        assert watch.pace is not None
        result.forecast = replace(forecast, iteration_s=watch.pace.seconds).summary()
        write_products(output, plane.image_plane.of_stokes(grid.stokes), images, result.sumwt, beam,
                       record and record(result), child)
    if result.finished or not checkpoint.stands:
        checkpoint.remove()
    return result


def _check(request, plane, parts):
    """Describe in the log what was read; errors of weights and beam are raised here, before the solver."""
    first = parts[0]
    for stokes, part in zip(request.grid.stokes, parts):
        describe(part.data, part.blocks, part.noise, stokes)
    if plane.grid.gridder == "wproject":
        accuracy = min(operator_accuracy(part.data, part.offsets, part.noise) for part in parts)
        log.info(WTerm.of(first.data.max_w, plane.grid.shape, plane.grid.cell_rad, accuracy).words)
    point_spread(first.data, plane.grid, request.weighting, request.options, plane.image_plane, SERIAL)


def _solve(request, plane, parts, watch):
    """Return the solution of each Stokes parameter, {} where nothing is to be solved."""
    options, grid, first = request.options, plane.grid, parts[0].data
    if options.niter == 0:
        return {}
    watch.deadline.reserve = after_iterations(len(parts) * first.size, grid.shape, request.output, request.limits,
                                              watch.deadline.elapsed())
    density = density_of(first, request.selection, grid, options)
    progress = log.Progress()
    preparing = Preparing(progress)
    with stop_on_interrupt() as pressed:
        def stopped():
            preparing()
            return pressed() or watch.deadline.near()

        problems = []
        for number, (stokes, part) in enumerate(zip(grid.stokes, parts)):
            report = partial(show_progress, progress, preparing, schedule_of(options).expected_iterations,
                             None if number else watch.pace, (f"Stokes {stokes}: ", number, len(parts)))
            control = Control(report, stopped, tell=partial(_tell, stokes))
            start = None if plane.startmodel is None else plane.startmodel[number]
            samples = Samples(part.data, part.offsets, density, part.noise)
            problems.append(StokesProblem(stokes, samples, start, control))
        progress.prepare("computing the norms of the measurement operators, and the first images by non-negative least "
                         "squares (NNLS)")
        if options.polbound and grid.stokes[0] == "I":
            log.info(f"polbound = True: {', '.join(grid.stokes[1:])} are solved together, with |(Q, U, V)| <= I")
        found = reconstruct_polarised(problems, grid, options, plane.support, watch.checkpoint)
    progress.close()
    for (stokes, one), part in zip(found.items(), parts):
        if one.record.stop_code == STOPPED_BY_USER and not pressed():
            one.record.stop_code = TIME_LIMIT
        log.info(f"Stokes {stokes}:")
        log_end(one, part.offsets, watch.checkpoint)
        list_islands(one.record, plane.image_plane, grid.cell_rad, options.significance)
    return found


def _tell(stokes, line):
    log.info(f"Stokes {stokes}: {line}")


def _images(request, plane, parts, found):
    """Return the result, the images and their beam.

    PSF and residuals are of the samples that are used of all Stokes parameters: a PSF is that of all.
    """
    grid, first = plane.grid, parts[0]
    used = [one.kept for one in found.values()] or [np.arange(first.data.size)]
    kept = reduce(np.intersect1d, used)
    everything = kept.size == first.data.size
    data = first.data if everything else first.data.take(kept)
    weights, operator, psf, beam = point_spread(data, grid, request.weighting, request.options, plane.image_plane,
                                                SERIAL)
    models = np.array([one.model for one in found.values()]) if found else plane.startmodel
    if models is None:
        models = np.zeros((len(parts), *grid.shape), np.float32)
    residuals, planes, sumwt = np.empty_like(models), {}, []
    for number, (stokes, part) in enumerate(zip(grid.stokes, parts)):
        one = part.data if everything else part.data.take(kept)
        vis = residual_visibilities(operator, one, grid, request.options, models[number], SERIAL)
        residuals[number] = dirty_image(operator, vis, weights)
        sumwt.append(sum_of_weights(data, weights, grid.stokes))
        planes[stokes] = _plane_result(plane, part, found.get(stokes), models[number], residuals[number])
        if plane.support is not None:
            check_confined(models[number], plane.support)
            sigma = thermal_noise(one, weights, part.noise, np.searchsorted(kept, part.offsets))
            caution(first.data, [f"Stokes {stokes}: {note}"
                                 for note in left_outside(residuals[number], plane.support, sigma)])
    if grid.stokes[0] == "I":
        caution(first.data, beyond_baselines(models[0], grid.cell_rad, data.min_uv))
    mask = {} if plane.support is None else {"mask": plane.support.astype(np.float32)}
    result = PolarisedResult(first.data, planes, sumwt, {}, _polarised_above(grid.stokes, models))
    return result, dict(psf=psf, residual=residuals, model=models) | mask, beam


def _plane_result(plane, part, found, model, residual):
    """Return the result of one Stokes parameter, and warn of suspect blocks."""
    blocks, doubtful = part.blocks, []
    if found:
        _, blocks = without_wild(part.data, part.blocks, part.offsets, found)
        doubtful = suspects(blocks, part.noise, found.l2_bounds)
    for line in named_suspects(blocks, doubtful):
        log.warn(line)
    return Result(part.data, part.data.size, blocks, part.noise, found, float(np.abs(residual).max()),
                  float(model.sum(dtype=float)), {}, doubtful)


def _polarised_above(stokes, models):
    """Return the largest |(Q, U, V)| − I, None without I."""
    if stokes[0] != "I":
        return None
    return float((np.sqrt(np.square(models[1:], dtype=float).sum(axis=0)) - models[0]).max())
