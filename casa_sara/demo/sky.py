"""The sky of the demo: a procedural radio galaxy that resembles Cygnus A.

It stands for Cygnus A at four times its distance: a quarter of its angular size
and a sixteenth of its 8.4 GHz flux density (190 Jy), so that both lobes fit an
image of 512×256 pixels of 0.06 arcsec.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

__all__ = ["Sky", "cyg_a_like", "ARCSEC", "COMPANION_JY"]

ARCSEC = np.pi / 180 / 3600
COMPANION_JY = 5e-3

TOTAL_JY = 12.0
CORE_JY = 0.1
COMPANION_OFFSET = (-0.33, -0.226)  # arcsec (east, north) of the core: 0.4 arcsec away
CORE_FWHM = 0.1  # arcsec
LENGTH = 12.6  # arcsec: from the core to the head of a lobe
POSITION_ANGLE = 17.0  # degrees, of the source axis against the east-west line
RESOLUTION = 0.12  # arcsec: FWHM below which the extended emission has no structure

# along the axis towards the west, across it towards the north [arcsec]; FWHM along and across; flux [Jy]
HOTSPOTS = (
    (11.93, 0.52, 0.30, 0.22, 0.75),
    (11.12, -0.63, 0.46, 0.26, 0.42),
    (-11.71, -0.43, 0.27, 0.20, 0.70),
    (-11.02, 0.71, 0.50, 0.30, 0.36),
)
# distance from the core along the jet [arcsec], flux [Jy]
KNOTS = ((0.95, 8e-3), (1.7, 5e-3), (2.6, 9e-3), (3.9, 6e-3), (5.4, 7e-3), (7.6, 4e-3), (-2.2, 2e-3), (-4.6, 2e-3))


@dataclass(frozen=True)
class Sky:
    """A sky brightness distribution: an image and point sources beside its pixels.

    Attributes
    ----------
    image : float64 (nx, ny)
        Flux of each pixel in Jy; pixel [nx//2, ny//2] lies on the phase centre.
    cell_rad : float
        Pixel size in radians.
    oversampling : int
        Pixels per pixel of the image to be made, along each axis.
    points : float64 (n, 3)
        Point sources: l (east), m (north) in radians, flux in Jy.
    index : float64 (nx, ny) or None
        Spectral index of each pixel, where it is not 0; point sources have spectra that are flat.
    reference_hz : float
        Frequency at which the sky is `image`, where there is an `index`.
    """

    image: np.ndarray
    cell_rad: float
    oversampling: int = 1
    points: np.ndarray = field(default_factory=lambda: np.zeros((0, 3)))
    index: np.ndarray | None = None
    reference_hz: float = 0.0

    def at(self, freq_hz: float) -> Sky:
        """Return the sky at one frequency, with flat spectra."""
        return replace(self, image=self.image * (freq_hz / self.reference_hz) ** self.index, index=None)

    def truth(self) -> np.ndarray:
        """Return what an image at the coarse cell should show, float64 (nx/k, ny/k) in Jy/pixel.

        The brightness at the coarse pixels' centres times their area, which a band-limited
        sky and its samples have in common. Point sources fall into the nearest pixel, if the image has it.
        """
        k = self.oversampling
        truth = self.image[::k, ::k] * k**2
        nx, ny = truth.shape
        for l, m, flux in self.points:
            ix, iy = round(nx // 2 - l / (k * self.cell_rad)), round(ny // 2 + m / (k * self.cell_rad))
            if 0 <= ix < nx and 0 <= iy < ny:
                truth[ix, iy] += flux
        return truth


def cyg_a_like(shape: tuple[int, int] = (512, 256), cell_arcsec: float = 0.06, oversampling: int = 2,
               seed: int = 1405) -> Sky:
    """Build the demo's radio galaxy.

    Two lobes of filaments with bright rims, two hotspots in each, a jet with knots, a core of
    0.1 Jy that is barely resolved and a point source of 5 mJy, 0.4 arcsec from the core and
    off the pixels' centres. Total flux 12 Jy.

    Parameters
    ----------
    shape : (int, int)
        Pixels of the image to be made (nx, ny).
    cell_arcsec : float
        Its pixel size.
    oversampling : int
        The sky is drawn on pixels that are this much smaller.
    seed : int
        Seed of the filaments.

    Returns
    -------
    Sky
    """
    rng = np.random.default_rng(seed)
    cell = cell_arcsec / oversampling
    west = (np.arange(shape[0] * oversampling) - shape[0] * oversampling // 2)[:, None] * cell
    north = (np.arange(shape[1] * oversampling) - shape[1] * oversampling // 2)[None, :] * cell
    cos, sin = np.cos(np.deg2rad(POSITION_ANGLE)), np.sin(np.deg2rad(POSITION_ANGLE))
    along, across = west * cos + north * sin, north * cos - west * sin

    lobes = _lobe(along, across, cell, rng) + 0.85 * _lobe(-along, -across, cell, rng)
    compact = _jet(along, across, cell)
    for a, c, fwhm_along, fwhm_across, flux in HOTSPOTS:
        compact += flux * cell**2 * _gaussian(along - a, across - c, fwhm_along, fwhm_across)
    compact += CORE_JY * cell**2 * _gaussian(along - 0.02, across + 0.013, CORE_FWHM, CORE_FWHM)
    lobes *= (TOTAL_JY - COMPANION_JY - compact.sum()) / lobes.sum()

    companion = np.array([[*np.multiply(COMPANION_OFFSET, ARCSEC), COMPANION_JY]])
    return Sky(lobes + compact, cell * ARCSEC, oversampling, companion)


def _lobe(along, across, cell, rng) -> np.ndarray:
    """Return one lobe, on the side of positive `along`: clouds and filaments, brighter at the rim and the head."""
    a = along + 0.35 * _noise(along.shape, cell, 3.0, rng)
    c = across + 0.35 * _noise(along.shape, cell, 3.0, rng)
    s = np.clip(a / LENGTH, 1e-3, 1)
    half_width = 2.7 * np.sqrt(1 - s**8) * (0.25 + 0.75 * np.sin(np.pi / 2 * np.minimum(1.5 * s, 1)) ** 1.6)
    radius = np.abs(c) / np.maximum(half_width, 1e-6)  # 1 on the outline
    depth = np.sqrt(np.clip(1 - radius**2, 0, 1)) * (a > 0)
    rim = np.exp(-(((1 - radius) / 0.1) ** 2)) * np.sqrt(depth)
    brightness = (0.03 + np.exp((a - LENGTH) / 3.8)) / (1 + np.exp((2.0 - a) / 0.45))

    clouds = depth * np.exp(0.6 * _noise(along.shape, cell, 2.0, rng))
    return _smooth(brightness * (0.5 * clouds + 0.5 * rim + _filaments(depth, cell, rng)), RESOLUTION / cell)


def _filaments(depth, cell, rng, number=420, steps=360) -> np.ndarray:
    """Return threads inside a lobe, drawn along a turbulent flow; their lengths and fluxes follow power laws."""
    shape = depth.shape
    stream = _noise(shape, cell, 3.0, rng) - 1.2 * _smooth(depth, 1.5 / cell) / 0.3
    flow = np.array(np.gradient(stream))[::-1] * [[[1]], [[-1]]]
    flow /= np.hypot(*flow) + 1e-12
    inside = np.argwhere(depth > 0.1)
    position = inside[rng.integers(len(inside), size=number)] + rng.random((number, 2))
    length = np.minimum(20 * (1 + rng.pareto(1.0, number)), steps)
    flux = 1 + rng.pareto(1.6, number)

    threads = np.zeros(shape)
    for step in range(steps):
        pixel = np.clip(position.astype(int), 0, np.subtract(shape, 2))
        taper = np.sin(np.pi * np.clip(step / length, 0, 1)) * flux
        _deposit(threads, pixel, position - pixel, taper * (depth[tuple(pixel.T)] > 0))
        position = position + flow[:, pixel[:, 0], pixel[:, 1]].T
    threads *= depth > 0
    threads += _smooth(threads, 0.35 / cell)  # thin threads in wider sheaths
    return 1.2 * threads / threads[depth > 0].mean()


def _deposit(image, pixel, fraction, flux) -> None:
    """Add `flux` (n,) to `image` at pixel + fraction (n, 2), shared among the four neighbours."""
    for dx in (0, 1):
        for dy in (0, 1):
            share = np.abs(1 - dx - fraction[:, 0]) * np.abs(1 - dy - fraction[:, 1])
            np.add.at(image, (pixel[:, 0] + dx, pixel[:, 1] + dy), share * flux)


def _jet(along, across, cell) -> np.ndarray:
    """Return the jet in Jy/pixel: a thin curved ridge that fades towards the west, and knots on both sides."""
    ridge = _bend(along)
    s = np.clip(along, 0, None)
    width = 0.15 + 0.02 * s
    profile = np.exp(-4 * np.log(2) * ((across - ridge) / width) ** 2) / width
    jet = 5e-3 * np.exp(-s / 4.5) / (1 + np.exp((0.6 - along) / 0.08)) * profile * (s < 11)
    for s, flux in KNOTS:
        jet += flux * _gaussian(along - s, across - _bend(s), 0.25, 0.16)
    return jet * cell**2


def _bend(along):
    """Return the offset of the jet's ridge from the axis."""
    return 0.006 * along**2 * np.sin(0.45 * along)


def _gaussian(x, y, fwhm_x, fwhm_y) -> np.ndarray:
    """Return a Gaussian of unit integral at the offsets x, y."""
    ln2 = np.log(2)
    return 4 * ln2 / (np.pi * fwhm_x * fwhm_y) * np.exp(-4 * ln2 * ((x / fwhm_x) ** 2 + (y / fwhm_y) ** 2))


def _wavenumbers(shape) -> np.ndarray:
    """Return |k| of an rfft2 of `shape`, in cycles per pixel."""
    return np.hypot(np.fft.fftfreq(shape[0])[:, None], np.fft.rfftfreq(shape[1])[None, :])


def _smooth(image, fwhm_pixels) -> np.ndarray:
    """Convolve (periodically) with a Gaussian of unit integral."""
    transfer = np.exp(-((np.pi * fwhm_pixels * _wavenumbers(image.shape)) ** 2) / (4 * np.log(2)))
    return np.clip(np.fft.irfft2(np.fft.rfft2(image) * transfer, image.shape), 0, None)


def _noise(shape, cell, scale, rng) -> np.ndarray:
    """Return a Gaussian random field of unit variance, its amplitude falling as k^-3 beyond 1/`scale`."""
    k = _wavenumbers(shape) / cell * scale
    field = np.fft.irfft2(np.fft.rfft2(rng.standard_normal(shape)) * k / (1 + k**2) ** 2, shape)
    return field / field.std()
