"""What each rule of the solver is worth: tsara with defaults, and with one rule after the other taken out.

    python benchmarks/ablation.py FOLDER                          # every rule, on all observations
    python benchmarks/ablation.py FOLDER --only faint             # of one kind: bright, faint or real
    python benchmarks/ablation.py FOLDER --rules release damping  # these rules alone

'bright' are the cases of schedule.py, their observations in FOLDER/bright; 'faint' the chosen scenes of faint.py, in
FOLDER/faint; 'real' the sets of real_data.py, in FOLDER/real. What is not there is simulated, or unpacked. Each is read
once and kept in FOLDER as the solver is given it; solutions, two at a time, one thread each, do without CASA.

Changes are what leaving a rule out makes: where dB are negative, the rule is good for the image. SNRs are those of
schedule.py and faint.py, σ that of the natural residual image. The scatter is what PERTURBED do, which change the way
to the solution and nothing else; the last column names what changes by more than twice what any of them does. Results
are kept in FOLDER/ablation.json, what it holds is not done again, and FOLDER/ablation.md has the table.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
import pickle
import sys
from concurrent.futures import ProcessPoolExecutor
from contextlib import ExitStack
from dataclasses import replace
from functools import partial
from itertools import product
from pathlib import Path
from unittest import mock

os.environ.setdefault("OMP_NUM_THREADS", "1")
sys.path.insert(0, str(Path(__file__).resolve().parent))

import faint_scenes
import numpy as np
import real_data
from faint import Judge
from machine import machine
from quality import cases
from scenes import smoothed_truth
from schedule import WIDTH, observed

SUBJECTS = {"bright": {case.folder: case for case in cases()}, "real": dict.fromkeys(real_data.SETS),
            "faint": {scene.label: scene for scene in faint_scenes.SETS["chosen"]}}
KINDS = ("bright", "faint", "real")
PERTURBED = ("79 of NNLS", "81 of NNLS", "other noise drawn")  # instead of 80, and another noise for the weights
SNRS = ("dB at half a beam: median, mean (least … most)", "dB at one beam", "iterations, images")
HEADS = {"bright": SNRS, "real": ("σ, %: median, mean (least … most)", "flux, %: median, most", "iterations, images"),
         "faint": (*SNRS, "flux off by, %: median, mean", "outside, %: median, mean, most", "on blank skies, σ")}
EPS = 1e-6  # accuracy of the residual images
FACTOR, LEAST = 2.0, 0.01  # times the largest scatter, and times this (dB, %), from which on a change is one


def rules() -> dict[str, dict]:
    """Every rule: what of the package is replaced by what."""
    from casa_sara.data.outliers import WildSamples
    from casa_sara.reconstruction import problem, reconstruct, solution
    from casa_sara.solver import l1_weights
    from casa_sara.solver.nnls import NNLS_ITERATIONS
    from casa_sara.solver.point_sources import PointSources

    schedule, iteration = reconstruct.schedule_of, solution.AdaptivePPD
    reweight, shares, no_samples = l1_weights.reweight, l1_weights._shares, WildSamples(*np.zeros((3, 0), int))
    undivided = lambda ppd, bounds, scale, confined: reweight(ppd, bounds, scale, False)
    no_points = lambda filter_, gradient, model, support, allowed, significance: (support, PointSources())
    asked = lambda level: {"reconstruction.reconstruct.schedule_of":
                           lambda options: replace(schedule(options), significance=level)}
    return {
        "nothing": {},
        "79 of NNLS": {"reconstruction.problem.nnls": _nnls_of(problem.nnls, NNLS_ITERATIONS - 1)},
        "81 of NNLS": {"reconstruction.problem.nnls": _nnls_of(problem.nnls, NNLS_ITERATIONS + 1)},
        "other noise drawn": {"solver.l1_weights.band_noise": partial(l1_weights.band_noise, seed=1)},
        "release": {"solver.positivity.Release.update": lambda self, ppd, bounds: 0},
        "damping": {"solver.reweighting._damp": lambda ppd, residual_norms: None},
        "shrinking": {"solver.l1_weights.SHRINK": 1.0},
        "steadiness": {"solver.reweighting._is_steady": lambda residual_norms, interval: True},
        "patience": {"solver.reweighting.PATIENCE": 10**9},
        "nearly": {"solver.reweighting.NEARLY": 1.0},
        "wild": {"reconstruction.problem.find_wild": lambda *data: no_samples},
        "over-relaxation": {"reconstruction.solution.AdaptivePPD": partial(iteration, relaxation=1.0)},
        "neighbours": {"operators.dictionary.SaraDictionary.reweight": _reweight_alone},
        "points": {"solver.significance.unresolved": no_points},
        "prior on points": {"solver.l1_weights.POINTS": 1.0},
        "approximations": {"solver.l1_weights.APPROXIMATIONS": 1.0},
        "alpha over nu": {"solver.reweighting.reweight": undivided,
                          "solver.l1_weights._shares": lambda ppd, confined: shares(ppd, True)},
        "excess": {"solver.significance.EXCESS": np.inf},
        "rim": {"solver.significance.FAINT": np.inf},
        "surroundings": {"solver.significance.GROWN": 1.0},
        "sure": {"solver.significance.SURE": 1.0},
        "sidelobes": {f"solver.matched_filter.{end}_SIDELOBE": 0.0 for end in ("LEAST", "MOST")},
        "wide templates": {"solver.matched_filter.BEAMS": (0.0, 1.0)},
        "significance 4": asked(4.0),
        "significance 0": asked(0.0),
    }


def _nnls_of(nnls, iterations):
    """The NNLS fit with another number of iterations."""
    return lambda measurement, vis, precond, norm_sq, fit, *others: nnls(
        measurement, vis, precond, norm_sq, replace(fit, max_iter=iterations), *others)


def _reweight_alone(self, image, alpha, scale, out):
    """W of every coefficient by itself, without its neighbours."""
    out = self.analysis(image, out)
    for band, a, s in zip(self.bands(), alpha, scale):
        out[band.slice] = s * a / (a + np.abs(out[band.slice]))
    return out


def read(kind: str, name: str, base: Path) -> dict:
    """What the solver is given of an observation, and `truth` to judge by; read once, and kept."""
    kept = base / f"{kind}_{name.replace(' ', '_')}.pickle"
    if not kept.exists():
        kept.write_bytes(pickle.dumps(_read(kind, SUBJECTS[kind][name], name, base / kind)))
    return pickle.loads(kept.read_bytes())


def _read(kind, subject, name, folder):
    """Read an observation."""
    if kind == "bright":
        sky, _, part, density, grid = observed(subject, folder)
        widths = [2 * [2 * factor * WIDTH * subject.super_resolution] for factor in (0.5, 1.0)]
        truth = [(width, smoothed_truth(sky, width)) for width in widths]
    elif kind == "faint":
        faint_scenes.simulate(subject, folder / name)
        truth = Judge(folder / name)
        truth.skies, truth.outside  # found now, and kept
        part, density, grid = _part(folder / name / "obs.ms", "", subject.size, truth.truth.cell_arcsec)
    else:
        case, truth = real_data.Case(name, folder), None
        part, density, grid = _part(case.vis, case.spw, case.size, case.cell)
    return dict(data=part.data, offsets=part.offsets, density=density, grid=grid, noise=part.noise, truth=truth)


def _part(vis, spw, size, cell_arcsec):
    """The samples of a MeasurementSet in blocks, their density and the grid."""
    from casa_sara.casa.ms.read import read_visibilities
    from casa_sara.casa.ms.weights import sampling_density
    from casa_sara.imaging.continuum import split
    from casa_sara.options import ImageGrid, Output, Selection

    selection = Selection((str(vis),), spw=spw, datacolumn="data")
    grid = ImageGrid((size, size), 2 * (float(np.radians(cell_arcsec / 3600)),))
    part = split(read_visibilities(selection), Output("").blocks)
    return part, sampling_density(part.data, selection, grid), grid


def solved(task: tuple[str, str, str], base: Path) -> dict:
    """Image an observation without a rule, and say what became of it."""
    from casa_sara.analysis.metrics import smooth, snr
    from casa_sara.casa.ms.weights import dirty_image
    from casa_sara.operators.sky import sky_operator
    from casa_sara.options import SolverOptions
    from casa_sara.reconstruction.problem import Samples
    from casa_sara.reconstruction.reconstruct import reconstruct

    rule, kind, name = task
    seen = read(kind, name, base)
    data, grid, truth, options = seen["data"], seen["grid"], seen["truth"], SolverOptions(nthreads=1)
    with ExitStack() as replaced:
        for target, value in rules()[rule].items():
            replaced.enter_context(mock.patch(f"casa_sara.{target}", value))
        found = reconstruct(Samples(data, seen["offsets"], seen["density"], seen["noise"]), grid, options)
    result = dict(iterations=found.record.iteration[-1], stop=found.record.stop_description, wild=len(found.wild),
                  released=sum(one["released"] for one in found.record.reweightings), flux=float(found.model.sum()))
    if kind == "bright":
        half, one = (snr(sky, smooth(found.model, width, 0.0)) for width, sky in truth)
        return result | dict(half=half, one=one)
    operator = sky_operator(data.uvw, grid, eps=EPS)
    residual = dirty_image(operator, data.vis - operator.forward(found.model), data.imaging_weight)
    if kind == "real":
        return result | dict(sigma=float(residual.std()))
    scores = truth.scores(found.model.astype(float), residual)
    return result | scores | dict(half=scores["0.5"], one=scores["1.0"], blank=not truth.truth.img.any())


def measures(kind: str, now: dict, before: dict) -> tuple[list[str], dict[str, float]]:
    """Cells of the table, and the numbers that are held against the scatter."""
    names = [name for name in now if not now[name].get("blank")]
    of, was = ((lambda key, those=those: np.array([those[name][key] for name in names])) for those in (now, before))
    cells, numbers = [], {}
    for key in ("sigma",) if kind == "real" else ("half", "one"):
        by = 100 * (of(key) / was(key) - 1) if kind == "real" else of(key) - was(key)
        cells.append(f"{np.median(by):+.3f}, {by.mean():+.3f} ({by.min():+.2f} … {by.max():+.2f})")
        numbers |= {key: np.median(by), f"mean {key}": by.mean(), f"least {key}": by.min(), f"most {key}": by.max()}
    if kind == "real":
        flux = 100 * np.abs(of("flux") / was("flux") - 1)
        cells.append(f"{np.median(flux):.2f}, {flux.max():.2f}")
        numbers["flux"] = np.median(flux)
    total, usual = (sum(those[name]["iterations"] for name in now) for those in (now, before))
    numbers["iterations"] = 100 * (total / usual - 1)
    cells.append(f"{total} ({numbers['iterations']:+.0f} %), {len(now)}")
    if kind == "faint":
        off, outside = 100 * np.abs(of("flux") - 1), 100 * np.abs(of("outside"))
        blank = max((abs(one["flux_sigma"]) for one in now.values() if one["blank"]), default=0.0)
        cells += [f"{np.median(off):.2f}, {off.mean():.2f}",
                  f"{np.median(outside):.2f}, {outside.mean():.2f}, {outside.max():.1f}", f"{blank:.1f}"]
        numbers |= dict(flux=np.mean(off - 100 * np.abs(was("flux") - 1)),
                        outside=np.mean(outside - 100 * np.abs(was("outside"))), blank=blank)
    return cells, {f"{kind} {key}": float(number) for key, number in numbers.items()}


def table(results: dict) -> str:
    """The table of all that is there, what is beyond the scatter, and the scatter."""
    usual = results["nothing"]
    kinds = [kind for kind in KINDS if kind in usual]
    found = {(rule, kind): measures(kind, results[rule][kind], usual[kind])
             for rule, kind in product(results, kinds) if results[rule].get(kind)}
    heads = ["without", *(f"{kind}: {head}" for kind in kinds for head in HEADS[kind]), "beyond the scatter"]
    lines, scatter = [f"| {' | '.join(heads)} |", "|---" * len(heads) + "|"], {}
    for rule, kind in found:
        for key, number in found[rule, kind][1].items() if rule in PERTURBED else ():
            scatter[key] = max(scatter.get(key, LEAST), abs(number))
    for rule in results:
        rows = [found.get((rule, kind), ([""] * len(HEADS[kind]), {})) for kind in kinds]
        beyond = [f"{key} {number:+.2f}" for _, numbers in rows for key, number in numbers.items()
                  if rule not in PERTURBED and abs(number) > FACTOR * scatter.get(key, np.inf)]
        lines.append(f"| {' | '.join([rule, *(cell for cells, _ in rows for cell in cells), ', '.join(beyond)])} |")
    for kind, key in product(kinds, ("half", "one", "sigma")):
        by = [abs(one[key] - usual[kind][name][key]) / (0.01 * usual[kind][name][key] if key == "sigma" else 1)
              for rule in PERTURBED for name, one in results[rule].get(kind, {}).items()
              if key in one and not one.get("blank")]
        if by:
            lines.append(f"\nScatter of one {kind} image, {key}, {'%' if key == 'sigma' else 'dB'}: median "
                         f"{np.median(by):.3f}, nine tenths within {np.quantile(by, 0.9):.3f}, most {max(by):.3f}.")
    return "\n".join(lines)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--rules", nargs="*", choices=list(rules()), default=list(rules()), metavar="NAME")
    parser.add_argument("--only", choices=KINDS)
    parser.add_argument("--every", type=int, default=1, metavar="N", help="only each Nth of the bright cases")
    options = parser.parse_args()
    sys.argv = sys.argv[:1]  # CASA reads the command line, too
    kept = (base := options.folder.resolve()) / "ablation.json"
    results = {rule: {} for rule in rules()} | (json.loads(kept.read_text()) if kept.exists() else {})
    there = [(kind, name) for kind in KINDS if options.only in (None, kind)
             for name in list(SUBJECTS[kind])[::options.every if kind == "bright" else 1]]
    tasks = [(rule, *one) for rule in dict.fromkeys(["nothing", *options.rules]) for one in there
             if one[1] not in results[rule].get(one[0], {})]
    with ProcessPoolExecutor(2, multiprocessing.get_context("spawn")) as pool:
        list(pool.map(partial(read, base=base), *zip(*there)))
        for (rule, kind, name), result in zip(tasks, pool.map(partial(solved, base=base), tasks)):
            results[rule] |= {kind: results[rule].get(kind, {}) | {name: result}}
            kept.write_text(json.dumps(results))
            (base / "ablation.md").write_text(table(results) + "\n")
    print(f"{machine()}\n\n{table(results)}")


if __name__ == "__main__":
    main()
