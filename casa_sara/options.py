"""The task parameters, as frozen dataclasses."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import accumulate
from typing import Any

__all__ = ["LARGEST_INDEX", "Comparing", "ImageGrid", "Limits", "Outlier", "Output", "Selection", "SolverOptions",
           "Spectrum", "SingleDish", "Weighting", "images_in", "stacked_shape"]

LARGEST_INDEX = 5.0  # spectral index of any continuum, plus or minus

SARA_BASES = ("dirac", "db1", "db2", "db3", "db4", "db5", "db6", "db7", "db8")


@dataclass(frozen=True)
class Selection:
    """Data selection with tclean's words (CASA MSSelection syntax).

    Every selection parameter is one string for all MeasurementSets, or a
    tuple with one string for each of them.
    """

    vis: tuple[str, ...]
    field: str | tuple[str, ...] = ""
    spw: str | tuple[str, ...] = ""
    timerange: str | tuple[str, ...] = ""
    uvrange: str | tuple[str, ...] = ""
    antenna: str | tuple[str, ...] = ""
    scan: str | tuple[str, ...] = ""
    observation: str | tuple[str, ...] = ""
    intent: str | tuple[str, ...] = ""
    datacolumn: str = "corrected"

    PARAMETERS = ("field", "spw", "timerange", "uvrange", "antenna", "scan", "observation", "intent")

    def of(self, ms: int) -> dict[str, str]:
        """Return the non-empty selection strings of MeasurementSet number `ms`."""
        chosen = {}
        for name in self.PARAMETERS:
            value = getattr(self, name)
            value = value if isinstance(value, str) else value[ms]
            if value:
                chosen[name] = value
        return chosen


@dataclass(frozen=True)
class Spectrum:
    """I(ν) = I(ν0)·(ν/ν0)^α: the index α, one number or a real image (nx, ny), and ν0 = `reference_hz`, the image's."""

    index: Any
    reference_hz: float


@dataclass(frozen=True)
class ImageGrid:
    """The image plane and how it is seen: `shape` = (nx, ny) pixels of `cell_rad` = (x, y) radians, both positive.

    `spectrum` is what `spectralindex` stands for, once it has been read, and `mosaic` the primary beams of
    gridder='mosaic', a :class:`casa_sara.operators.beams.Mosaic`; `subbands` are the frequencies at which a sky of
    `nterms` > 1 is solved for, a :class:`casa_sara.operators.subbands.Subbands`, once the data are known. `start` and
    `width` of a cube's spectral axis are '', a channel number or a quantity; `nchan` is -1 where the data tell it.
    `usemask`, `mask` and `pbmask` say where the model may be. `outliers` are small images elsewhere, solved together
    with this one.
    """

    shape: tuple[int, int]
    cell_rad: tuple[float, float]
    phasecenter: str = ""
    projection: str = "SIN"
    stokes: str = "I"
    reffreq: str = ""
    gridder: str = "standard"
    spectralindex: str = ""
    spectrum: Spectrum | None = None
    mosaic: Any = None
    nterms: int = 1
    subbands: Any = None
    onepointing: bool = False
    specmode: str = "mfs"
    nchan: int = -1
    start: int | str = ""
    width: int | str = ""
    outframe: str = "LSRK"
    veltype: str = "radio"
    restfreq: tuple[str, ...] = ()
    interpolation: str = "nearest"
    usemask: str = "user"
    mask: tuple[str, ...] = ()
    pbmask: float = 0.0
    outliers: tuple[Outlier, ...] = ()

    @property
    def shapes(self) -> tuple[tuple[int, int], ...]:
        """Those of this image and of its outliers."""
        return (self.shape, *(outlier.grid.shape for outlier in self.outliers))

    @property
    def is_cube(self) -> bool:
        """Whether the image has a plane for each channel."""
        return self.specmode == "cube"

    @property
    def is_mosaic(self) -> bool:
        """Whether the model is the sky, seen through the primary beam of each pointing."""
        return self.gridder == "mosaic"

    @property
    def needs_frequencies(self) -> bool:
        """Whether the samples keep their frequencies."""
        return bool(self.spectralindex) or self.is_mosaic or self.nterms > 1

    @property
    def masked(self) -> bool:
        """Whether the model is confined to a part of the image."""
        return self.usemask == "pb" or bool(self.mask)


@dataclass(frozen=True)
class Outlier:
    """A small image beside the main one, with products under its own `imagename`.

    `turn` is the matrix (3, 3) that takes (u, v, w) along the axes of the main image to those along its own, once the
    data are known; `startmodel` is '' where there is none.
    """

    imagename: str
    grid: ImageGrid
    startmodel: str = ""
    turn: Any = None


