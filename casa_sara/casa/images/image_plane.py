"""The image plane as tclean defines it: coordinates, primary beam, and information about the observation.

CASA's own synthesisimager makes them from the selected data, so they are tclean's by construction.
"""

from __future__ import annotations

import os
from dataclasses import dataclass, field, replace

import numpy as np

from casa_sara.casa.ms.frames import image_basis, unit_vectors
from casa_sara.casa.ms.integrity import reading
from casa_sara.casa.ms.msselect import for_parser
from casa_sara.casa.ms.subtables import readable
from casa_sara.casa.runtime.quantities import check_frequency
from casa_sara.casa.runtime.tools import check_handles, made, more_handles, opened, scratch_folder

__all__ = ["ImagePlane", "define_image_plane", "read_pixels", "read_planes", "relative_pb", "slabs"]

PB_LIMIT = 0.2  # of tclean
_SELECTDATA_KEYS = {"timerange": "timestr", "uvrange": "uvdist", "observation": "obs", "intent": "state"}
_LARGEST_OFFSET = 0.05  # pixels between where a pixel is and where its coordinates say
_SLAB = 4_000_000  # pixels read or written at a time


def relative_pb(weight: np.ndarray) -> np.ndarray:
    """Return the primary beam of a mosaic, √(weight/largest weight) of every channel; 0 in those without data.

    Parameters
    ----------
    weight : real (nx, ny) or (nchan, nx, ny)
        Weight of the data at each place of the sky.

    Returns
    -------
    real
        Of the shape of `weight`.
    """
    largest = weight.max(axis=(-2, -1), keepdims=True)
    return np.sqrt(np.divide(weight, largest, out=np.zeros_like(weight), where=largest > 0))


@dataclass(frozen=True)
class ImagePlane:
    """What all images of one run have in common.

    Attributes
    ----------
    csys : dict
        Record of the coordinate system: right ascension, declination, Stokes, frequency.
    pb : float32 (nx, ny) or (nchan, nx, ny)
        Primary beam, at most 1, and 0 below the limit; of each channel of a cube.
    mask : bool, as `pb`
        Good pixels, where the primary beam is above the limit.
    imageinfo : dict
        Name of the source and type of the image.
    miscinfo : dict
        Telescope and distance.
    sky_model : bool
        Whether the model is the sky itself, as in a mosaic; else it is the sky times the primary beam.
    masks_all : bool
        Whether .residual and .image have the mask, or only .pb and what is divided by it.
    notes : list of str
        What the user should know of it.
    """

    csys: dict
    pb: np.ndarray
    mask: np.ndarray
    imageinfo: dict
    miscinfo: dict
    masks_all: bool = True
    sky_model: bool = False
    notes: list[str] = field(default_factory=list)

    @property
    def shape(self) -> tuple[int, int]:
        """Pixels in right ascension and declination."""
        return self.pb.shape[-2:]

    def of_mosaic(self, weight, pblimit):
        """Return the same plane with the primary beam of a mosaic, √(weight/largest weight) above a limit.

        Parameters
        ----------
        weight : real (nx, ny), or (nchan, nx, ny) of a cube
            Weight of the data at each place of the sky; 0 in channels without data.
        pblimit : float
            As of :func:`define_image_plane`.

        Returns
        -------
        ImagePlane
        """
        pb = relative_pb(weight)
        mask = pb > abs(pblimit)
        return replace(self, pb=np.where(mask, pb, np.float32(0)), mask=mask, sky_model=True)

    def csys_at(self, freqs_hz):
        """Return the record of the same coordinates, but for the frequencies.

        Parameters
        ----------
        freqs_hz : float (n,)
            Of the planes of a cube.

        Returns
        -------
        dict
        """
        import casatools

        csys = casatools.coordsys()
        csys.fromrecord(self.csys)
        csys.setspectral(frequencies=casatools.quanta().quantity(list(freqs_hz), "Hz"))
        return csys.torecord()

    def of_stokes(self, stokes):
        """Return the same plane of one Stokes parameter or of several.

        Parameters
        ----------
        stokes : str
            As 'I', or 'IQUV'.

        Returns
        -------
        ImagePlane
        """
        import casatools

        csys = casatools.coordsys()
        csys.fromrecord(self.csys)
        csys.setstokes(list(stokes))
        return replace(self, csys=csys.torecord())

    @property
    def n_stokes(self) -> int:
        """Planes along the axis of Stokes parameters."""
        return len(self.csys["stokes1"]["stokes"])

    @property
    def channels(self) -> int:
        """Planes along the spectral axis."""
        return self.pb.size // (self.pb.shape[-2] * self.pb.shape[-1])


