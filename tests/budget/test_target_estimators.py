"""The estimators of `locate` in a budget: what is propagated is what is run, and both state the same uncertainty."""

from __future__ import annotations

import math

import numpy as np
import pytest

from budget.cameras import camera, element
from pixmetry.budget import compute_budget
from pixmetry.budget.monte_carlo import monte_carlo
from pixmetry.budget.probe import Target, facts_of, make_probe, resolve
from pixmetry.core.errors import InputError
from pixmetry.locate.estimators import AUTO, estimators, methods
from pixmetry.locate.job import locate
from pixmetry.locate.target_estimator import TargetEstimator
from pixmetry.scene.discs import Discs
from pixmetry.scene.uniform import Uniform

SMALL = Target(diameter_px=2.4, blur_px=0.7, peak_rel=0.7)
FAINT = Target(diameter_px=5.0, blur_px=0.9, peak_rel=0.4, background_rel=0.05)


def noisy_camera(prnu: float = 0.0):
    return camera(
        element("sensor.prnu", pixel_std_rel=prnu),
        element("sensor.shot_noise"),
        element("electronics.amplifier_noise", white_e=60.0),
        facts={"bits": 8, "interface": "digital", "sensor": "cmos"},
        adc=True,
        shape=(300, 400),
    )


def frame_of(rng: np.random.Generator, seed: int, cam, facts, target: Target) -> np.ndarray:
    """70 targets, each at a place of its own within the pixel."""
    y, x = (v.ravel() + rng.uniform(-0.5, 0.5, v.size) for v in np.mgrid[30:280:40, 30:400:40])
    scale = facts.saturation_dn / facts.dn_per_photon
    looks = {"diameter_px": target.diameter_px, "blur_px": target.blur_px, "peak_photons": target.peak_rel * scale}
    return cam.expose(Discs(x.tolist(), y.tolist(), **looks, background=Uniform(target.background_rel * scale)), seed=seed).data[0]


@pytest.mark.parametrize(("target", "prnu"), [(Target(), 0.0), (FAINT, 0.01), (SMALL, 0.0)], ids=["7 px", "faint", "2.4 px"])
def test_u_of_the_template_is_the_covariance_that_locate_states(target: Target, prnu: float, seed: int, rng: np.random.Generator) -> None:
    """The same camera and target; locate is told the camera's noise. The median of 140 stated u scatters by 1 %; 5 % is caught."""
    cam = noisy_camera(prnu)
    budget = compute_budget(cam, None, None, target, trials=0)
    assert budget.estimator.name == "template"
    table = locate(frame_of(rng, seed, cam, budget.facts, target), noise=cam)
    assert len(table) == 70 and set(table.columns["estimator"]) == {"template"}
    stated = math.sqrt(np.median(np.r_[table.columns["var_x_px2"], table.columns["var_y_px2"]]))
    assert budget.verdict.total_px == pytest.approx(stated, rel=0.05)


def test_u_of_the_soft_threshold_too(seed: int, rng: np.random.Generator) -> None:
    """What locate states holds the error over the phase: here a row of the budget."""
    cam = noisy_camera()
    facts, law = facts_of(cam, Target()), TargetEstimator("soft_threshold")
    probe = make_probe(facts, Target(), law)
    noise = np.sqrt(facts.noise_dn**2 + facts.gain_dn_per_e * (probe.signal_dn - probe.background_dn))
    phase = np.var(probe.x_hat_px - probe.x_px) + np.var(probe.y_hat_px - probe.y_px)
    u = math.sqrt(0.5 * (sum(v**2 for v in probe.white(noise)) + phase))
    table = locate(frame_of(rng, seed, cam, facts, Target()), noise=cam, estimator="soft_threshold")
    stated = math.sqrt(np.median(np.r_[table.columns["var_x_px2"], table.columns["var_y_px2"]]))
    assert u == pytest.approx(stated, rel=0.05)


@pytest.mark.parametrize("name", [n for n in methods() if n != "perimeter"])
def test_every_estimator_of_locate_can_be_propagated(name: str, seed: int) -> None:
    """White noise of 0.6 DN by the gradient against 600 pairs of windows: 2.9 % of chance, 4.9 of them, and what is not of first order.

    The perimeter jumps from pixel to pixel, and has no gradient worth the name.
    """
    cam = camera(element("electronics.amplifier_noise", white_e=60.0), facts={"saturation_dn": 200.0, "bits": 8})
    target, law = Target(peak_rel=0.75), TargetEstimator(name)
    facts = facts_of(cam, target, {"noise_dn": 0.6})
    got = monte_carlo(cam, target, law, only=["electronics.amplifier_noise"], trials=1200, facts=facts, seed=seed)
    u_x, u_y = make_probe(facts, target, law, phases=2).white(0.6)
    own = 0.15 if name in ("gaussian", "hard_threshold", "ellipse_edges") else 0.03
    assert got.lost == 0
    assert got.x.temporal == pytest.approx(u_x, rel=4.9 / math.sqrt(2 * 600) + own)
    assert got.y.temporal == pytest.approx(u_y, rel=4.9 / math.sqrt(2 * 600) + own)


def test_the_default_is_that_of_locate_and_their_names_are_the_same() -> None:
    assert set(estimators("disc")) == {AUTO, *methods()}
    cam = noisy_camera()
    facts = facts_of(cam, Target())
    assert resolve(TargetEstimator(), Target(), facts).name == "template"
    few = facts_of(cam, Target(), {"gain_dn_per_e": 4.0})  # 30 electrons at the peak
    assert resolve(TargetEstimator(), Target(), few).name == "poisson_gaussian"


def test_a_target_is_where_locate_finds_it(seed: int, rng: np.random.Generator) -> None:
    """The same pixels in `locate`'s hands and in the budget's: the same place to a tenth of its u."""
    cam = noisy_camera()
    facts = facts_of(cam, Target())
    law = resolve(TargetEstimator(), Target(), facts)
    frame = frame_of(rng, seed, cam, facts, Target())
    found = locate(frame, noise=cam)
    at = int(np.argmin(np.hypot(found.columns["x_px"] - 30, found.columns["y_px"] - 30)))
    half = law.window // 2 + 4
    window = frame[30 - half : 31 + half, 30 - half : 31 + half].copy()
    law = law.as_seen(lambda light_dn: light_dn + float(np.median(frame)))
    x, y = law.locate(np.stack([window, window]))
    assert abs(x[0] - x[1]) + abs(y[0] - y[1]) < 1e-9
    u = math.sqrt(found.columns["var_x_px2"][at])
    assert abs(x[0] + 30 - half - found.columns["x_px"][at]) < 0.1 * u
    assert abs(y[0] + 30 - half - found.columns["y_px"][at]) < 0.1 * u


def test_an_estimator_without_a_target_and_a_window_too_small_are_refused() -> None:
    with pytest.raises(InputError, match="needs a target"):
        TargetEstimator().locate(np.zeros((1, 40, 40)))
    facts = facts_of(noisy_camera(), Target())
    with pytest.raises(InputError, match="fit"):
        resolve(TargetEstimator(), Target(), facts).locate(np.zeros((1, 12, 40)))
    with pytest.raises(InputError, match="estimator"):
        TargetEstimator("median")
