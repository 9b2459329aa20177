"""The images of a cube channel by channel: its axis, the samples and the mask of each channel, and what was found."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from casa_sara.casa.images.image_files import read_model
from casa_sara.casa.images.image_plane import ImagePlane, define_image_plane, relative_pb
from casa_sara.casa.images.masks import read_support
from casa_sara.casa.images.spectral_axis import SpectralAxis, channels_of
from casa_sara.casa.ms.weights import imaging_weights
from casa_sara.casa.runtime import log
from casa_sara.data.visibilities import Visibilities
from casa_sara.imaging.continuum import Result, describe, split
from casa_sara.imaging.data_quality import check_confined, left_outside, nowhere_visible, thermal_noise
from casa_sara.imaging.error_images import error_images
from casa_sara.imaging.island_list import list_islands
from casa_sara.imaging.mosaic import weight_image
from casa_sara.imaging.plane_images import plane_images
from casa_sara.imaging.run_solver import Watch, density_of, expected_iterations, solve_image, without_wild
from casa_sara.imaging.time_forecast import Pace
from casa_sara.options import ImagingRequest
from casa_sara.parallel.serial import SERIAL
from casa_sara.reconstruction.bootstrap import jackknife_groups
from casa_sara.reconstruction.problem import Samples
from casa_sara.reconstruction.settings import check_l2bound

__all__ = ["Channel", "CubePlanes", "Tally"]


@dataclass(frozen=True)
class Tally:
    """The number of samples of a channel, and of those left out."""

    size: int
    dropped: dict[str, int]
    notes: tuple[str, ...] = ()


@dataclass
class Channel:
    """One channel: its frequency in the frame of the axis, and what was found; a blank one has no result, no beam.

    `closed` says that its plane of the mask is empty, so that there is nothing to solve for.
    """

    freq_hz: float
    result: Result | None = None
    sumwt: float = 0.0
    beam: dict | None = None
    closed: bool = False


@dataclass
class CubePlanes:
    """The images of all channels so far: `images` are 'psf', 'residual' and 'model', float32 (nchan, nx, ny).

    `support` bool (nchan, nx, ny), None without a mask, is where the model of each channel may be; `found` are notes on
    the solutions. With several ranks, each has its channels, until they are gathered.
    """

    request: ImagingRequest
    data: Visibilities
    plane: ImagePlane
    axis: SpectralAxis
    order: np.ndarray
    first: np.ndarray
    channels: list[Channel]
    support: np.ndarray | None = None
    images: dict[str, np.ndarray] = field(default_factory=dict)
    found: list[str] = field(default_factory=list)

    @classmethod
    def of(cls, request, data, planes, comm=SERIAL):
        """Lay out the axis and sort the samples by channel; there are no images yet."""
        plane = comm.once(define_image_plane, data, request.selection, request.grid, request.output.pblimit, planes)
        data.notes.extend(plane.notes)
        axis = SpectralAxis.of(plane)
        channel = channels_of(data, request.selection, axis)
        order = np.argsort(channel, kind="stable")
        first = np.searchsorted(channel[order], np.arange(axis.size + 1))
        blank = np.diff(first) == 0
        if blank.all():
            grid = request.grid
            raise ValueError(f"start = {grid.start!r}, width = {grid.width!r}, nchan = {grid.nchan}: no usable "
                             "visibility is in these channels")
        if blank.any():
            numbers = ", ".join(map(str, np.flatnonzero(blank)))
            data.notes.append(f"channels {numbers} are blank: they have no usable visibilities")
        if first[0]:
            log.info(f"{first[0]} visibilities are in none of the {axis.size} image channels")
        if request.grid.is_mosaic:
            plane = plane.of_mosaic(_weight_cube(request, data, order, first), request.output.pblimit)
        plane = replace(plane, mask=plane.mask & ~blank[:, None, None])
        if not plane.mask.any():
            data.notes.append(nowhere_visible(request.grid, request.output))
        support = None if request.output.images_stand else comm.once(read_support, request.grid, plane)
        closed = np.zeros(axis.size, bool) if support is None else ~support.any(axis=(1, 2))
        if (closed & ~blank).any():
            numbers = ", ".join(map(str, np.flatnonzero(closed & ~blank)))
            data.notes.append(f"the mask is empty in channels {numbers}: their models are zero")
        channels = [Channel(float(freq), closed=bool(shut)) for freq, shut in zip(axis.freqs_hz, closed)]
        names = () if request.output.images_stand else _error_names(request)
        names = ("psf", "residual", "model", *names, *["weight"] * request.grid.is_mosaic)
        images = {name: np.zeros(plane.pb.shape, np.float32) for name in names}
        return cls(request, data, plane, axis, order, first, channels, support, images)

    @property
    def filled(self):
        """The numbers of the channels that have samples."""
        return np.flatnonzero(np.diff(self.first)).tolist()

    @property
    def solvable(self):
        """The numbers of the channels that have samples, and pixels for a model."""
        return [k for k in self.filled if not self.channels[k].closed]

    def make_dirty(self, k):
        """Make the images of a channel from its first model, which is empty where none is given."""
        log.info(f"dirty image of channel {k} (of {self.axis.size} channels), {self.channels[k].freq_hz / 1e9:.9g} GHz "
                 f"{self.axis.frame}")
        start = self._startmodel(k)
        model = start if start is not None else np.zeros(self.plane.shape, np.float32)
        if self.support is not None:
            model *= self.support[k]
        try:
            part = self._split(k)
            describe(part.data, part.blocks, part.noise, self.request.grid.stokes)
            check_l2bound(self.request.options, len(part.blocks))
            if self.request.options.jackknife:
                jackknife_groups(len(part.blocks))
            self._fill(k, part.data, part.blocks, part.noise, None, model)
        except ValueError as error:
            raise ValueError(f"channel {k}, {self.channels[k].freq_hz / 1e9:.9g} GHz: {error}") from error

    def solve(self, k, checkpoint, deadline):
        """Return the solution of a channel."""
        log.info(f"reconstructing channel {k} (of {self.axis.size} channels)")
        part, request = self._split(k), self.request
        density = density_of(part.data, None, request.grid, request.options)
        samples = Samples(part.data, part.offsets, density, part.noise)
        watch = Watch(deadline, Pace(expected_iterations(request.options)), checkpoint)
        start, support = self._startmodel(k), None if self.support is None else self.support[k]
        if start is not None and support is not None:
            start *= support
        return solve_image(samples, request.grid, request.options, start, watch, support)

    def take(self, k, reconstruction):
        """Make the images of a channel from its solution."""
        part, request = self._split(k), self.request
        list_islands(reconstruction.record, self.plane, request.grid.cell_rad, request.options.significance)
        data, blocks = without_wild(part.data, part.blocks, part.offsets, reconstruction)
        weights = self._fill(k, data, blocks, part.noise, reconstruction, reconstruction.model)
        weight = self.images["weight"][k] if request.grid.is_mosaic else None
        errors = error_images(reconstruction.draws, reconstruction.jackknife, self.channels[k].beam,
                              request.output.restoringbeam, request.grid.cell_rad,
                              None if weight is None else relative_pb(weight))
        for name, image in errors.items():
            self.images[name][k] = image
        if self.support is not None:
            check_confined(reconstruction.model, self.support[k])
            sigma = thermal_noise(data, weights, part.noise, np.searchsorted(reconstruction.kept, part.offsets))
            if weight is not None:  # of flat noise
                sigma /= float(weight.max()) ** 0.5
            for note in left_outside(self.images["residual"][k], self.support[k], sigma):
                log.warn(f"channel {k}: {note}")
                self.found.append(f"channel {k}: {note}")

    def gather(self, comm):
        """Bring the channels of all ranks to rank 0, which says in the log what the others have found."""
        shares = [self.filled[rank :: comm.size] for rank in range(comm.size)]
        for cube in self.images.values():
            for own, part in zip(shares, comm.gather(cube[shares[comm.rank]]) or ()):
                cube[own] = part
        told = [self.channels[k] for k in shares[comm.rank]], self.found
        for rank, theirs in enumerate(comm.alltoall([told] + [None] * (comm.size - 1))):
            if comm.rank == 0 and rank > 0:
                self._take_over(shares[rank], *theirs)

    def _take_over(self, numbers, channels, found):
        """Take the channels of another rank, and say in the log how they ended."""
        for k, channel in zip(numbers, channels):
            self.channels[k] = channel
            solved = channel.result.reconstruction
            if solved:
                record = solved.record
                log.info(f"channel {k}: {record.stop_description}, after {record.iteration[-1]} iterations: model flux "
                         f"{channel.result.model_flux:.5g} Jy, {len(record.islands)} islands")
        for note in found:
            log.warn(note)
        self.found.extend(found)

    def products(self):
        """Return the images to be written."""
        mask = {} if self.support is None else {"mask": self.support.astype(np.float32)}
        return self.images | mask

    def beams(self):
        """Return the beam of each channel; a blank one has that of the nearest that is not."""
        filled = np.array(self.filled)
        return [self.channels[filled[np.abs(filled - k).argmin()]].beam for k in range(self.axis.size)]

    def _split(self, k):
        samples = self.data.part(self.order[self.first[k] : self.first[k + 1]])
        return split(replace(samples, dropped={}, notes=[]), self.request.output.blocks)

    def _startmodel(self, k):
        output = self.request.output
        return read_model(output.startmodel, self.plane, k) if output.startmodel and not output.resume else None

    def _fill(self, k, data, blocks, noise, reconstruction, model):
        """Make the images of a channel from a model and the samples in use; return the imaging weights of these."""
        request, channel = self.request, self.channels[k]
        found = plane_images(data, model, request.grid, request.weighting, request.options, self.plane)
        for name, pixels in found.pixels.items():
            self.images[name][k] = pixels
        channel.sumwt, channel.beam = found.sumwt, found.beam
        channel.result = Result(Tally(data.size, data.dropped), data.size, blocks, noise, reconstruction,
                                found.residual_peak, found.model_flux, {})
        return found.weights


def _weight_cube(request, data, order, first):
    """Return the weight of the data of a mosaic at each place of the sky, float32 (nchan, nx, ny), 0 without data."""
    grid, middle = request.grid, tuple(n // 2 for n in request.grid.shape)
    cube = np.zeros((len(first) - 1, *grid.shape), np.float32)
    for k in np.flatnonzero(np.diff(first)).tolist():
        part = data.part(order[first[k] : first[k + 1]])
        if not grid.mosaic.sensitivity(grid.mosaic.sums(part.beam, part.weight))[middle] > 0:
            raise ValueError(f"phasecenter = '{grid.phasecenter}': in channel {k} no pointing sees the centre of the "
                             "image: should be a direction within the mosaic, or channels that have data there")
        cube[k] = weight_image(part, grid, imaging_weights(part, grid, request.weighting))
    return cube


def _error_names(request):
    """Return the names of the images of errors that were asked for."""
    options, restored = request.options, request.output.restoringbeam is not None
    return ["model.error"] * bool(options.ndraws) + ["image.error"] * (bool(options.ndraws) and restored) + [
        "image.jackknife"] * (options.jackknife and restored)
