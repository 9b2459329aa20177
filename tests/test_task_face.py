"""The task tsara as its users meet it: import, help, conformity with tclean, validation, logging."""

import dataclasses
import inspect
import os
import subprocess
import sys
import types
import xml.etree.ElementTree as ElementTree
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest

from casa_sara import tsara
from casa_sara.options import SolverOptions
from casa_sara.private.parameters import SARACOMPARE, TSARA
from casa_sara.private.validation import Parameter, checked, validate

BY_NAME = {parameter.name: parameter for parameter in TSARA}
GOOD = {"vis": "data.ms", "imagename": "try", "cell": "0.1arcsec"}

BEYOND = {"stokes": {"IQU", "QUV"}}  # values that tclean does not allow
# Where tsara's parameters differ from tclean's of the same name, and why.
NARROWER = "tsara does not do the others"
SURER = "tclean lets anything through; a mistake is better found here"
EXCEPTIONS = {
    ("datacolumn", "allowed"): SURER,
    ("gridder", "allowed"): NARROWER,
    ("imagename", "types"): "one name; tclean's list is for outlier fields, its int an accident",
    ("imsize", "range"): SURER,
    ("interpolation", "allowed"): "samples stay what was measured, and their noise their own",
    ("interpolation", "default"): "the only one",
    ("niter", "default"): "an upper limit: the data decide when to stop",
    ("niter", "range"): SURER,
    ("npixels", "range"): SURER,
    ("nterms", "default"): "1 is the image of flat spectra; tclean has the default of one of its deconvolvers",
    ("nterms", "openers"): "of all continuum images, as there is one way to solve for them",
    ("outframe", "allowed"): SURER,
    ("pblimit", "range"): SURER,
    ("perchanweightdensity", "allowed"): NARROWER,
    ("projection", "allowed"): "the projection of an interferometer; others would put sources in wrong places",
    ("reffreq", "types"): "a frequency with its unit; tclean's variant lets anything through",
    ("pbmask", "range"): SURER,
    ("restart", "default"): "an old model must not enter a new image unasked; tclean's False renames the images",
    ("restfreq", "types"): "text; tclean's variant lets anything through",
    ("savemodel", "allowed"): NARROWER,
    ("specmode", "allowed"): NARROWER,
    ("start", "types"): "a number or a quantity; tclean's variant lets anything through",
    ("startmodel", "types"): "one image; tclean's list is for Taylor terms",
    ("stokes", "allowed"): "without single correlations; IQU and QUV need no empty planes",
    ("uvtaper", "default"): "[] as tclean's own in the shell; in Python tclean has ['']; both mean none",
    ("usemask", "allowed"): NARROWER,
    ("usepointing", "allowed"): NARROWER,
    ("weighting", "allowed"): NARROWER,
    ("wprojplanes",
     "default"): "tclean's 1 leaves the w-term out of gridder='wproject'; here -1, as no number is needed",
    ("wprojplanes", "range"): SURER,
    ("veltype", "allowed"): NARROWER,
    ("width", "types"): "a number or a quantity; tclean's variant lets anything through",
}


@pytest.fixture
def received(monkeypatch):
    """The keyword arguments that reach the implementation, which is replaced."""
    calls = []
    fake = types.SimpleNamespace(tsara=lambda **values: calls.append(values) or {"stopcode": 101})
    monkeypatch.setitem(sys.modules, "casa_sara.private.task_tsara", fake)
    os.mkdir("data.ms")
    return calls


@pytest.fixture
def log(tmp_path):
    """A function that returns what CASA's logger has written."""
    from casatasks import casalog

    casalog.setlogfile(str(tmp_path / "casa.log"))
    yield lambda: (tmp_path / "casa.log").read_text()
    casalog.setlogfile(os.devnull)


# Import and help --------------------------------------------------------------------------------


def test_import_is_fast_and_needs_no_casa(tmp_path):
    # The best of a few runs, in CPU time: whatever else the machine does is not counted.
    code = (
        "import sys, time; before = set(sys.modules); start = time.process_time(); from casa_sara import tsara; "
        "print(time.process_time() - start, *{name.split('.')[0] for name in set(sys.modules) - before})"
    )
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONDONTWRITEBYTECODE"}
    environment |= {"PYTHONPYCACHEPREFIX": str(tmp_path), "PYTHONPATH": str(Path(__file__).parents[1])}
    runs = [
        subprocess.run([sys.executable, "-c", code], env=environment, check=True, capture_output=True, text=True)
        for _ in range(5)
    ]
    seconds, modules = zip(*(run.stdout.split(maxsplit=1) for run in runs))
    assert min(map(float, seconds)) < 0.05
    assert {name for name in modules[0].split()} - sys.stdlib_module_names == {"casa_sara"}