def define_image_plane(visibilities, selection, grid, pblimit=PB_LIMIT, channels=1):
    """Return the image plane that tclean makes of this selection and grid.

    As in tclean, the MeasurementSet that begins first gives the date, the observer and the
    source's name. Where CASA has no primary beam of the telescope, it is 1 everywhere. Nothing is
    written to the MeasurementSets, and no files are left behind.

    Parameters
    ----------
    visibilities : casa_sara.data.visibilities.Visibilities
        What was read, for its phase centre and the MeasurementSets that it comes from.
    selection : casa_sara.options.Selection
        The MeasurementSets and the data selected in them.
    grid : casa_sara.options.ImageGrid
        Size, pixels, direction and gridder of the image; its plane is that of the first Stokes parameter.
    pblimit : float
        |pblimit| is the lowest primary beam; where it is negative, only .pb and what is divided by it are masked.
    channels : int
        Planes that it will have, as far as is known, for room on the disk of temporary files.

    Returns
    -------
    ImagePlane
        Of a cube, its primary beam and mask have a plane for each channel.

    Raises
    ------
    ValueError
        CASA cannot make coordinates of imsize, cell, projection and reffreq, or they are not those of the pixels.
    """
    if grid.reffreq:
        check_frequency(grid.reffreq, "reffreq")
    with scratch_folder((*grid.shape, channels)) as folder:
        root = os.path.join(folder, "plane")
        with more_handles(selection.vis):
            known = _make_primary_beam(visibilities, selection, grid, root)
            if not known:  # for the coordinates
                _make_primary_beam(visibilities, selection, grid, root, diameters=True)
        path = made(root + ".pb", f"vis = {list(selection.vis)}")
        with opened("image", path) as ia:
            pb = read_planes(ia) if grid.is_cube else read_pixels(ia)
            csys, miscinfo = ia.coordsys().torecord(), ia.miscinfo()
        with opened("table", path) as tb:
            imageinfo = tb.getkeyword("imageinfo")
    _check_coordinates(csys, visibilities.phase_center, grid)
    notes = []
    if not known:
        notes.append(_without_beam(csys["telescope"]))
        pb[...] = 1
    # above 1 where several fields are imaged together
    pb /= np.maximum(pb.max(axis=(-2, -1), keepdims=True), np.float32(1))
    mask = pb > abs(pblimit)
    pb[~mask] = 0
    kept = {key: miscinfo[key] for key in ("INSTRUME", "distance") if key in miscinfo}
    return ImagePlane(csys=csys, pb=pb, mask=mask, imageinfo=imageinfo, miscinfo=kept, masks_all=bool(pblimit >= 0),
                      notes=notes)


def _without_beam(telescope):
    """Say that the primary beam is unknown."""
    return (f"CASA has no primary beam of the telescope '{telescope}', whose first antenna has no diameter in "
            "ANTENNA/DISH_DIAMETER: .pb is 1 everywhere, and what is divided by it stays as it is")


def _check_coordinates(csys, center, grid):
    """Raise unless the coordinates give the corner pixels the places that imaging gives them.

    That is s = l·e_x + m·e_y + √(1 − l² − m²)·e_z with (e_x, e_y, e_z) of :func:`casa_sara.casa.ms.frames.image_basis`,
    l = (nx//2 − x)·cell and m = (y − ny//2)·cell.
    """
    import casatools

    # the corners, or as far out as is well this side of the horizon
    half, cell = np.array(grid.shape) // 2, np.array(grid.cell_rad)
    inward = min(1.0, 0.5 / np.hypot(*(half * cell)))
    offsets = np.array([[-1, 1, -1, 1], [-1, -1, 1, 1]]) * (half * inward)[:, None]
    l, m = -offsets[0] * cell[0], offsets[1] * cell[1]
    # once by our rule, once by the coordinates
    imaged = image_basis(center).T @ np.array([l, m, np.sqrt(1 - l**2 - m**2)])
    tool = casatools.coordsys()
    tool.fromrecord(csys)
    pixels = np.repeat(tool.referencepixel()["numeric"][:, None], 4, axis=1)
    pixels[:2] = half[:, None] + offsets
    labelled = unit_vectors(*tool.toworldmany(pixels)["numeric"][:2])
    apart = float(np.linalg.norm(imaged - labelled, axis=0).max() / cell.min())
    if not apart < _LARGEST_OFFSET:
        raise ValueError(f"phasecenter = '{grid.phasecenter}', projection = '{grid.projection}': CASA's coordinates of "
                         f"this image differ from the places of its pixels by up to {apart:.3g} pixels: should be "
                         "another phasecenter, as 'J2000 19h59m28.5s +40d44m02s'")


