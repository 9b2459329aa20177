"""The study of errors: how often the true sky lies within 1 and 2 of the errors that tsara's ndraws gives.

    python benchmarks/error_coverage.py FOLDER                  # the faint skies of faint_scenes.py, those of 'chosen'
    python benchmarks/error_coverage.py FOLDER --set apart      # those that were looked at once
    python benchmarks/error_coverage.py FOLDER --set bright     # every sky of quality.py, and gain errors of 1 %
    python benchmarks/error_coverage.py FOLDER --only table     # the tables of what was run before
    python benchmarks/error_coverage.py FOLDER --scenes arcs_30 # only scenes whose name holds this
    python benchmarks/error_coverage.py FOLDER --ndraws 50
    python benchmarks/error_coverage.py FOLDER --nothing 6 # p-values of so many places of every sky where nothing is

All skies are drawn on pixels three times finer than the image's. The model and the truth are smoothed to the restoring
beam (natural weights; bright skies: Briggs −1), and their difference is divided by the error of that, for all pixels
where the smoothed model is more than 5 times its error; there are several of them in a beam, so that fractions have the
scatter of beams, not of pixels. Fluxes are those of islands of S/N 5 and more, each with the surroundings of one beam.
"The error of a known shape" is what the record has without draws. All run on one thread.

With --nothing, circles of one beam's radius, two beams away from where the smoothed truth is above a thousandth of its
peak, are tested as saracompare's features are, on the images that an earlier run has left; the p-values should be
uniform.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import time
from dataclasses import dataclass, replace
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")
sys.path.insert(0, str(Path(__file__).resolve().parent))

import numpy as np
import quality
from faint import common
from faint_scenes import SETS, Truth, simulate
from scenes import SCENES, smoothed_truth

SIGNIFICANT = 5.0
RATIOS = (5, 10, 30, 100, np.inf)  # S/N at one beam, of the rows of a table
APART = 3.0  # beams of the centre of a place where nothing is, from all that is and from other places
GAIN_ERRORS = ("cyga", "M31", "3c353")


class Faint:
    """A sky of faint_scenes.py."""

    def __init__(self, scene):
        self.scene, self.name = scene, scene.label
        self.options: dict = {}

    def prepare(self, folder: Path) -> dict:
        """Simulate it unless that is done; return the parameters of tsara."""
        simulate(self.scene, folder)
        self.truth = Truth.read(folder)
        return common(self.truth, folder, "tsara")

    def smoothed(self, beam) -> np.ndarray:
        """The sky smoothed to a beam (pixels, pixels, degrees), Jy/pixel."""
        return replace(self.truth, beam=beam).smoothed(1.0)

    def binned(self) -> np.ndarray:
        """The sky on the pixels of the image."""
        return self.truth.img


class Bright:
    """A sky of quality.py."""

    def __init__(self, case):
        self.case, self.name = case, case.folder
        self.options = dict(weighting="briggs", robust=-1.0)

    def prepare(self, folder: Path) -> dict:
        """Simulate it unless that is done; return the parameters of tsara."""
        self.sky, simulated = quality.simulation_of(self.case, folder)
        return quality.common(self.case, self.sky, simulated, folder / "tsara")

    def smoothed(self, beam) -> np.ndarray:
        """The sky smoothed to a beam (pixels, pixels, degrees), Jy/pixel."""
        return smoothed_truth(self.sky, beam[:2], beam[2])

    def binned(self) -> np.ndarray:
        """The sky on the pixels of the image."""
        return self.sky.truth()


def skies(group: str) -> list:
    """Return the skies of a set."""
    if group != "bright":
        return [Faint(scene) for scene in SETS[group] if scene.sky != "blank"]
    cases = [quality.Case(scene) for scene in SCENES]
    return [Bright(case) for case in cases + [quality.Case(scene, gain_rms=0.01) for scene in GAIN_ERRORS]]


@dataclass(frozen=True)
class Deviations:
    """Differences from the truth in units of the error, and the S/N of each."""

    z: np.ndarray
    ratio: np.ndarray

    def row(self, low: float, high: float) -> list[float]:
        """How many there are between two S/N, the parts within 1 and 2, and the median |z| over that of a Gaussian."""
        z = np.abs(self.z[(self.ratio >= low) & (self.ratio < high)])
        return [z.size, (z < 1).mean(), (z < 2).mean(), np.median(z) / 0.6745] if z.size else [0, *3 * [np.nan]]


def at_one_beam(sky, model, draws, beam, seen=True) -> Deviations:
    """Compare the model smoothed to the beam with the truth, where it is `seen`."""
    from casa_sara.analysis.metrics import smooth

    def smoothed(image):
        return smooth(image, beam[:2], beam[2])

    error, found = draws.error(smoothed), smoothed(model)
    ratio = np.divide(found, error, out=np.zeros_like(found), where=error > 1e-3 * error.max())
    where = (ratio > SIGNIFICANT) & seen
    return Deviations(((found - sky.smoothed(beam))[where] / error[where]), ratio[where])


def of_islands(sky, model, islands, draws, beam) -> tuple[Deviations, np.ndarray]:
    """Compare the fluxes of islands with the truth; return also the differences over the errors for a known shape."""
    from scipy.ndimage import distance_transform_edt, label

    labels, number = label(model != 0, np.ones((3, 3), int))
    distance, nearest = distance_transform_edt(labels == 0, return_indices=True)
    regions = np.where(distance <= np.sqrt(beam[0] * beam[1]), labels[tuple(nearest)], 0)
    truth = np.bincount(regions.ravel(), sky.binned().ravel(), number + 1)
    flux = np.bincount(regions.ravel(), model.ravel(), number + 1)
    error = draws.flux_errors(regions)
    chosen = [island for island in islands if island["snr"] >= SIGNIFICANT]
    index = np.array([labels[island["x_peak"], island["y_peak"]] for island in chosen], int)
    off = (flux - truth)[index]
    known_shape = np.array([island["flux_error_jy"] for island in chosen])
    return Deviations(off / error[index - 1], np.array([island["snr"] for island in chosen])), off / known_shape


def run(sky, folder: Path, ndraws: int) -> None:
    """Image a sky with and without draws, and keep what the table needs."""
    from casa_sara import tsara
    from casa_sara.demo.imagers import quiet, read_image
    from casa_sara.reconstruction.draws import read_draws

    parameters = sky.prepare(folder) | dict(nthreads=1, overwrite=True, **sky.options)
    seconds = []
    with quiet(folder / "tsara.txt"):
        for number in (0, ndraws):
            begin = time.perf_counter()
            made = tsara(**parameters, ndraws=number)
            seconds.append(time.perf_counter() - begin)
    root = parameters["imagename"]
    model, beam = read_image(f"{root}.model")[0], read_image(f"{root}.image")[1]
    cell = float(parameters["cell"].removesuffix("arcsec"))
    beam = (beam[0] / cell, beam[1] / cell, beam[2])
    kept = dict(seconds=seconds, iterations=made["iterdone"], bytes_per_pixel=np.nan)
    if os.path.exists(f"{root}.draws.npz"):
        draws = read_draws(f"{root}.draws.npz")
        kept["bytes_per_pixel"] = os.path.getsize(f"{root}.draws.npz") / model.size
        beams = at_one_beam(sky, model, draws, beam)
        islands, known = of_islands(sky, model, made["sara"]["islands"], draws, beam)
        kept |= dict(z=beams.z, ratio=beams.ratio, island_z=islands.z, island_ratio=islands.ratio, island_known=known)
    np.savez_compressed(folder / "coverage.npz", **kept)


def p_values(sky, folder: Path, number: int, seed: int = 1) -> list[tuple[float, float]]:
    """Return p-value and rank p-value of places of an imaged sky where nothing is."""
    from scipy.ndimage import distance_transform_edt

    from casa_sara.casa.images.image_sets import read_image_set
    from casa_sara.comparison.features import test_features
    from casa_sara.demo.imagers import quiet
    from casa_sara.options import Selection

    parameters = sky.prepare(folder)
    one = read_image_set(parameters["imagename"])
    beam = [axis / float(parameters["cell"].removesuffix("arcsec")) for axis in one.beam[:2]] + [one.beam[2]]
    radius, truth = float(np.sqrt(beam[0] * beam[1])), sky.smoothed(beam)
    x, y = np.indices(truth.shape)
    free = distance_transform_edt(truth < 1e-3 * truth.max()) > APART * radius
    regions, rng = {}, np.random.default_rng(seed)
    edge = int(2 * radius)
    for _ in range(1000):
        px, py = (int(rng.integers(edge, n - edge)) for n in truth.shape)
        region = np.hypot(x - px, y - py) <= radius
        if len(regions) < number and free[region].all():
            regions[f"{px}, {py}"] = region
            free[np.hypot(x - px, y - py) <= APART * radius] = False
    vis = parameters["vis"] if isinstance(parameters["vis"], list) else [parameters["vis"]]
    with quiet(folder / "nothing.txt"):
        found = test_features(one, regions, Selection(tuple(vis), datacolumn="data"))
    return [(result.p_value, result.rank_p_value) for result in found.values()]


def print_p_values(chosen: list, base: Path, number: int) -> None:
    """Test, and print how many of the p-values are below some."""
    values = []
    for sky in chosen:
        if (base / sky.name / "tsara.model").exists():
            found = p_values(sky, base / sky.name, number)
            values += found
            print(f"{sky.name}: " + ", ".join(f"{p:.3g} ({rank:.2g})" for p, rank in found), flush=True)
    values = np.array(values).reshape(-1, 2)
    below = ", ".join(f"{(values[:, 0] < p).mean():.3f} of them below {p}" for p in (0.01, 0.05, 0.1, 0.25, 0.5, 0.75))
    print(f"\n{len(values)} p-values where nothing is: {below}.")


def print_table(group: str, chosen: list, base: Path) -> None:
    """Print what was found, by sky and by S/N."""
    paths = {sky.name: base / sky.name / "coverage.npz" for sky in chosen}
    found = {name: np.load(path) for name, path in paths.items() if path.exists()}
    print(f"\n## {group}: {len(found)} skies of {len(chosen)}\n")
    print("| sky | pixels | within 1, 2 σ | median z | islands | within 1, 2 σ | with the error of a known shape | "
          "draws' time / run's | bytes a pixel |\n" + "|---" * 9 + "|")
    for name, one in found.items():
        ratio = f"{one['seconds'][1] / one['seconds'][0] - 1:.1f}"
        if "z" not in one:
            print(f"| {name} | the model is empty |" + " |" * 5 + f" {ratio} | |")
            continue
        beams, islands = Deviations(one["z"], one["ratio"]), Deviations(one["island_z"], one["island_ratio"])
        (pixels, *within), (count, *fluxes) = beams.row(0, np.inf), islands.row(0, np.inf)
        known = Deviations(one["island_known"], one["island_ratio"]).row(0, np.inf)
        print(f"| {name} | {pixels} | {within[0]:.2f}, {within[1]:.2f} | {within[2]:.2f} | {count} | {fluxes[0]:.2f}, "
              f"{fluxes[1]:.2f} | {known[1]:.2f}, {known[2]:.2f} | {ratio} | {one['bytes_per_pixel']:.1f} |")
    for title, z, ratio in (("At one beam", "z", "ratio"), ("Islands", "island_z", "island_ratio")):
        skies = [one for one in found.values() if "z" in one]
        rows = [Deviations(one[z], one[ratio]) for one in skies]
        print(f"\n{title}, by S/N; of pixels each sky counts as one, islands are counted one by one:\n\n"
              "| S/N | number | within 1 σ | within 2 σ |\n" + "|---" * 4 + "|")
        for low, high in zip(RATIOS[:-1], RATIOS[1:]):
            if z == "z":
                lines = np.array([line for row in rows if (line := row.row(low, high))[0] >= 100]).reshape(-1, 4)
                number, *within = len(lines), *(lines[:, 1:3].mean(axis=0) if len(lines) else (np.nan, np.nan))
            else:
                whole = Deviations(*(np.concatenate([one[name] for one in skies]) for name in (z, ratio)))
                number, *within = whole.row(low, high)[:3]
            print(f"| {low}–{high:g} | {number} | {within[0]:.2f} | {within[1]:.2f} |")


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--set", choices=("chosen", "apart", "bright"), default="chosen")
    parser.add_argument("--only", choices=("run", "table"))
    parser.add_argument("--scenes", default="", help="only skies whose name holds this")
    parser.add_argument("--ndraws", type=int, default=20)
    parser.add_argument("--nothing", type=int, default=0, help="places of every sky to test where nothing is")
    given = parser.parse_args()
    sys.argv = sys.argv[:1]  # CASA reads the command line, too
    base = given.folder.resolve()
    chosen = [sky for sky in skies(given.set) if given.scenes in sky.name]
    if given.nothing:
        print_p_values(chosen, base, given.nothing)
        return
    for sky in chosen if given.only != "table" else ():
        (base / sky.name).mkdir(parents=True, exist_ok=True)
        run(sky, base / sky.name, given.ndraws)
        print(json.dumps(dict(done=sky.name)), flush=True)
    if given.only != "run":
        print_table(given.set, chosen, base)


if __name__ == "__main__":
    main()
