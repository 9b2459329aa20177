"""The algorithm of the paper to the letter beside ours: method='dabbech2018' and 'tsara' on simulated and real data.

    python benchmarks/methods.py FOLDER [--niter 20000] [--cases NAME ...]

Scenes of quality.py at an input SNR of 35 dB (their first observation each) and the sets of real_data.py, each solved
by both methods with defaults, but for `niter`, on one thread, two cases at a time. SNRs are those of the model smoothed
to half of and to the whole beam, as in schedule.py; σ is the standard deviation of the naturally weighted residual
image.
"""

from __future__ import annotations

import argparse
import multiprocessing
import os
import sys
import time
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")
sys.path.insert(0, str(Path(__file__).resolve().parent))

import numpy as np
import real_data
from machine import machine
from quality import Case
from scenes import smoothed_truth
from schedule import WIDTH, observed

SCENES = ("cyga", "M31", "W28", "3c353", "points off pixels")
METHODS = ("tsara", "dabbech2018")
ARCSEC = np.pi / 180 / 3600


def real(name, base):
    """Data in blocks, their density and the grid of a real observation."""
    from casa_sara.casa.ms.read import read_visibilities
    from casa_sara.casa.ms.weights import sampling_density
    from casa_sara.imaging.continuum import split
    from casa_sara.options import ImageGrid, Output, Selection

    case = real_data.Case(name, base)
    selection = Selection((str(case.vis),), spw=case.spw, datacolumn="data")
    grid = ImageGrid((case.size, case.size), 2 * (case.cell * ARCSEC,))
    part = split(read_visibilities(selection), Output("").blocks)
    return part, sampling_density(part.data, selection, grid), grid


def residual_sigma(data, grid, model, kept):
    """Standard deviation of the naturally weighted residual image, Jy/beam."""
    from casa_sara.operators.sky import sky_operator

    data = data.take(kept)
    operator = sky_operator(data.uvw, grid, eps=1e-6)
    residual = (data.vis - operator.forward(model)) * (data.weight / data.weight.sum(dtype=float))
    return float(operator.adjoint(residual.astype(np.complex64)).std())


def row(name, base, niter):
    """A line of the table for each method."""
    from casa_sara.analysis.metrics import smooth, snr
    from casa_sara.options import SolverOptions
    from casa_sara.reconstruction.problem import Samples
    from casa_sara.reconstruction.reconstruct import reconstruct

    simulated = name in SCENES
    if simulated:
        sky, _, part, density, grid = observed(Case(name), base)
    else:
        part, density, grid = real(name, base)
    lines = []
    for method in METHODS:
        begin = time.perf_counter()
        samples = Samples(part.data, part.offsets, density, part.noise)
        found = reconstruct(samples, grid, SolverOptions(method=method, niter=niter))
        seconds = time.perf_counter() - begin
        cells = [name, method]
        for factor in (0.5, 1.0):
            fwhm = 2 * [factor * 2 * WIDTH * Case(name).super_resolution] if simulated else None
            cells.append(f"{snr(smoothed_truth(sky, fwhm), smooth(found.model, fwhm, 0.0)):.1f}" if simulated else "")
        noise = found.l2_bounds / np.sqrt(2.0 * np.diff(part.offsets))
        cells += [f"{found.model.sum(dtype=float):.4g}",
                  f"{residual_sigma(part.data, grid, found.model, found.kept):.3g}",
                  f"{np.median(noise):.3g} ({np.nanmedian(part.noise):.3g})", f"{found.record.iteration[-1]}",
                  f"{seconds:.0f}", found.record.stop_description]
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--niter", type=int, default=20_000)
    parser.add_argument("--cases", nargs="*", default=[*SCENES, *real_data.SETS])
    options = parser.parse_args()
    sys.argv = sys.argv[:1]  # CASA reads the command line, too
    head = ("data", "method", "SNR at half a beam", "at one beam", "flux Jy", "σ residual", "noise found (measured)",
            "iterations", "s", "stop")
    print(f"{machine()}, at most {options.niter} iterations\n\n| {' | '.join(head)} |\n" + "|---" * len(head) + "|",
          flush=True)
    with ProcessPoolExecutor(2, multiprocessing.get_context("spawn")) as pool:
        for lines in pool.map(partial(row, base=options.folder.resolve(), niter=options.niter), options.cases):
            print(lines, flush=True)


if __name__ == "__main__":
    main()
