"""Several Stokes parameters of one image: against tclean's images of them, and against images of each alone."""

import json
import os

import numpy as np
import pytest
from fourier_sums import CELL, NOISE, OPTIONS, Sums, distance
from simulated_ms import edit, simulate
from test_polarisation import FEEDS, GRID, NOISE as OF_HANDS, SKY, polarise
from test_visibilities import observation

casatools = pytest.importorskip("casatools")

from casa_sara import saracompare, tsara
from casa_sara.analysis.comparison import Product
from casa_sara.analysis.polarisation import polarised_measures
from casa_sara.casa.images.image_plane import read_planes
from casa_sara.casa.ms.read import read_visibilities
from casa_sara.casa.runtime.tools import opened
from casa_sara.data.visibilities import sort_into_blocks
from casa_sara.options import ImageGrid, Selection, SolverOptions
from casa_sara.reconstruction.checkpoint import Checkpoint
from casa_sara.reconstruction.polarised import StokesProblem, reconstruct_polarised
from casa_sara.reconstruction.problem import Samples
from casa_sara.reconstruction.reconstruct import Control, reconstruct
from casa_sara.solver.record import STOPPED_BY_USER

INNER = np.s_[:, 20:60, 18:54]
SHORT = dict(niter=40, nreweights=1, **GRID)


@pytest.fixture(scope="module")
def observed(tmp_path_factory):
    folder = tmp_path_factory.mktemp("ms")
    return {feed: polarise(feed, simulate(folder / f"{feed}.ms", configuration="c", antennas=14, noise=OF_HANDS,
                                          correlations=correlations, scans=2, integration=20.0, hour_angle=-2.0,
                                          spacing_seconds=5400.0, spws=(("8.4GHz", "2MHz", 2),)))
            for feed, correlations in FEEDS.items()}


def planes(name):
    """Return all planes of an image, and the record of their coordinates."""
    with opened("image", name) as ia:
        return read_planes(ia), ia.coordsys().torecord(), list(ia.shape())


@pytest.mark.parametrize("feed, stokes", [
    ("circular", "IQUV"), *(pytest.param(*one, marks=pytest.mark.slow)
                            for one in (("linear", "IQUV"), ("circular", "QU"), ("linear", "IQ")))])
def test_dirty_planes_are_tcleans(observed, feed, stokes):
    import casatasks

    common = dict(vis=observed[feed], stokes=stokes, niter=0, imsize=[80, 72], cell="1arcsec", datacolumn="data",
                  weighting="briggs", robust=0.0)
    tsara(imagename="ours", positivity="I" in stokes, restoration=False, **common)
    casatasks.tclean(imagename="theirs", restoration=False, **common)
    for suffix in (".residual", ".psf", ".pb", ".sumwt"):
        (ours, csys, shape), (theirs, their_csys, their_shape) = planes("ours" + suffix), planes("theirs" + suffix)
        assert shape == their_shape and shape[2:] == [len(stokes), 1]
        for name in ("stokes", "crval", "cdelt", "crpix"):
            np.testing.assert_array_equal(csys["stokes1"][name], their_csys["stokes1"][name])
        if suffix in (".residual", ".psf"):
            difference = np.sqrt(np.mean((ours[INNER] - theirs[INNER]) ** 2, axis=(1, 2)))
            assert np.all(difference < 2e-3 * np.sqrt(np.mean(theirs[INNER] ** 2, axis=(1, 2))))
    np.testing.assert_allclose(planes("ours.sumwt")[0], planes("theirs.sumwt")[0], rtol=1e-5)


