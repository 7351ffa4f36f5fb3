"""Cameras written without the package: the frames of an EMVA 1288 series in plain NumPy, and what their noise-free images are.

The expectation of a stored number is exact: Poisson electrons and normal noise go through the rounding by their characteristic
function, through the full well and the top code as a normal variable does.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy import stats


@dataclass(frozen=True)
class Camera:
    """One camera, its light and the frames that are to be taken. Patterns are standard deviations (pixel, row, column)."""

    seed: int
    gain_dn_per_e: float = 0.3
    read_e: float = 4.0
    row_noise_e: float = 0.0  # temporal
    quantum_efficiency: float = 0.5
    dark_e_per_s: float = 100.0
    dsnu_e: tuple[float, float, float] = (1.0, 0.3, 0.3)
    prnu_rel: tuple[float, float, float] = (0.005, 0.001, 0.001)
    shading: float = 0.0  # fall of the light from the centre to a corner
    bits: int = 12
    offset_dn: float = 40.0
    full_well_e: float = np.inf
    shape: tuple[int, int] = (96, 128)
    levels: int = 50
    stack_frames: int = 32
    longest_s: float = 0.02
    over: float = 1.1  # light of the last level, in units of what saturates
    light_swept: bool = False  # at constant exposure; else the exposure is swept at constant light
    flicker_rel: float = 0.0  # of the light, frame by frame
    setting_rel: float = 0.0  # of the light, level by level
    pixel_area_um2: float = 25.0

    @property
    def top(self) -> int:
        return 2**self.bits - 1

    @cached_property
    def capacity_e(self) -> float:
        """Electrons of the light at which full well or top code are reached."""
        dark = self.dark_e_per_s * self.longest_s
        return min(self.full_well_e - dark, (self.top - self.offset_dn) / self.gain_dn_per_e - dark)

    @cached_property
    def _patterns(self) -> tuple[np.ndarray, np.ndarray]:
        rng = np.random.default_rng([self.seed, 1])
        rows, cols = self.shape

        def pattern(parts: tuple[float, float, float]) -> np.ndarray:
            drawn = rng.standard_normal((rows, cols)), rng.standard_normal((rows, 1)), rng.standard_normal((1, cols))
            return sum(part * values for part, values in zip(parts, drawn, strict=True))

        y, x = np.mgrid[-1 : 1 : rows * 1j, -1 : 1 : cols * 1j]
        light = 1 - self.shading * (x**2 + y**2) / 2
        return light / light.mean() * (1 + pattern(self.prnu_rel)), self.offset_dn + self.gain_dn_per_e * pattern(self.dsnu_e)

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

    def frames(self, number: int, exposure_s: float, photons: float, stream: int) -> Iterator[np.ndarray]:
        """Take frames; shape (rows, cols), uint16."""
        rng = np.random.default_rng([self.seed, 2, stream])
        response, offset = self._patterns
        rows, cols = self.shape
        light = photons * self.quantum_efficiency * (1 + self.setting_rel * rng.standard_normal())
        for _ in range(number):
            mean = light * (1 + self.flicker_rel * rng.standard_normal()) * response + self.dark_e_per_s * exposure_s
            electrons = np.minimum(rng.poisson(mean), self.full_well_e)
            noise = self.read_e * rng.standard_normal((rows, cols)) + self.row_noise_e * rng.standard_normal((rows, 1))
            stored = np.rint(offset + self.gain_dn_per_e * (electrons + noise))
            yield np.clip(stored, 0, self.top).astype(np.uint16)

    def expected(self, exposure_s: float, photons: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Noise-free image, temporal variance of each pixel (without flicker) and its chance to stand at the top code."""
        response, offset = self._patterns
        electrons = photons * self.quantum_efficiency * response + self.dark_e_per_s * exposure_s
        gain, white = self.gain_dn_per_e, self.gain_dn_per_e**2 * (self.read_e**2 + self.row_noise_e**2)
        kept_e, var_e, full = _clipped(electrons, electrons, self.full_well_e)
        mean, var = offset + gain * kept_e, gain**2 * var_e + white
        if not full:
            shift, var = _rounded(offset, gain, electrons, white)
            mean = mean + shift
        else:
            var = var + 1 / 12
        skew = 0.0 if full else gain**3 * electrons / var**1.5  # of Poisson's electrons; all other noise is normal
        clipped, clipped_var, _ = _clipped(mean, var, self.top, skew)
        c = (self.top - 0.5 - mean) / np.sqrt(var)
        return clipped, clipped_var, stats.norm.sf(c) + skew / 6 * (c**2 - 1) * stats.norm.pdf(c)


