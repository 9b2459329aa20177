"""A simulated observation of 10⁴ to 10⁸ visibilities, written in bulk.

    python benchmarks/large_ms.py FOLDER [--visibilities 1e8]
    python benchmarks/large_ms.py FOLDER --visibilities 1e6 --compare   # image it: tsara, wsclean and tclean, 1024²
    python benchmarks/large_ms.py FOLDER --visibilities 1e7 --compare --without tclean

The VLA observes the sources and the extended emission of `scaling.py` in four configurations, three scans of 25 min
each, in a band of 0.5 GHz around 8.4 GHz: 12 blocks. More visibilities are shorter integrations and narrower channels
of the same. There is no w-term. 10⁸ take about a minute, and 2 GB of disk.

Compared are 1024² pixels with one thread each, Briggs −1 weights, defaults of tsara, multiscale with four scales up to
5 beams down to twice the noise in tclean, and down to once the noise, without and with a mask, in wsclean where it is
installed. Time is that of the call; SNR that of the model, smoothed to a half and to one beam.
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

os.environ.setdefault("OMP_NUM_THREADS", "1")
sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
sys.path.insert(0, str(Path(__file__).resolve().parent))

from casatools import table
from scenes import VLA, scene_sky, smoothed_truth

from casa_sara.demo.simulate import SPEED_OF_LIGHT, _lay_out
from casa_sara.operators.measurement import MeasurementOperator

FINER = 4  # pixels of the sky in one of the image
BAND_HZ, SCAN_S, BASELINES, SCANS = 512e6, 1500.0, 351, 12
ROWS = 20_000  # written at a time


def observation_of(visibilities):
    """Return the `Observation` of that many."""
    channels = next(count for most, count in ((3e4, 1), (3e5, 4), (3e7, 16), (np.inf, 64)) if visibilities < most)
    integrations = round(visibilities / (SCANS * BASELINES * channels))
    return replace(VLA, channels=channels, channel_hz=BAND_HZ / channels, integrations=integrations,
                   integration_s=SCAN_S / integrations)


def sky_of(cell_arcsec):
    """Return the sky, its points on its own pixels."""
    sky = scene_sky("points off pixels", cell_arcsec, oversampling=FINER)
    for l, m, flux in sky.points:
        nx, ny = sky.image.shape
        sky.image[nx // 2 - round(l / sky.cell_rad), ny // 2 + round(m / sky.cell_rad)] += flux
    return replace(sky, points=sky.points[:0])


def compare(folder, cell_arcsec, without, size=1024):
    """Image the MeasurementSets of a folder with all imagers but those left out, and print time and SNR."""
    from astropy.io import fits
    from casatasks import tclean

    from casa_sara import tsara
    from casa_sara.analysis.metrics import smooth, snr
    from casa_sara.demo.imagers import quiet, read_image

    vis, cell = [str(folder / f"{config}.ms") for config in "ABCD"], f"{cell_arcsec}arcsec"
    common = dict(vis=vis, imsize=size, cell=cell, datacolumn="data", weighting="briggs", robust=-1.0)
    sky, found = sky_of(cell_arcsec), {}
    with quiet(folder / "log.txt"):
        begin = time.perf_counter()
        tsara(**common, imagename=str(folder / "tsara"), overwrite=True, nthreads=1)
        found["tsara"] = time.perf_counter() - begin, read_image(folder / "tsara.model")[0]
        if "tclean" not in without:
            begin = time.perf_counter()
            tclean(**common, imagename=str(folder / "tclean"), deconvolver="multiscale", niter=20_000, gain=0.2,
                   nsigma=2.0, scales=[0, 2, 5, 14])
            found["tclean"] = time.perf_counter() - begin, read_image(folder / "tclean.model")[0]
    runs = ("", ()), (", mask at 5 σ", ("-auto-mask", "5"))
    for label, more in runs if "wsclean" not in without and shutil.which("wsclean") else ():
        root = folder / f"wsclean{len(more)}"
        command = ["wsclean", "-j", "1", "-size", str(size), str(size), "-scale", f"{cell_arcsec}asec", "-weight",
                   "briggs", "-1", "-multiscale", "-niter", "1000000", "-mgain", "0.8", "-auto-threshold", "1", *more,
                   "-data-column", "DATA", "-no-update-model-required", "-pol", "I", "-name", str(root), *vis]
        begin = time.perf_counter()
        with open(folder / "wsclean.txt", "w", encoding="utf-8") as log:
            subprocess.run(command, check=True, stdout=log, stderr=log)
        found[f"wsclean{label}"] = time.perf_counter() - begin, fits.getdata(f"{root}-model.fits").squeeze().T
    beam = read_image(folder / "tsara.image")[1]
    margin = (size - sky.image.shape[0] // FINER) // 2
    print("| imager | s | of tsara's time | SNR at half a beam, dB | at one beam |\n|---|---|---|---|---|")
    for name, (seconds, model) in found.items():
        scores = []
        for factor in (0.5, 1.0):
            fwhm = [factor * axis / cell_arcsec for axis in beam[:2]]
            scores.append(snr(np.pad(smoothed_truth(sky, fwhm, beam[2]), margin), smooth(model, fwhm, beam[2])))
        print(f"| {name} | {seconds:.0f} | {seconds / found['tsara'][0]:.1f} | {scores[0]:.1f} | {scores[1]:.1f} |")


def observe(folder, visibilities, cell_arcsec, noise_jy=0.5, seed=1):
    """Write the MeasurementSets into a new folder."""
    sky, observation = sky_of(cell_arcsec), observation_of(visibilities)
    folder.mkdir(parents=True)
    names, rng = [], np.random.default_rng(seed)
    for number, config in enumerate("ABCD"):
        names.append(str(folder / f"{config}.ms"))
        _lay_out(Path(names[-1]), config, ((number + 0.5) / 4 + np.arange(3)) / 3, observation)
        _fill(names[-1], sky, observation, noise_jy, rng)
    return names


def _fill(name, sky, observation, noise_jy, rng):
    """Write visibilities with noise, and weights that agree with it."""
    tb, inverse_wavelength = table(), observation.channel_freqs_hz / SPEED_OF_LIGHT
    tb.open(name, nomodify=False)
    tb.removecols(["MODEL_DATA", "CORRECTED_DATA"])
    for first in range(0, tb.nrows(), ROWS):
        rows = min(ROWS, tb.nrows() - first)
        uv = (tb.getcol("UVW", first, rows)[:2, None, :] * inverse_wavelength[:, None]).reshape(2, -1)
        signal = MeasurementOperator(uv, sky.cell_rad, sky.image.shape).forward(sky.image.astype(np.float32))
        shape = 2, inverse_wavelength.size, rows
        noise = rng.standard_normal((*shape, 2), np.float32).view(np.complex64)[..., 0]
        tb.putcol("DATA", signal.reshape(shape[1:]) + np.float32(noise_jy) * noise, first, rows)
        for column, value in (("SIGMA", noise_jy), ("WEIGHT", noise_jy**-2)):
            tb.putcol(column, np.full((2, rows), value), first, rows)
    tb.close()


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--visibilities", type=float, default=1e8)
    parser.add_argument("--compare", action="store_true")
    parser.add_argument("--without", nargs="+", choices=("tclean", "wsclean"), default=[])
    options = parser.parse_args()
    sys.argv = sys.argv[:1]  # CASA reads the command line, too
    if shutil.disk_usage(options.folder.resolve().parent).free < 60 * options.visibilities:
        parser.error(f"{options.folder}: {60 * options.visibilities:.2g} bytes of disk are needed")
    if not (options.compare and options.folder.exists()):
        observe(options.folder.resolve(), options.visibilities, 0.06)
    if options.compare:
        compare(options.folder.resolve(), 0.06, options.without)
