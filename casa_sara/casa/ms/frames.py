"""Directions and frequencies: from metres in a field's frame to wavelengths in the image's.

The conventions are tclean's, measured on it: uvw is scaled by the LSRK frequency of each
integration, and a phase centre elsewhere than the field's is reached with those same
wavelengths.
"""

from __future__ import annotations

import numpy as np

from casa_sara.casa.ms.subtables import check_rows, readable
from casa_sara.casa.runtime.tools import opened

__all__ = ["Geometry", "direction_measure", "direction_on_sky", "image_basis", "image_direction", "is_of_earth",
           "on_sky", "rotation_between", "separation", "turn_to_frame", "unit_vectors"]

SPEED_OF_LIGHT = 299_792_458.0
_FIXED_FRAMES = ("J2000", "ICRS", "B1950", "B1950_VLA", "GALACTIC", "SUPERGAL", "ECLIPTIC")
_OF_EARTH = ("HADEC", "AZEL", "AZELSW", "AZELGEO", "AZELSWGEO", "ITRF")  # frames that turn with it
_OF_OBJECTS = ("MERCURY", "VENUS", "MARS", "JUPITER", "SATURN", "URANUS", "NEPTUNE", "PLUTO", "SUN", "MOON", "COMET")
_DOPPLER_STEP = 60.0  # s; linear interpolation is then good to 3e-12
_NEAR_POLE = 0.005  # rad, within which directions are not converted one by one
_SAME_DIRECTION = 1e-14  # of unit vectors, the round-off of an angle


def _measures():
    import casatools

    return casatools.measures()


def image_direction(phasecenter, selected):
    """Return the direction measure of the image centre.

    Parameters
    ----------
    phasecenter : str or int
        '' is the field of lowest number that is selected of the first MeasurementSet, as in
        tclean; a field number (int, or a str of digits), or '[FRAME] LONGITUDE LATITUDE'. A field in a frame that turns
        with the Earth stands for where it is when the observation begins, in J2000.
    selected : list of SelectedMS
        The selected data of all MeasurementSets.
    """
    first = selected[0]
    return _as_kept(on_sky(_direction_of(phasecenter, first), first, first.start_s))


def direction_on_sky(phasecenter):
    """Return the direction measure of a `phasecenter` that is a direction on the sky, no field.

    Parameters
    ----------
    phasecenter : str
        '[FRAME] LONGITUDE LATITUDE'.

    Raises
    ------
    ValueError
        It is something else.
    """
    if not str(phasecenter).strip() or str(phasecenter).strip().isdigit():
        raise ValueError(f"phasecenter = '{phasecenter}': should be a direction on the sky, 'J2000 19h59m28.5s "
                         "+40d44m02s' and the like")
    return _as_kept(_direction_of(phasecenter, None))


def is_of_earth(direction):
    """Return whether the frame of a direction measure rotates with the Earth, as azimuth and elevation do."""
    return direction["refer"] in _OF_EARTH


def on_sky(direction, ms, time_s):
    """Return a direction of a field as one on the sky.

    Parameters
    ----------
    direction : dict
        Direction measure.
    ms : SelectedMS
        Where the telescope stands.
    time_s : float
        MJD seconds, UTC.

    Returns
    -------
    dict
        That in J2000 at this time where the frame turns with the Earth, else the same.

    Raises
    ------
    ValueError
        The frame is that of an object of the solar system.
    """
    if direction["refer"] in _OF_OBJECTS:
        raise ValueError(f"vis = '{ms.name}': the direction of a field is that of {direction['refer']}: moving sources "
                         "cannot be imaged, select other fields with field")
    if not is_of_earth(direction):
        return direction
    me = _measures()
    me.doframe(ms.position)
    me.doframe(me.epoch("UTC", f"{time_s!r}s"))
    return me.measure(direction, "J2000")


def _as_kept(direction):
    """Return a direction with the latitude of CASA's coordinates: kept as unit vectors, it is rounded near a pole."""
    longitude, latitude = (direction[axis]["value"] for axis in ("m0", "m1"))
    return direction_measure(direction["refer"], longitude, np.arcsin(np.sin(latitude)))


def _direction_of(phasecenter, first):
    """Return the direction measure of `phasecenter`, with fields of the SelectedMS `first`."""
    text = str(phasecenter).strip()
    if text == "":
        return first.fields[min(first.fields)]
    if text.isdigit():
        return _field_direction(int(text), first)
    if text.upper() in ("TRACKFIELD", *_OF_OBJECTS):
        raise ValueError(f"phasecenter = '{phasecenter}': moving sources cannot be followed: it takes a field number "
                         "or a direction on the sky")
    words = text.split()
    if len(words) == 2:
        words.insert(0, "J2000")
    wanted = "a field number, or 'J2000 19h59m28.5s +40d44m02s' and the like"
    if len(words) != 3:
        raise ValueError(f"phasecenter = '{phasecenter}' is not a direction: it takes {wanted}")
    frame = words[0].upper()
    if frame not in _FIXED_FRAMES:
        raise ValueError(f"phasecenter = '{phasecenter}': frame '{words[0]}' is not one of {', '.join(_FIXED_FRAMES)}")
    angles = [_radians(word) for word in words[1:]]
    if None in angles:
        raise ValueError(f"phasecenter = '{phasecenter}' holds something that is not an angle: it takes {wanted}")
    return direction_measure(frame, *angles)


