"""Subtables with what CASA does not bear, telescopes without a beam, and many MeasurementSets: images,
or an error of ours."""

import glob
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

casatools = pytest.importorskip("casatools")

from simulated_ms import column, edit, pixels
from spoiled import GRID, lacking, observe, put, remake, without
from test_bad_data import assert_refused, contents

from casa_sara import saracompare, tsara
from casa_sara.analysis.folder import PAGE
from casa_sara.casa.images.sky_image import read_sky_image
from casa_sara.casa.ms.subtables import readable

NAME = "J\u00fcrgen"
LONGEST_S = 200  # of all cases together, which take half a minute


def within(table, spoil):
    """Return a function that spoils a subtable as `spoil` does a table."""
    return lambda name: spoil(os.path.join(name, table))


def latin1(table, col):
    """Return a function that fills a column of texts with one that has a byte which is not UTF-8."""
    return within(table, lambda name: edit(name, col, lambda old: np.full(old.size, NAME)))


def grown(table, col=None, value=None):
    """Return a function that gives a subtable one more row: an empty one, or the first with a value in a column."""

    def spoil(name):
        tb = casatools.table()
        tb.open(os.path.join(name, table), nomodify=False)
        try:
            if col is None:
                tb.addrows(1)
            else:
                tb.copyrows(os.path.join(name, table), startrowin=0, startrowout=-1, nrow=1)
                row = tb.nrows() - 1
                old = tb.getcell(col, row)
                tb.putcell(col, row, np.full_like(old, value) if np.ndim(old) else value)
        finally:
            tb.close()

    return spoil


def first(table, col, change):
    """Return a function that changes the first cell of a column of a subtable; None makes it undefined."""
    return within(table, remake(col, lambda old: [change(old[0]), *old[1:]], ndim=-1))


def all_of(*spoils):
    return lambda name: [spoil(name) for spoil in spoils]


def moving(rate):
    """Return a function that makes the field a polynomial in time, of this rate in radians per second."""

    def spoil(name):
        tb = casatools.table()
        tb.open(name, nomodify=False)
        for col in ("PHASE_DIR", "DELAY_DIR", "REFERENCE_DIR"):
            tb.putcell(col, 0, np.hstack([tb.getcell(col, 0), np.full((2, 1), rate)]))
        tb.putcell("NUM_POLY", 0, 1)
        tb.close()

    return within("FIELD", spoil)


def ephemeris(name):
    """Say that the field moves as a table says."""
    tb = casatools.table()
    tb.open(os.path.join(name, "FIELD"), nomodify=False)
    tb.addcols({"EPHEMERIS_ID": {key: value
                                 for key, value in tb.getcoldesc("SOURCE_ID").items() if "Manager" not in key}})
    tb.putcol("EPHEMERIS_ID", np.zeros(tb.nrows(), int))
    tb.close()


def telescope(name, diameter_m=None, antenna=...):
    """Return a function that renames the telescope, and changes the diameter of its antennas."""
    rename = within("OBSERVATION", lambda path: edit(path, "TELESCOPE_NAME", lambda old: np.full(old.size, name)))
    return rename if diameter_m is None else all_of(rename,
                                                    within("ANTENNA", put("DISH_DIAMETER", antenna, diameter_m)))


TEXTS = {"ANTENNA": "NAME STATION", "FIELD": "NAME CODE", "HISTORY": "MESSAGE",
         "OBSERVATION": "OBSERVER PROJECT TELESCOPE_NAME",
         "SOURCE": "NAME", "SPECTRAL_WINDOW": "NAME", "STATE": "OBS_MODE"}