def test_solver_options_have_the_defaults_of_the_task():
    for field in dataclasses.fields(SolverOptions):
        if field.name not in ("nthreads", "averaging"):  # 0 in the task: all cores; always on in the task
            default = BY_NAME[field.name].default
            assert field.default == (tuple(default) if isinstance(default, list) else default), field.name


def test_no_submodule_shadows_a_task():
    import casa_sara.tasks

    for name in casa_sara.tasks.__all__:
        assert find_spec(f"casa_sara.{name}") is None
        assert getattr(casa_sara, name) is getattr(casa_sara.tasks, name)
        assert callable(getattr(casa_sara, name))


def test_help_tells_every_parameter():
    documentation = inspect.getdoc(tsara)
    for section in ("Parameters\n----------\n", "Returns\n-------\n", "Examples\n--------\n"):
        assert section in documentation
    for parameter in TSARA:
        assert f"\n{parameter.name} : " in documentation
    assert tsara._info_group_ == "imaging" and tsara._info_desc_


# Conformity with tclean -------------------------------------------------------------------------


def tclean_params():
    """Return tclean's parameters as {name: {aspect: value}}, from the installed XML and signature.

    The signature gives the defaults, as what the XML says is not always what tclean gets: its
    <value type="stringVec">"1arcsec"</value> of cell becomes [].
    """
    import casatasks

    path = Path(casatasks.__file__).parent / "__xml__" / "tclean.xml"
    namespace = "{http://casa.nrao.edu/schema/psetTypes.html}"
    root = ElementTree.parse(path).getroot()
    defaults = {name: p.default for name, p in inspect.signature(casatasks.tclean).parameters.items()}
    params = {}
    for element in root.iter(namespace + "param"):
        types_ = [item.text for item in element.findall(namespace + "type")]
        allowed = element.find(namespace + "allowed")
        kind = None if allowed is None else allowed.get("kind")
        values = [] if allowed is None else list(allowed)
        params[element.get("name")] = {
            "types": set(types_) or {element.get("type")},
            "mustexist": element.get("mustexist") == "true",
            "default": defaults[element.get("name")],
            "allowed": {item.text for item in values} if kind == "enum" else set(),
            "range": {item.get("range"): float(item.text) for item in values} if kind == "range" else {},
            "openers": set(),
        }
    for when in root.iter(namespace + "when"):
        for branch in when:
            for default in branch.iter(namespace + "default"):
                if default.get("param") in params:
                    relation = (when.get("param"), branch.tag.removeprefix(namespace), branch.get("value"))
                    params[default.get("param")]["openers"].add(relation)
    return params


def our_params():
    """Return tsara's parameters in the same form."""
    params = {}
    for p in TSARA:
        ends = {"min": p.minimum, "max": p.maximum}
        relation = "equals" if p.open_on else "notequals"
        params[p.name] = {
            "types": set(p.types),
            "mustexist": p.mustexist,
            "default": p.default,
            "allowed": set(map(str, p.allowed)),
            "range": {end: value for end, value in ends.items() if np.isfinite(value)},
            "openers": {(p.opener, relation, str(value)) for value in (*p.open_on, *p.open_unless)},
        }
    return params


def test_mirrored_parameters_are_those_of_tclean():
    ours, theirs = our_params(), tclean_params()
    mirrored = ours.keys() & theirs.keys()
    assert len(mirrored) > 30
    differences = set()
    for name in mirrored:
        for aspect, value in ours[name].items():
            other = theirs[name][aspect]
            if aspect == "openers":  # of those, the ones with a value that the opener has in tsara
                allowed = {opener: ours[opener]["allowed"] for opener, _, _ in other if opener in ours}
                other = {item for item in other if item[0] in allowed and item[2] in (allowed[item[0]] or item[2])}
            if value != other:
                differences.add((name, aspect))
        if theirs[name]["allowed"]:
            assert ours[name]["allowed"] - BEYOND.get(name, set()) <= theirs[name]["allowed"]
    assert differences == EXCEPTIONS.keys()


