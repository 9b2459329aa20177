"""Sources that one point explains, islands of emission, and what is left in the residual; against Fourier sums."""

import numpy as np
import pytest
from fourier_sums import BEAM, NOISE, Sums, distance, gaussian, image, pixel, problem
from scipy.optimize import nnls

from casa_sara.solver.islands import islands_of, look_at
from casa_sara.solver.matched_filter import MatchedFilter
from casa_sara.solver.point_sources import PointSources
from casa_sara.solver.record import SolverRecord
from casa_sara.solver.significance import gradient_image, matched_filter
from casa_sara.solver.unresolved import unresolved


@pytest.fixture(scope="module")
def sums():
    return Sums((72, 64))


@pytest.fixture(scope="module")
def filter_(sums):
    return MatchedFilter(sums.psf)


# ---- sources that one point explains


def narrowed(sums, filter_, vis, model=None, places=((40, 27),), more=False):
    """Return the pixels above 2.5 within 3 beams of the places, with `more`, and the support and points they become."""
    model = np.zeros(sums.shape) if model is None else model
    gradient = sums.gradient(vis - sums.forward(model))
    support = filter_.snr(filter_.spectrum(gradient), 0) + filter_.nearby(model, 0) >= 2.5
    support &= np.any([distance(sums.shape, *place) < 3 * BEAM for place in places], axis=0)
    support |= more
    after, points = unresolved(filter_, gradient, model, support, np.ones(sums.shape, bool), 5.0)
    assert after[points.x, points.y].all()
    return support, after, points


def of_snr(sums, peak, *sources):
    """Noise-free visibilities whose largest S/N, of a point, is `peak`."""
    vis = sums.of(*sources)
    return vis * peak / (sums.gradient(vis).max() / sums.strength(pixel(sums.shape, 36, 32)))


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("held", [0, 1])
def test_a_lone_point_between_pixels_is_narrowed(sums, filter_, seed, held):
    """Whether the model holds nothing of it, or all of it as wide as a beam."""
    vis = of_snr(sums, 30, (1, 40.3, 26.8, 0))
    spread = gaussian(sums.shape, 40.3, 26.8, BEAM)
    model = held * spread * 30 * NOISE
    before, support, points = narrowed(sums, filter_, vis + sums.noise(seed), model)
    near = distance(sums.shape, 40, 27)
    assert before[near < 1.5 * BEAM].sum() > 20  # there was something to narrow
    np.testing.assert_allclose(points.places, [(40.3, 26.8)], atol=0.2)  # 0.05 pixels of noise at S/N 30
    pixels = points.pixels(sums.shape)
    assert pixels.sum() == 36
    np.testing.assert_array_equal(support[near <= 1.75 * BEAM - 1], pixels[near <= 1.75 * BEAM - 1])
    far = near > 1.75 * filter_.beam + 2
    np.testing.assert_array_equal(support[far], before[far])


@pytest.mark.parametrize("sources", [
    [(1, 40.3, 26.8, 1.5 * BEAM)],
    [(1, 40 - BEAM / 2, 27, 0), (1, 40 + BEAM / 2, 27, 0)],
    [(1, 40, 27 - BEAM / 2, 0), (0.6, 40, 27 + BEAM / 2, 0)],
], ids=["gaussian", "two", "unequal"])
def test_what_is_not_one_point_stays_as_it_is(sums, filter_, sources):
    for seed in range(3):
        before, support, points = narrowed(sums, filter_, of_snr(sums, 30, *sources) + sums.noise(seed))
        assert before.sum() > 20
        np.testing.assert_array_equal(support, before)
        assert not len(points)


def test_a_faint_halo_keeps_a_point_from_being_one(sums, filter_):
    """What a point leaves may be below 3.5 σ by pixels, and above it over a beam."""
    vis = sums.of((20 * NOISE, 40, 27, 0), (5 * NOISE * 5, 40, 27, 2 * BEAM))
    assert not len(narrowed(sums, filter_, vis)[2])
    assert len(narrowed(sums, filter_, sums.of((25 * NOISE, 40, 27, 0)))[2])


