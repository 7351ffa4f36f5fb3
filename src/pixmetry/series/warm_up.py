"""The curve through the motion of a field: a camera that settles with one or two time constants, and a frame grabber's clock."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
from scipy import stats
from scipy.optimize import least_squares

from pixmetry.camera.drift_series import CAMERA_MODES, DIGITAL, DriftSeries
from pixmetry.core.arrays import Array
from pixmetry.core.errors import MeasureError
from pixmetry.core.number import LOWER_LIMIT, ONE_SIDED_95, Estimates, Number
from pixmetry.series.modes import FieldMotion, design_of, focus_motion

MOST_BINS = 400  # means of neighbouring frames beyond that many: shorter than any time constant that the series tells
FALSE_ALARM = 1e-4  # that a part of the curve is taken for real where there is none
TOLD_U_REL = 0.5  # u of the largest motion until it settles, beyond which the settled place is not told
TOLD_SHARE = 0.8  # of the prior's u: what the series narrows less is not told by it
ALIKE = 25.0  # difference of χ² below which a second solution is not excluded
APART = 0.7  # of the logarithms of slow time constants, from which on they are two
NOT_APART = 0.99  # correlation from which on two parameters are told only as a sum
SIGNIFICANT = 3.0
CONFOUNDERS = (
    "sensor.thermal_expansion (a logged temperature tells it apart)",
    "expansion or motion of the target field",
    "a change of the focus",
)
TOO_SHORT = "the series of {:.0f} s is too short for the slow part: go on until nothing moves"
METHOD = "positions of a fixed field of targets over time; exponential curves by generalised least squares"
DRAWS = 2000  # of time constants: u to some per cent where curves of very different ones fit alike
KEPT = 200  # of them, by their probability
WIDER = 1.5  # than a minimum's own u: the draws about it
NO_SHARE = 1e-6
SINGLE = 13.3  # χ² that a second time constant must take away, so that it is not chance: once in 770, two parameters
ROUNDS = 3  # of weights and curve in turn
FAST = ("ln fast", "share")
LOCK_US, U_LOCK_US = 10.5, 1.0  # from the sync edge to the first pixel: CCIR 10.5, EIA 9.4 to 10.9 by the width of the blanking


@dataclass(frozen=True)
class Curve:
    """Which parts the motion has: a camera that settles, and a frame grabber that does."""

    camera: bool
    grabber: bool

    def names(self, modes: Sequence[str]) -> list[str]:
        """The parameters in order; ``ln fast`` is over the slow time constant."""
        names = [f"zero {mode}" for mode in modes]
        if self.camera:
            names += [*CAMERA_MODES, "ln slow", *FAST]
        if self.grabber:
            names += ["scale error", "ln scale", "lock", "delay", "ln delay"]
        return names


@dataclass(frozen=True)
class Series:
    """The motion as it is fitted: time, modes and their covariance, shape (times, modes) and (times, modes, modes).

    ``frames`` is how many frames each row is the mean of; ``x0_px`` the column of the frame's centre, ``clock_mhz`` the pixel clock.
    """

    time_s: Array
    modes: tuple[str, ...]
    values: Array
    covariance: Array
    frames: Array
    x0_px: float
    clock_mhz: float | None


@dataclass(frozen=True)
class Fit:
    """A fitted curve: parameters, covariance, χ²; ``draws`` are curves that fit too, by their probability, shape (draws, parameters)."""

    curve: Curve
    names: list[str]
    values: Array
    covariance: Array
    chi2: float
    dof: int
    draws: Array | None = None

    def __getitem__(self, name: str) -> float:
        return float(self.values[self.names.index(name)])

    def u(self, name: str) -> float:
        """Standard uncertainty of a parameter."""
        k = self.names.index(name)
        return float(np.sqrt(self.covariance[k, k]))


def drift_of(
    motion: FieldMotion,
    time_s: Array,
    frame_shape: tuple[int, int],
    *,
    clock_mhz: float | None = None,
    tolerance_px: float = 0.05,
    blur_px2: Array | None = None,
) -> DriftSeries:
    """Fit the warm-up of a camera, and of a frame grabber where the motion has its modes.

    Parameters
    ----------
    motion : FieldMotion
    time_s : ndarray, shape (frames,)
        Since switching on.
    frame_shape : (int, int)
    clock_mhz : float, optional
        Pixel clock of an analogue camera's frame grabber; without it the delay is not told in ns.
    tolerance_px : float
        Of the stability time.
    blur_px2 : ndarray, shape (frames, targets, 2), optional
        Variance of each target's blur, and its u.

    Returns
    -------
    DriftSeries

    Raises
    ------
    MeasureError
        With fewer frames than the curve has parameters.

    Notes
    -----
    Settled share p(t) = 1 − f exp(−t/τ₁) − (1 − f) exp(−t/τ₂) of shift, scale and rotation; of the clock δ(t) = δ₀ exp(−t/τ), by which a
    place x from the lock of a line moves by x δ; the delay of its lines has an amplitude and a time constant of its own. All parts are
    always fitted together, with wide priors on what a series may leave open (`_priors`), so that u holds what it cannot tell apart. A
    camera or a grabber without which χ² grows by no more than chance does once in 10⁴ (likelihood ratio) has limits in place of values.
    The covariance of a camera without a grabber holds all curves that fit, by their probability (`_marginal`): a series that ends before
    the image settles has a settled place with a large u. With a grabber, where two solutions fit alike (a delay that decays as a part of
    the camera does), what differs between them is not told.

    The weights hold, beside the positions' covariance, what shift and rotation scatter from frame to frame; that scatter is estimated from
    the residuals, and is the result for a stabilised sensor. Where residuals are correlated from frame to frame, all u grow by
    √((1 + ρ)/(1 − ρ)).
    """
    used = motion.used
    time, values = np.asarray(time_s, float)[used], motion.values[used]
    order = np.argsort(time, kind="stable")
    time, values, covariance = time[order], values[order], motion.covariance[used][order] * max(1.0, motion.location_factor) ** 2
    if not np.ptp(time) > 0:
        raise MeasureError("all frames were taken at the same time", where="series", remedy="correct their times")
    least = -(-3 * (len(motion.modes) + 8) // len(motion.modes))
    if len(time) < least:
        raise MeasureError(f"{len(time)} frames are too few for a curve", where="series", allowed=f"{least} or more", remedy="take more")
    single = Series(time, motion.modes, values, covariance, np.ones(len(time)), 0.5 * (frame_shape[1] - 1), clock_mhz)
    series = _binned(single)
    scatter = _first_scatter(single)
    whole = Curve(True, "affinity_rel" in motion.modes)
    fit = _fitted(series, whole, scatter, list(_starts(series, whole, scatter)))
    for _ in range(ROUNDS):
        scatter, _ = _scatter(single, fit)
        fit = _fitted(series, whole, scatter, [fit.values])
    scatter, u_scatter = _scatter(single, fit)
    fit, others = _alternatives(series, fit, scatter)
    found = _parts(series, fit, scatter)
    one_tau = _single_s(series, fit, scatter) if found.camera and not found.grabber else None
    widened = _widening(series, fit, scatter)
    draws = None if fit.draws is None else fit.values + np.sqrt(widened) * (fit.draws - fit.values)
    fit = replace(fit, covariance=fit.covariance * widened, draws=draws)
    estimates = _estimates(series, fit, found, others, u_scatter, one_tau)
    blur, u_blur = focus_motion(np.full((len(time_s), 1, 2), np.nan) if blur_px2 is None else blur_px2)
    corners = _corners(frame_shape)
    distance, u_distance = _from_settled(fit, series, corners, np.asarray(time_s, float))
    return DriftSeries(
        time_s=np.asarray(time_s, float),
        modes=motion.modes,
        values=np.where(used[:, None], motion.values, np.nan),
        u=np.sqrt(np.maximum(np.diagonal(motion.covariance, axis1=1, axis2=2), 0)) * max(1.0, motion.location_factor),
        fitted=_curve(fit.curve, fit.names, fit.values, np.asarray(time_s, float), series)[0],
        from_settled_px=distance,
        u_from_settled_px=u_distance,
        targets=len(motion.targets),
        location_factor=motion.location_factor,
        fit=estimates,
        stable=_stability(fit, series, found, corners, tolerance_px, settles=_differing("ln slow", fit, others) is None),
        tolerance_px=tolerance_px,
        blur_px2=blur,
        u_blur_px2=u_blur,
        focus=_focus_change(np.asarray(time_s, float), blur, u_blur),
    )


def _focus_change(time_s: Array, blur_px2: Array, u_px2: Array) -> Number:
    """Change of the blur's variance from the first fifth of a series to the last one."""
    method = "mean variance of the targets' blur in the last fifth of the frames, less that in the first fifth"
    order = np.argsort(time_s, kind="stable")
    order = order[np.isfinite(blur_px2[order])]
    part = len(order) // 5
    if not part:
        return Number.not_available("px²", "the blur of the targets is not measured", method, "blur_change_px2")
    first, last = order[:part], order[-part:]
    value = float(blur_px2[last].mean() - blur_px2[first].mean())
    u = float(np.sqrt((u_px2[first] ** 2).sum() + (u_px2[last] ** 2).sum())) / part
    return Number(value, u, np.inf, "px²", method, name="blur_change_px2")


