"""One comparison of images: read, regrid, make all residuals with one operator, measure."""

from __future__ import annotations

import os
from dataclasses import replace
from functools import partial
from importlib.metadata import version

import numpy as np

from casa_sara.analysis import metrics
from casa_sara.analysis.areas import Frame, places, region_masks
from casa_sara.analysis.comparison import Comparison, Product
from casa_sara.analysis.measuring import measure, source_support
from casa_sara.analysis.polarisation import polarised_measures
from casa_sara.casa.images.fits_files import is_fits
from casa_sara.casa.images.image_sets import check_same_data, data_names, read_frames, read_image_set, read_polarised
from casa_sara.casa.images.sky_image import read_sky_image
from casa_sara.casa.runtime import log
from casa_sara.comparison.features import measures_of, test_features
from casa_sara.comparison.injection import Injection, can_be_repeated, recover
from casa_sara.comparison.observed import Observed
from casa_sara.comparison.observed_mosaic import ObservedMosaic
from casa_sara.comparison.skies import as_skies, common_area, is_mosaic
from casa_sara.options import Comparing, Selection
from casa_sara.reconstruction.draws import read_draws
from casa_sara.version import __version__

__all__ = ["check_frame", "compare_images", "frame_of", "other_data", "product_of", "read_products", "versions"]

INJECTED = 100.0  # flux of an injected source, in units of the noise per beam with natural weights
LOST = 1e-4  # fraction of the flux beyond the common grid that is worth a note
ARCSEC = np.radians(1 / 3600)
RADESYS = {"J2000": "FK5", "ICRS": "ICRS", "B1950": "FK4", "B1950_VLA": "FK4"}
VERSIONS = ("casatools", "numpy", "scipy", "astropy", "regions")


def compare_images(request: Comparing, selection: Selection | None = None, single: bool = False) -> Comparison:
    """Compare the images that several imagers made of one sky.

    The pixels of the first model are the common grid; if it is turned, mirrored or not in SIN projection, pixels of
    this size with x to the west and y to the north. With a selection of visibilities, the residual of every model is
    made of them with one operator and one set of weights; without, the residual images beside the models are used.

    Parameters
    ----------
    request : Comparing
        What to compare.
    selection : Selection, optional
        The MeasurementSets and the data selected in them.
    single : bool
        One product will do, for the report of one run; it does to test features or to inject sources, too.

    Returns
    -------
    Comparison

    Raises
    ------
    ValueError, FileNotFoundError
        The products cannot be compared; the message names the task parameter.
    """
    fewest = 1 if single or request.features or request.inject else 2
    sets = as_skies(request, read_products(request, fewest, with_residual=selection is None))
    first, notes = sets[0].model, []
    check_frame(first, notes)
    frames = read_frames(request.frames, first.plane.upright())
    # one grid
    kind = ObservedMosaic if any(map(is_mosaic, sets)) else Observed
    observed = kind(selection, first.plane.upright(), request, sets, notes) if selection else None
    plane = observed.plane if observed else _common_plane(sets, notes)
    models = {one.name: _on_grid(one.model, plane, first, "models", notes) for one in sets}
    truth = _truth(request, plane, first, notes)
    frame = frame_of(plane)
    regions = region_masks(request.regions, frame)
    injected = _places_to_inject(request, frame, sets, observed)
    features, of_features = _features(request, sets, observed), region_masks(request.features, frame, "features")
    repeat = partial(test_features, selection=selection, nthreads=request.nthreads)
    # one operator
    if observed:
        notes.extend(other_data(sets, selection))
        beams, residuals, chi_square = observed.measured(sets, models)
    else:
        check_same_data(sets)
        beams, residuals, chi_square = *_beside(sets, plane, notes), {}
    primary_beams, area = common_area(sets, observed.primary_beams if observed else {}, plane, notes)
    if area is not None:
        models = {name: model * area for name, model in models.items()}
        truth = truth if truth is None else truth * area
        regions = _within(regions, area)
    # measure
    products = tuple(product_of(one, models[one.name], residuals[one.name], beams, frame.cell_arcsec, primary_beams)
                     for one in sets)
    products = tuple(replace(product, **_errors(one, plane, regions, beams, frame.cell_arcsec, area),
                             polarised=_polarised(one.polarised, plane),
                             features=_tested(one, features.get(one.name), of_features, plane, repeat))
                     for product, one in zip(products, sets))
    support = _support(request, plane, frame, list(models.values()), truth, next(iter(beams.values())), notes)
    measures = measure(products, frame.cell_arcsec, beams, truth, support, regions, chi_square)
    polarised_truth = _polarised(read_polarised(request.truth, "truth"), plane) if request.truth else None
    for name, entry in polarised_measures(products, frame.cell_arcsec, beams, polarised_truth).items():
        measures["products"][name]["polarisation"] = entry
    if injected:
        _inject(injected, plane, request, selection, sets, beams, measures["products"])
    for note in notes:
        log.warn(note)
    return Comparison(products, frame.cell_arcsec, frame.centre_deg, beams, truth, support, regions, measures,
                      versions(), tuple(notes), frames, polarised_truth)