def test_a_neighbour_does_not_hide_a_point(sums, filter_):
    """Two points, 5 beams from each other, known to the model or not: both are narrowed."""
    vis = of_snr(sums, 30, (1, 30, 26, 0), (0.7, 30, 44, 0)) + sums.noise(0)
    for model in (None, pixel(sums.shape, 30, 44, 20 * NOISE)):
        _, _, points = narrowed(sums, filter_, vis, model, [(30, 26), (30, 44)])
        np.testing.assert_allclose(points.places, [(30, 26), (30, 44)], atol=0.25)


def test_a_point_that_holds_too_much_flux_is_none(sums, filter_):
    """The model has twice the flux of the point there: more is around than the point."""
    vis = of_snr(sums, 30, (1, 40, 27, 0))
    flux = 30 * NOISE
    assert len(narrowed(sums, filter_, vis, pixel(sums.shape, 40, 27, flux))[2])
    assert not len(narrowed(sums, filter_, vis, pixel(sums.shape, 40, 27, flux) + pixel(sums.shape, 41, 27, flux))[2])


@pytest.mark.parametrize("x, y", [(0, 0), (71, 63), (1, 30), (36, 61), (0, 63)])
def test_at_the_edge_nothing_is_lost(sums, filter_, x, y):
    """Where the pixels of a point would reach over the edge the support stays;
    4 pixels from it there is enough to tell."""
    vis = of_snr(sums, 30, (1, x, y, 0))
    before, support, points = narrowed(sums, filter_, vis, places=[(x, y)])
    assert support[x, y] and not len(points)
    np.testing.assert_array_equal(support, before)
    x, y = np.clip([x, y], 4, np.array(sums.shape) - 5)
    _, _, points = narrowed(sums, filter_, of_snr(sums, 30, (1, x, y, 0)), places=[(x, y)])
    np.testing.assert_allclose(points.places, [(x, y)], atol=0.1)


def test_a_point_whose_pixels_a_mask_cuts_is_none(sums, filter_):
    vis, everywhere = of_snr(sums, 30, (1, 40.2, 27.1, 0)), np.ones(sums.shape, bool)
    support, nothing = distance(sums.shape, 40, 27) < 2 * BEAM, np.zeros(sums.shape)
    for cut, number in [((40, 31), 1), ((40, 30), 0), ((37, 27), 1), ((38, 27), 0)]:
        allowed = everywhere.copy()
        allowed[cut] = False
        assert len(unresolved(filter_, sums.gradient(vis), nothing, support, allowed, 5.0)[1]) == number


def test_what_belonged_to_a_point_alone_goes_with_it(sums, filter_):
    """A tongue of the region around a point, as noise above half of the significance makes them."""
    tongue = np.zeros(sums.shape, bool)
    tongue[40, 27:27 + int(3 * BEAM)] = True
    _, support, points = narrowed(sums, filter_, of_snr(sums, 30, (1, 40, 27, 0)), more=tongue)
    np.testing.assert_array_equal(support, points.pixels(sums.shape))
    assert support.sum() == 36


@pytest.mark.parametrize("place", [(40.5, 26.5), (39.8, 27.3), (33.999, 28.001), (36.0, 30.0)])
def test_a_point_between_pixels_is_one_in_the_data(sums, place):
    """3 % off at worst, root mean square, where the beam has 3.5 pixels, and less than 1e-3 where it has 7."""
    point = PointSources([place])
    on_pixel = place == (36.0, 30.0)
    for finer, tolerance in [(1, 0.035), (2, 1e-3)]:
        u, v = sums.u / finer, sums.v / finer
        found = np.exp(-2j * np.pi * (np.outer(u, point.x[0]) - np.outer(v, point.y[0]))) @ point.shapes[0]
        expected = np.exp(-2j * np.pi * (u * place[0] - v * place[1]))
        error = np.sqrt(sums.weight @ np.abs(found - expected) ** 2 / sums.weight.sum())
        assert error < (1e-12 if on_pixel else tolerance)
    assert point.shapes.sum() == pytest.approx(1) and point.shapes.min() > -0.1


