"""Where the active area lies in frames that store more than it, and the ratio of sampling clock and pixel clock.

The image begins where the mean over the rows (columns) rises through half of its height. Its width in samples over the sensor's columns is
the ratio of the clocks. The steps from pixel to pixel in the fixed pattern repeat with the pixel clock; sampled, they show a line at the
distance of f_pixel/f_sampling from the next whole number. The width tells that number and the side; the line the rest.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from pixmetry.camera.observations import ActiveArea, Observations
from pixmetry.camera.stated import StatedFacts
from pixmetry.core.arrays import Array
from pixmetry.core.number import Estimates
from pixmetry.observe.experiment import PictureGroup

LEAST_CONTRAST = 10.0  # height of the image over the noise of a profile
INNER_PX = 12  # inside of the border, where the level of the image is taken
BLACK_PX = 2  # black columns or rows that make a border
U_EDGE_PX = 0.3  # of the border of an analogue image: rise times and blanking, a rectangular distribution of half a pixel to each side
LEAST_POWER = 25.0  # of a line in the fixed pattern, over the median
SMOOTH_PX = 31  # slower waves of a profile are shading
SHADING_ORDER = 8  # of its polynomial
METHOD = "half height of the mean profiles; ratio of the clocks from the width, and from the line in the fixed pattern"


def reduce_borders(groups: Sequence[PictureGroup], seen: Observations) -> Observations:
    """Find the active area in the group of the most frames."""
    group = max(groups, key=lambda g: g.moments.n_frames)
    area = active_area(group.moments.mean_map_dn(), group.moments.n_frames, seen.stated)
    notes = () if len(area.fit) else (f"the border of the image is not told: {next(iter(area.fit.reasons.values()))}",)
    return replace(seen, area=area, notes=(*seen.notes, *notes))


def active_area(mean_map: np.ndarray, frames: int, stated: StatedFacts) -> ActiveArea:
    """Find the border of the image and the clocks' ratio.

    Parameters
    ----------
    mean_map : ndarray, shape (rows, cols), DN
        Mean of the frames.
    frames : int
    stated : StatedFacts
        Interface, pixel clock and size of the sensor, as far as known.

    Returns
    -------
    ActiveArea
    """
    rows, cols = mean_map.shape
    data = np.asarray(mean_map, float)
    edges = np.concatenate([data[:BLACK_PX].ravel(), data[-BLACK_PX:].ravel(), data[:, :BLACK_PX].ravel(), data[:, -BLACK_PX:].ravel()])
    black = float(np.percentile(edges, 1))
    lit = data > 0.5 * (black + float(np.percentile(data, 95)))
    bright = float(np.median(data[lit])) if lit.any() else black
    lit = lit if lit.any() else np.ones_like(lit)
    lit_rows, lit_cols = (lit.mean(axis=axis) > 0.5 * lit.mean(axis=axis).max() for axis in (1, 0))
    of_cols, of_rows = np.median(data[lit_rows], axis=0), np.median(data[:, lit_cols], axis=1)
    noise = float(np.median(np.abs(np.diff(data, axis=1))[lit[:, 1:]])) / 0.6745 / np.sqrt(2) if lit[:, 1:].any() else 0.0
    nowhere = ActiveArea(*(float("nan"),) * 4, rows, cols, black, bright, of_cols, of_rows, float("nan"), 0.0, Estimates.empty())
    if bright - black < LEAST_CONTRAST * max(noise, 0.1):
        why = "no side of the frame is black: set the grabber's window larger than the image, and light the field to half of saturation"
        return replace(nowhere, fit=replace(Estimates.empty(), reasons=dict.fromkeys(("row_offset", "col_offset", "clock_mhz"), why)))
    left, right = _ends(of_cols, black, bright)
    top, bottom = _ends(of_rows, black, bright)
    inside = slice(int(np.nan_to_num(top)) + INNER_PX, int(bottom if np.isfinite(bottom) else rows) - INNER_PX)
    first = int(np.ceil(left if np.isfinite(left) else 0)) + INNER_PX
    last = int(right if np.isfinite(right) else cols) - INNER_PX
    within = data[inside, first:last]
    nu, u_nu, power = strongest_line(within.mean(axis=0) if within.size else np.zeros(0))
    area = replace(nowhere, left=left, right=right, top=top, bottom=bottom, beat=nu, beat_power=power)
    return replace(area, fit=_told(area, u_nu, stated))


def _ends(profile: Array, black: float, bright: float) -> tuple[float, float]:
    """Where a profile rises and falls through half of the height that it has a little further inside; NaN without a black border."""
    n, found = len(profile), []
    for values in (profile, profile[::-1]):
        rises = int(np.argmax(values > 0.5 * (black + bright)))
        near = float(np.median(values[rises + 2 : rises + 2 + INNER_PX]))
        half = 0.5 * (black + near)
        k = int(np.argmax(values > half))
        if k < BLACK_PX:
            found.append(float("nan"))
            continue
        # a pixel k that is bright from its left edge on has its full level; one that is lit in part, a part of it
        share = float(np.clip((values[k - 1] - black) / (near - black), 0, 1)) + float(np.clip((values[k] - black) / (near - black), 0, 1))
        found.append(k + 1 - share)
    left, right = found
    return left, n - right if np.isfinite(right) else float("nan")


def strongest_line(profile: np.ndarray) -> tuple[float, float, float]:
    """Frequency of the strongest line in a profile (cycles per sample), its u, and its power over the median.

    u = √(6 σ²/(π² A² N³)) is the Cramér-Rao bound of a sinusoid of amplitude A in white noise σ (D. Rife, R. Boorstyn, IEEE Trans. Inf.
    Theory 20 (1974) 591).
    """
    m = len(profile)
    if m < 3 * SMOOTH_PX:
        return float("nan"), float("nan"), 0.0
    shading = np.polynomial.legendre.legvander(np.linspace(-1, 1, m), SHADING_ORDER)
    rest = profile - shading @ np.linalg.lstsq(shading, profile, rcond=None)[0]
    taper = np.hanning(m)
    power = np.abs(np.fft.rfft(rest * taper, 4 * m)) ** 2
    low = int(4 * m * 2 / SMOOTH_PX)
    at = low + int(np.argmax(power[low:-4]))
    median = float(np.median(power[low:]))
    k = np.arange(m)

    def residual(nu: float) -> tuple[float, float]:
        design = np.column_stack([np.cos(2 * np.pi * nu * k), np.sin(2 * np.pi * nu * k), shading])
        p = np.linalg.lstsq(design, rest, rcond=None)[0]
        return float(((rest - design @ p) ** 2).sum()), float(np.hypot(p[0], p[1]))

    nu, width = at / (4 * m), 1 / (4 * m)
    for _ in range(40):
        ends = [(residual(v)[0], v) for v in (nu - width, nu, nu + width)]
        nu, width = min(ends)[1], width * 0.7
    squares, amplitude = residual(nu)
    sigma2 = squares / max(m - 4 - SHADING_ORDER, 1)
    u = np.sqrt(6 * sigma2 / (np.pi**2 * max(amplitude, 1e-12) ** 2 * m**3))
    return float(nu), float(u), float(power[at]) / max(median, 1e-300)


def _told(area: ActiveArea, u_nu: float, stated: StatedFacts) -> Estimates:
    rows: list[tuple[str, float, float, float, str]] = []
    reasons: dict[str, str] = {}
    analogue = stated.interface == "analogue"
    height = area.bottom - area.top
    if not np.isfinite(area.top):
        reasons["row_offset"] = "the first row of the frame is bright: the window begins inside the image, and how far is not told"
    elif stated.sensor_rows is not None and np.isfinite(height) and round(height) != stated.sensor_rows:
        what = f"{round(height)} rows of the image are seen between black ones, and the sensor has {stated.sensor_rows}"
        reasons["row_offset"] = f"{what}: which rows are missing is not told"
    else:
        rows.append(("row_offset", -float(round(area.top)), 0.0, np.inf, "px"))
        if stated.sensor_rows is None:
            reasons["row_offset"] = "if the first row behind the black ones is the image's first: sensor_rows was not stated"
    ratio, u_ratio, why = clock_ratio(area, u_nu, stated)
    own = np.isfinite(ratio) and abs(ratio - 1) > 3 * u_ratio
    if not np.isfinite(area.left):
        reasons["col_offset"] = "the first column of the frame is bright: the window begins inside the image, and how far is not told"
    elif own:
        reasons["col_offset"] = "behind a sampling clock of its own the grabber's start is given as start_ns; both move the image alike"
    else:
        rows.append(("col_offset", -float(round(area.left)), 0.0, np.inf, "px"))
    if not np.isfinite(ratio):
        reasons |= dict.fromkeys(("clock_ratio", "clock_mhz", "start_ns"), why)
        return Estimates.from_rows(rows, method=METHOD, reasons=reasons)
    rows.append(("clock_ratio", ratio, u_ratio, np.inf, "1"))
    if why:
        reasons["clock_ratio"] = why
    if not analogue:
        reasons["clock_mhz"] = "a digital camera has no sampling clock of a frame grabber"
    elif stated.pixel_clock_mhz is None:
        reasons["clock_mhz"] = f"the sampling clock is {ratio:.5f} times the pixel clock, which was not stated (pixel_clock_mhz)"
    elif not own:
        reasons["clock_mhz"] = f"the sampling clock is the pixel clock: their ratio is {ratio:.5f} ± {u_ratio:.2g}"
    else:
        clock = ratio * stated.pixel_clock_mhz
        rows.append(("clock_mhz", clock, u_ratio * stated.pixel_clock_mhz, np.inf, "MHz"))
        if np.isfinite(area.left):
            rows.append(("start_ns", -1e3 * area.left / clock, 1e3 * U_EDGE_PX / clock, np.inf, "ns"))
    return Estimates.from_rows(rows, method=METHOD, reasons=reasons, confounders=("a line of another oscillator in the fixed pattern",))


def clock_ratio(area: ActiveArea, u_nu: float, stated: StatedFacts) -> tuple[float, float, str]:
    """Sampling clock over pixel clock, its u, and the reason why it is not finer (or not there: NaN)."""
    if not (np.isfinite(area.left) and np.isfinite(area.right)):
        return float("nan"), float("nan"), "the image has no black border on both sides, so its width is not told"
    if stated.sensor_cols is None:
        return float("nan"), float("nan"), "the number of columns of the sensor was not stated (sensor_cols)"
    coarse = (area.right - area.left) / stated.sensor_cols
    u_coarse = np.sqrt(2) * U_EDGE_PX / stated.sensor_cols
    if area.beat_power < LEAST_POWER or not np.isfinite(area.beat):
        return coarse, u_coarse, "from the width of the image: the fixed pattern shows no line in which the clocks beat"
    turns, u_turns = 1 / coarse, u_coarse / coarse**2  # pixel clock over sampling clock
    candidates = [m + sign * area.beat for m in range(int(turns) + 3) for sign in (1, -1) if m + sign * area.beat > 0]
    near = [c for c in candidates if abs(c - turns) < 4 * u_turns]
    if not near:
        line = f"a line at {area.beat:.5f} cycles per sample does not fit the width of the image"
        return coarse, u_coarse, f"from the width of the image: {line}, and is no beat of these clocks"
    if len(near) > 1:
        return coarse, u_coarse, "from the width of the image: two orders of the beat fit it"
    return 1 / near[0], max(u_nu, 1e-9) / near[0] ** 2, ""
