"""Output folders that appear whole or not at all."""

from __future__ import annotations

import contextlib
import os
import shutil
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

from semrecon.errors import InputError

Recognise = Callable[[Path], bool]
"""Says whether a folder is a former result of the same kind, which may be replaced."""


def check_target(target: Path, recognise: Recognise) -> None:
    """Refuse to write over what is not ours; raises `InputError` and changes nothing.

    Allowed are a path that does not exist, an empty folder and a folder that `recognise` knows.
    """
    if not target.exists():
        return
    if not target.is_dir():
        raise InputError(f"output {target} is a file; give the path of a new folder")
    if any(target.iterdir()) and not recognise(target):
        raise InputError(f"output folder {target} holds something else; give a new or empty folder")


@contextlib.contextmanager
def whole_folder(target: Path, recognise: Recognise) -> Iterator[Path]:
    """Give a temporary folder beside `target` to write into, and move it into place at the end.

    Whatever goes wrong in between, an interruption included, the temporary folder goes and the target stays as it was.
    """
    target = target.absolute()
    check_target(target, recognise)
    target.parent.mkdir(parents=True, exist_ok=True)
    partial = Path(tempfile.mkdtemp(prefix=f".{target.name}.", suffix=".partial", dir=target.parent))
    try:
        partial.chmod(0o777 & ~_umask())
        yield partial
        check_target(target, recognise)
        _replace(target, partial)
    except BaseException:
        shutil.rmtree(partial, ignore_errors=True)
        raise


def _replace(target: Path, fresh: Path) -> None:
    """Move `fresh` to `target`; a former folder steps aside first and comes back if the move fails."""
    if not target.exists():
        fresh.rename(target)
        return
    aside = Path(tempfile.mkdtemp(prefix=f".{target.name}.", suffix=".former", dir=target.parent))
    former = target.rename(aside / target.name)
    try:
        fresh.rename(target)
    except BaseException:
        former.rename(target)
        raise
    finally:
        if target.exists():
            shutil.rmtree(aside, ignore_errors=True)


def _umask() -> int:
    """Read the permissions mask that a plain mkdir would have obeyed."""
    mask = os.umask(0)
    os.umask(mask)
    return mask
