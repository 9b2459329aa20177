"""The primary beams of the pointings of a mosaic, by field, dishes and frequency.

Of ALMA and the ACA they are those of CASA's mosaic gridder: the Airy pattern of a dish of 10.7 m (of 12 m) or 6.25 m
(of 7 m) with a blockage of 0.75 m, and on a baseline of unlike dishes the product of the two voltage patterns. They end
at the first null. Of other telescopes, whose dishes must all be the same, they are CASA's .pb of the standard gridder.
They are centred on PHASE_DIR of FIELD, as with usepointing=False in tclean; POINTING is not read.
"""

from __future__ import annotations

import os
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import j1

from casa_sara.casa.images.image_plane import define_image_plane
from casa_sara.casa.ms.frames import SPEED_OF_LIGHT, is_of_earth, rotation_between
from casa_sara.casa.ms.subtables import readable, texts
from casa_sara.casa.runtime.tools import opened
from casa_sara.options import Selection
from casa_sara.parallel.numbering import numbered
from casa_sara.parallel.serial import SERIAL

__all__ = ["PrimaryBeams", "Profiles", "primary_beams"]

AIRY = {12.0: (10.7, 0.75), 7.0: (6.25, 0.75)}  # diameter → effective diameter and blockage, m, of ALMA and the ACA
OF_ALMA = {"ALMA", "ACA"}
BAND = 0.02  # frequencies within this share a beam, relative
SAME_POINTING = 1e-6  # rad
PROFILE = 4097  # values of a profile, along the square of the distance
FIRST_NULL = 3.8317  # of J1; that of a blocked dish is near it
TABLE_PIXELS, TABLE_WIDTH = 1024, 3.0  # of the image in which CASA makes a beam; its width in wavelengths/diameter
FAINTEST = 1e-3  # where CASA's beam ends


@dataclass(frozen=True)
class Profiles:
    """How the beams of a mosaic fall off, by dishes and frequency.

    Attributes
    ----------
    bands_hz : float64 (F,)
        The frequencies that samples are assigned to, the nearest.
    kinds : list of (str, float, float, int)
        Telescope, diameters of both dishes in m, the larger first, and number of the frequency.
    radii : float64 (n,)
        Where A ends, in direction cosines.
    values : float32 (n, K)
        A along the square of the distance, as of :class:`casa_sara.operators.beams.Beam`.
    """

    bands_hz: np.ndarray
    kinds: list[tuple[str, float, float, int]]
    radii: np.ndarray
    values: np.ndarray


@dataclass(frozen=True)
class PrimaryBeams:
    """The primary beam of every sample.

    Attributes
    ----------
    centres : float64 (P, 2)
        Pixels of the pointings, counted from 0.
    profiles : Profiles
    beams : int (B, 2)
        Pointing and profile of each beam.
    beam_of_sample : int32 (M,)
    """

    centres: np.ndarray
    profiles: Profiles
    beams: np.ndarray
    beam_of_sample: np.ndarray

    @property
    def words(self) -> str:
        """What they are, for the log."""
        pairs = sorted({(telescope, *diameters) for telescope, *diameters, _ in self.profiles.kinds})
        dishes = ", ".join(f"{one:g} m with {other:g} m" for _, one, other in pairs)
        bands = ", ".join(f"{band / 1e9:.5g}" for band in self.profiles.bands_hz)
        return (f"mosaic of {len(self.centres)} pointings: their primary beams are centred on PHASE_DIR of FIELD, "
                f"POINTING is not used; baselines of dishes of {dishes}; beams at {bands} GHz")


def primary_beams(data, selection, grid, profiles=None, comm=SERIAL):
    """Find the primary beam of every sample.

    Parameters
    ----------
    data : casa_sara.data.visibilities.Visibilities
        With `freq_hz` and `fields`; `weight`, `uvw` and what says where samples come from is used.
    selection : casa_sara.options.Selection
        Of the data.
    grid : casa_sara.options.ImageGrid
        Size, pixels and direction of the image.
    profiles : Profiles, optional
        That were found before, of other samples of the same data.
    comm : casa_sara.parallel.serial.Serial or MPI
        Over whose ranks the samples are spread: all but `beam_of_sample` is the same on all.

    Returns
    -------
    PrimaryBeams

    Raises
    ------
    ValueError
        A field moves on the sky, or CASA has no beam of these dishes.
    """
    centres, pointing_of_row = _pointings(data, grid, comm)
    dishes, dish_of_row = _dishes(data, comm)
    if profiles is None:
        comm.once(_check_fields, data)
        bands = _bands(data.freq_hz, data.weight, comm)
        profiles = Profiles(bands, [], np.zeros(0), np.zeros((0, PROFILE), np.float32))
    smaller, larger = np.sort(dish_of_row, axis=0)
    sizes = len(centres), len(dishes), len(dishes), len(profiles.bands_hz)
    of_row = np.ravel_multi_index((pointing_of_row, larger, smaller), sizes[:3])
    number = of_row[data.row] * sizes[3] + _nearest_band(data.freq_hz, profiles.bands_hz)
    used, beam_of_sample = numbered(number, comm)
    beams = np.array(np.unravel_index(used, sizes))
    wanted = [(dishes[k][0], dishes[k][1], dishes[n][1], int(number)) for _, k, n, number in beams.T.tolist()]
    profiles = comm.once(_with_kinds, profiles, sorted(set(wanted)), data, selection, grid)
    beams = np.stack([beams[0], [profiles.kinds.index(kind) for kind in wanted]], axis=1)
    return PrimaryBeams(centres, profiles, beams, beam_of_sample.astype(np.int32))


