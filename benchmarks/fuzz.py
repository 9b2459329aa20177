"""What tsara makes of MeasurementSets with one column of one table spoiled, counted by outcome.

    python benchmarks/fuzz.py [--tables main subtables] [--mode mfs] [--verbose] [WORDS]

spoils a small MeasurementSet in every way of `TABLES` whose name holds WORDS (a cell empty, of another shape or type,
not a number, an identifier out of range, a column gone, …) and runs tsara on it. Many cases share one process, which
says what it begins; when it dies or hangs, that case is counted and another process goes on after it. Right outcomes
are

    as untouched    the image of the MeasurementSet as it was: what was spoiled does not matter
    without rows    the image of it with the spoiled rows flagged
    clear error     an error that names vis (or datacolumn) and the spoiled column or subtable, not in CASA's words

and wrong ones "wrong image", "bare error", "changed" (the MeasurementSet is not the same afterwards), "signal" and
"hang".
"""

from __future__ import annotations

import argparse
import json
import os
import selectors
import shutil
import subprocess
import sys
import tempfile
from collections import Counter
from pathlib import Path

import casatools
import numpy as np

sys.path[:0] = [str(Path(__file__).resolve().parents[1] / "tests" / folder) for folder in ("", "faults")]

from machinery import hashes
from simulated_ms import column, edit, pixels
from spoiled import GRID, ROW, cells, lacking, observe, put, remake, shaped, undefined

LONGEST_S = 60  # of one case
SAME = 1e-5  # of the peak
GOOD = ("as untouched", "without rows", "clear error")
MODES = {
    "mfs": dict(niter=3),
    "uniform": dict(niter=0, weighting="uniform"),
    "cube": dict(niter=0, specmode="cube"),
    "dryrun": dict(niter=3, dryrun=True),
    "modelcolumn": dict(niter=0, savemodel="modelcolumn"),
    "corrected": dict(niter=3, datacolumn="corrected"),
}


# The cases: {table: {name: function of the path of a MeasurementSet that it spoils}} -------------


