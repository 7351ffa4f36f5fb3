"""Cameras that are not linear at all, logarithmic or with gamma: General's values against closed forms, and no Linear ones.

The closed forms are error propagation on the noise-free response y = f(N) of the electrons N: σ_y² = f'(N)²(N + σ_e²) + σ_out² + 1/12,
σ_p = σ_y/(η f'(N)), SNR_p = p/σ_p.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import pytest

from chance import rng_of
from emva.cameras import Camera
from emva.scoring import measured
from pixmetry.emva.evaluate import evaluate
from pixmetry.emva.files.keys import KEYS
from pixmetry.emva.linear_model import CURVED, REASON, is_curved, linear_model
from pixmetry.emva.records import RELEASES, Results
from pixmetry.emva.series import series_of

LEVEL_FREE = {"index_start", "sigma_y_dark", "DSNU1288_DN"}  # and the dark current, which a light sweep does not show
Curve = Callable[[np.ndarray], np.ndarray]


@dataclass(frozen=True)
class CurvedCamera(Camera):
    """A camera whose stored signal is a curve of its electrons, with white noise before (``read_e``) and after it."""

    curve: Curve = np.log1p
    out_dn: float = 2.0
    response_rel: float = 0.01  # pattern of the pixels' sensitivities
    brightest: float = 20_000.0  # photons

    @cached_property
    def settings(self) -> tuple[np.ndarray, np.ndarray]:
        share = np.arange(1, self.levels + 1) / self.levels
        return np.full(self.levels, 0.01), self.brightest * share

    @property
    def stack_level(self) -> int:
        return self.levels // 2

    def frames(self, number: int, exposure_s: float, photons: float, stream: int) -> Iterator[np.ndarray]:
        rng = np.random.default_rng([self.seed, 2, stream])
        response = 1 + self.response_rel * np.random.default_rng([self.seed, 1]).standard_normal(self.shape)
        for _ in range(number):
            gathered = rng.poisson(np.maximum(photons * self.quantum_efficiency * response, 0.0))
            electrons = np.minimum(gathered + self.read_e * rng.standard_normal(self.shape), self.full_well_e)
            stored = self.offset_dn + self.curve(electrons) + self.out_dn * rng.standard_normal(self.shape)
            yield np.clip(np.rint(stored), 0, self.top).astype(np.uint16)

    def snr(self, photons: np.ndarray) -> np.ndarray:
        """Signal-to-noise ratio at the input, by error propagation."""
        n, h = photons * self.quantum_efficiency, 1e-3
        slope = (self.curve(n * (1 + h)) - self.curve(n * (1 - h))) / (2 * h * n)
        sigma = np.sqrt(slope**2 * (n + self.read_e**2) + self.out_dn**2 + 1 / 12)
        return photons * self.quantum_efficiency * slope / sigma


def log_curve(electrons: np.ndarray) -> np.ndarray:
    return 160.0 * np.log1p(np.maximum(electrons, 0.0) / 200.0)


def gamma_curve(electrons: np.ndarray) -> np.ndarray:
    return np.copysign(4000.0 * np.abs(electrons / 12_000.0) ** 0.45, electrons)


def bent_curve(electrons: np.ndarray) -> np.ndarray:
    return 0.3 * electrons * (1 - 0.1 * electrons / 12_000.0)


def straight_curve(electrons: np.ndarray) -> np.ndarray:
    return 0.3 * electrons


COMMON = {"shape": (120, 160), "levels": 24, "stack_frames": 16, "read_e": 0.0, "quantum_efficiency": 0.5}
LOG = CurvedCamera(seed=1, curve=log_curve, offset_dn=100.0, out_dn=1.0, **COMMON)
GAMMA = CurvedCamera(seed=2, curve=gamma_curve, offset_dn=60.0, full_well_e=9000.0, **COMMON)


def fresh(rng: np.random.Generator, camera: CurvedCamera) -> CurvedCamera:
    return replace(camera, seed=int(rng.integers(2**31)))


def sheet(camera: Camera, release: str = "4.0") -> Results:
    """A data sheet, made without a single warning."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        return evaluate(measured(camera), release, draws=500)


@pytest.fixture(scope="module")
def sheets(request: pytest.FixtureRequest) -> dict[str, tuple[CurvedCamera, Results]]:
    rng = rng_of(request)
    cameras = {"log": fresh(rng, LOG), "gamma": fresh(rng, GAMMA)}
    return {name: (camera, sheet(camera)) for name, camera in cameras.items()}


