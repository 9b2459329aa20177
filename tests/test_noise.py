"""Noise from differences: what was put in is found, whatever the weights say and the sky does."""

import numpy as np
import pytest
from test_visibilities import observation

from casa_sara.data.noise import noise_from_differences

ONE_SCAN = [(0, 0, 1, 0, 120)]


def noisy(scans, true_over_weight=1.0, channels=2, seed=0):
    """Fill an observation with noise `true_over_weight` times what its weights predict."""
    vis = observation(scans, channels=channels, seed=seed)
    rng = np.random.default_rng(seed + 1)
    vis.weight[:] = rng.uniform(0.5, 20, vis.size)
    noise = rng.standard_normal((2, vis.size)) * true_over_weight / np.sqrt(vis.weight)
    vis.vis[:] = noise[0] + 1j * noise[1]
    return vis


def whole(vis):
    return np.array([0, vis.size])


@pytest.mark.parametrize("factor", [0.5, 1.0, 2.0])
def test_noise_relative_to_the_weights(factor):
    vis = noisy(ONE_SCAN, factor)
    np.testing.assert_allclose(noise_from_differences(vis, whole(vis)), factor, rtol=0.04)


def test_each_block_for_itself():
    vis = noisy(ONE_SCAN, 1.0, channels=8)
    order = np.argsort(vis.rows.time[vis.row], kind="stable")
    for name in ("vis", "weight", "row", "chan"):
        setattr(vis, name, getattr(vis, name)[order])
    offsets = np.array([0, vis.size // 3, vis.size])
    vis.vis[offsets[1] :] *= 3
    np.testing.assert_allclose(noise_from_differences(vis, offsets), [1, 3], rtol=0.06)


def test_slowly_varying_structure_hardly_biases():
    """A source of 1000 σ whose fringe turns by 0.1 rad per integration."""
    vis = noisy(ONE_SCAN)
    rows = vis.rows
    turn = 0.1 * rows.time[vis.row] / 10.0 * np.cos(rows.antenna2[vis.row])
    vis.weight[:] = 1.0
    rng = np.random.default_rng(5)
    noise = rng.standard_normal(vis.size) + 1j * rng.standard_normal(vis.size)
    vis.vis[:] = 30 * (1 + 0.2 * vis.chan) * np.exp(1j * turn) + noise
    np.testing.assert_allclose(noise_from_differences(vis, whole(vis)), 1.0, rtol=0.06)


def test_outliers_hardly_matter():
    vis = noisy(ONE_SCAN)
    vis.vis[np.random.default_rng(6).random(vis.size) < 0.02] += 1e4
    np.testing.assert_allclose(noise_from_differences(vis, whole(vis)), 1.0, rtol=0.1)


def test_no_differences_across_gaps():
    vis = noisy([(0, 0, scan, 500 * scan, 4) for scan in range(40)])
    vis.vis += 500 * vis.rows.scan[vis.row].astype(np.complex64) ** 2
    np.testing.assert_allclose(noise_from_differences(vis, whole(vis)), 1.0, rtol=0.06)


def test_baselines_fields_windows_and_channels_are_not_mixed():
    """Ten series at a time differ in baseline, field or spectral window, each at a level of its own."""
    vis = noisy(ONE_SCAN)
    rows = vis.rows
    number = rows.antenna2.copy()
    rows.antenna2, rows.field, rows.spw = 1 + number % 2, number // 2 % 2, number // 4
    vis.vis += (1000.0 * vis.chan + 1e4 * number[vis.row] ** 2).astype(np.complex64)
    np.testing.assert_allclose(noise_from_differences(vis, whole(vis)), 1.0, rtol=0.06)


def test_no_differences_between_fields():
    vis = noisy(ONE_SCAN)
    vis.rows.field = (vis.rows.time // 40).astype(int) % 2
    vis.vis += (1000.0 * vis.rows.field[vis.row]).astype(np.complex64)
    np.testing.assert_allclose(noise_from_differences(vis, whole(vis)), 1.0, rtol=0.06)


def test_two_integrations_take_first_differences():
    vis = noisy([(0, 0, 1, 0, 2)], 2.0, channels=400)
    np.testing.assert_allclose(noise_from_differences(vis, whole(vis)), 2.0, rtol=0.04)


def test_nan_where_it_cannot_be_measured():
    single = noisy([(0, 0, 1, 0, 1)])
    assert np.isnan(noise_from_differences(single, whole(single)))
    few = noisy([(0, 0, 1, 0, 2)], channels=1)  # ten differences
    assert np.isnan(noise_from_differences(few, whole(few)))


def test_rows_that_are_hardly_weighed_do_not_hide_the_noise_of_the_others():
    """The bound of a block needs the rms of its whitened samples: of 40 % with the noise that was put in,
    and of 60 % of nothing."""
    vis = noisy(ONE_SCAN, 2.0, channels=8)
    light = np.random.default_rng(7).random(vis.rows.row.size)[vis.row] < 0.6
    vis.weight[light] *= 1e-8
    found, rms = noise_from_differences(vis, whole(vis)), np.sqrt(np.mean(~light)) * 2
    np.testing.assert_allclose(found, rms, rtol=0.1)