def _radians(text):
    """Return an angle in CASA's notation, None if it is not one."""
    import casatools

    qa = casatools.quanta()
    try:
        angle = qa.convert(qa.quantity(text), "rad")
    except RuntimeError:
        return None
    return angle["value"] if angle["unit"] == "rad" else None


def direction_measure(frame, longitude, latitude):
    """Return the direction measure of two angles in radians."""
    angles = ({"unit": "rad", "value": float(angle)} for angle in (longitude, latitude))
    return {"type": "direction", "refer": frame, **dict(zip(("m0", "m1"), angles))}


def _field_direction(field, ms):
    """Return the phase centre of any field of this MeasurementSet, selected or not."""
    with opened("msmetadata", readable(ms.name)) as md:
        if field >= md.nfields():
            raise ValueError(f"phasecenter = {field}: '{ms.name}' has the fields 0 to {md.nfields() - 1}")
        check_rows(ms.name, FIELD=[field])
        return md.phasecenter(field)


def _basis(direction):
    """Return the rows east, north and towards, unit vectors (3, 3) at a direction, in its own frame."""
    lon, lat = direction["m0"]["value"], direction["m1"]["value"]
    cos, sin = np.cos, np.sin
    return np.array(
        [
            [-sin(lon), cos(lon), 0.0],
            [-sin(lat) * cos(lon), -sin(lat) * sin(lon), cos(lat)],
            unit_vectors(lon, lat),
        ]
    )


def image_basis(direction):
    """Return the axes of an image on the sky, in the frame of its centre.

    They are east and north at its centre but for the north pole, where every direction is south: there CASA follows the
    FITS standard, whose LONPOLE is then 0 and not 180, and both axes point the other way.

    Parameters
    ----------
    direction : dict
        Direction measure of the centre.

    Returns
    -------
    float64 (3, 3)
        Unit vectors: that of growing l (smaller x), that of growing m (larger y), and that to the centre.
    """
    basis = _basis(direction)
    if direction["m1"]["value"] >= np.pi / 2:
        basis[:2] *= -1
    return basis


def _converted(vector, frame, target, epoch_s):
    """Return a unit vector of one direction frame in another one, at a time (MJD seconds, UTC) where it matters.

    CASA's matrices are unitary to 1e-11, and its latitude is the arcsine of the third component: within δ of a pole it
    is wrong by 1e-11/δ, or NaN. There the mean of four vectors around is taken.
    """
    me = _measures()
    if epoch_s is not None:
        me.doframe(me.epoch("UTC", f"{epoch_s!r}s"))

    def converted(one):
        direction = direction_measure(frame, np.arctan2(one[1], one[0]), np.arctan2(one[2], np.hypot(*one[:2])))
        return _basis(me.measure(direction, target))[2]

    found = converted(vector)
    if abs(found[2]) < np.cos(_NEAR_POLE):
        return found
    axes = np.linalg.svd(vector[None])[2][1:]  # two across the vector
    mean = sum(converted(np.cos(4 * _NEAR_POLE) * vector + side * np.sin(4 * _NEAR_POLE) * axis)
               for axis in axes for side in (-1, 1))
    return mean / np.linalg.norm(mean)


def rotation_between(field, image, epoch_s=None):
    """Return the matrix that takes (u, v, w) at one phase centre to those along the axes of an image at another.

    Parameters
    ----------
    field, image : dict
        Direction measures, in whatever frames.
    epoch_s : float, optional
        Time of the observation, MJD seconds UTC: B1950 and J2000 turn against each other by 0.6 arcsec in 40 years.

    Returns
    -------
    matrix : float64 (3, 3) or None
        None when the two have the same axes in the same frame: nothing is to be done.
    """
    basis_field, basis_image = _basis_in(field, image["refer"], epoch_s), image_basis(image)
    if field["refer"] == image["refer"] and np.abs(basis_field - basis_image).max() < _SAME_DIRECTION:
        return None
    return basis_image @ basis_field.T


def _basis_in(direction, frame, epoch_s):
    """Return the rows east, north and towards at a direction, of its own frame, as unit vectors of another one."""
    basis = _basis(direction)
    if direction["refer"] == frame:
        return basis
    step, frames = 1e-3, (direction["refer"], frame, epoch_s)
    towards = _converted(basis[2], *frames)
    ahead = _converted(np.cos(step) * basis[2] + np.sin(step) * basis[1], *frames)
    north = ahead - towards * (towards @ ahead)
    north /= np.linalg.norm(north)
    return np.array([np.cross(north, towards), north, towards])


