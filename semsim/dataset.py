"""Training sets: many scenes and seeds rendered into folders, by one call that can be stopped and called again."""

from __future__ import annotations

import csv
import hashlib
import io
import os
import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Executor, Future, wait
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from semsim.capture import simulate
from semsim.errors import InputError
from semsim.io import write_series
from semsim.overrides import overridden
from semsim.scene import Scene, tables
from semsim.scenes import load_scene
from semsim.surface import Backend
from semsim.variation import Variation
from semsim.workers import process_pool

INDEX = "index.csv"
COLUMNS = ("folder", "scene", "number", "specimen_seed", "instrument_seed", "noise_seed")
"""First columns of the index; what varies follows."""

Progress = Callable[[str, int, int], None]
"""Called with the folder just finished, how many are done, and how many there are."""


@dataclass(frozen=True)
class Sample:
    """One series of a training set.

    Parameters
    ----------
    folder
        Name of its folder.
    number
        Counts the series of one scene from 0.
    scene
        What is photographed, variations and specimen seed included.
    noise_seed
        Of its noise.
    varied
        Value of each setting that was drawn.
    """

    folder: str
    number: int
    scene: Scene
    noise_seed: int
    varied: Mapping[str, Any] = field(default_factory=dict)


def plan(scenes: Sequence[Scene], seeds: int, variations: Sequence[Variation] = ()) -> tuple[Sample, ...]:
    """Lay down every series of a training set; nothing is rendered yet.

    Each seed and each drawn value comes from the SHA-256 of the scene's name, the number and what it is for. So a
    series does not depend on how many others there are, and more can be added later.

    Raises
    ------
    InputError
        No series at all, two scenes of one name, or a variation that does not suit a scene.
    """
    if seeds < 1:
        raise InputError(f"a training set needs 1 seed or more, not {seeds}")
    names = [scene.name for scene in scenes]
    if doubles := sorted({name for name in names if names.count(name) > 1}):
        raise InputError(f"two scenes are called {doubles[0]}; give each a name of its own")
    return tuple(_sample(scene, number, variations) for scene in scenes for number in range(seeds))


def render_dataset(
    samples: Sequence[Sample],
    out_dir: str | Path,
    workers: int = 1,
    backend: Backend = "auto",
    progress: Progress | None = None,
) -> Path:
    """Render every series that is not there yet into a folder of its own, and keep an index of what is there.

    A folder appears whole or not at all, so a run that was stopped is continued by the same call. The bits do not
    depend on the order or on the number of workers.

    Parameters
    ----------
    samples
        From `plan`.
    out_dir
        New, empty, or a training set that was begun before.
    workers
        Processes side by side. In a script, guard the call by ``if __name__ == "__main__":``.

    Returns
    -------
    The index: a CSV file with a row for each series that is there.

    Raises
    ------
    InputError
        The folder holds something else, or the same folders of other settings.
    """
    out = Path(out_dir).absolute()
    require_dataset(out)
    done = [sample for sample in samples if _is_rendered(sample, out)]
    out.mkdir(parents=True, exist_ok=True)
    _remove_remains(out)
    index = _write_index(samples, done, out)
    there = {sample.folder for sample in done}
    missing = [sample for sample in samples if sample.folder not in there]
    with _executor(min(workers, len(missing) or 1)) as executor:
        for sample in _finished(missing, executor, workers, out, backend):
            done.append(sample)
            _write_index(samples, done, out)
            if progress is not None:
                progress(sample.folder, len(done), len(samples))
    return index


def require_dataset(out: Path) -> None:
    """Raise InputError unless a folder can be made, is empty, or holds a training set."""
    if out.exists() and not out.is_dir():
        raise InputError(f"{out} is a file; give a folder for the training set")
    home = next(parent for parent in (out, *out.absolute().parents) if parent.exists())
    if not (home.is_dir() and os.access(home, os.W_OK)):
        raise InputError(f"{out} cannot be made, since {home} is not a folder that can be written to; give another")
    if not out.exists() or not any(out.iterdir()):
        return
    index = out / INDEX
    if not (index.is_file() and index.read_text(encoding="utf-8", errors="replace").startswith(",".join(COLUMNS))):
        raise InputError(f"{out} holds something else than a training set; give a new or empty folder")