def test_all_stokes_are_read_as_each_alone(observed):
    """Also of a sample of which one parallel hand has no weight: it has no V, and so it is not used."""
    for name in observed.values():
        data = read_visibilities(Selection((name,), datacolumn="data"), stokes="IQUV")
        for number, stokes in enumerate("IQUV"):
            one = read_visibilities(Selection((name,), datacolumn="data"), stokes=stokes)
            own = data.of_stokes(number)
            for array in ("vis", "weight", "imaging_weight", "uvw", "row", "chan"):
                np.testing.assert_array_equal(getattr(own, array), getattr(one, array))
    weights = []
    edit(name, "WEIGHT", lambda weight: weights.append(weight.copy()) or np.where(
        np.arange(weight.shape[1]) < 3, np.array([[0], [1], [1], [1]]) * weight, weight))
    try:
        few = read_visibilities(Selection((name,), datacolumn="data"), stokes="IQUV")
    finally:
        edit(name, "WEIGHT", lambda weight: weights[0])
    assert few.size == data.size - 6 and few.dropped == {"non-positive weight": 6}


@pytest.mark.slow
def test_without_the_bound_each_is_what_it_is_alone(observed):
    result = tsara(vis=observed["circular"], imagename="all", stokes="IQU", polbound=False, pbcor=True, **SHORT)
    for number, stokes in enumerate("IQU"):
        alone = tsara(vis=observed["circular"], imagename=stokes, stokes=stokes, positivity=stokes == "I", pbcor=True,
                      **SHORT)
        for suffix in (".model", ".residual", ".psf", ".image", ".pb", ".image.pbcor", ".model.pbcor"):
            np.testing.assert_array_equal(planes("all" + suffix)[0][number], planes(stokes + suffix)[0][0])
        entry = result["sara"]["stokes"][number]
        assert entry["stokes"] == stokes and entry["chosen"] == alone["sara"]["chosen"]
        assert entry["blocks"] == alone["sara"]["blocks"]
        assert result["summaryminor"][0][0][number]["modelFlux"] == alone["summaryminor"][0][0][0]["modelFlux"]
    assert result["sara"]["polarised_above_jy_per_pixel"] > 1e-6


@pytest.mark.slow
def test_no_pixel_is_polarised_beyond_its_brightness(observed):
    import casatasks

    given = dict(vis=observed["linear"], stokes="IQUV", polbound=True, mask="box[[10pix,10pix],[70pix,64pix]]") | GRID
    result = tsara(imagename="x", **given)
    model, *_ = planes("x.model")
    polarised = np.sqrt(np.square(model[1:], dtype=float).sum(axis=0))
    above = polarised > model[0] * (1 + 1e-6)
    for x, y in ((48, 30), (28, 50)):  # around unresolved sources, where I may be negative, there is no bound
        above[x - 2 : x + 3, y - 2 : y + 3] = False
    assert not above.any() and polarised.max() > 0.25
    assert not model[:, :10].any() and planes("x.mask")[2] == [80, 72, 4, 1]
    assert 0 < result["sara"]["polarised_above_jy_per_pixel"] < 0.02 * model.max()
    for number, stokes in enumerate("IQUV"):
        for (x, y), flux in zip(((48, 30), (28, 50)), SKY[stokes]):
            assert model[number, x - 4 : x + 5, y - 4 : y + 5].sum() == pytest.approx(flux, rel=0.05, abs=5e-3)
    assert [island["right_ascension"][:8] for island in result["sara"]["stokes"][0]["islands"][:2]]
    with open("x.sara.json") as record:
        assert json.load(record)["stokes"][3]["stokes"] == "V"
    # tclean's beside it: the same intensity and angle where it is bright
    theirs = {name: value for name, value in given.items() if name not in ("nthreads", "polbound")}
    casatasks.tclean(imagename="c", niter=300, **theirs)
    measures = saracompare(models=["x", "c"], outdir="report")["products"]
    found = measures["x"]["polarisation"]
    assert found["peak_jy_per_beam"] == pytest.approx(np.hypot(SKY["Q"], SKY["U"]).max(), rel=0.05)
    assert 0.3 < found["fraction"] < 0.5 and "snr" not in found
    assert measures["c"]["polarisation"]["snr"] > 20 and measures["c"]["polarisation"]["angle_rms_deg"] < 2
    assert measures["x"]["natural"]["sigma"] > 0 and os.path.getsize("report/polarisation.png") > 20_000
    # a restart goes on from the models of all
    again = tsara(imagename="x", restart=True, niter=0, **given)
    for entry, plane in zip(again["sara"]["stokes"], model):
        assert entry["model_flux_jy"] == pytest.approx(plane.sum(dtype=float), rel=1e-5)