def _binned(series: Series) -> Series:
    """Means of neighbouring frames, where there are very many."""
    if len(series.time_s) <= MOST_BINS:
        return series
    parts = np.array_split(np.arange(len(series.time_s)), MOST_BINS)
    count = np.array([len(p) for p in parts], float)
    return replace(
        series,
        time_s=np.array([series.time_s[p].mean() for p in parts]),
        values=np.array([series.values[p].mean(axis=0) for p in parts]),
        covariance=np.array([series.covariance[p].mean(axis=0) / len(p) for p in parts]),
        frames=count,
    )


def _curve(curve: Curve, names: list[str], values: Array, time_s: Array, series: Series) -> tuple[Array, Array]:
    """Modes at times, shape (times, modes), and their derivatives by the parameters, (times, modes, parameters)."""
    at = {name: k for k, name in enumerate(names)}
    modes = {mode: k for k, mode in enumerate(series.modes)}
    found = np.zeros((len(time_s), len(modes)))
    slope = np.zeros((len(time_s), len(modes), len(names)))
    for mode, k in modes.items():
        found[:, k] = values[at[f"zero {mode}"]]
        slope[:, k, at[f"zero {mode}"]] = 1
    if curve.camera:
        slow = np.exp(values[at["ln slow"]])
        e2 = np.exp(-time_s / slow)
        share, fast = values[at["share"]], slow * np.exp(values[at["ln fast"]])
        e1 = np.exp(-time_s / fast)
        settled = 1 - share * e1 - (1 - share) * e2
        by_slow = -(1 - share) * e2 * time_s / slow
        by_fast = -share * e1 * time_s / fast
        for mode in CAMERA_MODES:
            k, a = modes[mode], values[at[mode]]
            found[:, k] += a * settled
            slope[:, k, at[mode]] = settled
            slope[:, k, at["ln slow"]] = a * (by_slow + by_fast)
            slope[:, k, at["ln fast"]] = a * by_fast
            slope[:, k, at["share"]] = a * (e2 - e1)
    if curve.grabber:
        x, m = modes["shift_x_px"], modes["affinity_rel"]
        tau, zero = np.exp(values[at["ln scale"]]), values[at["zero affinity_rel"]]
        e = np.exp(-time_s / tau)
        delta = values[at["scale error"]] * e
        arm = series.x0_px + 0.5 + values[at["lock"]]
        by_delta, by_zero = 1 / (1 + zero), -(1 + delta) / (1 + zero) ** 2
        found[:, m] = (delta - zero) / (1 + zero)
        found[:, x] += arm * found[:, m]
        for name, change in (("scale error", e), ("ln scale", delta * time_s / tau)):
            slope[:, m, at[name]] = by_delta * change
        slope[:, m, at["zero affinity_rel"]] = by_zero
        slope[:, x] += arm * slope[:, m]
        slope[:, x, at["lock"]] = found[:, m]
        tau = np.exp(values[at["ln delay"]])
        e = np.exp(-time_s / tau)
        found[:, x] += values[at["delay"]] * e
        slope[:, x, at["delay"]] = e
        slope[:, x, at["ln delay"]] = values[at["delay"]] * e * time_s / tau
    return found, slope


