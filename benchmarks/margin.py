"""How far tsara's model is above tclean's: SNR to the truth over the reference skies, with and without gain errors.

    python benchmarks/margin.py [SKY ...] [--folder FOLDER]

Each sky is observed by the simulated VLA A–D of the demo at an input SNR of 35 dB. tsara runs with defaults, tclean
multiscale with the settings that the demo's grid found best. One line a case as soon as it is done.
"""

from __future__ import annotations

import argparse
import shutil
import sys
import tempfile
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent))

from scenes import SKIES, observe

GAINS = (0.0, 0.01)


def case_line(name, gain, folder):
    """Simulate one case, image it, and return its line of the table."""
    from casa_sara.analysis.metrics import smooth, snr
    from casa_sara.demo.cyga import CLEAN
    from casa_sara.demo.imagers import Case, quiet, run_tcleans, run_tsara

    with quiet(folder / "simulation.txt"):
        simulation = observe(name, folder, gain_rms=gain, seed=1)
    truth = simulation.truth
    case = Case(folder, simulation.vis, list(truth.shape), simulation.cell_arcsec, CLEAN)
    sara, briggs, natural = run_tsara(case), *run_tcleans(case)
    major, minor, angle = briggs.beam
    half = (0.5 * major / simulation.cell_arcsec, 0.5 * minor / simulation.cell_arcsec)
    cells = []
    for product in (sara, briggs, natural):
        halved = snr(smooth(truth, half, angle), smooth(product.model, half, angle))
        cells += [f"{snr(truth, product.model):6.1f}", f"{halved:6.1f}", f"{product.model.sum() / truth.sum():7.4f}",
                  f"{product.wall_s:5.0f}"]
    margin = snr(truth, sara.model) - max(snr(truth, briggs.model), snr(truth, natural.model))
    return f"| {name} | {gain:.0%} | " + " | ".join(cells) + f" | {margin:5.1f} |"


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("skies", nargs="*", default=["cyga", *SKIES])
    parser.add_argument("--folder", type=Path, help="where to keep the data and images; otherwise they are removed")
    options = parser.parse_args()
    sys.argv = sys.argv[:1]  # CASA reads the command line, too
    columns = [f"{name} {what}" for name in ("tsara", "Briggs −1", "natural") for what in ("SNR", "half beam", "flux", "s")]
    print("| sky | gain errors | " + " | ".join(columns) + " | margin |\n|" + "---|" * (len(columns) + 3), flush=True)
    for name in options.skies:
        for gain in GAINS:
            base = Path(tempfile.mkdtemp()) if options.folder is None else options.folder
            folder = base / f"{name}_{gain:g}"
            folder.mkdir(parents=True)
            print(case_line(name, gain, folder.resolve()), flush=True)
            if options.folder is None:
                shutil.rmtree(base)


if __name__ == "__main__":
    main()
