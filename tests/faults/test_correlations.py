"""Correlations of every kind that hold the Stokes parameter asked for, in any order:
tclean's images and model column."""

import shutil

import numpy as np
import pytest

casatools = pytest.importorskip("casatools")

from simulated_ms import column, edit, pixels
from spoiled import GRID, observe

from casa_sara import saracompare, tsara
from casa_sara.casa.ms.read import read_visibilities
from casa_sara.options import Selection

CODES = {name: code for code, name in enumerate("I Q U V RR RL LR LL XX XY YX YY".split(), 1)}
HELD = {  # correlations: where those stand that Stokes I is the mean of
    "I": [0], "I V": [0], "V U Q I": [3], "RR RL": [0], "LR LL": [1], "YY": [0], "XY XX": [1], "RR LL RL LR": [0, 1],
    "LR RL RR LL": [2, 3],
}
ORDINARY = {1: "RR", 2: "RR LL", 4: "RR RL LR LL"}
SHARES = dict(I=(0.5, 0, 0, 0.5), Q=(0, 0.5, 0.5, 0), U=(0, -0.5j, 0.5j, 0), V=(0.5, 0, 0, -0.5))  # of RR, RL, LR, LL


@pytest.fixture(scope="module")
def sky(tmp_path_factory):
    """The visibilities of Stokes I without noise, (channel, row)."""
    return column(observe(tmp_path_factory.mktemp("ms") / "sky.ms", noise=0.0, correlations="RR"), "DATA")[0]


@pytest.fixture(scope="module")
def observations(sky, tmp_path_factory):
    """MeasurementSets of one, two and four correlations, all of which see the sky, with noise of their own."""
    folder, made = tmp_path_factory.mktemp("ms"), {}
    for count, names in ORDINARY.items():
        made[count] = observe(folder / f"{count}.ms", correlations=names, noise=0.02 * np.arange(1, count + 1))
        cross = np.array([name in ("RL", "LR") for name in names.split()])[:, None, None]
        edit(made[count], "DATA", lambda data: data + cross * sky)
    return made


@pytest.fixture
def holding(observations, tmp_path):
    """A function that returns a MeasurementSet of these correlations."""

    def make(correlations, name="a.ms"):
        names = correlations.split()
        made = shutil.copytree(observations[len(names)], tmp_path / name, dirs_exist_ok=True)
        edit(f"{made}/POLARIZATION", "CORR_TYPE", lambda old: np.array([CODES[one] for one in names])[:, None])
        return str(made)

    return make


def assert_as_tclean(vis, **changes):
    """Raise unless the dirty image and the sum of the weights are tclean's."""
    import casatasks

    call = dict(vis=vis, niter=0, weighting="briggs", robust=0.0) | GRID | changes
    tsara(imagename="ours", **call)
    casatasks.tclean(imagename="theirs", **call)
    ours, theirs = (pixels(f"{name}.residual")[16:48, 16:48] for name in ("ours", "theirs"))
    assert np.abs(ours - theirs).max() < 2e-3 * np.abs(theirs).max() > 0
    assert pixels("ours.sumwt").item() == pytest.approx(pixels("theirs.sumwt").item(), rel=1e-5)


@pytest.mark.parametrize("correlations", HELD)
def test_stokes_i_is_imaged_as_tclean_images_it(holding, correlations):
    name = holding(correlations)
    edit(name, "DATA", lambda data: data * np.arange(2, len(data) + 2)[:, None, None])  # which of them are used shows
    assert_as_tclean(name)


def test_sets_of_different_correlations_add_up(holding):
    assert_as_tclean([holding(names, f"{k}.ms") for k, names in enumerate(("I V", "LL LR", "RR RL LR LL", "YY"))])


@pytest.mark.parametrize("correlations", ["V U Q I", "LR LL"])
def test_the_model_column_holds_what_each_correlation_sees(holding, correlations):
    """Where tclean writes its model of Stokes I, and 0 where it writes 0."""
    import casatasks

    name = holding(correlations)
    casatasks.tclean(vis=name, imagename="theirs", niter=3, savemodel="modelcolumn", **GRID)
    theirs = column(name, "MODEL_DATA").any(axis=(1, 2))
    tsara(vis=name, imagename="ours", niter=3, savemodel="modelcolumn", **GRID)
    ours = column(name, "MODEL_DATA")
    assert np.array_equal(ours.any(axis=(1, 2)), theirs) and theirs.any() and not theirs.all()
    assert np.array_equal(ours[theirs], np.broadcast_to(ours[theirs][:1], ours[theirs].shape))


@pytest.mark.parametrize("correlations, hands", HELD.items())
def test_weights_are_the_inverse_variance(holding, sky, correlations, hands):
    """Whitened noise, what differs from the sources, has unit variance."""
    data = read_visibilities(Selection((holding(correlations),), datacolumn="data"))
    noise = np.sqrt(data.weight) * (data.vis - sky[data.chan, data.rows.row[data.row]])
    assert data.size == sky.size and np.var([noise.real, noise.imag]) == pytest.approx(1, abs=4 / np.sqrt(data.size))
    variance = np.mean([(0.02 * (1 + hand)) ** 2 for hand in hands]) / len(hands)
    np.testing.assert_allclose(data.weight, 1 / variance, rtol=1e-5)


@pytest.mark.parametrize("order", ["I Q U V", "V U Q I"])
@pytest.mark.parametrize("stokes", "IQUV")
def test_a_stored_stokes_parameter_is_taken_as_it_stands(holding, order, stokes):
    """tclean's image of a stored Q, U or V is empty; the right one is that of the RR, RL,
    LR and LL that they are made of."""
    formed, stored = holding("RR RL LR LL", "formed.ms"), holding(order, "stored.ms")
    edit(stored, "DATA", lambda data: np.einsum("sc,cfr->sfr", [SHARES[name] for name in order.split()], data))
    ours, right = (read_visibilities(Selection((name,), datacolumn="data"), stokes=stokes) for name in (stored, formed))
    np.testing.assert_allclose(ours.vis, right.vis, atol=1e-6)
    weight = column(stored, "WEIGHT")[order.split().index(stokes)]
    np.testing.assert_allclose(ours.weight, weight[ours.rows.row[ours.row]], rtol=1e-6)


def test_cubes_and_their_noise_take_them_too(holding):
    made = tsara(vis=holding("V I"), imagename="cube", specmode="cube", niter=3, **GRID)["sara"]
    assert made["visibilities"] == sum(channel["visibilities"] for channel in made["channels"]) == 1008
    for channel in made["channels"]:
        for block in channel["blocks"]:
            assert block["noise_measured"] == pytest.approx(1, abs=0.3)


def test_rehearsals_and_comparisons_take_them_too(holding):
    name = holding("V U Q I")
    assert tsara(vis=name, imagename="m", niter=30, dryrun=True, **GRID)["forecast"]["visibilities"] == 1008
    tsara(vis=name, imagename="m", niter=30, **GRID)
    shutil.copytree("m.model", "n.model")
    saracompare(models=["m.model", "n.model"], vis=name, datacolumn="data")


@pytest.mark.parametrize("correlations, stokes", [
    ("Q U", "I"), ("V", "I"), ("RL LR", "I"), ("XX", "Q"), ("I V", "U"), ("RR RL", "V")])
def test_what_is_not_there_is_refused(holding, correlations, stokes):
    names = correlations.replace(" ", ", ")
    with pytest.raises(ValueError,
                       match=f"stokes = '{stokes}' cannot be formed from the correlations {names} of spw 0"):
        tsara(vis=holding(correlations), imagename="x", stokes=stokes, positivity=stokes == "I", **GRID)
