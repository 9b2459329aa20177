"""What every task does around its implementation, as the tasks of casatasks do it: checks, log messages and errors.

casatasks itself takes a second or two to import.
"""

from __future__ import annotations

import importlib.util
import threading
from collections.abc import Callable
from typing import Any

from casa_sara.casa.runtime import log
from casa_sara.private.validation import Parameter, validate

__all__ = ["run_task"]

_one_at_a_time = threading.RLock()  # the tools of CASA crash when two threads use them


def run_task(
    name: str, parameters: tuple[Parameter, ...], implementation: Callable[..., Any], values: dict[str, Any]
) -> Any:
    """Validate `values`, run `implementation` with them and return its result.

    Tasks called from several threads wait for each other.

    Beginning, parameters, end and any error are logged. Errors, those of the validation among
    them, are raised.
    """
    with _one_at_a_time:
        return _run(name, parameters, implementation, values)


def _run(name, parameters, implementation, values):
    if importlib.util.find_spec("casampi"):
        # makes servers of all processes of an MPI job but one, which do not come back from here
        import casatasks  # noqa: F401 - for what its import does
    with log.logged_task(name, values) as tell_result:
        result = implementation(**validate(parameters, values))
        tell_result(result)
    return result
