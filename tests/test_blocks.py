"""Blocks that the user selects, and the blocks that are pointed out:
against the columns of the data and the noise put in."""

import numpy as np
import pytest
from simulated_ms import CYGNUS_A, column, edit, simulate

casatools = pytest.importorskip("casatools")

from casa_sara import tsara
from casa_sara.casa.ms.block_selection import divide, parsed
from casa_sara.casa.ms.read import read_visibilities
from casa_sara.data.visibilities import BlockInfo
from casa_sara.imaging.data_quality import suspects
from casa_sara.options import Selection

CELL_RAD = np.radians(1.0 / 3600)
NOISE, WORSE = 0.05, 10.0


@pytest.fixture(scope="module")
def vis(tmp_path_factory):
    """Two MeasurementSets; of scan 2 of the first, the second half is ten times noisier than its weights say."""
    folder = tmp_path_factory.mktemp("ms")
    names = [simulate(folder / f"{number}.ms", configuration="c", antennas=14, scans=3, integration=10.0, noise=NOISE,
                      scan_seconds=120.0, spws=(("8.4GHz", "2MHz", 2), ("8.5GHz", "2MHz", 2)), hour_angle=-1.0 - number,
                      sky=[(0.2, 6 * CELL_RAD, 4 * CELL_RAD)], seed=number, fields=(CYGNUS_A,)) for number in range(2)]
    rng, bad = np.random.default_rng(9), _bad(names[0])
    edit(names[0], "DATA", lambda data: data + bad * NOISE * np.sqrt(WORSE**2 - 1) * (
        rng.standard_normal(data.shape) + 1j * rng.standard_normal(data.shape)))
    return names


def _bad(name):
    time, scan = column(name, "TIME"), column(name, "SCAN_NUMBER")
    return (scan == 2) & (time > np.median(time[scan == 2]))


def clock_range(name, rows):
    """The time range of rows, in the words of the data selection."""
    time = column(name, "TIME")[rows]
    ends = [np.datetime64("1858-11-17") + np.timedelta64(round(1000 * (t + step)), "ms")
            for t, step in ((time.min(), -4),
                                                                                                          (time.max(),
                                                                                                           4))]
    return "~".join(str(end).replace("-", "/").replace("T", "/") for end in ends)


def read(vis):
    return read_visibilities(Selection(tuple(vis), datacolumn="data"))


@pytest.mark.parametrize("entries, expected", [
    (("scan=3",), lambda rows: [rows["scan"] == 3]),
    (("vis=1 scan=1,3",), lambda rows: [(rows["ms"] == 1) & (rows["scan"] != 2)]),
    (("spw=1", "scan=2"), lambda rows: [rows["spw"] == 1, (rows["spw"] == 0) & (rows["scan"] == 2)]),
    (("spw=0:1 vis=1",), lambda rows: [(rows["ms"] == 1) & (rows["spw"] == 0) & (rows["chan"] == 1)]),
    (("vis=0", "antenna=A03"),
     lambda rows: [rows["ms"] == 0, (rows["ms"] == 1) & ((rows["one"] == 3) | (rows["two"] == 3))]),
])
def test_entries_set_apart_what_they_name(vis, entries, expected):
    data = read(vis)
    table = data.rows
    rows = {name: values[data.row] for name, values in dict(
        ms=table.ms, scan=table.scan, spw=table.spw, one=table.antenna1,
        two=table.antenna2).items()} | dict(chan=data.chan)
    block, infos = divide(data, entries)
    apart = expected(rows)
    for named in (*apart, ~np.any(apart, axis=0)):
        blocks = np.unique(block[named])
        assert named.any() and not np.isin(block[~named], blocks).any()
        # in snapshots of their own: one for each scan of a MeasurementSet
        pairs = np.unique(np.array([rows["ms"], rows["scan"]])[:, named], axis=1).shape[1]
        assert len(blocks) == (pairs if named.sum() >= 500 * pairs else 1)  # what is too small is joined
    assert np.array_equal(np.bincount(block), [info.samples for info in infos])
    by_default = divide(data, 0)
    assert len(by_default[1]) == 6