def test_only_the_flux_of_points_is_free():
    """The projection is the nearest of the multiples of the shape; the sums change as those of the images do."""
    rng = np.random.default_rng(4)
    points = PointSources([(5.3, 6.6), (14.0, 12.9), (6.2, 16.5)])
    x, free, anchor = rng.standard_normal((3, 22, 24)).astype(np.float32)
    free[points.x[0], points.y[0]] += 3 * points.shapes[0].astype(np.float32)
    free[points.x[2], points.y[2]] -= 3 * points.shapes[2].astype(np.float32)
    model, bar = free.copy(), 2 * free - anchor
    apart = points.project(model.copy(), anchor, bar.copy(), points.values(x), [[0, 2], [1]])
    change, = points.project(model, anchor, bar, points.values(x))
    np.testing.assert_allclose(apart.sum(axis=0), change, rtol=1e-10)
    second, = PointSources(points.places[1:2]).project(free.copy(), anchor, bar.copy(), points.values(x)[1:2])
    np.testing.assert_allclose(apart[1], second, rtol=1e-10)
    at = points.pixels(x.shape)
    np.testing.assert_array_equal(model[~at], free[~at])
    np.testing.assert_allclose(bar, 2 * model - anchor, rtol=1e-6, atol=1e-6)
    fluxes = []
    for px, py, shape in zip(points.x, points.y, points.shapes):
        flux = nnls(shape[:, None], free[px, py].astype(float))[0][0]
        np.testing.assert_allclose(model[px, py], flux * shape, atol=1e-6)
        fluxes.append(flux)
    assert fluxes[0] > 2 and fluxes[2] == 0
    sums = [np.array([np.square(new - x, dtype=float).sum(), np.square(new, dtype=float).sum(), new.sum(dtype=float)])
            for new in (free, model)]
    np.testing.assert_allclose(change, sums[1] - sums[0], rtol=1e-4, atol=1e-4)


def test_points_come_and_go_with_the_support():
    """A pixel of a point is free of the bound of the others, and under it again when it is a point's no more."""
    _, ppd, _ = problem()
    ppd.l2_step, ppd.threshold, whole = 1e-6, 0.1, np.ones(ppd.model.shape, bool)
    first, second = PointSources([(20.4, 15.2)]), PointSources([(23.0, 17.7), (9.1, 30.2)])
    for points in (first, second, PointSources()):
        ppd.support_only(whole, points)
        np.testing.assert_array_equal(ppd.lowest, np.where(points.pixels(whole.shape), -np.inf, 0))
        ppd.start_from(np.random.default_rng(1).uniform(0, 1, whole.shape))
        for _ in range(3):
            before = ppd.model.copy()
            ppd.step()
            held = ppd.model[points.x, points.y]
            np.testing.assert_allclose(held, held.sum(axis=1, keepdims=True) * points.shapes,
                                       atol=1e-6 * ppd.model.max())
            change = np.linalg.norm(ppd.model - before) / np.linalg.norm(ppd.model)
            assert ppd.rel_change == pytest.approx(change, rel=1e-4)
            assert (ppd.model_flux, ppd.model_max) == pytest.approx((ppd.model.sum(dtype=float), ppd.model.max()))
    state = ppd.state()
    assert state["points"].shape == (0, 2)


@pytest.mark.parametrize("x, y", [(6.5, -3.5), (6.3, -3.6), (6.0, -4.2)])
def test_the_flux_of_a_point_between_pixels_is_unbiased(x, y):
    """40 σ: positive pixels alone give 3 σ too much, as they are wider than a point."""
    found = [image([(40 * NOISE, x, y, 0)], seed=seed).model.sum() / NOISE for seed in range(3, 9)]
    assert np.mean(found) == pytest.approx(40, abs=1.2) and np.std(found) < 2


