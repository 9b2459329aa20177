"""Unresolved sources between pixels: found by the residual they leave, and held once the bounds give way."""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.optimize import lsq_linear

from casa_sara.operators.measurement import MeasurementOperator
from casa_sara.parallel.serial import SERIAL
from casa_sara.solver.planes import Planes
from casa_sara.solver.positivity import Release

SHAPE = (24, 20)
SAMPLES = 1500
NOISE = 0.02


def _case(offset, flux=1.0, seed=0):
    """One source `offset` pixels from pixel (12, 10), and the positive image that fits it best."""
    rng = np.random.default_rng(seed)
    uv = rng.uniform(-0.29, 0.29, (2, SAMPLES))  # cycles per pixel of 1 rad
    operator = MeasurementOperator(uv, 1.0, SHAPE, dtype=np.float64, eps=1e-10)
    source = flux * np.exp(-2j * np.pi * uv[0] * offset)
    vis = source + NOISE * (rng.standard_normal(SAMPLES) + 1j * rng.standard_normal(SAMPLES))
    vis /= NOISE
    unit = np.eye(SHAPE[0] * SHAPE[1]).reshape(-1, *SHAPE)
    matrix = np.array([operator.forward(image) for image in unit]).T / NOISE
    matrix, data = np.vstack([matrix.real, matrix.imag]), np.concatenate([vis.real, vis.imag])
    model = lsq_linear(matrix, data, (0, np.inf)).x.reshape(SHAPE)
    model[model < 1e-6] = 0  # an interior-point solution only comes near its bounds
    scaled = MeasurementOperator(uv, 1.0, SHAPE, np.full(SAMPLES, 1 / NOISE), dtype=np.float64, eps=1e-10)
    ppd = SimpleNamespace(sky_over_image=None, planes=Planes(), measurement=scaled, precond=np.ones(SAMPLES), vis=vis,
                          offsets=np.array([0, 600, SAMPLES]), model=model, lowest=np.zeros(SHAPE),
                          adjoint=scaled.adjoint, comm=SERIAL,
                          scratch_image=np.empty(SHAPE), scratch_vis=np.empty(SAMPLES, complex))
    return ppd, SimpleNamespace(noise_weights=np.ones(2)), matrix, data


def test_a_source_between_pixels_is_found_and_held():
    ppd, bounds, matrix, data = _case(0.5)
    chi_square = np.mean((data - matrix @ ppd.model.ravel()) ** 2)
    assert chi_square > 5  # what positive pixels cannot hold
    release = Release()
    assert release.update(ppd, bounds) == 0  # once is not enough
    released = release.update(ppd, bounds)
    assert released == np.count_nonzero(ppd.lowest < 0) > 0
    near = np.hypot(*(np.indices(SHAPE) - np.array([12.0, 10.0])[:, None, None])) < 8
    assert np.all(ppd.lowest >= -0.25 * ppd.model.max() * (1 + 1e-12))
    assert np.all(ppd.lowest[~near] > -0.01)  # in proportion to what is there
    held = lsq_linear(matrix, data, (ppd.lowest.ravel() - 1e-12, np.inf)).x
    assert np.mean((data - matrix @ held) ** 2) < 0.1 * chi_square
    assert release.update(ppd, bounds) == 0  # released once, counted once


@pytest.mark.parametrize("offset, flux", [(0.0, 1.0), (0.5, 0.0), (0.5, 0.02)])
def test_nothing_is_released_where_positive_pixels_hold_the_data(offset, flux):
    """A source on a pixel, noise alone, and a source too faint to tell."""
    ppd, bounds, _, _ = _case(offset, flux)
    release = Release()
    assert release.update(ppd, bounds) == release.update(ppd, bounds) == 0
    assert not np.any(ppd.lowest)


@pytest.mark.parametrize("beside, asks", [(0.001, False), (3.95, False), (4.05, True)])
def test_a_source_nearby_explains_it(beside, asks):
    """A negative source of 1, three pixels from one whose lobes of a quarter are too faint for it,
    or just bright enough."""
    ppd, bounds, *_ = _case(0.0, -1.0)
    ppd.model[...] = 0
    ppd.model[12, 13] = beside
    ppd.vis = ppd.vis + ppd.measurement.forward(ppd.model)  # the residual is that of the negative source alone
    release = Release()
    assert release.update(ppd, bounds) == 0
    assert bool(release.state()["asked"][12, 10] < 0) == asks
    released = release.update(ppd, bounds)
    assert bool(ppd.lowest[12, 10] < 0) or not asks
    assert released == 0 or beside > 0.01


def test_what_fades_is_not_released_until_it_stays():
    ppd, bounds, *_ = _case(0.5)
    predicted = ppd.measurement.forward(ppd.model)
    residual, release = ppd.vis - predicted, Release()
    counts = []
    for size in (1.0, 0.4, 0.16, 0.1):
        ppd.vis = predicted + size * residual
        counts.append(release.update(ppd, bounds))
    assert counts[:3] == [0, 0, 0] and counts[3] > 0


def test_without_positivity_nothing_changes():
    ppd, bounds, _, _ = _case(0.5)
    ppd.lowest[...] = -np.inf
    release = Release()
    assert release.update(ppd, bounds) == release.update(ppd, bounds) == 0 and np.all(ppd.lowest == -np.inf)
