"""The digital twin of cameras that we simulate: its values are the camera's, its maps have the camera's spread and follow the true ones."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.special import ndtr

from chance import rng_of
from pixmetry.assess.digital_twin import _with_true_black, best_values, digital_twin, of_unit
from pixmetry.assess.job import assess, by_the_standard, measure_sources
from pixmetry.assess.page.measured import twin_sentence
from pixmetry.assess.self_test import expose, exposures_of, fewer, middle_window, self_test
from pixmetry.camera.camera import Camera, Element
from pixmetry.camera.catalogue import get_source
from pixmetry.camera.observations import Observations
from pixmetry.files.in_memory import Frames, campaign_of_arrays
from pixmetry.files.records import CameraFacts, Campaign, FrameGroup, OpticsFacts
from pixmetry.observe.converter_bend import converter_bend
from pixmetry.observe.observe import observe
from pixmetry.sources.grabber.adc import bend, thresholds

SHAPE = (120, 160)
LEVELS, LONGEST_S, BRIGHTEST_PHOTONS, STACK = 20, 0.02, 60_000.0, 32
# Some 25 values of two series of one camera: a difference beyond 6 u for any of them happens once in 1e7 if u is right, and once in 1e6 if
# it is 4 % too small. A value that is off by 8 u is found with 98 %.
FAR_U = 6.0
PRNU_REL, DSNU_E = 0.006, 6.0

CHAIN: dict[str, dict] = {
    "optics.shading": {"gradient_y_per_px": 2e-4, "corner_rel": 0.05},
    "sensor.prnu": {"pixel_std_rel": PRNU_REL, "row_std_rel": 0.001, "col_std_rel": 0.002},
    "sensor.quantum_efficiency": {"quantum_efficiency": 0.6},
    "sensor.defects": {"hot_fraction": 1e-3, "hot_median_e": 800.0, "dead_fraction": 5e-4, "noisy_fraction": 5e-4, "cold_fraction": 2e-4},
    "sensor.dark_current": {"rate_e_per_s": 200.0},
    "sensor.shot_noise": {},
    "sensor.full_well": {"full_well_e": 30_000.0},
    "sensor.dsnu": {"pixel_std_e": DSNU_E, "row_std_e": 0.5, "col_std_e": 2.0},
    "electronics.amplifier_noise": {"white_e": 12.0},
    "electronics.row_noise": {"row_e": 2.0},
    "electronics.gain": {"gain_dn_per_e": 0.1},
    "electronics.nonlinearity": {"a2": -0.01, "reference_dn": 4095.0},
    "grabber.phase_pattern": {"amplitude_dn": 0.4, "moving": False},
    "grabber.adc": {"bits": 12, "offset_dn": 30.0, "dnl_std_lsb": 0.05},
}


def camera(seed: int, **changes: dict) -> Camera:
    """A camera; of the chain above with some parameters changed."""
    chain = {name: values | changes.get(name.replace(".", "_"), {}) for name, values in CHAIN.items()}
    elements = (Element(name, get_source(name), get_source(name).make(values)) for name, values in chain.items())
    return Camera("simulated", SHAPE, tuple(elements), unit_seed=seed + 1)


def campaign(bits: int = 12, photons: bool = True, stacks: tuple[str, ...] = ("dark", "bright")) -> tuple[Campaign, list[float]]:
    """A campaign without files, and the light of its groups."""
    groups = []

    def add(kind: str, share: float, count: int, role: str) -> None:
        paths = tuple(Path(f"{len(groups)}-{i}") for i in range(count))
        groups.append(FrameGroup(kind, share * LONGEST_S, share * BRIGHTEST_PHOTONS if kind == "bright" else 0.0, paths, role))

    for k in range(1, LEVELS + 1):
        for kind in ("dark", "bright"):
            add(kind, k / LEVELS, 2, "level")
    for kind in stacks:
        add(kind, 0.4, STACK, "stack")
    light = [g.photons for g in groups]
    if not photons:
        groups = [replace(g, photons=None) if g.kind == "bright" else g for g in groups]
    facts = CameraFacts("simulated", bits, sensor="cmos")
    return Campaign(facts, OpticsFacts(), tuple(groups), SHAPE, "uint16", Path("campaign.yaml")), light


def assessed(seed: int, real: Camera, frames: Campaign, light: list[float]) -> tuple[Observations, Camera]:
    """Observations of the campaign, and the twin."""
    seen = observe(expose(real, exposures_of(frames), light, seed), frames.bits)
    return seen, of_unit(digital_twin(frames, measure_sources(seen)[0], seen), seen)


@pytest.fixture(scope="module")
def both(request: pytest.FixtureRequest) -> tuple[Camera, Campaign, Observations, Camera]:
    seed = int(rng_of(request).integers(2**31))
    real = camera(seed)
    frames, light = campaign()
    return real, frames, *assessed(seed, real, frames, light)


def test_the_twin_has_the_values_of_the_camera(both, seed: int) -> None:
    _, frames, seen, twin = both
    tested = self_test(twin, frames, seen, by_the_standard(frames, seen), seed=seed + 1)
    assert len(tested.rows) >= 20 and tested.frames == tested.of == frames.frame_count
    assert abs(tested.worst.difference_u) < FAR_U, tested.worst
    assert "agree within" in twin_sentence(tested) or abs(tested.worst.difference_u) > 3


def test_a_twin_that_is_another_camera_is_found_out(both, seed: int) -> None:
    """A noise of 10 % more, and a pattern of the type in place of the unit's: the row and column patterns are other draws."""
    _, frames, seen, twin = both
    standard = by_the_standard(frames, seen)
    louder = twin.with_parameters("electronics.amplifier_noise", white_e=1.1 * twin["electronics.amplifier_noise"].params.white_e)
    far = {r.name for r in self_test(louder, frames, seen, standard, seed=seed + 1).rows if abs(r.difference_u) > FAR_U}
    assert {"sigma_2_y_stack_dark", "sigma_y_dark"} <= far
    paler = twin.with_parameters("sensor.prnu", pixel_std_rel=0.8 * PRNU_REL)
    assert "PRNU1288" in {r.name for r in self_test(paler, frames, seen, standard, seed=seed + 1).rows if abs(r.difference_u) > FAR_U}


