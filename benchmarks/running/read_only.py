"""Results that can be read and not written: a mounted disk, an artefact of a CI job, a colleague's folder."""

from __future__ import annotations

import os
import sqlite3
from pathlib import Path

from semrecon.errors import InputError

TABLES = {"answers", "scores", "limits", "bounds"}


def can_be_written(folder: Path) -> bool:
    """Tell whether files can be made in a folder, or in what is there of the way to it."""
    there = next(each for each in (folder, *folder.absolute().parents) if each.exists())
    return there.is_dir() and os.access(there, os.W_OK | os.X_OK)


def check_target(option: str, target: Path, *, folder: bool = False) -> None:
    """Refuse a file, or a folder of files, where nothing can be written, before any work; raises `InputError`."""
    if not can_be_written(target if folder else target.absolute().parent):
        raise InputError(f"{target} cannot be written, its folder is read-only; name another place with {option}")


def connect_frozen(path: Path) -> sqlite3.Connection:
    """Open a ledger in a folder that cannot be written, for reading.

    In WAL mode even a reader makes files beside the ledger; only of one that is said to never change does SQLite open
    the file alone.
    """
    return sqlite3.connect(path.absolute().as_uri() + "?mode=ro&immutable=1", uri=True)


def check_frozen(path: Path) -> None:
    """Refuse a ledger that cannot be read whole where nothing can be written beside it.

    Raises
    ------
    InputError
        A run was killed, or is under way, and part of its answers stands in the log beside the ledger; or the ledger
        lacks a table, which cannot be added here.
    """
    log = path.with_name(f"{path.name}-wal")
    if log.is_file() and log.stat().st_size:
        raise InputError(
            f"part of {path} still stands in {log.name}, and SQLite cannot join them in a folder that is read-only; "
            "copy the folder to where you can write"
        )
    connection = connect_frozen(path)
    try:
        found = {name for (name,) in connection.execute("SELECT name FROM sqlite_master WHERE type = 'table'")}
    finally:
        connection.close()
    if "answers" not in found:
        raise InputError(f"{path} is no ledger of a run; name the folder of one")
    if found < TABLES:
        raise InputError(
            f"{path} was written by an older version and lacks {', '.join(sorted(TABLES - found))}, which cannot be "
            "added in a folder that is read-only; copy the folder to where you can write"
        )
