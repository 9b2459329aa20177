"""A mask as a hard support of the model: against tclean's mask, an answer found another way, and the sky."""

import numpy as np
import pytest
from dense_problem import Problem
from simulated_ms import pixels, simulate

casatools = pytest.importorskip("casatools")

from casa_sara import tsara
from casa_sara.imaging.data_quality import beyond_baselines, check_confined, left_outside
from casa_sara.solver.adaptive_ppd import AdaptivePPD
from casa_sara.solver.l2_bounds import GivenBounds
from casa_sara.solver.nnls import NNLSFit, nnls
from casa_sara.solver.positivity import Release

CELL_RAD = np.radians(1.0 / 3600)
GRID = dict(imsize=[80, 72], cell="1arcsec", datacolumn="data", wavelets=["dirac", "db1", "db2"], nthreads=1)
# pixel = centre − l/cell, centre + m/cell: (48, 30) and (28, 50)
INSIDE, OUTSIDE = (1.0, -8 * CELL_RAD, -6 * CELL_RAD), (0.4, 12 * CELL_RAD, 14 * CELL_RAD)
BOX = "circle[[48pix,30pix],8pix]"


@pytest.fixture(scope="module")
def vis(tmp_path_factory):
    return simulate(tmp_path_factory.mktemp("ms") / "c.ms", configuration="c", antennas=14, sky=[INSIDE, OUTSIDE],
                    noise=0.05,
                    scans=2, integration=20.0, spacing_seconds=5400.0, spws=(("8.4GHz", "2MHz", 2),), seed=4)


def tcleans_mask(vis, **mask):
    """The mask that tclean makes."""
    import casatasks

    casatasks.tclean(vis=vis, imagename="theirs", imsize=GRID["imsize"], cell=GRID["cell"], datacolumn="data", niter=1,
                     **mask)
    return pixels("theirs.mask")


def test_mask_is_tcleans_and_the_model_is_zero_outside(vis):
    with open("regions.crtf", "w") as file:
        file.write("#CRTFv0 CASA Region Text Format version 0\nbox[[44pix,26pix],[52pix,34pix]]\n")
    mask = dict(mask=["regions.crtf", "circle[[28pix,50pix],6pix]"])
    result = tsara(vis=vis, imagename="x", niter=250, **mask, **GRID)
    support, model = pixels("x.mask"), pixels("x.model")
    np.testing.assert_array_equal(support, tcleans_mask(vis, **mask))
    assert set(np.unique(support)) == {0, 1} and not model[support == 0].any()
    assert support.sum() == 81 + 113
    assert model[44:53, 26:35].sum() == pytest.approx(1.0, rel=0.05)
    assert model[22:35, 44:57].sum() == pytest.approx(0.4, rel=0.05)
    assert not any("outside the mask" in note for note in result["sara"]["notes"])


def test_what_is_outside_stays_out_is_pointed_out_and_raises_the_noise(vis):
    """0.4 Jy that the mask keeps out add their power to what is found as noise: √(1 + 0.4²w/2), w the weight."""
    result = tsara(vis=vis, imagename="x", niter=200, mask="circle[[48pix,30pix],2pix]",
                   **(GRID | dict(wavelets=["dirac"])))
    model = pixels("x.model")
    assert not model[pixels("x.mask") == 0].any()
    assert model.sum() == pytest.approx(1.0, rel=0.1)
    (note,) = [note for note in result["sara"]["notes"] if "outside the mask" in note]
    assert "at pixel [28, 50]" in note
    weight = 2 / 0.05**2  # of the mean of two hands
    for block in result["sara"]["blocks"]:
        assert block["noise_found"] == pytest.approx(np.sqrt(1 + 0.4**2 * weight / 2), rel=0.1)
    # a mask of an image on another grid; the restart from the model, and dirty images, are confined too
    for more in (dict(niter=0, startmodel="x.model"), dict(niter=5, startmodel="x.model")):
        tsara(vis=vis, imagename="y", mask="circle[[48pix,30pix],1pix]", overwrite=True, **more, **GRID)
        model, support = pixels("y.model"), pixels("y.mask")
        assert support.sum() == 5 and not model[support == 0].any() and model.max() > (0.01 if more["niter"] else 0.3)
    tsara(vis=vis, imagename="wide", mask=BOX, niter=0, **GRID)
    tsara(vis=vis, imagename="z", mask="wide.mask", niter=0, **(GRID | dict(imsize=100, cell="0.8arcsec")))
    np.testing.assert_array_equal(
        pixels("z.mask") > 0, _on_grid(100, 0.8))


