"""Faults while the model column is written: kill -9, a full disk, a read-only MeasurementSet, one that is held open."""

import errno
import os
import shutil
import time

import numpy as np
import pytest
from machinery import begun_with, fill, hashes, killed, read_only, small_disk
from simulated_ms import add_column, column, edit, simulate
from spoiled import shaped, undefined

casatools = pytest.importorskip("casatools")

from casa_sara import tsara
from casa_sara.casa.ms import model_column
from casa_sara.casa.ms.model_column import INCOMPLETE, incomplete_columns
from casa_sara.casa.runtime import child_process
from casa_sara.casa.runtime.child_process import in_child

GRID = dict(imsize=64, cell="1arcsec", datacolumn="data", niter=3, nthreads=1)
FINISH = GRID | dict(restart=True, niter=0, savemodel="modelcolumn")
KEPT = ("DATA", "FLAG", "FLAG_ROW", "WEIGHT", "SIGMA", "UVW", "TIME", "ANTENNA1", "FIELD_ID")


@pytest.fixture(scope="module")
def vis(tmp_path_factory):
    """Never written to."""
    return simulate(tmp_path_factory.mktemp("ms") / "c.ms", configuration="c", antennas=10, noise=0.05, scans=3, seed=4)


@pytest.fixture(scope="module")
def uninterrupted(vis, tmp_path_factory):
    """The model column of a run that was left alone, and its images."""
    folder = tmp_path_factory.mktemp("uninterrupted")
    copy = shutil.copytree(vis, folder / "c.ms")
    tsara(vis=str(copy), imagename=str(folder / "source"), savemodel="modelcolumn", **GRID)
    assert not (copy / INCOMPLETE).exists()
    return column(copy, "MODEL_DATA"), folder / "source"


@pytest.fixture
def copy(vis, tmp_path):
    return shutil.copytree(vis, tmp_path / "c.ms")


def assert_the_rest_is_as_it_was(copy, vis):
    for col in KEPT:
        np.testing.assert_array_equal(column(copy, col), column(vis, col))


def products_of(folder):
    return {name: digest for name, digest in hashes(folder, "table.lock").items() if name.startswith("source.")}


FAMILY_DIES = """
import time
import casa_sara.casa.ms.model_column as model_column
def die():
    os.kill(os.getppid(), signal.SIGKILL)
    {last}
model_column._CHUNK = 300
"""
KILLED = """
import casa_sara.casa.runtime.child_process as child_process
child_process._START = {start!r}
tsara(vis={vis!r}, imagename={name!r}, savemodel="modelcolumn", **{grid!r})
"""


def kill_in_child(copy, name, where, last="os.kill(os.getpid(), signal.SIGKILL)"):
    """Run tsara in a process; it and its child, which writes the column, are killed at a point of the child."""
    start = begun_with(FAMILY_DIES.format(last=last) + where)
    killed(KILLED.format(start=start, vis=str(copy), name=str(name), grid=GRID))


@pytest.mark.slow
@pytest.mark.parametrize("where, most_written", [
    ('dies_in(model_column, "_mark", after=True)', None),
    ('dies_in(model_column, "_at_field_centre", 6)', 0.7),
], ids=["before it is added", "in the middle"])
def test_kill_9_while_the_column_is_written(vis, uninterrupted, copy, tmp_path, where, most_written):
    """The images are whole, the rest of the MeasurementSet is as it was, and niter = 0 finishes the column."""
    model, _ = uninterrupted
    kill_in_child(copy, tmp_path / "source", where)
    images = products_of(tmp_path)
    assert {name.split("/")[0] for name in images} == {f"source.{kind}" for kind in (
        "psf", "residual", "model", "image", "sumwt", "pb", "sara.json", "lock")}
    assert (copy / INCOMPLETE).exists() and incomplete_columns([str(copy), vis]) == [str(copy)]
    assert "restart=True, niter=0, savemodel='modelcolumn'" in (copy / INCOMPLETE).read_text()
    assert_the_rest_is_as_it_was(copy, vis)
    if most_written is not None:
        half = column(copy, "MODEL_DATA")
        there = np.isclose(half, model, atol=1e-5)
        assert np.all(there | (half == 1))  # CASA's default
        assert there.any() and there.mean() <= most_written
        casa_goes_on(copy, tmp_path)

    result = tsara(vis=str(copy), imagename=str(tmp_path / "source"), **FINISH)
    assert result["iterdone"] == 0 and result["summaryminor"][0][0][0]["peakRes"][0] > 0
    np.testing.assert_array_equal(column(copy, "MODEL_DATA"), model)
    assert not (copy / INCOMPLETE).exists()
    assert_the_rest_is_as_it_was(copy, vis)
    assert products_of(tmp_path) == {name: digest for name, digest in images.items() if name != "source.lock"}


