"""Choosing cell and blocks: one sky on pixels of several sizes, and noisy snapshots with one bound each or for all.

    python docs/tutorials/cell_and_blocks.py [folder]

Prints the tables and draws the picture of cell_and_blocks.md.
"""

import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from casa_sara import tsara
from casa_sara.analysis.metrics import smooth, snr
from casa_sara.demo.imagers import quiet, read_image
from casa_sara.demo.simulate import Observation, simulate_observation
from casa_sara.demo.sky import cyg_a_like

SEED = 2
NOISE_DB = 35.0
CELLS = (0.25, 0.2, 0.1)  # arcsec
FINE, WIDE = 0.05, (32.0, 16.0)  # arcsec: pixels that the sky is drawn on, and its extent
BEAM_ARCSEC = 0.8
FRINGE_ARCSEC = 0.66  # 1/B of the longest baseline
TOO_LARGE = 0.4  # above half a fringe


@dataclass
class Run:
    """One image: its pixels (nx, ny), its SNR in dB smoothed to the beam and to half of it, iterations, and bounds."""

    model: np.ndarray
    snr_beam: float
    snr_half: float
    iterations: int
    blocks: list[dict]


def simulate(folder, sky, **more):
    """Observe a sky with the VLA in the configurations B and C."""
    observation = Observation(scans=3, integrations=6, channels=1, **more)
    folder.mkdir()
    return simulate_observation(folder, sky, "BC", NOISE_DB, 0.0, SEED, observation).vis


def main(folder):
    """Do it all; return the runs by cell in arcsec, the words of the refusal, the runs by blocks, and the sky."""
    sky = cyg_a_like(tuple(round(side / FINE) for side in WIDE), FINE, oversampling=1)
    truth = sky.truth()
    with quiet(folder / "casa.txt"):
        good = simulate(folder / "good", sky)
        uneven = simulate(folder / "uneven", sky, noise_scale=(1.0, 10.0), weight_scale=(1.0, 100.0))
        cells = {cell: measured(*image_with_cell(good, folder, cell), truth, cell) for cell in CELLS}
        refusal = refused(good, folder)
        blocks = {number: measured(*image_with_blocks(uneven, folder, number), truth, 0.2) for number in (0, 1)}
    return cells, refusal, blocks, truth


def image_with_cell(vis, folder, cell):
    """The tutorial's first part: the same field on other pixels."""
    imsize = [round(side / cell) for side in WIDE]
    name = f"{folder}/cell{cell}"
    return tsara(vis=vis, imagename=name, imsize=imsize, cell=f"{cell}arcsec"), name


def refused(vis, folder):
    """Return what tsara says of pixels that cannot hold the finest fringe."""
    try:
        image_with_cell(vis, folder, TOO_LARGE)
    except ValueError as error:
        return str(error)
    raise AssertionError("pixels of more than half a fringe were not refused")


def image_with_blocks(vis, folder, number):
    """The tutorial's second part: a bound for every snapshot (0), or for so many blocks."""
    name = f"{folder}/blocks{number}"
    return tsara(vis=vis, imagename=name, imsize=[160, 80], cell="0.2arcsec", blocks=number), name


def measured(result, name, truth, cell):
    """Return the run with what it has of the truth, both smoothed on their own pixels."""
    model, step = read_image(name + ".model")[0], round(cell / FINE)
    beam, half = (snr(smooth(truth, width / FINE)[::step, ::step], smooth(model, width / cell) / step**2)
                  for width in (BEAM_ARCSEC, BEAM_ARCSEC / 2))
    return Run(model, beam, half, result["iterdone"], result["sara"]["blocks"])


def as_text(cells, refusal, blocks, truth):
    """Return the tables of the results."""
    lines = ["| cell | pixels per fringe | SNR at the beam | at half the beam | iterations |", "|---|---|---|---|---|"]
    for cell, run in cells.items():
        lines.append(f"| {cell} arcsec | {FRINGE_ARCSEC / cell:.1f} | {run.snr_beam:.1f} dB | {run.snr_half:.1f} dB "
                     f"| {run.iterations} |")
    lines += ["", refusal, "", "| blocks | noise found | SNR at the beam | at half the beam |", "|---|---|---|---|"]
    for number, run in blocks.items():
        found = ", ".join(f"{block['noise_found']:.2f}" for block in run.blocks)
        lines.append(f"| {number or '0 (automatic)'} | {found} | {run.snr_beam:.1f} dB | {run.snr_half:.1f} dB |")
    return "\n".join(lines)


def draw(path, cells, truth):
    """Draw the western hotspots on pixels of each size, beside the sky."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot
    from matplotlib.colors import LogNorm

    finest = truth / FINE**2  # Jy/arcsec²
    norm = LogNorm(finest.max() / 3e2, finest.max(), clip=True)
    panels = [(f"cell = '{cell}arcsec'", run.model / cell**2) for cell, run in cells.items()] + [("the sky", finest)]
    figure, axes = pyplot.subplots(1, len(panels), figsize=(11, 3.1), layout="constrained")
    for axis, (title, brightness) in zip(axes, panels):
        shown = axis.imshow(np.clip(brightness, norm.vmin, None).T, origin="lower", norm=norm, cmap="inferno",
                            extent=(WIDE[0] / 2, -WIDE[0] / 2, -WIDE[1] / 2, WIDE[1] / 2))
        axis.set(xlim=(-8.5, -14.5), ylim=(0.5, 6.5), xticks=[], yticks=[])
        axis.set_title(title, fontsize=10)
    figure.colorbar(shown, ax=axes, fraction=0.02, pad=0.01, label="Jy/arcsec²")
    figure.savefig(path, dpi=80)


if __name__ == "__main__":
    home = Path(sys.argv[1] if len(sys.argv) > 1 else tempfile.mkdtemp(prefix="cell_and_blocks-"))
    home.mkdir(parents=True, exist_ok=True)
    results = main(home)
    print(as_text(*results))
    draw(home / "cell_and_blocks.png", results[0], results[-1])
    print(f"{home}/cell_and_blocks.png")
