"""The metrics against numbers worked out by hand, and the picture that is drawn from them."""

import numpy as np
import pytest
from astropy import units
from astropy.convolution import convolve_fft
from radio_beam import Beam

from casa_sara.analysis import metrics
from casa_sara.analysis.areas import Frame, region_masks
from casa_sara.analysis.comparison import Product
from casa_sara.analysis.measuring import measure, source_support
from casa_sara.analysis.plots import Column, Zoom, compare
from casa_sara.analysis.points import recovered_point
from casa_sara.analysis.residuals import radial_power_spectrum, residual_statistics, whiteness


def test_snr_by_hand():
    assert metrics.snr([3.0, 4.0], [3.0, 4.5]) == pytest.approx(20.0)  # 5 against 0.5
    assert metrics.snr([[1.0, 0.0]], [[0.0, 0.0]]) == 0.0
    assert metrics.snr([1.0, 2.0], [1.0, 2.0]) == np.inf
    assert np.isnan(metrics.snr([1.0, 2.0], [1.0, np.nan]))  # not a perfect model


def test_log_snr_by_hand():
    # D = 9, peak 2: log10(1 + 9 x/2) of 2 and 0 is 1 and 0; of 4/9 it is log10(3)
    assert metrics.log_snr([2.0, 0.0], [2.0, 4 / 9], 9.0) == pytest.approx(-20 * np.log10(np.log10(3)))
    assert metrics.log_snr([2.0, 0.0], [2.0, -1.0], 9.0) == np.inf  # negative values count as zero


def test_different_shapes_are_refused():
    with pytest.raises(ValueError, match=r"truth has shape \(2, 2\) and model \(4,\)"):
        metrics.snr(np.ones((2, 2)), np.ones(4))


@pytest.mark.parametrize("angle", (0.0, 35.0, 90.0))
def test_smoothing_a_point_draws_the_beam(angle):
    point = np.zeros((64, 51))
    point[30, 25] = 2.0
    smoothed = metrics.smooth(point, (9.0, 5.0), angle)
    north, east = np.arange(51)[None, :] - 25, 30 - np.arange(64)[:, None]
    turn = np.deg2rad(angle)
    along, across = north * np.cos(turn) + east * np.sin(turn), east * np.cos(turn) - north * np.sin(turn)
    beam = np.exp(-4 * np.log(2) * ((along / 9) ** 2 + (across / 5) ** 2)) * 4 * np.log(2) / (np.pi * 45)
    np.testing.assert_allclose(smoothed, 2 * beam, atol=1e-6)


def test_smoothing_does_not_wrap_around():
    edge = np.zeros((40, 40))
    edge[0, 20] = 1.0
    smoothed = metrics.smooth(edge, 6.0)
    assert np.abs(smoothed[20:]).max() < 1e-7
    assert smoothed.sum() == pytest.approx(0.5, abs=0.15)  # about half of it falls off the edge


def test_dynamic_range_by_hand():
    assert metrics.dynamic_range([1.0, 8.0, np.nan], [2.0, -2.0, np.nan]) == pytest.approx(4.0)
    assert metrics.dynamic_range([1.0, 8.0], [12.0, 8.0]) == pytest.approx(4.0)  # the mean is no noise


def test_similarity_by_hand():
    assert metrics.similarity([3.0, 4.0], [3.0, 4.5]) == pytest.approx(20 * np.log10(np.hypot(3, 4.5) / 0.5))
    assert metrics.similarity([3.0, 4.5], [3.0, 4.0]) == metrics.similarity([3.0, 4.0], [3.0, 4.5])
    assert metrics.similarity([1.0, 0.0], [0.0, 2.0]) == pytest.approx(20 * np.log10(2 / np.sqrt(5)))
    assert metrics.similarity([1.0, 2.0], [1.0, 2.0]) == np.inf
    with pytest.raises(ValueError, match=r"one has shape \(2,\) and other \(1,\)"):
        metrics.similarity([1.0, 2.0], [1.0])