def _priors(names: Sequence[str], series: Series) -> tuple[list[int], Array, Array]:
    """What is known of parameters that a series may leave open: their places, centres and u.

    Time constants of cameras and grabbers lie between minutes and an hour (a slow part of 10 to 60 min, a fast one of 1 to 5 min), the
    share of the fast part between 0 and 1; the lock of the lines follows from the video standard.
    """
    clock = series.clock_mhz or 14.75
    known = {
        "ln slow": (np.log(1500.0), 1.0),
        "ln fast": (np.log(1 / 8), 0.8),
        "share": (0.35, 0.3),
        "ln scale": (np.log(820.0), 1.0),
        "ln delay": (np.log(820.0), 1.0),
        "lock": (LOCK_US * clock, U_LOCK_US * clock),
    }
    at = [k for k, name in enumerate(names) if name in known]
    return at, np.array([known[names[k]][0] for k in at]), np.array([known[names[k]][1] for k in at])


def _whitening(series: Series, scatter: Array) -> Array:
    """Inverse of a factor of each row's covariance, shape (times, modes, modes)."""
    whole = series.covariance + np.eye(len(series.modes)) * (scatter / series.frames[:, None])[:, None, :]
    return np.linalg.inv(np.linalg.cholesky(whole))


def _fitted(series: Series, curve: Curve, scatter: Array, starts: Sequence[Array], *, single: bool = False) -> Fit:
    """The best fit from several starts; ``single`` has no fast part."""
    names = curve.names(series.modes)
    white = _whitening(series, scatter)
    at, centre, u = _priors(names, series)
    if single:
        one = at.index(names.index("share"))
        centre[one], u[one] = 0.0, NO_SHARE
    prior = np.zeros((len(at), len(names)))
    prior[np.arange(len(at)), at] = 1 / u

    def residuals(values: Array) -> Array:
        found = _curve(curve, names, values, series.time_s, series)[0]
        return np.concatenate([np.einsum("kab,kb->ka", white, found - series.values).ravel(), (values[at] - centre) / u])

    def slopes(values: Array) -> Array:
        by = _curve(curve, names, values, series.time_s, series)[1]
        return np.concatenate([np.einsum("kab,kbp->kap", white, by).reshape(-1, len(names)), prior])

    tried = [least_squares(residuals, start, slopes, method="lm", x_scale="jac", max_nfev=200) for start in starts]
    best = min(tried, key=lambda one: float(one.cost))
    by = slopes(best.x)
    size = np.maximum(np.linalg.norm(by, axis=0), 1e-300)
    covariance = np.linalg.pinv((by / size).T @ (by / size), rcond=1e-13, hermitian=True) / size / size[:, None]
    return Fit(curve, names, best.x, covariance, 2 * float(best.cost), series.values.size + len(at) - len(names))


