"""Products appear whole or not at all: full disks, kill -9 at every step, folders that cannot be written to."""

import errno
import os
import shutil
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from machinery import fill, free_bytes, hashes, killed, read_only, run_script, small_disk
from simulated_ms import pixels, simulate

pytest.importorskip("casatools")

from casa_sara import tsara
from casa_sara.casa.images import products
from casa_sara.casa.images.products import (
    PRODUCTS,
    RECORD,
    existing_products,
    new_products,
    recover_products,
    write_products,
)
from casa_sara.casa.runtime.child_process import ChildError, in_child

GRID = dict(imsize=64, cell="1arcsec", datacolumn="data")
ALL = [*PRODUCTS, RECORD]


@pytest.fixture(scope="module")
def vis(tmp_path_factory):
    return simulate(tmp_path_factory.mktemp("ms") / "c.ms", configuration="c", antennas=8, noise=0.05, seed=4)


@pytest.fixture(scope="module")
def run(vis, tmp_path_factory):
    """An earlier run: the folder of its products, and how `write_products` was called, but for its child process."""
    name, called = tmp_path_factory.mktemp("old") / "source", []

    def noted(*args):
        called.append(args[:-1])
        products.write_products(*args)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("casa_sara.imaging.continuum.write_products", noted)
        tsara(vis=vis, imagename=str(name), niter=2, **GRID)
    return name.parent, called[0]


@pytest.fixture(scope="module")
def old(run):
    return run[0]


def model(name):
    return pixels(f"{name}.model")


def fills_the_disk(monkeypatch, disk, left):
    """Let the disk fill up, but for so many bytes, when CASA begins to write."""
    def filled(*args, **kwargs):
        fill(disk, left)
        in_child(*args, **kwargs)

    monkeypatch.setattr(products, "in_child", filled)
    words = rf"imagename = '{disk}/source': '{disk}' filled up while .* MB they had .* left"
    return pytest.raises(OSError, match=words)


@pytest.mark.parametrize("left", [0, 40_000, 300_000, 700_000])
def test_a_disk_that_fills_while_the_images_are_written(run, tmp_path, monkeypatch, left):
    """With no byte left, in the first image, in a later one, and in the restored one."""
    old, (output, *rest) = run
    with small_disk(tmp_path / "disk", 8_000) as disk:
        output = replace(output, imagename=str(disk / "source"))
        shutil.copytree(old, disk, dirs_exist_ok=True)
        before = hashes(disk)
        with fills_the_disk(monkeypatch, disk, left) as raised:
            write_products(output, *rest)
        assert raised.value.errno == errno.ENOSPC
        (disk / "filler").unlink()
        assert hashes(disk) == before and free_bytes(disk) > 4_000_000
        monkeypatch.undo()
        write_products(output, *rest)
        assert hashes(disk) != before
        assert sorted(path.name for path in disk.iterdir()) == sorted("source" + suffix for suffix in ALL)


def test_the_session_goes_on_after_a_full_disk(vis, old, tmp_path, monkeypatch):
    with small_disk(tmp_path / "disk", 8_000) as disk:
        shutil.copytree(old, disk, dirs_exist_ok=True)
        before = hashes(disk)
        with fills_the_disk(monkeypatch, disk, 300_000):
            tsara(vis=vis, imagename=str(disk / "source"), niter=0, overwrite=True, **GRID)
        (disk / "filler").unlink()
        assert hashes(disk) == before
        monkeypatch.undo()
        tsara(vis=vis, imagename=str(disk / "source"), niter=0, overwrite=True, **GRID)
        assert not model(disk / "source").any()


def test_a_disk_without_room_is_refused_before_and_after_the_solution(vis, tmp_path, monkeypatch):
    with small_disk(tmp_path / "disk", 8_000) as disk:
        filler = fill(disk, 1_000_000)
        with pytest.raises(OSError,
                           match=r"imagename = '.*', imsize = .*: the images take 2.1 MB, '.*' has 1.0 MB left"):
            tsara(vis=vis, imagename=str(disk / "source"), niter=0, **GRID)
        filler.unlink()
        monkeypatch.setattr("casa_sara.imaging.plane_images.fit_beam", lambda *args: fill(disk, 1_000_000) and {})
        with pytest.raises(OSError,
                           match=r"imagename = '.*', imsize = .*: the images take 2.1 MB, '.*' has 1.0 MB left"):
            tsara(vis=vis, imagename=str(disk / "source"), niter=0, **GRID)
        assert [path.name for path in disk.iterdir()] == ["filler"]


def test_temporary_files_without_room(vis, tmp_path, monkeypatch):
    with small_disk(tmp_path / "disk", 8_000) as disk:
        monkeypatch.setattr(tempfile, "tempdir", str(disk))
        filler = fill(disk, 1_000_000)
        words = f"the folder of temporary files, '{disk}', has 1.0 MB left, and an image takes 2.0 MB"
        with pytest.raises(OSError, match=words):
            tsara(vis=vis, imagename=str(tmp_path / "source"), niter=0, **GRID)
        assert list(disk.iterdir()) == [filler] and list(tmp_path.iterdir()) == [disk]


