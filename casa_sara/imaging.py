"""The story of one image: read, weigh, split, solve, write."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass, field, replace

import numpy as np

from casa_sara.casa import log
from casa_sara.casa.blockwords import divide
from casa_sara.casa.child import waiting_child
from casa_sara.casa.imageplane import define_image_plane, read_pixels
from casa_sara.casa.images import read_model
from casa_sara.casa.modelcolumn import save_model_column, write_model_column
from casa_sara.casa.ms import read_visibilities
from casa_sara.casa.products import write_products
from casa_sara.casa.restore import fit_beam
from casa_sara.casa.support import read_support
from casa_sara.casa.tools import opened
from casa_sara.casa.weights import dirty_image, imaging_weights, sum_of_weights
from casa_sara.cautions import beyond_baselines, check_confined, left_outside, named_suspects, suspects, thermal_noise
from casa_sara.deadline import Deadline
from casa_sara.noise import noise_from_differences
from casa_sara.operators.measurement import MeasurementOperator, check_cell, check_field
from casa_sara.options import ImageGrid, Limits, Output, Selection, SolverOptions, Weighting
from casa_sara.reconstruction import Reconstruction, schedule_of
from casa_sara.rehearsal import foresee
from casa_sara.solver.record import UNFINISHED
from casa_sara.solving import Watch, checkpoint_of, solve_image, without_wild
from casa_sara.timing import Pace, writing_seconds
from casa_sara.visibilities import BlockInfo, Visibilities, sort_into_blocks

__all__ = ["Result", "make_image", "write_column"]

FEWEST_PIXELS = 3.0  # of the finest fringe
LARGEST_W_PHASE = 0.3  # rad, in the corners of the image
MODEL_COLUMN = 3.0  # times as long as reading, to write it and read it back
REPORT_SECONDS = 30.0
IMAGE_EPS = 1e-6  # accuracy of the PSF, the residual image and the model column


@dataclass
class Result:
    """What one run found, for the return value of the task.

    `reconstruction` is None when only dirty images were asked for; `noise` is the noise of each block measured
    from the data, in units of what the weights say; `forecast` is what was said of memory and time before; `suspects`
    are the blocks of :func:`casa_sara.cautions.suspects`.
    """

    data: Visibilities
    blocks: list[BlockInfo]
    noise: np.ndarray
    reconstruction: Reconstruction | None
    residual_peak: float
    model_flux: float
    forecast: dict
    suspects: list = field(default_factory=list)

    @property
    def finished(self) -> bool:
        """Whether there is nothing left for a restart to go on with."""
        return self.reconstruction is None or self.reconstruction.record.stop_code not in UNFINISHED


def make_image(selection: Selection, grid: ImageGrid, weighting: Weighting, options: SolverOptions,
               output: Output, record: Callable[[Result], dict] | None = None, limits: Limits = Limits()) -> Result:
    """Image a selection of MeasurementSets and write the products.

    Parameters
    ----------
    selection, grid, weighting, options, output
        What the task was asked for.
    record : callable, optional
        Returns what is kept beside the images of the result.

    Raises
    ------
    MemoryError
        The run would not fit; nothing large was allocated.
    ValueError, FileNotFoundError, RuntimeError
        For data or parameters that no image can be made of; the message names the task parameter.
    """
    deadline, forecast = Deadline(limits.maxtime_s), foresee(selection, grid, options, limits)
    forecast.require(limits.maxmem_gb)
    checkpoint = checkpoint_of(selection, grid, options, output)
    if output.resume:
        checkpoint.open()
    # read
    data = read_visibilities(selection, grid.phasecenter, grid.stokes)
    data.notes.extend(_limits(data, grid))
    plane = define_image_plane(data, selection, grid, output.pblimit)
    if not plane.mask.any():
        data.notes.append(f"phasecenter = '{grid.phasecenter}': the primary beam is nowhere in the image above pblimit = "
                          f"{output.pblimit:g}, and its pixels are masked everywhere")
    _caution(data)
    start = read_model(output.startmodel, plane) if output.startmodel and not output.resume else None
    if output.images_stand:
        _save_model(selection, data, grid, options, start)
        return Result(data, [], np.zeros(0), None, _peak(output.imagename + ".residual"), float(start.sum(dtype=float)),
                      forecast.summary())
    support = read_support(grid, plane)
    if support is not None and start is not None:
        start *= support
    # split and weigh
    block_of_sample, blocks = divide(data, output.blocks)
    data, offsets = sort_into_blocks(data, block_of_sample)
    noise = noise_from_differences(data, offsets)
    _describe(data, blocks, noise, grid.stokes)
    _point_spread(data, grid, weighting, options, plane)  # what cannot be weighed or restored is refused before the hours
    # solve
    reconstruction, model = None, start if start is not None else np.zeros(grid.shape, np.float32)
    if options.niter > 0:
        deadline.reserve = _after_iterations(data, grid, output, limits, deadline.elapsed())
        watch = Watch(deadline, Pace(schedule_of(options).expected_iterations))
        reconstruction = solve_image(data, offsets, noise, selection, grid, options, start, checkpoint, watch,
                                     support)
        forecast = replace(forecast, iteration_s=watch.pace.seconds)
        model = reconstruction.model
        data, blocks = without_wild(data, blocks, offsets, reconstruction)
    doubtful = suspects(blocks, noise, reconstruction.l2_bounds) if reconstruction else []
    for line in named_suspects(blocks, doubtful):
        log.warn(line)
    # write
    with waiting_child() as child:  # which starts meanwhile
        weights, operator, psf, beam = _point_spread(data, grid, weighting, options, plane)
        residual = dirty_image(operator, data.vis - operator.forward(model), weights)
        _caution(data, beyond_baselines(model, grid.cell_rad, data.uvw[:2]))
        images = dict(psf=psf, residual=residual, model=model)
        if support is not None:
            images["mask"] = check_confined(model, support)
            _caution(data, left_outside(residual, support, thermal_noise(data, weights, noise, blocks)))
        result = Result(data, blocks, noise, reconstruction, float(np.abs(residual).max()),
                        float(model.sum(dtype=float)), forecast.summary(), doubtful)
        write_products(output, plane, images, sum_of_weights(data, selection, weights, grid.stokes), beam, record and record(result),
                       child)
    if result.finished or not checkpoint.stands:  # else one of an older run
        checkpoint.remove()
    if output.savemodel == "modelcolumn":
        _save_model(selection, data, grid, options, model)
    return result


def _caution(data, notes=None):
    """Warn of these notes, which the record keeps too, or of those that are there."""
    for note in data.notes if notes is None else notes:
        log.warn(note)
    data.notes.extend(notes or [])


def _save_model(selection, data, grid, options, model):
    """Write the model's visibilities into the MeasurementSets: the last phase, the images are whole."""
    log.info("writing the model column")
    save_model_column(selection.vis, write_column, selection=asdict(selection), phase_center=data.phase_center,
                      cell_rad=grid.cell_rad, nthreads=options.nthreads, model=model)