def _starts(series: Series, curve: Curve, scatter: Array) -> Iterator[Array]:
    """Time constants over the series; what is linear by least squares."""
    names, span = curve.names(series.modes), float(np.ptp(series.time_s))
    at, centre, _ = _priors(names, series)
    cameras = [(span / 2, 1 / 4), (span / 5, 1 / 6), (span / 2, 1 / 20)] if curve.camera else [(1.0, 1.0)]
    clocks = [(span / 6, span / 6), (span / 6, span / 20), (span / 3, span / 6)] if curve.grabber else [(1.0, 1.0)]
    for (slow, ratio), (scale, delay) in product(cameras, clocks):
        values = np.zeros(len(names))
        values[at] = centre
        for name, value in (("ln slow", slow), ("ln fast", ratio), ("ln scale", scale), ("ln delay", delay)):
            if name in names:
                values[names.index(name)] = np.log(value)
        yield _with_linear(series, curve, values, scatter)


def _with_linear(series: Series, curve: Curve, values: Array, scatter: Array) -> Array:
    """Parameters with those without a prior, which are (nearly) linear, by least squares."""
    names = curve.names(series.modes)
    linear = [k for k in range(len(names)) if k not in _priors(names, series)[0]]
    values, white = values.copy(), _whitening(series, scatter)
    values[linear] = 0
    found, slope = _curve(curve, names, values, series.time_s, series)
    by = np.einsum("kab,kbp->kap", white, slope).reshape(-1, len(names))[:, linear]
    values[linear] = np.linalg.lstsq(by, np.einsum("kab,kb->ka", white, series.values - found).ravel(), rcond=1e-12)[0]
    return values


def _alternatives(series: Series, fit: Fit, scatter: Array) -> tuple[Fit, list[Fit]]:
    """The best fit, and others that are not excluded beside it: from starts where the camera settles long after the series, and where the
    delay decays as one part of the camera does.
    """
    span, fits = float(np.ptp(series.time_s)), [fit]
    for slow, ratio in ((3 * span, 1 / 20), (3 * span, 1 / 5), (span, 1 / 8), (span / 3, 1 / 8)):
        start = fit.values.copy()
        start[fit.names.index("ln slow")], start[fit.names.index("ln fast")] = np.log(slow), np.log(ratio)
        fits.append(_fitted(series, fit.curve, scatter, [_with_linear(series, fit.curve, start, scatter)]))
    if not fit.curve.grabber:
        return _marginal(series, fits, scatter), []
    slow, fast = fit["ln slow"], fit["ln slow"] + fit["ln fast"]
    near, swapped = fit["ln fast"], fit["ln delay"] - slow
    for delay, ratio in ((slow, near), (fast, near), (fast, swapped), (fit["ln scale"], near), (fast, near - 0.7), (fast, near + 0.5)):
        start = fit.values.copy()
        start[fit.names.index("ln delay")], start[fit.names.index("ln fast")] = delay, min(ratio, -0.5)
        fits.append(_fitted(series, fit.curve, scatter, [_with_linear(series, fit.curve, start, scatter)]))
    best = min(fits, key=lambda one: one.chi2)
    return best, [one for one in fits if one is not best and one.chi2 < best.chi2 + ALIKE]


