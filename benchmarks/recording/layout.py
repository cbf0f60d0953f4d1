"""How the viewer of a recording is arranged, in plain values: what the one file that knows rerun makes views of."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True)
class Space:
    """A view of surfaces in space, from the front and above, as far away as the field of view is wide.

    Parameters
    ----------
    contents
        Paths that it shows; one that ends with ``/**`` shows all beneath.
    width_um
        Of the field of view.
    centre_um
        What it looks at, (x, y, z).
    """

    name: str
    contents: tuple[str, ...]
    width_um: float
    centre_um: tuple[float, float, float] = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class Flat:
    """A view of one thing: a picture, series over the timeline that is chosen, a text, or the messages of a log."""

    kind: Literal["picture", "series", "text", "log"]
    name: str
    path: str


@dataclass(frozen=True)
class Box:
    """Views beside each other, above each other, in a grid, or behind each other.

    Parameters
    ----------
    shares
        Of the width or height, one a part; all alike where there are none.
    name
        What the tab says where it is one of several behind each other.
    """

    kind: Literal["across", "down", "grid", "tabs"]
    parts: tuple[Part, ...]
    shares: tuple[float, ...] = ()
    name: str = ""


Part = Box | Space | Flat
"""What an arrangement is made of."""