GROWN = ("ANTENNA", "DATA_DESCRIPTION", "FIELD", "OBSERVATION", "POLARIZATION", "SOURCE", "SPECTRAL_WINDOW", "STATE")
UNTOUCHED = {  # name: what spoils; the image is that of the MeasurementSet as it was
    **{f"Latin-1 in {table}/{col}": latin1(table, col) for table, cols in TEXTS.items() for col in cols.split()},
    **{f"empty row in {table}": grown(table) for table in GROWN},
    **{f"{table}/{col} {value} in a row more": grown(table, col, value) for table, col, value in (
        ("ANTENNA", "POSITION", np.nan), ("DATA_DESCRIPTION", "SPECTRAL_WINDOW_ID", -1), ("FIELD", "PHASE_DIR", np.nan),
        ("POLARIZATION", "CORR_TYPE", 0), ("SPECTRAL_WINDOW", "CHAN_FREQ", np.nan), ("SPECTRAL_WINDOW", "NUM_CHAN", 7),
        ("SOURCE", "DIRECTION", np.nan))},
    "REST_FREQUENCY NaN": first("SOURCE", "REST_FREQUENCY", lambda cell: np.array([np.nan])),
    **{f"{table}/{col} undefined": first(table, col, lambda cell: None) for table, col in (
        ("ANTENNA", "OFFSET"), ("FIELD", "DELAY_DIR"), ("FIELD", "REFERENCE_DIR"), ("OBSERVATION", "TIME_RANGE"),
        ("POLARIZATION", "CORR_PRODUCT"), ("SPECTRAL_WINDOW", "EFFECTIVE_BW"), ("SPECTRAL_WINDOW", "RESOLUTION"))},
    "a line break in the name of a spectral window":
        within("SPECTRAL_WINDOW", lambda name: edit(name, "NAME", lambda old: np.full(old.size, "a\nb"))),
    "REF_FREQUENCY NaN": within("SPECTRAL_WINDOW", put("REF_FREQUENCY", 0, np.nan)),
    "a polynomial without a rate": moving(0.0),
    "DISH_DIAMETER NaN of a known telescope": telescope("VLA", np.nan),
}
NAMED = {  # name: (what spoils, the subtable and column that the error names)
    "no ANTENNA": (without("ANTENNA"), "ANTENNA"),
    "no HISTORY": (without("HISTORY"), "HISTORY"),
    "no SOURCE": (without("SOURCE"), "SOURCE"),
    "correlations of single precision": (within("POLARIZATION",
                                                remake("CORR_TYPE", lambda old: [1.0 * cell for cell in old],
                                                                        valueType="float")),
                                         "POLARIZATION/CORR_TYPE holds"),
    "no column NAME": (lacking("NAME", "FIELD"), "FIELD has no column NAME"),
    "CHAN_FREQ of single precision": (within("SPECTRAL_WINDOW",
                                             remake("CHAN_FREQ", lambda old: old, valueType="float")),
                                      "SPECTRAL_WINDOW/CHAN_FREQ holds float arrays: should be double arrays"),
    "CHAN_FREQ undefined": (first("SPECTRAL_WINDOW", "CHAN_FREQ", lambda cell: None),
                            "SPECTRAL_WINDOW/CHAN_FREQ of row 0"),
    "CHAN_WIDTH too long": (first("SPECTRAL_WINDOW", "CHAN_WIDTH", lambda cell: np.tile(cell, 2)),
                            "SPECTRAL_WINDOW/CHAN_WIDTH of row 0"),
    "NUM_CHAN 5": (within("SPECTRAL_WINDOW", put("NUM_CHAN", 0, 5)), "SPECTRAL_WINDOW/NUM_CHAN of row 0 holds 5"),
    "unknown frame": (within("SPECTRAL_WINDOW", put("MEAS_FREQ_REF", 0, 77)),
                      "SPECTRAL_WINDOW/MEAS_FREQ_REF of row 0 holds 77"),
    "CORR_TYPE one too few": (first("POLARIZATION", "CORR_TYPE", lambda cell: cell[:1]),
                              "POLARIZATION/NUM_CORR of row 0"),
    "PHASE_DIR flat": (first("FIELD", "PHASE_DIR", lambda cell: cell[:, 0]), "FIELD/PHASE_DIR of row 0"),
    "spectral window beyond the table": (within("DATA_DESCRIPTION", put("SPECTRAL_WINDOW_ID", 0, 3)),
                                         "DATA_DESCRIPTION/SPECTRAL_WINDOW_ID of row 0 holds 3"),
    "positions NaN": (within("ANTENNA", put("POSITION", ..., np.nan)), "ANTENNA/POSITION of row 0 holds nan"),
    "a field that moves": (moving(1e-10), "field [0] (FIELD0)"),
    "a field with an ephemeris": (ephemeris, "field [0] (FIELD0)"),
}
CASES = UNTOUCHED | {name: spoil for name, (spoil, _) in NAMED.items()}


@pytest.fixture(scope="module")
def vis(tmp_path_factory):
    return observe(tmp_path_factory.mktemp("ms") / "whole.ms")


@pytest.fixture
def copy(vis, tmp_path):
    """A copy of the MeasurementSet that a test may spoil."""
    return str(shutil.copytree(vis, tmp_path / "copy.ms"))


def residual(vis, folder=".", **changes):
    """Return the dirty image, or cube, in Jy/beam, and the record."""
    root = os.path.join(folder, "out")
    found = tsara(vis=vis, imagename=root, **(dict(niter=0, overwrite=True) | GRID | changes))
    return np.array(pixels(root + ".residual")), found["sara"]


# One process that may die, many cases ------------------------------------------------------------


