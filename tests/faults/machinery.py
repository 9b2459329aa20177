"""Real faults for tests: small disks, read-only mounts, other users, and runs that kill themselves on the way."""

import hashlib
import os
import signal
import subprocess
import sys
from contextlib import contextmanager
from pathlib import Path

import pytest

NOBODY = 65534


@contextmanager
def small_disk(folder, kilobytes):
    """Mount a file system of this size over an empty folder; the test is skipped where that is not permitted."""
    folder = Path(folder)
    folder.mkdir(exist_ok=True)
    if not _mounted("-t", "tmpfs", "-o", f"size={kilobytes}k", "none", folder):
        pytest.skip("file systems cannot be mounted here")
    try:
        yield folder
    finally:
        subprocess.run(["umount", "-l", folder], check=True)


@contextmanager
def read_only(folder):
    """Mount a folder over itself, read-only: also root cannot write to it."""
    if not _mounted("--bind", folder, folder):
        pytest.skip("file systems cannot be mounted here")
    try:
        subprocess.run(["mount", "-o", "remount,bind,ro", folder], check=True)
        yield
    finally:
        subprocess.run(["umount", "-l", folder], check=True)


def _mounted(*words):
    try:
        return subprocess.run(["mount", *map(str, words)], capture_output=True).returncode == 0
    except FileNotFoundError:
        return False


def free_bytes(folder):
    """Bytes left on the disk of a folder."""
    state = os.statvfs(folder)
    return state.f_bavail * state.f_frsize


def fill(folder, leave_bytes=0):
    """Fill a small disk but for so many bytes; return the file that does it."""
    path = Path(folder) / "filler"
    with open(path, "wb", buffering=0) as file:
        count = max(0, free_bytes(folder) - leave_bytes)
        file.write(bytes(count))
    return path


PREAMBLE = """
import os, signal
from casa_sara import tsara

def die():
    os.kill(os.getpid(), signal.SIGKILL)

def dies_in(module, name, call=1, after=False):
    '''Let the process die at the beginning (or end) of the call-th call of module.name.'''
    original, calls = getattr(module, name), []
    def dying(*args, **kwargs):
        calls.append(1)
        if len(calls) == call and not after:
            die()
        result = original(*args, **kwargs)
        if len(calls) == call:
            die()
        return result
    setattr(module, name, dying)
"""


def begun_with(script):
    """Return the program of the child process of `casa_sara.casa.runtime.child_process`,
    with a script of Python before its job."""
    from casa_sara.casa.runtime import child_process

    first, main = child_process._START.rsplit("; ", 1)
    return f"{first}\n{PREAMBLE}{script}\n{main}"


def start_script(script, *arguments, **options):
    """Start a script of Python, after `PREAMBLE`, in a process of its own."""
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    return subprocess.Popen([sys.executable, "-c", PREAMBLE + script, *arguments], env=environment, text=True,
                            stdout=subprocess.PIPE, stderr=subprocess.STDOUT, **options)


def run_script(script, *arguments):
    """Run such a script; return its process, ended, and what it said."""
    process = start_script(script, *arguments)
    try:
        said, _ = process.communicate(timeout=120)
    finally:
        process.kill()
    return subprocess.CompletedProcess(process.args, process.returncode, said)


def killed(script):
    """Run a script that is to kill itself, and see that it did."""
    ended = run_script(script)
    assert ended.returncode == -signal.SIGKILL, ended.stdout[-2000:]


def hashes(folder, *leave_out):
    """Return the digest of every file in a folder, but for those of these names."""
    return {str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest()
            for path in Path(folder).rglob("*") if path.is_file() and path.name not in leave_out}
