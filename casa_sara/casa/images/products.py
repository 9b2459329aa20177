"""What one run leaves under one name: the images .psf .residual .model .image .sumwt .pb, those asked for beside them
(.mask .image.pbcor .model.pbcor .model.error .image.error .image.jackknife .draws.npz), .weight of a mosaic, .alpha
.alpha.error .subbands of spectra, and the record .sara.json.

They appear together (:mod:`casa_sara.runtime.atomic`), and replace those of an older run of this name together.
"""

from __future__ import annotations

import errno
import math
import os
import shutil
from contextlib import contextmanager
from dataclasses import asdict, replace

import numpy as np

from casa_sara.casa.images.image_files import write_image
from casa_sara.casa.images.image_plane import ImagePlane, relative_pb
from casa_sara.casa.images.restore import restore, restored_beam, write_corrected
from casa_sara.casa.runtime.child_process import ChildError, in_child
from casa_sara.casa.runtime.tools import opened
from casa_sara.options import Output
from casa_sara.runtime import jsonfile
from casa_sara.runtime.atomic import new_files, recover_files, sync
from casa_sara.version import __version__

__all__ = [
    "CHECKPOINT", "DRAWS", "PRODUCTS", "RECORD", "REPORT", "check_imagename", "existing_products", "history_lines",
    "new_products", "recover_products", "remove_products", "write_products",
]

PRODUCTS = (".psf", ".residual", ".model", ".image", ".sumwt", ".pb")
ON_REQUEST = (".mask", ".weight", ".image.pbcor", ".model.pbcor", ".model.error", ".image.error", ".image.jackknife",
              ".alpha", ".alpha.error", ".subbands")
DRAWS = ".draws.npz"  # of a bootstrap
CHECKPOINT = ".checkpoint"  # of a run that has not finished; no product
RECORD, REPORT = ".sara.json", ".report"  # the report, a folder, is written by the task after the others


def existing_products(imagename):
    """Return the paths of the existing products of this name."""
    return [imagename + suffix for suffix in (*PRODUCTS, *ON_REQUEST, DRAWS, RECORD, REPORT)
            if os.path.lexists(imagename + suffix)]


def remove_products(imagename):
    """Remove the existing products of this name."""
    for path in existing_products(imagename):
        shutil.rmtree(path) if os.path.isdir(path) and not os.path.islink(path) else os.unlink(path)


