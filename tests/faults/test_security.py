"""What comes from outside is data, never a program: no pickle, no eval, no shell; records are checked."""

import ast
import json
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

casatools = pytest.importorskip("casatools")

import casa_sara
from casa_sara import saracompare
from casa_sara.analysis.convergence import block_noise, convergence
from casa_sara.casa.images.record import read_record
from casa_sara.runtime import jsonfile

PACKAGE = Path(casa_sara.__file__).parent
MODULES = sorted(path.relative_to(PACKAGE).as_posix() for path in PACKAGE.rglob("*.py"))

# Calls that run what they are given, and modules that are made for it.
CALLS = {"eval", "exec", "compile", "__import__", "os.system", "os.popen", "os.execv", "os.execvp", "os.spawnv",
         "runpy.run_path", "runpy.run_module", "yaml.load", "yaml.unsafe_load", "numba.core.serialize",
         "tempfile.mktemp"}
IMPORTS = {"pickle", "cPickle", "dill", "marshal", "shelve", "joblib", "cloudpickle", "subprocess", "pty",
           "ctypes.util",
           "runpy", "code", "xmlrpc", "telnetlib"}
EXCEPTIONS = {
    ("parallel/mpi.py", "pickle"): "an error of its own is packed and unpacked, to see whether mpi4py can send it",
    ("casa/runtime/child_process.py",
     "subprocess"): "this Python, told a function of casa_sara and its arguments by JSON",
    ("reconstruction/compile_cache.py",
     "subprocess"): "this Python, with a fixed text that compiles the kernels of the dictionary",
    ("private/shelltask.py", "runpy"): "tget runs what tput saved, as CASA's own tasks do",
    ("private/shelltask.py", "runpy.run_path"): "tget runs what tput saved, as CASA's own tasks do",
}


def dotted(node):
    """Return the name a.b.c of an expression, '' where it is none."""
    if isinstance(node, ast.Name):
        return node.id
    return f"{dotted(node.value)}.{node.attr}" if isinstance(node, ast.Attribute) else ""


def dangers(source):
    """Return what in a module's source could run what it is given."""
    found = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names} & IMPORTS
        elif isinstance(node, ast.ImportFrom):
            names = {node.module, *(f"{node.module}.{alias.name}" for alias in node.names)}
            found |= names & (IMPORTS | CALLS)
        elif isinstance(node, ast.Call):
            name = dotted(node.func)
            found |= {name} & CALLS
            words = {keyword.arg: keyword.value for keyword in node.keywords}
            if name.split(".")[-1] == "load" and name.split(".")[0] in ("np", "numpy"):
                safe = isinstance(words.get("allow_pickle"), ast.Constant) and words["allow_pickle"].value is False
                found |= set() if safe else {name}
            if not (isinstance(words.get("shell"), (ast.Constant, type(None)))
                    and not getattr(words.get("shell"), "value", 0)):
                found.add("shell=")
    return found


@pytest.mark.parametrize("module", MODULES)
def test_nothing_runs_what_it_is_given(module):
    allowed = {name for where, name in EXCEPTIONS if where == module}
    assert dangers((PACKAGE / module).read_text()) == allowed


@pytest.mark.parametrize("source", [
    "import pickle", "from pickle import loads", "eval(x)", "import os; os.system(x)", "import numpy as np; np.load(x)",
    "import numpy as np; np.load(x, allow_pickle=True)", "run(x, shell=True)", "run(x, shell=y)",
    "from os import system",
    "exec(x)", "import subprocess",
])  # fmt: skip
def test_the_search_finds_what_it_is_for(source):
    assert dangers(source)


def test_numbers_are_kept_without_pickles(tmp_path):
    assert not dangers("import numpy as np; np.load(x, allow_pickle=False)") and not dangers("run(x, shell=False)")
    np.save(tmp_path / "hostile.npy", np.array([{}], object), allow_pickle=True)
    with pytest.raises(ValueError, match="allow_pickle"):
        np.load(tmp_path / "hostile.npy")


# Records ----------------------------------------------------------------------------------------

