"""The visibilities of a finished model, written into the column MODEL_DATA of its MeasurementSets."""

from __future__ import annotations

from dataclasses import asdict

from casa_sara.casa.ms.model_column import save_model_column, write_model_column
from casa_sara.casa.runtime import log
from casa_sara.imaging.mosaic import MosaicModel, beams_record
from casa_sara.imaging.plane_images import IMAGE_EPS
from casa_sara.operators.sky import sky_operator
from casa_sara.options import ImageGrid, Selection, Spectrum

__all__ = ["save_model", "write_column"]


def save_model(selection, data, grid, options, model):
    """Write the model's visibilities into the MeasurementSets: the last phase, after the images are complete."""
    log.info("writing MODEL_DATA")
    save_model_column(selection.vis, write_column, selection=asdict(selection), phase_center=data.phase_center,
                      cell_rad=grid.cell_rad, gridder=grid.gridder, spectrum=grid.spectrum and asdict(grid.spectrum),
                      nthreads=options.nthreads, model=model,
                      beams=beams_record(data, grid) if grid.is_mosaic else None)


def write_column(selection, phase_center, cell_rad, gridder, spectrum, nthreads, model,  # noqa: PLR0913 - of a message
                 beams=None):
    """Predict the visibilities of a model and write them: what `save_model_column` has a child process do."""
    chosen = Selection(**{name: tuple(value) if isinstance(value, list) else value
                          for name, value in selection.items()})
    grid = ImageGrid(model.shape, tuple(cell_rad), gridder=gridder, spectrum=spectrum and Spectrum(**spectrum))
    accuracy = dict(eps=IMAGE_EPS, nthreads=nthreads)
    if beams is not None:
        predict = MosaicModel(model, grid, chosen, phase_center, beams, accuracy)
        write_model_column(chosen, phase_center, predict, by_row=True)
        return
    write_model_column(chosen, phase_center,
                       lambda uvw, freq_hz: sky_operator(uvw, grid, freq_hz, **accuracy).forward(model))
