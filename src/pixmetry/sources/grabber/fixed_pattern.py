"""Fixed pattern of the grabber: a black level that settles over the first lines, channels that alternate, and a fixed grain."""

from __future__ import annotations

import numpy as np

from pixmetry.camera.contribution import Contribution, Probe
from pixmetry.camera.observations import Observations
from pixmetry.camera.signal import Kind, Signal
from pixmetry.camera.source import Parameters, Source, quantity
from pixmetry.core.arrays import Array
from pixmetry.core.errors import MeasureError
from pixmetry.core.number import Estimates
from pixmetry.core.random import Stream

FOUND_Z = 5.0  # of a settling: its length is searched for, too
LAGS = 10  # rows over which noise may be alike


class FixedPattern(Parameters):
    """What the grabber adds to every frame alike."""

    settling_dn: float = quantity(0.0, "DN", "error of the black level in row 0", ge=-1e3, le=1e3)
    settling_rows: float = quantity(10.0, "rows", "number of rows over which it falls to 1/e", gt=0.1, le=1e4)
    interlaced: bool = quantity(False, "1", "whether even and odd rows are two fields; the level then settles within each field")
    column_step_dn: float = quantity(0.0, "DN", "height of one column in every period above the others", ge=-1e3, le=1e3)
    column_period: int = quantity(2, "px", "period of the column pattern: number of converters that take turns", ge=2, le=64)
    random_std_dn: float = quantity(0.0, "DN", "standard deviation of the fixed pattern from pixel to pixel", ge=0, le=1e3)


def settling(params: FixedPattern, rows: np.ndarray) -> np.ndarray:
    """Error of the black level in DN at absolute rows: B e^(−r/r_s); in fields both rows of a pair are the same line."""
    line = np.asarray(rows) // 2 * 2 if params.interlaced else np.asarray(rows)
    return params.settling_dn * np.exp(-line.astype(float) / params.settling_rows)


def channel(params: FixedPattern, cols: np.ndarray) -> np.ndarray:
    """Column pattern in DN at absolute columns, with mean zero over a period."""
    offset: Array = params.column_step_dn * ((np.asarray(cols) % params.column_period == 0) - 1 / params.column_period)
    return offset


def forward(params: FixedPattern, signal: Signal, stream: Stream) -> Signal:
    """Add the settling of the rows, the pattern of the columns and the fixed grain."""
    data = signal.data
    if params.random_std_dn:
        data = stream.add_normal_fixed(data, signal.grid, params.random_std_dn)
    if params.settling_dn:
        data = data + settling(params, signal.rows).astype(np.float32)[:, :, None]
    if params.column_step_dn:
        data = data + channel(params, signal.cols).astype(np.float32)[:, None, :]
    return signal.with_data(data)


def measure(observations: Observations) -> Estimates:
    """Fit the settling to the row means of the mean dark image, and the step to its column means; the grain is not told from DSNU.

    The uncertainties come from the scatter of the row and column means about the fit, so that they contain what else is fixed there.
    """
    stack = observations.dark_stack
    if stack is None or min(stack.shape) < 16:
        raise MeasureError(
            "the fixed pattern needs a stack of dark frames", where="grabber.fixed_pattern", remedy="take at least 16 of them"
        )
    settled = _fit_settling(stack.mean_map_dn.mean(axis=1))
    step = _fit_step(stack.mean_map_dn.mean(axis=0))
    return settled.join(step)


