"""The rows, channels and correlations that are selected from the MeasurementSets, and checks of them.

The selection strings go to CASA's own parser (MSSelection, the one behind tclean), so they
mean here what they mean there. Everything that can be wrong with the input is said here,
before anything is computed. Nothing is written to the MeasurementSets.
"""

from __future__ import annotations

import os
from dataclasses import dataclass, field, replace

import numpy as np

from casa_sara.casa.ms.integrity import check_measurement_set, reading
from casa_sara.casa.ms.msselect import MSSELECT_KEYS, in_words, msselect
from casa_sara.casa.ms.subtables import check_rows, readable, texts
from casa_sara.casa.ms.table_cells import lacking_cells
from casa_sara.casa.runtime.tools import opened

__all__ = ["UNPOLARISED", "RowGroup", "SelectedMS", "select_data"]

UNPOLARISED = "it is imaged as Stokes I, as if the source were unpolarised"
_DATA_COLUMNS = {"corrected": "CORRECTED_DATA", "data": "DATA", "observed": "DATA"}
_STOKES_CODES = {1: "I", 2: "Q", 3: "U", 4: "V", 5: "RR", 6: "RL", 7: "LR", 8: "LL", 9: "XX", 10: "XY", 11: "YX",
                 12: "YY"}
_PARALLEL = (5, 8, 9, 12)
_LAST_CHANNEL = 32767
# Stokes parameter → ways to form it: two correlations a and b, s and d of (a + s·b)/d
_FORMED = {
    "I": ((5, 8, 1, 2), (9, 12, 1, 2)),
    "Q": ((6, 7, 1, 2), (9, 12, -1, 2)),
    "U": ((6, 7, -1, 2j), (10, 11, 1, 2)),
    "V": ((5, 8, -1, 2), (10, 11, -1, 2j)),
}


@dataclass(frozen=True)
class RowGroup:
    """The selected rows of one data description, which share frequencies and correlations.

    Attributes
    ----------
    spw : int
    rows : int64 (R,), row numbers in the MeasurementSet
    channels : int64 (C,), selected channel numbers, increasing
    freqs_hz, widths_hz : float64 (C,), centres and widths in `frame`
    frame : str, reference of the frequencies ('TOPO', 'LSRK', …)
    hands : tuple of int, the positions of the correlations that form the Stokes parameters; () without one
    forms : for each Stokes parameter which one or two of the hands, sign and divisor of (first + sign·second)/divisor
    either : bool, whether one of the two will do where the other has no weight, as if the source were unpolarised
    weighing : tuple of int, the first correlation and the last: tclean's imaging weight is the mean of theirs
    correlations : tuple of str, all the correlations of the rows
    dd : int, number of the data description
    nchan : int, number of channels of the spectral window
    lacking : dict, array column → the rows that hold no cell of it, increasing; other columns have one in every row
    """

    spw: int
    rows: np.ndarray
    channels: np.ndarray
    freqs_hz: np.ndarray
    widths_hz: np.ndarray
    frame: str
    hands: tuple[int, ...]
    correlations: tuple[str, ...]
    forms: tuple[tuple[tuple[int, ...], int, complex], ...] = ()
    either: bool = False
    weighing: tuple[int, ...] = ()
    dd: int = 0
    nchan: int = 0
    lacking: dict[str, np.ndarray] = field(default_factory=dict)

    @property
    def cell_shape(self) -> tuple[int, int]:
        """Correlations and channels of a cell of DATA."""
        return len(self.correlations), self.nchan

    def has(self, column, rows):
        """Return whether these rows (R,) hold a cell of an array column, bool (R,)."""
        lacking = self.lacking.get(column, np.arange(0))
        return np.searchsorted(lacking, rows, "left") == np.searchsorted(lacking, rows, "right")


@dataclass(frozen=True)
class SelectedMS:
    """One MeasurementSet and the selected part of it.

    Attributes
    ----------
    number : int, its place in `vis`
    name : str
    column : str, the data column to read
    groups : tuple of RowGroup
    fields : dict, selected field number → phase centre (direction measure)
    observatory : str, and `position`, its position measure
    start_s : float, time of the first selected row, MJD seconds UTC
    """

    number: int
    name: str
    column: str
    groups: tuple[RowGroup, ...]
    fields: dict[int, dict]
    observatory: str
    position: dict
    start_s: float


