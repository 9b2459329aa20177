"""A line cube: a rotating disc imaged channel by channel, and its line maps beside tclean's.

    python docs/tutorials/line_cube.py [folder]

Prints the table and draws the picture of line_cube.md.
"""

import sys
import tempfile
from dataclasses import replace
from pathlib import Path

import casatasks
import numpy as np
from casatools import table

from casa_sara import saracompare, tsara
from casa_sara.demo.imagers import quiet
from casa_sara.demo.predict import predict
from casa_sara.demo.simulate import SPEED_OF_LIGHT, Observation, simulate_observation
from casa_sara.demo.sky import ARCSEC, Sky

SEED = 21
SIZE, CELL_ARCSEC = 96, 12.0
CHANNELS, WIDTH_KM_S = 8, 40.0
NOISE_JY = 0.08  # of Re and of Im of one hand, for a sample of one channel
FLUX_JY_KM_S = 60.0
ROTATION_KM_S, DISPERSION_KM_S = 130.0, 25.0
REST_HZ = 1.420405752e9


def disc():
    """A disc of 5' with spiral arms, inclined and turning: Jy/pixel in each channel, (nx, ny, channels)."""
    west, north = ((np.indices((SIZE, SIZE)) - SIZE // 2) * CELL_ARCSEC)
    along, across = 0.8 * west + 0.6 * north, (0.8 * north - 0.6 * west) / 0.6
    radius, angle = np.hypot(along, across), np.arctan2(across, along)
    brightness = np.exp(-((radius / 150.0) ** 2)) * (1 + 0.8 * np.cos(2 * angle - radius / 40.0)) * (radius < 330)
    velocity = ROTATION_KM_S * np.tanh(radius / 60.0) * np.cos(angle)
    line = np.exp(-0.5 * ((velocity[..., None] - channel_velocities()) / DISPERSION_KM_S) ** 2)
    cube = brightness[..., None] * line
    return FLUX_JY_KM_S / WIDTH_KM_S * cube / cube.sum()


def channel_velocities():
    """Radio velocity in the middle of each channel, km/s."""
    return ((CHANNELS - 1) / 2 - np.arange(CHANNELS)) * WIDTH_KM_S


def simulate(folder):
    """Observe the disc with the VLA in its configuration D; return the MeasurementSet."""
    cube = disc()
    sky = Sky(cube.sum(axis=2), CELL_ARCSEC * ARCSEC)
    width_hz = REST_HZ * WIDTH_KM_S * 1e3 / SPEED_OF_LIGHT
    observation = Observation(freq_hz=REST_HZ, channel_hz=width_hz, channels=CHANNELS, scans=4, integrations=4)
    (vis,) = simulate_observation(folder, sky, "D", observation=observation).vis
    tb, rng = table(), np.random.default_rng(SEED)
    tb.open(vis, nomodify=False)
    uvw = tb.getcol("UVW")
    data = np.array([predict(replace(sky, image=cube[..., k]), uvw * freq / SPEED_OF_LIGHT)
                     for k, freq in enumerate(observation.channel_freqs_hz)])
    noise = rng.standard_normal((2, 2, *data.shape))
    tb.putcol("DATA", (data + NOISE_JY * (noise[0] + 1j * noise[1])).astype(np.complex64))
    tb.putcol("SIGMA", np.full((2, uvw.shape[1]), NOISE_JY))
    tb.putcol("WEIGHT", np.full((2, uvw.shape[1]), NOISE_JY**-2))
    tb.close()
    return vis


def main(folder):
    """Do it all; return the channels that tsara recorded, and the measures of the comparison."""
    with quiet(folder / "casa.txt"):
        vis, sara, clean = simulate(folder), str(folder / "sara"), str(folder / "clean")
        return image_and_compare(vis, sara, clean, str(folder / "compared"))


def image_and_compare(vis, sara, clean, outdir):
    """The tutorial: image the channels with both, then compare."""
    grid = dict(imsize=96, cell="12arcsec", specmode="cube", restfreq="1.420405752GHz", interpolation="nearest")
    result = tsara(vis=vis, imagename=sara, **grid)
    casatasks.tclean(vis=vis, imagename=clean, datacolumn="data", deconvolver="multiscale", scales=[0, 4, 10],
                     gain=0.2, niter=20000, nsigma=2.0, **grid)
    measures = saracompare(models=[sara, clean], names=["tsara", "tclean"], vis=vis, outdir=outdir)
    return result["sara"]["channels"], measures


def as_text(channels, measures):
    """Return the tables: of the channels, and of the line."""
    lines = ["| channel | velocity, km/s | true flux, Jy | tsara, Jy | tclean, Jy | noise found | ended |",
             "|---|---|---|---|---|---|---|"]
    truth = disc().sum(axis=(0, 1))
    for k, (one, measured) in enumerate(zip(channels, measures["channels"])):
        ours, theirs = (measured["products"][name]["flux_jy"] for name in ("tsara", "tclean"))
        found = np.median([block["noise_found"] for block in one["blocks"]])
        lines.append(f"| {k} | {measured['velocity_km_s']:.0f} | {truth[k]:.3f} | {ours:.3f} | {theirs:.3f} "
                     f"| {found:.2f} | {one['stopDescription']} |")
    both = measures["products"]
    lines += ["", f"flux of the line: true {FLUX_JY_KM_S:.1f}, tsara {both['tsara']['line_flux']:.1f}, tclean "
              f"{both['tclean']['line_flux']:.1f} Jy km/s"]
    similar = measures["similarity"]["tsara|tclean"]
    return "\n".join([*lines, f"moment 0: similarity {similar['moment0_db']:.1f} dB; moment 1 differs by "
                      f"{similar['moment1_rms']:.1f} km/s"])


def draw(path, folder):
    """Keep the line maps of the report, smaller."""
    from PIL import Image

    with Image.open(folder / "compared" / "moments.png") as picture:
        small = picture.convert("RGB").resize([side * 9 // 20 for side in picture.size], Image.Resampling.LANCZOS)
    small.quantize(128, Image.Quantize.MAXCOVERAGE).save(path, optimize=True)


if __name__ == "__main__":
    home = Path(sys.argv[1] if len(sys.argv) > 1 else tempfile.mkdtemp(prefix="line_cube-"))
    home.mkdir(parents=True, exist_ok=True)
    print(as_text(*main(home)))
    draw(home / "line_cube.png", home)
    print(f"{home}/line_cube.png")
