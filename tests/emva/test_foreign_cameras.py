"""Cameras as other people simulate them: gains down to 0.02 DN/e-, hot pixels, waves, shading, bent responses, and campaigns with gaps.

The quick form of ``benchmarks/study_foreign_cameras.py``. Statistical tests fail by chance once in a million runs, for any seed.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from emva.foreign_cameras import ForeignCamera, random_camera
from emva.foreign_scoring import groups, outcomes, physical_truths
from pixmetry.camera.observations import Observations
from pixmetry.emva.evaluate import evaluate
from pixmetry.emva.files.keys import KEYS
from pixmetry.emva.records import Measurement
from pixmetry.observe.observe import Group, observe
from pixmetry.observe.photon_transfer_levels import levels_from, light_scale, usable_levels

ALPHA = 1e-6


def fresh(rng: np.random.Generator) -> int:
    return int(rng.integers(2**31))


def assert_within(seen: Observations, camera: ForeignCamera, names: tuple[str, ...]) -> None:
    """Each estimate within Student's t of its u at ALPHA over their number; an error of 9 u is found in all but a millionth."""
    fit, true = seen.photon_transfer_fit, physical_truths(camera)
    for name in names:
        e = fit[name]
        if e.kind == "upper_limit":
            assert e.value >= 0.5 * true[name], (camera.seed, name)
            continue
        p = 2 * stats.t.sf(abs(e.value - true[name]) / e.u, min(e.dof, 1e9))
        assert p > ALPHA / len(names), (camera.seed, name, e.value, e.u, true[name])


def test_hot_pixels_are_not_black_level_noise_or_dark_current(rng: np.random.Generator):
    """A share of 6e-4 with 400 e- each: taken along, they move the black level by 20 u, the noise by 5 u, the dark current by 10 u."""
    camera = ForeignCamera(fresh(rng), hot_share=6e-4, hot_e=1500.0, shape=(120, 160), row_noise_e=1.5)
    seen = observe(groups(camera), camera.bits)
    assert_within(seen, camera, ("offset_dn", "dark_noise_e", "dark_current_e_per_s", "gain_dn_per_e", "row_noise_e", "column_noise_e"))


def test_without_a_stack_hot_pixels_are_seen_in_the_codes(rng: np.random.Generator):
    camera = ForeignCamera(fresh(rng), hot_share=6e-4, hot_e=3000.0, shape=(120, 160))
    seen = observe((g for g in groups(camera) if g.role == "level"), camera.bits)
    assert_within(seen, camera, ("offset_dn", "dark_noise_e", "dark_current_e_per_s", "gain_dn_per_e"))


@pytest.mark.parametrize("full_well", [math.inf, 9000.0])
def test_a_converter_that_clips_first_gives_a_lower_limit_of_the_full_well(full_well, rng: np.random.Generator):
    camera = ForeignCamera(fresh(rng), bend="rational", full_well_e=full_well)
    e = observe(groups(camera), camera.bits).photon_transfer_fit["full_well_e"]
    assert e.kind == ("lower_limit" if math.isinf(full_well) else "value")
    assert abs(e.value - min(full_well, camera.clip_e)) < 6 * e.u, camera.seed


def test_ripple_of_rounded_variance_is_no_knee(rng: np.random.Generator):
    """8 bits, 0.02 DN/e-, dark noise of 0.04 DN: the variance of levels a fraction of a code apart goes up and down by ¼ DN²."""
    share = np.geomspace(0.001, 0.9, 40)
    camera = ForeignCamera(fresh(rng), gain_dn_per_e=0.02, read_e=2.0, dsnu_e=(0, 0, 0), prnu_rel=(0.002, 0, 0), bits=8, offset_dn=4.3)
    most = camera.settings[1][-1] / camera.over

    def frames():
        yield Group("dark", "level", 0.02, 0.0, list(camera.frames(2, 0.02, 0.0, 0)))
        for i, part in enumerate(share):
            yield Group("bright", "level", 0.02, part * most, list(camera.frames(2, 0.02, part * most, i + 1)))

    seen = observe(frames(), camera.bits)
    pt = seen.photon_transfer
    levels, _ = levels_from(pt, *light_scale(pt.bright))
    assert (usable_levels(pt, levels) & levels.bright).sum() == share.size
    gain = seen.photon_transfer_fit["gain_dn_per_e"]
    assert abs(gain.value - 0.02) < 6 * gain.u and gain.u < 0.001, camera.seed


def test_dark_levels_that_rounding_bends_do_not_bend_the_gain(rng: np.random.Generator):
    """Exposure swept, dark noise of 0.09 DN, 0.3 DN of dark current: the dark variances rise with the exposure by rounding alone.

    Taken for noise of the dark current, they move the gain by 4 %, ten u and more.
    """
    camera = ForeignCamera(
        fresh(rng), gain_dn_per_e=0.03, read_e=3.0, dsnu_e=(0, 0, 0), bits=8, offset_dn=3.2, dark_e_per_s=500.0, shape=(120, 160), over=1.05
    )  # fmt: skip
    seen = observe(groups(camera), camera.bits)
    assert_within(seen, camera, ("gain_dn_per_e", "quantum_efficiency", "offset_dn", "responsivity_dn_per_s"))
    gain = seen.photon_transfer_fit["gain_dn_per_e"]
    assert gain.u < 0.01 * gain.value


