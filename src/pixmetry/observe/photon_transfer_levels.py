"""From a photon-transfer record to the levels of the joint fit: which can be used, how the light is counted, what is known before."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from pixmetry.camera.observations import LevelMoments, PhotonTransfer, StackMoments
from pixmetry.core.arrays import Flags
from pixmetry.core.errors import MeasureError
from pixmetry.observe import photon_transfer_model as model

USABLE_FRACTION = 2e-5  # a share p of pixels clipped at one end takes about 2p of the variance away
CLIPPED_BLACK_FRACTION = 0.005  # EMVA 1288 R4.0 §6.1: at most 0.5 % of the dark pixels may underflow
MINIMUM_LEVELS = 4
NONLINEARITY_PRIOR = 0.1
LIGHT_OFFSET_PRIOR = 0.05
STRONGLY_CURVED, CURVED = 0.85, 0.95  # exponents of the response: below the first it is refused, below the second if it is a power curve
POWER_CURVE = 0.25  # a power law that leaves less than this share of the squares that a cubic with one parameter more leaves
CURVE_LEVELS = 6
CURVE_DARKEST, CURVE_BRIGHTEST = 0.1, 0.8  # of the brightest level above black: the levels that tell the exponent


def light_scale(bright: LevelMoments) -> tuple[float, bool]:
    """Largest light, and whether light is counted by exposure time (else by photons).

    Photons that go with the exposure time are often rounded in the manifest, so the time is the better axis where both say the same.
    """
    t, photons = bright.exposure_s, bright.photons
    if t.size == 0:
        raise MeasureError("no bright level", where="photon transfer", remedy="take bright frames at 10 or more light levels, two at each")
    exposure_varies = np.ptp(t) > 0.01 * t.max()
    if photons is None:
        if not exposure_varies:
            what = "the light of the levels is not known"
            raise MeasureError(what, where="photon transfer", remedy="vary the exposure time, or give the photons per pixel")
        return float(t.max()), True
    ratio = photons.sum() / t.sum() if t.sum() > 0 else 0.0
    proportional = exposure_varies and np.all(np.abs(photons - ratio * t) <= np.maximum(0.02 * ratio * t, 1.0))
    return (float(t.max()), True) if proportional else (float(photons.max()), False)


def with_stacks(pt: PhotonTransfer, dark: StackMoments | None, bright: StackMoments | None) -> PhotonTransfer:
    """The series with each stack as one more level of many frames."""
    return replace(pt, dark=_append(pt.dark, dark), bright=_append(pt.bright, bright))


def _append(levels: LevelMoments, stack: StackMoments | None) -> LevelMoments:
    if stack is None or _holds(levels, stack):
        return levels
    same = ("exposure_s", "n_frames", "mean_dn", "fraction_min", "fraction_max", "ms_pixel_dn2", "ms_row_dn2", "ms_col_dn2", "ms_frame_dn2")
    extra = {name: getattr(stack, name) for name in same}
    extra |= {"var_total_dn2": stack.var_stack_dn2, "kurtosis_excess": np.nan, "photons": np.nan}
    extra["spatial_cov_dn2"] = float(np.var(stack.mean_map_dn)) - stack.var_stack_dn2 / stack.n_frames
    present = [name for name in LevelMoments.__dataclass_fields__ if getattr(levels, name) is not None]
    return replace(levels, **{name: np.append(getattr(levels, name), extra[name]) for name in present})


def _holds(levels: LevelMoments, stack: StackMoments) -> bool:
    """Whether the frames of a stack are a level of the series already, for want of others."""
    same = (levels.exposure_s == stack.exposure_s) & (levels.n_frames == stack.n_frames)
    return bool(np.any(same & (np.abs(levels.mean_dn - stack.mean_dn) <= 1e-9 * max(abs(stack.mean_dn), 1.0))))


def temporal_row_col_vars(pt: PhotonTransfer) -> tuple[np.ndarray, np.ndarray]:
    """Row and column temporal variances from the dark mean squares, DN², and the variances of these two estimates.

    Where the dark frames are clipped at black, from the bright ones that are not clipped.
    """
    rows, cols = pt.frame_shape
    dark, whole = pt.dark, pt.dark.fraction_min - pt.bright.fraction_min.min(initial=1.0) <= CLIPPED_BLACK_FRACTION
    if not whole.any() and pt.bright.mean_dn.size:
        dark, whole = pt.bright, unclipped_bright(pt)
    f = (dark.n_frames - 1) * whole
    value, var = np.zeros(2), np.zeros(2)
    for i, (ms, groups, size) in enumerate(((dark.ms_row_dn2, rows, cols), (dark.ms_col_dn2, cols, rows))):
        dof = f * (groups - 1)
        total = max(dof.sum(), 1.0)
        line, pixel = (dof * ms).sum() / total, (dof * dark.ms_pixel_dn2).sum() / total / size
        value[i] = line - pixel
        var[i] = 2 * line**2 / total + 2 * pixel**2 / (total * (size - 1))
    return value, var


def core_spread_dn2(dark_stack: StackMoments | None) -> float:
    """Variance of the core of the dark map, by quartiles: a few hot pixels dither nothing; zero without a stack."""
    if dark_stack is None:
        return 0.0
    low, high = np.percentile(dark_stack.mean_map_dn, [25, 75])
    return float(((high - low) / 1.349) ** 2)


def levels_from(
    pt: PhotonTransfer, scale: float, by_exposure: bool, dark_spread_dn2: float = 0.0, dnl_lsb: float = 0.0
) -> tuple[model.Levels, float]:
    """All levels, dark ones first, in the form that the model takes, and the scale of the time axis (s).

    ``dark_spread_dn2`` is the variance of the dark signal over the pixels, as far as it is known to be that of most of them.
    """
    if pt.dark.mean_dn.size == 0:
        raise MeasureError("no dark level", where="photon transfer", remedy="take two or more dark frames at the same gain and exposure")
    rows, cols = pt.frame_shape
    names = [name for name in LevelMoments.__dataclass_fields__ if name != "photons"]
    both = {name: np.concatenate([getattr(pt.dark, name), getattr(pt.bright, name)]).astype(float) for name in names}
    is_bright = np.arange(both["mean_dn"].size) >= pt.dark.mean_dn.size
    light = np.zeros(is_bright.size)
    photons = pt.bright.photons
    light[is_bright] = (pt.bright.exposure_s if by_exposure or photons is None else photons) / scale
    time_scale = float(max(both["exposure_s"].max(), 1e-12))
    lines = np.maximum(temporal_row_col_vars(pt)[0], 0) @ [1 / rows, 1 / cols]
    black = pt.dark.mean_dn.mean()
    spatial = np.maximum(both["spatial_cov_dn2"], 0.0)
    dither = np.maximum(spatial - spatial[~is_bright].mean(), 0.0) * is_bright + dark_spread_dn2
    lamp_change = np.maximum(both["ms_frame_dn2"] - both["ms_pixel_dn2"] / (rows * cols) - lines, 0)
    levels = model.Levels(
        bright=is_bright,
        light=light,
        time=both["exposure_s"] / time_scale,
        mean=both["mean_dn"],
        ms=both["ms_pixel_dn2"],
        spatial=spatial,
        row_col_var=lines / both["n_frames"],
        n_frames=both["n_frames"],
        ms_dof=(both["n_frames"] - 1) * (rows - 1) * (cols - 1),
        kurtosis=np.full(is_bright.size, np.nan),
        leak=np.where(is_bright, lamp_change * spatial / np.maximum(both["mean_dn"] - black, 1.0) ** 2, 0.0),
        dither=dither,
        dnl_lsb=dnl_lsb,
        coherence=float(np.exp(-2 * np.pi**2 * np.var(pt.dark.mean_dn))),
        pixels=rows * cols,
        x_ref=float(2**pt.bits - 1),
    )
    return replace(levels, kurtosis=_contradicting_kurtosis(levels, both["kurtosis_excess"], black)), time_scale


def _contradicting_kurtosis(levels: model.Levels, measured: np.ndarray, black: float) -> np.ndarray:
    """Excess kurtosis of one pixel where that of the differences (half as large) is far from Poisson's, else NaN."""
    signal = np.maximum(levels.mean - black, 1e-3)
    gain = np.median((levels.ms[levels.bright] - levels.ms[~levels.bright].mean()) / signal[levels.bright])
    expected = np.where(levels.bright, 0.5 * max(gain, 0) ** 3 * signal / np.maximum(levels.ms, 0.05) ** 2, 0.0)
    far = np.abs(measured - expected) > 6 * np.sqrt(24 / levels.pixels) + 0.5 * expected
    return np.where(np.isfinite(measured) & far, 2 * measured, np.nan)


