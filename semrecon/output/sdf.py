"""Surface data files (.sdf, ISO 25178-71, text form) of height maps, for surface metrology programs."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from semrecon.data import HeightMap

MAGIC = "aISO-1.0"
"""Text form of the first edition of ISO 25178-71; the older "aBCR-1.0" leaves the order of profiles open."""
DOUBLE = 7
"""Number of the format for 64 bit floats."""
METRES_PER_UM = 1e-6


def write_sdf(path: Path, heights: HeightMap) -> None:
    """Write a height map: a header, the heights row by row, a trailer, each ended by an asterisk.

    The format counts lengths in metres and heights in units of `Zscale`, which is 1e-6 here: the numbers are um. Its
    first profile lies at y = 0 and y grows from profile to profile in a right-handed frame, so the lowest row of the
    image is written first. Missing heights are the word BAD.
    """
    with path.open("w", encoding="ascii", newline="\r\n") as file:
        file.write(_header(heights))
        for row in heights.z_um[::-1]:
            file.write("\n".join(f"{z:.9g}" if np.isfinite(z) else "BAD" for z in row.tolist()) + "\n")
        file.write("*\n*\n")


def _header(heights: HeightMap) -> str:
    """Record 1 of the format, in its fixed order; a negative resolution means unknown."""
    rows, columns = heights.z_um.shape
    now = datetime.now(UTC).strftime("%d%m%Y%H%M")
    pitch = heights.pixel_size_um * METRES_PER_UM
    fields = {
        "ManufacID": "semrecon",
        "CreateDate": now,
        "ModDate": now,
        "NumPoints": columns,
        "NumProfiles": rows,
        "Xscale": f"{pitch:.12g}",
        "Yscale": f"{pitch:.12g}",
        "Zscale": f"{METRES_PER_UM:.12g}",
        "Zresolution": -1,
        "Compression": 0,
        "DataType": DOUBLE,
        "CheckType": 0,
    }
    return "\n".join([MAGIC, *(f"{name} = {value}" for name, value in fields.items()), "*", ""])
