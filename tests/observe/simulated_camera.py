"""A camera written without the package: exact moments by cumulants, records drawn from their sampling law, and real frames."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from math import comb, erfc, exp, pi, sqrt

import numpy as np

from pixmetry.camera.observations import LevelMoments, PhotonTransfer


@dataclass(frozen=True)
class Camera:
    gain: float = 0.1
    dark_noise_e: float = 30.0
    row_noise_e: float = 5.0
    column_noise_e: float = 0.0
    dark_current_e_per_s: float = 200.0
    a: tuple[float, float, float] = (0.0, 0.0, 0.0)
    bits: int = 12
    offset_dn: float = 40.0
    shape: tuple[int, int] = (480, 640)
    levels: int = 50
    exposure_s: float = 0.02
    over: float = 1.1  # longest exposure, in units of the one that saturates
    lamp: float = 0.0
    wander_dn: float = 0.0
    clamped: bool = False
    prnu: float = 0.0
    dsnu_dn: float = 0.0

    @property
    def x_ref(self) -> float:
        return 2.0**self.bits - 1

    @property
    def x_top(self) -> float:
        """Linear signal at the top code."""
        x = np.linspace(0, 1.5, 20001) * self.x_ref
        return float(x[np.searchsorted(self.offset_dn + self.curve(x), self.x_ref)])

    @property
    def rate_dn_per_s(self) -> float:
        """Light signal per second; dark current comes on top."""
        return self.over * self.x_top / self.exposure_s - self.gain * self.dark_current_e_per_s

    def curve(self, x):
        w = x / self.x_ref
        return x + self.a[0] * x * w + self.a[1] * x * w**2 + self.a[2] * x * w**3

    @property
    def times(self) -> np.ndarray:
        return self.exposure_s * np.arange(1, self.levels + 1) / self.levels


def central_moments(cumulants: np.ndarray) -> np.ndarray:
    """Central moments 0 … n from cumulants κ₂ … κₙ by the recursion µₙ = Σ C(n−1, k−1) κₖ µₙ₋ₖ."""
    m = np.zeros(cumulants.size + 2)
    m[0] = 1
    for n in range(2, m.size):
        m[n] = sum(comb(n - 1, k - 1) * cumulants[k - 2] * m[n - k] for k in range(2, n + 1))
    return m


@lru_cache(maxsize=1000)
def stored_statistics(camera: Camera, light_dn: float, dark_e: float) -> tuple[float, float, float, float]:
    """Mean above black and variance of the unquantised stored value, exact; third and fourth central moment to leading order."""
    k, electrons = camera.gain, light_dn / camera.gain + dark_e
    x, ref = k * electrons, camera.x_ref
    cumulants = np.array([k**r * electrons for r in range(2, 9)])
    cumulants[0] += (k * camera.dark_noise_e) ** 2
    mu = central_moments(cumulants)
    a = np.array(camera.a) / ref ** np.arange(1, 4)
    powers = [1.0, *a]  # f = Σ powers[n−1] xⁿ; its Taylor coefficients about x
    c = [sum(powers[n - 1] * comb(n, i) * x ** (n - i) for n in range(max(i, 1), 5)) for i in range(5)]
    shift = sum(c[i] * mu[i] for i in range(2, 5))
    square = sum(c[i] * c[j] * mu[i + j] for i in range(1, 5) for j in range(1, 5))
    return c[0] + shift, square - shift**2, c[1] ** 3 * mu[3], c[1] ** 4 * mu[4]


def clipped_normal(c: float) -> tuple[float, float, float]:
    """Loss of the mean, remaining variance and clipped share of a standard normal value clipped above at ``c``."""
    density, above = exp(-0.5 * c**2) / sqrt(2 * pi), 0.5 * erfc(c / sqrt(2))
    mean = -(density - c * above)
    second = (1 - above) - c * density + c**2 * above
    return -mean, max(second - mean**2, 0.0), above


def drawn_levels(camera: Camera, times, rate, rng, frames: int = 2) -> LevelMoments:
    """Mean squares and means drawn from their sampling distributions, without making frames."""
    rows, cols = camera.shape
    n = rows * cols
    row, col = (camera.gain * camera.row_noise_e) ** 2, (camera.gain * camera.column_noise_e) ** 2
    out = {name: [] for name in LevelMoments.__dataclass_fields__}
    for t in times:
        light = rate * t * (1 + camera.lamp * rng.standard_normal()) if rate else 0.0
        dark_e = camera.dark_current_e_per_s * t
        mean, var, m3, m4 = stored_statistics(camera, light, dark_e)
        if camera.clamped:
            mean -= camera.gain * dark_e
        var += 1 / 12
        dof = (frames - 1) * (rows - 1) * (cols - 1)
        relative = (2 + (m4 / (var - 1 / 12) ** 2 - 3) * (frames - 1) / frames) / dof
        shape = 1 / relative
        ms = var * rng.gamma(shape) / shape
        level_var = (var / n + row / rows + col / cols) / frames
        rho = m3 / (frames * n) / sqrt(level_var * relative * var**2)
        level = rho * (ms / var - 1) / sqrt(relative) + sqrt(max(1 - rho**2, 0)) * rng.standard_normal()
        level = camera.offset_dn + mean + sqrt(level_var) * level + camera.wander_dn * rng.standard_normal()
        spread = sqrt(var + row + col + (camera.prnu * light) ** 2)
        lost, kept, above = clipped_normal((camera.x_ref - level) / spread)
        share = np.round(above * frames * n) / (frames * n)
        level, ms, row_l, col_l = level - spread * lost, ms * kept, row * kept, col * kept
        f = frames - 1
        out["exposure_s"].append(t)
        out["n_frames"].append(frames)
        out["mean_dn"].append(level)
        out["var_total_dn2"].append(ms + row_l + col_l)
        out["ms_pixel_dn2"].append(ms)
        out["ms_row_dn2"].append((row_l + ms / cols) * rng.chisquare(f * (rows - 1)) / (f * (rows - 1)))
        out["ms_col_dn2"].append((col_l + ms / rows) * rng.chisquare(f * (cols - 1)) / (f * (cols - 1)))
        out["ms_frame_dn2"].append((ms / n + row_l / rows + col_l / cols) * rng.chisquare(f) / f)
        out["kurtosis_excess"].append(0.5 * (m4 / var**2 - 3) + sqrt(24 / n) * rng.standard_normal())
        out["fraction_min"].append(0.0)
        out["fraction_max"].append(share)
        out["spatial_cov_dn2"].append((camera.prnu * light) ** 2 + camera.dsnu_dn**2)
    out["photons"] = None
    return LevelMoments(**{k: None if v is None else np.array(v, float) for k, v in out.items()})


def drawn_record(camera: Camera, rng) -> PhotonTransfer:
    bright = drawn_levels(camera, camera.times, camera.rate_dn_per_s, rng)
    return PhotonTransfer(bright, drawn_levels(camera, camera.times, 0.0, rng), camera.shape, camera.bits)


def truth(camera: Camera) -> dict[str, float]:
    return {
        "gain_dn_per_e": camera.gain,
        "dark_noise_e": camera.dark_noise_e,
        "row_noise_e": camera.row_noise_e,
        "column_noise_e": camera.column_noise_e,
        "offset_dn": camera.offset_dn,
        "dark_current_e_per_s": camera.dark_current_e_per_s,
        "nonlinearity_a1": camera.a[0],
        "nonlinearity_a2": camera.a[1],
        "nonlinearity_a3": camera.a[2],
        "responsivity_dn_per_s": camera.rate_dn_per_s,
        "illumination_noise_rel": camera.lamp,
        "full_well_e": camera.x_top / camera.gain,
    }


def random_camera(rng, **fixed) -> Camera:
    """A camera from the range that the estimator is meant for; ``fixed`` fields as given."""
    while True:
        gain, noise = 10 ** rng.uniform(-2, np.log10(5)), 10 ** rng.uniform(np.log10(2), 2)
        bits = int(rng.integers(8, 15))
        sigma = max(gain * noise, 0.3)
        offset = 6 * sigma * 1.2 + 2
        if gain * noise > 0.45 and offset < 0.15 * 2**bits and 2**bits / gain > 300:
            break
    full_e, levels = 2**bits / gain, int(rng.integers(10, 51))
    exposure = 10 ** rng.uniform(-3, 0)
    shape = [(48, 64), (120, 160), (240, 320), (480, 640)][rng.integers(4)]
    row = noise * rng.uniform(0, 0.5) * (rng.random() < 0.8)
    drawn = Camera(
        gain=gain,
        dark_noise_e=noise,
        row_noise_e=row,
        dark_current_e_per_s=rng.choice([0.0, 1.0]) * rng.uniform(0, 0.02) * full_e / exposure,
        a=tuple(rng.normal(0, [0.02, 0.015, 0.015])),
        bits=bits,
        offset_dn=offset,
        shape=shape,
        levels=levels,
        exposure_s=exposure,
        over=rng.uniform(1.05, 1.3),
        lamp=rng.choice([0.0, 1.0]) * rng.uniform(0.0002, 0.002),
        wander_dn=rng.choice([0.0, 1.0]) * 0.02 * sigma,
    )
    return replace(drawn, **fixed)


def reference_u(camera: Camera) -> dict[str, float]:
    """Cramér-Rao bound of means and mean squares with all weights known, by finite differences of the exact moments.

    Written on the raw pair (mean, mean square) of a level with the common lamp noise in both, not on residuals as the fit does.
    Free: offset, light at zero exposure, slope, gain, dark noise, three coefficients, dark signal and dark variance per exposure.
    """
    rows, cols = camera.shape
    n, frames = rows * cols, 2
    row, col = (camera.gain * camera.row_noise_e) ** 2, (camera.gain * camera.column_noise_e) ** 2
    dark_dn = camera.gain * camera.dark_current_e_per_s * camera.exposure_s
    start = np.array([camera.offset_dn, 0.0, 1.0, camera.gain, camera.dark_noise_e, *camera.a, dark_dn, 0.0])
    step = np.array([1e-2, 1e-5, 1e-5, camera.gain * 1e-4, camera.dark_noise_e * 1e-4, 1e-4, 1e-4, 1e-4, 1e-2, 1e-2])

    def moments(p, t, bright):
        c = replace(camera, gain=p[3], dark_noise_e=p[4], a=tuple(p[5:8]))
        share = t / camera.exposure_s
        light = p[2] * camera.rate_dn_per_s * (t + p[1] * camera.exposure_s) if bright else 0.0
        mean, var, m3, m4 = stored_statistics(c, light + p[8] * share, 0.0)
        return np.array([p[0] + mean, var + p[9] * share + 1 / 12]), m3, m4

    information = np.diag([0, 1 / 0.05**2, 0, 0, 0, 100.0, 100.0, 100.0, 0, 0])  # the weak priors of the fit
    for t in camera.times:
        for bright in (True, False):
            (mean, var), m3, m4 = moments(start, t, bright)
            spread = sqrt(var + row + col)
            if bright and 0.5 * erfc((camera.x_ref - mean) / sqrt(2) / spread) > 2e-5:
                continue
            jac = np.array([(moments(start + h, t, bright)[0] - moments(start - h, t, bright)[0]) for h in np.diag(step)]).T / (2 * step)
            lamp = camera.lamp * jac[:, 2] if bright else np.zeros(2)
            cov = np.diag([(var / n + row / rows + col / cols) / frames + camera.wander_dn**2, var**2 * (1 + 0.5 * (m4 / var**2 - 1)) / n])
            cov[0, 1] = cov[1, 0] = m3 / (frames * n)
            information += jac.T @ np.linalg.inv(cov + np.outer(lamp, lamp)) @ jac
    scale = 1 / np.sqrt(np.diag(information))
    u = scale * np.sqrt(np.diag(np.linalg.inv(information * np.outer(scale, scale))))
    names = ("gain_dn_per_e", "dark_noise_e", "nonlinearity_a1", "nonlinearity_a2", "nonlinearity_a3")
    return dict(zip(names, u[3:8], strict=True)) | {"responsivity_dn_per_s": u[2] * camera.rate_dn_per_s, "offset_dn": u[0]}


def frame_moments(frames: np.ndarray, top: float) -> dict[str, float]:
    """Mean squares of two frames, from the definition of the two-way analysis of variance."""
    d = (frames[0] - frames[1]) / sqrt(2)
    rows, cols = d.shape
    by_row, by_col, all_mean = d.mean(axis=1, keepdims=True), d.mean(axis=0, keepdims=True), d.mean()
    white = d - by_row - by_col + all_mean
    return {
        "n_frames": 2,
        "mean_dn": frames.mean(),
        "var_total_dn2": d.var(),
        "ms_pixel_dn2": (white**2).sum() / ((rows - 1) * (cols - 1)),
        "ms_row_dn2": ((by_row - all_mean) ** 2).sum() / (rows - 1),
        "ms_col_dn2": ((by_col - all_mean) ** 2).sum() / (cols - 1),
        "ms_frame_dn2": all_mean**2,
        "kurtosis_excess": ((d - all_mean) ** 4).mean() / d.var() ** 2 - 3 if d.var() else np.nan,
        "fraction_min": (frames <= 0).mean(),
        "fraction_max": (frames >= top).mean(),
        "spatial_cov_dn2": (frames[0] * frames[1]).mean() - frames[0].mean() * frames[1].mean(),
    }


def framed_record(camera: Camera, rng, shading: float = 0.0) -> PhotonTransfer:
    """A record from real frames: Poisson electrons, fixed patterns, row noise, non-linearity, rounding; the lamp flickers by frame."""
    rows, cols = camera.shape
    y, x = np.mgrid[-1 : 1 : rows * 1j, -1 : 1 : cols * 1j]
    fall = 1 - shading * (x**2 + y**2 + x**2 * y**2)
    light_map = fall / fall.mean() * (1 + camera.prnu * rng.standard_normal(camera.shape))
    light_map /= light_map.mean()
    offset_map = camera.dsnu_dn * rng.standard_normal(camera.shape)
    offset_map -= offset_map.mean()

    def frame(t, rate):
        light_e = rate * t * (1 + camera.lamp * rng.standard_normal()) / camera.gain
        electrons = rng.poisson(light_e * light_map + camera.dark_current_e_per_s * t)
        signal = camera.gain * (electrons + camera.dark_noise_e * rng.standard_normal(camera.shape))
        lines = camera.row_noise_e * rng.standard_normal((rows, 1)) + camera.column_noise_e * rng.standard_normal((1, cols))
        stored = camera.offset_dn + offset_map + camera.curve(signal) + camera.gain * lines
        return np.clip(np.rint(stored), 0, camera.x_ref)

    def levels(rate):
        out = [{"exposure_s": t} | frame_moments(np.array([frame(t, rate), frame(t, rate)]), camera.x_ref) for t in camera.times]
        return LevelMoments(photons=None, **{k: np.array([level[k] for level in out], float) for k in out[0]})

    return PhotonTransfer(levels(camera.rate_dn_per_s), levels(0.0), camera.shape, camera.bits)