@pytest.mark.parametrize(("source", "name"), [("sensor.prnu", "response_dev_rel"), ("sensor.dsnu", "offset_e")])
def test_maps_have_the_spread_of_the_camera_and_follow_its_pattern(both, source, name) -> None:
    """Spread by pixels as the true map's, and a correlation with it of √(s²/(s² + t/L)): both to 6 standard errors (once in 1e9).

    Of n pixels a variance is known to √(2/n) of itself, here to 1 %, and the correlation better. The measured map itself would be too wide
    by t/L: 8 % and 6 % in its standard deviation.
    """
    real, _, seen, twin = both
    told = real.truth(0)[source]
    true = (told["prnu_rel"] - 1 if source == "sensor.prnu" else told["dsnu_e"]).astype(float)
    found = twin[source].maps[name].astype(float)
    good = ~seen.defects.mask()

    def pixels(image: np.ndarray) -> np.ndarray:
        filled = np.where(good, image, image[good].mean())
        left = filled - filled.mean(axis=0) - filled.mean(axis=1)[:, None] + filled.mean()
        return left[good]

    one, other = pixels(true), pixels(found)
    tolerance = 6 * np.sqrt(2 / good.sum())
    assert other.var() / one.var() == pytest.approx(1, abs=1.5 * tolerance)  # the share of the noise is estimated too
    stack = seen.bright_stack if source == "sensor.prnu" else seen.dark_stack
    gain = seen.photon_transfer_fit["gain_dn_per_e"].value
    temporal = stack.ms_pixel_dn2 / STACK
    if source == "sensor.prnu":
        light = seen.bright_stack.mean_dn - seen.dark_stack.mean_dn
        temporal = (temporal + seen.dark_stack.ms_pixel_dn2 / STACK) / light**2
    else:
        temporal /= gain**2
    expected = np.sqrt(one.var() / (one.var() + temporal))
    assert np.corrcoef(one, other)[0, 1] == pytest.approx(expected, abs=0.02)


def test_fixed_waves_stand_where_they_stood(both) -> None:
    """Phase to 6 times √2 σ/(A √N), σ the noise of the mean map: about 0.01 turns."""
    real, _, seen, twin = both
    (turns,) = twin["grabber.phase_pattern"].maps["phase_turns"]
    true = float(real.streams(0).of("grabber.phase_pattern").uniform_unit(1)[0])
    found = twin["grabber.phase_pattern"].params
    # the wave in the middle of the frame, where phase and frequency are not correlated
    middle = (SHAPE[1] - 1) / 2, (SHAPE[0] - 1) / 2
    shift = (found.frequency_x - 0.11) * middle[0] + (found.frequency_y - 0.07) * middle[1]
    off = (turns + shift - true + 0.5) % 1 - 0.5
    sigma = np.sqrt(np.var(seen.dark_stack.mean_map_dn))
    assert abs(off) < 6 * np.sqrt(2 / seen.dark_stack.mean_map_dn.size) * sigma / 0.4 / (2 * np.pi) + 1e-3, off


