"""Iterations and quality of tsara alone on the cases of quality.py: in minutes, what a change of the schedule does.

    python benchmarks/schedule.py FOLDER [--cases M31] [--against BEFORE.json] [--all-samples]

Observations are those of quality.py; the solution is that of the task with defaults on one thread, two cases at a time.
SNRs are those of the model, smoothed to half of and to the whole beam that the longest baseline and Briggs' weights
give, 1.2 of its fringe. The results are written to FOLDER/schedule.json, which a later run can be held `--against`.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import sys
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent))

import numpy as np
from machine import machine
from quality import Case, cases, common, simulation_of
from scenes import smoothed_truth

WIDTH = 1.2  # of the beam, in fringes of the longest baseline


def observed(case: Case, base: Path):
    """Sky and simulation of a case, its data in blocks, their density and the grid: what the task's solver is given."""
    from casa_sara.casa.ms.read import read_visibilities
    from casa_sara.casa.ms.weights import sampling_density
    from casa_sara.imaging.continuum import split
    from casa_sara.options import ImageGrid, Output, Selection

    sky, simulated = simulation_of(case, base / case.folder)
    selection = Selection(tuple(simulated["vis"]), datacolumn="data")
    shape = tuple(common(case, sky, simulated, "")["imsize"])
    grid = ImageGrid(shape, 2 * (sky.cell_rad * sky.oversampling,))
    part = split(read_visibilities(selection), Output("").blocks)
    return sky, simulated, part, sampling_density(part.data, selection, grid), grid


def solved(case: Case, base: Path, averaging: bool = True) -> dict:
    """Image a case, with averages or with all samples, and say what became of it."""
    from casa_sara.analysis.metrics import smooth, snr
    from casa_sara.options import SolverOptions
    from casa_sara.reconstruction.problem import Samples
    from casa_sara.reconstruction.reconstruct import reconstruct

    sky, simulated, part, density, grid = observed(case, base)
    options = SolverOptions(nthreads=1, averaging=averaging)
    found = reconstruct(Samples(part.data, part.offsets, density, part.noise), grid, options)
    ratio = found.l2_bounds / simulated["errors"]
    result = dict(iterations=found.record.iteration[-1], stop=found.record.stop_description,
                  raw=snr(sky.truth(), found.model),
                  bounds=(float(ratio.min()), float(ratio.max())))
    for name, factor in (("half", 0.5), ("one", 1.0)):
        fwhm = 2 * [factor * 2 * WIDTH * case.super_resolution]
        result[name] = snr(smoothed_truth(sky, fwhm), smooth(found.model, fwhm, 0.0))
    return result


def row(case: Case, now: dict, before: dict | None) -> str:
    """A line of the table."""
    cells = [case.label, f"{now['iterations']}", *(f"{now[name]:.2f}" for name in ("raw", "half", "one")),
             "{:.2f}–{:.2f}".format(*now["bounds"]), now["stop"]]
    if before:
        cells[1] = f"{before['iterations']} → {now['iterations']}"
        cells[2:5] = [f"{now[name]:.2f} ({now[name] - before[name]:+.2f})" for name in ("raw", "half", "one")]
    return "| " + " | ".join(cells) + " |"


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--cases", default="", help="only cases whose label holds this")
    parser.add_argument("--oversampling", type=int, default=3,
                        help="pixels of the sky in one of the image; 1: the image's own")
    parser.add_argument("--all-samples", action="store_true", help="do not average the samples in uv cells")
    parser.add_argument("--against", type=Path, help="the results of an earlier run")
    options = parser.parse_args()
    sys.argv = sys.argv[:1]  # CASA reads the command line, too
    base, grid = options.folder.resolve(), [case for case in cases(options.oversampling) if options.cases in case.label]
    earlier = json.loads(options.against.read_text()) if options.against else {}
    print(f"{machine()}\n\n| case | iterations | SNR, dB | at half a beam | at one beam | bounds / true | |\n"
          + "|---" * 7 + "|")
    results = {}
    with ProcessPoolExecutor(2, multiprocessing.get_context("spawn")) as pool:
        for case, result in zip(grid, pool.map(partial(solved, base=base, averaging=not options.all_samples), grid)):
            results[case.folder] = result
            print(row(case, result, earlier.get(case.folder)), flush=True)
    (base / "schedule.json").write_text(json.dumps(results))
    both = [name for name in results if name in earlier]
    if both:
        change = [results[name]["half"] - earlier[name]["half"] for name in both]
        sums = [sum(those[name]["iterations"] for name in both) for those in (earlier, results)]
        print(f"\n{len(both)} cases: {sums[0]} → {sums[1]} iterations; at half a beam {min(change):+.2f} to "
              f"{max(change):+.2f}, median {np.median(change):+.2f} dB.")


if __name__ == "__main__":
    main()
