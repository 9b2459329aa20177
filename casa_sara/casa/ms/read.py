"""Visibilities of Stokes parameters out of MeasurementSets."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from casa_sara.casa.ms.frames import Geometry, image_direction, is_of_earth, on_sky, separation
from casa_sara.casa.ms.integrity import reading
from casa_sara.casa.ms.selection import UNPOLARISED, select_data
from casa_sara.casa.ms.table_cells import read_slice
from casa_sara.casa.ms.usable_samples import IN_FLAGS, LIGHTEST, SMALLEST, Usability
from casa_sara.casa.runtime.tools import opened
from casa_sara.data.visibilities import RowTable, Visibilities
from casa_sara.parallel.partition import ALONE
from casa_sara.runtime.scratch import IN_MEMORY

__all__ = ["read_visibilities"]

STOKES = ("I", "Q", "U", "V")
_CHUNK = 400_000  # complex numbers read at a time
_WIDEST_BEAM = 10.0  # degrees; no field is farther from the image's centre
_ROW_COLUMNS = {
    "time": "TIME",
    "interval": "INTERVAL",
    "scan": "SCAN_NUMBER",
    "observation": "OBSERVATION_ID",
    "field": "FIELD_ID",
    "antenna1": "ANTENNA1",
    "antenna2": "ANTENNA2",
}
_SAMPLE_DTYPES = {"vis": np.complex64, "weight": np.float32, "imaging_weight": np.float32, "uvw": np.float64,
                  "row": np.int32,
                  "chan": np.int16, "freq_hz": np.float32}
_ROW_DTYPES = {"time": np.float64, "interval": np.float64, "ms": np.int16, "spw": np.int16, "row": np.int64,
               "hands": np.int8}


def read_visibilities(selection, phasecenter="", stokes="I", frequencies=False, ranks=ALONE, scratch=IN_MEMORY):
    """Read, select, flag, combine to Stokes parameters and turn to one phase centre.

    V_I = (V_RR + V_LL)/2, or (V_XX + V_YY)/2, or the one parallel-hand correlation there is, and as tclean (of
    circular, or of linear feeds)

        V_Q = (V_RL + V_LR)/2,  (V_XX − V_YY)/2;    V_U = (V_RL − V_LR)/2i,  (V_XY + V_YX)/2;
        V_V = (V_RR − V_LL)/2,  (V_XY − V_YX)/2i;

    where the Stokes parameter itself is stored, it is used as it is.

    A sample is left out when any of its correlations is flagged (cross-hands too, as in tclean), when its row is
    flagged or an autocorrelation, and when data, weights or uvw cannot be used; what was left out is counted by the
    first reason that applies. Weights are, row by row, WEIGHT_SPECTRUM where it is filled, else WEIGHT, whatever the
    data column (as in tclean). Where one parallel-hand correlation has no weight (0, negative or NaN), Stokes I is the
    other one, with its weight; tclean takes the mean of both there. Of several Stokes parameters a sample has all, or
    is left out.

    The inverse variance of Re V_I and of Im V_I follows from those of the correlations:
    Var(V_I) = (1/w_RR + 1/w_LL)/4, hence w = 4/(1/w_RR + 1/w_LL), when CASA's
    WEIGHT = 1/SIGMA² with SIGMA the scatter of the real and of the imaginary part. The same holds for Q, U and V of
    theirs. tclean's imaging weight is the mean of those of the first and the last correlation, in the order of the
    MeasurementSet and whatever the Stokes parameter: of RR, RL, LR, LL the mean of RR and LL.

    The MeasurementSets are opened read-only and stay as they are, byte by byte.

    Parameters
    ----------
    selection : casa_sara.options.Selection
        The MeasurementSets and the data selected in them.
    phasecenter : str or int
        Image centre, as in tclean; '' is that of the first selected field.
    stokes : str
        'I', 'Q', 'U' or 'V', or several of them, as 'IQUV'.
    frequencies : bool
        Keep the frequency of each sample.
    ranks : casa_sara.parallel.partition.RankAssignment
        The ranks that read, each its rows: what is returned is this rank's, but the counts, notes and frequencies are
        of all.
    scratch : casa_sara.runtime.scratch.Scratch
        Where the samples go.

    Returns
    -------
    Visibilities

    Raises
    ------
    ValueError, FileNotFoundError
        When there is nothing to image, or what was asked for is not in the data.
    """
    if not stokes or not set(stokes) <= set(STOKES):
        raise ValueError(f"stokes = '{stokes}' cannot be imaged: should be one of {', '.join(STOKES)}, or some of them")
    selected, notes = select_data(selection, stokes)
    image = image_direction(phasecenter, selected)
    _check_directions(phasecenter, image, selected)
    comm = ranks.comm
    table, ranges = comm.together(_read_all, selected, image, _own_pieces(selected, ranks), frequencies, scratch,
                                  len(stokes) - 1)
    ranges = np.concatenate(comm.allgather(ranges))
    data = table.usable_visibilities(comm)
    usable, size = table.usable, comm.total(data.size)
    rows_of = comm.allreduce(np.bincount(data.rows.ms, minlength=len(selection.vis)))
    unused = [f"'{ms.name}' has no usable visibilities and is not imaged" for ms in selected if not rows_of[ms.number]]
    if size == 0:
        raise ValueError(f"vis: {', '.join(selection.vis)} has no usable visibilities: {_counts(usable.dropped)}")
    if usable.strongest < SMALLEST:
        raise ValueError(f"datacolumn = '{selection.datacolumn}': all {size} usable visibilities of "
                         f"{', '.join(selection.vis)} are zero: the column may never have been filled")
    return replace(
        data,
        ms_names=tuple(selection.vis),
        dropped=usable.dropped,
        alone=usable.alone,
        notes=notes + unused + _notes(selected, usable),
        phase_center=image,
        freq_range_hz=(float(ranges[:, 0].min()), float(ranges[:, 1].max())),
        spws={ms.number: tuple(sorted({group.spw for group in ms.groups})) for ms in selected},
        observatory=selected[0].observatory,
        fields={(ms.number, number): on_sky(direction, ms, ms.start_s)
                for ms in selected for number, direction in ms.fields.items()},
        mixed_weights=any(0 < sum(group.has("WEIGHT_SPECTRUM", group.rows).sum() for group in ms.groups)
                          < sum(group.rows.size for group in ms.groups) for ms in selected),
    )


def _read_all(selected, image, pieces, frequencies, scratch, further):
    """Return the table of the samples in these pieces, and the frequencies of each MeasurementSet."""
    most = sum(rows.size * group.channels.size for ms in selected for number, group in enumerate(ms.groups)
               for rows in pieces[ms.number, number])
    table, ranges = _SampleTable(frequencies, scratch, most, further), []
    for ms in selected:
        geometry = Geometry(ms, image)
        with reading(ms.name), opened("table", ms.name) as tb:
            for number, group in enumerate(ms.groups):
                for chunk in _chunks(tb, ms, group, pieces[ms.number, number]):
                    table.add(chunk, ms, group, geometry)
        ranges.append(tuple(geometry.freq_range_hz))
    return table, ranges


def _own_pieces(selected, ranks):
    """Return the rows of each group, in pieces, that this rank reads: an equal share of the samples, in order."""
    pieces = [((ms.number, number), rows, rows.size * group.channels.size)
              for ms in selected for number, group in enumerate(ms.groups) for rows in _pieces(group)]
    sizes = np.array([size for *_, size in pieces])
    reader = ((np.cumsum(sizes) - sizes / 2) * ranks.readers / sizes.sum()).astype(int)
    own = {key: [] for key, *_ in pieces}
    for (key, rows, _), number in zip(pieces, reader):
        if number == ranks.reader(ranks.comm.rank):
            own[key].append(rows)
    return own


def _pieces(group):
    """Yield the rows of a group, as many as are read at a time."""
    count = max(1, _CHUNK // (int(np.ptp(group.channels) + 1) * len(group.correlations)))
    for start in range(0, group.rows.size, count):
        yield group.rows[start : start + count]


@dataclass
class _Chunk:
    """R rows, C channels: `vis` and `weight` hold an (R, C) array per correlation, `weighing` tclean's two weights.

    `either` is that of the RowGroup; `undefined` says of which rows (bool (R,)) a cell of DATA, FLAG or WEIGHT is not
    there.
    """

    rows: np.ndarray
    columns: dict[str, np.ndarray]
    uvw_m: np.ndarray
    vis: list[np.ndarray]
    weight: list[np.ndarray]
    weighing: list[np.ndarray]
    flag: np.ndarray
    flag_row: np.ndarray
    either: bool
    undefined: dict[str, np.ndarray]


def _chunks(tb, ms, group, pieces):
    """Read the rows of a group in pieces."""
    for rows in pieces:
        part = tb.selectrows(rows.tolist())
        try:
            yield _read(part, rows, ms.column, group)
        except RuntimeError as error:
            raise RuntimeError(f"rows {rows[0]} to {rows[-1]}: {error}") from error
        finally:
            part.close()


def _read(part, rows, column, group):
    """Read one piece."""
    first = group.channels[0]
    low, high = [0, int(first)], [len(group.correlations) - 1, int(group.channels[-1])]

    def planes(name, dtype):
        cells = read_slice(part, name, group.has(name, rows), low, high, dtype)
        return [plane[group.channels - first].T for plane in cells]

    spectra = group.has("WEIGHT_SPECTRUM", rows)
    weight = planes("WEIGHT_SPECTRUM", float)
    if not spectra.all():
        of_rows = read_slice(part, "WEIGHT", ~spectra & group.has("WEIGHT", rows), low[:1], high[:1], float)
        weight = [np.where(spectra[:, None], plane, row[:, None]) for plane, row in zip(weight, of_rows)]
    vis, of_hands = planes(column, complex), [weight[hand] for hand in group.hands]
    undefined = {column: ~group.has(column, rows), "FLAG": ~group.has("FLAG", rows),
                 "WEIGHT": ~spectra & ~group.has("WEIGHT", rows)}
    return _Chunk(
        rows=rows,
        columns={name: part.getcol(of_ms) for name, of_ms in _ROW_COLUMNS.items()},
        uvw_m=part.getcol("UVW"),
        vis=[vis[hand] for hand in group.hands],
        weight=of_hands,
        weighing=of_hands if group.weighing == group.hands else [weight[hand] for hand in group.weighing],
        flag=np.any(planes("FLAG", bool), axis=0),
        flag_row=part.getcol("FLAG_ROW"),
        either=group.either,
        undefined={name: where for name, where in undefined.items() if where.any()},
    )


class _SampleTable:
    """The usable samples of all chunks so far."""

    def __init__(self, frequencies, scratch, most, further=0):
        self.usable, self._scratch = Usability(), scratch
        self._size = self._rows_so_far = 0
        self._alone = []
        size = most if scratch.on_disk else 0
        shapes = dict.fromkeys(_SAMPLE_DTYPES, (size,)) | dict(uvw=(3, size))
        shapes |= dict(further_vis=(further, size), further_weight=(further, size)) if further else {}
        if not frequencies:
            del shapes["freq_hz"]
        self._samples = {name: [scratch.empty(shape, self._dtype(name))] for name, shape in shapes.items()}
        self._rows = {name: [np.empty(0, _ROW_DTYPES.get(name, np.int32))] for name in RowTable.__dataclass_fields__}

    @staticmethod
    def _dtype(name):
        """Return the type of a column of the samples; those of further Stokes parameters are as of the first."""
        return _SAMPLE_DTYPES[name.removeprefix("further_")]

    def add(self, chunk, ms, group, geometry):
        """Whiten, turn and append the usable samples of a chunk."""
        ok, weighted = self.usable(chunk)
        columns = chunk.columns
        kept = ok.any(axis=1)
        uvw, shift = geometry.wavelengths(group, columns["field"], columns["time"], np.where(kept, chunk.uvw_m, 0.0))
        (vis, weight, alone), *further = [_formed(chunk, form, ok, weighted) for form in group.forms]
        self._alone += [(group.correlations[hand], self._size + np.flatnonzero(here))
                        for hand, here in zip(group.hands, alone) if here.any()]
        if shift is not None:
            for one in (vis, *(one for one, *_ in further)):
                one *= np.exp(-2j * np.pi * shift[ok])
        hands = len(group.forms[0][0])
        number = self._rows_so_far + np.cumsum(kept) - 1
        channel = np.broadcast_to(group.channels, ok.shape)
        new = {
            "vis": vis,
            "weight": weight,
            "imaging_weight": _imaging_weight([hand[ok] for hand in chunk.weighing], alone, weight / hands),
            "uvw": np.array([axis[ok] for axis in uvw]),
            "row": np.repeat(number, ok.sum(axis=1)),
            "chan": channel[ok],
        }
        if further:
            new |= {"further_vis": np.array([one for one, *_ in further]),
                    "further_weight": np.array([one for _, one, _ in further])}
        if "freq_hz" in self._samples:
            new["freq_hz"] = geometry.frequencies(group, columns["field"], columns["time"])[ok]
        self._append(new)
        of_group = {name: np.full(kept.size, value)
                    for name, value in (("ms", ms.number), ("spw", group.spw), ("hands", hands))}
        for name, values in (columns | of_group | {"row": chunk.rows}).items():
            self._rows[name].append(values[kept].astype(_ROW_DTYPES.get(name, np.int32)))
        self._rows_so_far += int(kept.sum())
        self._size += vis.size

    def _append(self, new):
        """Append samples: to a list of chunks, or to what is on the disk."""
        if not self._scratch.on_disk:
            for name, values in new.items():
                self._samples[name].append(values.astype(self._dtype(name), copy=False))
            return
        for name, values in new.items():
            self._samples[name][0][..., self._size : self._size + values.shape[-1]] = values
        self._scratch.let_go()

    def usable_visibilities(self, comm):
        """Join the chunks, leave out what is out of proportion to all others, and add up the counts of all ranks."""
        # one column after the other, to keep the peak of memory low
        if self._scratch.on_disk:
            samples = {name: lists.pop()[..., : self._size] for name, lists in self._samples.items()}
        else:
            samples = {name: _join(self._samples, name) for name in tuple(self._samples)}
        rows = {name: _join(self._rows, name) for name in tuple(self._rows)}
        data = Visibilities(**samples, rows=RowTable(**rows), scratch=self._scratch)
        ok = self.usable.compare(data, comm)
        self.usable.count_alone((name, np.count_nonzero(ok[index])) for name, index in self._alone)
        data = data if ok.all() else data.part(np.flatnonzero(ok))
        for number in range(1, data.n_stokes):
            ok = self.usable.compare(data.of_stokes(number), comm)
            data = data if ok.all() else data.part(np.flatnonzero(ok))
        self.usable.merge(comm)
        return data


def _formed(chunk, form, ok, weighted):
    """Return the Stokes parameter of the samples that are `ok`, its inverse variance, and where it is one correlation.

    `form` is that of the RowGroup.

    Returns
    -------
    vis, weight : (M,)
    alone : list of bool (M,)
        For each correlation, where it alone has a weight.
    """
    hands, sign, divisor = form
    vis, weight = ([of_hands[hand][ok] for hand in hands] for of_hands in (chunk.vis, chunk.weight))
    if len(vis) == 1:
        return vis[0], weight[0], []
    with np.errstate(divide="ignore", invalid="ignore"):
        formed, total = (vis[0] + sign * vis[1]) / divisor, 4 / (1 / weight[0] + 1 / weight[1])
    alone = [~weighted[hand][ok] for hand in reversed(hands)]
    for here, one, its_weight in zip(alone, vis, weight):
        formed[here], total[here] = one[here], its_weight[here]
    return formed, total, alone


def _imaging_weight(weighing, alone, otherwise):
    """Return the mean of tclean's two weights, or `otherwise`, the weight by the noise, where one is not usable."""
    unusable = np.any([*alone, *(~(weight >= LIGHTEST) for weight in weighing)], axis=0)
    return np.where(unusable, otherwise, sum(weighing) / len(weighing))