@pytest.mark.parametrize(
    "given",
    [
        {"vis": "data.ms"},
        {"vis": ["data.ms"]},
        {"vis": "data.ms", "imsize": 64, "cell": "1arcsec"},
        {"vis": "data.ms", "imsize": (64, 32), "cell": ("1arcsec", "2arcsec")},
        {"vis": "data.ms", "imsize": np.int64(64), "cell": 2},
        {"vis": "data.ms", "cell": 0.25, "robust": 1, "weighting": "briggs"},
        {"vis": "data.ms", "cell": [1, 2], "uvtaper": "5klambda", "restoringbeam": "1arcsec"},
        {"vis": "data.ms", "field": ["0", "1"], "spw": np.str_("0:3~5"), "observation": 0, "phasecenter": 3},
    ],
)
def test_same_call_reaches_tclean_with_the_same_values(received, monkeypatch, given):
    import casatasks

    module = sys.modules["casatasks.tclean"]
    names = list(inspect.signature(casatasks.tclean).parameters)
    theirs = {}
    monkeypatch.setattr(module, "_tclean_t", lambda *values: theirs.update(zip(names, values)))
    given = {"imagename": "try", "cell": "1arcsec"} | given
    casatasks.tclean(**given)
    tsara(**given)
    for name in given:  # one number may come in a list or without one
        assert np.array_equal(np.atleast_1d(received[0][name]), np.atleast_1d(theirs[name])), name


# Values -----------------------------------------------------------------------------------------


def test_defaults_reach_the_implementation(received):
    assert tsara(**GOOD) == {"stopcode": 101}
    defaults = {name: parameter.default for name, parameter in inspect.signature(tsara).parameters.items()}
    assert received == [defaults | GOOD]
    assert received[0]["wavelets"] is not defaults["wavelets"]  # a copy: the default cannot be changed


@pytest.mark.parametrize("parameter", [p for p in (*TSARA, *SARACOMPARE) if not p.required], ids=lambda p: p.name)
def test_default_is_what_the_validator_makes_of_it(parameter):
    """So that `validate` may leave it alone."""
    assert repr(checked(parameter, parameter.default)) == repr(parameter.default)


def test_default_of_another_type_is_coerced():
    parameters = Parameter("scale", ("double",), 1.0, ""), Parameter("scales", ("doubleVec",), [1.0], "")
    found = validate(parameters, {"scale": 1, "scales": [1]})
    assert repr(found) == "{'scale': 1.0, 'scales': [1.0]}"


def test_python_and_numpy_values_are_taken(received):
    tsara(
        vis=(Path("data.ms"),), imagename=Path("try"), cell=np.array([0.1, 0.2]), imsize=np.array([8, 6]),
        niter=np.int32(5), positivity=np.bool_(False), reltol=np.float32(0.5), regscale=2,
        databound="fixed", l2bound=(1, 1.5),
    )
    values = received[0]
    assert (values["vis"], values["imagename"], values["cell"]) == (["data.ms"], "try", [0.1, 0.2])
    assert (values["imsize"], values["niter"], values["positivity"]) == ([8, 6], 5, False)
    assert (values["reltol"], values["regscale"], values["l2bound"]) == (0.5, 2.0, [1.0, 1.5])
    for name in ("niter", "positivity", "reltol", "regscale"):
        assert type(values[name]) in (int, bool, float)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"vis": ""}, "vis = '': must be given, a path or a list of paths that exists"),
        ({"vis": []}, r"vis = \[\]: must be given"),
        ({"imagename": ""}, "imagename = '': must be given, a string"),
        ({"cell": []}, r"cell = \[\]: must be given"),
        ({"vis": 3}, "vis = 3: should be a path or a list of paths that exists"),
        ({"niter": 3.5}, "niter = 3.5: should be an integer, at least 0"),
        ({"niter": -1}, "niter = -1: should be an integer, at least 0"),
        ({"niter": True}, "niter = True: should be an integer"),
        ({"niter": None}, "niter = None: should be an integer"),
        ({"robust": 2.5, "weighting": "briggs"}, "robust = 2.5: should be a number, at least -2, at most 2"),
        ({"robust": "1", "weighting": "briggs"}, "robust = '1': should be a number"),
        ({"reltol": float("nan")}, "reltol = nan: should be a number"),
        ({"regscale": float("inf")}, "regscale = inf: should be a number"),
        ({"l2bound": [1, -1], "databound": "fixed"},
         r"l2bound = \[1, -1\]: should be a list of numbers, at least 1e-06"),
        ({"imsize": [64, 0]}, r"imsize = \[64, 0\]: should be an integer or a list of integers, at least 1"),
        ({"imsize": "64"}, "imsize = '64': should be an integer or a list of integers"),
        ({"weighting": "Briggs"}, "weighting = 'Briggs': should be a string out of 'natural', 'uniform', 'briggs'"),
        ({"wavelets": ["db1", "x"]}, r"wavelets = \['db1', 'x'\]: should be a list of strings out of 'dirac', 'db1'"),
        ({"stokes": "RRLL"}, "stokes = 'RRLL': should be a string out of 'I', 'Q', 'U', 'V', 'IQ'"),
        ({"parallel": 1}, "parallel = 1: should be True or False"),
        ({"positivity": 1}, "positivity = 1: should be True or False"),
        ({"field": 3}, "field = 3: should be a string or a list of strings"),
    ],
)
def test_wrong_value_is_refused_with_what_would_be_right(received, given, message):
    with pytest.raises(ValueError, match=message):
        tsara(**(GOOD | given))
    assert not received