@pytest.mark.parametrize("given, message", [
    (dict(stokes="QU"), "positivity = True with stokes = 'QU': .*; should be False"),
    (dict(positivity=False, polbound=True), "positivity = False with stokes = 'IQUV' and polbound = True"),
    (dict(specmode="cube"), "specmode = 'cube' with stokes = 'IQUV': .*; should be 'mfs'"),
    (dict(gridder="mosaic"), "gridder = 'mosaic' with stokes = 'IQUV': .*; should be 'standard' or 'wproject'"),
    (dict(method="dabbech2018"), "method = 'dabbech2018' with stokes = 'IQUV'"),
    (dict(nterms=2), "stokes = 'IQUV' with nterms = 2"),
    (dict(parallel=True), "parallel = True with stokes = 'IQUV'"),
    (dict(ndraws=5), "ndraws = 5 with stokes = 'IQUV'"),
    (dict(jackknife=True), "jackknife = True with stokes = 'IQUV'"),
    (dict(savemodel="modelcolumn"), "savemodel = 'modelcolumn' with stokes = 'IQUV': .*; should be 'none'"),
    (dict(report=True), "report = True with stokes = 'IQUV': .*; should be False"),
    (dict(startmodel="i.model"), "startmodel = 'i.model' is of Stokes I: should be of I, Q, U, V")])
def test_what_several_do_not_have_is_refused(observed, given, message):
    if "startmodel" in given:
        tsara(vis=observed["circular"], imagename="i", niter=0, **GRID)
    with pytest.raises(ValueError, match=message):
        tsara(vis=observed["circular"], imagename="x", **dict(stokes="IQUV") | given, **GRID)


def test_a_dry_run_counts_all_of_them(observed):
    given = dict(vis=observed["circular"], imagename="x", polbound=True, dryrun=True) | GRID
    one, four = (tsara(stokes=stokes, **given)["forecast"] for stokes in ("I", "IQUV"))
    part = "wavelet duals and weights"
    assert four["memory_bytes"]["iterating"][part] == 3 * one["memory_bytes"]["iterating"][part]
    assert four["memory_bytes"]["reading"]["further Stokes parameters"] == 36 * four["visibilities"]
    assert four["seconds"]["total"] > 1.5 * one["seconds"]["total"]


def _problems(stopping=lambda reached: False):
    """I, Q and U of two sources, one more polarised than bright, and noise."""
    shape = (48, 48)
    sums, problems, reached = Sums(shape), [], {}
    for seed, (stokes, fluxes) in enumerate((("I", (30, 60)), ("Q", (10, -60)), ("U", (-8, 45)))):
        data = observation([(0, 0, 0, 0, 60), (0, 0, 1, 1e4, 60)])
        data, offsets = sort_into_blocks(data, data.rows.scan[data.row])
        data.uvw[:] = sums.u / CELL, sums.v / CELL, 0 * sums.u
        data.weight[:] = sums.weight
        data.vis[:] = sums.of((fluxes[0] * NOISE, 30, 20, 0), (fluxes[1] * NOISE, 18, 30, 6)) + sums.noise(seed)
        control = Control(lambda ppd, record, stokes=stokes: reached.__setitem__(stokes, ppd.iteration),
                          lambda: stopping(reached))
        problems.append(StokesProblem(stokes, Samples(data, offsets, np.ones(data.size), np.ones(2)), None, control))
    return problems, ImageGrid(shape, (CELL, CELL), stokes="IQU"), SolverOptions(**OPTIONS, polbound=True)


