"""Wall time from MeasurementSets to images, and what it buys: tsara with defaults beside tclean and wsclean multiscale.

    python benchmarks/time_to_solution.py FOLDER [--scenes cyga M31 W28] [--repeat 3] [--known briggs short]

Scenes and settings are those of quality.py. The best tclean multiscale run of a scene is that of its five settings and
two weightings whose model has the highest SNR to the truth; all ten are tried first, and their own spread is not
counted against anybody; --known leaves the search out. wsclean (where it is installed) runs multiscale with Briggs −1
and natural weights, each with its automatic threshold at one and two times the noise and an automatic mask; its best is
taken in the same way. Then the best runs and tsara take turns, every run in a new process: time is that of the call,
reading and writing included, importing not. tclean runs with one and with two OpenMP threads, and the faster counts.
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

CORES = 2
WSCLEAN = [(weighting, sigma) for weighting in WEIGHTINGS for sigma in (1, 2)]


def worker(path):
    """Run one CASA task with the parameters in a file; write the seconds of the call into it."""
    from casa_sara.demo.imagers import quiet

    job = json.loads(Path(path).read_text())
    with quiet(Path(path).with_suffix(".txt")):
        import casatasks

        import casa_sara

        task = casa_sara.tsara if job["task"] == "tsara" else casatasks.tclean
        begin = time.perf_counter()
        task(**job["parameters"])
        seconds = time.perf_counter() - begin
    Path(path).write_text(json.dumps(job | dict(seconds=seconds)))


def time_task(folder, task, parameters, threads):
    """Seconds that a task takes in a process of its own; its images are removed before."""
    for old in folder.glob("timed.*"):
        shutil.rmtree(old) if old.is_dir() else old.unlink()
    path = folder / "job.json"
    path.write_text(json.dumps(dict(task=task, parameters=parameters | dict(imagename=str(folder / "timed")))))
    environment = os.environ | dict(OMP_NUM_THREADS=str(threads))
    subprocess.run([sys.executable, __file__, "--worker", str(path)], check=True, env=environment)
    return json.loads(path.read_text())["seconds"]


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
            times["wsclean"].append(run_wsclean(case, folder, *chosen)[0])
        times["tsara"].append(time_task(folder, "tsara", sara, CORES))
    found = {"tsara": scores(sky, read_image(folder / "timed.model")[0], *beam)}
    found |= {"tclean, 1 thread": best, "tclean, 2 threads": best} | ({"wsclean": tried[chosen]} if chosen else {})
    settings = {"tsara": "defaults", "wsclean": "{}, {} σ".format(*chosen) if chosen else ""}
    settings |= dict.fromkeys(("tclean, 1 thread", "tclean, 2 threads"), f"{best['weighting']}, {best['setting']}")
    quickest = np.median(times["tsara"])
    for imager, seconds in times.items():
        if seconds:
            score, low, middle, high = found[imager], *np.percentile(seconds, (0, 50, 100))
            print(f"| {name} | {imager} | {settings[imager]} | {middle:.1f} ({low:.1f}–{high:.1f}) | "
                  f"{middle / quickest:.1f} | {score['raw']:.1f} | {found['tsara']['raw'] - score['raw']:+.1f} | "
                  f"{score['0.5']:.1f} | {found['tsara']['0.5'] - score['0.5']:+.1f} |", flush=True)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--scenes", nargs="+", default=["cyga", "M31", "W28"])
    parser.add_argument("--repeat", type=int, default=3)
    parser.add_argument("--known", nargs=2, metavar=("WEIGHTING", "SETTING"), help="tclean's best")
    options = parser.parse_args()
    sys.argv = sys.argv[:1]  # CASA reads the command line, too
    print(f"{machine()}\n\n| scene | imager | settings | s (least–greatest) | of tsara's time | SNR, dB | tsara's "
          "margin | at half beam | tsara's margin |\n" + "|---" * 9 + "|", flush=True)
    for name in options.scenes:
        scene(name, options.folder.resolve(), options.repeat, options.known)


if __name__ == "__main__":
    if sys.argv[1:2] == ["--worker"]:
        arguments, sys.argv = sys.argv[2:], sys.argv[:1]
        worker(*arguments)
    else:
        main()