def stacked_shape(shapes: Sequence[tuple[int, int]]) -> tuple[int, int]:
    """Return the shape of an array that holds images of these shapes, one after the other along the first axis.

    Parameters
    ----------
    shapes : sequence of (int, int)
        Of the images.

    Returns
    -------
    (int, int)
    """
    return sum(nx for nx, _ in shapes), max(ny for _, ny in shapes)


def images_in(stacked: Any, shapes: Sequence[tuple[int, int]]) -> list[Any]:
    """Return the images in an array of :func:`stacked_shape`, without copies.

    Parameters
    ----------
    stacked : array
        The images; what is beside the narrower ones belongs to none.
    shapes : sequence of (int, int)
        Of the images.

    Returns
    -------
    list of arrays
    """
    ends = list(accumulate(nx for nx, _ in shapes))
    return [stacked[end - nx : end, :ny] for end, (nx, ny) in zip(ends, shapes)]


@dataclass(frozen=True)
class Weighting:
    """Imaging weights of .psf, .residual and .image; they never touch the model.

    `mosweight` says that the fields of a mosaic are weighted separately.
    """

    weighting: str = "natural"
    robust: float = 0.5
    npixels: int = 0
    uvtaper: tuple[str, ...] = ()
    mosweight: bool = True


@dataclass(frozen=True)
class SolverOptions:
    """Everything the solver may be told, named after the task parameters, which describe them."""

    method: str = "tsara"
    niter: int = 100_000
    wavelets: tuple[str, ...] = SARA_BASES
    wavelevels: int = 4
    positivity: bool = True
    polbound: bool = False
    precondition: bool = True
    databound: str = "adapt"
    boundtol: float = 1e-2
    boundrelchange: float = 1e-2
    boundstep: float = 0.618
    boundinterval: int = 20
    l2bound: tuple[float, ...] = ()
    nreweights: int = 20
    reweightdecay: float = 0.618
    reweighttol: float = 1e-2
    reltol: float = 3e-4
    finalreltol: float = 3e-4
    regscale: float = 1.0
    significance: float = 5.0
    gainfit: bool = False
    ndraws: int = 0
    jackknife: bool = False
    nthreads: int = 1
    averaging: bool = True  # no task parameter

    @property
    def averages(self) -> bool:
        """Whether visibilities are averaged: not for the paper's method to the letter, nor where bounds constrain."""
        return self.averaging and self.method == "tsara" and self.databound == "adapt"


@dataclass(frozen=True)
class Output:
    """Where results go, and what goes along.

    `restoringbeam` is None when no restored image is wanted; `history` holds the lines written into every image;
    `resume` says to go on from the checkpoint. `pbcor` asks for the images divided by the primary beam. With
    `images_stand` the products of an earlier run stay as they are, and only the model column is written.
    """

    imagename: str
    startmodel: str = ""
    blocks: int | tuple[str, ...] = 0
    restoringbeam: tuple[str, ...] | None = ()
    savemodel: str = "none"
    images_stand: bool = False
    history: tuple[str, ...] = ()
    resume: bool = False
    pblimit: float = 0.2
    pbcor: bool = False


@dataclass(frozen=True)
class Limits:
    """What the run may take; `report` tells whether a report is made after it, which takes its share.

    `maxmem_gb` is the most that the process may hold, in 1e9 bytes, 0 for what the machine has; `maxtime_s` is infinite
    where there is no limit.
    """

    maxmem_gb: float = 0.0
    maxtime_s: float = math.inf
    report: bool = False


@dataclass(frozen=True)
class SingleDish:
    """Total power: names of a single-dish `image` and of its beam (`psf`), and a factor (`gain`) on its brightness.

    Without an image there is none; without a psf the beam is the one in the header of the image.
    """

    image: str = ""
    psf: str = ""
    gain: float = 1.0


@dataclass(frozen=True)
class ImagingRequest:
    """What a run of tsara is asked for."""

    selection: Selection
    grid: ImageGrid
    weighting: Weighting
    options: SolverOptions
    output: Output
    limits: Limits = Limits()
    single_dish: SingleDish = SingleDish()


@dataclass(frozen=True)
class Comparing:
    """What to compare, named after the task parameters of saracompare, which describe them."""

    models: tuple[str, ...]
    names: tuple[str, ...] = ()
    truth: str = ""
    regions: tuple[str, ...] = ()
    support: str = ""
    threshold: float = 1e-3
    robust: float = -1.0
    frames: tuple[str, ...] = ()
    inject: tuple[str, ...] = ()
    injectflux: float = 0.0
    features: tuple[str, ...] = ()
    nthreads: int = 1