@pytest.mark.parametrize("entry, message", [
    ("scan=99", "blocks = 'scan=99' selects no visibility that is imaged: should be a number, or a list of entries as"),
    ("vis=7", "blocks = 'vis=7' selects no visibility"),
    ("antenna=nobody", "blocks = 'antenna=nobody': antenna = 'nobody' does not select from"),
])
def test_entries_that_name_nothing_are_refused(vis, entry, message):
    with pytest.raises(ValueError, match=message):
        divide(read(vis), ("scan=1", entry))


def test_an_entry_inside_an_earlier_one_is_refused(vis):
    with pytest.raises(ValueError,
                       match="blocks = 'scan=1' selects only visibilities that earlier entries have selected"):
        divide(read(vis), ("vis=0~1 scan=1~2", "scan=1"))


@pytest.mark.parametrize("entry", ["", "3", "scan", "scan=", "scan=1 scan=2", "x scan=1", "vis=a", "vis=1~", "pol=2"])
def test_entries_that_are_none_are_refused_before_anything_is_read(vis, entry):
    with pytest.raises(ValueError, match="blocks = '.*': (vis )?should be"):
        tsara(vis=vis, imagename="x", imsize=32, cell="1arcsec", blocks=["scan=1", entry], dryrun=True)


def test_words_of_an_entry():
    assert parsed(" vis=0,2  timerange=09:14:00~09:20:00 spw=0:1~3;5") == {
        "vis": "0,2", "timerange": "09:14:00~09:20:00", "spw": "0:1~3;5"}


def test_a_bad_stretch_of_time_gets_its_own_bound_and_is_named(vis):
    """Within 10 % of the noise put in, elsewhere as the weights say; without the entry it spoils its whole scan."""
    common = dict(vis=vis[0], imsize=64, cell="1arcsec", datacolumn="data", wavelets=["dirac"], nthreads=1, niter=400)
    when = clock_range(vis[0], _bad(vis[0]))
    record = tsara(imagename="x", blocks=f"timerange={when}", **common)["sara"]
    found = [block["noise_found"] for block in record["blocks"]]
    assert len(found) == 4 and found[-1] == pytest.approx(WORSE, rel=0.1)
    assert found[:-1] == pytest.approx([1, 1, 1], rel=0.1)
    (suspect,) = record["suspects"]
    assert suspect["block"] == 3 and suspect["reason"] == "thermal noise" and suspect["others"] == pytest.approx(1,
                                                                                                                 rel=0.1)
    whole = tsara(imagename="y", **common)["sara"]["blocks"]
    assert len(whole) == 3 and whole[1]["noise_found"] == pytest.approx(np.sqrt((1 + WORSE**2) / 2), rel=0.15)


def blocks_of(names, samples=1000):
    return [BlockInfo(name, (0,), (k,), 0.0, 1.0, samples) for k, name in enumerate(names)]


def found_by(found, measured, names):
    """The suspects of noise levels that the adaptation found."""
    blocks = blocks_of(names)
    return [(one["block"], one["reason"]) for one in suspects(blocks, measured, np.asarray(found) * np.sqrt(2000.0))]


def test_what_is_suspect():
    calm = np.ones(6)
    same, two = ["a"] * 6, ["a"] * 3 + ["b"] * 3
    assert found_by(calm, calm, same) == []
    assert found_by([1, 1, 3.1, 1, 1, 1], calm, same) == [(2, "errors")]
    assert found_by([1, 1, 2.9, 1, 1, 1], calm, same) == []
    # wrong weights alone, everywhere, or calibration errors that go with the configuration, are no news
    assert found_by(5 * calm, 5 * calm, same) == []
    assert found_by([1, 1.2, 1.1, 6, 5, 8], calm, two) == []
    # the noise of a whole MeasurementSet of one block, where nothing can be measured, against the others
    assert found_by([1, 1, 1, 4], [np.nan] * 4, ["a", "b", "c", "d"]) == [(3, "errors")]
    # thermal noise is compared over all of them
    found = found_by([1, 1, 1, 1, 4, 4], [1, 1, 1, 1, 4, 4], ["a"] * 4 + ["b"] * 2)
    assert found == [(4, "thermal noise"), (5, "thermal noise")]
    assert found_by([7], [7], ["a"]) == []
    # far below what the weights say: three times the others, and still within the weights
    assert found_by([0.1, 0.1, 0.1, 0.4], [0.1, 0.1, 0.1, 0.4], ["a"] * 4) == []