@pytest.mark.slow
def test_a_checkpoint_continues_as_if_nothing_had_stopped(tmp_path):
    """While I is solved, while Q and U are, and when one of these has come to its end."""
    def run(stopping=lambda reached: False):
        checkpoint = Checkpoint(str(tmp_path / "c"), "1", {})
        if (tmp_path / "c").exists():
            checkpoint.open()
        problems, grid, options = _problems(stopping)
        return reconstruct_polarised(problems, grid, options, checkpoint=checkpoint)

    problems, grid, options = _problems()
    wanted = reconstruct_polarised(problems, grid, options)
    ends = {stokes: one.record.iteration[-1] for stokes, one in wanted.items()}
    first, second = sorted(("Q", "U"), key=ends.get)
    assert ends[first] < ends[second] - 2
    assert run(lambda reached: reached.get("I") == 25)["I"].record.stop_code == STOPPED_BY_USER
    found = run(lambda reached: reached.get("Q") == 25)
    assert [found[stokes].record.stop_code == STOPPED_BY_USER for stokes in "IQU"] == [False, True, True]
    found = run(lambda reached: reached.get(second) == ends[second] - 1)
    assert [found[stokes].record.stop_code == STOPPED_BY_USER for stokes in ("I", first, second)] == [0, 0, 1]
    found = run()
    assert found[second].record.resumed == [25, ends[second] - 1]
    for stokes, one in wanted.items():
        np.testing.assert_array_equal(found[stokes].model, one.model)
        np.testing.assert_array_equal(found[stokes].l2_bounds, one.l2_bounds)


def test_the_bound_leaves_brightness_as_it_is_and_confines_its_polarisation():
    """Of one source Q and U together are brighter than I; around the other, a point, there is no bound."""
    problems, grid, options = _problems()
    together = reconstruct_polarised(problems, grid, options)
    alone = {one.stokes: reconstruct(one.samples, grid, SolverOptions(**OPTIONS, positivity=one.stokes == "I"))
             for one in problems}
    np.testing.assert_array_equal(together["I"].model, alone["I"].model)
    resolved = distance((48, 48), 30, 20) > 6
    for found, within in (together, True), (alone, False):
        i, q, u = (found[stokes].model.astype(float) for stokes in "IQU")
        assert np.all((np.hypot(q, u) <= i * (1 + 1e-6))[resolved]) == within
    area = np.s_[10:27, 22:39]
    fluxes = [np.hypot(*(found[stokes].model[area].sum() for stokes in "QU")) for found in (together, alone)]
    assert fluxes[0] < together["I"].model[area].sum() < fluxes[1]


def test_polarised_intensity_and_angle_are_measured_against_a_reference():
    """A source turned by 10 degrees and 20 % fainter; noise alone tells the level."""
    x, y = np.mgrid[-32:32, -32:32]
    source = np.exp(-(x**2 + y**2) / 50) + 0j
    rng, beams = np.random.default_rng(4), {"natural": (3.0, 3.0, 0.0)}
    residual = {"natural": 0.01 * rng.standard_normal((64, 64))}
    turned = 0.8 * source * np.exp(2j * np.radians(10))
    products = [Product("one", 2 * source.real, residual, residual, polarised=source * np.exp(0.3j)),
                Product("without", source.real, residual, residual),
                Product("other", 2 * source.real, residual, residual, polarised=turned * np.exp(0.3j))]
    found = polarised_measures(products, (1.0, 1.0), beams)
    assert found.keys() == {"one", "other"} and "snr" not in found["one"]
    assert found["other"]["angle_rms_deg"] == pytest.approx(10, rel=1e-6)
    assert [found[name]["fraction"] for name in found] == pytest.approx([0.5, 0.4], rel=1e-6)
    assert found["other"]["snr"] == pytest.approx(-20 * np.log10(abs(1 - 0.8 * np.exp(2j * np.radians(10)))), rel=1e-6)
    area = np.pi * 9 / (4 * np.log(2))
    assert found["one"]["level_jy_per_beam"] == pytest.approx(0.1, rel=0.05)
    assert 0.8 * area < found["one"]["peak_jy_per_beam"] < area
    against = polarised_measures(products, (1.0, 1.0), beams, source)
    assert against["one"]["angle_rms_deg"] == pytest.approx(np.degrees(0.15), rel=1e-6)
    assert polarised_measures(products[1:2], (1.0, 1.0), beams) == {}