def test_a_point_in_a_beam_of_one_pixel_is_found():
    """Pixels as large as the beam: what is shifted of the response is then all of the patch."""
    psf = np.zeros((32, 32), np.float32)
    psf[15:18, 15:18], psf[16, 16] = 10, 110
    gradient = np.zeros_like(psf)
    gradient[10:13, 12:15], gradient[11, 13] = 15, 165
    support = np.zeros(psf.shape, bool)
    support[9:15, 10:17] = True
    _, points = unresolved(MatchedFilter(psf), gradient, np.zeros_like(psf), support, np.ones(psf.shape, bool), 5.0)
    np.testing.assert_allclose(points.places, [(11, 13)], atol=1e-6)


# ---- islands


def test_islands_of_nothing():
    assert islands_of(np.zeros((20, 30)), np.ones((20, 30))) == []


def test_islands_are_measured():
    """A wide Gaussian, two pixels that touch at a corner, a negative pixel in the box of the first, one at the edge."""
    sums = Sums((40, 50), 400)
    parts = [
        gaussian(sums.shape, 14.3, 20.7, 5.0) * 2.0,
        pixel(sums.shape, 30, 40, 0.02) + pixel(sums.shape, 31, 41, 0.06),
        pixel(sums.shape, 6, 13, -0.05),
        pixel(sums.shape, 0, 49, 0.01),
    ]
    parts[0][distance(sums.shape, 14, 21) > 9] = 0
    expected = sorted(parts, key=lambda part: -sums.strength(part))
    found = islands_of(sum(parts), sums.psf, unit_jy=0.5)
    assert len(found) == 4 and [island["snr"] for island in found] == sorted((i["snr"] for i in found), reverse=True)
    for island, part in zip(found, expected):
        snr = np.sqrt(np.vdot(part, sums.hessian(part)))
        assert island["snr"] == pytest.approx(snr, rel=1e-6) and snr == pytest.approx(sums.strength(part))
        assert island["flux_jy"] == pytest.approx(0.5 * part.sum())
        assert island["flux_error_jy"] == pytest.approx(0.5 * abs(part.sum()) / snr)
        assert island["pixels"] == np.count_nonzero(part)
    wide, pair, negative, corner = found
    assert (wide["x"], wide["y"]) == pytest.approx((14.3, 20.7), abs=0.02)
    assert wide["fwhm_pixels"] == pytest.approx(5.0, rel=0.01)
    assert (pair["x"], pair["y"]) == pytest.approx((30.75, 40.75))
    assert pair["fwhm_pixels"] == pytest.approx(2.35482 * np.sqrt(0.75 * 0.25))
    assert (negative["x"], negative["y"], negative["fwhm_pixels"]) == pytest.approx((6, 13, 0))
    assert negative["flux_jy"] < 0
    assert (corner["x"], corner["y"]) == (0, 49)


@pytest.mark.parametrize("place", [(14.3, 20.7), (10.5, 30.0), (22.0, 9.0)])
def test_the_island_of_a_point_between_pixels_is_a_point(sums, place):
    """At its place and without extent, though 36 pixels of both signs hold it; where both signs cancel,
    the modulus tells."""
    point = PointSources([place])
    model = np.zeros(sums.shape)
    model[point.x, point.y] = 0.3 * point.shapes
    (island,) = islands_of(model, sums.psf)
    assert (island["x"], island["y"]) == pytest.approx(place, abs=1e-6)
    assert island["flux_jy"] == pytest.approx(0.3) and island["fwhm_pixels"] < 1e-3
    (pair,) = islands_of(pixel(sums.shape, 10, 12) - pixel(sums.shape, 10, 13), sums.psf)
    assert (pair["x"], pair["y"]) == (10, 12.5) and pair["fwhm_pixels"] == pytest.approx(2.35482 * np.sqrt(0.125))


