"""Photograph a known mesh the way an SEM would and keep the exact truth. Knows nothing of reconstruction.

>>> capture = semsim.simulate(semsim.load_scene("pollen"), seed=1)  # doctest: +SKIP
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from semsim.capture import Capture, Surfaces, expose, prepare, simulate
    from semsim.errors import InputError
    from semsim.io import read_truth, write_series
    from semsim.mesh import Mesh
    from semsim.microscope import Microscope, TiltSchedule
    from semsim.scene import Scene, load_scene, scaled
    from semsim.truth import GroundTruth

__version__ = "0.1.0"

_HOME = {
    "Capture": "capture",
    "GroundTruth": "truth",
    "InputError": "errors",
    "Mesh": "mesh",
    "Microscope": "microscope",
    "Scene": "scene",
    "Surfaces": "capture",
    "TiltSchedule": "microscope",
    "expose": "capture",
    "load_scene": "scene",
    "prepare": "capture",
    "read_truth": "io",
    "scaled": "scene",
    "simulate": "capture",
    "write_series": "io",
}
__all__ = [
    "Capture",
    "GroundTruth",
    "InputError",
    "Mesh",
    "Microscope",
    "Scene",
    "Surfaces",
    "TiltSchedule",
    "expose",
    "load_scene",
    "prepare",
    "read_truth",
    "scaled",
    "simulate",
    "write_series",
]


def __getattr__(name: str) -> Any:
    """Import a public name when it is first asked for, so that `semsim --help` waits for none of them."""
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_HOME[name]}"), name)