def _sample(scene: Scene, number: int, variations: Sequence[Variation]) -> Sample:
    varied = {each.name: each.draw(scene, _seed(scene, number, each.name)) for each in variations}
    changed = overridden(scene, varied) if varied else scene
    planned = replace(
        changed,
        specimen_seed=_seed(scene, number, "specimen"),
        instrument_seed=_seed(scene, number, "instrument"),
    )
    return Sample(f"{scene.name}_{number:04d}", number, planned, _seed(scene, number, "noise"), varied)


def _seed(scene: Scene, number: int, purpose: str) -> int:
    """63 bits of the SHA-256 of what a seed is for: TOML has no larger whole numbers."""
    content = hashlib.sha256(f"{scene.name}\n{number}\n{purpose}".encode())
    return int.from_bytes(content.digest()[:8], "big") >> 1


def _is_rendered(sample: Sample, out: Path) -> bool:
    """Tell whether a series is there; raises InputError where its folder holds another one."""
    folder = out / sample.folder
    if not folder.exists():
        return False
    settings = folder / "truth" / "settings.toml"
    if not settings.is_file() or tables(load_scene(settings)) != tables(sample.scene):
        raise InputError(f"{folder} was rendered with other settings; give the same settings or a new folder")
    return True


def _remove_remains(out: Path) -> None:
    """Remove the half-written folders of runs that were killed; those of a run that still lives stay."""
    for path in out.glob(".*.*.partial"):
        pid = path.suffixes[-2].removeprefix(".")
        if not (pid.isdigit() and _lives(int(pid))):
            path.unlink() if path.is_file() else shutil.rmtree(path, ignore_errors=True)


def _lives(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        return True
    return True


def _write_index(samples: Sequence[Sample], done: Sequence[Sample], out: Path) -> Path:
    """Write the rows of what is there, whole or not at all: first those of an earlier plan, then those of this one."""
    rows = {row["folder"]: row for row in _earlier_rows(out)} | {each.folder: _row(each) for each in done}
    planned = {each.folder: i for i, each in enumerate(samples)}
    order = sorted(rows, key=lambda folder: planned.get(folder, -1))
    columns = dict.fromkeys([*COLUMNS, *(key for row in rows.values() for key in row)])
    text = io.StringIO()
    writer = csv.DictWriter(text, list(columns), lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows[folder] for folder in order)
    partial = out / f".{INDEX}.{os.getpid()}.partial"
    partial.write_text(text.getvalue(), encoding="utf-8")
    return partial.replace(out / INDEX)


def _earlier_rows(out: Path) -> list[dict[str, str]]:
    if not (out / INDEX).is_file():
        return []
    with (out / INDEX).open(encoding="utf-8", newline="") as file:
        return [row for row in csv.DictReader(file) if (out / row["folder"]).is_dir()]


def _row(sample: Sample) -> dict[str, Any]:
    scene = sample.scene
    seeds = (scene.specimen_seed, scene.instrument_seed, sample.noise_seed)
    return dict(zip(COLUMNS, (sample.folder, scene.name, sample.number, *seeds), strict=True)) | dict(sample.varied)


def _finished(
    samples: Sequence[Sample], executor: Executor | None, workers: int, out: Path, backend: Backend
) -> Iterator[Sample]:
    """Render samples here or by workers, and yield each as it is finished; few are handed out at a time."""
    if executor is None:
        for sample in samples:
            yield _render(sample, out, backend)
        return
    waiting, running = list(samples), set[Future[Sample]]()
    while waiting or running:
        while waiting and len(running) < 2 * workers:
            running.add(executor.submit(_render, waiting.pop(0), out, backend))
        finished, running = wait(running, return_when=FIRST_COMPLETED)
        yield from (each.result() for each in finished)


def _render(sample: Sample, out: Path, backend: Backend) -> Sample:
    try:
        write_series(simulate(sample.scene, sample.noise_seed, backend=backend), out / sample.folder, sample.noise_seed)
    except InputError as error:
        raise InputError(f"{sample.folder}: {error}") from error
    return sample


@contextmanager
def _executor(workers: int) -> Iterator[Executor | None]:
    """Lend processes, or none where one is enough; what was not begun is dropped when anything goes wrong."""
    if workers == 1:
        yield None
        return
    executor = process_pool(workers)
    try:
        yield executor
    finally:
        executor.shutdown(cancel_futures=True)
