"""tsara in the CASA shell: inp, default, tput, tget, saveinputs, go, taskhelp and tsara?."""

import json
import os
import subprocess
import sys
import textwrap
from importlib.util import find_spec
from pathlib import Path

import pytest

from casa_sara.private import shelltask
from casa_sara.private.parameters import TSARA

BY_NAME = {parameter.name: parameter for parameter in TSARA}
pytestmark = pytest.mark.skipif(find_spec("casashell") is None, reason="casashell is not installed")

STARTUP = """
import sys, types
sys.modules["casa_sara.private.task_tsara"] = types.SimpleNamespace(tsara=lambda **values: values)
from casa_sara.gotasks import *
"""

# Runs the cells as if they were typed, and writes what each printed, returned and raised.
SCRIPT = """
import json
from IPython.utils.capture import capture_output

shell, records = get_ipython(), []
for cell in json.load(open("cells.json")):
    with capture_output(display=False) as captured:
        result = shell.run_cell(cell, store_history=False)
    error = result.error_in_exec or result.error_before_exec
    records.append({"printed": captured.stdout, "result": result.result, "error": type(error).__name__})
json.dump(records, open("records.json", "w"))
"""

CELLS = {
    "collisions": f"[name for name in {[p.name for p in TSARA]} if name in globals()]",
    "inp": "inp tsara",
    "inp by name": "inp('tsara')",
    "wrong": "vis = 'nosuch.ms'",
    "set": "imagename = 'try'; cell = ('0.1arcsec',); databound = 'fixed'; l2bound = [1.5]",
    "set more": "weighting = 'briggs'; robust = -1.0; imsize = __import__('numpy').array([64, 32])",
    "inp again": "inp",
    "go wrong": "go",
    "right": "vis = 'data.ms'",
    "go": "go",
    "tput": "tput tsara",
    "saveinputs": "saveinputs(tsara, 'mine.txt')",
    "leftover": "weighting = 'natural'",
    "inp natural": "inp tsara",
    "go natural": "go tsara",
    "call": "tsara(vis='data.ms', imagename='other', cell='2arcsec')",
    "call wrong": "tsara(vis='data.ms', imagename='other', cell='2arcsec', niter=-1)",
    "default": "default tsara",
    "after default": "[name for name in ('vis', 'weighting', 'l2bound') if name in globals()]",
    "go unset": "go tsara",
    "tget": "tget(tsara, 'mine.txt')",
    "after tget": "[vis, weighting, robust, l2bound, imsize, cell]",
    "tget last": "tget tsara",
    "after tget last": "vis",
    "tget missing": "tget(tsara, 'nosuch.txt')",
    "tput of nonsense": "vis = open; tput(tsara)",
    "taskhelp": "taskhelp()",
    "help": "tsara?",
}


@pytest.fixture(scope="module")
def shell(tmp_path_factory):
    """What each cell did in one session of the CASA shell, and the session's folder."""
    folder = tmp_path_factory.mktemp("shell")
    (folder / "data.ms").mkdir()
    (folder / "startup.py").write_text(STARTUP)
    (folder / "script.py").write_text(SCRIPT)
    (folder / "cells.json").write_text(json.dumps(list(CELLS.values())))
    flags = "--nogui --nologger --nologfile --agg --colors NoColor --cachedir cache"
    environment = os.environ | {"HOME": str(folder), "COLUMNS": "110", "PYTHONPATH": str(Path(__file__).parents[1])}
    run = subprocess.run(
        [sys.executable, "-m", "casashell", *flags.split(), "--startupfile", "startup.py", "-c", "script.py"],
        cwd=folder, env=environment, capture_output=True, text=True, timeout=120,
    )
    assert (folder / "records.json").exists(), run.stdout + run.stderr
    records = dict(zip(CELLS, json.loads((folder / "records.json").read_text())))
    records["help"]["printed"] += run.stdout  # in some versions what tsara? shows goes past the capture
    for name, record in records.items():
        if not any(word in name for word in ("wrong", "missing", "nonsense", "unset")):
            assert record["error"] == "NoneType", f"{CELLS[name]}: {record['printed']}"
    return records, folder


def shown(text):
    """Return what inp has printed, as {name: value}."""
    lines = [line.split("#")[0].split("=", 1) for line in text.splitlines()[1:] if "=" in line.split("#")[0]]
    return {name.strip(): value.strip() for name, value in lines}


def saved(path):
    """Return the parameters that a file of tput sets."""
    values = {}
    exec(path.read_text(), {}, values)
    return values


def test_no_global_variable_of_the_shell_is_a_parameter(shell):
    assert shell[0]["collisions"]["result"] == []


def test_inp_shows_the_defaults_and_the_open_sub_parameters(shell):
    records, _ = shell
    text = records["inp"]["printed"]
    assert text.startswith("# tsara -- Image MeasurementSets")
    defaults = {parameter.name: parameter.default for parameter in TSARA}
    assert shown(text) == {p.name: repr(p.default) for p in TSARA if p.is_open(defaults)}
    assert "\n   field " in text and "\nweighting " in text
    assert records["inp by name"]["printed"] == text


