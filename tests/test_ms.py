"""Reading MeasurementSets: against row-by-row table reads, an explicit sky, phaseshift and tclean."""

import hashlib
import os
import shutil
import tarfile
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("casatools")

from simulated_ms import (
    CYGNUS_A,
    SPEED_OF_LIGHT,
    add_column,
    column,
    direction_cosines,
    edit,
    remove_columns,
    simulate,
)

from casa_sara.casa.ms.frames import rotation_between
from casa_sara.casa.ms.read import read_visibilities
from casa_sara.options import Selection

SHARED = Path(__file__).resolve().parents[2] / "shared/data"
NORTH = "J2000 19h59m28.5s +40d45m02s"
SKY = ((1.0, 0.0, 0.0), (0.5, 2e-4, -3e-4))
TWO_SPWS = (("8.4GHz", "2MHz", 3), ("8.7GHz", "1MHz", 2))


def read(*names, phasecenter="", **selection):
    return read_visibilities(Selection(vis=tuple(map(str, names)), **selection), phasecenter)


@pytest.fixture(scope="module")
def observation(tmp_path_factory):
    """Two spws, two fields, topocentric frequencies, noise: never written to."""
    name = tmp_path_factory.mktemp("ms") / "observation.ms"
    return simulate(name, spws=TWO_SPWS, fields=(CYGNUS_A, NORTH), scans=3, sky=SKY, noise=(0.1, 0.2), frame="TOPO",
                    columns=("DATA", "CORRECTED_DATA"))  # fmt: skip


@pytest.fixture
def copied(observation, tmp_path):
    """A copy of the observation to spoil."""
    return shutil.copytree(observation, tmp_path / "copied.ms")


def explicit_samples(name, hands, col="CORRECTED_DATA", weight_spectrum=False):
    """Read all samples one table cell after the other: {(row, chan): (vis, weight, imaging weight)}, and counts."""
    import casatools

    tb = casatools.table()
    tb.open(str(name))
    samples, counts = {}, {}
    for row in range(tb.nrows()):
        data, flag, weights = (tb.getcell(of_ms, row) for of_ms in (col, "FLAG", "WEIGHT"))
        if weight_spectrum:
            weights = tb.getcell("WEIGHT_SPECTRUM", row)
        else:
            weights = np.repeat(weights[:, None], data.shape[1], axis=1)
        auto = tb.getcell("ANTENNA1", row) == tb.getcell("ANTENNA2", row)
        uvw = tb.getcell("UVW", row)
        for chan in range(data.shape[1]):
            vis = [data[hand, chan] for hand in hands]
            weight = [weights[hand, chan] for hand in hands]
            heaviest = max((w for w in weight if w > 0), default=0)
            used = [k for k, w in enumerate(weight) if w > 0 and w >= 1e-6 * heaviest]
            if auto:
                reason = "autocorrelation"
            elif tb.getcell("FLAG_ROW", row):
                reason = "flagged row"
            elif any(flag[:, chan]):
                reason = "flagged"
            elif not all(np.isfinite(vis[k]) for k in used):
                reason = "non-finite data"
            elif any(np.isinf(w) for w in weight) or not used and any(np.isnan(w) for w in weight):
                reason = "non-finite weight"
            elif not used:
                reason = "non-positive weight"
            elif not all(np.isfinite(x) for x in uvw):
                reason = "non-finite uvw"
            else:
                whitening = len(used) ** 2 / sum(1 / weight[k] for k in used)
                samples[row, chan] = (sum(vis[k] for k in used) / len(used), whitening,
                                      sum(weight[k] for k in used) / len(hands))
                continue
            counts[reason] = counts.get(reason, 0) + 1
    tb.close()
    return samples, counts


def assert_same_samples(vis, samples):
    found = {(row, chan): k for k, (row, chan) in enumerate(zip(vis.rows.row[vis.row].tolist(), vis.chan.tolist()))}
    assert found.keys() == samples.keys() and vis.size == len(samples) > 0
    order = [found[key] for key in samples]
    expected = np.array(list(samples.values()))
    assert np.array_equal(vis.vis[order], expected[:, 0].astype(np.complex64))
    np.testing.assert_allclose(vis.weight[order], expected[:, 1].real, rtol=1e-6)
    np.testing.assert_allclose(vis.imaging_weight[order], expected[:, 2].real, rtol=1e-6)