def clipped_black(pt: PhotonTransfer) -> float:
    """Largest share of dark pixels at the lowest code, without those that stay there in the light."""
    return float(np.max(pt.dark.fraction_min - pt.bright.fraction_min.min(), initial=0.0))


def unclipped_bright(pt: PhotonTransfer) -> np.ndarray:
    """Bright levels without pixels at either end, but for those that always are (stuck and hot ones)."""
    stuck, hot = pt.bright.fraction_min.min(), pt.dark.fraction_max.max(initial=0.0)
    unclipped: Flags = (pt.bright.fraction_max - hot <= USABLE_FRACTION) & (pt.bright.fraction_min - stuck <= USABLE_FRACTION)
    return unclipped


def refuse_dead_series(pt: PhotonTransfer) -> None:
    """Refuse a series of which no estimate can be made, with the plain reason."""
    what = remedy = ""
    if not pt.bright.mean_dn.size:
        what, remedy = "no bright level", "take bright frames at 10 or more light levels, two at each"
    elif (pt.bright.fraction_max > 0.5).all():
        what, remedy = "all bright frames are saturated", "shorten the exposure or reduce the light"
    elif (pt.bright.fraction_min > 0.5).all():
        what, remedy = "all bright frames are black", "check lamp, shutter and exposure"
    elif not pt.bright.var_total_dn2.any():
        what = "the frames of each level are identical: there is no temporal noise to measure"
        remedy = "list frames that were taken one after the other, not copies, averages or synthetic frames"
    if what:
        raise MeasureError(what, where="photon transfer", remedy=remedy)