def main_cases():
    """Return the ways in which columns of the main table are spoiled."""
    cases = {}
    for col, shapes in {
        "MODEL_DATA": ((2, 2), (2, 4)), "CORRECTED_DATA": ((2, 2), (2, 4)),
        "DATA": ((2, 2), (2, 4), (1, 3), (4, 3), (3, 2), (6, 1)), "FLAG": ((2, 2), (2, 4), (1, 3), (3, 2)),
        "WEIGHT": ((1,), (3,), (4,)), "SIGMA": ((1,), (3,)), "WEIGHT_SPECTRUM": ((2, 2), (2, 4), (1, 3), (3, 2)),
        "UVW": ((2,), (4,)),
    }.items():  # fmt: skip
        for rows, which in (([0], "first row"), ([ROW], "one row"), (None, "all rows")):
            for manager in ("StandardStMan", "TiledShapeStMan"):
                cases |= {f"{col} {shape} in {which}, {manager}": shaped(col, rows, shape, manager=manager)
                          for shape in shapes}
                cases[f"{col} undefined in {which}, {manager}"] = undefined(col, rows, manager=manager)
        cases[f"{col} empty in one row"] = cells(col, [ROW], lambda cell: cell[..., :0])
        cases[f"{col} {shapes[0]} of fixed shape"] = shaped(col, None, shapes[0], manager="TiledColumnStMan",
                                                            shape=shapes[0])
        cases[f"{col} with an axis more"] = cells(col, None, lambda cell: cell[None], ndim=len(shapes[0]) + 1)
    for col in ("DATA", "WEIGHT", "SIGMA", "WEIGHT_SPECTRUM", "UVW"):
        cases |= {f"{col} {value} in one row": put(col, (..., ROW), value) for value in (np.nan, np.inf, -np.inf)}
    for col, kinds in {
        "DATA": ("dcomplex", "float", "double", "int"), "FLAG": ("int", "uchar", "float"),
        "WEIGHT": ("double", "int", "complex"), "SIGMA": ("double", "int"),
        "WEIGHT_SPECTRUM": ("double", "int", "complex"),
        "UVW": ("float", "int"), "TIME": ("float", "string"), "INTERVAL": ("float", "int"), "EXPOSURE": ("float",),
        "FLAG_ROW": ("int",), "TIME_CENTROID": ("float",),
        **dict.fromkeys(("ANTENNA1", "ANTENNA2", "FIELD_ID", "DATA_DESC_ID", "SCAN_NUMBER", "OBSERVATION_ID",
                         "STATE_ID"),
                        ("short", "double", "string")),
    }.items():  # fmt: skip
        cases |= {f"{col} of type {kind}": remake(col, _as_type(kind), valueType=kind) for kind in kinds}
    for col in ("ANTENNA1", "ANTENNA2", "FIELD_ID", "DATA_DESC_ID", "SCAN_NUMBER", "OBSERVATION_ID", "STATE_ID",
                "ARRAY_ID",
                "FEED1", "FEED2", "PROCESSOR_ID"):
        for value in (-1, -2, 99, 2**31 - 1, -(2**31)):
            cases[f"{col} {value} in one row"] = put(col, ROW, value)
            cases[f"{col} {value} in all rows"] = put(col, ..., value)
    for col in ("TIME", "INTERVAL", "EXPOSURE", "TIME_CENTROID"):
        for value in (np.nan, np.inf, -1.0, 0.0, 1e30):
            cases[f"{col} {value} in one row"] = put(col, ROW, value)
            cases[f"{col} {value} in all rows"] = put(col, ..., value)
    for col in ("ANTENNA1", "TIME", "FIELD_ID", "SCAN_NUMBER", "FLAG_ROW", "DATA_DESC_ID"):
        cases[f"{col} as an array"] = remake(col, lambda old: [np.array([cell]) for cell in old], ndim=1)
    for col in ("DATA", "FLAG", "WEIGHT", "UVW"):
        cases[f"{col} as a scalar"] = remake(col, lambda old: [cell.flat[0].item() for cell in old], ndim=0)
    for col in MAIN_COLUMNS:
        cases[f"{col} gone"] = lacking(col)
    return cases


MAIN_COLUMNS = ("ANTENNA1", "ANTENNA2", "ARRAY_ID", "CORRECTED_DATA", "DATA", "DATA_DESC_ID", "EXPOSURE", "FEED1",
                "FEED2",
                "FIELD_ID", "FLAG", "FLAG_CATEGORY", "FLAG_ROW", "INTERVAL", "MODEL_DATA", "OBSERVATION_ID",
                "PROCESSOR_ID",
                "SCAN_NUMBER", "SIGMA", "STATE_ID", "TIME", "TIME_CENTROID", "UVW", "WEIGHT", "WEIGHT_SPECTRUM")
_TYPES = {"short": np.int16, "int": np.int32, "uchar": np.uint8, "float": np.float32, "double": float,
          "complex": complex,
          "dcomplex": complex, "string": str}


def _as_type(kind):
    """Return a function that converts cells to a type of casacore's."""

    def converted(old):
        real = [np.real(cell) if kind not in ("complex", "dcomplex") else cell for cell in old]
        return [np.asarray(cell).astype(_TYPES[kind])[()] if np.ndim(cell) else _TYPES[kind](cell) for cell in real]

    return converted