@pytest.mark.parametrize(
    ("correlations", "hands"),
    [("RR LL", (0, 1)), ("LL RR", (0, 1)), ("XX YY", (0, 1)), ("RR RL LR LL", (0, 3)), ("LL RL LR RR", (0, 3)),
     ("XX", (0,)),
     ("LL", (0,))],
)
def test_samples_equal_a_cell_by_cell_read(tmp_path, correlations, hands):
    rng = np.random.default_rng(1)
    count = len(correlations.split())
    name = simulate(tmp_path / "a.ms", antennas=6, correlations=correlations, noise=0.1 * np.arange(1, count + 1),
                    autocorrelations=True,
                    columns=("DATA", "CORRECTED_DATA"))  # fmt: skip

    def spoil(share, value):
        return lambda old: np.where(rng.random(old.shape) < share, value, old)

    edit(name, "FLAG", spoil(0.1, True))
    edit(name, "FLAG_ROW", spoil(0.1, True))
    edit(name, "CORRECTED_DATA", spoil(0.03, np.nan + 0j))
    edit(name, "CORRECTED_DATA", spoil(0.03, 1j * np.inf))
    for value in (0.0, -1.0, np.inf, np.nan):
        edit(name, "WEIGHT", spoil(0.1, value))
    edit(name, "UVW", spoil(0.02, np.inf))
    vis = read(name)
    samples, counts = explicit_samples(name, hands)
    assert_same_samples(vis, samples)
    assert vis.dropped == counts and len(counts) == 7
    assert any("unflagged visibilities are not usable" in note for note in vis.notes)
    assert any(" has only " in note for note in vis.notes) == (count == 1)
    assert bool(vis.alone) == any("alone, because the other" in note for note in vis.notes) == (len(hands) == 2)


def test_dtypes_and_layout(observation):
    vis = read(observation)
    dtypes = {"vis": np.complex64, "weight": np.float32, "imaging_weight": np.float32, "uvw": np.float64,
              "row": np.int32,
              "chan": np.int16}
    for name, dtype in dtypes.items():
        array = getattr(vis, name)
        assert array.dtype == dtype and array.shape[-1] == vis.size and array.flags.c_contiguous
    assert {len(value) for value in vars(vis.rows).values()} == {vis.row.max() + 1}
    assert vis.ms_names == (observation,) and vis.spws == {0: (0, 1)} and vis.observatory == "VLA"


def test_row_table(observation):
    rows = read(observation).rows
    for name, of_ms in (("time", "TIME"), ("scan", "SCAN_NUMBER"), ("field", "FIELD_ID"), ("spw", "DATA_DESC_ID"),
                        ("antenna1", "ANTENNA1"), ("antenna2", "ANTENNA2"), ("interval", "INTERVAL")):  # fmt: skip
        assert np.array_equal(getattr(rows, name), column(observation, of_ms)[rows.row])
    assert not rows.ms.any() and not rows.observation.any()


def test_weight_spectrum_is_used_where_it_is_filled(tmp_path):
    name = simulate(tmp_path / "a.ms", antennas=5, scans=1, noise=(0.1, 0.2), weight_spectrum=True)
    edit(name, "WEIGHT_SPECTRUM", lambda old: old * np.random.default_rng(2).uniform(0.5, 2, old.shape))
    assert_same_samples(read(name), explicit_samples(name, (0, 1), "DATA", weight_spectrum=True)[0])


def test_empty_weight_spectrum_column_is_not_used(tmp_path):
    name = simulate(tmp_path / "a.ms", antennas=5, scans=1, noise=(0.1, 0.2))
    add_column(name, "WEIGHT_SPECTRUM", None)
    assert_same_samples(read(name), explicit_samples(name, (0, 1), "DATA")[0])


