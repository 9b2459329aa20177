"""The first part of the demo: a simulated VLA A+B+C+D observation of a radio galaxy like Cygnus A."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from casatools import image

from casa_sara import saracompare
from casa_sara.analysis import metrics
from casa_sara.analysis.plots import Column, Zoom, compare
from casa_sara.demo.imagers import Case, Product, quiet, run_tcleans, run_tsara, write_comparison
from casa_sara.demo.simulate import Simulation, simulate_observation
from casa_sara.demo.sky import COMPANION_JY, CORE_JY, Sky, cyg_a_like

__all__ = ["run"]

NOISE_DB = 35.0
GAIN_RMS = 0.01
REGIONS = (
    "core = 19h59m28.356s 40d44m02.10s 0.25arcsec", "companion = 19h59m28.327s 40d44m01.874s 0.12arcsec",
    "western hotspots = 19h59m27.39s 40d44m05.4s 1.6arcsec",
)
FEATURE = "companion = 19h59m28.327s 40d44m01.874s 0.15arcsec"
INJECTED = "19h59m28.356s 40d44m06.6s"  # between the lobes
COARSER = 1.5  # pixels of the first frame of the animation
SEED = 1
# the best SNR of a grid over scales, bias, gain and mask, for each weighting; more iterations do not raise it
COMMON = {"gain": 0.2, "niter": 4000, "nsigma": 2.0}
CLEAN = {
    "briggs": {"scales": [0, 2, 6, 18], "smallscalebias": -0.8, **COMMON},
    "natural": {"scales": [0, 2, 6, 18, 54], "smallscalebias": -0.6, **COMMON},
}


def run(folder: Path) -> None:
    """Simulate the observation, image it with tsara and tclean, write the picture and print the table."""
    print("A radio galaxy like Cygnus A, seen by the VLA in its configurations A, B, C and D at 8.4 GHz")
    sky = cyg_a_like()
    with quiet(folder / "simulation.txt"):
        simulation = simulate_observation(folder, sky, "ABCD", NOISE_DB, GAIN_RMS, SEED)
    samples = sum(block.samples for block in simulation.blocks)
    print(f"  simulated: {samples} visibilities, input SNR {NOISE_DB:.0f} dB, gain errors of {GAIN_RMS:.1%} per scan")

    case = Case(folder, simulation.vis, list(simulation.truth.shape), simulation.cell_arcsec, CLEAN)
    print("  tclean multiscale, Briggs −1 and natural, side by side …", flush=True)
    cleaned = run_tcleans(case)
    print("  tsara …", flush=True)
    products = [run_tsara(case), *cleaned]
    write_truth(simulation, folder)
    print("\n" + table(simulation.truth, products, simulation.cell_arcsec))
    picture(folder / "cyga.png", simulation, products, samples)
    print("  tsara with coarser pixels, again with a point source injected, and without the companion …", flush=True)
    run_tsara(_coarser(case), "tsara_coarser")
    frames = tuple(str(folder / name) for name in ("tsara_coarser", "tsara"))
    text, page = write_comparison(case, truth=str(folder / "truth.model"), regions=REGIONS, frames=frames,
                                  inject=(INJECTED,), features=(FEATURE,))
    print(f"\n{text}\n\n  report: {page}")
    print("  the same test of a sky without the companion …", flush=True)
    test = _test_without_companion(case, sky)
    print(f"  {1e3 * test['flux_jy']:.2f} mJy at its place, without which chi-square is larger by "
          f"{test['delta_chi_square']:.1f}: p = {test['p_value']:.2g}")


def _coarser(case: Case) -> Case:
    """Return the same field on coarser pixels."""
    imsize = [2 * round(n / COARSER / 2) for n in case.imsize]
    return Case(case.folder, case.vis, imsize, COARSER * case.cell_arcsec)


def _test_without_companion(case: Case, sky: Sky) -> dict:
    """Observe the sky without its companion in the same way, image it, and test the companion's place."""
    folder = case.folder / "without_companion"
    folder.mkdir()
    with quiet(folder / "log.txt"):
        simulation = simulate_observation(folder, replace(sky, points=sky.points[:0]), "ABCD", NOISE_DB, GAIN_RMS, SEED)
        run_tsara(replace(case, folder=folder, vis=simulation.vis))
        measures = saracompare(str(folder / "tsara"), vis=simulation.vis, datacolumn="data", features=[FEATURE])
    return measures["products"]["tsara"]["features"]["companion"]


