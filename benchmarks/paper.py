"""The paper's experiments on a synthetic Cygnus A: X and C band, four configurations, three cell sizes each.

    python benchmarks/paper.py FOLDER [--bands XC] [--only clean|tsara]

The sky is the demo's radio galaxy (a quarter of Cygnus A's angular size), drawn once on 0.02 arcsec; the
configurations are observed in the ratio of the paper's integration times, one block a scan (22 and 16), decimated to
8 424 visibilities a block; input SNR 35 dB, gain errors of 1 %. Measures are those of section 4.2 of the paper;
residual images of every model are made with one operator and the same weights. The row "true sky" is what noise and
calibration errors leave on these data where the model has no error. Simulations and runs of tclean are kept in FOLDER
and not repeated where they are there; tsara runs anew.

Writes tables to the terminal and pictures to FOLDER: models and residuals of each band (`<band>.png`), the core with
its 5 mJy neighbour over cell sizes (`<band>_core.png`), and convergence (`convergence.png`).
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import time
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")
sys.path[:0] = [str(folder) for folder in Path(__file__).resolve().parents[:2]]

import numpy as np
from paper_pictures import convergence_picture, core_picture, picture
from paper_sky import MASTER_CELL, Truth, aperture, grid_of, left_by_truth
from scenes import VLA, Array, observe, replace
from scipy.ndimage import map_coordinates

from casa_sara.analysis.metrics import dynamic_range, similarity, smooth, snr
from casa_sara.demo.sky import ARCSEC

BANDS = {
    "X": (replace(VLA, freq_hz=8.422e9, channel_hz=32e6, scans=(15, 4, 2, 1)), (0.08, 0.04, 0.025)),
    "C": (replace(VLA, freq_hz=6.678e9, channel_hz=32e6, scans=(9, 3, 3, 1)), (0.08, 0.05, 0.035)),
}
COMPARED = 1  # which of the cell sizes tclean images too
CLEAN = {
    "briggs": dict(scales=(0, 0.6, 1.8, 5.4), niter=8000), "natural": dict(scales=(0, 0.6, 1.8, 5.4), niter=8000),
}  # in units of the beam
WEIGHTING = {"briggs": dict(weighting="briggs", robust=-1.0), "natural": dict(weighting="natural")}


def run(folder, vis, cell, name, **parameters):
    """tsara with these parameters, quietly; return the dictionary, and the seconds."""
    from casa_sara import tsara
    from casa_sara.demo.imagers import quiet

    with quiet(folder / "log.txt"):
        begin = time.perf_counter()
        made = tsara(vis=vis, imagename=str(folder / name), imsize=grid_of(cell), cell=f"{cell}arcsec",
                     datacolumn="data", overwrite=True, **parameters)
    return made, time.perf_counter() - begin


def beam_of(folder, vis, cell, weighting):
    """Major, minor in arcsec and position angle of the beam, from a dirty image."""
    from casa_sara.demo.imagers import read_image

    run(folder, vis, cell, f"dirty_{weighting}", niter=0, **WEIGHTING[weighting])
    return read_image(folder / f"dirty_{weighting}.image")[1]


def run_clean(folder, vis, cell, weighting):
    """tclean multiscale; return its model, images and seconds, those of the run before if there was one."""
    from casa_sara.demo.imagers import quiet, read_image

    key = f"clean_{weighting}"
    if (folder / f"{key}.npz").exists():
        return _kept(folder, key)
    beam = beam_of(folder, vis, cell, weighting)
    width = np.sqrt(beam[0] * beam[1]) / cell
    chosen = dict(CLEAN[weighting], scales=sorted({round(scale * width) for scale in CLEAN[weighting]["scales"]}))
    with quiet(folder / "log.txt"):
        from casatasks import tclean

        begin = time.perf_counter()
        tclean(vis=vis, imagename=str(folder / key), imsize=grid_of(cell), cell=f"{cell}arcsec",
               datacolumn="data", deconvolver="multiscale", gain=0.2, nsigma=2.0, smallscalebias=-0.8,
               **WEIGHTING[weighting], **chosen)
        seconds = time.perf_counter() - begin
    images = {}
    for w in WEIGHTING:
        for kind, image in zip(("restored", "residual", "beam"), residual_images(folder, vis, cell, key, w)):
            images[f"{kind}_{w}"] = image
    np.savez_compressed(folder / f"{key}.npz", model=read_image(folder / f"{key}.model")[0], seconds=seconds, **images)
    return _kept(folder, key)


def _kept(folder, key):
    """Model, {weighting: (restored, residual, beam)} and seconds of a run of tclean."""
    with np.load(folder / f"{key}.npz") as kept:
        images = {w: tuple(kept[f"{kind}_{w}"] for kind in ("restored", "residual", "beam")) for w in WEIGHTING}
        return kept["model"], images, float(kept["seconds"])


def residual_images(folder, vis, cell, name, weighting, model=None):
    """Restored image, residual and beam of a model, all models with one operator and the same weights."""
    from casa_sara.demo.imagers import read_image

    run(folder, vis, cell, f"{name}_{weighting}", niter=0, startmodel=str(folder / f"{model or name}.model"),
        **WEIGHTING[weighting])
    restored, beam = read_image(folder / f"{name}_{weighting}.image")
    return restored, read_image(folder / f"{name}_{weighting}.residual")[0], beam


def simulate(name, folder, truth):
    """Return MeasurementSets, error norms of the blocks and the number of samples, simulated unless they are there."""
    from casa_sara.demo.imagers import quiet

    record = folder / "simulation.json"
    if not record.exists():
        folder.mkdir(parents=True, exist_ok=True)
        with quiet(folder / "log.txt"):
            made = observe(truth.sky, folder / "data", Array(BANDS[name][0], tuple("ABCD")), 35.0, 0.01, 8)
        record.write_text(json.dumps({"errors": [block.error for block in made.blocks],
                                      "samples": sum(block.samples for block in made.blocks)}))
    kept = json.loads(record.read_text())
    return [str(folder / "data" / f"{config}.ms") for config in "ABCD"], np.array(kept["errors"]), kept["samples"]


def run_tsara(name, folder, vis, errors, truth):
    """tsara at every cell size and the lines of the table; return models and seconds by cell size."""
    from casa_sara.demo.imagers import read_image

    print("| cell | pixels | tsara SNR at 0.1\" | flux | neighbour, Jy in 0.15\" (true) | bounds / true | MDR | s | "
          "iterations |")
    print("|---" * 9 + "|", flush=True)
    models, took, cells = {}, {}, BANDS[name][1]
    for cell in cells:
        made, seconds = run(folder, vis, cell, f"tsara{cell}")
        model = read_image(folder / f"tsara{cell}.model")[0]
        smoothed, true = smooth(model, 0.1 / cell), truth.on(model.shape, cell, (0.1, 0.1))
        ratios = np.array([block["l2_bound"] for block in made["sara"]["blocks"]]) / errors
        outside = model[~truth.support(model.shape, cell)].max()
        found = aperture(model, cell)
        exact = aperture(truth.image, MASTER_CELL)
        print(f"| {cell}\" | {model.shape[0]}×{model.shape[1]} | {snr(true, smoothed):.1f} | "
              f"{model.sum() / truth.image.sum():.4f} | {found:.5f} ({exact:.5f}) | "
              f"{ratios.min():.2f}–{ratios.max():.2f} | {model.max() / max(outside, 1e-12):.3g} | {seconds:.0f} | "
              f"{made['iterdone']} |", flush=True)
        models[cell], took[cell] = model, seconds
    low, high = (smooth(models[cell], 0.1 / cell) for cell in (cells[1], cells[2]))
    where = [(np.arange(n) - n // 2) * cells[2] / cells[1] + m // 2 for n, m in zip(high.shape, low.shape)]
    again = map_coordinates(low, np.meshgrid(*where, indexing="ij"), order=3) * (cells[2] / cells[1]) ** 2
    print(f"\nConsistency of cells {cells[1]}\" and {cells[2]}\", smoothed to 0.1\": "
          f"S = {similarity(again, high):.1f} dB")
    return models, took


def band(name, base, truth, only):
    """Simulate, image and measure one band, and draw the pictures."""
    folder, cell = base / name, BANDS[name][1][COMPARED]
    vis, errors, samples = simulate(name, folder, truth)
    print(f"\n### {name} band: {samples} visibilities, {errors.size} blocks\n")
    found, images, seconds = {}, {}, {}
    if only != "clean":
        models, took = run_tsara(name, folder, vis, errors, truth)
        found["tsara"], seconds["tsara"] = models[cell], took[cell]
        images["tsara"] = {w: residual_images(folder, vis, cell, "tsara", w, f"tsara{cell}") for w in WEIGHTING}
    for w in WEIGHTING:
        key = f"clean_{w}"
        if only != "tsara" or (folder / f"{key}.npz").exists():
            found[key], images[key], seconds[key] = run_clean(folder, vis, cell, w)
    beams = {w: one[2] for w, one in next(iter(images.values())).items()}
    images["true sky"] = left_by_truth(truth, vis, cell, beams, WEIGHTING)
    table(cell, truth, found, images, seconds)
    for w in WEIGHTING if len(found) == 3 else ():
        pair = [smooth(found[key], beams[w][:2], beams[w][2], (cell, cell)) for key in ("tsara", f"clean_{w}")]
        print(f"S({w}) = {similarity(*pair):.1f} dB, beam {beams[w][0]:.2f}\" × {beams[w][1]:.2f}\"")
    if len(found) == 3:
        picture(base / f"{name}.png", name, truth, found, {key: images[key]["briggs"] for key in found}, cell)
        core_picture(base / f"{name}_core.png", name, truth, models, found, cell)


def table(cell, truth, found, images, seconds):
    """Print the residuals, dynamic ranges and errors of the models, and of the true sky on the same data."""
    print(f"\n| model at {cell}\" | σ natural | σ Briggs | DR natural | DR Briggs | SNR at 0.1\" | neighbour, Jy | "
          "negative, Jy | s |")
    print("|---" * 9 + "|")
    for key in images:
        sigma = {w: images[key][w][1].std() for w in WEIGHTING}
        ranges = {w: dynamic_range(*images[key][w][:2]) for w in WEIGHTING}
        line = (f"| {key} | {sigma['natural']:.3g} | {sigma['briggs']:.3g} | {ranges['natural']:.0f} | "
                f"{ranges['briggs']:.0f} | ")
        if key in found:
            model = found[key]
            true = truth.on(model.shape, cell, (0.1, 0.1))
            line += (f"{snr(true, smooth(model, 0.1 / cell)):.1f} | {aperture(model, cell):.5f} | "
                     f"{np.minimum(model, 0).sum():.2f} | {seconds[key]:.0f} |")
        else:
            line += f" | {aperture(truth.image, MASTER_CELL):.5f} | | |"
        print(line, flush=True)


def convergence(base, truth):
    """Iterations with and without preconditioner and re-weighting, on the X band at the largest cell."""
    from casa_sara.casa.ms.read import read_visibilities
    from casa_sara.casa.ms.weights import sampling_density
    from casa_sara.data.blocks import snapshot_blocks
    from casa_sara.data.noise import noise_from_differences
    from casa_sara.data.visibilities import sort_into_blocks
    from casa_sara.options import ImageGrid, Selection, SolverOptions
    from casa_sara.reconstruction.problem import Samples
    from casa_sara.reconstruction.reconstruct import Control, reconstruct

    cell = BANDS["X"][1][0]
    selection = Selection(tuple(str(base / "X/data" / f"{config}.ms") for config in "ABCD"), datacolumn="data")
    grid = ImageGrid(tuple(grid_of(cell)), (cell * ARCSEC, cell * ARCSEC))
    data = read_visibilities(selection)
    data, offsets = sort_into_blocks(data, snapshot_blocks(data)[0])
    density, noise = sampling_density(data, selection, grid), noise_from_differences(data, offsets)
    true = truth.on(grid.shape, cell, (0.1, 0.1))
    variants = {
        "adaptive PPD": dict(), "without preconditioner": dict(precondition=False, niter=3000),
        "without re-weighting": dict(nreweights=0),
    }
    reached = {}
    for name, changed in variants.items():
        curve = []

        def note(ppd, record, curve=curve):
            if ppd.iteration % 10 == 0:
                curve.append((ppd.iteration, snr(true, smooth(ppd.model * ppd.unit_jy, 0.1 / cell))))

        reconstruct(Samples(data, offsets, density, noise), grid, SolverOptions(**changed), control=Control(note))
        curve = np.array(curve)
        reached[name] = curve
    convergence_picture(base / "convergence.png", reached)
    print("\n### Convergence\n\n| SNR at 0.1\" | " + " | ".join(variants) + " |\n" + "|---" * (1 + len(variants)) + "|")
    best = min(curve[:, 1].max() for name, curve in reached.items() if "re-weighting" not in name)
    for level in np.floor(best) - np.array([6, 4, 2, 1, 0]):
        first = [curve[curve[:, 1] >= level, 0] for curve in reached.values()]
        words = [f"{found[0]:.0f}" if found.size else "never" for found in first]
        print(f"| {level:.0f} dB | {' | '.join(words)} |")


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--bands", default="XC")
    parser.add_argument("--only", choices=("clean", "tsara"),
                        help="simulate and run tclean, or run tsara beside what is kept")
    options = parser.parse_args()
    sys.argv = sys.argv[:1]  # CASA reads the command line, too
    base, truth = options.folder.resolve(), Truth()
    for name in options.bands:
        band(name, base, truth, options.only)
    if "X" in options.bands and options.only != "clean":
        convergence(base, truth)


if __name__ == "__main__":
    main()
