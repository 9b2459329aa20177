"""Estimated bound over the true norm of noise and gain errors, per snapshot, on the demo's observation.

    python benchmarks/bounds.py
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent))

from scenes import observe


def main():
    sys.argv = sys.argv[:1]  # CASA reads the command line, too
    from casa_sara import tsara
    from casa_sara.demo.imagers import quiet

    print("| gain errors | " + " | ".join("ABCD") + " |\n|---|---|---|---|---|", flush=True)
    for gain in (0.0, 0.01):
        with tempfile.TemporaryDirectory() as folder:
            with quiet(Path(folder) / "simulation.txt"):
                simulation = observe("cyga", Path(folder) / "data", gain_rms=gain, seed=1)
            made = tsara(vis=simulation.vis, imagename=f"{folder}/tsara", imsize=list(simulation.truth.shape),
                         cell=f"{simulation.cell_arcsec}arcsec", datacolumn="data")
        ratios = {}
        for found, true in zip(made["sara"]["blocks"], simulation.blocks, strict=True):
            ratios.setdefault(found["ms"], []).append(found["l2_bound"] / true.error)
        cells = [f"{min(values):.3f}–{max(values):.3f}" for values in ratios.values()]
        print(f"| {gain:.0%} | " + " | ".join(cells) + " |", flush=True)


if __name__ == "__main__":
    main()