@pytest.fixture(scope="module")
def outcomes(vis, tmp_path_factory):
    """What tsara makes of every case, in a process that may die: {name: [largest difference, message, changed]}."""
    here = Path(__file__).parent
    code = (f"import sys; sys.path[:0] = {[str(here), str(here.parent)]!r}; "
            f"from test_subtables import try_all; try_all({vis!r})")
    with subprocess.Popen([sys.executable, "-c", code], cwd=tmp_path_factory.mktemp("cases"), stdout=subprocess.PIPE,
                          stderr=subprocess.DEVNULL) as process:
        try:
            out = process.communicate(timeout=LONGEST_S)[0]
        except subprocess.TimeoutExpired:
            process.kill()
            out = process.communicate()[0]
    lines = [line for line in out.decode(errors="replace").splitlines() if line.startswith('["')]
    return {name: outcome for name, *outcome in map(json.loads, lines)}


def try_all(whole):
    """Print what tsara makes of every case, a JSON list in each line."""
    expected = residual(whole)[0]
    for name, spoil in CASES.items():
        shutil.copytree(whole, "spoiled.ms")
        spoil("spoiled.ms")
        before, off, message = contents("spoiled.ms"), None, ""
        try:
            off = float(np.abs(residual("spoiled.ms")[0] - expected).max() / expected.max())
        except Exception as error:
            message = f"{type(error).__name__}: {error}"
        print(json.dumps([name, off, message, contents("spoiled.ms") != before]), flush=True)
        shutil.rmtree("spoiled.ms")


@pytest.mark.parametrize("name", UNTOUCHED)
def test_what_no_image_depends_on_is_passed_over(outcomes, name):
    assert name in outcomes, "the process hung or died here, or before"
    off, message, changed = outcomes[name]
    assert not message and off < 1e-6 and not changed


@pytest.mark.parametrize("name", NAMED)
def test_what_the_image_depends_on_is_named(outcomes, name):
    assert name in outcomes, "the process hung or died here, or before"
    _, message, changed = outcomes[name]
    assert message.startswith("ValueError: ") and "spoiled.ms" in message and NAMED[name][1] in message and not changed


# Texts -------------------------------------------------------------------------------------------


def test_the_images_tell_what_was_meant(copy, tmp_path):
    """A Latin-1 letter is the same letter in the images, which are UTF-8."""
    for table, col in (("OBSERVATION", "OBSERVER"), ("OBSERVATION", "TELESCOPE_NAME"), ("FIELD", "NAME")):
        latin1(table, col)(copy)
    residual(copy, tmp_path)
    with_image = casatools.image()
    with_image.open(str(tmp_path / "out.image"))
    csys = with_image.coordsys()
    assert (csys.observer(), csys.telescope(), with_image.miscinfo()["INSTRUME"]) == (NAME, NAME, NAME)
    with_image.close()


@pytest.mark.parametrize("bytes_", ["Latin-1", "UTF-8"])
@pytest.mark.parametrize("options", [dict(), dict(weighting="uniform", niter=2), dict(specmode="cube")], ids=str)
def test_a_field_is_selected_by_a_name_that_the_parser_does_not_read(vis, tmp_path, bytes_, options):
    both = observe(tmp_path / "both.ms", fields=("J2000 19h59m28.5s +40d44m02s",) * 2)
    tb = casatools.table()
    tb.open(both + "/FIELD", nomodify=False)
    if bytes_ == "UTF-8":
        tb.putcell("NAME", 1, NAME)
    else:
        tb.putcol("NAME", np.array(["FIELD0", NAME]))
    tb.close()
    np.testing.assert_array_equal(residual(both, tmp_path, field=NAME, **options)[0],
                                  residual(both, tmp_path, field="1", **options)[0])


def test_images_of_others_may_hold_any_text(copy, tmp_path):
    """tclean passes the bytes on, and their record would end the process."""
    from casatasks import tclean

    for col in ("OBSERVER", "TELESCOPE_NAME"):
        latin1("OBSERVATION", col)(copy)
    tclean(vis=copy, imagename=str(tmp_path / "other"), niter=0, **GRID)
    image = read_sky_image(str(tmp_path / "other.residual"), "models", None)
    assert image.pixels.max() > 0 and image.plane.csys["observer"] == image.plane.csys["telescope"] == ""


# Rows that are selected, and rows that are not -----------------------------------------------------


def test_a_wrong_row_counts_only_where_it_is_selected(tmp_path):
    both = observe(tmp_path / "both.ms", fields=("J2000 19h59m28.5s +40d44m02s",) * 2)
    expected = residual(both, tmp_path, field="0")[0]
    direction = column(both + "/FIELD", "PHASE_DIR")
    direction[..., 1] = np.nan
    edit(both + "/FIELD", "PHASE_DIR", lambda old: direction)
    np.testing.assert_array_equal(residual(both, tmp_path, field="0")[0], expected)
    for changes in (dict(field="1"), dict(field="FIELD1"), dict(field="0", phasecenter=1), dict()):
        assert_refused(both, tmp_path, "vis = .*both.ms': FIELD/PHASE_DIR of row 1 holds nan",
                       **(dict(imagename=str(tmp_path / "none")) | changes))


