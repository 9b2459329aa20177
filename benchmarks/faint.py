"""The study of faint skies: tsara with defaults beside tclean, tuned for every scene, at an S/N of 5 to 300.

    python benchmarks/faint.py FOLDER                     # both sets; what FOLDER holds of tclean is not done again
    python benchmarks/faint.py FOLDER --set chosen        # to develop with; those of 'apart' are to be looked at once
    python benchmarks/faint.py FOLDER --only simulate     # write the observations: FOLDER/<scene>/obs.ms and truth.npz
    python benchmarks/faint.py FOLDER --only clean        # run tclean on what is not done yet
    python benchmarks/faint.py FOLDER --only tsara        # run tsara, anew
    python benchmarks/faint.py FOLDER --only table        # the table and its summary
    python benchmarks/faint.py FOLDER --scenes points_30_  # only scenes whose label holds this
    python benchmarks/faint.py FOLDER --options regscale=2.0 nreweights=5   # kept under another name than the defaults
    python benchmarks/faint.py FOLDER --only table --twice     # tsara on images of twice the width: does the flux stay?
    python benchmarks/faint.py FOLDER --only table --picture   # a picture of all models as well, FOLDER/<set>.png

The scenes are those of faint_scenes.py; S/N is that of the peak of the natural dirty image. tclean runs multiscale with
the eight settings of TRIES on every scene; the better is that with the highest SNR against the truth: at half a beam
for all that is said of it, and at one beam for the margin there. On a blank sky it is that with the least flux.

SNR = 20 log10(‖truth‖/‖truth − model‖), the model smoothed to half, one and two natural beams, the truth as well, on
its grid three times finer. σ is the noise of the natural dirty image, which is that of the flux of a point source.
Outside is where the true sky, smoothed to one beam, is below a thousandth of its peak, a beam away from all that is
not. A flux fails, at an S/N of 30 and more, by more than 3 % and 2 σ; what is outside by more than 2 % of the total, or
1 σ at a lower S/N. All run on one thread.
"""

from __future__ import annotations

import argparse
import ast
import json
import os
import shutil
import sys
import time
from functools import cached_property
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")
sys.path.insert(0, str(Path(__file__).resolve().parent))

import numpy as np
from faint_scenes import SETS, Scene, Truth, simulate

BEAMS = (0.5, 1.0, 2.0)
EMPTY = 1e-3  # of the peak: fainter is outside the sources
WEIGHTINGS = {"natural": dict(weighting="natural"), "briggs": dict(weighting="briggs", robust=0.5)}
TRIES = [(weighting, mask, nsigma) for weighting in WEIGHTINGS for mask in ("auto", "none") for nsigma in (3, 2)]
SCALES = (0, 1, 2.5)  # beams
CLEAN = dict(deconvolver="multiscale", gain=0.2, niter=3000, cycleniter=500)
# what ALMA advises for its arrays; less than the defaults where the sidelobes are at 0.34; the defaults elsewhere
AUTO = {
    "ALMA-compact": dict(sidelobethreshold=2.0, noisethreshold=4.25),
    "7-m": dict(sidelobethreshold=1.25, noisethreshold=5.0, lownoisethreshold=2.0, minbeamfrac=0.1),
    "snapshot": dict(sidelobethreshold=1.25),
}
WHOLE = -0.01  # pblimit: the simulated sky has no primary beam, and the whole image counts


class Judge:
    """Scores models of a scene."""

    def __init__(self, folder: Path):
        self.truth = Truth.read(folder)

    @cached_property
    def skies(self) -> dict[float, np.ndarray]:
        """The true sky at each of BEAMS."""
        return {beams: self.truth.smoothed(beams) for beams in BEAMS}

    @cached_property
    def outside(self) -> np.ndarray:
        """Where there is nothing."""
        from scipy.ndimage import binary_dilation

        sky = self.skies[1.0]
        sources = sky > EMPTY * sky.max() if sky.max() > 0 else np.zeros(sky.shape, bool)
        radius = float(np.sqrt(self.truth.beam[0] * self.truth.beam[1]))
        reach = np.arange(-int(radius), int(radius) + 1)
        return ~binary_dilation(sources, np.hypot(reach[:, None], reach) <= radius) if sources.any() else ~sources

    def smoothed(self, model, beams: float) -> np.ndarray:
        """A model as the truth is smoothed."""
        from casa_sara.analysis.metrics import smooth

        major, minor, angle = self.truth.beam
        return smooth(model, [beams * major, beams * minor], angle)

    def scores(self, model, residual) -> dict:
        """Return SNRs, fluxes in units of the true one (0 on a blank sky) and of σ, and the residual's σ."""
        from casa_sara.analysis.metrics import snr

        true, noise = float(self.truth.img.sum()), self.truth.noise
        total, outside = float(model.sum()), float(model[self.outside].sum())
        result = dict(flux=total / true if true else 0.0, flux_sigma=(total - true) / noise,
                      outside=outside / true if true else 0.0, outside_sigma=outside / noise,
                      residual=float(residual.std() / noise))
        for beams in BEAMS:
            result[str(beams)] = snr(self.skies[beams], self.smoothed(model, beams)) if true else 0.0
        return result


