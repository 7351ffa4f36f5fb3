"""Gamma: the curve against published points and roots, Poisson noise through a square root, the S-curve, and the exponent found again."""

from __future__ import annotations

import re

import numpy as np
import pytest
from scipy.stats import t as student

from pixmetry.core.errors import InputError, MeasureError
from pixmetry.core.observations import LevelMoments, Observations, PhotonTransfer
from pixmetry.core.signal import Kind
from pixmetry.electronics.gamma import SOURCE, Gamma
from pixmetry.sensor.shot_noise import SOURCE as SHOT
from source_signals import ALPHA, K_DN_PER_E, Z, centroid_probe, flat, signal, spots, stream

TV = Gamma(gamma=0.45, reference_dn=1000.0)
ROOT = Gamma(gamma=0.5, reference_dn=1000.0)


def bent(params: Gamma, x) -> np.ndarray:
    return SOURCE.forward(params, signal(np.reshape(x, (1, 1, -1)), Kind.DN), stream()).data[0, 0].astype(float)


def test_doubling_steps_keep_their_ratio_and_the_ends_stay():
    """0.45 is 9/20: twenty halvings of the light are nine of the signal."""
    assert bent(TV, [1000, 1000 / 2**20, 1000 * 2**20, 0]) == pytest.approx([1000, 1000 / 2**9, 1000 * 2**9, 0], rel=1e-6)


def test_published_point_of_bt_709():
    """ITU-R BT.709-6, item 1.2: 1.099 L^0.45 − 0.099 meets 4.5 L at L = 0.018, as far as its three digits go."""
    assert bent(TV, [18.0])[0] / 1000 == pytest.approx((4.5 * 0.018 + 0.099) / 1.099, rel=3e-3)


def test_a_gamma_of_one_half_is_a_square_root_and_odd_about_black():
    x = np.random.default_rng().uniform(0, 3000, 500)
    assert bent(ROOT, x) == pytest.approx(np.sqrt(1000 * x), rel=1e-5)
    assert np.array_equal(bent(TV, -x), -bent(TV, x))


def test_inverse_restores_the_light_on_both_sides_of_black():
    x = np.random.default_rng().uniform(-300, 2500, (2, 50, 60))
    frame = signal(x, Kind.DN)
    back = SOURCE.correct(TV, SOURCE.forward(TV, frame, stream()), {})
    assert back.data.dtype == np.float32
    assert np.abs(back.data - frame.data).max() < 5e-3  # 1/γ times some steps of float32 at 2500 DN


def test_poisson_noise_behind_a_square_root_is_the_same_at_any_level():
    """Anscombe (1948): Var √N = ¼(1 + 3/(8µ)), so σ² = K f/4. Fails at 1e-6 by chance; finds an error of 2 % in the variance."""
    for electrons in (1000.0, 20000.0):
        shot = SHOT.forward(SHOT.typical, flat(electrons, (500, 500)), stream())
        out = SOURCE.forward(ROOT, shot.with_data(shot.data * np.float32(K_DN_PER_E), Kind.DN), stream()).data.astype(float)
        expected = K_DN_PER_E * 1000 / 4 * (1 + 3 / (8 * electrons))
        assert abs(out.var() / expected - 1) < Z * np.sqrt(2 / out.size) + 1 / electrons**2


def test_s_curve_is_that_of_a_wider_spot():
    """A Gaussian to the power γ has σ/√γ; sampled at points, its centroid is off by 4πσ² exp(−2π²σ²) sin 2πc (Poisson summation)."""
    sigma, x = 0.5, 12 + np.linspace(-0.5, 0.5, 16, endpoint=False)

    def amplitude(s: float) -> float:
        return 4 * np.pi * s**2 * np.exp(-2 * np.pi**2 * s**2)

    got = SOURCE.propagate(ROOT, centroid_probe(spots(x, np.full(16, 12.0), sigma=sigma), x, np.full(16, 12.0)))
    assert got.u_x_px == pytest.approx((amplitude(sigma) - amplitude(sigma / np.sqrt(0.5))) / np.sqrt(2), rel=1e-3)
    assert abs(got.bias_x_px) < 1e-6 and got.u_y_px < 1e-6


def test_a_brighter_target_or_another_full_scale_does_not_matter():
    x, y = 12 + np.linspace(-0.5, 0.5, 16, endpoint=False), np.full(16, 12.2)
    image = spots(x, y, sigma=0.6)
    here = SOURCE.propagate(TV, centroid_probe(image, x, y)).total_px
    assert here > 1e-4
    assert SOURCE.propagate(TV, centroid_probe(10 * image, x, y)).total_px == pytest.approx(here, rel=1e-9)
    assert SOURCE.propagate(Gamma(gamma=0.45), centroid_probe(image, x, y)).total_px == pytest.approx(here, rel=1e-9)