@pytest.mark.parametrize("noise", [(0.1, 0.1), (0.1, 0.4)])
def test_whitening_factor_on_simulated_noise(tmp_path, noise):
    """CASA's WEIGHT = 1/SIGMA² per real part: whitened samples have E|n|² = 2, not 1."""
    name = simulate(tmp_path / "a.ms", antennas=14, sky=((0.0, 0.0, 0.0),), noise=noise, scan_seconds=120, seed=3)
    vis = read(name)
    whitened = vis.vis * np.sqrt(vis.weight)
    tolerance = 4 / np.sqrt(vis.size)
    assert abs(np.mean(np.abs(whitened) ** 2) / 2 - 1) < tolerance < 0.07
    assert abs(np.var(whitened.real) - 1) < 1.5 * tolerance and abs(np.var(whitened.imag) - 1) < 1.5 * tolerance


def test_channel_selection(observation):
    everything, some = read(observation), read(observation, spw="0:0~2^2,1:1")
    spw, chan = everything.rows.spw[everything.row], everything.chan
    wanted = np.where(spw == 0, chan != 1, chan == 1)
    assert np.array_equal(some.vis, everything.vis[wanted]) and np.array_equal(some.uvw, everything.uvw[:, wanted])
    assert np.array_equal(some.chan, chan[wanted])
    assert read(observation, spw="1").spws == {0: (1,)}
    for same in ("0:8~9GHz", "*:8.4~8.5GHz"):
        assert np.array_equal(read(observation, spw=same).vis, everything.vis[spw == 0])


def test_data_column(copied):
    edit(copied, "DATA", lambda old: 2 * old)
    corrected, data = read(copied), read(copied, datacolumn="data")
    np.testing.assert_allclose(data.vis, 2 * corrected.vis, rtol=1e-6)
    assert not any("datacolumn" in note for note in corrected.notes)
    remove_columns(copied, "CORRECTED_DATA")
    fallback = read(copied)
    assert np.array_equal(fallback.vis, data.vis)
    assert any("DATA is imaged instead" in note and str(copied) in note for note in fallback.notes)


def test_uvw_and_phases_untouched_at_the_fields_own_centre(tmp_path):
    name = simulate(tmp_path / "a.ms", sky=SKY, noise=0.1)
    data, uvw_m = column(name, "DATA"), column(name, "UVW")
    frequencies = column(name + "/SPECTRAL_WINDOW", "CHAN_FREQ")[:, 0]
    for phasecenter in ("", 0, "0", CYGNUS_A, "19:59:28.5 +40.44.02", "J2000 299.86875deg 40d44m02s"):
        vis = read(name, phasecenter=phasecenter)
        row, chan = vis.rows.row[vis.row], vis.chan
        assert np.array_equal(vis.vis, ((data[0] + data[1]) / 2)[chan, row].astype(np.complex64))
        assert np.array_equal(vis.uvw, uvw_m[:, row] * (frequencies / SPEED_OF_LIGHT)[chan])


def test_two_fields_at_a_third_centre_hold_one_sky(tmp_path):
    """Against the explicit sum over the components, with directions from spherical trigonometry."""
    fields, centre = (CYGNUS_A, "J2000 19h59m40s +40d40m02s"), "J2000 19h59m31s +40d45m00s"
    name = simulate(tmp_path / "a.ms", configuration="b", fields=fields, sky=SKY)
    vis = read(name, phasecenter=centre)
    flux, lmn = direction_cosines((fields[0], centre), SKY)
    u, v, w = vis.uvw[:, :, None]
    l, m, n = lmn[1]
    expected = np.exp(2j * np.pi * (u * l + v * m + w * (n - 1))) @ flux
    np.testing.assert_allclose(vis.vis, expected, atol=2e-6)
    assert len(vis.fields) == 2


def test_phase_centre_against_phaseshift(tmp_path):
    from casatasks import phaseshift

    name = simulate(tmp_path / "a.ms", configuration="b", sky=SKY, noise=0.1)
    centre = "J2000 19h59m33s +40d43m02s"
    phaseshift(name, str(tmp_path / "shifted.ms"), phasecenter=centre, datacolumn="data")
    ours, theirs = read(name, phasecenter=centre), read(tmp_path / "shifted.ms", datacolumn="data")
    assert np.array_equal(ours.row, theirs.row) and np.array_equal(ours.chan, theirs.chan)
    np.testing.assert_allclose(ours.uvw, theirs.uvw, atol=1e-6 * np.abs(ours.uvw).max())
    np.testing.assert_allclose(ours.vis, theirs.vis, atol=2e-6)
    assert np.abs(ours.vis - read(name).vis).max() > 0.5