def check_imagename(imagename, shape, more=0):
    """Raise unless the products of an image of this shape, and as many `more`, can be written under this name.

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
    needed, free = _bytes_needed(shape, more), shutil.disk_usage(folder).free
    if free < needed:
        space = f"the images take {needed / 1e6:.1f} MB, '{folder}' has {free / 1e6:.1f} MB left"
        raise OSError(errno.ENOSPC, f"imagename = '{imagename}', imsize = {list(shape)}: {space}; free some, or choose "
                                    "another folder")


def _bytes_needed(shape, more=0):
    """Return the size of all products and `more` images: pixels, masks, and what is around them."""
    return ((len(PRODUCTS) + more) * 4 + 3 + more) * math.prod(shape) + 2_000_000


@contextmanager
def new_products(imagename):
    """Yield the name under which to write the products; they take their places when all are complete.

    Those of an older run are replaced, all together; when something fails, everything stays as it was. The folder
    of the report, where others may have put files, is left to who writes reports. No name of another run can give one
    of the folders in which products wait (:mod:`casa_sara.runtime.atomic`).
    """
    with new_files(imagename, lambda: _older(imagename)) as new:
        yield os.path.join(new, os.path.basename(imagename))


def recover_products(imagename):
    """Complete or remove the products of a run of this name that was killed while it wrote them."""
    recover_files(imagename, lambda: _older(imagename))


def _older(imagename):
    """Return the paths of the products that new ones replace."""
    return [path for path in existing_products(imagename) if not path.endswith(REPORT)]


def write_products(output, plane, images, sumwt, beam, record=None, child=None):
    """Write the products of a run, as tclean does.

    Parameters
    ----------
    output : casa_sara.options.Output
        Its `imagename`, `restoringbeam` and `history`, lines for the history of every image.
    plane : ImagePlane
        The image plane: coordinates, primary beam, mask.
    images : dict of float32 (nx, ny), or (n, nx, ny) of n channels or of n Stokes parameters
        'psf' and 'residual' of `weights.dirty_image` (the PSF is 1 at its centre, the
        residual in Jy/beam) and 'model' in Jy/pixel; 'mask', 'weight' of a mosaic, 'model.error', 'image.error' and
        'image.jackknife' where there are; 'draws' is a dict of arrays, kept as `DRAWS`. Of spectra, 'alpha' and
        'alpha.error', bool 'known' (nx, ny) where they are known, and 'subbands' (T, nx, ny) in Jy/pixel at 'freqs_hz'.
    sumwt : float, or one for each channel or Stokes parameter
        Sum of the imaging weights.
    beam : dict
        Of `restore.fit_beam`, or a list with one for each channel.
    record : dict, optional
        Kept as `RECORD`.
    child : Popen, optional
        Of `child.waiting_child`, to write in.

    Raises
    ------
    OSError
        The images could not be written, as on a full disk; everything is as it was before.
    """
    images, draws = {name: image for name, image in images.items() if name != "draws"}, images.get("draws")
    more = 2 * output.pbcor + sum(max(np.size(image) // math.prod(plane.pb.shape), 1) for name, image in images.items()
                                  if name not in ("psf", "residual", "model"))
    more += (plane.n_stokes - 1) * (len(PRODUCTS) + 2 * output.pbcor)
    check_imagename(output.imagename, plane.pb.shape, more)  # the disk may have filled up since the run began
    with new_products(output.imagename) as root:
        try:
            in_child(write_images, child, root=root, plane=vars(plane), images=images,
                     sumwt=np.asarray(sumwt, np.float32), beam=beam, output=asdict(output))
            if record is not None:
                jsonfile.save(root + RECORD, record)
            if draws is not None:
                np.savez_compressed(root + DRAWS, **draws)
            sync(os.path.dirname(root))
        except (ChildError, OSError) as error:
            raise _not_written(output.imagename, _bytes_needed(plane.pb.shape, more), os.path.dirname(root),
                               error) from error


def write_images(root, plane, images, sumwt, beam, output):
    """Write the images under the name `root`: what `write_products` has a child process do."""
    plane, output = ImagePlane(**plane), Output(**output)
    write_image(root + ".psf", images["psf"], plane, beam=beam)
    write_image(root + ".residual", images["residual"], plane, masked=plane.masks_all)
    seen = images["model"]
    if plane.sky_model:  # restored is what is seen of it, of flat noise as .residual
        seen = seen * relative_pb(images["weight"])
        write_image(root + ".weight", images["weight"], plane)
    write_image(root + ".model", seen, plane, unit="Jy/pixel")
    write_image(root + ".pb", plane.pb, plane, masked=True)
    write_image(root + ".sumwt", sumwt.reshape(-1, 1, 1), plane)
    if output.restoringbeam is not None:
        restore(root, output.restoringbeam, "cube" if plane.pb.ndim == 3 else "mfs")
    if plane.sky_model:
        shutil.rmtree(root + ".model")
        write_image(root + ".model", images["model"], plane, unit="Jy/pixel")
    if "mask" in images:
        write_image(root + ".mask", images["mask"], plane)
    if output.pbcor:
        write_corrected(root, plane, seen)
    _write_errors(root, plane, images, beam, output)
    if "subbands" in images:
        _write_spectra(root, plane, images, beam)
    for path in existing_products(root):
        with opened("image", path) as ia:
            ia.sethistory(origin="tsara", history=list(output.history))


def _write_errors(root, plane, images, beam, output):
    """Write the images of errors that there are."""
    if "model.error" in images:
        write_image(root + ".model.error", images["model.error"], plane, unit="Jy/pixel")
    for name in {"image.error", "image.jackknife"} & images.keys():
        words = list(output.restoringbeam)
        restored = [restored_beam(words, one) for one in beam] if isinstance(beam, list) else restored_beam(words, beam)
        write_image(f"{root}.{name}", images[name], plane, unit="Jy/beam", beam=restored, masked=plane.masks_all)


def _write_spectra(root, plane, images, beam):
    """Write the images of the spectra."""
    known = replace(plane, mask=images["known"])
    for name in ("alpha", "alpha.error"):
        write_image(f"{root}.{name}", images[name], known, beam=beam, masked=True)
    write_image(root + ".subbands", images["subbands"], replace(plane, csys=plane.csys_at(images["freqs_hz"])),
                unit="Jy/pixel")


def _not_written(imagename, needed, scratch, error):
    """Return the error why the images were not written: a full disk, or the error of CASA."""
    folder, free = os.path.dirname(imagename) or ".", shutil.disk_usage(scratch).free
    written = sum(os.lstat(os.path.join(parent, name)).st_blocks * 512
                  for parent, _, names in os.walk(scratch) for name in names)
    if free + written < needed:
        return OSError(errno.ENOSPC, f"imagename = '{imagename}': '{folder}' filled up while the images were written: "
                       f"of {needed / 1e6:.1f} MB they had {written / 1e6:.1f} MB, and {free / 1e6:.1f} MB are left")
    return OSError(errno.EIO, f"imagename = '{imagename}': the images could not be written in '{folder}': {error}")


def history_lines(taskname, parameters):
    """Return the lines that a CASA task writes into the history of its images.

    Parameters
    ----------
    taskname : str
        Name of the task.
    parameters : dict
        Task parameters, in order.
    """
    import casatools

    lines = [f"taskname={taskname}", f"version: casa_sara {__version__}, CASA {casatools.version_string()}"]
    for name, value in parameters.items():
        lines.append(f"{name:<11} = " + (f'"{value}"' if isinstance(value, str) else str(value)))
    return lines
