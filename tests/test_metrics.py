"""The metrics against numbers worked out by hand, and the picture that is drawn from them."""

import numpy as np
import pytest

from casa_sara.analysis import metrics
from casa_sara.analysis.plots import Column, Zoom, compare


def test_snr_by_hand():
    assert metrics.snr([3.0, 4.0], [3.0, 4.5]) == pytest.approx(20.0)  # 5 against 0.5
    assert metrics.snr([[1.0, 0.0]], [[0.0, 0.0]]) == 0.0
    assert metrics.snr([1.0, 2.0], [1.0, 2.0]) == np.inf


def test_log_snr_by_hand():
    # D = 9, peak 2: log10(1 + 9 x/2) of 2 and 0 is 1 and 0; of 4/9 it is log10(3)
    assert metrics.log_snr([2.0, 0.0], [2.0, 4 / 9], 9.0) == pytest.approx(-20 * np.log10(np.log10(3)))
    assert metrics.log_snr([2.0, 0.0], [2.0, -1.0], 9.0) == np.inf  # negative values count as zero


def test_different_shapes_are_refused():
    with pytest.raises(ValueError, match=r"truth has shape \(2, 2\) and model \(4,\)"):
        metrics.snr(np.ones((2, 2)), np.ones(4))


@pytest.mark.parametrize("angle", (0.0, 35.0, 90.0))
def test_smoothing_a_point_draws_the_beam(angle):
    point = np.zeros((64, 51))
    point[30, 25] = 2.0
    smoothed = metrics.smooth(point, (9.0, 5.0), angle)
    north, east = np.arange(51)[None, :] - 25, 30 - np.arange(64)[:, None]
    turn = np.deg2rad(angle)
    along, across = north * np.cos(turn) + east * np.sin(turn), east * np.cos(turn) - north * np.sin(turn)
    beam = np.exp(-4 * np.log(2) * ((along / 9) ** 2 + (across / 5) ** 2)) * 4 * np.log(2) / (np.pi * 45)
    np.testing.assert_allclose(smoothed, 2 * beam, atol=1e-6)


def test_smoothing_does_not_wrap_around():
    edge = np.zeros((40, 40))
    edge[0, 20] = 1.0
    smoothed = metrics.smooth(edge, 6.0)
    assert np.abs(smoothed[20:]).max() < 1e-7
    assert smoothed.sum() == pytest.approx(0.5, abs=0.15)  # about half of it falls off the edge


def test_dynamic_range_by_hand():
    assert metrics.dynamic_range([1.0, 8.0, np.nan], [2.0, -2.0, np.nan]) == pytest.approx(4.0)


def test_compare_draws_a_picture(tmp_path):
    rng = np.random.default_rng(0)
    sky = np.exp(-np.hypot(*np.mgrid[-32:32, -16:16]) / 4)
    noise = 1e-3 * rng.standard_normal(sky.shape)
    beam = (2.0, 1.5, 30.0)
    columns = [Column("truth", sky, sky, None, beam, "truth", "a note"), Column("image", sky, sky + noise, noise, beam)]
    compare(tmp_path / "picture.png", columns, 0.5, [Zoom("centre", 0, 0, 6.0)], title="test")
    assert (tmp_path / "picture.png").stat().st_size > 10_000