NOT_JSON = ["", "{", "\0", "nonsense", '{"a": 1', "[" * 100_000, '{"a":' * 50_000, '{"a": 1e}', "\ud800"]
HOSTILE = [
    [], 3, "text", None, True,
    {"history": 3}, {"history": {"iteration": "no list"}}, {"history": {"rel_change": [1, 2]}},
    {"history": {"iteration": [1, "a"], "rel_change": [1, 2]}}, {"history": {"iteration": [1], "rel_change": [1, 2]}},
    {"history": {"iteration": [1, 2], "rel_change": [{}, []]}},
    {"history": {"iteration": [[1], [2]], "rel_change": [1, 2]}},
    {"bounds": [{}]}, {"bounds": 3}, {"bounds": [{"iteration": 1, "l2_bounds": "a"}]},
    {"bounds": [{"iteration": 0, "l2_bounds": [1]}, {"iteration": 1, "l2_bounds": [1, 2]}]},
    {"reweightings": [{}]}, {"reweightings": {"iteration": 1}},
    {"blocks": 3}, {"blocks": [3]}, {"blocks": [{"noise_found": 1}]}, {"blocks": [{"noise_found": "a", "ms": "x"}]},
    {"wild": 3}, {"wild": "text"},
]  # fmt: skip
RIGHT = {
    "history": {name: [1, 2]
                for name in ("iteration", "reweighting", "rel_change", "residual_norm", "model_flux", "model_max")},
    "bounds": [{"iteration": 0, "l2_bounds": [1.0]}, {"iteration": 2, "l2_bounds": [0.5]}],
    "reweightings": [{"iteration": 1, "scale": 1.0}],
    "blocks": [{"ms": "a.ms", "observations": [0], "scans": [1], "start_mjd_s": 5e9, "end_mjd_s": 5e9 + 60,
                "samples": 10,
                "noise_measured": "NaN", "l2_bound": 1.0, "residual_norm": 1.0, "noise_found": 1.0,
                "nnls_residual_norm": 1.0}],
    "wild": [],
}


@pytest.mark.parametrize("text", NOT_JSON, ids=lambda text: repr(text)[:12])
def test_a_file_that_is_no_record_is_named(tmp_path, text):
    path = tmp_path / "x.sara.json"
    path.write_bytes(text.encode("utf-8", "surrogatepass"))
    with pytest.raises(ValueError, match="x.sara.json"):
        jsonfile.load(path)


def written(path, record):
    jsonfile.save(path, record)
    return str(path)


@pytest.mark.parametrize("record", HOSTILE, ids=lambda record: json.dumps(record)[:40])
def test_a_record_that_tsara_did_not_write_is_refused(tmp_path, record):
    with pytest.raises(ValueError, match="models: '.*x.sara.json' is not a record of tsara: "):
        read_record(written(tmp_path / "x.sara.json", record))


def test_a_record_of_tsara_is_taken_and_every_broken_one_refused(tmp_path):
    """Each entry of a right record, replaced or left out: no other error than one that names the record."""
    right = read_record(written(tmp_path / "x.sara.json", RIGHT))
    assert right["blocks"][0]["samples"] == 10
    refused = 0
    for name, entries in RIGHT.items():
        for value in (None, 3, "text", [3], {"a": 1}, [[]], [{"iteration": None}], "NaN", 1e400):
            try:
                read_record(written(tmp_path / "x.sara.json", RIGHT | {name: value}))
            except ValueError as error:
                assert "x.sara.json" in str(error)
                refused += 1
        inner = entries[0] if isinstance(entries, list) and entries else entries
        for key in inner:
            for broken in ({other: inner[other] for other in inner if other != key}, inner | {key: "text"},
                           inner | {key: {}}):
                record = RIGHT | {name: [broken] if isinstance(entries, list) else broken}
                try:
                    record = read_record(written(tmp_path / "x.sara.json", record))
                except ValueError as error:
                    assert "x.sara.json" in str(error)
                    refused += 1
                    continue
                draw = block_noise if name == "blocks" else convergence
                draw(tmp_path / "picture.png", SimpleNamespace(record=record))
    assert refused > 60


def write_image(name):
    ia = casatools.image()
    ia.fromshape(name, [16, 16, 1, 1], log=False)
    ia.setbrightnessunit("Jy/pixel")
    ia.close()


def test_a_comparison_names_a_hostile_record(tmp_path):
    names = [str(tmp_path / name) for name in ("one", "two")]
    for name in names:
        write_image(name + ".model")
    (tmp_path / "two.sara.json").write_text('{"history": {"iteration": "none"}}')
    with pytest.raises(ValueError, match="models: '.*two.sara.json' is not a record"):
        saracompare(models=names)
