"""The video line from slanted edges: filters and echoes are found blind behind lens, pixel, noise and jitter, or named as not separable."""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
import pytest

from observe.edge_cameras import stored_squares
from pixmetry.camera.catalogue import get_source
from pixmetry.camera.line import Line
from pixmetry.camera.observations import Observations
from pixmetry.camera.stated import StatedFacts
from pixmetry.core.errors import MeasureError
from pixmetry.core.number import Estimates
from pixmetry.core.random import Grid
from pixmetry.observe.edge_curves import curves_of
from pixmetry.observe.edges import responses_of, search_edges
from pixmetry.observe.line_fit import FILTERS, TAPS, LineModel, fit_line
from pixmetry.sources.cable.t_piece import DELAY_S_PER_M, TPiece
from pixmetry.sources.cable.t_piece import echoes as branch_echoes
from pixmetry.sources.cable.termination import Termination, echoes
from pixmetry.sources.electronics.video_amplifier import VideoAmplifier
from pixmetry.sources.grabber.low_pass import LowPass

LIMIT = 5.5  # u; beyond it once in 3e7
MHZ = 14.1875
OPTICS: dict[str, dict[str, object]] = {
    "optics.point_spread": {"sigma_px": 0.5},
    "sensor.pixel_aperture": {"width_x_px": 0.7, "width_y_px": 0.9},
}
SPREAD = 0.25 + (0.7**2 + 0.9**2) / 24


def seen_of(rng: np.random.Generator, sources: dict[str, dict[str, object]]) -> tuple[Observations, Any]:
    """Observations of an analogue camera that took one picture of edges, and the search."""
    search = search_edges([stored_squares(rng, OPTICS | sources)], analogue=True)
    line, optics = fit_line(search.measured)
    stated = StatedFacts(interface="analogue", pixel_clock_mhz=MHZ)
    return Observations(edges=responses_of(search, optics, line), stated=stated), search


def measured(source: str, seen: Observations) -> Estimates:
    measure = get_source(source).measure
    assert measure is not None
    return measure(seen)


def _bare() -> Line:
    return Line(MHZ * 1e6, MHZ * 1e6)


def _filtered(kind: Any, order: int) -> Line:
    return _bare().filtered([], LowPass(kind=kind, order=order, cutoff_mhz=5.0).poles)


@pytest.mark.parametrize(
    ("model", "values", "line"),
    [
        *((LineModel(kind, order), {"cutoff_rel": 5 / MHZ}, partial(_filtered, kind, order)) for kind, order in FILTERS),
        (
            LineModel("off", 0, True),
            {"natural_rel": 8 / MHZ, "damping": 1.0},
            lambda: _bare().filtered([], VideoAmplifier(natural_mhz=8, damping=1.0).poles),
        ),
        (
            LineModel(echo="far"),
            {"ghost_rel": 0.04, "echo_px": 20 * DELAY_S_PER_M * 1e6 * MHZ},
            lambda: _bare().echoed(*echoes(Termination(length_m=20, line_ohm=50))),
        ),
        (
            LineModel("bessel", 4, True, "branch"),
            {"cutoff_rel": 5 / MHZ, "natural_rel": 6 / MHZ, "damping": 0.3, "branch_px": 5 * DELAY_S_PER_M * 1e6 * MHZ},
            lambda: (
                _bare()
                .filtered([], VideoAmplifier(natural_mhz=6, damping=0.3).poles)
                .echoed(*branch_echoes(TPiece(branch="open", length_m=5)))
                .filtered([], LowPass(kind="bessel", order=4).poles)
            ),
        ),
    ],
)
def test_taps_and_gain_of_a_delay_are_what_the_line_of_the_sources_makes(model: LineModel, values: dict[str, float], line):
    """Against the state space by which cameras are simulated (float32); equal poles, moved apart by 1e-4, err by 3e-5."""
    zero, one = np.zeros(1, np.int64), np.zeros((1, 1, TAPS), np.float32)
    one[0, 0, 0] = 1
    expected = line().limited().read(one, zero, Grid(zero, zero, zero, (1, TAPS)))[0, 0]
    np.testing.assert_allclose(model.taps(values), expected, atol=4e-5)
    assert model.delay_px(values) == pytest.approx(line().delay_s * MHZ * 1e6, abs=2e-6)
    # rows that come ± 0.02 px late move the sum over a step by so much times the gain
    step, late, whole = (np.arange(4 * TAPS) > 4).astype(np.float32)[None, None], 0.02, Grid(zero, zero, zero, (1, 3 * TAPS))
    moved = [line().limited().delayed(np.full((1, 1), d / (MHZ * 1e6))).read(step, zero, whole).sum(dtype=float) for d in (-late, late)]
    assert model.row_gain(values) == pytest.approx((moved[0] - moved[1]) / (2 * late), abs=3e-3)


