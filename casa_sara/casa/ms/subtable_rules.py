"""What the subtables of a MeasurementSet should hold: their columns, and what is right in a cell."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

__all__ = ["COLUMNS", "DIAMETER_M", "OPTIONAL", "OPTIONAL_COLUMNS", "RULES", "Rule", "UNREAD"]

COLUMNS = {  # that CASA wants in the subtables: type, and 'arrays' → names
    "ANTENNA": {"string": "MOUNT NAME STATION TYPE", "double": "DISH_DIAMETER", "double arrays": "OFFSET POSITION",
                "boolean": "FLAG_ROW"},
    "DATA_DESCRIPTION": {"int": "POLARIZATION_ID SPECTRAL_WINDOW_ID", "boolean": "FLAG_ROW"},
    "FIELD": {"string": "CODE NAME", "int": "NUM_POLY SOURCE_ID", "double": "TIME",
              "double arrays": "DELAY_DIR PHASE_DIR REFERENCE_DIR", "boolean": "FLAG_ROW"},
    "OBSERVATION": {"string": "OBSERVER PROJECT SCHEDULE_TYPE TELESCOPE_NAME", "string arrays": "LOG SCHEDULE",
                    "double": "RELEASE_DATE", "double arrays": "TIME_RANGE", "boolean": "FLAG_ROW"},
    "POLARIZATION": {"int": "NUM_CORR", "int arrays": "CORR_PRODUCT CORR_TYPE", "boolean": "FLAG_ROW"},
    "SPECTRAL_WINDOW": {"string": "FREQ_GROUP_NAME NAME",
                        "int": "FREQ_GROUP IF_CONV_CHAIN MEAS_FREQ_REF NET_SIDEBAND NUM_CHAN",
                        "double": "REF_FREQUENCY TOTAL_BANDWIDTH",
                        "double arrays": "CHAN_FREQ CHAN_WIDTH EFFECTIVE_BW RESOLUTION",
                        "boolean": "FLAG_ROW"},
    "STATE": {"string": "OBS_MODE", "int": "SUB_SCAN", "double": "CAL LOAD", "boolean": "FLAG_ROW REF SIG"},
    "SOURCE": {"string": "CODE NAME", "int": "CALIBRATION_GROUP NUM_LINES SOURCE_ID SPECTRAL_WINDOW_ID",
               "double": "INTERVAL TIME", "double arrays": "DIRECTION PROPER_MOTION REST_FREQUENCY SYSVEL"},
    "FEED": {"int": "ANTENNA_ID BEAM_ID FEED_ID NUM_RECEPTORS SPECTRAL_WINDOW_ID", "double": "INTERVAL TIME",
             "double arrays": "BEAM_OFFSET POSITION RECEPTOR_ANGLE", "complex arrays": "POL_RESPONSE",
             "string arrays": "POLARIZATION_TYPE"},
    "FLAG_CMD": {"string": "COMMAND REASON TYPE", "int": "LEVEL SEVERITY", "double": "INTERVAL TIME",
                 "boolean": "APPLIED"},
    "HISTORY": {"string": "APPLICATION MESSAGE ORIGIN PRIORITY", "string arrays": "APP_PARAMS CLI_COMMAND",
                "int": "OBJECT_ID OBSERVATION_ID", "double": "TIME"},
    "POINTING": {"string": "NAME", "int": "ANTENNA_ID NUM_POLY", "double": "INTERVAL TIME TIME_ORIGIN",
                 "double arrays": "DIRECTION TARGET", "boolean": "TRACKING"},
    "PROCESSOR": {"string": "SUB_TYPE TYPE", "int": "MODE_ID TYPE_ID", "boolean": "FLAG_ROW"},
}
OPTIONAL = {"SOURCE"}
OPTIONAL_COLUMNS = {"REST_FREQUENCY", "SYSVEL"}  # cells may be empty, too
UNREAD = {"FEED", "FLAG_CMD", "HISTORY", "POINTING", "PROCESSOR"}  # may be long, and no image depends on them
_FREQUENCY_FRAMES = {*range(9), 64}  # REST to CMB, and Undefined
_LAST_CORRELATION = 32
DIAMETER_M = 25.0


class Rule(NamedTuple):
    """What a cell should hold: `right` takes the cell, others of its row by name, and numbers of rows by subtable.

    `instead` takes the others of its row and returns what stands for a wrong cell, which the image does not depend on.
    Without it a wrong cell is refused when selected data refer to it, and elsewhere the cell of a row that is right
    stands for it.
    """

    column: str
    words: str  # what the cell should hold, for the error message
    right: Callable[[np.ndarray, dict, dict], Any]
    instead: Callable[[dict], Any] | None = None


def _numbers(*shape):
    """Return the rule of a cell of finite numbers."""
    return lambda cell, row, counts: cell.shape == shape and np.isfinite(cell)


def _per_channel(right):
    """Return the rule of a cell with a number for each channel."""
    return lambda cell, row, counts: cell.ndim == 1 and cell.shape == np.shape(row["CHAN_FREQ"]) and right(cell)


def _directions(cell, row, counts):
    """A direction and its rates, as NUM_POLY has it."""
    return cell.shape == (2, int(row["NUM_POLY"]) + 1) and np.isfinite(cell)


def _row_of(table):
    """Return the rule of a row number of another subtable."""
    return lambda cell, row, counts: (cell >= 0) & (cell < counts[table])


def _size_of(column):
    """Return the rule of the number of cells in another column."""
    return lambda cell, row, counts: cell == np.size(row[column])


RULES = {
    "ANTENNA": (
        Rule("POSITION", "three finite numbers in m", _numbers(3)),
        Rule("OFFSET", "three finite numbers in m", _numbers(3), lambda row: np.zeros(3)),
    ),
    "DATA_DESCRIPTION": (
        Rule("SPECTRAL_WINDOW_ID", "a row of SPECTRAL_WINDOW", _row_of("SPECTRAL_WINDOW")),
        Rule("POLARIZATION_ID", "a row of POLARIZATION", _row_of("POLARIZATION")),
    ),
    "FIELD": (
        Rule("NUM_POLY", "0 or more", lambda cell, row, counts: cell >= 0),
        Rule("PHASE_DIR", "2 by NUM_POLY + 1 finite numbers", _directions),
        Rule("DELAY_DIR", "", _directions, lambda row: row["PHASE_DIR"]),
        Rule("REFERENCE_DIR", "", _directions, lambda row: row["PHASE_DIR"]),
        Rule("TIME", "", _numbers(), lambda row: np.zeros(())),
    ),
    "OBSERVATION": (Rule("TIME_RANGE", "", _numbers(2), lambda row: np.zeros(2)),),
    "POLARIZATION": (
        Rule("CORR_TYPE", "codes of correlations",
              lambda cell, row, counts: cell.ndim == 1 and cell.size and (cell > 0) & (cell <= _LAST_CORRELATION)),
        Rule("NUM_CORR", "the number of correlations in CORR_TYPE", _size_of("CORR_TYPE")),
        Rule("CORR_PRODUCT", "", lambda cell, row, counts: cell.shape == (2, np.size(row["CORR_TYPE"])) and cell >= 0,
              lambda row: np.zeros((2, np.size(row["CORR_TYPE"])), int)),
    ),
    "SPECTRAL_WINDOW": (
        Rule("CHAN_FREQ", "a frequency in Hz for each channel",
              lambda cell, row, counts: cell.ndim == 1 and cell.size and np.isfinite(cell) & (cell > 0)),
        Rule("CHAN_WIDTH", "a width in Hz for each channel",
              _per_channel(lambda cell: np.isfinite(cell) & (cell != 0))),
        Rule("NUM_CHAN", "the number of channels in CHAN_FREQ", _size_of("CHAN_FREQ")),
        Rule("MEAS_FREQ_REF", "the code of a frame", lambda cell, row, counts: int(cell) in _FREQUENCY_FRAMES),
        Rule("EFFECTIVE_BW", "", _per_channel(np.isfinite), lambda row: np.abs(row["CHAN_WIDTH"])),
        Rule("RESOLUTION", "", _per_channel(np.isfinite), lambda row: np.abs(row["CHAN_WIDTH"])),
        Rule("REF_FREQUENCY", "", lambda cell, row, counts: np.isfinite(cell) & (cell > 0),
              lambda row: row["CHAN_FREQ"][0]),
        Rule("TOTAL_BANDWIDTH", "", _numbers(), lambda row: np.abs(row["CHAN_WIDTH"]).sum()),
    ),
    "SOURCE": (
        Rule("DIRECTION", "", _numbers(2), lambda row: np.zeros(2)),
        Rule("PROPER_MOTION", "", _numbers(2), lambda row: np.zeros(2)),
        Rule("TIME", "", _numbers(), lambda row: np.zeros(())),
        Rule("INTERVAL", "", _numbers(), lambda row: np.zeros(())),
        Rule("REST_FREQUENCY", "", lambda cell, row, counts: cell.ndim == 1 and np.isfinite(cell) & (cell > 0),
              lambda row: np.zeros(0)),
        Rule("SYSVEL", "", lambda cell, row, counts: cell.ndim == 1 and np.isfinite(cell), lambda row: np.zeros(0)),
    ),
}