def test_model_dynamic_range_by_hand():
    model, support = np.array([[8.0, 0.5], [0.25, -3.0]]), np.array([[True, False], [False, False]])
    assert metrics.model_dynamic_range(model, support) == pytest.approx(16.0)
    assert metrics.model_dynamic_range(np.where(support, model, 0), support) == np.inf
    for nothing in (np.zeros((2, 2), bool), np.ones((2, 2), bool)):
        with pytest.raises(ValueError, match="support holds [04] of 4 pixels"):
            metrics.model_dynamic_range(model, nothing)


def test_integrated_flux_by_hand():
    image, mask = np.array([[1.0, 2.0], [4.0, 8.0]]), np.array([[True, True], [False, True]])
    assert metrics.integrated_flux(image, mask) == (11.0, None)
    flux, error = metrics.integrated_flux(image, mask, "Jy/beam", beam=4.0, rms=0.1)
    assert flux == pytest.approx(11 / 4) and error == pytest.approx(0.1 * np.sqrt(3 / 4))
    for change, message in (
        (dict(mask=~mask & mask), "mask is empty"),
        (dict(unit="K"), "unit = 'K'"),
        (dict(unit="Jy/beam"), "beam = None"),
        (dict(mask=mask[:1]), "image has shape"),
    ):
        with pytest.raises(ValueError, match=message):
            metrics.integrated_flux(**(dict(image=image, mask=mask) | change))


def test_beam_and_smoothing_are_those_of_radio_beam():
    """Along both axes and the angle, and in a cell that is not square by its area."""
    model = np.zeros((80, 70))
    model[[30, 44, 40], [33, 30, 41]] = 1.0, 2.0, 0.5
    beam = Beam(4 * units.arcsec, 2.5 * units.arcsec, 40 * units.deg)
    cell = 0.5
    area = (beam.sr / (cell * units.arcsec) ** 2).decompose().to_value("", units.dimensionless_angles())
    assert metrics.beam_pixels((4.0, 2.5), (cell, cell)) == pytest.approx(area, rel=1e-9)
    kernel = beam.as_kernel(cell * units.arcsec, x_size=69, y_size=69).array
    # theirs is indexed [y, x] with x to the west as here
    theirs = convolve_fft(model.T, kernel / kernel.sum(), boundary="fill", normalize_kernel=False).T
    ours = metrics.smooth(model, (4.0, 2.5), 40.0, (cell, cell))
    assert np.linalg.norm(ours - theirs) < 1e-6 * np.linalg.norm(theirs)
    np.testing.assert_allclose(ours, metrics.smooth(model, (8.0, 5.0), 40.0), atol=1e-12)
    shifted = np.roll(model, 1, axis=0)
    smoothed = [convolve_fft(image.T, kernel / kernel.sum(), boundary="fill", normalize_kernel=False)
                for image in (model, shifted)]
    by_hand = 20 * np.log10(np.linalg.norm(smoothed[0]) / np.linalg.norm(smoothed[0] - smoothed[1]))
    found = metrics.similarity(*(metrics.smooth(image, (4.0, 2.5), 40.0, (cell, cell)) for image in (model, shifted)))
    assert found == pytest.approx(by_hand, rel=1e-6)


def test_smoothing_in_oblong_cells():
    point = np.zeros((41, 81))
    point[20, 40] = 1.0
    smoothed = metrics.smooth(point, 8.0, 0.0, (2.0, 1.0))
    x, y = np.indices(point.shape) - np.array([20, 40])[:, None, None]
    beam = np.exp(-4 * np.log(2) * ((2 * x) ** 2 + y**2) / 64)
    np.testing.assert_allclose(smoothed, beam * 2 * 4 * np.log(2) / (np.pi * 64), atol=1e-6)


