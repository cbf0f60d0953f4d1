"""Draw docs/img/frames.svg, the picture in docs/conventions.md, with nothing but Python: python3 docs/img/frames.py."""

from __future__ import annotations

import math
from pathlib import Path

WORLD, CAMERA, TILT, GREY, INK = "#1261a0", "#c2571a", "#2e7d32", "#8a8f98", "#20242a"
THETA = math.radians(18)
Point = tuple[float, float]


def line(a: Point, b: Point, colour: str = GREY, width: float = 1.5, dash: str = "", head: bool = False) -> str:
    extra = f' stroke-dasharray="{dash}"' if dash else ""
    extra += f' marker-end="url(#head{colour[1:]})"' if head else ""
    return (
        f'<line x1="{a[0]:.1f}" y1="{a[1]:.1f}" x2="{b[0]:.1f}" y2="{b[1]:.1f}" '
        f'stroke="{colour}" stroke-width="{width}"{extra}/>'
    )


def arrow(a: Point, b: Point, colour: str) -> str:
    return line(a, b, colour, 2.5, head=True)


def text(at: Point, words: str, colour: str = INK, size: int = 15, anchor: str = "start", bold: bool = False) -> str:
    weight = ' font-weight="bold"' if bold else ""
    return (
        f'<text x="{at[0]:.1f}" y="{at[1]:.1f}" fill="{colour}" font-size="{size}" '
        f'text-anchor="{anchor}"{weight}>{words}</text>'
    )


def path(points: list[Point], fill: str, stroke: str = GREY) -> str:
    corners = " ".join(f"{x:.1f},{y:.1f}" for x, y in points)
    return f'<polygon points="{corners}" fill="{fill}" stroke="{stroke}" stroke-width="1.5"/>'


def arc(centre: Point, radius: float, start: float, stop: float, colour: str) -> str:
    """Draw an arrow along a circle; angles in radians, clockwise from up as the eye sees it."""
    ends = [(centre[0] + radius * math.sin(a), centre[1] - radius * math.cos(a)) for a in (start, stop)]
    return (
        f'<path d="M {ends[0][0]:.1f} {ends[0][1]:.1f} A {radius} {radius} 0 0 {int(stop > start)} '
        f'{ends[1][0]:.1f} {ends[1][1]:.1f}" fill="none" stroke="{colour}" stroke-width="2.5" '
        f'marker-end="url(#head{colour[1:]})"/>'
    )


def into_page(at: Point, colour: str) -> list[str]:
    x, y, r = *at, 6
    d = r * math.sqrt(0.5)
    return [
        f'<circle cx="{x}" cy="{y}" r="{r}" fill="white" stroke="{colour}" stroke-width="2"/>',
        line((x - d, y - d), (x + d, y + d), colour, 2),
        line((x - d, y + d), (x + d, y - d), colour, 2),
    ]


def out_of_page(at: Point, colour: str) -> list[str]:
    return [
        f'<circle cx="{at[0]}" cy="{at[1]}" r="6" fill="white" stroke="{colour}" stroke-width="2"/>',
        f'<circle cx="{at[0]}" cy="{at[1]}" r="2" fill="{colour}"/>',
    ]


def specimen(origin: Point, tilt: float) -> list[str]:
    """Draw the specimen from the side, x to the right and z up, turned by a positive tilt: clockwise, seen along +y."""

    def seen(x: float, z: float) -> Point:
        turned_x, turned_z = x * math.cos(tilt) + z * math.sin(tilt), -x * math.sin(tilt) + z * math.cos(tilt)
        return origin[0] + turned_x, origin[1] - turned_z

    outline = [(-120, 0), (-18, 0), (0, 66), (18, 0), (120, 0), (120, -24), (-120, -24)]
    top = seen(0, 66)
    return [
        path([seen(x, z) for x, z in outline], "#eceff3"),
        f'<circle cx="{top[0]:.1f}" cy="{top[1]:.1f}" r="5" fill="{TILT}"/>',
    ]