def read_pixels(ia, getmask=False, number=0):
    """Return the pixels (nx, ny) of plane `number` of an open image: float32, or bool for its mask."""
    nx, ny, *rest = ia.shape()
    pixels = np.empty((nx, ny), bool if getmask else np.float32)
    for rows in slabs(nx, ny):
        place = [number if size > 1 else 0 for size in rest]  # one axis at most is longer
        blc = [rows.start, 0] + place
        trc = [rows.stop - 1, ny - 1] + place
        pixels[rows] = ia.getchunk(blc, trc, getmask=getmask).reshape(rows.stop - rows.start, ny)
    return pixels


def read_planes(ia, getmask=False):
    """Return all planes (nchan, nx, ny) of an open cube: float32, or bool for its mask."""
    nx, ny, *rest = ia.shape()
    planes = np.empty((int(np.prod(rest)), nx, ny), bool if getmask else np.float32)
    for number, plane in enumerate(planes):
        plane[...] = read_pixels(ia, getmask, number)
    return planes


def slabs(nx, ny):
    """Cut nx rows of ny pixels into slices of moderate size."""
    step = max(1, _SLAB // ny)
    return [slice(start, min(start + step, nx)) for start in range(0, nx, step)]


def _make_primary_beam(visibilities, selection, grid, root, diameters=False):
    """Write the image `root`.pb, not normalised yet, with synthesisimager, and return whether it could.

    Of a telescope without a model of its beam and without the diameter of its first antenna, CASA makes none unless it
    is told of `diameters`.

    Its partner synthesisnormalizer would do that, but now and then the two tools overwrite
    each other's pixels.
    """
    import casatools

    imager = casatools.synthesisimager()
    try:
        for number in _by_start(visibilities):
            check_handles(selection.vis[number], selection.vis)
            with reading(selection.vis[number]):
                imager.selectdata(_selection_record(selection, number, diameters))
        try:
            imager.defineimage(_image_record(visibilities, grid, root), {"gridder": "standard", "imagename": root})
        except RuntimeError as error:
            parameters = f"{_axes_words(grid)}, vis = {list(selection.vis)}"
            raise ValueError(f"{parameters}: CASA cannot make an image of them: "
                         f"{' '.join(str(error).split())}") from error
        imager.makepb()
    finally:
        imager.done()
    return os.path.exists(root + ".pb")


def _axes_words(grid):
    """Return the task parameters that the axes may fail on, for a message."""
    if grid.is_cube:
        names = ("nchan", "start", "width", "outframe", "veltype", "restfreq")
        return ", ".join(f"{name} = {getattr(grid, name)!r}" for name in names)
    return f"imsize = {list(grid.shape)}, projection = '{grid.projection}', reffreq = '{grid.reffreq}'"


def _by_start(visibilities):
    """Return the numbers of the MeasurementSets that hold data, by the time of their first row."""
    starts = {}
    for number in visibilities.spws:
        with opened("table", visibilities.ms_names[number]) as tb:
            starts[number] = tb.getcol("TIME").min()
    return sorted(starts, key=starts.get)


def _selection_record(selection, number, diameters=False):
    """Return the selection of one MeasurementSet as parameters of synthesisimager."""
    import casatools

    name = selection.vis[number]
    chosen = dict.fromkeys(("field", "spw", "timestr", "uvdist", "antenna", "scan", "obs", "state"), "")
    strings = for_parser(name, selection.of(number))
    chosen |= {_SELECTDATA_KEYS.get(parameter, parameter): value for parameter, value in strings.items()}
    chosen |= {"msname": readable(name, diameters), "datacolumn": selection.datacolumn, "savemodel": "none"}
    utils = casatools.synthesisutils()
    try:
        return utils.checkselectionparams(chosen)
    finally:
        utils.done()


def _image_record(visibilities, grid, root):
    """Return the image definition as parameters of synthesisimager."""
    center = visibilities.phase_center
    longitude, latitude = (float(center[axis]["value"]) for axis in ("m0", "m1"))
    return {
        "imagename": root,
        "imsize": [int(n) for n in grid.shape],
        "cell": [f"{float(cell)!r}rad" for cell in grid.cell_rad],
        "phasecenter": f"{center['refer']} {longitude!r}rad {latitude!r}rad",
        "stokes": grid.stokes[0],
        "projection": grid.projection,
        "specmode": grid.specmode,
        "reffreq": grid.reffreq,
        "nchan": grid.nchan if grid.is_cube else 1,
        "start": grid.start,
        "width": grid.width,
        "outframe": grid.outframe,
        "veltype": grid.veltype,
        "restfreq": list(grid.restfreq),
        "interpolation": grid.interpolation,
        "deconvolver": "hogbom",
    }
