"""A simulated observation of 10⁴ to 10⁸ visibilities, written in bulk.

    python benchmarks/large_ms.py FOLDER [--visibilities 1e8]

The VLA observes the sources and the extended emission of `scaling.py` in four configurations, three scans of 25 min
each, in a band of 0.5 GHz around 8.4 GHz: 12 blocks. More visibilities are shorter integrations and narrower channels
of the same. There is no w-term. 10⁸ take about a minute, and 2 GB of disk.
"""

from __future__ import annotations

import argparse
import shutil
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
sys.path.insert(0, str(Path(__file__).resolve().parent))

from casatools import table
from scenes import VLA, scene_sky

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


def observe(folder, visibilities, cell_arcsec, noise_jy=0.5, seed=1):
    """Write the MeasurementSets into a new folder."""
    sky, observation = scene_sky("points off pixels", cell_arcsec, oversampling=FINER), observation_of(visibilities)
    for l, m, flux in sky.points:
        nx, ny = sky.image.shape
        sky.image[nx // 2 - round(l / sky.cell_rad), ny // 2 + round(m / sky.cell_rad)] += flux
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
    options = parser.parse_args()
    sys.argv = sys.argv[:1]  # CASA reads the command line, too
    if shutil.disk_usage(options.folder.resolve().parent).free < 60 * options.visibilities:
        parser.error(f"{options.folder}: {60 * options.visibilities:.2g} bytes of disk are needed")
    observe(options.folder, options.visibilities, 0.06)
