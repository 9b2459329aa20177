"""The scenes of faint.py: skies of random shape at a stated signal-to-noise ratio, observed by several arrays.

    scene = SETS["chosen"][0]
    simulate(scene, folder)              # folder/obs.ms and folder/truth.npz
    truth = Truth.read(folder)

A sky is drawn on a grid three times finer than the image's; pixel 3i of it lies on the centre of pixel i of the image.
The peak signal-to-noise ratio is that of the natural dirty image: its peak, without noise, over its noise. Every scan
has four integrations or more, so short that the sky barely changes between them: differences of successive ones show
the noise. WEIGHT is 1/σ² of each correlation.
"""

from __future__ import annotations

import shutil
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

__all__ = ["FINER", "SETS", "Scene", "Truth", "binned", "dirty_image", "gaussian", "natural_beam", "simulate",
           "write_observed"]

FINER = 3
FLUX_JY = 0.1
BLANK_NOISE_JY = 1e-3
FWHM = 2 * np.sqrt(2 * np.log(2))
SIGNAL_TO_NOISE = (5, 10, 30, 100, 300)
# antenna file, frequency, scans, integrations and their seconds, channels, hour angles, declinations, image size
ARRAYS = {
    "ALMA-compact": ("alma.cycle8.3", 230e9, 6, 4, 10, 1, (-1.5, 1.5), (-50, 0), 256),
    "ALMA-extended": ("alma.cycle8.6", 230e9, 6, 4, 6, 1, (-1.5, 1.5), (-50, 0), 256),
    "7-m": ("aca.cycle8", 230e9, 24, 8, 10, 2, (-2, 2), (-50, 0), 128),
    "VLA-A": ("vla.a", 8.4e9, 12, 5, 5, 1, (-4, 4), (10, 60), 256),
    "VLA-C": ("vla.c", 8.4e9, 12, 5, 10, 1, (-4, 4), (10, 60), 256),
    "snapshot": ("vla.b", 8.4e9, 1, 60, 5, 1, (0.5, 1.5), (10, 60), 256),
}


SMALL = {"7-m": 0.5}  # extended sources are this much smaller, so that the shortest baselines see their flux


@dataclass(frozen=True)
class Scene:
    """A sky, the S/N of its peak (0 for a blank one), who observes it, and the seed of all that is random."""

    group: str
    sky: str
    peak: int
    array: str
    seed: int

    @property
    def label(self) -> str:
        """The scene in words; also the name of its folder."""
        return f"{self.group}_{self.sky}_{self.peak}_{self.array}"

    @property
    def size(self) -> int:
        """Pixels of the image along each axis."""
        return ARRAYS[self.array][-1]


@dataclass(frozen=True)
class Truth:
    """What a scene is known to hold.

    `fine` and `img` are in Jy/pixel of either grid, `noise` that of the natural dirty image in Jy/beam, and `beam` its
    restoring beam: both widths in pixels of the image, and the position angle in degrees.
    """

    fine: np.ndarray
    img: np.ndarray
    cell_arcsec: float
    noise: float
    beam: tuple[float, float, float]

    @classmethod
    def read(cls, folder: Path) -> Truth:
        """Read what :func:`simulate` wrote."""
        with np.load(folder / "truth.npz") as kept:
            return cls(kept["fine"], kept["img"], float(kept["cell_arcsec"]), float(kept["noise"]), tuple(kept["beam"]))

    def smoothed(self, beams: float) -> np.ndarray:
        """The sky smoothed to a number of beams on the fine grid, at the centres of the image's pixels, in Jy/pixel."""
        from casa_sara.analysis.metrics import smooth

        major, minor, angle = self.beam
        fine = smooth(self.fine, [FINER * beams * major, FINER * beams * minor], angle)
        return fine[::FINER, ::FINER] * FINER**2