def test_ssim_against_explicit_windows():
    rng = np.random.default_rng(3)
    truth, model = rng.random((19, 16)), rng.random((19, 16))
    window = np.exp(-(np.arange(-5, 6) ** 2) / (2 * 1.5**2))
    window = np.outer(window, window) / window.sum() ** 2
    values = []
    for i in range(5, 14):
        for j in range(5, 11):
            a, b = (image[i - 5 : i + 6, j - 5 : j + 6] for image in (truth, model))
            ma, mb = (window * a).sum(), (window * b).sum()
            va, vb = (window * (a - ma) ** 2).sum(), (window * (b - mb) ** 2).sum()
            both = (window * (a - ma) * (b - mb)).sum()
            c1, c2 = (0.01 * 2) ** 2, (0.03 * 2) ** 2
            values.append((2 * ma * mb + c1) * (2 * both + c2) / ((ma**2 + mb**2 + c1) * (va + vb + c2)))
    assert metrics.ssim(truth, model, 2.0) == pytest.approx(np.mean(values), rel=1e-9)
    assert metrics.ssim(truth, truth, 2.0) == pytest.approx(1.0)
    with pytest.raises(ValueError, match="too small for a window of 11"):
        metrics.ssim(truth[:8], model[:8], 1.0)


def test_width_of_a_recovered_point():
    x, y = np.indices((61, 51)) - np.array([30, 24])[:, None, None]
    turn = np.deg2rad(20)
    along, across = x * np.cos(turn) + y * np.sin(turn), y * np.cos(turn) - x * np.sin(turn)
    blob = 3 * np.exp(-4 * np.log(2) * ((along / 8) ** 2 + (across / 4.5) ** 2))
    assert metrics.point_width(blob, (30, 24), 20) == pytest.approx(np.sqrt(8 * 4.5), rel=1e-3)
    assert metrics.point_width(blob, (30, 24), 20, (0.5, 0.5)) == pytest.approx(np.sqrt(8 * 4.5) / 2, rel=1e-3)
    assert metrics.point_width(blob, (0, 0), 2) is not None  # the tail
    assert metrics.point_width(0 * blob, (30, 24), 20) is None
    truth = np.zeros((40, 40))
    truth[10:14, 10:14] = 5.0
    assert metrics.isolated_point(truth) is None
    truth[30, 25] = 1.0
    assert metrics.isolated_point(truth) == (30, 25)


def test_snr_at_scale_forgives_what_is_below_the_scale():
    truth, model = np.zeros((2, 64, 64))
    truth[32, 32], model[33, 32] = 1.0, 1.0
    by_hand = metrics.snr(metrics.smooth(truth, 6.0), metrics.smooth(model, 6.0))
    assert metrics.snr_at_scale(truth, model, 6.0) == pytest.approx(by_hand)
    assert metrics.snr_at_scale(truth, model, 3.0, (0.5, 0.5)) == pytest.approx(by_hand)
    assert metrics.snr(truth, model) < by_hand < metrics.snr_at_scale(truth, model, 12.0)


def test_residual_statistics_by_hand():
    image = np.array([[1.0, 1.0, 1.0, 5.0]])  # mean 2, deviations −1 −1 −1 3
    found = residual_statistics(image)
    sigma = np.sqrt(3)
    assert found["sigma"] == pytest.approx(sigma) and found["max_abs"] == 5.0
    assert found["skewness"] == pytest.approx((27 - 3) / 4 / sigma**3)
    assert found["kurtosis"] == pytest.approx((81 + 3) / 4 / 9 - 3)
    for value, message in ((2.0, "all pixels are 2"), (np.nan, "16 pixels are not finite")):
        with pytest.raises(ValueError, match=message):
            residual_statistics(np.full((4, 4), value))


