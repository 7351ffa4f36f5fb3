"""Pictures of upright lines in an assessment: through the package's own cameras, with everything else on, and alone."""

from __future__ import annotations

import json

import numpy as np

from pixmetry import Frames, campaign_of_arrays
from pixmetry.assess.digital_twin import digital_twin
from pixmetry.assess.job import measure_sources, observe_campaign
from pixmetry.assess.page.lines import lines_section
from pixmetry.assess.results import lines_record
from pixmetry.camera.camera import Camera, Element, in_order
from pixmetry.camera.catalogue import get_source
from pixmetry.camera.group_facts import GroupFacts
from pixmetry.core.progress import no_progress
from pixmetry.report import Page, html_of
from pixmetry.scene.outlines import polygon
from pixmetry.scene.picture import Picture as Scene
from pixmetry.scene.shapes import Shapes
from pixmetry.scene.uniform import Uniform

ROWS, COLS, CLOCK_MHZ = 220, 150, 14.1875
LIMIT = 5.5  # u; beyond it once in 3e7
OTHERS: dict[str, dict[str, object]] = {
    "optics.point_spread": {"sigma_px": 0.6},
    "sensor.pixel_aperture": {},
    "sensor.quantum_efficiency": {},
    "sensor.prnu": {"pixel_std_rel": 0.008},
    "sensor.shot_noise": {},
    "sensor.stabilisation": {},
    "electronics.amplifier_noise": {"white_e": 30.0},
    "electronics.row_noise": {"row_e": 15.0},
    "electronics.gain": {"gain_dn_per_e": 0.008},
    "grabber.low_pass": {"kind": "butterworth", "cutoff_mhz": 5.0},
    "grabber.clamp": {"noise_dn": 0.3, "offset_dn": 16.0},
    "grabber.adc": {"bits": 8},
}


def frames_of_lines(seed: int, count: int, **changed: dict[str, object]) -> np.ndarray:
    chosen = OTHERS | {name.replace("__", "."): values for name, values in changed.items()}
    chain = tuple(Element(s.id, s, s.make(chosen[s.id])) for s in in_order(get_source(name) for name in chosen))
    camera = Camera("lines", (ROWS, COLS), chain, facts={"interface": "analogue", "bits": 8})
    y = np.array([-5.0, ROWS + 5.0])
    bars = [polygon(np.r_[a + 0.02 * y, (b + 0.02 * y)[::-1]], np.r_[y, y[::-1]], 16000.0) for a, b in ((50, 53), (90, 130))]
    return camera.expose(Scene((Shapes.of(bars),), Uniform(2000.0)), count, seed=seed).data


def measured(*groups: Frames):
    campaign = campaign_of_arrays(groups, bits=8, interface="analogue", pixel_clock_mhz=CLOCK_MHZ)
    _, seen = observe_campaign(campaign, no_progress)
    return seen, *measure_sources(seen)


def test_jitter_and_loop_through_the_camera(rng: np.random.Generator):
    frames = frames_of_lines(int(rng.integers(1 << 30)), 14, grabber__line_jitter={"white_ns": 5.0, "loop_ns": 10.0, "loop_rows": 6.0})
    _, estimates, _ = measured(Frames("line", None, frames))
    found = estimates["grabber.line_jitter"]
    for name, true in (("white_ns", 5.0), ("loop_ns", 10.0)):
        assert abs(found[name].value - true) < LIMIT * found[name].u and found[name].u < 0.15 * true
    assert abs(np.log(found["loop_rows"].value / 6.0)) < LIMIT * found["loop_rows"].u / 6.0


def test_what_a_recorder_adds_is_told_from_lines_played_and_direct(rng: np.random.Generator):
    jitter = {"white_ns": 4.0}
    seeds = rng.integers(1 << 30, size=2)
    direct = frames_of_lines(int(seeds[0]), 10, grabber__line_jitter=jitter)
    tape = {"generations": 1, "bandwidth_mhz": 3.0, "white_ns": 8.0, "wow_ns": 12.0, "wow_rows": 8.0, "noise_dn": 2.0}
    played = frames_of_lines(int(seeds[1]), 10, grabber__line_jitter=jitter, storage__tape=tape)
    _, estimates, _ = measured(Frames("line", None, direct), Frames("line", None, played, facts=GroupFacts(recorded=True)))
    found = estimates["storage.tape"]
    for name in ("white_ns", "wow_ns"):
        assert abs(found[name].value - tape[name]) < LIMIT * found[name].u and found[name].u < 0.2 * tape[name]
    assert abs(estimates["grabber.line_jitter"]["white_ns"].value - 4.0) < LIMIT * estimates["grabber.line_jitter"]["white_ns"].u
    _, _, alone = measured(Frames("line", None, played, facts=GroupFacts(recorded=True)))
    assert "not separable from grabber.line_jitter" in alone["storage.tape"]


def test_lines_alone_reach_twin_page_and_record(rng: np.random.Generator):
    frames = frames_of_lines(int(rng.integers(1 << 30)), 6, grabber__line_jitter={"white_ns": 15.0})
    campaign = campaign_of_arrays([Frames("line", None, frames)], bits=8, interface="analogue", pixel_clock_mhz=CLOCK_MHZ)
    _, seen = observe_campaign(campaign, no_progress)
    estimates, _ = measure_sources(seen)
    twin = digital_twin(campaign, estimates, seen)
    assert abs(twin["grabber.line_jitter"].params.white_ns - 15.0) < 3.0 and twin["grabber.line_jitter"].known_from == "measured"
    assert seen.lines is not None
    page = Page("lines", sections=[lines_section(seen.lines)])
    text = html_of(page)
    assert "3 lines and edges were followed row by row" in text and "each row jumps by" in text.lower()
    record = lines_record(seen.lines)
    assert len(record["lines"]) == 3 and record["jitter"]["names"][0] == "white_px"
    assert json.loads(json.dumps(record)) == record


def test_too_few_frames_say_how_many_more(rng: np.random.Generator):
    frames = frames_of_lines(int(rng.integers(1 << 30)), 3, grabber__line_jitter={"white_ns": 15.0})
    _, _, why = measured(Frames("line", None, frames))
    assert "take 1 more" in why["grabber.line_jitter"]