def casa_goes_on(copy, folder):
    """The table tool, tclean and gaincal work on a MeasurementSet whose model column is half written."""
    import casatasks

    edit(copy, "FLAG", lambda flag: flag)
    casatasks.tclean(vis=str(copy), imagename=str(folder / "clean"), imsize=64, cell="1arcsec", niter=5,
                     datacolumn="data")
    casatasks.gaincal(vis=str(copy), caltable=str(folder / "gains"), solint="inf", refant="0")
    assert np.isfinite(column(folder / "gains", "CPARAM")).all()


def test_an_incomplete_column_is_pointed_out_by_the_next_run(copy, tmp_path, monkeypatch):
    (copy / INCOMPLETE).touch()
    said = []
    monkeypatch.setattr("casa_sara.private.task_tsara.log.warn", said.append)
    tsara(vis=str(copy), imagename=str(tmp_path / "source"), **GRID | {"niter": 0})
    assert any(f"MODEL_DATA of '{copy}' is incomplete" in line for line in said)


@pytest.mark.slow
def test_the_child_ends_with_its_parent(copy, tmp_path):
    """kill -9 of the session alone: nothing goes on writing behind its back."""
    pid = tmp_path / "pid"
    last = f"open({str(pid)!r}, 'w').write(str(os.getpid())); time.sleep(120)"
    kill_in_child(copy, tmp_path / "source", 'dies_in(model_column, "_at_field_centre", 6)', last)
    for _ in range(300):
        if pid.exists() and pid.read_text() and not os.path.exists(f"/proc/{pid.read_text()}"):
            break
        time.sleep(0.1)
    else:
        pytest.fail("the child goes on")
    assert (copy / INCOMPLETE).exists()


@pytest.mark.slow
@pytest.mark.parametrize("left", [0, 8_000, 60_000])
def test_a_disk_that_fills_while_the_column_is_added(vis, uninterrupted, tmp_path, monkeypatch, left):
    """An error that says so, the MeasurementSet as it was; when there is room again, the same session finishes."""
    model, images = uninterrupted
    for kind in ("model", "residual"):
        shutil.copytree(f"{images}.{kind}", tmp_path / f"source.{kind}")
    with small_disk(tmp_path / "disk", 3_000) as disk:
        copy = shutil.copytree(vis, disk / "c.ms")
        before = hashes(copy, "table.lock")

        def filled(*args, **kwargs):
            fill(disk, left)
            in_child(*args, **kwargs)

        monkeypatch.setattr(model_column, "in_child", filled)
        with pytest.raises(OSError, match="savemodel = 'modelcolumn': MODEL_DATA could not be written, the disk is "
                                          "full: .*; the MeasurementSets are as they were"):
            tsara(vis=str(copy), imagename=str(tmp_path / "source"), **FINISH)
        assert hashes(copy, "table.lock") == before
        assert_the_rest_is_as_it_was(copy, vis)
        (disk / "filler").unlink()
        monkeypatch.undo()
        tsara(vis=str(copy), imagename=str(tmp_path / "source"), **FINISH)
        np.testing.assert_array_equal(column(copy, "MODEL_DATA"), model)


@pytest.mark.slow
def test_a_disk_that_is_full_when_the_column_is_due(vis, uninterrupted, tmp_path, monkeypatch):
    """Refused before imaging, and again at the last phase, when the images are whole."""
    model, _ = uninterrupted
    with small_disk(tmp_path / "disk", 3_000) as disk:
        copy = shutil.copytree(vis, disk / "c.ms")
        before = hashes(copy, "table.lock")
        filler = fill(disk, 200_000)
        words = "savemodel = 'modelcolumn' needs .* MB for MODEL_DATA, but the disk of"
        with pytest.raises(OSError, match=words) as raised:
            tsara(vis=str(copy), imagename=str(tmp_path / "never"), savemodel="modelcolumn", **GRID)
        assert raised.value.errno == errno.ENOSPC and not (tmp_path / "never.model").exists()
        filler.unlink()
        monkeypatch.setattr("casa_sara.imaging.plane_images.fit_beam", fit_beam_and(lambda: fill(disk, 200_000)))
        with pytest.raises(OSError, match=words):
            tsara(vis=str(copy), imagename=str(tmp_path / "source"), savemodel="modelcolumn", **GRID)
        assert (tmp_path / "source.sara.json").exists() and hashes(copy, "table.lock") == before
        monkeypatch.undo()
        (disk / "filler").unlink()
        tsara(vis=str(copy), imagename=str(tmp_path / "source"), **FINISH)
        np.testing.assert_array_equal(column(copy, "MODEL_DATA"), model)