def test_a_target_that_the_estimator_does_not_see_does_not_move():
    x = np.full(2, 12.0)
    probe = centroid_probe(spots(x, x), x, x)
    blind = type(probe)(**{**probe.__dict__, "gx": 0 * probe.gx, "gy": 0 * probe.gy})
    assert SOURCE.propagate(TV, blind).total_px == 0


def series(params: Gamma, levels: int = 20, light=None, photons: bool = False) -> Observations:
    """Pairs of frames of 64 × 64 pixels: shot noise, noise and dark signal before the curve, black at 400 DN, 12 bits."""
    light = np.arange(1, levels + 1) / levels if light is None else np.asarray(light)
    rng = np.random.default_rng()

    def mean_dn(part: float) -> float:
        electrons = SHOT.forward(SHOT.typical, flat(part * params.reference_dn / K_DN_PER_E, (64, 64), n=2), stream())
        x = electrons.data * K_DN_PER_E + 0.05 + 0.1 * rng.standard_normal(electrons.data.shape)
        y = SOURCE.forward(params, signal(x, Kind.DN), stream()).data.astype(float)
        return float(np.clip(np.rint(y + 400), 0, 4095).mean())

    def moments(parts: np.ndarray) -> LevelMoments:
        nothing = {name: np.zeros(len(parts)) for name in LevelMoments.__dataclass_fields__}
        means = np.array([mean_dn(p) for p in parts])
        times = np.full(len(parts), 0.01) if photons else 0.02 * light
        return LevelMoments(**nothing | {"exposure_s": times, "photons": 1e4 * parts if photons else None, "mean_dn": means})

    return Observations(photon_transfer=PhotonTransfer(moments(light), moments(0 * light), (64, 64), 12))


@pytest.mark.parametrize("photons", [False, True])
@pytest.mark.parametrize("gamma", [0.45, 0.7, 1.0])
def test_exponent_is_found_again(gamma, photons):
    """Within its own u, by Student's t at 1e-6; u is small enough to tell the two settings apart, and no error above 0.1 would pass."""
    got = SOURCE.measure(series(Gamma(gamma=gamma, reference_dn=3600.0), photons=photons))["gamma"]
    assert got.unit == "1"
    assert got.u < 0.02
    assert abs(got.value - gamma) < min(student.isf(ALPHA / 2, got.dof) * got.u, 0.1)
    assert SOURCE.make({"gamma": got.value})


def test_a_linear_camera_with_a_bend_is_measured_as_linear_and_says_so():
    """2 % of non-linearity belong to another source: the value is exactly 1, and the difference is in its u."""
    clean = series(Gamma(reference_dn=3600.0)).photon_transfer
    above = clean.bright.mean_dn - 400
    curved = LevelMoments(**{**clean.bright.__dict__, "mean_dn": 400 + above * (1 - 0.02 * above / 3600)})
    got = SOURCE.measure(Observations(photon_transfer=PhotonTransfer(curved, clean.dark, (64, 64), 12)))["gamma"]
    found = float(re.search(r"exponent of ([\d.]+):", got.reason)[1])
    assert got.value == 1 and 0.95 < found < 0.99
    assert 1 - found < got.u < 0.1


def test_series_that_do_not_tell_are_refused_with_a_remedy():
    for observed in (
        Observations(),
        series(TV, levels=4),
        series(TV, light=np.linspace(0.5, 0.51, 20)),
    ):
        with pytest.raises(MeasureError, match="light levels"):
            SOURCE.measure(observed)


def test_light_that_does_not_go_with_the_exposure_is_refused():
    """Light as the square of the exposure makes an exponent of 2."""
    parts = np.linspace(0.2, 1, 20)
    transfer = series(Gamma(reference_dn=3600.0), light=parts**2).photon_transfer
    bright = LevelMoments(**{**transfer.bright.__dict__, "exposure_s": parts})
    with pytest.raises(MeasureError, match="no curve"):
        SOURCE.measure(Observations(photon_transfer=PhotonTransfer(bright, transfer.dark, (64, 64), 12)))


@pytest.mark.parametrize("values", [{"gamma": 0.2}, {"gamma": 1.1}, {"reference_dn": 0}])
def test_settings_that_no_camera_has_are_refused(values):
    with pytest.raises(InputError):
        SOURCE.make(values)
