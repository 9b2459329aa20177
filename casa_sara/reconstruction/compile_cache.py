"""The compiled kernels, made ready by a thread while CASA reads.

Numba compiles a kernel when it is first called, and keeps it on the disk (:mod:`casa_sara.runtime.jit`); after that a
new process loads it. All kernels of a solution are compiled in one go by the first process that needs them, with the
help of a second process that compiles those of the dictionary; a mark beside them then says so. `python -m
casa_sara.reconstruction.compile_cache` compiles beforehand.
"""

from __future__ import annotations

import fcntl
import hashlib
import os
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from types import SimpleNamespace

import llvmlite.binding as llvm
import numba
import numpy as np

from casa_sara.operators._wavelet_kernels import transform
from casa_sara.operators.dictionary import SaraDictionary
from casa_sara.operators.measurement import MeasurementOperator
from casa_sara.solver.adaptive_ppd import AdaptivePPD
from casa_sara.solver.nnls import NNLSFit, nnls

__all__ = ["compile_kernels", "kernels_loading", "use_every_kernel"]

HELPER_SECONDS = 120.0  # after which this process compiles what the helper should have
SHAPE = (32, 32)
# sys.path comes along; the folder that Python puts first is the user's, whose files may have the names of modules
_HELP = ("import sys; sys.path[:] = sys.argv[1:]; "
         "from casa_sara.reconstruction.compile_cache import _use_dictionary; _use_dictionary()")


@contextmanager
def kernels_loading(tell: Callable[[str], None]) -> Iterator[None]:
    """Have a thread load the compiled kernels, a quarter of a second's work in a new process; the end waits for it.

    CASA's tools let other threads go on while they work, so that this costs next to nothing. Kernels that are not
    compiled yet are, which `tell` is told.

    Parameters
    ----------
    tell : callable
        Takes a line for the log.
    """
    mark = _mark()
    if mark is None:
        tell("compiling the numerical kernels, 10 to 20 s: no folder for compiled code can be written to, so that "
             "every process compiles them; set NUMBA_CACHE_DIR to a folder that can")
    elif not mark.exists():
        tell(f"compiling the numerical kernels for this computer, 5 to 10 s, once: later runs find them in "
             f"'{mark.parent}'")
    thread = threading.Thread(target=compile_kernels, name="casa_sara kernels")
    thread.start()
    try:
        yield
    finally:
        thread.join()


def compile_kernels() -> None:
    """Load every kernel of a solution, and compile those that are not on the disk yet.

    Several processes that find them missing at the same time wait for the first.
    """
    mark = _mark()
    if mark is None or mark.exists():
        use_every_kernel()
        return
    with _one_at_a_time(mark.parent):
        helper = None if mark.exists() else _helper()
        _use_operators()
        _wait_for(helper)
        _use_dictionary()
        with suppress(OSError):
            mark.touch()


def use_every_kernel() -> None:
    """Call every kernel of a solution once, on an image of 32×32 pixels and three visibilities."""
    _use_operators()
    _use_dictionary()


def _use_operators():
    """Call the kernels of the measurement operator and of the solver."""
    uv, image = np.array([[0.0, 1e3, 2e3], [0.0, 5e2, 1e3]]), np.ones(SHAPE, np.float32)
    for eps in (2e-5, 1e-6):  # of most solutions, and of the images: the gridding kernels are compiled for their width
        measurement = MeasurementOperator(uv, 1e-5, image.shape, eps=eps)
        vis = measurement.forward(image)
        measurement.adjoint(vis)
    precond, norm_sq = np.ones(3, np.float32), 3.0 * image.size
    model, _ = nnls(measurement, vis, precond, norm_sq, NNLSFit(max_iter=1))
    no_prior = SimpleNamespace(allocate=lambda: np.zeros(1, np.float32), dual_step=lambda *arguments: None)
    ppd = AdaptivePPD(measurement, no_prior, vis, np.array([0, 3]), precond, norm_sq)
    ppd.start_from(model)
    ppd.step()


def _use_dictionary():
    """Call the kernels of the dictionary."""
    dictionary, image = SaraDictionary(SHAPE), np.ones(SHAPE, np.float32)
    dual, weights = dictionary.allocate(), dictionary.allocate()
    dictionary.dual_step(image, dual, 0.0)
    dictionary.reweight(image, 1.0, 1.0, weights)


def _mark():
    """Return the path of the file that is there when everything is compiled, None where nothing is kept on the disk.

    Its name depends on all that compiled code depends on: sources, Numba, Python and processor.
    """
    folder = transform.stats.cache_path
    if folder is None:
        return None
    package = Path(__file__).parents[1]
    known = hashlib.sha256(repr((numba.__version__, sys.version_info[:2], llvm.get_host_cpu_name(),
                                 llvm.get_host_cpu_features().flatten())).encode())
    for source in sorted([*package.glob("operators/*.py"), *package.glob("solver/*.py"), package / "runtime/jit.py",
                          Path(__file__)]):
        known.update(source.read_bytes())
    return Path(folder) / f"casa_sara-{known.hexdigest()[:16]}.compiled"


@contextmanager
def _one_at_a_time(folder):
    """Wait for other processes that compile; without a lock, as on some network disks, go on all the same."""
    with suppress(OSError):
        folder.mkdir(parents=True, exist_ok=True)
    handle = None
    try:
        with suppress(OSError):
            handle = os.open(folder / "casa_sara.compiling", os.O_RDWR | os.O_CREAT, 0o600)
            fcntl.flock(handle, fcntl.LOCK_EX)
        yield
    finally:
        if handle is not None:
            os.close(handle)


def _helper():
    """Start the process that compiles the kernels of the dictionary; None where that cannot be."""
    if not sys.executable or (os.cpu_count() or 1) < 2:
        return None
    with suppress(OSError):
        return subprocess.Popen([sys.executable, "-c", _HELP, *filter(None, sys.path)], stdin=subprocess.DEVNULL,
                                stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)


def _wait_for(helper):
    """Wait for the end of the helper; what it has not compiled is compiled by who waits."""
    if helper is None:
        return
    try:
        helper.wait(HELPER_SECONDS)
    except subprocess.TimeoutExpired:
        helper.kill()
        helper.wait()


if __name__ == "__main__":
    compile_kernels()