def _marginal(series: Series, fits: Sequence[Fit], scatter: Array) -> Fit:
    """The best fit, with the covariance about it of all curves of a camera by their probability.

    The curve is linear in all but its time constants and their share. Those are drawn about each minimum of χ² and from the prior; what is
    linear is solved in closed form; draws weigh by its best likelihood × prior over the density that they were drawn from (importance
    sampling). Integrated over, a flat prior of the amplitudes would favour the time constants that tell least of them.
    """
    best = min(fits, key=lambda one: one.chi2)
    names, white = best.names, _whitening(series, scatter)
    at, centre, u_prior = _priors(names, series)
    linear = [k for k in range(len(names)) if k not in at]
    normal = stats.norm.ppf(stats.qmc.Halton(len(at), scramble=False).random(DRAWS + 1)[1:])
    prior = np.diag(u_prior**2)
    proposals = [(centre, prior), *((one.values[at], WIDER**2 * one.covariance[np.ix_(at, at)]) for one in fits)]
    parts = np.array_split(normal, len(proposals))
    draws = np.concatenate([c + z @ np.linalg.cholesky(v).T for z, (c, v) in zip(parts, proposals, strict=True)])
    density = np.mean([stats.multivariate_normal.pdf(draws, c, v, allow_singular=True) for c, v in proposals], axis=0)
    values = np.tile(best.values, (len(draws), 1))
    values[:, at] = draws
    log_weight, inside = np.zeros(len(draws)), np.zeros((len(draws), len(linear), len(linear)))
    for k, one in enumerate(values):
        one[linear] = 0
        found, slope = _curve(best.curve, names, one, series.time_s, series)
        by = np.einsum("kab,kbp->kap", white, slope[:, :, linear]).reshape(-1, len(linear))
        left = np.einsum("kab,kb->ka", white, series.values - found).ravel()
        size = np.linalg.norm(by, axis=0)
        inverse = np.linalg.pinv((by / size).T @ (by / size), hermitian=True)
        one[linear] = inverse @ ((by / size).T @ left) / size
        inside[k] = inverse / size / size[:, None]
        log_weight[k] = -0.5 * float(((left - by @ one[linear]) ** 2).sum())
    log_weight += stats.multivariate_normal.logpdf(draws, centre, prior) - np.log(density)
    weight = np.exp(log_weight - log_weight.max())
    weight /= weight.sum()
    away = values - best.values
    covariance = np.einsum("n,np,nq->pq", weight, away, away)
    covariance[np.ix_(linear, linear)] += np.einsum("n,npq->pq", weight, inside)
    chosen = np.searchsorted(np.cumsum(weight), (np.arange(KEPT) + 0.5) / KEPT).clip(max=len(weight) - 1)
    kept = values[chosen]
    steps = stats.norm.ppf(stats.qmc.Halton(len(linear), scramble=False).random(KEPT + 1)[1:])
    kept[:, linear] += np.einsum("npq,nq->np", np.linalg.cholesky(inside[chosen]), steps)
    return replace(best, covariance=covariance, draws=kept)


def _parts(series: Series, fit: Fit, scatter: Array) -> Curve:
    """Which parts of the whole curve the data ask for: those without which χ² grows beyond chance."""
    found = {}
    for part in ("camera", "grabber"):
        less = replace(fit.curve, **{part: False})
        if less == fit.curve:
            found[part] = False
            continue
        names = less.names(series.modes)
        near = np.array([fit[name] for name in names])
        without = _fitted(series, less, scatter, [near, *_starts(series, less, scatter)])
        found[part] = without.chi2 - fit.chi2 > stats.chi2.isf(FALSE_ALARM, len(fit.names) - len(names))
    return Curve(**found)


def _single_s(series: Series, fit: Fit, scatter: Array) -> tuple[float, float] | None:
    """The time constant and its u, where one fits as well as two."""
    start = fit.values.copy()
    start[fit.names.index("share")] = 0.0
    starts = []
    for slow in np.ptp(series.time_s) / np.array([1.0, 3.0, 10.0]):
        start[fit.names.index("ln slow")] = np.log(slow)
        starts.append(_with_linear(series, fit.curve, start, scatter))
    one = _fitted(series, fit.curve, scatter, starts, single=True)
    if one.chi2 - fit.chi2 > SINGLE:
        return None
    tau = float(np.exp(one["ln slow"]))
    return tau, tau * one.u("ln slow")


def _first_scatter(series: Series) -> Array:
    """Variance from frame to frame that the positions do not explain, from differences of neighbouring frames: a start."""
    squares = np.median(np.diff(series.values, axis=0) ** 2, axis=0) / (2 * 0.4549)  # median of χ² with one degree of freedom
    extra = np.maximum(squares - np.diagonal(series.covariance, axis1=1, axis2=2).mean(axis=0), 0.0)
    return _of_rigid(series, extra)


def _of_rigid(series: Series, variance: Array) -> Array:
    """Only shift and rotation scatter."""
    rigid = np.array([mode in ("shift_x_px", "shift_y_px", "rotation_rad") for mode in series.modes])
    return np.where(rigid, np.maximum(variance, 0.0), 0.0)


