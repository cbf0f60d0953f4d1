"""What a run was of, on what, by which code: written beside the ledger, so that a report need not guess."""

from __future__ import annotations

import json
import os
import platform
import subprocess
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from benchmarks.running.bench import Plan
from benchmarks.running.case import Case, contender_of, judge_version, needs_of
from benchmarks.suite import BenchScene, Purpose, described
from semrecon.errors import InputError
from semrecon.reconstruction import versions

MANIFEST, SWEEP_MANIFEST, PLAN_MANIFEST = "run.json", "sweep.json", "plan.json"
_ROOT = Path(__file__).resolve().parents[2]


@dataclass(frozen=True)
class MethodRecord:
    """What tables say of a method; stands in for it where it is not called.

    `given` is what an oracle was handed of the truth, "" for a method.
    """

    name: str
    needs: tuple[str, ...]
    gauge: tuple[str, ...]
    citation: str = ""
    given: str = ""
    options: str = ""


@dataclass(frozen=True)
class SceneRecord:
    """A scene's name, a sentence on it, and the digest of all that decides its images."""

    name: str
    about: str
    identity: str


@dataclass(frozen=True)
class CaseRecord:
    """Where a case stands in the ledger."""

    key: str
    scene: str
    method: str
    repetition: int


@dataclass(frozen=True)
class Manifest:
    """A run, a sweep or a plan.

    Parameters
    ----------
    quick, purpose
        Which suite of scenes it was.
    cases
        Empty for a plan, which chooses them as it goes.
    judge
        Version of the judge whose scores its tables show.
    started
        UTC, ISO 8601.
    code
        Commit, and whether files were changed since; "" where this is no checkout.
    command
        What was typed; "" where that is not known.
    settings
        What else decides it: of a sweep, all that its scenes are made from.
    """

    quick: bool
    purpose: Purpose
    repetitions: int
    limit_s: float
    limit_gib: float
    judge: str
    started: str
    code: str
    machine: Mapping[str, str]
    versions: Mapping[str, str]
    methods: tuple[MethodRecord, ...]
    scenes: tuple[SceneRecord, ...]
    cases: tuple[CaseRecord, ...]
    command: str = ""
    settings: Mapping[str, Any] = field(default_factory=dict)


def manifest_of(
    plan: Plan,
    *,
    quick: bool,
    purpose: Purpose,
    command: str = "",
    settings: Mapping[str, Any] | None = None,
) -> Manifest:
    """Say what a plan is of, and what it runs on; `settings` must be what JSON can hold."""
    return Manifest(
        quick,
        purpose,
        plan.repetitions,
        plan.limits.seconds,
        plan.limits.memory_gib,
        judge_version(),
        datetime.now(UTC).isoformat(timespec="seconds"),
        commit(),
        machine(),
        versions(),
        tuple(_method(each) for each in plan.methods),
        tuple(_scene(each) for each in plan.scenes),
        tuple(_case(each) for each in plan.cases),
        command,
        dict(settings or {}),
    )


def write_manifest(out: Path, manifest: Manifest, name: str = MANIFEST) -> None:
    """Write it beside the ledger; the file is replaced as a whole."""
    partial = out / f"{name}.{os.getpid()}.partial"
    partial.write_text(json.dumps(asdict(manifest), indent=1) + "\n", encoding="utf-8")
    partial.replace(out / name)


def read_manifest(folder: Path, name: str = MANIFEST) -> Manifest:
    """Read what `write_manifest` wrote; raises `InputError` where there is none or it is damaged."""
    path, what = folder / name, name.removesuffix(".json")
    try:
        table: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
        table["methods"] = tuple(_method_from(each) for each in table["methods"])
        table["scenes"] = tuple(SceneRecord(**each) for each in table["scenes"])
        table["cases"] = tuple(CaseRecord(**each) for each in table["cases"])
        return Manifest(**table)
    except FileNotFoundError:
        raise InputError(
            f"{folder} has no {name}; name the folder of a {what}, or repeat the command that made it with "
            f"--out {folder}: what is on record is not run again"
        ) from None
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InputError(
            f"{path} is damaged ({error}); repeat the command that made the {what} with --out {folder}: what is on "
            "record is not run again"
        ) from error


def origin(manifest: Manifest) -> list[str]:
    """Say in Markdown which command, code and machine a page rests on."""
    versions_of = ", ".join(f"{name} {version}" for name, version in manifest.versions.items())
    machine_of = ", ".join(f"{name} {value}" for name, value in manifest.machine.items())
    typed = [f"    {manifest.command}", ""] if manifest.command else []
    return [
        "## Where it comes from",
        "",
        *typed,
        f"Begun {manifest.started} by commit {manifest.code or 'not known'}; {machine_of}; {versions_of}.",
        "",
    ]


def commit() -> str:
    """Commit of the code, and whether it was changed since; "" where that cannot be told."""
    head = _git("rev-parse", "--short=12", "HEAD")
    if not head:
        return ""
    return f"{head}, with changes" if _git("status", "--porcelain", "--untracked-files=no") else head


def machine() -> dict[str, str]:
    """Describe the machine without its name."""
    found = {"system": f"{platform.system()} {platform.release()}", "cores": str(os.cpu_count() or "unknown")}
    processor = _field("/proc/cpuinfo", "model name") or platform.processor() or platform.machine()
    memory = _field("/proc/meminfo", "MemTotal")
    if memory:
        found["memory"] = f"{int(memory.split()[0]) / (1 << 20):.0f} GiB"
    return {"processor": processor, **found}


def _method(method: Any) -> MethodRecord:
    gauge = tuple(contender_of(method).gauge)
    about = (str(getattr(method, "citation", "")), str(getattr(method, "given", "")))
    return MethodRecord(method.name, needs_of(method), gauge, *about, repr(method))


def _method_from(table: Mapping[str, Any]) -> MethodRecord:
    return MethodRecord(**{**table, "needs": tuple(table["needs"]), "gauge": tuple(table["gauge"])})


def _scene(scene: BenchScene) -> SceneRecord:
    return SceneRecord(scene.name, described(scene), scene.identity)


def _case(case: Case) -> CaseRecord:
    return CaseRecord(case.key, case.scene.name, case.method.name, case.repetition)


def _git(*arguments: str) -> str:
    command: Sequence[str] = ("git", "-C", str(_ROOT), *arguments)
    try:
        done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=30)
    except (OSError, subprocess.TimeoutExpired):
        return ""
    return done.stdout.strip() if done.returncode == 0 else ""


def _field(path: str, name: str) -> str:
    try:
        lines = Path(path).read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError:
        return ""
    return next((line.partition(":")[2].strip() for line in lines if line.startswith(name)), "")
