"""The common part of all tasks: checks, log messages and errors, as in casatasks."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any

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
    from casatasks.private.task_logging import end_log, except_log, start_log

    state = start_log(name, [f"{key}={value!r}" for key, value in values.items()])
    result = None
    try:
        result = implementation(**validate(parameters, values))
    except Exception as error:
        except_log(name, error)
        raise
    finally:
        end_log(state, name, result)
    return result
