"""Resolution of images, measured with point sources that are added to the visibilities."""

from __future__ import annotations

import ast
from dataclasses import dataclass, fields, replace

import numpy as np

from casa_sara.analysis.points import recovered_point
from casa_sara.casa.images.regrid import PixelMap
from casa_sara.casa.images.sky_image import SkyPlane
from casa_sara.casa.images.spectral_index import with_spectrum
from casa_sara.casa.ms.block_selection import divide
from casa_sara.casa.ms.read import read_visibilities
from casa_sara.casa.runtime import log
from casa_sara.data.noise import noise_from_differences
from casa_sara.data.visibilities import sort_into_blocks
from casa_sara.imaging.run_solver import density_of, solve_image
from casa_sara.options import ImageGrid, Selection, SolverOptions
from casa_sara.reconstruction.problem import Samples
from casa_sara.solver.record import STOPPED_BY_USER

__all__ = ["Injection", "can_be_repeated", "problem_of_run", "recover", "spectral_index_of"]

ARCSEC = np.radians(1 / 3600)


@dataclass(frozen=True)
class Injection:
    """Point sources: pixel coordinates by name on the grid `plane`, and the flux of each in Jy.

    `radius` in arcsec is that of the circle in which each is measured.
    """

    places: dict[str, tuple[float, float]]
    plane: SkyPlane
    flux: float
    radius: float


def can_be_repeated(one) -> bool:
    """Return whether the run of an ImageSet can be repeated: of tsara, Stokes I alone, no mask, no spectra."""
    masked = one.parameters.get("usemask", "user") != "user" or one.parameters.get("mask", "") not in ("", "[]", "['']")
    alone = one.parameters.get("stokes", "I") == "I"
    return one.parameters.get("taskname") == "tsara" and not masked and not one.spectra and alone


def spectral_index_of(one) -> str:
    """Return the spectral index that an ImageSet was imaged with, as its history has it, '' for flat spectra."""
    return one.parameters.get("spectralindex", "")


def recover(one, injection: Injection, selection: Selection, nthreads: int = 1) -> dict[str, dict[str, float]]:
    """Image a selection without and with injected point sources, and measure the difference of the models.

    Both times with the parameters in the history of the images, and from nothing, so that the models differ by the
    sources alone. These are points, V = S exp(2πi(ul + vm + w(n − 1))), not pixels.

    Parameters
    ----------
    one : casa_sara.casa.images.image_sets.ImageSet
        Of a run of tsara.
    injection : Injection
        Sources to inject.
    selection : Selection
        The MeasurementSets and the data selected in them.
    nthreads : int
        Number of threads.

    Returns
    -------
    dict
        Name of the source → injected_jy, flux_jy and, where there is any, offset_arcsec and fwhm_arcsec.

    Raises
    ------
    ValueError
        A source, or the circle around it, is not within the image.
    KeyboardInterrupt
        One of the runs was stopped by Ctrl-C.
    """
    plane = one.model.plane.upright()
    cell = tuple(size / ARCSEC for size in plane.cell_rad)
    x, y = np.array(list(injection.places.values()), float).T
    places = PixelMap(injection.plane.coordinates(), plane)(x, y).T
    for name, place in zip(injection.places, places):
        try:
            recovered_point(np.zeros(plane.shape), place, injection.radius, cell)
        except ValueError as error:
            raise ValueError(f"inject = '{name}' is outside of '{one.name}', or closer to its edge than "
                             f"{injection.radius:.3g} arcsec: should be inside") from error
    log.info(f"imaging '{one.name}' again without and with {len(places)} injected point sources of "
             f"{injection.flux:.4g} Jy")
    without, with_sources = _repeat(one, places, injection.flux, selection, nthreads)
    more = with_sources.astype(float) - without
    found = {}
    for name, place in zip(injection.places, places):
        measured = recovered_point(more, place, injection.radius, cell)
        found[name] = {"injected_jy": injection.flux, "flux_jy": measured["flux"]}
        if "width" in measured:
            found[name] |= {"offset_arcsec": measured["offset"], "fwhm_arcsec": measured["width"]}
    return found