def _on_grid(size, cell):
    """The mask as it is, after a look: a circle of 8 arcsec, to the pixels of both grids."""
    x, y = (np.indices((size, size)) - size // 2) * cell
    near = np.hypot(x - 8, y + 6)
    theirs = pixels("z.mask") > 0
    assert theirs[near < 8 - cell].all() and not theirs[near > 8 + 2].any()
    return theirs


@pytest.mark.parametrize("limit, region", [(0.0, ""), (0.9, ""), (0.9, "box[[2pix,2pix],[118pix,60pix]]")])
def test_primary_beam_mask_is_tcleans(vis, limit, region):
    options = dict(usemask="user", mask=region) if region else dict(usemask="pb")
    options |= dict(pbmask=limit, pblimit=0.85)
    tsara(vis=vis, imagename="x", niter=0, **options, **(GRID | dict(imsize=120)))
    support, beam = pixels("x.mask"), pixels("x.pb")
    import casatasks

    casatasks.tclean(vis=vis, imagename="theirs", imsize=120, cell="1arcsec", datacolumn="data", niter=1, **options)
    np.testing.assert_array_equal(support, pixels("theirs.mask"))
    inside = np.ones(support.shape, bool)
    if region:
        inside[:], inside[2:119, 2:61] = False, True
    np.testing.assert_array_equal(support > 0, (beam > limit) & inside)
    assert 0 < support.sum() < support.size


@pytest.mark.parametrize("given, message", [
    (dict(mask="nosuch.mask"), "mask = 'nosuch.mask' selects no pixel"),
    (dict(mask="circle[[400pix,400pix],10pix]"), r"mask = 'circle.*' selects no pixel: should be a CRTF region"),
    (dict(mask=[BOX, "rubbish[["]), r"mask = 'rubbish\[\[' selects no pixel"),
    (dict(mask="circle[[48pix,30pix],3pix]", pbmask=1.0), r"mask = 'circle.*', pbmask = 1 selects no pixel"),
    (dict(usemask="pb", pbmask=0.9, phasecenter="J2000 19h59m50s +40d44m02s"),
     "usemask = 'pb', pbmask = 0.9: the primary beam"),
    (dict(pbmask=0.3), "pbmask = 0.3 has no effect without a mask"),
    (dict(usemask="pb", mask=BOX), "mask = .* has no effect with usemask = 'pb'"),
])
def test_empty_masks_are_refused(vis, given, message):
    with pytest.raises(ValueError, match=message):
        tsara(vis=vis, imagename="x", niter=1, **given, **GRID)


# ---- the solver


SUPPORT = np.array([[1, 1, 0, 0], [1, 1, 1, 0], [0, 1, 1, 0], [0, 0, 1, 1]], bool)


@pytest.mark.parametrize("positivity", [True, False])
def test_confined_solution_is_that_of_the_smaller_problem(positivity):
    """Pixels of the support alone as unknowns: NNLS against scipy's solver, the primal-dual against its own limit."""
    from scipy.optimize import lsq_linear

    problem = Problem(seed=3)
    weighted = np.sqrt(problem.precond)[:, None] * problem.measurement.matrix[:, SUPPORT.ravel()]
    vis = np.sqrt(problem.precond) * problem.vis
    stacked, data = np.vstack([weighted.real, weighted.imag]), np.concatenate([vis.real, vis.imag])
    expected = lsq_linear(stacked, data, bounds=(0 if positivity else -np.inf, np.inf), tol=1e-12).x
    norm_sq = problem.data_norm_sq(problem.precond)
    model, _ = nnls(problem.measurement, problem.vis, problem.precond, norm_sq,
                    NNLSFit(3000, 0.0, positivity=positivity), support=SUPPORT)
    assert not model[~SUPPORT].any()
    np.testing.assert_allclose(model[SUPPORT], expected, atol=1e-4)


def confined(problem, positivity=True):
    ppd = AdaptivePPD(problem.measurement, problem.dictionary, problem.vis, problem.offsets, problem.precond,
                      problem.data_norm_sq(problem.precond), positivity)
    ppd.confine(SUPPORT)
    ppd.start_from(np.ones(SUPPORT.shape))
    ppd.threshold = 0.1
    bounds = GivenBounds(2 * problem.errors, np.array(problem.samples), np.ones(2), problem.dictionary.n_bases)
    bounds.apply_to(ppd)
    return ppd, bounds


@pytest.mark.parametrize("positivity", [True, False])
def test_iteration_is_that_of_a_problem_with_nothing_outside(positivity):
    """The optimality conditions hold on the support: x = P(x − τ g), g the gradient; outside x is 0 at every step."""
    ppd, _ = confined(Problem(seed=5), positivity)
    for _ in range(4000):
        ppd.step()
        assert not ppd.model[~SUPPORT].any() and not ppd.anchor[~SUPPORT].any()
    gradient = (ppd.l2_step * ppd._data_gradient + ppd._prior_gradient)[SUPPORT]
    model = ppd.model[SUPPORT]
    free = model > 1e-6 if positivity else np.ones(model.size, bool)
    assert free.sum() >= 2
    np.testing.assert_allclose(gradient[free], 0, atol=1e-6)
    assert (gradient[~free] > -1e-6).all()


def test_no_pixel_outside_is_released():
    """The data want pixels on either side to be negative: the lower bound falls inside, and stays outside."""
    problem = Problem(seed=7)
    sky = np.full(SUPPORT.shape, -0.5)
    sky[1, 1] = 3
    problem.vis = problem.measurement.matrix @ sky.ravel()
    ppd, bounds = confined(problem)
    for _ in range(200):
        ppd.step()
    release = Release()
    released = [release.update(ppd, bounds) for _ in range(3)]
    assert sum(released) >= 1 and (ppd.lowest[~SUPPORT] == np.inf).all() and (ppd.lowest[SUPPORT] < 0).any()
    for _ in range(50):
        ppd.step()
    assert not ppd.model[~SUPPORT].any() and np.isfinite(ppd.model).all()


def test_a_model_outside_is_an_error_and_artefacts_are_no_news():
    support = np.zeros((8, 8), bool)
    support[2:5, 2:5] = True
    model = np.where(support, 1.0, 0.0)
    assert check_confined(model, support).sum() == 9
    model[7, 7] = -1e-30
    with pytest.raises(RuntimeError, match="1 pixels of the model outside the mask are not zero"):
        check_confined(model, support)
    residual = np.random.default_rng(0).normal(size=(8, 8))
    assert left_outside(residual, support, 1.0) == []
    residual[6, 1] = -9.0
    assert "9.0 times its noise, at pixel [6, 1]" in left_outside(residual, support, 1.0)[0]
    residual[3, 3] = 7.0  # as large inside
    assert left_outside(residual, support, 1.0) == []


# ---- what the shortest baseline does not see


def gaussian(axes, shape=(96, 96), centre=(50, 45)):
    """A Gaussian of these FWHM in pixels, of 1 Jy."""
    x, y = (np.indices(shape) - np.reshape(centre, (2, 1, 1))) * 2.3548 / np.reshape(axes, (2, 1, 1))
    image = np.exp(-(x**2 + y**2) / 2)
    return image / image.sum()


def test_a_source_that_the_shortest_baseline_cannot_see_is_pointed_out():
    """Just above and just below 0.6 of its fringe; not for a narrow one, many small ones, or a faint one."""
    cell, seen = (CELL_RAD, 1.25 * CELL_RAD), 0.6 / (20 * CELL_RAD)

    def told(model):
        return beyond_baselines(model, cell, seen)

    (words,) = told(gaussian((24, 24 / 1.25)))
    assert "scales up to 20 arcsec" in words and 20 < float(words.split("a source of ")[1].split(" ")[0]) < 25
    assert told(gaussian((18, 18 / 1.25))) == [] and told(-gaussian((30, 24)))
    assert told(gaussian((40, 8))) == []
    points = np.zeros((96, 96))
    points[10:90:26, 10:90:26] = 1
    assert told(points) == [] and told(np.zeros((96, 96))) == []
    assert told(points + gaussian((26, 26))) == []  # 1 Jy of 17


@pytest.mark.parametrize("finer", [1, 4, 10])
def test_the_size_of_a_source_does_not_depend_on_the_pixels(finer):
    """Pixels are summed to bins before sources are told apart and measured: here none, none, and 4 × 2."""
    cell = (CELL_RAD / finer, 2 * CELL_RAD / finer)
    axes = 30 * finer, 13 * finer  # 30 and 26 arcsec
    model = gaussian(axes, (96 * finer, 50 * finer), (50 * finer, 22 * finer))
    (words,) = beyond_baselines(model, cell, 0.6 / (20 * CELL_RAD))
    assert float(words.split("a source of ")[1].split(" ")[0]) == pytest.approx(25, rel=0.05)


def test_a_coarse_start_model_keeps_its_flux_and_is_pointed_out(vis):
    """An image as a single dish's, 4 arcsec a pixel and of another size, of a source that no baseline sees."""
    common = dict(vis=vis, uvrange=">12klambda", **(GRID | dict(imsize=96)))
    tsara(imagename="dish", niter=0, **(common | dict(imsize=40, cell="4arcsec", uvrange="<20klambda")))
    coarse = 3 * gaussian((8, 7), (40, 40), (20, 21))
    ia = casatools.image()
    ia.open("dish.model")
    ia.putchunk(coarse[:, :, None, None])
    ia.close()
    result = tsara(imagename="x", niter=0, startmodel="dish.model", **common)
    model = pixels("x.model")
    assert model.sum() == pytest.approx(3, rel=1e-3)
    centre = [model.sum(axis=1 - axis) @ np.arange(96) / model.sum() for axis in (0, 1)]
    assert centre == pytest.approx([48, 48 + 4], abs=0.1)
    assert any("the shortest baseline is sensitive to scales up to" in note for note in result["sara"]["notes"])
    assert not any("shortest baseline" in note for note in tsara(imagename="y", niter=0, **common)["sara"]["notes"])


def test_a_start_model_in_another_unit_is_refused_with_the_way_to_the_right_one(vis):
    tsara(vis=vis, imagename="x", niter=0, restoringbeam=["6arcsec", "4arcsec", "0deg"], **GRID)
    pixels_in_beam = f"{np.pi / (4 * np.log(2)) * 24:.3f}"
    refused = f"startmodel = 'x.image' is in 'Jy/beam': it takes 'Jy/pixel'; divide it by {pixels_in_beam}"
    with pytest.raises(ValueError, match=refused):
        tsara(vis=vis, imagename="y", niter=0, startmodel="x.image", **GRID)
