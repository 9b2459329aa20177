"""A dynamic range of 10⁵: does the last problem go on for as long as the residual's structure changes?

    python benchmarks/dynamic_range.py FOLDER [--visibilities 1e6 1e7]

Observations of large_ms.py whose image has a noise of 5·10⁻⁵ Jy/beam beside sources of up to 1 Jy between the pixels,
without errors of calibration. Each is imaged with defaults, with a last problem that ends when the model has settled,
and with one that ends when it changes by less than 10⁻⁵. SNRs are of model and truth smoothed to one, two and four
pixels; the fringe of the longest baseline has 2.6.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from pathlib import Path
from unittest import mock

os.environ.setdefault("OMP_NUM_THREADS", "1")
sys.path.insert(0, str(Path(__file__).resolve().parent))

import large_ms
import numpy as np
from machine import machine
from scenes import scene_sky

NOISE_JY, PIXELS, CELL = 5e-5, 512, 0.06  # per beam; arcsec
WIDTHS = (1, 2, 4)  # pixels


def truth() -> np.ndarray:
    """The sky of large_ms.py, on its grid."""
    sky = scene_sky("points off pixels", CELL, oversampling=large_ms.FINER)
    nx, ny = sky.image.shape
    for l, m, flux in sky.points:
        sky.image[nx // 2 - round(l / sky.cell_rad), ny // 2 + round(m / sky.cell_rad)] += flux
    return sky.image


def measure(vis: list[str], name: Path, options: dict, sky: np.ndarray) -> list[str]:
    """Image the data; return what there is to say."""
    from casa_sara import tsara
    from casa_sara.analysis.metrics import smooth, snr
    from casa_sara.demo.imagers import quiet, read_image

    with quiet(Path(f"{name}.txt")):
        begin = time.perf_counter()
        made = tsara(vis=vis, imagename=str(name), imsize=PIXELS, cell=f"{CELL}arcsec", datacolumn="data", blocks=12,
                     overwrite=True, nthreads=1, fullsummary=True, **options)
        seconds = time.perf_counter() - begin
    model, residual = (read_image(f"{name}.{kind}")[0] for kind in ("model", "residual"))
    first, finer = (PIXELS - sky.shape[0] // large_ms.FINER) // 2, large_ms.FINER
    inner = slice(first, first + sky.shape[0] // finer)
    snrs = [snr(smooth(sky, 2 * [finer * width], 0.0)[::finer, ::finer] * finer**2,
                smooth(model, 2 * [width], 0.0)[inner, inner]) for width in WIDTHS]
    largest = max(peak["snr"] for peak in made["sara"]["residual_snr"] if peak["beams"] >= 1)
    return [f"{largest:.1f}", f"{residual.std() / NOISE_JY:.2f}", " / ".join(f"{value:.1f}" for value in snrs),
            f"{made['iterdone']}", f"{seconds:.0f}"]


def main() -> None:
    """Read the command line and print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--visibilities", type=float, nargs="+", default=[1e6, 1e7])
    options = parser.parse_args()
    sys.argv = sys.argv[:1]  # CASA reads the command line, too
    from casa_sara.solver import reweighting

    usual = reweighting.CHANGING
    print(machine())
    head = ("visibilities", "the last problem ends", "structure, σ", "residual / noise", "dB at 1, 2, 4 pixels",
            "iterations", "s")
    print("\n| " + " | ".join(head) + " |\n" + "|---" * len(head) + "|")
    sky = truth()
    for number in options.visibilities:
        folder = options.folder / f"{number:.0e}"
        if not folder.exists():
            large_ms.observe(folder, number, CELL, NOISE_JY * np.sqrt(number))
        vis = [str(path) for path in sorted(folder.glob("*.ms"))]
        for words, changing, more in (("settled", np.inf, {}), ("and structure steady (default)", usual, {}),
                                      ("finalreltol=1e-5", np.inf, dict(finalreltol=1e-5))):
            with mock.patch.object(reweighting, "CHANGING", changing):
                cells = measure(vis, folder / "tsara", more, sky)
            print("| " + " | ".join([f"{number:.0e}", words, *cells]) + " |", flush=True)


if __name__ == "__main__":
    main()
