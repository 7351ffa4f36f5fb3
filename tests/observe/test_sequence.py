"""Frames in a row, against a loop of gain and a lamp that are simulated here frame by frame, without the package."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy import stats

from observe.sequence_frames import Body, Lamp, Loop, Scene, dark_frames, flats, sequence, taken
from pixmetry import Frames, assess, campaign_of_arrays
from pixmetry.assess.job import measure_sources, observe_campaign
from pixmetry.camera.observations import Observations
from pixmetry.core.errors import InputError
from pixmetry.core.number import Estimates
from pixmetry.core.progress import no_progress
from pixmetry.files.images import write_frame
from pixmetry.files.manifest import load_campaign
from pixmetry.observe.gain_loop import LoopData, fit_loop
from pixmetry.observe.sequence import mean_of_loops

ALPHA = 1e-6


def seen_of(*groups: Frames, bits: int = 12, **camera) -> Observations:
    return observe_campaign(campaign_of_arrays(list(groups), bits=bits, **camera), no_progress)[1]


def dark_of(rng: np.random.Generator, body: Body) -> Frames:
    return Frames("dark", 0.001, dark_frames(rng, 4, body))


def test_loop_lamp_and_black_are_found_within_their_u(rng: np.random.Generator):
    """10 cameras; χ² of κ and target, 1e-6 on either side: finds u that is 60 % too small, or 2.5 u."""
    z, swings = [], []
    for k in range(10):
        loop = Loop(float(np.exp(rng.uniform(np.log(0.05), np.log(0.8)))), rng.uniform(400, 900))
        lamp = Lamp(0.03 * (k % 2), 25 * (rng.integers(3, 7) + rng.uniform(0.05, 0.45)), rng.uniform(0, 6))
        body = Body(black=rng.uniform(20, 90), row_s=1e-4 * (k % 4 == 1), exposure_s=0.003)
        data = sequence(rng, 60, loop, lamp, body, Scene(patch=rng.uniform(1.4, 2.2), period=2 * int(rng.integers(4, 9))))
        found = seen_of(taken(data, body), dark_of(rng, body), line_time_us=100.0).sequences
        z.append([(found.loop[n].value - truth) / found.loop[n].u for n, truth in (("kappa", loop.kappa), ("target_dn", loop.target_dn))])
        assert found.loop.u[0] < 0.02 * loop.kappa + 2e-3
        wave = found.sequences[0].wave
        assert (wave is not None) == bool(k % 2)
        if wave is not None:
            left = lamp.depth * abs(np.sinc(lamp.hertz * body.exposure_s))
            swings.append((wave.amplitude_rel - left) / wave.u_amplitude_rel)
    for values in (np.ravel(z), np.array(swings)):
        assert stats.chi2.ppf(ALPHA / 2, len(values)) < np.sum(values**2) < stats.chi2.isf(ALPHA / 2, len(values)) * 1.6


def test_a_gain_at_its_limit_is_not_taken_for_a_slower_loop(rng: np.random.Generator):
    """Half of the frames stand at the upper limit; without the limit κ is a third too small. u is about 1e-3; six u."""
    body = Body()
    loop = Loop(0.3, 1000.0, highest=1.15)
    data = sequence(rng, 80, loop, Lamp(), body)
    seen = seen_of(taken(data, body), *flats(rng, body))
    found = measure_sources(seen)[0]["electronics.agc"]
    assert found["kappa"].value == pytest.approx(0.3, abs=6 * found["kappa"].u) and found["kappa"].u < 0.005
    assert "highest_rel" in seen.sequences.sequences[0].loop
    limit = 20 * np.log10(1.15)
    assert abs(found["highest_db"].value - limit) < 6 * found["highest_db"].u < 1.0


def test_a_locked_gain_has_no_loop(rng: np.random.Generator):
    """8 cameras, a lamp in every other one. A false loop needs κ above 0.02, 20 u here."""
    for k in range(8):
        data = sequence(rng, 50, None, Lamp(0.03 * (k % 2), 77.0))
        estimates, _ = measure_sources(seen_of(taken(data)))
        agc = estimates["electronics.agc"]
        assert agc["kappa"].value == 0 and "stays as it is" in agc["kappa"].reason


def test_an_exposure_that_follows_the_scene_is_told_from_a_gain_by_the_noise(rng: np.random.Generator):
    """The share of the gain has a u of 0.1: 1 and 0 are ten u apart."""
    body = Body()
    for exposes in (True, False):
        seen = seen_of(taken(sequence(rng, 80, Loop(exposes=exposes), None, body), body), dark_of(rng, body))
        told, refused = measure_sources(seen)
        if exposes:
            assert "the exposure follows the scene" in refused["electronics.agc"]
        else:
            assert not told["electronics.agc"].confounders and told["electronics.agc"]["kappa"].value == pytest.approx(0.3, abs=0.01)


def test_bands_over_the_rows_tell_the_frequency_and_the_depth(rng: np.random.Generator):
    """Of the order of 1e-3 Hz and 1e-4 of the light; six u."""
    body = Body(row_s=1e-4, exposure_s=0.003)
    data = sequence(rng, 40, None, Lamp(0.05, 103.3), body, Scene(patch=0))
    lamp = measure_sources(seen_of(taken(data, body), dark_of(rng, body), line_time_us=100.0))[0]["optics.flicker"]
    for name, truth in (("depth_rel", 0.05), ("frequency_hz", 103.3)):
        assert abs(lamp[name].value - truth) < 6 * lamp[name].u
    assert lamp["depth_rel"].u < 1e-3 and lamp["frequency_hz"].u < 0.01
    assert "dark frames" in measure_sources(seen_of(taken(data, body), line_time_us=100.0))[1]["optics.flicker"]


def test_two_frame_rates_unfold_the_frequency_and_one_does_not(rng: np.random.Generator):
    groups = []
    for period in (0.04, 0.0396):
        body = Body(exposure_s=0.003, period_s=period)
        groups.append(taken(sequence(rng, 60, None, Lamp(0.04, 103.3), body, Scene(patch=0)), body))
    dark = dark_of(rng, Body())
    lamp = measure_sources(seen_of(*groups, dark))[0]["optics.flicker"]
    assert abs(lamp["frequency_hz"].value - 103.3) < 6 * lamp["frequency_hz"].u
    assert abs(lamp["depth_rel"].value - 0.04) < 6 * lamp["depth_rel"].u
    assert "second sequence at another frame rate" in measure_sources(seen_of(groups[0], dark))[1]["optics.flicker"]


def test_an_exposure_of_whole_periods_tells_no_depth(rng: np.random.Generator):
    body = Body(exposure_s=0.0199, period_s=0.041, row_s=1e-4)
    data = sequence(rng, 60, None, Lamp(0.9, 100.0), body, Scene(patch=0))
    reason = measure_sources(seen_of(taken(data, body), dark_of(rng, body), line_time_us=100.0))[1]["optics.flicker"]
    assert "periods" in reason


def test_without_flicker_there_is_a_limit_and_an_exposure_that_hides_it_tells_nothing(rng: np.random.Generator):
    short = Body(exposure_s=0.002, period_s=0.043)
    told, _ = measure_sources(seen_of(taken(sequence(rng, 50, None, None, short, Scene(patch=0)), short), dark_of(rng, short)))
    assert told["optics.flicker"].limits == {"depth_rel"} and told["optics.flicker"]["depth_rel"].value < 0.01
    long = Body(exposure_s=0.01, period_s=0.043)
    _, refused = measure_sources(seen_of(taken(sequence(rng, 50, None, None, long, Scene(patch=0)), long), dark_of(rng, long)))
    assert "whole periods" in refused["optics.flicker"]


def test_what_cannot_be_measured_has_its_reason(rng: np.random.Generator):
    def reason(data: np.ndarray, **facts) -> str:
        return measure_sources(seen_of(taken(data, **facts)))[1]["electronics.agc"]

    assert "does not change" in reason(sequence(rng, 40, Loop(), None, None, Scene(patch=0)))
    assert "changes 1 times" in reason(sequence(rng, 40, Loop(), None, None, Scene(period=50)))
    assert "2 frames more" in reason(sequence(rng, 10, Loop()))
    assert "clipped" in reason(np.full((20, 96, 128), 4095, np.uint16))
    moving = np.array([np.roll(f, 5 * k, axis=1) for k, f in enumerate(sequence(rng, 30, None, None, None, Scene(patch=0)))])
    assert "of the frame stays" in reason(moving) or "too little" in reason(moving)
    assert (
        "answers 2 frames later"
        in measure_sources(seen_of(taken(sequence(rng, 60, Loop(delay=2))), dark_of(rng, Body())))[1]["electronics.agc"]
    )
    with pytest.raises(InputError, match="do not rise|times"):
        seen_of(taken(sequence(rng, 12), interval_s=1.0, times_s=tuple(range(12))))


def test_a_missing_frame_is_seen_and_does_no_harm(rng: np.random.Generator):
    """Once by the times, once without: the loop is not followed over the gap. u is about 1e-3; six u."""
    data = np.delete(sequence(rng, 61, Loop(0.3)), 33, axis=0)
    times = np.delete(np.arange(61) * 0.04 + 0.002 * rng.uniform(-1, 1, 61), 33)
    for facts in ({"interval_s": None, "times_s": tuple(times.tolist())}, {}):
        seen = seen_of(taken(data, **facts), dark_of(rng, Body()))
        kappa = seen.sequences.loop["kappa"]
        assert abs(kappa.value - 0.3) < 6 * kappa.u and kappa.u < 0.01
        assert any("missing after frame 33" in note for note in seen.notes)


def test_eight_bits_a_mosaic_and_two_fields_do_no_harm(rng: np.random.Generator, tmp_path: Path):
    """κ of files of 8 and of 16 bits, of a colour mosaic, and of frames of two fields: six u, and 0.02."""
    coarse = Body(gain=0.025, black=8.0, bits=8)
    mosaic = sequence(rng, 60, Loop(0.3, 700.0))
    factors = np.tile([[1.0, 0.7], [0.7, 0.4]], (48, 64))
    dark = dark_frames(rng, 4, Body())
    groups = {
        "eight": (sequence(rng, 60, Loop(0.3, 50.0), None, coarse), dark_frames(rng, 4, coarse), 8, {}),
        "mosaic": (np.rint(32 + (mosaic - 32.0) * factors).astype(np.uint16), dark, 12, {"cfa": "RGGB"}),
        "fields": (mosaic[:, np.r_[0:96:2, 1:96:2]], dark, 12, {"interface": "analogue"}),
        "sixteen": (16 * mosaic, 16 * dark, 16, {}),
    }
    for name, (data, without, bits, facts) in groups.items():
        for k, frame in enumerate([*data, *without]):
            write_frame(tmp_path / f"{name}_{k:02d}.tif" if k < 60 else tmp_path / f"dark_{name}_{k:02d}.tif", frame, bits)
        said = "".join(f", {key}: {value}" for key, value in facts.items())
        text = f"schema: pixmetry/campaign/1\ncamera: {{name: one, bits: {bits}{said}}}\nframes:\n"
        text += f'- {{kind: dark, exposure_s: 0.004, files: "dark_{name}_*.tif"}}\n'
        text += f'- {{kind: sequence, exposure_s: 0.004, interval_s: 0.04, files: "{name}_*.tif"}}\n'
        (tmp_path / "campaign.yaml").write_text(text)
        loop = observe_campaign(load_campaign(tmp_path), no_progress)[1].sequences.loop
        assert abs(loop["kappa"].value - 0.3) < 6 * loop["kappa"].u and loop["kappa"].u < 0.02, name


def test_page_results_and_budget_have_it(rng: np.random.Generator, tmp_path: Path):
    body = Body()
    groups = [taken(sequence(rng, 60, Loop(0.3)), body), *flats(rng, body)]
    found = assess(campaign_of_arrays(groups, bits=12, name="in a row"), tmp_path / "result", trials=0)
    assert "The gain follows the scene" in (tmp_path / "result" / "report.html").read_text()
    record = found.to_record()["sequences"]
    assert record["loop"]["names"][:2] == ["kappa", "target_dn"] and len(record["sequences"][0]["gain_rel"]) == 60
    assert found.camera["electronics.agc"].params.kappa == pytest.approx(0.3, abs=0.01)


def test_frames_without_light_or_full_of_it_are_left_out(rng: np.random.Generator):
    """A dark frame, one of zeros and one that is saturated all over; u is about 1e-3, six u."""
    data = sequence(rng, 60, Loop(0.3))
    data[20], data[35], data[47] = dark_frames(rng, 1, Body())[0], 0, 4095
    seen = seen_of(taken(data), dark_of(rng, Body()))
    kappa = seen.sequences.loop["kappa"]
    assert abs(kappa.value - 0.3) < 6 * kappa.u and kappa.u < 0.01
    assert any("3 of 60 frames are left out" in note for note in seen.notes)
    assert any("missing after frame 20, 35, 47" in note for note in seen.notes)


def test_a_pause_begins_another_sequence(rng: np.random.Generator):
    """κ and target of both stretches, six u; one of less than 12 frames is refused by itself."""
    data, times = sequence(rng, 70, Loop(0.3)), 0.04 * np.arange(70) + 3600.0 * (np.arange(70) >= 40) + 3600.0 * (np.arange(70) >= 65)
    found = seen_of(taken(data, interval_s=None, times_s=tuple(times.tolist())), dark_of(rng, Body())).sequences
    assert [len(s.gain_rel) for s in found.sequences] == [40, 25] and "sequence 3 of 3: 5 frames" in found.refused[0]
    for name, truth in (("kappa", 0.3), ("target_dn", 700.0)):
        assert abs(found.loop[name].value - truth) < 6 * found.loop[name].u


def test_the_scale_of_codes_that_are_shifted_ends_below_the_highest_number(rng: np.random.Generator):
    """12 bits in the upper ones of 16, a patch that saturates: what clipped frames ask is not used. Six u."""
    data = 16 * sequence(rng, 60, Loop(target_dn=2200.0))
    loop = seen_of(taken(data), Frames("dark", 0.001, 16 * dark_frames(rng, 4, Body())), bits=16).sequences.loop
    for name, truth in (("kappa", 0.3), ("target_dn", 16 * 2200.0)):
        assert abs(loop[name].value - truth) < 6 * loop[name].u
    assert loop["kappa"].u < 0.01


def test_dark_frames_that_are_cut_off_at_zero_leave_black_uncertain(rng: np.random.Generator):
    """Noise below 0 is lost, and the dark level is 1.3 DN too high: u of the target holds that."""
    body = Body(black=0.0)
    target = seen_of(taken(sequence(rng, 60, Loop(), None, body), body), dark_of(rng, body)).sequences.loop["target_dn"]
    assert abs(target.value - 700) < 3 * target.u and 0.3 < target.u < 5


def test_frames_without_noise_or_contrast_do_not_end_the_run(rng: np.random.Generator):
    for data in (np.full((20, 96, 128), 500, np.uint16), np.repeat(sequence(rng, 1), 20, axis=0)):
        assert "does not change" in measure_sources(seen_of(taken(data), dark_of(rng, Body())))[1]["electronics.agc"]


def test_no_limit_of_flicker_without_the_time_from_frame_to_frame(rng: np.random.Generator):
    """25 frames a second all see a lamp of 100 Hz alike."""
    data = sequence(rng, 40, None, Lamp(0.3, 100.0), None, Scene(patch=0))
    assert "interval_s" in measure_sources(seen_of(taken(data, interval_s=None), dark_of(rng, Body())))[1]["optics.flicker"]


def test_two_fields_in_one_frame_tell_no_lamp(rng: np.random.Generator):
    body = Body(exposure_s=0.003, period_s=0.02)
    fields = sequence(rng, 80, None, Lamp(0.2, 113.0), body, Scene(patch=0))
    woven = np.where((np.arange(96) % 2 == 0)[:, None], fields[::2], fields[1::2])
    told = measure_sources(seen_of(taken(woven, body, interval_s=0.04), dark_of(rng, body), line_time_us=64.0))[1]["optics.flicker"]
    assert "each field as a frame" in told


def test_black_that_sequences_share_is_not_averaged_out():
    """Two sequences whose target is as uncertain as black: their mean is, too."""
    own, black = np.array([1e-3, 0.01]), np.array([1e-5, 1.0])
    joint = np.block([[np.diag(own**2) + np.outer(black, black), 1.0 * black[:, None]], [1.0 * black, np.ones((1, 1))]])
    one = Estimates(("kappa", "target_dn", "black_dn"), np.array([0.3, 700.0, 32.0]), joint, np.full(3, 50.0), ("1", "DN", "DN"))
    _, covariance, _, _ = mean_of_loops([one, one])
    assert covariance[1, 1] == pytest.approx(1.0, rel=1e-3) and covariance[0, 0] == pytest.approx(own[0] ** 2 / 2, rel=1e-2)


def test_a_lamp_beside_a_fast_loop_is_found_whatever_wave_the_search_begins_with(rng: np.random.Generator):
    """Gains of 60 frames, u 2e-4; a lamp of 2.5 % at 0.388 cycles a frame. κ is told to 1e-3 with it, to 0.02 without."""
    for phase in np.arange(6) / 6:
        gain, levels = [0.76], []
        lamp = np.log1p(0.025 * np.cos(2 * np.pi * (0.388 * np.arange(60) + phase)))
        for k in range(60):
            levels.append(5.5 + 0.3 * ((k // 8) % 2) + gain[k] + lamp[k])
            gain.append(gain[k] + 0.543 * (6.01 - levels[k]))
        log_gain = np.array(gain[:60]) + lamp + 2e-4 * rng.standard_normal(60)
        found = fit_loop(LoopData(log_gain, np.full(60, 2e-4), np.array(levels), np.arange(60.0)))
        assert found.has_wave and abs(found["kappa"] - 0.543) < 6 * found.u("kappa") < 0.02
