"""What a campaign tells of gain and noise where it carries no photon-transfer series: dark frames alone, one light, a bent response."""

from __future__ import annotations

import numpy as np

from pixmetry.camera.observations import LevelMoments, PhotonTransfer, StackMoments
from pixmetry.core.number import ONE_SIDED_95, Estimates
from pixmetry.observe import photon_transfer_model as model
from pixmetry.observe.hot_pixels import without_hot_pixels
from pixmetry.observe.photon_transfer_levels import (
    MINIMUM_LEVELS,
    NONLINEARITY_PRIOR,
    core_spread_dn2,
    temporal_row_col_vars,
    unclipped_bright,
    with_stacks,
)

NOT_SIGNIFICANT = 3.0
METHOD = "mean squares of the differences of dark frames"
METHOD_WITH_LIGHT = f"{METHOD}; gain from variance and mean of one light level"
ONE_LIGHT = "from one light level: u holds that the response may be bent by 10 % over the range"


def partial_transfer(series: PhotonTransfer, stack: StackMoments | None, *, straight: bool) -> Estimates:
    """Black level and dark noise in DN; in electrons too, with the gain, where a few light levels of a straight response tell it.

    Parameters
    ----------
    series : PhotonTransfer
        Bright levels may be none.
    stack : StackMoments, optional
        Dark frames beside the series.
    straight : bool
        Whether the response is not known to be bent: then a light level tells the gain.

    Returns
    -------
    Estimates
        ``offset_dn``, ``dark_noise_dn``, ``row_noise_dn``, ``column_noise_dn``; with a gain ``gain_dn_per_e``, ``dark_noise_e``,
        ``row_noise_e``, ``column_noise_e``, and with photons ``quantum_efficiency``. A noise that is not significant is a 95 % upper limit.
        Empty without dark frames.

    Notes
    -----
    K = (σ² − σ²_dark)/(µ − µ_dark) (EMVA 1288 R4.0 eq. 14). A response y = x(1 + a w), w the share of the range, makes that K(1 + 3aw)
    to first order; a is taken as 0 ± 0.1, as in the joint fit. Of several levels the one of the smallest u is taken.
    """
    whole, hot = without_hot_pixels(with_stacks(series, stack, None), stack)
    dark, pixels = whole.dark, int(np.prod(whole.frame_shape))
    if dark.mean_dn.size == 0:
        return Estimates.empty()
    frames = dark.n_frames - 1.0
    black = float(np.average(dark.mean_dn, weights=dark.n_frames))
    scatter = float(dark.mean_dn.std(ddof=1) / np.sqrt(dark.mean_dn.size)) if dark.mean_dn.size > 1 else 0.0
    white, spread = float(np.average(dark.ms_pixel_dn2, weights=frames)), core_spread_dn2(stack)
    white_u = white * np.sqrt(2 / (frames.sum() * pixels)) + 1 / (dark.n_frames.sum() * pixels)
    before = model.white_before_rounding(white, spread)
    q_mean, q_var = (float(q) for q in model.rounding_error_vars(np.array(before), spread))
    u_black = float(np.linalg.norm([scatter, hot.mean_dn, np.sqrt(q_mean), np.sqrt(dark.ms_frame_dn2.mean() / dark.n_frames.sum())]))
    rows = [("offset_dn", black, u_black, float(max(dark.mean_dn.size - 1, 1)), "DN")]
    reasons = {"offset_dn": "the mean of the dark frames: contains their dark signal"}
    hidden = white < model.MINIMUM_DARK_VAR_DN2
    lines, line_vars = temporal_row_col_vars(whole)
    squares = [white - model.QUANTISATION_DN2, *lines]
    u_squares = [float(np.linalg.norm([white_u, np.sqrt(q_var), hot.var_dn2])), *np.sqrt(line_vars)]
    limits: set[str] = set()
    gain = _gain(whole, (white, float(np.hypot(white_u, hot.var_dn2))), (black, u_black), pixels) if straight else None
    for name, square, u in zip(("dark_noise", "row_noise", "column_noise"), squares, u_squares, strict=True):
        value, u_value, limit, reason = _root(float(square), float(u), hidden)
        rows.append((f"{name}_dn", value, u_value, np.inf, "DN"))
        if gain is not None:
            rows.append((f"{name}_e", value / gain[0], float(np.hypot(u_value, value * gain[1] / gain[0]) / gain[0]), np.inf, "e-"))
        limits |= {f"{name}_dn", f"{name}_e"} if limit else set()
        reasons |= {f"{name}_dn": reason, f"{name}_e": reason} if reason else {}
    if gain is not None:
        rows.append(("gain_dn_per_e", gain[0], gain[1], np.inf, "DN/e-"))
        reasons["gain_dn_per_e"] = ONE_LIGHT
        if gain[2] is not None:
            rows.append(("quantum_efficiency", gain[2], gain[2] * gain[1] / gain[0], np.inf, "1"))
            reasons["quantum_efficiency"] = f"{ONE_LIGHT}; u leaves out the calibration of the photon count"
    method, names = METHOD if gain is None else METHOD_WITH_LIGHT, {row[0] for row in rows}
    told = {name: reason for name, reason in reasons.items() if name in names}
    return Estimates.from_rows(rows, method=method, limits=frozenset(limits & names), reasons=told)


