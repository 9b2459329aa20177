"""Comparing with tclean: the same data imaged by both, and held against each other by saracompare.

    python docs/tutorials/compare_with_tclean.py [folder]

Prints the table and draws the picture of compare_with_tclean.md.
"""

import sys
import tempfile
from pathlib import Path

import casatasks
import numpy as np

from casa_sara import saracompare, tsara
from casa_sara.demo.imagers import quiet, read_image
from casa_sara.demo.simulate import Observation, simulate_observation
from casa_sara.demo.sky import cyg_a_like

SEED = 11
NOISE_DB = 35.0
GAIN_RMS = 0.01
SIZE, CELL_ARCSEC = (160, 80), 0.2
CORE = "core = 19h59m28.356s 40d44m02.10s 1arcsec"


def simulate(folder):
    """Observe a radio galaxy with the VLA in its configuration B, with gains that are off by 1 %."""
    observation = Observation(scans=6, integrations=6, channels=1)
    return simulate_observation(folder, cyg_a_like(SIZE, CELL_ARCSEC), "B", NOISE_DB, GAIN_RMS, SEED, observation)


def main(folder):
    """Do it all; return the truth (nx, ny), the measures, and the models (nx, ny) by name."""
    with quiet(folder / "casa.txt"):
        simulation = simulate(folder)
        vis, sara, clean = simulation.vis[0], str(folder / "sara"), str(folder / "clean")
        measures = image_and_compare(vis, sara, clean, str(folder / "compared"))
    models = {name: read_image(f"{root}.model")[0] for name, root in (("tsara", sara), ("tclean", clean))}
    return simulation.truth, measures, models


def image_and_compare(vis, sara, clean, outdir):
    """The tutorial: image with both, then compare."""
    grid = dict(imsize=[160, 80], cell="0.2arcsec", weighting="briggs", robust=-1.0)
    tsara(vis=vis, imagename=sara, **grid)
    casatasks.tclean(vis=vis, imagename=clean, datacolumn="data", deconvolver="multiscale", scales=[0, 2, 6, 18],
                     smallscalebias=-0.8, gain=0.2, niter=4000, nsigma=2.0, **grid)
    return saracompare(models=[sara, clean], names=["tsara", "tclean"], vis=vis, regions=[CORE], outdir=outdir)


def as_text(truth, measures, models):
    """Return the table of the measures."""
    lines = ["| | dynamic range | noise of the residual, mJy/beam | flux, Jy | core, Jy |", "|---|---|---|---|---|"]
    for name, one in measures["products"].items():
        briggs, core = one["briggs"], one["regions"]["core"]
        lines.append(f"| {name} | {briggs['dr']:.0f} | {1e3 * briggs['sigma']:.2f} | {one['flux_jy']:.2f} "
                     f"| {core['model_flux_jy']:.3f} |")
    similar = measures["similarity"]["briggs"]["tsara|tclean"]
    return "\n".join([*lines, "", f"similarity of the models at the beam: {similar:.1f} dB"])


def draw(path, truth, models):
    """Draw the models and the truth on one logarithmic scale."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot
    from matplotlib.colors import LogNorm

    figure, axes = pyplot.subplots(1, 3, figsize=(9, 2.0), layout="constrained")
    norm = LogNorm(truth.max() / 3e3, truth.max(), clip=True)
    for axis, (title, pixels) in zip(axes, {**models, "the sky": truth}.items()):
        shown = axis.imshow(np.clip(pixels, norm.vmin, None).T, origin="lower", norm=norm, cmap="inferno")
        axis.set(xticks=[], yticks=[])
        axis.set_title(title, fontsize=10)
    figure.colorbar(shown, ax=axes, fraction=0.02, pad=0.01, label="Jy/pixel")
    figure.savefig(path, dpi=80)


if __name__ == "__main__":
    home = Path(sys.argv[1] if len(sys.argv) > 1 else tempfile.mkdtemp(prefix="compare_with_tclean-"))
    home.mkdir(parents=True, exist_ok=True)
    sky, *made = main(home)
    print(as_text(sky, *made))
    draw(home / "compare_with_tclean.png", sky, made[-1])
    print(f"{home}/compare_with_tclean.png")
