"""The demo: visibilities against an explicit Fourier sum, noise against WEIGHT, gains by closure, sky and folder."""

from dataclasses import replace

import numpy as np
import pytest
from casatools import table

from casa_sara.demo.__main__ import MARKER, prepare
from casa_sara.demo.predict import predict
from casa_sara.demo.simulate import Observation, simulate_observation
from casa_sara.demo.sky import ARCSEC, COMPANION_JY, Sky, cyg_a_like

SMALL = Observation(scans=2, integrations=2, channels=2)
C = 299_792_458.0


def small_sky():
    """A lopsided blob on fine pixels and two point sources between them, one far out."""
    x, y = np.meshgrid(np.arange(48) - 24, np.arange(32) - 16, indexing="ij")
    blob = np.exp(-(((x - 6) / 7.0) ** 2) - ((y + 2) / 4.0) ** 2)
    points = np.array([[1.23 * ARCSEC, -0.31 * ARCSEC, 0.4], [-40 * ARCSEC, 33 * ARCSEC, 0.1]])
    return Sky(blob / blob.sum(), 0.05 * ARCSEC, 2, points)


def columns(vis, *names):
    """Read columns of a MeasurementSet."""
    tb = table()
    tb.open(str(vis))
    try:
        return [tb.getcol(name) for name in names]
    finally:
        tb.close()


