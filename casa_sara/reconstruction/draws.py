"""The draws of a bootstrap: how models of one sky and other noise differ from the model, and the errors that follow."""

from __future__ import annotations

import zipfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

import numpy as np

__all__ = ["FEWEST", "Draws", "read_draws"]

FEWEST = 2  # draws of which an error is taken
LARGEST = 3e4  # of a difference as a 16-bit number: its largest is 65504


@dataclass
class Draws:
    """Differences x_b − x̂ of the draws' models from the model, kept where they are not 0.

    A difference takes 6 bytes for each of these pixels: its number, and a 16-bit floating-point value in units of the
    draw's scale, exact to 5e-4 of itself down to 2e-9 of the largest of the draw.

    Attributes
    ----------
    shape : (int, int)
        Of the model.
    asked : int
        How many draws were asked for.
    pixels : list of int32 (n,)
        Numbers of the pixels, row by row.
    values : list of float16 (n,)
    scales : list of float
        Jy/pixel.
    """

    shape: tuple[int, int]
    asked: int
    pixels: list[np.ndarray] = field(default_factory=list)
    values: list[np.ndarray] = field(default_factory=list)
    scales: list[float] = field(default_factory=list)

    def __len__(self) -> int:
        return len(self.scales)

    @property
    def complete(self) -> bool:
        """Whether all that were asked for are made."""
        return len(self) >= self.asked

    def add(self, difference: np.ndarray) -> None:
        """Keep one more draw.

        Parameters
        ----------
        difference : real (nx, ny)
            x_b − x̂, Jy/pixel.
        """
        pixels = np.flatnonzero(difference).astype(np.int32)
        values = difference.ravel()[pixels]
        scale = float(np.abs(values).max(initial=0)) / LARGEST or 1.0
        self.pixels.append(pixels)
        self.values.append((values / scale).astype(np.float16))
        self.scales.append(scale)

    def differences(self) -> Iterator[np.ndarray]:
        """Yield x_b − x̂ of every draw, float32 (nx, ny) in Jy/pixel: the same array, filled anew each time."""
        image = np.zeros(self.shape, np.float32)
        flat = image.reshape(-1)
        for pixels, values, scale in zip(self.pixels, self.values, self.scales):
            flat.fill(0)
            flat[pixels] = values.astype(np.float32) * np.float32(scale)
            yield image

    def seen(self, look: Callable[[np.ndarray], np.ndarray]) -> Draws:
        """Return the same draws of an image that is linear in these.

        Parameters
        ----------
        look : callable
            Takes an image of these draws, and returns another, (nx, ny).

        Returns
        -------
        Draws
        """
        images = (look(difference) for difference in self.differences())
        first = look(np.zeros(self.shape, np.float32))
        found = Draws(first.shape, self.asked)
        for image in images:
            found.add(image)
        return found

    def error(self, measure: Callable[[np.ndarray], np.ndarray] = lambda difference: difference) -> np.ndarray:
        """Return the error of something linear in the model: the root mean square of what it is of the differences.

        Parameters
        ----------
        measure : callable
            Takes an image (nx, ny) and returns an array.

        Returns
        -------
        float32
            Of the shape that `measure` returns.
        """
        total = sum(np.square(measure(difference), dtype=float) for difference in self.differences())
        return np.sqrt(total / len(self)).astype(np.float32)

    def flux_errors(self, labels: np.ndarray) -> np.ndarray:
        """Return the error of the flux of each region, from all the draws.

        Parameters
        ----------
        labels : int (nx, ny)
            Region 1 … n of each pixel, 0 for those in none.

        Returns
        -------
        float (n,)
            Jy.
        """
        regions, flat = int(labels.max(initial=0)) + 1, labels.reshape(-1)
        fluxes = [scale * np.bincount(flat[pixels], values.astype(float), regions)
                  for pixels, values, scale in zip(self.pixels, self.values, self.scales)]
        return np.sqrt(np.mean(np.square(fluxes), axis=0))[1:]

    def arrays(self) -> dict[str, np.ndarray]:
        """Return all of it as arrays, for a file."""
        empty = [np.zeros(0, np.int32)], [np.zeros(0, np.float16)]
        return dict(shape=np.array(self.shape), asked=np.array(self.asked),
                    counts=np.array([len(pixels) for pixels in self.pixels], int), scales=np.array(self.scales, float),
                    pixels=np.concatenate(self.pixels or empty[0]), values=np.concatenate(self.values or empty[1]))

    @classmethod
    def of(cls, arrays: dict[str, np.ndarray]) -> Draws:
        """Make it of what :meth:`arrays` has returned.

        Parameters
        ----------
        arrays : dict
            Arrays by name.

        Returns
        -------
        Draws

        Raises
        ------
        ValueError
            They do not fit together.
        """
        if not arrays["counts"].sum() == arrays["pixels"].size == arrays["values"].size:
            raise ValueError("its arrays do not fit together")
        places = np.cumsum(arrays["counts"])[:-1]
        parts = {name: [np.array(part) for part in np.split(arrays[name], places)] if len(arrays["scales"]) else []
                 for name in ("pixels", "values")}
        nx, ny = (int(n) for n in arrays["shape"])
        return cls((nx, ny), int(arrays["asked"]), **parts, scales=arrays["scales"].tolist())


def read_draws(path: str) -> Draws:
    """Read the file of draws that tsara writes with its images.

    Parameters
    ----------
    path : str
        Of the file.

    Returns
    -------
    Draws

    Raises
    ------
    ValueError
        It is no such file, or damaged.
    """
    try:
        with np.load(path, allow_pickle=False) as arrays:
            draws = Draws.of({name: arrays[name] for name in arrays.files})
        size = draws.shape[0] * draws.shape[1]
        good = len(draws.pixels) == len(draws) >= FEWEST and all(
            pixels.min(initial=0) >= 0 and pixels.max(initial=0) < size for pixels in draws.pixels)
    except (OSError, EOFError, KeyError, TypeError, IndexError, ValueError, zipfile.BadZipFile) as error:
        raise ValueError(f"models: '{path}' cannot be read as the draws of a model: {error}") from error
    if not good:
        raise ValueError(f"models: '{path}' cannot be read as the draws of a model: its arrays do not fit together")
    return draws
