"""What is weighed least does not decide what is impossible, and neither do the order of the rows or how they are
read."""

import shutil
import threading

import numpy as np
import pytest

casatools = pytest.importorskip("casatools")

from simulated_ms import column, edit, pixels
from spoiled import ARCSEC, observe

from casa_sara import tsara
from casa_sara.casa.ms import read as reader
from casa_sara.casa.ms.usable_samples import Usability
from casa_sara.options import Selection
from casa_sara.parallel.serial import Serial

HEAVY_ROW, STRONG_ROW = 7, 19  # among the good rows


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    return observe(tmp_path_factory.mktemp("ms") / "whole.ms", antennas=10)  # 540 rows, three channels


@pytest.fixture
def copy(whole, tmp_path):
    return shutil.copytree(whole, tmp_path / "copy.ms")


def junk_rows(name, which, share):
    """Return which rows are junk, bool (R,)."""
    size = column(name, "TIME").size
    if which == "at random":
        return np.random.default_rng(1).random(size) < share
    if which == "the first ones":
        return np.arange(size) < share * size
    antennas = round(10 * (1 - np.sqrt(1 - share)))  # of these
    return np.minimum(column(name, "ANTENNA1"), column(name, "ANTENNA2")) < antennas


def add_junk(name, rows, factor, level=10.0):
    """Spoil rows, and weigh them down."""
    rng = np.random.default_rng(2)

    def spoil(data):
        noise = rng.standard_normal((2, *data.shape))
        return data + np.where(rows, level * (noise[0] + 1j * noise[1]), 0)

    edit(name, "DATA", spoil)
    edit(name, "WEIGHT", lambda weight: np.where(rows, factor * weight, weight))


def change(name, col, where, value):
    values = column(name, col)
    values[where] = value
    edit(name, col, lambda old: values)


def spoil_two(name, junk):
    """Make the weight of a good row 1e12 times too large, and one visibility 1e30 Jy; return the rows."""
    heavy, strong = np.flatnonzero(~junk)[[HEAVY_ROW, STRONG_ROW]]
    change(name, "WEIGHT", (..., heavy), 2.5e15)
    change(name, "DATA", (0, 1, strong), 1e30)
    return heavy, strong


def read(*names):
    return reader.read_visibilities(Selection(tuple(map(str, names)), datacolumn="data"))


def samples(data):
    """Return what there is of each sample that was kept, in an order of its own."""
    rows, row = data.rows, data.row
    table = np.column_stack([rows.time[row], rows.antenna1[row], rows.antenna2[row], data.chan, data.vis.real,
                             data.vis.imag,
                             data.weight, data.imaging_weight])
    return table[np.lexsort(table.T[3::-1])]


@pytest.mark.parametrize("share, which",
                         [(0.6, "at random"), (0.9, "at random"), (0.9, "the first ones"), (0.7, "by antenna")])
@pytest.mark.parametrize("factor", [1e-5, 1e-8, 1e-14, 1e-30])
def test_no_good_sample_is_left_out(copy, share, which, factor):
    junk = junk_rows(copy, which, share)
    add_junk(copy, junk, factor)
    data = read(copy)
    # where the junk itself is
    assert {"impossible weight", "impossible data"}.isdisjoint(data.dropped) or factor == 1e-30
    assert np.count_nonzero(~junk[data.rows.row[data.row]]) == 3 * np.count_nonzero(~junk)


@pytest.mark.parametrize("factor", [1.0, 1e-8, 1e-14])
def test_what_is_impossible_is_found_among_them(copy, factor):
    junk = junk_rows(copy, "at random", 0.8)
    add_junk(copy, junk, factor)
    heavy, strong = spoil_two(copy, junk)
    data = read(copy)
    assert data.dropped == {"impossible weight": 3, "impossible data": 1}
    rows = data.rows.row[data.row]
    assert heavy not in rows and np.count_nonzero(rows == strong) == 2


def test_strong_data_are_believed_beside_junk(copy):
    edit(copy, "DATA", lambda data: data * 1e12)
    add_junk(copy, junk_rows(copy, "at random", 0.8), 1e-20, 1e12)
    assert not read(copy).dropped


def rewritten(name, rows, path):
    """Return a MeasurementSet of these rows, in this order."""
    tb = casatools.table()
    tb.open(str(name))
    part = tb.selectrows(rows.tolist())
    part.copy(str(path), deep=True).close()
    part.close()
    tb.close()
    return path