def test_a_subtable_that_was_mended_is_read_again(copy):
    assert readable(copy) == copy
    latin1("FIELD", "NAME")(copy)
    shown = readable(copy)
    assert shown != copy and readable(copy) == shown and os.path.samefile(shown + "/table.dat", copy + "/table.dat")
    within("FIELD", lambda name: edit(name, "NAME", lambda old: np.array(["plain"])))(copy)
    assert readable(copy) == copy and not os.path.exists(shown)


# Telescopes --------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def expected(vis, tmp_path_factory):
    """The dirty image of the MeasurementSet as it was."""
    return residual(vis, tmp_path_factory.mktemp("expected"))[0]


@pytest.mark.parametrize(("name", "diameter_m"), [
    *((name, 0.0) for name in ("MeerKAT", "VLBA", "EHT", "LOFAR", "HERA", "MWA", "nobody knows it", "")),
    ("EVN", -1.0), ("EVN", np.nan)])
def test_an_unknown_primary_beam_is_flat_and_said_to_be(copy, expected, tmp_path, name, diameter_m):
    telescope(name, diameter_m, antenna=0)(copy)
    made, record = residual(copy, tmp_path)
    np.testing.assert_allclose(made, expected, atol=1e-5 * made.max())
    assert any("no primary beam" in note for note in record["notes"])
    assert (pixels(f"{tmp_path}/out.pb") == 1).all()


def test_a_flat_primary_beam_in_cubes_masks_and_corrected_images(copy, tmp_path):
    telescope("EVN", 0.0)(copy)
    for changes in (dict(specmode="cube"), dict(usemask="pb", pbmask=0.2, niter=2)):
        residual(copy, tmp_path, pbcor=True, **changes)
        assert (pixels(f"{tmp_path}/out.pb") == 1).all()
        np.testing.assert_array_equal(pixels(f"{tmp_path}/out.image.pbcor"), pixels(f"{tmp_path}/out.image"))
    names = [str(tmp_path / name) for name in "ab"]
    for niter, name in enumerate(names):
        tsara(vis=copy, imagename=name, niter=3 + niter, **GRID)
    saracompare(models=names, vis=copy, datacolumn="data", outdir=str(tmp_path / "report"))
    assert "no primary beam" in (tmp_path / "report" / PAGE).read_text()


# Many MeasurementSets, and their names -------------------------------------------------------------


MANY = """
import sys; sys.path[:0] = {path!r}
import resource, shutil
from test_subtables import residual
soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
names = [shutil.copytree({vis!r}, f"{{number:02d}}.ms") for number in range(10)]
first = residual(names[:2])[0]
resource.setrlimit(resource.RLIMIT_NOFILE, (200, hard))
made = residual(names)[0]
assert abs(made - first).max() < 1e-5 * first.max() and resource.getrlimit(resource.RLIMIT_NOFILE) == (200, hard)
assert residual(names, specmode="cube")[0].max() > 0
resource.setrlimit(resource.RLIMIT_NOFILE, (200, 200))
try:
    residual(names)
except OSError as error:
    print("refused:", error)
"""


@pytest.mark.slow
def test_more_measurement_sets_than_file_handles(vis, tmp_path):
    here = Path(__file__).parent
    code = MANY.format(path=[str(here), str(here.parent)], vis=vis)
    run = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, timeout=LONGEST_S)
    assert run.returncode == 0, run.stderr[-2000:]
    assert "vis has 10 MeasurementSets" in run.stdout and "ulimit -n" in run.stdout


@pytest.mark.parametrize("spell", [
    tuple, np.array, iter, set, lambda names: (name for name in names), lambda names: [Path(name) for name in names],
    lambda names: [name + "//" for name in names], lambda names: [os.path.relpath(name) for name in names],
    lambda names: ["~/" + os.path.basename(name) for name in names],
    lambda names: glob.glob(os.path.dirname(names[0]) + "/?.ms"),
], ids=["tuple", "array", "iterator", "set", "generator", "paths", "slashes", "relative", "tilde", "wildcard"])
def test_a_list_of_measurement_sets_is_spelled_as_for_tclean(vis, expected, tmp_path, monkeypatch, spell):
    names = [str(shutil.copytree(vis, tmp_path / f"{name}.ms")) for name in "ab"]
    monkeypatch.setenv("HOME", str(tmp_path))
    for one in (spell(names), spell(names[:1])):
        made = residual(one, tmp_path)[0]
        np.testing.assert_allclose(made, expected, atol=1e-5 * expected.max())
