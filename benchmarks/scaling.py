"""How time and memory of a whole run grow with the image and with the data.

    python benchmarks/scaling.py FOLDER [--picture scaling.png] [--only visibilities] [--most 1e7]

One sky of 256² pixels (unresolved sources on extended emission) is observed by the VLA in four configurations. Images
of 256² to 4096² pixels are made of 10⁵ visibilities; images of 1024² of 10⁴ to 10⁸ in 12 blocks (`large_ms.py`). Every
run is `tsara` with defaults on two threads in a process of its own, from MeasurementSets to images; memory is the most
that the process has held above what CASA takes before. The exponents are those of a power law between one line and the
next.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent))

import large_ms
import numpy as np
from machine import machine, resident_mb
from scenes import VLA, Array, observe, scene_sky

CELL = 0.06  # arcsec
PIXELS = (256, 512, 1024, 2048, 4096)
VISIBILITIES = ("1e4", "1e5", "1e6", "1e7", "1e8")


def worker(parameters):
    """Run tsara once; print what it took."""
    from casa_sara.demo.imagers import quiet

    parameters = json.loads(parameters)
    with quiet(Path(parameters["imagename"] + ".txt")):
        import casatasks  # so that it counts for nobody

        from casa_sara import tsara

        assert casatasks.version()
        before, begin = resident_mb(), time.perf_counter()
        made = tsara(fullsummary=True, **parameters)
        seconds, memory = time.perf_counter() - begin, resident_mb() - before
    print(json.dumps(dict(seconds=seconds, memory=memory, iterations=made["iterdone"], stop=made["stopDescription"],
                          each=1e3 * made["sara"]["forecast"]["iteration_s"],
                          averages=made["sara"]["averaging"].get("averages", 0),
                          visibilities=sum(block["samples"] for block in made["sara"]["blocks"]))))


def run(folder, vis, pixels, blocks=0):
    """What one run took."""
    parameters = dict(vis=vis, imagename=str(folder / f"tsara{pixels}"), imsize=pixels, cell=f"{CELL}arcsec",
                      datacolumn="data", overwrite=True, nthreads=2, blocks=blocks)
    command = [sys.executable, __file__, "--worker", json.dumps(parameters)]
    environment = os.environ | dict(OMP_NUM_THREADS="1")
    return json.loads(subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True, env=environment).stdout)


def series(title, sizes, runs):
    """Print one table; `sizes` is what grows."""
    print(f"\n| {title} | visibilities | averages | s | exponent | iterations | ms per iteration | exponent | "
          "memory, MB | exponent |\n" + "|---" * 10 + "|", flush=True)
    done = []
    for size, made in zip(sizes, runs):
        steps = {key: "" for key in ("seconds", "each", "memory")}
        if done:
            growth = np.log(size / done[-1][0])
            steps = {key: f"{np.log(made[key] / done[-1][1][key]) / growth:.2f}" for key in steps}
        print(f"| {size:.3g} | {made['visibilities']:.3g} | {made['averages'] or 'none'} | {made['seconds']:.1f} | "
              f"{steps['seconds']} | {made['iterations']} {made['stop']} | {made['each']:.0f} | {steps['each']} | "
              f"{made['memory']:.0f} | {steps['memory']} |", flush=True)
        done.append((size, made))
    return done


def picture(path, curves):
    """Draw both curves."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(2, 2, figsize=(9, 6), sharex="col", constrained_layout=True)
    for column, (label, done) in zip(axes.T, curves.items()):
        sizes = np.array([size for size, _ in done], float)
        for axis, key, name in zip(column, ("each", "memory"),
                                   ("ms per iteration", "memory above CASA [MB]")):
            values = np.array([made[key] for _, made in done])
            axis.loglog(sizes, values, "o-", color="#0072B2", label="measured")
            axis.loglog(sizes, values[-1] * sizes / sizes[-1], ":", color="0.4", label="proportional")
            axis.set(ylabel=name)
            axis.grid(alpha=0.3)
        column[1].set(xlabel=label)
    axes[0, 0].legend()
    figure.savefig(path, dpi=100)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--picture", type=Path)
    parser.add_argument("--most", type=float, default=1e8, help="visibilities")
    parser.add_argument("--only", choices=("pixels", "visibilities"))
    options = parser.parse_args()
    sys.argv = sys.argv[:1]  # CASA reads the command line, too
    base, sky = options.folder.resolve(), scene_sky("points off pixels", CELL)
    from casa_sara.demo.imagers import quiet

    few, vis = base / "few", {}
    if options.only != "visibilities" and not few.exists():
        few.mkdir(parents=True)
        with quiet(few / "simulation.txt"):
            observe(sky, few, Array(VLA, tuple("ABCD")), 35.0)
    for name in VISIBILITIES:
        if options.only != "pixels" and float(name) <= options.most:
            vis[name] = [str(base / name / f"{config}.ms") for config in "ABCD"]
            if not (base / name).exists():
                with quiet(base / f"{name}.txt"):
                    large_ms.observe(base / name, float(name), CELL)
    print(machine())
    curves = {}
    if options.only != "visibilities":
        names = [str(few / f"{config}.ms") for config in "ABCD"]
        curves["pixels"] = series("pixels", [n * n for n in PIXELS], (run(few, names, n) for n in PIXELS))
    if options.only != "pixels":
        curves["visibilities"] = series("visibilities, 1024² pixels", [float(name) for name in vis],
                                        (run(base / name, vis[name], 1024, 12) for name in vis))
    if options.picture and len(curves) == 2:
        picture(options.picture, curves)


if __name__ == "__main__":
    if sys.argv[1:2] == ["--worker"]:
        argument, sys.argv = sys.argv[2], sys.argv[:1]
        worker(argument)
    else:
        main()