def _scatter(series: Series, fit: Fit) -> tuple[Array, Array]:
    """Variance of shift and rotation from frame to frame about the curve, and its u; of single frames."""
    left = series.values - _curve(fit.curve, fit.names, fit.values, series.time_s, series)[0]
    frames, taken = len(left), len(fit.names) / len(series.modes)
    known = np.diagonal(series.covariance, axis1=1, axis2=2).mean(axis=0)
    whole = (left**2).sum(axis=0) / (frames - taken)
    u = np.sqrt(2 / (frames - taken)) * whole
    variance = whole - known
    return _of_rigid(series, variance), np.stack([variance, u])


def _widening(series: Series, fit: Fit, scatter: Array) -> float:
    """By how much the covariance grows: for a curve that does not fit, and for residuals that are alike from frame to frame."""
    left = series.values - _curve(fit.curve, fit.names, fit.values, series.time_s, series)[0]
    white = np.einsum("kab,kb->ka", _whitening(series, scatter), left)
    alike = float((white[1:] * white[:-1]).sum() / (white**2).sum())
    alike = min(alike, 0.95) if alike > SIGNIFICANT / np.sqrt(white.size) else 0.0
    return max(1.0, fit.chi2 / fit.dof) * (1 + alike) / (1 - alike)


PARAMETERS = (  # of the sources: name, parameter of the fit, unit
    *((mode, mode, unit) for mode, unit in zip(CAMERA_MODES, ("px", "px", "1", "rad"), strict=True)),
    ("fast_share", "share", "1"),
    ("fast_s", "ln fast", "s"),
    ("slow_s", "ln slow", "s"),
    ("scale_error_rel", "scale error", "1"),
    ("scale_tau_s", "ln scale", "s"),
    ("delay_ns", "delay", "ns"),
    ("delay_tau_s", "ln delay", "s"),
)
OF_CAMERA = PARAMETERS[:7]


def _estimates(
    series: Series, fit: Fit, found: Curve, others: Sequence[Fit], u_scatter: Array, single: tuple[float, float] | None
) -> Estimates:
    """The parameters of the sources with their covariance: values, limits, or reasons."""
    at, _, u_prior = _priors(fit.names, series)
    wide = {fit.names[k]: u for k, u in zip(at, u_prior, strict=True)}
    span = float(np.ptp(series.time_s))
    too_short = min(fit.u(mode) / max(abs(fit[mode]), 1e-300) for mode in CAMERA_MODES) > TOLD_U_REL
    reasons: dict[str, str] = {}
    limits: set[str] = set()
    rows: list[tuple[str, str, float]] = []  # name, unit, value
    slopes = []
    for name, parameter, unit in PARAMETERS:
        of_camera = any(name == row[0] for row in OF_CAMERA)
        if parameter not in fit.names:
            reasons[name] = DIGITAL
            continue
        value, u = fit[parameter], fit.u(parameter)
        by = np.zeros(len(fit.names))
        by[fit.names.index(parameter)] = 1.0
        if not (found.camera if of_camera else found.grabber):
            if parameter in wide:
                reasons[name] = "nothing moves beyond the noise of the positions"
                continue
            limits.add(name)
            reasons[name] = f"{'the camera' if of_camera else 'the clock'} does not move the image beyond the noise of the positions"
            value = abs(value) + ONE_SIDED_95 * u
        elif other := _differing(parameter, fit, others):
            reasons[name] = TOO_SHORT.format(span) if _differing("ln slow", fit, others) else _alike(fit, other)
            continue
        elif of_camera and too_short:
            reasons[name] = TOO_SHORT.format(span)
            continue
        elif u > TOLD_SHARE * wide.get(parameter, np.inf):
            known = "the series tells it no better than what is known of all cameras"
            reasons[name] = known if single is None else f"one time constant of {single[0]:.3g} ± {single[1]:.2g} s fits as well as two"
            continue
        elif name == "delay_tau_s" and abs(fit["delay"]) < SIGNIFICANT * fit.u("delay"):
            reasons[name] = "the delay is not larger than its uncertainty"
            continue
        elif name == "fast_share" and not 0 < value < 1:
            value = min(max(value, 0.0), 1.0)
        if name == "delay_ns":
            if series.clock_mhz is None:
                reasons[name] = "in pixels only: state the pixel clock"
                continue
            value, by = value * 1e3 / series.clock_mhz, by * 1e3 / series.clock_mhz
        if parameter.startswith("ln "):
            if name == "fast_s":
                by[fit.names.index("ln slow")] = 1.0
                value += fit["ln slow"]
            value = float(np.exp(value))
            by *= value
        rows.append((name, unit, value))
        slopes.append(by)
    turn = np.array(slopes).reshape(len(rows), len(fit.names))
    estimates = Estimates(
        tuple(r[0] for r in rows), np.array([r[2] for r in rows]), turn @ fit.covariance @ turn.T, np.full(len(rows), float(fit.dof)),
        tuple(r[1] for r in rows), METHOD, CONFOUNDERS, frozenset(limits),
        reasons=reasons,
    )  # fmt: skip
    return _apart(estimates, fit).join(_from_frame_to_frame(series, u_scatter))


