"""Wall time from MeasurementSets to images, and what it buys: tsara with defaults beside tclean and wsclean multiscale.

    python benchmarks/time_to_solution.py FOLDER [--scenes cyga M31 W28] [--repeat 3] [--known briggs short]

Scenes and settings are those of quality.py. The best tclean multiscale run of a scene is that of its five settings and
two weightings whose model has the highest SNR to the truth; all ten are tried first, and their own spread is not
counted against anybody; --known leaves the search out. wsclean (where it is installed) runs multiscale with Briggs −1
and natural weights, each with its automatic threshold at one and two times the noise and an automatic mask; its best is
taken in the same way. Then the best runs and tsara take turns, every run in a new process: time is that of the call,
reading and writing included, importing not; that of the whole process has Python's start and all imports in it. tclean
runs with one and with two OpenMP threads, and the faster counts.
SNR = 20 log10(‖truth‖/‖truth − model‖), of the models as they are and smoothed to half the beam of tclean.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent))

import numpy as np
from astropy.io import fits
from machine import machine
from quality import GRID, WEIGHTINGS, Case, common, run_clean, scores, simulation_of

ROOT, CORES = Path(__file__).resolve().parents[1], 2
RUN = """
import json, sys, time
task, parameters = json.loads(open(sys.argv[1]).read())
if task == "tsara":
    import casatools  # it and the next are what the first call imports, as casatasks imports all of tclean
    import casa_sara.private.task_tsara
    from casa_sara import tsara as run
else:
    from casatasks import tclean as run
