"""Unresolved sources on and between pixels: what becomes of them,
on scenes enough to tell a change of the solver from chance.

    python benchmarks/point_sources.py FOLDER [--against BEFORE.json]

The samples are those of observations of quality.py (made in FOLDER where they are not there); their visibilities are
the exact sums of point sources and Gaussians at random places, with thermal noise and, in some scenes, gain errors of
every antenna and block. The solution is that of the task with defaults on one thread, two scenes at a time. SNRs are
those of the model, smoothed to half of and to the whole beam, against the same Gaussians without pixels. A single scene
goes up and down by a decibel or two with anything that changes; the means count. "First" scenes were looked at while
the release from positivity was chosen, the "kept apart" ones only for the last choice. Results are written to
FOLDER/point_sources.json.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import sys
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import partial
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent))

import numpy as np
from machine import machine
from quality import Case
from scenes import replace
from schedule import WIDTH, observed

FWHM = 2 * np.sqrt(2 * np.log(2))
EXTENDED = ((3.0, 8, -5, 20.0), (2.0, -15, 10, 12.0), (1.0, 0, 0, 35.0))  # Jy, pixels from the centre, FWHM in pixels


@dataclass(frozen=True)
class Scene:
    """Point sources of 1 Jy to 1/`faintest` Jy, or Gaussians of `width` pixels, in the middle quarter of an image."""

    name: str
    number: int
    faintest: float
    noise_db: float
    seed: int
    on_pixels: bool = False
    width: float = 0.0
    extended: bool = False
    gain_rms: float = 0.0
    samples_of: Case = Case("M31")

    @property
    def label(self) -> str:
        """The scene in words."""
        changed = [f"{self.noise_db:g} dB", *([f"gains {self.gain_rms:.1%}"] if self.gain_rms else [])]
        return ", ".join([self.name, *changed, self.samples_of.label.removeprefix(self.samples_of.scene + ", ")])

    def sources(self, shape, rng):
        """Rows of Jy, pixel in x and y, FWHM in pixels."""
        places = rng.uniform(0.25 * shape[0], 0.75 * shape[0], (self.number, 2))
        if self.on_pixels:
            places = np.round(places)
        fluxes = self.faintest ** -rng.uniform(0, 1, self.number)
        fluxes[0] = 1
        rows = [(flux, *place, self.width) for flux, place in zip(fluxes, places)]
        if self.extended:
            rows += [(flux, shape[0] / 2 + x, shape[1] / 2 + y, fwhm) for flux, x, y, fwhm in EXTENDED]
        return np.array(rows)


SNAPSHOT = Case("M31", array="ALMA snapshot")
FIRST = (
    Scene("one", 1, 1, 35, 100), Scene("five", 5, 100, 45, 101), Scene("sixty", 60, 30, 35, 102),
    Scene("sixty on pixels", 60, 30, 45, 103, on_pixels=True), Scene("ten compact", 10, 20, 40, 104, width=1.5),
    Scene("twenty and extended", 20, 20, 40, 105, extended=True), Scene("twenty", 20, 30, 35, 106, samples_of=SNAPSHOT),
    Scene("three on pixels and extended", 3, 5, 50, 107, on_pixels=True, extended=True),
    Scene("twenty and extended", 20, 20, 30, 108, extended=True, samples_of=Case("M31", array="VLA C")),
)  # fmt: skip
KEPT_APART = (
    *(replace(scene, seed=900 + number) for number, scene in enumerate(FIRST)),
    Scene("sixty", 60, 30, 40, 909, gain_rms=0.01),
    Scene("twenty and extended", 20, 20, 40, 910, extended=True, gain_rms=0.02),
    Scene("five", 5, 100, 45, 911, gain_rms=0.005), Scene("one", 1, 1, 40, 912, samples_of=Case("M31", array="VLA A")),
    Scene("sixty", 60, 30, 40, 913, samples_of=Case("3c353", super_resolution=2.5)),
    Scene("twenty and extended", 20, 20, 40, 914, extended=True, samples_of=Case("3c353", super_resolution=4.0)),
)  # fmt: skip


def visibilities(sources, uvw, grid):
    """The exact visibilities of the sources, complex (M,)."""
    total = np.zeros(uvw.shape[1], complex)
    for flux, x, y, fwhm in sources:
        l, m = -(x - grid.shape[0] // 2) * grid.cell_rad[0], (y - grid.shape[1] // 2) * grid.cell_rad[1]
        spread = np.exp(-2 * (np.pi * fwhm / FWHM * grid.cell_rad[0]) ** 2 * (uvw[0] ** 2 + uvw[1] ** 2))
        total += flux * np.exp(2j * np.pi * (uvw[0] * l + uvw[1] * m)) * spread
    return total


def smoothed(sources, shape, fwhm):
    """The sources in a Gaussian beam of `fwhm` pixels, Jy/pixel."""
    x, y = np.indices(shape)
    image = np.zeros(shape)
    for flux, x0, y0, width in sources:
        variance = (width**2 + fwhm**2) / FWHM**2
        image += flux / (2 * np.pi * variance) * np.exp(-((x - x0) ** 2 + (y - y0) ** 2) / (2 * variance))
    return image


def solved(scene: Scene, base: Path) -> dict:
    """Image a scene, and say what became of it."""
    from casa_sara.analysis.metrics import smooth, snr
    from casa_sara.options import SolverOptions
    from casa_sara.reconstruction.problem import Samples
    from casa_sara.reconstruction.reconstruct import reconstruct

    _, _, part, density, grid = observed(scene.samples_of, base)
    data, offsets, rng = part.data, part.offsets, np.random.default_rng(scene.seed)
    sources = scene.sources(grid.shape, rng)
    vis = visibilities(sources, data.uvw.astype(float), grid)
    if scene.gain_rms:
        block = np.repeat(np.arange(len(offsets) - 1), np.diff(offsets))
        shape = len(offsets) - 1, 64
        gains = 1 + scene.gain_rms * (rng.standard_normal(shape) + 1j * rng.standard_normal(shape)) / np.sqrt(2)
        rows = data.rows
        vis *= gains[block, rows.antenna1[data.row]] * gains[block, rows.antenna2[data.row]].conj()
    noise = np.sqrt(np.mean(np.abs(vis) ** 2) / 2) * 10 ** (-scene.noise_db / 20)
    vis += noise * (rng.standard_normal(vis.size) + 1j * rng.standard_normal(vis.size))
    data = replace(data, vis=vis.astype(np.complex64), weight=np.full(vis.size, noise**-2, np.float32))
    found = reconstruct(Samples(data, offsets, density, np.ones(len(offsets) - 1)), grid, SolverOptions(nthreads=1))
    beam = 2 * WIDTH * scene.samples_of.super_resolution
    quality = {name: snr(smoothed(sources, grid.shape, factor * beam), smooth(found.model, 2 * [factor * beam], 0.0))
               for name, factor in (("half", 0.5), ("one", 1.0))}
    return dict(iterations=found.record.iteration[-1], negative=int(np.count_nonzero(found.model < 0)), **quality)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--against", type=Path, help="the results of an earlier run")
    options = parser.parse_args()
    sys.argv = sys.argv[:1]  # CASA reads the command line, too
    base = options.folder.resolve()
    before = json.loads(options.against.read_text()) if options.against else {}
    print(f"{machine()}\n\n| scene | iterations | negative pixels | at half a beam | at one beam |\n" + "|---" * 5
          + "|")
    results = {}
    # the observations first, so that no two processes make the same one
    for case in {scene.samples_of: None for scene in FIRST + KEPT_APART}:
        observed(case, base)
    with ProcessPoolExecutor(2, multiprocessing.get_context("spawn")) as pool:
        for title, scenes in (("first", FIRST), ("kept apart", KEPT_APART)):
            for scene, result in zip(scenes, pool.map(partial(solved, base=base), scenes)):
                results[f"{title}: {scene.label}"] = result
                row(f"{title}: {scene.label}", result, before.get(f"{title}: {scene.label}"))
            names = [name for name in results if name.startswith(title)]
            mean = {key: np.mean([results[name][key] for name in names])
                    for key in ("iterations", "negative", "half", "one")}
            earlier = {key: np.mean([before[name][key] for name in names]) for key in mean} if before else None
            row(f"**{title}: means**", mean, earlier)
    (base / "point_sources.json").write_text(json.dumps(results))


def row(label, now, before):
    """Print a line of the table."""
    counts = [f"{now[key]:.0f}" if before is None else f"{before[key]:.0f} → {now[key]:.0f}"
              for key in ("iterations", "negative")]
    snrs = [f"{now[key]:.2f}" + ("" if before is None else f" ({now[key] - before[key]:+.2f})")
            for key in ("half", "one")]
    print("| " + " | ".join([label, *counts, *snrs]) + " |", flush=True)


if __name__ == "__main__":
    main()