def versions():
    """Return the versions of the packages that measures depend on."""
    return {"casa_sara": __version__} | {name: version(name) for name in VERSIONS}


def check_frame(first, notes):
    """Raise unless the first product is in a frame that pictures can have; add a note where it is none of today."""
    if first.plane.frame not in RADESYS:
        raise ValueError(f"models: '{first.name}' is in {first.plane.frame}: the first should be in J2000, ICRS or "
                         "B1950")
    if RADESYS[first.plane.frame] == "FK4":
        notes.append(f"'{first.name}' is in {first.plane.frame}: so are the coordinates in the pictures")


def _common_plane(sets, notes):
    """Return the grid of the first model, upright; if one is turned, without the edges that not all images reach."""
    plane = sets[0].model.plane.upright()
    turned = any(one.model.plane.upright() is not one.model.plane for one in sets)
    return _covered(plane, sets, notes) if turned else plane


def _truth(request, plane, first, notes):
    """Return the true sky on the common grid, Jy/pixel, None where none is given."""
    if not request.truth:
        return None
    return _on_grid(read_sky_image(request.truth, "truth", ("Jy/pixel",)), plane, first, "truth", notes)


def frame_of(plane):
    """Return the coordinates of the common grid."""
    centre_deg = tuple(np.degrees(plane.centre).tolist())
    cell_arcsec = tuple((np.array(plane.cell_rad) / ARCSEC).tolist())
    return Frame(centre_deg, cell_arcsec, plane.shape, RADESYS[plane.frame])


def _places_to_inject(request, frame, sets, observed):
    """Return the pixel coordinates of the point sources to inject, by name; raise where no run can be repeated."""
    injected = places(request.inject, frame, "inject")
    if injected and not (observed and any(can_be_repeated(one) for one in sets)):
        raise ValueError(f"inject = {list(injected)}: needs vis, and images of tsara with their history among models; "
                         "images of other imagers cannot be made again")
    return injected


def read_products(request, fewest, **options):
    """Read the products (`options` as of :func:`read_image_set`) and give them different names."""
    models, names = request.models, request.names
    if len(models) < fewest:
        raise ValueError(f"models = {list(models)}: should be {fewest} or more products to compare")
    if names and len(names) != len(models):
        raise ValueError(f"names = {list(names)}: {len(names)} for {len(models)} models; should be one each, or none")
    if len(set(names)) < len(names) or any("|" in name or not name.strip() for name in names):
        raise ValueError(f"names = {list(names)}: should differ, not be empty, and hold no '|'")
    sets = [read_image_set(given, name, **options) for given, name in zip(models, names or [""] * len(models))]
    taken = set()
    for number, one in enumerate(sets):
        name = one.name.replace("|", "_")
        tries = [name, os.path.normpath(models[number]).replace("|", "_")]
        tries += [f"{name} {n}" for n in range(2, len(sets) + 2)]
        sets[number] = one.called(next(word for word in tries if word not in taken))
        taken.add(sets[number].name)
    return sets


def _within(regions, area):
    """Return the regions within what is compared of mosaics; raise where one of them has nothing there."""
    inside = {name: mask & area for name, mask in regions.items()}
    for name, mask in inside.items():
        if not mask.any():
            raise ValueError(f"regions: '{name}' lies where the primary beam of the mosaic is too low to compare: "
                             "should be within the mosaic")
    return inside


