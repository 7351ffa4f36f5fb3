"""Checks of light, noise and pixels in a preflight; see ``preflight_checks``."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from pixmetry.emva.planning.preflight_checks import FALSE_ALARM, NAN, Check, Frames, beyond, level_text, new_check
from pixmetry.emva.planning.preflight_frames import BLOCK, Group
from pixmetry.observe.surface import Surface, cross_strata, fill, fit_surface

UNIFORMITY = 0.03  # (max − min)/mean of the light, as the standard allows
SURFACE_DEGREE = 4
FLICKER_FRAMES, DRIFT_FRAMES = 4, 6  # least numbers that tell of the light


@dataclass(frozen=True)
class Flattened:
    """The light of the brightest unsaturated level, dark image taken off: smooth surface and what is left."""

    group: Group
    signal_dn: float
    surface: Surface
    residual_dn: np.ndarray


def flattened(frames: Frames) -> Flattened | None:
    """The light and its smooth part; None where there is no light, or the frames are too small."""
    levels = frames.unsaturated
    if not levels or min(frames.dark.shape) < 2 * SURFACE_DEGREE + 4:
        return None
    light = levels[-1].mean_map_dn - frames.dark.mean_map_dn
    outliers = np.abs(light - np.median(light)) > 0.5 * np.median(light)
    light = fill(light, outliers) if outliers.mean() < 0.01 else light
    surface = fit_surface(light, SURFACE_DEGREE)
    return Flattened(levels[-1], float(light.mean()), surface, light - surface.values)


def flicker_rel(group: Group, dark: Group) -> float:
    """Scatter of the frame means beyond noise, over the signal."""
    excess = group.squares.frame_dn2 - group.mean_noise_dn2
    return math.sqrt(max(excess, 0.0)) / max(group.mean_dn - dark.mean_dn, 1e-9)


def check_flicker(frames: Frames) -> Check:
    """Scatter of the light from frame to frame: variance ratio against the noise of a mean."""
    make = new_check("flicker", "scatter of the light between frames", "%", "at most 0.2 %")
    groups = [g for g in frames.unsaturated if g.n_frames >= FLICKER_FRAMES and g.mean_noise_dn2 > 0]
    if not groups:
        return make(NAN, NAN, "not judged", "four bright frames or more at one unsaturated level are needed")
    from scipy.stats import f

    worst, verdict = max(groups, key=lambda g: flicker_rel(g, frames.dark)), "ok"
    value = flicker_rel(worst, frames.dark)
    dof = worst.n_frames - 1
    limit = f.isf(FALSE_ALARM / len(groups), dof, min(worst.shape) - 1)
    if worst.squares.frame_dn2 > limit * worst.mean_noise_dn2:
        verdict = "fail" if value > 0.02 else "warn" if value > 0.002 else "ok"
    reason = f"the light flickers or drifts {level_text(worst)}; responsivity, linearity and quantum efficiency will scatter by as much"
    remedy = "Run the light on direct current; make exposures multiples of the mains period (10 ms at 50 Hz); let the lamp warm up"
    return make(100 * value, 100 * value / math.sqrt(2 * dof), verdict, reason, remedy)


def _drift(group: Group) -> tuple[float, float, bool]:
    """Change of the frame mean over the series along a line, its u, and whether it is more than chance."""
    from scipy.stats import t

    n = group.n_frames
    time = np.arange(n) - (n - 1) / 2
    slope = float(time @ group.frame_means_dn / (time @ time))
    rest = group.frame_means_dn - group.mean_dn - slope * time
    u = math.sqrt(max(rest @ rest / (n - 2), group.mean_noise_dn2) / (time @ time))
    return abs(slope) * (n - 1), u * (n - 1), abs(slope) > t.isf(FALSE_ALARM / 2, n - 2) * u


def check_drift(frames: Frames) -> Check:
    """Trend of the light over the frames of a level."""
    make = new_check("drift", "drift of the light over the frames", "%", "at most 0.5 %")
    groups = [g for g in frames.unsaturated if g.n_frames >= DRIFT_FRAMES]
    if not groups:
        return make(NAN, NAN, "not judged", "six bright frames or more at one unsaturated level are needed")
    group = max(groups, key=lambda g: g.n_frames)
    signal = group.mean_dn - frames.dark.mean_dn
    change, u, real = _drift(group)
    verdict = "warn" if real and change > 0.005 * signal else "ok"
    return make(100 * change / signal, 100 * u / signal, verdict, f"the light drifts {level_text(group)}", "Let lamp and camera warm up")


def check_dark_drift(frames: Frames) -> Check:
    """Trend of the dark signal over the frames, against the dark noise."""
    make = new_check("dark_drift", "drift of the dark mean over the frames", "DN", "at most 0.1 σ of the dark noise")
    dark = frames.dark
    if dark.n_frames < DRIFT_FRAMES:
        return make(NAN, NAN, "not judged", "six dark frames or more are needed")
    change, u, real = _drift(dark)
    verdict = "warn" if real and change > 0.1 * math.sqrt(dark.squares.total_dn2) else "ok"
    return make(change, u, verdict, "the dark signal drifts", "Let the camera warm up to its steady temperature")


def check_banding(frames: Frames) -> Check:
    """Waves down the rows that differ between frames: mains flicker under a rolling shutter."""
    make = new_check("banding", "bands down the rows, amplitude", "%", "at most 0.1 % of the signal")
    from scipy.stats import gamma

    if not frames.unsaturated or frames.dark.shape[0] < 32:
        return make(NAN, NAN, "not judged", "no unsaturated bright level, or fewer than 32 rows")
    worst, found = 0.0, "ok"
    for g in frames.unsaturated:
        profiles, rows = g.row_profiles_dn, g.shape[0]
        pairs = profiles[1::2][: g.n_frames // 2] - profiles[0::2][: g.n_frames // 2]
        power = (np.abs(np.fft.rfft(pairs - pairs.mean(axis=1, keepdims=True), axis=1)) ** 2).mean(axis=0)[1:-1] / rows
        n = len(pairs)
        floor = float(np.median(power)) / (gamma.median(n) / n)
        # the floor is a median over the frequencies: room for its scatter
        limit = gamma.isf(FALSE_ALARM / power.size / len(frames.bright), n) / n * (1 + 6.5 / math.sqrt(power.size))
        peak = float(power.max())
        amplitude = math.sqrt(max(2 * (peak - floor) / rows, 0.0)) / (g.mean_dn - frames.dark.mean_dn)
        if peak > limit * floor and amplitude > worst:
            worst, found = amplitude, "fail" if amplitude > 0.01 else "warn" if amplitude > 0.001 else "ok"
    remedy = "Run the light on direct current, make exposures multiples of the mains period, or use a global shutter"
    return make(100 * worst, NAN, found, "bands move through the image from frame to frame: flickering light, read row by row", remedy)


def check_uniformity(frames: Frames) -> Check:
    """Largest less smallest light over its mean, of the smooth surface fitted to bright less dark."""
    make = new_check("uniformity", "(max − min)/mean of the light", "%", "at most 3 %")
    light = flattened(frames)
    if light is None:
        return make(NAN, NAN, "not judged", "no unsaturated bright level, or frames smaller than 12 x 12")
    s, residual = light.surface, light.residual_dn
    strata, (rows, cols) = cross_strata(residual, residual), residual.shape
    variances = s.coefficient_variances(strata.pixel / residual.size, strata.row / rows, strata.col / cols)
    high, low = (np.unravel_index(at, residual.shape) for at in (s.values.argmax(), s.values.argmin()))
    contrast = np.outer(s.basis_y[high[0]], s.basis_x[high[1]]) - np.outer(s.basis_y[low[0]], s.basis_x[low[1]])
    value, u = float(np.ptp(s.values)) / light.signal_dn, math.sqrt(float((contrast**2 * variances).sum())) / light.signal_dn
    remedy = "Move the light away, use an integrating sphere and no lens, and centre the camera"
    return make(100 * value, 100 * u, beyond(value, u, UNIFORMITY, UNIFORMITY), "the light is uneven; PRNU will hold part of it", remedy)


def check_defects(frames: Frames) -> Check:
    """Pixels that are clearly hot in the dark, or respond to light by less than half or more than one and a half."""
    make = new_check("defects", "hot, dead and deviating pixels", "%", "at most 0.1 %")
    image, dark = frames.dark.mean_map_dn, frames.dark
    spread = 1.4826 * float(np.median(np.abs(image - np.median(image))))
    limit = 10 * max(spread, math.sqrt(dark.squares.total_dn2 / dark.n_frames)) + 1
    bad = np.abs(image - np.median(image)) > limit
    if frames.unsaturated:
        group = frames.unsaturated[-1]
        response = group.mean_map_dn - image
        noise = math.sqrt(group.squares.total_dn2 / group.n_frames + dark.squares.total_dn2 / dark.n_frames)
        middle = float(np.median(response))
        bad |= np.abs(response - middle) > max(0.5 * middle, 10 * noise)
    share = float(bad.mean())
    u = math.sqrt(share * (1 - share) / bad.size)
    remedy = "Check the cooling, clean the sensor, or leave these pixels out; say so in the data sheet"
    return make(100 * share, 100 * u, beyond(share, u, 0.001, 0.01), f"{int(bad.sum())} pixels stand out", remedy)


def _log_slope(x: np.ndarray, y: np.ndarray, u_log_y: np.ndarray) -> tuple[float, float]:
    """Exponent of y ∝ x^p by weighted least squares, and its u."""
    w, lx = u_log_y**-2.0, np.log(x)
    lx = lx - (w @ lx) / w.sum()
    return float(w * lx @ np.log(y) / (w * lx @ lx)), float(1 / math.sqrt(w * lx @ lx))


def check_transfer(frames: Frames) -> Check:
    """Exponent of variance per signal against signal: 0 for a linear camera, below −1 after gamma 0.45."""
    make = new_check("transfer", "x in variance/signal ~ signal^x", "", "0 ± 0.1")
    dark = frames.dark
    x = np.array([g.mean_dn - dark.mean_dn for g in frames.unsaturated])
    var = np.array([g.squares.pixel_dn2 for g in frames.unsaturated])
    pairs = np.array([g.n_frames - 1 for g in frames.unsaturated]) * dark.mean_map_dn.size
    y = var - dark.squares.pixel_dn2
    # the dark term is common to all levels; taken as independent it makes u larger
    u = np.sqrt(2 * var**2 / pairs + 2 * dark.squares.pixel_dn2**2 / (dark.mean_map_dn.size * (dark.n_frames - 1)) + 0.02**2)
    use = y > 5 * u
    if use.sum() < 2 or np.ptp(np.log(x[use])) < 0.4:
        return make(NAN, NAN, "not judged", "two unsaturated levels, one and a half times apart, with noise of the light are needed")
    slope, u_slope = _log_slope(x[use], y[use] / x[use], (u / np.where(y > 0, y, 1))[use])
    reason = "the noise does not grow with the signal as photons make it: gamma, a table, noise reduction or strong compression"
    remedy = "Switch gamma and filters off, or use the General values, which need no linear camera"
    return make(slope, u_slope, beyond(abs(slope), u_slope, 0.1, 0.3), reason, remedy)


def check_response(frames: Frames) -> Check:
    """Exponent of signal against photons, or exposure time where photons are not known."""
    make = new_check("response", "x in signal ~ light^x", "", "1 ± 0.05")
    levels = frames.unsaturated
    by_photons = all(g.photons for g in levels)
    light = [g.photons if by_photons else g.exposure_s for g in levels]
    known = np.array([v for v in light if v], dtype=float)
    if len(levels) < 2 or known.size < len(levels) or known.max() < 1.5 * known.min():
        return make(NAN, NAN, "not judged", "two unsaturated levels with known light, one and a half times apart, are needed")
    x = np.array([g.mean_dn - frames.dark.mean_dn for g in levels])
    noise = np.array([max(g.squares.frame_dn2 / g.n_frames, g.mean_noise_dn2 / g.n_frames) for g in levels])
    dark = frames.dark.squares.frame_dn2 / frames.dark.n_frames
    slope, u = _log_slope(known, x, np.sqrt(noise + dark + (1e-3 * x) ** 2) / x)
    reason = "the signal does not follow the light" + ("" if by_photons else " (or the light changed while the exposure was swept)")
    remedy = "Switch gamma, automatic gain and exposure off and check the light, or use the General values, which need no linear camera"
    return make(slope, u, beyond(abs(slope - 1), u, 0.05, 0.2), reason, remedy)


def check_blocks(frames: Frames) -> Check:
    """Steps of the frame difference that are larger or smaller at every eighth column or row: JPEG."""
    make = new_check("blocks", "noise steps at every 8th row or column", "%", "by chance only")
    from scipy.stats import t

    groups = frames.unsaturated or (frames.dark,)
    worst, u_worst, chance = 0.0, NAN, 1.0
    tests = 2 * BLOCK * len(groups)
    for steps in (s for g in groups for s in (g.steps_x_dn2, g.steps_y_dn2)):
        if steps.size < 8 * BLOCK or steps.mean() == 0:
            continue
        for phase in range(BLOCK):
            own, rest = steps[phase::BLOCK], np.delete(steps, np.s_[phase::BLOCK])
            # neighbours share a column: of the others every second is independent at least
            u = math.sqrt(own.var(ddof=1) / own.size + 2 * rest.var(ddof=1) / rest.size)
            excess = own.mean() - rest.mean()
            p = 2 * t.sf(abs(excess) / u, own.size - 1) if u > 0 else float(excess == 0)
            if p < chance:
                worst, u_worst, chance = excess / steps.mean(), u / steps.mean(), p
    if math.isnan(u_worst):
        return make(NAN, NAN, "not judged", "the frames are too small or have no noise")
    verdict = "warn" if chance < FALSE_ALARM / tests and abs(worst) > 0.02 else "ok"
    reason = "the noise has seams every 8 pixels, as JPEG leaves them"
    return make(100 * worst, 100 * u_worst, verdict, reason, "Store frames without compression")


LIGHT_CHECKS: tuple[Callable[[Frames], Check], ...] = (
    check_flicker,
    check_drift,
    check_dark_drift,
    check_banding,
    check_uniformity,
    check_defects,
    check_transfer,
    check_response,
    check_blocks,
)