def test_inp_describes_every_parameter_within_the_terminal(shell):
    lines = shell[0]["inp"]["printed"].splitlines()
    described = " ".join(" ".join(line.split("#", 1)[1] for line in lines if "#" in line).split())
    for parameter in TSARA:
        if f"\n{parameter.name} " in shell[0]["inp"]["printed"]:
            assert parameter.summary in described
    assert max(map(len, lines)) <= 110


def test_inp_follows_the_variables(shell):
    values = shown(shell[0]["inp again"]["printed"])
    assert values["robust"] == "-1.0" and values["l2bound"] == "[1.5]" and values["vis"] == "'nosuch.ms'"
    assert "boundtol" not in values


def test_go_raises_what_is_wrong(shell):
    assert shell[0]["go wrong"]["error"] == "FileNotFoundError"
    assert "vis = 'nosuch.ms'" in shell[0]["go wrong"]["printed"]
    assert shell[0]["go unset"]["error"] == "ValueError"


def test_go_runs_with_the_variables(shell):
    values = shell[0]["go"]["result"]
    assert values.keys() == {parameter.name for parameter in TSARA}
    assert (values["vis"], values["weighting"], values["robust"]) == ("data.ms", "briggs", -1.0)
    assert (values["imsize"], values["cell"], values["l2bound"]) == ([64, 32], ["0.1arcsec"], [1.5])
    set_ = {"vis", "imagename", "cell", "databound", "l2bound", "weighting", "robust", "imsize"}
    assert all(values[p.name] == p.default for p in TSARA if p.name not in set_)


def test_hidden_sub_parameter_has_its_default(shell):
    assert "robust" not in shown(shell[0]["inp natural"]["printed"])
    values = shell[0]["go natural"]["result"]
    assert (values["weighting"], values["robust"], values["l2bound"]) == ("natural", 0.5, [1.5])


def test_call_takes_defaults_and_not_the_variables(shell):
    values = shell[0]["call"]["result"]
    defaults = {parameter.name: parameter.default for parameter in TSARA}
    assert values == defaults | {"vis": "data.ms", "imagename": "other", "cell": "2arcsec"}
    assert shell[0]["call wrong"]["error"] == "ValueError"


def test_tput_and_saveinputs_write_all_parameters(shell):
    values = saved(shell[1] / "mine.txt")
    assert list(values) == [parameter.name for parameter in TSARA]
    assert values | {"vis": "data.ms", "robust": -1.0, "imsize": [64, 32], "cell": ["0.1arcsec"]} == values
    text = (shell[1] / "mine.txt").read_text().splitlines()
    assert text[-1].startswith("#tsara(vis='data.ms', ")


def test_default_forgets_the_variables(shell):
    assert shell[0]["after default"]["result"] == []


def test_tget_brings_saved_parameters_back(shell):
    assert shell[0]["after tget"]["result"] == ["data.ms", "briggs", -1.0, [1.5], [64, 32], ["0.1arcsec"]]


def test_last_inputs_are_kept_by_every_run(shell):
    # The last run before tget was go without anything set.
    assert shell[0]["after tget last"]["result"] == ""


def test_tget_and_tput_refuse_what_they_cannot_do(shell):
    assert shell[0]["tget missing"]["error"] == "FileNotFoundError"
    assert shell[0]["tput of nonsense"]["error"] == "ValueError"
    assert "vis = " in shell[0]["tput of nonsense"]["printed"]


def test_taskhelp_lists_the_task(shell):
    extra = shell[0]["taskhelp"]["printed"].split("Extra tasks")[1]
    assert "> imaging" in extra and "tsara : Image MeasurementSets" in extra


def test_question_mark_tells_every_parameter(shell):
    text = textwrap.dedent(shell[0]["help"]["printed"])
    for parameter in TSARA:
        assert f"{parameter.name} : " in text


def test_shell_leaves_only_its_own_file(shell):
    names = {path.name for path in shell[1].iterdir()}
    ours = {"data.ms", "startup.py", "script.py", "cells.json", "records.json", "cache", "mine.txt"}
    assert names - ours - {".cache", ".config"} == {"tsara.last"}


@pytest.mark.parametrize(
    ("value", "colour"), [(BY_NAME["robust"].default, ""), (1.0, shelltask.BLUE), (3.0, shelltask.RED)]
)
def test_inp_in_a_terminal_colours_what_is_set_and_what_is_wrong(monkeypatch, capsys, value, colour):
    monkeypatch.setattr(sys.stdout, "isatty", lambda: True)
    shelltask._print_parameter(BY_NAME["robust"], value, is_opener=False)
    text = f"{colour}{value}{shelltask.NORMAL}" if colour else f" {value} "
    assert text in capsys.readouterr().out


def test_elsewhere_the_shell_tasks_say_so():
    from casa_sara.gotasks import tsara

    with pytest.raises(RuntimeError, match="for the CASA shell"):
        tsara.inp()
