"""A mosaic of ALMA's 12 m and 7 m dishes, of a sky larger than a beam: tsara beside tclean, and the time it takes.

    python benchmarks/mosaic.py FOLDER                 # seven pointings of M31 at 100 GHz, noise, gain errors of 1 %
    python benchmarks/mosaic.py FOLDER --scene W28     # another sky
    python benchmarks/mosaic.py FOLDER --speed         # an iteration of 23 pointings beside one of one pointing
    python benchmarks/mosaic.py FOLDER --errors        # how often the truth lies within the errors of ndraws

The visibilities are type-3 non-uniform transforms, exact with w, of a sky on pixels a third as large as those of the
image, for each pair of dishes through the product of their Airy patterns (to their first nulls). tclean runs
gridder='mosaic' with multiscale; the best of GRID at half a beam is shown. SNR = 20 log10(‖truth‖/‖truth − model‖) of
the sky smoothed to a half and to one beam of tclean, where the primary beam is above 0.3. tclean's model is divided by
the primary beam.
"""

from __future__ import annotations

import argparse
import itertools
import json
import os
import sys
import time
from dataclasses import dataclass
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")
ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT / "benchmarks"), str(ROOT / "tests"), str(ROOT)]

import numpy as np

CELL, SIZE, FINER = 0.9, 200, 3  # arcsec, pixels, and the pixels of the sky in one of the image
SPACING = 29.0  # arcsec, half of the beam of a 12 m dish
POINTINGS = [(0.0, 0.0), *((SPACING * np.cos(a), SPACING * np.sin(a)) for a in np.arange(6) * np.pi / 3)]
ARRAYS = {"12m": ("alma.cycle8.1", 12.0, 1), "7m": ("aca.cycle8", 7.0, 4)}  # file, diameter, integrations in a scan
FAINT = {"M31": (1.0, 3.0), "W28": (4.0, 12.0)}  # Jy of a visibility, for peaks of 80 and 25 times the noise
NOISE, GAIN_RMS = 0.05, 0.01  # Jy of a visibility of two 12 m dishes; amplitude and phase
WEIGHTINGS = {"briggs": 0.5, "natural": 0.0}
# scales in beams, bias towards small ones, most iterations, gain and cyclefactor
GRID = {"short": ((0, 1, 3), 0.0, 4000, 0.2, 1.0), "biased": ((0, 1, 3), 0.6, 4000, 0.2, 1.0),
        "long": ((0, 1, 3, 6), 0.6, 4000, 0.2, 1.0), "careful": ((0, 1, 3), 0.6, 20_000, 0.1, 3.0),
        "small": ((0, 1), 0.6, 20_000, 0.1, 2.0)}
LEAST = 0.3  # of the primary beam, where skies are compared


def placed(config):
    """Return the antennas of a CASA configuration file around ALMA, ITRF (3, N) in metres."""
    from simulated_mosaic import ALMA

    from casa_sara.demo.simulate import Observation, antennas

    (x, y, z, _), _, _ = antennas(Observation(antenna_file="alma/simmos/{}.cfg"), config)
    up = ALMA / np.linalg.norm(ALMA)
    east = np.cross([0, 0, 1], up) / np.hypot(*up[:2])
    axes = east, np.cross(up, east), up
    return ALMA[:, None] + sum(np.outer(axis, along - along.mean()) for axis, along in zip(axes, (x, y, z)))


def transform(uvw, lmn, flux):
    """The sum over all pixels, by a type-3 transform, to 1e-9."""
    import finufft

    u, v, w = (2 * np.pi * np.ascontiguousarray(axis) for axis in uvw)
    return finufft.nufft3d3(lmn[0], lmn[1], lmn[2] - 1, flux.astype(complex), u, v, w, isign=1, eps=1e-9)