@pytest.mark.parametrize(("frame", "tolerance"), [("ICRS", 3e-7), ("J2000", 3e-7), ("GALACTIC", 3e-6)])
def test_rotation_between_frames_against_astropy(frame, tolerance):
    """Matrix elements are products of the unit vectors of both frames, here taken from astropy.

    CASA and astropy place the galactic pole 0.4 arcsec apart.
    """
    import casatools
    from astropy.coordinates import SkyCoord

    def basis(coordinate, target):
        offset = coordinate.spherical_offsets_by
        step = 1e-4
        vectors = []
        for east, north in ((step, 0), (0, step)):
            ahead, behind = (offset(sign * east * rad, sign * north * rad).transform_to(target) for sign in (1, -1))
            difference = np.array([ahead.cartesian.xyz.value - behind.cartesian.xyz.value])[0]
            vectors.append(difference / np.linalg.norm(difference))
        return np.array([*vectors, coordinate.transform_to(target).cartesian.xyz.value])

    import astropy.units

    rad = astropy.units.rad
    names = {"ICRS": "icrs", "GALACTIC": "galactic", "J2000": "fk5"}
    field = SkyCoord(5.1, 0.7, unit="rad", frame="fk5")
    image = SkyCoord(5.1002, 0.7003, unit="rad", frame="fk5").transform_to(names[frame])
    expected = basis(image, "icrs") @ basis(field, "icrs").T
    me = casatools.measures()
    angles = image.data.lon.rad, image.data.lat.rad
    centre = me.direction(frame, *({"unit": "rad", "value": float(angle)} for angle in angles))
    found = rotation_between(me.direction("J2000", "5.1rad", "0.7rad"), centre)
    np.testing.assert_allclose(found, expected, atol=tolerance)
    np.testing.assert_allclose(found @ found.T, np.eye(3), atol=1e-13)


def test_lsrk_frequencies_against_the_ms_tool(observation):
    import casatools

    vis = read(observation, field="0", scan="1", spw="0")
    tool = casatools.ms()
    tool.open(observation)
    start = str(np.datetime64("1858-11-17T00:00:00.000") + np.timedelta64(round(vis.rows.time[0] * 1000), "ms"))
    obstime = start.replace("-", "/").replace("T", "/")
    expected = tool.cvelfreqs(spwids=[0], fieldids=[0], mode="channel", outframe="LSRK", obstime=obstime)
    tool.close()
    here = vis.rows.time[vis.row] == vis.rows.time[0]
    found = vis.uvw[0, here] / column(observation, "UVW")[0, vis.rows.row[vis.row[here]]] * SPEED_OF_LIGHT
    np.testing.assert_allclose(found, np.asarray(expected)[vis.chan[here]], rtol=1e-10)
    assert np.abs(found / (8.4e9 + 2e6 * vis.chan[here]) - 1).min() > 1e-5


def test_lsrk_factor_follows_the_measures_tool_at_every_integration(observation):
    import casatools

    vis, me = read(observation, spw="0:1"), casatools.measures()
    me.doframe(me.observatory("VLA"))
    uvw_m = column(observation, "UVW")[:, vis.rows.row]
    for time, field in {(vis.rows.time[k], vis.rows.field[k]) for k in range(vis.rows.time.size)}:
        me.doframe(me.direction(*(CYGNUS_A, NORTH)[field].split()))
        me.doframe(me.epoch("UTC", f"{float(time)!r}s"))
        frequency = me.measure(me.frequency("TOPO", "8.402e9Hz"), "LSRK")["m0"]["value"]
        here = (vis.rows.time == time) & (vis.rows.field == field)
        if field == 0:  # not rotated
            np.testing.assert_allclose(vis.uvw[0, here], uvw_m[0, here] * frequency / SPEED_OF_LIGHT, rtol=2e-11)


