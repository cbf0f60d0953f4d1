"""Methods of reconstruction: one file a method, all with the call of `base.Method`. To add one, add a line here."""

from __future__ import annotations

from dataclasses import fields, replace
from typing import Any

from semrecon.errors import InputError
from semrecon.methods.affine_factorization import AffineFactorization
from semrecon.methods.base import Method
from semrecon.methods.dense_multiview import DenseMultiview
from semrecon.methods.disparity import Disparity, DisparityIcp
from semrecon.methods.essential_sfm import EssentialSfm
from semrecon.methods.incremental_sfm import IncrementalSfm
from semrecon.methods.known_rotation import KnownRotation
from semrecon.methods.light_field import LightField
from semrecon.methods.multiview_sfm import MultiviewSfm
from semrecon.methods.outside import outside_methods
from semrecon.methods.photometric_stereo import PhotometricStereo, UncalibratedPhotometricStereo
from semrecon.methods.shape_from_shading import ShapeFromShading

__all__ = [
    "METHODS",
    "DenseMultiview",
    "Disparity",
    "DisparityIcp",
    "KnownRotation",
    "Method",
    "all_methods",
    "method_named",
]

METHODS: tuple[Method, ...] = (
    DenseMultiview(),
    KnownRotation(),
    Disparity(),
    DisparityIcp(),
    EssentialSfm(),
    IncrementalSfm(),
    AffineFactorization(),
    MultiviewSfm(),
    PhotometricStereo(),
    UncalibratedPhotometricStereo(),
    ShapeFromShading(),
    LightField(),
)
"""Every method of this project with its default options."""


def all_methods() -> tuple[Method, ...]:
    """Methods of this project, then those of other packages; a name counts once, and ours goes first."""
    ours = {method.name for method in METHODS}
    return METHODS + tuple(method for method in outside_methods() if method.name not in ours)


def method_named(name: str, **options: Any) -> Method:
    """Pick a method, of this project or of another package, by its name (hyphens are underscores) and set its options.

    Raises
    ------
    InputError
        There is no such method, or it has no such option.
    """
    known = all_methods()
    found = next((method for method in known if method.name == name.replace("-", "_")), None)
    if found is None:
        raise InputError(f"there is no method {name!r}; the methods are {', '.join(m.name for m in known)}")
    allowed = [one.name for one in fields(found)]  # type: ignore[arg-type]  # a Method is a dataclass by agreement
    unknown = [option for option in options if option not in allowed]
    if unknown:
        raise InputError(f"method {found.name} has no option {unknown[0]!r}; its options are {', '.join(allowed)}")
    return replace(found, **options)  # type: ignore[type-var]
