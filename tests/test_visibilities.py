"""Snapshot blocks: the rule, the equal split, and the sorting."""

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from casa_sara.data import blocks as module
from casa_sara.data.blocks import snapshot_blocks
from casa_sara.data.visibilities import RowTable, Visibilities, sort_into_blocks


def observation(scans, baselines=10, channels=1, interval=10.0, seed=0):
    """Make samples of scans (ms, observation, scan, start in s, number of integrations), rows in random order."""
    columns = {name: [] for name in ("ms", "observation", "scan", "time", "antenna1", "antenna2")}
    for ms, obs, scan, start, integrations in scans:
        count = integrations * baselines
        for name, value in (("ms", ms), ("observation", obs), ("scan", scan)):
            columns[name].append(np.full(count, value))
        columns["time"].append(np.repeat(start + interval * (np.arange(integrations) + 0.5), baselines))
        columns["antenna1"].append(np.zeros(count, int))
        columns["antenna2"].append(np.tile(1 + np.arange(baselines), integrations))
    rng = np.random.default_rng(seed)
    columns = {name: np.concatenate(values) for name, values in columns.items()}
    shuffled = rng.permutation(columns["time"].size)
    columns = {name: values[shuffled] for name, values in columns.items()}
    rows = shuffled.size
    rest = {name: np.zeros(rows, np.int32) for name in ("field", "spw", "hands")}
    table = RowTable(row=np.arange(rows), interval=np.full(rows, interval), **rest, **columns)
    size = rows * channels
    return Visibilities(
        vis=(rng.standard_normal(size) + 1j * rng.standard_normal(size)).astype(np.complex64),
        weight=rng.uniform(1, 2, size).astype(np.float32),
        imaging_weight=rng.uniform(1, 2, size).astype(np.float32),
        uvw=rng.standard_normal((3, size)),
        row=np.repeat(np.arange(rows, dtype=np.int32), channels),
        chan=np.tile(np.arange(channels, dtype=np.int16), rows),
        rows=table,
        ms_names=tuple(f"{k}.ms" for k in range(3)),
    )


def scans_of(infos):
    return [info.scans for info in infos]


def test_one_block_for_each_scan_along_time():
    vis = observation([(0, 0, 7, 0, 60), (0, 0, -1, 1000, 60), (0, 1, 7, 3000, 60), (1, 0, 2, -5000, 60)])
    number, infos = snapshot_blocks(vis)
    assert number.dtype == np.int32 and number.shape == (vis.size,)
    assert [(info.ms_name, info.observations, info.scans) for info in infos] == [
        ("0.ms", (0,), (7,)), ("0.ms", (0,), (-1,)), ("0.ms", (1,), (7,)), ("1.ms", (0,), (2,)),
    ]  # fmt: skip
    rows = vis.rows
    for block, info in enumerate(infos):
        inside = vis.row[number == block]
        assert set(rows.scan[inside]) == set(info.scans) and info.samples == inside.size == 600
        assert info.start == np.min(rows.time[inside]) - 5 and info.end == np.max(rows.time[inside]) + 5


def test_label_names_ms_observation_scan_time_and_size():
    mjd_2015_06_01 = 57174 * 86400.0
    label = snapshot_blocks(observation([(0, 3, 4, mjd_2015_06_01, 60)]))[1][0].label
    assert label == "0.ms observation 3 scan 4, 2015-06-01T00:00:00 to 2015-06-01T00:10:00, 600 samples"


def test_long_scan_is_cut_into_equal_times():
    vis = observation([(0, 0, 1, 0, 720)])  # two hours
    number, infos = snapshot_blocks(vis)
    assert [info.samples for info in infos] == [1800] * 4
    assert np.array_equal(number, np.minimum(vis.rows.time[vis.row] / 1800, 3).astype(int))


def test_large_scan_is_cut_by_size_at_integrations():
    vis = observation([(0, 0, 1, 0, 50)], baselines=100, channels=64)
    number, infos = snapshot_blocks(vis)
    assert len(infos) == 4 and max(info.samples for info in infos) <= module.SNAPSHOT_SAMPLES
    blocks_of_time = {}
    for time, block in zip(vis.rows.time[vis.row], number):
        blocks_of_time.setdefault(time, set()).add(block)
    assert all(len(blocks) == 1 for blocks in blocks_of_time.values())


def test_size_alone_makes_a_limited_number_of_blocks(monkeypatch):
    vis = observation([(0, 0, 1, 0, 50), (0, 0, 2, 1000, 10)], baselines=100, channels=64)
    for most, expected in ((64, [80_000] * 4 + [64_000]), (2, [160_000] * 2 + [64_000])):
        monkeypatch.setattr(module, "CUT_FOR_SIZE", most)
        infos = snapshot_blocks(vis)[1]
        np.testing.assert_allclose([info.samples for info in infos], expected, atol=6400)


def test_a_single_integration_stays_whole():
    assert len(snapshot_blocks(observation([(0, 0, 1, 0, 1)], baselines=300, channels=512))[1]) == 1


