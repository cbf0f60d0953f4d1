"""Solids along upright lines, from meshes whose solids are known."""

import numpy as np
import pytest
from joined_meshes import inside_out, sheet, together

from semsim import layers as module
from semsim.layers import layers
from semsim.mesh import Mesh


def box(low, high) -> Mesh:
    """A closed box with faces that look outward."""
    corners = [(x, y, z) for x in (low[0], high[0]) for y in (low[1], high[1]) for z in (low[2], high[2])]
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    faces = [half for a, b, c, d in quads for half in ((a, b, c), (a, c, d))]
    return Mesh(np.array(corners, dtype=float), np.array(faces, dtype=np.int32))


def solids(mesh: Mesh, x: float, y: float, step_um: float = 0.5):
    """Solids along the line at (x, y), as tuples of top and bottom."""
    found = layers(mesh, np.array([-20.0, -20.0]), np.array([20.0, 20.0]), step_um)
    line = (round(y / step_um) - found.first[0]) * found.shape[1] + round(x / step_um) - found.first[1]
    return [tuple(ends) for ends in found.ends_um[found.start[line] : found.start[line + 1]]]


LOW, HIGH = box((-2.2, -2.2, 1), (2.2, 2.2, 3)), box((-1.2, -1.2, 5), (3.2, 1.2, 6))
SUNK, OVERLAPPING = box((-2.2, -2.2, -4), (2.2, 2.2, 2)), box((-1.2, -1.2, 2), (1.2, 1.2, 7))


@pytest.mark.parametrize(
    ("parts", "expected"),
    [
        ((LOW, HIGH), [(6, 5), (3, 1)]),
        ((LOW, HIGH, sheet(0.0, 9.0)), [(6, 5), (3, 1), (0, -np.inf)]),
        ((SUNK, sheet(0.0, 9.0)), [(2, -np.inf)]),
        ((LOW, OVERLAPPING), [(7, 1)]),
        ((sheet(4.0, 9.0), LOW), [(4, -np.inf)]),
    ],
    ids=["two in the air", "over a sheet", "sunk in a sheet", "overlapping", "under a sheet"],
)
def test_solids_are_counted_whichever_way_the_mesh_turns(parts, expected):
    mesh = together(*parts)
    assert solids(mesh, 0.5, -1.0) == expected
    assert solids(inside_out(mesh), 0.5, -1.0) == expected


def test_lines_stand_in_the_world_and_not_in_the_box():
    mesh = together(LOW, HIGH, sheet(0.0, 9.0))
    whole = layers(mesh, np.array([-9.0, -9.0]), np.array([9.0, 9.0]), 0.3)
    part = layers(mesh, np.array([-1.07, 0.2]), np.array([3.4, 2.9]), 0.3)
    assert part.shape == (9, 15)
    for row in range(part.shape[0]):
        for column in range(part.shape[1]):
            here = row * part.shape[1] + column
            there = (row + part.first[0] - whole.first[0]) * whole.shape[1] + column + part.first[1] - whole.first[1]
            one = part.ends_um[part.start[here] : part.start[here + 1]]
            assert np.array_equal(one, whole.ends_um[whole.start[there] : whole.start[there + 1]])


def test_a_box_beside_the_mesh_holds_nothing():
    found = layers(LOW, np.array([50.0, 50.0]), np.array([60.0, 60.0]), 0.5)
    assert np.prod(found.shape) == 0
    assert len(found.ends_um) == 0


def test_a_lattice_too_large_is_made_coarser(monkeypatch):
    monkeypatch.setattr(module, "MOST_LINES", 100)
    found = layers(sheet(0.0, 9.0), np.array([-9.0, -9.0]), np.array([9.0, 9.0]), 0.5)
    assert found.step_um == 2.0
    assert np.prod(found.shape) <= 100