def tclean_products(vis, folder, **parameters):
    """Return (sum of weights, reference direction in radians, reference frequency) of tclean's dirty image."""
    import casatools
    from casatasks import tclean

    name = os.path.join(str(folder), "dirty")
    for path in Path(folder).glob("dirty.*"):
        shutil.rmtree(path)
    tclean(vis, imagename=name, imsize=64, niter=0, calcres=False, restoration=False,
           **({"cell": "1arcsec"} | parameters))
    ia = casatools.image()
    ia.open(name + ".sumwt")
    weight = float(ia.getchunk().ravel()[0])
    value = ia.coordsys().referencevalue()["numeric"]
    ia.close()
    return weight, value[:2] % (2 * np.pi), value[3]


@pytest.mark.parametrize(
    "selection",
    [
        {},
        {"field": "1", "timerange": "09:30:00~11:00:00", "observation": "0"},
        {"spw": "*:8.401~8.405GHz", "scan": "2~3", "antenna": "!A01"},
        {"uvrange": "3~10klambda", "antenna": "A00,A02&*"},
    ],
)
def test_selection_weights_and_centre_as_tclean(copied, tmp_path, selection):
    rng = np.random.default_rng(4)
    edit(copied, "FLAG", lambda old: rng.random(old.shape) < 0.05)
    edit(copied, "FLAG_ROW", lambda old: rng.random(old.shape) < 0.05)
    edit(copied, "WEIGHT", lambda old: old * rng.uniform(0.5, 2, old.shape))
    vis = read(copied, **selection)
    weight, direction, frequency = tclean_products(str(copied), tmp_path, **selection)
    np.testing.assert_allclose(2 * vis.imaging_weight.sum(dtype=float), weight, rtol=1e-6)
    centre = [vis.phase_center["m0"]["value"] % (2 * np.pi), vis.phase_center["m1"]["value"]]
    np.testing.assert_allclose(centre, direction, atol=1e-12)
    np.testing.assert_allclose(np.mean(vis.freq_range_hz), frequency, rtol=1e-7)


def test_default_centre_is_the_lowest_selected_field(copied):
    edit(copied, "FIELD_ID", lambda old: 1 - old)
    for selection, declination in (({}, "+40d44m02s"), ({"field": "1"}, "+40d45m02s"), ({"scan": "1"}, "+40d45m02s")):
        import casatools

        expected = casatools.measures().direction("J2000", "19h59m28.5s", declination)["m1"]["value"]
        assert read(copied, **selection).phase_center["m1"]["value"] == pytest.approx(expected, abs=1e-12)


def test_several_measurement_sets_are_their_union(observation, tmp_path):
    other = simulate(tmp_path / "other.ms", configuration="c", sky=SKY, noise=0.1, date="2015/09/01")
    both, first, second = read(observation, other), read(observation), read(other)
    for name in ("vis", "weight", "uvw"):
        assert np.array_equal(getattr(both, name),
                              np.concatenate([getattr(first, name), getattr(second, name)], axis=-1))
    assert np.array_equal(both.rows.ms[both.row], np.repeat([0, 1], [first.size, second.size]))
    assert both.spws == {0: (0, 1), 1: (0,)} and both.freq_range_hz[0] <= first.freq_range_hz[0]
    assert sum(str(other) in note and "CORRECTED_DATA" in note for note in both.notes) == 1


def test_selection_for_each_measurement_set(observation, tmp_path):
    other = simulate(tmp_path / "other.ms", sky=SKY, noise=0.1)
    vis = read(observation, other, scan=("1", "2"))
    assert {(ms, scan) for ms, scan in zip(vis.rows.ms.tolist(), vis.rows.scan.tolist())} == {(0, 1), (1, 2)}
    vis = read(observation, other, scan="3")
    assert set(vis.rows.ms.tolist()) == {0} and any("leaves no rows" in note and other in note for note in vis.notes)


def fingerprint(name):
    return {str(p): hashlib.sha256(p.read_bytes()).hexdigest() for p in sorted(Path(name).rglob("*")) if p.is_file()}


