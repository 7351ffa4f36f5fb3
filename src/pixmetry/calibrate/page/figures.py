"""Figures of one calibrated camera: residuals, distortion curves, correlations, projection uncertainty; and parts that several figures
share."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from pixmetry.report.drawing import BLUE, INK, RED, SOFT, WIDTH_IN, canvas, plain_log
from pixmetry.report.numbers import MINUS, significant, uncertain
from pixmetry.report.page import Figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure as Drawing

    from pixmetry.calibrate.bundle.model import Sensor
    from pixmetry.calibrate.bundle.network import Adjustment
    from pixmetry.calibrate.records import DistortionCurves, ImageRecord, ProjectionMap, ResidualGrid

MOST_VECTORS = 3000  # in a figure, from which on they are stored as pixels
SHEET_COLS, SHEET_ROWS = 3, 4  # images on a sheet of small ones
MOST_IN_SMALL = MOST_VECTORS // (SHEET_COLS * SHEET_ROWS)  # vectors in one small image
LEAST_IN_CELL = 4
KEY_IN = 0.12  # of the middle of the key above the axes
COVER_95 = 1.96
WIDE_RANGE = 6.0  # of a map, from which its colours are logarithmic
MOST_DOTS = 20_000  # in a scatter of residuals
DARK_TEXT, LIGHT_TEXT = "#101010", "#fefefe"  # on coloured cells, which do not change with the page's theme


@dataclass(frozen=True)
class Residuals:
    """Residuals of one camera that were used: measured minus computed, px."""

    x: np.ndarray
    y: np.ndarray
    dx: np.ndarray
    dy: np.ndarray
    image: np.ndarray
    sensor: Sensor

    @classmethod
    def of(cls, adjustment: Adjustment, camera: int) -> Residuals:
        """Those of a camera; what was rejected or could not be computed is left out."""
        net, v = adjustment.network, adjustment.residual_px
        mine = adjustment.used & (net.camera_of[net.image] == camera) & np.isfinite(v).all(axis=1)
        return cls(net.x_px[mine], net.y_px[mine], v[mine, 0], v[mine, 1], net.image[mine], net.cameras[camera].sensor)

    def __len__(self) -> int:
        return len(self.x)


def round_number(value: float) -> float:
    """The largest of 1, 2, 5 times a power of ten that is not above a positive value."""
    power = 10.0 ** np.floor(np.log10(value))
    return float(power * max(k for k in (1, 2, 5) if k * power <= value * (1 + 1e-9)))


def enlargement(dx: np.ndarray, dy: np.ndarray, extent: float, share: float = 0.06) -> tuple[float, float]:
    """Factor that draws long vectors (their 95th percentile) as a share of an extent, as a round number, and a round length for the key."""
    length = np.hypot(dx, dy)
    length = length[np.isfinite(length)]
    long = float(np.percentile(length, 95)) if len(length) else 0.0
    if long <= 0:
        return 1.0, 1.0
    return round_number(share * extent / long), round_number(1.5 * long)


def even_choice(items: np.ndarray, most: int) -> np.ndarray:
    """Every k-th item, at most a given number."""
    return items[:: max(1, -(-len(items) // most))]


def chain(*parts: np.ndarray) -> np.ndarray:
    """Many short polylines as one line with gaps: the k-th goes through the k-th element of each part."""
    return np.column_stack([*parts, np.full(len(parts[0]), np.nan)]).ravel()


def arrows(x: np.ndarray, y: np.ndarray, dx: np.ndarray, dy: np.ndarray, factor: float) -> tuple[np.ndarray, np.ndarray]:
    """Lines from each place along its enlarged vector, with a head."""
    ax, ay = factor * dx, factor * dy
    tip_x, tip_y = x + ax, y + ay
    left = (tip_x - 0.24 * ax + 0.13 * ay, tip_y - 0.24 * ay - 0.13 * ax)
    right = (tip_x - 0.24 * ax - 0.13 * ay, tip_y - 0.24 * ay + 0.13 * ax)
    return chain(x, tip_x, left[0], tip_x, right[0]), chain(y, tip_y, left[1], tip_y, right[1])


def frame_height(sensor: Sensor, beside_in: float = 0.55) -> float:
    """Height of a figure that shows the whole sensor, inches; ``beside_in`` of its width are for labels and colour bar."""
    return 0.75 + (WIDTH_IN - beside_in) * float(np.clip(sensor.rows / sensor.cols, 0.25, 1.6))


def frame(axes: Axes, sensor: Sensor) -> None:
    """Axes over the sensor: x to the right, y down, with room for a key above."""
    edge_x, edge_y = [-0.5, sensor.cols - 0.5], [-0.5, sensor.rows - 0.5]
    axes.plot([*edge_x, *edge_x[::-1], edge_x[0]], np.repeat(edge_y, 2).tolist() + edge_y[:1], color=SOFT, linewidth=0.6)
    axes.set_xlim(-0.02 * sensor.cols, 1.02 * sensor.cols)
    axes.set_ylim(1.02 * sensor.rows, -0.02 * sensor.rows)
    axes.set_aspect("equal")
    axes.grid(False)
    axes.set_xlabel("x / px")
    axes.set_ylabel("y / px")


def colour_bar(figure: Drawing, axes: Axes, image: Any, label: str) -> Axes:
    """A colour bar as high as the axes beside it, whatever their aspect; the layout sees it only in part and needs wider margins."""
    engine: Any = figure.get_layout_engine()
    engine.set(w_pad=0.11)
    bar = figure.colorbar(image, cax=axes.inset_axes((1.03, 0.0, 0.045, 1.0)))
    bar.ax.grid(False)
    bar.set_label(label)
    bar.outline.set_linewidth(0.4)
    return bar.ax


def length_key(axes: Axes, factor: float, key: float, unit: str = "px") -> None:
    """An arrow of a round length above the axes, enlarged as the vectors are."""
    from matplotlib.transforms import ScaledTranslation

    figure: Any = axes.figure
    low, high = axes.get_xlim()
    share = factor * key / abs(high - low)
    above = axes.transAxes + ScaledTranslation(0, KEY_IN, figure.dpi_scale_trans)
    head = 1 + 0.13 * share * abs((high - low) / np.diff(axes.get_ylim())[0]) * np.array([1, -1])  # x and y have one scale
    tip = 0.76 * share
    axes.plot([0, share, tip, share, tip], [1, 1, head[0], 1, head[1]], color=INK, linewidth=0.9, transform=above, clip_on=False)
    text = f"{significant(key, 1)} {unit}, drawn {significant(factor, 1)} times as long"
    axes.text(share + 0.02, 1, text, transform=above, va="center", fontsize=7)


def draw_vectors(axes: Axes, x: np.ndarray, y: np.ndarray, dx: np.ndarray, dy: np.ndarray, sensor: Sensor) -> float:
    """Vectors over the sensor with their key; returns the factor by which they are drawn enlarged."""
    factor, key = enlargement(dx, dy, sensor.cols)
    frame(axes, sensor)
    width = float(np.clip(25 / np.sqrt(max(len(x), 1)), 0.4, 0.9))
    axes.plot(*arrows(x, y, dx, dy, factor), color=BLUE, linewidth=width, rasterized=len(x) > MOST_VECTORS)
    length_key(axes, factor, key)
    return factor


def residual_vectors(r: Residuals, name: str) -> Figure:
    """The residual vectors of all images of a camera over its sensor; of very many an even choice, which leaves them apart."""
    shown = even_choice(np.arange(len(r)), MOST_VECTORS)
    with canvas(frame_height(r.sensor)) as (figure, axes):
        factor = draw_vectors(axes, r.x[shown], r.y[shown], r.dx[shown], r.dy[shown], r.sensor)
        images = len(np.unique(r.image))
        drawn = "" if len(shown) == len(r) else f" {len(shown)} of them are drawn."
        caption = (
            f"Residual vectors of all {images} images, {len(r)} points: measured minus computed, {significant(factor, 1)} times enlarged."
            f"{drawn} Noise has random directions; arrows that agree with their neighbours are a pattern."
        )
        return Figure(figure, f"{name}-vectors", f"Residual vectors of {len(r)} points over the sensor", caption)


def cell_means(r: Residuals, per_cell: float = 12.0) -> dict[str, np.ndarray]:
    """Mean residual in square cells with a given mean number of points: positions, means, and number of points."""
    cell = np.sqrt(per_cell * r.sensor.cols * r.sensor.rows / max(len(r), 1))
    cell = float(np.clip(cell, r.sensor.cols / 24, r.sensor.cols / 3))
    col, row = ((v + 0.5) // cell for v in (r.x, r.y))
    _, index, n = np.unique(col + 1000 * row, return_inverse=True, return_counts=True)
    means = {key: np.bincount(index, v) / n for key, v in (("x", r.x), ("y", r.y), ("dx", r.dx), ("dy", r.dy))}
    kept = n >= LEAST_IN_CELL
    return {key: v[kept] for key, v in means.items()} | {"n": n[kept], "cell_px": np.array(cell)}


def mean_vectors(r: Residuals, name: str) -> Figure | None:
    """What of the residuals is common to all images at one place of the sensor."""
    means = cell_means(r)
    if len(means["n"]) < 6:
        return None
    found = float(np.sqrt(np.mean(means["dx"] ** 2 + means["dy"] ** 2)))
    noise = float(np.sqrt(np.mean((np.mean(r.dx**2) + np.mean(r.dy**2)) / means["n"])))
    with canvas(frame_height(r.sensor)) as (figure, axes):
        factor = draw_vectors(axes, means["x"], means["y"], means["dx"], means["dy"], r.sensor)
        caption = (
            f"Mean residual in cells of {significant(float(means['cell_px']), 2)} px, {significant(factor, 1)} times enlarged. Their rms "
            f"length is {significant(found, 2)} px; residuals without a pattern would give {significant(noise, 2)} px."
        )
        alt = f"Mean residual vectors in {len(means['n'])} cells of the sensor, {significant(found, 2)} px rms"
        return Figure(figure, f"{name}-means", alt, caption)


def grid_vectors(grid: ResidualGrid, sensor: Sensor, name: str) -> Figure | None:
    """The correction grid at its nodes."""
    x, y = np.meshgrid(grid.x_px, grid.y_px)
    dx, dy = grid.dx_px, grid.dy_px
    good = np.isfinite(dx + dy)
    if not good.any():
        return None
    with canvas(frame_height(sensor)) as (figure, axes):
        factor = draw_vectors(axes, x[good], y[good], dx[good], dy[good], sensor)
        caption = f"Correction grid of {x.shape[1]} × {x.shape[0]} nodes, {significant(factor, 1)} times enlarged."
        caption += f" A node has an uncertainty of {significant(float(np.nanmedian(grid.u_px)), 2)} px (median u)."
        before, after = (significant(rms, 3) for rms in (grid.rms_without_px, grid.rms_with_px))
        caption += f" In images left out of the fit, it reduces the residuals from {before} px to {after} px rms."
        return Figure(figure, f"{name}-grid", f"Correction vectors at {int(good.sum())} nodes of a grid over the sensor", caption)


def image_order(r: Residuals) -> np.ndarray:
    """Images of a camera by the rms of their residuals, worst first."""
    images, index, n = np.unique(r.image, return_inverse=True, return_counts=True)
    return images[np.argsort(-np.bincount(index, r.dx**2 + r.dy**2) / n, kind="stable")]


def residual_sheet(r: Residuals, images: Sequence[int], titles: Sequence[str], scale: tuple[float, float], name: str) -> Figure:
    """Residual vectors image by image, small, all at the same enlargement ``scale[0]``; ``scale[1]`` is the length of the key, px."""
    factor, key = scale
    step_x, step_y, title = 1.08 * r.sensor.cols, r.sensor.rows + 0.19 * r.sensor.cols, 0.16 * r.sensor.cols
    rows = -(-len(images) // SHEET_COLS)
    across, down = SHEET_COLS * step_x - 0.05 * r.sensor.cols, rows * step_y
    with canvas(0.3 + (WIDTH_IN - 0.06) * down / across) as (figure, axes):
        axes.set_axis_off()
        axes.set_aspect("equal")
        axes.set_xlim(-0.01 * r.sensor.cols, across - 0.01 * r.sensor.cols)
        axes.set_ylim(down - title, -title)
        lines: list[tuple[np.ndarray, np.ndarray]] = []
        edges: list[tuple[float, float]] = []
        for k, image in enumerate(images):
            left, top = k % SHEET_COLS * step_x, k // SHEET_COLS * step_y
            mine = even_choice(np.flatnonzero(r.image == image), MOST_IN_SMALL)
            x, y = r.x[mine] + left, r.y[mine] + top
            lines.append((chain(x, x + factor * r.dx[mine]), chain(y, y + factor * r.dy[mine])))
            edges.append((left, top))
            axes.text(left, top - 0.03 * r.sensor.cols, titles[k], fontsize=6.2, va="bottom")
        at = np.array(edges) - 0.5
        corners = np.array([[0, 0], [1, 0], [1, 1], [0, 1], [0, 0]]) * [r.sensor.cols, r.sensor.rows]
        axes.plot(chain(*(at[:, 0] + c[0] for c in corners)), chain(*(at[:, 1] + c[1] for c in corners)), color=SOFT, linewidth=0.5)
        x, y = (np.concatenate(part) for part in zip(*lines, strict=True))
        axes.plot(x, y, color=BLUE, linewidth=0.6)
        length_key(axes, factor, key)
        return Figure(figure, name, f"Residual vectors of {len(images)} images", "")


@dataclass(frozen=True)
class Bins:
    """Mean and its standard uncertainty in each bin."""

    at: np.ndarray
    mean: np.ndarray
    u: np.ndarray


def bin_means(at: np.ndarray, value: np.ndarray, edges: np.ndarray) -> Bins:
    """Means between edges, where there are at least `LEAST_IN_CELL` values."""
    index = np.clip(np.searchsorted(edges, at, side="right") - 1, 0, len(edges) - 2)
    n = np.bincount(index, minlength=len(edges) - 1)
    kept = n >= LEAST_IN_CELL
    n = np.maximum(n, 1)
    mean, place = (np.bincount(index, v, len(edges) - 1) / n for v in (value, at))
    scatter = np.sqrt(np.bincount(index, (value - mean[index]) ** 2, len(edges) - 1) / np.maximum(n - 1, 1) / n)
    return Bins(place[kept], mean[kept], scatter[kept])


def _scatter(axes: Axes, at: np.ndarray, value: np.ndarray) -> None:
    """Dots, of very many an even choice, with the ordinate so that single far ones do not press the others together."""
    many, shown = len(at) > MOST_VECTORS, even_choice(np.arange(len(at)), MOST_DOTS)
    axes.plot(at[shown], value[shown], ".", color=SOFT, markersize=1.2 if many else 1.8, alpha=0.5, markeredgewidth=0, rasterized=many)
    span = float(np.percentile(np.abs(value), 99)) if len(value) else 1.0
    axes.set_ylim(-1.35 * max(span, 1e-9), 1.35 * max(span, 1e-9))


def _bars(axes: Axes, bins: Bins, colour: str, marker: str, label: str) -> None:
    style: dict[str, Any] = {"color": colour, "marker": marker, "elinewidth": 0.8, "linewidth": 0.9}
    axes.errorbar(bins.at, bins.mean, yerr=2 * bins.u, label=label, zorder=3, **style)


def against_radius(r: Residuals, centre: tuple[float, float], name: str) -> Figure:
    """Radial and tangential part of the residuals against the distance from the principal point."""
    x, y = r.x - centre[0], r.y - centre[1]
    radius = np.maximum(np.hypot(x, y), 1e-9)
    radial, tangential = (r.dx * x + r.dy * y) / radius, (r.dy * x - r.dx * y) / radius
    edges = np.unique(np.quantile(radius, np.linspace(0, 1, int(np.clip(len(r) // 30, 3, 12)) + 1)))
    with canvas(2.4) as (figure, axes):
        _scatter(axes, radius, radial)
        axes.axhline(0, color=SOFT, linewidth=0.6)
        _bars(axes, bin_means(radius, radial, edges), BLUE, "o", "radial, mean ± 2 u")
        _bars(axes, bin_means(radius, tangential, edges), RED, "s", "tangential, mean ± 2 u")
        axes.set_xlabel("distance from the principal point / px")
        axes.set_ylabel("residual / px")
        figure.legend(loc="outside upper center", ncols=2)
        caption = (
            "Residuals against the radius: dots are radial parts. A mean that oscillates with the radius shows that a lens term is missing."
        )
        return Figure(figure, f"{name}-radius", "Radial and tangential residuals against the radius", caption)


def against_phase(r: Residuals, name: str) -> Figure:
    """Residuals of x and of y against the sub-pixel phase of that coordinate."""
    edges = np.linspace(-0.5, 0.5, 11)
    with canvas(2.4, ncols=2, sharey=True) as (figure, both):
        for axes, axis, at, value in zip(both, "xy", (r.x, r.y), (r.dx, r.dy), strict=True):
            phase = (at - value + 0.5) % 1.0 - 0.5  # of the computed place: the measured one holds the noise that is looked at
            _scatter(axes, phase, value)
            axes.axhline(0, color=SOFT, linewidth=0.6)
            _bars(axes, bin_means(phase, value, edges), BLUE, "o", "mean ± 2 u")
            axes.set_xlabel(f"phase of {axis} / px")
            axes.set_xlim(-0.5, 0.5)
            axes.set_xticks([-0.4, 0.0, 0.4])
        both[0].set_ylabel("residual / px")
        caption = (
            "Residuals of x (left) and y (right) against the sub-pixel phase. A wave comes from targets that are too small or saturated."
        )
        return Figure(figure, f"{name}-phase", "Residuals in x and y against the sub-pixel phase", caption)


def short(r: float) -> str:
    """A correlation to two places, without the zero before the point."""
    return f"{r:.2f}".replace("0.", ".").replace("-", MINUS)


def correlation_map(names: Sequence[str], matrix: np.ndarray, name: str) -> Figure:
    """Correlations of the interior parameters, with their numbers."""
    matrix = np.asarray(matrix, float)
    n = len(names)
    labels = [label.upper() if label[0] in "bpk" else label for label in names]
    with canvas(0.95 * WIDTH_IN) as (figure, axes):
        axes.imshow(matrix, cmap="RdBu_r", vmin=-1, vmax=1, interpolation="none")
        axes.grid(False)
        axes.tick_params(length=0)
        axes.set_xticks(range(n), labels)
        axes.set_yticks(range(n), labels)
        axes.xaxis.tick_top()
        for i, j in zip(*np.nonzero(np.abs(matrix) >= 0.005), strict=True):
            if i != j:
                colour = LIGHT_TEXT if abs(matrix[i, j]) > 0.6 else DARK_TEXT
                axes.text(j, i, short(matrix[i, j]), color=colour, fontsize=5.4, ha="center", va="center")
        caption = (
            "Correlations of the interior parameters: red positive, blue negative. Strongly correlated parameters are only known together."
        )
        return Figure(figure, f"{name}-correlations", f"Correlation matrix of {n} interior parameters", caption)


def curve_pictures(curves: DistortionCurves, direction: str, name: str) -> list[Figure]:
    """Radial, balanced and tangential distortion with their 95 % bands; ``direction`` as of a `CameraModel`."""
    what = "correction" if direction == "image_to_object" else "distortion"
    unit, radius = curves.unit, curves.radius
    scaled = 1000.0 if unit == "mm" else 1.0
    shown = "µm" if unit == "mm" else unit
    made = []
    forms = (("radial", curves.radial_curve, BLUE, "-"), ("balanced", curves.balanced_curve, RED, "--"))
    for kind, members in (("radial", forms), ("tangential", (("tangential", curves.tangential_curve, BLUE, "-"),))):
        parts = [(key, curve, colour, dash) for key, curve, colour, dash in members if curve is not None]
        if not parts:
            continue
        with canvas(2.4) as (figure, axes):
            axes.axhline(0, color=SOFT, linewidth=0.6)
            for key, curve, colour, dash in parts:
                value = scaled * curve.value
                if curve.u is not None:
                    half = COVER_95 * scaled * curve.u
                    axes.fill_between(radius, value - half, value + half, color=colour, alpha=0.25, linewidth=0)
                axes.plot(radius, value, dash, color=colour, label=key)
            axes.set_xlabel(f"distance from the principal point / {unit}")
            axes.set_ylabel(f"{what} / {shown}")
            if len(parts) > 1:
                axes.legend(loc="best")
            made.append(Figure(figure, f"{name}-{kind}", f"{kind} {what} against the radius", _curve_caption(kind, what, curves)))
    return made


def _curve_caption(kind: str, what: str, curves: DistortionCurves) -> str:
    """What is drawn, and its size at the largest radius with the 95 % band."""
    unit, scaled = curves.unit, 1000.0 if curves.unit == "mm" else 1.0
    curve = curves.tangential_curve if kind == "tangential" else curves.radial_curve
    text = f"Tangential (decentring) {what}, √(P1² + P2²) r²" if kind == "tangential" else f"Radial {what} of the radius"
    text += ", with its 95 % band"
    if curve is not None and curve.u is not None:
        r, value, u = (float(part[-1]) for part in (curves.radius, curve.value, curve.u))
        number = uncertain(scaled * value, COVER_95 * scaled * u, "um" if unit == "mm" else unit)
        text += f": {number.value} ± {number.u} {number.unit} at {significant(r)} {unit}"
        if unit == "mm" and curve.value_px is not None and curve.u_px is not None:
            px = uncertain(float(curve.value_px[-1]), COVER_95 * float(curve.u_px[-1]), "px")
            text += f" ({px.value} ± {px.u} px)"
    if kind == "radial" and curves.balanced is not None and curves.balanced_c is not None:
        text += f". Balanced: the same lens with a principal distance of {significant(curves.balanced_c, 5)} {unit}"
    return text + "."


def projection_map(p: ProjectionMap, sensor: Sensor, name: str) -> Figure:
    """Standard uncertainty of a projected direction over the sensor."""
    u, x, y = p.u_px, p.x_px, p.y_px
    half_x, half_y = (float(np.ptp(v)) / max(len(v) - 1, 1) / 2 for v in (x, y))
    extent = (x.min() - half_x, x.max() + half_x, y.max() + half_y, y.min() - half_y)
    wide = float(np.nanmax(u)) > WIDE_RANGE * float(np.nanmin(u)) > 0
    with canvas(frame_height(sensor, 1.15) - 0.2) as (figure, axes):
        image = axes.imshow(1000 * u, cmap="cividis", extent=extent, interpolation="none", norm="log" if wide else "linear")
        axes.grid(False)
        axes.set_xlabel("x / px")
        axes.set_ylabel("y / px")
        bar = colour_bar(figure, axes, image, "u / 10⁻³ px")
        if wide:
            plain_log(bar.yaxis)
        caption = (
            "Projection uncertainty: standard uncertainty of an image coordinate (mean of x and y) with which the calibration tells "
            "where a direction is imaged; the part that a rotation of the camera would compensate is removed. Where there were no "
            "image points, the model extrapolates."
        )
        alt = f"Projection uncertainty over the sensor, {significant(float(np.nanmin(u)), 2)} to {significant(float(np.nanmax(u)), 2)} px"
        return Figure(figure, f"{name}-projection", alt, caption)


def by_image(records: Sequence[ImageRecord], name: str) -> Figure:
    """Residuals image by image in the order of time, and the x-scale where it was estimated."""
    timed = all(r.time_s is not None for r in records)
    at = np.array([r.time_s for r in records], float) if timed else np.arange(1, len(records) + 1, dtype=float)
    factor, label = (1.0, "image") if not timed else (1 / 60, "time / min") if np.ptp(at) > 300 else (1.0, "time / s")
    scale = np.array([r.x_scale for r in records], float)
    scaled = bool(np.isfinite(scale).any())
    with canvas(3.4 if scaled else 2.2, nrows=1 + scaled, sharex=True, squeeze=False) as (figure, grid):
        top, size = grid[0, 0], 3.0 if len(records) < 80 else 1.5
        rms_px = np.array([(r.rms_x_px, r.rms_y_px) for r in records], float)
        for axis, rms, colour, marker in zip("xy", rms_px.T, (BLUE, RED), "os", strict=True):
            top.plot(factor * at, rms, marker, color=colour, linestyle="none", markersize=size, label=f"{axis}, rms")
        top.set_ylim(0, 1.15 * top.get_ylim()[1])
        top.set_ylabel("residuals / px")
        if scaled:
            u = np.array([r.u_x_scale for r in records], float)
            low = grid[1, 0]
            low.axhline(0, color=SOFT, linewidth=0.6)
            low.errorbar(factor * at, 1e6 * scale, yerr=2e6 * u, fmt="o", color=INK, markersize=size, elinewidth=0.24 * size)
            low.set_ylabel("x-scale / 10⁻⁶")
        grid[-1, 0].set_xlabel(label)
        grid[-1, 0].xaxis.get_major_locator().set_params(integer=not timed)
        figure.legend(*top.get_legend_handles_labels(), loc="outside upper center", ncols=2)
        caption = "Residuals of each image in the order " + ("of time." if timed else "of the project.")
        if scaled:
            caption += " Below: the x-scale of each image against their mean, ± 2 u; a drift comes from a clock that warms up."
        return Figure(figure, f"{name}-time", f"Residual rms of {len(records)} images in order", caption)
