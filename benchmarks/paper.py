"""The paper's experiments on a synthetic Cygnus A: X and C band, four configurations, three cell sizes each.

    python benchmarks/paper.py FOLDER

The sky is the demo's radio galaxy (a quarter of Cygnus A's angular size), drawn once on 0.02 arcsec; the configurations are
observed in the ratio of the paper's integration times, one block a scan (22 and 16), decimated to 8 424 visibilities a block;
input SNR 35 dB, gain errors of 1 %. Measures are those of section 4.2 of the paper; residual images of every model are made with
one operator and the same weights.

Writes tables to the terminal and pictures to FOLDER: models and residuals of each band (`<band>.png`), the core with its 5 mJy
neighbour over cell sizes (`<band>_core.png`), and convergence (`convergence.png`).
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")
sys.path.insert(0, str(Path(__file__).resolve().parent))

import numpy as np
from scenes import VLA, Array, observe, replace
from scipy.ndimage import binary_dilation, map_coordinates

from casa_sara.analysis.metrics import dynamic_range, smooth, snr
from casa_sara.demo.sky import ARCSEC, COMPANION_JY, COMPANION_OFFSET, cyg_a_like

FIELD = (30.72, 15.36)  # arcsec
MASTER_CELL = 0.02
BANDS = {
    "X": (replace(VLA, freq_hz=8.422e9, channel_hz=32e6, scans=(15, 4, 2, 1)), (0.08, 0.04, 0.025)),
    "C": (replace(VLA, freq_hz=6.678e9, channel_hz=32e6, scans=(9, 3, 3, 1)), (0.08, 0.05, 0.035)),
}
COMPARED = 1  # which of the cell sizes tclean images too
CLEAN = {
    "briggs": dict(scales=(0, 0.6, 1.8, 5.4), niter=8000), "natural": dict(scales=(0, 0.6, 1.8, 5.4), niter=8000),
}  # in units of the beam
WEIGHTING = {"briggs": dict(weighting="briggs", robust=-1.0), "natural": dict(weighting="natural")}
APERTURE = 0.15  # arcsec, radius around the neighbour


def similarity(one, two):
    """S of the paper: 20 log10(max(‖x1‖, ‖x2‖)/‖x1 − x2‖)."""
    return float(20 * np.log10(max(np.linalg.norm(one), np.linalg.norm(two)) / np.linalg.norm(one - two)))


class Truth:
    """The sky that is observed, and what it is on any grid."""

    def __init__(self):
        shape = tuple(round(size / MASTER_CELL) for size in FIELD)
        self.sky = cyg_a_like(shape, MASTER_CELL, oversampling=1)
        self.image = self.sky.truth()

    def on(self, shape, cell, fwhm_arcsec, angle=0.0):
        """Return the sky smoothed with a Gaussian, Jy per pixel of `cell`."""
        smoothed = smooth(self.image, [axis / MASTER_CELL for axis in fwhm_arcsec], angle)
        where = [(np.arange(n) - n // 2) * cell / MASTER_CELL + m // 2 for n, m in zip(shape, smoothed.shape)]
        return map_coordinates(smoothed, np.meshgrid(*where, indexing="ij"), order=3) * (cell / MASTER_CELL) ** 2

    def support(self, shape, cell):
        """Return where the sky is above a thousandth of its peak at 0.3 arcsec, or near it."""
        sky = self.on(shape, cell, (0.3, 0.3))
        return binary_dilation(sky > 1e-3 * sky.max(), iterations=round(0.3 / cell))


def aperture(image, cell, radius=APERTURE):
    """Return the flux within a radius of the neighbour's place."""
    nx, ny = image.shape
    east = -(np.arange(nx) - nx // 2)[:, None] * cell - COMPANION_OFFSET[0]
    north = (np.arange(ny) - ny // 2)[None, :] * cell - COMPANION_OFFSET[1]
    # pixels on the rim count by the share of them inside
    inside = np.clip((radius - np.hypot(east, north)) / cell + 0.5, 0, 1)
    return float(np.sum(image * inside))


def grid_of(cell):
    """Image size for the field at a cell size, even numbers."""
    return [2 * round(size / cell / 2) for size in FIELD]


def run(folder, vis, cell, name, **parameters):
    """tsara with these parameters, quietly; return the dictionary, and the seconds."""
    from casa_sara import tsara
    from casa_sara.demo.imagers import quiet

    with quiet(folder / "log.txt"):
        begin = time.perf_counter()
        made = tsara(vis=vis, imagename=str(folder / name), imsize=grid_of(cell), cell=f"{cell}arcsec", datacolumn="data",
                     overwrite=True, **parameters)
    return made, time.perf_counter() - begin


def run_clean(folder, vis, cell, weighting, beam):
    """tclean multiscale; return the seconds."""
    from casa_sara.demo.imagers import quiet

    width = np.sqrt(beam[0] * beam[1]) / cell
    chosen = dict(CLEAN[weighting], scales=sorted({round(scale * width) for scale in CLEAN[weighting]["scales"]}))
    with quiet(folder / "log.txt"):
        from casatasks import tclean

        begin = time.perf_counter()
        tclean(vis=vis, imagename=str(folder / f"clean_{weighting}"), imsize=grid_of(cell), cell=f"{cell}arcsec",
               datacolumn="data", deconvolver="multiscale", gain=0.2, nsigma=2.0, smallscalebias=-0.8,
               **WEIGHTING[weighting], **chosen)
    return time.perf_counter() - begin


def residual_images(folder, vis, cell, name, weighting):
    """Restored image, residual and beam of a model, all models with one operator and the same weights."""
    from casa_sara.demo.imagers import read_image

    run(folder, vis, cell, f"{name}_{weighting}", niter=0, startmodel=str(folder / f"{name}.model"),
        **WEIGHTING[weighting])
    restored, beam = read_image(folder / f"{name}_{weighting}.image")
    return restored, read_image(folder / f"{name}_{weighting}.residual")[0], beam


def band(name, base, truth):
    """Simulate, image and measure one band; return what the pictures need."""
    from casa_sara.demo.imagers import quiet, read_image

    observation, cells = BANDS[name]
    folder = base / name
    folder.mkdir(parents=True)
    with quiet(folder / "log.txt"):
        simulation = observe(truth.sky, folder / "data", Array(observation, tuple("ABCD")), 35.0, 0.01, 8)
    vis, errors = simulation.vis, np.array([block.error for block in simulation.blocks])
    print(f"\n### {name} band: {sum(block.samples for block in simulation.blocks)} visibilities, {errors.size} blocks\n")
    print("| cell | pixels | tsara SNR at 0.1\" | flux | neighbour, Jy in 0.15\" (true) | bounds / true | MDR | s | iterations |")
    print("|---" * 9 + "|", flush=True)
    models, took = {}, {}
    for cell in cells:
        made, seconds = run(folder, vis, cell, f"tsara{cell}")
        model = read_image(folder / f"tsara{cell}.model")[0]
        smoothed, true = smooth(model, 0.1 / cell), truth.on(model.shape, cell, (0.1, 0.1))
        ratios = np.array([block["l2_bound"] for block in made["sara"]["blocks"]]) / errors
        outside = model[~truth.support(model.shape, cell)].max()
        found = aperture(model, cell)
        exact = aperture(truth.image, MASTER_CELL)
        print(f"| {cell}\" | {model.shape[0]}×{model.shape[1]} | {snr(true, smoothed):.1f} | {model.sum() / truth.image.sum():.4f} | "
              f"{found:.5f} ({exact:.5f}) | {ratios.min():.2f}–{ratios.max():.2f} | {model.max() / max(outside, 1e-12):.3g} | "
              f"{seconds:.0f} | {made['iterdone']} |", flush=True)
        models[cell], took[cell] = model, seconds
    low, high = (smooth(models[cell], 0.1 / cell) for cell in (cells[1], cells[2]))
    where = [(np.arange(n) - n // 2) * cells[2] / cells[1] + m // 2 for n, m in zip(high.shape, low.shape)]
    again = map_coordinates(low, np.meshgrid(*where, indexing="ij"), order=3) * (cells[2] / cells[1]) ** 2
    print(f"\nConsistency of cells {cells[1]}\" and {cells[2]}\", smoothed to 0.1\": S = {similarity(again, high):.1f} dB")

    cell = cells[COMPARED]
    os.rename(folder / f"tsara{cell}.model", folder / "tsara.model")
    images = {("tsara", w): residual_images(folder, vis, cell, "tsara", w) for w in WEIGHTING}
    seconds = {f"clean_{w}": run_clean(folder, vis, cell, w, images["tsara", w][2]) for w in WEIGHTING}
    seconds["tsara"] = took[cell]
    print(f"\n| model at {cell}\" | σ natural | σ Briggs | DR natural | DR Briggs | SNR at 0.1\" | neighbour, Jy | negative, Jy | s |")
    print("|---" * 9 + "|")
    found = {"tsara": models[cell]}
    for w in WEIGHTING:
        found[f"clean_{w}"] = read_image(folder / f"clean_{w}.model")[0]
    true = truth.on(models[cell].shape, cell, (0.1, 0.1))
    for key, model in found.items():
        for w in WEIGHTING:
            if key != "tsara":
                images[key, w] = residual_images(folder, vis, cell, key, w)
        sigma = {w: images[key, w][1].std() for w in WEIGHTING}
        ranges = {w: dynamic_range(*images[key, w][:2]) for w in WEIGHTING}
        print(f"| {key} | {sigma['natural']:.3g} | {sigma['briggs']:.3g} | {ranges['natural']:.0f} | {ranges['briggs']:.0f} | "
              f"{snr(true, smooth(model, 0.1 / cell)):.1f} | {aperture(model, cell):.5f} | {np.minimum(model, 0).sum():.2f} | "
              f"{seconds[key]:.0f} |", flush=True)
    for w in WEIGHTING:
        beam = images["tsara", w][2]
        pair = [smooth(found[key], [axis / cell for axis in beam[:2]], beam[2]) for key in ("tsara", f"clean_{w}")]
        print(f"S({w}) = {similarity(*pair):.1f} dB, beam {beam[0]:.2f}\" × {beam[1]:.2f}\"")
    picture(base / f"{name}.png", name, truth, found, {key: images[key, "briggs"] for key in found}, cell)
    core_picture(base / f"{name}_core.png", name, truth, models, found, cell)


def picture(path, name, truth, found, images, cell):
    """Models and residuals of the three imagers beside the truth."""
    from casa_sara.analysis.plots import Column, Zoom, compare

    beam = images["tsara"][2]
    shape = found["tsara"].shape
    area = np.pi * beam[0] * beam[1] / (4 * np.log(2)) / cell**2
    columns = [Column("truth", truth.on(shape, cell, (cell, cell)), area * truth.on(shape, cell, beam[:2], beam[2]), None,
                      beam, "truth", f"{name} band, VLA A+B+C+D")]
    for key, label in (("tsara", "tsara"), ("clean_briggs", "tclean Briggs −1"), ("clean_natural", "tclean natural")):
        restored, residual, beam = images[key]
        columns.append(Column(label, found[key], restored, residual, beam, f"model, {found[key].sum():.2f} Jy"))
    compare(path, columns, cell, [Zoom("core and neighbour", -0.15, -0.1, 1.8), Zoom("western hotspots", -11.0, 3.3, 3.0)],
            title=f"{name} band at {cell} arcsec")


def core_picture(path, name, truth, models, found, cell):
    """The core over cell sizes: brightness of the truth, of tsara's models, and of tclean's natural one."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    shown = [("truth at 0.1\"", smooth(truth.image, 0.1 / MASTER_CELL), MASTER_CELL)]
    shown += [(f"tsara, {size}\"", model, size) for size, model in models.items()]
    shown += [(f"tclean {key.removeprefix('clean_')}, {cell}\"", found[key], cell) for key in ("clean_briggs", "clean_natural")]
    figure, axes = plt.subplots(1, len(shown), figsize=(3 * len(shown), 3.4), constrained_layout=True)
    top = np.log10(shown[0][1].max() / MASTER_CELL**2)
    for axis, (title, image, size) in zip(axes, shown):
        nx, ny = image.shape
        extent = np.array([nx // 2 + 0.5, nx // 2 + 0.5 - nx, -(ny // 2) - 0.5, ny - ny // 2 - 0.5]) * size
        drawn = axis.imshow(np.log10(np.maximum(image / size**2, 10 ** (top - 4))).T, origin="lower", extent=extent,
                            cmap="inferno", vmin=top - 3.5, vmax=top, interpolation="nearest")
        axis.add_patch(plt.Circle(COMPANION_OFFSET, APERTURE, fill=False, color="lime"))
        axis.set(xlim=(0.75, -1.05), ylim=(-1.0, 0.8), title=title, xlabel="east [arcsec]")
    figure.colorbar(drawn, ax=axes, label="log10 Jy arcsec$^{-2}$")
    figure.suptitle(f"{name} band: the core and its neighbour of {1e3 * COMPANION_JY:.0f} mJy (circle)")
    figure.savefig(path, dpi=90)
    plt.close(figure)


def convergence(base, truth):
    """Iterations with and without preconditioner and re-weighting, on the X band at the largest cell."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    from casa_sara.casa.ms import read_visibilities
    from casa_sara.casa.weights import sampling_density
    from casa_sara.noise import noise_from_differences
    from casa_sara.options import ImageGrid, Selection, SolverOptions
    from casa_sara.reconstruction import reconstruct
    from casa_sara.snapshots import snapshot_blocks
    from casa_sara.visibilities import sort_into_blocks

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
    figure, axis = plt.subplots(figsize=(7, 4.5), constrained_layout=True)
    reached = {}
    for name, changed in variants.items():
        curve = []

        def note(ppd, record, curve=curve):
            if ppd.iteration % 10 == 0:
                curve.append((ppd.iteration, snr(true, smooth(ppd.model * ppd.unit_jy, 0.1 / cell))))

        reconstruct(data, offsets, density, grid, SolverOptions(**changed), noise, progress=note)
        curve = np.array(curve)
        axis.plot(*curve.T, label=name)
        reached[name] = curve
    axis.set(xlabel="iteration", ylabel="SNR of the model at 0.1 arcsec [dB]", xscale="log")
    axis.legend()
    axis.grid(alpha=0.3)
    figure.savefig(base / "convergence.png", dpi=100)
    plt.close(figure)
    print("\n### Convergence\n\n| SNR at 0.1\" | " + " | ".join(variants) + " |\n" + "|---" * (1 + len(variants)) + "|")
    best = min(curve[:, 1].max() for name, curve in reached.items() if "re-weighting" not in name)
    for level in np.floor(best) - np.array([6, 4, 2, 1, 0]):
        first = [curve[curve[:, 1] >= level, 0] for curve in reached.values()]
        print(f"| {level:.0f} dB | " + " | ".join(f"{found[0]:.0f}" if found.size else "never" for found in first) + " |")


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--bands", default="XC")
    options = parser.parse_args()
    sys.argv = sys.argv[:1]  # CASA reads the command line, too
    base, truth = options.folder.resolve(), Truth()
    for name in options.bands:
        band(name, base, truth)
    convergence(base, truth)


if __name__ == "__main__":
    main()
