"""tsara beside tclean multiscale (natural) on the real observations of ../shared/data: a table and a picture of each.

    python benchmarks/real_data.py [NAME ...] [--out real-data]

Both with the same data, cell and image size; tsara with defaults. For M87, each of its two bands beside the published image of
that band: χ²/N of both, Σ w|y − Φx|²/(2M).
"""

from __future__ import annotations

import argparse
import sys
import tarfile
import time
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

DATA = Path(__file__).resolve().parents[2] / "shared/data/ms"
# MeasurementSet, image size, cell in arcsec, scales of tclean, spw
SETS = {
    "3C273": ("VLA_3C273_X", 192, 0.5, [0, 3, 9, 18], ""),
    "HD142527": ("ALMA_HD142527_B9cont", 256, 0.03, [0, 5, 15, 30], ""),
    "M87 low": ("EHT_M87_2017_101_selfcal", 128, 2e-6, [0, 5, 10], "0"),
    "M87 high": ("EHT_M87_2017_101_selfcal", 128, 2e-6, [0, 5, 10], "1"),
    "NGC5921 continuum": ("VLA_NGC5921_cont", 128, 10.0, [0, 4, 12], ""),
    "NGC5921 HI": ("VLA_NGC5921_HI_ch16-45", 128, 10.0, [0, 4, 12], ""),
    "DM Tau": ("SMA_DMTau_CO21", 128, 0.2, [0, 5, 15], ""),
}
PUBLISHED = {"M87 low": "M87_original_lowfreq.fits", "M87 high": "M87_original_highfreq.fits"}


def image(name, out):
    """Image one observation with both and return the lines of the table."""
    from casa_sara import tsara
    from casa_sara.demo.imagers import quiet, read_image

    file, size, cell, scales, spw = SETS[name]
    folder = out / name.replace(" ", "_")
    folder.mkdir(parents=True)
    with tarfile.open(DATA / f"{file}.ms.tgz") as archive:
        archive.extractall(folder, filter="data")
    common = dict(vis=str(folder / f"{file}.ms"), spw=spw, imsize=size, cell=f"{cell}arcsec", datacolumn="data")
    begin = time.perf_counter()
    made = tsara(imagename=str(folder / "tsara"), **common)
    seconds = [time.perf_counter() - begin]
    with quiet(folder / "tclean.txt"):
        from casatasks import tclean

        begin = time.perf_counter()
        tclean(imagename=str(folder / "tclean"), deconvolver="multiscale", scales=scales, niter=10_000, gain=0.2,
               nsigma=2.0, **common)
        seconds.append(time.perf_counter() - begin)
    products = {kind: [read_image(folder / f"{imager}.{kind}")[0] for imager in ("tsara", "tclean")]
                for kind in ("model", "image", "residual")}
    _picture(folder / "comparison.png", name, products)
    found = [block["noise_found"] for block in made["sara"]["blocks"]]
    measured = [block["noise_measured"] for block in made["sara"]["blocks"]]
    lines = []
    for k, imager in enumerate(("tsara", "tclean")):
        model, restored, residual = (products[kind][k] for kind in ("model", "image", "residual"))
        noise = f"{np.median(found):.3g} ({np.nanmedian(measured):.3g})" if k == 0 else ""
        stop = f"{made['iterdone']}, {made['stopDescription']}" if k == 0 else ""
        lines.append(f"| {name} | {imager} | {model.sum():.4g} | {restored.max():.4g} | {residual.std():.3g} | "
                     f"{restored.max() / residual.std():.3g} | {noise} | {seconds[k]:.0f} | {stop} |")
    if name in PUBLISHED:
        print(f"{name}: χ²/N of tsara {_misfit(common, products['model'][0], cell):.2f}, of tclean "
              f"{_misfit(common, products['model'][1], cell):.2f}, of the published image {_misfit(common, *_published(name)):.2f}")
    return "\n".join(lines)


def _misfit(common, model, cell, centre=None):
    """χ²/N of a model whose phase centre is at pixel `centre`."""
    from casa_sara.casa.ms import read_visibilities
    from casa_sara.operators.measurement import MeasurementOperator
    from casa_sara.options import Selection

    data = read_visibilities(Selection((common["vis"],), spw=common["spw"], datacolumn="data"))
    cell_rad = np.radians(cell / 3600)
    operator = MeasurementOperator(data.uvw[:2], cell_rad, model.shape, dtype=np.float64, eps=1e-8)
    east, north = (0, 0) if centre is None else [at - n // 2 for at, n in zip(centre, model.shape)]
    turn = np.exp(2j * np.pi * cell_rad * (data.uvw[0] * east - data.uvw[1] * north))
    residual = data.vis - turn * operator.forward(np.ascontiguousarray(model))
    return np.sum(data.weight * np.abs(residual) ** 2) / (2 * data.size)


def _published(name):
    """The published image, its cell in arcsec, and the pixel of its centre."""
    from astropy.io import fits

    with fits.open(DATA.parent / "reference" / PUBLISHED[name]) as hdus:
        header, image = hdus[0].header, hdus[0].data.squeeze().T.astype(float)
    return image, abs(header["CDELT2"]) * 3600, (header["CRPIX1"] - 1, header["CRPIX2"] - 1)


def _picture(path, name, products):
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(2, 3, figsize=(12, 8), constrained_layout=True)
    for k, imager in enumerate(("tsara", "tclean")):
        for axis, kind in zip(axes[k], ("model", "image", "residual")):
            pixels = products[kind][k].T
            spread = 5 * products["residual"][0].std()
            if kind == "residual":
                axis.imshow(pixels, origin="lower", cmap="RdBu_r", vmin=-spread, vmax=spread)
            else:
                top = products[kind][0].max()
                axis.imshow(np.log10(np.maximum(pixels, 1e-4 * top)), origin="lower", cmap="inferno")
            axis.set_title(f"{name}: {imager} {kind}")
    figure.savefig(path, dpi=70)
    plt.close(figure)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("names", nargs="*", default=list(SETS))
    parser.add_argument("--out", type=Path, default=Path("real-data"), help="new folder for data, images and pictures")
    options = parser.parse_args()
    sys.argv = sys.argv[:1]  # CASA reads the command line, too
    print("| data | imager | flux Jy | peak Jy/beam | residual rms | DR | noise found (measured) | s | iterations |\n"
          + "|---" * 9 + "|", flush=True)
    for name in options.names:
        print(image(name, options.out.resolve()), flush=True)


if __name__ == "__main__":
    main()
