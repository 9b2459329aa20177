"""The images of one plane that are not solved for: PSF, residual, the sum of the weights and the fitted beam."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from casa_sara.casa.images.restore import fit_beam
from casa_sara.casa.ms.weights import dirty_image, imaging_weights, sum_of_weights
from casa_sara.imaging.mosaic import flat_noise, weight_image
from casa_sara.operators.measurement import Summed
from casa_sara.operators.piecewise import operator_on_disk
from casa_sara.operators.sky import sky_operator
from casa_sara.parallel.serial import SERIAL

__all__ = ["IMAGE_EPS", "PlaneImages", "plane_images", "point_spread", "residual_visibilities"]

IMAGE_EPS = 1e-6  # accuracy of the PSF, residual images and the model column


@dataclass
class PlaneImages:
    """The images of one plane: `pixels` are 'psf', 'residual', 'model' and, of a mosaic, 'weight', float32 (nx, ny).

    `weights` (M,) made them, of the visibilities that the model has left, complex (M,), where there are outliers.
    """

    pixels: dict[str, np.ndarray]
    weights: np.ndarray
    sumwt: float
    beam: dict
    left: np.ndarray | None = None

    @property
    def residual_peak(self) -> float:
        """Largest absolute pixel of the residual, Jy/beam."""
        return float(np.abs(self.pixels["residual"]).max())

    @property
    def model_flux(self) -> float:
        """Flux of the model, Jy."""
        return float(self.pixels["model"].sum(dtype=float))


def plane_images(data, model, grid, weighting, options, plane, comm=SERIAL):
    """Return the `PlaneImages` of a model (nx, ny) in Jy/pixel and the samples it was made of.

    Parameters
    ----------
    data : Visibilities
        The samples.
    model : real (nx, ny)
        Jy/pixel; (T, nx, ny) at the frequencies of `grid.subbands`, where there are some and the model differs there;
        stacked with those of the outliers, where there are some. The images are those of the main one.
    grid : ImageGrid
        Size, pixels, direction and gridder of the image.
    weighting : Weighting
        Imaging weights that were asked for.
    options : SolverOptions
        Whose number of threads is used.
    plane : ImagePlane
        For the beam.
    comm : casa_sara.parallel.serial.Serial or MPI
        Over whose ranks the samples are spread.

    Returns
    -------
    PlaneImages
    """
    weights, operator, psf, beam = point_spread(data, grid, weighting, options, plane, comm)
    if grid.is_mosaic:
        operator = _operator(data, grid, options, comm)
    seen = model if grid.subbands is None else grid.subbands.stacked(model)
    left = residual_visibilities(operator, data, grid, options, seen, comm)
    residual = dirty_image(operator, left, weights, comm)
    pixels = dict(psf=psf, residual=residual, model=model)
    if grid.is_mosaic:
        pixels["weight"] = weight_image(data, grid, weights, comm)
        pixels["residual"] = flat_noise(residual, pixels["weight"])
    if grid.is_cube and weighting.weighting == "uniform":  # tclean's density of a channel counts the correlations, too
        sumwt = float(weights.sum(dtype=float))
    else:
        sumwt = sum_of_weights(data, weights, grid.stokes)
    return PlaneImages(pixels, weights, comm.total(sumwt), beam, left if grid.outliers else None)


def residual_visibilities(operator, data, grid, options, model, comm):
    """Return the visibilities less those of a model; of samples on the disk what gives them piece by piece.

    These are predicted by the operator of the dirty images unless there are spectra, or outliers.

    Parameters
    ----------
    operator : object
        Of the dirty images.
    data, grid, options, model, comm
        As of :func:`plane_images`.

    Returns
    -------
    complex (M,) or callable
    """
    if data.scratch.on_disk and grid.spectrum is None:
        return lambda piece, operator: data.vis[piece] - operator.forward(model)
    if grid.spectrum is not None or grid.subbands is not None or grid.outliers:
        operator = _sky_operator(data, grid, options, comm, data.freq_hz)
    if data.scratch.on_disk:
        predicted = operator.forward_pieces(model)
        return lambda piece, _: data.vis[piece] - next(predicted)
    return data.vis - operator.forward(model)


def _sky_operator(data, grid, options, comm, freq_hz=None):
    """Return the operator of the samples, without weights."""
    if data.scratch.on_disk:
        return operator_on_disk(data.uvw, grid, freq_hz, IMAGE_EPS, options.nthreads, data.scratch)
    return sky_operator(data.uvw, grid, freq_hz, eps=IMAGE_EPS, nthreads=options.nthreads, comm=comm, beam=data.beam)


def _operator(data, grid, options, comm):
    """Return the operator of the dirty images, for flat spectra."""
    operator = _sky_operator(data, grid, options, comm)
    return operator if data.scratch.on_disk else Summed(operator, comm)


def point_spread(data, grid, weighting, options, plane, comm):
    """Return the imaging weights, the operator of the PSF (flat spectra), the PSF and its fitted beam.

    The PSF of a mosaic is that of all samples without their primary beams.
    """
    weights = imaging_weights(data, grid, weighting, comm)
    single = replace(grid, gridder="standard", mosaic=None) if grid.is_mosaic else replace(grid, outliers=())
    operator = _operator(data, single, options, comm)
    ones = _ones if data.scratch.on_disk else np.ones(data.size, np.complex64)
    psf = dirty_image(operator, ones, weights, comm)
    return weights, operator, psf, comm.once(fit_beam, psf, plane)


def _ones(piece, operator):
    """Return the visibilities of a source in the centre of the image."""
    return np.ones(operator.size, np.complex64)
