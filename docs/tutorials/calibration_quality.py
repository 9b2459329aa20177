"""Reading the noise plot: wrong weights, and one bad antenna in one scan, found by tsara.

    python docs/tutorials/calibration_quality.py [folder]

Prints the table and makes the picture of calibration_quality.md.
"""

import shutil
import sys
import tempfile
from pathlib import Path

from casatools import table

from casa_sara import tsara
from casa_sara.demo.imagers import quiet
from casa_sara.demo.simulate import Observation, simulate_observation
from casa_sara.demo.sky import cyg_a_like

SEED = 5
NOISE_DB = 30.0
GAIN_RMS = 0.002
SIZE, CELL_ARCSEC = (160, 80), 0.2
BAD_SCAN, BAD_ANTENNA, BAD_GAIN = 4, 9, 1.2  # in the first MeasurementSet
WEIGHTS_TOO_HIGH = 4.0  # in the second: its noise is 2 x MS weights


def simulate(folder):
    """Observe a radio galaxy in the configurations B and C, well but for one antenna, and one set of weights."""
    observation = Observation(scans=6, integrations=8, channels=1, weight_scale=(1.0, WEIGHTS_TOO_HIGH))
    sky = cyg_a_like(SIZE, CELL_ARCSEC)
    simulation = simulate_observation(folder, sky, "BC", NOISE_DB, GAIN_RMS, SEED, observation)
    spoil(simulation.vis[0])
    return simulation.vis


def spoil(vis):
    """Multiply the visibilities of one antenna in one scan, as a wrong gain does."""
    tb = table()
    tb.open(vis, nomodify=False)
    try:
        scan, first, second = (tb.getcol(name) for name in ("SCAN_NUMBER", "ANTENNA1", "ANTENNA2"))
        bad = (scan == BAD_SCAN) & ((first == BAD_ANTENNA) | (second == BAD_ANTENNA))
        data = tb.getcol("DATA")
        data[..., bad] *= BAD_GAIN
        tb.putcol("DATA", data)
    finally:
        tb.close()


def main(folder):
    """Do it all; return the blocks of the run with all data, of that without the bad antenna, and the picture."""
    with quiet(folder / "casa.txt"):
        vis, name = simulate(folder), str(folder / "galaxy")
        before, after = find_and_leave_out(vis, name)
    return before, after, folder / "galaxy.report" / "blocks_1.png"


def find_and_leave_out(vis, name):
    """The tutorial: image, look at the blocks, leave out what is bad, and image again."""
    before = tsara(vis=vis, imagename=name, imsize=[160, 80], cell="0.2arcsec", report=True)
    # scan 4 of B stands out in the picture: without it
    after = tsara(vis=vis, imagename=name + "_without", imsize=[160, 80], cell="0.2arcsec", scan=["1~3,5~6", ""])
    return before["sara"]["blocks"], after["sara"]["blocks"]


def as_text(before, after):
    """Return the table of the blocks."""
    left = {(Path(block["ms"]).name, *block["scans"]): block["noise_found"] for block in after}
    lines = ["| MeasurementSet, scan | noise measured | noise found | found without the bad scan |",
             "|---|---|---|---|"]
    for block in before:
        key = Path(block["ms"]).name, *block["scans"]
        without = f"{left[key]:.2f}" if key in left else "–"
        lines.append(f"| {', '.join(map(str, key))} | {block['noise_measured']:.2f} | {block['noise_found']:.2f} "
                     f"| {without} |")
    return "\n".join(lines)


if __name__ == "__main__":
    home = Path(sys.argv[1] if len(sys.argv) > 1 else tempfile.mkdtemp(prefix="calibration_quality-"))
    home.mkdir(parents=True, exist_ok=True)
    *blocks, picture = main(home)
    print(as_text(*blocks))
    shutil.copy(picture, home / "calibration_quality.png")
    print(f"{home}/calibration_quality.png")
