"""What every source is said to do to a target, against the camera with it and without: in its own chain, at its own clock.

The cameras are analogue: a Butterworth filter of 5 MHz stands on the line, whatever else is on it, and one grabber samples with a clock
of its own. Pixel clocks from 10 to 28.4 MHz, and frames of several sizes. Sources of the line are tried at every clock; each source of
the catalogue is tried in `test_rows_against_brute_force`. What a propagator predicts must be what the Monte Carlo of the same chain
shows, within the error that it declares.

A false failure in 1e-6 of the comparisons: 8 standard errors, the quantile of Student's t for the 16 units of which a mean may be (for
means over the places it is more than enough). With 192 places a standard deviation is known to 5 %: an error of a factor of 1.4
beyond the declared one is seen, and for filters and cables, which are nearly constant, of some thousandths of a pixel.
"""

from __future__ import annotations

import numpy as np
import pytest

from budget.cameras import camera
from pixmetry.budget.monte_carlo import Trials
from pixmetry.budget.probe import Facts, Probes, Target, facts_of
from pixmetry.camera.camera import Camera, Element, in_order
from pixmetry.camera.catalogue import get_source, sources
from pixmetry.camera.signal import Kind
from pixmetry.camera.source import Source
from pixmetry.locate.centroids.fixed import FixedCentroid

CLOCKS = {10e6: (120, 160), 14.1875e6: (200, 300), 14.75e6: (96, 400), 28.4e6: (160, 240)}
OWN_CLOCK = 14.75e6  # of the pixels, where the grabber's is another
QUANTILE = 8.0
CASES = {i: s for i, s in sources().items() if s.forward is not None and s.propagate is not None and s.ideal is None}
ON_LINE = [i for i, s in CASES.items() if Kind.VIDEO in s.consumes and i != "grabber.low_pass"]
TARGET, LAW = Target(peak_rel=0.7, background_rel=0.05), FixedCentroid(threshold_dn=12.0)


def element(source_id: str, **params: object) -> Element:
    source = get_source(source_id)
    return Element(source_id, source, source.make(params) if params else source.typical)


def chain(*sources: str, clock_hz: float) -> Camera:
    """Conversions, the filter, the grabber's clock where it has one, and these sources with the parameters of a camera of 200 DN."""
    elements = {e.name: e for e in camera().chain} | {s: element(s) for s in sources}
    for s in sources:
        ours = {k: v for k, v in {"reference_dn": 200.0, "target_dn": 12.0}.items() if k in get_source(s).parameters.model_fields}
        elements[s] = element(s, **(get_source(s).typical.model_dump() | ours))
    elements |= {"grabber.low_pass": element("grabber.low_pass", kind="butterworth", cutoff_mhz=5.0)}
    if clock_hz == OWN_CLOCK:
        elements |= {"grabber.sampling_clock": element("grabber.sampling_clock", clock_mhz=11.0)}
    ordered = in_order(e.source for e in elements.values())
    by_id = {e.source.id: e for e in elements.values()}
    facts = {"saturation_dn": 200.0, "bits": 8}
    return Camera("chain", CLOCKS[clock_hz], tuple(by_id[s.id] for s in ordered), facts=facts, pixel_clock_hz=clock_hz)


def known(cam: Camera) -> Facts:
    return facts_of(cam, TARGET, {"noise_dn": 0.6})


def agree(source: Source, cam: Camera, trials: Trials, probes: Probes) -> None:
    said = source.propagate(cam[source.id].params, probes.of(source.id, source))
    seen = trials.of(only=[source.id])
    assert seen.lost == 0
    rare = said.total_px * np.sqrt((said.kurtosis - 1) / (seen.units * seen.places)) / 2
    for axis, u, bias in ((seen.x, said.u_x_px, said.bias_x_px), (seen.y, said.u_y_px, said.bias_y_px)):
        text = f"u {u:.5f}, bias {bias:.5f}; Monte Carlo {axis.u:.5f} ± {axis.se_u:.5f}, {axis.bias:.5f} ± {axis.se_bias:.5f}"
        assert abs(axis.u - u) <= max(said.model_error * u, said.floor_px) + QUANTILE * np.hypot(axis.se_u, rare), text
        size = max(abs(bias), u)
        assert abs(axis.bias - bias) <= max(said.model_error * size, said.floor_px) + QUANTILE * axis.se_bias, text


LOGARITHMIC = ("sensor.prnu", "sensor.shot_noise", "sensor.log_response", "grabber.adc", "electronics.column_noise")


@pytest.mark.parametrize("mode", ["log", "lin-log"])
def test_a_logarithmic_camera(mode: str, seed: int) -> None:
    """Black to the end of the scale are 120 electrons to 1300 (lin-log: 600): the response bends by a factor of ten over a target.

    Ahead of the logarithm errors are of electrons, behind it of DN; the response's own are told by its own row.
    """
    own = {"mode": mode, "gain_dn_per_v": 4000.0, "foot_e": 120.0, "knee_e": 90.0, "offset_std_dn": 1.0, "slope_std_rel": 0.01}
    elements = [element(s) for s in ("sensor.quantum_efficiency", *LOGARITHMIC)]
    spread = element("sensor.log_response", **own, foot_std_rel=0.05, noise_dn=0.5)
    elements = [spread if e.name == "sensor.log_response" else e for e in elements]
    by_id = {e.source.id: e for e in elements}
    cam = Camera("log", (96, 128), tuple(by_id[s.id] for s in in_order(e.source for e in elements)), facts={"bits": 8})
    cam = cam.with_parameters("grabber.adc", offset_dn=8.0)
    facts = facts_of(cam, TARGET, {"noise_dn": 2.0})
    law = FixedCentroid()
    trials, probes = Trials(cam, TARGET, law, facts, trials=768, units=16, seed=seed), Probes(cam, facts, TARGET, law)
    for source_id in LOGARITHMIC:
        agree(get_source(source_id), cam, trials, probes)
    whole = trials.of(off=["sensor.log_response"])  # it stays, without its errors
    assert whole.x.u == pytest.approx(trials.of(only=["sensor.log_response"]).x.u, rel=0.5)
    if mode == "log":  # the light that saturates in closed form; kT/q at 20 °C
        saturating_e = 120 * np.expm1(facts.saturation_dn / (4000 * 0.0252617))
        assert facts.gain_dn_per_e == pytest.approx(facts.saturation_dn / saturating_e, rel=1e-3)


@pytest.mark.parametrize("clock_hz", CLOCKS)
@pytest.mark.parametrize("source_id", [*ON_LINE, "grabber.low_pass"])
def test_a_source_of_the_line_behind_the_rest_of_it(source_id: str, clock_hz: float, seed: int) -> None:
    cam = chain(source_id, clock_hz=clock_hz)
    facts = known(cam)
    trials = Trials(cam, TARGET, LAW, facts, trials=192, units=8, seed=seed)
    agree(get_source(source_id), cam, trials, Probes(cam, facts, TARGET, LAW))
