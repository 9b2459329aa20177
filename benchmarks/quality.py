"""The quality study: tsara with defaults beside tclean over scenes, arrays, noise, calibration errors and cell sizes.

    python benchmarks/quality.py FOLDER              # everything; what FOLDER holds already is not done again
    python benchmarks/quality.py FOLDER --only clean   # simulate and run tclean
    python benchmarks/quality.py FOLDER --only tsara   # run tsara on what was simulated, anew
    python benchmarks/quality.py FOLDER --only table   # the tables of docs/validation.md
    python benchmarks/quality.py FOLDER --only longer  # what ten times the iterations would change

Skies stand on pixels three times smaller than the image's, and between them; `--oversampling 1` puts them on its own.

tclean multiscale runs with Briggs −1 and natural weights. On the first case of every scene and array each of the
settings in GRID is tried; the best against the truth, at half the beam, serves all cases of that scene and array
(arrays other than the first, that of M31). `asp` runs on the first case of every scene. All run on one thread.

SNR = 20 log10(‖truth‖/‖truth − model‖) of models, raw and smoothed to a half and to one restoring beam of the CLEAN
that tsara is compared with. The table compares with the harder of the two, where tsara's margin at half a beam is
smaller.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import time
from dataclasses import dataclass
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")  # more of them slow tclean's minor cycle down
sys.path.insert(0, str(Path(__file__).resolve().parent))

import numpy as np
from scenes import ARRAYS, SCENES, Array, nominal_cell_arcsec, observe, replace, scene_sky, smoothed_truth

SUPER_RESOLUTION = 1.7
BEAMS = (0.5, 1.0)
WEIGHTINGS = {"briggs": -1.0, "natural": 0.0}
# scales in units of the beam, bias towards small ones, most iterations; all stop at twice the noise
SHORT, LONG = (0, 0.6, 1.8, 5.4), (0, 0.6, 1.8, 5.4, 16)
GRID = {
    "short": (SHORT, -0.8, 4000), "long": (LONG, -0.8, 4000), "unbiased": (SHORT, 0.0, 4000),
    "long unbiased": (LONG, 0.0, 4000), "deep": (SHORT, -0.8, 20_000),
}  # fmt: skip


@dataclass(frozen=True)
class Case:
    """What is observed, and how."""

    scene: str
    array: str = "VLA A-D"
    noise_db: float = 35.0
    gain_rms: float = 0.0
    pointing_rms: float = 0.0
    noise_scale: tuple[float, ...] = ()
    weight_scale: tuple[float, ...] = ()
    super_resolution: float = SUPER_RESOLUTION
    oversampling: int = 3

    @property
    def label(self) -> str:
        """The case in words: what differs from the first of its scene."""
        first = Case(self.scene)
        changed = [name for name in self.__dataclass_fields__ if getattr(self, name) != getattr(first, name)]
        return ", ".join([self.scene, *(f"{name} {getattr(self, name)}" for name in changed)])

    @property
    def folder(self) -> str:
        """Name of its folder."""
        return "".join(c if c.isalnum() or c in ".-" else "_" for c in self.label)

    @property
    def tuned_on(self) -> Case:
        """The case whose tclean settings it takes."""
        return Case(self.scene if self.array == "VLA A-D" else "M31", self.array, oversampling=self.oversampling)

    @property
    def plain(self) -> bool:
        """Whether it is the first of its scene."""
        return self == Case(self.scene, oversampling=self.oversampling)


def cases(oversampling: int = 3) -> list[Case]:
    """Return the grid: every scene once, then one thing after the other on several of them.

    The skies' pixels are `oversampling` times smaller than the image's; 1: they are the image's own.
    """
    grid = [Case(scene) for scene in SCENES]
    for scene in ("M31", "3c353"):
        grid += [Case(scene, array=array) for array in list(ARRAYS)[1:]]
        grid += [Case(scene, noise_db=noise) for noise in (20.0, 30.0, 40.0, 45.0)]
        grid += [Case(scene, gain_rms=gain) for gain in (0.003, 0.01, 0.03)]
        grid += [Case(scene, pointing_rms=0.01)]
        grid += [Case(scene, noise_scale=(1.0, 3.0, 1.0, 3.0)), Case(scene, weight_scale=(0.5, 0.5, 2.0, 2.0))]
        grid += [Case(scene, super_resolution=factor) for factor in (1.5, 2.5, 4.0)]
    for scene in ("cyga", "W28", "points off pixels"):
        grid += [Case(scene, noise_db=30.0), Case(scene, noise_db=40.0), Case(scene, gain_rms=0.03)]
    return [replace(case, oversampling=oversampling) for case in grid]


def simulation_of(case: Case, folder: Path):
    """Return sky and simulation of a case; the MeasurementSets are written unless they are there."""
    array = ARRAYS[case.array]
    observation = replace(array.observation, pointing_rms=case.pointing_rms, noise_scale=case.noise_scale,
                          weight_scale=case.weight_scale)
    array = Array(observation, array.configs)
    sky = scene_sky(case.scene, nominal_cell_arcsec(array) / case.super_resolution,
                    oversampling=case.oversampling)
    kept = folder / "blocks.json"
    if not kept.exists():
        from casa_sara.demo.imagers import quiet

        folder.mkdir(parents=True, exist_ok=True)
        with quiet(folder / "simulation.txt"):
            simulation = observe(sky, folder, array, case.noise_db, case.gain_rms)
        kept.write_text(json.dumps(dict(vis=simulation.vis, errors=[block.error for block in simulation.blocks])))
    return sky, json.loads(kept.read_text())


def common(case, sky, kept, imagename):
    """Return the parameters that both imagers share."""
    shape = [int(n) // sky.oversampling for n in sky.image.shape]
    cell = sky.cell_rad * sky.oversampling * 180 * 3600 / np.pi
    return dict(vis=kept["vis"], imagename=str(imagename), imsize=shape, cell=f"{cell}arcsec", datacolumn="data")


def scores(sky, model, beam_pixels, angle):
    """Return SNRs of a model, raw and at each of BEAMS, and its total flux over the true one."""
    from casa_sara.analysis.metrics import log_snr, smooth, snr

    truth = sky.truth()
    result = {"raw": snr(truth, model), "log": log_snr(truth, model), "flux": float(model.sum() / truth.sum())}
    for factor in BEAMS:
        fwhm = [factor * axis for axis in beam_pixels]
        result[str(factor)] = snr(smoothed_truth(sky, fwhm, angle), smooth(model, fwhm, angle))
    return result


def run_clean(case: Case, folder: Path, weighting: str, setting: str):
    """Run tclean once, or return what it gave before."""
    name = f"{setting.replace(' ', '_')}_{weighting}"
    kept = folder / f"{name}.json"
    if kept.exists():
        return json.loads(kept.read_text())
    from casa_sara.demo.imagers import quiet, read_image

    sky, simulated = simulation_of(case, folder)
    parameters = common(case, sky, simulated, folder / name)
    cell = float(parameters["cell"].removesuffix("arcsec"))
    parameters.update(weighting=weighting, robust=WEIGHTINGS[weighting], nsigma=2.0)
    with quiet(folder / f"{name}.txt"):
        from casatasks import tclean

        begin = time.perf_counter()
        if setting == "asp":
            parameters.update(deconvolver="asp", niter=4000, gain=0.1)
        else:
            tclean(**{**parameters, "imagename": str(folder / f"{name}_beam"), "niter": 0})
            beam = read_image(folder / f"{name}_beam.image")[1]
            width = np.sqrt(beam[0] * beam[1]) / cell
            scales, bias, niter = GRID[setting]
            scales = sorted({round(scale * width) for scale in scales})
            parameters.update(deconvolver="multiscale", scales=scales, smallscalebias=bias, niter=niter, gain=0.2)
            begin = time.perf_counter()
        made = tclean(**parameters)
    seconds = time.perf_counter() - begin
    model, restored, residual = (read_image(folder / f"{name}.{kind}")[0] for kind in ("model", "image", "residual"))
    beam = read_image(folder / f"{name}.image")[1]
    np.savez_compressed(folder / f"{name}.npz", model=model.astype(np.float32))
    result = dict(beam=beam, seconds=seconds, iterations=int(made["iterdone"]), residual=float(residual.std()),
                  dr=float(restored.max() / residual.std()), setting=setting, weighting=weighting)
    result.update(scores(sky, model, [axis / cell for axis in beam[:2]], beam[2]))
    kept.write_text(json.dumps(result))
    return result


def cleaned(case: Case, base: Path) -> dict[str, dict]:
    """Return the better result of the grid for each weighting."""
    home = case.tuned_on
    best = {}
    for weighting in WEIGHTINGS:
        tried = [run_clean(home, base / home.folder, weighting, setting) for setting in GRID]
        best[weighting] = max(tried, key=lambda result: result["0.5"])["setting"]
    return {weighting: run_clean(case, base / case.folder, weighting, setting) for weighting, setting in best.items()}


def run_tsara(case: Case, folder: Path, against: dict[str, dict], suffix="", **options):
    """Run tsara and score it at the beams of every tclean result."""
    from casa_sara import tsara
    from casa_sara.demo.imagers import quiet, read_image

    sky, simulated = simulation_of(case, folder)
    parameters = common(case, sky, simulated, folder / f"tsara{suffix}")
    cell = float(parameters["cell"].removesuffix("arcsec"))
    with quiet(folder / f"tsara{suffix}.txt"):
        begin = time.perf_counter()
        made = tsara(**parameters, weighting="briggs", robust=-1.0, nthreads=1, overwrite=True, **options)
    seconds = time.perf_counter() - begin
    model, restored, residual = (read_image(folder / f"tsara{suffix}.{kind}")[0]
                                 for kind in ("model", "image", "residual"))
    bounds = [block["l2_bound"] / true for block, true in zip(made["sara"]["blocks"], simulated["errors"], strict=True)]
    result = dict(seconds=seconds, iterations=made["iterdone"], stop=made["stopDescription"],
                  residual=float(residual.std()), dr=float(restored.max() / residual.std()),
                  bounds=(min(bounds), max(bounds)), at={})
    for weighting, clean in against.items():
        result["at"][weighting] = scores(sky, model, [axis / cell for axis in clean["beam"][:2]], clean["beam"][2])
    (folder / f"tsara{suffix}.json").write_text(json.dumps(result))
    return result


def compare_with_longer(cases: list[Case], base: Path) -> None:
    """Print SNRs with defaults and with ten times the interval and the iterations,
    at half of Briggs' beam and at one."""
    from unittest import mock

    from casa_sara.solver.reweighting import Schedule

    patient = Schedule(niter=3400, interval=300, nreweights=11, reltol=1e-7, final_reltol=1e-7)
    print("| case | at half beam | ten times longer | at one beam | ten times longer |\n" + "|---" * 5 + "|")
    for case in cases:
        folder, found = base / case.folder, cleaned(case, base)
        usual = json.loads((folder / "tsara.json").read_text())["at"]["briggs"]
        with mock.patch("casa_sara.reconstruction.reconstruct.schedule_of", lambda options: patient):
            longer = run_tsara(case, folder, found, "_longer")["at"]["briggs"]
        print(f"| {case.label} | " + " | ".join(f"{of[beam]:.1f}" for beam in ("0.5", "1.0") for of in (usual, longer))
              + " |",
              flush=True)