@pytest.mark.parametrize("name", ["log", "gamma"])
def test_linear_values_are_missing_with_the_reason_and_the_rest_is_there(sheets: dict, name: str) -> None:
    values, notes = sheets[name][1].values, sheets[name][1].notes
    for key in filter(KEYS.get, values):
        free = key in LEVEL_FREE or KEYS[key].section == "general" or key.startswith(("s_2_y", "sigma_2_y"))
        if free:
            assert math.isfinite(values[key].value), key
        elif key != "u_I_mean_DN":
            assert math.isnan(values[key].value) and values[key].reason == REASON, key
    assert REASON in notes and linear_model(sheets[name][1]) == CURVED


@pytest.mark.parametrize("name", ["log", "gamma"])
def test_general_agrees_with_error_propagation(sheets: dict, name: str) -> None:
    """6 u and 1 % for the curve's stiffness: a false failure is rarer than 1e-6; the mean over the levels catches a slope off by 5 %."""
    camera, result = sheets[name]
    values, curve = result.values, result.curves["general"]
    top = camera.brightest if name == "log" else 9000.0 / camera.quantum_efficiency
    largest, got = float(camera.snr(curve["photons"]).max()), values["general_SNR_max"]
    shown = got.value + (1.6449 * got.u if got.is_lower_limit else 0.0)
    assert abs(shown - largest) < 6 * got.u + 0.01 * largest
    assert got.u < 0.06 * largest  # 3.1 % ± 0.3 %
    assert got.is_lower_limit == (name == "log")
    middle = slice(3, -3)
    np.testing.assert_allclose(curve["snr_p"][middle], camera.snr(curve["photons"][middle]), rtol=0.25)
    np.testing.assert_allclose(np.mean(curve["snr_p"][middle] / camera.snr(curve["photons"][middle])), 1, atol=0.05)
    saturation = values["general_u_p_sat"]
    if name == "log":
        assert saturation.is_lower_limit and saturation.value == pytest.approx(top)
    else:
        # the last level before the 1.25 % of the pixels that shot noise takes to the full well
        least = top - 2.24 * math.sqrt(9000.0 + (0.01 * 9000.0) ** 2) / camera.quantum_efficiency
        assert least - 1.5 * camera.brightest / camera.levels < saturation.value < top
    pattern = values["general_PRNU"]
    assert abs(pattern.value - 1.0) < 6 * pattern.u + 0.05


@pytest.mark.parametrize("name", ["log", "gamma"])
def test_a_threshold_far_below_the_darkest_level_is_an_upper_limit(sheets: dict, name: str) -> None:
    camera, result = sheets[name]
    light = np.geomspace(1e-2, 1e3, 4000)
    true = float(light[np.argmax(camera.snr(light) >= 1)])
    limit, ratio = result.values["general_u_p_min"], result.values["general_DR"]
    assert limit.is_upper_limit and "darkest level" in limit.reason and true < limit.value < result.curves["general"]["photons"][0]
    assert ratio.is_lower_limit and ratio.value < result.values["general_u_p_sat"].value / true


@pytest.mark.parametrize("release", RELEASES)
def test_every_release_says_so(release: str, rng: np.random.Generator) -> None:
    values = sheet(fresh(rng, LOG), release).values
    assert math.isnan(values["K"].value) and values["K"].reason == REASON
    assert values["sigma_y_dark"].value == pytest.approx(math.sqrt(1 + 1 / 12), rel=0.05)


def test_linear_and_gently_bent_cameras_are_not_taken_for_curved(rng: np.random.Generator) -> None:
    """A bend of 10 % leaves the variance growing; 20 cameras of each kind, dim and noisy ones too."""
    taken = 0
    for seed in rng.integers(2**31, size=20):
        for curve, brightest, read in ((straight_curve, 26_000.0, 5.0), (bent_curve, 20_000.0, 5.0), (straight_curve, 100.0, 20.0)):
            camera = CurvedCamera(
                seed=int(seed), curve=curve, brightest=brightest, **{**COMMON, "read_e": read, "shape": (24, 32), "levels": 10}
            )
            taken += is_curved(series_of(measured(camera)))
    assert taken <= 4  # of 60 with a chance of 1e-3 each, more are rarer than 1e-6
    assert is_curved(series_of(measured(fresh(rng, LOG)))) and is_curved(series_of(measured(fresh(rng, GAMMA))))
