"""Total power of an image: where the single dish is looked at, and what of it the image can hold."""

from __future__ import annotations

import numpy as np

from casa_sara.casa.images.single_dish import COARSEST, frequency_of, read_dish_image, read_dish_psf
from casa_sara.casa.images.sky_image import SkyPlane
from casa_sara.casa.runtime import log
from casa_sara.operators.beams import LEAST
from casa_sara.operators.single_dish import GaussianBeam, ImagedBeam, Points, SingleDishOperator
from casa_sara.reconstruction.flat_noise import FlatNoise
from casa_sara.reconstruction.total_power import TotalPower

__all__ = ["total_power"]

INSIDE = 0.8  # of the beam around a point, that must be in the part of the sky that is modelled
FEWEST = 4  # points
SAME_FREQUENCY = 0.02
GAP = 0.05  # of the flux that the dish passes at the shortest baseline
ARCSEC = np.pi / 180 / 3600


def total_power(asked, data, plane, grid):
    """Return what a single dish tells of the sky of an image.

    It measures the sky itself. The image is that of a mosaic times its sensitivity, or else the sky times the primary
    beam, by which it is divided; where that is below a tenth, or below pblimit, nothing is known of the sky, and points
    are taken where four fifths of the dish's beam are elsewhere.

    Parameters
    ----------
    asked : casa_sara.options.SingleDish
        Names of image and beam, and the gain.
    data : casa_sara.data.visibilities.Visibilities
        The samples.
    plane : casa_sara.casa.images.image_plane.ImagePlane
        Coordinates, frequency and primary beam of the image.
    grid : casa_sara.options.ImageGrid
        Size and pixels of the image.

    Returns
    -------
    TotalPower or None
        None where no image is given.

    Raises
    ------
    FileNotFoundError, ValueError
        The image cannot serve: it is absent, in a wrong unit, without a beam, of another frequency, as fine as the
        visibilities, or elsewhere.
    """
    if not asked.image:
        return None
    image = read_dish_image(asked.image)
    _check_frequency(image, plane)
    beam = _beam(asked, image, plane)
    _check_beam(image, beam, data)
    sensitivity = FlatNoise.of(data, grid).sensitivity if grid.is_mosaic else _at_least(plane.pb, LEAST)
    over = np.zeros(grid.shape, np.float32)
    np.divide(1, sensitivity, out=over, where=sensitivity > 0, casting="same_kind")
    points = Points.within(grid.shape, grid.cell_rad, beam.width)
    everywhere = points.size
    points = points.only(_inside(points, beam, grid, sensitivity > 0))
    modelled = points.size
    values = image.at(plane, *points.pixels(grid.shape, grid.cell_rad))
    points = points.only(np.isfinite(values))
    if points.size < FEWEST:
        raise ValueError(f"sdimage = '{asked.image}': of {everywhere} points of the image, half a beam "
                         f"({0.5 * beam.width / ARCSEC:.3g} arcsec) apart, {modelled} are so far inside of what is "
                         f"modelled that the dish sees nothing else there, and sdimage holds {points.size} of these: "
                         f"should be at least {FEWEST}; a larger imsize, or an sdimage of this part of the sky")
    log.info(f"total power: {points.size} points of '{asked.image}', half a beam ({0.5 * beam.width / ARCSEC:.3g} "
             f"arcsec) apart, as far as the image reaches; {modelled - points.size} more are not in sdimage")
    return TotalPower(asked.gain * values[np.isfinite(values)], points, beam, grid.cell_rad, over)


def _at_least(pb, least):
    """The primary beam where it is above a limit, else 0."""
    return np.where(pb > least, pb, 0)


def _beam(asked, image, plane):
    """Return the beam of the dish on the plane of the image."""
    turn = image.turn(plane)
    if asked.psf:
        return ImagedBeam(*read_dish_psf(asked.psf), turn)
    if image.beam is None:
        raise ValueError(f"sdimage = '{asked.image}' has no beam in its header: should have one (imhead sets it), or "
                         "sdpsf should be an image of the beam")
    return GaussianBeam(image.beam[0], image.beam[1], image.beam[2] + turn)


def _check_frequency(image, plane):
    """Raise unless the image is of the frequency of the single dish."""
    own = frequency_of(SkyPlane(plane.csys, plane.shape))
    if image.freq_hz is None:
        log.warn(f"sdimage = '{image.name}' does not say its frequency: it is taken to be that of the image")
    elif abs(image.freq_hz - own) > SAME_FREQUENCY * own:
        raise ValueError(f"sdimage = '{image.name}' is of {image.freq_hz / 1e9:.6g} GHz, the image of {own / 1e9:.6g} "
                         f"GHz: should be within {100 * SAME_FREQUENCY:g} %")


def _check_beam(image, beam, data):
    """Raise where the beam is no single dish's; note a gap between it and the baselines."""
    finest = 1 / max(data.max_uv, 1e-30)
    if beam.width <= finest:
        raise ValueError(f"sdimage = '{image.name}' has a beam of {beam.width / ARCSEC:.3g} arcsec, the finest fringe "
                         f"of vis is {finest / ARCSEC:.3g} arcsec: should be wider than what the visibilities resolve; "
                         "startmodel takes images as fine as that")
    if max(image.plane.cell_rad) > COARSEST * beam.width:
        raise ValueError(f"sdimage = '{image.name}' has pixels of {max(image.plane.cell_rad) / ARCSEC:.3g} arcsec and "
                         f"a beam of {beam.width / ARCSEC:.3g} arcsec: should have two pixels or more in a beam")
    passed = float(abs(beam.transform(np.array([0.0]), np.array([data.min_uv]))[0]) / beam.solid_angle)
    if passed < GAP:
        data.notes.append(f"sdimage passes {100 * passed:.2g} % of what the shortest baseline sees "
                          f"({1 / data.min_uv / ARCSEC:.3g} arcsec): nothing measures the scales between it and the "
                          f"beam of {beam.width / ARCSEC:.3g} arcsec, and the flux scales of both cannot be compared")


def _inside(points, beam, grid, modelled):
    """Whether the beam around each point is in the modelled part of the image, but for a fifth of it; bool (N,)."""
    operator = SingleDishOperator(points, beam, grid.shape, grid.cell_rad)
    seen = operator.forward(modelled.astype(np.float32)).view(np.float32)[: points.size]
    return seen > INSIDE * beam.solid_angle / (grid.cell_rad[0] * grid.cell_rad[1])