def test_code_widths_are_those_of_the_converter(both) -> None:
    """Over the tested codes: the correlation of true and measured widths is that of the counts, and their scatter is the true one.

    With widths that scatter by s and counts that tell each to u, it is √(s²/(s² + u²)); of a thousand codes it is known to 0.03.
    """
    real, _, seen, twin = both
    params, stream = real["grabber.adc"].params, real.streams(0).of("grabber.adc")
    codes = seen.code_errors.codes
    true = np.diff(thresholds(params, stream))[codes - 1] - 1
    found = np.diff(twin["grabber.adc"].maps["threshold_lsb"])[codes - 1]
    u = np.sqrt(np.mean(seen.code_errors.u_dnl_lsb**2))
    expected = np.sqrt(true.var() / (true.var() + u**2))
    assert np.corrcoef(true, found)[0, 1] > expected - 6 / np.sqrt(codes.size), expected
    assert found.std() == pytest.approx(true.std(), rel=0.25)


def test_uneven_codes_do_not_move_what_is_stored_of_black(both, rng: np.random.Generator) -> None:
    """The measured black level is that of equal steps. With thresholds of its own at black the twin stores the same mean of the stack.

    The mean of the normal values about the stack's pixels is computed for both kinds of steps; without the shift they differ by 0.1 DN.
    """
    _, _, seen, twin = both
    dark = replace(seen.dark_stack, ms_pixel_dn2=0.7)
    moved = 0.3 * rng.standard_normal(4095)
    adc = replace(twin["grabber.adc"], maps={"threshold_lsb": moved})
    shifted = _with_true_black(adc, replace(seen, dark_stack=dark))
    assert shifted.maps is adc.maps
    by_pixel = dark.mean_map_dn.ravel()[:, None] - np.arange(1, 100) + 0.5
    shift = shifted.params.offset_dn - adc.params.offset_dn
    std = np.sqrt(0.7 - 1 / 12)
    equal, uneven = ndtr(by_pixel / std).sum(axis=1).mean(), ndtr((by_pixel + shift - moved[:99]) / std).sum(axis=1).mean()
    assert uneven == pytest.approx(equal, abs=0.01)
    assert _with_true_black(replace(adc, maps={}), seen).params == adc.params


def test_a_bend_of_the_converter_is_followed(seed: int) -> None:
    """A sinusoid of 2 LSB and 7 periods over the range, of which a cubic takes nothing: its slope changes variances by ± 2 %."""
    real = camera(seed, grabber_adc={"inl_amplitude_lsb": 2.0, "inl_cycles": 7.0})
    frames, light = campaign()
    seen, twin = assessed(seed, real, frames, light)
    tested = self_test(twin, frames, seen, by_the_standard(frames, seen), seed=seed + 1)
    temporal = [r for r in tested.rows if r.name in ("sigma_2_y_stack", "sigma_2_y_stack_dark", "PRNU1288", "s_2_y")]
    assert len(temporal) == 4 and max(abs(r.difference_u) for r in temporal) < FAR_U, temporal
    codes = np.arange(200, 2600)
    true = bend(real["grabber.adc"].params, codes)
    found = converter_bend(seen, 12).displacement_lsb[codes]
    assert np.corrcoef(true, found)[0, 1] > 0.8


