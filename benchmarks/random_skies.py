"""Random skies, arrays, signal-to-noise ratios and gain errors: tsara with defaults, and with gainfit=True.

    python benchmarks/random_skies.py FOLDER                # simulate what is missing, image, and print the table
    python benchmarks/random_skies.py FOLDER --gains none   # the same kind of skies without gain errors
    python benchmarks/random_skies.py FOLDER --seeds 0 10

Everything follows from the seed of a scene: the telescope, its times, one or two skies of the kinds of faint_scenes.py
and KINDS, on a grid three times finer than the image's, the S/N of the peak (6 to 3000), and gain errors of 1, 3 or 6 %
of real and imaginary part, for each scan or each integration. SNRs are those of faint.py. Results are kept in FOLDER.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import sys
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")
sys.path.insert(0, str(Path(__file__).resolve().parent))

import faint_scenes
import numpy as np
from faint import BEAMS, Judge, run_tsara
from faint_scenes import FINER, FLUX_JY, binned, dirty_image, gaussian, natural_beam, write_observed
from machine import machine

SEEDS = {"errors": (0, 36), "none": (100, 112)}
# telescope, antenna file, frequency, declinations
TELESCOPES = [
    ("ALMA", "alma.cycle10.2", 100e9, (-50, 0)), ("ALMA", "alma.cycle10.4", 345e9, (-50, 0)),
    ("ALMA", "alma.cycle10.7", 230e9, (-50, 0)), ("ALMA", "aca.cycle10", 230e9, (-50, 0)),
    ("VLA", "vla.a", 3e9, (0, 60)), ("VLA", "vla.b", 1.5e9, (0, 60)), ("VLA", "vla.c", 5e9, (0, 60)),
    ("VLA", "vla.d", 22e9, (-10, 60)), ("MeerKAT", "meerkat", 1.3e9, (-60, 0)),
    ("ATCA", "atca_750a", 5.5e9, (-70, -30)), ("ATCA", "atca_6a", 2.1e9, (-70, -30)),
    ("SMA", "sma.compact", 230e9, (0, 40)),
]  # fmt: skip
FEW_ANTENNAS = ("atca", "sma", "aca")


def jets(rng, x, y, beam, extent):
    """A core, two lobes with hot spots, and knots between them."""
    n, angle = len(x), rng.uniform(0, np.pi)
    length, along = n * rng.uniform(0.1, 0.3), np.array([np.cos(angle), np.sin(angle)])
    image = rng.uniform(0.02, 0.5) * gaussian(x, y, (0, 0), 0.1 * beam + 1)
    for side, flux in ((1, 1), (-1, rng.uniform(0.1, 1))):
        spot = gaussian(x, y, side * length * along, beam * rng.uniform(0.2, 1), rng.uniform(0.4, 1),
                        rng.uniform(0, np.pi))
        image += flux * spot * rng.uniform(0.3, 1)
        image += 2 * flux * gaussian(x, y, 0.75 * side * length * along, 0.6 * length, rng.uniform(0.3, 0.7), angle)
        for part in np.linspace(0.1, 0.9, 9):
            knot = 0.05 * flux * rng.uniform(0, 1)
            image += knot * gaussian(x, y, side * length * part * along + rng.normal(0, 0.3 * beam, 2), 0.4 * beam)
    return image


def shell(rng, x, y, beam, extent):
    """A supernova remnant: a shell with filaments, brighter on one side."""
    n = len(x)
    radius, centre = n * rng.uniform(0.1, 0.25) * extent, rng.uniform(-0.1, 0.1, 2) * n
    r_sq, angle = (x - centre[0]) ** 2 + (y - centre[1]) ** 2, np.arctan2(y - centre[1], x - centre[0])
    depth = np.sqrt(np.clip(radius**2 - r_sq, 0, None)) - np.sqrt(np.clip((0.85 * radius) ** 2 - r_sq, 0, None))
    wavenumber = np.hypot(np.fft.fftfreq(n)[:, None], np.fft.rfftfreq(n)[None]) + 1 / n
    field = np.fft.irfft2(np.fft.rfft2(rng.standard_normal((n, n))) * wavenumber**-1.6, (n, n))
    return depth * np.exp(0.8 * field / field.std()) * (1 + rng.uniform(0, 0.9) * np.cos(angle - rng.uniform(0, 6)))


def planet(rng, x, y, beam, extent):
    """A disc with a sharp edge, darkened towards it."""
    radius, angle, ratio = beam * rng.uniform(1, 6) * extent, rng.uniform(0, np.pi), rng.uniform(0.7, 1)
    u, v = x * np.cos(angle) + y * np.sin(angle), (y * np.cos(angle) - x * np.sin(angle)) / ratio
    r = np.hypot(u, v)
    return np.clip(radius - r + 0.5, 0, 1) * (1 - rng.uniform(0, 0.4) * r / radius)


def halo(rng, x, y, beam, extent):
    """Wide emission under thirty points."""
    n = len(x)
    image = 6 * gaussian(x, y, rng.uniform(-0.05, 0.05, 2) * n, n * rng.uniform(0.1, 0.25) * extent,
                         rng.uniform(0.5, 1), rng.uniform(0, 3))
    return image + faint_scenes.points(rng, x, y, beam, extent) * rng.uniform(0.1, 2) / 5


def spiral(rng, x, y, beam, extent):
    """A galaxy: an exponential disc with two arms, clumps and a nucleus."""
    n = len(x)
    scale, ratio, angle = n * rng.uniform(0.06, 0.12) * extent, rng.uniform(0.3, 1), rng.uniform(0, 3.1)
    u, v = x * np.cos(angle) + y * np.sin(angle), (y * np.cos(angle) - x * np.sin(angle)) / ratio
    r, turn = np.hypot(u, v) + 1, np.arctan2(v, u)
    arms = 1 + np.cos(2 * turn - rng.uniform(2, 4) * np.log(r / scale)) ** 2 * rng.uniform(1, 6)
    image = np.exp(-r / scale) * arms
    clumps = np.zeros_like(x)
    for _ in range(40):
        far, direction = scale * rng.exponential(1.5) + 1, rng.uniform(0, 6.28)
        flux, place = rng.uniform(0, 1), (far * np.cos(direction), far * np.sin(direction))
        clumps += flux * gaussian(x, y, place, beam * rng.uniform(0.2, 0.8))
    image = image / image.sum() + rng.uniform(0, 0.4) * clumps / clumps.sum()
    return image + rng.uniform(0, 0.1) * gaussian(x, y, (0, 0), 0.2 * beam + 1)


KINDS = {name: getattr(faint_scenes, name) for name in ("compact", "points", "disc", "cloud", "arcs")} | dict(
    jets=jets, shell=shell, planet=planet, halo=halo, spiral=spiral)


def sky_of(rng, n: int, beam: float, extent: float) -> tuple[list[str], np.ndarray]:
    """Draw one or two skies, of FLUX_JY together, on the fine grid."""
    names = [str(name) for name in rng.choice(list(KINDS), int(rng.choice([1, 1, 2])), replace=False)]
    x, sky = (np.arange(n) - n // 2)[:, None] * np.ones(n), np.zeros((n, n))
    for name in names:
        image = KINDS[name](rng, x, x.T, beam, extent)
        image = image / image.sum()
        if rng.uniform() < 0.4:
            image = np.roll(image, tuple(rng.integers(-n // 6, n // 6, 2)), (0, 1))
        sky += rng.uniform(0.1, 1) * image
    return names, sky * (FLUX_JY / sky.sum())


def simulate(seed: int, folder: Path, errors: bool) -> dict:
    """Write obs.ms, truth.npz and what.json unless they are there; return what the last says."""
    from casa_sara.demo.imagers import quiet
    from casa_sara.demo.predict import predict
    from casa_sara.demo.sky import ARCSEC, Sky

    if (folder / "what.json").exists():
        return json.loads((folder / "what.json").read_text())
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    rng = np.random.default_rng([9, seed])
    telescope, file, freq, declinations = TELESCOPES[rng.integers(len(TELESCOPES))]
    n, few = int(rng.choice([144, 180, 200, 243, 256, 300, 320])), file.startswith(FEW_ANTENNAS)
    scans = int(rng.choice([6, 12, 24] if few else [1, 2, 4, 8]))
    with quiet(folder / "simulation.txt"):
        uvw, rows = _laid_out(rng, folder, telescope, file, freq, declinations, scans)
    major, minor, angle = natural_beam(uvw)
    reach = np.hypot(*uvw[:2])
    cell = round(min(minor / rng.uniform(3.5, 7), 0.48 / reach.max()) / ARCSEC, 4) * ARCSEC
    beam = np.array([major / cell, minor / cell, angle])
    extent = float(np.clip(0.6 / reach.min() / cell / (0.45 * n), 0.15, 1))  # the shortest baselines see it
    kinds, fine = sky_of(rng, FINER * n, FINER * np.sqrt(beam[0] * beam[1]), extent)
    vis = predict(Sky(fine, cell / FINER), uvw)
    peak = float(np.exp(rng.uniform(np.log(6), np.log(3000))))
    noise = dirty_image(vis, uvw, cell, n).max() / peak
    rms, often = float(rng.choice([0.01, 0.03, 0.06])), rng.uniform() < 0.4
    rms = rms if errors else 0.0
    vis = vis * _gains(rng, rows, rms, often)
    write_observed(folder, rng, vis, noise)
    np.savez_compressed(folder / "truth.npz", fine=fine.astype(np.float32), img=binned(fine), cell_arcsec=cell / ARCSEC,
                        noise=noise, beam=beam, visibilities=vis.size)
    what = dict(array=file, sky=" + ".join(kinds), peak=peak, errors=rms, each="integration" if often else "scan",
                scans=scans)
    (folder / "what.json").write_text(json.dumps(what))
    return what


def _laid_out(rng, folder, telescope, file, freq, declinations, scans):
    """Write a MeasurementSet without signal; return its baselines in wavelengths, antennas and times."""
    from casatools import table

    from casa_sara.demo.simulate import SPEED_OF_LIGHT, Observation, simulate_observation
    from casa_sara.demo.sky import Sky

    minutes = round(60 * rng.uniform(*declinations))
    sign, (degrees, minutes) = "-" if minutes < 0 else "", divmod(abs(minutes), 60)
    observation = Observation(
        telescope=telescope, antenna_file=f"alma/simmos/{file}.cfg", source="target",
        direction=("16h00m00.0s", f"{sign}{degrees}d{minutes:02d}m00.0s"), freq_hz=freq, channel_hz=freq * 1e-3,
        channels=1, correlations="RR LL" if telescope == "VLA" else "XX YY",
        hour_angles=(-3, 3) if scans > 2 else (0.5, 1.0), scans=min(scans, 4) if file == "meerkat" else scans,
        integrations=5 if scans > 1 else 30, integration_s=8,
    )  # fmt: skip
    simulate_observation(folder, Sky(np.zeros((4, 4)), 1e-6), ("obs",), np.inf, observation=observation)
    tb = table()
    tb.open(str(folder / "obs.ms"))
    uvw, rows = tb.getcol("UVW"), [tb.getcol(name) for name in ("ANTENNA1", "ANTENNA2", "TIME")]
    tb.close()
    return uvw * (freq / SPEED_OF_LIGHT), rows


def _gains(rng, rows, rms, often):
    """(1 + g_p)(1 + g_q*) of every row."""
    first, second, time = rows
    times, interval = np.unique(time, return_inverse=True)
    if not often:
        interval = np.cumsum(np.r_[0, np.diff(times) > 60])[interval]
    shape = interval.max() + 1, max(first.max(), second.max()) + 1
    gains = 1 + rms * (rng.standard_normal(shape) + 1j * rng.standard_normal(shape))
    return gains[interval, first] * gains[interval, second].conj()


def imaged(folder: Path) -> tuple[dict, dict, str]:
    """Image without and with the fit of gains, unless that was done; return both results, and the errors found."""
    judge, found = Judge(folder), {}
    for name, options in (("without", {}), ("with", {"gainfit": True})):
        kept = folder / f"{name}.json"
        found[name] = json.loads(kept.read_text()) if kept.exists() else run_tsara(folder, judge, name, options)
    log = (folder / "with.txt").read_text()
    said = log.split(" to scan: ")[-1] if " to scan: " in log else log.split(" to integration: ")[-1]
    errors = said.split(" (rms)")[0].replace(" in amplitude and", ",").replace(" degrees in phase", "°")
    return found["without"], found["with"], errors if "antenna gain errors that change" in log else ""


def main() -> None:
    """Read the command line and print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--gains", choices=tuple(SEEDS), default="errors")
    parser.add_argument("--seeds", nargs=2, type=int, metavar=("FIRST", "END"))
    options = parser.parse_args()
    sys.argv = sys.argv[:1]  # CASA reads the command line, too
    print(machine())
    head = ("seed, sky, array, scans", "S/N", "gain errors", "found", "dB at half, one, two beams",
            "with the fit", "flux", "outside, %", "residual / noise", "iterations")
    print("\n| " + " | ".join(head) + " |\n" + "|---" * len(head) + "|")
    changes = []
    for seed in range(*(options.seeds or SEEDS[options.gains])):
        folder = options.folder / f"{options.gains}_{seed}"
        what = simulate(seed, folder, options.gains == "errors")
        before, after, errors = imaged(folder)
        changes.append([after[str(beams)] - before[str(beams)] for beams in BEAMS])
        pairs = [f"{before[name] * scale:.{digits}f} → {after[name] * scale:.{digits}f}" for name, scale, digits in (
            ("flux", 1, 3), ("outside", 100, 1), ("residual", 1, 2), ("iterations", 1, 0))]
        print("| " + " | ".join([
            f"{seed}, {what['sky']}, {what['array']}, {what['scans']}", f"{what['peak']:.0f}",
            f"{100 * what['errors']:.0f} % per {what['each']}" if what["errors"] else "none", errors,
            " ".join(f"{before[str(beams)]:.1f}" for beams in BEAMS),
            " ".join(f"{change:+.2f}" for change in changes[-1]), *pairs]) + " |", flush=True)
    changes = np.array(changes)
    print(f"\n{len(changes)} scenes; change of dB at half, one and two beams:\n")
    for name, values in (("mean", changes.mean(axis=0)), ("least", changes.min(axis=0)), ("most", changes.max(axis=0))):
        print(f"- {name}: " + ", ".join(f"{value:+.2f}" for value in values))


if __name__ == "__main__":
    main()