def test_a_pattern_that_rounding_hides_is_bounded(rng: np.random.Generator):
    camera = ForeignCamera(fresh(rng), gain_dn_per_e=0.03, read_e=1.5, dsnu_e=(1.5, 0.7, 0.7), dark_e_per_s=0.0, bits=8, offset_dn=5.0)
    spatial, true = observe(groups(camera), camera.bits).spatial_fit, physical_truths(camera)
    for name in ("dsnu_pixel_dn", "dsnu_row_dn", "dsnu_col_dn", "dsnu_total_dn"):
        assert spatial[name].kind == "upper_limit" and spatial[name].value > true[name], (camera.seed, name)


def test_stat_intervals_hold_the_truth_on_random_cameras(rng: np.random.Generator):
    """8 cameras of some 110 values. Values of one camera go together: counted as if 20 were independent, ALPHA; 60 % held would fail."""
    first, held, count, limits = fresh(rng), 0, 0, []
    for seed in range(first, first + 8):
        found, _ = outcomes(random_camera(seed), 300)
        held, count = held + sum(o.holds for o in found if o.kind == "value"), count + sum(o.kind == "value" for o in found)
        limits += [o.holds for o in found if o.kind != "value"]
    assert stats.binom.cdf(round(160 * held / count), 160, 0.95) > ALPHA, (first, held, count)
    assert stats.binom.cdf(round(40 * np.mean(limits)), 40, 0.95) > ALPHA, (first, limits)


CAMERA = ForeignCamera(1, shape=(64, 80))


def dark(n: int, stream: int) -> Group:
    return Group("dark", "stack" if n >= 8 else "level", 0.01, 0.0, list(CAMERA.frames(n, 0.01, 0.0, stream)))


def bright(n: int, stream: int, part: float = 0.4) -> Group:
    photons = part * CAMERA.settings[1][-1]
    return Group("bright", "stack" if n >= 8 else "level", 0.01, photons, list(CAMERA.frames(n, 0.01, photons, stream)))


def measurement(seen: Observations) -> Measurement:
    return Measurement(seen.photon_transfer, seen.dark_stack, seen.bright_stack)


@pytest.mark.parametrize("n", [2, 16])
def test_dark_frames_alone_give_black_level_and_noise_in_codes(n, rng: np.random.Generator):
    camera = replace(CAMERA, dark_e_per_s=0.0)
    seen = observe([Group("dark", "stack" if n > 8 else "level", 0.01, 0.0, list(camera.frames(n, 0.01, 0.0, fresh(rng))))], camera.bits)
    fit = seen.photon_transfer_fit
    noise = camera.gain_dn_per_e * camera.read_e
    assert abs(fit["dark_noise_dn"].value - noise) < 6 * fit["dark_noise_dn"].u
    # u has one degree of freedom, so that 6 u are nothing; the standard deviation of a mean of two frames is known here (1e-6 by chance)
    scatter = math.hypot(noise, 12**-0.5) / math.sqrt(2 * camera.patterns["offset"].size)
    assert abs(fit["offset_dn"].value - camera.patterns["offset"].mean()) < 4.9 * scatter
    assert fit["offset_dn"].dof == 1 and fit["offset_dn"].u < 5 * scatter
    assert "gain_dn_per_e" not in fit and any("gain" in note for note in seen.notes)
    assert (seen.spatial_fit is not None) == (n == 16)
    values = evaluate(measurement(seen), "4.0").values
    assert abs(values["sigma_y_dark"].value - math.hypot(noise, 1 / math.sqrt(12))) < 6 * values["sigma_y_dark"].u
    assert math.isfinite(values["DSNU1288_DN"].value) == (n == 16)
    assert all(math.isfinite(v.value) or v.reason for v in values.values()) and set(KEYS) - {"u_I_ref", "T_d"} <= set(values)
    assert "exposure series" in values["K"].reason


def test_one_light_level_gives_a_gain_as_sure_as_a_straight_line_is():
    seen = observe([dark(2, 1), bright(2, 2)], CAMERA.bits)
    gain = seen.photon_transfer_fit["gain_dn_per_e"]
    assert abs(gain.value - CAMERA.gain_dn_per_e) < 2 * gain.u and 0.05 < gain.u / gain.value < 0.2 and "straight line" in gain.reason
    assert seen.photon_transfer_fit["quantum_efficiency"].u / seen.photon_transfer_fit["quantum_efficiency"].value > 0.05


def test_two_stacks_alone_give_the_non_uniformities():
    seen = observe([dark(16, 3), bright(16, 4)], CAMERA.bits)
    prnu, want = seen.spatial_fit["prnu_pixel_rel"], CAMERA.prnu_rel[0]
    assert abs(prnu.value - want) < 6 * prnu.u and "gain_dn_per_e" in seen.photon_transfer_fit
    sheet = evaluate(measurement(seen), "3.1").values["PRNU1288_pixel"]
    assert abs(sheet.value - 100 * want) < 0.1 * 100 * want and sheet.u > 0


def test_a_gamma_camera_keeps_its_dark_values():
    def gamma(g: Group) -> Group:
        return replace(g, frames=[np.rint(4095 * np.sqrt(frame / 4095)).astype(np.uint16) for frame in g.frames])

    lights = [gamma(bright(2, 10 + i, part)) for i, part in enumerate(np.linspace(0.05, 0.85, 12))]
    seen = observe([*lights, gamma(dark(2, 5))], 12)
    assert "gain_dn_per_e" not in seen.photon_transfer_fit and "dark_noise_dn" in seen.photon_transfer_fit
    assert any("strongly curved" in note for note in seen.notes)