def test_filter_and_cable_are_found_behind_noise_and_jitter(rng: np.random.Generator):
    """Butterworth, 5 MHz, third order; 20 m of 50 Ω; shot noise, PRNU, rounding, and lines that jitter by 0.07 px."""
    seen, search = seen_of(
        rng,
        {
            "grabber.low_pass": {"kind": "butterworth", "order": 3, "cutoff_mhz": 5.0},
            "cable.termination": {"length_m": 20.0, "line_ohm": 50.0},
            "grabber.line_jitter": {"white_ns": 5.0},
        },
    )
    low_pass, cable = measured("grabber.low_pass", seen), measured("cable.termination", seen)
    assert low_pass.settings == {"kind": "butterworth", "order": 3}
    for found, name, truth, most in ((low_pass, "cutoff_mhz", 5.0, 0.15), (cable, "length_m", 20.0, 0.6), (cable, "line_ohm", 50.0, 1.0)):
        assert abs(found[name].value - truth) < LIMIT * found[name].u < LIMIT * most, found[name]
    edges = seen.edges
    assert edges is not None and edges.line is not None
    v = edges.optics["spread_var_px2"]
    assert abs(v.value - SPREAD) < LIMIT * v.u < LIMIT * 0.006
    for absent in ("electronics.video_amplifier", "cable.t_piece"):
        with pytest.raises(MeasureError, match=r"do not need it|not separable"):
            measured(absent, seen)
    (curve,) = [c for c in curves_of(search.measured, 40.0) if c.across == "x"]
    assert np.sqrt(curve.jitter_px2) == pytest.approx(5e-3 * MHZ, rel=0.35)  # of the 111 rows that all edges share: 7 %


def test_what_cannot_be_told_apart_is_named_and_its_delay_is_given(rng: np.random.Generator):
    """Filter, amplifier and 5 m of cable: their sum is known to a hundredth of a pixel, and no part is a wrong number."""
    seen, _ = seen_of(
        rng,
        {
            "grabber.low_pass": {"kind": "butterworth", "order": 3, "cutoff_mhz": 5.0},
            "electronics.video_amplifier": {"natural_mhz": 8.0, "damping": 0.7},
            "cable.termination": {"length_m": 5.0, "line_ohm": 50.0},
        },
    )
    assert seen.edges is not None and seen.edges.line is not None
    low_pass, amplifier = LowPass(kind="butterworth"), VideoAmplifier(natural_mhz=8.0, damping=0.7)
    line = _bare().filtered([], low_pass.poles).filtered([], amplifier.poles).echoed(*echoes(Termination(length_m=5.0, line_ohm=50.0)))
    delay = seen.edges.line["delay_px"]
    assert abs(delay.value - line.delay_s * MHZ * 1e6) < LIMIT * delay.u < LIMIT * 0.04
    truth = {"cutoff_mhz": 5.0, "natural_mhz": 8.0, "damping": 0.7}
    for source in ("grabber.low_pass", "electronics.video_amplifier"):
        try:
            for e in measured(source, seen):
                assert abs(e.value - truth[e.name]) < LIMIT * e.u, e
                assert e.name != "damping" or e.u > 0.01, e  # 0.006 without an echo, which may hide behind the rise and change it by 0.3
        except MeasureError as why:
            assert "the whole line delays by" in str(why)
    with pytest.raises(MeasureError, match=r"do not need it|not separable|hardly tell"):
        measured("cable.termination", seen)


def test_jitter_of_an_unfiltered_line_is_not_taken_for_a_filter(rng: np.random.Generator):
    """Rows that are read early or late have a share of their neighbours: as after a filter that delays by one pixel."""
    seen, _ = seen_of(rng, {"grabber.line_jitter": {"white_ns": 2.9}})
    assert seen.edges is not None and seen.edges.line is not None and not len(seen.edges.line)
    for source in ("grabber.low_pass", "electronics.video_amplifier", "cable.termination", "cable.t_piece"):
        with pytest.raises(MeasureError, match=r"rows jitter by 0\.0\d+ px.*take frames with the pixel clock"):
            measured(source, seen)
    v = seen.edges.optics["spread_var_px2"]
    assert abs(v.value - SPREAD) < LIMIT * v.u < LIMIT * 0.006


def test_what_the_line_needs_is_asked_for(rng: np.random.Generator):
    picture = stored_squares(rng, OPTICS | {"grabber.low_pass": {"kind": "butterworth"}}, cells=1)
    search = search_edges([picture], analogue=True)
    one_sided = [m for m in search.measured if m[0].across == "x"]
    line, optics = fit_line(one_sided)
    assert not len(line) and not len(optics) and all("along x and along y" in why for why in line.reasons.values())
    for clock_mhz, own in ((None, False), (MHZ, False), (10.0, True)):
        assert StatedFacts(interface="analogue", pixel_clock_mhz=MHZ, sampling_clock_mhz=clock_mhz).own_clock is own
    line, optics = fit_line(search.measured, own_clock=True)
    assert not len(line) and not len(optics) and all("a clock of its own" in why for why in line.reasons.values())
    told = Estimates.from_rows([("cutoff_rel", 0.35, 0.001, 500.0, "1")])
    without_clock = Observations(edges=responses_of(search, optics, told), stated=StatedFacts(interface="analogue"))
    with pytest.raises(MeasureError, match="pixel_clock_mhz"):
        measured("grabber.low_pass", without_clock)
    with pytest.raises(MeasureError, match="the camera is digital"):
        measured("grabber.low_pass", Observations(edges=responses_of(search)))
    with pytest.raises(MeasureError, match="needs slanted edges"):
        measured("grabber.low_pass", Observations())