@pytest.mark.slow
def test_a_disk_that_fills_after_the_column_was_added(vis, uninterrupted, tmp_path, monkeypatch):
    """The column is left incomplete, and said to be; when there is room again, the same session finishes it."""
    model, images = uninterrupted
    for kind in ("model", "residual"):
        shutil.copytree(f"{images}.{kind}", tmp_path / f"source.{kind}")
    with small_disk(tmp_path / "disk", 3_000) as disk:
        copy = shutil.copytree(vis, disk / "c.ms")
        monkeypatch.setattr(child_process, "_START", begun_with(f"""
import casa_sara.casa.ms.model_column as model_column
original = model_column._write
def filled(*args):
    state = os.statvfs({str(disk)!r})
    open({str(disk / 'filler')!r}, "wb", buffering=0).write(bytes(state.f_bavail * state.f_frsize))
    return original(*args)
model_column._write = filled
"""))
        words = f"the disk is full: .*; MODEL_DATA of {copy} is incomplete; restart=True"
        with pytest.raises(OSError, match=words) as got:
            tsara(vis=str(copy), imagename=str(tmp_path / "source"), **FINISH)
        assert got.value.errno == errno.ENOSPC and (copy / INCOMPLETE).exists()
        assert_the_rest_is_as_it_was(copy, vis)
        (disk / "filler").unlink()
        monkeypatch.undo()
        tsara(vis=str(copy), imagename=str(tmp_path / "source"), **FINISH)
        np.testing.assert_array_equal(column(copy, "MODEL_DATA"), model)
        assert not (copy / INCOMPLETE).exists()


@pytest.mark.parametrize("fault, words", [
    (undefined("MODEL_DATA"), "row 0 is empty"),
    (undefined("MODEL_DATA", range(100, 200), manager="TiledShapeStMan"), "row 100 is empty"),
    (shaped("MODEL_DATA", None, (2, 5)), r"row 0 has the shape \[2, 5\]"),
    (shaped("MODEL_DATA", [70], (2, 2), manager="TiledShapeStMan"), r"row 70 has the shape \[2, 2\]"),
], ids=["no cells", "some cells", "another shape", "another shape in one row"])
def test_a_column_that_cannot_be_written_is_refused_first(uninterrupted, copy, tmp_path, fault, words):
    """Before anything is imaged, and the advice is good."""
    import casatasks

    model, images = uninterrupted
    shutil.copytree(f"{images}.model", tmp_path / "source.model")
    add_column(copy, "MODEL_DATA", column(copy, "DATA"))
    fault(copy)
    before = hashes(copy, "table.lock")
    for call in (FINISH, GRID | dict(savemodel="modelcolumn", overwrite=True)):
        with pytest.raises(ValueError, match=f"savemodel = 'modelcolumn': vis = .*MODEL_DATA of {words}") as raised:
            tsara(vis=str(copy), imagename=str(tmp_path / "source"), **call)
        assert f"casatasks.delmod(vis='{copy}', otf=False, scr=True)" in str(raised.value)
    assert hashes(copy, "table.lock") == before and not (tmp_path / "source.image").exists()
    casatasks.delmod(vis=str(copy), otf=False, scr=True)
    tsara(vis=str(copy), imagename=str(tmp_path / "source"), savemodel="modelcolumn", overwrite=True, **GRID)
    np.testing.assert_array_equal(column(copy, "MODEL_DATA"), model)


def fit_beam_and(also):
    from casa_sara.casa.images.restore import fit_beam

    def fitted(*args):
        also()
        return fit_beam(*args)

    return fitted


def test_read_only_measurement_set(copy, tmp_path):
    """It is imaged as any other; a model column is refused before the imaging begins."""
    before = hashes(copy)
    with read_only(copy):
        words = f"savemodel = 'modelcolumn' writes into vis = '{copy}', but .* is write-protected"
        with pytest.raises(PermissionError, match=words):
            tsara(vis=str(copy), imagename=str(tmp_path / "source"), savemodel="modelcolumn", **GRID)
        assert not list(tmp_path.glob("source*"))
        tsara(vis=str(copy), imagename=str(tmp_path / "source"), **GRID)
    assert os.path.isdir(tmp_path / "source.image") and hashes(copy) == before
