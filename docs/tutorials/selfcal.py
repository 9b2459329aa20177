"""One round of self-calibration: tsara → gaincal → applycal → tsara, beside the same round with tclean.

    python docs/tutorials/selfcal.py [folder]

Simulates a VLA observation of a small radio galaxy with known gain errors, one amplitude and one phase for each
antenna and scan, and compares what the two models recover of them. Prints the table and draws the picture of
selfcal.md.
"""

import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

import casatasks
import numpy as np
from casatools import table

from casa_sara import tsara
from casa_sara.analysis.metrics import snr_at_scale
from casa_sara.demo.imagers import quiet, read_image
from casa_sara.demo.simulate import Observation, gain_errors, simulate_observation
from casa_sara.demo.sky import cyg_a_like

SEED = 7
NOISE_DB = 40.0
GAIN_RMS = 0.05  # of amplitudes, and of phases in radians
CELL_ARCSEC = 0.2
BEAM_ARCSEC = 0.8  # of the configuration B: the scale at which models are held against the truth
CLEAN = dict(deconvolver="multiscale", scales=[0, 4, 10, 25], weighting="briggs", robust=-1.0, niter=20_000, nsigma=3.0)


@dataclass
class Round:
    """What one imager found, before and after the calibration, and how far its gains are from the true ones."""

    models: list[np.ndarray]
    snr_db: list[float]
    dynamic_range: list[float]
    gain_error: float


def main(folder, size=(160, 80), scans=6, imagers=("tclean", "tsara")):
    """Do the round with each imager on its own copy of the data; return the truth (nx, ny) and {name: Round}."""
    sky = cyg_a_like(size, CELL_ARCSEC)
    observation = Observation(scans=scans, integrations=6, channels=1)
    grid = dict(imsize=list(size), cell=f"{CELL_ARCSEC}arcsec")
    rounds = {}
    for name in imagers:
        (folder / name).mkdir()
        with quiet(folder / "casa.txt"):
            simulation = simulate_observation(folder / name, sky, "B", NOISE_DB, GAIN_RMS, SEED, observation)
            rounds[name] = one_round(folder / name, simulation, tsara_model if name == "tsara" else tclean_model, grid)
    return simulation.truth, rounds


def one_round(folder, simulation, image, grid):
    """Image, solve for one gain of each antenna in each scan, apply it, and image again."""
    vis, gains = simulation.vis[0], str(folder / "gains")
    image(vis, str(folder / "before"), grid, "data")
    casatasks.gaincal(vis=vis, caltable=gains, solint="inf", refant="0", gaintype="T", calmode="ap", solnorm=True)
    casatasks.applycal(vis=vis, gaintable=gains, calwt=False, flagbackup=False)
    image(vis, str(folder / "after"), grid, "corrected")
    roots = [str(folder / when) for when in ("before", "after")]
    models = [read_image(root + ".model")[0] for root in roots]
    snr_db = [snr_at_scale(simulation.truth, model, BEAM_ARCSEC / CELL_ARCSEC) for model in models]
    return Round(models, snr_db, [dynamic_range(root) for root in roots], gain_error(gains))


def tsara_model(vis, imagename, grid, column):
    """Image with tsara; its model goes into MODEL_DATA."""
    tsara(vis=vis, imagename=imagename, datacolumn=column, savemodel="modelcolumn", weighting="briggs",
          robust=-1.0, **grid)


def tclean_model(vis, imagename, grid, column):
    """Image with tclean; its model goes into MODEL_DATA."""
    casatasks.tclean(vis=vis, imagename=imagename, datacolumn=column, savemodel="modelcolumn", **CLEAN, **grid)


def dynamic_range(root):
    """Return the peak of the restored image over the rms of its residual."""
    return float(read_image(root + ".image")[0].max() / read_image(root + ".residual")[0].std())


def gain_error(caltable):
    """Return the rms of found over true gains − 1; one scale, and one phase in each scan, are free."""
    tb = table()
    tb.open(caltable)
    try:
        scan, antenna, found = tb.getcol("SCAN_NUMBER"), tb.getcol("ANTENNA1"), tb.getcol("CPARAM")[0, 0]
        good = ~tb.getcol("FLAG")[0, 0]
    finally:
        tb.close()
    true = gain_errors(GAIN_RMS, (scan.max() + 1, antenna.max() + 1), [SEED, 0])
    ratio = found / true[scan, antenna]
    for one in np.unique(scan):
        ratio[scan == one] *= np.exp(-1j * np.angle(ratio[good & (scan == one)].mean()))
    ratio /= np.abs(ratio[good]).mean()
    return float(np.sqrt(np.mean(np.abs(ratio[good] - 1) ** 2)))


def as_text(rounds):
    """Return the table of the results."""
    lines = ["| model | gains, rms error | SNR of the model before, after | dynamic range before, after |",
             "|---|---|---|---|"]
    for name, one in rounds.items():
        lines.append(f"| {name} | {one.gain_error:.2%} | {one.snr_db[0]:.1f}, {one.snr_db[1]:.1f} dB "
                     f"| {one.dynamic_range[0]:.0f}, {one.dynamic_range[1]:.0f} |")
    return "\n".join(lines)


def draw(path, truth, rounds):
    """Draw the models before and after, and the truth, on one logarithmic scale."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot
    from matplotlib.colors import LogNorm

    figure, axes = pyplot.subplots(len(rounds), 3, figsize=(9, 1.75 * len(rounds)), layout="constrained", squeeze=False)
    norm = LogNorm(truth.max() / 3e3, truth.max(), clip=True)
    for row, (name, one) in zip(axes, rounds.items()):
        for axis, pixels, title in zip(row, (*one.models, truth), (f"{name}, before", f"{name}, after", "the sky")):
            axis.imshow(np.clip(pixels, norm.vmin, None).T, origin="lower", norm=norm, cmap="inferno")
            axis.set(xticks=[], yticks=[])
            axis.set_title(title, fontsize=9)
    figure.savefig(path, dpi=80)


if __name__ == "__main__":
    home = Path(sys.argv[1] if len(sys.argv) > 1 else tempfile.mkdtemp(prefix="selfcal-"))
    home.mkdir(parents=True, exist_ok=True)
    results = main(home)
    print(as_text(results[1]))
    draw(home / "selfcal.png", *results)
    print(f"{home}/selfcal.png")
