"""The communicator of the ranks of an MPI job.  mpi4py is imported when it is made, not before."""

from __future__ import annotations

import atexit
import os
import pickle
import shutil
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import numpy.typing as npt

from casa_sara.parallel.serial import Number, Serial, T

__all__ = ["LAUNCHED", "MPI", "world"]

LAUNCHED = ("OMPI_COMM_WORLD_RANK", "PMIX_RANK", "PMI_RANK")  # set by mpirun and srun, one of them at least
SPIN, NAP = 0.001, 1e-4  # s of waiting at full speed; s of each pause after that
GRACE = 10.0  # s that the other ranks have to end by themselves after an error
PIECE = 1 << 28  # bytes of one message
ERROR, STOP = 0, 1  # tags of what ranks say unasked
FEW = 1 << 20  # values that every rank can be given
SHARED_MEMORY = "/dev/shm"


class MPI(Serial):
    """One rank of several processes.

    Errors: before ranks exchange anything they meet at a barrier that does not block.  While a rank waits there it
    looks for word of an error of another rank, and raises it too.  So no rank waits for one that will not come.

    Parameters
    ----------
    comm : mpi4py.MPI.Intracomm
        This communicator is duplicated.
    """

    def __init__(self, comm):
        from mpi4py import MPI as mpi

        self._mpi, self._comm, self._errors = mpi, comm.Dup(), comm.Dup()
        self.rank, self.size = comm.Get_rank(), comm.Get_size()
        self._node = comm.Split_type(mpi.COMM_TYPE_SHARED)
        self.node_size = self._node.Get_size()
        self.part, self._windows = (0, 1), []
        self._sent, self._raised, self._stuck = [], None, False
        self._stops, self._told, self._stop_code = [], 0, 0

    def allreduce(self, array: np.ndarray) -> np.ndarray:
        self._meet()
        self._comm.Allreduce(self._mpi.IN_PLACE, array)
        return array

    def iallreduce(self, array: np.ndarray) -> Callable[[], np.ndarray]:
        request = self._comm.Iallreduce(self._mpi.IN_PLACE, array)

        def wait():
            self._wait(request)
            return array
        return wait

    def total(self, number: Number) -> Number:
        return self._reduced(number, self._mpi.SUM)

    def largest(self, number: Number) -> Number:
        return self._reduced(number, self._mpi.MAX)

    def _reduced(self, number, operation):
        value = np.array([number], float if isinstance(number, (float, np.floating)) else np.int64)
        self._wait(self._comm.Iallreduce(self._mpi.IN_PLACE, value, operation))
        return value[0].item()

    def bcast_numbers(self, values: list[float]) -> list[float]:
        values = np.array(values, float)
        self._wait(self._comm.Ibcast(values))
        return values.tolist()

    def mean(self, values: np.ndarray, dtype: npt.DTypeLike | None = None) -> Any:
        dtype = values.dtype if dtype is None else np.dtype(dtype)
        total, count = self.allreduce(np.array([values.sum(dtype=float), values.size]))
        return dtype.type(total / count)

    def median(self, values: np.ndarray) -> Any:
        if self.total(values.size) <= FEW:
            return np.median(np.concatenate([part.ravel() for part in self.allgather(values)]))
        values = np.sort(values, axis=None)
        bits = values.view({4: np.int32, 8: np.int64}[values.itemsize])  # of numbers ≥ 0: these are in the same order
        count = self.total(values.size)
        middle = [self._order_statistic(bits, k) for k in {(count - 1) // 2, count // 2}]
        return np.mean(np.array(middle, bits.dtype).view(values.dtype))

    def _order_statistic(self, bits, k):
        """The k-th (from 0) of the sorted integers ≥ 0 of all ranks, by bisection."""
        low, high = 0, int(np.iinfo(bits.dtype).max)
        while low < high:
            between = (low + high) // 2
            if self.total(int(np.searchsorted(bits, between, "right"))) > k:
                high = between
            else:
                low = between + 1
        return low

    def norms(self, norms: np.ndarray) -> np.ndarray:
        return np.sqrt(self.allreduce(np.square(norms, dtype=float)))

    def block_sums(self, values: np.ndarray, offsets: np.ndarray) -> np.ndarray:
        return self.allreduce(np.array([values[a:b].sum(dtype=float) for a, b in zip(offsets[:-1], offsets[1:])]))

    def exscan(self, counts: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        every = self.allgather(np.asarray(counts))
        none = np.zeros_like(counts)
        return sum(every[: self.rank], none), sum(every, none)

    def bcast(self, value: T) -> T:
        self._meet()
        whole: Any = value
        array = isinstance(whole, np.ndarray) and whole.size > 0
        about = self._comm.bcast((whole.shape, whole.dtype.str) if array else None)
        if about is None:
            return self._comm.bcast(value)
        whole = np.empty(*about) if self.rank else np.ascontiguousarray(whole)
        memory = whole.reshape(-1).view(np.uint8)
        for start in range(0, memory.size, PIECE):
            self._comm.Bcast(memory[start : start + PIECE])
        return whole

    def allgather(self, value: T) -> list[T]:
        self._meet()
        return self._comm.allgather(value)

    def alltoall(self, values: list[T]) -> list[T]:
        self._meet()
        return self._comm.alltoall(values)

    def gather(self, array: np.ndarray) -> list[Any] | None:
        about = self.allgather((array.shape, array.dtype.str))
        if self.rank:
            self._send(np.ascontiguousarray(array), 0)
            return None
        return [array, *(self._receive(*about[rank], rank) for rank in range(1, self.size))]

    def scatter(self, arrays: list[np.ndarray] | None) -> np.ndarray:
        kinds = [(array.shape, array.dtype.str) for array in arrays or ()]
        shape, dtype = self.bcast(kinds)[self.rank]
        if self.rank or arrays is None:
            return self._receive(shape, dtype, 0)
        for rank in range(1, self.size):
            self._send(np.ascontiguousarray(arrays[rank]), rank)
        return arrays[0]

    def once(self, function: Callable[..., T], *arguments: Any, **options: Any) -> T:
        result: Any = None
        error: BaseException | None = None
        if self.rank == 0:
            try:
                result = function(*arguments, **options)
            except BaseException as raised:
                error = raised
        found = self.bcast(_portable(error, 0) if error else None)
        if found is not None:
            self._raised = error or found  # every rank knows
            raise self._raised
        return self.bcast(result)

    def together(self, function: Callable[..., T], *arguments: Any, **options: Any) -> T:
        result: Any = None
        error: BaseException | None = None
        try:
            result = function(*arguments, **options)
        except BaseException as raised:
            error = raised
        found = [words for words in self.allgather(_portable(error, self.rank) if error else None) if words is not None]
        if found:
            self._raised = error or found[0]  # every rank knows
            raise self._raised
        return result

    def same_here(self, value: object) -> int:
        self._meet()
        return self._node.allgather(value).count(value)

    def shared_images(self, count: int, shape: tuple[int, ...], dtype: npt.DTypeLike) -> list[np.ndarray]:
        return self._shared(count, shape, dtype) or super().shared_images(count, shape, dtype)

    def shared_slots(self, shape: tuple[int, ...], dtype: npt.DTypeLike) -> list[np.ndarray] | None:
        return self._shared(self.size, shape, dtype) if self.node_size == self.size else None

    def _shared(self, count, shape, dtype):
        """Return zeroed images in memory that the ranks of this machine share; None where it has no room for them."""
        size = count * int(np.prod(shape)) * np.dtype(dtype).itemsize
        if not self._node_has_room(size):
            return None
        self.part = self._node.Get_rank(), self.node_size
        window = self._mpi.Win.Allocate_shared(size if self._node.Get_rank() == 0 else 0, comm=self._node)
        self._windows.append(window)
        memory = np.frombuffer(window.Shared_query(0)[0], dtype).reshape(count, *shape)
        memory[...] = 0
        self.barrier()
        return list(memory)

    def _node_has_room(self, size):
        """Whether this machine has shared memory, and room for `size` more bytes in it, as its first rank finds."""
        free = shutil.disk_usage(SHARED_MEMORY).free if os.path.isdir(SHARED_MEMORY) else np.inf
        self._meet()
        return self.node_size > 1 and self._node.bcast(free > 1.1 * size + PIECE // 16)

    def own(self, image: np.ndarray) -> np.ndarray:
        return image.copy()

    def ask_stop(self, code: int) -> None:
        if not self._stops:
            self._stops = [self._errors.isend(code, rank, STOP) for rank in range(self.size) if rank != self.rank]

    def stop_asked(self) -> int:
        self._look_for_errors()
        while self._errors.Iprobe(tag=STOP):
            self._hear_stop()
        return self._stop_code

    def meet(self, meanwhile: Callable[[], Any]) -> None:
        self._wait(self._comm.Ibarrier(), meanwhile)
        asked = bool(self._stops)
        for _ in range(self.total(int(asked)) - asked - self._told):  # which have not arrived yet
            self._hear_stop()
        self._stops, self._told, self._stop_code = [], 0, 0

    def _hear_stop(self):
        """Receive what another rank has sent by :meth:`ask_stop`."""
        self._stop_code = self._errors.recv(tag=STOP)
        self._told += 1

    def barrier(self) -> None:
        if self.node_size > 1:
            self._wait(self._node.Ibarrier())

    @contextmanager
    def guarded(self) -> Iterator[Serial]:
        try:
            yield self
            self._meet()  # nobody leaves while another may still fail
            for window in self._windows:
                window.Free()
            self._windows.clear()
        except BaseException as error:
            if error is not self._raised:
                self._tell(error)
            raise

    def _send(self, array, rank):
        memory = array.reshape(-1).view(np.uint8)
        for start in range(0, memory.size, PIECE):
            self._wait(self._comm.Isend(memory[start : start + PIECE], rank))

    def _receive(self, shape, dtype, rank):
        array = np.empty(shape, dtype)
        memory = array.reshape(-1).view(np.uint8)
        for start in range(0, memory.size, PIECE):
            self._wait(self._comm.Irecv(memory[start : start + PIECE], rank))
        return array

    def _meet(self):
        """Wait until all ranks are here."""
        self._wait(self._comm.Ibarrier())

    def _wait(self, request, meanwhile=lambda: None):
        """Wait for the end of what ranks do together, or for word of an error."""
        begun = None
        while not request.Test():
            self._look_for_errors()
            meanwhile()
            now = time.monotonic()
            begun = begun or now
            time.sleep(0 if now - begun < SPIN else NAP)

    def _look_for_errors(self):
        """Raise what another rank has raised."""
        if self._errors.Iprobe(tag=ERROR):
            self._stuck = True
            self._raised = self._errors.recv(tag=ERROR)
            self._end_at_exit()
            raise self._raised

    def _tell(self, error):
        """Send word of this rank's error to all others."""
        self._raised, words = error, _portable(error, self.rank)
        self._sent = [self._errors.isend(words, rank, ERROR) for rank in range(self.size) if rank != self.rank]
        self._end_at_exit()

    def _end_at_exit(self):
        """End the job when this process ends: MPI cannot be closed in order while exchanges are open."""
        atexit.register(self._end)

    def _end(self):
        arrived, begun = self._errors.Ibarrier(), time.monotonic()
        while not arrived.Test() and time.monotonic() - begun < GRACE:
            time.sleep(0.01)
        self._mpi.COMM_WORLD.Abort(1)


def _portable(error, rank):
    """Return the error as another process can raise it, with a note that says where it comes from."""
    try:
        copy = pickle.loads(pickle.dumps(error))
    except Exception:
        copy = RuntimeError(f"{type(error).__name__}: {error}")
    if hasattr(copy, "add_note"):
        copy.add_note(f"This error was raised on rank {rank} of the MPI job.")
    return copy


def world():
    """Return the communicator of all ranks of the MPI job that this process is part of.

    Raises
    ------
    ValueError
        It is part of none, or mpi4py is not installed; the message says what to install and how to start.
    """
    how = "start the script with 'mpirun -n 4 python script.py', or with mpicasa"
    if not any(name in os.environ for name in LAUNCHED):
        raise ValueError(f"parallel = True: this process was not started by MPI: {how}. It needs an MPI (Open MPI or "
                         "MPICH, from the system or from PyPI) and mpi4py: pip install 'casa_sara[mpi]'")
    try:
        from mpi4py import MPI as mpi
    except (ImportError, RuntimeError) as error:
        raise ValueError(f"parallel = True: mpi4py cannot be used ({error}): pip install 'casa_sara[mpi]', and an MPI "
                         "(Open MPI or MPICH), the same that mpirun belongs to") from error
    if mpi.COMM_WORLD.Get_size() == 1 and os.environ.get("OMPI_COMM_WORLD_SIZE", "1") != "1":
        raise ValueError("parallel = True: mpi4py was built for another MPI than the one whose mpirun started this "
                         "process: every rank believes to be alone; pip install --force-reinstall --no-binary mpi4py "
                         "mpi4py")
    return MPI(mpi.COMM_WORLD)
