"""A page of small pictures, one of every named scene and a pair of the main ones, with what was set to get them."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

from semsim.capture import simulate
from semsim.detector import Image
from semsim.errors import InputError
from semsim.scene import Scene, scaled
from semsim.scenes import NAMED, geometry, scene
from semsim.template import inline

PAIRED = ("pollen", "diatom")
"""Scenes shown by their first and their last view, which differ most in tilt."""
QUALITY = 82
SEED = 1
INTRODUCTION = """# Gallery

One small picture of every named scene, and two of a tilt series for the scenes that the studies rest on. Made by

    semsim gallery docs

from the same fields in fewer pixels; spot, scan errors and dose are those of a pixel of the smaller picture.
`semsim render NAME` makes the series in full, with its truth, and `semsim scene NAME` says what each setting means.
"""
Progress = Callable[[str, int, int], None]


def write_gallery(
    out_dir: str | Path, names: Sequence[str] | None = None, width_px: int = 480, progress: Progress | None = None
) -> Path:
    """Render every named scene, reduced, to img/gallery/*.jpg under a folder, and write gallery.md that shows them.

    Parameters
    ----------
    names
        Of the scenes; None is all there are.
    width_px
        Columns of a picture; a scene is never enlarged.

    Returns
    -------
    The page.

    Raises
    ------
    InputError
        A scene is unknown, or the folder cannot be made.
    """
    scenes = [scene(name) for name in (NAMED if names is None else names)]
    folder = Path(out_dir) / "img" / "gallery"
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{folder} cannot be made ({error.strerror}); give another folder for the gallery") from None
    parts = [INTRODUCTION]
    for done, full in enumerate(scenes, start=1):
        parts.append(_part(full, folder, width_px))
        if progress is not None:
            progress(full.name, done, len(scenes))
    page = Path(out_dir) / "gallery.md"
    page.write_text("\n".join(parts), encoding="utf-8")
    return page


def reduced(full: Scene, width_px: int) -> Scene:
    """Return a scene at no more than `width_px` columns."""
    width = full.microscope.width_px
    return full if width <= width_px else scaled(full, width_px / width)


def views_shown(full: Scene) -> tuple[int, ...]:
    """Return which views of a scene the gallery shows: the one nearest zero tilt, or the first and the last."""
    tilts = full.schedule.tilts_deg
    if full.name in PAIRED:
        return 0, len(tilts) - 1
    return (min(range(len(tilts)), key=lambda view: abs(tilts[view])),)


def settings(made: Any, default: Any) -> Iterator[str]:
    """Yield `name = value` of every field of a dataclass that is not the default, tables within tables included."""
    for field in dataclasses.fields(made):
        value, usual = getattr(made, field.name), getattr(default, field.name, None)
        if value == usual:
            continue
        if dataclasses.is_dataclass(value) and not isinstance(value, type):
            yield from (f"{field.name}.{each}" for each in settings(value, usual))
        else:
            yield f"{field.name} = {inline(value)}"


def _part(full: Scene, folder: Path, width_px: int) -> str:
    """Render one scene and return its part of the page."""
    images = simulate(reduced(full, width_px), SEED).images
    pictures = []
    for view in views_shown(full):
        path = folder / (f"{full.name}_{view}.jpg" if full.name in PAIRED else f"{full.name}.jpg")
        _write_jpeg(images[view], path)
        tilt = full.schedule.tilts_deg[view]
        pictures.append(f"![{full.name}, tilt {tilt:g} degrees](img/gallery/{path.name})")
    return f"## {full.name}\n\n{_caption(full)}\n\n{' '.join(pictures)}\n"


def _caption(full: Scene) -> str:
    facts = f"{geometry(full.microscope, full.schedule)}; {full.detector.dose_e:g} electrons a pixel."
    changed = [each for section in _sections(full) for each in section]
    lines = [NAMED[full.name].about, "", facts]
    return "\n".join([*lines, *(["", f"Set: `{'`, `'.join(changed)}`."] if changed else [])])


def _sections(full: Scene) -> Iterator[Iterator[str]]:
    """Yield what is set beside the defaults in each section that has any."""
    for field in dataclasses.fields(full):
        value = getattr(full, field.name)
        if not dataclasses.is_dataclass(value) or isinstance(value, type) or field.name in ("microscope", "schedule"):
            continue
        usual = type(value)() if field.name == "specimen" else _usual(field)
        yield (f"{field.name}.{each}" for each in settings(value, usual))


def _usual(field: dataclasses.Field[Any]) -> Any:
    return field.default if field.default_factory is dataclasses.MISSING else field.default_factory()


def _write_jpeg(image: Image, path: Path) -> None:
    """Write a grey picture of 8 bits; a picture of 16 keeps its upper 8."""
    from PIL import Image as Pillow

    eight = image if image.itemsize == 1 else image >> 8
    Pillow.fromarray(eight.astype("uint8")).save(path, quality=QUALITY, optimize=True)
