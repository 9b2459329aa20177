"""Polarisation: Stokes I, Q, U and V with and without |(Q, U, V)| ≤ I, and tclean's multiscale.

    python benchmarks/polarisation.py FOLDER              # everything; what FOLDER holds already is not done again
    python benchmarks/polarisation.py FOLDER --only table   # the tables of docs/validation.md
    python benchmarks/polarisation.py FOLDER --only pictures
    python benchmarks/polarisation.py FOLDER --cases "VLA snapshot 3c353"

Skies stand on pixels three times smaller than the image's, and between them; the polarised fraction varies smoothly
from 0 to 0.6, the angle by several turns, and V is up to 1 % of I. In the case 'screen' the polarised emission comes
from a foreground whose own brightness is smooth, so that the array does not see it: there the bound is wrong.

SNR is that of the model against the sky, both smoothed to one beam; of tclean it is the better of model and restored
image. P is Q + iU. Angles are compared where the sky has P above 10 times its noise. Leakage is P of the model, in
units of the noise of Q at the beam, where I of the sky is below its noise: rms, and the share of pixels above 3. tclean
runs with each of GRID; the best by the SNR of P is shown.
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
from scenes import ALMA, VLA, Array, nominal_cell_arcsec, scene_sky, smoothed_truth
from scipy.ndimage import gaussian_filter
from scipy.special import erf

SUPER_RESOLUTION = 1.7
STOKES = "IQUV"
MOST_POLARISED, TURNS, CIRCULAR = 0.6, 2.0, 0.01
SHORT_SCALES, LONG_SCALES = (0, 0.6, 1.8, 5.4), (0, 0.6, 1.8, 5.4, 16)
# scales in units of the beam, most iterations, nsigma; 40 major cycles at most
GRID = {"short": (SHORT_SCALES, 20_000, 3.0), "long": (LONG_SCALES, 20_000, 3.0), "deep": (LONG_SCALES, 20_000, 1.5)}
CIRCULAR_FEEDS, LINEAR_FEEDS = "RR RL LR LL", "XX XY YX YY"


@dataclass(frozen=True)
class Case:
    """What is observed, and how."""

    scene: str
    array: Array
    noise_db: float = 40.0
    screen: bool = False

    @property
    def sky(self):
        """The sky of each Stokes parameter."""
        intensity = scene_sky(self.scene, nominal_cell_arcsec(self.array) / SUPER_RESOLUTION, oversampling=3)
        shape = intensity.image.shape
        fraction = MOST_POLARISED * field(shape, 5)
        angle = 2 * np.pi * TURNS * field(shape, 6)
        source = np.full(shape, intensity.image.mean()) if self.screen else intensity.image
        polarised = fraction * source * np.exp(1j * angle)
        circular = CIRCULAR * (2 * field(shape, 7) - 1) * intensity.image
        return {stokes: replace(intensity, image=image) for stokes, image in zip(STOKES, (
            intensity.image, polarised.real, polarised.imag, circular))}


def of_vla(configs, scans, integrations):
    """Return the VLA with four correlations."""
    return Array(replace(VLA, correlations=CIRCULAR_FEEDS, scans=scans, integrations=integrations), configs)


OF_ALMA = Array(replace(ALMA, correlations=LINEAR_FEEDS, integrations=10), ("alma.cycle8.5",))
CASES = {
    "VLA snapshot 3c353": Case("3c353", of_vla(("B",), 2, 6)),
    "VLA snapshot 3c353 faint": Case("3c353", of_vla(("B",), 2, 6), 20.0),
    "VLA B-D track M31": Case("M31", of_vla(("B", "C", "D"), 6, 6), 35.0),
    "VLA B-D track M31 faint": Case("M31", of_vla(("B", "C", "D"), 6, 6), 15.0),
    "VLA A-C track 3c196": Case("3c196", of_vla(("A", "B", "C"), 6, 6), 45.0),
    "ALMA snapshot 30dor": Case("30dor", OF_ALMA, 30.0),
    "VLA snapshot 3c353 screen": Case("3c353", of_vla(("B",), 2, 6), 40.0, screen=True),
}  # fmt: skip


def field(shape, seed, width=0.04):
    """A smooth random field, its values spread evenly from 0 to 1."""
    values = gaussian_filter(np.random.default_rng(seed).standard_normal(shape), width * shape[0], mode="wrap")
    return 0.5 * (1 + erf((values - values.mean()) / values.std() / np.sqrt(2)))


def simulate(case, folder):
    """Write the MeasurementSets of a case, and return their names; the noise of I, Q, U and V is the same."""
    from casatools import table

    from casa_sara.demo import simulate as demo
    from casa_sara.demo.predict import predict

    sky, names, seen = case.sky, [], []
    observation = case.array.observation
    for number, config in enumerate(case.array.configs):
        name = folder / f"{config}.ms"
        start = (number + 0.5) / len(case.array.configs)
        demo._lay_out(name, config, (start + np.arange(observation.scans)) / observation.scans, observation)
        names.append(str(name))
        tb = table()
        tb.open(names[-1], nomodify=False)
        tb.removecols(["MODEL_DATA", "CORRECTED_DATA"])
        waves = observation.channel_freqs_hz / demo.SPEED_OF_LIGHT
        uvw = (tb.getcol("UVW")[:, None, :] * waves[:, None]).reshape(3, -1)
        i, q, u, v = (predict(one, uvw).reshape(waves.size, -1) for one in sky.values())
        seen.append((tb, np.array([i + v, q + 1j * u, q - 1j * u, i - v]
                                  if observation.correlations == CIRCULAR_FEEDS
                                  else [i + q, u + 1j * v, u - 1j * v, i - q]), np.sum(np.abs(i) ** 2), i.size))
    power, samples = sum(power for *_, power, _ in seen), sum(size for *_, size in seen)
    noise = np.sqrt(power / (2 * samples)) * 10 ** (-case.noise_db / 20)
    sigma, rng = np.sqrt(2) * noise, np.random.default_rng(9)
    for tb, data, *_ in seen:
        tb.putcol("DATA", (data + sigma * (rng.standard_normal(data.shape) + 1j * rng.standard_normal(data.shape))
                           ).astype(np.complex64))
        tb.putcol("SIGMA", np.full((4, data.shape[-1]), sigma))
        tb.putcol("WEIGHT", np.full((4, data.shape[-1]), sigma**-2.0))
        tb.close()
    return names


def prepared(name, folder):
    """Return case, its folder, the parameters that both imagers share, and the pixel size in arcsec."""
    case, folder = CASES[name], folder / name.replace(" ", "_")
    kept, sky = folder / "vis.json", case.sky["I"]
    if not kept.exists():
        from casa_sara.demo.imagers import quiet

        folder.mkdir(parents=True, exist_ok=True)
        with quiet(folder / "simulation.txt"):
            names = simulate(case, folder)
        kept.write_text(json.dumps(names))
    cell = sky.cell_rad * sky.oversampling * 180 * 3600 / np.pi
    common = dict(vis=json.loads(kept.read_text()), imsize=[n // sky.oversampling for n in sky.image.shape],
                  cell=f"{cell}arcsec", stokes=STOKES, datacolumn="data", weighting="briggs", robust=0.0)
    return case, folder, common, cell


def planes(name):
    """Return the Stokes planes (4, nx, ny) of an image, and its beam in arcsec and degrees."""
    from casatools import image

    ia = image()
    ia.open(str(name))
    try:
        beam = ia.restoringbeam()
        beam = beam["beams"]["*0"]["*0"] if "beams" in beam else beam
        found = [beam[axis]["value"] for axis in ("major", "minor", "positionangle")] if beam else None
        return np.moveaxis(ia.getchunk()[:, :, :, 0].astype(float), -1, 0), found
    finally:
        ia.close()


class Measures:
    """The truth of a case at a beam, in Jy/beam, and how far images are from it."""

    def __init__(self, case, beam, cell, noise):
        from casa_sara.analysis.metrics import smooth

        axes, self._angle = [axis / cell for axis in beam[:2]], beam[2]
        self._axes, self._smooth = axes, smooth
        self._area = np.pi / (4 * np.log(2)) * axes[0] * axes[1]
        self.truth = self._area * np.array([smoothed_truth(sky, axes, self._angle) for sky in case.sky.values()])
        self.noise = noise  # of each Stokes parameter, Jy/beam

    def seen(self, models):
        """Return models in Jy/pixel, smoothed to the beam."""
        return self._area * np.array([self._smooth(model, self._axes, self._angle) for model in models])

    def of(self, images):
        """Return the measures of images in Jy/beam."""
        truth, found = self.truth, {}
        p, true_p = images[1] + 1j * images[2], truth[1] + 1j * truth[2]
        for name, one, true in (*zip(STOKES, images, truth), ("P", p, true_p)):
            found[f"snr {name}"] = float(20 * np.log10(np.linalg.norm(true) / np.linalg.norm(one - true)))
        bright = np.abs(true_p) > 10 * self.noise[1]
        angle = 0.5 * np.degrees(np.angle(p * np.conj(true_p)))[bright]
        dark = np.abs(truth[0]) < self.noise[0]
        leaked = np.abs(p[dark]) / self.noise[1]
        return found | dict(
            angle_rms_deg=float(np.sqrt(np.mean(angle**2))) if bright.any() else np.nan, pixels=int(bright.sum()),
            leakage_rms=float(np.sqrt(np.mean(leaked**2))), leaked=float(np.mean(leaked > 3)), dark=int(dark.sum()),
            flux_i=float(images[0].sum() / truth[0].sum()),
            polarised_above=float(np.mean(np.hypot(images[1], images[2]) > images[0] + 1e-6 * images[0].max())))


def run_tsara(name, folder):
    """Run tsara without the bound and with it."""
    from casa_sara import tsara
    from casa_sara.demo.imagers import quiet

    case, folder, common, cell = prepared(name, folder)
    result = {}
    for kind, bound in (("alone", False), ("bound", True)):
        root, begin = folder / f"tsara_{kind}", time.perf_counter()
        with quiet(folder / "tsara.txt"):
            made = tsara(**common, imagename=str(root), polbound=bound, overwrite=True, nthreads=1)["sara"]["stokes"]
        seconds = time.perf_counter() - begin
        beam = planes(f"{root}.image")[1]
        if kind == "alone":  # the noise at the beam of the image, measured where there is little else
            noise = [float(one.std()) for one in planes(f"{root}.residual")[0]]
        measures = Measures(case, beam, cell, noise)
        result[kind] = measures.of(measures.seen(planes(f"{root}.model")[0])) | dict(
            seconds=seconds, noise=noise, iterations=[one["reweightings"][-1]["iteration"] for one in made],
            stopcodes=[one["stopcode"] for one in made],
            noise_found=[float(np.mean([block["noise_found"] for block in one["blocks"]])) for one in made])
        print(name, kind, json.dumps(result[kind]), flush=True)
    (folder / "tsara.json").write_text(json.dumps(result))


def run_clean(name, folder):
    """Run tclean multiscale with each setting."""
    from casa_sara.demo.imagers import quiet

    case, folder, common, cell = prepared(name, folder)
    noise = json.loads((folder / "tsara.json").read_text())["alone"]["noise"]
    beam = planes(folder / "tsara_alone.image")[1]
    width, result = np.sqrt(beam[0] * beam[1]) / cell, {}
    measures = Measures(case, beam, cell, noise)
    for setting, (scales, niter, nsigma) in GRID.items():
        root, begin = folder / f"clean_{setting}", time.perf_counter()
        with quiet(folder / "clean.txt"):
            from casatasks import tclean

            tclean(**common, imagename=str(root), deconvolver="multiscale",
                   scales=sorted({round(scale * width) for scale in scales}), niter=niter, nsigma=nsigma, nmajor=40,
                   restoringbeam=[f"{beam[0]}arcsec", f"{beam[1]}arcsec", f"{beam[2]}deg"])
        seconds = time.perf_counter() - begin
        of_model = measures.of(measures.seen(planes(f"{root}.model")[0]))
        of_image = measures.of(planes(f"{root}.image")[0])
        better = {key: max(of_model[key], of_image[key]) for key in of_model if key.startswith("snr")}
        chosen = of_image if of_image["snr P"] > of_model["snr P"] else of_model
        result[setting] = chosen | better | dict(seconds=seconds)
        print(name, setting, json.dumps(result[setting]), flush=True)
    (folder / "clean.json").write_text(json.dumps(result))


def tables(folder, names):
    """Print the tables."""
    print("| case | imager | SNR I | SNR Q | SNR U | SNR P | angle rms, P > 10σ | leakage: rms, above 3σ | flux of I |")
    print("|---|---|---|---|---|---|---|---|---|")
    for name in names:
        where = folder / name.replace(" ", "_")
        rows = list(json.loads((where / "tsara.json").read_text()).items())
        if (where / "clean.json").exists():
            found = json.loads((where / "clean.json").read_text())
            best = max(found, key=lambda one: found[one]["snr P"])
            rows.append((f"tclean {best}", found[best]))
        for kind, one in rows:
            print(f"| {name} | {kind} | " + " | ".join(f"{one[f'snr {stokes}']:.2f}" for stokes in "IQUP")
                  + f" | {one['angle_rms_deg']:.2f}° ({one['pixels']}) | {one['leakage_rms']:.3f}, "
                  f"{100 * one['leaked']:.2f} % | {one['flux_i']:.4f} |")
        seconds = {kind: round(one["seconds"]) for kind, one in rows}
        print(f"  {seconds}, stop codes {[one.get('stopcodes') for _, one in rows[:2]]}, noise found "
              f"{[np.round(one['noise_found'], 3).tolist() for _, one in rows[:2]]}")


def pictures(folder, names):
    """Draw P of the sky, of tsara with and without the bound, and of tclean."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    for name in names:
        case, where, _, cell = prepared(name, folder)
        kept = json.loads((where / "tsara.json").read_text())["alone"]
        measures = Measures(case, planes(where / "tsara_alone.image")[1], cell, kept["noise"])
        panels = {"sky": measures.truth} | {f"tsara, {kind}": measures.seen(planes(where / f"tsara_{kind}.model")[0])
                                            for kind in ("alone", "bound")}
        for path in sorted(where.glob("clean_*.image"))[:1]:
            panels["tclean"] = planes(path)[0]
        figure, axes = plt.subplots(2, len(panels), figsize=(4 * len(panels), 7.6), layout="constrained")
        for (title, images), (above, below) in zip(panels.items(), axes.T):
            p = images[1] + 1j * images[2]
            shown = above.imshow(np.abs(p).T / kept["noise"][1], origin="lower", vmin=0, vmax=30, cmap="inferno")
            above.set_title(f"{title}: P/noise")
            angle = np.where(np.abs(p) > 5 * kept["noise"][1], 0.5 * np.degrees(np.angle(p)), np.nan)
            turned = below.imshow(angle.T, origin="lower", vmin=-90, vmax=90, cmap="twilight")
            below.set_title("angle where P > 5 times the noise")
        figure.colorbar(shown, ax=axes[0], label="P/noise")
        figure.colorbar(turned, ax=axes[1], label="degrees")
        figure.savefig(where / "polarisation.png", dpi=80)
        plt.close(figure)


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--only", choices=("tsara", "clean", "table", "pictures"))
    parser.add_argument("--cases", default=",".join(CASES))
    given = parser.parse_args()
    folder, names = given.folder.resolve(), given.cases.split(",")
    for what, do in (("tsara", run_tsara), ("clean", run_clean)):
        for name in names:
            done = (folder / name.replace(" ", "_") / f"{what}.json").exists()
            if given.only == what or not given.only and not done:
                do(name, folder)
    for what, show in (("table", tables), ("pictures", pictures)):
        if given.only in (None, what):
            show(folder, names)


if __name__ == "__main__":
    main()
