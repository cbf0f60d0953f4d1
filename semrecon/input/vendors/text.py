"""Text blocks and sidecar files of microscopes: complete lines only, in whatever encoding they come."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

MOST_BYTES = 1 << 20
"""A sidecar above this size is something else."""
BOMS = {b"\xff\xfe": "utf-16-le", b"\xfe\xff": "utf-16-be", b"\xef\xbb\xbf": "utf-8"}

Sections = dict[str, dict[str, str]]


def decode(block: bytes) -> str:
    """Decode by the byte order mark, as UTF-8, or as the code page of Western Windows; never fails."""
    for mark, encoding in BOMS.items():
        if block.startswith(mark):
            return block[len(mark) :].decode(encoding, errors="replace")
    try:
        return block.decode("utf-8")
    except UnicodeDecodeError:
        return block.decode("cp1252", errors="replace")


def complete_lines(block: bytes) -> Iterator[str]:
    """Give the lines that have an end; a cut-off last line could hold half a number, which reads as a whole one."""
    parts = re.split(r"\r\n|[\r\n\0]", decode(block))
    return (part.strip() for part in parts[:-1])


def sections(block: bytes) -> Sections:
    """Read ``[section]`` and ``key=value`` lines; keys before any section stand under "".

    A key that comes twice with two values in a section is dropped: nobody can tell which one is right.
    """
    found: Sections = {"": {}}
    torn: set[tuple[str, str]] = set()
    section = ""
    for line in complete_lines(block):
        if line.startswith("[") and line.endswith("]"):
            section = line[1:-1].strip()
            found.setdefault(section, {})
        elif "=" in line:
            key, value = (part.strip() for part in line.split("=", 1))
            if found[section].setdefault(key, value) != value:
                torn.add((section, key))
    for section, key in torn:
        del found[section][key]
    return found


def sidecar(image: Path, suffix: str) -> tuple[bytes, str]:
    """Read the text file beside an image, ``a.txt`` or ``a-tif.txt`` for ``a.tif``; empty where there is none.

    Returns
    -------
    Content and file name.
    """
    suffixes = (suffix, suffix.upper())
    stems = (image.stem, f"{image.stem}-{image.suffix.lstrip('.')}")
    for path in (image.with_name(stem + end) for stem in stems for end in suffixes):
        try:
            if path != image and path.is_file() and path.stat().st_size <= MOST_BYTES:
                return path.read_bytes(), path.name
        except OSError:
            continue
    return b"", ""