def test_nothing_is_written_to_the_measurement_set(copied):
    for path in Path(copied).rglob("*"):
        path.chmod(0o555 if path.is_dir() else 0o444)
    before = fingerprint(copied)
    try:
        read(copied, spw="0", phasecenter="J2000 19h59m30s +40d44m02s", uvrange=">0.1klambda")
        with pytest.raises(ValueError, match="antenna"):
            read(copied, antenna="nobody")
        assert fingerprint(copied) == before
    finally:
        for path in Path(copied).rglob("*"):
            path.chmod(0o755 if path.is_dir() else 0o644)


@pytest.mark.parametrize(
    ("selection", "message"),
    [
        ({"field": "nowhere"}, "field = 'nowhere' does not select from"),
        ({"spw": "9"}, "spw = '9' does not select from"),
        ({"spw": "1:0,0:1;3~5"}, "spw = .* channel 3 is beyond 2, the last of spw 0"),
        ({"antenna": "nobody"}, "antenna = 'nobody' does not select from"),
        ({"antenna": "A01&nobody", "field": "0"}, "antenna = 'A01&nobody' does not select from"),
        ({"timerange": "junk", "spw": "0"}, "timerange = 'junk' does not select from"),
        ({"uvrange": "junk"}, "uvrange = 'junk' does not select from"),
        ({"intent": "CALIBRATE*"}, "intent = 'CALIBRATE.' does not select from"),
        ({"scan": "77"}, "selects no data: scan = '77'"),
        ({"timerange": ">2030/1/1"}, "selects no data"),
        ({"field": "0", "scan": "2"}, "selects no data: field = '0', scan = '2'"),
        ({"scan": ("1", "2")}, "scan = .* 2 entries for 1"),
        ({"datacolumn": "model"}, "datacolumn = 'model'"),
        ({"phasecenter": "somewhere"}, "phasecenter = 'somewhere'"),
        ({"phasecenter": "7"}, "phasecenter = 7: .* fields 0 to 1"),
        ({"phasecenter": "J2000 19h59m28.5s north"}, "phasecenter = .* not an angle"),
        ({"phasecenter": "AZEL 10deg 20deg"}, "phasecenter = .* frame 'AZEL'"),
    ],
)
def test_bad_parameters(observation, selection, message):
    with pytest.raises(ValueError, match=message):
        read(observation, **selection)


def test_bad_vis(observation, tmp_path):
    with pytest.raises(ValueError, match="vis is empty"):
        read()
    with pytest.raises(FileNotFoundError, match="vis = .*nothing.ms' does not exist"):
        read(tmp_path / "nothing.ms")
    (tmp_path / "file.ms").write_text("not a table")
    with pytest.raises(ValueError, match="file.ms' is a file"):
        read(tmp_path / "file.ms")
    (tmp_path / "junk.ms").mkdir()
    with pytest.raises(ValueError, match="junk.ms' is a directory, but not a MeasurementSet"):
        read(observation, tmp_path / "junk.ms")
    (tmp_path / "junk.ms/table.dat").write_text("not a table")
    with pytest.raises(ValueError, match="junk.ms' cannot be opened"):
        read(tmp_path / "junk.ms")
    with pytest.raises(ValueError, match="FIELD' is a CASA table, but not a MeasurementSet"):
        read(observation + "/FIELD")
    with pytest.raises(ValueError, match="stokes = 'RR'"):
        read_visibilities(Selection(vis=(observation,)), stokes="RR")


def test_measurement_set_without_rows(observation, tmp_path):
    import casatools

    tb = casatools.table()
    tb.open(observation)
    tb.copy(str(tmp_path / "empty.ms"), deep=True, norows=True).close()
    tb.close()
    with pytest.raises(ValueError, match="empty.ms' is a MeasurementSet without rows"):
        read(tmp_path / "empty.ms")


