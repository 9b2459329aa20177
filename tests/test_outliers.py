"""Wild samples are found and named; what a model lacks, or a gain error, is not taken for one."""

import numpy as np
import pytest
from test_visibilities import observation

from casa_sara.data.outliers import find_wild

FLUX = 10.0
NOISE = 0.1


def case(scans=((0, 0, 1, 0, 60),), seed=0):
    """Samples of up to FLUX Jy with noise, their residual being the noise; and the whole as one block."""
    data = observation(list(scans), channels=2, seed=seed)
    rng = np.random.default_rng(seed)
    data.weight[:] = NOISE**-2
    model = FLUX * rng.uniform(0, 1, data.size)
    noise = NOISE * (rng.standard_normal(data.size) + 1j * rng.standard_normal(data.size))
    data.vis[:] = model + noise
    return data, np.array([0, data.size]), model


def found(data, offsets, model):
    return find_wild(data, offsets, (data.vis - model) / NOISE, FLUX)


def test_nothing_is_wild_in_noise():
    assert found(*case()).index.size == 0


@pytest.mark.parametrize("amplitude", [1e6, 30.0, 12.0])
def test_wild_samples_are_found_and_named(amplitude):
    data, offsets, model = case()
    spoiled = [17, 18, 402]
    data.vis[spoiled] += amplitude * np.exp(1j * np.arange(3)).astype(np.complex64)
    wild = found(data, offsets, model)
    assert wild.index.tolist() == spoiled
    np.testing.assert_allclose(wild.amplitude_jy, np.abs(data.vis[spoiled]))
    np.testing.assert_allclose(wild.predicted_jy, model[spoiled], rtol=1e-3)
    for sample, name in zip(spoiled, wild.named(data)):
        row = data.row[sample]
        assert (name["row"], name["channel"]) == (data.rows.row[row], data.chan[sample])
        assert (name["antenna1"], name["antenna2"]) == (data.rows.antenna1[row], data.rows.antenna2[row])
        assert name["time_mjd_s"] == data.rows.time[row]


def test_only_the_largest_are_named_at_once():
    """What a sample of 10⁶ Jy does to the image makes others look wild: they wait for the next image."""
    data, offsets, model = case()
    data.vis[40] += 1e6
    data.vis[90] += 100
    assert found(data, offsets, model).index.tolist() == [40]


def test_what_the_image_lacks_is_not_wild():
    """A source of 8 Jy that the image does not have yet: 80 σ in every sample of every baseline."""
    data, offsets, model = case()
    data.vis += 8
    assert found(data, offsets, model).index.size == 0


def test_gain_errors_are_not_wild():
    data, offsets, model = case()
    rng = np.random.default_rng(1)
    data.vis *= (1 + 0.3 * rng.standard_normal(data.rows.time.size)[data.row]).astype(np.float32)
    assert found(data, offsets, model).index.size == 0


def test_a_wrong_image_makes_no_sample_wild():
    """More than one per cent would be: then it is not the samples."""
    data, offsets, model = case()
    data.vis[::50] += 1e3
    assert found(data, offsets, model).index.size == 0


def test_samples_that_are_hardly_weighed_have_no_say():
    """What the image lacks of one baseline for a while, between such samples, does not stand alone; one sample does."""
    data, offsets, model = case([(0, 0, k, 1000 * k, 60) for k in range(8)])
    rows, light = data.rows, np.random.default_rng(3).random(data.rows.row.size)[data.row] < 0.6
    data.weight[light] *= 1e-8
    series = (rows.antenna2[data.row] == 4) & (data.chan == 0)
    lacking = series * 60 * np.exp(-(((rows.time[data.row] - 300) / 150) ** 2))  # times the noise
    assert 3 < np.count_nonzero((lacking > 25) & ~light) < 0.01 * np.count_nonzero(~light)
    data.vis += (NOISE * lacking).astype(np.complex64)

    def wild():
        return find_wild(data, offsets, (data.vis - model) * np.sqrt(data.weight), FLUX).index.tolist()

    assert wild() == []
    spoiled = np.flatnonzero(~light & (rows.antenna2[data.row] == 2))[3]
    data.vis[spoiled] += 1e3
    assert wild() == [spoiled]