def _nearest_band(freq_hz, bands_hz):
    """Return the number of the nearest of some frequencies, int (M,)."""
    distinct, of_sample = np.unique(np.asarray(freq_hz, float), return_inverse=True)
    return np.abs(np.log(distinct[:, None] / bands_hz)).argmin(axis=1)[of_sample.ravel()]


def _with_kinds(profiles, kinds, data, selection, grid):
    """Return the profiles with those of these kinds."""
    new = [kind for kind in kinds if kind not in profiles.kinds]
    made = [_profile(data, selection, grid, kind[0], kind[1:3], profiles.bands_hz[kind[3]]) for kind in new]
    radii, values = [radius for radius, _ in made], [one for _, one in made]
    return replace(profiles, kinds=profiles.kinds + new, radii=np.append(profiles.radii, radii),
                   values=np.concatenate([profiles.values, np.reshape(values, (-1, PROFILE)).astype(np.float32)]))


def _pointings(data, grid, comm):
    """Return the pixels (P, 2) of the distinct directions of fields, and the number of that of each row, int (R,)."""
    rows, centre = data.rows, data.phase_center
    most = 1 + max(field for _, field in data.fields)
    fields, of_row = numbered(rows.ms.astype(np.int64) * most + rows.field, comm)
    cosines = []
    for number in fields.tolist():
        matrix = rotation_between(data.fields[divmod(number, most)], centre)
        cosines.append(np.array([0.0, 0.0, 1.0]) if matrix is None else matrix[:, 2])
    cosines, distinct, found = np.array(cosines), [], np.empty(len(fields), int)
    for k, one in enumerate(cosines):
        same = [p for p in distinct if np.linalg.norm(cosines[p] - one) < SAME_POINTING]
        distinct += [] if same else [k]
        found[k] = distinct.index(same[0]) if same else len(distinct) - 1
    l, m = cosines[distinct, 0], cosines[distinct, 1]
    pixels = np.stack([grid.shape[0] // 2 - l / grid.cell_rad[0], grid.shape[1] // 2 + m / grid.cell_rad[1]], axis=1)
    return pixels, found[of_row]


def _check_fields(data):
    """Raise where a field moves on the sky."""
    for number, field in data.fields:
        name = data.ms_names[number]
        with opened("msmetadata", readable(name)) as md:
            frame = md.phasecenter(field)["refer"]
        if is_of_earth({"refer": frame}):
            raise ValueError(f"gridder = 'mosaic': field {field} of '{name}' is in {frame}, and moves on the sky: "
                             "mosaics take fields in J2000 and the like; choose them with field")


def _dishes(data, comm):
    """Return the kinds of dishes, (telescope, diameter in m), and those of the baseline of each row, int (2, R)."""
    rows, ends, found = data.rows, np.zeros((2, data.rows.ms.size)), []
    for number in np.unique(rows.ms):
        name, here = data.ms_names[number], rows.ms == number
        with opened("table", os.path.join(name, "ANTENNA")) as tb:
            diameters = tb.getcol("DISH_DIAMETER")
        telescopes = set(texts(name, "OBSERVATION", "TELESCOPE_NAME"))
        telescope = "ALMA" if telescopes <= OF_ALMA else ", ".join(sorted(telescopes))
        ends[:, here] = diameters[np.stack([rows.antenna1[here], rows.antenna2[here]])]
        found += [(int(number), diameter, telescope) for diameter in np.unique(ends[:, here]).tolist()]
    found = sorted(set().union(*comm.allgather(found)))
    kinds = list(dict.fromkeys((telescope, diameter) for _, diameter, telescope in found))
    _check_dishes(kinds)
    of_row = np.zeros(ends.shape, int)
    for number, diameter, telescope in found:
        of_row[(rows.ms == number) & (ends == diameter)] = kinds.index((telescope, diameter))
    return kinds, of_row


def _check_dishes(kinds):
    """Raise unless the beams of these dishes are known."""
    wrong = [diameter for telescope, diameter in kinds if telescope == "ALMA" and diameter not in AIRY]
    if wrong:
        raise ValueError(f"gridder = 'mosaic': ALMA's dishes have {' or '.join(f'{size:g}' for size in AIRY)} m in "
                         f"ANTENNA/DISH_DIAMETER, not {', '.join(f'{size:g}' for size in wrong)} m: correct it, or "
                         "image with gridder = 'standard'")
    if len(kinds) > 1 and any(telescope != "ALMA" for telescope, _ in kinds):
        named = ", ".join(f"{telescope}, {size:g} m" for telescope, size in kinds)
        raise ValueError(f"gridder = 'mosaic': unlike dishes ({named}) can be imaged together for ALMA and the ACA "
                         "only: image them separately, or with gridder = 'standard'")


def _bands(freq_hz, weight, comm):
    """Return the mean frequencies of groups of similar ones, float64 (F,)."""
    distinct, of_sample = numbered(np.asarray(freq_hz, float), comm)
    group, start = np.zeros(distinct.size, int), distinct[0]
    for k in range(1, distinct.size):
        new = distinct[k] > start * (1 + BAND)
        group[k] = group[k - 1] + new
        start = distinct[k] if new else start
    of_sample, size = group[of_sample], group[-1] + 1
    weighted = weight * np.asarray(freq_hz, float)
    sums, moments = comm.allreduce(np.array([np.bincount(of_sample, one, size) for one in (weight, weighted)], float))
    return moments / sums


def _profile(data, selection, grid, telescope, diameters, freq_hz):
    """Return the radius in rad of a beam, and A along the square of the distance."""
    if telescope == "ALMA":
        patterns = [AIRY[diameter] for diameter in diameters]
        radius = min(_null(*pattern) for pattern in patterns) * SPEED_OF_LIGHT / freq_hz
        distance = radius * np.sqrt(np.linspace(0, 1, PROFILE))
        beam = np.prod([_voltage(distance * freq_hz / SPEED_OF_LIGHT, *pattern) for pattern in patterns], axis=0)
        return radius, np.maximum(beam, 0).astype(np.float32)
    return _of_casa(data, selection, grid, telescope, diameters[0], freq_hz)


def _voltage(place, diameter, blockage):
    """The voltage pattern of a blocked dish at direction cosines × wave number, 1 in the middle."""
    def jinc(x):
        return np.where(x > 1e-4, 2 * j1(x) / np.maximum(x, 1e-4), 1 - x**2 / 8)

    ratio = blockage / diameter
    x = np.pi * diameter * place
    return (jinc(x) - ratio**2 * jinc(ratio * x)) / (1 - ratio**2)


def _null(diameter, blockage):
    """Where the voltage pattern first vanishes."""
    place = np.linspace(0.5, 1.1, PROFILE) * FIRST_NULL / (np.pi * diameter)
    return float(np.interp(0, -_voltage(place, diameter, blockage), place))


def _of_casa(data, selection, grid, telescope, diameter, freq_hz):
    """The same of another telescope, from CASA's image of its beam at one frequency, around the centre of a field."""
    wavelength = SPEED_OF_LIGHT / freq_hz
    cell = TABLE_WIDTH * wavelength / max(diameter, 1.0) / TABLE_PIXELS
    (number, field), centre = min(data.fields.items(), key=lambda one: one[0])
    # CASA averages the beams of all fields that are selected
    chosen = selection.of(number) | dict(field=str(field))
    selection = Selection((selection.vis[number],), **chosen, datacolumn=selection.datacolumn)
    data = replace(data, phase_center=centre, ms_names=selection.vis, spws={0: data.spws[number]})
    around = replace(grid, shape=(TABLE_PIXELS, TABLE_PIXELS), cell_rad=(cell, cell), phasecenter="",
                     reffreq=f"{float(freq_hz)!r}Hz")
    plane = define_image_plane(data, selection, around, pblimit=FAINTEST)
    if plane.notes:
        raise ValueError(f"gridder = 'mosaic': CASA has no primary beam of the telescope '{telescope}': image with "
                         "gridder = 'standard'")
    half = TABLE_PIXELS // 2
    along = plane.pb[half:, half].astype(float)
    faint = np.flatnonzero((along < FAINTEST) | np.append(np.diff(along) > 0, True))  # to its end, or its first minimum
    radius = (faint[0] - 1) * cell
    distance = radius * np.sqrt(np.linspace(0, 1, PROFILE))
    return radius, np.interp(distance / cell, np.arange(half), along).astype(np.float32)