def test_power_spectrum_of_noise_and_of_a_wave():
    noise = 0.3 * np.random.default_rng(5).standard_normal((128, 96))
    frequency, power = radial_power_spectrum(noise, (0.5, 0.5))
    assert 0 < frequency.min() < 0.1 and frequency.max() < 1.0  # Nyquist is 1 cycle per arcsec
    np.testing.assert_allclose(power[4:], 0.09, rtol=0.3)
    assert whiteness(noise) > 0.95
    assert whiteness(metrics.smooth(noise, 4.0)) < 0.1
    wave = np.cos(2 * np.pi * 12 * np.arange(96) / 96) * np.ones((96, 1))
    frequency, power = radial_power_spectrum(wave)
    assert frequency[np.argmax(power)] == pytest.approx(12 / 96, abs=1 / 48)
    assert power.max() > 1e6 * np.median(power)


FRAME = Frame((299.87, 40.73), (0.5, 0.5), (64, 50))


def test_regions_of_every_kind_cover_their_area(tmp_path):
    """Circle, CRTF and DS9 name the same pixels; a circle 3 arcsec to the east of the centre, radius 4 arcsec."""
    east = 299.87 + 3 / 3600 / np.cos(np.deg2rad(40.73))
    circle = f"circle[[{east}deg, 40.73deg], 4arcsec]"
    (tmp_path / "a.crtf").write_text(f"#CRTFv0\n{circle}, coord=J2000, label='inner part'\n")
    ellipse = f"ellipse[[{east}deg, 40.73deg], [4arcsec, 4arcsec], 0deg]"
    (tmp_path / "c.crtf").write_text(f"#CRTFv0\n{ellipse}\n")  # in the frame of the image
    ds9 = f'circle({east},40.73,4")\nbox({east},40.73,5",4",0)'
    (tmp_path / "b.reg").write_text(f"# Region file format: DS9\nfk5\n{ds9}\n")
    masks = region_masks([f"lobe = {east}deg 40.73deg 4arcsec", "a.crtf", "b.reg",
                          circle, "c.crtf"], FRAME)
    assert list(masks)[:4] == ["lobe", "inner part", "b", "b 2"] and list(masks)[5] == "c"
    x, y = np.indices((64, 50))
    by_hand = np.hypot(x - (32 - 6), y - 25) < 8 + 1e-3
    for name in ("lobe", "inner part", "b", list(masks)[4], "c"):
        difference = masks[name] != by_hand
        assert (np.abs(np.hypot(x - 26, y - 25) - 8)[difference] < 0.01).all() and masks[name].sum() > 150
    assert masks["b 2"].sum() == pytest.approx(5 * 4 / 0.25, rel=0.25)


def test_regions_keep_their_shape_in_oblong_cells():
    frame = Frame((299.87, 40.73), (0.5, 0.25), (64, 100))
    masks = region_masks(["299.87deg 40.73deg 4arcsec", "fk5; box(299.87,40.73,5.9\",7.9\",0)"], frame)
    x, y = (np.indices((64, 100)) - np.array([32, 50])[:, None, None]) * np.array([0.5, 0.25])[:, None, None]
    for mask, by_hand, edge in zip(masks.values(), (np.hypot(x, y) < 4, (abs(x) < 2.95) & (abs(y) < 3.95)),
                                   (abs(np.hypot(x, y) - 4) < 0.01, np.zeros(x.shape, bool))):
        assert not (mask ^ by_hand)[~edge].any() and mask.sum() > 300
    # 25 arcsec high; 17 of 16 to the west
    for text in ("299.87deg 40.73deg 13arcsec", "299.8637deg 40.73deg 0.1arcsec"):
        with pytest.raises(ValueError, match="beyond the image|outside the image"):
            region_masks([text], frame)
    assert region_masks(["299.8650deg 40.73deg 1arcsec"], frame)  # 14 to the west


def test_a_file_with_a_line_that_is_not_understood_is_refused(tmp_path):
    (tmp_path
     / "half.reg").write_text('# Region file format: DS9\nfk5\ncircle(299.87,40.73,4")\nblob(299.87,40.73,4")\n')
    with pytest.raises(ValueError, match="regions = 'half.reg' is not a region.*blob"):
        region_masks(["half.reg"], FRAME)


