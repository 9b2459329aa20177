"""Outliers: small images elsewhere on the sky that are solved together with the main one, and their products."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from casa_sara.casa.images.image_files import read_model
from casa_sara.casa.images.image_plane import ImagePlane, define_image_plane
from casa_sara.casa.images.island_positions import located
from casa_sara.casa.images.masks import read_support
from casa_sara.casa.images.products import write_products
from casa_sara.casa.images.restore import fit_beam
from casa_sara.casa.ms.frames import direction_on_sky, rotation_between
from casa_sara.casa.ms.weights import dirty_image
from casa_sara.casa.runtime import log
from casa_sara.imaging.data_quality import check_confined, without_w_term
from casa_sara.imaging.plane_images import IMAGE_EPS, PlaneImages
from casa_sara.operators.measurement import check_cell, check_field
from casa_sara.operators.outliers import directions, rotation, stacked
from casa_sara.operators.sky import sky_operator
from casa_sara.options import Outlier

__all__ = ["OutlierPlane", "OutlierResult", "joint_start", "joint_support", "outlier_images", "outlier_planes",
           "with_islands", "with_turns", "write_outliers"]

MOST_TOLD = 5  # islands of each outlier that the log lists


@dataclass(frozen=True)
class OutlierPlane:
    """The plane of one outlier.

    `startmodel` real (nx, ny) in Jy/pixel and `support` bool (nx, ny) are None where there is none.
    """

    outlier: Outlier
    image_plane: ImagePlane
    startmodel: np.ndarray | None
    support: np.ndarray | None


@dataclass
class OutlierResult:
    """What was found of one outlier: its `images`, and its `islands`, as of the main image."""

    outlier: Outlier
    images: PlaneImages
    islands: list[dict[str, Any]]

    def summary(self):
        """Return what the record of the run says of it."""
        axes = {name: self.images.beam[name] for name in ("major", "minor", "positionangle")}
        return {"imagename": self.outlier.imagename, "phasecenter": self.outlier.grid.phasecenter,
                "imsize": list(self.outlier.grid.shape), "model_flux_jy": self.images.model_flux,
                "residual_peak_jy_per_beam": self.images.residual_peak, "sumwt": self.images.sumwt,
                "beam": {name: f"{axis['value']:.9g}{axis['unit']}" for name, axis in axes.items()},
                "islands": [dict(island) for island in self.islands]}


def with_turns(grid, data):
    """Return the grid whose outliers know how they lie to the main image.

    Parameters
    ----------
    grid : casa_sara.options.ImageGrid
        With its outliers.
    data : casa_sara.data.visibilities.Visibilities
        With the direction of the main image.

    Returns
    -------
    ImageGrid

    Raises
    ------
    ValueError
        Two of the images overlap, one is beyond the horizon of the main image, or its pixels are too large.
    """
    if not grid.outliers:
        return grid
    time = float(data.rows.time.min()) if data.rows.time.size else None
    turned = []
    for outlier in grid.outliers:
        matrix = rotation_between(data.phase_center, direction_on_sky(outlier.grid.phasecenter), time)
        turned.append(replace(outlier, turn=np.eye(3) if matrix is None else matrix))
    grid = replace(grid, outliers=tuple(turned))
    _check_apart(grid)
    for outlier in grid.outliers:
        _check_pixels(outlier, data)
    return grid


def _check_apart(grid):
    """Raise where images overlap, which leaves open in which of them a source is."""
    half = np.array([n * cell / 2 for n, cell in zip(grid.shape, grid.cell_rad)])
    boxes = {"the main image": (-half, half)}
    for outlier in grid.outliers:
        corners, name = directions(outlier), f"imagename = '{outlier.imagename}'"
        where = f"outlierfile: phasecenter = '{outlier.grid.phasecenter}' of {name}"
        if corners[2].min() <= 0:
            raise ValueError(f"{where} is beyond the horizon of the main image: should be less than 90 deg away")
        box = corners[:2].min(axis=1), corners[:2].max(axis=1)
        for other, (least, most) in boxes.items():
            if np.all(box[0] < most) and np.all(least < box[1]):
                raise ValueError(f"{where}: its image overlaps {other}: a source in both would be in either; should "
                                 "be a smaller imsize, a larger main image without this outlier, or another direction")
        boxes[f"that of {name}"] = box


def _check_pixels(outlier, data):
    """Raise where the pixels of an outlier are too large for the data, or its image too small; note a w-term."""
    reach = np.abs(outlier.turn @ data.uvw).max(axis=1, initial=0)
    data.notes.extend(without_w_term(reach[2], outlier.grid, f"the image '{outlier.imagename}'"))
    try:
        check_cell(reach[:2, None], outlier.grid.cell_rad)
        check_field(data.max_uv, outlier.grid.shape, outlier.grid.cell_rad)
    except ValueError as error:
        raise ValueError(f"outlierfile, imagename = '{outlier.imagename}': {error}") from error


def outlier_planes(request, data, grid):
    """Return the planes of the outliers.

    Parameters
    ----------
    request : casa_sara.options.ImagingRequest
        What the task was asked for.
    data : casa_sara.data.visibilities.Visibilities
        The samples.
    grid : casa_sara.options.ImageGrid
        Of :func:`with_turns`.

    Returns
    -------
    tuple of OutlierPlane
    """
    planes = []
    for outlier in grid.outliers:
        there = replace(data, phase_center=direction_on_sky(outlier.grid.phasecenter))
        plane = define_image_plane(there, request.selection, outlier.grid, request.output.pblimit)
        start = None
        if outlier.startmodel and not request.output.resume:
            start = read_model(outlier.startmodel, plane)
        if not plane.mask.any():
            data.notes.append(f"outlierfile: the primary beam is below pblimit = {request.output.pblimit:g} in all of "
                              f"image '{outlier.imagename}', whose pixels are masked; its model is not, and nothing is "
                              "where pblimit is negative")
        planes.append(OutlierPlane(outlier, plane, start, read_support(outlier.grid, plane)))
    return tuple(planes)


def joint_support(support, grid, outliers):
    """Return where main image and outliers may be non-zero, stacked; the pixels of masks, else all of an image.

    Parameters
    ----------
    support : bool (nx, ny) or None
        Of the main image.
    grid : casa_sara.options.ImageGrid
        Of the main image.
    outliers : list of OutlierPlane
        The others.

    Returns
    -------
    bool (nx, ny), stacked where there are outliers, or None
    """
    if not outliers:
        return support
    return stacked([np.ones(shape, bool) if own is None else own
                    for shape, own in zip(grid.shapes, [support, *(one.support for one in outliers)])])


def joint_start(start, grid, outliers):
    """Return the first model of main image and outliers, stacked: as :func:`joint_support`, None without any.

    Parameters
    ----------
    start : real (nx, ny) or None
        Of the main image.
    grid : casa_sara.options.ImageGrid
        Of the main image.
    outliers : list of OutlierPlane
        The others.

    Returns
    -------
    float32 (nx, ny), stacked where there are outliers, or None
    """
    starts = [start, *(one.startmodel for one in outliers)]
    if not outliers or all(own is None for own in starts):
        return start
    return stacked([np.zeros(shape, np.float32) if own is None else own for shape, own in zip(grid.shapes, starts)])


def with_islands(record, outliers, significance):
    """Take the islands of the outliers out of a record, with their places on the sky, and list them in the log.

    Parameters
    ----------
    record : casa_sara.solver.record.SolverRecord
        Whose islands are then those of the main image.
    outliers : list of OutlierPlane
        The planes.
    significance : float
        That was asked for.

    Returns
    -------
    list of list of dict
        The islands of each outlier.
    """
    found = []
    for number, one in enumerate(outliers, 1):
        of_part = [{name: value for name, value in island.items() if name != "part"}
                   for island in record.islands if island.get("part", 0) == number]
        islands = located(of_part, one.image_plane, one.outlier.grid.cell_rad)
        bright = [island for island in islands if island["snr"] >= significance]
        log.info(f"outlier '{one.outlier.imagename}': {len(bright)} islands of emission of {significance:g} sigma or "
                 f"more, {sum(island['flux_jy'] for island in islands):.4g} Jy in all")
        for island in bright[:MOST_TOLD]:
            log.info(f"  {island['right_ascension']} {island['declination']}: {island['flux_jy']:.4g} +- "
                     f"{island['flux_error_jy']:.2g} Jy, S/N {island['snr']:.3g}, FWHM {island['fwhm_arcsec']:.3g} "
                     "arcsec")
        found.append(islands)
    record.islands = [island for island in record.islands if "part" not in island]
    return found


def outlier_images(outliers, solution, main, options):
    """Make the images of each outlier, with the imaging weights of the main image.

    Parameters
    ----------
    outliers : sequence of OutlierPlane
        The planes.
    solution : object
        Its `outliers` are their models, real (nx, ny) in Jy/pixel, its `islands` what was found in them, and
        `part.data` the samples.
    main : PlaneImages
        Of the main image, with the visibilities that all models together leave.
    options : casa_sara.options.SolverOptions
        Whose number of threads is used.

    Returns
    -------
    list of OutlierResult
    """
    data, found = solution.part.data, []
    ones = np.ones(data.size if outliers else 0, np.complex64)
    for one, model, islands in zip(outliers, solution.outliers, solution.islands):
        outlier = one.outlier
        operator = sky_operator(outlier.turn @ data.uvw, outlier.grid, eps=IMAGE_EPS, nthreads=options.nthreads)
        psf = dirty_image(operator, ones, main.weights)
        residual = dirty_image(operator, main.left * rotation(data.uvw, outlier).conj(), main.weights)
        pixels = dict(psf=psf, residual=residual, model=model)
        if one.support is not None:
            pixels["mask"] = check_confined(model, one.support)
        images = PlaneImages(pixels, main.weights, main.sumwt, fit_beam(psf, one.image_plane))
        found.append(OutlierResult(outlier, images, islands))
    return found


def write_outliers(output, outliers, found):
    """Write the products of the outliers, each under its own name.

    Parameters
    ----------
    output : casa_sara.options.Output
        Of the main image.
    outliers : sequence of OutlierPlane
        The planes.
    found : list of OutlierResult
        Their images.
    """
    for one, result in zip(outliers, found):
        own, images = replace(output, imagename=one.outlier.imagename), result.images
        write_products(own, one.image_plane, images.pixels, images.sumwt, images.beam)
