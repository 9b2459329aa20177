"""Every parameter of every task takes what it should, and says by its name what it does not take."""

import hashlib
import math
import os
import re
import shutil
import signal
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, Phase, given, settings, strategies as st

casatools = pytest.importorskip("casatools")

from simulated_ms import simulate

from casa_sara import saracompare, tsara
from casa_sara.demo.single_dish import dish_image
from casa_sara.private.parameters import SARACOMPARE, TSARA

REFUSALS = (ValueError, TypeError, OSError, MemoryError)  # OSError: a path that is not there, or not to be written
EXAMPLES, OF_SLOW = 6, 2
SLOW = ("outdir", "report")  # write a report
LONGEST_S = 30  # of one call, which takes a fraction of a second: what takes longer hangs

STRINGS = ("", " ", "x", "Ünïcode ☆", "a b", "it's", 'say "hi"', "new\nline", "*", "[a]", "{x}", "-x", "~", "$HOME",
           "\0",
           ".", "..", "%s", "1e400", "nan", "-1arcsec", "1Jy", "0", "all", "y" * 5000, "ab\udcff")
NUMBERS = (0, 1, -1, 2, 3, 2**31, -(2**31), 2**63, 2**64, 10**30, 0.5, 1e-300, 1e300, -0.0, math.nan, math.inf,
           -math.inf)
ODD = (None, True, False, b"bytes", 1j, {}, {"a": 1}, {1}, object, (), [], [[]], [[1, 2], [3, 4]], [None], [""],
       ["", ""],
       [1, "a"], np.zeros((2, 2)), np.array([]), np.array(math.nan), np.float32(1), np.int64(3), range(3))
NO_SLASH = st.characters(exclude_characters="/")


def values_of(parameter):
    """Return a strategy of values: right ones, nearly right ones, extremes and nonsense."""
    ends = [end for end in (parameter.minimum, parameter.maximum) if math.isfinite(end)]
    near = [*parameter.allowed, parameter.default, *ends, *(int(end) for end in ends), *(end - 1 for end in ends),
            *(end + 1 for end in ends), *(math.nextafter(end, s * math.inf) for end in ends for s in (1, -1))]
    one = st.one_of(st.sampled_from(STRINGS), st.sampled_from(NUMBERS), st.sampled_from(near), st.integers(),
                    st.floats(),
                    st.text(NO_SLASH, max_size=8))
    return st.one_of(one, st.sampled_from(ODD), st.lists(one, max_size=3))


def bounded(parameter):
    """Return the settings of hypothesis for this parameter."""
    examples = OF_SLOW if parameter.name in SLOW else EXAMPLES
    return settings(max_examples=examples, suppress_health_check=list(HealthCheck), phases=[Phase.generate])


def opened(parameters, name):
    """Return the values of the parameters that must be set for one of them to have an effect."""
    parameter = next(parameter for parameter in parameters if parameter.name == name)
    if not parameter.opener:
        return {}
    closed = parameter.open_unless
    opener = next(other for other in parameters if other.name == parameter.opener)
    value = parameter.open_on[-1] if parameter.open_on else opener.default or "dish.image"
    assert value not in closed
    return {parameter.opener: value}


def refused_or_done(task, name, call):
    """Call the task: it returns a dictionary, or raises an error that names the parameter."""
    signal.alarm(LONGEST_S)
    try:
        assert isinstance(task(**call), dict)
    except REFUSALS as error:
        assert re.search(rf"\b{name}\b", str(error)), f"{type(error).__name__}: {error}"
    finally:
        signal.alarm(0)


def contents(folder):
    """Return the hashes of the files of a MeasurementSet, without its locks."""
    files = (path for path in Path(folder).rglob("*") if path.is_file() and path.name != "table.lock")
    return {str(path): hashlib.sha256(path.read_bytes()).hexdigest() for path in files}


@pytest.fixture(autouse=True)
def alarm():
    """A call that hangs is interrupted."""
    before = signal.signal(signal.SIGALRM, _hangs)
    yield
    signal.signal(signal.SIGALRM, before)


