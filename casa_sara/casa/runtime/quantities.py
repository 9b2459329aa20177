"""Numbers with units in task parameters."""

from __future__ import annotations

import math

__all__ = ["check_frequency", "check_spectral", "hertz", "radians", "seconds"]


def radians(text, parameter):
    """Return the angle `text`, as '0.5arcsec', in radians.

    Raises
    ------
    ValueError
        It is not an angle; the message names `parameter`.
    """
    if not _is(text, "rad"):
        raise ValueError(f"{parameter} = '{text}' is not an angle: it takes a number with its unit, as '0.5arcsec'")
    import casatools

    return casatools.quanta().convert(text, "rad")["value"]


def seconds(text, parameter):
    """Return the time span `text`, as '90min' or '2h', in seconds.

    Raises
    ------
    ValueError
        It is not a positive, finite time; the message names `parameter`.
    """
    value = 0.0
    if _is(text, "s"):
        import casatools

        value = casatools.quanta().convert(text, "s")["value"]
    if not 0 < value < math.inf:
        right = "a positive number with its unit, as '2h' or '90min'"
        raise ValueError(f"{parameter} = '{text}' is not a time: it takes {right}")
    return value


def check_frequency(text, parameter):
    """Raise ValueError unless `text` is a frequency, as '1.4GHz'."""
    if not _is(text, "Hz"):
        raise ValueError(f"{parameter} = '{text}' is not a frequency: it takes a number with its unit, as '1.4GHz'")


def hertz(text, parameter):
    """Return the frequency `text`, as '1.4GHz', in Hz; raise ValueError unless it is positive."""
    check_frequency(text, parameter)
    import casatools

    value = casatools.quanta().convert(text, "Hz")["value"]
    if not 0 < value < math.inf:
        raise ValueError(f"{parameter} = '{text}' should be a positive frequency, as '1.4GHz'")
    return value


def check_spectral(text, parameter):
    """Return 'Hz' for a frequency as '1.42GHz', 'km/s' for a velocity as '-10km/s'; raise ValueError for others."""
    for unit in ("Hz", "km/s"):
        if _is(text, unit):
            return unit
    raise ValueError(f"{parameter} = '{text}' is neither a channel number, a frequency nor a velocity: it takes 5, "
                     "'1.42GHz' or '10km/s'")


def _is(text, unit):
    """Tell whether a quantity has the dimension of this unit."""
    import casatools

    quanta = casatools.quanta()
    try:
        return quanta.compare(text, unit) or (unit == "rad" and quanta.isangle(text))
    except RuntimeError:
        return False