@pytest.mark.parametrize("text, error, message", [
    ("299.87009deg 40.73deg 0.05arcsec", ValueError, "is empty: no pixel centre"),  # between pixels
    ("299.88deg 40.73deg 1arcsec", ValueError, "outside the image"),
    ("12deg -40.73deg 1arcsec", ValueError, "outside the image"),
    ("299.87deg 40.73deg 14arcsec", ValueError, "reaches beyond the image"),
    ("299.87deg 40.73deg -1arcsec", ValueError, "radius should be positive"),
    ("299.87deg 40.73deg", ValueError, "is not a region"),
    ("here there 1arcsec", ValueError, "is not a region"),
    ("299.87deg 40.73deg 1Jy", ValueError, "is not a region"),
    ("absent.crtf", FileNotFoundError, "absent.crtf' does not exist"),
    ("circle[[32pix, 25pix], 4pix]", ValueError, "in pixels"),
    ("image; circle(32,25,4)", ValueError, "in pixels"),
    ("fk5; -circle(299.87,40.73,4\")", ValueError, "excludes"),
    ("fk5; blob(299.87,40.73,4\")", ValueError, "is not a region"),
    ("blob[[299.87deg, 40.73deg], 4arcsec]", ValueError, "is not a region"),
])
def test_regions_that_are_refused(text, error, message):
    with pytest.raises(error, match=message) as caught:
        region_masks([text], FRAME)
    assert str(caught.value).startswith("regions = ")


def test_measures_on_plain_arrays():
    rng = np.random.default_rng(8)
    truth = np.zeros((64, 64))
    truth[20, 40], truth[40:46, 20:26] = 1.0, 0.05
    beams = {"natural": (3.0, 2.0, 10.0)}
    products = []
    for name, error in (("one", 1e-3), ("two", 1e-2)):
        noise = error * rng.standard_normal((2, *truth.shape))
        model, residual = truth + np.abs(noise[0]), noise[1]
        products.append(Product(name, model, {"natural": residual}, {"natural": 20 * model + residual}))
    support = source_support([p.model for p in products], truth, 1e-2, beams["natural"], (0.5, 0.5))
    mask = np.zeros((64, 64), bool)
    mask[38:48, 18:28] = True
    found = measure(products, (0.5, 0.5), beams, truth, support, {"lobe": mask}, {"one": [1.5, 2.0]})
    one, two = (found["products"][name] for name in ("one", "two"))
    assert one["flux_jy"] == pytest.approx(products[0].model.sum())
    assert one["mdr"] == pytest.approx(products[0].model.max() / products[0].model[~support].max())
    area = np.pi * 3 * 2 / (4 * np.log(2) * 0.25)
    assert one["regions"]["lobe"]["flux_jy"] == pytest.approx(products[0].restored["natural"][mask].sum() / area)
    error = products[0].residual["natural"].std() * np.sqrt(100 / area)
    assert one["regions"]["lobe"]["error_jy"] == pytest.approx(error)
    assert one["regions"]["lobe"]["model_flux_jy"] == pytest.approx(products[0].model[mask].sum())
    assert one["natural"]["dr"] == pytest.approx(products[0].restored["natural"].max() / one["natural"]["sigma"])
    assert one["natural"]["chi_square"] == [1.5, 2.0] and "chi_square" not in two["natural"]
    assert one["truth"]["snr"] == pytest.approx(metrics.snr(truth, products[0].model))
    assert one["truth"]["snr"] > two["truth"]["snr"] + 15
    scale = min(one["truth"]["snr_at_scale"], key=lambda key: abs(float(key) - np.sqrt(6)))
    by_hand = metrics.snr(*(metrics.smooth(image, np.sqrt(6) / 0.5) for image in (truth, products[0].model)))
    assert one["truth"]["snr_at_scale"][scale] == pytest.approx(by_hand)
    assert one["fwhm_recovered_arcsec"] < two["fwhm_recovered_arcsec"]
    by_hand = metrics.similarity(*(metrics.smooth(p.model, (6.0, 4.0), 10.0) for p in products))
    assert found["similarity"] == {"natural": {"one|two": pytest.approx(by_hand)}}