def the_sky(scene):
    """Return a scene of 77 arcsec on finer pixels than the image's, and the same as sources (Jy, l, m)."""
    from scenes import Sky, scene_sky

    from casa_sara.demo.sky import ARCSEC

    image = scene_sky(scene).image
    sky = Sky(np.pad(image, (FINER * SIZE - image.shape[0]) // 2), CELL / FINER * ARCSEC, FINER)
    ix, iy = np.nonzero(sky.image)
    half = FINER * SIZE // 2
    return sky, np.stack([sky.image[ix, iy], -(ix - half) * sky.cell_rad, (iy - half) * sky.cell_rad], axis=1)


def observe(folder, scene):
    """Write the two MeasurementSets unless they are there; return their names."""
    from simulated_mosaic import simulate_mosaic

    names = []
    for seed, (name, (config, diameter, integrations)) in enumerate(ARRAYS.items()):
        path, places = folder / f"{name}.ms", placed(config)
        if not path.exists():
            simulate_mosaic(path, POINTINGS, the_sky(scene)[1], dishes=(diameter,) * places.shape[1], noise=NOISE,
                            gain_rms=GAIN_RMS, spws=(("100GHz", "50MHz", 1),), scan_seconds=30.0 * integrations,
                            integration=30.0, rounds=8, hours=4.0, places=places, fourier_sum=transform, seed=seed)
        names.append(str(path))
    return names


def scored(sky, model, pb, beam):
    """SNR at a half and one beam, and flux over the truth, where the primary beam is high."""
    from scenes import smoothed_truth

    from casa_sara.analysis.metrics import smooth, snr

    seen, found = pb > LEAST, {}
    for factor in (0.5, 1.0):
        fwhm = [factor * axis / CELL for axis in beam[:2]]
        truth, ours = smoothed_truth(sky, fwhm, beam[2]), smooth(model, fwhm, beam[2])
        found[factor] = snr(truth * seen, ours * seen)
        found["flux"] = float((ours * seen).sum() / (truth * seen).sum())
    return found


def common(names):
    from simulated_mosaic import CENTRE

    return dict(vis=names, imsize=SIZE, cell=f"{CELL}arcsec", gridder="mosaic", datacolumn="data", pblimit=0.2,
                phasecenter=f"J2000 {CENTRE[0]}deg {CENTRE[1]}deg")


def cleaned(folder, names, sky):
    """Return the best of tclean's settings for each weighting, as (label, scores, beam, seconds, residual)."""
    from casatasks import tclean

    from casa_sara.demo.imagers import quiet, read_image

    best = {}
    for weighting, setting in itertools.product(WEIGHTINGS, GRID):
        root, kept = folder / f"clean_{weighting}_{setting}", folder / f"clean_{weighting}_{setting}.json"
        if not kept.exists():
            options = common(names) | dict(imagename=str(root), weighting=weighting, robust=WEIGHTINGS[weighting],
                                           deconvolver="multiscale", nsigma=2.0, usemask="pb", pbmask=0.2)
            scales, bias, niter, gain, cyclefactor = GRID[setting]
            width = {"briggs": 3.4, "natural": 3.8}[weighting] / CELL
            begin = time.perf_counter()
            with quiet(folder / "tclean.txt"):
                tclean(**options, scales=sorted({round(scale * width) for scale in scales}), smallscalebias=bias,
                       niter=niter, gain=gain, cyclefactor=cyclefactor)
            seconds, beam = time.perf_counter() - begin, read_image(f"{root}.image")[1]
            pb, model = read_image(f"{root}.pb")[0], read_image(f"{root}.model")[0]
            model = np.divide(model, pb, out=np.zeros_like(model), where=pb > 0.2)
            residual = float(read_image(f"{root}.residual")[0][pb > LEAST].std())
            kept.write_text(json.dumps([scored(sky, model, pb, beam), beam, seconds, residual]))
        found = json.loads(kept.read_text())
        if weighting not in best or found[0]["0.5"] > best[weighting][1]["0.5"]:
            best[weighting] = (f"tclean {weighting}, {setting}", *found)
    return best


def compare(folder, scene):
    """Simulate, image and print one table."""
    from casa_sara import tsara
    from casa_sara.demo.imagers import quiet, read_image

    names, sky = observe(folder, scene), the_sky(scene)[0]
    best, rows = cleaned(folder, names, sky), []
    root, begin = str(folder / "tsara"), time.perf_counter()
    with quiet(folder / "tsara.txt"):
        made = tsara(**common(names), imagename=root, weighting="briggs", robust=0.5, overwrite=True)
    seconds = time.perf_counter() - begin
    model, pb = read_image(root + ".model")[0], read_image(root + ".pb")[0]
    residual = float(read_image(root + ".residual")[0][pb > LEAST].std())
    print(f"{scene}: {made['sara']['visibilities']} samples, {made['iterdone']} iterations, {made['stopDescription']}")
    print("| imager | SNR at half a beam, dB | at one beam | flux / true | residual, mJy/beam | s |")
    print("|---|---|---|---|---|---|")
    for label, scores, beam, clean_s, clean_residual in best.values():
        rows.append((label, scores["0.5"], scores["1.0"], scores["flux"], clean_residual, clean_s))
        ours = scored(sky, model, pb, beam)
        rows.append((f"tsara, at that beam ({beam[0]:.2f} by {beam[1]:.2f} arcsec)", ours[0.5], ours[1.0], ours["flux"],
                     residual, seconds))
    for label, half, one, flux, left, took in rows:
        print(f"| {label} | {half:.1f} | {one:.1f} | {flux:.3f} | {1e3 * left:.3f} | {took:.0f} |")


@dataclass(frozen=True)
class Truth:
    """A sky as those of error_coverage.py."""

    sky: object

    def smoothed(self, beam):
        """The sky smoothed to a beam (pixels, pixels, degrees), Jy/pixel."""
        from scenes import smoothed_truth

        return smoothed_truth(self.sky, beam[:2], beam[2])

    def binned(self):
        """The sky on the pixels of the image."""
        return self.sky.truth()


def errors(folder, realisations=4, ndraws=20):
    """Print how often the true sky lies within the errors of a small mosaic, over skies and realisations of the noise.

    Pixels at one beam and islands are counted as in error_coverage.py, where the
    primary beam is above LEAST.
    """
    from error_coverage import Deviations, at_one_beam, of_islands
    from simulated_mosaic import simulate_mosaic

    from casa_sara import tsara
    from casa_sara.demo.imagers import quiet, read_image
    from casa_sara.reconstruction.draws import read_draws

    beams, islands, known = [], [], []
    for number, scene in enumerate(tuple(FAINT) * realisations):
        here = folder / f"errors_{scene}_{number}"
        here.mkdir(exist_ok=True)
        sky, sources = the_sky(scene)
        simulate_mosaic(here / "x.ms", POINTINGS, sources, dishes=(12.0,) * 14 + (7.0,) * 6, rounds=6, hours=5.0,
                        noise=FAINT[scene][number // 2 % 2], spread=45.0, seed=number, fourier_sum=transform)
        root = str(here / "tsara")
        with quiet(here / "tsara.txt"):
            made = tsara(**common(str(here / "x.ms")) | dict(imagename=root, ndraws=ndraws, overwrite=True, nthreads=1))
        model, beam, pb = read_image(root + ".model")[0], read_image(root + ".image")[1], read_image(root + ".pb")[0]
        beam, draws, seen = (beam[0] / CELL, beam[1] / CELL, beam[2]), read_draws(root + ".draws.npz"), pb > LEAST
        truth = Truth(sky)
        beams.append(at_one_beam(truth, model, draws, beam, seen))
        inside = [island for island in made["sara"]["islands"] if seen[island["x_peak"], island["y_peak"]]]
        of, shape = of_islands(truth, model, inside, draws, beam)
        islands.append(of)
        known.append(shape)
        noise = read_image(root + ".residual")[0][seen].std()
        print(scene, number, f"peak S/N {read_image(root + '.image')[0].max() / noise:.0f}, model",
              f"{model[seen].sum():.3f} Jy of {sky.truth()[seen].sum():.3f},",
              "pixels: {:.0f}, {:.2f}, {:.2f}, {:.2f}".format(*beams[-1].row(5, np.inf)),
              "islands: {:.0f}, {:.2f}, {:.2f}, {:.2f}".format(*of.row(5, np.inf)), flush=True)
    for label, found in ("at one beam", beams), ("islands", islands):
        whole = Deviations(np.concatenate([one.z for one in found]), np.concatenate([one.ratio for one in found]))
        print(f"{label}: {{:.0f}} places, {{:.2f}} within 1, {{:.2f}} within 2, median {{:.2f}}".format(
            *whole.row(5, np.inf)))
    print(f"islands, error of a known shape: {(np.abs(np.concatenate(known)) < 1).mean():.2f} within 1")


def speed(pixels=1024, samples=200_000, side=5):
    """Time an iteration, and measure the memory of the operator, of one pointing and of 23 that cover the image."""
    from casa_sara.operators.beams import Beam, Mosaic
    from casa_sara.operators.dictionary import SaraDictionary
    from casa_sara.operators.measurement import MeasurementOperator
    from casa_sara.operators.mosaic import MosaicOperator
    from casa_sara.options import SARA_BASES
    from casa_sara.solver.adaptive_ppd import AdaptivePPD

    rng, radius = np.random.default_rng(0), 1.21  # of the first null, in beams (FWHM)
    places = np.array([((i - (count - 1) / 2) / 2, (k - 2) * 0.433) for k, count in enumerate((4, 5, 5, 5, 4))
                       for i in range(count)])
    cell = (np.ptp(places[:, 0]) + 1.5 * radius) / pixels  # in beams: to where the outer ones are faint
    squares = np.linspace(0, 1, 4097)
    profile = (np.exp(-4 * np.log(2) * squares * radius**2) * (1 - squares**4)).astype(np.float32)
    scale = 1e-4
    beams = tuple(Beam((pixels / 2 + x / cell, pixels / 2 + y / cell), radius * scale, profile) for x, y in places)
    mosaic = Mosaic((pixels, pixels), (cell * scale,) * 2, beams)
    uvw = np.clip(rng.normal(0, 0.07, (3, samples)), -0.25, 0.25) / (cell * scale)
    number = rng.integers(0, len(beams), samples)
    flat = mosaic.flat(mosaic.sensitivity(np.bincount(number)))
    for label, make in (("one pointing", lambda: MeasurementOperator(uvw[:2], cell * scale, mosaic.shape, eps=1e-5)),
                        (f"{len(beams)} pointings", lambda: MosaicOperator(uvw, number, flat, eps=1e-5))):
        before, operator = _resident(), make()
        vis = operator.forward(rng.random(mosaic.shape).astype(np.float32))
        operator.adjoint(vis)
        held = _resident() - before
        ppd = AdaptivePPD(operator, SaraDictionary(mosaic.shape, SARA_BASES, 4), vis, np.array([0, samples]),
                          np.ones(samples, np.float32), 1.0)
        ppd.threshold, times = 1.0, []
        for _ in range(6):
            begin = time.perf_counter()
            ppd.step()
            times.append(time.perf_counter() - begin)
        print(f"{label}: {1e3 * min(times):.0f} ms an iteration, operator {held:.0f} MB, in all {_resident():.0f} MB")


def _resident():
    """Memory held, MB."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, nargs="?")
    parser.add_argument("--scene", default="M31")
    parser.add_argument("--speed", action="store_true")
    parser.add_argument("--errors", action="store_true")
    args = parser.parse_args()
    if args.speed:
        speed()
        return
    if args.errors:
        args.folder.mkdir(parents=True, exist_ok=True)
        errors(args.folder)
        return
    folder = args.folder / args.scene.replace(" ", "_")
    folder.mkdir(parents=True, exist_ok=True)
    compare(folder, args.scene)


if __name__ == "__main__":
    main()
