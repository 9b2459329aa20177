"""Cells of the main table that are not there, or of another shape: each row has its own,
and is looked at before it is read."""

import shutil

import numpy as np
import pytest

casatools = pytest.importorskip("casatools")

from simulated_ms import _tool, add_column, column, pixels
from spoiled import GRID, ROW, cells, observe, remake, shaped, undefined

from casa_sara import tsara
from casa_sara.casa.ms.read import read_visibilities
from casa_sara.casa.ms.selection import select_data
from casa_sara.casa.ms.weights import sampling_density
from casa_sara.options import ImageGrid, Selection

WINDOWS = (("8.4GHz", "2MHz", 3), ("8.6GHz", "1MHz", 5))
INNER = (slice(32, 96), slice(32, 96))  # where tclean's gridding is good


@pytest.fixture(scope="module")
def vis(tmp_path_factory):
    return observe(tmp_path_factory.mktemp("ms") / "whole.ms")


@pytest.fixture(scope="module")
def two_windows(tmp_path_factory):
    return observe(tmp_path_factory.mktemp("ms") / "two.ms", spws=WINDOWS, noise=0.3)


@pytest.fixture
def copy(vis, tmp_path):
    return shutil.copytree(vis, tmp_path / "copy.ms")


def selected(name, **chosen):
    """Return what is selected of a MeasurementSet."""
    (ms,), _ = select_data(Selection((str(name),), datacolumn="data", **chosen))
    return ms


# Weights row by row -----------------------------------------------------------------------------


def with_spectra(name, rows, of_others=False):
    """Give some rows a WEIGHT_SPECTRUM of 25 times their weight; the others none, or one of their weight."""
    add_column(name, "WEIGHT_SPECTRUM", None)
    tb = _tool("table")
    tb.open(str(name), nomodify=False)
    try:
        for row in range(tb.nrows()):
            weight = np.repeat(tb.getcell("WEIGHT", row)[:, None], tb.getcell("DATA", row).shape[1], axis=1)
            if of_others or row in rows:
                tb.putcell("WEIGHT_SPECTRUM", row, weight * (25 if row in rows else 1))
    finally:
        tb.close()
    return str(name)


