"""Two runs under one name are kept apart: threads, processes, crashes, and file systems without locks."""

import errno
import fcntl
import os
import subprocess
import threading

import pytest
from machinery import killed, start_script
from simulated_ms import simulate

pytest.importorskip("casatools")

from casa_sara import tsara
from casa_sara.casa.runtime import lock
from casa_sara.casa.runtime.lock import one_run_of

HOLDS = """
import sys
from casa_sara.casa.runtime.lock import one_run_of
with one_run_of(sys.argv[1]):
    print("held", flush=True)
    sys.stdin.read()
"""


@pytest.fixture
def name(tmp_path):
    return str(tmp_path / "source")


def test_another_process_holds_the_name(name, tmp_path):
    other = start_script(HOLDS, name, stdin=subprocess.PIPE)
    try:
        assert other.stdout.readline() == "held\n"
        before = (tmp_path / "source.lock").read_text()
        words = rf"imagename = '{name}': process {other.pid} on .*, since 20\S+ \S+, is writing"
        with pytest.raises(BlockingIOError, match=words), one_run_of(name):
            pass
        with one_run_of(name + "2"), one_run_of(str(tmp_path / "sourc")):
            assert (tmp_path / "source.lock").read_text() == before
        other.kill()
        other.wait()
        assert (tmp_path / "source.lock").exists()  # and locks nothing
        with one_run_of(name):
            assert f'"pid": {os.getpid()}' in (tmp_path / "source.lock").read_text()
    finally:
        other.kill()
        other.communicate()
    assert not list(tmp_path.iterdir())


def test_threads_of_one_process_take_turns(name, tmp_path):
    """Many threads, again and again: never two at once, and each refusal names this process."""
    inside, most, entered, refused = 0, 0, 0, []
    counting = threading.Lock()

    def work():
        nonlocal inside, most, entered
        for _ in range(200):
            try:
                with one_run_of(name):
                    with counting:
                        inside, entered = inside + 1, entered + 1
                        most = max(most, inside)
                    with counting:
                        inside -= 1
            except BlockingIOError as error:
                refused.append(str(error))

    threads = [threading.Thread(target=work) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert most == 1 and entered + len(refused) == 800 and entered > 0
    assert not list(tmp_path.iterdir())
    with one_run_of(name), pytest.raises(BlockingIOError, match=f"process {os.getpid()} on "), one_run_of(name):
        pass


def test_a_run_that_ends_while_the_next_one_begins(name, monkeypatch):
    """The file is opened, then its holder removes it and ends: the lock on it would keep nobody off."""
    original, calls = lock._lock, []

    def late(*args):
        if not calls:
            os.unlink(name + ".lock")
        calls.append(args)
        original(*args)

    monkeypatch.setattr(lock, "_lock", late)
    with one_run_of(name), pytest.raises(BlockingIOError), one_run_of(name):
        pass
    assert len(calls) == 3


def test_an_error_inside_gives_the_lock_back(name, tmp_path):
    with pytest.raises(KeyboardInterrupt), one_run_of(name):
        raise KeyboardInterrupt
    assert not list(tmp_path.iterdir())


def test_a_file_of_something_else_is_left_alone(name, tmp_path):
    """Also a link to one."""
    (tmp_path / "source.lock").write_text("precious")
    with pytest.raises(FileExistsError, match="source.lock' is not a lock file of tsara"), one_run_of(name):
        pass
    os.symlink(tmp_path / "source.lock", tmp_path / "other.lock")
    with pytest.raises(OSError, match="other.lock"), one_run_of(str(tmp_path / "other")):
        pass
    assert (tmp_path / "source.lock").read_text() == "precious"


def test_a_lock_that_was_removed_is_not_the_lock_any_more(name, tmp_path):
    """The user removed the file of a run: that run does not remove its successor's."""
    with one_run_of(name):
        os.unlink(name + ".lock")
        with one_run_of(name):
            first = os.stat(name + ".lock").st_ino
    with one_run_of(name) as _:
        os.unlink(name + ".lock")
        (tmp_path / "source.lock").write_text("of another run")
    assert first and (tmp_path / "source.lock").read_text() == "of another run"


def test_a_file_system_without_locks_is_pointed_out(name, tmp_path, monkeypatch):
    """Such as a network disk without a lock daemon, which no test can mount."""
    def refuse(*args):
        raise OSError(errno.ENOLCK, "No locks available")

    said = []
    monkeypatch.setattr(fcntl, "flock", refuse)
    monkeypatch.setattr(lock.log, "warn", said.append)
    with one_run_of(name):
        assert "source: the file system does not support locks" in said[0].replace("'", "")
    assert not list(tmp_path.iterdir())


def test_tsara_takes_the_lock_before_it_reads_and_gives_it_back(name, tmp_path):
    vis = simulate(tmp_path / "a.ms", antennas=5)
    grid = dict(vis=vis, imagename=name, imsize=32, cell="3arcsec", datacolumn="data", niter=0)
    with one_run_of(name), pytest.raises(BlockingIOError, match="is writing under this name"):
        tsara(**grid | {"field": "NOWHERE"})
    killed(f"""
import casa_sara.imaging.continuum as imaging
dies_in(imaging, "read_visibilities")
tsara(**{grid!r})
""")
    assert os.path.exists(name + ".lock")
    tsara(**grid)
    assert not os.path.exists(name + ".lock") and os.path.exists(name + ".image")
