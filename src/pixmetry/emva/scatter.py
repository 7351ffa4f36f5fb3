"""Scatter of the levels of an exposure series, estimated from the series itself.

Four independent causes:

* ``light``: the light of a level is not quite what it was set to (lamp, shutter, flicker), and the black level wanders. The light moves
  mean and variance of a level together, along the photon transfer.
* ``variance``: a temporal variance scatters by the sampling of its pixels, rows and columns, and often by more.
* ``dark_mean``, ``dark_variance``: the same for the dark levels, about a line in exposure time.

and two that no residual shows: ``spatial`` (the noise of the frames of a level in their covariance) and ``counts`` (of the pixels at the
top code).
The size of the first four is read from the residuals about smooth curves, of levels that are not saturated.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from pixmetry.camera.observations import LevelMoments
from pixmetry.core.arrays import Array, Flags
from pixmetry.core.errors import MeasureError
from pixmetry.emva.general.response import ScatterFit, fit_scatter
from pixmetry.emva.linear_model import following, is_curved
from pixmetry.emva.records import Measurement, Series
from pixmetry.emva.series import (
    MINIMUM_EXPOSURES,
    MINIMUM_LEVELS,
    bright_order,
    count_exposures,
    dark_order,
    exposure_varies,
    light_of,
    pairing,
)
from pixmetry.observe.photon_transfer_levels import USABLE_FRACTION

GROUPS = ("light", "variance", "dark_mean", "dark_variance", "spatial", "counts")
OWN_DOF = 5  # residuals with fewer degrees of freedom are helped by what frames of one level tell


@dataclass(frozen=True)
class Scatter:
    """The smooth series behind a measured one, and the standard deviations of its levels.

    ``centre`` holds the smooth curves where they are fitted and the measured values elsewhere. ``u_*`` have shape (levels,) or
    (dark levels,). ``light_slope``: change of a level's variance with its mean when the light changes. ``z_*``: standardised residuals
    of the fitted levels, of light and variance of the same level at the same index. ``u_spatial`` is what the spatial variances scatter
    beside ``spatial_share`` of the deviations of the temporal ones. ``dof`` by group.
    """

    centre: Series
    weights: Array  # of the dark levels for each bright one
    u_light: Array
    light_slope: Array
    u_variance: Array
    u_spatial: Array
    spatial_share: Array
    own_dark_spatial_dn2: Array
    u_dark_spatial: Array
    dark_spatial_share: Array
    u_dark_mean: Array
    u_dark_variance: Array
    z_light: Array
    z_variance: Array
    z_dark_mean: Array
    z_dark_variance: Array
    wave_dn2: float  # scatter of the dark variances beyond sampling, where the dark levels themselves show it
    pixels: Array  # of a level, all frames together, shape (levels,)
    dof: dict[str, float]


def scatter_of(m: Measurement, series: Series) -> Scatter:
    """Read from a series how it scatters.

    Parameters
    ----------
    m : Measurement
    series : Series
        ``series_of(m)``.

    Raises
    ------
    MeasureError
        Fewer than three levels below saturation.
    """
    shape = m.transfer.frame_shape
    bright = _sorted(m.transfer.bright, bright_order(m.transfer.bright))
    dark = _sorted(m.transfer.dark, dark_order(m.transfer.dark))
    weights = pairing(series.exposure_s, series.dark_exposure_s)
    used = unsaturated(series)
    if used.sum() < MINIMUM_LEVELS:
        raise MeasureError(
            "too few bright levels below saturation",
            where="exposure series",
            value=int(used.sum()),
            allowed=f"{MINIMUM_LEVELS} or more; EMVA 1288 R4.0 §6.5 asks for 50",
            remedy="take levels from dark to saturation in about equal steps; check lamp, exposure and offset",
        )

    dark_mean, wander, wander_dof = _dark_mean(m, series, dark)
    signal = series.mean_dn - weights @ dark_mean.values
    sampled = np.sqrt(bright.var_total_dn2 / (bright.n_frames * shape[0] * shape[1]))
    light = _light(series, bright, signal, used, np.hypot(wander, sampled), wander)
    u_light = np.hypot(np.hypot(wander, sampled), light.excess * signal * (1 - series.fraction_max))

    u_var = sampling_u(bright, shape)
    variance = fit_scatter(signal[used], series.var_dn2[used], u_var[used], series.var_dn2[used])
    u_var = np.hypot(u_var, variance.excess * series.var_dn2 * (1 - series.fraction_max))
    dark_sampled = sampling_u(dark, shape)
    dark_variance = _dark_variance(series, dark_sampled, variance)
    # few dark levels have no residuals to speak of; of one there must be two signs all the same
    own = dark_variance.fit.dof >= OWN_DOF
    z_dark_variance = dark_variance.standardised if own else np.resize([-1.0, 1.0], max(series.dark_exposure_s.size, 2))
    wave = np.sqrt(np.maximum(dark_variance.u**2 - dark_sampled**2, 0.0)) * own

    u_spatial, share = spatial_scatter(bright, shape, u_var)
    u_dark_spatial, dark_share = spatial_scatter(dark, shape, dark_variance.u, wave)
    slope = np.zeros_like(signal)
    slope[used] = variance.fit.slopes
    mean, var = series.mean_dn.copy(), series.var_dn2.copy()
    mean[used] = (weights @ dark_mean.values)[used] + light.values
    # the variance that belongs to the smooth mean
    var[used] = variance.fit.values + variance.fit.slopes * (light.values - signal[used])
    centre = replace(
        series,
        mean_dn=mean,
        var_dn2=var,
        dark_mean_dn=weights @ dark_mean.values,
        dark_var_dn2=weights @ dark_variance.fit.values,
        own_dark_mean_dn=dark_mean.values,
        own_dark_var_dn2=dark_variance.fit.values,
    )
    return Scatter(
        centre=centre,
        weights=weights,
        u_light=u_light,
        light_slope=slope * _light_share(light.excess * signal, u_light),
        u_variance=u_var,
        u_spatial=u_spatial,
        spatial_share=share,
        own_dark_spatial_dn2=dark.spatial_cov_dn2,
        u_dark_spatial=u_dark_spatial,
        dark_spatial_share=dark_share,
        u_dark_mean=np.full(dark_mean.values.size, wander),
        u_dark_variance=dark_variance.u,
        z_light=light.z,
        z_variance=variance.standardised,
        z_dark_mean=dark_mean.z,
        z_dark_variance=z_dark_variance,
        wave_dn2=float(wave.mean()),
        pixels=bright.n_frames * shape[0] * shape[1],
        dof={
            "light": light.dof,
            "variance": variance.dof,
            "dark_mean": wander_dof,
            "dark_variance": dark_variance.dof,
            "spatial": np.inf,
            "counts": np.inf,
        },
    )


def unsaturated(series: Series) -> Flags:
    """Levels below both the top code and the maximum of the variance, shape (levels,), bool.

    Of a camera that is not linear at all the variance tells no end: its response does.
    """
    below: Flags = series.fraction_max <= USABLE_FRACTION
    if is_curved(series):
        below &= following(series)
        return below
    peak = int(np.argmax(np.where(below, series.var_dn2, -np.inf)))
    return below & (np.arange(below.size) <= peak)


def sampling_u(levels: LevelMoments, shape: tuple[int, int]) -> Array:
    """Standard deviation of the temporal variances by sampling alone, DN², shape (levels,).

    The variance is made of three independent mean squares with (M−1)(N−1), M−1 and N−1 degrees of freedom for each frame beyond the first;
    Var(MS) = MS² (2 + γ)/ν, with γ the excess kurtosis of the frame differences for the pixels.
    """
    rows, cols = shape
    more = levels.n_frames - 1.0
    gamma = np.maximum(np.nan_to_num(levels.kurtosis_excess), -1.5) * 2 * more / levels.n_frames
    parts = (
        (levels.ms_pixel_dn2, (rows - 1) * (cols - 1), 1.0, gamma),
        (levels.ms_row_dn2, rows - 1, cols, 0.0),
        (levels.ms_col_dn2, cols - 1, rows, 0.0),
    )
    variance = sum((size * lines * ms / (rows * cols)) ** 2 * (2 + kurtosis) / (lines * more) for ms, lines, size, kurtosis in parts)
    # one pixel that toggled once: no variance is known better than to that
    u: Array = np.hypot(np.sqrt(variance), (levels.fraction_max < 1) / (rows * cols * levels.n_frames))
    return u


@dataclass(frozen=True)
class _Curve:
    """A smooth curve of means: values, standardised residuals, degrees of freedom, and the relative scatter of the light."""

    values: Array
    z: Array
    dof: float
    excess: float = 0.0


def _dark_mean(m: Measurement, series: Series, dark: LevelMoments) -> tuple[_Curve, float, float]:
    """Line of the dark mean, its scatter from level to level (DN) and the degrees of freedom of that.

    With few dark levels the scatter from frame to frame, within levels and in the dark stack, helps out.
    """
    t, y = series.dark_exposure_s, series.own_dark_mean_dn
    several = count_exposures(t) >= MINIMUM_EXPOSURES
    fitted = np.polynomial.Polynomial.fit(t, y, 1)(t) if several else y
    parts = [(float(((y - fitted) ** 2).sum()), float(y.size - 2))] if several else []
    if not parts or parts[0][1] < OWN_DOF:
        frames = dark.n_frames
        parts.append((float(((frames - 1) * dark.ms_frame_dn2 / frames).sum()), float((frames - 1).sum())))
        if m.dark_stack is not None:
            count = float(np.median(frames))
            own = m.dark_stack.n_frames - 1.0
            parts.append((own * float(np.var(m.dark_stack.frame_means_dn, ddof=1)) / count, own))
    squares, dof = (float(sum(column)) for column in zip(*parts, strict=True))
    # codes that do not change tell the mean no better than to one that does
    wander = float(np.hypot(np.sqrt(squares / dof), (1 / (dark.n_frames * np.prod(m.transfer.frame_shape))).max()))
    residuals = (y - fitted) / max(wander, 1e-300) * np.sqrt(y.size / max(y.size - 2, 1)) if several else np.array([-1.0, 1.0])
    return _Curve(fitted, residuals, dof), wander, dof


def _light(series: Series, bright: LevelMoments, signal: Array, used: Flags, sigma: Array, wander: float) -> _Curve:
    """Smooth signal over the light, at the fitted levels, and the relative scatter of the light."""
    known = light_of(series)
    y = signal[used]
    if known is None:
        # nothing tells what the light should have been: frames of one level tell how it flickers
        more, frames = bright.n_frames[used] - 1.0, bright.n_frames[used]
        flicker = (bright.ms_frame_dn2[used] - frames * wander**2) / frames / np.maximum(y, 1e-9) ** 2
        flicker = float((more * flicker).sum() / more.sum())
        return _Curve(y, np.resize([-1.0, 1.0], y.size), float(more.sum()), float(np.sqrt(max(flicker, 0.0))))
    light = _finer(series, known[0])[used]
    if is_curved(series):  # a power or a logarithm of the light is no polynomial of it, but nearly one of its logarithm
        light = np.log1p(light / light[light > 0].min())
    scatter: ScatterFit = fit_scatter(light, y, sigma[used], y)
    return _Curve(scatter.fit.values, scatter.standardised, scatter.dof, scatter.excess)


def _finer(series: Series, light: Array) -> Array:
    """The light; by exposure where the photons are proportional to it, since they are often rounded."""
    if series.photons is None or not exposure_varies(series.exposure_s):
        return light
    ratio = light.sum() / series.exposure_s.sum()
    return series.exposure_s if np.all(np.abs(light - ratio * series.exposure_s) <= np.maximum(1.0, 1e-3 * light)) else light


def _dark_variance(series: Series, sampled: Array, bright: ScatterFit) -> ScatterFit:
    """Line of the dark variance over exposure; few levels scatter beyond sampling as the bright ones do."""
    t, y = series.dark_exposure_s, series.own_dark_var_dn2
    degree = 1 if count_exposures(t) >= MINIMUM_EXPOSURES else 0
    found = fit_scatter(t, y, sampled, y, degree)
    if found.fit.dof >= OWN_DOF:
        return found
    return ScatterFit(found.fit, bright.excess, np.hypot(sampled, bright.excess * y), bright.dof)


def _light_share(light: Array, u_light: Array) -> Array:
    """Share of a level's deviation that is due to the light, the rest being wander of the black level: regression of one on both."""
    return np.divide(light**2, u_light**2, out=np.zeros_like(light), where=u_light > 0)