@pytest.mark.parametrize(
    ("col", "change", "message"),
    [
        ("FLAG_ROW", np.ones_like,
         "no usable visibilities: .*1008 samples|no usable visibilities: .* left out as flagged row"),
        ("WEIGHT", np.zeros_like, "no usable visibilities: .* left out as non-positive weight"),
        ("UVW", lambda old: old * np.nan, "no usable visibilities: .* left out as non-finite uvw"),
        ("ANTENNA1", np.zeros_like, None),
    ],
)
def test_nothing_usable(copied, col, change, message):
    edit(copied, col, change)
    if col == "ANTENNA1":
        edit(copied, "ANTENNA2", np.zeros_like)
        message = "no usable visibilities: .* left out as autocorrelation"
    with pytest.raises(ValueError, match=message):
        read(copied)


def test_missing_and_single_dish_data(copied, tmp_path):
    remove_columns(copied, "CORRECTED_DATA", "DATA")
    with pytest.raises(ValueError, match="neither CORRECTED_DATA nor DATA"):
        read(copied)
    add_column(copied, "FLOAT_DATA", None, like="SIGMA")
    with pytest.raises(ValueError, match="single-dish"):
        read(copied)


def test_data_column_without_data(tmp_path):
    name = simulate(tmp_path / "a.ms", antennas=4, scans=1)
    add_column(name, "CORRECTED_DATA", None)
    with pytest.raises(ValueError, match="CORRECTED_DATA column of .* is empty"):
        read(name)


def test_stokes_i_not_formable(tmp_path):
    name = simulate(tmp_path / "a.ms", antennas=4, scans=1, correlations="RL LR")
    with pytest.raises(ValueError, match="stokes = 'I' cannot be formed from the correlations RL, LR of spw 0"):
        read(name)


def test_moving_field_is_refused(copied):
    add_ephemeris = np.array([-1, 3])
    import casatools

    tb = casatools.table()
    tb.open(str(copied) + "/FIELD", nomodify=False)
    tb.addcols({"EPHEMERIS_ID": tb.getcoldesc("SOURCE_ID")})
    tb.putcol("EPHEMERIS_ID", add_ephemeris)
    tb.close()
    with pytest.raises(ValueError, match=r"vis = .*: field \[1\] \(FIELD1\) moves on the sky"):
        read(copied)


def test_unknown_observatory_is_the_first_antennas_place(copied):
    edit(str(copied) + "/OBSERVATION", "TELESCOPE_NAME", lambda old: np.array(["NONESUCH"]))
    vis, known = read(copied), None
    edit(str(copied) + "/OBSERVATION", "TELESCOPE_NAME", lambda old: np.array(["VLA"]))
    known = read(copied)
    assert vis.observatory == "NONESUCH"
    np.testing.assert_allclose(vis.uvw, known.uvw, rtol=1e-7)


@pytest.fixture(scope="module")
def real(tmp_path_factory):
    """Return a function that unpacks a real MeasurementSet."""
    folder = tmp_path_factory.mktemp("real")

    def unpack(name):
        archive = SHARED / "ms" / f"{name}.ms.tgz"
        if not archive.exists():
            pytest.skip(f"{archive} is not there")
        with tarfile.open(archive) as packed:
            packed.extractall(folder, filter="data")
        return str(folder / f"{name}.ms")

    return unpack


@pytest.mark.parametrize(
    ("name", "hands"),
    [("VLA_3C273_X", (0, 3)), ("EHT_M87_2017_101_selfcal", (0, 1))],
)
def test_real_data(real, tmp_path, name, hands):
    ms = real(name)
    before = fingerprint(ms)
    vis = read(ms)
    assert fingerprint(ms) == before
    assert_same_samples(vis, explicit_samples(ms, hands, "DATA", weight_spectrum=True)[0])
    cell = f"{np.degrees(1 / vis.max_uv / 4) * 3600:.9f}arcsec"
    weight, direction, frequency = tclean_products(ms, tmp_path, cell=cell)
    np.testing.assert_allclose(2 * vis.imaging_weight.sum(dtype=float), weight, rtol=1e-5)
    centre = [vis.phase_center["m0"]["value"] % (2 * np.pi), vis.phase_center["m1"]["value"]]
    np.testing.assert_allclose(centre, direction, atol=1e-12)
    np.testing.assert_allclose(np.mean(vis.freq_range_hz), frequency, rtol=1e-7)
