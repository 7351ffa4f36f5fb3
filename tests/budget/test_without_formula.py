"""Sources that no formula describes: their contribution is simulated, and must be what whole frames of the camera show.

The oracle is brute force of its own: whole frames by `Camera.expose`, discs drawn here, a centroid written here, every frame with the
source and without. The budget's simulation is another way: windows, frozen surroundings, paired draws, places of its own choice.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from budget.cameras import camera, element
from budget.test_in_the_chain import CASES, LAW, TARGET, chain, known
from catalogue.support import soft_centroid
from pixmetry.budget import compute_budget
from pixmetry.budget.monte_carlo import Trials
from pixmetry.budget.probe import put
from pixmetry.camera.camera import Camera, Element, load_camera
from pixmetry.camera.catalogue import get_source, sources
from pixmetry.camera.signal import Kind
from pixmetry.core.errors import ChainError
from pixmetry.locate.centroids.fixed import FixedCentroid
from pixmetry.scene.discs import Discs
from pixmetry.scene.uniform import Uniform

PRESETS = ("cid_generic", "dcs420_like", "ft_ccd_generic", "imx264_like", "pulnix_tm6cn", "pulnix_tm6cn_epix_512", "sony_xc8500_field")
SIMULATED = {
    "optics.olpf": {},
    "optics.point_spread": {"sigma_px": 0.6},
    "sensor.image_lag": {},
    "sensor.pixel_aperture": {},
    "sensor.read_out": {},
    "sensor.smear": {},
    "grabber.sampling_clock": {"clock_mhz": 11.0},
    "grabber.window_offset": {},
}
CLOCKS = {"grabber.sampling_clock": (14.1875e6, 20e6)}
SIDE, FRAMES, HOLD = 13, 1200, 3  # of the oracle; the side is that of the window of `LAW`
LIGHT = 100.0 / (0.5 * 0.01)  # photons for 100 DN of the small camera


def simulated(source_id: str, clock_hz: float) -> tuple[Camera, Element]:
    source = get_source(source_id)
    params = source.typical.model_dump() | SIMULATED[source_id]
    return camera(pixel_clock_hz=clock_hz), element(source_id, **params)


def by_brute_force(cam: Camera, seed: int) -> np.ndarray:
    """Place found less place that the layout gives, in px of the sensor; one disc in the middle part of each frame, shape (2, frames).

    The disc rests for some frames, of which the last is looked at: what remembers the frames before has settled.
    """
    rng = np.random.default_rng(seed)
    rows, cols = cam.frame_shape
    x, y = (np.repeat(rng.uniform(40, side - 41, FRAMES // HOLD), HOLD) for side in (cols, rows))
    light = {"peak_photons": 1.4 * LIGHT, "background": Uniform(0.1 * LIGHT)}
    scene = Discs(x_px=x[:, None], y_px=y[:, None], diameter_px=7.0, blur_px=0.7, per_frame=True, **light)
    seen = np.arange(HOLD - 1, len(x), HOLD)
    data = cam.expose(scene, len(x), seed=3, threads=1).data[seen].astype(float)
    at_x, at_y = cam.layout(x[seen], y[seen], seen)
    row, col = np.rint(at_y).astype(int) - SIDE // 2, np.rint(at_x).astype(int) - SIDE // 2
    windows = np.stack([d[r : r + SIDE, c : c + SIDE] for d, r, c in zip(data, row, col, strict=True)])
    threshold = float(np.median(cam.expose(Uniform(0.22 * LIGHT), quiet=True).data))
    found_x, found_y = soft_centroid(windows, threshold)
    step = [float(np.diff(v)[0]) for v in cam.layout([0.0, 1.0], [0.0, 1.0])]
    return np.stack([(found_x + col - at_x) / step[0], (found_y + row - at_y) / step[1]])


@pytest.mark.parametrize(("source_id", "clock_hz"), [(s, c) for s in SIMULATED for c in CLOCKS.get(s, (14.1875e6,))])
def test_the_simulated_contribution_is_that_of_whole_frames(source_id: str, clock_hz: float, seed: int) -> None:
    """Root mean square and mean of the shifts in x and y: within 6 standard errors of both, and 5 % for what the two thresholds differ."""
    cam, one = simulated(source_id, clock_hz)
    facts = known(cam)
    said = Trials(cam, TARGET, LAW, facts, trials=1024, units=4, seed=seed).alone(one).contribution(one.source.gum_class)
    assert said is not None
    shift = by_brute_force(put(cam, one), seed) - by_brute_force(cam, seed)
    frames = shift.shape[1]
    for k, (u, bias) in enumerate(zip(said.u_px, said.bias_px, strict=True)):
        mean, std = shift[k].mean(), shift[k].std(ddof=1)
        of_std = np.std((shift[k] - mean) ** 2) / np.sqrt(frames) / (2 * std) if std > 0 else 0.0
        text = f"{source_id}: u {u:.6f}, bias {bias:.6f} ± {said.floor_px:.6f}; whole frames {std:.6f} ± {of_std:.6f}, {mean:.6f}"
        assert abs(u - std) <= 6 * of_std + 3 * said.floor_px + 0.05 * std + 1e-4, text
        assert abs(bias - mean) <= 6 * std / np.sqrt(frames) + 3 * said.floor_px + 0.05 * (abs(mean) + std) + 1e-4, text


@pytest.mark.parametrize("source_id", [*CASES, *SIMULATED])
def test_a_source_that_the_chain_does_not_hold_acts_as_one_that_it_holds(source_id: str) -> None:
    """Put into a chain for the simulation, it does what it does in the chain that holds it: bit for bit, as the draws are its own."""
    clock_hz = list((14.1875e6, 28.4e6))[len(source_id) % 2]
    converter = ["grabber.adc"] if Kind.CODES in get_source(source_id).consumes else []
    whole = chain(source_id, *converter, clock_hz=clock_hz)
    without = replace(whole, chain=tuple(e for e in whole.chain if e.name != source_id))
    facts = known(whole)
    inside, beside = (Trials(c, TARGET, LAW, facts, trials=16, units=2, seed=1) for c in (whole, without))
    order = [e.source.id for e in put(without, whole[source_id]).chain]
    if order != [e.source.id for e in whole.chain]:
        pytest.skip("another order of the same stage")
    assert beside.alone(whole[source_id]) == inside.of(only=[source_id])


def test_every_source_of_the_presets_has_a_contribution_or_cannot_be_left_out() -> None:
    """What stands in a chain without one are conversions that scale all pixels alike; nothing that counts is left without a number."""
    told = set()
    for name in PRESETS:
        cam = load_camera(name)
        for e in cam.active:
            if e.source.propagate is None and (e.source.forward is None or e.source.essential and e.source.ideal is None):
                told.add(e.source.id)
    assert told == {"sensor.quantum_efficiency", "electronics.gain"}
    cam = put(camera(element("optics.point_spread", sigma_px=0.5)), element("sensor.exposure"))
    budget = compute_budget(cam, None, {"noise_dn": 0.6}, TARGET, FixedCentroid(), trials=0)
    for row in budget.rows:
        bare = row.source_id in told
        assert row.contribution is not None or bare or row.status in ("not applicable", "left to calibration"), (row.name, row.reason)
        assert row.contribution is None or np.isfinite(row.total_px)


@pytest.mark.parametrize(
    "name", ["sensor.exposure", "sensor.interlace", "sensor.light_pulses", "sensor.rolling_shutter", "sensor.trigger_jitter"]
)
def test_what_moves_moving_targets_only_is_refused_with_the_reason(name: str) -> None:
    """In the camera or not: neither a contribution of 0, as if it were known of a moving target, nor left to a calibration."""
    plain = camera(element("optics.point_spread", sigma_px=0.5))
    for cam in (plain, put(plain, element(name))):
        budget = compute_budget(cam, None, {"noise_dn": 0.6}, TARGET, FixedCentroid(), trials=0)
        row = next(r for r in budget.rows if r.name == name)
        assert row.contribution is None and row.status == "not applicable" and not row.counts
        assert name == "sensor.light_pulses" and cam is plain or ("at rest" in row.reason and "speed" in row.reason)


def test_a_chain_without_a_place_says_so() -> None:
    with pytest.raises(ChainError):
        put(Camera("empty", (8, 8), ()), Element("x", sources()["grabber.adc"], sources()["grabber.adc"].typical))
