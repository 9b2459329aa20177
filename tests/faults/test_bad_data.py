"""Data that are wrong: an error that names the parameter, or the image of the data without them."""

import hashlib
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

casatools = pytest.importorskip("casatools")

from simulated_ms import CYGNUS_A, column, edit, pixels
from spoiled import BROKEN, FAULTS, GRID, HOPELESS, ROW, SAMPLE, flag, observe, put

from casa_sara import tsara
from casa_sara.casa.ms.usable_samples import IN_FLAGS

SAME = 1e-5  # of the brightest pixel
LONGEST_S = 120  # of all broken MeasurementSets together, which take some seconds


@pytest.fixture(scope="module")
def vis(tmp_path_factory):
    return observe(tmp_path_factory.mktemp("ms") / "whole.ms")


@pytest.fixture
def copy(vis, tmp_path):
    """A copy of the MeasurementSet that a test may spoil."""
    return shutil.copytree(vis, tmp_path / "copy.ms")


@pytest.fixture(scope="module")
def flagged_model(vis, tmp_path_factory):
    """A function that returns the model, and what was left out, with some samples flagged."""
    made, folder = {}, tmp_path_factory.mktemp("flagged")

    def model(where):
        if repr(where) not in made:
            name = shutil.copytree(vis, folder / "flagged.ms", dirs_exist_ok=True)
            flag(where)(name)
            made[repr(where)] = image(name, folder)
        return made[repr(where)]

    return model


@pytest.fixture(scope="module")
def whole_model(vis, tmp_path_factory):
    """The model of the data as they are."""
    return image(vis, tmp_path_factory.mktemp("whole"))[0]


@pytest.fixture(scope="module")
def wide_residual(vis, tmp_path_factory):
    """The dirty image of the data as they are, on 128 by 128 pixels."""
    return image(vis, tmp_path_factory.mktemp("wide"), "residual", imsize=128, niter=0)[0]


def contents(folder):
    """Return the hashes of the files of a MeasurementSet, without its locks."""
    files = (path for path in Path(folder).rglob("*") if path.is_file() and path.name != "table.lock")
    return {str(path): hashlib.sha256(path.read_bytes()).hexdigest() for path in files}


def image(vis, folder, product="model", **changes):
    """Return the image that tsara makes, and its record; the MeasurementSets stay as they are."""
    names = [str(name) for name in (vis if isinstance(vis, list) else [vis])]
    before = [contents(name) for name in names]
    call = dict(niter=30, wavelets=["dirac", "db1", "db4"], nthreads=1, overwrite=True) | GRID | changes
    result = tsara(vis=names, imagename=str(folder / "out"), **call)
    assert [contents(name) for name in names] == before
    made = pixels(f"{folder}/out.{product}")
    assert np.isfinite(made).all()
    return made, result["sara"]


def assert_same(one, other, tol=SAME):
    np.testing.assert_allclose(one, other, rtol=0, atol=tol * other.max())


def assert_refused(vis, folder, message, error=ValueError, **changes):
    """Raise unless tsara refuses the data, leaves them as they are and writes nothing."""
    names = [str(name) for name in (vis if isinstance(vis, list) else [vis])]
    before, there = [contents(name) for name in names], set(os.listdir(folder))
    with pytest.raises(error, match=message):
        tsara(vis=names, **(dict(imagename=str(folder / "out"), niter=3) | GRID | changes))
    assert [contents(name) for name in names] == before and set(os.listdir(folder)) == there


# Wrong numbers ----------------------------------------------------------------------------------


@pytest.mark.parametrize("fault", FAULTS)
def test_wrong_numbers_count_as_if_flagged(copy, tmp_path, flagged_model, fault):
    spoil, where = FAULTS[fault]
    spoil(copy)
    expected, flagged = flagged_model(where)
    model, record = image(copy, tmp_path)
    assert_same(model, expected)
    (reason, count), = record["dropped"].items()
    assert reason not in IN_FLAGS and count == flagged["dropped"]["flagged"]
    assert any(f"{count} samples left out as {reason}" in note for note in record["notes"])


def test_a_wild_visibility_is_found_by_the_image(copy, tmp_path, flagged_model):
    put("DATA", (0, *SAMPLE[1:]), 1e4)(copy)  # S/N 5e5: no receiver fault by its number alone
    model, record = image(copy, tmp_path, precondition=False)
    expected = shutil.copytree(copy, tmp_path / "flagged.ms")
    flag(SAMPLE)(expected)
    assert_same(model, image(expected, tmp_path, precondition=False)[0], 1e-4)  # the order of sums differs
    assert [(one["row"], one["channel"]) for one in record["wild"]] == [(ROW, SAMPLE[1])]


@pytest.mark.parametrize("fault", HOPELESS)
def test_nothing_to_image_is_an_error(copy, tmp_path, fault):
    HOPELESS[fault](copy)
    assert_refused(copy, tmp_path, "datacolumn = 'data'.*zero" if fault == "all data zero"
                   else "vis.*samples left out as")


