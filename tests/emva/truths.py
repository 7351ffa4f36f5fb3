"""What each value of an EMVA 1288 assessment is for a camera without noise: each release's formula, on the noise-free images.

Written without the package. Names of values are those of the public result format.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy import ndimage

from emva.cameras import Camera


@dataclass(frozen=True)
class Levels:
    """Expectations of an exposure series; arrays have shape (levels,), the dark ones belong to the bright ones of the same exposure."""

    exposure_s: np.ndarray
    photons: np.ndarray
    mean: np.ndarray
    var: np.ndarray
    spatial: np.ndarray
    dark_mean: np.ndarray
    dark_var: np.ndarray
    dark_spatial: np.ndarray
    at_top: np.ndarray
    slope: np.ndarray  # DN per photon


@lru_cache(maxsize=20)
def levels(camera: Camera) -> Levels:
    """Expectations of what two frames of each level give (R4.0 eq. 16, 18, 32); all releases of a camera ask for the same."""
    exposure, photons = camera.settings
    rows = camera.shape[0]
    row_dn2 = (camera.gain_dn_per_e * camera.row_noise_e) ** 2

    def statistics(t: float, p: float) -> tuple[float, float, float, float]:
        image, var, top = camera.expected(t, p)
        by_row = row_dn2 * np.mean(1 - top) ** 2
        # half the squared difference of the two frame means is taken off the variance
        return image.mean(), var.mean() - by_row / rows - (var.mean() - by_row) / image.size, image.var(), top.mean()

    def slope(t: float, p: float) -> float:
        more, less = (camera.expected(t, f * p)[0].mean() for f in (1.001, 0.999))
        return (more - less) / (0.002 * p)

    bright = np.array([statistics(t, p) for t, p in zip(exposure, photons, strict=True)]).T
    slopes = np.array([slope(t, p) for t, p in zip(exposure, photons, strict=True)])
    dark = {t: statistics(t, 0.0) for t in camera.dark_exposures_s}
    own = np.array([dark[t] for t in exposure]).T
    return Levels(exposure, photons, *bright[:3], *own[:3], bright[3], slopes)


def saturation_index(s: Levels, release: str) -> int:
    """4.0: last level with 0.2 % of the pixels or less at the top code, or the maximum of the variance if it fell by a fifth before.

    3.1: the maximum of the variance. Reference: the same, sought from the end.
    """
    if release == "3.1":
        return int(np.argmax(s.var))
    if release == "4.0":
        top = int(np.flatnonzero(s.at_top <= 0.002).max())
        peak = int(np.argmax(s.var[: top + 1]))
        return peak if s.var[top] < 0.8 * s.var[peak] else top
    highest, found = 0.0, 0
    for i in range(s.var.size - 1, -1, -1):
        if s.var[i] >= highest or s.var[abs(i - 1)] >= highest:
            highest, found = s.var[i], i
        else:
            break
    return found


def temporal(s: Levels, release: str, area_um2: float) -> dict[str, float]:
    """Sensitivity, linearity and dark current."""
    y, v = s.mean - s.dark_mean, s.var - s.dark_var
    sat = saturation_index(s, release)
    last = int(np.flatnonzero(y <= 0.7 * y[sat]).max())
    fit = slice(0, last + 1)
    responsivity = s.photons[fit] @ y[fit] / (s.photons[fit] @ s.photons[fit])
    gain = y[fit] @ v[fit] / (y[fit] @ y[fit])
    eta = responsivity / gain
    times, first = np.unique(s.exposure_s, return_index=True)
    dark_var, out = s.dark_var[0], {}
    if times.size > 2:
        mean_line, var_line = (np.polyfit(times, d[first], 1) for d in (s.dark_mean, s.dark_var))
        dark_var = var_line[1]
        out = {"u_I_mean_DN": mean_line[0], "u_I_var_DN": var_line[0] / gain}
        out |= {"u_I_mean": mean_line[0] / gain, "u_I_var": var_line[0] / gain**2}
    visible = max(dark_var, 0.24)

    def least(var: float) -> float:
        noise_e = np.sqrt(var) / gain
        return np.sqrt(noise_e**2 + 0.25) + 0.5 if release == "4.0" else noise_e + 0.5

    p_sat = s.photons[sat]
    e_sat, ratio = eta * p_sat, eta * p_sat / least(visible)
    # where quantisation hides the noise, 3.1 and 4.0 state an upper limit of what there is
    dark_var = visible if release == "reference" else dark_var
    e_min = least(dark_var)
    out |= {
        "index_start": 0,
        "index_u_ysat": sat,
        "index_sensitivity_min": 0,
        "index_sensitivity_max": last,
        "R": responsivity,
        "K": gain,
        "inverse_K": 1 / gain,
        "QE": 100 * eta,
        "sigma_y_dark": np.sqrt(dark_var),
        "sigma_d": np.sqrt(max(dark_var - 1 / 12, 0.0)) / gain,
        "u_p_min": e_min / eta,
        "u_e_min": e_min,
        "u_p_sat": p_sat,
        "u_e_sat": e_sat,
        "SNR_max": np.sqrt(e_sat),
        "SNR_max_dB": 10 * np.log10(e_sat),
        "SNR_max_bit": 0.5 * np.log2(e_sat),
        "inverse_SNR_max": 100 / np.sqrt(e_sat),
        "DR": ratio,
        "DR_dB": 20 * np.log10(ratio),
        "DR_bit": np.log2(ratio),
    }
    out |= {f"{name}_area": out[name] / area_um2 for name in ("u_p_min", "u_e_min", "u_p_sat", "u_e_sat")}
    return out | linearity(s, y, sat)


def linearity(s: Levels, y: np.ndarray, sat: int) -> dict[str, float]:
    """Deviation from the straight line through 5 to 95 % of saturation, weights 1/y² (R4.0 eq. 58-63)."""
    low, high = int(np.flatnonzero(y >= 0.05 * y[sat]).min()), int(np.flatnonzero(y <= 0.95 * y[sat]).max())
    use = slice(low, high + 1)
    line = np.polyval(np.polyfit(s.photons[use], y[use], 1, w=1 / y[use]), s.photons[use])
    deviation = 100 * (y[use] - line) / line
    return {
        "index_linearity_min": low,
        "index_linearity_max": high,
        "LE": np.abs(deviation).mean(),
        "LE_min": deviation.min(),
        "LE_max": deviation.max(),
    }


def stack_statistics(camera: Camera, bright: bool) -> tuple[np.ndarray, np.ndarray, float, float, float]:
    """Noise-free image of a stack, and per frame: white variance, row variance, variance of the light, and the image's signal (DN)."""
    level = camera.stack_level
    exposure, photons = (values[level] for values in camera.settings)
    image, var, _ = camera.expected(exposure, photons if bright else 0.0)
    row = (camera.gain_dn_per_e * camera.row_noise_e) ** 2
    signal = camera.gain_dn_per_e * camera.quantum_efficiency * photons if bright else 0.0
    return image, var, row, (camera.flicker_rel * signal) ** 2, signal


