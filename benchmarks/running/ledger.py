"""The record of what was measured: one SQLite file, one transaction a case, so that a killed run loses nothing."""

from __future__ import annotations

import io
import json
import sqlite3
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

_SCHEMA = """
CREATE TABLE IF NOT EXISTS cases (
    key TEXT PRIMARY KEY,
    study TEXT NOT NULL,
    scene TEXT NOT NULL,
    contender TEXT NOT NULL,
    repetition INTEGER NOT NULL,
    metrics TEXT NOT NULL,
    failure TEXT NOT NULL,
    arrays BLOB NOT NULL
)
"""


@dataclass(frozen=True)
class Row:
    """One measured case.

    Parameters
    ----------
    key
        Digest of all that determines the result: settings of the scene, contender, repetition, code.
    study, scene, contender, repetition
        What was run.
    metrics
        Numbers by name, units in the names; NaN is kept as NaN.
    failure
        The sentence of a contender that could not answer; empty where it did.
    arrays
        Estimates kept so that figures and recordings can be drawn again without the method.
    """

    key: str
    study: str
    scene: str
    contender: str
    repetition: int
    metrics: Mapping[str, float]
    failure: str = ""
    arrays: Mapping[str, NDArray[Any]] = field(default_factory=dict)


class Ledger:
    """Rows on disk, safe against being killed and against two writers at once (SQLite in WAL mode)."""

    def __init__(self, path: Path) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        self.path = path
        with self._connection() as connection:
            connection.execute(_SCHEMA)

    def record(self, rows: Sequence[Row]) -> None:
        """Write all rows of a job in one transaction; a row that is there already is replaced."""
        values = [
            (
                row.key,
                row.study,
                row.scene,
                row.contender,
                row.repetition,
                json.dumps(dict(row.metrics)),
                row.failure,
                _packed(row.arrays),
            )
            for row in rows
        ]
        with self._connection() as connection:
            connection.executemany("INSERT OR REPLACE INTO cases VALUES (?, ?, ?, ?, ?, ?, ?, ?)", values)

    def has(self, key: str) -> bool:
        """Tell whether the case of this key was measured."""
        with self._connection() as connection:
            return connection.execute("SELECT 1 FROM cases WHERE key = ?", (key,)).fetchone() is not None

    def rows(self, keys: Sequence[str]) -> list[Row]:
        """Read the rows of these keys, in their order; a key that was never measured is left out."""
        with self._connection() as connection:
            found = (connection.execute("SELECT * FROM cases WHERE key = ?", (key,)).fetchone() for key in keys)
            return [_row(values) for values in found if values is not None]

    @contextmanager
    def _connection(self) -> Iterator[sqlite3.Connection]:
        with closing(sqlite3.connect(self.path, timeout=60)) as connection, connection:
            connection.execute("PRAGMA journal_mode = WAL")
            yield connection


def _packed(arrays: Mapping[str, NDArray[Any]]) -> bytes:
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **dict(arrays))  # type: ignore[arg-type]
    return buffer.getvalue()


def _row(values: Sequence[Any]) -> Row:
    key, study, scene, contender, repetition, metrics, failure, blob = values
    with np.load(io.BytesIO(blob)) as stored:
        arrays = {name: stored[name] for name in stored.files}
    return Row(key, study, scene, contender, repetition, json.loads(metrics), failure, arrays)