def frames_panel(x: float, y: float) -> list[str]:
    origin, camera = (x + 190, y + 235), (x + 62, y + 78)
    return [
        text((x + 10, y + 24), "Zero tilt, seen along +y: world and camera", bold=True),
        *[
            line((x + 190 + d, y + 70), (x + 190 + d, y + (126 if d == 0 else 160)), GREY, 1.5, "4 4")
            for d in (-40, 0, 40)
        ],
        text((x + 244, y + 100), "beam, from the gun", GREY, 13),
        *specimen(origin, 0),
        arrow(origin, (origin[0] + 170, origin[1]), WORLD),
        arrow(origin, (origin[0], origin[1] - 105), WORLD),
        *into_page(origin, WORLD),
        text((origin[0] + 176, origin[1] + 5), "x", WORLD),
        text((origin[0] + 8, origin[1] - 96), "z", WORLD),
        text((origin[0] - 12, origin[1] + 46), "world: y into the page, origin on the axis", WORLD, 13, "middle"),
        arrow(camera, (camera[0] + 62, camera[1]), CAMERA),
        arrow(camera, (camera[0], camera[1] + 62), CAMERA),
        *out_of_page(camera, CAMERA),
        text((camera[0] + 50, camera[1] + 20), "x", CAMERA),
        text((camera[0] - 16, camera[1] + 60), "z", CAMERA),
        text((camera[0] - 46, camera[1] - 16), "camera: y out of the page", CAMERA, 13),
        text((x + 190, y + 312), "R_cam_from_world = diag(1, -1, -1)", INK, 14, "middle"),
    ]


def tilt_panel(x: float, y: float) -> list[str]:
    origin = (x + 190, y + 235)
    moved = (origin[0] + 66 * math.sin(THETA), origin[1] - 66 * math.cos(THETA))
    return [
        text((x + 10, y + 24), "Positive tilt, axis 0: the left side is lifted", bold=True),
        *specimen(origin, THETA),
        line((origin[0], origin[1]), (origin[0], y + 75), GREY, 1.5, "4 4"),
        line(moved, (moved[0], y + 75), TILT, 1.5, "4 4"),
        line((x + 60, y + 75), (x + 320, y + 75), INK, 1.5),
        arrow((origin[0], y + 62), (moved[0] + 6, y + 62), TILT),
        text((x + 60, y + 92), "image", INK, 13),
        text((origin[0] + 34, y + 58), "to higher columns", TILT, 13),
        arc(origin, 112, math.radians(-8), math.radians(24), TILT),
        text((origin[0] + 60, origin[1] - 86), "tilt &gt; 0", TILT),
        *into_page(origin, WORLD),
        text((origin[0] - 150, origin[1] + 48), "axis: world +y, into the page", WORLD, 13),
        text((x + 190, y + 312), "x' = x cos(tilt) + z sin(tilt)", INK, 14, "middle"),
    ]


def axis_panel(x: float, y: float) -> list[str]:
    middle, phi = (x + 190, y + 172), math.radians(35)
    along = (middle[0] + 92 * math.sin(phi), middle[1] - 92 * math.cos(phi))
    return [
        text((x + 10, y + 24), "In the image: the direction of the tilt axis", bold=True),
        f'<rect x="{x + 50}" y="{y + 62}" width="280" height="220" fill="#f6f7f9" stroke="{GREY}" stroke-width="1.5"/>',
        arrow(middle, (middle[0], middle[1] - 96), WORLD),
        arrow(middle, (middle[0] + 122, middle[1]), WORLD),
        line(middle, along, WORLD, 2, "6 4", head=True),
        arc(middle, 50, 0, phi - 0.12, INK),
        text((middle[0] - 8, middle[1] - 84), "0: world +y, up", WORLD, 13, "end"),
        text((middle[0] + 138, middle[1] + 18), "90: world +x, right", WORLD, 13, "end"),
        text((along[0] + 8, along[1] - 4), "(sin, cos, 0)", WORLD, 13),
        text((middle[0] + 50, middle[1] - 36), "tilt_axis_deg", INK, 13),
        arrow((middle[0] - 120, middle[1] + 62), (middle[0] - 70, middle[1] + 62), TILT),
        text((middle[0] - 126, middle[1] + 84), "axis 0: raised", TILT, 13),
        text((middle[0] - 126, middle[1] + 100), "moves right", TILT, 13),
        arrow((middle[0] + 22, middle[1] + 46), (middle[0] + 22, middle[1] + 96), TILT),
        text((middle[0] + 34, middle[1] + 66), "axis 90: raised", TILT, 13),
        text((middle[0] + 34, middle[1] + 82), "moves down", TILT, 13),
        text((x + 190, y + 312), "right-handed about the arrow, tilt &gt; 0", INK, 14, "middle"),
    ]