def _root(square: float, u: float, hidden: bool) -> tuple[float, float, bool, str]:
    """A standard deviation from its square, with its u; a limit where it is not significant or rounding hides it."""
    if hidden:
        bound = 0.40  # EMVA 1288 R4.0 eq. 54
        what = f"the dark variance is below {model.MINIMUM_DARK_VAR_DN2} DN², where rounding hides it"
        reason = f"{what}: bound 0.40 DN (EMVA 1288 R4.0 eq. 54)"
        return bound, bound / np.sqrt(12), True, reason
    if square < NOT_SIGNIFICANT * u:
        limit = float(np.sqrt(max(square, 0.0) + ONE_SIDED_95 * u))
        return limit, u / (2 * max(limit, 1e-12)), True, "not significantly above zero; 95 % upper limit"
    return float(np.sqrt(square)), float(u / (2 * np.sqrt(square))), False, ""


def _gain(
    series: PhotonTransfer, dark_var: tuple[float, float], dark_mean: tuple[float, float], pixels: int
) -> tuple[float, float, float | None] | None:
    """Gain, its u, and electrons per photon where these are known; None where no level tells. Of the dark: values with their u."""
    bright: LevelMoments = series.bright
    (white, white_u), (black, black_u) = dark_var, dark_mean
    if bright.mean_dn.size == 0:
        return None
    signal, noise = bright.mean_dn - black, bright.ms_pixel_dn2 - white
    usable = unclipped_bright(series) & (signal > 0)
    if not usable.any():
        return None
    with np.errstate(divide="ignore", invalid="ignore"):
        gain = noise / signal
        sampling = np.sqrt(2 / ((bright.n_frames - 1) * pixels)) * bright.ms_pixel_dn2
        before = np.array([bright.ms_pixel_dn2, np.full_like(noise, white)]) - model.QUANTISATION_DN2
        q_var = model.rounding_error_vars(before)[1].sum(axis=0)
        of_scale = np.hypot(3 * NONLINEARITY_PRIOR * signal / (2**series.bits - 1), black_u / signal)
        u = np.hypot(np.sqrt(sampling**2 + q_var + white_u**2) / signal, of_scale * gain)
    relative = np.where(usable & (gain > 0), u / gain, np.inf)
    at = int(np.argmin(relative))
    if not relative[at] < 1 / NOT_SIGNIFICANT:
        return None
    known = bright.photons is not None and bool(bright.photons[at] > 0)
    efficiency = float(signal[at] / (gain[at] * bright.photons[at])) if known else None
    return float(gain[at]), float(u[at]), efficiency


def is_short(series: PhotonTransfer) -> bool:
    """Whether the series has fewer light levels below saturation than the joint fit needs, so that nothing is known of a bend."""
    return series.bright.mean_dn.size == 0 or int(unclipped_bright(series).sum()) < MINIMUM_LEVELS
