"""Figures as small SVG that takes its colours and its type from the page around it."""

from __future__ import annotations

import base64
import io
import re
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Each hue is drawn in its light-page value and replaced by a style variable, so that a dark page can lighten it.
# Blue, vermilion, amber: told apart with any common colour vision (Okabe and Ito 2008); lines differ in dash or marker too.
INK, SOFT, GRID = "#1a1d21", "#5b626b", "#d9dde2"
BLUE, RED, AMBER = "#0067a5", "#c44e00", "#a87400"
VARIABLES = {INK: "ink", SOFT: "soft", GRID: "grid", BLUE: "blue", RED: "red", AMBER: "amber"}
WIDTH_IN = 3.7  # of a figure that fills a phone, and half of a sheet
DENSE = 1500  # points in a line from which it is stored as pixels
MAP_SIDE = 224  # pixels of a map thumbnail
LONG_PATH = 10_000  # characters of a path, from which on a tenth of a point has to do
STYLE: Any = {
    "svg.fonttype": "none",
    "svg.hashsalt": "pixmetry",  # the same figure gives the same file
    "font.family": ["DejaVu Sans"],  # sets the space; the page sets the type
    "font.size": 7.5,
    "axes.titlesize": 7.5,
    "axes.labelsize": 7.5,
    "legend.fontsize": 7.0,
    "xtick.labelsize": 7.0,
    "ytick.labelsize": 7.0,
    "text.color": INK,
    "axes.labelcolor": INK,
    "axes.edgecolor": SOFT,
    "xtick.color": SOFT,
    "ytick.color": SOFT,
    "xtick.labelcolor": INK,
    "ytick.labelcolor": INK,
    "axes.linewidth": 0.6,
    "xtick.major.width": 0.6,
    "ytick.major.width": 0.6,
    "xtick.minor.width": 0.4,
    "ytick.minor.width": 0.4,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.color": GRID,
    "grid.linewidth": 0.5,
    "legend.frameon": False,
    "lines.linewidth": 1.2,
    "lines.markersize": 3.2,
    "axes.unicode_minus": True,
    "path.simplify": True,
}


_style_lock = threading.RLock()  # matplotlib's settings are those of the process


@contextmanager
def own_style(settings: Any) -> Iterator[None]:
    """Matplotlib's own defaults with these settings, whatever the user's ``matplotlibrc`` says; one thread after the other."""
    import matplotlib

    with _style_lock, matplotlib.rc_context():
        matplotlib.rcdefaults()
        matplotlib.rcParams.update(settings)
        yield


@contextmanager
def canvas(height_in: float, **kw: Any) -> Iterator[tuple[Figure, Any]]:
    """An empty figure in the report's style, and its axes (``kw`` as of ``Figure.subplots``)."""
    from matplotlib.figure import Figure
    from matplotlib.layout_engine import ConstrainedLayoutEngine

    with own_style(STYLE):
        figure = Figure(figsize=(WIDTH_IN, height_in), layout=ConstrainedLayoutEngine(w_pad=0.03, h_pad=0.03))
        yield figure, figure.subplots(**kw)


def svg_of(figure: Figure, name: str, alt: str) -> str:
    """Turn a figure into markup for a page on which its ``name`` is unique."""
    raw = io.StringIO()
    with own_style(STYLE):
        figure.savefig(raw, format="svg", transparent=True, dpi=200, metadata={"Date": None, "Creator": None, "Format": None, "Type": None})
    return _slim(raw.getvalue(), name, alt)


