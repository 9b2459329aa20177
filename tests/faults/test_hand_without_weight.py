"""Correlations without a weight, unflagged: the other parallel hand is used where it is enough,
and the samples are counted."""

import shutil

import numpy as np
import pytest

casatools = pytest.importorskip("casatools")

from simulated_ms import add_column, column, edit, pixels
from spoiled import GRID, observe

from casa_sara import tsara
from casa_sara.casa.ms.read import read_visibilities
from casa_sara.casa.ms.weights import sampling_density
from casa_sara.options import ImageGrid, Selection

ROWS, ALL, THIRD = 336, np.s_[:], np.s_[::3]
WHERE = {"all rows": [(1, ALL)], "every third row": [(1, THIRD)], "now this, now that": [(0, THIRD), (1, np.s_[1::3])]}
NO_WEIGHT = (0.0, -1.0, np.nan, 1e-38, 1e-5)  # or hardly any, beside 1111 and 2500


@pytest.fixture(scope="module")
def observations(tmp_path_factory):
    folder = tmp_path_factory.mktemp("ms")
    return {names: observe(folder / f"{names}.ms", correlations=names, noise=noise)
            for names, noise in {"RR LL": (0.02, 0.03), "RR RL LR LL": (0.02, 0.04, 0.05, 0.03)}.items()}


@pytest.fixture
def copy(observations, tmp_path):
    """A function that returns a copy that a test may spoil."""
    return lambda names="RR LL", name="copy.ms": shutil.copytree(observations[names], tmp_path / name)


def put(name, col, where, value):
    values = column(name, col)
    values[where] = value
    edit(name, col, lambda old: values)


def take_weight(name, places, value, data=np.nan):
    """Take the weight of hands in some rows, and spoil what they hold."""
    for hand, rows in places:
        put(name, "WEIGHT", (hand, rows), value)
        put(name, "DATA", (hand, slice(None), rows), data)


def give_halves(name, places):
    """Let both hands hold what the other one has, of half its weight: their mean is that hand, with its noise."""
    for hand, rows in places:
        for col, factor in (("WEIGHT", 0.5), ("DATA", 1)):
            values = column(name, col)
            values[0][..., rows] = values[1][..., rows] = factor * values[1 - hand][..., rows]
            edit(name, col, lambda old: values)


def read(name, stokes="I"):
    return read_visibilities(Selection((str(name),), datacolumn="data"), stokes=stokes)


@pytest.mark.parametrize("where", WHERE)
@pytest.mark.parametrize("value", NO_WEIGHT)
def test_the_other_hand_is_used_with_its_weight(copy, where, value):
    right, spoiled = copy(name="right.ms"), copy()
    give_halves(right, WHERE[where])
    take_weight(spoiled, WHERE[where], value)
    ours, other = read(spoiled), read(right)
    assert not ours.dropped and ours.size == 3 * ROWS
    np.testing.assert_array_equal(ours.vis, other.vis)
    np.testing.assert_allclose(ours.weight, other.weight, rtol=1e-6)
    np.testing.assert_allclose(ours.imaging_weight, other.imaging_weight, rtol=1e-6)
    alone = {("LL", "RR")[hand]: 3 * np.arange(ROWS)[rows].size for hand, rows in WHERE[where]}
    assert ours.alone == alone
    for name, count in alone.items():
        assert any(f"{count} samples use {name} alone, because the other correlation has no weight" in note
               for note in ours.notes)