def _fit_settling(profile: np.ndarray) -> Estimates:
    from scipy.optimize import curve_fit

    rows = np.arange(len(profile), dtype=float)
    tail = float(np.median(profile[len(profile) // 2 :]))
    best = None
    for start in np.geomspace(1.0, len(profile) / 4, 4):  # the scale enters non-linearly: several starts, the best is kept
        try:
            fit = curve_fit(
                lambda r, b, s, c: b * np.exp(-r / s) + c,
                rows,
                profile,
                p0=(profile[0] - tail, start, tail),
                bounds=([-np.inf, 0.2, -np.inf], [np.inf, len(profile) / 2, np.inf]),
            )
        except RuntimeError:
            continue
        chi2 = float(((profile - fit[0][0] * np.exp(-rows / fit[0][1]) - fit[0][2]) ** 2).sum())
        best = (chi2, *fit) if best is None or chi2 < best[0] else best
    dof = len(profile) - 3.0
    if best is not None:  # rows that are noisy alike, as by flicker, tell less than rows that are independent
        left = profile - best[1][0] * np.exp(-rows / best[1][1]) - best[1][2]
        whole = float(left @ left) or 1.0  # frames without noise
        lags = [float(left[k:] @ left[:-k]) / whole for k in range(1, min(LAGS, len(left) // 4) + 1)]
        best = (best[0], best[1], best[2] * max(1 + 2 * sum(lags), 1.0))
    method = "least squares of B exp(−r/r_s) + c over the row means of the mean dark image"
    if best is not None and np.isfinite(best[2]).all() and abs(best[1][0]) > FOUND_Z * np.sqrt(best[2][0, 0]):
        values, covariance = best[1][:2], best[2][:2, :2]
        names, units = ("settling_dn", "settling_rows"), ("DN", "rows")
        confounders = ("dark signal that decreases from row to row, such as amplifier glow at the upper edge",)
        return Estimates(names, values, covariance, np.full(2, dof), units, method=method, confounders=confounders)
    u = float(np.std(np.diff(profile[len(profile) // 2 :])) / np.sqrt(2))
    first = abs(float(profile[0]) - tail)
    return Estimates.from_rows(
        [("settling_dn", first + 1.645 * u, u, dof, "DN")],
        method=method,
        limits=frozenset({"settling_dn"}),
        reasons={"settling_dn": "no settling is significant against the scatter of the rows; the limit holds for row 0"},
    )


def _fit_step(profile: np.ndarray) -> Estimates:
    """Mean of the second differences of neighbouring columns with alternating sign: shading up to a slope drops out.

    The second differences that are left have 3/2 of the variance of independent columns, and their overlaps leave about half as many
    degrees of freedom as there are columns.
    """
    n = len(profile)
    even = np.arange(1, n - 1) % 2 == 0
    share = np.where(even, 0.5 / even.sum(), -0.5 / (~even).sum())
    weight = np.convolve(share, [-0.5, 1.0, -0.5])  # of every column
    step = float(weight @ profile)
    left = np.convolve(profile, [-0.5, 1.0, -0.5], mode="valid") - np.where(even, step, -step)
    u = float(np.sqrt((left**2).sum() / (n - 3) / 1.5 * (weight**2).sum()))
    return Estimates.from_rows(
        [("column_step_dn", step, u, n // 2, "DN")],
        method="alternating sum of the column means of the mean dark image (period 2)",
        confounders=("odd-even difference of the sensor's own columns",),
    )


def propagate(params: FixedPattern, probe: Probe) -> Contribution:
    """Settling (P2) for a target anywhere in the frame, the columns' pattern at each of its phases, the grain as white noise (P1)."""
    n, rows, cols = probe.gx.shape
    first_rows = np.arange(max(probe.frame_shape[0] - rows, 0) + 1)
    step = 2 if params.interlaced else 1
    settle = np.empty((2, len(first_rows)))
    for begin in range(step):
        field = np.broadcast_to(settling(params, np.arange(rows) + begin)[:, None], (n, rows, cols))
        fall = np.exp(-(first_rows[begin::step] - begin) / params.settling_rows)
        settle[:, begin::step] = [np.mean(shift) * fall for shift in probe.field(field)]
    stripes = [probe.field(np.broadcast_to(channel(params, np.arange(cols) + k), (n, rows, cols))) for k in range(params.column_period)]
    grain = probe.white(params.random_std_dn)
    u = [np.sqrt(np.var(settle[a]) + np.mean([s[a] ** 2 for s in stripes]) + grain[a] ** 2) for a in (0, 1)]
    return Contribution(
        u_x_px=float(u[0]),
        u_y_px=float(u[1]),
        bias_x_px=float(settle[0].mean()),
        bias_y_px=float(settle[1].mean()),
        gum_class="F",
        model_error=0.3,
        method="response of the estimator to the ramp of the rows, the pattern of the columns and the pattern of the pixels, averaged "
        "over all positions",
    )


SOURCE = Source(
    id="grabber.fixed_pattern",
    title="Fixed pattern of the grabber",
    description="The black level settles over the first lines, the converters that take turns differ, and every pixel has a fixed offset.",
    number=33,
    stars=1,
    note="Note 20",
    parameters=FixedPattern,
    consumes=(Kind.DN,),
    after=("sensor", "electronics", "cable"),
    before=("grabber.adc", "processing"),
    neutral=FixedPattern(),
    typical=FixedPattern(settling_dn=4.0, settling_rows=20.0, column_step_dn=0.3, random_std_dn=0.3),
    bound=FixedPattern(settling_dn=8.0, settling_rows=30.0, column_step_dn=1.0, random_std_dn=1.0),
    forward=forward,
    measure=measure,
    propagate=propagate,
    applies_to=("analogue",),
    gum_class="F",
    equation="y' = y + B e^(−r/r_s) + a ([c mod p = 0] − 1/p) + s n_rc;  interlaced: 2 (r div 2) in place of r",
    typical_size="0.035 px for a ramp of 0.2 DN a row under a disc of 7 px of 150 DN (centroid, window radius 6)",
    references=("EMVA 1288 R4.0 Linear, §8.2 (row, column and pixel parts)",),
    advice="Do not use the first lines. Subtract a mean dark frame of the same grabber, or the background around each target.",
    reasons={
        "correct": "subtracting the mean dark frame removes it together with the sensor's own dark pattern, and dark frames do not tell "
        "the two apart. What it settles by at the top of the frame is corrected with them, by sensor.dsnu"
    },
)
