"""A simulated mosaic: each pointing sees the sky through the primary beam of its dishes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.special import j1

from casa_sara.demo.simulate import SPEED_OF_LIGHT, Observation, simulate_observation
from casa_sara.demo.sky import Sky

__all__ = ["ACA", "observe_mosaic", "primary_beam"]

ACA = Observation(telescope="ALMA", antenna_file="alma/simmos/aca.{}.cfg", source="cloud",
                  direction=("150.0deg", "-30.0deg"), freq_hz=1e11, channel_hz=1e8, channels=1, correlations="XX YY",
                  hour_angles=(-1.5, 1.5), scans=3, integrations=2, integration_s=30.0)
EFFECTIVE, BLOCKAGE = 6.25, 0.75  # m, of dishes of 7 m
FIRST_NULL = 3.8  # of the pattern, nearly


def primary_beam(sky: Sky, freq_hz: float) -> np.ndarray:
    """Return the primary beam of the ACA's dishes around the centre of a sky, to its first null.

    Parameters
    ----------
    sky : Sky
        Whose pixels are looked at.
    freq_hz : float
        Frequency.

    Returns
    -------
    float64 (nx, ny)
    """
    x, y = ((np.arange(n) - n // 2) * sky.cell_rad for n in sky.image.shape)
    place = np.maximum(np.pi * EFFECTIVE * freq_hz / SPEED_OF_LIGHT * np.hypot(x[:, None], y[None, :]), 1e-6)
    hole = BLOCKAGE / EFFECTIVE
    voltage = (2 * j1(place) / place - hole**2 * 2 * j1(hole * place) / (hole * place)) / (1 - hole**2)
    return np.where((place < FIRST_NULL) & (voltage > 0), voltage, 0) ** 2


def observe_mosaic(folder: str | Path, sky: Sky, pointings: Sequence[tuple[int, int]], config: str = "cycle8",
                   noise_db: float = 30.0, seed: int = 0, observation: Observation = ACA) -> list[str]:
    """Observe a sky with the ACA, and write one MeasurementSet for each pointing.

    Parameters
    ----------
    folder : str or Path
        Existing folder.
    sky : Sky
        Around the direction of the observation; its edges are empty.
    pointings : sequence of (int, int)
        Pixels of the sky to the west and north of its centre.
    config : str
        Of the ACA.
    noise_db : float
        Input SNR of each pointing, 20 log10(‖V‖/‖n‖).
    seed : int
        Of the noise.
    observation : Observation
        Source, frequency and times.

    Returns
    -------
    list of str
    """
    right, declination = (np.radians(float(text.removesuffix("deg"))) for text in observation.direction)
    beam, names = primary_beam(sky, observation.freq_hz), []
    for number, (west, north) in enumerate(pointings):
        l, m = -west * sky.cell_rad, north * sky.cell_rad
        n = np.sqrt(1 - l**2 - m**2)
        there = right + np.arctan2(l, n * np.cos(declination) - m * np.sin(declination))
        up = np.arcsin(m * np.cos(declination) + n * np.sin(declination))
        direction = tuple(f"{float(np.degrees(angle))!r}deg" for angle in (there, up))
        seen = replace(sky, image=np.roll(sky.image, (-west, -north), (0, 1)) * beam)
        place = Path(folder) / f"pointing{number}"
        place.mkdir()
        made = simulate_observation(place, seen, [config], noise_db, 0.0, seed + number,
                                    replace(observation, direction=direction))
        names += made.vis
    return names
