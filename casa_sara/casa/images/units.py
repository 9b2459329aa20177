"""The brightness units of images in all spellings, with astropy and a table of further spellings."""

from __future__ import annotations

import re
import warnings

__all__ = ["brightness_unit"]

UNITS = ("Jy/pixel", "Jy/beam", "Jy/sr", "")
_WORDS = {"jy": "Jy", "jansky": "Jy", "janskys": "Jy", "pixel": "pixel", "pixels": "pixel", "pix": "pixel",
          "px": "pixel",
          "beam": "beam", "beams": "beam", "bm": "beam", "sr": "sr", "per": "/"}


def brightness_unit(text):
    """Return the unit of an image among those that can be worked with.

    Parameters
    ----------
    text : str
        As in an image: 'Jy/pixel', 'pixel-1 Jy', 'JY/PIX', 'mJy beam-1', 'MJy/sr' …

    Returns
    -------
    unit : str
        'Jy/pixel', 'Jy/beam', 'Jy/sr' or ''; the text itself where it is none of these.
    factor : float
        By which the pixels are multiplied to be in `unit`.
    """
    text = text.strip().strip('"').strip()  # CASA quotes what it does not know
    if text in UNITS:
        return text, 1.0
    from astropy import units  # takes a while, and few need it

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", units.UnitsWarning)  # of what other standards discourage
            found = units.Unit(re.sub(r"[^\W\d_]+", _word, text))
    except (ValueError, TypeError):
        return text, 1.0
    for name in UNITS:
        if found.is_equivalent(units.Unit(name)):
            return name, float(found.to(units.Unit(name)))
    return text, 1.0


def _word(match):
    """Return a name in a unit as astropy spells it; a prefix in capitals could be mega or milli, and is kept."""
    word = match[0]
    if word.lower() in _WORDS:
        return _WORDS[word.lower()]
    if word[1:].lower() == "jy" and not word.isupper():
        return word[0] + "Jy"
    return word