def refuse_curved(pt: PhotonTransfer, d: model.Levels, failed: bool = False) -> None:
    """Refuse a response like that of a gamma setting: level means that grow as a power of the light with an exponent well below 1.

    A power curve starts with an infinite slope, which no polynomial follows: the gain that came out would depend on the levels chosen.
    Where the fit has ``failed`` anyway, a smaller bend of any shape is its reason.
    """
    exponent, u, is_power = response_exponent(pt, d)
    if exponent + 3 * u < (CURVED if failed or is_power else STRONGLY_CURVED):
        raise MeasureError(
            "the camera's response is strongly curved, as with a gamma setting: the level means grow as a power of the light",
            where="photon transfer",
            value=f"exponent {exponent:.2f}",
            allowed="about 1, a straight line",
            remedy="set the camera's gamma to 1 and switch off contrast curves; check that the light is proportional to the exposure",
        )


def response_exponent(pt: PhotonTransfer, d: model.Levels) -> tuple[float, float, bool]:
    """Exponent γ of mean = b + c light^γ by least squares, its standard uncertainty, and whether this fits far better than a cubic.

    The black level b is free, so that dark current and the curve's start do not bend the result. Too few levels: (1, inf, False).
    """
    unclipped = np.concatenate([np.zeros(pt.dark.mean_dn.size, bool), unclipped_bright(pt)])
    above = d.mean - d.mean[~d.bright].mean()
    share = above / max(float(above.max()), 1e-9)
    at = unclipped & (share > CURVE_DARKEST) & (share < CURVE_BRIGHTEST) & (d.light > 0)
    if at.sum() < CURVE_LEVELS or d.light[at].max() < 2 * d.light[at].min():
        return 1.0, np.inf, False
    light, signal = d.light[at] / d.light[at].max(), share[at]

    def line(*columns: np.ndarray) -> tuple[np.ndarray, float]:
        design = np.stack([np.ones_like(light), *columns], axis=1)
        found = np.linalg.lstsq(design, signal, rcond=None)[0]
        return found, float(((signal - design @ found) ** 2).sum())

    gamma = _place_of_least(lambda g: line(light**g)[1], 0.05, 3.0, 1e-8)
    found, squares = line(light**gamma)
    jacobian = np.stack([np.ones_like(light), light**gamma, found[1] * light**gamma * np.log(light)], axis=1)
    u = float(np.sqrt(np.linalg.pinv(jacobian.T @ jacobian)[2, 2] * squares / (light.size - 3)))
    return gamma, u, squares < POWER_CURVE * line(light, light**2, light**3)[1]


def _place_of_least(function: Callable[[float], float], low: float, high: float, within: float) -> float:
    """Place of a function's only minimum in an interval, by the golden section (J. Kiefer, Proc. AMS 4, 502 (1953))."""
    ratio = (math.sqrt(5.0) - 1) / 2
    left, right = high - ratio * (high - low), low + ratio * (high - low)
    f_left, f_right = function(left), function(right)
    while high - low > within:
        if f_left < f_right:
            high, right, f_right = right, left, f_left
            left = high - ratio * (high - low)
            f_left = function(left)
        else:
            low, left, f_left = left, right, f_right
            right = low + ratio * (high - low)
            f_right = function(right)
    return (low + high) / 2