def scenes(group: str, family: int, turn: int) -> list[Scene]:
    """Return every sky at every signal-to-noise ratio, the arrays taking turns, and four blank skies."""
    names = list(ARRAYS)
    made = []
    for number, sky in enumerate(("compact", "points", "disc", "cloud", "arcs")):
        for step, peak in enumerate(SIGNAL_TO_NOISE):
            array = names[(turn + number + step) % len(names)]
            made.append(Scene(group, sky, peak, array, 1000 * family + 10 * number + step))
    blank = [names[(turn + step) % len(names)] for step in (0, 2, 3, 5)]
    return made + [Scene(group, "blank", 0, array, 1000 * family + 90 + step) for step, array in enumerate(blank)]


SETS = {"chosen": scenes("chosen", 1, 0), "apart": scenes("apart", 2, 2)}


def sky_image(name: str, rng, n: int, beam: float, extent: float = 1.0) -> np.ndarray:
    """Draw a sky of unit flux (none, for 'blank') on n × n pixels.

    `beam` is the width of the beam in these pixels, and `extent` a factor on the size of extended sources.
    """
    x = (np.arange(n) - n // 2)[:, None] * np.ones(n)
    image = {"compact": compact, "points": points, "disc": disc, "cloud": cloud, "arcs": arcs, "blank": blank}[name](
        rng, x, x.T, beam, extent)
    return image if name == "blank" else image / image.sum()


def blank(rng, x, y, beam, extent):
    """Nothing."""
    return np.zeros_like(x)


def gaussian(x, y, place, fwhm, ratio=1.0, angle=0.0):
    """A Gaussian of unit integral at `place`; `ratio` is that of its axes."""
    cos, sin = np.cos(angle), np.sin(angle)
    along, across = (x - place[0]) * cos + (y - place[1]) * sin, (y - place[1]) * cos - (x - place[0]) * sin
    sigma = fwhm / FWHM
    return np.exp(-0.5 * (along**2 + (across / ratio) ** 2) / sigma**2) / (2 * np.pi * sigma**2 * ratio)


def off_pixels(rng, n, number, part=0.7):
    """Random pixels in the middle `part` of the fine grid, none of them on the centre of a pixel of the image."""
    low, high = int(n * (1 - part) / 2) // FINER, int(n * (1 + part) / 2) // FINER
    shift = rng.integers(1, FINER**2, number)
    return FINER * rng.integers(low, high, (number, 2)) + np.column_stack([shift // FINER, shift % FINER])


def compact(rng, x, y, beam, extent):
    """Twelve Gaussians of 0.2 to 1.5 beams and eight points, over a factor of twenty in flux."""
    n, image = len(x), np.zeros_like(x)
    for place in rng.uniform(-0.35 * n, 0.35 * n, (12, 2)):
        width = beam * 0.2 * 7.5 ** rng.uniform()
        image += 20 ** -rng.uniform() * gaussian(x, y, place, width, rng.uniform(0.5, 1), rng.uniform(0, np.pi))
    np.add.at(image, tuple(off_pixels(rng, n, 8).T), 20 ** -rng.uniform(size=8))
    return image


def points(rng, x, y, beam, extent):
    """Thirty unresolved sources over a factor of thirty in flux."""
    image = np.zeros_like(x)
    np.add.at(image, tuple(off_pixels(rng, len(x), 30, 0.8).T), 30 ** -rng.uniform(size=30))
    return image


def disc(rng, x, y, beam, extent):
    """An inclined disc with two to four gaps, brighter on one side, with or without a bright centre."""
    n, angle, tilt = len(x), rng.uniform(0, np.pi), np.cos(np.deg2rad(rng.uniform(20, 65)))
    x, y = x - rng.uniform(-1, 1) * beam, y - rng.uniform(-1, 1) * beam
    along, across = x * np.cos(angle) + y * np.sin(angle), (y * np.cos(angle) - x * np.sin(angle)) / tilt
    radius, edge = np.hypot(along, across), n * extent * rng.uniform(0.15, 0.25)
    profile = (1 + (radius / (0.2 * edge)) ** 2) ** -rng.uniform(0.4, 0.8) * np.exp(-((radius / edge) ** 8))
    for place in rng.uniform(0.2, 0.9, rng.integers(2, 5)) * edge:
        width = beam * rng.uniform(0.2, 0.6)
        profile *= 1 - rng.uniform(0.5, 0.95) * np.exp(-0.5 * ((radius - place) / width) ** 2)
    return profile * (1 + rng.uniform(0, 0.4) * np.cos(np.arctan2(across, along) - rng.uniform(0, 2 * np.pi)))


def cloud(rng, x, y, beam, extent):
    """A turbulent cloud: the exponential of a random field of a power law, in an elliptical envelope."""
    n = len(x)
    wavenumber = np.hypot(np.fft.fftfreq(n)[:, None], np.fft.rfftfreq(n)[None, :]) + 1 / n
    spectrum = np.fft.rfft2(rng.standard_normal((n, n))) * wavenumber ** -rng.uniform(1.5, 2.0)
    field = np.fft.irfft2(spectrum, (n, n))
    place, width = rng.uniform(-0.06, 0.06, 2) * n, n * extent * rng.uniform(0.22, 0.34)
    envelope = gaussian(x, y, place, width, rng.uniform(0.5, 1), rng.uniform(0, np.pi))
    return np.exp(rng.uniform(0.6, 1.0) * field / field.std()) * envelope


def arcs(rng, x, y, beam, extent):
    """A source of a few Gaussians behind an isothermal lens in a shear, which bends it into arcs."""
    radius, strength, turn = beam * extent * rng.uniform(3.5, 6), rng.uniform(0.05, 0.15), rng.uniform(0, np.pi)
    distance = np.hypot(x, y) + 1e-3
    cos, sin = strength * np.cos(2 * turn), strength * np.sin(2 * turn)
    behind = (x * (1 - radius / distance - cos) - y * sin, y * (1 - radius / distance + cos) - x * sin)
    centre = radius * rng.uniform(0.05, 0.3) * np.array([np.cos(angle := rng.uniform(0, 2 * np.pi)), np.sin(angle)])
    image = np.zeros_like(x)
    for _ in range(rng.integers(1, 4)):
        place, width = centre + rng.normal(0, 0.1 * radius, 2), beam * rng.uniform(0.3, 1.0)
        image += rng.uniform(0.3, 1) * gaussian(*behind, place, width, rng.uniform(0.5, 1), rng.uniform(0, np.pi))
    return image


def binned(fine):
    """The flux of the image's pixels, whose centres are those of every third pixel of the fine grid."""
    n = len(fine) // FINER
    return np.roll(fine, FINER // 2, (0, 1)).reshape(n, FINER, n, FINER).sum(axis=(1, 3))


def laid_out(scene: Scene, folder: Path, rng):
    """Write a MeasurementSet without signal; return its baselines in wavelengths, (3, channels × rows)."""
    from casatools import table

    from casa_sara.demo.simulate import SPEED_OF_LIGHT, Observation, simulate_observation
    from casa_sara.demo.sky import Sky

    file, freq, scans, integrations, seconds, channels, hours, declinations, _ = ARRAYS[scene.array]
    minutes = round(60 * rng.uniform(*declinations))
    sign, (degrees, minutes) = "-" if minutes < 0 else "", divmod(abs(minutes), 60)
    vla = file.startswith("vla")
    observation = Observation(
        telescope="VLA" if vla else "ALMA", antenna_file=f"alma/simmos/{file}.cfg", source="target",
        direction=("16h00m00.0s", f"{sign}{degrees}d{minutes:02d}m00.0s"), freq_hz=freq, channel_hz=100e6,
        channels=channels, correlations="RR LL" if vla else "XX YY", hour_angles=hours, scans=scans,
        integrations=integrations, integration_s=seconds,
    )  # fmt: skip
    simulate_observation(folder, Sky(np.zeros((4, 4)), 1e-6), ("obs",), np.inf, observation=observation)
    tb = table()
    tb.open(str(folder / "obs.ms"))
    uvw = tb.getcol("UVW")
    tb.close()
    return (uvw[:, None, :] * (observation.channel_freqs_hz / SPEED_OF_LIGHT)[:, None]).reshape(3, -1)


def dirty_image(vis, uvw, cell, n):
    """The natural dirty image of visibilities of equal weights, Jy/beam."""
    import finufft

    x, y = (np.ascontiguousarray(sign * 2 * np.pi * cell * axis) for sign, axis in zip((-1, 1), uvw))
    return finufft.nufft2d1(x, y, np.ascontiguousarray(vis, complex), (n, n), isign=-1, eps=1e-9).real / len(vis)


def natural_beam(uvw) -> tuple[float, float, float]:
    """Fit a Gaussian to the main lobe of the natural beam; return both widths in radians and the angle in degrees."""
    from scipy.ndimage import label
    from scipy.optimize import curve_fit

    n, cell = 64, 0.08 / np.sqrt(np.mean(uvw[0] ** 2 + uvw[1] ** 2) / 2)
    beam = dirty_image(np.ones(uvw.shape[1]), uvw, cell, n)
    lobes = label(beam > 0.35)[0]
    pixels = np.argwhere(lobes == lobes[n // 2, n // 2])
    east, north = n // 2 - pixels[:, 0], pixels[:, 1] - n // 2

    def lobe(_, ee, en, nn):
        return np.exp(-(ee * east**2 + 2 * en * east * north + nn * north**2))

    ee, en, nn = curve_fit(lobe, None, beam[tuple(pixels.T)], (0.1, 0.0, 0.1))[0]
    (least, most), axes = np.linalg.eigh([[ee, en], [en, nn]])
    major, minor = (2 * np.sqrt(np.log(2) / value) * cell for value in (least, most))
    return major, minor, float(np.rad2deg(np.arctan2(*axes[:, 0])))


def simulate(scene: Scene, folder: Path) -> None:
    """Write obs.ms and truth.npz unless they are there."""
    from casa_sara.demo.imagers import quiet
    from casa_sara.demo.predict import predict
    from casa_sara.demo.sky import ARCSEC, Sky

    if (folder / "truth.npz").exists():
        return
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    rng = np.random.default_rng(scene.seed)
    with quiet(folder / "simulation.txt"):
        uvw = laid_out(scene, folder, rng)
    major, minor, angle = natural_beam(uvw)
    cell = round(minor / rng.uniform(5, 8) / ARCSEC, 4) * ARCSEC
    beam = np.array([major / cell, minor / cell, angle])
    fine = FLUX_JY * sky_image(scene.sky, rng, FINER * scene.size, FINER * np.sqrt(beam[0] * beam[1]),
                             SMALL.get(scene.array, 1.0))
    vis = predict(Sky(fine, cell / FINER), uvw)
    noise = BLANK_NOISE_JY
    if scene.sky != "blank":
        noise = dirty_image(vis, uvw, cell, scene.size).max() / scene.peak
    write_observed(folder, rng, vis, noise)
    np.savez_compressed(folder / "truth.npz", fine=fine.astype(np.float32), img=binned(fine), cell_arcsec=cell / ARCSEC,
                        noise=noise, beam=beam, visibilities=vis.size)


def write_observed(folder: Path, rng, vis: np.ndarray, noise: float) -> None:
    """Write visibilities into both correlations of obs.ms, with noise that is `noise` in the natural dirty image."""
    from casatools import table

    sigma = noise * np.sqrt(2 * vis.size)  # of Re and of Im of one correlation
    draw = rng.standard_normal((2, 2, vis.size))
    tb = table()
    tb.open(str(folder / "obs.ms"), nomodify=False)
    shape = tb.getcol("DATA").shape
    tb.putcol("DATA", (vis + sigma * (draw[0] + 1j * draw[1])).reshape(shape).astype(np.complex64))
    tb.putcol("SIGMA", np.full((2, shape[2]), sigma))
    tb.putcol("WEIGHT", np.full((2, shape[2]), sigma**-2))
    tb.close()