begin = time.perf_counter()
run(**parameters)
seconds = time.perf_counter() - begin
print(json.dumps(seconds), file=open("seconds.json", "w"))
"""
WSCLEAN = [(weighting, sigma) for weighting in WEIGHTINGS for sigma in (1, 2)]


def time_task(folder, task, parameters, threads):
    """Seconds that a task takes in a process of its own, and that process; its images are removed before."""
    for old in folder.glob("timed.*"):
        shutil.rmtree(old) if old.is_dir() else old.unlink()
    (folder / "job.json").write_text(json.dumps([task, parameters | dict(imagename=str(folder / "timed"))]))
    environment = os.environ | dict(OMP_NUM_THREADS=str(threads), PYTHONPATH=str(ROOT))
    with open(folder / "timed.txt", "w") as log:
        begin = time.perf_counter()
        subprocess.run([sys.executable, "-c", RUN, "job.json"], cwd=folder, check=True, env=environment, stdout=log,
                       stderr=log)
        whole = time.perf_counter() - begin
    return json.loads((folder / "seconds.json").read_text()), whole


def best_clean(case, folder, known=None):
    """The tclean run of the grid with the best model, or the known one, and the parameters to do it again."""
    runs = [known] if known else [(weighting, setting) for weighting in WEIGHTINGS for setting in GRID]
    tried = [run_clean(case, folder, weighting, setting) for weighting, setting in runs]
    best = max(tried, key=lambda result: result["raw"])
    sky, simulated = simulation_of(case, folder)
    parameters = common(case, sky, simulated, folder / "timed")
    cell = float(parameters["cell"].removesuffix("arcsec"))
    scales, bias, niter = GRID[best["setting"]]
    width = np.sqrt(best["beam"][0] * best["beam"][1]) / cell
    parameters.update(weighting=best["weighting"], robust=WEIGHTINGS[best["weighting"]], nsigma=2.0,
                      deconvolver="multiscale",
                      scales=sorted({round(scale * width) for scale in scales}), smallscalebias=bias, niter=niter,
                      gain=0.2)
    return best, parameters


def run_wsclean(case, folder, weighting, sigma):
    """Run wsclean multiscale on all cores; return seconds and model."""
    sky, simulated = simulation_of(case, folder)
    parameters = common(case, sky, simulated, "")
    (nx, ny), cell = parameters["imsize"], parameters["cell"].removesuffix("arcsec")
    weight = ["briggs", str(WEIGHTINGS[weighting])] if weighting == "briggs" else [weighting]
    root = folder / f"wsclean_{weighting}_{sigma}"
    command = ["wsclean", "-j", str(CORES), "-size", str(nx), str(ny), "-scale", f"{cell}asec", "-weight", *weight,
               "-multiscale",
               "-niter", "1000000", "-mgain", "0.8", "-auto-threshold", str(sigma), "-auto-mask", "5", "-data-column",
               "DATA",
               "-no-update-model-required", "-pol", "I", "-name", str(root), *parameters["vis"]]
    begin = time.perf_counter()
    with open(folder / "wsclean.txt", "w") as log:
        subprocess.run(command, check=True, stdout=log, stderr=log)
    seconds = time.perf_counter() - begin
    return seconds, fits.getdata(f"{root}-model.fits").squeeze().T.astype(float)


def scene(name, base, repeat, known):
    """Print the lines of one scene."""
    from casa_sara.demo.imagers import read_image

    case = Case(name)
    folder = base / case.folder
    sky, simulated = simulation_of(case, folder)
    best, clean = best_clean(case, folder, known)
    sara = common(case, sky, simulated, "") | dict(weighting="briggs", robust=-1.0, nthreads=CORES)
    beam = [axis / float(sara["cell"].removesuffix("arcsec")) for axis in best["beam"][:2]], best["beam"][2]
    chosen = None
    if shutil.which("wsclean"):
        tried = {one: scores(sky, run_wsclean(case, folder, *one)[1], *beam) for one in WSCLEAN}
        tried = {one: score for one, score in tried.items() if np.isfinite(score["raw"])}  # some diverge
        chosen = max(tried, key=lambda one: tried[one]["raw"])
    times = {"tsara": [], "tclean, 1 thread": [], "tclean, 2 threads": [], "wsclean": []}
    for _ in range(repeat):
        times["tclean, 1 thread"].append(time_task(folder, "tclean", clean, 1))
        times["tclean, 2 threads"].append(time_task(folder, "tclean", clean, 2))
        if chosen:
            times["wsclean"].append(2 * run_wsclean(case, folder, *chosen)[:1])
        times["tsara"].append(time_task(folder, "tsara", sara, CORES))
    found = {"tsara": scores(sky, read_image(folder / "timed.model")[0], *beam)}
    found |= {"tclean, 1 thread": best, "tclean, 2 threads": best} | ({"wsclean": tried[chosen]} if chosen else {})
    settings = {"tsara": "defaults", "wsclean": "{}, {} σ".format(*chosen) if chosen else ""}
    settings |= dict.fromkeys(("tclean, 1 thread", "tclean, 2 threads"), f"{best['weighting']}, {best['setting']}")
    quickest = np.median(times["tsara"], axis=0)
    for imager, seconds in times.items():
        if seconds:
            score, cells = found[imager], []
            for one, least in zip(np.transpose(seconds), quickest):
                low, middle, high = np.percentile(one, (0, 50, 100))
                cells += [f"{middle:.1f} ({low:.1f}–{high:.1f})", f"{middle / least:.1f}"]
            for kind in ("raw", "0.5"):
                cells += [f"{score[kind]:.1f}", f"{found['tsara'][kind] - score[kind]:+.1f}"]
            print(f"| {name} | {imager} | {settings[imager]} | {' | '.join(cells)} |", flush=True)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--scenes", nargs="+", default=["cyga", "M31", "W28"])
    parser.add_argument("--repeat", type=int, default=3)
    parser.add_argument("--known", nargs=2, metavar=("WEIGHTING", "SETTING"), help="tclean's best")
    options = parser.parse_args()
    sys.argv = sys.argv[:1]  # CASA reads the command line, too
    head = ("scene", "imager", "settings", "call, s (least–greatest)", "of tsara's", "process, s", "of tsara's",
            "SNR, dB", "tsara's margin", "at half beam", "tsara's margin")
    print(f"{machine()}\n\n| {' | '.join(head)} |\n" + "|---" * len(head) + "|", flush=True)
    for name in options.scenes:
        scene(name, options.folder.resolve(), options.repeat, options.known)


if __name__ == "__main__":
    main()