def test_support_is_the_median_of_the_models_and_no_artefact_of_one():
    sky = np.zeros((64, 64))
    sky[30:34, 30:34] = 1.0
    ghost = sky.copy()
    ghost[5, 50] = 1.0
    support = source_support([sky, ghost, sky], None, 0.05, (2.0, 2.0, 0.0), (1.0, 1.0))
    assert support[31, 31] and not support[5, 50] and 16 <= support.sum() < 100


def test_compare_draws_a_picture(tmp_path):
    rng = np.random.default_rng(0)
    sky = np.exp(-np.hypot(*np.mgrid[-32:32, -16:16]) / 4)
    noise = 1e-3 * rng.standard_normal(sky.shape)
    beam = (2.0, 1.5, 30.0)
    columns = [Column("truth", sky, sky, None, beam, "truth", "a note"), Column("image", sky, sky + noise, noise, beam)]
    compare(tmp_path / "picture.png", columns, 0.5, [Zoom("centre", 0, 0, 6.0)], title="test")
    assert (tmp_path / "picture.png").stat().st_size > 10_000


# Points -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("cell", [(1.0, 1.0), (0.5, 1.0)])
def test_a_gaussian_is_recovered_with_its_flux_place_and_width(cell):
    x, y = np.indices((90, 80))
    fwhm, place = 6.0, (40.3, 37.8)
    away = np.hypot((x - place[0]) * cell[0], (y - place[1]) * cell[1])
    image = np.exp(-4 * np.log(2) * (away / fwhm) ** 2)
    image /= image.sum()
    found = recovered_point(image, place, 15.0, cell)
    assert found["flux"] == pytest.approx(1, rel=1e-4)
    assert found["offset"] == pytest.approx(0, abs=1e-3)
    assert found["width"] == pytest.approx(fwhm, rel=2e-2)
    narrow = recovered_point(image, place, fwhm, cell)["flux"]
    assert narrow == pytest.approx(1 - 1 / 16, rel=1e-2)  # beyond one width, of a Gaussian
    beside = recovered_point(image, (place[0] + 1, place[1]), 15.0, cell)
    assert beside["offset"] == pytest.approx(cell[0], rel=1e-3)
    assert beside["width"] == pytest.approx(found["width"], rel=1e-2)


def test_one_pixel_is_as_wide_as_the_circle_of_half_its_area():
    image = np.zeros((21, 21))
    image[9, 12] = 2.0
    found = recovered_point(image, (9, 12), 4.0, (0.5, 0.5))
    assert found == {"flux": pytest.approx(2.0), "offset": pytest.approx(0, abs=1e-12),
                     "width": pytest.approx(0.5 * 2 * np.sqrt(0.5 / np.pi), rel=2e-2)}
    image[9, 12] = -2.0
    assert recovered_point(image, (9, 12), 4.0) == {"flux": pytest.approx(-2.0)}
    with pytest.raises(ValueError, match="a circle of 4 around it is not within"):
        recovered_point(image, (9, 18), 4.0)


def test_a_width_does_not_grow_with_what_noise_leaves_around():
    """An even sprinkling of a tenth of the flux: second moments would more than double."""
    rng = np.random.default_rng(3)
    image = np.exp(-4 * np.log(2) * ((np.indices((41, 41)) - 20) ** 2).sum(axis=0) / 3.0**2)
    alone = recovered_point(image, (20, 20), 15.0)["width"]
    image += rng.standard_normal(image.shape) * 0.1 * image.sum() / 700
    assert recovered_point(image, (20, 20), 15.0)["width"] == pytest.approx(alone, rel=0.1)