def _differing(parameter: str, fit: Fit, others: Sequence[Fit]) -> Fit | None:
    """A fit that is as good and has another value."""
    return next((one for one in others if abs(one[parameter] - fit[parameter]) > 2 * fit.u(parameter)), None)


def _alike(fit: Fit, other: Fit) -> str:
    """Why a parameter is not told: what two solutions have in common."""
    sums = [one["shift_x_px"] - one["delay"] for one in (fit, other)]
    return (
        "two solutions fit alike, for the delay of the lines decays as a part of the camera's shift does: their difference, shift along x "
        f"less delay, is {sums[0]:.3f} px in one and {sums[1]:.3f} px in the other; warm the frame grabber first, then switch the camera on"
    )


def _apart(found: Estimates, fit: Fit) -> Estimates:
    """Without the camera's shift along x and the clock's delay where only their sum is told."""
    pair = ("shift_x_px", "delay_ns")
    if not all(name in found and name not in found.limits for name in pair):
        return found
    i, j = fit.names.index("shift_x_px"), fit.names.index("delay")
    correlation = fit.covariance[i, j] / np.sqrt(fit.covariance[i, i] * fit.covariance[j, j])
    if abs(correlation) < NOT_APART:
        return found
    u = np.sqrt(fit.covariance[i, i] + fit.covariance[j, j] - 2 * fit.covariance[i, j])
    why = (
        f"not told from each other: shift along x less the delay of the lines is {fit.values[i] - fit.values[j]:.4f} ± {u:.4f} px; "
        "warm the frame grabber first, then switch the camera on"
    )
    kept = found.select([name for name in found.names if name not in (*pair, "delay_tau_s")])
    return replace(kept, reasons={**found.reasons, **dict.fromkeys((*pair, "delay_tau_s"), why)})


def _from_frame_to_frame(series: Series, scatter: Array) -> Estimates:
    """Scatter of the image from frame to frame: values, or limits."""
    at = {mode: k for k, mode in enumerate(series.modes)}
    rows, limits, reasons = [], set(), {}
    (x, u_x), (y, u_y) = (scatter[:, at[mode]] for mode in ("shift_x_px", "shift_y_px"))
    alike = abs(x - y) < SIGNIFICANT * np.hypot(u_x, u_y)
    shift = ((x + y) / 2, np.hypot(u_x, u_y) / 2) if alike else min((x, u_x), (y, u_y))
    for name, (variance, u), unit in (("shift_std_px", shift, "px"), ("roll_std_rad", scatter[:, at["rotation_rad"]], "rad")):
        if variance > SIGNIFICANT * u:
            std = float(np.sqrt(variance))
            rows.append((name, std, u / (2 * std), float(len(series.time_s)), unit))
        else:
            most = float(np.sqrt(max(variance, 0.0) + ONE_SIDED_95 * u))
            rows.append((name, most, float(np.sqrt(u)) / 2, float(len(series.time_s)), unit))
            limits.add(name)
            reasons[name] = "not more than the noise of the positions"
        if name == "shift_std_px" and not alike:
            stds = [float(np.sqrt(max(v, 0.0))) for v in (x, y)]
            reasons[name] = (
                f"the image scatters by {stds[0]:.2g} px along x and {stds[1]:.2g} px along y: the smaller one; a sampling clock adds to "
                "x, a motion of the camera to either"
            )
    told = ("vibration of the camera or of the targets", "jitter of the trigger of moving targets")
    return Estimates.from_rows(rows, method=METHOD, confounders=told, limits=frozenset(limits), reasons=reasons)


def _corners(frame_shape: tuple[int, int]) -> Array:
    y, x = (0.5 * (size - 1) for size in frame_shape)
    return np.array([(-x, -y), (x, -y), (-x, y), (x, y)])


def _left(fit: Fit, series: Series, values: Array, corners: Array, time_s: Array) -> Array:
    """Displacement of the corners from where they settle, shape (times, corners, 2)."""
    found = _curve(fit.curve, fit.names, values, time_s, series)[0]
    settled = _curve(fit.curve, fit.names, values, np.array([1e12]), series)[0]
    moved: Array = np.einsum("iam,km->kia", design_of(corners, series.modes), found - settled)
    return moved