def write_column(selection, phase_center, cell_rad, nthreads, model):
    """Predict the visibilities of a model and write them: what `save_model_column` has a child process do."""
    chosen = {name: tuple(value) if isinstance(value, list) else value for name, value in selection.items()}
    write_model_column(Selection(**chosen), phase_center, lambda uvw: MeasurementOperator(
        uvw[:2], cell_rad, model.shape, eps=IMAGE_EPS, nthreads=nthreads).forward(model))


def _peak(name):
    """Return the largest absolute pixel of an image that stands."""
    with opened("image", name) as ia:
        return float(np.abs(read_pixels(ia)).max())


def _point_spread(data, grid, weighting, options, plane):
    """Return the imaging weights, the operator of the dirty images, the PSF and the beam fitted to it."""
    weights = imaging_weights(data, grid, weighting)
    operator = MeasurementOperator(data.uvw[:2], grid.cell_rad, grid.shape, eps=IMAGE_EPS, nthreads=options.nthreads)
    psf = dirty_image(operator, np.ones(data.size, np.complex64), weights)
    return weights, operator, psf, fit_beam(psf, plane)


def _limits(data, grid):
    """What the user should know of this image plane and these baselines; raise where no image can be made of them."""
    notes = []
    check_cell(data.uvw[:2], grid.cell_rad)
    check_field(data.max_uv, grid.shape, grid.cell_rad)
    arcsec = np.degrees(grid.cell_rad[0]) * 3600
    pixels = 1 / (data.max_uv * max(grid.cell_rad))
    if pixels < FEWEST_PIXELS:
        notes.append(f"cell = '{arcsec:.4g}arcsec' gives the finest fringe {pixels:.2g} pixels: below {FEWEST_PIXELS:g} "
                     f"sources between pixels cannot be represented; 5 would be cell = '{arcsec * pixels / 5:.3g}arcsec'")
    corner_sq = 0.25 * sum((n * cell) ** 2 for n, cell in zip(grid.shape, grid.cell_rad))
    phase = np.pi * data.max_w * corner_sq
    if phase > LARGEST_W_PHASE:
        notes.append(f"the w-term is not modelled: it turns phases by up to {phase:.2g} rad in the corners of this image")
    return notes


def _after_iterations(data, grid, output, limits, read_s):
    """Seconds to keep for what comes after the iterations: images, model column, report."""
    column = MODEL_COLUMN * read_s if output.savemodel == "modelcolumn" else 0.0
    return writing_seconds(data.size, grid.shape) + column + (REPORT_SECONDS if limits.report else 0.0)


def _describe(data, blocks, noise, stokes):
    """Say in the log what was read."""
    log.info(f"{data.size} Stokes {stokes} visibilities, longest baseline {data.max_uv / 1e3:.4g} klambda, "
             f"{len(blocks)} blocks")
    for reason, count in data.dropped.items():
        log.info(f"left out: {count} samples, {reason}")
    for j, (block, level) in enumerate(zip(blocks, noise)):
        measured = f"noise measured from the data {level:.3g} times what the weights say" if np.isfinite(level) \
            else "too few integrations to measure the noise"
        log.info(f"block {j}: {block.label}; {measured}")