def test_flux_error_of_an_island_is_that_of_its_strength():
    """The strength of a known shape, fitted to many realisations of the noise, scatters by it."""
    sums = Sums((32, 32), 400)
    part = gaussian(sums.shape, 15, 17, 4.0) * 40 * NOISE
    part[part < 1e-3 * part.max()] = 0
    (island,) = islands_of(part, sums.psf)
    response = sums.weight * sums.forward(part)
    strength = [1 + np.vdot(response, sums.noise(seed)).real / sums.strength(part) ** 2 for seed in range(400)]
    assert part.sum() * np.std(strength) == pytest.approx(island["flux_error_jy"], rel=0.15)


# ---- what is left in the residual


@pytest.mark.parametrize("noise", [(1.0, 1.0), (0.7, 1.6)])
def test_what_is_left_is_on_record(noise):
    """The largest |T| at every width, with the noise levels found, and the islands; all in explicit sums."""
    sums, ppd, bounds = problem(noise=noise)
    sums_of_residual = sums.of((-9 * NOISE, 20.2, 22.7, 0)) + sums.noise(3)
    ppd.model[...] = gaussian(sums.shape, 30, 15, 3.0) * (distance(sums.shape, 30, 15) < 6)
    ppd.vis[:] = sums.whiten * (sums.forward(ppd.model) + sums_of_residual)
    ppd.unit_jy = 2.0
    gradient = sums.gradient(sums_of_residual)
    np.testing.assert_allclose(gradient_image(ppd, bounds, ppd.model), gradient, atol=1e-6 * np.abs(gradient).max())
    filter_ = matched_filter(ppd, bounds)
    np.testing.assert_allclose(filter_.psf, sums.psf, atol=1e-6 * sums.psf.max())
    record = SolverRecord()
    look_at(ppd, bounds, record)
    assert [entry["beams"] for entry in record.residual_snr] == [0, 1, 2]  # 4 beams are wider than a quarter of 40
    for entry in record.residual_snr:
        width = entry["beams"] * filter_.beam
        rows, columns = ([gaussian((n, 1), k, 0, width)[:, 0] for k in range(n)] for n in sums.shape)
        scale = sum(rows[20]) * sum(columns[20])
        norm = sums.strength(gaussian(sums.shape, 24, 20, width))
        expected = np.abs(np.array(rows) @ gradient @ np.array(columns).T).max() / scale / norm
        assert entry["snr"] == pytest.approx(expected, rel=3e-3)
    (island,) = record.islands
    assert island["snr"] == pytest.approx(sums.strength(ppd.model), rel=1e-5)
    assert island["flux_jy"] == pytest.approx(2 * ppd.model.sum())


@pytest.mark.parametrize("fwhm, width, snr, structured", [
    (BEAM, 1, 5.5, True), (BEAM, 1, -5.5, True), (BEAM, 1, 4.5, False), (2 * BEAM, 2, 5.5, True), (0, 0, 5.6, False)])
def test_structure_is_more_than_five_sigma_over_a_beam(fwhm, width, snr, structured):
    """A residual without noise, scaled to the S/N wanted at its own width; a point of more than 5 σ is none."""
    sums, ppd, bounds = problem()
    residual = sums.of((1.0, 24.0, 20.0, fwhm))
    source = gaussian(sums.shape, 24, 20, width * matched_filter(ppd, bounds).beam)
    residual *= snr / (np.vdot(source, sums.gradient(residual)) / sums.strength(source))
    ppd.vis[:] = sums.whiten * residual
    record = SolverRecord()
    assert look_at(ppd, bounds, record) == structured
    assert record.residual_snr[width]["snr"] == pytest.approx(abs(snr), rel=2e-3) and record.islands == []


def test_noise_is_no_structure():
    sums, ppd, bounds = problem()
    for seed in range(5):
        ppd.vis[:] = sums.whiten * sums.noise(seed)
        assert not look_at(ppd, bounds, SolverRecord())
