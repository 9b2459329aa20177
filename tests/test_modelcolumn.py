"""Writing MODEL_DATA: against the explicit sky, the component predictor, and what must stay as it was."""

import os
import shutil
import signal

import numpy as np
import pytest

pytest.importorskip("casatools")

from simulated_ms import CYGNUS_A, _tool, add_column, column, direction_cosines, edit, simulate

from casa_sara.casa.ms import model_column
from casa_sara.casa.ms.model_column import check_model_column_writable, save_model_column, write_model_column
from casa_sara.casa.ms.read import read_visibilities
from casa_sara.options import Selection

SKY = ((1.0, 0.0, 0.0), (0.5, 2e-4, -3e-4))
CENTRE = "J2000 19h59m33s +40d43m02s"


@pytest.fixture(scope="module")
def observation(tmp_path_factory):
    """Four correlations, two spws, a few flags, no MODEL_DATA: never written to."""
    name = simulate(tmp_path_factory.mktemp("ms") / "a.ms", configuration="b", antennas=6, correlations="RR RL LR LL",
                    sky=SKY,
                    fields=(CYGNUS_A, CENTRE), spws=(("8.4GHz", "2MHz", 4), ("8.6GHz", "2MHz", 2)))  # fmt: skip
    rng = np.random.default_rng(1)
    edit(name, "FLAG", lambda old: rng.random(old.shape) < 0.2)
    edit(name, "FLAG_ROW", lambda old: rng.random(old.shape) < 0.2)
    return name


@pytest.fixture
def copied(observation, tmp_path):
    return shutil.copytree(observation, tmp_path / "copied.ms")


def predictor(centre):
    """Return the exact model visibilities of SKY at an image centre."""
    flux, lmn = direction_cosines((CYGNUS_A, centre), SKY)
    l, m, n = lmn[1]

    def predict(uvw, freq_hz):
        u, v, w = uvw[:, :, None]
        return np.exp(2j * np.pi * (u * l + v * m + w * (n - 1))) @ flux

    return predict


def write(name, centre=CENTRE, **selection):
    selection = Selection(vis=(str(name),), **selection)
    write_model_column(selection, read_visibilities(selection, centre).phase_center, predictor(centre))


def spectral_window(name, col, number):
    """Return a column of the rows of one spectral window."""
    return column(name, col, np.flatnonzero(column(name, "DATA_DESC_ID") == number))


def column_names(name):
    import casatools

    tb = casatools.table()
    tb.open(str(name))
    names = set(tb.colnames())
    tb.close()
    return names


def test_model_at_the_fields_centres(copied):
    """The data hold no noise, so the model column is the data column, whatever the image centre and the flags."""
    write(copied)
    for number in (0, 1):
        model, data = (spectral_window(copied, col, number) for col in ("MODEL_DATA", "DATA"))
        np.testing.assert_allclose(model, data, atol=2e-6)
        assert not model[1:3].any() and np.abs(model[0]).min() > 0.4


def test_pieces(copied, monkeypatch):
    """Written in pieces of a few rows, the column is the same."""
    monkeypatch.setattr(model_column, "_CHUNK", 50)
    write(copied)
    for number in (0, 1):
        model, data = (spectral_window(copied, column, number) for column in ("MODEL_DATA", "DATA"))
        np.testing.assert_allclose(model, data, atol=2e-6)


def test_rows_without_uvw_get_no_model(copied):
    edit(copied, "UVW", lambda old: np.where(np.arange(old.shape[1]) % 5 == 0, np.nan, old))
    write(copied)
    model, lost = spectral_window(copied, "MODEL_DATA", 0), np.isnan(spectral_window(copied, "UVW", 0)[0])
    assert lost.any() and not model[:, :, lost].any()
    np.testing.assert_allclose(model[:, :, ~lost], spectral_window(copied, "DATA", 0)[:, :, ~lost], atol=2e-6)


def test_nothing_else_changes(copied):
    columns = ("DATA", "FLAG", "FLAG_ROW", "WEIGHT", "SIGMA", "UVW", "TIME", "FIELD_ID")
    before = {col: spectral_window(copied, col, 0) for col in columns}
    names = column_names(copied)
    write(copied)
    assert column_names(copied) == names | {"MODEL_DATA"}
    for col in columns:
        assert np.array_equal(spectral_window(copied, col, 0), before[col])


def test_only_the_selection_is_written(copied):
    write(copied)
    keep = {number: spectral_window(copied, "MODEL_DATA", number) for number in (0, 1)}
    selection = Selection(vis=(str(copied),), spw="0:1;3", scan="2")
    centre = read_visibilities(selection).phase_center
    write_model_column(selection, centre, lambda uvw, freq_hz: np.full(uvw.shape[1], 7.0))
    model = spectral_window(copied, "MODEL_DATA", 0)
    rows = spectral_window(copied, "SCAN_NUMBER", 0) == 2
    assert np.array_equal(spectral_window(copied, "MODEL_DATA", 1), keep[1])
    assert np.array_equal(model[:, :, ~rows], keep[0][:, :, ~rows])
    assert np.array_equal(model[:, 0::2], keep[0][:, 0::2])
    np.testing.assert_allclose(np.abs(model[0, 1::2][:, rows]), 7, rtol=1e-6)
    assert not model[1:3, 1::2].any()


