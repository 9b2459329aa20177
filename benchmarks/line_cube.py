"""tsara beside tclean multiscale on the H I line of NGC5921, as cubes of one axis: measures, and a report to look at.

    python benchmarks/line_cube.py [--out line-cube] [--only clean|tsara|compare]

All with the same channels, cell, image size and natural weights: tsara with defaults, and tclean with the masks that
usemask='auto-multithresh' finds, with the parameters of ALMA's pipeline for lines. What stands in the output folder is
not made again. saracompare then makes the residual of every channel from the visibilities by one operator; its report
has spectra, line maps and channel maps.
"""

from __future__ import annotations

import argparse
import os
import sys
import tarfile
import time
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

DATA = Path(__file__).resolve().parents[2] / "shared/data/ms/VLA_NGC5921_HI_ch16-45.ms.tgz"
GRID = dict(imsize=128, cell="10arcsec", datacolumn="data", specmode="cube", outframe="BARY", restfreq="1.420405752GHz",
            interpolation="nearest")
CLEAN = dict(deconvolver="multiscale", scales=[0, 4, 12], niter=100_000, nsigma=2.0, usemask="auto-multithresh",
             noisethreshold=4.25, sidelobethreshold=2.0)


def make(vis, which):
    """Make the cubes that are not there."""
    from casatasks import tclean

    from casa_sara import tsara

    if which in ("", "clean") and not Path("clean.model").exists():
        begun = time.monotonic()
        tclean(vis=vis, imagename="clean", **GRID, **CLEAN)
        print(f"tclean: {time.monotonic() - begun:.1f} s")
    if which in ("", "tsara") and not Path("tsara.model").exists():
        begun = time.monotonic()
        result = tsara(vis=vis, imagename="tsara", nthreads=1, **GRID)
        print(f"tsara: {time.monotonic() - begun:.1f} s, {result['iterdone']} iterations")


def tell(measures):
    """Print what was measured, and the spectra."""
    products = measures["products"]
    for name, entry in products.items():
        print(f"{name}: line flux {entry['line_flux']:.4g} Jy km/s, brightest channel {entry['peak_channel']}, "
              + ", ".join(f"σ {weighting} {1e3 * sigma:.3f} mJy/beam" for weighting, sigma in entry["sigma"].items()))
    for pair, entry in measures["similarity"].items():
        print(f"{pair}: S of moment 0 {entry['moment0_db']:.1f} dB, moment 1 differs by {entry['moment1_rms']:.2f} "
              "km/s")
    channels = [channel for channel in measures["channels"] if "products" in channel]
    print("channel  km/s  " + "  ".join(f"{name} Jy, σ, max |r| mJy/beam" for name in products))
    for channel in channels:
        print(f"{channel['channel']:7d} {channel['velocity_km_s']:7.1f}", *(
            f"{one['flux_jy']:8.4f} {1e3 * one['natural']['sigma']:6.3f} {1e3 * one['natural']['max_abs']:6.2f}"
            for one in channel["products"].values()))
    for name in products:
        flux = [channel["products"][name]["flux_jy"] for channel in channels]
        print(f"{name}: channels whose model is empty: {np.sum(np.array(flux) == 0)}")


def main():
    options = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    options.add_argument("--out", default="line-cube")
    options.add_argument("--only", default="", choices=["", "clean", "tsara", "compare"])
    chosen = options.parse_args()
    Path(chosen.out).mkdir(parents=True, exist_ok=True)
    os.chdir(chosen.out)
    if not list(Path().glob("*.ms")):
        with tarfile.open(DATA) as archive:
            archive.extractall(filter="data")
    vis = str(next(Path().glob("*.ms")))
    make(vis, chosen.only)
    if chosen.only in ("", "compare"):
        from casa_sara import saracompare

        tell(saracompare(models=["tsara", "clean"], vis=vis, datacolumn="data", outdir="report", overwrite=True,
                         regions="galaxy = 15h22m00s +05d04m10s 250arcsec"))


if __name__ == "__main__":
    main()
