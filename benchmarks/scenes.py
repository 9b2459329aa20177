"""Simulated observations for studies: the skies of ../shared/data and our own, as MeasurementSets of known truth.

    sky = scene_sky("M31", cell_arcsec=0.06)
    simulation = observe(sky, folder, ARRAYS["VLA A-D"], noise_db=30, gain_rms=0.01, seed=3)

`simulation.vis`, `.truth`, `.cell_arcsec` and `.blocks` (true noise and error norms of every snapshot) are all a
study needs.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from astropy.io import fits
from scipy.ndimage import map_coordinates

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from casa_sara.analysis.metrics import smooth
from casa_sara.demo.simulate import SPEED_OF_LIGHT, Observation, Simulation, antennas, simulate_observation
from casa_sara.demo.sky import ARCSEC, Sky, cyg_a_like

__all__ = ["ARRAYS", "SCENES", "Array", "nominal_cell_arcsec", "observe", "replace", "scene_sky", "smoothed_truth"]

DATA = Path(__file__).resolve().parents[2] / "shared/data/skies"
FLUX_JY = 10.0
SIZE = 256

# file, background to subtract, and how its pixels become 256²: 'all', the 'centre', or 'bin'ned by 2
REFERENCE = {
    "M31": ("M31_256.fits", 0.0, "all"),
    "W28": ("W28_256.fits", 0.0, "all"),
    "30dor": ("30dor_256.fits", 2.6, "all"),
    "3c353": ("3c353_512.fits", 0.0, "bin"),
    "3c295": ("3c295_512.fits", 0.0, "centre"),
    "3c196": ("3c196_512.fits", 0.0, "centre"),
}
SCENES = ("cyga", *REFERENCE, "points on pixels", "points off pixels")


@dataclass(frozen=True)
class Array:
    """A telescope with the configurations it observes in, one after the other."""

    observation: Observation
    configs: tuple[str, ...]


VLA = Observation()
ALMA = Observation(
    telescope="ALMA", antenna_file="alma/simmos/{}.cfg", source="target", direction=("15h00m00.0s", "-30d00m00.0s"),
    freq_hz=230e9, channel_hz=500e6, correlations="XX YY", hour_angles=(-0.5, 0.5), scans=1, integrations=8,
    integration_s=30.0,
)  # fmt: skip
ARRAYS = {
    "VLA A-D": Array(VLA, tuple("ABCD")),
    "VLA A": Array(VLA, ("A",)),
    "VLA C": Array(VLA, ("C",)),
    "ALMA snapshot": Array(ALMA, ("alma.cycle8.5",)),
}


def nominal_cell_arcsec(array: Array) -> float:
    """Return the pixel size of the nominal resolution, 1/(2B) with B the longest baseline in wavelengths."""
    longest = 0.0
    for config in array.configs:
        (x, y, z, _), _, _ = antennas(array.observation, config)
        longest = max(longest, *(np.hypot(np.hypot(x - x[i], y - y[i]), z - z[i]).max() for i in range(x.size)))
    return 0.5 * SPEED_OF_LIGHT / array.observation.freq_hz / longest / ARCSEC


def scene_sky(name: str, cell_arcsec: float = 0.06, flux_jy: float = FLUX_JY, oversampling: int = 1) -> Sky:
    """Return a scene for an image with pixels of `cell_arcsec`, scaled to a total flux; 'cyga' is the demo's.

    Its own pixels are `oversampling` times smaller. Where these are smaller than the file's, a reference sky is
    interpolated by cubic splines and lies half a pixel of the image off its grid.
    """
    if name == "cyga":
        sky = cyg_a_like(oversampling=max(2, oversampling))
        return replace(sky, cell_rad=cell_arcsec * ARCSEC / sky.oversampling)
    if name.startswith("points"):
        return _points(cell_arcsec, flux_jy, name.endswith("on pixels"), oversampling)
    file, background, how = REFERENCE[name]
    image = np.clip(fits.getdata(DATA / file).squeeze().T.astype(float) - background, 0, None)
    if how == "centre":
        first = (image.shape[0] - SIZE) // 2
        image = image[first : first + SIZE, first : first + SIZE]
    elif how == "bin" and oversampling == 1:
        image = image.reshape(SIZE, 2, SIZE, 2).sum(axis=(1, 3))
    if oversampling > 1:
        image = _between_pixels(image, SIZE * oversampling)
    return Sky(image * (flux_jy / image.sum()), cell_arcsec * ARCSEC / oversampling, oversampling)


def _between_pixels(image, size):
    """Interpolate an image to (size, size) by cubic splines, half a pixel of the image to be made off its grid;
    never negative."""
    places = (np.arange(size) - size // 2) * (image.shape[0] / size) + image.shape[0] // 2 + 0.5 * image.shape[0] / SIZE
    fine = map_coordinates(image, np.meshgrid(places, places, indexing="ij"), order=3, mode="constant")
    return np.clip(fine, 0, None)


def _points(cell_arcsec, flux_jy, on_pixels, oversampling=1, number=60, seed=77):
    """Unresolved sources over three decades of brightness, and as much flux again in extended emission below them."""
    rng = np.random.default_rng(seed)
    size = SIZE * oversampling
    x, y = np.meshgrid(*[(np.arange(size) - size // 2) / oversampling] * 2, indexing="ij")
    extended = np.zeros((size, size))
    for _ in range(25):
        (cx, cy), width = rng.normal(0, 30, 2), rng.uniform(5, 18)
        extended += rng.exponential() * np.exp(-((x - cx) ** 2 + (y - cy) ** 2) / (2 * width**2)) / width
    fluxes = 10 ** -np.linspace(0, 3, number)
    places = rng.uniform(-0.4, 0.4, (number, 2)) * SIZE
    if on_pixels:
        places = np.rint(places)
    points = np.column_stack([places * cell_arcsec * ARCSEC, fluxes * (0.5 * flux_jy / fluxes.sum())])
    return Sky(extended * (0.5 * flux_jy / extended.sum()), cell_arcsec * ARCSEC / oversampling, oversampling, points)


def smoothed_truth(sky: Sky, fwhm, position_angle_deg=0.0) -> np.ndarray:
    """Return the sky convolved with a Gaussian, its point sources at their places between the pixels, in Jy/pixel.

    It is smoothed on its own pixels and sampled at those of the image. Parameters are those of
    :func:`casa_sara.analysis.metrics.smooth`, in pixels of the image.
    """
    k = sky.oversampling
    smoothed = smooth(sky.image, np.multiply(fwhm, k), position_angle_deg)[::k, ::k] * k**2
    nx, ny = smoothed.shape
    cell = sky.cell_rad * k
    major, minor = np.broadcast_to(fwhm, 2)
    sin, cos = np.sin(np.deg2rad(position_angle_deg)), np.cos(np.deg2rad(position_angle_deg))
    for l, m, flux in sky.points:
        east = -(np.arange(nx) - nx // 2)[:, None] - l / cell
        north = (np.arange(ny) - ny // 2)[None, :] - m / cell
        along, across = north * cos + east * sin, east * cos - north * sin
        exponent = -4 * np.log(2) * ((along / major) ** 2 + (across / minor) ** 2)
        smoothed += flux * 4 * np.log(2) / (np.pi * major * minor) * np.exp(exponent)
    return smoothed


def observe(sky: Sky, folder: str | Path, array: Array = ARRAYS["VLA A-D"], noise_db=35.0, gain_rms=0.0,
            seed=1) -> Simulation:
    """Simulate an observation of a sky into a new or empty folder."""
    Path(folder).mkdir(parents=True, exist_ok=True)
    return simulate_observation(folder, sky, array.configs, noise_db, gain_rms, seed, array.observation)
