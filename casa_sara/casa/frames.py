"""Directions and frequencies: from metres in a field's frame to wavelengths in the image's.

The conventions are tclean's, measured on it: uvw is scaled by the LSRK frequency of each
integration, and a phase centre elsewhere than the field's is reached with those same
wavelengths.
"""

from __future__ import annotations

import numpy as np

from casa_sara.casa.subtables import check_rows, readable
from casa_sara.casa.tools import opened

__all__ = ["Geometry", "image_direction", "rotation_between", "separation"]

SPEED_OF_LIGHT = 299_792_458.0
_FIXED_FRAMES = ("J2000", "ICRS", "B1950", "B1950_VLA", "GALACTIC", "SUPERGAL", "ECLIPTIC")
_DOPPLER_STEP = 60.0  # s; linear interpolation is then good to 3e-12
_SAME_DIRECTION = 1e-14  # rad, the round-off of an angle


def _measures():
    import casatools

    return casatools.measures()


def image_direction(phasecenter, selected):
    """Return the direction measure of the image centre.

    Parameters
    ----------
    phasecenter : str or int
        '' is the field of lowest number that is selected of the first MeasurementSet, as in
        tclean; a field number (int, or a str of digits), or '[FRAME] LONGITUDE LATITUDE'.
    selected : list of SelectedMS
    """
    first = selected[0]
    text = str(phasecenter).strip()
    if text == "":
        return first.fields[min(first.fields)]
    if text.isdigit():
        return _field_direction(int(text), first)
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
    return _direction(frame, *angles)


def _radians(text):
    """Return an angle in CASA's notation, None if it is not one."""
    import casatools

    qa = casatools.quanta()
    try:
        angle = qa.convert(qa.quantity(text), "rad")
    except RuntimeError:
        return None
    return angle["value"] if angle["unit"] == "rad" else None


def _direction(frame, longitude, latitude):
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
            [cos(lat) * cos(lon), cos(lat) * sin(lon), sin(lat)],
        ]
    )


def _converted(vector, frame, target, epoch_s):
    """Return a unit vector of one direction frame in another one, at a time (MJD seconds, UTC) where it matters."""
    direction = _direction(frame, np.arctan2(vector[1], vector[0]), np.arctan2(vector[2], np.hypot(*vector[:2])))
    me = _measures()
    if epoch_s is not None:
        me.doframe(me.epoch("UTC", f"{epoch_s!r}s"))
    return _basis(me.measure(direction, target))[2]


def rotation_between(field, image, epoch_s=None):
    """Return the matrix that takes (u, v, w) at one phase centre to those at another.

    Parameters
    ----------
    field, image : dict
        Direction measures, in whatever frames.
    epoch_s : float, optional
        Time of the observation, MJD seconds UTC: B1950 and J2000 turn against each other by 0.6 arcsec in 40 years.

    Returns
    -------
    matrix : float64 (3, 3) or None
        None when the two are the same direction in the same frame: nothing is to be done.
    """
    basis_field, basis_image = _basis(field), _basis(image)
    if field["refer"] != image["refer"]:
        step, frames = 1e-3, (field["refer"], image["refer"], epoch_s)
        towards = _converted(basis_field[2], *frames)
        ahead = _converted(np.cos(step) * basis_field[2] + np.sin(step) * basis_field[1], *frames)
        north = ahead - towards * (towards @ ahead)
        north /= np.linalg.norm(north)
        basis_field = np.array([np.cross(north, towards), north, towards])
    elif np.linalg.norm(basis_field[2] - basis_image[2]) < _SAME_DIRECTION:
        return None
    return basis_image @ basis_field.T


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
        self._ms = ms
        self._rotations = {field: rotation_between(centre, image, ms.start_s) for field, centre in ms.fields.items()}
        self._factors = {}
        self.freq_range_hz = [np.inf, 0.0]

    def wavelengths(self, group, field, time, uvw_m):
        """Return the baselines at the image centre and the delay to it.

        Parameters
        ----------
        group : RowGroup
        field : int (R,), field numbers
        time : float64 (R,), MJD seconds
        uvw_m : float64 (3, R), metres at the field's phase centre

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
        for number in np.unique(field):
            matrix = self._rotations[int(number)]
            if matrix is not None:
                if not turned:
                    rotated, turned = uvw_m.copy(), True
                here = field == number
                rotated[:, here] = matrix @ uvw_m[:, here]
        shift = (rotated[2] - uvw_m[2])[:, None] * wave_number if turned else None
        return rotated[:, :, None] * wave_number, shift

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
            me.doframe(self._ms.fields[field])
            me.doframe(me.epoch("UTC", f"{time!r}s"))
            self._factors[key] = me.measure(me.frequency(frame, "1Hz"), "LSRK")["m0"]["value"]
        return self._factors[key]
