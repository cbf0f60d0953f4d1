"""XYZ text files: one point a line, which every program for point clouds reads."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from semrecon.data import PointCloud


def write_xyz(path: Path, points: PointCloud) -> None:
    """Write x, y and z in um, world frame, with blanks between and no header: some readers stumble over one."""
    np.savetxt(path, points.xyz_um, fmt="%.9g", newline="\n", encoding="ascii")