@pytest.mark.parametrize("factor", [1.0, 1e-8])
def test_neither_order_nor_pieces_nor_measurement_sets_matter(copy, tmp_path, monkeypatch, factor):
    junk = junk_rows(copy, "at random", 0.6)
    add_junk(copy, junk, factor)
    spoil_two(copy, junk)
    usual = read(copy)
    order = np.random.default_rng(3).permutation(junk.size)
    ways = {"shuffled": [rewritten(copy, order, tmp_path / "shuffled.ms")],
            "junk first": [rewritten(copy, np.argsort(~junk, kind="stable"), tmp_path / "first.ms")],
            "apart": [rewritten(copy, np.flatnonzero(junk == which), tmp_path / f"{which}.ms")
                      for which in (False, True)]}
    for chunk in (150, 10**7):
        monkeypatch.setattr(reader, "_CHUNK", chunk)
        for way, names in (ways | {"as it was": [copy]}).items():
            data = read(*names)
            assert data.dropped == usual.dropped, (way, chunk)
            np.testing.assert_array_equal(samples(data), samples(usual))


class Ranks(Serial):
    """One of several threads that speak to each other as the ranks of an MPI job do."""

    def __init__(self, rank, barrier, values):
        self.rank, self.size, self._barrier, self._values = rank, barrier.parties, barrier, values

    def allgather(self, value):
        self._barrier.wait()
        self._values[self.rank] = value
        self._barrier.wait()
        return list(self._values)

    def allreduce(self, array):
        return np.sum(self.allgather(array), axis=0)

    def total(self, number):
        return sum(self.allgather(number))

    def largest(self, number):
        return max(self.allgather(number))

    def median(self, values):
        return np.median(np.concatenate(self.allgather(values)))


def test_ranks_do_not_matter(copy):
    """One has the junk, one what is impossible and a few others, one nothing."""
    junk = junk_rows(copy, "at random", 0.6)
    add_junk(copy, junk, 1e-8)
    clean = read(copy)
    good = np.flatnonzero(~junk[clean.rows.row[clean.row]])
    clean.weight[good[:3]], clean.vis[good[9]] = 1e15, 1e25
    parts = [np.flatnonzero(junk[clean.rows.row[clean.row]]), good[:20], good[20:], good[:0]]
    barrier, values, kept = threading.Barrier(len(parts)), [None] * len(parts), [None] * len(parts)

    def work(rank):
        usability = Usability()
        usability.strongest = 1e27 if rank == 1 else 1.0
        kept[rank] = usability.compare(clean.part(parts[rank]), Ranks(rank, barrier, values))

    threads = [threading.Thread(target=work, args=(rank,)) for rank in range(len(parts))]
    [thread.start() for thread in threads]
    [thread.join(60) for thread in threads]
    found = np.zeros(clean.size, bool)
    for part, ok in zip(parts, kept):
        found[part] = ok
    assert np.flatnonzero(~found).tolist() == [*good[:3], good[9]]


@pytest.mark.parametrize("which", ["row", "baseline", "antenna"])
def test_weights_far_above_all_others_are_of_a_few_or_of_one_antenna(copy, which):
    one, other = column(copy, "ANTENNA1"), column(copy, "ANTENNA2")
    heavy = {"row": np.arange(one.size) == 11, "baseline": (one == 2) & (other == 5),
             "antenna": (one == 4) | (other == 4)}[which]
    edit(copy, "WEIGHT", lambda weight: np.where(heavy, 1e12 * weight, weight))
    assert read(copy).dropped == {"impossible weight": 3 * np.count_nonzero(heavy)}


@pytest.mark.parametrize("decades", [4, 8, 16])
def test_weights_may_span_many_decades(copy, decades):
    rng = np.random.default_rng(4)
    edit(copy, "WEIGHT", lambda weight: weight * 10 ** rng.uniform(-decades / 2, decades / 2, weight.shape[1]))
    assert not read(copy).dropped


def test_two_arrays_of_very_different_weights_are_imaged_together(whole, copy):
    """A tenth of the samples, of other baselines, weighs 1e8 times what the others do."""
    light = [shutil.copytree(whole, copy.parent / f"light{k}.ms") for k in range(4)]
    for name in light:
        edit(name, "WEIGHT", lambda weight: 1e-8 * weight)
    data = read(copy, *light)
    assert not data.dropped and data.size == 5 * 3 * 540


@pytest.mark.parametrize("factor", [1e-6, 1e-8])
def test_the_image_is_that_of_the_good_samples(copy, factor):
    junk = junk_rows(copy, "at random", 0.6)
    add_junk(copy, junk, factor)
    made = tsara(vis=str(copy), imagename="out", niter=300, imsize=64, cell="1arcsec", datacolumn="data", nthreads=1)
    assert not made["sara"]["dropped"] and not made["sara"]["wild"]
    x, y = (32 + round(offset / ARCSEC) for offset in (5 * ARCSEC, 7 * ARCSEC))
    assert pixels("out.model")[x - 3 : x + 4, y - 3 : y + 4].sum() == pytest.approx(1, abs=0.03)