def table(truth: np.ndarray, products: list[Product], cell_arcsec: float) -> str:
    """Return the comparison with the truth as text.

    The smoothed SNR is of the models (and the truth) convolved with tclean's beam at Briggs −1.
    """
    major, minor, angle = products[1].beam
    beam = (major / cell_arcsec, minor / cell_arcsec)
    smoothed = metrics.smooth(truth, beam, angle)
    head = ("model", "SNR", "log SNR", "SNR at beam", "flux", "residual rms", "iterations", "time", "CPU")
    unit = ("", "dB", "dB", "dB", "Jy", "mJy/beam", "", "s", "s")
    rows = [head, unit, ("truth", "", "", "", f"{truth.sum():.3f}", "", "", "", "")]
    for product in products:
        numbers = (
            metrics.snr(truth, product.model),
            metrics.log_snr(truth, product.model),
            metrics.snr(smoothed, metrics.smooth(product.model, beam, angle)),
        )
        rows.append((
            product.name, *(f"{number:.1f}" for number in numbers), f"{product.model.sum():.3f}",
            f"{1e3 * product.residual.std():.2f}", str(product.iterations),
            f"{product.wall_s:.0f}", f"{product.cpu_s:.0f}",
        ))  # fmt: skip
    return layout(rows)


def layout(rows: list[tuple[str, ...]]) -> str:
    """Return rows of text in columns, the first one to the left."""
    widths = [max(len(cell) for cell in column) for column in zip(*rows)]
    return "\n".join(
        "  " + "  ".join([row[0].ljust(widths[0]), *(cell.rjust(width) for cell, width in zip(row[1:], widths[1:]))])
        for row in rows
    )


def picture(path: Path, simulation: Simulation, products: list[Product], samples: int) -> None:
    """Draw the truth and every product."""
    truth, cell = simulation.truth, simulation.cell_arcsec
    major, minor, angle = beam = products[1].beam
    area = np.pi * major * minor / (4 * np.log(2)) / cell**2
    smoothed = area * metrics.smooth(truth, (major / cell, minor / cell), angle)
    note = (
        f"VLA A+B+C+D, 8.4 GHz, {samples:,} visibilities\n"
        f"thermal noise: input SNR {NOISE_DB:.0f} dB\n"
        f"gain errors: {GAIN_RMS:.1%} and {np.rad2deg(GAIN_RMS):.1f}° per antenna and scan\n"
        f"core {CORE_JY} Jy, point source {1e3 * COMPANION_JY:.0f} mJy at 0.4\" from it, total {truth.sum():.1f} Jy"
    )
    true = Column("truth", truth, smoothed, None, beam, "truth", note)
    found = [
        Column(
            product.name, product.model, product.restored, product.residual, product.beam,
            f"model, SNR {metrics.snr(truth, product.model):.1f} dB, {product.model.sum():.2f} Jy",
        )
        for product in products
    ]  # fmt: skip
    zooms = [Zoom("core and companion", -0.15, -0.1, 1.8), Zoom("western hotspots", -11.0, 3.3, 3.0)]
    compare(path, [true, *found], cell, zooms, title="A simulated radio galaxy like Cygnus A")


def write_truth(simulation: Simulation, folder: Path) -> None:
    """Write the truth as a CASA image beside the models, `truth.model`."""
    ia = image()
    ia.open(str(folder / "tclean_natural.model"))
    coordinates = ia.coordsys().torecord()
    ia.close()
    ia.fromarray(str(folder / "truth.model"), simulation.truth.astype(np.float32)[:, :, None, None], csys=coordinates)
    ia.setbrightnessunit("Jy/pixel")
    ia.close()
