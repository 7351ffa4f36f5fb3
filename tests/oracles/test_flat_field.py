"""Flat fields of the whole detection chain against its exact law, from darkness to saturation.

The law of a stored code is summed, not drawn: over the pixel's response (Gauss-Hermite), over the electrons (Poisson), and over the codes
between the thresholds of the converter (normal distribution function); full well, both ends of the converter and the rounding are in it as
they are in the camera. So nothing is taken as small, and the rounding is counted once because no term of it is added by hand.

Each level has 2^20 pixels in each of two units. A mean or a variance may lie within 5 standard errors of what is expected; they come from
the exact fourth moment. It fails by chance with 6e-7 a comparison, and catches with 99 % a mean off by 0.5 % of the standard deviation, a
variance off by 0.7 % (of a normal distribution).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
from scipy import special, stats

from pixmetry.camera.camera import Camera, Element
from pixmetry.camera.catalogue import get_source
from pixmetry.scene.uniform import Uniform

SHAPE = (1024, 1024)
UNITS = 2
Z = 5.0
PRNU_NODES, DSNU_NODES = 31, 21  # more than twice as many change no moment by 1e-10 of itself
TAIL = 8.0  # standard deviations up to which normal laws are summed


@dataclass(frozen=True)
class Detector:
    """A detection chain by its numbers."""

    quantum_efficiency: float = 0.6
    prnu_rel: float = 0.01
    dark_e_per_s: float = 300.0
    exposure_s: float = 0.01
    full_well_e: float = 12_000.0
    dsnu_e: float = 1.5
    read_e: float = 2.5
    gain_dn_per_e: float = 0.3
    bits: int = 12
    offset_dn: float = 40.0

    @property
    def dark_e(self) -> float:
        return self.dark_e_per_s * self.exposure_s

    @property
    def top(self) -> int:
        return 2**self.bits - 1

    def camera(self, unit_seed: int) -> Camera:
        chain = (
            ("sensor.quantum_efficiency", {"quantum_efficiency": self.quantum_efficiency}),
            ("sensor.prnu", {"pixel_std_rel": self.prnu_rel}),
            ("sensor.dark_current", {"rate_e_per_s": self.dark_e_per_s}),
            ("sensor.shot_noise", {}),
            ("sensor.full_well", {"full_well_e": self.full_well_e}),
            ("sensor.dsnu", {"pixel_std_e": self.dsnu_e}),
            ("electronics.amplifier_noise", {"white_e": self.read_e}),
            ("electronics.gain", {"gain_dn_per_e": self.gain_dn_per_e}),
            ("grabber.adc", {"bits": self.bits, "offset_dn": self.offset_dn}),
        )
        elements = tuple(Element(name, get_source(name), get_source(name).make(values)) for name, values in chain)
        return Camera("detection", SHAPE, elements, exposure_s=self.exposure_s, unit_seed=unit_seed)


FINE = Detector()
COARSE = Detector(gain_dn_per_e=0.02, bits=8, offset_dn=5.3, dsnu_e=3.0, read_e=4.0)  # noise of 0.1 DN: rounding rules
CLIPPED = Detector(offset_dn=0.0, dark_e_per_s=0.0, full_well_e=14_000.0)  # black at the lowest code, the converter ends before the well
DETECTORS = {"fine": FINE, "coarse": COARSE, "clipped": CLIPPED}
LEVELS_E = (0.0, 0.4, 5.0, 60.0, 1000.0, 8000.0, 11_990.0, 13_600.0, 20_000.0)


def nodes(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Abscissas and weights of the standard normal law (Gauss-Hermite)."""
    x, w = special.roots_hermitenorm(count)
    return x, w / w.sum()


