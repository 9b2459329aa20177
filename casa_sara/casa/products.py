"""What one run leaves under one name: the images .psf .residual .model .image .sumwt .pb, and the record .sara.json."""

from __future__ import annotations

import errno
import os
import shutil
import tempfile
from contextlib import contextmanager

import numpy as np

from casa_sara.casa.images import write_image
from casa_sara.casa.restore import restore
from casa_sara.casa.tools import opened

__all__ = [
    "CHECKPOINT", "RECORD", "REPORT", "check_imagename", "existing_products", "history_lines", "new_products",
    "remove_products", "write_products",
]

PRODUCTS = (".psf", ".residual", ".model", ".image", ".sumwt", ".pb")
CHECKPOINT = ".checkpoint"  # of a run that has not finished; no product
RECORD, REPORT = ".sara.json", ".report"  # written last, by the task; the report is a folder


def existing_products(imagename):
    """Return the paths of the products that stand under this name."""
    return [imagename + suffix for suffix in (*PRODUCTS, RECORD, REPORT) if os.path.lexists(imagename + suffix)]


def remove_products(imagename):
    """Remove the products that stand under this name."""
    for path in existing_products(imagename):
        shutil.rmtree(path) if os.path.isdir(path) and not os.path.islink(path) else os.unlink(path)


def check_imagename(imagename, shape):
    """Raise unless the products of an image of this shape can be written under this name.

    Raises
    ------
    ValueError, FileNotFoundError, PermissionError, OSError
        No name; its folder is missing, cannot be written to, or has too little space left.
    """
    folder, base = os.path.split(imagename)
    folder = folder or "."
    if not base:
        raise ValueError(f"imagename = '{imagename}' is not a name: it takes the images' common root, as 'run/source'")
    if not os.path.isdir(folder):
        raise FileNotFoundError(f"imagename = '{imagename}': the folder '{folder}' does not exist")
    if not os.access(folder, os.W_OK | os.X_OK):
        raise PermissionError(f"imagename = '{imagename}': the folder '{folder}' cannot be written to")
    needed = (len(PRODUCTS) * 4 + 3) * int(np.prod(shape)) + 2_000_000
    free = shutil.disk_usage(folder).free
    if free < needed:
        space = f"the images take {needed / 1e6:.0f} MB, '{folder}' has {free / 1e6:.0f} MB left"
        raise OSError(errno.ENOSPC, f"imagename = '{imagename}': {space}")


@contextmanager
def new_products(imagename):
    """Yield the name under which to write the products; they take their place when all are complete.

    They are written in a temporary folder beside `imagename`. At the end those of an older
    run are replaced, all together; when something fails, everything stays as it was. The folder
    of the report, where others may have put files, is left to who writes reports.
    """
    folder, base = os.path.split(imagename)
    scratch = tempfile.mkdtemp(prefix=f".{base}.", dir=folder or ".")
    try:
        yield os.path.join(scratch, base)
        written = os.listdir(scratch)
        replaced = tempfile.mkdtemp(dir=scratch)
        for path in existing_products(imagename):
            if path.endswith(REPORT):
                continue
            os.rename(path, os.path.join(replaced, os.path.basename(path)))
        for name in written:
            os.rename(os.path.join(scratch, name), os.path.join(folder, name))
    finally:
        shutil.rmtree(scratch, ignore_errors=True)


def write_products(imagename, plane, images, sumwt, beam, restoringbeam=None, history=()):
    """Write the products of a run, as tclean does.

    Parameters
    ----------
    imagename : str
    plane : ImagePlane
    images : dict of float32 (nx, ny)
        'psf' and 'residual' of `weights.dirty_image` (the PSF is 1 at its centre, the
        residual in Jy/beam) and 'model' in Jy/pixel.
    sumwt : float
    beam : dict
        Of `restore.fit_beam`.
    restoringbeam : str or sequence, optional
        As tclean's; None leaves out the restored image.
    history : sequence of str
        Lines for the history of every image.
    """
    with new_products(imagename) as root:
        write_image(root + ".psf", images["psf"], plane, beam=beam)
        write_image(root + ".residual", images["residual"], plane, masked=True)
        write_image(root + ".model", images["model"], plane, unit="Jy/pixel")
        write_image(root + ".pb", plane.pb, plane, masked=True)
        write_image(root + ".sumwt", np.array([[sumwt]], np.float32), plane)
        if restoringbeam is not None:
            restore(root, restoringbeam)
        for path in existing_products(root):
            with opened("image", path) as ia:
                ia.sethistory(origin="tsara", history=list(history))


def history_lines(taskname, parameters):
    """Return the lines that a CASA task writes into the history of its images.

    Parameters
    ----------
    taskname : str
    parameters : dict
        Task parameters, in order.
    """
    import casatools

    import casa_sara

    lines = [f"taskname={taskname}", f"version: casa_sara {casa_sara.__version__}, CASA {casatools.version_string()}"]
    for name, value in parameters.items():
        lines.append(f"{name:<11} = " + (f'"{value}"' if isinstance(value, str) else str(value)))
    return lines