def _clipped(mean: np.ndarray, var: np.ndarray, limit: float, skew: np.ndarray | float = 0.0) -> tuple[np.ndarray, np.ndarray, bool]:
    """Mean and variance of min(x, limit) for a nearly normal x (Gram and Charlier's density to the skewness); whether any is cut off."""
    std = np.sqrt(np.maximum(var, 1e-12))
    c = (limit - mean) / std
    if c.min() > 7:
        return mean, var, False
    below, density = stats.norm.cdf(c), stats.norm.pdf(c)
    first = np.where(np.isfinite(c), c, 0.0) * (1 - below) - density  # E[min(z, c)] less 0
    second = below - c * density + c**2 * (1 - below)
    if np.any(skew):  # ∫ (c − z) He₃ φ and ∫ (c² − z²) He₃ φ from c on are −c φ(c) and −2 (c² + 1) φ(c)
        first, second = first - skew / 6 * c * density, second - skew / 3 * (c**2 + 1) * density
    return mean + std * first, np.maximum(var * (second - first**2), 0.0), True


def _rounded(offset: np.ndarray, gain: float, electrons: np.ndarray, white_dn2: float) -> tuple[np.ndarray, np.ndarray]:
    """Shift of the mean, and variance, of the rounded x = offset + gain·Poisson(electrons) + N(0, white); exact.

    The rounding error is Σ (−1)ᵏ sin(2πkx)/(πk), its square 1/12 + Σ (−1)ᵏ cos(2πkx)/(πk)²; their expectations, and that of the
    product with x, are the characteristic function of x and its derivative.
    """
    mean, var = offset + gain * electrons, gain**2 * electrons + white_dn2
    error, square, product = np.zeros_like(mean), np.full_like(mean, 1 / 12), np.zeros_like(mean)
    for k in range(1, 60):
        t, sign = 2 * np.pi * k, (-1) ** k
        turn = np.exp(1j * t * gain)
        white = np.exp(-0.5 * t**2 * white_dn2)
        if white < 1e-9:  # and with each further k the less
            break
        if white * np.exp(electrons.min() * (turn.real - 1)) < 1e-9:  # in photon noise it comes back where k·gain is a whole number
            continue
        phi = np.exp(1j * t * offset + electrons * (turn - 1) - 0.5 * t**2 * white_dn2)
        error += sign / (np.pi * k) * phi.imag
        square += sign / (np.pi * k) ** 2 * phi.real
        product += sign / (np.pi * k) * (phi * (offset + electrons * gain * turn + 1j * t * white_dn2)).imag
    return error, np.maximum(var + square - error**2 + 2 * (product - mean * error), 0.0)


def random_camera(seed: int, small: bool = False) -> Camera:
    """A linear camera, from somewhat more than the range that the standard is made for: it asks for a dark noise of half a code or more."""
    rng = np.random.default_rng([seed, 0])
    shapes = [(48, 64), (64, 48), (64, 80), (72, 96)] if small else [(48, 64), (64, 96), (96, 128), (128, 160), (120, 80)]
    while True:
        gain, read, bits = np.exp(rng.uniform(np.log(0.05), np.log(1.5))), np.exp(rng.uniform(0, np.log(15))), int(rng.integers(8, 17))
        # rows keep their noise through the rounding only where white noise dithers it
        row = read * rng.uniform(0.05, 0.4) * (rng.random() < 0.4) * (gain * read > 0.45)
        dsnu = rng.uniform(0, 1, 3) * np.array([1.5, 0.5, 0.5]) * read * (rng.random(3) < 0.75)
        longest = 10 ** rng.uniform(-3, -0.5)
        dark = rng.choice([0.0, 1.0]) * rng.uniform(0.1, 1.5) * read**2 / longest
        black = 7 * gain * np.hypot(read + row, np.linalg.norm(dsnu)) + 2
        capacity = (2**bits - black) / gain
        if gain * read > 0.2 and 600 < capacity < 60_000 and capacity > 20 * read**2 and black < 0.15 * 2**bits:
            break
    full_well = capacity * rng.uniform(0.75, 0.9) if rng.random() < 0.3 and gain * read > 0.3 else np.inf
    return Camera(
        seed=seed,
        gain_dn_per_e=gain,
        read_e=read,
        row_noise_e=row,
        quantum_efficiency=rng.uniform(0.2, 0.8),
        dark_e_per_s=dark,
        dsnu_e=tuple(dsnu),
        prnu_rel=tuple(rng.uniform(0.1, 1, 3) * np.array([0.01, 0.003, 0.003]) * (rng.random(3) < 0.75)),
        shading=rng.uniform(0, 0.03) * (rng.random() < 0.5),
        bits=bits,
        offset_dn=black,
        full_well_e=full_well,
        shape=shapes[rng.integers(len(shapes))],
        stack_frames=int(rng.integers(16, 25 if small else 51)),
        longest_s=longest,
        over=rng.uniform(1.05, 1.2),
        light_swept=bool(rng.random() < 0.2),
        flicker_rel=rng.uniform(0, 0.0005) * (rng.random() < 0.4),
        setting_rel=rng.uniform(0.0002, 0.002) * (rng.random() < 0.4),
    )
