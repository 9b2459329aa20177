"""The visibilities of a finished model, written into the column MODEL_DATA of its MeasurementSets."""

from __future__ import annotations

from dataclasses import asdict
from functools import partial

import numpy as np

from casa_sara.casa.images.spectral_axis import SpectralAxis
from casa_sara.casa.ms.model_column import save_model_column, write_model_column
from casa_sara.casa.runtime import log
from casa_sara.imaging.mosaic import MosaicModel, beams_record
from casa_sara.imaging.plane_images import IMAGE_EPS
from casa_sara.operators.sky import sky_operator
from casa_sara.operators.subbands import Subbands
from casa_sara.options import ImageGrid, Outlier, Selection, Spectrum

__all__ = ["save_model", "write_column"]


def save_model(selection, data, grid, options, model, axis=None):
    """Write the model's visibilities into the MeasurementSets: the last phase, after the images are complete.

    The model (nchan, nx, ny) of a cube comes with its spectral axis; with outliers the models are stacked. With
    `grid.subbands` it is that at these frequencies, (T, nx, ny), or (nx, ny) where it is the same at all of them.
    """
    log.info("writing MODEL_DATA")
    save_model_column(selection.vis, write_column, selection=asdict(selection), phase_center=data.phase_center,
                      shape=grid.shape, cell_rad=grid.cell_rad, gridder=grid.gridder,
                      spectrum=grid.spectrum and asdict(grid.spectrum), nthreads=options.nthreads, model=model,
                      beams=beams_record(data, grid) if grid.is_mosaic else None, axis=axis and vars(axis),
                      subbands=grid.subbands and asdict(grid.subbands),
                      outliers=[dict(shape=outlier.grid.shape, cell_rad=outlier.grid.cell_rad, turn=outlier.turn)
                                for outlier in grid.outliers])


def write_column(selection, phase_center, shape, cell_rad, gridder, spectrum, nthreads, model,  # noqa: PLR0913
                 beams=None, axis=None, outliers=(), subbands=None):
    """Predict the visibilities of a model and write them: what `save_model_column` has a child process do.

    The arguments are those of a message.
    """
    chosen = Selection(**{name: tuple(value) if isinstance(value, list) else value
                          for name, value in selection.items()})
    others = tuple(Outlier("", ImageGrid(tuple(one["shape"]), tuple(one["cell_rad"]), gridder=gridder),
                           turn=one["turn"]) for one in outliers)
    grid = ImageGrid(tuple(shape), tuple(cell_rad), gridder=gridder, spectrum=spectrum and Spectrum(**spectrum),
                     outliers=others, subbands=subbands and Subbands(**subbands))
    if grid.subbands is not None:
        model = grid.subbands.stacked(model)
    accuracy = dict(eps=IMAGE_EPS, nthreads=nthreads)
    if beams is not None:
        predict = MosaicModel(model, grid, chosen, phase_center, beams, accuracy, axis and SpectralAxis(**axis))
        write_model_column(chosen, phase_center, predict, by_row=True)
        return
    plane = partial(_predicted, grid=grid, accuracy=accuracy)
    predict = partial(plane, model=model) if axis is None else partial(_of_channels, model, SpectralAxis(**axis), plane)
    write_model_column(chosen, phase_center, predict)


def _predicted(uvw, freq_hz, model, grid, accuracy):
    """Return the visibilities of one plane."""
    return sky_operator(uvw, grid, freq_hz, **accuracy).forward(model)


def _of_channels(models, axis, plane, uvw, freq_hz):
    """Return the visibilities of a cube: each of the channel that holds its frequency, 0 where none does."""
    channel, vis = axis.nearest(freq_hz), np.zeros(freq_hz.size, np.complex64)
    for k in np.unique(channel[channel >= 0]):
        if models[k].any():
            here = channel == k
            vis[here] = plane(uvw[:, here], freq_hz[here], model=models[k])
    return vis