def predict_with_casa(name, usescratch):
    """Let CASA predict SKY from a component list, into MODEL_DATA or into the header."""
    import casatools

    cl, me, im = casatools.componentlist(), casatools.measures(), casatools.imager()
    for flux, l, m in SKY:
        offset, angle = ({"unit": "rad", "value": float(value)} for value in (np.hypot(l, m), np.arctan2(l, m)))
        direction = me.shift(me.direction(*CYGNUS_A.split()), offset, angle)
        cl.addcomponent(dir=direction, flux=flux, fluxunit="Jy", freq="8.4GHz", shape="point")
    cl.rename("sky.cl")
    cl.done()
    im.open(name, usescratch=usescratch)
    im.ft(complist="sky.cl")
    im.done()


def test_sign_and_frequency_as_casas_component_predictor(tmp_path):
    name = simulate(tmp_path / "a.ms", configuration="b", antennas=6, sky=SKY)
    predict_with_casa(name, usescratch=True)
    theirs = column(name, "MODEL_DATA")
    assert np.ptp(np.abs(theirs)) > 0.9
    write(name)
    np.testing.assert_allclose(column(name, "MODEL_DATA"), theirs, atol=3e-5)


def test_a_model_in_the_header_is_deleted(tmp_path):
    """It would be used instead of the column. (CASA deletes it by itself when it adds the column, but not later.)"""
    import casatools

    name = simulate(tmp_path / "a.ms", antennas=5, sky=((1.0, 0.0, 0.0),))
    write(name)
    predict_with_casa(name, usescratch=False)

    def in_header():
        tb = casatools.table()
        tb.open(name + "/SOURCE")
        found = bool(tb.getcell("SOURCE_MODEL", 0))
        tb.close()
        return found

    assert in_header()
    write(name)
    assert not in_header()


def test_a_measurement_set_that_is_open_in_the_session(copied):
    """A child process would wait for this tool for ever: this process writes."""
    import casatools

    tb = casatools.table()
    tb.open(str(copied))
    try:
        assert tb.getcol("SCAN_NUMBER").any()
        save_model_column([str(copied)], lambda name: write(name), name=copied)
    finally:
        tb.close()
    model, data = (spectral_window(copied, col, 0) for col in ("MODEL_DATA", "DATA"))
    np.testing.assert_allclose(model, data, atol=2e-6)


def test_wrong_read_back_is_an_error(copied, monkeypatch):
    monkeypatch.setattr(model_column, "_read_back", lambda ms: iter([np.zeros(3)]))
    with pytest.raises(RuntimeError, match="MODEL_DATA of .* does not read back"):
        write(copied)


def test_interrupts_wait_until_the_column_is_whole(copied):
    received = []
    before = signal.signal(signal.SIGTERM, lambda *got: received.append(column(copied, "MODEL_DATA", [0, 5])))
    exact = predictor(CENTRE)

    def interrupted(uvw, freq_hz):
        os.kill(os.getpid(), signal.SIGTERM)
        return exact(uvw, freq_hz)

    try:
        selection = Selection(vis=(str(copied),), spw="0")
        write_model_column(selection, read_visibilities(selection, CENTRE).phase_center, interrupted)
        assert len(received) == 1
        np.testing.assert_allclose(received[0], column(copied, "DATA", [0, 5]), atol=2e-6)
        assert signal.getsignal(signal.SIGTERM) is not signal.SIG_DFL
    finally:
        signal.signal(signal.SIGTERM, before)


def test_writable_check(copied, monkeypatch):
    selection = Selection(vis=(str(copied),))
    check_model_column_writable(selection)
    usage = shutil.disk_usage(copied)
    cells = 8 * sum(spectral_window(copied, "DATA", number).size for number in (0, 1))
    for free, enough in ((int(cells * 1.06) + 200_000, True), (int(cells * 1.04) + 200_000, False)):
        monkeypatch.setattr(shutil, "disk_usage", lambda path: usage._replace(free=free))
        if enough:
            check_model_column_writable(selection)
        else:
            with pytest.raises(OSError, match="savemodel = 'modelcolumn' needs"):
                check_model_column_writable(selection)
    add_column(copied, "MODEL_DATA", None)
    tb = _tool("table")
    tb.open(str(copied), nomodify=False)
    for row in range(tb.nrows()):  # two shapes
        tb.putcell("MODEL_DATA", row, tb.getcell("DATA", row))
    tb.close()
    check_model_column_writable(selection)  # what is there needs no space


def test_write_protected(copied, monkeypatch):
    monkeypatch.setattr(os, "access", lambda path, mode: not str(path).endswith("table.dat"))
    with pytest.raises(PermissionError, match="savemodel = 'modelcolumn' .*table.dat' is write-protected"):
        check_model_column_writable(Selection(vis=(str(copied),)))
