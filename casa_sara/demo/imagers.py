"""Runs tsara and tclean on the same data and reads their images."""

from __future__ import annotations

import multiprocessing
import os
import sys
import time
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from casatools import image

from casa_sara import tsara

__all__ = ["Case", "Product", "run_tsara", "run_tcleans", "read_image", "quiet", "write_comparison"]

TCLEAN_WEIGHTINGS = {"tclean Briggs −1": ("briggs", -1.0), "tclean natural": ("natural", 0.0)}


@dataclass(frozen=True)
class Case:
    """One set of data and how it is imaged.

    `clean` holds the parameters of tclean that depend on the source (scales, niter …), for each weighting.
    """

    folder: Path
    vis: list[str]
    imsize: list[int]
    cell_arcsec: float
    clean: dict[str, dict] = field(default_factory=dict)

    def common(self, imagename: str) -> dict:
        """Return the parameters that tsara and tclean share."""
        return {
            "vis": self.vis,
            "imagename": str(self.folder / imagename),
            "imsize": self.imsize,
            "cell": f"{self.cell_arcsec}arcsec",
            "datacolumn": "data",
        }


@dataclass(frozen=True)
class Product:
    """What an imager made: images (nx, ny), the beam (arcsec, arcsec, degrees), iterations and seconds."""

    name: str
    model: np.ndarray
    restored: np.ndarray
    residual: np.ndarray
    beam: tuple[float, float, float]
    iterations: int
    wall_s: float
    cpu_s: float


def run_tsara(case: Case, name: str = "tsara") -> Product:
    """Image a case with tsara under a name; restored and residual images are weighted as tclean's with Briggs −1."""
    wall, cpu = time.perf_counter(), time.process_time()
    made = tsara(**case.common(name), weighting="briggs", robust=-1.0)
    times = time.perf_counter() - wall, time.process_time() - cpu
    return _product(name, case.folder / name, made["iterdone"], *times)


def run_tcleans(case: Case) -> list[Product]:
    """Image a case with tclean multiscale, Briggs −1 and natural, each in a process and on a core of its own."""
    threads = os.environ.get("OMP_NUM_THREADS")
    os.environ["OMP_NUM_THREADS"] = "1"  # a second thread costs the multiscale minor cycle more than it brings
    try:
        with ProcessPoolExecutor(2, multiprocessing.get_context("spawn")) as pool:
            made = list(pool.map(_tclean, [case] * 2, TCLEAN_WEIGHTINGS.values()))
    finally:
        del os.environ["OMP_NUM_THREADS"]
        if threads is not None:
            os.environ["OMP_NUM_THREADS"] = threads
    return [_product(name, *result) for name, result in zip(TCLEAN_WEIGHTINGS, made)]


def write_comparison(case: Case, **more: Any) -> tuple[str, Path]:
    """Compare the three products of a case as the task saracompare does; return its tables as text, and the report.

    `more` is the rest of `casa_sara.options.Comparing`.
    """
    from casa_sara.analysis.report import write_report
    from casa_sara.analysis.tables import as_text
    from casa_sara.comparison.compare_images import compare_images
    from casa_sara.options import Comparing, Selection
    from casa_sara.runtime.machine import available_cores

    roots = tuple(str(case.folder / name) for name in ("tsara", "tclean_briggs", "tclean_natural"))
    request = Comparing(roots, ("tsara", *TCLEAN_WEIGHTINGS), **more, nthreads=available_cores())
    with quiet(case.folder / "comparison.txt"):
        comparison = compare_images(request, Selection(tuple(case.vis), datacolumn="data"))
        page = write_report(comparison, case.folder / "report", f"tsara beside tclean: {case.folder.name}")
    return as_text(comparison), page


def _tclean(case: Case, weighting: tuple[str, float]) -> tuple[Path, int, float, float]:
    """Run tclean in a process of its own; return the images' path, iterations, wall and CPU seconds."""
    root = case.folder / f"tclean_{weighting[0]}"
    with quiet(root.with_suffix(".txt")):
        from casatasks import tclean

        wall, cpu = time.perf_counter(), time.process_time()
        chosen = {"weighting": weighting[0], "robust": weighting[1], **case.clean[weighting[0]]}
        made = tclean(**case.common(root.name), deconvolver="multiscale", **chosen)
        return root, made["iterdone"], time.perf_counter() - wall, time.process_time() - cpu


def _product(name, root, iterations, wall_s, cpu_s) -> Product:
    """Read the images of one run."""
    model, _ = read_image(f"{root}.model")
    restored, beam = read_image(f"{root}.image")
    residual, _ = read_image(f"{root}.residual")
    return Product(name, model, restored, residual, beam, iterations, wall_s, cpu_s)


def read_image(name: str | Path) -> tuple[np.ndarray, tuple[float, float, float] | None]:
    """Return a CASA image's pixels, float64 (nx, ny), and its beam (arcsec, arcsec, degrees) if it has one."""
    ia = image()
    ia.open(str(name))
    try:
        pixels = ia.getchunk()[:, :, 0, 0].astype(float)
        beam = ia.restoringbeam()
    finally:
        ia.close()
    if not beam:
        return pixels, None
    return pixels, (beam["major"]["value"], beam["minor"]["value"], beam["positionangle"]["value"])


@contextmanager
def quiet(log: str | Path) -> Iterator[None]:
    """Send what CASA writes to the terminal, from C++ too, to the end of a file."""
    sys.stdout.flush()
    sys.stderr.flush()
    kept = os.dup(1), os.dup(2)
    with open(log, "ab") as file:
        try:
            os.dup2(file.fileno(), 1)
            os.dup2(file.fileno(), 2)
            yield
        finally:
            sys.stdout.flush()
            sys.stderr.flush()
            os.dup2(kept[0], 1)
            os.dup2(kept[1], 2)
            os.close(kept[0])
            os.close(kept[1])
