"""Does a long session stay as it was: memory, open files, results.

    python benchmarks/endurance.py [--iterations 10000] [--runs 10]

Four checks on a small simulated MeasurementSet, each a line of the table printed:

1. one solution of many iterations: growth of the resident memory, fitted after the first tenth, and of the open files;
2. runs one after the other in one session: growth after the second, files, and whether the results are the same;
3. runs at the same time in threads, and from an event loop, beside it and inside it: whether the results are the same;
4. one to four threads: the largest relative difference of the models.
"""

import argparse
import asyncio
import os
import sys
import tempfile
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "tests")]

from casa_sara import tsara
from casa_sara.runtime.machine import resident_memory

CELL_RAD = np.radians(0.5 / 3600)
SKY = [(1.0, -24 * CELL_RAD, 14 * CELL_RAD), (0.4, 18 * CELL_RAD, -20 * CELL_RAD), (0.2, 4 * CELL_RAD, 3 * CELL_RAD)]
OBSERVATION = dict(configuration="c", antennas=27, sky=SKY, noise=0.05, scans=4, scan_seconds=240.0, integration=20.0,
                   spacing_seconds=5400.0, hour_angle=-2.5)  # 50 544 visibilities
GRID = dict(imsize=128, cell="0.5arcsec", datacolumn="data", overwrite=True)
FOREVER = dict(reltol=0.0, reweighttol=0.0, reweightdecay=1.0, nreweights=10**6)


def open_files():
    """Number of files that this process has open."""
    return len(os.listdir("/proc/self/fd"))


def model_of(name):
    """Pixels of a model image."""
    from casatools import image

    ia = image()
    ia.open(f"{name}.model")
    try:
        return ia.getchunk()[:, :, 0, 0]
    finally:
        ia.close()


def run(vis, name, **changes):
    """Image one MeasurementSet; return the model."""
    tsara(vis=vis, imagename=name, **GRID | dict(nthreads=1) | changes)
    return model_of(name)


def growth(values):
    """Slope of a straight line through values, per step."""
    return float(np.polyfit(np.arange(len(values)), values, 1)[0])


def long_solution(vis, iterations):
    """Bytes of growth per 1000 iterations after the first tenth, iterations done, files opened more than closed.

    The solver is called directly: the task would have converged long before.
    """
    from casa_sara.casa.ms.read import read_visibilities
    from casa_sara.data.blocks import snapshot_blocks
    from casa_sara.data.visibilities import sort_into_blocks
    from casa_sara.options import ImageGrid, Selection, SolverOptions
    from casa_sara.reconstruction.problem import Samples
    from casa_sara.reconstruction.reconstruct import Control, reconstruct

    data = read_visibilities(Selection((vis,), datacolumn="data"))
    data, offsets = sort_into_blocks(data, snapshot_blocks(data)[0])
    grid, options = ImageGrid((128, 128), (CELL_RAD, CELL_RAD)), SolverOptions(niter=iterations, **FOREVER)
    memory, files = [], []

    def watch(ppd, record):
        if ppd.iteration % max(1, iterations // 200) == 0:
            memory.append(resident_memory())
            files.append(open_files())

    record = reconstruct(Samples(data, offsets, np.ones(data.size)), grid, options, control=Control(watch)).record
    start = len(memory) // 10
    per_step = growth(memory[start:]) * 1000 / max(1, iterations // 200)
    return per_step, record.iteration[-1], files[-1] - files[start]


def many_runs(vis, runs, **changes):
    """Bytes of growth per run after the second, files opened more than closed, and whether all results are the same."""
    memory, files, models = [], [], []
    for number in range(runs):
        models.append(run(vis, "session", **changes))
        memory.append(resident_memory())
        files.append(open_files())
    same = all(np.array_equal(model, models[0]) for model in models)
    return growth(memory[min(2, runs - 2):]), files[-1] - files[0], same


def at_once(sets, **changes):
    """Whether runs in threads, in threads of an event loop and inside it give what they give one after the other."""
    alone = [run(vis, f"alone{k}", **changes) for k, vis in enumerate(sets)]
    with ThreadPoolExecutor(len(sets)) as pool:
        threads = list(pool.map(lambda k: run(sets[k], f"thread{k}", **changes), range(len(sets))))

    async def loop():
        jobs = (asyncio.to_thread(run, vis, f"loop{k}", **changes) for k, vis in enumerate(sets))
        return await asyncio.gather(*jobs), run(sets[0], "inside", **changes)

    beside, inside = asyncio.run(loop())
    return all(map(np.array_equal, alone * 2 + alone[:1], threads + list(beside) + [inside]))


def thread_counts(vis, counts=(1, 2, 3, 4), **changes):
    """Largest difference of the models from that of one thread, relative to its brightest pixel."""
    models = [run(vis, "threads", nthreads=count, **changes) for count in counts]
    return max(float(np.abs(model - models[0]).max() / models[0].max()) for model in models)


def main(iterations, runs):
    from simulated_ms import simulate

    from casa_sara.demo.imagers import quiet

    with tempfile.TemporaryDirectory() as folder, quiet(Path(folder) / "casa.txt"):
        os.chdir(folder)
        sets = [simulate(f"{k}.ms", **OBSERVATION, seed=k) for k in range(3)]
        session, files_session, same = many_runs(sets[0], runs)
        per_step, done, files = long_solution(sets[0], iterations)
        threads, difference = at_once(sets), thread_counts(sets[0])
        os.chdir(ROOT)
    print("| check | outcome |\n|---|---|")
    print(f"| {done} iterations | {per_step / 1024:.1f} kB per 1000 iterations, {files} more open files |")
    print(f"| {runs} runs in one session | {session / 1024:.1f} kB per run, {files_session} more open files, "
          f"results {'the same' if same else 'DIFFER'} |")
    print(f"| 3 runs at once in threads, 3 in an event loop, 1 inside it | results "
          f"{'the same' if threads else 'DIFFER'} |")
    print(f"| 1, 2, 3 and 4 threads | largest difference {difference:.1e} of the brightest pixel |")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--iterations", type=int, default=10_000)
    parser.add_argument("--runs", type=int, default=10)
    main(**vars(parser.parse_args()))
