"""What this machine can do, measured in the run that it is compared with: name, bandwidth, peak rate,
memory of a process."""

from __future__ import annotations

import os
import platform
import time
from pathlib import Path

import numpy as np
from numba import njit

from casa_sara.operators._vectors import VECTOR_BYTES, load, splat, store
from casa_sara.operators._workers import Workers

__all__ = ["bandwidth", "machine", "peak", "resident_mb", "seconds", "spread"]

CHAINS = 12  # independent multiply-adds, enough to hide their latency


@njit(nogil=True)
def copy(source, to, worker, workers):
    """Copy this worker's share of an array, a vector at a time."""
    like = splat(source[0])
    share = source.nbytes // workers // VECTOR_BYTES * VECTOR_BYTES
    for k in range(worker * share, (worker + 1) * share, VECTOR_BYTES):
        store(to.ctypes.data + k, load(source.ctypes.data + k, like))


@njit(nogil=True, fastmath={"contract"})
def multiply_add(rounds, result, worker, workers):
    """CHAINS independent chains of multiply-adds in registers."""
    m = splat(result[0])
    a = b = c = d = e = f = g = h = i = j = k = q = m
    for _ in range(rounds):
        a, b, c, d = a * m + m, b * m + m, c * m + m, d * m + m
        e, f, g, h = e * m + m, f * m + m, g * m + m, h * m + m
        i, j, k, q = i * m + m, j * m + m, k * m + m, q * m + m
    total = ((a + b) + (c + d)) + ((e + f) + (g + h)) + ((i + j) + (k + q))
    store(result.ctypes.data + worker * VECTOR_BYTES, total)


def seconds(function, *args):
    begin = time.perf_counter()
    function(*args)
    return time.perf_counter() - begin


def bandwidth(nthreads, repeat, megabytes=256):
    """Copy bandwidth in bytes/s, read and written bytes counted."""
    source, to = (np.ones(megabytes << 18, np.float32) for _ in range(2))
    workers = Workers(nthreads)
    workers.run(copy, source, to)
    return 2 * source.nbytes / np.median([seconds(workers.run, copy, source, to) for _ in range(repeat)])


def peak(nthreads, repeat, rounds=300_000):
    """Multiplications and additions per second in single precision."""
    result = np.full(nthreads * VECTOR_BYTES // 4, 0.5, np.float32)
    workers = Workers(nthreads)
    workers.run(multiply_add, 1, result)
    flops = 2 * CHAINS * rounds * VECTOR_BYTES // 4 * nthreads
    return flops / np.median([seconds(workers.run, multiply_add, rounds, result) for _ in range(repeat)])


def machine():
    model = next((line.split(":")[1].strip() for line in Path("/proc/cpuinfo").read_text().splitlines()
                  if line.startswith("model name")), platform.processor()) if os.path.exists("/proc/cpuinfo") else ""
    return f"{model or platform.machine()}, {os.cpu_count()} cores, vectors of {VECTOR_BYTES} bytes"


def resident_mb(kind="VmHWM"):
    """Resident memory of this process, or its largest so far."""
    with open("/proc/self/status") as status:
        return next(int(line.split()[1]) / 1024 for line in status if line.startswith(kind))


def spread(times, unit=1e3):
    """Median and quartiles in words, in milliseconds."""
    low, middle, high = np.percentile(times, (25, 50, 75)) * unit
    return f"{middle:.1f} ({low:.1f}–{high:.1f})"
