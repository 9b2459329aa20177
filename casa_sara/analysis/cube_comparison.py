"""The data of a comparison of cubes: line maps, spectra, pictures of channels, and the measures of each channel."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import combinations
from typing import Any

import numpy as np

from casa_sara.analysis import metrics

__all__ = ["CubeComparison", "CubeProduct", "LineMaps", "line_measures"]

DETECTED = 5.0  # standard deviations of the residual, above which a pixel of a channel counts in moment 1


@dataclass(frozen=True)
class CubeProduct:
    """What one imager made; images are (nx, ny), indexed [ix, iy].

    Attributes
    ----------
    name : str
    model : ndarray
        Moment 0 of the model, Jy/pixel times the unit of the axis.
    moment0, moment1 : ndarray
        Of the restored images: Jy/beam times the unit of the axis, and the unit of the axis, NaN where nothing is
        detected.
    restored, residual : dict
        Channel → image in Jy/beam, float32, of the channels that pictures show.
    parameters : dict
        Task parameters in the history, name → text.
    record : dict
        What tsara recorded of the run, else empty.
    """

    name: str
    model: np.ndarray
    moment0: np.ndarray
    moment1: np.ndarray
    restored: dict[int, np.ndarray] = field(default_factory=dict)
    residual: dict[int, np.ndarray] = field(default_factory=dict)
    parameters: dict[str, str] = field(default_factory=dict)
    record: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class CubeComparison:
    """Several cubes and what was measured.

    Attributes
    ----------
    products : tuple of CubeProduct
    cell_arcsec, centre_deg
        As of :class:`casa_sara.analysis.comparison.Comparison`.
    values : float64 (nchan,)
        Place of each channel on the axis: radio velocity in km/s, or frequency in MHz.
    unit, frame : str
        'km/s' or 'MHz', and the frame of the axis.
    beams : dict
        Weighting → beam of the channel in the middle of those with data.
    weighting : str
        Of the maps and the pictures.
    measures : dict
        Plain numbers, strings, lists and dicts only: `channels` → a list of {channel, frequency_hz, velocity_km_s,
        beams, and `products` and `similarity` as of a Comparison}, without the latter where the channel is blank;
        `products` → name → {line_flux, peak_channel, sigma → {weighting → median of the channels}, truth → {snr}}, and
        `similarity` → {'one|other' → {moment0_db, moment1_rms}}; fluxes in Jy times the unit of the axis.
    truth : ndarray or None
        Moment 0 of the true sky, Jy/pixel times the unit of the axis.
    versions, notes
        As of Comparison.
    """

    products: tuple[CubeProduct, ...]
    cell_arcsec: tuple[float, float]
    centre_deg: tuple[float, float]
    values: np.ndarray
    unit: str
    frame: str
    beams: dict[str, tuple[float, float, float]]
    weighting: str
    measures: dict[str, Any]
    truth: np.ndarray | None = None
    versions: dict[str, str] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    frames: tuple = ()

    @property
    def axis_words(self) -> str:
        """The spectral axis in words."""
        first, last = self.values[[0, -1]]
        return f"{self.values.size} channels, {first:.7g} to {last:.7g} {self.unit} in {self.frame}"

    def measured(self, name: str, *keys: str) -> np.ndarray:
        """Return a measure of a product by channel.

        Parameters
        ----------
        name : str
            Of the product.
        *keys : str
            Of the measure, from the outside to the inside.

        Returns
        -------
        float64 (nchan,)
            NaN where it was not measured.
        """
        found = np.full(self.values.size, np.nan)
        for number, channel in enumerate(self.measures["channels"]):
            entry: Any = channel.get("products", {}).get(name, {})
            for key in keys:
                entry = entry.get(key, {})
            if entry != {}:
                found[number] = entry
        return found


class LineMaps:
    """Adds up the line maps of several products, channel after channel.

    Moment 1 is Σ I v/Σ I over the channels in which the mean of the products exceeds 5 times the mean of their σ: the
    same channels for all, so that none declares its own artefacts to be line.

    Parameters
    ----------
    names : sequence of str
        The products.
    shape : (int, int)
        Of a channel.
    """

    def __init__(self, names: Sequence[str], shape: tuple[int, int]) -> None:
        self._names = tuple(names)
        self.model, self.moment0, self._above, self._weighted = (
            {name: np.zeros(shape) for name in self._names} for _ in range(4))

    def add_models(self, models: dict[str, np.ndarray], width: float) -> None:
        """Add the models of a channel.

        Parameters
        ----------
        models : dict
            Name → Jy/pixel.
        width : float
            Of the channel.
        """
        for name in self._names:
            self.model[name] += width * models[name]

    def add_restored(self, restored: dict[str, np.ndarray], sigma: dict[str, float], value: float,
                     width: float) -> None:
        """Add the restored images of a channel.

        Parameters
        ----------
        restored : dict
            Name → Jy/beam.
        sigma : dict
            Name → standard deviation of the residual, Jy/beam.
        value, width : float
            Place and width of the channel.
        """
        mean = np.mean([restored[name] for name in self._names], axis=0)
        line = mean > DETECTED * np.mean([sigma[name] for name in self._names])
        for name in self._names:
            self.moment0[name] += width * restored[name]
            self._above[name][line] += restored[name][line]
            self._weighted[name][line] += value * restored[name][line]

    def moment1(self, name: str) -> np.ndarray:
        """Return the mean place of the line in each pixel, NaN where there is none.

        Parameters
        ----------
        name : str
            Of the product.

        Returns
        -------
        float64 (nx, ny)
        """
        above = self._above[name]
        return np.divide(self._weighted[name], above, out=np.full(above.shape, np.nan), where=above > 0)


def line_measures(products: Sequence[CubeProduct], channels: Sequence[dict[str, Any]],
                  squares: dict[str, float] | None = None, truth: float = 0.0) -> dict[str, Any]:
    """Return the measures of whole cubes.

    Parameters
    ----------
    products : sequence of CubeProduct
        With their maps.
    channels : sequence of dict
        The measures of the channels.
    squares : dict, optional
        Name → sum over the cube of the squared difference to the truth.
    truth : float
        Sum over the cube of the square of the truth.

    Returns
    -------
    dict
        `products` and `similarity` of :class:`CubeComparison`.
    """
    found: dict[str, Any] = {}
    for product in products:
        name = product.name
        own = [channel["products"][name] if "products" in channel else {} for channel in channels]
        flux = [entry.get("flux_jy", 0.0) for entry in own]
        sigma = {weighting: float(np.median(levels)) for weighting in ("natural", "briggs")
                 if (levels := [entry[weighting]["sigma"] for entry in own if weighting in entry])}
        found[name] = {"line_flux": float(product.model.sum()), "peak_channel": int(np.argmax(flux)), "sigma": sigma}
        if squares is not None:
            found[name]["truth"] = {"snr": float(10 * np.log10(truth / squares[name])) if squares[name] else np.inf}
    pairs = {}
    for one, other in combinations(products, 2):
        apart = one.moment1 - other.moment1
        both = np.isfinite(apart)
        pairs[f"{one.name}|{other.name}"] = {"moment0_db": metrics.similarity(one.moment0, other.moment0)} | (
            {"moment1_rms": float(np.sqrt(np.mean(apart[both] ** 2)))} if both.any() else {})
    return {"products": found, "similarity": pairs}
