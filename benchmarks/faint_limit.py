"""How far the prior can go on faint skies: tsara that is told of the true sky, beside the better tclean.

    python benchmarks/faint_limit.py FOLDER [--set chosen|apart]      # FOLDER of faint.py, whose results are read

The scenes, judged as in faint.py, imaged with defaults; with the true support, where the sky smoothed to one beam is
above a thousandth of its peak, in place of what is significant; and with that and weights of the prior that are made of
the true sky in place of the model. Point sources are those that the solver finds. Margins are over the better tclean,
at half a beam and at one.
"""

from __future__ import annotations

import argparse
import os
import sys
from contextlib import ExitStack
from pathlib import Path
from unittest import mock

os.environ.setdefault("OMP_NUM_THREADS", "1")
sys.path.insert(0, str(Path(__file__).resolve().parent))

import numpy as np
from faint import EMPTY, Judge, cleaned, run_tsara
from faint_scenes import SETS
from machine import machine

TOLD = {"by default": (), "with the true support": ("support",), "and true weights": ("support", "weights")}


def told(judge: Judge, of: tuple[str, ...]) -> ExitStack:
    """Return what tells the solver of the true sky, once entered."""
    from casa_sara.solver import reweighting, significance

    sky, image = judge.skies[1.0], judge.truth.img.astype(np.float32)
    find, reweight, replaced = significance.SignificantSupport.update, reweighting.reweight, ExitStack()

    def update(self, ppd, *arguments):
        pixels = find(self, ppd, *arguments)
        ppd.support_only((sky > EMPTY * sky.max()) | ppd.points.pixels(ppd.model.shape), ppd.points)
        return pixels

    def reweight_by_truth(ppd, *arguments):
        model = ppd.model.copy()
        ppd.model[...] = image / ppd.unit_jy
        reweight(ppd, *arguments)
        ppd.model[...] = model

    if "support" in of:
        replaced.enter_context(mock.patch.object(significance.SignificantSupport, "update", update))
    if "weights" in of:
        replaced.enter_context(mock.patch.object(reweighting, "reweight", reweight_by_truth))
    return replaced


def main() -> None:
    """Read the command line and print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--set", choices=tuple(SETS), default="chosen")
    options = parser.parse_args()
    sys.argv = sys.argv[:1]  # CASA reads the command line, too
    head = "sky, S/N, array", *(f"margins {name}: half, one" for name in TOLD), "flux"
    print(f"{machine()}\n\n| {' | '.join(head)} |\n" + "|---" * len(head) + "|")
    margins = []
    for scene in SETS[options.set]:
        if scene.sky == "blank":
            continue
        folder = options.folder / scene.label
        judge, clean, found = Judge(folder), cleaned(scene, folder), []
        for name, of in TOLD.items():
            with told(judge, of):
                found.append(run_tsara(folder, judge, name.replace(" ", "_"), {}))
        margins.append([[one[beams] - clean[beams][beams] for beams in ("0.5", "1.0")] for one in found])
        cells = [f"{half:+.1f}, {one:+.1f}" for half, one in margins[-1]]
        cells.append(" ".join(f"{one['flux']:.2f}" for one in found))
        print(f"| {scene.label.removeprefix(f'{scene.group}_').replace('_', ' ')} | {' | '.join(cells)} |", flush=True)
    for name, (half, one) in zip(TOLD, np.array(margins).transpose(1, 2, 0)):
        print(f"\n- {name}: median {np.median(half):+.1f} dB at half a beam and {np.median(one):+.1f} at one; below "
              f"tclean on {np.sum(half < 0)} and {np.sum(one < 0)} of {len(half)}.")


if __name__ == "__main__":
    main()