def test_images_and_the_sum_of_weights_are_those_of_the_other_hand(copy):
    """tclean, which takes the mean of both hands for these samples, images that hand when both hold it."""
    import casatasks

    right, spoiled = copy(name="right.ms"), copy()
    give_halves(right, [(1, ALL)])
    take_weight(spoiled, [(1, ALL)], 0.0, 100.0)
    made = tsara(vis=str(spoiled), imagename="ours", niter=30, weighting="briggs", robust=0.0, **GRID)["sara"]
    for block in made["blocks"]:
        assert block["noise_measured"] == pytest.approx(1, abs=0.15)
    tsara(vis=str(right), imagename="same", niter=30, weighting="briggs", robust=0.0, **GRID)
    np.testing.assert_allclose(pixels("ours.model"), pixels("same.model"), atol=1e-5 * pixels("same.model").max())
    tsara(vis=str(spoiled), imagename="dirty", niter=0, weighting="briggs", robust=0.0, **GRID)
    casatasks.tclean(vis=str(right), imagename="theirs", niter=0, weighting="briggs", robust=0.0, **GRID)
    ours, theirs = (pixels(f"{name}.residual")[16:48, 16:48] for name in ("dirty", "theirs"))
    assert np.abs(ours - theirs).max() < 2e-3 * theirs.max()
    assert pixels("dirty.sumwt").item() == pytest.approx(pixels("theirs.sumwt").item(), rel=1e-5)


def test_each_channel_has_its_own(copy):
    name = copy()
    spectrum = np.repeat(column(name, "WEIGHT")[:, None], 3, axis=1)
    spectrum[0, 1, THIRD] = 0
    add_column(name, "WEIGHT_SPECTRUM", spectrum)
    data = read(name)
    assert not data.dropped and data.alone == {"LL": ROWS // 3} and data.size == 3 * ROWS
    of_one_hand = (data.chan == 1) & (data.rows.row[data.row] % 3 == 0)
    np.testing.assert_allclose(data.weight[of_one_hand], 1 / 0.03**2, rtol=1e-6)
    np.testing.assert_allclose(data.weight[~of_one_hand], 4 / (0.02**2 + 0.03**2), rtol=1e-6)


@pytest.mark.parametrize("value", [np.nan, -1.0])
def test_cross_hands_do_not_matter_to_stokes_i(observations, copy, value):
    name = copy("RR RL LR LL")
    take_weight(name, [(1, ALL), (2, THIRD)], value)
    ours, right = read(name), read(observations["RR RL LR LL"])
    assert not ours.dropped and not ours.alone
    for column_ in ("vis", "weight", "imaging_weight"):
        np.testing.assert_array_equal(getattr(ours, column_), getattr(right, column_))


@pytest.mark.parametrize("stokes, hand", [("V", 0), ("Q", 1), ("U", 2)])
def test_what_takes_both_is_left_out_without_one(copy, stokes, hand):
    name = copy("RR RL LR LL")
    take_weight(name, [(hand, THIRD)], -1.0)
    data = read(name, stokes)
    assert data.dropped == {"non-positive weight": ROWS} and not data.alone and data.size == 2 * ROWS


def test_imaging_weights_stand_in_for_those_of_other_correlations(copy):
    """Stokes Q of RL and LR, where RR and LL, of which the imaging weight is the mean, have none."""
    name = copy("RR RL LR LL")
    take_weight(name, [(0, ALL), (3, THIRD)], np.nan)
    data = read(name, "Q")
    assert data.size == 3 * ROWS and not data.dropped
    np.testing.assert_allclose(data.imaging_weight, 0.5 * data.weight)


def test_densities_count_the_weight_that_is_used(copy):
    name = copy()
    take_weight(name, [(1, THIRD)], -2000.0)
    selection, grid = Selection((str(name),), datacolumn="data"), ImageGrid((64, 64), (np.radians(1 / 3600),) * 2)
    data = read(name)
    np.testing.assert_array_equal(sampling_density(data, selection, grid), sampling_density(data, None, grid))


def test_a_flagged_hand_takes_the_other_along_as_in_tclean(copy):
    import casatasks

    name = str(copy())
    put(name, "FLAG", (1, slice(None), THIRD), True)
    call = dict(vis=name, niter=0, weighting="natural", **GRID)
    assert tsara(imagename="ours", **call)["sara"]["dropped"] == {"flagged": ROWS}
    casatasks.tclean(imagename="theirs", **call)
    assert pixels("ours.sumwt").item() == pytest.approx(pixels("theirs.sumwt").item(), rel=1e-5)


def test_the_hand_that_has_a_weight_must_hold_numbers(copy):
    name = copy()
    take_weight(name, [(0, THIRD)], 0.0)
    put(name, "DATA", (1, 0, 0), np.nan)
    assert read(name).dropped == {"non-finite data": 1}
