"""Everything between an analogue camera's output and the stored number in one chain: order, windows, and where a target is found."""

from __future__ import annotations

import numpy as np
import pytest

from catalogue.support import Flat, Targets, Texture, lead_in
from pixmetry.camera.camera import Camera, Element, in_order
from pixmetry.camera.catalogue import get_source
from pixmetry.camera.signal import Kind
from pixmetry.core.errors import ChainError
from pixmetry.core.random import Grid

CHAIN = {
    "electronics.video_amplifier": {"natural_mhz": 7.0, "damping": 0.6},
    "cable.termination": {"length_m": 5.0, "line_ohm": 50.0},
    "cable.t_piece": {"branch": "open", "length_m": 0.5},
    "storage.tape": {"generations": 1, "bandwidth_mhz": 5.0, "noise_dn": 1.0, "white_ns": 3.0, "wow_ns": 3.0},
    "grabber.low_pass": {"kind": "butterworth", "cutoff_mhz": 5.0},
    "grabber.sampling_clock": {"clock_mhz": 10.0, "samples": 100, "start_ns": 300.0},
    "grabber.clock_warm_up": {"scale_error_rel": 0.002},
    "grabber.line_jitter": {"white_ns": 5.0, "loop_ns": 5.0},
    "grabber.clamp": {"offset_dn": -1.0, "noise_dn": 0.2, "droop_rel": 0.01},
    "grabber.fixed_pattern": {"settling_dn": 4.0},
    "grabber.phase_pattern": {"amplitude_dn": 0.5},
    "grabber.window_offset": {"row_offset": 8, "row_increment": 4, "col_offset": 2, "rows": 64, "inactive_rows": 2},
    "grabber.adc": {"offset_dn": 5.0},
}


def chain(names: object) -> Camera:
    elements = [Element(i, get_source(i), get_source(i).make(CHAIN[i])) for i in names]
    return Camera("analogue", (96, 160), (*lead_in(Kind.DN), *elements))


def test_the_order_of_the_chain_is_found_and_others_are_refused() -> None:
    found = [s.id for s in in_order(get_source(i) for i in reversed(CHAIN))]
    stages = [i.partition(".")[0] for i in found]
    assert stages == ["electronics", "cable", "cable", "storage"] + 9 * ["grabber"]
    video = [i for i in found if get_source(i).consumes == (Kind.VIDEO,)]
    assert found[: len(video)] == video and found[-1] == "grabber.adc"
    chain(found)
    for wrong in ("storage.tape", "electronics.video_amplifier"):
        with pytest.raises(ChainError, match="must come"):
            chain([i for i in CHAIN if i not in (wrong, "grabber.adc")] + [wrong])


def test_any_window_of_it_is_the_crop() -> None:
    camera = chain(CHAIN)
    whole = camera.expose(Texture(), 2, seed=3).data
    assert whole.shape == (2, 64, 100) and camera.output_shape == (64, 100)
    for r, c, h, w in ((0, 0, 9, 7), (20, 13, 11, 30), (63, 99, 1, 1), (3, 60, 20, 40)):
        assert np.array_equal(camera.expose(Texture(), 2, seed=3, window=(r, c, h, w)).data, whole[:, r : r + h, c : c + w])
    grid = Grid(np.array([0, 1, 1]), np.array([0, 30, 55]), np.array([91, 40, 0]), (9, 9))
    for got, f, r, c in zip(camera.expose_windows(Texture(), grid, seed=3), grid.frame, grid.row0, grid.col0, strict=True):
        assert np.array_equal(got, whole[f, r : r + 9, c : c + 9])


def test_a_target_is_found_where_geometry_and_delays_put_it() -> None:
    """The geometry, with the stretch of the warm-up in it, and the group delays of all filters and echoes, in samples of the grabber."""
    quiet = {i: v for i, v in CHAIN.items() if i not in ("grabber.phase_pattern", "grabber.fixed_pattern", "grabber.clamp")}
    camera = chain(quiet)
    x, y = np.array([60.3, 90.7, 120.1]), np.array([40.0, 50.4, 45.7])
    frames = camera.expose(Targets(x, y, background_dn=0.0), 3, quiet=True).data.astype(float)
    background = camera.expose(Flat(0.0), 1, quiet=True).data.astype(float)
    told_x, told_y = camera.true_positions(x, y)
    delay_px = 14.1875e6 * delay_of_the_line()
    stretched = (x + 0.5 + 10.5e-6 * 14.1875e6) * 0.002 * 10 / 14.1875
    assert told_x == pytest.approx(camera.layout(x, y)[0] + stretched, abs=1e-3)
    for i in range(3):
        light = np.maximum(frames[i] - background[0] - 1.0, 0.0)
        found_x = (light.sum(axis=0) * np.arange(100)).sum() / light.sum()
        found_y = (light.sum(axis=1) * np.arange(64)).sum() / light.sum()
        assert found_x == pytest.approx(told_x[i] + delay_px * 10 / 14.1875, abs=0.03)
        assert found_y == pytest.approx(told_y[i], abs=0.02)


def delay_of_the_line() -> float:
    """2ζ/ω0, ρτ/(1 − ρ), a quarter of the stub's τ, 2/ω_c: closed forms, one by one."""
    there_and_back = 2 / (0.66 * 299_792_458.0)
    amplifier = 2 * 0.6 / (2 * np.pi * 7e6)
    cable = 0.04 / 0.96 * 5.0 * there_and_back
    stub = 0.25 * 0.5 * there_and_back
    return amplifier + cable + stub + 2 / (2 * np.pi * 5e6)
