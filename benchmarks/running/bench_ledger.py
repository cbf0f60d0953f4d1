"""The record of `run`: answers of methods and, apart from them, their scores, so that judging anew calls no method."""

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

from benchmarks.judging.efficiency import SceneLimit
from benchmarks.running.case import Answer, Case, Outcome
from benchmarks.running.cell import Limits
from benchmarks.running.read_only import can_be_written, check_frozen, connect_frozen
from semrecon.data import Array
from semrecon.errors import InputError

_SCHEMA = """
CREATE TABLE IF NOT EXISTS answers (
    key TEXT PRIMARY KEY,
    scene TEXT NOT NULL,
    method TEXT NOT NULL,
    options TEXT NOT NULL,
    repetition INTEGER NOT NULL,
    kind TEXT NOT NULL,
    failure TEXT NOT NULL,
    detail TEXT NOT NULL,
    seconds REAL,
    peak_mib REAL,
    limit_s REAL NOT NULL,
    limit_gib REAL NOT NULL,
    estimate BLOB NOT NULL,
    recorded TEXT NOT NULL DEFAULT CURRENT_TIMESTAMP
);
CREATE TABLE IF NOT EXISTS scores (
    key TEXT NOT NULL REFERENCES answers (key),
    judge TEXT NOT NULL,
    metrics TEXT NOT NULL,
    PRIMARY KEY (key, judge)
);
CREATE TABLE IF NOT EXISTS limits (
    identity TEXT PRIMARY KEY,
    version TEXT NOT NULL,
    window_px REAL NOT NULL,
    reason TEXT NOT NULL,
    sigma_um BLOB NOT NULL
);
CREATE TABLE IF NOT EXISTS bounds (
    key TEXT PRIMARY KEY REFERENCES answers (key),
    version TEXT NOT NULL,
    bound_um REAL
);
"""
_SETTLED = """
SELECT 1 FROM answers WHERE key = ?
AND NOT (kind = 'timeout' AND limit_s < ?) AND NOT (kind = 'memory' AND limit_gib < ?)
"""
NAN = float("nan")


@dataclass(frozen=True)
class Result:
    """A case as tables show it: all but the estimate.

    `kind`, `failure`, `seconds` and `peak_mib` are those of `benchmarks.running.case.Answer`; `metrics` is empty for a
    failure. Where the physical limit of the scene is on record, `metrics` holds `bound_um`, the limit over the pixels
    that were answered, and `efficiency`, `median_um` over it; they are NaN where there is none.
    """

    key: str
    scene: str
    method: str
    repetition: int
    kind: str = ""
    failure: str = ""
    seconds: float = NAN
    peak_mib: float = NAN
    metrics: Mapping[str, float] = field(default_factory=dict)
    options: str = ""