def _on_grid(image, plane, first, parameter, notes):
    """Return a model on the common grid, with notes about the regridding."""
    if not image.overlaps(plane):
        raise ValueError(f"{parameter}: '{image.name}' does not overlap '{first.name}' on the sky: should be images of "
                         "one field")
    if not image.pixels.any():
        raise ValueError(f"{parameter}: '{image.name}' is zero everywhere: should be a model with emission")
    model = image.flux_on(plane)
    total = float(np.abs(image.pixels).sum(dtype=float))
    lost = 1 - float(np.abs(model).sum()) / total
    if not model.any():
        raise ValueError(f"{parameter}: '{image.name}' has no flux within '{first.name}': should show the same sky")
    if model.shape != image.pixels.shape or not np.array_equal(model, image.pixels):
        grid = "pixels along right ascension and declination" if image is first else f"the pixels of '{first.name}'"
        notes.append(f"'{image.name}' was regridded to {grid}, with its flux conserved")
        if lost > LOST:
            notes.append(f"{100 * lost:.2g} % of the flux of '{image.name}' cancels or lies outside of '{first.name}'")
    return model


def other_data(sets, selection):
    """Say which products were not made of just these visibilities."""
    given = data_names(selection.vis)
    for one in sets:
        if one.data and one.data != given:
            theirs, ours = (", ".join(sorted(names)) for names in (one.data, given))
            yield f"'{one.name}' was made from {theirs}, and is compared with {ours} like the others"
        if one.record.get("wild"):
            yield f"{len(one.record['wild'])} outliers that '{one.name}' left out are included in the residuals of all"


def product_of(one, model, residuals, beams, cell_arcsec, primary_beams=None):
    """Return a product with its restored images, model ∗ beam + residual, blank where the primary beam is."""
    restored, of_product = {}, dict(residuals)
    for weighting, residual in residuals.items():
        *axes, angle = beams[weighting]
        seen = model
        if primary_beams:
            pb = primary_beams[weighting]
            seen, of_product[weighting] = model * np.nan_to_num(pb), np.where(np.isfinite(pb), residual, np.nan)
        smoothed = metrics.smooth(seen, axes, angle, cell_arcsec) * metrics.beam_pixels(axes, cell_arcsec)
        restored[weighting] = smoothed + of_product[weighting]
    return Product(one.name, model, of_product, restored, dict(one.parameters), dict(one.record),
                   primary_beams=primary_beams or {})


def _polarised(images, plane):
    """Return Q + iU on the common grid, complex (nx, ny) in Jy/pixel, None where there are none."""
    return images["Q"].flux_on(plane) + 1j * images["U"].flux_on(plane) if images else None


def _features(request, sets, observed):
    """Return the regions to test, by product and name, on its own pixels; raise where no run can be repeated."""
    again = [one for one in sets if observed and can_be_repeated(one)]
    if request.features and not again:
        raise ValueError(f"features = {list(request.features)}: needs vis, and images of tsara with their history "
                         "among models; images of other imagers cannot be made again")
    return {one.name: region_masks(request.features, frame_of(one.model.plane.upright()), "features") for one in again}


def _tested(one, features, masks, plane, repeat):
    """Return the tests of a product's features: by name, measures, models with and without it and mask."""
    if not features:
        return {}
    own, tested = one.model.upright(), {}
    for name, result in repeat(one, features).items():
        models = [replace(own, pixels=model).flux_on(plane) for model in (result.with_, result.without)]
        tested[name] = measures_of(result), *models, masks[name]
    return tested


def _errors(one, plane, regions, beams, cell_arcsec, area):
    """Return the errors that a product's draws give: of the model, of the smoothed model and of regions."""
    if not one.draws:
        return {}
    draws = read_draws(one.draws)
    if draws.shape != one.model.pixels.shape:
        (nx, ny), (width, height) = draws.shape, one.model.pixels.shape
        raise ValueError(f"models: '{one.draws}' is of an image of {nx} x {ny} pixels, '{one.model.name}' has "
                         f"{width} x {height}: should be of one run of tsara")

    def on_plane(difference):
        flux = replace(one.model, pixels=difference).flux_on(plane)
        return flux if area is None else flux * area

    def fluxes(difference):
        flux = on_plane(difference)
        return np.array([flux[mask].sum() for mask in regions.values()])

    def smoothed(difference, major, minor, angle):
        return metrics.smooth(on_plane(difference), (major, minor), angle, cell_arcsec)

    return dict(model_error=draws.error(on_plane), region_errors=dict(zip(regions, draws.error(fluxes).tolist())),
                smoothed_error={name: draws.error(partial(smoothed, major=beam[0], minor=beam[1], angle=beam[2]))
                                for name, beam in beams.items()})