@pytest.mark.parametrize("weighting", ["natural", "uniform", "briggs"])
@pytest.mark.parametrize("part", ["first half", "second half", "every second"])
def test_each_row_has_its_own_weights(two_windows, tmp_path, part, weighting):
    """As tclean images the data with a WEIGHT_SPECTRUM in all rows: else its uniform weights mix the kinds,
    or it ends."""
    from casatasks import tclean

    count = column(two_windows, "TIME").size
    rows = {"first half": range(count // 2), "second half": range(count // 2, count),
            "every second": range(0, count, 2)}[part]
    some, every = (shutil.copytree(two_windows, tmp_path / f"{kind}.ms") for kind in ("some", "every"))
    call = dict(imsize=128, cell="0.5arcsec", datacolumn="data", niter=0, weighting=weighting)
    tsara(vis=with_spectra(some, rows), imagename=str(tmp_path / "s"), **call)
    tclean(vis=with_spectra(every, rows, of_others=True), imagename=str(tmp_path / "c"), **call)
    ours, tcleans = (pixels(f"{tmp_path}/{name}.residual")[INNER] for name in "sc")
    np.testing.assert_allclose(ours, tcleans, rtol=0, atol=2e-3 * tcleans.max())
    assert pixels(tmp_path / "s.sumwt") == pytest.approx(pixels(tmp_path / "c.sumwt"), rel=1e-5)


def test_a_concat_is_imaged_as_tclean_does(tmp_path):
    from casatasks import concat, tclean

    names = [observe(tmp_path / "a.ms", weight_spectrum=True, noise=0.3),
             observe(tmp_path / "b.ms", seed=2, date="2015/06/02")]
    both = str(tmp_path / "both.ms")
    _in_all_columns(names)
    concat(vis=names, concatvis=both)
    call = dict(imsize=128, cell="0.5arcsec", datacolumn="data", niter=0)
    for task, root in ((tsara, "s"), (tclean, "c")):
        task(vis=both, imagename=str(tmp_path / root), **call)
    ours, tcleans = (pixels(f"{tmp_path}/{name}.residual")[INNER] for name in "sc")
    np.testing.assert_allclose(ours, tcleans, rtol=0, atol=2e-3 * tcleans.max())
    assert pixels(tmp_path / "s.sumwt") == pytest.approx(pixels(tmp_path / "c.sumwt"), rel=1e-5)


def _in_all_columns(names):
    """Add what concat expects of every MeasurementSet."""
    for name in names:
        for col in ("CORRECTED_DATA", "MODEL_DATA"):
            add_column(name, col, column(name, "DATA"))


@pytest.mark.parametrize("manager", ["StandardStMan", "TiledShapeStMan"])
def test_the_density_of_rows_with_other_weights(vis, tmp_path, manager):
    """casatools imager takes one kind of weights for all rows, and ends the process at some tables."""
    name = with_spectra(shutil.copytree(vis, tmp_path / "some.ms"), range(100, 336))
    remake("WEIGHT_SPECTRUM", lambda old: old, manager=manager)(name)
    selection, cell = Selection((name,), datacolumn="data"), np.radians(1 / 3600)
    data, grid = read_visibilities(selection), ImageGrid((64, 64), (cell, cell))
    assert data.mixed_weights and not data.dropped
    np.testing.assert_array_equal(sampling_density(data, selection, grid), sampling_density(data, None, grid))


# Cells of another shape -------------------------------------------------------------------------

MATRICES, VECTORS = ("DATA", "FLAG", "WEIGHT_SPECTRUM", "SIGMA_SPECTRUM"), ("WEIGHT", "SIGMA")
SHAPES = [(col, shape) for col in MATRICES for shape in ((2, 2), (2, 4), (1, 3), (4, 3), (3, 2), (6, 1))] + [
    (col, shape) for col in VECTORS for shape in ((1,), (3,))]


@pytest.mark.parametrize("manager", ["StandardStMan", "TiledShapeStMan"])
@pytest.mark.parametrize(("col", "shape"), SHAPES)
def test_a_cell_of_another_shape_is_named(copy, col, shape, manager):
    if col.endswith("SPECTRUM"):
        add_column(copy, col, np.ones((2, 3, column(copy, "TIME").size)))
    shaped(col, [ROW, ROW + 7], shape, manager=manager)(copy)
    with pytest.raises(ValueError) as raised:
        selected(copy)
    assert f"vis = '{copy}': {col} of row {ROW} has the shape {list(shape)}: should have" in str(raised.value)


@pytest.mark.parametrize("call", [dict(dryrun=True), dict(specmode="cube"), dict(niter=0)], ids=str)
def test_all_tasks_look_first(copy, tmp_path, call):
    shaped("WEIGHT", None, (1,))(copy)
    with pytest.raises(ValueError, match="vis = '.*copy.ms': WEIGHT of row 0 has the shape"):
        tsara(vis=str(copy), imagename=str(tmp_path / "out"), **GRID | call)


@pytest.mark.parametrize("manager", ["StandardStMan", "TiledShapeStMan"])
def test_windows_are_told_apart(two_windows, tmp_path, manager):
    """A cell that would fit the other spectral window does not fit its own."""
    name, number = shutil.copytree(two_windows, tmp_path / "copy.ms"), column(two_windows, "DATA_DESC_ID")
    remake("DATA", lambda old: old, manager=manager)(name)
    assert [group.lacking["WEIGHT_SPECTRUM"].size for group in selected(name).groups] == np.bincount(number).tolist()
    row = int(np.flatnonzero(number == 1)[3])
    shaped("DATA", [row], (2, 3), manager=manager)(name)
    with pytest.raises(ValueError, match=rf"DATA of row {row} has the shape \[2, 3\]: should have the shape \[2, 5\]"):
        selected(name)
    assert selected(name, spw="0").groups[0].rows.size  # what is not selected does not matter


def test_tables_that_consist_of_several(tmp_path):
    """The storage managers of the first alone are known there."""
    from casatasks import virtualconcat

    names = [observe(tmp_path / "a.ms"), observe(tmp_path / "b.ms", date="2015/06/02")]
    _in_all_columns(names)
    shaped("DATA", [ROW], (3, 2), manager="TiledShapeStMan")(names[1])
    undefined("FLAG", [ROW], manager="TiledShapeStMan")(names[1])
    whole, rows = str(tmp_path / "whole.mms"), column(names[0], "TIME").size
    virtualconcat(vis=names, concatvis=whole)
    with pytest.raises(ValueError, match=rf"DATA of row {rows + ROW} has the shape \[3, 2\]"):
        selected(whole)
    (ms,), _ = select_data(Selection((whole,), datacolumn="corrected"))
    assert ms.groups[0].lacking["FLAG"].tolist() == [rows + ROW]


@pytest.mark.parametrize(("empty", "manager"), [
    (lambda cell: None, "StandardStMan"), (lambda cell: None, "TiledShapeStMan"),
    (lambda cell: cell[:, :0], "StandardStMan"),
], ids=["undefined", "undefined, tiled", "without elements"])
def test_rows_without_a_cell_are_known(copy, empty, manager):
    rows = [3, ROW, 300]
    cells("FLAG", rows, empty, manager=manager)(copy)
    (group,) = selected(copy).groups
    assert group.lacking["FLAG"].tolist() == rows
    assert np.flatnonzero(~group.has("FLAG", group.rows)).tolist() == rows and group.has("DATA", group.rows).all()


@pytest.mark.parametrize("name", ["new\nline.ms", "a 'b' \"c\".ms", "x::y.ms", "[a](b)*.ms"])
def test_any_name_of_a_measurement_set(vis, tmp_path, name):
    undefined("FLAG", [ROW])(shutil.copytree(vis, tmp_path / name))
    assert selected(tmp_path / name).groups[0].lacking["FLAG"].tolist() == [ROW]
