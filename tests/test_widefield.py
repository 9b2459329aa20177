"""The w-term: against the explicit Fourier sum, CASA's component predictor and tclean, and in whole runs."""

import gc
import os
import re
import tracemalloc

import numpy as np
import pytest
import scipy.special
from simulated_ms import CYGNUS_A, column, pixels, simulate

casatools = pytest.importorskip("casatools")

from casa_sara import tsara
from casa_sara.casa.ms.data_volume import measure_volume
from casa_sara.casa.ms.read import read_visibilities
from casa_sara.comparison.compare_images import compare_images
from casa_sara.operators import widefield
from casa_sara.operators.modulated import ModulatedOperator, bessel_factors, terms_needed
from casa_sara.operators.sky import further_bytes
from casa_sara.operators.widefield import MOST_TERMS, WGridder, WTerm, w_operator
from casa_sara.options import Comparing, ImageGrid, Selection

pytestmark = pytest.mark.usefixtures("every_thread")

CELL = np.array([2.2e-3, 1.8e-3])
SHAPE = (33, 48)
# VLA D at 74 MHz, a field of 10 degrees; the second source is 3.5 degrees from the centre, and w turns it by 3 rad
FIELD, CELL_RAD, PLACE = 128, np.radians(270 / 3600), (108, 24)
FAR = tuple(sign * (place - FIELD // 2) * CELL_RAD for sign, place in zip((-1, 1), PLACE))
SKY = [(1.0, 0.0, 0.0), (2.0, *FAR)]
GRID = dict(imsize=FIELD, cell="270arcsec", datacolumn="data", nthreads=1)


def wavelengths(rng, phase, shape=SHAPE, size=300):
    """(3, size) baselines whose w turns the corners of the image by up to `phase` rad."""
    uvw = rng.uniform(-0.4, 0.4, (3, size)) / np.array([*CELL, 1])[:, None]
    uvw[2] = np.append(rng.uniform(-1, 1, size - 1), 1) * phase / (2 * np.pi * depth(shape))
    return uvw


def complex_normal(rng, size):
    return rng.standard_normal(size) + 1j * rng.standard_normal(size)


def depth(shape):
    """Largest 1 − n of the pixels."""
    l, m = ((np.arange(n) - n // 2) * cell for n, cell in zip(shape, CELL))
    return 1 - np.sqrt(1 - np.abs(l).max() ** 2 - np.abs(m).max() ** 2)


def fourier_sum(uvw, shape=SHAPE):
    """Matrix (M, nx·ny) of exp(2πi [u l + v m + w (n − 1)])."""
    l = -(np.arange(shape[0]) - shape[0] // 2)[:, None] * CELL[0]
    m = (np.arange(shape[1]) - shape[1] // 2)[None, :] * CELL[1]
    lmn = [np.broadcast_to(axis, shape).ravel() for axis in (l, m, np.sqrt(1 - l**2 - m**2) - 1)]
    return np.exp(2j * np.pi * (uvw.T @ np.array(lmn)))


# The operator -----------------------------------------------------------------------------------


@pytest.mark.parametrize("dtype, eps", [(np.float32, 1e-4), (np.float32, 1e-6), (np.float64, 1e-9)])
@pytest.mark.parametrize("phase, kind", [(0.01, ModulatedOperator), (1.0, ModulatedOperator), (8.0, ModulatedOperator),
                                         (200.0, WGridder)])
@pytest.mark.parametrize("shape", [SHAPE, (64, 20)])
def test_equals_the_fourier_sum_and_its_adjoint(shape, phase, kind, dtype, eps):
    rng = np.random.default_rng(0)
    uvw, scale = wavelengths(rng, phase, shape), rng.uniform(0.5, 2, 300)
    matrix = fourier_sum(uvw, shape) * scale[:, None]
    operator = w_operator(uvw, CELL, shape, scale, eps, dtype, nthreads=2)
    assert isinstance(operator, kind)
    image, vis = rng.standard_normal(shape).astype(dtype), complex_normal(rng, 300)
    found = operator.forward(image, np.full(300, np.nan, operator.complex_dtype))
    found_image = operator.adjoint(vis, np.full(shape, np.nan, dtype))
    assert found.dtype == operator.complex_dtype and found_image.dtype == dtype
    error, error_image = found - matrix @ image.ravel(), found_image - (matrix.conj().T @ vis).real.reshape(shape)
    assert np.linalg.norm(error) <= 0.5 * eps * np.linalg.norm(image) * np.linalg.norm(scale)
    assert np.linalg.norm(error_image) <= 0.5 * eps * np.linalg.norm(vis * scale) * np.sqrt(image.size)
    # without the w-term it would be another result, and the adjoint is the transpose far beyond the accuracy
    flat = fourier_sum(uvw * [[1], [1], [0]], shape) * scale[:, None] @ image.ravel()
    assert np.linalg.norm(found - flat) > 0.1 * min(phase, 1) * np.linalg.norm(flat)
    products = np.vdot(found.astype(complex), vis).real, np.vdot(image, found_image.astype(float))
    bound = {np.float32: 1e-7, np.float64: 1e-14}[dtype]
    assert abs(products[0] - products[1]) < bound * np.linalg.norm(found) * np.linalg.norm(vis)


def test_series_is_the_same_for_any_number_of_threads():
    rng = np.random.default_rng(1)
    uvw = wavelengths(rng, 3.0, size=20_000)
    image, vis = rng.standard_normal(SHAPE), complex_normal(rng, 20_000)
    one, *others = [w_operator(uvw, CELL, SHAPE, eps=1e-5, nthreads=n) for n in (1, 3)]
    for other in others:
        assert np.array_equal(one.forward(image), other.forward(image))
        assert np.array_equal(one.adjoint(vis), other.adjoint(vis))


def test_series_allocates_nothing_and_holds_what_is_forecast():
    rng = np.random.default_rng(2)
    uvw, shape = wavelengths(rng, 3.0, (200, 180), 50_000), (200, 180)
    operator = w_operator(uvw, CELL / 4, shape, eps=1e-6)
    image, vis = np.ones(shape, "f4"), np.empty(50_000, "c8")
    operator.adjoint(operator.forward(image, vis), image)
    gc.collect()
    tracemalloc.start()
    operator.adjoint(operator.forward(image, vis), image)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 100_000
    held = sum(array.nbytes for array in vars(operator).values() if isinstance(array, np.ndarray))
    grid = ImageGrid(shape, tuple(CELL / 4), gridder="wproject")
    said = further_bytes(50_000, grid, np.abs(uvw[2]).max(), eps=1e-6)
    assert 0 <= held - said < 1000
    assert further_bytes(50_000, ImageGrid(shape, tuple(CELL / 4)), 1e9) == 0


def test_the_way_is_chosen_by_the_largest_phase():
    rng = np.random.default_rng(3)
    for phase in (0.3, 5.0, 300.0):
        uvw = wavelengths(rng, phase)
        plan = WTerm.of(np.abs(uvw[2]).max(), SHAPE, CELL, 1e-5)
        assert plan.phase == pytest.approx(phase, rel=1e-9) and f"{phase:.3g} rad" in plan.words
        assert (plan.terms == 0) == (phase > 30) and ("w-gridder" in plan.words) == (phase > 30)
    assert WTerm.of(1e3, SHAPE, CELL, 1e-4).terms < WTerm.of(1e3, SHAPE, CELL, 1e-6).terms <= MOST_TERMS
    assert WTerm.of(0.0, SHAPE, CELL, 1e-6).terms == WTerm.of(1e9, (1, 1), CELL, 1e-6).terms == 1


@pytest.mark.parametrize("modified, function", [(False, scipy.special.jv), (True, scipy.special.iv)])
def test_bessel_factors(modified, function):
    argument = np.concatenate([np.linspace(-8, 8, 1001), [0.0, 1e-300, -1e-7, 1e-6, 2e-6, 1e-3]])
    for count in (1, 2, 5, 20):
        expected = np.array([function(k, argument) * (2 - (k == 0)) for k in range(count)])
        found = bessel_factors(argument, count, modified, np.float64)
        np.testing.assert_allclose(found, expected, atol=1e-13 * np.abs(expected).max())
    terms = terms_needed(3.0, 1e-6, modified)
    rest = [2 * np.abs(function(np.arange(first, 60), 3.0)).sum() for first in (terms, terms - 1)]
    assert rest[0] <= 1e-6 < rest[1]


def test_an_image_wider_than_the_sky_is_refused():
    with pytest.raises(ValueError, match="imsize and cell make an image whose corners are beyond the horizon"):
        w_operator(np.ones((3, 4)), 0.03, (64, 64))
    with pytest.raises(ValueError, match="cell=.* is too large"):
        w_operator(np.array([[9e3], [0], [1e9]]), CELL, SHAPE)


# Runs -------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def vis(tmp_path_factory):
    return simulate(tmp_path_factory.mktemp("ms") / "far.ms", antennas=14, sky=SKY, noise=0.02, scans=4,
                    integration=20.0,
                    spacing_seconds=5400.0, hour_angle=-4.0, spws=(("74MHz", "0.5MHz", 2),), seed=1)


@pytest.fixture(scope="module")
def run(vis, tmp_path_factory):
    """A run with the w-term: its return dictionary, its name and its log."""
    from casatasks import casalog

    folder = tmp_path_factory.mktemp("run")
    casalog.setlogfile(str(folder / "casa.log"))
    result = tsara(vis=vis, imagename=str(folder / "wide"), gridder="wproject", wprojplanes=64, **GRID)
    casalog.setlogfile(os.devnull)
    return result, str(folder / "wide"), (folder / "casa.log").read_text()


@pytest.fixture(scope="module")
def flat(vis, tmp_path_factory):
    """A short run without the w-term: its return dictionary and its name."""
    name = str(tmp_path_factory.mktemp("run") / "flat")
    return tsara(vis=vis, imagename=name, niter=150, **GRID), name


def source(image, radius=3):
    """Return place and flux of what is around PLACE."""
    x, y = np.ogrid[: image.shape[0], : image.shape[1]]
    near = np.where(np.maximum(abs(x - PLACE[0]), abs(y - PLACE[1])) <= radius, image, 0).astype(float)
    return (near * x).sum() / near.sum(), (near * y).sum() / near.sum(), near.sum()


def test_a_source_far_off_centre_is_recovered(run):
    result, name, log = run
    x, y, flux = source(pixels(name + ".model"))
    assert np.hypot(x - PLACE[0], y - PLACE[1]) < 0.2
    assert flux == pytest.approx(2.0, rel=0.02)
    assert pixels(name + ".model").sum() == pytest.approx(3.0, rel=0.03)
    assert all(block["noise_found"] < 1.2 for block in result["sara"]["blocks"])
    assert not any("w-term" in note for note in result["sara"]["notes"])
    assert re.search(r"w-term: changes phases by up to 7\.1\d? rad in this image, modelled by a series of 1\d Fourier "
                     r"transforms", log)
    assert "wprojplanes = 64: not used, the w-term is computed exactly" in log
    assert pixels(name + ".psf")[FIELD // 2, FIELD // 2] == pytest.approx(1, abs=1e-5)
    assert np.abs(pixels(name + ".residual")).max() < 6 * result["sara"]["chosen"]["noise_jy_per_beam"]


def test_without_the_w_term_it_is_not(flat):
    result, name = flat
    assert any("is not modelled: it changes phases by up to 7.1 rad" in note and "gridder = 'wproject'" in note
               for note in result["sara"]["notes"])
    assert abs(source(pixels(name + ".model"))[2] - 2) > 0.2
    assert max(block["noise_found"] for block in result["sara"]["blocks"]) > 3


def test_series_and_w_gridder_lead_to_the_same_image(vis, tmp_path, monkeypatch):
    made = []
    for name, most in (("series", MOST_TERMS), ("gridder", 0)):
        monkeypatch.setattr(widefield, "MOST_TERMS", most)
        assert (WTerm.of(100.0, (FIELD, FIELD), (CELL_RAD, CELL_RAD), 1e-5).terms == 0) == (most == 0)
        tsara(vis=vis, imagename=str(tmp_path / name), gridder="wproject", niter=10, **GRID)
        made.append([pixels(str(tmp_path / f"{name}.{kind}")) for kind in ("model", "residual", "psf")])
    for series, gridder in zip(*made):
        assert 0 < np.abs(series - gridder).max() < 1e-3 * np.abs(series).max()


def test_dirty_image_shows_it_where_tclean_does(vis, tmp_path):
    from casatasks import tclean

    tsara(vis=vis, imagename=str(tmp_path / "ours"), gridder="wproject", niter=0, **GRID)
    tclean(vis=vis, imagename=str(tmp_path / "theirs"), gridder="wproject", wprojplanes=128, niter=0, imsize=FIELD,
           cell="270arcsec", datacolumn="data", pblimit=-0.01)
    ours, theirs = (pixels(str(tmp_path / f"{who}.residual")) for who in ("ours", "theirs"))
    assert np.unravel_index(ours.argmax(), ours.shape) == np.unravel_index(theirs.argmax(), theirs.shape) == PLACE
    assert ours[PLACE] == pytest.approx(theirs[PLACE], rel=0.01) and ours[PLACE] == pytest.approx(2, rel=0.02)


def test_model_column_has_the_phases_of_casas_component_predictor(vis, tmp_path):
    """One source, by the operator of a model image and by CASA's predictor of components."""
    name = simulate(tmp_path / "one.ms", antennas=8, sky=SKY[1:], scans=2, spacing_seconds=9000.0, hour_angle=-4.0,
                    spws=(("74MHz", "0.5MHz", 2),))
    model = str(tmp_path / "one.model")
    tsara(vis=name, imagename=str(tmp_path / "one"), gridder="wproject", niter=0, **GRID)
    ia = casatools.image()
    ia.open(model)
    ia.putchunk(np.zeros(ia.shape()))
    ia.putchunk(np.full((1, 1, 1, 1), 2.0), blc=[*PLACE, 0, 0])
    ia.close()
    tsara(vis=name, imagename=str(tmp_path / "one"), gridder="wproject", niter=0, restart=True, savemodel="modelcolumn",
          **GRID)
    ours = column(name, "MODEL_DATA")
    cl, me, im = casatools.componentlist(), casatools.measures(), casatools.imager()
    offset, angle = (f"{value!r}rad" for value in (float(np.arcsin(np.hypot(*FAR))), float(np.arctan2(*FAR))))
    cl.addcomponent(dir=me.shift(me.direction(*CYGNUS_A.split()), offset, angle), flux=2.0, fluxunit="Jy", freq="74MHz",
                    shape="point")
    cl.rename(str(tmp_path / "sky.cl"))
    cl.done()
    im.open(name, usescratch=True)
    im.ft(complist=str(tmp_path / "sky.cl"))
    im.done()
    theirs = column(name, "MODEL_DATA")
    np.testing.assert_allclose(ours, theirs, atol=2e-4)
    np.testing.assert_allclose(ours, column(name, "DATA"), atol=2e-4)


def test_comparison_takes_the_w_term_into_the_residuals(run, flat, vis):
    """The residuals of a model made with the w-term are noise, and all products are held against the same operator."""
    names = run[1], flat[1]
    selection = Selection((vis,), datacolumn="data")
    comparison = compare_images(Comparing(names, ("wide", "flat")), selection)
    chi_square = {name: comparison.measures["products"][name]["natural"]["chi_square"] for name in ("wide", "flat")}
    assert max(chi_square["wide"]) < 1.3 and max(chi_square["flat"]) > 10
    assert any("with the w-term, which changes phases by up to 7.1 rad in this image; 'flat' was imaged without it"
               in note
               for note in comparison.notes)
    alone = compare_images(Comparing(names[1:]), selection, single=True)
    assert not any("with the w-term" in note for note in alone.notes)
    own = pixels(names[1] + ".residual")
    assert alone.measures["products"]["flat"]["natural"]["max_abs"] == pytest.approx(np.abs(own).max(), rel=1e-3)


@pytest.mark.parametrize("parameters, message", [
    (dict(gridder="wproject", wprojplanes=1), "wprojplanes = 1 would leave the w-term out"),
    (dict(gridder="wproject", wprojplanes=0), "wprojplanes = 0"),
    (dict(gridder="wproject", wprojplanes=-2), "wprojplanes = -2: should be an integer, at least -1"),
    (dict(wprojplanes=16), "wprojplanes = 16 has no effect with gridder = 'standard'"),
    (dict(gridder="awproject"), "gridder = 'awproject': should be a string out of 'standard', 'wproject', 'mosaic'")])
def test_what_cannot_be_is_refused(vis, tmp_path, parameters, message):
    with pytest.raises(ValueError, match=message):
        tsara(vis=vis, imagename=str(tmp_path / "none"), **GRID | parameters)
    assert os.listdir(tmp_path) == []


def test_dry_run_knows_of_the_w_term(vis, tmp_path):
    plain, wide = (tsara(vis=vis, imagename=str(tmp_path / "none"), dryrun=True, gridder=gridder, **GRID)["forecast"]
                   for gridder in ("standard", "wproject"))
    parts = [said["memory_bytes"]["iterating"]["operator"] for said in (plain, wide)]
    volume, data = (take(Selection((vis,), datacolumn="data")) for take in (measure_volume, read_visibilities))
    assert data.max_w <= volume.max_w < 1.01 * data.max_w
    grid = ImageGrid((FIELD, FIELD), (CELL_RAD, CELL_RAD), gridder="wproject")
    assert parts[1] - parts[0] == further_bytes(volume.samples, grid, volume.max_w)
    assert wide["seconds"]["pair"] > 3 * plain["seconds"]["pair"]