def _join(lists, name):
    """Take a list of arrays out of `lists` and concatenate it along the last axis."""
    return np.concatenate(lists.pop(name), axis=-1)


def _check_directions(phasecenter, image, selected):
    """Raise when a field is elsewhere on the sky."""
    for ms in selected:
        for number, direction in ms.fields.items():
            apart = np.degrees(separation(on_sky(direction, ms, ms.start_s), image))
            if apart > _WIDEST_BEAM:
                raise ValueError(f"phasecenter = '{phasecenter}': field {number} of '{ms.name}' is {apart:.3g} degrees "
                                 f"from the centre of the image: should be within {_WIDEST_BEAM:g}; choose fields with "
                                 "field")


def _counts(dropped):
    """Spell the dropped samples for a message."""
    return ", ".join(f"{count} samples left out as {reason}" for reason, count in dropped.items())


def _notes(selected, usable):
    """Return warnings about the data."""
    notes = [f"{count} samples use {name} alone, because the other correlation has no weight: {UNPOLARISED}"
             for name, count in usable.alone.items()]
    unusable = {reason: count for reason, count in usable.dropped.items() if reason not in IN_FLAGS}
    if unusable:
        notes.append(f"unflagged visibilities are not usable: {_counts(unusable)}")
    notes += [f"field {number} of '{ms.name}' is in {direction['refer']}: its direction on the sky is "
              "computed for every integration"
              for ms in selected for number, direction in ms.fields.items() if is_of_earth(direction)]
    return notes