TEXTS = {
    "ANTENNA": "MOUNT NAME STATION TYPE", "FIELD": "CODE NAME", "FLAG_CMD": "COMMAND REASON TYPE",
    "HISTORY": "APPLICATION MESSAGE ORIGIN", "OBSERVATION": "OBSERVER PROJECT SCHEDULE_TYPE TELESCOPE_NAME",
    "POINTING": "NAME",
    "PROCESSOR": "SUB_TYPE TYPE", "SOURCE": "CODE NAME", "SPECTRAL_WINDOW": "FREQ_GROUP_NAME NAME", "STATE": "OBS_MODE",
}
INTEGERS = {
    "DATA_DESCRIPTION": "POLARIZATION_ID SPECTRAL_WINDOW_ID",
    "FEED": "ANTENNA_ID BEAM_ID FEED_ID NUM_RECEPTORS SPECTRAL_WINDOW_ID",
    "FIELD": "NUM_POLY SOURCE_ID", "POINTING": "ANTENNA_ID NUM_POLY", "POLARIZATION": "NUM_CORR",
    "SOURCE": "CALIBRATION_GROUP NUM_LINES SOURCE_ID SPECTRAL_WINDOW_ID",
    "SPECTRAL_WINDOW": "FREQ_GROUP IF_CONV_CHAIN MEAS_FREQ_REF NET_SIDEBAND NUM_CHAN", "STATE": "SUB_SCAN",
}
NUMBERS = {
    "ANTENNA": "DISH_DIAMETER", "FEED": "INTERVAL TIME", "FIELD": "TIME", "OBSERVATION": "RELEASE_DATE",
    "POINTING": "INTERVAL TIME", "SOURCE": "INTERVAL TIME", "SPECTRAL_WINDOW": "REF_FREQUENCY TOTAL_BANDWIDTH",
    "STATE": "CAL LOAD",
}
ARRAYS = {
    "ANTENNA": "OFFSET POSITION", "FEED": "BEAM_OFFSET POL_RESPONSE POSITION RECEPTOR_ANGLE",
    "FIELD": "DELAY_DIR PHASE_DIR REFERENCE_DIR",
    "OBSERVATION": "TIME_RANGE", "POINTING": "DIRECTION TARGET", "POLARIZATION": "CORR_PRODUCT CORR_TYPE",
    "SOURCE": "DIRECTION PROPER_MOTION REST_FREQUENCY SYSVEL",
    "SPECTRAL_WINDOW": "CHAN_FREQ CHAN_WIDTH EFFECTIVE_BW RESOLUTION",
}
REQUIRED = ("ANTENNA", "DATA_DESCRIPTION", "FEED", "FIELD", "FLAG_CMD", "HISTORY", "OBSERVATION", "POINTING",
            "POLARIZATION",
            "PROCESSOR", "SPECTRAL_WINDOW", "STATE")
UNUSED = "unused row"


def subtable_cases():
    """Return the ways in which the subtables are spoiled: in their first row, and in one that no data refer to."""
    cases = {}
    for table in sorted({*REQUIRED, *TEXTS, *ARRAYS}):
        every = [cells for kind in (TEXTS, INTEGERS, NUMBERS, ARRAYS) for cells in kind.get(table, "").split()]
        cases |= {f"{table} gone": lambda name, table=table: shutil.rmtree(f"{name}/{table}"),
                  f"{table} without rows": rows_of(table, lambda tb: tb.removerows(list(range(tb.nrows())))),
                  f"{table} without its last row": rows_of(table, lambda tb: tb.nrows()
                                                           and tb.removerows([tb.nrows() - 1])),
                  f"{table} with an empty row, an {UNUSED}": rows_of(table, lambda tb: tb.addrows(1))}
        cases |= {f"{table}/{col} gone": within(table, lacking(col)) for col in every}
        cases |= {f"{table}/{col} of type {kind}": within(table, remake(col, _as_type(kind), valueType=kind))
                  for cols, kind in ((INTEGERS, "double"), (INTEGERS, "string"), (NUMBERS, "float"),
                                     (NUMBERS, "string"), (ARRAYS, "float"), (ARRAYS, "string"))
                  for col in cols.get(table, "").split()}
        cases |= {f"{table}/{col} of type int": within(table, remake(col, lambda old: [0] * len(old), valueType="int"))
                  for col in TEXTS.get(table, "").split()}
        for where in ("first row", UNUSED):
            cases |= {f"{table}/{col} {words} in an {where}".replace("an first", "the first"): spoil
                      for col in every for words, spoil in ways(table, col, where == UNUSED)}
    return cases


