"""A first image: simulate a small observation, ask what a run takes, run tsara, and look at what it made.

    python docs/tutorials/first_image.py [folder]

Prints the numbers and draws the picture of first_image.md.
"""

import sys
import tempfile
from pathlib import Path

import numpy as np

from casa_sara import tsara
from casa_sara.analysis.metrics import snr_at_scale
from casa_sara.demo.imagers import quiet, read_image
from casa_sara.demo.simulate import Observation, simulate_observation
from casa_sara.demo.sky import cyg_a_like

SEED = 3
NOISE_DB = 35.0
GAIN_RMS = 0.01
SIZE, CELL_ARCSEC = (160, 80), 0.2
BEAM_ARCSEC = 0.8  # of the configuration B: the scale at which the model is held against the truth


def simulate(folder):
    """Observe a radio galaxy with the VLA in its configuration B, 6 scans of a minute; gains are off by 1 %."""
    observation = Observation(scans=6, integrations=6, channels=1)
    sky = cyg_a_like(SIZE, CELL_ARCSEC)
    return simulate_observation(folder, sky, "B", NOISE_DB, GAIN_RMS, SEED, observation)


def main(folder):
    """Do it all; return the truth (nx, ny), the forecast, what tsara returned, and its images by suffix."""
    with quiet(folder / "casa.txt"):
        simulation = simulate(folder)
        vis, name = simulation.vis[0], str(folder / "galaxy")
        forecast, result = make_image(vis, name)
    images = {suffix: read_image(f"{name}.{suffix}")[0] for suffix in ("model", "image", "residual")}
    return simulation.truth, forecast, result, images


def make_image(vis, name):
    """The tutorial: first ask what it takes, then do it."""
    forecast = tsara(vis=vis, imagename=name, imsize=[160, 80], cell="0.2arcsec", dryrun=True)["forecast"]
    result = tsara(vis=vis, imagename=name, imsize=[160, 80], cell="0.2arcsec")
    return forecast, result


def as_text(truth, forecast, result, images):
    """Return the numbers of a run."""
    model, blocks = images["model"], result["sara"]["blocks"]
    found = [block["noise_found"] for block in blocks]
    return "\n".join([
        f"forecast            {forecast['peak_bytes'] / 1e9:.2f} GB",
        f"stopped             {result['stopDescription']}, {result['iterdone']} iterations",
        f"flux of the model   {model.sum():.2f} Jy (truth {truth.sum():.2f} Jy)",
        f"SNR of the model    {snr_at_scale(truth, model, BEAM_ARCSEC / CELL_ARCSEC):.1f} dB at the beam, 0.8 arcsec",
        f"dynamic range       {images['image'].max() / images['residual'].std():.0f}",
        f"noise, {len(blocks)} snapshots  {min(found):.2f} to {max(found):.2f} x MS weights",
    ])


def draw(path, truth, images):
    """Draw the model, the restored image and the truth on logarithmic scales, and the residual."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot
    from matplotlib.colors import LogNorm

    figure, axes = pyplot.subplots(2, 2, figsize=(8.5, 5.0), layout="constrained")
    bright = LogNorm(truth.max() / 3e3, truth.max(), clip=True)
    beam = LogNorm(images["image"].max() / 3e3, images["image"].max(), clip=True)
    panels = [("the sky, Jy/pixel", truth, dict(norm=bright, cmap="inferno")),
              (".model, Jy/pixel", images["model"], dict(norm=bright, cmap="inferno")),
              (".image, Jy/beam", images["image"], dict(norm=beam, cmap="inferno")),
              (".residual, Jy/beam", images["residual"], dict(cmap="RdBu_r", vmin=-4 * images["residual"].std(),
                                                             vmax=4 * images["residual"].std()))]
    for axis, (title, pixels, look) in zip(axes.flat, panels):
        floor = look["norm"].vmin if "norm" in look else -np.inf
        shown = axis.imshow(np.clip(pixels, floor, None).T, origin="lower", **look)
        axis.set(xticks=[], yticks=[])
        axis.set_title(title, fontsize=10)
        figure.colorbar(shown, ax=axis, fraction=0.025, pad=0.01)
    figure.savefig(path, dpi=75)


if __name__ == "__main__":
    home = Path(sys.argv[1] if len(sys.argv) > 1 else tempfile.mkdtemp(prefix="first_image-"))
    home.mkdir(parents=True, exist_ok=True)
    sky, *made = main(home)
    print(as_text(sky, *made))
    draw(home / "first_image.png", sky, made[-1])
    print(f"{home}/first_image.png")