def test_strong_data_of_right_weights_are_believed(copy, tmp_path):
    """A weight may differ a thousandfold, and data may be strong: only together with the others they are impossible."""
    edit(copy, "DATA", lambda data: data * 1e12)
    model, record = image(copy, tmp_path)
    assert not record["dropped"] and model.max() > 1e10


# Little data, and many MeasurementSets ----------------------------------------------------------


@pytest.mark.parametrize("what", ["baseline", "integration"])
def test_one_of_them_alone(vis, copy, tmp_path, what):
    time = column(vis, "TIME")
    if what == "baseline":
        other, selection = (column(vis, "ANTENNA1") != 0) | (column(vis, "ANTENNA2") != 1), dict(antenna="0&1")
    else:
        other, selection = time != time[0], dict(scan="1", timerange=f"<2015/06/01/{_middle(time)}")
    flag((..., np.flatnonzero(other)))(copy)
    assert_same(image(vis, tmp_path, **selection)[0], image(copy, tmp_path)[0])


def _middle(time):
    """Return the time of day between the first integration and the next."""
    first, second = np.unique(time)[:2]
    return str(np.datetime64("1858-11-17T00:00:00") + np.timedelta64(round(first + second) // 2, "s")).split("T")[1]


def test_one_visibility_is_not_enough(tmp_path):
    one = observe(tmp_path / "one.ms", antennas=2, scans=1, scan_seconds=10.0, spws=(("8.4GHz", "2MHz", 1),))
    assert_refused(one, tmp_path, "cell = .*imsize = .*vis and its selection")


def test_autocorrelations_are_left_out(tmp_path):
    name = observe(tmp_path / "auto.ms", autocorrelations=True)
    assert (column(name, "ANTENNA1") == column(name, "ANTENNA2")).any()
    assert_same(image(name, tmp_path)[0], image(name, tmp_path, antenna="*&*")[0])
    assert_refused(name, tmp_path, "vis: .*autocorrelation", antenna="*&&&", imagename=str(tmp_path / "none"))


def test_one_of_several_may_be_empty(vis, copy, whole_model, tmp_path):
    model, record = image([vis, copy], tmp_path, scan=["", "7"])
    assert_same(model, whole_model)
    assert any("scan = '7' leaves no rows" in note for note in record["notes"])
    flag(...)(copy)
    for names in ([vis, copy], [copy, vis]):
        model, record = image(names, tmp_path)
        assert_same(model, whole_model)
        assert any(f"'{copy}' has no usable visibilities" in note for note in record["notes"])
    assert_refused([vis, copy], tmp_path, "scan = '9'.*; scan = '7'", scan=["9", "7"], imagename=str(tmp_path / "none"))


def test_the_same_data_twice_are_refused(vis, whole_model, tmp_path):
    os.symlink(vis, tmp_path / "link.ms")
    assert_refused([vis, str(tmp_path / "link.ms")], tmp_path, "vis = .* twice", scan="1")
    apart = image([vis, vis], tmp_path, scan=["1", "2"])[0]
    assert_same(apart, whole_model)


@pytest.fixture(scope="module")
def model_of_two(vis, tmp_path_factory):
    """The model of the data and of others, both of RR and LL."""
    folder = tmp_path_factory.mktemp("two")
    return image([vis, observe(folder / "other.ms", seed=5, correlations="RR LL")], folder)[0]


@pytest.mark.parametrize("correlations", ["XX YY", "LL RR"])
def test_other_polarisation_products_add_up(vis, model_of_two, tmp_path, correlations):
    other = observe(tmp_path / "other.ms", seed=5, correlations=correlations)
    assert_same(image([vis, other], tmp_path)[0], model_of_two)


def test_spectral_frames_add_up(vis, tmp_path):
    names = [observe(tmp_path / f"{k}.ms", seed=5, frame="TOPO") for k in range(2)]
    me = casatools.measures()
    me.doframe(me.observatory("VLA"))
    me.doframe(me.direction(*CYGNUS_A.split()))
    me.doframe(me.epoch("UTC", f"{float(column(names[0], 'TIME').mean())!r}s"))
    factor = me.measure(me.frequency("TOPO", "1Hz"), "LSRK")["m0"]["value"]
    window = names[1] + "/SPECTRAL_WINDOW"
    edit(window, "CHAN_FREQ", lambda freq: freq * factor)
    edit(window, "MEAS_FREQ_REF", lambda code: code * 0 + 1)  # LSRK
    assert abs(factor - 1) > 5e-5
    one, other = (image([vis, name], tmp_path, "residual", niter=0)[0] for name in names)
    assert_same(one, other)


def test_phase_centres_add_up_and_must_be_one_field(vis, tmp_path):
    near = "J2000 19h59m29.2s +40d44m05s"
    both = observe(tmp_path / "both.ms", fields=(CYGNUS_A, near))
    together = image(both, tmp_path, phasecenter=0, onepointing=True)[0]
    assert_same(image([both, both], tmp_path, field=["0", "1"], phasecenter=0, onepointing=True)[0], together)
    assert together[37, 39] > 0.1 * together.max()  # the brighter source, 5 arcsec west and 7 north
    far = observe(tmp_path / "far.ms", fields=("J2000 03h00m00s +40d44m10s",), hour_angle=0)
    assert_refused([vis, far], tmp_path, "phasecenter = '': field 0 of '.*far.ms' is 74 degrees",
                   imagename=str(tmp_path / "none"))
    assert_refused(vis, tmp_path, "phasecenter = 'J2000 .* is 180 degrees",
                   phasecenter="J2000 07h59m28.5s -40d44m01.5s",
                   imagename=str(tmp_path / "none"))


# Broken MeasurementSets -------------------------------------------------------------------------


@pytest.fixture(scope="module")
def of_broken(vis, tmp_path_factory):
    """What tsara says of every broken MeasurementSet, in a process that may hang or die: {fault: [error, message,
    changed]}."""
    folder = tmp_path_factory.mktemp("broken")
    code = f"import sys; sys.path[:0] = {[str(Path(__file__).parent), str(Path(__file__).parents[1])]!r}; " \
           f"from test_bad_data import try_all; try_all({str(vis)!r})"
    try:
        run = subprocess.run([sys.executable, "-c", code], cwd=folder, capture_output=True, timeout=LONGEST_S)
        out = run.stdout
    except subprocess.TimeoutExpired as expired:
        out = expired.stdout or b""
    lines = [line for line in out.decode(errors="replace").splitlines() if line.startswith('["')]
    return {fault: outcome for fault, *outcome in map(json.loads, lines)}


def try_all(whole):
    """Print what tsara says of every broken MeasurementSet, a JSON list in each line."""
    for fault, spoil in BROKEN.items():
        name = shutil.copytree(whole, "broken.ms", dirs_exist_ok=True)
        spoil(name)
        before, error = contents(name), None
        try:
            tsara(vis=name, imagename="out", niter=3, overwrite=True, **GRID)
        except Exception as found:
            error = found
        print(json.dumps([fault, type(error).__name__, str(error), contents(name) != before]), flush=True)
        shutil.rmtree(name)


@pytest.mark.parametrize("fault", BROKEN)
def test_a_broken_measurement_set_is_named(of_broken, fault):
    assert fault in of_broken, "the process hung or died here, or before"
    error, message, changed = of_broken[fault]
    named = any(word in message for word in ("vis = ", "vis: ", "datacolumn = "))
    assert error == "ValueError" and named, f"{error}: {message}"
    assert "broken.ms" in message and not changed


# Image planes -----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("given", "message"),
    [
        (dict(cell="100arcsec"), "cell=100arcsec is too large for the longest baseline"),
        (dict(cell="0.9rad"), "cell=.*arcsec is too large"),
        (dict(cell="1e-3arcsec"), "imsize = .* with cell = .* is an image 0.064 arcsec wide"),
        (dict(cell="1e-300arcsec"), "imsize = .* with cell = "),
        (dict(cell=["1arcsec", "1e-6arcsec"]), "imsize = .* with cell = "),
        (dict(imsize=1), "imsize = .* with cell = .* is an image 1 arcsec wide"),
        (dict(imsize=[1, 64]), "imsize = .* with cell = "),
        (dict(imsize=[64, 1]), "imsize = .* with cell = "),
    ],
    ids=str,
)
@pytest.mark.parametrize("niter", [0, 3])
def test_an_image_plane_that_cannot_hold_the_data_is_refused(vis, tmp_path, given, message, niter):
    assert_refused(vis, tmp_path, message, niter=niter, **given)


@pytest.mark.parametrize("imsize", [[61, 67], [64, 63], [97, 3], [128, 101]], ids=str)
def test_any_size_shows_the_same_sky(vis, wide_residual, tmp_path, imsize):
    part = image(vis, tmp_path, "residual", imsize=imsize, niter=0)[0]
    x, y = (64 - n // 2 for n in imsize)
    seen = wide_residual[x : x + imsize[0], y : y + imsize[1]]
    np.testing.assert_allclose(part, seen, atol=2e-5 * wide_residual.max())
    model = image(vis, tmp_path, imsize=imsize)[0]
    assert model.shape == tuple(imsize) and model.max() > 0


def test_an_image_beyond_the_primary_beam_says_so(vis, tmp_path):
    _, record = image(vis, tmp_path, niter=3, phasecenter="J2000 19h59m28.5s +41d44m02s")
    assert any("phasecenter = " in note and "primary beam" in note for note in record["notes"])


def test_what_cannot_be_weighed_is_said_before_the_hours_of_solving(vis, tmp_path):
    """Wrong imaging weights and beams come up before the first iteration."""
    with pytest.raises(ValueError, match="uvtaper"):
        tsara(vis=vis, imagename=str(tmp_path / "out"), uvtaper="1e-30lambda", niter=10**9, reltol=0.0, finalreltol=0.0,
              **GRID)