def select_data(selection, stokes=""):
    """Apply the selection to every MeasurementSet.

    Parameters
    ----------
    selection : casa_sara.options.Selection
        The MeasurementSets and the data selected in them.
    stokes : str
        Of 'I', 'Q', 'U' and 'V' those that must be in the data; '' where their correlations do not matter.

    Returns
    -------
    selected : list of SelectedMS
        Those of `vis` of which at least one row is selected.
    notes : list of str
        Warnings for the user.

    Raises
    ------
    FileNotFoundError, ValueError
        With the parameter's name, its value and what would be right.
    """
    _check_parameters(selection)
    selected, notes, empty = [], [], []
    for number, name in enumerate(selection.vis):
        check_measurement_set(name)
        with reading(name):
            rows, channels = msselect(name, selection.of(number))
            if rows.size == 0:
                empty.append(f"{in_words(selection.of(number))} leaves no rows of '{name}'")
                continue
            column = _data_column(name, selection.datacolumn, notes)
            selected.append(_describe(number, name, column, rows, (channels, stokes), notes))
    if not selected:
        raise ValueError("the data selection selects no data: " + "; ".join(empty))
    return selected, notes + [f"{reason}, so nothing of it is imaged" for reason in empty]


def _check_parameters(selection):
    """Raise on errors that are found without opening a MeasurementSet."""
    if not selection.vis:
        raise ValueError("vis is empty: it takes the name of a MeasurementSet, or a list of names")
    if selection.datacolumn not in _DATA_COLUMNS:
        raise ValueError(f"datacolumn = '{selection.datacolumn}' is not one of 'corrected', 'data'")
    for parameter in MSSELECT_KEYS:
        value = getattr(selection, parameter)
        if not isinstance(value, str) and len(value) != len(selection.vis):
            raise ValueError(
                f"{parameter} = {list(value)} has {len(value)} entries for {len(selection.vis)} MeasurementSets "
                "in vis: it takes one string for all of them, or one for each"
            )
    chosen = [(os.path.realpath(name), selection.of(number)) for number, name in enumerate(selection.vis)]
    for number, one in enumerate(chosen):
        if one in chosen[:number]:
            raise ValueError(f"vis = {list(selection.vis)} has the same data of '{selection.vis[number]}' twice: "
                             "should name each MeasurementSet once, or select different parts of it")


def _data_column(name, datacolumn, notes):
    """Return the column to read, DATA with a note where CORRECTED_DATA is asked for and absent."""
    with opened("table", name) as tb:
        columns = set(tb.colnames())
    wanted = _DATA_COLUMNS[datacolumn]
    if wanted in columns:
        return wanted
    if "DATA" in columns:
        notes.append(f"datacolumn = '{datacolumn}', but '{name}' has no {wanted} column: DATA is imaged instead")
        return "DATA"
    if "FLOAT_DATA" in columns:
        raise ValueError(f"vis = '{name}' holds single-dish data (FLOAT_DATA): only interferometer data can be imaged")
    raise ValueError(f"datacolumn = '{datacolumn}': '{name}' has neither {wanted} nor DATA")


def _describe(number, name, column, rows, wanted, notes):
    """Return the SelectedMS of these rows, of the channels and the Stokes parameter `wanted`."""
    channels, stokes = wanted
    with opened("table", name) as tb:
        description = tb.getcol("DATA_DESC_ID")[rows]
        field_ids = np.unique(tb.getcol("FIELD_ID")[rows])
        observation = int(tb.getcell("OBSERVATION_ID", int(rows[0])))
        start_s = float(tb.getcell("TIME", int(rows[0])))
    check_rows(name, FIELD=field_ids, DATA_DESCRIPTION=np.unique(description))
    _refuse_moving(name, field_ids)
    with opened("msmetadata", readable(name)) as md:
        groups = []
        for dd in np.unique(description):
            spw = md.spwfordatadesc(int(dd))
            check_rows(name, SPECTRAL_WINDOW=[spw], POLARIZATION=[md.polidfordatadesc(int(dd))])
            codes = np.ravel(md.corrtypesforpol(md.polidfordatadesc(int(dd)))).tolist()
            chosen = channels.get(spw, np.arange(md.nchan(spw)))
            if chosen[-1] > _LAST_CHANNEL:
                raise ValueError(f"spw {spw} of '{name}': channels beyond {_LAST_CHANNEL} cannot be imaged, select "
                                 "others")
            groups.append(
                RowGroup(
                    spw=spw,
                    rows=rows[description == dd],
                    channels=chosen,
                    freqs_hz=md.chanfreqs(spw)[chosen],
                    widths_hz=np.abs(md.chanwidths(spw))[chosen],
                    frame=md.reffreq(spw)["refer"],
                    **_formation(name, spw, codes, stokes, notes),
                    correlations=tuple(_STOKES_CODES.get(code, str(code)) for code in codes),
                    dd=int(dd),
                    nchan=md.nchan(spw),
                )
            )
        groups = _with_lacking(name, column, groups)
        if all(group.has(column, group.rows).sum() == 0 for group in groups):
            raise ValueError(f"vis: the {column} column of '{name}' is empty at row {rows[0]} and at all others that "
                             "are selected")
        return SelectedMS(
            number=number,
            name=name,
            column=column,
            groups=tuple(groups),
            fields={int(field): md.phasecenter(int(field)) for field in field_ids},
            observatory=md.observatorynames()[observation],
            position=_position(md, observation),
            start_s=start_s,
        )


