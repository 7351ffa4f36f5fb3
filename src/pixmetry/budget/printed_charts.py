"""Charts to print, as SVG on a sheet of A4: slanted edges, thin lines, a step wedge, bright spots, a plate of dots; drawings of set-ups."""

from __future__ import annotations

import math
from collections.abc import Callable

WIDTH_MM, HEIGHT_MM = 297.0, 210.0
MARGIN_MM = 12.0
EDGE_DEG, LINE_DEG = 5.0, 0.6
WEDGE_DENSITIES = (0.1, 0.22, 0.34, 0.46, 0.58, 0.7, 0.82, 0.94, 1.06, 1.18, 1.3, 1.45)  # nominal; a print is measured
BLACK, WHITE = "#000", "#fff"


def _sheet(shapes: list[str], background: str = WHITE) -> str:
    size = f'width="{WIDTH_MM:g}mm" height="{HEIGHT_MM:g}mm" viewBox="0 0 {WIDTH_MM:g} {HEIGHT_MM:g}"'
    head = f'<svg xmlns="http://www.w3.org/2000/svg" {size}>'
    ground = f'<rect width="{WIDTH_MM:g}" height="{HEIGHT_MM:g}" fill="{background}"/>'
    return "\n".join([head, ground, *shapes, "</svg>", ""])


def _rect(x: float, y: float, w: float, h: float, fill: str, turn_deg: float = 0.0) -> str:
    turn = f' transform="rotate({turn_deg:g} {x + w / 2:.3f} {y + h / 2:.3f})"' if turn_deg else ""
    return f'<rect x="{x:.3f}" y="{y:.3f}" width="{w:.3f}" height="{h:.3f}" fill="{fill}"{turn}/>'


def edges() -> str:
    """Squares turned by 5°, black on white and white on black: edges in both directions and polarities."""
    shapes, cell = [], 45.5
    for row in range(4):
        for col in range(6):
            x, y = MARGIN_MM + col * cell, MARGIN_MM + row * cell
            dark = (row + col) % 2 == 1
            if dark:
                shapes.append(_rect(x, y, cell, cell, BLACK))
            side = 0.56 * cell
            turn = EDGE_DEG if row % 2 else -EDGE_DEG
            shapes.append(_rect(x + (cell - side) / 2, y + (cell - side) / 2, side, side, WHITE if dark else BLACK, turn))
    return _sheet(shapes)


def lines() -> str:
    """Upright thin lines that lean by 0.6°, black on white on the left half, white on black on the right."""
    half = WIDTH_MM / 2
    shapes = [_rect(half, 0, half, HEIGHT_MM, BLACK)]
    lean = math.tan(math.radians(LINE_DEG)) * HEIGHT_MM
    for k in range(10):
        at = MARGIN_MM + k * (WIDTH_MM - 2 * MARGIN_MM) / 9.5
        fill = BLACK if at + lean < half else WHITE
        width = 0.8 + 0.4 * (k % 3)
        points = f"{at:.3f},0 {at + width:.3f},0 {at + lean + width:.3f},{HEIGHT_MM:g} {at + lean:.3f},{HEIGHT_MM:g}"
        shapes.append(f'<polygon points="{points}" fill="{fill}"/>')
    return _sheet(shapes)


def grey_of(density: float) -> str:
    """The sRGB grey whose luminance is 10^−D of white (IEC 61966-2-1)."""
    v = 10.0**-density
    code = 12.92 * v if v <= 0.0031308 else 1.055 * v ** (1 / 2.4) - 0.055
    level = round(255 * code)
    return f"#{level:02x}{level:02x}{level:02x}"


def wedge() -> str:
    """Twelve grey patches on middle grey, in mixed order so that uneven light is not taken for the response."""
    shapes, side, gap, columns = [], 52.0, 14.0, 4
    order = (0, 7, 3, 10, 5, 1, 11, 6, 9, 2, 8, 4)
    for place, number in enumerate(order):
        x = (WIDTH_MM - columns * side - (columns - 1) * gap) / 2 + (place % columns) * (side + gap)
        y = (HEIGHT_MM - 3 * side - 2 * gap) / 2 + (place // columns) * (side + gap)
        density = WEDGE_DENSITIES[number]
        shapes.append(_rect(x, y, side, side, grey_of(density)))
        shapes.append(f'<text x="{x:.3f}" y="{y + side + 5:.3f}" font-size="3.5" fill="{WHITE}">{density:g}</text>')
    return _sheet(shapes, "#303030")


def spots() -> str:
    """White discs on black in the middle third, no two of them in one column or row."""
    order = (2, 0, 4, 1, 3)
    shapes = []
    for k, place in enumerate(order):
        x, y = WIDTH_MM / 3 + (k + 0.5) * WIDTH_MM / 15, HEIGHT_MM / 3 + (place + 0.5) * HEIGHT_MM / 15
        shapes.append(f'<circle cx="{x:.3f}" cy="{y:.3f}" r="3" fill="{WHITE}"/>')
    return _sheet(shapes, BLACK)


def dots() -> str:
    """A plate of 11 × 8 black dots of 8 mm, 24 mm apart."""
    pitch, cols, rows = 24.0, 11, 8
    x0, y0 = (WIDTH_MM - (cols - 1) * pitch) / 2, (HEIGHT_MM - (rows - 1) * pitch) / 2
    at = [(x0 + c * pitch, y0 + r * pitch) for r in range(rows) for c in range(cols)]
    return _sheet([f'<circle cx="{x:.3f}" cy="{y:.3f}" r="4" fill="{BLACK}"/>' for x, y in at])


def laser() -> str:
    """The set-up of a laser spot, seen from above: the surface moves along itself from frame to frame."""
    x, y = WIDTH_MM / 2, 60.0
    text = [
        (x + 62, y + 3, "surface: move it sideways between frames"),
        (x - 96, y + 100, "laser"),
        (x + 78, y + 100, "camera, stop as in the measurement"),
        (x - 118, y - 24, "Nothing else moves. Step: the diameter of the spot or more. 50 frames."),
    ]
    shapes = [_rect(x - 60, y, 120, 6, "#888"), _rect(x - 85, y + 90, 30, 12, BLACK), _rect(x + 45, y + 85, 30, 20, BLACK)]
    rays = [(x - 70, y + 90, x, y + 6, "#c00"), (x, y + 6, x + 60, y + 85, "#888"), (x - 55, y - 8, x + 55, y - 8, BLACK)]
    shapes += [f'<line x1="{a:.3f}" y1="{b:.3f}" x2="{c:.3f}" y2="{d:.3f}" stroke="{k}" stroke-width="1"/>' for a, b, c, d, k in rays]
    for end, tip in ((x - 55, x - 62), (x + 55, x + 62)):
        shapes.append(f'<polygon points="{end:g},{y - 11:g} {end:g},{y - 5:g} {tip:g},{y - 8:g}" fill="{BLACK}"/>')
    shapes += [f'<text x="{a:.3f}" y="{b:.3f}" font-size="6" fill="{BLACK}">{t}</text>' for a, b, t in text]
    return _sheet(shapes)


CHARTS: dict[str, Callable[[], str]] = {"edges": edges, "lines": lines, "wedge": wedge, "spots": spots, "dots": dots, "laser": laser}