def spatial_before_4(camera: Camera, reference: bool) -> dict[str, float]:
    """Row, column and pixel parts as 3.1 and the public reference implementation take them: no high-pass, temporal row noise left in."""
    rows, cols = camera.shape
    n, frames = rows * cols, camera.stack_frames
    out, means = {}, {}
    for tag, bright in (("", True), ("_dark", False)):
        image, var, row, light, _ = stack_statistics(camera, bright)
        white = var.mean() - row
        stack = white + row + light
        measured = image.var() + (white * (1 - 1 / n) + row * (1 - 1 / rows)) / frames
        if reference:
            measured *= n / (n - 1)
        total = measured - stack / frames
        by_col = image.mean(axis=0).var() + white * (1 - 1 / cols) / (frames * rows) - stack / (frames * rows)
        by_row = image.mean(axis=1).var() + (white / cols + row) * (1 - 1 / rows) / frames - stack / (frames * cols)
        rest = n - rows - cols
        out |= {
            f"sigma_2_y_stack{tag}": stack,
            f"s_2_y_measured{tag}": measured,
            f"s_2_y{tag}": total,
            f"s_2_y_cav{tag}": by_col,
            f"s_2_y_rav{tag}": by_row,
            f"s_2_y_col{tag}": ((n - rows) * by_col - cols * (total - by_row)) / rest,
            f"s_2_y_row{tag}": ((n - cols) * by_row - rows * (total - by_col)) / rest,
            f"s_2_y_pixel{tag}": n * (total - by_col - by_row) / rest,
        }
        means[tag] = image.mean()
    return out | _non_uniformities(out, means[""] - means["_dark"])


def _non_uniformities(squares: dict[str, float], signal: float) -> dict[str, float]:
    """DSNU in DN and PRNU in per cent (R4.0 eq. 66, 67); NaN where the difference of the squares is negative."""
    out = {}
    with np.errstate(invalid="ignore"):
        for part in ("", "_row", "_col", "_pixel"):
            dark = squares[f"s_2_y{part}_dark"]
            out[f"DSNU1288{part}_DN"] = np.sqrt(dark)
            out[f"PRNU1288{part}"] = 100 * np.sqrt(squares[f"s_2_y{part}"] - dark) / signal
    return out


