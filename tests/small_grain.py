"""A scene that is small enough to be photographed and reconstructed within a test."""

from __future__ import annotations

from benchmarks.running import case

GRAIN = """
[specimen]
name = "pollen"
edge_um = 1.2
frame_width_um = 96.0
frame_height_um = 72.0
[microscope]
pixel_size_um = 0.6
width_px = 160
height_px = 120
[schedule]
tilts_deg = [0.0, 5.0]
"""
"""A pollen grain of coarse mesh on a small field: a second to prepare."""


def close_cell() -> None:
    """End the process that called the methods of this thread."""
    case._cells.own.close()