def turn_to_frame(direction, frame, epoch_s=None):
    """Return the matrix that takes unit vectors near a direction from its frame to another one.

    Parameters
    ----------
    direction : dict
        Direction measure.
    frame : str
        Name of the frame of the image.
    epoch_s : float, optional
        As of :func:`rotation_between`.

    Returns
    -------
    float64 (3, 3)
    """
    return _basis_in(direction, frame, epoch_s).T @ _basis(direction)


def unit_vectors(longitude, latitude):
    """Return the unit vectors (3, …) of directions in radians."""
    return np.array([np.cos(latitude) * np.cos(longitude), np.cos(latitude) * np.sin(longitude), np.sin(latitude)])


def separation(first, second):
    """Return the angle in radians between two direction measures."""
    matrix = rotation_between(first, second)
    return 0.0 if matrix is None else float(np.arctan2(np.hypot(*matrix[:2, 2]), matrix[2, 2]))


class Geometry:
    """Wavelengths and phase-centre shifts of the rows of one MeasurementSet.

    Parameters
    ----------
    ms : SelectedMS
    image : dict
        Direction measure of the image centre.

    Attributes
    ----------
    freq_range_hz : list of two float
        Lowest and highest LSRK frequency, edges of the channels, of the rows asked for so far.
    """

    def __init__(self, ms, image):
        self._ms, self._image = ms, image
        self._rotations, self._factors = {}, {}
        self.freq_range_hz = [np.inf, 0.0]

    def wavelengths(self, group, field, time, uvw_m):
        """Return the baselines at the image centre and the delay to it.

        Parameters
        ----------
        group : RowGroup
            Rows of one spectral window.
        field : int (R,), field numbers
            Field of each row.
        time : float64 (R,), MJD seconds
            MJD seconds of each row.
        uvw_m : float64 (3, R), metres at the field's phase centre
            Baselines in metres.

        Returns
        -------
        uvw : float64 (3, R, C)
            Wavelengths at the LSRK frequency of the C channels.
        shift : float64 (R, C) or None
            w at the image centre − w at the field's, in wavelengths: a visibility at the
            image centre is exp(−2πi·shift) times that at the field's. None when no row needs it.
        """
        factors = self.lsrk_factors(group.frame, field, time)
        self._note_range(group, factors)
        wave_number = group.freqs_hz / SPEED_OF_LIGHT * factors[:, None]
        rotated, turned = uvw_m, False
        for here, matrix in self._turns(field, time):
            if matrix is not None:
                if not turned:
                    rotated, turned = uvw_m.copy(), True
                rotated[:, here] = matrix @ uvw_m[:, here]
        shift = (rotated[2] - uvw_m[2])[:, None] * wave_number if turned else None
        return rotated[:, :, None] * wave_number, shift

    def _turns(self, field, time):
        """Yield the rows (bool) of each field, and of each time where it moves on the sky, with `rotation_between`."""
        for number in np.unique(field).tolist():
            of_field, centre = field == number, self._ms.fields[number]
            times = np.unique(time[of_field]).tolist() if is_of_earth(centre) else [self._ms.start_s]
            for at in times:
                if (number, at) not in self._rotations:
                    self._rotations[number, at] = rotation_between(on_sky(centre, self._ms, at), self._image,
                                                                   self._ms.start_s)
                yield of_field & (time == at) if len(times) > 1 else of_field, self._rotations[number, at]

    def frequencies(self, group, field, time):
        """Return the LSRK frequencies, float64 (R, C) in Hz, of rows as :meth:`wavelengths` takes them."""
        return group.freqs_hz * self.lsrk_factors(group.frame, field, time)[:, None]

    def _note_range(self, group, factors):
        """Widen `freq_range_hz` to the channels of these rows."""
        low, high = (group.freqs_hz - group.widths_hz / 2).min(), (group.freqs_hz + group.widths_hz / 2).max()
        self.freq_range_hz[0] = min(self.freq_range_hz[0], float(low * factors.min()))
        self.freq_range_hz[1] = max(self.freq_range_hz[1], float(high * factors.max()))

    def lsrk_factors(self, frame, field, time):
        """Return LSRK frequency / frequency in `frame` for every row; `time` in MJD seconds."""
        factors = np.ones(time.size)
        if frame in ("LSRK", "REST", "Undefined"):
            return factors
        for number in np.unique(field):
            here = field == number
            node = np.floor(time[here] / _DOPPLER_STEP)
            nodes = np.unique(np.concatenate([node, node + 1]))
            values = [self._lsrk_factor(frame, int(number), at) for at in (nodes * _DOPPLER_STEP).tolist()]
            factors[here] = np.interp(time[here], nodes * _DOPPLER_STEP, values)
        return factors

    def _lsrk_factor(self, frame, field, time):
        """Return the same at one time (MJD seconds, UTC) towards a field's phase centre."""
        key = frame, field, time
        if key not in self._factors:
            me = _measures()
            me.doframe(self._ms.position)
            me.doframe(on_sky(self._ms.fields[field], self._ms, time))
            me.doframe(me.epoch("UTC", f"{time!r}s"))
            self._factors[key] = me.measure(me.frequency(frame, "1Hz"), "LSRK")["m0"]["value"]
        return self._factors[key]
