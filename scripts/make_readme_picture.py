"""Draw the picture of the README from an assessment of the packaged example.

    python scripts/make_readme_picture.py [FILE]

It shows the links of the camera in the order of the light, and under each link its error sources with their contributions to the
position of a target. Bars are in proportion to the standard uncertainty; percentages are shares of the variance.
"""

from __future__ import annotations

import sys
from html import escape
from pathlib import Path
from typing import Any

import pixmetry

TARGET = Path(__file__).resolve().parents[1] / "docs" / "images" / "chain.svg"
LINKS = {"optics": "light and lens", "sensor": "sensor", "electronics": "amplifier", "grabber": "converter"}
LEAST_PX = 1e-5  # smaller contributions are left out
LEFT, TOP, WIDTH, GAP, HEAD, ROW = 12, 12, 178, 26, 40, 46  # of the columns, in the SVG's units
STYLE = (
    "text{font-family:system-ui,Helvetica,Arial,sans-serif;font-size:13px;fill:#1c2733}.head{font-weight:600;font-size:15px}"
    ".quiet{fill:#5b6875}.white{fill:#fff;font-weight:600}.box{fill:#e8eef4;stroke:#9fb3c6}.bar{fill:#2f6fab}.rail{fill:#dde5ec}"
)


def make_picture(result: Any) -> str:
    """SVG of an assessment's contributions, sorted by the link that makes them.

    Parameters
    ----------
    result : Assessment
        What `pixmetry.assess` returns.
    """
    rows = [row for row in result.budget.rows if row.status in ("measured", "modelled") and row.total_px >= LEAST_PX]
    columns = {link: [row for row in rows if row.source_id.startswith(f"{link}.")] for link in LINKS}
    total_px = result.budget.verdict.total_px
    largest_px = max(row.total_px for row in rows)
    width = LEFT + 5 * WIDTH + 4 * GAP + LEFT
    height = TOP + HEAD + 24 + ROW * max(map(len, columns.values())) + 26
    parts = []
    for k, (link, own) in enumerate(columns.items()):
        x = LEFT + k * (WIDTH + GAP)
        parts += _head(x, LINKS[link], "box", "head") + _arrow(x + WIDTH)
        for i, row in enumerate(own):
            parts += _contribution(x, TOP + HEAD + 24 + ROW * i, row, largest_px)
    x = LEFT + 4 * (WIDTH + GAP)
    parts += _head(x, "position", "bar", "head white")
    below = TOP + HEAD + 24
    words = (
        ("head", f"u = {total_px:.4f} px"),
        ("quiet", "standard uncertainty"),
        ("quiet", "of one coordinate"),
        ("quiet", "in one frame"),
    )
    parts += [f'<text x="{x}" y="{below + 12 + 22 * i}" class="{kind}">{escape(text)}</text>' for i, (kind, text) in enumerate(words)]
    foot = "Bars: standard uncertainty. Percentages: shares of the variance."
    parts.append(f'<text x="{LEFT}" y="{height - 10}" class="quiet">{foot}</text>')
    label = "; ".join(f"{escape(row.title)} {row.total_px:.5f} px, {_percent(row.share)}" for row in rows)
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{width}" height="{height}" viewBox="0 0 {width} {height}" role="img" '
        f'aria-label="{label}"><style>{STYLE}</style>\n<rect width="{width}" height="{height}" rx="8" fill="#fff"/>\n'
        + "\n".join(parts)
        + "\n</svg>\n"
    )


def _head(x: int, text: str, box: str, words: str) -> list[str]:
    return [
        f'<rect x="{x}" y="{TOP}" width="{WIDTH}" height="{HEAD}" rx="6" class="{box}"/>',
        f'<text x="{x + WIDTH / 2}" y="{TOP + 25}" text-anchor="middle" class="{words}">{escape(text)}</text>',
    ]


def _arrow(x: int) -> list[str]:
    y = TOP + HEAD / 2
    path = f"M{x + 4},{y}h{GAP - 14}m-5,-5l7,5l-7,5"
    return [f'<path d="{path}" fill="none" stroke="#2f6fab" stroke-width="2"/>']


def _contribution(x: int, y: int, row: Any, largest_px: float) -> list[str]:
    bar = max(WIDTH * row.total_px / largest_px, 1.0)
    return [
        f'<text x="{x}" y="{y}">{escape(_short(row.title))}</text>',
        f'<rect x="{x}" y="{y + 6}" width="{WIDTH}" height="5" class="rail"/>',
        f'<rect x="{x}" y="{y + 6}" width="{bar:.1f}" height="5" class="bar"/>',
        f'<text x="{x}" y="{y + 25}" class="quiet">{row.total_px:.5f} px · {_percent(row.share)}</text>',
    ]


def _percent(share: float) -> str:
    return "&lt; 1 %" if share < 0.005 else f"{100 * share:.0f} %"


def _short(title: str) -> str:
    names = {
        "Photo response non-uniformity": "Pattern in light (PRNU)",
        "Dark signal non-uniformity": "Pattern in the dark (DSNU)",
        "Temporal row and column noise": "Row and column noise",
        "Analogue-to-digital conversion": "Quantisation and codes",
        "Lens shading and uneven light": "Shading, uneven light",
    }
    return names.get(title, title)


def main() -> None:
    """Assess the packaged example and write the picture."""
    path = Path(sys.argv[1]) if len(sys.argv) > 1 else TARGET
    path.write_text(make_picture(pixmetry.assess(trials=200)), encoding="utf-8")
    print(path)


if __name__ == "__main__":
    main()
