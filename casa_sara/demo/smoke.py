"""A smoke test of a few seconds: simulate, image with tsara, check the products."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from casa_sara import tsara
from casa_sara.analysis.metrics import snr
from casa_sara.demo.imagers import Case, quiet, read_image
from casa_sara.demo.simulate import Observation, simulate_observation
from casa_sara.demo.sky import ARCSEC, Sky

__all__ = ["run"]

PRODUCTS = ("model", "psf", "residual", "image", "sumwt", "pb")
OBSERVATION = Observation(scans=2, integrations=2, channels=1, integration_s=30.0)
SIZE, CELL_ARCSEC = 64, 0.2


def run(folder: Path) -> None:
    """Image 64² pixels of a simulated VLA B configuration.

    Raises
    ------
    RuntimeError
        If a product is missing, or the model is not better than the dirty image.
    """
    with quiet(folder / "simulation.txt"):
        simulation = simulate_observation(folder, _sky(), "B", noise_db=30.0, seed=1, observation=OBSERVATION)
    case = Case(folder, simulation.vis, [SIZE, SIZE], CELL_ARCSEC)
    tsara(**case.common("dirty"), niter=0)
    tsara(**case.common("tsara"))
    missing = [product for product in PRODUCTS if not (folder / f"tsara.{product}").is_dir()]
    if missing:
        raise RuntimeError(f"tsara did not write {missing}")
    truth = simulation.truth
    dirty = read_image(folder / "dirty.residual")[0]
    dirty *= np.sum(dirty * truth) / np.sum(dirty**2)  # Jy/beam to Jy/pixel as well as it can be
    model_db, dirty_db = snr(truth, read_image(folder / "tsara.model")[0]), snr(truth, dirty)
    print(f"SNR of the model {model_db:.1f} dB, of the dirty image {dirty_db:.1f} dB")
    if not model_db > dirty_db + 3:
        raise RuntimeError(f"the model has an SNR of {model_db:.1f} dB, the dirty image {dirty_db:.1f} dB")


def _sky() -> Sky:
    """Return an elliptical blob of 1 Jy and a compact source of 0.2 Jy."""
    x, y = np.meshgrid(*[np.arange(SIZE) - SIZE // 2] * 2, indexing="ij")
    blob = np.exp(-(((x - 5) / 6) ** 2) - ((y + 3) / 4) ** 2)
    compact = np.exp(-((x + 14) ** 2 + (y - 9) ** 2) / 2)
    return Sky(blob / blob.sum() + 0.2 * compact / compact.sum(), CELL_ARCSEC * ARCSEC)