def problem_of_run(one, selection: Selection, nthreads: int) -> tuple[Samples, ImageGrid, SolverOptions]:
    """Return what a run of tsara has solved, by the parameters in the history of its images.

    Parameters
    ----------
    one : casa_sara.casa.images.image_sets.ImageSet
        Of the run.
    selection : Selection
        Of the visibilities.
    nthreads : int
        Threads of the numerics.

    Returns
    -------
    samples : Samples
    grid : ImageGrid
    options : SolverOptions
        Without draws.
    """
    plane = one.model.plane.upright()
    longitude, latitude = (float(angle) for angle in plane.centre)
    grid = ImageGrid(plane.shape, plane.cell_rad, f"{plane.frame} {longitude!r}rad {latitude!r}rad",
                     gridder=one.parameters.get("gridder", "standard"), spectralindex=spectral_index_of(one))
    grid = with_spectrum(grid, plane)
    data = read_visibilities(selection, grid.phasecenter, grid.stokes, bool(grid.spectralindex))
    block_of_sample, _ = divide(data, _blocks(one.parameters.get("blocks", "0")))
    data, offsets = sort_into_blocks(data, block_of_sample)
    noise, options = noise_from_differences(data, offsets), _options(one.parameters, nthreads)
    return Samples(data, offsets, density_of(data, selection, grid, options), noise), grid, options


def _repeat(one, places, flux, selection, nthreads):
    """Return the models of the same run on the visibilities as they are, and with the sources."""
    samples, grid, options = problem_of_run(one, selection, nthreads)
    data, models = samples.data, []
    for vis in (data.vis, data.vis + _visibilities(places, flux, data, grid)):
        solved = solve_image(replace(samples, data=replace(data, vis=vis)), grid, options)
        if solved.record.stop_code == STOPPED_BY_USER:  # an unfinished run does not show the resolution
            raise KeyboardInterrupt
        models.append(solved.model)
    return models


def _visibilities(places, flux, data, grid):
    """Return complex64 (M,), the visibilities of points at pixel coordinates, with the model's spectrum there."""
    vis = np.zeros(data.size, np.complex64)
    for x, y in places:
        l, m = (grid.shape[0] // 2 - x) * grid.cell_rad[0], (y - grid.shape[1] // 2) * grid.cell_rad[1]
        towards = np.array([l, m, np.sqrt(1 - l**2 - m**2) - 1])
        vis += flux * _spectrum_at(x, y, data, grid) * np.exp(2j * np.pi * (towards @ data.uvw))
    return vis


def _spectrum_at(x, y, data, grid):
    """Return (ν/ν0)^α of each sample at a pixel, 1 where no spectral index was given."""
    if grid.spectrum is None:
        return 1.0
    index = np.asarray(grid.spectrum.index)
    index = float(index[round(x), round(y)] if index.ndim else index)
    return (data.freq_hz.astype(float) / grid.spectrum.reference_hz) ** index


def _options(parameters, nthreads) -> SolverOptions:
    """Return the solver options in a history; others have their defaults."""
    given = {field.name: _value(parameters[field.name], field.default)
             for field in fields(SolverOptions) if field.name in parameters}
    return SolverOptions(**given | {"nthreads": nthreads, "ndraws": 0, "jackknife": False})


def _blocks(text):
    """Return the blocks as they are spelt in a history: a number, a list of entries, or one."""
    try:
        blocks = ast.literal_eval(text)
    except (SyntaxError, ValueError):
        blocks = text
    return blocks if isinstance(blocks, int) else (blocks,) if isinstance(blocks, str) else tuple(blocks)


def _value(text, default):
    """Return a value as it is spelt in a history, of the kind of the default."""
    if isinstance(default, str):
        return text
    value = ast.literal_eval(text)
    return tuple(value) if isinstance(default, tuple) else value