def row(case: Case, base: Path):
    """Return a line of the table, and the margins over the harder CLEAN at half and one beam."""
    folder = base / case.folder
    clean, sara = cleaned(case, base), json.loads((folder / "tsara.json").read_text())
    margin = {name: {beam: sara["at"][name][beam] - result[beam] for beam in ("0.5", "1.0")}
              for name, result in clean.items()}
    better, other = (clean[name] for name in sorted(clean, key=lambda name: margin[name]["0.5"]))
    at, margins = sara["at"][better["weighting"]], margin[better["weighting"]]
    margins["least at one beam"] = min(each["1.0"] for each in margin.values())
    margins["flux"] = abs(at["flux"] - 1), min(abs(result["flux"] - 1) for result in clean.values())
    asp = [json.loads(path.read_text())["0.5"] for path in folder.glob("asp_*.json")]
    cells = [case.label, f"{better['weighting']}, {better['setting']}"]
    cells += [f"{at[key]:.1f} / {better[key]:.1f}" for key in ("raw", "log", "0.5", "1.0")]
    cells += [f"{margins['0.5']:+.1f}", f"{margin[other['weighting']]['0.5']:+.1f}", f"{max(asp):.1f}" if asp
              else "", f"{at['flux']:.4f} / {better['flux']:.4f}",
              f"{sara['residual'] / clean['briggs']['residual']:.2f}",
              f"{sara['dr']:.0f} / {clean['briggs']['dr']:.0f}",
              "{:.2f}–{:.2f}".format(*sara["bounds"]),
              f"{sara['seconds']:.0f} / {better['seconds']:.0f}", f"{sara['iterations']} {sara['stop']}"]
    return "| " + " | ".join(cells) + " |", margins