def usable_levels(pt: PhotonTransfer, d: model.Levels) -> np.ndarray:
    """Levels that are clipped at neither end and lie below the knee of the variance curve, shape (levels,), bool."""
    stuck = pt.bright.fraction_min.min()
    keep = np.concatenate([pt.dark.fraction_min - stuck <= CLIPPED_BLACK_FRACTION, unclipped_bright(pt)])
    at = np.flatnonzero(d.bright & keep)
    at = at[np.argsort(d.light[at], kind="stable")]
    if at.size:
        # the knee: the first level in order of light whose variance lies significantly below that of a darker one,
        # whatever rounding did to the two
        least, most = model.bounds_before_rounding(d.ms[at])
        noise = np.sqrt(4 / np.maximum(d.ms_dof[at], 1))
        fallen = np.flatnonzero(most < np.maximum.accumulate(least) * np.minimum(0.9, 1 - 6 * noise))
        if fallen.size:
            keep[at[int(np.argmax(d.ms[at[: fallen[0]]])) :]] = False  # the peak itself is already bent
    found = int((keep & d.bright).sum())
    if found < MINIMUM_LEVELS:
        raise MeasureError(
            "too few bright levels lie between black and saturation",
            where="photon transfer",
            value=found,
            allowed=f"{MINIMUM_LEVELS} or more",
            remedy="take levels from dark to saturation in about equal steps; check lamp, gain and black level",
        )
    contrast = d.mean[keep & d.bright].max() - d.mean[~d.bright].mean()
    if contrast < 10 * np.sqrt(max(d.ms[keep].min(), model.QUANTISATION_DN2) / d.pixels):
        what = "the bright levels are as dark as the dark ones"
        raise MeasureError(what, where="photon transfer", remedy="check the lamp and the exposure")
    return keep


def prior_precision(pt: PhotonTransfer, d: model.Levels) -> np.ndarray:
    """Inverse variances of what is known about the parameters beforehand, shape (12,), zero for most.

    The non-linearity is taken as 0 ± 0.1 a coefficient and the light at zero exposure as 0 ± 5 % of the largest: enough to keep
    a short series solvable, far wider than what a usable series leaves open. Rounding and clipping at black shift the means and the
    variances of all dark levels in common by an unknown amount.
    """
    out = np.zeros(len(model.PARAMETERS))
    out[model.A1 : model.A3 + 1] = 1 / NONLINEARITY_PRIOR**2
    out[model.LIGHT_OFFSET] = 1 / LIGHT_OFFSET_PRIOR**2
    dark_var = float(d.ms[~d.bright].mean())
    dither = float(d.dither[~d.bright].mean())
    total = dark_var + dither  # rounding shares its error between frames and pixels
    least = model.least_var_before_rounding(total)
    q_mean, q_var = model.rounding_error_vars(np.array(model.white_before_rounding(dark_var, dither)), dither, d.dnl_lsb)
    q_mean, q_var = d.coherence**2 * q_mean, d.coherence**2 * (q_var + (total - model.QUANTISATION_DN2 - least) ** 2 / 3)
    p = min(clipped_black(pt), CLIPPED_BLACK_FRACTION)
    out[model.Q_MEAN] = 1 / (q_mean + p**2 * dark_var + 1e-12)
    out[model.Q_VAR] = 1 / (q_var + (2 * p * dark_var) ** 2 + 1e-12)
    return out


def uneven_codes(pt: PhotonTransfer, d: model.Levels) -> tuple[float, float]:
    """Share of the uneven codes in what is common to the means of the dark levels, and variance of the part that is not told apart, DN².

    Of a sum Q of two unknowns with variances u and r, the first is expected to be Q u/(u + r), with a variance of u r/(u + r).
    """
    dark = ~d.bright
    if not (d.dnl_lsb and dark.any()):
        return 0.0, 0.0
    dither = float(d.dither[dark].mean())
    white = np.array(model.white_before_rounding(float(d.ms[dark].mean()), dither))
    both, equal = (float(model.rounding_error_vars(white, dither, dnl)[0]) for dnl in (d.dnl_lsb, 0.0))
    total = 1 / prior_precision(pt, d)[model.Q_MEAN]
    share = float(d.coherence**2 * (both - equal) / total)
    return share, share * (1 - share) * total
