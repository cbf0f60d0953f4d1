"""Results as flat tables for other programs: CSV, and Parquet where pyarrow is installed."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from pathlib import Path

from benchmarks.running.bench_ledger import Result
from semrecon.errors import InputError

FIXED = ("scene", "method", "repetition", "kind", "failure", "seconds", "peak_mib")
"""Columns that every table begins with; those of the metrics follow in the order of the alphabet."""


def columns(results: Sequence[Result]) -> dict[str, list[object]]:
    """Turn results into columns; a metric that a case has not is NaN."""
    table: dict[str, list[object]] = {name: [getattr(each, name) for each in results] for name in FIXED}
    for name in sorted({metric for each in results for metric in each.metrics}):
        table[name] = [each.metrics.get(name, float("nan")) for each in results]
    return table | {"options": [each.options for each in results], "key": [each.key for each in results]}


def write_csv(path: Path, results: Sequence[Result]) -> None:
    """Write one line a case."""
    table = columns(results)
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(table)
        writer.writerows(zip(*table.values(), strict=True))


def write_parquet(path: Path, results: Sequence[Result]) -> None:
    """Write one line a case; raises `InputError` where pyarrow is missing."""
    try:
        import pyarrow  # type: ignore[import-untyped]  # has no types
        import pyarrow.parquet  # type: ignore[import-untyped]
    except ImportError:
        raise InputError(
            "Parquet needs pyarrow: pip install pyarrow, or take results.csv, which says the same"
        ) from None
    pyarrow.parquet.write_table(pyarrow.table(columns(results)), path, compression="zstd")
