"""One comparison of cubes: channel by channel on one grid and one spectral axis, and the maps of the line."""

from __future__ import annotations

import numpy as np

from casa_sara.analysis.areas import region_masks
from casa_sara.analysis.cube_comparison import CubeComparison, CubeProduct, LineMaps, line_measures
from casa_sara.analysis.measuring import measure
from casa_sara.casa.images.image_sets import check_same_data
from casa_sara.casa.images.sky_cube import read_sky_cube
from casa_sara.casa.runtime import log
from casa_sara.comparison.compare_images import (
    check_frame,
    frame_of,
    other_data,
    product_of,
    read_products,
    versions,
)
from casa_sara.comparison.observed_cube import ObservedCube
from casa_sara.comparison.skies import refuse_mosaics
from casa_sara.options import Comparing, Selection

__all__ = ["compare_cubes"]

MOST_SHOWN = 48  # channels of which pictures are made
UNITS = ("Jy/pixel",)


def compare_cubes(request: Comparing, selection: Selection | None = None, single: bool = False) -> CubeComparison:
    """Compare the cubes that several imagers made of one line.

    The pixels of the first model are the common grid, its channels the common axis, which all must have. With a
    selection of visibilities, the residual of every channel of every model is made of them with one operator and one
    set of weights; without, the residual cubes beside the models are used.

    Parameters
    ----------
    request : Comparing
        What to compare.
    selection : Selection, optional
        The MeasurementSets and the data selected in them.
    single : bool
        One product will do, for the report of one run.

    Returns
    -------
    CubeComparison

    Raises
    ------
    ValueError, FileNotFoundError
        The products cannot be compared; the message names the task parameter.
    """
    for name in ("frames", "inject", "features", "support"):
        if value := getattr(request, name):
            right = "''" if isinstance(value, str) else "[]"
            raise ValueError(f"{name} = {value!r} with cubes: for images of one channel only; should be {right}")
    sets = read_products(request, 1 if single else 2, with_residual=selection is None, cube=True)
    refuse_mosaics(request.models, sets)
    first, notes = sets[0].model, []
    check_frame(first, notes)
    truth = read_sky_cube(request.truth, "truth", UNITS) if request.truth else None
    _check_axes(sets, truth)
    observed = ObservedCube(selection, first, request, sets, notes) if selection else None
    if observed:
        notes.extend(other_data(sets, selection))
    else:
        check_same_data(sets)
        notes.extend(_lacking(sets))
    channels = _Channels(sets, truth, observed, request)
    for number in range(first.axis.size):
        channels.add(number)
    for product in channels.products():
        if not (single or product.model.any()):
            raise ValueError(f"models: '{product.name}' is zero in all channels: should be a model with emission")
    for note in notes:
        log.warn(note)
    return channels.comparison(notes)


def _check_axes(sets, truth):
    """Raise unless all cubes have the channels of the first."""
    first = sets[0].model
    for parameter, cube in [("models", one.model) for one in sets] + [("truth", truth)] * (truth is not None):
        if not cube.has_channels_of(first):
            raise ValueError(f"{parameter}: '{cube.name}' has {_axis_words(cube)}, '{first.name}' "
                             f"{_axis_words(first)}: should be cubes of the same channels")
    for one in sets:
        if one.residual is not None and one.residual.axis.size != first.axis.size:
            raise ValueError(f"models: '{one.residual.name}' has {one.residual.axis.size} channels, '{one.model.name}' "
                             f"{first.axis.size}: should be of one run")


def _axis_words(cube):
    freqs = cube.axis.freqs_hz
    return f"{freqs.size} channels, {freqs[0] / 1e6:.6f} to {freqs[-1] / 1e6:.6f} MHz in {cube.axis.frame}"


def _lacking(sets):
    """Yield notes about products without a residual or a beam."""
    for one in sets:
        if one.residual is None:
            yield f"'{one.name}' has no residual cube; with vis one is made"
        elif one.beam is None:
            raise ValueError(f"models: '{one.residual.name}' has no beams, and there is no image or PSF with beams: "
                             "give vis, or add the restored image")


