"""Specimens: what can be photographed, by name or from a file.

A specimen is a frozen dataclass of its options with a `name`, called with a random generator for its mesh. A new one is
a file and a line in `SPECIMENS`.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, ClassVar, Protocol

import numpy as np

from semsim.errors import InputError
from semsim.mesh import Mesh
from semsim.specimens.analytic import Plane, Sphere, Step, Wedge
from semsim.specimens.artefacts import Pyramid, Steps
from semsim.specimens.diatom import Diatom
from semsim.specimens.files import HEIGHT_MAP_SUFFIXES, HeightMapFile, MeshFile
from semsim.specimens.fracture import Fracture
from semsim.specimens.grains import Grains
from semsim.specimens.options import checked_options
from semsim.specimens.pollen import Pollen
from semsim.specimens.spheres import Spheres
from semsim.specimens.wires import Wires

__all__ = [
    "SPECIMENS",
    "Diatom",
    "Fracture",
    "Grains",
    "HeightMapFile",
    "MeshFile",
    "Plane",
    "Pollen",
    "Pyramid",
    "Specimen",
    "Sphere",
    "Spheres",
    "Step",
    "Steps",
    "Wedge",
    "Wires",
    "build",
    "specimen_from",
]


class Specimen(Protocol):
    """What can be photographed."""

    name: ClassVar[str]

    def __call__(self, rng: np.random.Generator) -> Mesh:
        """Return the mesh; the same state of the generator gives the same arrays."""


SPECIMENS: tuple[Any, ...] = (
    Pollen,
    Diatom,
    Fracture,
    Grains,
    Wires,
    Spheres,
    Pyramid,
    Steps,
    Plane,
    Step,
    Sphere,
    Wedge,
)


def specimen_from(options: Mapping[str, Any], base_dir: Path | None = None) -> Specimen:
    """Return the specimen that a table of options describes, as it stands in a scene's TOML.

    Parameters
    ----------
    options
        `name` and options of a procedural specimen, or `file` and options of a mesh or height map.
    base_dir
        Where a relative `file` starts; None is the working directory.

    Raises
    ------
    InputError
        If the specimen or an option is unknown, or a value is of the wrong kind.
    """
    rest = dict(options)
    if ("name" in rest) == ("file" in rest):
        raise InputError(
            'a specimen needs either a name (such as "pollen") or a file (a mesh or a height map), not both'
        )
    if "name" in rest:
        kind = _named(rest.pop("name"))
        named: Specimen = kind(**checked_options(kind, rest))
        return named
    path = (base_dir or Path()) / str(rest.pop("file"))
    reader = HeightMapFile if path.suffix.lower() in HEIGHT_MAP_SUFFIXES else MeshFile
    return reader(**checked_options(reader, {"file": path, **rest}))


def build(options: Mapping[str, Any], rng: np.random.Generator, base_dir: Path | None = None) -> Mesh:
    """Return the mesh of the specimen that a table of options describes."""
    return specimen_from(options, base_dir)(rng)


def _named(name: object) -> Any:
    """Return the specimen of a name; raise `InputError` that lists the names there are."""
    for kind in SPECIMENS:
        if kind.name == name:
            return kind
    names = ", ".join(kind.name for kind in SPECIMENS)
    raise InputError(f"there is no specimen {name!r}; the names are {names}")
