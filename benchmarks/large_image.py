"""An image of the size of the paper's, from MeasurementSets to images and report: 4096×2048 pixels,
2 million visibilities, 22 blocks.

    python benchmarks/large_image.py FOLDER [--clean NITER]

The demo's radio galaxy at Cygnus A's own size and flux density (190 Jy over two arcminutes) in X band, configurations
A–D in the ratio of the paper's integration times; pixels of 0.04 arcsec, 2.5 times the nominal resolution; input SNR 35
dB, gain errors of 1 %.
`tsara` runs with defaults and `report=True` on two threads. With --clean, tclean multiscale (Briggs −1) runs to at most
NITER iterations after it.
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
from machine import machine, resident_mb
from scenes import VLA, Array, observe, replace

SHAPE, CELL, STRETCH = (4096, 2048), 0.04, 4
OBSERVATION = replace(VLA, freq_hz=8.422e9, channel_hz=8e6, channels=16, scans=(15, 4, 2, 1), integrations=16)


def large_sky():
    """The demo's galaxy, four times as large."""
    from casa_sara.demo.sky import ARCSEC, cyg_a_like

    sky = cyg_a_like(SHAPE, CELL / STRETCH, oversampling=1)
    points = sky.points * [STRETCH, STRETCH, STRETCH**2]
    return replace(sky, image=sky.image * STRETCH**2, cell_rad=CELL * ARCSEC, points=points)


def report_line(name, model, truth, seconds, beam, more=""):
    """Print how good a model is."""
    from casa_sara.analysis.metrics import smooth, snr

    half = [0.5 * axis / CELL for axis in beam[:2]]
    print(f"| {name} | {seconds:.0f} | {more} | {snr(truth, model):.1f} | "
          f"{snr(smooth(truth, half, beam[2]), smooth(model, half, beam[2])):.1f} | {model.sum():.2f} "
          f"({truth.sum():.2f}) |", flush=True)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--clean", type=int, metavar="NITER")
    options = parser.parse_args()
    sys.argv = sys.argv[:1]  # CASA reads the command line, too
    from casa_sara.demo.imagers import quiet, read_image

    base = options.folder.resolve()
    sky = large_sky()
    vis = [str(base / f"data/{config}.ms") for config in "ABCD"]
    if not base.exists():
        base.mkdir(parents=True)
        with quiet(base / "simulation.txt"):
            observe(sky, base / "data", Array(OBSERVATION, tuple("ABCD")), 35.0, 0.01, 8)
    truth = sky.truth()
    common = dict(vis=vis, imsize=list(SHAPE), cell=f"{CELL}arcsec", datacolumn="data", weighting="briggs", robust=-1.0)
    with quiet(base / "tsara.txt"):
        from casa_sara import tsara

        before, begin = resident_mb("VmRSS"), time.perf_counter()
        made = tsara(**common, imagename=str(base / "tsara"), report=True, overwrite=True, nthreads=2)
        seconds, memory = time.perf_counter() - begin, resident_mb() - before
    blocks = made["sara"]["blocks"]
    print(f"{machine()}; {sum(block['samples'] for block in blocks)} visibilities, {len(blocks)} blocks, "
          f"{memory:.0f} MB above the {before:.0f} MB before\n")
    print("| imager | s | iterations | SNR of the model, dB | at half a beam | flux, Jy (true) |\n" + "|---" * 6 + "|")
    model, (_, beam) = read_image(base / "tsara.model")[0], read_image(base / "tsara.image")
    report_line("tsara, with report", model, truth, seconds, beam, f"{made['iterdone']}, {made['stopDescription']}")
    if options.clean:
        scales = [0, *(round(factor * np.sqrt(beam[0] * beam[1]) / CELL) for factor in (0.6, 1.8, 5.4, 16))]
        with quiet(base / "tclean.txt"):
            from casatasks import tclean

            begin = time.perf_counter()
            done = tclean(**common, imagename=str(base / "tclean"), deconvolver="multiscale", scales=scales,
                          smallscalebias=-0.8,
                          niter=options.clean, gain=0.2, nsigma=2.0)
            seconds = time.perf_counter() - begin
        report_line("tclean multiscale", read_image(base / "tclean.model")[0], truth, seconds, beam, done["iterdone"])


if __name__ == "__main__":
    main()
