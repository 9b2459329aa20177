"""Numbers for what is distinct among the values of all ranks."""

from __future__ import annotations

import numpy as np

from casa_sara.parallel.serial import SERIAL, Serial

__all__ = ["numbered"]


def numbered(values: np.ndarray, comm: Serial = SERIAL) -> tuple[np.ndarray, np.ndarray]:
    """Return the distinct values of all ranks, sorted, and which of them each value of this rank is.

    Parameters
    ----------
    values : (n,), or (n, columns) where rows are compared
        Of this rank, which may have none.
    comm : casa_sara.parallel.serial.Serial or MPI
        Over whose ranks the values are spread.

    Returns
    -------
    distinct : (k,) or (k, columns)
        The same on all ranks.
    number : int (n,)
        `distinct[number]` are the values.
    """
    here, place = np.unique(values, axis=0, return_inverse=True)
    distinct, number = np.unique(np.concatenate([*comm.allgather(here), here]), axis=0, return_inverse=True)
    return distinct, number.ravel()[number.size - len(here):][place.ravel()]