def spatial_4(camera: Camera) -> dict[str, float]:
    """Parts of release 4.0: of the noise-free image after the high-pass, as strengths of white patterns before it."""
    gains = filter_gains(camera.shape)
    out, means = {}, {}
    for tag, bright in (("", True), ("_dark", False)):
        image, var, row, light, _ = stack_statistics(camera, bright)
        passed = high_passed(image)
        pixel, by_row, by_col = np.linalg.solve(gains, [passed.var(), passed.mean(axis=1).var(), passed.mean(axis=0).var()])
        total = pixel + by_row + by_col
        out |= {
            f"sigma_2_y_stack{tag}": var.mean() + light,
            f"s_2_y_measured{tag}": total + var[9:-9, 9:-9].mean() / camera.stack_frames,
            f"s_2_y{tag}": total,
            f"s_2_y_cav{tag}": by_col + pixel / camera.shape[0],
            f"s_2_y_rav{tag}": by_row + pixel / camera.shape[1],
            f"s_2_y_col{tag}": by_col,
            f"s_2_y_row{tag}": by_row,
            f"s_2_y_pixel{tag}": pixel,
        }
        means[tag] = image.mean()
    return out | _non_uniformities(out, means[""] - means["_dark"])


def high_passed(image: np.ndarray) -> np.ndarray:
    """The image less its mean over 7 x 7, 11 x 11 and 3 x 3 (binomial) pixels in turn, where all of these are in the frame (R4.0 §8.1)."""
    smooth = image
    for kernel in (np.full((7, 7), 1 / 49), np.full((11, 11), 1 / 121), np.outer([1, 2, 1], [1, 2, 1]) / 16):
        smooth = ndimage.convolve(smooth, kernel)
    return (image - smooth)[9:-9, 9:-9]


def filter_gains(shape: tuple[int, int]) -> np.ndarray:
    """Expected variance of all values, of row and of column means after the high-pass, for white pixels, rows and columns of variance 1.

    The filter is S X S' − L X L' with S selecting and L smoothing rows or columns; a white X gives E|A X B'|² = |A|² |B|².
    """
    low = np.convolve(np.convolve(np.ones(7), np.ones(11)), [1, 2, 1]) / (7 * 11 * 4)

    def axis(n: int) -> tuple[np.ndarray, np.ndarray, tuple[np.ndarray, np.ndarray]]:
        select = np.eye(n)[9:-9]
        smooth = np.array([np.r_[np.zeros(i), low, np.zeros(n - 19 - i)] for i in range(n - 18)])
        return select, smooth, (select.mean(axis=0), smooth.mean(axis=0))

    def power(a: np.ndarray, b: np.ndarray, c: np.ndarray, d: np.ndarray) -> float:
        """E|a X c' − b X d'|²."""
        return np.sum(a * a) * np.sum(c * c) - 2 * np.sum(a * b) * np.sum(c * d) + np.sum(b * b) * np.sum(d * d)

    (sy, ly, my), (sx, lx, mx) = axis(shape[0]), axis(shape[1])
    m, n = len(sy), len(sx)
    whole = power(*my, *mx)
    rows = np.sum((sy - ly) ** 2) / m - np.sum((my[0] - my[1]) ** 2)
    cols = np.sum((sx - lx) ** 2) / n - np.sum((mx[0] - mx[1]) ** 2)
    return np.array(
        [
            [power(sy, ly, sx, lx) / (m * n) - whole, rows, cols],
            [power(sy, ly, *mx) / m - whole, rows, 0.0],
            [power(*my, sx, lx) / n - whole, 0.0, cols],
        ]
    )


def general(s: Levels) -> dict[str, float]:
    """R4.0 General: noise at the input is that at the output over the slope of the characteristic curve."""
    usable = s.at_top <= 0.002
    if usable.all():  # full well below the top code: up to 1.25 % of the pixels beyond the plateau, as the normal tail has it
        usable = s.mean[-1] - s.mean >= 2.24 * np.sqrt((s.var + s.spatial).max())
    count = int(np.flatnonzero(usable).max()) + 1
    p, slope, var, spatial = (values[:count] for values in (s.photons, s.slope, s.var, s.spatial))
    snr, total = p * slope / np.sqrt(var), p * slope / np.sqrt(var + spatial)
    eta = slope[0] ** 2 * p[0] / (var[0] - s.dark_var[0])  # of a linear camera: R/K
    threshold = (np.sqrt(s.dark_var[0] * (eta / slope[0]) ** 2 + 0.25) + 0.5) / eta
    threshold = threshold if s.dark_var[0] > 0.24 else np.nan  # below, the rounding bends the curve of the variance
    half = 0.5 * p[-1]
    dark = s.dark_spatial[:count][(p <= half) | (np.arange(count) == 0)].mean()
    return {
        "general_u_p_min": threshold,
        "general_u_p_sat": p[-1],
        "general_SNR_max": snr.max(),
        "general_SNR_max_dB": 20 * np.log10(snr.max()),
        "general_SNR_total_max": total.max(),
        "general_DR": p[-1] / threshold,
        "general_DR_dB": 20 * np.log10(p[-1] / threshold),
        "general_DSNU": np.sqrt(dark) / slope[0],
        "general_PRNU": 100 * np.sqrt(np.interp(half, p, spatial / (p * slope) ** 2)),
    }