def explicit(sky, uvw):
    """V = Σ I exp(2πi [u l + v m + w (n − 1)]), term by term; uvw (3, M) in wavelengths."""
    nx, ny = sky.image.shape
    l = -(np.arange(nx)[:, None] - nx // 2) * sky.cell_rad + np.zeros(sky.image.shape)
    m = (np.arange(ny)[None, :] - ny // 2) * sky.cell_rad + np.zeros(sky.image.shape)
    l, m, flux = (np.append(a.ravel(), b) for a, b in zip((l, m, sky.image), sky.points.T))
    u, v, w = uvw[:, :, None]
    return np.sum(flux * np.exp(2j * np.pi * (u * l + v * m + w * (np.sqrt(1 - l**2 - m**2) - 1))), axis=1)


@pytest.fixture(scope="module")
def clean(tmp_path_factory):
    """One MeasurementSet without errors: its path, true visibilities (channels, rows)."""
    folder = tmp_path_factory.mktemp("clean")
    simulation = simulate_observation(folder, small_sky(), "A", noise_db=np.inf, observation=SMALL)
    return simulation.vis[0], columns(simulation.vis[0], "DATA")[0][0]


def test_prediction_in_the_measurementset_is_the_explicit_sum(clean):
    vis, data = clean
    (uvw_m,), (both,) = columns(vis, "UVW"), columns(vis, "DATA")
    rows = np.random.default_rng(5).choice(uvw_m.shape[1], 40, replace=False)
    for channel, freq in enumerate(columns(vis + "/SPECTRAL_WINDOW", "CHAN_FREQ")[0][:, 0]):
        expected = explicit(small_sky(), uvw_m[:, rows] * freq / C)
        for hand in both:
            assert np.abs(hand[channel, rows] - expected).max() < 1e-6


def test_large_w_is_predicted():
    sky = replace(small_sky(), cell_rad=5 * ARCSEC, points=np.zeros((0, 3)))
    uvw = np.random.default_rng(1).uniform(-1, 1, (3, 50)) * np.array([[2e3], [2e3], [2e6]])
    assert np.abs(predict(sky, uvw) - explicit(sky, uvw)).max() < 1e-8
    assert np.abs(predict(sky, uvw * [[1], [1], [0]]) - explicit(sky, uvw)).max() > 0.1


def test_layout_of_the_measurementset(clean):
    vis, _ = clean
    scan, time, flag = columns(vis, "SCAN_NUMBER", "TIME", "FLAG")
    assert scan.size == 351 * 4 and not flag.any()
    assert [np.unique(time[scan == s]).size for s in np.unique(scan)] == [2, 2]
    tb = table()
    tb.open(vis)
    assert not {"CORRECTED_DATA", "MODEL_DATA"} & set(tb.colnames())
    tb.close()


def test_noise_follows_weight_and_input_snr(tmp_path, clean):
    simulation = simulate_observation(tmp_path, small_sky(), "A", noise_db=20.0, seed=4, observation=SMALL)
    data, weight, sigma = columns(simulation.vis[0], "DATA", "WEIGHT", "SIGMA")
    noise = data - clean[1]
    np.testing.assert_allclose(weight, sigma**-2.0, rtol=1e-6)
    whitened = noise * np.sqrt(weight)[:, None, :]
    spread = 5 / np.sqrt(2 * whitened[0].size)
    for hand in whitened:
        assert hand.real.std() == pytest.approx(1, abs=spread) and hand.imag.std() == pytest.approx(1, abs=spread)
        assert abs(np.mean(hand.real * hand.imag)) < 2 * spread
    assert abs(np.mean(whitened[0] * whitened[1].conj())) < 2 * spread
    stokes_i = noise.mean(axis=0)
    assert 20 * np.log10(np.linalg.norm(clean[1]) / np.linalg.norm(stokes_i)) == pytest.approx(20, abs=0.3)
    assert stokes_i.real.std() == pytest.approx(simulation.noise_std[0], rel=spread)


def test_blocks_tell_what_the_measurementset_holds(tmp_path, clean):
    simulation = simulate_observation(tmp_path, small_sky(), "A", 30.0, 0.05, 4, replace(SMALL, weight_scale=(2.0,)))
    data, weight, scan = columns(simulation.vis[0], "DATA", "WEIGHT", "SCAN_NUMBER")
    whitening = np.sqrt(4 / (1 / weight[0] + 1 / weight[1]))
    for block in simulation.blocks:
        of = scan == block.scan
        assert block.samples == 2 * of.sum()
        error = (data.mean(axis=0) - clean[1])[:, of] * whitening[of]
        assert block.error == pytest.approx(np.linalg.norm(error), rel=1e-4)
        assert block.signal == pytest.approx(np.linalg.norm(clean[1][:, of] * whitening[of]), rel=1e-4)
        assert block.noise == pytest.approx(np.sqrt(2 * 2 * block.samples), rel=0.05)  # E|n|² = 2; weight doubled
        assert block.error**2 == pytest.approx(block.noise**2 + block.gain**2, rel=0.05)


@pytest.mark.slow
def test_noise_is_drawn_anew_for_each_seed_and_measurementset(tmp_path):
    noise = []
    for seed in (1, 2):
        (tmp_path / str(seed)).mkdir()
        blank = Sky(np.full((4, 4), 1e-9), ARCSEC, points=np.array([[0, 0, 1.0]]))
        simulation = simulate_observation(tmp_path / str(seed), blank, "AD", 0.0, 0.0, seed, SMALL)
        noise += [(columns(vis, "DATA")[0] - 1).ravel() for vis in simulation.vis]
    correlation = np.abs(np.corrcoef(noise)) - np.eye(4)
    assert correlation.max() < 5 / np.sqrt(noise[0].size)


def test_noise_scale_and_weight_scale_of_each_configuration(tmp_path):
    scaled = replace(SMALL, noise_scale=(1.0, 3.0), weight_scale=(0.5, 1.0))
    simulation = simulate_observation(tmp_path, small_sky(), "AC", 30.0, 0.0, 0, scaled)
    first, second = simulation.noise_std
    assert second == pytest.approx(3 * first)
    for vis, std, factor in zip(simulation.vis, (first, second), (0.5, 1.0)):
        np.testing.assert_allclose(columns(vis, "WEIGHT")[0], factor / (2 * std**2), rtol=1e-6)


def test_gain_errors_are_antenna_gains_of_each_scan(tmp_path, clean):
    rms = 0.02
    simulation = simulate_observation(tmp_path, small_sky(), "A", np.inf, rms, 4, SMALL)
    data, scan, first, second = columns(simulation.vis[0], "DATA", "SCAN_NUMBER", "ANTENNA1", "ANTENNA2")
    ratio = data / clean[1]
    np.testing.assert_allclose(ratio[0], ratio[1], rtol=1e-4)
    gains = []
    for number in np.unique(scan):
        table_of = np.full((2 * 2, 27, 27), np.nan, complex)  # (channel and integration, antenna, antenna)
        of = scan == number
        samples = ratio[0][:, of].reshape(2, 2, 351).reshape(4, 351)
        pairs = first[of][:351], second[of][:351]
        table_of[:, pairs[0], pairs[1]] = samples
        np.testing.assert_allclose(samples, samples[:1].repeat(4, axis=0), rtol=1e-4)  # constant within the scan
        r = table_of[0]
        assert abs(np.angle(r[0, 1] * r[1, 2] * r[0, 2].conj())) < 1e-5  # closure phase
        assert abs(r[0, 1]) * abs(r[2, 3]) == pytest.approx(abs(r[0, 2]) * abs(r[1, 3]), rel=1e-5)  # closure amplitude
        gains.append(samples[0])
    gains = np.array(gains)
    assert np.abs(gains[0] - gains[1]).max() > rms  # another snapshot, other gains
    assert np.log(np.abs(gains)).std() == pytest.approx(np.sqrt(2) * rms, rel=0.3)
    assert np.angle(gains).std() == pytest.approx(np.sqrt(2) * rms, rel=0.3)
    assert all(block.noise == 0 and block.gain == block.error for block in simulation.blocks)


@pytest.mark.slow
def test_pointing_errors_are_gains_that_grow_from_the_centre(tmp_path):
    """Two sources at half the way to the edge: opposite errors, antenna by antenna; one at the centre: none."""
    rms, shape = 0.02, (48, 32)
    observation = replace(SMALL, pointing_rms=rms)
    ratios = {}
    for name, place in (("centre", (24, 16)), ("east", (12, 16)), ("west", (36, 16)), ("north", (24, 24))):
        image = np.zeros(shape)
        image[place] = 1.0
        (tmp_path / name).mkdir()
        sky = Sky(image, 0.1 * ARCSEC)
        simulation = simulate_observation(tmp_path / name, sky, "A", np.inf, 0.0, 3, observation)
        data, uvw_m, first, second = columns(simulation.vis[0], "DATA", "UVW", "ANTENNA1", "ANTENNA2")
        uvw = uvw_m * (observation.channel_freqs_hz[0] / C)
        ratios[name] = data[0, 0] / predict(sky, uvw)
        assert simulation.blocks[0].gain == simulation.blocks[0].error
    np.testing.assert_allclose(ratios["centre"], 1, atol=1e-5)
    assert np.abs(ratios["east"].imag).max() < 1e-5
    np.testing.assert_allclose(ratios["east"].real - 1, 1 - ratios["west"].real, atol=1e-5)
    assert np.std(ratios["east"].real) == pytest.approx(0.5 * np.sqrt(2) * rms, rel=0.3)
    table_of = np.zeros((27, 27))
    table_of[first[:351], second[:351]] = ratios["north"].real[:351] - 1
    # a sum of antennas
    assert table_of[0, 1] + table_of[2, 3] == pytest.approx(table_of[0, 2] + table_of[1, 3], abs=1e-5)
    assert abs(table_of[0, 1] - table_of[0, 2]) > 1e-3
    assert abs(np.corrcoef(ratios["east"].real, ratios["north"].real)[0, 1]) < 0.3  # the axes for themselves


def test_scans_of_each_configuration(tmp_path):
    simulation = simulate_observation(tmp_path, small_sky(), "AC", 30.0, 0.0, 0, replace(SMALL, scans=(3, 1)))
    assert [np.unique(columns(vis, "SCAN_NUMBER")[0]).size for vis in simulation.vis] == [3, 1]
    assert [block.scan for block in simulation.blocks] == [1, 2, 3, 1]


@pytest.mark.slow
def test_seed_decides(tmp_path):
    data = []
    for name, db, seed in (("a", 30.0, 1), ("b", 30.0, 1), ("c", 30.0, 2), ("d", 90.0, 1), ("e", 120.0, 1)):
        (tmp_path / name).mkdir()
        simulation = simulate_observation(tmp_path / name, small_sky(), "D", db, 0.05, seed, SMALL)
        data.append(columns(simulation.vis[0], "DATA")[0])
    assert np.array_equal(data[0], data[1])
    assert np.abs(data[0] - data[2]).max() > 1e-3
    np.testing.assert_allclose(data[3], data[4], atol=1e-3)  # the same gains whatever the noise
    with pytest.raises(FileExistsError, match="D.ms"):
        simulate_observation(tmp_path / "a", small_sky(), "D", observation=SMALL)


def test_another_telescope(tmp_path):
    alma = Observation(
        telescope="ALMA", antenna_file="alma/simmos/{}.cfg", source="dust", direction=("15h00m00.0s", "-30d00m00.0s"),
        freq_hz=230e9, channels=1, correlations="XX YY", hour_angles=(-2, 2), scans=1, integrations=1,
    )  # fmt: skip
    simulation = simulate_observation(tmp_path, small_sky(), ["alma.cycle8.3"], observation=alma)
    (uvw,) = columns(simulation.vis[0], "UVW")
    assert uvw.shape[1] == 43 * 42 // 2
    assert 400 < np.linalg.norm(uvw, axis=0).max() < 520  # the longest baseline is 0.50 km
    assert list(columns(simulation.vis[0] + "/POLARIZATION", "CORR_TYPE")[0][:, 0]) == [9, 12]
    assert set(columns(simulation.vis[0] + "/FEED", "POLARIZATION_TYPE")[0].ravel()) == {"X", "Y"}
    position = columns(simulation.vis[0] + "/ANTENNA", "POSITION")[0]
    np.testing.assert_allclose(position.T, [[2225e3, -5440e3, -2481e3]] * 43, atol=2e3)  # Chajnantor, geocentric


def test_truth_and_sky_agree_within_the_band():
    x, y = np.meshgrid(np.arange(96) - 48, np.arange(96) - 48, indexing="ij")
    blob = np.exp(-(((x - 5.3) ** 2 + (y + 3.1) ** 2) / 2 / 2.5**2))  # FWHM of 2.9 coarse pixels
    points = np.array([[0.31, 0.62, 0.5], [2.0, 0, 1], [-2.0, 0, 1], [0, 2.0, 1], [0, -2.0, 1]])  # four outside
    sky = Sky(blob / blob.sum(), 0.03 * ARCSEC, 2, points * [ARCSEC, ARCSEC, 1])
    truth = sky.truth()
    assert truth.shape == (48, 48) and truth.sum() == pytest.approx(1.5, abs=1e-6)
    assert truth[24 - 5, 24 + 10] == pytest.approx(0.5, abs=1e-3)  # the point source, in the nearest pixel
    uvw = np.random.default_rng(0).uniform(-0.3, 0.3, (3, 60)) / (0.06 * ARCSEC)
    extended = replace(sky, points=np.zeros((0, 3)))
    seen = Sky(extended.truth(), 0.06 * ARCSEC)
    assert np.abs(predict(extended, uvw) - predict(seen, uvw)).max() < 1e-5


def test_the_radio_galaxy():
    sky = cyg_a_like()
    assert sky.image.shape == (1024, 512) and sky.image.min() >= 0
    assert sky.image.sum() + sky.points[:, 2].sum() == pytest.approx(12.0)
    l, m, flux = sky.points[0]
    assert flux == COMPANION_JY == 5e-3 and np.hypot(l, m) / ARCSEC == pytest.approx(0.4, abs=1e-3)
    truth = sky.truth()
    assert truth.sum() == pytest.approx(12.0, rel=1e-5)
    edge = np.concatenate([truth[[0, -1]].ravel(), truth[:, [0, -1]].ravel()])
    assert edge.max() < 1e-6 * truth.max()
    assert np.array_equal(cyg_a_like().image, sky.image)
    assert not np.array_equal(cyg_a_like(seed=2).image, sky.image)


def test_folder_of_the_demo(tmp_path):
    out = tmp_path / "out"
    (prepare(out, "cyga") / "left").write_text("over")
    assert not list(prepare(out, "cyga").iterdir())
    (out / "3c273").mkdir()
    (out / "3c273" / "kept").touch()
    prepare(out, "cyga")
    assert (out / "3c273" / "kept").exists() and (out / MARKER).exists()

    mine = tmp_path / "mine"
    mine.mkdir()
    (mine / "thesis.tex").write_text("precious")
    with pytest.raises(FileExistsError, match="--out=.*mine"):
        prepare(mine, "cyga")
    assert [file.name for file in mine.iterdir()] == ["thesis.tex"]