def ways(table, col, unused):
    """Yield how a cell of the first row is spoiled, or of a row that no data refer to: words, and what spoils."""
    if col in TEXTS.get(table, "").split():
        changes = {"with a Latin-1 byte": "J\u00fcrgen", "empty": "", "long": "x" * 5000, "with a line break": "a\nb"}
    elif col in INTEGERS.get(table, "").split():
        changes = {f"{value}": value for value in (-1, -2, 99, 2**31 - 1)}
    elif col in NUMBERS.get(table, "").split():
        changes = {f"{value}": value for value in (np.nan, np.inf, -1.0, 0.0, 1e300)}
    else:
        changes = {"undefined": lambda cell: None, "of no size": lambda cell: cell[..., :0],
                   "zero": lambda cell: cell * 0,
                   "longer": lambda cell: np.concatenate([cell, cell], axis=-1),
                   "negative": lambda cell: -abs(cell) - 1,
                   "of an axis more": lambda cell: cell[None],
                   "NaN": lambda cell: cell * 0 - 1 if cell.dtype.kind == "i" else cell * np.nan}
    for words, change in changes.items():
        yield words, within(table, _cell(col, change, unused))


def _cell(col, change, unused):
    """Return a function that changes one cell of a subtable: the first, or that of a row more."""

    def spoil(name):
        tb = casatools.table()
        tb.open(name, nomodify=False)
        try:
            if unused and tb.nrows():
                tb.copyrows(name, startrowin=0, startrowout=-1, nrow=1)
            elif not tb.nrows():
                tb.addrows(1)
            row = tb.nrows() - 1 if unused else 0
            if not callable(change):
                part = tb.selectrows([row])
                part.putcol(col, np.array([change]))  # text by bytes, not as UTF-8
                part.close()
                return
        finally:
            tb.close()
        cells(col, [row], change, ndim=-1)(name)

    return spoil


def within(table, spoil):
    """Return a function that spoils a subtable as `spoil` does a table."""
    return lambda name: spoil(f"{name}/{table}")


def rows_of(table, change):
    """Return a function that changes the rows of a subtable."""

    def spoil(name):
        tb = casatools.table()
        tb.open(f"{name}/{table}", nomodify=False)
        try:
            change(tb)
        finally:
            tb.close()

    return spoil


TABLES = {"main": main_cases, "subtables": subtable_cases}


# One process, many cases -------------------------------------------------------------------------


def image(name, mode):
    """Return what is compared of the images of a MeasurementSet: the residual,
    or of a dry run the number of samples."""
    from casa_sara import tsara

    result = tsara(vis=name, imagename="out", overwrite=True, nthreads=1, wavelets=["dirac", "db1"],
                   **GRID | MODES[mode])
    if MODES[mode].get("dryrun"):
        return np.array([result["forecast"]["visibilities"]], float)
    if MODES[mode].get("savemodel"):
        assert np.isfinite(column(name, "MODEL_DATA")).all()
    return np.array(pixels("out.residual"))


def attempt(spoil, mode, references, words):
    """Return the outcome of one case, and what it said."""
    shutil.rmtree("spoiled.ms", ignore_errors=True)
    shutil.copytree("whole.ms", "spoiled.ms")
    try:
        spoil("spoiled.ms")
    except Exception as error:
        return "not spoiled", f"{type(error).__name__}: {error}"
    before = hashes("spoiled.ms", "table.lock")
    try:
        made, said = image("spoiled.ms", mode), ""
    except Exception as error:
        made, said = None, f"{type(error).__name__}: {error}"
    if mode != "modelcolumn" and hashes("spoiled.ms", "table.lock") != before:
        return "changed", said
    if made is None:
        named = any(word in said for word in ("vis = ", "vis: ", "datacolumn = ")) and any(word in said
                                                                                           for word in words)
        return "clear error" if named and "cannot be read" not in said else "bare error", said
    off = {outcome: np.abs(made - one).max() / np.abs(one).max() for outcome, one in references.items()
           if one.shape == made.shape}
    closest = min(off, key=off.get, default="")
    if off and off[closest] <= SAME:
        return closest, said
    return "wrong image", f"differs by {off.get(closest, np.inf):.1e} of the peak"