def _hangs(number, frame):
    raise AssertionError(f"still running after {LONGEST_S} s")


@pytest.fixture(scope="module")
def vis(tmp_path_factory):
    """The smallest observation of which a beam can be fitted."""
    return simulate(tmp_path_factory.mktemp("fuzz") / "tiny.ms", antennas=6, spws=(("8.4GHz", "2MHz", 1),), scans=1,
                    scan_seconds=20.0, noise=0.01)


@pytest.fixture(scope="module")
def models(vis):
    """Two images of it, as one who compares them would have."""
    names = [str(Path(vis).parent / name) for name in ("one", "two")]
    for number, name in enumerate(names):
        tsara(vis=vis, imagename=name, niter=3 + number, **SMALL)
    return names


SMALL = dict(imsize=16, cell="3arcsec", datacolumn="data", wavelets=["dirac"], nthreads=1)


@pytest.mark.parametrize("parameter", TSARA, ids=lambda parameter: parameter.name)
def test_tsara_names_the_parameter_that_it_refuses(vis, tmp_path, parameter):
    before = contents(vis)
    own = shutil.copytree(vis, tmp_path / "own.ms") if parameter.name == "savemodel" else vis
    call = dict(vis=str(own), imagename="out", niter=2, overwrite=True, **SMALL) | opened(TSARA, parameter.name)
    if call.get("databound") == "fixed":
        call["l2bound"] = 1.0
    if "sdimage" in call:
        dish_image(call["sdimage"], np.ones((20, 20)), 4.0, (299.86875, 40.733889), 20.0, 8.4e9)

    @bounded(parameter)
    @given(values_of(parameter))
    def attempt(value):
        refused_or_done(tsara, parameter.name, call | {parameter.name: value})

    attempt()
    assert contents(vis) == before


@pytest.mark.parametrize("parameter", SARACOMPARE, ids=lambda parameter: parameter.name)
def test_saracompare_names_the_parameter_that_it_refuses(vis, models, parameter):
    before = contents(vis)
    call = dict(models=models, vis=vis, datacolumn="data") | opened(SARACOMPARE, parameter.name)

    @bounded(parameter)
    @given(values_of(parameter))
    def attempt(value):
        refused_or_done(saracompare, parameter.name, call | {parameter.name: value})

    attempt()
    assert contents(vis) == before


# Paths ------------------------------------------------------------------------------------------

NAMES = ("with spaces", "Ünïcode ☆", "it's", 'say "hi"', "[brackets](and) {more}", "glob*?", "-leading-dash",
         "semi;colon&$HOME",
         # fmt: skip
         "new\nline", "percent%s", "comma,equal=", "back\\slash", "trailing ", "#hash", "~tilde", "n" * 200)
REFUSED = ("semi;colon&$HOME",)  # CASA takes $HOME for the variable
PRODUCTS = ("model", "psf", "residual", "image", "sumwt", "pb", "sara.json")


@pytest.mark.parametrize("name", NAMES, ids=ascii)
def test_any_name_of_a_file_works_or_is_refused(vis, tmp_path, name):
    """The products stand under just the name that was asked for,
    or the parameter is named and nothing is left behind."""
    folders = [("in", "out")] + [("", "")] * name.startswith(("-", "~"))
    for number, (data, images) in enumerate(folders):
        own, base = os.path.join(data, name), f"{name}{number}"
        os.makedirs("out", exist_ok=True)
        call = dict(vis=shutil.copytree(vis, own), imagename=os.path.join(images, base))
        before, there = contents(own), set(os.listdir(images or "."))
        try:
            tsara(**call, niter=2, **SMALL)
        except REFUSALS as error:
            assert re.search(r"\b(vis|imagename)\b", str(error)), f"{type(error).__name__}: {error}"
            assert name in REFUSED and set(os.listdir(images or ".")) == there
        else:
            assert set(os.listdir(images or ".")) - there == {f"{base}.{product}" for product in PRODUCTS}
            assert name not in REFUSED
        assert contents(own) == before