def pixel_panel(x: float, y: float) -> list[str]:
    size, columns, rows, left, top = 46, 5, 4, x + 80, y + 86
    middle = (left + columns * size / 2, top + rows * size / 2)
    squares = [
        f'<rect x="{left + c * size}" y="{top + r * size}" width="{size}" height="{size}" fill="#f6f7f9" '
        f'stroke="{GREY}"/>'
        f'<circle cx="{left + (c + 0.5) * size}" cy="{top + (r + 0.5) * size}" r="2.5" fill="{INK}"/>'
        for c in range(columns)
        for r in range(rows)
    ]
    return [
        text((x + 10, y + 24), "Pixels: integers are centres", bold=True),
        *squares,
        *[text((left + (c + 0.5) * size, top - 8), str(c), CAMERA, 13, "middle") for c in range(columns)],
        *[text((left - 12, top + (r + 0.5) * size + 5), str(r), CAMERA, 13, "middle") for r in range(rows)],
        arrow((left, top - 28), (left + 70, top - 28), CAMERA),
        text((left + 78, top - 24), "column; xy_px = (column, row)", CAMERA, 13),
        arrow((left - 30, top), (left - 30, top + 70), CAMERA),
        text((left - 66, top + 92), "row, y", CAMERA, 13),
        arrow(middle, (middle[0] + 62, middle[1]), WORLD),
        arrow(middle, (middle[0], middle[1] - 62), WORLD),
        *out_of_page(middle, WORLD),
        text((middle[0] + 52, middle[1] - 8), "x", WORLD),
        text((middle[0] + 8, middle[1] - 50), "y", WORLD),
        text((middle[0] + 8, middle[1] + 18), "z", WORLD),
        text((x + 190, y + 292), "world origin at ((W-1)/2, (H-1)/2) = (2, 1.5)", WORLD, 13, "middle"),
        text((x + 190, y + 312), "here W = 5, H = 4, zero tilt", INK, 14, "middle"),
    ]


def drawing() -> str:
    heads = "".join(
        f'<marker id="head{c[1:]}" viewBox="0 0 10 10" refX="8" refY="5" markerWidth="5" markerHeight="5" '
        'orient="auto">'
        f'<path d="M 0 0 L 10 5 L 0 10 z" fill="{c}"/></marker>'
        for c in (WORLD, CAMERA, TILT, GREY, INK)
    )
    panels = [*frames_panel(10, 5), *tilt_panel(410, 5), *axis_panel(10, 345), *pixel_panel(410, 345)]
    return "\n".join(
        [
            '<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 810 680" width="810" height="680" '
            'font-family="Helvetica, Arial, sans-serif" role="img" aria-label="Frames and signs">',
            f'<defs>{heads}</defs><rect width="810" height="680" fill="white"/>',
            line((400, 20), (400, 660), "#d5d8dd", 1),
            line((20, 340), (790, 340), "#d5d8dd", 1),
            *panels,
            "</svg>\n",
        ]
    )


if __name__ == "__main__":
    Path(__file__).with_name("frames.svg").write_text(drawing(), encoding="utf-8")