def work(table, mode, words, skip):
    """Run the cases of a table after the first `skip`, and print a JSON list when one begins and when it ends."""
    import casatasks

    casatasks.casalog.setlogfile(os.devnull)
    references = {}
    for outcome, rows in (("as untouched", []), ("without rows", [ROW]), ("without rows ", [0])):
        shutil.copytree("whole.ms", "flagged.ms", dirs_exist_ok=True)
        edit("flagged.ms", "FLAG_ROW", lambda old: old | np.isin(np.arange(old.size), rows))
        references[outcome] = image("flagged.ms", mode)
    for name, spoil in list(chosen(table, words).items())[skip:]:
        print(json.dumps(["begin", name]), flush=True)
        outcome, said = attempt(spoil, mode, references, name.split()[0].split("/"))
        print(json.dumps(["end", name, outcome.strip(), said]), flush=True)


def chosen(table, words):
    """Return the cases of a table whose names hold these words."""
    return {name: spoil for name, spoil in TABLES[table]().items() if words in name}


# The process that counts -------------------------------------------------------------------------


def lines_of(process):
    """Yield the lines of a process as they come, and None when there was none for too long."""
    with selectors.DefaultSelector() as selector:
        selector.register(process.stdout, selectors.EVENT_READ)
        rest = b""
        while True:
            if not selector.select(LONGEST_S):
                yield None
                return
            data = os.read(process.stdout.fileno(), 65536)
            if not data:
                return
            *lines, rest = (rest + data).split(b"\n")
            yield from (line.decode(errors="replace") for line in lines)


def run(table, mode, words, folder):
    """Yield (name, outcome, what was said) of every case of a table."""
    done, count = 0, len(chosen(table, words))
    while done < count:
        errors = Path(folder, "errors.txt")
        with open(errors, "wb") as file:
            process = subprocess.Popen([sys.executable, os.path.abspath(__file__), words, "--tables", table, "--mode",
                                        mode,
                                        "--work", str(done)], cwd=folder, stdout=subprocess.PIPE, stderr=file)
        begun, hung = None, False
        for line in lines_of(process):
            if line is None:
                hung = True
                process.kill()
                break
            if line.startswith('["begin", '):
                begun = json.loads(line)[1]
            elif line.startswith('["end", '):
                _, *outcome = json.loads(line)
                begun, done = None, done + 1
                yield outcome
        process.communicate()
        said = errors.read_text(errors="replace")
        if begun is None and done < count:
            raise RuntimeError(f"the process ended between two cases: {said[-2000:]}")
        if begun is not None:
            done += 1
            yield begun, "hang" if hung else "signal", f"{-process.returncode}: {' '.join(said.split())[-300:]}"


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("words", nargs="?", default="")
    parser.add_argument("--tables", nargs="+", choices=list(TABLES), default=list(TABLES))
    parser.add_argument("--mode", choices=list(MODES), default="mfs")
    parser.add_argument("--verbose", action="store_true", help="print the right outcomes too")
    parser.add_argument("--work", type=int, help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.work is not None:
        work(given.tables[0], given.mode, given.words, given.work)
        return
    with tempfile.TemporaryDirectory() as folder:
        observe(Path(folder) / "whole.ms", weight_spectrum=True, columns=("DATA", "CORRECTED_DATA", "MODEL_DATA"))
        for table in given.tables:
            counts = Counter()
            for name, outcome, said in run(table, given.mode, given.words, folder):
                counts[outcome] += 1
                if given.verbose or outcome not in GOOD:
                    print(f"{name}: {outcome} {said}", flush=True)
            print(f"{table}, {given.mode}: "
                  + ", ".join(f"{outcome} {count}" for outcome, count in counts.most_common()))


if __name__ == "__main__":
    main()
