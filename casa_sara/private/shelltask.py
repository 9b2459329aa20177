"""The task interface of the CASA shell: inp, default, tget, tput, go and a call."""

from __future__ import annotations

import ast
import runpy
import shutil
import sys
import textwrap
from collections.abc import Callable
from contextlib import suppress
from types import ModuleType
from typing import Any

from casa_sara.private.validation import Parameter, checked, plain

__all__ = ["ShellTask", "register"]

SUMMARY_COLUMN = 42  # where the descriptions of inp begin
BOLD, GREEN, BLUE, RED, NORMAL = "\x1b[1m\x1b[47m", "\x1b[92m", "\x1b[34m", "\x1b[91m", "\x1b[0m"


class ShellTask:
    """A task whose parameters are the global variables of the CASA shell.

    The shell's commands call these methods: ``inp`` inp, ``default`` set_global_defaults, ``tget``
    tget, ``tput`` and ``saveinputs`` tput, ``go`` the task itself without arguments. Unlike CASA's
    own tasks it does not pass on a left-over global variable of a sub-parameter that ``inp`` does
    not show.

    Parameters
    ----------
    name : str
        The task's name.
    parameters : tuple of Parameter
        Its parameters, in the order in which ``inp`` shows them.
    task : callable
        The plain task, which takes all of them as keyword arguments.
    """

    def __init__(self, name: str, parameters: tuple[Parameter, ...], task: Callable[..., Any]) -> None:
        self._name = name
        self._parameters = parameters
        self._task = task

    def inp(self) -> None:
        """Print the parameters: set ones blue, wrong ones red, idle sub-parameters left out."""
        values = self._current()
        openers = {parameter.opener for parameter in self._parameters}
        print(f"# {self._name} -- {self._info_desc_}")
        for parameter in self._parameters:
            if parameter.is_open(values):
                _print_parameter(parameter, values[parameter.name], parameter.name in openers)

    def set_global_defaults(self) -> None:
        """Forget the values in the shell, so that all parameters have their defaults."""
        shell = _shell_globals()
        for parameter in self._parameters:
            shell.pop(parameter.name, None)

    def tput(self, outfile: str | None = None) -> None:
        """Save the parameters to `outfile`, <task>.last by default."""
        self._save(outfile or f"{self._name}.last", self._current())

    def tget(self, savefile: str | None = None) -> None:
        """Set the parameters from `savefile`, <task>.last by default; those it lacks to their defaults.

        Raises
        ------
        FileNotFoundError
            When there is no such file.
        """
        saved = runpy.run_path(savefile or f"{self._name}.last")
        self.set_global_defaults()
        names = {parameter.name for parameter in self._parameters}
        _shell_globals().update({name: value for name, value in saved.items() if name in names})

    def _run(self, given: dict[str, Any]) -> Any:
        """Run the task with the arguments that are not None or, where all are, with the shell's variables."""
        given = {name: value for name, value in given.items() if value is not None}
        values = {p.name: p.default for p in self._parameters} | given if given else self._current()
        with suppress(OSError, ValueError):  # a convenience for tget, which must not keep the task from running
            self._save(f"{self._name}.last", values)
        return self._task(**values)

    def _current(self) -> dict[str, Any]:
        """Return the shell's values; sub-parameters that are not open have their defaults."""
        shell = _shell_globals()
        values = {p.name: shell.get(p.name, p.default) for p in self._parameters}
        return {p.name: values[p.name] if p.is_open(values) else p.default for p in self._parameters}

    def _save(self, filename: str, values: dict[str, Any]) -> None:
        """Write `values` as Python, one assignment a line and the whole call as a comment."""
        texts = {name: repr(plain(value)) for name, value in values.items()}
        for name, text in texts.items():
            try:
                ast.literal_eval(text)
            except (SyntaxError, ValueError):
                raise ValueError(f"{name} = {text}: cannot be saved; should be strings, numbers or lists") from None
        width = max(map(len, texts))
        lines = [f"{name:<{width}} = {text}" for name, text in texts.items()]
        call = ", ".join(f"{name}={text}" for name, text in texts.items())
        with open(filename, "w") as file:
            file.write("\n".join([*lines, f"#{self._name}({call})", ""]))


def register(module: ModuleType) -> None:
    """List the tasks of `module` in the shell's taskhelp(); without a shell, do nothing."""
    shell = sys.modules.get("casashell")
    if shell is not None and module not in shell.extra_task_modules:
        shell.extra_task_modules.append(module)


def _shell_globals() -> dict[str, Any]:
    """Return the CASA shell's global variables."""
    frame = None
    if "casashell" in sys.modules:
        from casashell.private.stack_manip import find_frame

        frame = find_frame()
    if frame is None:
        raise RuntimeError("casa_sara.gotasks is for the CASA shell; elsewhere use the tasks of casa_sara itself")
    return frame


def _print_parameter(parameter: Parameter, value: Any, is_opener: bool) -> None:
    """Print one parameter as inp does: name, value, and the summary wrapped into its column."""
    try:
        checked(parameter, value)
        value_colour = "" if plain(value) == parameter.default else BLUE
    except (ValueError, FileNotFoundError):
        value_colour = RED
    name_colour = BOLD if is_opener else GREEN if parameter.opener else ""
    name = f"   {parameter.name:<16} =" if parameter.opener else f"{parameter.name:<19} ="
    line = f"{name} {value!r}"
    padding = " " * (SUMMARY_COLUMN - len(line))
    width = max(20, shutil.get_terminal_size().columns - SUMMARY_COLUMN - 3)
    first, *more = textwrap.wrap(parameter.summary, width, break_on_hyphens=False)
    if len(line) > SUMMARY_COLUMN:
        padding = "\n" + " " * SUMMARY_COLUMN
    print(f"{_coloured(name, name_colour)} {_coloured(repr(value), value_colour)}{padding} # {first}")
    for text in more:
        print(" " * SUMMARY_COLUMN + f" # {text}")


def _coloured(text: str, colour: str) -> str:
    return f"{colour}{text}{NORMAL}" if colour and sys.stdout.isatty() else text
