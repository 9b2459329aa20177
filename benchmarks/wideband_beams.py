"""Wide bands through the primary beam: nterms with gridder='mosaic', beside gridder='standard' and tclean mtmfs.

    python benchmarks/wideband_beams.py FOLDER                # all cases; what FOLDER holds already is not done again
    python benchmarks/wideband_beams.py FOLDER --cases sources
    python benchmarks/wideband_beams.py FOLDER --again        # run tsara anew

2 to 4 GHz in 16 channels, VLA D, spectral indices from −1.5 to +0.5: sources of a half to three beams all over one
pointing, and M31 across the beam of one pointing or of three that are half a beam apart. The beams of the simulation
are CASA's .pb of each channel, made by tclean(specmode='cube', niter=0), along a radius. Errors of the index are those
where the sky at the beam exceeds 30 times the noise there, which is that of the residual image over .pb; bias is their
mean weighted by the square of the signal-to-noise ratio up to 100, so that no bright pixel decides.

tclean runs mtmfs with nterms=2 and each of GRID: with the standard gridder (one pointing) its index is corrected by
that of the beam, d ln A/d ln ν of CASA's .pb, and by the task widebandpbcor; and with specmode='mvc', which divides by
the beams of every channel in its minor cycle. The best of GRID, by the errors of the index in all ranges, is shown.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
from dataclasses import dataclass, replace
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")
sys.path.insert(0, str(Path(__file__).resolve().parent))

import numpy as np
from scenes import VLA, Sky, scene_sky
from wideband import HIGHEST, LOWEST, Measures, index_map, opened

from casa_sara.demo.simulate import simulate_observation
from casa_sara.demo.sky import ARCSEC

CELL, SIZE, FINER = 6.0, 256, 3  # arcsec, pixels, and the pixels of the sky in one of the image
CHANNELS, FREQ_HZ = 16, 3e9
OBSERVATION = replace(VLA, telescope="EVLA", direction=("10h00m00.0s", "00d00m00.0s"), freq_hz=FREQ_HZ, scans=4,
                      channel_hz=2e9 / CHANNELS, channels=CHANNELS, integrations=4, hour_angles=(-3.0, 3.0))
CASES = {"sources": ("sources", [(0, 0)]), "M31": ("M31", [(0, 0)]),  # pixels of the image to the west and north
         "M31 three": ("M31", [(-38, -22), (38, -22), (0, 44)])}
NOISE_DB, GAIN_RMS = 40.0, 0.003
LEVEL, MOST = 30, 100  # S/N of pixels that are looked at, and the largest that counts
RANGES = ((0.8, 1.0), (0.5, 0.8), (0.3, 0.5), (0.2, 0.3))  # of the primary beam at the reference frequency
# scales in beams, most iterations, gain, robust
GRID = {"short": ((0, 0.6, 1.8, 5.4), 4000, 0.2, -1.0), "deep": ((0, 0.6, 1.8, 5.4), 20_000, 0.2, -1.0),
        "small": ((0, 0.6, 1.8), 4000, 0.1, -1.0), "robust": ((0, 0.6, 1.8, 5.4), 4000, 0.1, 0.5)}


@dataclass(frozen=True)
class Seen(Sky):
    """A sky that is seen through a beam at each frequency: `beams` {Hz: A along the radius in pixels}."""

    beams: dict | None = None

    def at(self, freq_hz):
        seen = super().at(freq_hz)
        if self.beams is None:
            return seen
        x, y = (np.arange(n) - n // 2 for n in self.image.shape)
        profile = self.beams[min(self.beams, key=lambda one: abs(one - freq_hz))]
        beam = np.interp(np.hypot(x[:, None], y[None, :]), np.arange(profile.size), profile, right=0)
        return replace(seen, image=seen.image * beam)


def the_sky(scene):
    """A scene over the whole image, with its index."""
    if scene == "sources":
        return sources()
    sky = scene_sky(scene, CELL, oversampling=FINER)
    return Seen(sky.image, sky.cell_rad, FINER, index=index_map(sky.image.shape, width=0.05), reference_hz=FREQ_HZ)


def sources(number=70, seed=5):
    """Gaussians within 12 arcmin, each with an index of its own; where they overlap it is the mean by brightness."""
    rng = np.random.default_rng(seed)
    size, cell = FINER * SIZE, CELL / FINER
    x = (np.arange(size) - size // 2) * cell
    image, weighted = np.zeros((size, size)), np.zeros((size, size))
    for _ in range(number):
        radius, turn, fwhm = 720 * np.sqrt(rng.uniform()), rng.uniform(0, 2 * np.pi), rng.uniform(10, 60)
        width = fwhm / 2.355
        one = np.exp(-((x[:, None] - radius * np.cos(turn)) ** 2 + (x[None, :] - radius * np.sin(turn)) ** 2)
                     / (2 * width**2)) * 10 ** rng.uniform(-1, 0)
        image += one
        weighted += one * rng.uniform(LOWEST, HIGHEST)
    image, index = image / image.sum() * 10, weighted / np.maximum(image, 1e-30)
    return Seen(image, cell * ARCSEC, FINER, index=index, reference_hz=FREQ_HZ)


def beams_of_casa(folder):
    """Return CASA's primary beam of each channel along the radius, in pixels of the sky."""
    from casatasks import tclean

    from casa_sara.demo.imagers import quiet

    kept = folder / "beams.npz"
    if not kept.exists():
        small = Seen(np.pad([[1.0]], 32), CELL * ARCSEC, index=np.zeros((65, 65)), reference_hz=FREQ_HZ)
        place = folder / "of_beams"
        place.mkdir()
        with quiet(folder / "log.txt"):
            vis = simulate_observation(place, small, ["D"], 60.0, 0.0, 1, OBSERVATION).vis
            tclean(vis=vis, imagename=str(place / "cube"), imsize=FINER * SIZE, cell=f"{CELL / FINER}arcsec", niter=0,
                   specmode="cube", datacolumn="data", pblimit=-1e-4)
        cube = opened(place / "cube.pb")[0]
        half = FINER * SIZE // 2
        np.savez(kept, freqs_hz=OBSERVATION.channel_freqs_hz, values=cube[half:, half].T)
    found = np.load(kept)
    return dict(zip(found["freqs_hz"].tolist(), found["values"]))