def surface(image: np.ndarray) -> np.ndarray:
    """Polynomial of total degree 4 through an image."""
    y, x = np.mgrid[-1 : 1 : image.shape[0] * 1j, -1 : 1 : image.shape[1] * 1j]
    terms = np.stack([(x**i * y**j).ravel() for i in range(5) for j in range(5 - i)], axis=1)
    return (terms @ np.linalg.lstsq(terms, image.ravel(), rcond=None)[0]).reshape(image.shape)


def strengths(image: np.ndarray, degree: int) -> dict[str, float]:
    """Variances of the pixel, row and column part and their sum, by analysis of variance; ``degree`` of a polynomial that was taken off."""
    (m, n), by_row, by_col = image.shape, image.mean(axis=1, keepdims=True), image.mean(axis=0, keepdims=True)
    rest = image - by_row - by_col + image.mean()
    pixel = np.sum(rest**2) / ((m - 1) * (n - 1) - degree * (degree - 1) // 2)
    row = by_row.var() * m / (m - 1 - degree) - pixel / n
    col = by_col.var() * n / (n - 1 - degree) - pixel / m
    return {"": pixel + row + col, "_row": row, "_col": col, "_pixel": pixel}


def nonlinear(camera: Camera, s: Levels) -> dict[str, float]:
    """What a fit that allows for a bent response should find of a straight one."""
    k, eta = camera.gain_dn_per_e, camera.quantum_efficiency
    # with one exposure time, the dark current's noise is not told from the rest
    noise = np.sqrt(camera.read_e**2 + camera.row_noise_e**2 + camera.light_swept * camera.dark_e_per_s * camera.longest_s)
    e_min = np.sqrt(noise**2 + 1 / 12 / k**2 + 0.25) + 0.5
    dark, bright = (stack_statistics(camera, lit)[0] for lit in (False, True))
    ratio = (bright - dark) / surface(bright - dark)
    out = {"K": k, "inverse_K": 1 / k, "sigma_d": noise, "QE": 100 * eta * camera._patterns[0].mean(), "u_e_min": e_min}
    out |= {"u_p_min": 100 * e_min / out["QE"], "u_I_mean": camera.dark_e_per_s}
    with np.errstate(invalid="ignore"):
        out |= {f"DSNU1288{part}": np.sqrt(value) / k for part, value in strengths(dark, 0).items()}
        out |= {f"PRNU1288{part}": 100 * np.sqrt(value) for part, value in strengths(ratio - surface(ratio), 4).items()}
    # below, the rounding bends the photon transfer, which the model has not
    return {f"{key}_nonlinear": value for key, value in out.items()} if s.dark_var[0] > 0.3 else {}


def truths(camera: Camera, release: str) -> dict[str, float]:
    """All values of a release; NaN or missing where the camera has none."""
    series = levels(camera)  # of all pixels, before any filter
    out = temporal(series, release, camera.pixel_area_um2)
    out |= spatial_4(camera) if release == "4.0" else spatial_before_4(camera, release == "reference")
    for part in ("", "_row", "_col", "_pixel"):
        out[f"DSNU1288{part}"] = out[f"DSNU1288{part}_DN"] / out["K"]
        if part:
            del out[f"DSNU1288{part}_DN"]
    # the noise, the light's own and the patterns', at saturation (R4.0 eq. 69)
    noise = max(out["sigma_y_dark"] ** 2, 0.24) / out["K"] ** 2 + np.nan_to_num(out["DSNU1288"]) ** 2
    noise += out["u_e_sat"] + (np.nan_to_num(out["PRNU1288"]) / 100 * out["u_e_sat"]) ** 2
    out["SNR_total_max"] = out["u_e_sat"] / np.sqrt(noise)
    if release == "4.0":
        # the photon transfer of a linear camera is straight, but for what rounding does where there is no noise
        out["PTC_linearity"] = 0.0 if series.dark_var[0] > 0.3 else np.nan
        out |= general(series) | nonlinear(camera, series)
    return out