def test_small_scans_join_the_nearer_neighbour():
    vis = observation([(0, 0, 1, 0, 60), (0, 0, 2, 700, 3), (0, 0, 3, 2000, 60), (0, 0, 4, 5000, 3)])
    assert scans_of(snapshot_blocks(vis)[1]) == [(1, 2), (3, 4)]
    vis = observation([(0, 0, 1, 0, 60), (0, 0, 2, 1900, 3), (0, 0, 3, 2000, 60)])
    assert scans_of(snapshot_blocks(vis)[1]) == [(1,), (2, 3)]
    vis = observation([(0, 0, k, 100 * k, 3) for k in range(40)])  # 30 samples each
    infos = snapshot_blocks(vis)[1]
    assert all(500 <= info.samples < 1500 for info in infos) and sum(scans_of(infos), ()) == tuple(range(40))


def test_small_scans_stay_within_ms_observation_and_session():
    far = module.SESSION_GAP_SECONDS
    vis = observation([(0, 0, 1, 0, 3), (0, 1, 1, 100, 3), (1, 0, 1, 200, 3), (1, 0, 1, 300 + far, 3)])
    assert [info.samples for info in snapshot_blocks(vis)[1]] == [30] * 4


@pytest.mark.parametrize("blocks", [1, 2, 3, 7, 600])
def test_given_number_of_equal_blocks_along_time(blocks):
    vis = observation([(0, 0, 1, 0, 20), (0, 0, 2, 1000, 40)])
    number, infos = snapshot_blocks(vis, blocks)
    sizes = np.bincount(number)
    assert len(infos) == sizes.size == blocks and np.ptp(sizes) <= 1 and number.dtype == np.int32
    order = np.argsort(number, kind="stable")
    assert np.all(np.diff(vis.rows.time[vis.row][order]) >= 0) or blocks < 600
    last = [vis.rows.time[vis.row][number == k].max() for k in range(blocks)]
    first = [vis.rows.time[vis.row][number == k].min() for k in range(blocks)]
    assert all(a <= b for a, b in zip(last[:-1], first[1:]))


def test_given_number_of_blocks_respects_measurement_sets():
    vis = observation([(0, 0, 1, 0, 10), (2, 0, 1, 1000, 35)])
    assert [info.ms_name for info in snapshot_blocks(vis, 5)[1]] == ["0.ms"] + 4 * ["2.ms"]
    assert [info.ms_name for info in snapshot_blocks(vis, 2)[1]] == ["0.ms", "2.ms"]
    assert [info.ms_name for info in snapshot_blocks(vis, 1)[1]] == ["0.ms, 2.ms"]


@pytest.mark.parametrize("blocks", [-1, 31])
def test_impossible_number_of_blocks(blocks):
    with pytest.raises(ValueError, match=f"blocks = {blocks}: .* 1 to 30"):
        snapshot_blocks(observation([(0, 0, 1, 0, 3)]), blocks)


@settings(max_examples=60, deadline=None)
@given(
    st.lists(
        st.tuples(st.integers(0, 2), st.integers(0, 1), st.integers(1, 4), st.integers(0, 200_000),
                  st.integers(1, 250)),
        min_size=1,
        max_size=8,
    ),
    st.sampled_from([0, 0, 1, 4]),
)
def test_every_sample_is_in_one_described_block(scans, blocks):
    vis = observation(scans, baselines=4)
    number, infos = snapshot_blocks(vis, blocks)
    assert np.array_equal(np.bincount(number), [info.samples for info in infos]) and min(np.bincount(number)) > 0
    assert len(np.unique(number)) == len(infos)
    ordered, offsets = sort_into_blocks(vis, number)
    for block, info in enumerate(infos):
        inside = ordered.row[offsets[block] : offsets[block + 1]]
        assert tuple(np.unique(vis.rows.scan[inside])) == info.scans
        assert tuple(np.unique(vis.rows.observation[inside])) == info.observations
        if not blocks:
            assert len(np.unique(vis.rows.ms[inside])) == len(info.observations) == 1


def test_sorting_into_blocks_keeps_samples_together():
    vis = observation([(0, 0, 1, 0, 5), (0, 0, 2, 500, 5)], channels=3)
    number = np.random.default_rng(1).integers(0, 4, vis.size)
    ordered, offsets = sort_into_blocks(vis, number)
    assert offsets.tolist() == [0, *np.cumsum(np.bincount(number))]
    for block in range(4):
        inside = slice(offsets[block], offsets[block + 1])
        for name in ("vis", "weight", "imaging_weight", "row", "chan", "uvw"):
            array = getattr(ordered, name)
            assert np.array_equal(array[..., inside], getattr(vis, name)[..., number == block])
            assert array.dtype == getattr(vis, name).dtype and array.flags.c_contiguous
    assert ordered.rows is vis.rows and ordered.ms_names == vis.ms_names


def test_extent():
    vis = observation([(0, 0, 1, 0, 5)])
    assert vis.max_uv == pytest.approx(max(np.hypot(u, v) for u, v in vis.uvw[:2].T))
    assert vis.max_w == pytest.approx(max(abs(w) for w in vis.uvw[2]))
