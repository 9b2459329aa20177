"""The outlier file, in the format of tclean: what images there are beside the main one.

Lines `name = value`; empty lines, and those that begin with '#', say nothing. Each outlier begins with its imagename.
What is not given of imsize and cell is that of the main image.
"""

from __future__ import annotations

import ast
import os
from dataclasses import replace

from casa_sara.casa.ms.frames import direction_on_sky
from casa_sara.options import ImageGrid, Outlier
from casa_sara.private.pixels import cell_rad, pair

__all__ = ["read_outlier_file"]

# of tclean's file, what is the same for all images here, and the values that say no more than that
FIXED = {"nchan": ("1", "-1"), "specmode": ("mfs",), "nterms": ("1",), "start": ("",), "width": ("",)}
NEEDED = ("imagename", "imsize", "cell", "phasecenter")
KNOWN = (*NEEDED, "startmodel", "usemask", "mask", "pbmask")


def read_outlier_file(name: str, grid: ImageGrid, imagename: str) -> tuple[Outlier, ...]:
    """Read an outlier file.

    Parameters
    ----------
    name : str
        Its path; '' for none.
    grid : ImageGrid
        The main image, of which an outlier has what its file does not say.
    imagename : str
        Of the main image, which no outlier may have.

    Returns
    -------
    tuple of Outlier

    Raises
    ------
    ValueError, FileNotFoundError
        There is no such file, it defines no image, or a line says what is not possible; the line is named.
    """
    if not name:
        return ()
    if not os.path.isfile(name):
        raise FileNotFoundError(f"outlierfile = '{name}': there is no such file: should be a text file as of tclean, "
                                "with lines imagename=..., imsize=..., cell=..., phasecenter=...")
    outliers: list[dict[str, str]] = []
    with open(name, encoding="utf-8") as file:
        for number, line in enumerate(file, 1):
            text = line.strip()
            if text and not text.startswith("#"):
                _take(text, f"outlierfile = '{name}', line {number}, {text!r}", outliers, grid)
    if not outliers:
        raise ValueError(f"outlierfile = '{name}' defines no image: should have lines imagename=..., phasecenter=...")
    found, names = [], {os.path.abspath(imagename)}
    for given in outliers:
        found.append(_outlier(given, grid, f"outlierfile = '{name}', imagename = '{given['imagename']}'"))
        path = os.path.abspath(given["imagename"])
        if path in names:
            raise ValueError(f"outlierfile = '{name}': imagename = '{given['imagename']}' is that of another image, "
                             "too: should be a name of its own")
        names.add(path)
    return tuple(found)


def _take(text, where, outliers, grid):
    """Take over one line."""
    parameter, equals, value = (part.strip() for part in text.partition("="))
    if not equals:
        raise ValueError(f"{where}: should be name=value")
    if parameter == "imagename":
        outliers.append({})
    elif not outliers:
        raise ValueError(f"{where}: the first line should be imagename=..., with which each image begins")
    fixed = FIXED | {"gridder": (grid.gridder,), "reffreq": ("", grid.reffreq)}
    value = _unquoted(value)
    if parameter not in fixed:
        _check_known(parameter, value, where, outliers[-1])
        outliers[-1][parameter] = value
    elif value not in fixed[parameter]:
        raise ValueError(f"{where}: {parameter} of an outlier is that of the main image; should be left out")


def _check_known(parameter, value, where, given):
    """Raise where a parameter is none of an outlier, is given already, or needs a value."""
    if parameter not in KNOWN:
        raise ValueError(f"{where}: '{parameter}' is no parameter of an outlier: should be one of {', '.join(KNOWN)}")
    if parameter in given:
        raise ValueError(f"{where}: {parameter} is given twice for this image")
    if not value and parameter in NEEDED:
        raise ValueError(f"{where}: should have a value")


def _outlier(given, grid, where):
    """Return the outlier of these parameters."""
    if "phasecenter" not in given:
        raise ValueError(f"{where}: phasecenter is missing: should be a direction, 'J2000 19h58m40.9s +40d55m58.5s'")
    try:
        direction_on_sky(given["phasecenter"])
        shape, cell = _pixels(given, grid)
        mask, pbmask = _entries(given.get("mask", "")), float(given.get("pbmask", 0.0))
    except ValueError as error:
        raise ValueError(f"{where}: {error}") from error
    usemask = given.get("usemask", "user")
    if usemask not in ("user", "pb"):
        raise ValueError(f"{where}: usemask = '{usemask}': should be 'user' or 'pb'")
    own = replace(grid, shape=shape, cell_rad=cell, phasecenter=given["phasecenter"], usemask=usemask, mask=mask,
                  pbmask=pbmask)
    return Outlier(given["imagename"], own, given.get("startmodel", ""))


def _pixels(given, grid):
    """Return number and size of the pixels."""
    shape, cell = grid.shape, grid.cell_rad
    if "imsize" in given:
        right = "one number of pixels, or two"
        try:
            shape = tuple(int(word) for word in pair(_words(given["imsize"]), "imsize", right))
        except ValueError:
            shape = (0, 0)
        if min(shape) < 1:
            raise ValueError(f"imsize = {given['imsize']}: should be {right}")
    if "cell" in given:
        cell = tuple(map(cell_rad, pair(_words(given["cell"]), "cell", "one pixel size as '8arcsec', or two")))
    return shape, cell


def _words(text):
    """Return the words of a list, with or without brackets and quotes."""
    return [_unquoted(word.strip()) for word in text.strip("[] ").split(",")]


def _entries(text):
    """Return the entries of a mask: one, or a list of them in quotes."""
    if text[:2] in ("['", '["'):
        try:
            entries = ast.literal_eval(text)
        except (SyntaxError, ValueError):
            raise ValueError(f"mask = {text}: should be one region or image, or a list of them in quotes") from None
        return tuple(entry for entry in entries if entry.strip())
    return (text,) if text else ()


def _unquoted(text):
    """Return a text without quotes around it."""
    return text[1:-1] if len(text) > 1 and text[0] == text[-1] and text[0] in "\"'" else text