def test_defects_are_where_they_were(both) -> None:
    _, _, seen, twin = both
    pixels = twin["sensor.defects"].maps["pixels"]
    assert {(int(r), int(c)) for r, c in pixels[:, :2]} == set(zip(seen.defects.row.tolist(), seen.defects.col.tolist(), strict=True))
    hot = np.array([kind == "hot" for kind in seen.defects.kind])
    gain = seen.photon_transfer_fit["gain_dn_per_e"].value
    # 12 e- of noise in the mean of 32 frames, six times; and what rows and columns differ by
    assert pixels[hot, 3] == pytest.approx(seen.defects.dark_excess_dn[hot] / gain, rel=0.05, abs=15)


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({}, {"photons": False}),
        ({}, {"stacks": ()}),
        ({}, {"stacks": ("dark",)}),
        ({"sensor_full_well": {"full_well_e": 60_000.0}}, {}),  # the converter does not clip either: no saturation is seen
        (
            {
                "electronics_gain": {"gain_dn_per_e": 0.007},
                "electronics_nonlinearity": {"reference_dn": 255.0, "a2": 0.0},
                "grabber_adc": {"bits": 8, "offset_dn": 5.3, "dnl_std_lsb": 0.0},
                "grabber_phase_pattern": {"amplitude_dn": 0.0},
                "electronics_amplifier_noise": {"white_e": 80.0},
            },
            {"bits": 8},
        ),
    ],
    ids=["no photons counted", "no stacks", "dark stack only", "not saturated", "8 bits"],
)
def test_other_cameras_and_campaigns_have_twins_too(changes, told, seed: int) -> None:
    real = camera(seed, **changes)
    frames, light = campaign(**told)
    seen, twin = assessed(seed, real, frames, light)
    tested = self_test(twin, frames, seen, by_the_standard(frames, seen), seed=seed + 1)
    assert tested.rows, tested.reason
    assert abs(tested.worst.difference_u) < FAR_U, tested.worst


def test_large_frames_are_tested_with_fewer() -> None:
    wanted = exposures_of(campaign()[0])
    chosen = fewer(wanted, 5_000_000)
    assert sum(e.frames for e in chosen) < 0.7 * sum(e.frames for e in wanted)
    assert {e.frames for e in chosen if e.role == "stack"} == {16}
    assert len([e for e in chosen if e.kind == "bright" and e.role == "level"]) == 12
    assert fewer(wanted, 100) == wanted


def test_of_large_frames_a_window_is_tested(both, seed: int) -> None:
    """As if frames of 120 × 160 pixels were too many: less than half of each, of every second frame."""
    _, frames, seen, twin = both
    assert middle_window((480, 640)) is None
    tested = self_test(twin, frames, seen, by_the_standard(frames, seen), seed=seed + 1, most_pixels=80 * 80 * 100)
    assert tested.window == (21, 28, 77, 103)
    names = {r.name for r in tested.rows}
    assert {"K", "sigma_y_dark", "sigma_2_y_stack", "DSNU1288", "PRNU1288"} <= names and not names & {"R", "QE", "LE_min", "s_2_y_row"}
    assert abs(tested.worst.difference_u) < FAR_U, tested.worst
    assert "in the middle" in twin_sentence(tested)


def test_what_is_not_significant_is_not_simulated(both) -> None:
    source = get_source("optics.shading")
    estimates = source.measure(both[2])
    i = estimates.index("gradient_x_per_px")
    weak = replace(estimates, values=np.where(np.arange(len(estimates)) == i, estimates.u[i], estimates.values))
    assert best_values(source, weak)["gradient_x_per_px"] == 0
    assert best_values(source, estimates)["gradient_y_per_px"] == pytest.approx(2e-4, rel=0.2)


def test_what_is_in_a_twin_without_being_measured_is_typical(seed: int) -> None:
    """Without photons the quantum efficiency is set to 1: no description of the camera, and nothing that was measured."""
    frames, light = campaign(photons=False)
    _, twin = assessed(seed, camera(seed), frames, light)
    known = {e.name: e.known_from for e in twin.chain}
    assert known["sensor.quantum_efficiency"] == "typical" and "sensor.quantum_efficiency" not in twin.estimates
    assert known["sensor.prnu"] == "measured" and known["sensor.shot_noise"] == ""
    assert twin["electronics.amplifier_noise"].params.white_e != twin.estimates["electronics.amplifier_noise"]["white_e"].value


def test_few_levels_below_saturation_tell_no_response_and_the_twin_is_tested_all_the_same(rng: np.random.Generator) -> None:
    """Three levels with counted photons and two that saturate: they tell the gain, but not how the response bends."""

    def taken(kind: str, exposure_s: float, electrons: float) -> Frames:
        dn = 20 + 0.5 * rng.poisson(electrons, (2, 48, 64)) + rng.normal(0, 2, (2, 48, 64))
        frames = np.rint(np.minimum(dn, 4095)).astype(np.uint16)
        return Frames(kind, exposure_s, frames, 2 * electrons if kind == "bright" else None)

    steps = [0.001 * k for k in range(1, 6)]
    groups = [taken("dark", t, 0) for t in steps] + [taken("bright", t, 2.4e6 * t) for t in steps]
    found = assess(campaign_of_arrays(groups, bits=12), trials=0)
    assert "quantum_efficiency" in found.observations.fit and "nonlinearity_a1" not in found.observations.fit
    assert found.self_test.rows and not found.self_test.reason