def _with_lacking(name, column, groups):
    """Return the groups with the rows that lack cells; raise where a cell does not fit its window and correlations."""
    wanted = {}
    for group in groups:
        matrix, vector = group.cell_shape, group.cell_shape[:1]
        wanted[group.dd] = group.rows, {column: matrix, "FLAG": matrix, "WEIGHT": vector, "SIGMA": vector,
                                        "WEIGHT_SPECTRUM": matrix, "SIGMA_SPECTRUM": matrix}
    with opened("table", name) as tb:
        lacking = lacking_cells(tb, name, wanted)
    return [replace(group, lacking=lacking[group.dd]) for group in groups]


def _position(md, observation):
    """Return the position of the telescope: that of its first antenna if CASA does not know the name, as in tclean."""
    try:
        return md.observatoryposition(observation)
    except RuntimeError:
        return md.antennaposition(0)


def _formation(name, spw, codes, stokes, notes):
    """Return how Stokes parameters are formed of correlations `codes`: fields `hands` to `weighing` of a RowGroup."""
    ways = [_formed_of(name, spw, codes, one, notes) for one in stokes]
    hands = tuple(dict.fromkeys(hand for chosen, *_ in ways for hand in chosen))
    forms = tuple((tuple(map(hands.index, chosen)), sign, divisor) for chosen, sign, divisor in ways)
    return dict(hands=hands, forms=forms, either=stokes == "I" and len(hands) == 2,
                weighing=tuple(sorted({0, len(codes) - 1})))


def _formed_of(name, spw, codes, stokes, notes):
    """Return the positions of the correlations that form one Stokes parameter, sign and divisor."""
    for number, code in enumerate(codes):  # the Stokes parameter itself
        if _STOKES_CODES.get(code) == stokes:
            return (number,), 1, 1
    for first, second, sign, divisor in _FORMED[stokes]:
        if {first, second} <= set(codes):
            return (codes.index(first), codes.index(second)), sign, divisor
    parallel = [number for number, code in enumerate(codes) if code in _PARALLEL]
    if stokes == "I" and parallel:
        note = f"'{name}' has only {_STOKES_CODES[codes[parallel[0]]]}: {UNPOLARISED}"
        if note not in notes:
            notes.append(note)
        return (parallel[0],), 1, 1
    names = ", ".join(_STOKES_CODES.get(code, f"type {code}") for code in codes)
    ways = ", or ".join(f"{_STOKES_CODES[first]} and {_STOKES_CODES[second]}" for first, second, *_ in _FORMED[stokes])
    raise ValueError(
        f"stokes = '{stokes}' cannot be formed from the correlations {names} of spw {spw} in '{name}': it needs {ways}"
        f"{', or one of them alone' if stokes == 'I' else ''}, or {stokes} itself; other spws can be selected with spw"
    )


def _refuse_moving(name, field_ids):
    """Raise when a selected field moves on the sky: its phase centre is not one direction."""
    with opened("table", os.path.join(readable(name), "FIELD")) as tb:
        moving = np.array([np.any(tb.getcell("PHASE_DIR", int(number))[:, 1:]) for number in field_ids])
        if "EPHEMERIS_ID" in tb.colnames():
            moving |= tb.getcol("EPHEMERIS_ID")[field_ids] >= 0
    if moving.any():
        names = np.array(texts(name, "FIELD", "NAME"))[field_ids]
        raise ValueError(
            f"vis = '{name}': field {field_ids[moving].tolist()} ({', '.join(names[moving])}) moves on the sky "
            "(ephemeris or polynomial): moving sources cannot be imaged, select other fields with the parameter field"
        )