def print_table(base: Path, grid: list[Case]) -> None:
    """Print the study and its summary."""
    head = ("case", "harder CLEAN", "SNR", "log SNR", "at half beam", "at one beam", "margin at half beam",
            "margin over the other", "asp at half beam", "flux", "residual ratio", "DR", "bounds / true", "s",
            "iterations")
    print("| " + " | ".join(head) + " |\n" + "|---" * len(head) + "|")
    half, one, moderate, fluxes = [], [], [], []
    for case in grid:
        line, margins = row(case, base)
        print(line, flush=True)
        half.append(margins["0.5"])
        one.append(margins["least at one beam"])
        if margins["flux"][1] < 0.01 < margins["flux"][0]:
            fluxes.append(case.label)
        if 30 <= case.noise_db <= 40:
            moderate.append(margins["0.5"])
    print(f"\n{len(grid)} cases. Margin at half a beam: least {min(half):.1f}, median {np.median(half):.1f} dB (at "
          f"30–40 dB input: {np.median(moderate):.1f}); at one beam, over either CLEAN: least {min(one):.1f}, median "
          f"{np.median(one):.1f} dB. Total flux off by more than 1 % where a CLEAN's is not: "
          f"{'; '.join(fluxes) or 'none'}.")


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--only", choices=("clean", "tsara", "table", "longer"))
    parser.add_argument("--cases", default="", help="only cases whose label holds this")
    parser.add_argument("--oversampling", type=int, default=3,
                        help="pixels of the sky in one of the image; 1: the image's own")
    options = parser.parse_args()
    sys.argv = sys.argv[:1]  # CASA reads the command line, too
    base = options.folder.resolve()
    grid = [case for case in cases(options.oversampling) if options.cases in case.label]
    if options.only == "longer":
        compare_with_longer([case for case in grid if case.plain or case.gain_rms == 0.03], base)
    for case in grid:
        if options.only in ("table", "longer"):
            break
        found = cleaned(case, base)
        if case.plain and options.only != "tsara":
            for weighting in WEIGHTINGS:
                run_clean(case, base / case.folder, weighting, "asp")
        print(case.label, {name: round(result["0.5"], 1) for name, result in found.items()}, flush=True)
        if options.only != "clean":
            sara = run_tsara(case, base / case.folder, found)
            print("   tsara", {name: round(scored["0.5"], 1) for name, scored in sara["at"].items()}, flush=True)
    if options.only in (None, "table"):
        print_table(base, grid)


if __name__ == "__main__":
    main()