def _slim(svg: str, name: str, alt: str) -> str:
    """Take out what only a file of its own needs, make names unique on the page, and hand colours and type to the page."""
    svg = svg[svg.index("<svg") :]
    svg = re.sub(r"<!--.*?-->|<metadata>.*?</metadata>|<style[^>]*>\*\{[^}]*\}</style>", "", svg, flags=re.S)
    view = re.search(r'viewBox="([^"]+)"', svg)
    assert view is not None
    head = f'<svg class="figure" role="img" aria-label="{escape(alt)}" viewBox="{view[1]}" xmlns:xlink="http://www.w3.org/1999/xlink">'
    used = set(re.findall(r'(?:url\(|href=")#([^)"]+)', svg))
    svg = re.sub(r' id="([^"]+)"', lambda m: f' id="{name}-{m[1]}"' if m[1] in used else "", svg)
    svg = re.sub(r'(url\(|href=")#', rf"\g<1>#{name}-", svg)
    for colour, variable in VARIABLES.items():
        svg = svg.replace(colour, f"var(--{variable})")
    svg = re.sub(r"'DejaVu Sans'(, [^;\"]+)?", "var(--sans)", svg)
    svg = re.sub(r"<[^>]*>", lambda tag: re.sub(r"(\d+\.\d{2})\d+", r"\1", tag[0]), svg)  # coordinates, not the labels between tags
    svg = re.sub(rf' d="[^"]{{{LONG_PATH},}}"', lambda path: re.sub(r"(\d\.\d)\d+", r"\1", path[0]), svg)
    svg = head + svg[svg.index(">") + 1 :]  # last, so that its words keep all their digits
    svg = re.sub(r'href="data:image/png;base64,([^"]+)"', lambda m: f'href="{_palette_png(m[1])}"', svg)
    return re.sub(r">\s+<", "><", re.sub(r"\s*\n\s*", " ", svg))


def escape(text: str) -> str:
    """Text for an attribute in double quotes."""
    return text.replace("&", "&amp;").replace('"', "&quot;").replace("<", "&lt;").replace(">", "&gt;")


def _palette_png(encoded: str) -> str:
    """The same picture with few colours, 96 where it is opaque: less than half the bytes."""
    from PIL import Image

    image: Image.Image = Image.open(io.BytesIO(base64.b64decode(encoded)))
    if image.mode == "RGBA":
        if image.getchannel("A").getextrema() == (255, 255):
            image = image.convert("RGB").quantize(96, dither=Image.Dither.NONE)
        else:
            image = image.quantize(48, method=Image.Quantize.FASTOCTREE)
    out = io.BytesIO()
    image.save(out, format="PNG", optimize=True)
    return "data:image/png;base64," + base64.b64encode(out.getvalue()).decode()


def plain_log(axis: Any) -> None:
    """Label a logarithmic axis: 1, 2, 5 where it spans few decades, else powers of ten, all plain or all with an exponent."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    from pixmetry.report.numbers import SUPERSCRIPT

    low, high = axis.get_view_interval()
    decades = np.log10(high / low)
    plain = decades < 2 or (low > 2e-4 and high < 5e5)

    def label(value: float, _: object) -> str:
        exponent = round(np.log10(value))
        return f"{value:g}" if plain else f"10{str(exponent).translate(SUPERSCRIPT)}"

    axis.set_major_locator(LogLocator(subs=(1, 2, 5) if decades < 2 else (1,), numticks=7 if decades >= 2 else 12))
    axis.set_major_formatter(FuncFormatter(label))
    axis.set_minor_formatter(NullFormatter())


def thumbnail(values: np.ndarray) -> tuple[np.ndarray, int]:
    """A map averaged over blocks until it is small, and the side of the blocks in pixels; edges that fill no block are left off."""
    block = max(1, -(-max(values.shape) // MAP_SIDE))
    rows, cols = (n // block * block for n in values.shape)
    blocks = np.asarray(values, float)[:rows, :cols].reshape(rows // block, block, cols // block, block)
    return blocks.mean(axis=(1, 3)), block


def draw_map(figure: Figure, axes: Axes, values: np.ndarray, unit: str) -> tuple[float, float, int]:
    """A map with a colour bar; contrast from the 1st to the 99th percentile. Returns these two and the block side."""
    small, block = thumbnail(values)
    low, high = (float(v) for v in np.percentile(small, [1, 99]))
    if high <= low:
        low, high = low - 0.5, high + 0.5
    extent = (-0.5, small.shape[1] * block - 0.5, small.shape[0] * block - 0.5, -0.5)
    image = axes.imshow(small, cmap="cividis", vmin=low, vmax=high, interpolation="none", extent=extent)
    axes.grid(False)
    axes.tick_params(length=2)
    bar = figure.colorbar(image, ax=axes, shrink=0.85, aspect=18, pad=0.02, extend="both")
    bar.set_label(unit)
    bar.outline.set_linewidth(0.4)
    return low, high, block


def line(axes: Axes, x: np.ndarray, y: np.ndarray, **kw: Any) -> None:
    """A line; a dense one goes into the file as pixels."""
    axes.plot(x, y, rasterized=np.size(x) > DENSE, **kw)
