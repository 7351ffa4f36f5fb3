"""Motion blur: the length, the centre and the profile of the exposure."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import quad

from catalogue.support import Flat
from pixmetry.sources.sensor.exposure import SOURCE, Exposure, rule, truth
from source_signals import flat, stream
from sources.sensor.moving_scenes import Spot, chain, moments

PROFILES = {
    "box": lambda t: 1.0,
    "trapezoid": lambda t: min(1.0, t / 0.3, (1 - t) / 0.3),
    "exponential": lambda t: np.exp(-t / 0.15),
    "gaussian": lambda t: np.exp(-0.5 * ((t - 0.5) / 0.12) ** 2),
}


def params(profile: str, nodes: int) -> Exposure:
    return Exposure(profile=profile, nodes=nodes, ramp_rel=0.3, decay_rel=0.15, width_rel=0.12)


@pytest.mark.parametrize("profile", PROFILES)
@pytest.mark.parametrize("nodes", [1, 2, 5, 12])
def test_nodes_give_the_moments_of_the_profile(profile: str, nodes: int) -> None:
    """A Gauss rule of m nodes is exact up to the power 2m − 1; the moments by adaptive quadrature."""
    times, weights = rule(params(profile, nodes))
    assert (times > 0).all() and (times < 1).all() and (weights > 0).all()

    def moment(power: int) -> float:
        return quad(lambda t: PROFILES[profile](t) * t**power, 0, 1, points=[0.3, 0.5, 0.7], epsabs=1e-13, epsrel=1e-12)[0]

    for power in range(2 * nodes):
        assert weights @ times**power == pytest.approx(moment(power) / moment(0), rel=2e-9)


def test_fifty_pixels_per_second_for_20_ms_blur_by_one_pixel_along_the_motion_only() -> None:
    """A box of length b adds b²/12 to the variance along the motion, and the centre is that of the middle."""
    camera = chain((SOURCE, Exposure(nodes=5)), exposure_s=0.02)
    blurred = moments(camera.expose(Spot(20.0, 15.2, 50.0)).data[0])
    still = moments(camera.expose(Spot(20.0, 15.2)).data[0])
    assert blurred[2] - still[2] == pytest.approx(1 / 12, abs=2e-5)
    assert blurred[3] - still[3] == pytest.approx(0, abs=2e-5)
    assert blurred[0] - 20.0 == pytest.approx(0.5, abs=2e-5)
    assert blurred[1] == pytest.approx(15.2, abs=2e-5)


def test_acceleration_moves_the_centre_by_a_24th_of_a_t_squared() -> None:
    camera = chain((SOURCE, Exposure(nodes=4)), exposure_s=0.1)
    a, t = 300.0, 0.1
    x = moments(camera.expose(Spot(20.0, 15.0, 0.0, a)).data[0])[0]
    assert x - (20.0 + 0.5 * a * (t / 2) ** 2) == pytest.approx(0.5 * a * t**2 / 12, abs=1e-4)


@pytest.mark.parametrize("profile", ["exponential", "trapezoid"])
def test_the_centre_belongs_to_the_mean_time_of_the_profile(profile: str, rng: np.random.Generator) -> None:
    chosen = params(profile, 6)
    x = moments(chain((SOURCE, chosen), exposure_s=0.02).expose(Spot(20.0, 15.0, 100.0)).data[0])[0]
    told = truth(chosen, flat(0, (4, 4), exposure_s=0.02), stream(rng))
    mean, second = (
        quad(lambda t, k=k: PROFILES[profile](t) * t**k, 0, 1, points=[0.3, 0.7])[0] / quad(PROFILES[profile], 0, 1, points=[0.3, 0.7])[0]
        for k in (1, 2)
    )
    assert told["mean_time_s"] == pytest.approx(0.02 * mean, rel=1e-6)
    assert told["spread_s"] == pytest.approx(0.02 * np.sqrt(second - mean**2), rel=1e-6)
    assert x == pytest.approx(20.0 + 100.0 * 0.02 * mean, abs=1e-4)


def test_nodes_converge_to_the_blurred_profile() -> None:
    """A blur four times as long as the spot is wide: nine looks agree with 40 to 1e-3 of the peak, and light is kept."""
    images = [chain((SOURCE, Exposure(nodes=n)), exposure_s=0.02).expose(Spot(20.0, 15.0, 300.0)).data[0] for n in (9, 40)]
    assert np.abs(images[0] - images[1]).max() < 1e-3 * images[1].max()
    assert images[0].sum() == pytest.approx(images[1].sum(), rel=1e-6)


def test_a_scene_that_stands_still_is_left_bit_for_bit() -> None:
    camera = chain((SOURCE, Exposure(nodes=5)))
    assert np.array_equal(camera.expose(Flat(30.0)).data, camera.switched(off=[SOURCE.id]).expose(Flat(30.0)).data)