def _support(request, plane, frame, models, truth, beam, notes):
    """Return the support of the source, from a mask image, a region or the threshold."""
    text = request.support
    if not text:
        return source_support(models, truth, request.threshold, beam, frame.cell_arcsec)
    if os.path.isdir(text) or is_fits(text) or text.endswith((".fits", ".mask")):
        image = read_sky_image(text, "support", None)
        support = np.zeros(plane.shape, bool)
        if image.overlaps(plane):
            support = np.nan_to_num(image.brightness_on(plane)) > 0.5
    else:
        support = np.any(list(region_masks([text], frame, "support").values()), axis=0)
    if support.all() or not support.any():
        raise ValueError(f"support = '{text}' holds {support.sum()} of {support.size} pixels of the image: should be a "
                         "part of it, above 0.5 in a mask image")
    outside = max(model[~support].max() / model.max() for model in models)
    if outside > 0.5:
        notes.append(f"support = '{text}' excludes a pixel with {100 * outside:.2g} % of the peak of a model: please "
                     "check it")
    return support


def _inject(injected, plane, request, selection, sets, beams, measured):
    """Add the measures of the injected point sources."""
    again = [one for one in sets if can_be_repeated(one)]
    flux = request.injectflux or INJECTED * max(measured[one.name]["natural"]["sigma"] for one in again)
    widths = {weighting: float(np.sqrt(beam[0] * beam[1])) for weighting, beam in beams.items()}
    injection = Injection(injected, plane, flux, min(widths.values()))
    for one in again:
        found = recover(one, injection, selection, request.nthreads)
        for source in found.values():
            if "fwhm_arcsec" in source:
                source["fwhm_in_beams"] = {name: source["fwhm_arcsec"] / width for name, width in widths.items()}
        measured[one.name]["injected"] = found


def _covered(plane, sets, notes):
    """Return the plane without edges that an existing residual image does not cover, such as one that is rotated."""
    known = np.ones(plane.shape, bool)
    for one in sets:
        if one.residual is not None and one.residual.overlaps(plane):
            known &= np.isfinite(one.residual.brightness_on(plane))
    nx, ny = plane.shape
    edges = ((x, x * ny // nx) for x in range(nx // 2))
    x, y = next(((x, y) for x, y in edges if known[x : nx - x, y : ny - y].all()), (0, 0))
    if not x:
        return plane
    notes.append(f"compared within {nx - 2 * x} x {ny - 2 * y} pixels, which the residual images cover; with vis all "
                 "of the first model is compared")
    return plane.trimmed((x, y))


def _beside(sets, plane, notes):
    """Return the beams and the residuals by product and weighting, from the existing images of the products."""
    beams, residuals = {}, {one.name: {} for one in sets}
    for one in sets:
        if one.residual is None:
            notes.append(f"'{one.name}' has no residual image; with vis one is made")
            continue
        if one.beam is None:
            raise ValueError(f"models: '{one.residual.name}' has no beam, and there is no image or PSF with a beam: "
                             "give vis, or add the restored image")
        image = _residual_on(plane, one, sets[0])
        weighting = "briggs" if one.weighting in ("briggs", "uniform") else "natural"
        if one.weighting not in ("briggs", "natural"):
            known = f"weighting '{one.weighting}'" if one.weighting else "an unknown weighting"
            notes.append(f"the residual of '{one.name}' has {known}; it is listed under {weighting}")
        beam = beams.setdefault(weighting, one.beam)
        if not np.allclose(beam[:2], one.beam[:2], rtol=1e-2):
            notes.append(f"'{one.name}' has another beam, {one.beam[0]:.3g} x {one.beam[1]:.3g} arcsec; with vis "
                         "the residuals of all have the same beam")
        residuals[one.name][weighting] = image
    if not beams:
        beam = next((one.beam for one in sets if one.beam), None)
        if beam is None:
            raise ValueError("models: none of them has an .image, .residual or .psf with a beam: give vis, or "
                             "add a restored image")
        beams["natural"] = beam
    return beams, residuals


def _residual_on(plane, one, first):
    """Return the residual image of a product on the pixels of the plane, which is that of the first product's model."""
    image = one.residual.brightness_on(plane) if one.residual.overlaps(plane) else np.full(plane.shape, np.nan)
    if not np.isfinite(image).all():
        covered = 100 * np.isfinite(image).mean()
        raise ValueError(f"models: '{one.residual.name}' covers {covered:.3g} % of '{first.model.name}' and "
                         "cannot be put on its pixels: give vis, and the residuals are made there")
    return image


