"""The measurement operator Φ: model image to visibilities, and its adjoint.

A point source of unit flux at pixel (ix, iy) contributes to visibility k

    exp(+2πi (u_k l + v_k m)),   l = −(ix − nx//2)·cell_x,   m = (iy − ny//2)·cell_y,

with (u, v) in wavelengths and l (east), m (north) in radians.  This is the sign
convention of the MeasurementSet and of tclean, without the w-term.

A real image needs half of the Fourier plane only, and visibilities that reach over the
inner part of it need fewer samples than the image has pixels: the image is decimated
(`decimation.py`) before a non-uniform FFT (`nufft.py`).  All visibilities go through one
transform; the blocks of the data are slices of its result.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from casa_sara.operators._arguments import for_adjoint, for_forward
from casa_sara.operators._decimation_kernels import decimate, expand, expand_rows, scratch_shape
from casa_sara.operators._workers import Workers
from casa_sara.operators.decimation import AxisDecimation, separable
from casa_sara.operators.nufft import NonUniformFFT, memory_size
from casa_sara.parallel.serial import SERIAL, Serial

__all__ = ["SMALLEST_EPS", "MeasurementOperator", "Summed", "WorkSpace", "check_cell", "check_field", "choose_eps",
           "eps_of", "grid_bytes", "share_of", "share_work_space"]

ARCSEC_PER_RAD = 180.0 * 3600.0 / np.pi
LARGEST_EPS = 1e-4
DECIMATE_NS, EXPAND_NS, ROWS_NS = 2.0, 1.5, 1.0  # of a pixel on one thread
SMALLEST_EPS = {np.dtype(np.float32): 1e-6, np.dtype(np.float64): 1e-13}


class MeasurementOperator:
    """Non-uniform Fourier transform of a real image, built once and applied often.

    Calls share work space: one operator serves one thread at a time (and uses `nthreads` itself).

    Parameters
    ----------
    uv : float64 (2, M)
        Baselines in wavelengths.
    cell_rad : float or (float, float)
        Pixel size in radians, positive; one number, or one per image axis.
    shape : (int, int)
        Image size (nx, ny); images are indexed [ix, iy], ix grows to the west.
    row_scale : real (M,), optional
        Factor on each visibility, e.g. the square root of its weight for whitening.
    eps : float
        Accuracy: bound on ‖error‖/‖result‖; at least 1e-6 in single and 1e-13 in double precision.
    dtype : float32 or float64
        Of images; visibilities are complex of the same precision.
    nthreads : int or Workers
        Threads used by each call, or the threads themselves.
    whole : (int, (float, float)), optional
        Number of all visibilities and their largest |u| and |v| in wavelengths, where `uv` is a share of them: grid and
        kernel, and with them the errors, are those of the whole.

    Attributes
    ----------
    workers : Workers
        These threads.

    Raises
    ------
    ValueError
        For an argument out of these ranges, or a `cell` too large for the longest baseline.
    """

    def __init__(self, uv: np.ndarray, cell_rad: npt.ArrayLike,  # noqa: PLR0913 - five have a default
                 shape: tuple[int, int], row_scale: np.ndarray | None = None, eps: float = 1e-6,
                 dtype: npt.DTypeLike = np.float32,
                 nthreads: int | Workers = 1, whole: tuple[int, npt.ArrayLike] | None = None) -> None:
        uv = np.asarray(uv, dtype=np.float64)
        if uv.ndim != 2 or uv.shape[0] != 2 or uv.shape[1] == 0 or not np.all(np.isfinite(uv)):
            raise ValueError(f"uv must be finite and of shape (2, M) with M >= 1, not {uv.shape}")
        self.shape = tuple(int(n) for n in shape)
        if len(self.shape) != 2 or min(self.shape) < 1:
            raise ValueError(f"imsize must be two sizes of at least 1 pixel, not {self.shape}")
        self.size, self.dtype = uv.shape[1], np.dtype(dtype)
        if self.dtype not in SMALLEST_EPS:
            raise ValueError(f"dtype must be float32 or float64, not {self.dtype}")
        if not SMALLEST_EPS[self.dtype] <= eps < 1:
            raise ValueError(f"eps={eps} must be at least {SMALLEST_EPS[self.dtype]} for {self.dtype}, and below 1")
        self.complex_dtype = np.result_type(self.dtype, np.complex64)
        row_scale = np.broadcast_to(1.0, self.size) if row_scale is None else np.asarray(row_scale, np.float64)
        if row_scale.shape != (self.size,):
            raise ValueError(f"row_scale must have shape ({self.size},), not {row_scale.shape}")
        self.workers = nthreads if isinstance(nthreads, Workers) else Workers(nthreads)
        frequencies = _cycles_per_pixel(uv, cell_rad)
        scales = np.stack([row_scale, row_scale], axis=1, dtype=self.dtype, casting="same_kind")
        lower = frequencies[1] < 0  # V(−u, −v) is the conjugate of V(u, v)
        np.negative(frequencies, out=frequencies, where=lower)
        np.negative(scales[:, 1], out=scales[:, 1], where=lower)
        if whole is None:
            whole = self.size, np.abs([frequencies.min(axis=1), frequencies.max(axis=1)]).max(axis=0)
        else:
            whole = whole[0], np.asarray(whole[1]) * np.broadcast_to(np.asarray(cell_rad, np.float64), (2,))
        self._plan(frequencies, scales, eps / 2, *whole)

    def _plan(self, frequencies, scales, eps, n_points, reach):
        """Decimation along both axes, then the transform of what it leaves; `frequencies` and `scales` are used up."""
        axes = _decimations(self.shape, reach, eps, self.dtype)
        for axis, frequency in zip(axes, frequencies):
            scales /= axis.response(frequency)[:, None]
            frequency -= axis.centre
            frequency *= axis.factor
        starts, counts = [axis.start for axis in axes], [axis.count for axis in axes]
        self._nufft = NonUniformFFT(frequencies, scales, starts, counts, eps, self.workers, n_points)
        self._rows, self._columns = (
            separable(axis, size, cells, factors, self.complex_dtype)
            for axis, size, (cells, factors) in zip(axes, self.shape, self._nufft.placement))
        self._lines = np.zeros((counts[0], self.shape[1]), self.dtype)
        self._scratch = np.zeros(scratch_shape(self._columns, self.workers.count), self.dtype)

    def forward(self, image: np.ndarray, out: np.ndarray | None = None) -> np.ndarray:
        """Return the visibilities Φ·image, complex (M,), of a real image (nx, ny), in `out` where given.

        Parameters
        ----------
        image : real (nx, ny)
            The image x.
        out : complex (M,), optional
            Receives the result.

        Returns
        -------
        complex (M,)
        """
        image, out = for_forward(self, image, out)
        self._nufft.clear()
        self.workers.run(decimate, image, self._rows, self._columns, self._nufft.grid, self._lines, self._scratch,
                         work_ns=DECIMATE_NS * image.size)
        self._nufft.to_points(out)
        return out

    def keep_in(self, space: WorkSpace, empty: Callable[..., np.ndarray]) -> None:
        """Work in a space that others use, too, and keep what there is of each visibility in other memory.

        Parameters
        ----------
        space : WorkSpace
            For the grid.
        empty : callable
            Makes an array from shape and dtype.
        """
        space.admit(self)
        self._nufft.points_in(empty)

    def adjoint(self, vis: np.ndarray, out: np.ndarray | None = None) -> np.ndarray:
        """Return the real image Re(Φ†·vis), (nx, ny), of complex visibilities (M,), in `out` where given.

        It is the adjoint for real inner products: Re⟨Φx, y⟩ = ⟨x, adjoint(y)⟩.

        Parameters
        ----------
        vis : complex (M,)
            The visibilities.
        out : real (nx, ny), optional
            Receives the result.

        Returns
        -------
        real (nx, ny)
        """
        vis, out = for_adjoint(self, vis, out)
        self._nufft.from_points(vis)
        self.workers.run(expand, self._nufft.grid, self._rows, self._columns, self._lines, self._scratch,
                         work_ns=EXPAND_NS * out.size)
        self.workers.run(expand_rows, self._lines, self._rows, out, work_ns=ROWS_NS * out.size)
        return out


class WorkSpace:
    """The grid of operators that are applied one after the other: as large as the largest of them needs."""

    def __init__(self) -> None:
        self._users: list[MeasurementOperator] = []
        self._memory = self._lines = np.empty(0, np.float32)

    def admit(self, operator: MeasurementOperator) -> None:
        """Let one more operator use it.

        Parameters
        ----------
        operator : MeasurementOperator
            In single precision.
        """
        self._users.append(operator)
        users = [operator]
        if operator._nufft.memory_size > self._memory.size or operator._lines.size > self._lines.size:
            self._memory = np.empty(max(operator._nufft.memory_size, self._memory.size), np.float32)
            self._lines = np.empty(max(operator._lines.size, self._lines.size), np.float32)
            users = self._users
        for user in users:
            user._nufft.work_in(self._memory)
            user._lines = self._lines[: user._lines.size].reshape(user._lines.shape)


def share_work_space(operators: Sequence[MeasurementOperator]) -> None:
    """Let operators that are applied one after the other share their grids: they hold what the largest of them needs.

    Parameters
    ----------
    operators : sequence of MeasurementOperator
        Of one precision.
    """
    if len(operators) < 2:
        return
    transforms = [operator._nufft for operator in operators]
    memory = np.empty(max(transform.memory_size for transform in transforms), operators[0].dtype)
    lines = np.empty(max(operator._lines.size for operator in operators), operators[0].dtype)
    for operator, transform in zip(operators, transforms):
        transform.work_in(memory)
        operator._lines = lines[: operator._lines.size].reshape(operator._lines.shape)


class NoVisibilities:
    """The operator of a process that holds none: `forward` returns nothing, `adjoint` an empty image."""

    def __init__(self, shape: tuple[int, int], dtype: npt.DTypeLike = np.float32, nthreads: int = 1) -> None:
        self.shape, self.size, self.dtype = tuple(shape), 0, np.dtype(dtype)
        self.complex_dtype, self.workers = np.result_type(self.dtype, np.complex64), Workers(nthreads)

    def forward(self, image: np.ndarray, out: np.ndarray | None = None) -> np.ndarray:
        """Return no visibilities.

        Parameters
        ----------
        image : real (nx, ny)
            The image, which is not looked at.
        out : complex (0,), optional
            Returned where given.

        Returns
        -------
        complex (0,)
        """
        return np.empty(0, self.complex_dtype) if out is None else out

    def adjoint(self, vis: np.ndarray, out: np.ndarray | None = None) -> np.ndarray:
        """Return zeros (nx, ny), in `out` where given.

        Parameters
        ----------
        vis : complex (0,)
            No visibilities.
        out : real (nx, ny), optional
            Receives the zeros.

        Returns
        -------
        real (nx, ny)
        """
        out = np.empty(self.shape, self.dtype) if out is None else out
        out.fill(0)
        return out


class Summed:
    """An operator whose visibilities are spread over the ranks of a communicator: `adjoint` is the sum of theirs."""

    def __init__(self, measurement: Any, comm: Serial) -> None:
        self._measurement, self._comm = measurement, comm
        self.shape, self.dtype, self.workers = measurement.shape, measurement.dtype, measurement.workers
        self.forward = measurement.forward

    def adjoint(self, vis: np.ndarray, out: np.ndarray | None = None) -> np.ndarray:
        """Return the image of all visibilities, on every rank.

        Parameters
        ----------
        vis : complex (M,)
            Of this rank.
        out : real (nx, ny), optional
            Receives the result.

        Returns
        -------
        real (nx, ny)
        """
        return self._comm.allreduce(self._measurement.adjoint(vis, out))


def share_of(uv: np.ndarray, *arguments: Any, comm: Serial = SERIAL,
             **options: Any) -> MeasurementOperator | NoVisibilities:
    """Return the operator of this rank's visibilities; arguments and errors as of :class:`MeasurementOperator`.

    Parameters
    ----------
    uv : float64 (2, M)
        Baselines of this rank's visibilities in wavelengths; M may be 0.
    *arguments, **options
        As of :class:`MeasurementOperator`.
    comm : casa_sara.parallel.serial.Serial or MPI
        Over whose ranks the visibilities are spread.

    Returns
    -------
    MeasurementOperator or NoVisibilities
    """
    if comm.size == 1:
        return MeasurementOperator(uv, *arguments, **options)
    reach = [comm.largest(float(np.abs(axis).max(initial=0))) for axis in uv]
    whole = comm.total(uv.shape[1]), reach
    if uv.shape[1]:
        return MeasurementOperator(uv, *arguments, **(options | dict(whole=whole)))
    return NoVisibilities(arguments[1], nthreads=options.get("nthreads", 1))


def check_cell(uv: np.ndarray, cell_rad: float | Sequence[float] | np.ndarray) -> None:
    """Raise ValueError unless pixels of `cell_rad` (one number, or one per axis) sample the fringes of uv (2, M).

    Parameters
    ----------
    uv : float64 (2, M)
        Baselines in wavelengths.
    cell_rad : float or (float, float)
        Pixel size in radians.
    """
    cell = np.broadcast_to(np.asarray(cell_rad, dtype=np.float64), (2,))
    if not np.all(cell > 0):
        raise ValueError(f"cell={cell_rad} must be positive, in radians")
    longest = np.maximum(uv.max(axis=1), -uv.min(axis=1))
    if np.any(longest * cell > 0.5):
        largest = 0.5 / longest.max() * ARCSEC_PER_RAD
        raise ValueError(f"cell={cell.max() * ARCSEC_PER_RAD:.4g}arcsec is too large for the longest baseline, "
                         f"{longest.max() / 1e3:.4g} klambda: use at most cell={0.999 * largest:.4g}arcsec")


def check_field(longest: float, shape: tuple[int, int], cell_rad: tuple[float, float]) -> None:
    """Raise ValueError unless the image is as wide as the fringe of the longest baseline, in wavelengths.

    Parameters
    ----------
    longest : float
        Longest baseline in wavelengths.
    shape : (int, int)
        Pixels of the image.
    cell_rad : (float, float)
        Pixel size in radians.
    """
    width = min(n * cell for n, cell in zip(shape, cell_rad))
    if width * longest < 1:
        cells = [f"{cell * ARCSEC_PER_RAD:.4g}arcsec" for cell in cell_rad]
        raise ValueError(f"imsize = {list(shape)} with cell = {cells} is an image {width * ARCSEC_PER_RAD:.3g} arcsec "
                         f"wide: should be at least as wide as the finest fringe, "
                             f"{ARCSEC_PER_RAD / longest:.3g} arcsec")


def _decimations(shape, reach, eps, dtype):
    """Decimation of both axes for |f| ≤ reach, in cycles per pixel; along columns f ≥ 0."""
    bands, precision = ((-reach[0], reach[0]), (0.0, reach[1])), np.finfo(dtype).eps
    return [AxisDecimation(size, band, eps, precision) for size, band in zip(shape, bands)]


def grid_bytes(size: int, reach: Sequence[float], shape: tuple[int, int], eps: float = 1e-6,
               dtype: npt.DTypeLike = np.float32) -> int:
    """Memory of an operator but for what it keeps of each visibility: its grid, and the decimated image.

    Parameters
    ----------
    size : int
        Number of visibilities M.
    reach : (float, float)
        Largest |u|·cell and |v|·cell, in cycles per pixel.
    shape, eps, dtype
        As of the operator.

    Returns
    -------
    int
    """
    axes = _decimations(shape, reach, eps / 2, np.dtype(dtype))
    starts, counts = [axis.start for axis in axes], [axis.count for axis in axes]
    cells = memory_size(size, starts, counts, eps / 2, dtype)
    return np.dtype(dtype).itemsize * (cells + counts[0] * shape[1])


def _cycles_per_pixel(uv, cell_rad):
    """Baselines (2, M) as frequencies along the image axes."""
    check_cell(uv, cell_rad)
    return uv * (np.broadcast_to(np.asarray(cell_rad, dtype=np.float64), (2,))[:, None] * [[-1.0], [1.0]])


def choose_eps(vis: np.ndarray, weight: np.ndarray, dtype: npt.DTypeLike = np.float32,
               comm: Serial = SERIAL) -> float:
    """Return the accuracy at which the operator's errors are far below the noise of the image.

    The errors in the naturally weighted dirty image are below eps times its peak, in practice a tenth of that; the
    peak is at most Σw|V|/Σw and the noise is 1/√Σw.  eps is the ratio of this noise to this peak.

    Parameters
    ----------
    vis : complex (M,)
        Jy.
    weight : real (M,)
        Inverse variance of the real part and of the imaginary part, 1/Jy².
    dtype : float32 or float64
        Of the operator.
    comm : casa_sara.parallel.serial.Serial or MPI
        Over whose ranks the visibilities are spread.

    Returns
    -------
    float
        At most 1e-4, and not less than the operator can.
    """
    peak, total = comm.allreduce(np.array([np.sum(values, dtype=np.float64)
                                           for values in (weight * np.abs(vis), weight)]))
    return eps_of(peak, total, dtype)


def eps_of(peak: float, total: float, dtype: npt.DTypeLike = np.float32) -> float:
    """Return :func:`choose_eps` of the sums Σw|V| and Σw.

    Parameters
    ----------
    peak, total : float
        Σw|V| and Σw.
    dtype : float32 or float64
        Of the operator.

    Returns
    -------
    float
    """
    return float(np.clip(np.sqrt(total) / max(peak, 1e-300), SMALLEST_EPS[np.dtype(dtype)], LARGEST_EPS))
