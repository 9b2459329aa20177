"""One iteration on ranks of an MPI job: 1 rank × 2 threads beside 2 ranks × 1 thread and more, memory of each rank,
the sum.

    python benchmarks/parallel.py [--cases 0 1 …] [--repeat 15] [--rounds 3] [--costs]

The iteration is that of the task, on the same arrays, shared as the task shares them.  Every layout is an MPI job of
its own; the jobs take turns for some rounds, so that a ratio compares what ran at the same time.  Times are medians
over iterations of the slowest rank; "sum" is that of the image's gradient over the ranks alone.  Memory is what a rank
holds, above what it holds before: its own, and its share of what the ranks of a machine have in common.  The model is

    t = max over ranks of (operator on those that have visibilities + their visibilities + their bases) + sum

with the costs in casa_sara/imaging/load_balance.py, which --costs measures.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
import time
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parent))

from iteration import visibilities
from machine import resident_mb

from casa_sara.casa.ms.data_volume import DataVolume
from casa_sara.imaging.load_balance import assign_ranks, basis_costs, operator_costs
from casa_sara.operators.dictionary import SaraDictionary
from casa_sara.operators.measurement import MeasurementOperator, share_of
from casa_sara.options import SARA_BASES, ImageGrid, SolverOptions
from casa_sara.parallel.mpi import world
from casa_sara.solver.adaptive_ppd import AdaptivePPD

CASES = [(1024, 1024, 100_000, 12, 1), (2048, 2048, 1_000_000, 12, 2), (4096, 2048, 2_000_000, 22, 2)]
LAYOUTS = [(1, 2), (2, 1), (1, 1), (4, 1)]  # ranks, threads of each


def iteration(case, nthreads, repeat):
    """What one rank does: build its share, iterate, and let rank 0 print what was found."""
    comm, (nx, ny, _, blocks, _) = world(), case
    uv, cell, image, _ = visibilities(case)
    volume = DataVolume(uv.shape[1], tuple(np.abs(uv).max(axis=1)))
    ranks = assign_ranks(comm, volume, ImageGrid((nx, ny), (cell, cell)), SolverOptions(averaging=False))
    reader = ranks.reader(comm.rank)
    if reader is None:
        uv = uv[:, :0]
    else:
        uv = uv[:, uv.shape[1] * reader // ranks.readers : uv.shape[1] * (reader + 1) // ranks.readers]
    before = resident_mb()
    measurement = share_of(uv, cell, (nx, ny), eps=1e-5, nthreads=nthreads, comm=comm)
    dictionary = SaraDictionary((nx, ny), ranks.wavelets(SARA_BASES), nthreads=nthreads, n_bases=len(SARA_BASES))
    vis = measurement.forward(image)
    ppd = AdaptivePPD(measurement, dictionary, vis, np.linspace(0, vis.size, blocks + 1).astype(int),
                      np.full(vis.size, 0.5, np.float32), float(volume.samples), comm=comm)
    ppd.threshold, ppd.multipliers[:] = 1e-3, 0.1
    ppd.step()
    times, sums = [], []
    for _ in range(repeat):
        times.append(_seconds(comm, ppd.step))
        sums.append(_seconds(comm, lambda: comm.allreduce(ppd._data_gradient)))
    memory = comm.allgather(round(resident_mb() - before))
    if comm.rank == 0:
        print("\n" + json.dumps(dict(seconds=statistics.median(times), sum=statistics.median(sums), memory_mb=memory,
                                     readers=ranks.readers, owners=ranks.owners)), flush=True)


def _seconds(comm, call):
    comm.total(0)
    begin = time.perf_counter()
    call()
    return comm.largest(time.perf_counter() - begin)


def job(case, ranks, nthreads, repeat):
    """Run an MPI job and return what it found."""
    environment = dict(os.environ, OMPI_ALLOW_RUN_AS_ROOT="1", OMPI_ALLOW_RUN_AS_ROOT_CONFIRM="1",
                       OMP_NUM_THREADS=str(nthreads))
    found = subprocess.run(["mpirun", "--oversubscribe", "--bind-to", "none", "-n", str(ranks), sys.executable,
                            __file__, "--rank",
                            json.dumps([case, nthreads, repeat])], env=environment, capture_output=True, text=True)
    lines = [line for line in found.stdout.split("\n") if line.startswith('{"seconds"')]
    if not lines:
        raise RuntimeError(found.stderr)
    return json.loads(lines[0])


def modelled(case, found, ranks):
    """Seconds of the slowest rank by the table of costs, without the sum."""
    uv, cell, _, _ = visibilities(case)
    grid = ImageGrid(case[:2], (cell, cell))
    fixed, shared = operator_costs(DataVolume(uv.shape[1], tuple(np.abs(uv).max(axis=1))), grid, uv.shape[1])
    bases = basis_costs(SARA_BASES, case[:2])
    owners = np.array(found["owners"] or [0] * len(bases))
    readers = [rank * found["readers"] % ranks < found["readers"] for rank in range(ranks)]
    return max(reads * (fixed + shared / found["readers"]) + bases[owners == rank].sum()
               for rank, reads in enumerate(readers))


def compare(case, repeat, rounds):
    """One line for each layout."""
    found = {layout: [] for layout in LAYOUTS}
    for _ in range(rounds):
        for layout in LAYOUTS:
            found[layout].append(job(case, *layout, repeat))
    reference = [one["seconds"] for one in found[LAYOUTS[0]]]
    print(f"\n{case[0]} x {case[1]}, {case[2]:.0e} visibilities")
    print("| ranks x threads | s/iteration | ratio to 1 x 2 | sum, s | model, 1 thread, s | with visibilities | MB of "
          "each rank |")
    print("|---|---|---|---|---|---|---|")
    for (ranks, nthreads), every in found.items():
        ratios = sorted(one["seconds"] / base for one, base in zip(every, reference))
        last = every[-1]
        print(f"| {ranks} x {nthreads} | {statistics.median(one['seconds'] for one in every):.3f} | "
              f"{statistics.median(ratios):.2f} ({ratios[0]:.2f}–{ratios[-1]:.2f}) | "
              f"{statistics.median(one['sum'] for one in every):.4f} | {modelled(case, last, ranks):.3f} | "
              f"{last['readers']} | {', '.join(map(str, last['memory_mb']))} |",
              flush=True)


def costs():
    """The table of casa_sara/imaging/load_balance.py, measured: CPU time, one thread."""
    shape = (2048, 2048)
    image, out = np.ones(shape, np.float32), np.zeros(shape, np.float32)
    for name in SARA_BASES:
        dictionary = SaraDictionary(shape, (name,), n_bases=len(SARA_BASES))
        dual, weights = dictionary.allocate(), dictionary.allocate()
        seconds = _cpu(lambda: dictionary.dual_step(image, dual, 1.0, weights, out, 1.8))
        print(f"{name}: {seconds:.4f} s, table {basis_costs((name,), shape)[0]:.4f} s")
    for reach in (0.1, 0.2, 0.4):
        for size in (10_000, 1_000_000):
            uv = np.random.default_rng(1).uniform(-reach, reach, (2, size))
            operator = MeasurementOperator(uv, 1.0, shape, eps=1e-5)
            vis = operator.forward(image)
            seconds = _cpu(lambda: (operator.forward(image, vis), operator.adjoint(vis, out)))
            table = operator_costs(DataVolume(size, (reach, reach)), ImageGrid(shape, (1.0, 1.0)), size)
            print(f"operator, reach {reach}, {size} visibilities: {seconds:.4f} s, table {sum(table):.4f} s")


def _cpu(call, repeats=5):
    call()
    times = []
    for _ in range(repeats):
        begin = time.process_time()
        call()
        times.append(time.process_time() - begin)
    return min(times)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--cases", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--repeat", type=int, default=15)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--costs", action="store_true")
    parser.add_argument("--rank", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.rank:
        iteration(*json.loads(options.rank))
    elif options.costs:
        costs()
    else:
        for number in options.cases:
            compare(CASES[number], options.repeat, options.rounds)
