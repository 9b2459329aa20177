"""A bright source far outside the image, and an outlier file for it: tsara and tclean.

    python benchmarks/outlier.py FOLDER            # VLA B at 1.4 GHz, M31 of 0.2 Jy, a double of 2 Jy 0.7 degrees away
    python benchmarks/outlier.py FOLDER --case D   # VLA D, 2 degrees away, with the w-term
    python benchmarks/outlier.py FOLDER --seeds 4  # of the noise: what the outlier file loses, tsara alone
    python benchmarks/outlier.py FOLDER --time     # an iteration with and without an outlier

Two observations with the same noise: of the field alone, and with the double beside it, whose sidelobes cover the
field. Visibilities are type-3 non-uniform transforms, exact with w, of a sky on pixels half as large as those of the
image. The field is imaged from the first (`alone`), and from the second with the outlier file and without it. SNR =
20 log10(‖truth‖/‖truth − model‖) of the field smoothed to half and to one beam. tclean runs multiscale, with the same
file and pblimit=-1, without which it does nothing outside the primary beam; of GRID, that with the best SNR at half a
beam is shown. outlier.png shows the models.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from dataclasses import dataclass
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("MPLBACKEND", "Agg")
ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT / "benchmarks"), str(ROOT / "tests"), str(ROOT)]

import numpy as np

ARCSEC = np.pi / 180 / 3600
SPEED_OF_LIGHT = 299792458.0
SIZE, FINER, FLUX = 256, 2, 0.2  # pixels, of the sky in one of the image, Jy of the field
OUTLIER = 96  # pixels
NOISE = 0.005  # Jy, of a visibility of one correlation
# of the double: flux, place in pixels of the outlier's image, FWHM in pixels
DOUBLE = ((1.4, 3.3, -2.6, 0.0), (0.6, -9.0, 5.0, 6.0))
THRESHOLD = "25uJy"  # of tclean, twice the noise of the images
# scales in beams, bias towards small ones, most iterations, gain
GRID = {"short": ((0, 1, 3), 0.0, 3000, 0.2), "long": ((0, 1, 3, 8), 0.6, 20_000, 0.1)}


@dataclass(frozen=True)
class Case:
    """An observation: configuration, pixels, how far the double is, and how it is imaged."""

    configuration: str
    cell: float
    distance_deg: float
    gridder: str
    integration: float

    @property
    def grid(self):
        """Task parameters of the image."""
        return dict(imsize=SIZE, cell=f"{self.cell}arcsec", gridder=self.gridder, datacolumn="data")


CASES = {"B": Case("b", 0.9, 0.7, "standard", 10.0), "D": Case("d", 9.0, 2.0, "wproject", 20.0)}


def axes(longitude, latitude):
    """East, north and towards a direction, (3, 3)."""
    sin, cos = np.sin, np.cos
    return np.array([[-sin(longitude), cos(longitude), 0],
                     [-sin(latitude) * cos(longitude), -sin(latitude) * sin(longitude), cos(latitude)],
                     [cos(latitude) * cos(longitude), cos(latitude) * sin(longitude), sin(latitude)]])


def placed(case):
    """Return the axes of the field and of the outlier, and the phase centre of the outlier as text."""
    from simulated_ms import CYGNUS_A

    from casa_sara.casa.ms.frames import direction_on_sky

    centre = direction_on_sky(CYGNUS_A)
    field = axes(*(centre[axis]["value"] for axis in ("m0", "m1")))
    l, m = np.sin(np.radians(case.distance_deg)) * np.array([0.8, -0.6])
    x, y, z = field.T @ [l, m, np.sqrt(1 - l**2 - m**2)]
    longitude, latitude = np.arctan2(y, x), np.arcsin(z)
    text = f"J2000 {float(np.degrees(longitude))!r}deg {float(np.degrees(latitude))!r}deg"
    return field, axes(longitude, latitude), text


def the_sky(case):
    """Return the field and, as sources (Jy, l, m, n − 1) around its centre, the field and the double."""
    from scenes import scene_sky

    sky = scene_sky("M31", case.cell, FLUX, FINER)
    ix, iy = np.nonzero(sky.image)
    l, m = -(ix - SIZE * FINER // 2) * sky.cell_rad, (iy - SIZE * FINER // 2) * sky.cell_rad
    field, there, _ = placed(case)
    far, cell = [], case.cell * ARCSEC
    for flux, x, y, width in DOUBLE:
        steps = np.arange(-10.0, 10.0, 0.25) * cell if width else np.zeros(1)
        dl, dm = (grid.ravel() for grid in np.meshgrid(steps, steps))
        shape = np.exp(-4 * np.log(2) * (dl**2 + dm**2) / (max(width, 1) * cell) ** 2)
        own = np.array([dl - x * cell, dm + y * cell])
        s = field @ there.T @ np.array([*own, np.sqrt(1 - (own**2).sum(axis=0))])
        far.append(np.array([flux * shape / shape.sum(), *s]))
    near = np.array([sky.image[ix, iy], l, m, np.sqrt(1 - l**2 - m**2)])
    return sky, near, np.concatenate(far, axis=1)


def predicted(uvw, flux, *s):
    """Σ flux exp(2πi b·(s − s_0)) of sources near each other: a transform around one of them, turned to the centre."""
    from mosaic import transform

    s = np.array(s)
    near = s - s[:, :1]
    return np.exp(2j * np.pi * (s[:, 0] - [0, 0, 1]) @ uvw) * transform(uvw, near + [[0], [0], [1]], flux)


def observe(folder, case, sources, seed=0):
    """Write the two MeasurementSets unless they are there; return their names."""
    from simulated_ms import column, edit, simulate

    names = {}
    for label, seen in (("alone", sources[:1]), ("both", sources)):
        names[label] = path = str(folder / f"{label}.ms")
        if os.path.exists(path):
            continue
        simulate(path, configuration=case.configuration, antennas=27, spws=(("1.4GHz", "2MHz", 3),), scans=8,
                 scan_seconds=8 * case.integration, integration=case.integration, spacing_seconds=2700, hour_angle=-3.0,
                 sky=((0.0, 0.0, 0.0),), noise=NOISE, seed=seed)
        freqs, uvw = column(path + "/SPECTRAL_WINDOW", "CHAN_FREQ")[:, 0], column(path, "UVW")
        vis = np.array([sum(predicted(uvw * freq / SPEED_OF_LIGHT, *part) for part in seen) for freq in freqs])
        edit(path, "DATA", lambda noise, vis=vis: noise + vis)
    return names


def outlier_file(folder, case, name):
    """Write the outlier file of one run; return its name."""
    path = folder / f"{name}.txt"
    path.write_text(f"imagename={folder / name}_far\nnchan=1\nimsize=[{OUTLIER},{OUTLIER}]\ncell=[{case.cell}arcsec]\n"
                    f"phasecenter={placed(case)[2]}\n")
    return str(path)


def scored(sky, model, case, beam):
    """SNR at a half and one beam, and flux over the truth."""
    from scenes import smoothed_truth

    from casa_sara.analysis.metrics import smooth, snr

    found = [snr(smoothed_truth(sky, fwhm, beam[2]), smooth(model, fwhm, beam[2]))
             for fwhm in ([factor * axis / case.cell for axis in beam[:2]] for factor in (0.5, 1.0))]
    return [*found, float(model.sum() / sky.image.sum())]


def of_double(model):
    """Flux of an outlier over the truth, and how far its centroid is off, in pixels."""
    flux, x, y, _ = np.array(DOUBLE).T
    i, j = np.indices(model.shape) - OUTLIER // 2
    off = np.hypot((model * i).sum() / model.sum() - flux @ x / flux.sum(),
                   (model * j).sum() / model.sum() - flux @ y / flux.sum())
    return float(model.sum() / flux.sum()), float(off)


def imaged(folder, case, vis, name, with_file):
    """Image with tsara; return its models, beam, noise found and seconds."""
    from casa_sara import tsara
    from casa_sara.demo.imagers import quiet, read_image

    begin = time.perf_counter()
    with quiet(folder / f"{name}.log"):
        made = tsara(vis=vis, imagename=str(folder / name), weighting="briggs", robust=0.5, overwrite=True,
                     outlierfile=outlier_file(folder, case, name) if with_file else "", **case.grid)
    seconds, sara = time.perf_counter() - begin, made["sara"]
    noise = float(np.median([block["noise_found"] for block in sara["blocks"]]))
    beam = read_image(str(folder / name) + ".image")[1]
    models = [read_image(str(folder / name) + kind)[0] for kind in (".model", *["_far.model"] * with_file)]
    averages = sara["averaging"].get("averages", "no")
    print(f"tsara {name}: {made['stopDescription']}, {made['iterdone']} iterations, {sara['visibilities']} "
          f"visibilities, {averages} averages, noise found {noise:.2f} x MS weights, {seconds:.0f} s", flush=True)
    return models, beam, seconds


def cleaned(folder, case, vis, name, with_file, setting):
    """Image with tclean; return its models, beam and seconds."""
    from casatasks import tclean

    from casa_sara.demo.imagers import quiet, read_image

    scales, bias, niter, gain = GRID[setting]
    name = f"clean_{name}_{setting}"
    begin = time.perf_counter()
    with quiet(folder / f"{name}.log"):
        tclean(vis=vis, imagename=str(folder / name), weighting="briggs", robust=0.5, deconvolver="multiscale",
               scales=sorted({round(scale * 4.7) for scale in scales}), smallscalebias=bias, niter=niter, gain=gain,
               threshold=THRESHOLD, pblimit=-1.0, cyclefactor=1.5, wprojplanes=64 if case.gridder == "wproject" else 1,
               outlierfile=outlier_file(folder, case, name) if with_file else "", **case.grid)
    seconds, beam = time.perf_counter() - begin, read_image(str(folder / name) + ".image")[1]
    return [read_image(str(folder / name) + kind)[0] for kind in (".model", *["_far.model"] * with_file)], beam, seconds


def compare(folder, case):
    """Simulate, image and print one table."""
    import shutil

    sky, *sources = the_sky(case)
    names, rows, beam = observe(folder, case, sources), [], None
    runs = (("field alone", "alone", "alone", False), ("outlier file", "with_file", "both", True),
            ("no outlier file", "without_file", "both", False))
    for label, name, vis, with_file in runs:
        models, own, seconds = imaged(folder, case, names[vis], name, with_file)
        beam = beam or own  # that of tclean is the same
        rows.append((f"tsara, {label}", models, seconds))
    for label, name, vis, with_file in runs:
        best = None
        for setting in GRID:
            for old in folder.glob(f"clean_{name}_{setting}*"):
                shutil.rmtree(old) if old.is_dir() else old.unlink()
            models, _, seconds = cleaned(folder, case, names[vis], name, with_file, setting)
            if best is None or scored(sky, models[0], case, beam)[0] > scored(sky, best[1][0], case, beam)[0]:
                best = f"tclean {setting}, {label}", models, seconds
        rows.append(best)
    print(f"beam {beam[0]:.2f} by {beam[1]:.2f} arcsec")
    print("| imager | SNR at half a beam, dB | at one beam | flux / true | outlier: flux / true | off, pixels | s |")
    print("|---|---|---|---|---|---|---|")
    for label, models, seconds in rows:
        half, one, flux = scored(sky, models[0], case, beam)
        far = "{:.4f} | {:.3f}".format(*of_double(models[1])) if len(models) > 1 else "– | –"
        print(f"| {label} | {half:.1f} | {one:.1f} | {flux:.3f} | {far} | {seconds:.0f} |")
    draw(folder, case, sky, beam, [(rows[k][0], rows[k][1][0]) for k in (1, 4, 2)])


def draw(folder, case, sky, beam, models):
    """Draw the field, smoothed to half a beam, on one logarithmic scale: outlier.png."""
    import matplotlib.pyplot as plt
    from scenes import smoothed_truth

    from casa_sara.analysis.metrics import smooth

    fwhm = [0.5 * axis / case.cell for axis in beam[:2]]
    panels = [("true sky", smoothed_truth(sky, fwhm, beam[2]))]
    panels += [(label, smooth(model, fwhm, beam[2])) for label, model in models]
    top = panels[0][1].max()
    figure, axes_of_panels = plt.subplots(1, len(panels), figsize=(16, 4.3), layout="constrained")
    for axis, (label, image) in zip(axes_of_panels, panels):
        axis.imshow(np.log10(np.maximum(image / top, 1e-4)).T, origin="lower", vmin=-3.5, vmax=0, cmap="inferno")
        axis.set(title=label, xticks=[], yticks=[])
    figure.savefig(folder / "outlier.png", dpi=70)
    plt.close(figure)


def lost(folder, case, seeds):
    """Print what becomes of the SNR of the field, with the outlier file, for several realisations of the noise."""
    sky, *sources = the_sky(case)
    for seed in range(seeds):
        own, rows = folder / f"seed{seed}", []
        own.mkdir(exist_ok=True)
        names = observe(own, case, sources, seed)
        for name, vis, with_file in (("alone", "alone", False), ("with_file", "both", True)):
            models, beam, _ = imaged(own, case, names[vis], name, with_file)
            rows.append(scored(sky, models[0], case, beam) + (list(of_double(models[1])) if with_file else []))
        print(f"seed {seed}: field alone {rows[0][0]:.2f} and {rows[0][1]:.2f} dB, with the outlier file "
              f"{rows[1][0] - rows[0][0]:+.2f} and {rows[1][1] - rows[0][1]:+.2f} dB; outlier {rows[1][3]:.4f} of its "
              f"flux, {rows[1][4]:.4f} pixels off", flush=True)


def iteration_time(pixels=1024, outlier=128, samples=200_000):
    """Time an iteration of an image with and without outliers."""
    from casa_sara.operators.dictionary import SaraDictionary
    from casa_sara.operators.outliers import ImagesDictionary
    from casa_sara.operators.sky import sky_operator
    from casa_sara.options import SARA_BASES, ImageGrid, Outlier
    from casa_sara.solver.adaptive_ppd import AdaptivePPD

    rng, cell = np.random.default_rng(0), (1e-6, 1e-6)
    uvw = rng.uniform(-0.25, 0.25, (3, samples)) / cell[0]
    for count in (0, 1, 3):
        others = tuple(Outlier("", ImageGrid((outlier, outlier), cell), turn=np.linalg.qr(
            np.eye(3) + 0.01 * rng.standard_normal((3, 3)))[0]) for _ in range(count))
        grid = ImageGrid((pixels, pixels), cell, outliers=others)
        operator = sky_operator(uvw, grid, eps=1e-5)
        each = [SaraDictionary(shape, SARA_BASES, 4) for shape in grid.shapes]
        vis = operator.forward(rng.random(operator.shape).astype(np.float32))
        ppd = AdaptivePPD(operator, ImagesDictionary(each) if count else each[0], vis, np.array([0, samples]),
                          np.ones(samples, np.float32), 1.0)
        ppd.threshold, times = 1.0, []
        for _ in range(8):
            begin = time.perf_counter()
            ppd.step()
            times.append(time.perf_counter() - begin)
        print(f"{count} outliers of {outlier} x {outlier} beside {pixels} x {pixels} pixels, {samples} samples: "
              f"{1e3 * min(times):.0f} ms an iteration")


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--case", default="B", choices=CASES)
    parser.add_argument("--seeds", type=int, default=0)
    parser.add_argument("--time", action="store_true")
    args = parser.parse_args()
    if args.time:
        iteration_time()
        return
    folder = args.folder.resolve() / args.case
    folder.mkdir(parents=True, exist_ok=True)
    if args.seeds:
        lost(folder, CASES[args.case], args.seeds)
    else:
        compare(folder, CASES[args.case])


if __name__ == "__main__":
    main()