def common(truth: Truth, folder: Path, name: str) -> dict:
    """Return the parameters that both imagers share."""
    return dict(vis=str(folder / "obs.ms"), imagename=str(folder / name), imsize=len(truth.img), pblimit=WHOLE,
                cell=f"{truth.cell_arcsec}arcsec", datacolumn="data")


def clean_name(weighting: str, mask: str, nsigma: int) -> str:
    """Return what the files of a run of tclean are called."""
    return f"clean_{weighting}_{mask}_{nsigma}"


def run_clean(scene: Scene, folder: Path, judge: Judge, weighting: str, mask: str, nsigma: int) -> dict:
    """Run tclean once, or return what it gave before."""
    name = clean_name(weighting, mask, nsigma)
    kept = folder / f"{name}.json"
    if kept.exists():
        return json.loads(kept.read_text())
    from casa_sara.demo.imagers import quiet, read_image

    width = np.sqrt(judge.truth.beam[0] * judge.truth.beam[1])
    parameters = {**common(judge.truth, folder, name), **WEIGHTINGS[weighting], **CLEAN, "nsigma": float(nsigma),
                  "scales": [round(scale * width) for scale in SCALES]}
    if mask == "auto":
        parameters |= dict(usemask="auto-multithresh", **AUTO.get(scene.array, {}))
    remove_images(folder, name)
    with quiet(folder / f"{name}.txt"):
        from casatasks import tclean

        begin = time.perf_counter()
        made = tclean(**parameters)
    seconds = time.perf_counter() - begin
    model, residual = (read_image(folder / f"{name}.{kind}")[0] for kind in ("model", "residual"))
    remove_images(folder, name)
    np.savez_compressed(folder / f"{name}.npz", model=model.astype(np.float32))
    result = dict(name=name, seconds=seconds, iterations=int(made["iterdone"]), stop=made.get("stopDescription", ""),
                  **judge.scores(model, residual))
    kept.write_text(json.dumps(result))
    return result


def remove_images(folder: Path, name: str) -> None:
    """Remove the images of a run."""
    for path in folder.glob(f"{name}.*"):
        if path.is_dir():
            shutil.rmtree(path)


def cleaned(scene: Scene, folder: Path) -> dict[str, dict]:
    """Return the better tclean at half a beam, and that at one; of a blank sky both are that with the least flux."""
    tried = [json.loads((folder / f"{clean_name(*settings)}.json").read_text()) for settings in TRIES]
    if scene.sky == "blank":
        return dict.fromkeys(("0.5", "1.0"), min(tried, key=lambda result: abs(result["flux_sigma"])))
    return {beams: max(tried, key=lambda result: result[beams]) for beams in ("0.5", "1.0")}


def run_tsara(folder: Path, judge: Judge, name: str, options: dict) -> dict:
    """Run tsara and score it."""
    from casa_sara import tsara
    from casa_sara.demo.imagers import quiet, read_image

    with quiet(folder / f"{name}.txt"):
        begin = time.perf_counter()
        made = tsara(**{**common(judge.truth, folder, name), "nthreads": 1, "overwrite": True, **options})
    seconds = time.perf_counter() - begin
    model, residual = (read_image(folder / f"{name}.{kind}")[0] for kind in ("model", "residual"))
    np.savez_compressed(folder / f"{name}.npz", model=model.astype(np.float32))
    result = dict(name=name, seconds=seconds, iterations=int(made["iterdone"]), stop=made["stopDescription"])
    if model.shape == judge.truth.img.shape:
        result |= judge.scores(model, residual)
    (folder / f"{name}.json").write_text(json.dumps(result))
    return result


def kept_model(folder: Path, name: str) -> np.ndarray:
    """Return the model that a run left."""
    return np.load(folder / f"{name}.npz")["model"].astype(float)