@pytest.mark.parametrize("vis", ["nosuch.ms", ["data.ms", "nosuch.ms"], "~/nosuch.ms"])
def test_missing_path_is_named(received, vis):
    with pytest.raises(FileNotFoundError, match=r"vis = .*'(~/)?nosuch.ms' not found"):
        tsara(**(GOOD | {"vis": vis}))


def test_every_problem_is_named(received):
    with pytest.raises(ValueError) as error:
        tsara(vis="nosuch.ms", cell="1arcsec", niter="all", stokes="RR")
    names = [line.split(" = ")[0] for line in str(error.value).splitlines()]
    assert names == ["vis", "imagename", "stokes", "niter"]


def test_unknown_parameter_is_refused(received):
    with pytest.raises(TypeError, match="deconvolver"):
        tsara(**GOOD, deconvolver="hogbom")


def closing_and_opening(parameter):
    """Return the values of the parameter's opener that close it, and those that open it."""
    opener = BY_NAME[parameter.opener]
    values = opener.allowed or {("bool",): (True, False), ("string",): ("", "name")}.get(opener.types, (0, 1))
    if parameter.open_on:
        return [value for value in values if value not in parameter.open_on], list(parameter.open_on)
    return list(parameter.open_unless), [value for value in values if value not in parameter.open_unless]


@pytest.mark.parametrize(
    "parameter", [p for p in TSARA if p.opener and closing_and_opening(p)[0] and len(p.allowed) != 1],
    ids=lambda p: p.name,
)
def test_sub_parameter_that_would_be_ignored_is_refused(received, parameter):
    closing, opening = closing_and_opening(parameter)
    other = {"bool": not parameter.default, "string": "x", "stringVec": ["x"], "double": 0.25, "doubleVec": [0.25],
             "int": 7}[parameter.types[0]]
    other = parameter.allowed[-1] if parameter.allowed else other
    message = f"{parameter.name} = .* has no effect with {parameter.opener} = .*: set {parameter.opener} to"
    with pytest.raises(ValueError, match=message):
        tsara(**GOOD, **{parameter.opener: closing[0], parameter.name: other})
    assert not received
    tsara(**GOOD, **{parameter.opener: closing[0], parameter.name: parameter.default})
    tsara(**GOOD, **{parameter.opener: opening[0], parameter.name: other})
    assert len(received) == 2


def test_empty_text_and_empty_list_both_leave_a_closed_sub_parameter_alone():
    parameters = (
        Parameter("restoration", ("bool",), True, ""),
        Parameter("beam", ("string", "stringVec"), [], "", opener="restoration", open_on=(True,)),
    )
    for nothing in ("", [], [""]):
        assert validate(parameters, {"restoration": False, "beam": nothing})["beam"] == nothing


# Logging and errors -----------------------------------------------------------------------------


def test_run_is_logged_as_by_a_casa_task(received, log):
    tsara(**GOOD)
    text = log()
    for part in ("##### Begin Task: tsara", "tsara( vis='data.ms'", "imagename='try'", "##### End Task: tsara"):
        assert part in text


@pytest.mark.parametrize("given", [{}, {"niter": -1}])
def test_error_is_logged_and_raised(received, log, monkeypatch, given):
    def fail(**values):
        raise RuntimeError("all 12 samples are flagged")

    monkeypatch.setattr(sys.modules["casa_sara.private.task_tsara"], "tsara", fail)
    expected = "niter = -1" if given else "all 12 samples are flagged"
    with pytest.raises((RuntimeError, ValueError), match=expected):
        tsara(**GOOD, **given)
    assert "Task tsara raised an exception" in log() and expected in log()
    assert "##### End Task: tsara" in log()