class _Channels:
    """Measures channel after channel, and adds up the maps."""

    def __init__(self, sets, truth, observed, request):
        self._sets, self._truth, self._observed = sets, truth, observed
        self._first = sets[0].model
        self._plane = observed.plane if observed else self._first.plane.upright()
        self._frame = frame_of(self._plane)
        self._regions = region_masks(request.regions, self._frame)
        velocities = self._first.velocities
        self._unit = "MHz" if velocities is None else "km/s"
        self._values = self._first.axis.freqs_hz / 1e6 if velocities is None else velocities
        self._widths = np.abs(np.gradient(self._values))
        step = -(-self._values.size // MOST_SHOWN)
        self._shown = range(0, self._values.size, step)
        self._maps = LineMaps([one.name for one in sets], self._plane.shape)
        self._measures, self._images = [], {one.name: ({}, {}) for one in sets}
        self._truth_map = np.zeros(self._plane.shape) if truth else None
        self._squares, self._truth_sq = dict.fromkeys((one.name for one in sets), 0.0), 0.0

    def add(self, number):
        """Measure one channel."""
        own = {one.name: one.model.channel(number) for one in self._sets}
        models = {name: image.flux_on(self._plane) for name, image in own.items()}
        truth = self._true_sky(number, models)
        self._maps.add_models(models, self._widths[number])
        entry = {"channel": number, "frequency_hz": float(self._first.axis.freqs_hz[number])}
        if self._unit == "km/s":
            entry["velocity_km_s"] = float(self._values[number])
        beams, residuals, chi_square = self._residuals(number, own, models)
        if beams or not self._observed:
            products = [product_of(one, models[one.name], residuals[one.name], beams, self._frame.cell_arcsec)
                        for one in self._sets]
            nowhere = np.zeros(self._plane.shape, bool)
            entry["beams"] = {name: list(beam) for name, beam in beams.items()}
            entry |= measure(products, self._frame.cell_arcsec, beams, truth, nowhere, self._regions, chi_square)
            self._keep(number, products, entry)
        self._measures.append(entry)

    def products(self):
        """Return the products with their maps."""
        maps = self._maps
        return tuple(CubeProduct(one.name, maps.model[one.name], maps.moment0[one.name], maps.moment1(one.name),
                                 *self._images[one.name], dict(one.parameters), dict(one.record))
                     for one in self._sets)

    def comparison(self, notes):
        """Return what was measured."""
        products = self.products()
        measures = line_measures(products, self._measures, self._squares if self._truth else None, self._truth_sq)
        with_beams = [entry["beams"] for entry in self._measures if entry.get("beams")]
        beams = {name: tuple(beam) for name, beam in with_beams[len(with_beams) // 2].items()} if with_beams else {}
        return CubeComparison(products, self._frame.cell_arcsec, self._frame.centre_deg, self._values, self._unit,
                              self._first.axis.frame, beams, next(iter(beams), ""),
                              {"channels": self._measures} | measures, self._truth_map, versions(), tuple(notes))

    def _true_sky(self, number, models):
        """Return the truth of a channel on the common grid, None where it is not known, or nothing."""
        if self._truth is None:
            return None
        truth = self._truth.channel(number).flux_on(self._plane)
        self._truth_map += self._widths[number] * truth
        self._truth_sq += float(np.sum(truth**2))
        for name, model in models.items():
            self._squares[name] += float(np.sum((model - truth) ** 2))
        return truth if truth.any() else None

    def _residuals(self, number, own, models):
        """Return beams, residuals and χ² of a channel, of the visibilities or of the residual cubes."""
        if self._observed:
            return self._observed.measured(number, own, models)
        beams, residuals = {}, {name: {} for name in models}
        for one in self._sets:
            image = self._residual(one, number) if one.residual is not None else None
            if image is not None:
                weighting = "briggs" if one.weighting in ("briggs", "uniform") else "natural"
                beams.setdefault(weighting, one.beam[number])
                residuals[one.name][weighting] = image
        return beams, residuals, {}

    def _residual(self, one, number):
        """Return a residual on the common grid, None where the channel is blank."""
        image = one.residual.channel(number, finite=False)
        if not np.nan_to_num(image.pixels).any():
            return None
        found = image.brightness_on(self._plane)
        if not np.isfinite(found).all():
            covered = 100 * np.isfinite(found).mean()
            raise ValueError(f"models: '{image.name}' covers {covered:.3g} % of channel {number} of "
                             f"'{self._first.name}': give vis, and the residuals are made there")
        return found

    def _keep(self, number, products, entry):
        """Add the restored images to the maps, and keep those that pictures show."""
        weighting = next((name for name in entry["beams"] if all(name in one.residual for one in products)), None)
        if weighting is None:
            return
        sigma = {one.name: entry["products"][one.name][weighting]["sigma"] for one in products}
        self._maps.add_restored({one.name: one.restored[weighting] for one in products}, sigma, self._values[number],
                                self._widths[number])
        if number in self._shown:
            for one in products:
                for images, kind in zip(self._images[one.name], (one.restored, one.residual)):
                    images[number] = kind[weighting].astype(np.float32)