def observe(folder, case, beams):
    """Write a MeasurementSet for each pointing unless they are there; return their names."""
    (scene, pointings), names = CASES[case], []
    sky = replace(the_sky(scene), beams=beams)
    for number, (west, north) in enumerate(pointings):
        place = folder / f"pointing{number}"
        if not (place / "D.ms").exists():
            place.mkdir(exist_ok=True)
            l, m = -west * CELL * ARCSEC, north * CELL * ARCSEC
            right = np.radians(150) + np.arctan2(l, np.sqrt(1 - l**2 - m**2))  # of a field on the equator
            direction = tuple(f"{float(np.degrees(angle))!r}deg" for angle in (right, np.arcsin(m)))
            image, index = (np.roll(one, (-west * FINER, -north * FINER), (0, 1)) for one in (sky.image, sky.index))
            simulate_observation(place, replace(sky, image=image, index=index), ["D"], NOISE_DB, GAIN_RMS, 3 + number,
                                 replace(OBSERVATION, direction=direction))
        names.append(str(place / "D.ms"))
    return names


def index_of_beam(beams):
    """Return d ln A/d ln ν around the centre, by a fit over the channels weighted by A², at pixels of the image."""
    freqs, values = np.array(list(beams)), np.array(list(beams.values()))
    place = np.log(freqs / FREQ_HZ)[:, None]
    good = values.min(axis=0) > 1e-3
    values = np.where(good, values, 1.0)
    offset = place - (values**2 * place).sum(axis=0) / (values**2).sum(axis=0)
    slope = (values**2 * offset * np.log(values)).sum(axis=0) / (values**2 * offset**2).sum(axis=0)
    x = FINER * (np.arange(SIZE) - SIZE // 2)
    return np.interp(np.hypot(x[:, None], x[None, :]), np.arange(slope.size), np.where(good, slope, np.nan))


class Judge:
    """The truth at a beam, and errors of the index by ranges of the primary beam."""

    def __init__(self, scene, beam, pb, noise):
        case = type("Case", (), dict(freq_hz=FREQ_HZ))
        self._measures, self._pb = Measures(case, the_sky(scene), beam, CELL), pb
        self.index = self._measures.index
        self._snr = self._measures.brightness * pb / noise

    def __call__(self, index, known):
        """Return (pixels, known, bias, rms) in each range."""
        found = []
        for low, high in RANGES:
            here = (self._pb > low) & (self._pb <= high) & (self._snr > LEVEL)
            valid = here & known & np.isfinite(index)
            error, weight = (index - self.index)[valid], np.minimum(self._snr[valid], MOST) ** 2
            found.append((int(here.sum()), float(valid.sum() / max(here.sum(), 1)),
                          float((weight @ error) / weight.sum()), float(np.sqrt(np.mean(error**2)))))
        return found

    def snr(self, model):
        """SNR of a sky at half a beam and at one, where the primary beam is above 0.3."""
        from casa_sara.analysis.metrics import smooth, snr

        seen, measures = self._pb > 0.3, self._measures
        return [snr(truth * seen, smooth(model, [factor * axis for axis in measures._beam], measures._angle) * seen)
                for factor, truth in measures._truth.items()]


def common(names):
    return dict(vis=names, imsize=SIZE, cell=f"{CELL}arcsec", datacolumn="data", weighting="briggs", robust=-1.0,
                phasecenter="J2000 10h00m00.0s 00d00m00.0s", reffreq=f"{FREQ_HZ}Hz", pblimit=0.1)


def run_tsara(folder, names, gridder, again):
    """Run tsara unless it was run."""
    from casa_sara import tsara
    from casa_sara.demo.imagers import quiet

    root = folder / f"tsara_{gridder}"
    if again or not root.with_suffix(".alpha").exists():
        with quiet(folder / "log.txt"):
            made = tsara(**common(names), imagename=str(root), gridder=gridder, nterms=3, overwrite=True, nthreads=1)
        print(gridder, made["iterdone"], "iterations,", made["stopDescription"], flush=True)
    return root


def run_clean(folder, names, how, setting, beam):
    """Run tclean, with `how` = (specmode, gridder), unless it was run."""
    from casatasks import tclean

    from casa_sara.demo.imagers import quiet

    specmode, gridder = how
    root, (scales, niter, gain, robust) = folder / f"mtmfs_{specmode}_{setting}", GRID[setting]
    if not Path(f"{root}.alpha").exists():
        width = np.sqrt(beam[0] * beam[1]) / CELL
        with quiet(folder / "log.txt"):
            tclean(**common(names) | dict(robust=robust), imagename=str(root), deconvolver="mtmfs", nterms=2,
                   specmode=specmode, gridder=gridder, scales=sorted({round(scale * width) for scale in scales}),
                   niter=niter, gain=gain, nsigma=2.0, usemask="pb", pbmask=0.1,
                   restoringbeam=[f"{beam[0]}arcsec", f"{beam[1]}arcsec", f"{beam[2]}deg"])
    return root


def best_clean(folder, names, how, beam, judge, index_of=lambda root: opened(f"{root}.alpha")):
    """Return the setting of GRID whose index has the least error in all ranges, and what `judge` says of it."""
    found = {setting: judge(*index_of(run_clean(folder, names, how, setting, beam))) for setting in GRID}
    print(how, {setting: [round(rms, 2) for *_, rms in cells] for setting, cells in found.items()}, flush=True)
    return min(found.items(), key=lambda one: np.nansum([cells[3] ** 2 for cells in one[1]]))


def corrected(folder, names, root):
    """Return the index of the task widebandpbcor."""
    from casatasks import widebandpbcor

    from casa_sara.demo.imagers import quiet

    here = os.getcwd()
    os.chdir(folder)  # it takes names in the working folder only
    with quiet(folder / "log.txt"):
        widebandpbcor(vis=names[0], imagename=root.name, nterms=2, action="pbcor", pbmin=0.1, field="0",
                      spwlist=[0] * CHANNELS, chanlist=list(range(CHANNELS)), weightlist=[1.0] * CHANNELS,
                      threshold="0.0Jy")
    os.chdir(here)
    return opened(f"{root}.pbcor.image.alpha")


def compare(folder, case, again):
    """Simulate, image and print one table."""
    from casa_sara.demo.imagers import read_image

    beams = beams_of_casa(folder.parent)
    names, rows = observe(folder, case, beams), []
    root = run_tsara(folder, names, "mosaic", again)
    beam, pb = read_image(f"{root}.image")[1], read_image(f"{root}.pb")[0]
    judge = Judge(CASES[case][0], beam, pb, float(read_image(f"{root}.residual")[0][pb > 0.3].std()))
    index, known = opened(f"{root}.alpha")
    error, _ = opened(f"{root}.alpha.error")
    rows.append(("tsara, mosaic", judge(index, known)))
    print("SNR of the model", [round(one, 1) for one in judge.snr(opened(f"{root}.model")[0])])
    away = ((index - judge.index) / np.where(known, error, 1))[known & (pb > 0.3)]
    print(f"errors in units of .alpha.error: rms {np.sqrt(np.mean(away**2)):.2f}, median {np.median(abs(away)):.2f}")
    several = len(names) > 1
    if not several:
        other, steeper = run_tsara(folder, names, "standard", again), index_of_beam(beams)
        index, known = opened(f"{other}.alpha")
        rows.append(("tsara, standard", judge(index, known)))
        rows.append(("the same less that of the beam", judge(index - steeper, known)))
        how = "mfs", "standard"

        def less_beam(root):
            index, known = opened(f"{root}.alpha")
            return index - steeper, known

        for label, index_of in (("less that of the beam", less_beam),
                                ("with widebandpbcor", lambda root: corrected(folder, names, root))):
            setting, cells = best_clean(folder, names, how, beam, judge, index_of)
            rows.append((f"mtmfs {label}, {setting}", cells))
    setting, cells = best_clean(folder, names, ("mvc", "mosaic" if several else "standard"), beam, judge)
    rows.append((f"mtmfs, specmode='mvc', {setting}", cells))
    print(f"| {case} | " + " | ".join(f"{low} to {high}" for low, high in RANGES) + " |")
    for label, cells in rows:
        print(f"| {label} | " + " | ".join(f"{bias:+.3f}, {rms:.3f}" for _, _, bias, rms in cells) + " |")
    print("pixels", [count for count, *_ in rows[0][1]], "known", {
        label: [round(share, 2) for _, share, *_ in cells] for label, cells in rows})
    (folder / "table.json").write_text(json.dumps(rows))
    draw(folder, judge, pb)


def draw(folder, judge, pb):
    """Draw the index of all imagers."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    paths = [path for path in sorted(folder.glob("*.alpha")) if "mtmfs" not in path.name or "short" in path.name]
    figure, axes = plt.subplots(2, len(paths) + 1, figsize=(4 * len(paths) + 4, 7.6), layout="constrained")
    panels = [("sky", judge.index, pb > 0.2), *((path.stem, *opened(path)) for path in paths)]
    for (top, below), (title, index, known) in zip(axes.T, panels):
        known = known & (judge._snr > LEVEL) & (pb > 0.2)
        shown = top.imshow(np.where(known, index, np.nan).T, origin="lower", vmin=-1.7, vmax=0.7, cmap="turbo")
        top.contour(pb.T, [0.3, 0.5, 0.8], colors="k", linewidths=0.5)
        wrong = below.imshow(np.where(known, index - judge.index, np.nan).T, origin="lower", vmin=-0.5, vmax=0.5,
                             cmap="RdBu")
        top.set_title(title)
    figure.colorbar(shown, ax=axes[0], label="spectral index")
    figure.colorbar(wrong, ax=axes[1], label="error")
    figure.savefig(folder / "index.png", dpi=70)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--cases", default=",".join(CASES))
    parser.add_argument("--again", action="store_true")
    given = parser.parse_args()
    for case in given.cases.split(","):
        folder = given.folder.resolve() / case.replace(" ", "_")
        folder.mkdir(parents=True, exist_ok=True)
        compare(folder, case, given.again)


if __name__ == "__main__":
    main()
