"""Simulated observations for studies: the skies of ../shared/data and the demo's, as MeasurementSets of known truth.

    simulation = observe("M31", folder, noise_db=30, gain_rms=0.01, seed=3)
    simulation = observe("cyga", folder, configs="A")
    simulation = observe("W28", folder, configs=ALMA_CONFIGS, observation=ALMA)
    simulation = observe("3c353", folder, observation=replace(VLA, weight_scale=(0.5, 0.5, 2, 2)))

`simulation.vis`, `.truth`, `.cell_arcsec` and `.blocks` (true noise and error norms of every snapshot) are all a
study needs.
"""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
from astropy.io import fits

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from casa_sara.demo.simulate import Observation, Simulation, simulate_observation
from casa_sara.demo.sky import ARCSEC, Sky, cyg_a_like

__all__ = ["SKIES", "VLA", "ALMA", "ALMA_CONFIGS", "reference_sky", "observe", "replace"]

DATA = Path(__file__).resolve().parents[2] / "shared/data/skies"
FLUX_JY = 10.0

# file and background to subtract
SKIES = {
    "M31": ("M31_256.fits", 0.0),
    "W28": ("W28_256.fits", 0.0),
    "30dor": ("30dor_256.fits", 2.6),
    "3c353": ("3c353_512.fits", 0.0),
    "3c295": ("3c295_512.fits", 0.0),
    "3c196": ("3c196_512.fits", 0.0),
}

VLA = Observation()
ALMA_CONFIGS = ("alma.cycle8.3", "alma.cycle8.6")
ALMA = Observation(
    telescope="ALMA", antenna_file="alma/simmos/{}.cfg", source="target", direction=("15h00m00.0s", "-30d00m00.0s"),
    freq_hz=230e9, channel_hz=500e6, correlations="XX YY", hour_angles=(-2.0, 2.0), integrations=2, integration_s=30.0,
)  # fmt: skip


def reference_sky(name: str, cell_arcsec: float = 0.06, flux_jy: float = FLUX_JY) -> Sky:
    """Return a reference sky on its own pixels, scaled to a total flux; 'cyga' is the demo's."""
    if name == "cyga":
        return cyg_a_like(cell_arcsec=cell_arcsec)
    file, background = SKIES[name]
    image = np.clip(fits.getdata(DATA / file).squeeze().T.astype(float) - background, 0, None)
    return Sky(image * (flux_jy / image.sum()), cell_arcsec * ARCSEC)


def observe(
    name: str, folder: str | Path, configs="ABCD", noise_db=35.0, gain_rms=0.0, seed=0, observation: Observation = VLA
) -> Simulation:
    """Simulate an observation of a sky into a new or empty folder."""
    Path(folder).mkdir(parents=True, exist_ok=True)
    return simulate_observation(folder, reference_sky(name), configs, noise_db, gain_rms, seed, observation)
