"""Targets followed on the stream of a camera in the process, whose image drifts as that of a camera that warms up."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from capture.live_cameras import LiveDouble
from pixmetry.capture.follow import Followed, follow

SHIFT_PX, TAU_S, NOISE_DN, STEP_S = 0.3, 600.0, 12.0, 60.0
PLACES = [(22.3 + 31.4 * i, 20.6 + 29.7 * j) for i in range(4) for j in range(3)]


class Warming(LiveDouble):
    """Twelve discs whose image moves along x by 0.3 px in ten minutes; a frame a minute."""

    start_s = 1.7e9

    def __init__(self, rng: np.random.Generator, faults: dict[int, str] | None = None) -> None:
        super().__init__(rng, faults)
        self.now_s = self.start_s

    def picture(self) -> np.ndarray:
        y, x = np.indices((104, 140))
        moved = SHIFT_PX * (1 - np.exp(-(self.now_s - self.start_s) / TAU_S))
        grey = np.full(x.shape, 300.0)
        for px, py in PLACES:
            grey += 2000 / (1 + np.exp(2.5 * (np.hypot(x - px - moved, y - py) - 6)))
        return np.clip(np.rint(grey + self.rng.normal(0, NOISE_DN, x.shape)), 0, 4095).astype(np.uint16)

    def frame(self, timeout_s: float):
        self.now_s += STEP_S
        found = super().frame(timeout_s)
        return found

    def clock(self) -> float:
        return self.now_s


def checked(found: Followed) -> None:
    """The shift from the first frame on, which is a minute old, and when it is stable: τ ln(shift/0.05) = 17 min later; 5 u: 6e-7."""
    moves = SHIFT_PX * np.exp(-STEP_S / TAU_S)
    shift = found.series.drift.fit["shift_x_px"]
    assert abs(shift.value - moves) < 5 * shift.u + 0.001 and shift.u < 0.02
    stable = found.series.drift.stable
    assert abs(stable.value - TAU_S * np.log(moves / 0.05)) < 5 * stable.u + 30 and stable.u < 400
    assert (found.report.parent / "series.json").is_file()


def test_drift_and_repeatability_of_a_stream(rng: np.random.Generator, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("pixmetry.capture.follow.TELL_S", 3000.0)
    camera = Warming(rng, {7: "lost2", 12: "incomplete", 30: "copied"})
    told: list[str] = []
    found = follow(camera, tmp_path / "out", frames=70, exposure_s=0.01, tell=told.append, clock=camera.clock)
    checked(found)
    assert found.faults == {"missed": 2, "damaged": 1, "doubled": 1}
    assert len(found.series.frames) == 70 and any("px to go" in line for line in told)
    s = found.statistics
    assert len(s.frames) == len(PLACES) and np.all(s.frames == 70)
    assert 0.5 < np.median(s.repeat_y_px) / np.median(s.stated_y_px) < 1.5


def test_a_stream_that_broke_off_goes_on(rng: np.random.Generator, tmp_path: Path) -> None:
    camera = Warming(rng)

    def breaks(sent: int) -> None:
        if sent == 36:
            raise RuntimeError("killed")

    camera.after = breaks
    with pytest.raises(RuntimeError):
        follow(camera, tmp_path / "out", frames=70, clock=camera.clock)
    log = tmp_path / "out.frames.jsonl"
    assert len(log.read_bytes().splitlines()) == 2 + 35
    log.write_bytes(log.read_bytes() + b'{"frame": "17000')
    camera.after = lambda sent: None
    found = follow(camera, tmp_path / "out", frames=70, clock=camera.clock)
    assert len(found.series.frames) == 70 and camera.sent == 36 + 35
    checked(found)


def test_an_interruption_writes_the_results(rng: np.random.Generator, tmp_path: Path) -> None:
    camera = Warming(rng)

    def stop(sent: int) -> None:
        if sent == 25:
            raise KeyboardInterrupt

    camera.after = stop
    found = follow(camera, tmp_path / "out", clock=camera.clock)
    assert len(found.series.frames) == 24 and found.report.is_file()
