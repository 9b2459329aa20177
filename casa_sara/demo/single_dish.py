"""A single-dish observation of a known sky: its image in Jy/beam, with the noise of a gridded map."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.ndimage import gaussian_filter, map_coordinates

from casa_sara.analysis.metrics import smooth

__all__ = ["ARCSEC", "dish_image", "observe_with_dish"]

ARCSEC = np.pi / 180 / 3600
KERNEL = 0.35  # FWHM of the kernel that grids the samples, of the beam
PIXELS = 7  # in a beam
SIGMA_TO_FWHM = 2.3548200450309493


def dish_image(path: str | Path, pixels: np.ndarray, cell: float, centre: tuple[float, float], beam: float,
               freq_hz: float, unit: str = "Jy/beam") -> str:
    """Write a CASA image in J2000, in SIN projection.

    Parameters
    ----------
    path : str or Path
        Where; an image there is replaced.
    pixels : real (nx, ny)
        In `unit`.
    cell, beam : float
        Pixel size and FWHM of the beam, arcsec; without a beam where that is 0.
    centre : (float, float)
        Right ascension and declination of pixel (nx//2, ny//2), degrees.
    freq_hz : float
        Frequency.
    unit : str
        Of the brightness.

    Returns
    -------
    str
        `path`.
    """
    import casatools

    csys = casatools.coordsys().newcoordsys(direction=True, spectral=True, stokes=["I"])
    csys.setreferencecode("J2000", "direction")
    csys.setprojection("SIN")
    csys.setunits(["rad", "rad", "", "Hz"])
    csys.setreferencevalue(np.radians(centre).tolist(), type="direction")
    csys.setreferencepixel([n // 2 for n in pixels.shape], type="direction")
    csys.setincrement([-cell * ARCSEC, cell * ARCSEC], type="direction")
    csys.setreferencevalue(freq_hz, type="spectral")
    ia = casatools.image()
    ia.fromshape(str(path), [*pixels.shape, 1, 1], csys=csys.torecord(), overwrite=True, log=False)
    try:
        ia.putchunk(np.asarray(pixels, float)[:, :, None, None])
        ia.setbrightnessunit(unit)
        if beam:
            ia.setrestoringbeam(f"{beam}arcsec", f"{beam}arcsec", "0deg", log=False)
    finally:
        ia.close()
    return str(path)


def observe_with_dish(path: str | Path, sky: np.ndarray, cell: float,  # noqa: PLR0913 - three have a default
                      centre: tuple[float, float], beam: float, freq_hz: float, noise: float = 0.0,
                      width: float = 0.0, seed: int = 0) -> str:
    """Write what a single dish sees of a sky, on pixels of a seventh of its beam.

    Its noise is that of independent samples gridded by a Gaussian of 0.35 of the beam.

    Parameters
    ----------
    path : str or Path
        Of the image.
    sky : real (nx, ny)
        Jy/pixel.
    cell, beam : float
        Pixel size of the sky and FWHM of the beam, arcsec.
    centre : (float, float)
        Right ascension and declination of pixel (nx//2, ny//2), degrees.
    freq_hz : float
        Frequency.
    noise : float
        Standard deviation of a pixel, Jy/beam.
    width : float
        Of the image, arcsec; that of the sky unless given.
    seed : int
        Of the noise.

    Returns
    -------
    str
        `path`.
    """
    step, wide = beam / PIXELS, width or min(sky.shape) * cell
    half = int(wide / step / 2)
    margin = int(np.ceil(max(wide / 2 + 2 * beam - min(sky.shape) * cell / 2, 0) / cell))  # the dish sees the sky there
    seen = smooth(np.pad(sky, margin), beam / cell) * (np.pi / (4 * np.log(2)) * (beam / cell) ** 2)
    places = [margin + n // 2 + np.arange(-half, half + 1) * (step / cell) for n in sky.shape]
    pixels = map_coordinates(seen, np.meshgrid(*places, indexing="ij"), order=3, mode="nearest")
    drawn = gaussian_filter(np.random.default_rng(seed).standard_normal(pixels.shape), KERNEL * PIXELS / SIGMA_TO_FWHM)
    return dish_image(path, pixels + noise * drawn / drawn.std(), step, centre, beam, freq_hz)
