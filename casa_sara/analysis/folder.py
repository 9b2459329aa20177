"""The folder of a report, in which the files of a new report replace those of an earlier one together."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path

from casa_sara.runtime.atomic import new_files

__all__ = ["MEASURES", "PAGE", "in_the_way", "remove", "replaced"]

PAGE, MEASURES = "report.html", "measures.json"
LIST = "report.files"  # names of the files that are the report's


@contextmanager
def replaced(folder: Path) -> Iterator[Path]:
    """Yield an empty folder; what is written there takes the place of the earlier report's files when it is complete.

    The file `report.files` says which files are the report's. All others stay. When something fails, everything does.

    Parameters
    ----------
    folder : Path
        Made if it is not there, but not kept empty.

    Yields
    ------
    Path

    Raises
    ------
    FileExistsError
        A file that is not of an earlier report has the name of a new one.
    """
    made = not folder.exists()
    folder.mkdir(parents=True, exist_ok=True)
    try:
        with new_files(str(folder / "report"), lambda: [str(folder / name) for name in _own(folder)]) as new:
            yield Path(new)
            names = sorted([*os.listdir(new), LIST])
            Path(new, LIST).write_text("\n".join(names) + "\n", encoding="utf-8")
            if taken := in_the_way(folder, names):
                raise FileExistsError(f"'{folder}' holds {', '.join(taken)}, not of an earlier report: choose another "
                                      "folder, or move it away")
    finally:
        if made and not os.listdir(folder):
            folder.rmdir()


def in_the_way(folder: Path, names: Iterable[str]) -> list[str]:
    """Return those of the names that stand in the folder and are not of an earlier report.

    Parameters
    ----------
    folder : Path
        The folder of a report.
    names : iterable of str
        Names of files.

    Returns
    -------
    list of str
    """
    own = _own(folder)
    return [name for name in names if os.path.lexists(folder / name) and name not in own]


def remove(folder: Path) -> None:
    """Remove the files of a report, and the folder where it holds no others; nothing where there is none.

    Parameters
    ----------
    folder : Path
        The folder of a report.
    """
    for name in _own(folder):
        (folder / name).unlink()
    if folder.is_dir() and not os.listdir(folder):
        folder.rmdir()


def _own(folder) -> list[str]:
    """Return the names of the files of the earlier report that are still there; a list from elsewhere does no harm."""
    try:
        names = (folder / LIST).read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError):
        return []
    return [name for name in dict.fromkeys(names) if name == os.path.basename(name) and (folder / name).is_file()]
