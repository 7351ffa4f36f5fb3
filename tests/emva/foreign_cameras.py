"""Cameras as other people simulate them: plain NumPy, none of the package's forward code, and what should be found of them.

Beyond ``cameras``: gains down to 0.02 DN/e-, so that rounding may be most of the noise, hot pixels, fixed waves, strong shading, temporal
column noise, and in some a response that bends by 2 % in one of three ways.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy import stats

BENDS = ("quadratic", "cubic", "rational")


@dataclass(frozen=True)
class ForeignCamera:
    """One camera, its light and the frames that are to be taken. Patterns are standard deviations (pixel, row, column)."""

    seed: int
    gain_dn_per_e: float = 0.3
    read_e: float = 6.0
    row_noise_e: float = 0.0  # temporal
    col_noise_e: float = 0.0
    quantum_efficiency: float = 0.5
    dark_e_per_s: float = 100.0
    hot_share: float = 0.0
    hot_e: float = 500.0  # mean excess of a hot pixel at the longest exposure, exponentially spread; half of it is there at once
    dsnu_e: tuple[float, float, float] = (1.0, 0.3, 0.3)
    prnu_rel: tuple[float, float, float] = (0.005, 0.001, 0.001)
    shading: float = 0.0  # fall of the light, a bell, from its centre to the first corner
    lamp: tuple[float, float] = (0.0, 0.0)  # centre of that bell, as parts of the frame
    tilt: tuple[float, float] = (0.0, 0.0)  # change of the light over half of the frame, along x and y
    wave_e: float = 0.0  # amplitude of a fixed wave
    bend: str = ""  # "" or one of BENDS
    bend_rel: float = 0.02  # departure from the straight line at the top code
    bits: int = 12
    offset_dn: float = 40.0
    full_well_e: float = np.inf
    shape: tuple[int, int] = (96, 128)
    levels: int = 40
    stack_frames: int = 24
    longest_s: float = 0.02
    over: float = 1.1  # light of the last level, in units of what saturates
    flicker_rel: float = 0.0  # of the light, frame by frame
    setting_rel: float = 0.0  # of the light, level by level
    pixel_area_um2: float = 25.0
    light_swept: bool = False
    take: int = 0  # another set of frames of the same camera

    @property
    def top(self) -> int:
        return 2**self.bits - 1

    def curve(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Stored signal above black, DN, of a linear one, and its first two derivatives; the slope at black is one."""
        span = self.top - self.offset_dn
        w, c = x / span, self.bend_rel
        if self.bend == "quadratic":
            return x * (1 - c * w), 1 - 2 * c * w, np.full_like(w, -2 * c / span)
        if self.bend == "cubic":
            return x * (1 - c * w**2), 1 - 3 * c * w**2, -6 * c * w / span
        if self.bend == "rational":
            return x / (1 + c * w), 1 / (1 + c * w) ** 2, -2 * c / span / (1 + c * w) ** 3
        return x, np.ones_like(w), np.zeros_like(w)

    @cached_property
    def clip_e(self) -> float:
        """Electrons at which the converter clips."""
        x = np.linspace(0, 1.2 * (self.top - self.offset_dn), 20_001)
        return float(np.interp(self.top - self.offset_dn, self.curve(x)[0], x)) / self.gain_dn_per_e

    @cached_property
    def capacity_e(self) -> float:
        return min(self.full_well_e, self.clip_e) - self.dark_e_per_s * self.longest_s

    @cached_property
    def patterns(self) -> dict[str, np.ndarray]:
        """``light`` (mean one) and ``prnu`` make ``response``; ``offset`` (DN) is without ``hot`` (e- at the longest exposure)."""
        rng = np.random.default_rng([self.seed, 1])
        rows, cols = self.shape

        def pattern(parts: tuple[float, float, float]) -> np.ndarray:
            drawn = rng.standard_normal((rows, cols)), rng.standard_normal((rows, 1)), rng.standard_normal((1, cols))
            return sum(part * values for part, values in zip(parts, drawn, strict=True))

        y, x = np.mgrid[0:rows, 0:cols] - np.array([(rows - 1) / 2, (cols - 1) / 2])[:, None, None]
        light = 1.0 + self.tilt[0] * x / (cols / 2) + self.tilt[1] * y / (rows / 2)
        corner2 = (x[0, 0] - cols * self.lamp[0]) ** 2 + (y[0, 0] - rows * self.lamp[1]) ** 2
        away2 = ((x - cols * self.lamp[0]) ** 2 + (y - rows * self.lamp[1]) ** 2) / corner2
        light = light * (1 - self.shading) ** away2  # no polynomial
        prnu, dark = pattern(self.prnu_rel), pattern(self.dsnu_e)
        fx, fy, phase = rng.uniform(0.08, 0.42), rng.uniform(0.08, 0.42), rng.uniform(0, 2 * np.pi)
        dark = dark + self.wave_e * np.sin(2 * np.pi * (fx * x + fy * y) + phase)
        hot = np.where(rng.random((rows, cols)) < self.hot_share, rng.exponential(self.hot_e, (rows, cols)), 0.0)
        light = light / light.mean()
        offset = self.offset_dn + self.gain_dn_per_e * dark
        return {"light": light, "prnu": prnu, "response": light * (1 + prnu), "offset": offset, "hot": hot}

    @cached_property
    def settings(self) -> tuple[np.ndarray, np.ndarray]:
        """Exposure (s) and stated photons per pixel of the bright levels, shape (levels,)."""
        share = np.arange(1, self.levels + 1) / self.levels
        exposure = np.full(self.levels, self.longest_s) if self.light_swept else self.longest_s * share
        return exposure, self.over * self.capacity_e / self.quantum_efficiency * share

    @property
    def dark_exposures_s(self) -> np.ndarray:
        return np.unique(self.settings[0])

    @property
    def stack_level(self) -> int:
        """Level nearest to half of saturation."""
        return int(np.argmin(np.abs(self.settings[1] * self.quantum_efficiency - 0.5 * self.capacity_e)))

    def electrons(self, exposure_s: float, light_e: float) -> np.ndarray:
        """Mean electrons of every pixel."""
        p = self.patterns
        return light_e * p["response"] + self.dark_e_per_s * exposure_s + p["hot"] * 0.5 * (1 + exposure_s / self.longest_s)

    def frames(self, number: int, exposure_s: float, photons: float, stream: int) -> Iterator[np.ndarray]:
        """Take frames; shape (rows, cols), uint8 or uint16."""
        rng = np.random.default_rng([self.seed, 2, stream, self.take])
        rows, cols = self.shape
        light = photons * self.quantum_efficiency * (1 + self.setting_rel * rng.standard_normal())
        for _ in range(number):
            mean = self.electrons(exposure_s, light * (1 + self.flicker_rel * rng.standard_normal()))
            signal = self.curve(self.gain_dn_per_e * np.minimum(rng.poisson(mean), self.full_well_e))[0]
            noise = self.read_e * rng.standard_normal((rows, cols)) + self.row_noise_e * rng.standard_normal((rows, 1))
            noise += self.col_noise_e * rng.standard_normal((1, cols))
            stored = np.rint(self.patterns["offset"] + signal + self.gain_dn_per_e * noise)
            yield np.clip(stored, 0, self.top).astype(np.uint8 if self.bits == 8 else np.uint16)

    def expected(self, exposure_s: float, photons: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Noise-free image, temporal variance of each pixel (without flicker) and its chance to stand at the top code.

        Poisson as normal, the bend to second order, rounding by the harmonics of its error for normal values.
        """
        gain, electrons = self.gain_dn_per_e, self.electrons(exposure_s, photons * self.quantum_efficiency)
        kept, var_e = clipped_normal(electrons, electrons, self.full_well_e)
        f, slope, bent = self.curve(gain * kept)
        mean = self.patterns["offset"] + f + 0.5 * bent * gain**2 * var_e
        var = gain**2 * (slope**2 * var_e + slope * bent * gain * var_e)
        white = gain**2 * (self.read_e**2 + self.row_noise_e**2 + self.col_noise_e**2)
        mean, var = rounded(mean, var, gain * slope, electrons, white)
        at_top = stats.norm.sf((self.top - 0.5 - mean) / np.sqrt(np.maximum(var, 1e-12)))
        return *clipped_normal(mean, var, self.top), at_top


def clipped_normal(mean: np.ndarray, var: np.ndarray, limit: float) -> tuple[np.ndarray, np.ndarray]:
    """Mean and variance of min(x, limit) for a normal x."""
    if not np.isfinite(limit):
        return mean, var
    std = np.sqrt(np.maximum(var, 1e-12))
    c = np.clip((limit - mean) / std, -40, 40)
    below, density = stats.norm.cdf(c), stats.norm.pdf(c)
    first, second = c * (1 - below) - density, below - c * density + c**2 * (1 - below)
    return mean + std * first, np.maximum(var * (second - first**2), 0.0)


def rounded(mean: np.ndarray, var: np.ndarray, gain: np.ndarray, electrons: np.ndarray, white: float) -> tuple[np.ndarray, np.ndarray]:
    """Mean and variance of the rounded sum of a signal of Poisson electrons (mean ``mean``, variance ``var``) and of white noise.

    The rounding error is Σ (−1)ᵏ sin(2πkx)/(πk), its square 1/12 + Σ (−1)ᵏ cos(2πkx)/(πk)²; their expectations, and that of the product
    with x, are the characteristic function of x = a + gain·Poisson(electrons) + N(0, white) and its derivative.
    """
    out_mean, out_var = mean.copy(), var + white + 1 / 12
    near = var + white < 1.5
    if near.any():
        m, g, e = mean[near], gain[near], electrons[near]
        start, error, square, product = m - g * e, np.zeros(m.shape), np.full(m.shape, 1 / 12), np.zeros(m.shape)
        for k in range(1, 80):
            t, sign = 2 * np.pi * k, (-1) ** k
            turn = np.exp(1j * t * g)
            if k > g.max() and np.max(np.exp(e * (turn.real - 1) - 0.5 * t**2 * white)) < 1e-7:
                break
            phi = np.exp(1j * t * start + e * (turn - 1) - 0.5 * t**2 * white)
            error += sign / (np.pi * k) * phi.imag
            square += sign / (np.pi * k) ** 2 * phi.real
            product += sign / (np.pi * k) * (phi * (start + e * g * turn + 1j * t * white)).imag
        out_mean[near] += error
        out_var[near] = np.maximum(var[near] + white + square - error**2 + 2 * (product - m * error), 0.0)
    return out_mean, out_var


def random_camera(seed: int) -> ForeignCamera:
    """A camera of a kind that laboratories bring."""
    rng = np.random.default_rng([seed, 0])
    while True:
        bits = int(rng.choice([8, 10, 12, 14, 16]))
        gain, read = np.exp(rng.uniform(np.log(0.02), np.log(2.0))), np.exp(rng.uniform(0, np.log(15)))
        lines = read * rng.uniform(0.05, 0.4, 2) * (rng.random(2) < 0.4)
        dsnu = read * rng.uniform(0, 1, 3) * np.array([1.0, 0.4, 0.4]) * (rng.random(3) < 0.75)
        wave = read * rng.uniform(0.1, 0.5) * (rng.random() < 0.25) * (gain * read > 0.4)
        black = 7 * gain * np.hypot(np.hypot(read, np.linalg.norm(lines)), np.hypot(np.linalg.norm(dsnu), wave)) + rng.uniform(2, 6)
        capacity = (2**bits - black) / gain
        if 1500 < capacity < 60_000 and capacity > 20 * read**2 and black < 0.15 * 2**bits:
            break
    longest = 10 ** rng.uniform(-3, -0.5)
    hot = rng.random() < 0.5
    return ForeignCamera(
        seed=seed,
        gain_dn_per_e=gain,
        read_e=read,
        row_noise_e=lines[0],
        col_noise_e=lines[1],
        quantum_efficiency=rng.uniform(0.2, 0.8),
        dark_e_per_s=rng.choice([0.0, 1.0]) * rng.uniform(0.1, 1.5) * read**2 / longest,
        hot_share=10 ** rng.uniform(-4, -3) * hot,
        hot_e=capacity * rng.uniform(0.02, 0.2),
        dsnu_e=tuple(dsnu),
        prnu_rel=tuple(rng.uniform(0.1, 1, 3) * np.array([0.01, 0.003, 0.003]) * (rng.random(3) < 0.75)),
        shading=rng.uniform(0, 0.15) * (rng.random() < 0.5),
        lamp=tuple(rng.uniform(-0.2, 0.2, 2)),
        tilt=tuple(rng.uniform(-0.03, 0.03, 2) * (rng.random() < 0.5)),
        wave_e=wave,
        bend=str(rng.choice(BENDS)) if rng.random() < 0.35 else "",
        bits=bits,
        offset_dn=black,
        full_well_e=capacity * rng.uniform(0.75, 0.9) if rng.random() < 0.3 else np.inf,
        shape=[(96, 128), (120, 160), (160, 120)][rng.integers(3)],
        stack_frames=int(rng.integers(16, 33)),
        longest_s=longest,
        over=rng.uniform(1.05, 1.2),
        flicker_rel=rng.uniform(0, 0.0005) * (rng.random() < 0.4),
        setting_rel=rng.uniform(0.0002, 0.002) * (rng.random() < 0.4),
        light_swept=bool(rng.random() < 0.2),
    )
