"""Wide bands: tsara with nterms, a flat model, tclean mtmfs, joined channels of wsclean, and sub-bands one by one.

    python benchmarks/wideband.py FOLDER              # everything; what FOLDER holds already is not done again
    python benchmarks/wideband.py FOLDER --only tsara   # simulate and run tsara (anew)
    python benchmarks/wideband.py FOLDER --only clean   # simulate and run tclean mtmfs
    python benchmarks/wideband.py FOLDER --only wsclean # simulate and run wsclean, where it is installed
    python benchmarks/wideband.py FOLDER --only prior   # the prior of the orders compared with an ℓ2,1 norm
    python benchmarks/wideband.py FOLDER --only time    # sub-bands solved one by one, and together
    python benchmarks/wideband.py FOLDER --only table   # the tables of docs/validation.md
    python benchmarks/wideband.py FOLDER --only pictures

Skies stand on pixels three times smaller than the image's, and between them; their spectral index has structure of
several beams, from −1.5 to +0.5. SNR is that of the model against the sky at the reference frequency, both smoothed to
a half and to one beam (Briggs −1); that of tclean is the better of model and restored image. Errors of the index are
rms over the pixels above a signal-to-noise ratio, the noise being what tsara leaves in the residual image; thermal is
what the noise alone makes of it. tclean runs with each of GRID on TUNED_ON; the best by SNR at one beam, and the best
by index, serve the others. wsclean runs multiscale with joined channels and each of WSCLEAN in the same way; its model
is that of its two-term polynomial at the reference frequency, its index that of the restored channels or of the models
of the channels at the beam, whichever is better on TUNED_ON.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
import time
from dataclasses import dataclass, replace
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")
sys.path.insert(0, str(Path(__file__).resolve().parent))

import numpy as np
from scenes import VLA, Array, nominal_cell_arcsec, observe, scene_sky, smoothed_truth
from scipy.ndimage import gaussian_filter
from scipy.special import erf

SUPER_RESOLUTION = 1.7
LOWEST, HIGHEST = -1.5, 0.5
LEVELS = (30, 100)
SHORT, LONG = (0, 0.6, 1.8, 5.4), (0, 0.6, 1.8, 5.4, 16)
# scales in units of the beam, bias towards small ones, most iterations, weighting
GRID = {
    "briggs": (SHORT, 0.0, 4000, "briggs"), "briggs biased": (SHORT, 0.6, 4000, "briggs"),
    "briggs deep": (SHORT, 0.0, 20_000, "briggs"), "briggs long": (LONG, 0.0, 4000, "briggs"),
    "briggs long deep": (LONG, 0.0, 20_000, "briggs"), "briggs deeper": (SHORT, 0.0, 60_000, "briggs"),
}  # fmt: skip
# weighting, robust, threshold in units of the noise, channels of the output, further options
MASKED = ("-auto-mask", "3")
WSCLEAN = {
    "briggs+0 1 4": ("briggs", 0.0, 1.0, 4, MASKED), "briggs+0 0.5 4": ("briggs", 0.0, 0.5, 4, MASKED),
    "briggs+0.5 1 4": ("briggs", 0.5, 1.0, 4, MASKED), "briggs+0.5 0.5 4": ("briggs", 0.5, 0.5, 4, MASKED),
    "natural 1 4": ("natural", 0.0, 1.0, 4, MASKED), "natural 0.5 4": ("natural", 0.0, 0.5, 4, MASKED),
    "briggs-1 1 4": ("briggs", -1.0, 1.0, 4, MASKED), "briggs-1 0.5 4": ("briggs", -1.0, 0.5, 4, MASKED),
    "briggs+0 0.5 8": ("briggs", 0.0, 0.5, 8, MASKED), "briggs-1 0.5 8": ("briggs", -1.0, 0.5, 8, MASKED),
    "briggs-1 1 4 unmasked": ("briggs", -1.0, 1.0, 4, ()), "briggs-1 0.5 4 unmasked": ("briggs", -1.0, 0.5, 4, ()),
    "briggs-0.5 1 4 unmasked": ("briggs", -0.5, 1.0, 4, ()), "briggs+0 1 4 unmasked": ("briggs", 0.0, 1.0, 4, ()),
    "briggs-1 0.5 4 slow": ("briggs", -1.0, 0.5, 4, (*MASKED, "-multiscale-gain", "0.05", "-mgain", "0.6")),
}  # fmt: skip
TUNED_ON = "S M31"


@dataclass(frozen=True)
class Case:
    """What is observed, and how."""

    scene: str
    configs: tuple[str, ...] = tuple("ABCD")
    freq_hz: float = 3e9
    noise_db: float = 45.0
    gain_rms: float = 0.003
    flat: bool = False

    @property
    def array(self) -> Array:
        """16 channels over an octave around `freq_hz`."""
        width = 2 / 3 * self.freq_hz
        return Array(replace(VLA, freq_hz=self.freq_hz, channel_hz=width / 16, channels=16, scans=2, integrations=4),
                     self.configs)

    @property
    def sky(self):
        """The sky with its spectral index."""
        sky = scene_sky(self.scene, nominal_cell_arcsec(self.array) / SUPER_RESOLUTION, oversampling=3)
        index = np.zeros(sky.image.shape) if self.flat else index_map(sky.image.shape)
        return replace(sky, index=index, reference_hz=self.freq_hz)


CASES = {
    "S M31": Case("M31"), "S M31 flat": Case("M31", flat=True), "S M31 faint": Case("M31", noise_db=30.0),
    "S 3c353": Case("3c353", noise_db=40.0, gain_rms=0.01), "S 3c353 flat": Case("3c353", noise_db=40.0, gain_rms=0.01,
                                                                                 flat=True),
    "L M31": Case("M31", ("A",), 1.5e9), "L 3c196": Case("3c196", ("B",), 1.5e9, noise_db=40.0),
}  # fmt: skip


def index_map(shape, seed=11, width=0.06):
    """A smooth random field, its values spread evenly from LOWEST to HIGHEST."""
    field = gaussian_filter(np.random.default_rng(seed).standard_normal(shape), width * shape[0], mode="wrap")
    place = 0.5 * (1 + erf((field - field.mean()) / field.std() / np.sqrt(2)))
    return LOWEST + (HIGHEST - LOWEST) * place


def simulated(name, folder):
    """Return case, sky and the parameters that both imagers share; the MeasurementSets are written unless there."""
    case, folder = CASES[name], folder / name.replace(" ", "_")
    sky, kept = case.sky, folder / "vis.json"
    if not kept.exists():
        from casa_sara.demo.imagers import quiet

        folder.mkdir(parents=True, exist_ok=True)
        with quiet(folder / "simulation.txt"):
            made = observe(sky, folder, case.array, case.noise_db, case.gain_rms, seed=3)
        kept.write_text(json.dumps(made.vis))
    shape = [n // sky.oversampling for n in sky.image.shape]
    cell = sky.cell_rad * sky.oversampling * 180 * 3600 / np.pi
    common = dict(vis=json.loads(kept.read_text()), imsize=shape, cell=f"{cell}arcsec", datacolumn="data",
                  weighting="briggs", robust=-1.0)
    return case, sky, folder, common, cell


class Measures:
    """The truth of a case at a beam, and how far images are from it."""

    def __init__(self, case, sky, beam, cell):
        from casa_sara.analysis.metrics import smooth, snr

        self._snr, self._smooth = snr, smooth
        self._beam, self._angle = [axis / cell for axis in beam[:2]], beam[2]
        self._area = np.pi / (4 * np.log(2)) * self._beam[0] * self._beam[1]
        self._sky = sky.at(case.freq_hz)
        self._truth = {factor: self._seen(self._sky, factor) for factor in (0.5, 1.0)}
        low, high = (self._seen(sky.at(case.freq_hz * ratio), 1.0) for ratio in (0.98, 1.02))
        good = (low > 0) & (high > 0) & (self._truth[1.0] > 0)
        self.index = np.where(good, np.log(np.where(good, high / np.where(good, low, 1), 1)) / np.log(1.02 / 0.98), 0)
        self.brightness = self._truth[1.0] * self._area  # Jy/beam

    def _seen(self, sky, factor):
        return smoothed_truth(sky, [factor * axis for axis in self._beam], self._angle)

    def snr(self, model, restored=None):
        """SNR of a model at half a beam and at one; of a restored image too, at one."""
        found = [self._snr(truth, self._smooth(model, [factor * axis for axis in self._beam], self._angle))
                 for factor, truth in self._truth.items()]
        if restored is not None:
            found[1] = max(found[1], self._snr(self.brightness, restored))
        return found

    def of_index(self, index, noise, known):
        """Rms error where it is known, its median, and that by thermal noise, above each of LEVELS; the share known."""
        found = {}
        for level in LEVELS:
            here = self.brightness > level * noise
            valid = here & np.isfinite(index) & known
            error = (index - self.index)[valid] if valid.any() else np.full(1, np.nan)
            expected = noise / self.brightness[here] / 0.2  # 0.2 is the spread of ln ν in an octave
            found[level] = dict(pixels=int(here.sum()), rms=float(np.sqrt(np.mean(error**2))),
                                median=float(np.median(np.abs(error))), known=float(valid.sum() / max(here.sum(), 1)),
                                thermal=float(np.sqrt(np.mean(expected**2))))
        return found


def opened(name):
    """Return pixels and mask of an image, (nx, ny) or (nx, ny, T)."""
    from casatools import image

    ia = image()
    ia.open(str(name))
    try:
        return ia.getchunk()[:, :, 0].squeeze().astype(float), ia.getchunk(getmask=True)[:, :, 0].squeeze()
    finally:
        ia.close()


def run_tsara(name, folder):
    """Run tsara with 1 to 3 terms."""
    from casa_sara import tsara
    from casa_sara.demo.imagers import quiet, read_image

    case, sky, folder, common, cell = simulated(name, folder)
    result = {}
    for nterms in (3, 2, 1):
        root, begin = folder / f"tsara{nterms}", time.perf_counter()
        with quiet(folder / "tsara.txt"):
            made = tsara(**common, imagename=str(root), nterms=nterms, overwrite=True, nthreads=1)
        seconds = time.perf_counter() - begin
        measures = Measures(case, sky, read_image(f"{root}.image")[1], cell)
        if nterms == 3:
            noise = float(opened(f"{root}.residual")[0].std())
        one = dict(snr=measures.snr(opened(f"{root}.model")[0]), seconds=seconds, iterations=int(made["iterdone"]),
                   noise=noise, flux=float(opened(f"{root}.model")[0].sum() / sky.at(case.freq_hz).image.sum()))
        if nterms > 1:
            index, known = opened(f"{root}.alpha")
            error, _ = opened(f"{root}.alpha.error")
            one["index"] = measures.of_index(index, noise, known)
            away = ((index - measures.index) / np.where(known, error, 1))[known & (measures.brightness > 30 * noise)]
            one["in_errors"] = float(np.sqrt(np.mean(away**2)))
        result[nterms] = one
        print(name, nterms, json.dumps(one), flush=True)
    (folder / "tsara.json").write_text(json.dumps(result))


def run_clean(name, folder, settings):
    """Run tclean mtmfs with some settings."""
    from casa_sara.demo.imagers import quiet, read_image

    case, sky, folder, common, cell = simulated(name, folder)
    kept = folder / "clean.json"
    result = json.loads(kept.read_text()) if kept.exists() else {}
    noise = json.loads((folder / "tsara.json").read_text())["3"]["noise"]
    beam = read_image(folder / "tsara3.image")[1]
    for setting in settings:
        if setting in result:
            continue
        scales, bias, niter, weighting = GRID[setting]
        root, width = folder / f"mtmfs_{setting.replace(' ', '_')}", np.sqrt(beam[0] * beam[1]) / cell
        begin = time.perf_counter()
        with quiet(folder / "clean.txt"):
            from casatasks import tclean

            tclean(**common | dict(weighting=weighting), imagename=str(root), deconvolver="mtmfs", nterms=2,
                   scales=sorted({round(scale * width) for scale in scales}), smallscalebias=bias, niter=niter,
                   gain=0.2, nsigma=2.0, restoringbeam=[f"{beam[0]}arcsec", f"{beam[1]}arcsec", f"{beam[2]}deg"])
        seconds = time.perf_counter() - begin
        measures = Measures(case, sky, beam, cell)
        index, known = opened(f"{root}.alpha")
        model, restored = (opened(f"{root}.{kind}.tt0")[0] for kind in ("model", "image"))
        result[setting] = dict(snr=measures.snr(model, restored), seconds=seconds,
                               index=measures.of_index(index, noise, known))
        print(name, setting, json.dumps(result[setting]), flush=True)
        kept.write_text(json.dumps(result))


def run_wsclean(name, folder, settings):
    """Run wsclean with joined channels and some settings."""
    from astropy.io import fits

    from casa_sara.analysis.metrics import smooth
    from casa_sara.demo.imagers import read_image

    case, sky, folder, common, cell = simulated(name, folder)
    kept = folder / "wsclean.json"
    result = json.loads(kept.read_text()) if kept.exists() else {}
    noise = json.loads((folder / "tsara.json").read_text())["3"]["noise"]
    beam = read_image(folder / "tsara3.image")[1]
    measures = Measures(case, sky, beam, cell)
    for setting in settings:
        if setting in result:
            continue
        weighting, robust, sigma, channels, more = WSCLEAN[setting]
        root = folder / f"wsclean_{setting.replace(' ', '_')}"
        command = ["wsclean", "-j", "1", "-size", *map(str, common["imsize"]), "-scale", f"{cell}asec", "-weight",
                   *([weighting, str(robust)] if weighting == "briggs" else [weighting]), "-multiscale",
                   "-join-channels", "-channels-out", str(channels), "-fit-spectral-pol", "2", "-niter", "1000000",
                   "-mgain", "0.8", "-auto-threshold", str(sigma), *more, "-data-column", "DATA", "-pol",
                   "I", "-beam-shape", f"{beam[0]}asec", f"{beam[1]}asec", f"{beam[2]}deg",
                   "-no-update-model-required", "-name", str(root), *common["vis"]]
        begin = time.perf_counter()
        with open(folder / "wsclean.txt", "w", encoding="utf-8") as log:
            subprocess.run(command, check=True, stdout=log, stderr=log)
        seconds = time.perf_counter() - begin
        files = [[f"{root}-{k:04d}-{kind}.fits" for k in range(channels)] for kind in ("model", "image")]
        models, restored = (np.array([fits.getdata(file).squeeze().T for file in some], float) for some in files)
        freqs = np.array([fits.getheader(file)["CRVAL3"] for file in files[0]])
        powers = (freqs / case.freq_hz - 1)[:, None] ** np.arange(2)
        model = np.tensordot(np.linalg.pinv(powers)[0], models, 1)  # its channels are on this line
        at_beam = np.array([smooth(one, measures._beam, measures._angle) for one in models])
        result[setting] = dict(snr=measures.snr(model, np.tensordot(np.linalg.pinv(powers)[0], restored, 1)),
                               seconds=seconds)
        for kind, seen in (("index", restored), ("index of models", at_beam)):
            known = (seen > 0).all(axis=0)
            place = np.log(freqs / case.freq_hz)
            slope = np.tensordot(np.linalg.pinv(np.stack([place**0, place], axis=1))[1], np.log(
                np.where(known, seen, 1.0)), 1)
            result[setting][kind] = measures.of_index(slope, noise, known)
        print(name, "wsclean", setting, json.dumps(result[setting]), flush=True)
        kept.write_text(json.dumps(result))


def best_settings(folder, grid=GRID, file="clean.json"):
    """The settings that are best on TUNED_ON."""
    found = json.loads((folder / TUNED_ON.replace(" ", "_") / file).read_text())
    return list(dict.fromkeys([max(grid, key=lambda one: found[one]["snr"][1]),
                               min((one for one in grid if found[one]["index"]["30"]["known"] > 0.99),
                                   key=lambda one: found[one]["index"]["100"]["rms"])]))


def time_one_by_one(folder, name=TUNED_ON):
    """Seconds of tsara on three sub-bands, one after the other, and on all of them together."""
    from casa_sara import tsara
    from casa_sara.demo.imagers import quiet

    _, _, folder, common, _ = simulated(name, folder)
    seconds = {}
    runs = {"warm": [dict(nterms=3)], "together": [dict(nterms=3)],
            "one by one": [dict(spw=f"0:{first}~{last}") for first, last in ((0, 4), (5, 10), (11, 15))],
            "flat": [dict()]}
    for what, calls in runs.items():
        begin = time.perf_counter()
        for more in calls:
            with quiet(folder / "time.txt"):
                tsara(**common, imagename=str(folder / "timed"), overwrite=True, nthreads=1, **more)
        seconds[what] = time.perf_counter() - begin
    print(name, {what: round(value, 2) for what, value in seconds.items()})
    (folder / "time.json").write_text(json.dumps(seconds))


def compare_priors(folder, names=("S M31", "S M31 flat", "S M31 faint")):
    """The same runs with the ℓ2,1 norm over the frequencies in place of the prior of the orders."""
    import casa_sara.reconstruction.solution as solution
    from casa_sara import tsara
    from casa_sara.demo.imagers import quiet, read_image

    kept = solution.SubbandDictionary
    for name in names:
        case, sky, where, common, cell = simulated(name, folder)
        measures = Measures(case, sky, read_image(where / "tsara3.image")[1], cell)
        noise = json.loads((where / "tsara.json").read_text())["3"]["noise"]
        solution.SubbandDictionary, begin = joint_prior(kept), time.perf_counter()
        try:
            with quiet(where / "prior.txt"):
                tsara(**common, imagename=str(where / "joint"), nterms=3, overwrite=True, nthreads=1)
        finally:
            solution.SubbandDictionary = kept
        index, known = opened(where / "joint.alpha")
        one = dict(snr=measures.snr(opened(where / "joint.model")[0]), index=measures.of_index(index, noise, known),
                   seconds=time.perf_counter() - begin)
        print(name, "ℓ2,1", json.dumps(one), flush=True)
        (where / "joint.json").write_text(json.dumps(one))


def joint_prior(base):
    """The dictionary of `base` with the prior Σ W √(Σ_t (Ψ†z_t)²), which the orders have as well: F is orthonormal."""
    from scipy.ndimage import uniform_filter

    class Joint(base):
        def dual_step(self, model_bar, dual, threshold, weights, out, relaxation=1.0):
            step = self.analysis(model_bar)
            step += dual
            size = np.sqrt(np.einsum("tbij,tbij->bij", step, step))
            step *= np.minimum(1, threshold * weights[0] / np.maximum(size, np.float32(1e-30)))
            dual += np.float32(relaxation) * (step - dual)
            return self.synthesis(dual, out)

        def reweight(self, image, alpha, scale, out):
            coefs = self.analysis(image, out)
            power = np.einsum("tbij,tbij->bij", coefs, coefs)
            for a, s, band in zip(alpha, scale, self._dictionary.bands()):
                around = np.sqrt(np.maximum(uniform_filter(power[band.slice], 3, mode="wrap"), 0))
                out[(slice(None), *band.slice)] = s * a / (a + around)
            return out

    return Joint


def tables(folder):
    """Print the tables."""
    def line(name, kind, one):
        index = one.get("index", {})
        parts = [index[str(level)] for level in LEVELS] if index else []
        cells = [f"{part['rms']:.3f} ({part['median']:.3f})" for part in parts] or [""] * len(LEVELS)
        return f"| {name} | {kind} | {one['snr'][0]:.1f} | {one['snr'][1]:.1f} | {' | '.join(cells)} |"

    print("| case | imager | half a beam | one beam | α error, S/N > 30 | α error, S/N > 100 |")
    print("|---|---|---|---|---|---|")
    for name in CASES:
        where = folder / name.replace(" ", "_")
        rows = [(f"tsara nterms={n}", one) for n, one in json.loads((where / "tsara.json").read_text()).items()]
        for file, label in (("joint.json", "ℓ2,1"), ("clean.json", "")):
            if (where / file).exists():
                found = json.loads((where / file).read_text())
                rows += [(f"mtmfs {one}", found[one]) for one in found] if not label else [(label, found)]
        if (where / "wsclean.json").exists():
            for setting, one in json.loads((where / "wsclean.json").read_text()).items():
                rows += [(f"wsclean {setting}", one), ("the same, of models", one | dict(index=one["index of models"]))]
        for kind, one in rows:
            print(line(name, kind, one))
        three = json.loads((where / "tsara.json").read_text())["3"]
        parts = three["index"].values()
        print(f"  thermal errors {[round(part['thermal'], 3) for part in parts]}, pixels "
              f"{[part['pixels'] for part in parts]}, known {[round(part['known'], 3) for part in parts]}, errors in "
              f"units of .alpha.error {three['in_errors']:.2f}")


def pictures(folder):
    """Draw the index of truth, tsara and tclean."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    from casa_sara.demo.imagers import read_image

    for name in CASES:
        case, sky, where, _, cell = simulated(name, folder)
        measures = Measures(case, sky, read_image(where / "tsara3.image")[1], cell)
        noise = json.loads((where / "tsara.json").read_text())["3"]["noise"]
        index, known = opened(where / "tsara3.alpha")
        panels = {"sky at the beam": (measures.index, measures.brightness > 30 * noise),
                  "tsara nterms=3": (index, known)}
        for path in sorted(where.glob("mtmfs*.alpha"))[:1]:
            panels["tclean mtmfs"] = opened(path)
        figure, axes = plt.subplots(2, len(panels), figsize=(4 * len(panels), 7.6), layout="constrained")
        for axis, wrong, (title, (values, mask)) in zip(*axes, panels.items()):
            shown = axis.imshow(np.where(mask, values, np.nan).T, origin="lower", vmin=-1.7, vmax=0.7, cmap="turbo")
            axis.set_title(title)
            here = mask & (measures.brightness > 30 * noise)
            error = wrong.imshow(np.where(here, values - measures.index, np.nan).T, origin="lower", vmin=-0.3, vmax=0.3,
                                 cmap="RdBu")
            wrong.set_title(f"error, S/N > 30: rms {np.sqrt(np.mean((values - measures.index)[here] ** 2)):.3f}")
        figure.colorbar(shown, ax=axes[0], label="spectral index")
        figure.colorbar(error, ax=axes[1], label="error")
        figure.savefig(where / "index.png", dpi=80)
        plt.close(figure)


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--only", choices=("tsara", "clean", "wsclean", "prior", "time", "table",
                                           "pictures"))
    parser.add_argument("--cases", default=",".join(CASES))
    given = parser.parse_args()
    folder, names = given.folder.resolve(), given.cases.split(",")
    for name in names:
        if given.only == "tsara" or not given.only and not (folder / name.replace(" ", "_") / "tsara.json").exists():
            run_tsara(name, folder)
    if given.only in (None, "clean"):
        if TUNED_ON in names:
            run_clean(TUNED_ON, folder, GRID)
        for name in names:
            run_clean(name, folder, best_settings(folder))
    if given.only in (None, "wsclean") and shutil.which("wsclean"):
        if TUNED_ON in names:
            run_wsclean(TUNED_ON, folder, WSCLEAN)
        for name in names:
            run_wsclean(name, folder, best_settings(folder, WSCLEAN, "wsclean.json"))
    for what, do in (("prior", compare_priors), ("time", time_one_by_one), ("table", tables), ("pictures", pictures)):
        if given.only in (None, what):
            do(folder)


if __name__ == "__main__":
    main()
