"""Photograph a known mesh the way an SEM would and keep the exact truth. Knows nothing of reconstruction.

A scene says everything that decides what the micrographs look like, save the seed of their noise:

>>> import semsim
>>> scene = semsim.load_scene("wedge")  # a named scene (`semsim scenes` lists them) or a TOML file
>>> scene = semsim.overridden(scene, {"detector.dose_e": 50, "specimen.edge_um": 2.0})
>>> capture = semsim.simulate(semsim.scaled(scene, 0.5), seed=1)
>>> capture.images[0].shape  # grey levels, (rows, columns)
(96, 128)
>>> capture.truth.height_map(0).shape  # um; and `normals`, `visibility`, `correspondence`, `poses`
(96, 128)

`write_series` and `read_truth` keep a capture in a folder, `write_contact_sheet` draws one. `prepare` finds the
surfaces once and `expose` photographs them often. `semsim.dataset` makes training sets, `semsim.specimens` holds what
can be photographed. Frames, signs and units are those of docs/conventions.md; docs/simulating.md is a guide.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from semsim.backscatter import BackscatterOptions
    from semsim.capture import Capture, Surfaces, expose, prepare, simulate
    from semsim.charging import ChargingOptions
    from semsim.databar import DataBarOptions
    from semsim.detector import DetectorOptions
    from semsim.errors import InputError
    from semsim.figures import write_contact_sheet
    from semsim.imperfections import StageErrors, ViewErrors
    from semsim.io import read_truth, write_series
    from semsim.mesh import Mesh
    from semsim.microscope import Microscope, TiltSchedule
    from semsim.overrides import overridden
    from semsim.scan import ScanOptions
    from semsim.scene import Scene, scaled
    from semsim.scenes import load_scene
    from semsim.signal import SignalOptions
    from semsim.spot import SpotOptions
    from semsim.truth import GroundTruth

__version__ = "0.1.0"

_HOME = {
    "BackscatterOptions": "backscatter",
    "Capture": "capture",
    "ChargingOptions": "charging",
    "DataBarOptions": "databar",
    "DetectorOptions": "detector",
    "GroundTruth": "truth",
    "InputError": "errors",
    "Mesh": "mesh",
    "Microscope": "microscope",
    "ScanOptions": "scan",
    "Scene": "scene",
    "SignalOptions": "signal",
    "SpotOptions": "spot",
    "StageErrors": "imperfections",
    "Surfaces": "capture",
    "TiltSchedule": "microscope",
    "ViewErrors": "imperfections",
    "expose": "capture",
    "load_scene": "scenes",
    "overridden": "overrides",
    "prepare": "capture",
    "read_truth": "io",
    "scaled": "scene",
    "simulate": "capture",
    "write_contact_sheet": "figures",
    "write_series": "io",
}
__all__ = [
    "BackscatterOptions",
    "Capture",
    "ChargingOptions",
    "DataBarOptions",
    "DetectorOptions",
    "GroundTruth",
    "InputError",
    "Mesh",
    "Microscope",
    "ScanOptions",
    "Scene",
    "SignalOptions",
    "SpotOptions",
    "StageErrors",
    "Surfaces",
    "TiltSchedule",
    "ViewErrors",
    "expose",
    "load_scene",
    "overridden",
    "prepare",
    "read_truth",
    "scaled",
    "simulate",
    "write_contact_sheet",
    "write_series",
]


def __getattr__(name: str) -> Any:
    """Import a public name when it is first asked for, so that `semsim --help` waits for none of them."""
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_HOME[name]}"), name)


def __dir__() -> list[str]:
    """Name what can be asked for, so that `help(semsim)` and completion show it."""
    return sorted({*globals(), *__all__})
