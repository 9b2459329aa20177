"""What the models of mosaics have in common: the sky itself, where all of them see it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from casa_sara.casa.images.sky_image import read_sky_image

__all__ = ["as_skies", "common_area", "is_mosaic", "refuse_mosaics"]

PBLIMIT = 0.2  # of products that do not say theirs, as tclean's default
LEAST = 0.1  # of the primary beam, where a model of tsara ends


def is_mosaic(one) -> bool:
    """Return whether an ImageSet was imaged with the mosaic gridder, by its history."""
    return one.parameters.get("gridder", "").startswith("mosaic")


def as_skies(request, sets):
    """Return the products with models of the sky itself, where one of them or more are mosaics; else as they are.

    The model of tsara is the sky; that of tclean is the sky times its .pb, and is divided by it.

    Raises
    ------
    ValueError, FileNotFoundError
        A product is of a single pointing, or its .pb is absent; or what is asked for is not for mosaics.
    """
    if not any(map(is_mosaic, sets)):
        return sets
    for name in ("inject", "features"):
        if value := getattr(request, name):
            raise ValueError(f"{name} = {list(value)} with images of gridder = 'mosaic': sources are injected, and "
                             "features tested, in images of single pointings only; should be []")
    return [_sky(given, one) for given, one in zip(request.models, sets)]


def refuse_mosaics(models, sets):
    """Raise where a product is of several pointings."""
    for given, one in zip(models, sets):
        if is_mosaic(one):
            raise ValueError(f"models: '{given}' is a cube imaged with gridder = 'mosaic': should be an image of one "
                             "channel, or a cube of a single pointing")


def _sky(given, one):
    """Return a product with the model of the sky itself."""
    gridder, normtype = one.parameters.get("gridder", ""), one.parameters.get("normtype", "flatnoise")
    if gridder and not is_mosaic(one):
        raise ValueError(f"models: '{given}' was imaged with gridder = '{gridder}', and is the sky times a primary "
                         "beam, where others are mosaics: should be images of gridder = 'mosaic'")
    if not gridder or one.parameters.get("taskname") == "tsara" or normtype == "flatsky":
        return one
    if normtype != "flatnoise":
        raise ValueError(f"models: '{given}' was imaged with normtype = '{normtype}': should be 'flatnoise' or "
                         "'flatsky'")
    if not one.pb:
        raise FileNotFoundError(f"models: '{given}' was imaged with gridder = 'mosaic', and there is no .pb beside it, "
                                "by which its model has to be divided to be the sky")
    pb = read_sky_image(one.pb, "models", None).pixels
    if pb.shape != one.model.pixels.shape:
        raise ValueError(f"models: '{one.pb}' has {pb.shape[0]} x {pb.shape[1]} pixels, unlike its model: should be of "
                         "one run")
    sky = np.divide(one.model.pixels, pb, out=np.zeros_like(one.model.pixels), where=pb > 0)
    return replace(one, model=replace(one.model, pixels=sky))


def common_area(sets, primary_beams, plane, notes):
    """Return the primary beams of mosaics, NaN outside of what is compared, and where that is.

    Parameters
    ----------
    sets : list of ImageSet
        The products.
    primary_beams : dict
        Weighting → primary beam (nx, ny), from visibilities; empty without any.
    plane : SkyPlane
        The common grid.
    notes : list of str
        To which a line is added.

    Returns
    -------
    primary_beams : dict
        Weighting → float64 (nx, ny); empty unless the products are mosaics.
    area : bool (nx, ny) or None
    """
    if not any(map(is_mosaic, sets)):
        return {}, None
    if not primary_beams:
        name = next((one.pb for one in sets if one.pb), "")
        if not name:
            raise FileNotFoundError("models: there is no .pb beside them, which images of gridder = 'mosaic' need: "
                                    "give vis, or keep the .pb")
        pb = np.nan_to_num(read_sky_image(name, "models", None).brightness_on(plane))
        primary_beams = dict(natural=pb, briggs=pb)
    limit = max(LEAST, *(abs(float(one.parameters.get("pblimit", PBLIMIT))) for one in sets))
    area = np.all([pb >= limit for pb in primary_beams.values()], axis=0)
    notes.append(f"mosaics: models are the sky itself, restored and residual images the sky times the primary beam, of "
                 f"the same noise everywhere; all are compared where the primary beam is above {limit:g}")
    return {name: np.where(area, pb, np.nan) for name, pb in primary_beams.items()}, area