def spatial_scatter(levels: LevelMoments, shape: tuple[int, int], u_var: Array, wave_dn2: Array | float = 0.0) -> tuple[Array, Array]:
    """How the spatial variance of a level scatters by the noise of its F frames, beside what goes with its temporal variance.

    It is the mean of ⟨y_k y_l⟩ − µ_k µ_l over the pairs of frames: Var = 4 s²σ²/(F n) + 2 σ⁴/(F (F − 1) n), for pixels, rows and columns.
    It is also the variance of the mean image less 1/F of the temporal variance, which is independent of that image: so the covariance of
    the two is minus the second term. A wave through the frames takes from the one what it gives to the other.

    Returns
    -------
    u, share : ndarray, shape (levels,)
        Standard deviation of what is independent of the temporal variance, and the part of the latter's deviation (of standard deviation
        ``u_var``) that comes off the spatial one.
    """
    rows, cols = shape
    frames = levels.n_frames.astype(float)
    pattern, pixels = np.maximum(levels.spatial_cov_dn2, 0.0), float(rows * cols)
    row = np.maximum(levels.ms_row_dn2 - levels.ms_pixel_dn2 / cols, 0.0)
    col = np.maximum(levels.ms_col_dn2 - levels.ms_pixel_dn2 / rows, 0.0)
    white = levels.ms_pixel_dn2
    common = 2 * (white**2 / pixels + row**2 / rows + col**2 / cols) / (frames * (frames - 1)) + np.square(wave_dn2)
    share = np.divide(common, u_var**2, out=np.zeros_like(common), where=u_var > 0)
    return np.sqrt(np.maximum(4 * pattern * white / (frames * pixels) + common - share**2 * u_var**2, 0.0)), share


def _sorted(levels: LevelMoments, order: Array) -> LevelMoments:
    return replace(levels, **{k: v[order] for k, v in vars(levels).items() if v is not None})