class BenchLedger:
    """Answers and scores in one SQLite file (WAL), a transaction a case; what was said to be there survives a kill.

    In a folder that cannot be written it is opened for reading, and leaves nothing beside it.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.frozen = path.is_file() and not can_be_written(path.parent)
        try:
            if self.frozen:
                check_frozen(path)
            else:
                self._make()
        except sqlite3.DatabaseError as error:
            raise InputError(f"{path} is no ledger of a run ({error}); name another --out") from error

    def _make(self) -> None:
        self.path.parent.mkdir(parents=True, exist_ok=True)
        with self._connection() as connection:
            connection.execute("PRAGMA journal_mode = WAL")
            connection.executescript(_SCHEMA)

    def settled(self, key: str, limits: Limits) -> bool:
        """Tell whether a case has an answer; one that ran into a narrower limit than now has none."""
        with self._connection() as connection:
            found = connection.execute(_SETTLED, (key, limits.seconds, limits.memory_gib)).fetchone()
        return found is not None

    def judged(self, key: str, judge: str) -> bool:
        """Tell whether a case has a score by this judge."""
        with self._connection() as connection:
            asked = "SELECT 1 FROM scores WHERE key = ? AND judge = ?"
            return connection.execute(asked, (key, judge)).fetchone() is not None

    def record(self, outcome: Outcome, limits: Limits) -> None:
        """Write answer and score of a case in one transaction."""
        case, answer = outcome.case, outcome.answer
        values = (
            case.key, case.scene.name, case.method.name, case.options, case.repetition, answer.kind, answer.failure,
            answer.detail, answer.seconds, answer.peak_mib, limits.seconds, limits.memory_gib, answer.estimate,
        )  # fmt: skip
        with self._connection() as connection:
            connection.execute(
                "INSERT OR REPLACE INTO answers (key, scene, method, options, repetition, kind, failure, detail, "
                f"seconds, peak_mib, limit_s, limit_gib, estimate) VALUES ({', '.join('?' * len(values))})",
                values,
            )
            _write_score(connection, case.key, outcome.judge, outcome.metrics)

    def record_score(self, key: str, judge: str, metrics: Mapping[str, float]) -> None:
        """Write a score of an answer that is on record."""
        with self._connection() as connection:
            _write_score(connection, key, judge, metrics)

    def record_limit(self, identity: str, version: str, limit: SceneLimit) -> None:
        """Write the physical limit of a scene; an older one is replaced."""
        values = (identity, version, limit.window_px, limit.reason, _packed_map(limit.sigma_um))
        with self._connection() as connection:
            connection.execute("INSERT OR REPLACE INTO limits VALUES (?, ?, ?, ?, ?)", values)

    def limit(self, identity: str, version: str = "") -> SceneLimit | None:
        """Read the limit of a scene, by this version of its code if one is named; None where it is not on record."""
        asked = "SELECT window_px, reason, sigma_um FROM limits WHERE identity = ? AND ? IN ('', version)"
        with self._connection() as connection:
            found = connection.execute(asked, (identity, version)).fetchone()
        return None if found is None else SceneLimit(_unpacked_map(found[2]), found[0], found[1])

    def record_bounds(self, version: str, bounds_um: Mapping[str, float]) -> None:
        """Write the limit over what each of some answers covers, by the key of its case, in one transaction."""
        values = [(key, version, bound_um) for key, bound_um in bounds_um.items()]
        with self._connection() as connection:
            connection.executemany("INSERT OR REPLACE INTO bounds VALUES (?, ?, ?)", values)

    def bounded(self, key: str, version: str) -> bool:
        """Tell whether the limit over what the answer to a case covers is on record, by this version of its code."""
        with self._connection() as connection:
            asked = "SELECT 1 FROM bounds WHERE key = ? AND version = ?"
            return connection.execute(asked, (key, version)).fetchone() is not None

    def answer(self, case: Case) -> Answer:
        """Read the answer to a case, its estimate included; raises `KeyError` if there is none."""
        asked = "SELECT kind, failure, seconds, peak_mib, estimate, detail FROM answers WHERE key = ?"
        with self._connection() as connection:
            found = connection.execute(asked, (case.key,)).fetchone()
        if found is None:
            raise KeyError(case.key)
        kind, failure, seconds, peak_mib, estimate, detail = found
        return Answer(case.key, kind, failure, _number(seconds), _number(peak_mib), estimate, detail)

    def results(self, keys: Sequence[str], judge: str) -> list[Result]:
        """Read what tables show of these cases, in their order; those without an answer are left out."""
        asked = (
            "SELECT a.key, scene, method, repetition, kind, failure, seconds, peak_mib, metrics, options, b.key, "
            "bound_um FROM answers a LEFT JOIN scores s ON s.key = a.key AND s.judge = ? "
            "LEFT JOIN bounds b ON b.key = a.key WHERE a.key = ?"
        )
        with self._connection() as connection:
            found = [connection.execute(asked, (judge, key)).fetchone() for key in keys]
        return [_result(row) for row in found if row is not None]

    def count(self) -> int:
        """How many answers there are."""
        with self._connection() as connection:
            return int(connection.execute("SELECT count(*) FROM answers").fetchone()[0])

    @contextmanager
    def _connection(self) -> Iterator[sqlite3.Connection]:
        opened = connect_frozen(self.path) if self.frozen else sqlite3.connect(self.path, timeout=60)
        with closing(opened) as connection, connection:
            yield connection


def _write_score(connection: sqlite3.Connection, key: str, judge: str, metrics: Mapping[str, float]) -> None:
    values = (key, judge, json.dumps(dict(metrics)))
    connection.execute("INSERT OR REPLACE INTO scores (key, judge, metrics) VALUES (?, ?, ?)", values)


def _result(row: Sequence[Any]) -> Result:
    key, scene, method, repetition, kind, failure, seconds, peak_mib, said, options, bounded, bound_um = row
    times, metrics = (_number(seconds), _number(peak_mib)), json.loads(said or "{}")
    if metrics and bounded:
        bound = _number(bound_um)
        metrics |= {"bound_um": bound, "efficiency": metrics.get("median_um", NAN) / bound}
    return Result(key, scene, method, repetition, kind, failure, *times, metrics, options)


def _packed_map(values: Array) -> bytes:
    buffer = io.BytesIO()
    np.savez_compressed(buffer, values=values.astype(np.float32))
    return buffer.getvalue()


def _unpacked_map(blob: bytes) -> Array:
    with np.load(io.BytesIO(blob)) as stored:
        return np.asarray(stored["values"], dtype=np.float64)


def _number(value: float | None) -> float:
    """SQLite keeps a NaN as NULL."""
    return NAN if value is None else float(value)