def compare_with_twice(scene: Scene, folder: Path, judge: Judge, name: str, options: dict) -> None:
    """Image twice the width, and print how the total flux and that of the sources change."""
    n, noise = scene.size, judge.truth.noise
    made = run_tsara(folder, judge, f"{name}_twice", {**options, "imsize": 2 * n})
    usual, wide = kept_model(folder, name), kept_model(folder, f"{name}_twice")
    middle = wide[n // 2 : n // 2 + n, n // 2 : n // 2 + n]
    sources, cells = judge.outside ^ (scene.sky != "blank"), [scene.label]
    for before, after in ((usual.sum(), wide.sum()), (usual[sources].sum(), middle[sources].sum())):
        cells += [f"{(after - before) / before:+.3f}" if before else "", f"{(after - before) / noise:+.1f}"]
    print("| " + " | ".join([*cells, f"{made['iterations']}", f"{made['seconds']:.0f}"]) + " |", flush=True)


def done(folder: Path, name: str) -> bool:
    """Whether a scene has all results."""
    names = [name, *(clean_name(*settings) for settings in TRIES)]
    return all((folder / f"{each}.json").exists() for each in names)


def row(scene: Scene, folder: Path, name: str) -> tuple[str, dict, dict[str, dict]]:
    """Return a line of the table, what tsara gave and the better tcleans."""
    sara, clean = json.loads((folder / f"{name}.json").read_text()), cleaned(scene, folder)
    better, other = clean["0.5"], clean["1.0"]
    names = scene.label.removeprefix(f"{scene.group}_"), better["name"].removeprefix("clean_")
    cells = [each.replace("_", " ") for each in names]
    if scene.sky == "blank":
        cells += [""] * 5
    else:
        cells += [f"{sara[beams]:.1f} / {against[beams]:.1f}"
                  for beams, against in (("0.5", better), ("1.0", other), ("2.0", better))]
        cells += [f"{sara['0.5'] - better['0.5']:+.1f}, {sara['1.0'] - other['1.0']:+.1f}",
                  f"{sara['flux']:.3f} / {better['flux']:.3f}"]
    cells += [f"{sara['flux_sigma']:+.1f} / {better['flux_sigma']:+.1f}"]
    cells += ["" if scene.sky == "blank" else f"{100 * sara['outside']:.1f} / {100 * better['outside']:.1f}"]
    cells += [f"{sara['outside_sigma']:.1f} / {better['outside_sigma']:.1f}",
              f"{sara['residual']:.2f}", f"{sara['seconds']:.0f} / {better['seconds']:.0f}",
              f"{sara['iterations']} {sara['stop']} / {better['iterations']}"]
    return "| " + " | ".join(cells) + " |", sara, clean


def flux_fails(scene: Scene, result: dict) -> bool:
    """Whether a total flux is wrong by more than the noise and a few percent, where the sky is bright enough to ask."""
    return scene.peak >= 30 and abs(result["flux"] - 1) > 0.03 and abs(result["flux_sigma"]) > 2


def outside_fails(scene: Scene, result: dict) -> bool:
    """Whether there is too much where there is nothing."""
    return abs(result["outside"]) > 0.02 if scene.peak >= 30 else abs(result["outside_sigma"]) > 1


def print_table(grid: list[Scene], base: Path, name: str) -> None:
    """Print the study, of all scenes that have results, and its summary."""
    head = ("sky, S/N, array", "better tclean", "dB at half a beam", "at one", "at two", "margins at half, at one",
            "flux", "flux off, σ", "outside, %", "outside, σ", "tsara's residual / noise", "s", "iterations")
    print("| " + " | ".join(head) + " |\n" + "|---" * len(head) + "|")
    found = {}
    for scene in grid:
        if done(base / scene.label, name):
            line, *found[scene] = row(scene, base / scene.label, name)
            print(line, flush=True)
    print(f"\nTwo numbers are those of tsara / tclean. {len(found)} scenes of {len(grid)}:\n")
    skies = [scene for scene in found if scene.sky != "blank"]
    if skies:
        summarise(skies, found)
    for scene in (scene for scene in found if scene.sky == "blank"):
        sara, clean = found[scene]
        print(f"- {scene.label}: flux {sara['flux_sigma']:.2f} σ in {sara['iterations']} iterations, tclean "
              f"{clean['0.5']['flux_sigma']:.2f} σ.")
    if found:
        seconds = [sara["seconds"] for sara, _ in found.values()]
        print(f"- Seconds of tsara: median {np.median(seconds):.0f}, most {max(seconds):.0f}.")


def summarise(skies: list[Scene], found: dict) -> None:
    """Print margins and failures."""
    for beams, words in (("0.5", "half a beam"), ("1.0", "one beam")):
        margins = {scene: found[scene][0][beams] - found[scene][1][beams][beams] for scene in skies}
        least = min(margins, key=margins.get)
        print(f"- At {words}: median {np.median(list(margins.values())):+.1f} dB, least {margins[least]:+.1f} dB "
              f"({least.label}); below tclean on {named(scene for scene in skies if margins[scene] < 0)}.")
    for words, fails in (("Total flux (S/N of 30 and more) off by more than 3 % and 2 σ", flux_fails),
                         ("Outside more than 2 % (S/N of 30 and more) or 1 σ (below)", outside_fails)):
        print(f"- {words}: tsara {named(scene for scene in skies if fails(scene, found[scene][0]))}; "
              f"tclean {named(scene for scene in skies if fails(scene, found[scene][1]['0.5']))}.")


def named(scenes) -> str:
    """Return how many scenes there are and which."""
    labels = [scene.label for scene in scenes]
    return f"{len(labels)}" + (f" ({', '.join(labels)})" if labels else "")


def draw(grid: list[Scene], base: Path, name: str, path: Path, across: int = 3) -> None:
    """Draw truth, tsara and the better tclean of every scene at one beam, on one brightness scale each."""
    from matplotlib.figure import Figure

    grid = [scene for scene in grid if done(base / scene.label, name)]
    down = -(-len(grid) // across)
    figure = Figure(figsize=(5.4 * across, 1.95 * down), layout="constrained")
    panels = figure.subplots(down, 3 * across, squeeze=False)
    for panel in panels.flat:
        panel.set_axis_off()
    for number, scene in enumerate(grid):
        folder = base / scene.label
        judge, better = Judge(folder), cleaned(scene, folder)["0.5"]["name"]
        beam = np.pi * judge.truth.beam[0] * judge.truth.beam[1] / (4 * np.log(2))
        images = [judge.skies[1.0], *(judge.smoothed(kept_model(folder, which), 1.0) for which in (name, better))]
        top = max(images[0].max(), 3 * judge.truth.noise / beam)
        for place, (image, words) in enumerate(zip(images, (scene.label, "tsara", better))):
            panel = panels[number // across, 3 * (number % across) + place]
            panel.imshow(np.sqrt(np.clip(image.T / top, 0, 1)), origin="lower", vmin=0, vmax=1, cmap="inferno")
            panel.set_title(words, fontsize=6)
    figure.savefig(path, dpi=90)


def arguments():
    """Read the command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--set", choices=(*SETS, "all"), default="all")
    parser.add_argument("--only", choices=("simulate", "clean", "tsara", "table"))
    parser.add_argument("--scenes", default="", help="only scenes whose label holds this")
    parser.add_argument("--options", nargs="*", default=[], metavar="k=v", help="parameters of tsara")
    parser.add_argument("--twice", action="store_true", help="tsara on images of twice the width")
    parser.add_argument("--picture", action="store_true", help="draw the models")
    given = parser.parse_args()
    sys.argv = sys.argv[:1]  # CASA reads the command line, too
    return given


def value_of(text: str):
    """Return a value of the command line as Python reads it, else as text."""
    try:
        return ast.literal_eval(text)
    except (ValueError, SyntaxError):
        return text


def main():
    given = arguments()
    base = given.folder.resolve()
    options = {key: value_of(value) for key, value in (option.split("=", 1) for option in given.options)}
    name = "_".join(["tsara", *("".join(c if c.isalnum() or c in ".-" else "-" for c in o) for o in given.options)])
    groups = {group: [scene for scene in scenes if given.scenes in scene.label] for group, scenes in SETS.items()
              if given.set in (group, "all")}
    for scene in (scene for scenes in groups.values() for scene in scenes):
        if given.only == "table":
            break
        folder = base / scene.label
        simulate(scene, folder)
        judge = Judge(folder)
        if given.only in (None, "clean"):
            tried = [run_clean(scene, folder, judge, *settings) for settings in TRIES]
            print(scene.label, "tclean at half a beam:", *(f"{result['0.5']:.1f}" for result in tried), flush=True)
        if given.only in (None, "tsara"):
            made = run_tsara(folder, judge, name, options)
            print(scene.label, f"tsara: {made['0.5']:.1f} dB, flux off by {made['flux_sigma']:.1f} σ, "
                               f"{made['seconds']:.0f} s", flush=True)
    for group, scenes in groups.items():
        if given.twice:
            print(f"\n## {group}, twice the width\n\n"
                  "| scene | total flux | σ | in the sources | σ | iterations | s |\n" + "|---" * 7 + "|")
            for scene in scenes:
                compare_with_twice(scene, base / scene.label, Judge(base / scene.label), name, options)
        elif given.only in (None, "table"):
            print(f"\n## {group}\n")
            print_table(scenes, base, name)
        if given.picture:
            draw(scenes, base, name, base / f"{group}.png")


if __name__ == "__main__":
    main()