def test_a_failure_of_casa_is_told_in_its_words(tmp_path):
    with pytest.raises(ChildError, match="missing 5 required positional arguments: 'csys'"):
        in_child(products.write_images, root=str(tmp_path / "x"), plane={}, images={}, sumwt=1.0, beam={}, output={})
    with pytest.raises(ChildError, match="posixpath:join is no function of casa_sara"):
        in_child(os.path.join)


STEPS = 1 + len(ALL) + 1 + 3  # to .whole, older ones away, to .moving, new ones to their places
KILLED_AT_EVERY_STEP = """
import sys
from casa_sara.casa.images.products import new_products
for step in range(int(sys.argv[2]) + 1):
    child = os.fork()
    if child:
        os.waitpid(child, 0)
        continue
    dies_in(os, "rename", step + 1)
    with new_products(f"{sys.argv[1]}/{step}/source") as root:
        for suffix in (".psf", ".model", ".sara.json"):
            os.mkdir(root + suffix)
            open(root + suffix + "/new", "w").close()
    die()
"""


def test_killed_between_any_two_renames(tmp_path):
    """After kill -9 at every step, the next run finds the older set or the new one, whole, and nothing else."""
    for step in range(STEPS + 1):
        for suffix in ALL:
            (tmp_path / f"{step}/source{suffix}").mkdir(parents=True)
            (tmp_path / f"{step}/source{suffix}/old").touch()
    assert run_script(KILLED_AT_EVERY_STEP, str(tmp_path), str(STEPS)).returncode == 0
    found = []
    for step in range(STEPS + 1):
        folder = tmp_path / str(step)
        on_the_way = set(os.listdir(folder)) - {"source" + suffix for suffix in ALL}
        assert bool(on_the_way) == (step < STEPS), "this step was not killed"
        recover_products(str(folder / "source"))
        left = sorted(str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file())
        older = sorted(f"source{suffix}/old" for suffix in ALL)
        newer = [f"source{suffix}/new" for suffix in (".model", ".psf", ".sara.json")]
        assert left in (older, newer), (step, left)
        assert len(os.listdir(folder)) == len(left)
        found.append(left == newer)
    assert found == [False] + [True] * STEPS


@pytest.mark.parametrize("after", [False, True], ids=["before writing", "before the record"])
def test_kill_9_while_products_are_written(vis, old, tmp_path, after):
    """The older products stay; what the dead run left is cleared by the next one of the same name, and only by that."""
    shutil.copytree(old, tmp_path, dirs_exist_ok=True)
    (tmp_path / ".source.new.new").mkdir()  # of a run called source.new
    before = hashes(tmp_path)
    killed(f"""
import casa_sara.casa.images.products as products
dies_in(products, "in_child", after={after})
tsara(vis={vis!r}, imagename={str(tmp_path / 'source')!r}, niter=0, overwrite=True, **{GRID!r})
""")
    left = hashes(tmp_path, "source.lock")
    assert {name: digest for name, digest in left.items() if not name.startswith(".")} == before
    assert (tmp_path / ".source.new").exists() and (tmp_path / ".source.new" / "source.image").exists() == after
    tsara(vis=vis, imagename=str(tmp_path / "source"), niter=0, overwrite=True, **GRID)
    expected = [".source.new.new", *("source" + suffix for suffix in ALL)]
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted(expected)
    assert not model(tmp_path / "source").any()


def test_a_set_that_was_complete_is_taken_by_the_next_run_whatever_it_does(vis, old, tmp_path):
    """Killed after the new set was complete: it has taken its place before the next run refuses to overwrite it."""
    with new_products(str(tmp_path / "source")) as root:
        (Path(root).parent / "source.psf").mkdir()
    shutil.copytree(old, tmp_path / ".source.whole")
    with pytest.raises(FileExistsError, match="overwrite = True"):
        tsara(vis=vis, imagename=str(tmp_path / "source"), niter=0, **GRID)
    assert hashes(tmp_path) == hashes(old) and np.any(model(tmp_path / "source"))
    assert len(existing_products(str(tmp_path / "source"))) == len(os.listdir(tmp_path)) == len(ALL)


def test_read_only_output_folder(vis, tmp_path):
    folder = tmp_path / "closed"
    folder.mkdir()
    with read_only(folder):
        words = f"imagename = '{folder}/source': the folder '{folder}' cannot be written to"
        with pytest.raises(PermissionError, match=words):
            tsara(vis=vis, imagename=str(folder / "source"), niter=0, **GRID)
        assert not list(folder.iterdir())