def _from_settled(fit: Fit, series: Series, corners: Array, time_s: Array) -> tuple[Array, Array]:
    """Distance of the farthest corner from where it settles, and its u, at times."""
    base = _left(fit, series, fit.values, corners, time_s)
    far = np.linalg.norm(base, axis=2).argmax(axis=1)
    rows = np.arange(len(time_s))
    chosen = base[rows, far]
    size = np.linalg.norm(chosen, axis=1)
    along = np.divide(chosen, size[:, None], out=np.full_like(chosen, np.sqrt(0.5)), where=size[:, None] > 0)
    if fit.draws is not None:
        moved = np.einsum("kam,nkm->nka", design_of(corners, series.modes)[far], _to_settle(fit, fit.draws, time_s))
        away = np.einsum("nka,ka->nk", moved - chosen, along)
        return size, np.sqrt((away**2).mean(axis=0))
    slopes = np.zeros((len(time_s), 2, len(fit.names)))
    for k in range(len(fit.names)):
        step = np.zeros(len(fit.names))
        step[k] = 1e-3 * float(np.sqrt(max(fit.covariance[k, k], 1e-300)))
        more, less = (_left(fit, series, fit.values + sign * step, corners, time_s)[rows, far] for sign in (1, -1))
        slopes[:, :, k] = (more - less) / (2 * step[k])
    covariance = np.einsum("kap,pq,kbq->kab", slopes, fit.covariance, slopes)
    return size, np.sqrt(np.maximum(np.einsum("ka,kab,kb->k", along, covariance, along), 0.0))


def _to_settle(fit: Fit, draws: Array, time_s: Array) -> Array:
    """Modes of a camera less where they settle, of many curves, shape (draws, times, modes)."""
    at = {name: k for k, name in enumerate(fit.names)}
    slow, share = np.exp(draws[:, at["ln slow"]]), draws[:, at["share"]]
    fast = slow * np.exp(draws[:, at["ln fast"]])
    left = share[:, None] * np.exp(-time_s / fast[:, None]) + (1 - share)[:, None] * np.exp(-time_s / slow[:, None])
    moved: Array = -left[:, :, None] * draws[:, None, [at[mode] for mode in CAMERA_MODES]]
    return moved


def _stability(fit: Fit, series: Series, found: Curve, corners: Array, tolerance_px: float, *, settles: bool) -> Number:
    """Time from which on the farthest corner stays within the tolerance."""
    first, last = float(series.time_s[0]), float(series.time_s[-1])
    method = f"the farthest corner of the frame stays within {tolerance_px:g} px of where it settles, by the fitted curve"
    if not (found.camera or found.grabber):
        whole = np.sqrt(np.diagonal(series.covariance, axis1=1, axis2=2).mean(axis=0))
        reach = float(np.abs(design_of(corners, series.modes) * whole).sum(axis=2).max()) * 2 / np.sqrt(len(series.time_s))
        if reach < tolerance_px:
            return Number(first, 0.0, np.inf, "s", method, "nothing moves from the first frame on", name="stable_s")
        return Number.not_available("s", "the positions are too uncertain to tell a motion of this size", method, "stable_s")
    if found.camera and not settles:
        return Number(last, np.nan, np.inf, "s", method, "where it settles is not told yet", LOWER_LIMIT, "stable_s")
    times = np.concatenate([np.linspace(first, last, 2000), last + (last - first) * np.geomspace(1e-3, 30, 500)])
    distance, u_distance = _from_settled(fit, series, corners, times)
    outside = np.flatnonzero(distance > tolerance_px)
    if not outside.size:
        sure = distance[0] + 2 * u_distance[0] < tolerance_px
        why = "nothing moves that far from the first frame on"
        if sure:
            return Number(first, 0.0, np.inf, "s", method, why, name="stable_s")
        return Number.not_available("s", "the distance to where it settles is not told well enough", method, "stable_s")
    k = int(outside[-1])
    if k + 1 == len(times):
        return Number(last, np.nan, np.inf, "s", method, "not yet stable when the series ends", LOWER_LIMIT, "stable_s")
    share = (distance[k] - tolerance_px) / (distance[k] - distance[k + 1])
    at = float(times[k] + share * (times[k + 1] - times[k]))
    later = int(np.flatnonzero(distance + u_distance > tolerance_px)[-1])  # by one u: the motion slows down, so the time is skewed to later
    speed = (distance[k] - distance[k + 1]) / (times[k + 1] - times[k])
    u = max(float(u_distance[k] / speed), float(times[later]) - at)
    if u_distance[k] > tolerance_px / 2 or later + 1 == len(times):
        if at > last:
            return Number(last, np.nan, np.inf, "s", method, "not yet stable when the series ends", LOWER_LIMIT, "stable_s")
        return Number.not_available("s", "the distance to where it settles is not told well enough", method, "stable_s")
    reason = f"extrapolated: the series ends at {last:.0f} s" if at > last else ""
    return Number(at, u, float(fit.dof), "s", method, reason, name="stable_s")