def electrons(detector: Detector, level_e: float, responses: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Numbers of electrons that a pixel may hold, and their probabilities for each response, shape (responses, numbers)."""
    means = level_e * (1 + detector.prnu_rel * responses) + detector.dark_e
    low, high = (int(stats.poisson.ppf(q, m)) for q, m in ((1e-16, means.min()), (1 - 1e-16, means.max())))
    n = np.arange(low, min(high, int(detector.full_well_e)) + 1)
    p = stats.poisson.pmf(n, means[:, None])
    if high >= detector.full_well_e:
        n, p = np.append(n[n < detector.full_well_e], detector.full_well_e), p[:, n < detector.full_well_e]
        p = np.column_stack([p, stats.poisson.sf(np.ceil(detector.full_well_e) - 1, means)])
    return n, p / p.sum(axis=1, keepdims=True)  # SciPy's are good to 1e-11 here


def code_law(detector: Detector, stored_dn: np.ndarray, std_dn: float) -> tuple[np.ndarray, np.ndarray]:
    """Codes and their probabilities for values with normal noise, shape (values, codes): the law between the thresholds k ± 1/2."""
    reach = int(np.ceil(TAIL * std_dn)) + 1
    codes = np.floor(stored_dn + 0.5)[:, None] + np.arange(-reach, reach + 1)
    upper = special.ndtr((codes + 0.5 - stored_dn[:, None]) / std_dn)
    lower = special.ndtr((codes - 0.5 - stored_dn[:, None]) / std_dn)
    return np.clip(codes, 0, detector.top), upper - lower


def in_dn(detector: Detector, n: np.ndarray) -> np.ndarray:
    return detector.gain_dn_per_e * n + detector.offset_dn


def whole_law(detector: Detector, level_e: float) -> np.ndarray:
    """Probability of every code over all pixels of all units, shape (2^bits,)."""
    x, w = nodes(PRNU_NODES)
    n, per_response = electrons(detector, level_e, x)
    std_dn = detector.gain_dn_per_e * np.hypot(detector.dsnu_e, detector.read_e)
    codes, p = code_law(detector, in_dn(detector, n), std_dn)
    p *= (w @ per_response)[:, None]
    return np.bincount(codes.ravel().astype(int), p.ravel(), detector.top + 1)


def temporal_moments(detector: Detector, level_e: float) -> tuple[float, float]:
    """E D²/2 and E D⁴/4 of the difference D of two frames of one pixel, over all pixels: the temporal variance and its scatter.

    Given the pixel both codes have one law: E D² = 2 m₂, E D⁴ = 2 m₄ + 6 m₂² with its central moments.
    """
    x, w = nodes(PRNU_NODES)
    n, per_response = electrons(detector, level_e, x)
    second = fourth = 0.0
    for offset, weight in zip(*nodes(DSNU_NODES), strict=True):
        shifted = in_dn(detector, n) + detector.gain_dn_per_e * detector.dsnu_e * offset
        codes, p = code_law(detector, shifted, detector.gain_dn_per_e * detector.read_e)
        raw = codes - detector.gain_dn_per_e * min(level_e, detector.full_well_e) - detector.offset_dn  # about nearby: no cancellation
        m1, m2, m3, m4 = (per_response @ np.sum(p * raw**power, 1) for power in (1, 2, 3, 4))
        variance = m2 - m1**2
        central = m4 - 4 * m3 * m1 + 6 * m2 * m1**2 - 3 * m1**4
        second += weight * float(w @ variance)
        fourth += weight * float(w @ (2 * central + 6 * variance**2)) / 4
    return second, fourth


def within(variance: float, samples: int) -> float:
    """Five standard errors of a mean of so many samples; the rounding of the sums where nothing scatters."""
    return Z * np.sqrt(max(variance, 0.0) / samples) + 1e-8


@pytest.fixture(params=[(name, level) for name in DETECTORS for level in LEVELS_E], ids=lambda p: f"{p[0]}-{p[1]:g}e")
def case(request, rng: np.random.Generator) -> tuple[Detector, float, list[np.ndarray]]:
    name, level_e = request.param
    detector, seed = DETECTORS[name], int(rng.integers(2**60))
    scene = Uniform(level_e / detector.quantum_efficiency)
    return detector, level_e, [detector.camera(seed + u).expose(scene, 2, seed + u).data for u in range(UNITS)]


def test_stat_flat_field_has_its_exact_law(case) -> None:
    """Mean and variance over the pixels, the frequency of every code, and the temporal variance from pairs of frames."""
    detector, level_e, units = case
    law = whole_law(detector, level_e)
    assert law.sum() == pytest.approx(1, abs=1e-12)
    k = np.arange(len(law))
    mean = law @ k
    variance, fourth = law @ (k - mean) ** 2, law @ (k - mean) ** 4
    pixels = np.concatenate([frames[0].ravel() for frames in units])
    n = pixels.size
    assert n == UNITS * 2**20
    assert abs(pixels.mean() - mean) <= within(variance, n)
    assert abs(((pixels - mean) ** 2).mean() - variance) <= within(fourth - variance**2, n)

    seen, expected = np.bincount(pixels, minlength=len(law)), n * law
    often = expected >= 20
    seen, expected = (np.append(v[often], v[~often].sum()) for v in (seen, expected))
    statistic = np.sum((seen - expected) ** 2 / np.maximum(expected, 20))
    assert stats.chi2.sf(statistic, len(seen)) > 1e-6

    temporal, scatter = temporal_moments(detector, level_e)
    half_squares = np.concatenate([0.5 * (a.astype(float) - b) ** 2 for a, b in units])
    assert abs(half_squares.mean() - temporal) <= within(scatter - temporal**2, n)


@pytest.mark.parametrize("level_e", [0.0, 60.0, 1000.0, 8000.0])
def test_rounding_adds_a_twelfth_once_where_noise_dithers_it(level_e: float) -> None:
    """With 0.75 DN of read noise the exact variance is K²(read² + µ) + 1/12 to 1e-3 DN² (EMVA 1288, linear model)."""
    detector = Detector(prnu_rel=0.0)
    expected = detector.gain_dn_per_e**2 * (detector.read_e**2 + level_e + detector.dark_e) + 1 / 12
    assert temporal_moments(detector, level_e)[0] == pytest.approx(expected, abs=1e-3)


def test_the_law_agrees_with_plain_drawing(rng: np.random.Generator) -> None:
    """The oracle against NumPy's own generators, written without it: a wrong sum would show here. Catches 0.7 % of a variance."""
    detector, level_e, n = CLIPPED, 5.0, 2**21
    response = 1 + detector.prnu_rel * rng.standard_normal(n)
    held = np.minimum(rng.poisson(level_e * response + detector.dark_e), detector.full_well_e)
    noisy = held + rng.normal(0, detector.dsnu_e, n) + rng.normal(0, detector.read_e, n)
    codes = np.clip(np.floor(detector.gain_dn_per_e * noisy + detector.offset_dn + 0.5), 0, detector.top)
    law = whole_law(detector, level_e)
    k = np.arange(len(law))
    mean = law @ k
    variance, fourth = law @ (k - mean) ** 2, law @ (k - mean) ** 4
    assert abs(codes.mean() - mean) < within(variance, n)
    assert abs(((codes - mean) ** 2).mean() - variance) < within(fourth - variance**2, n)
