"""What sources that depend on the place have in common: the frame's centre, shifts and ramps over the frame, and their contributions."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from pixmetry.camera.contribution import Contribution, Probe
from pixmetry.camera.light import Pull
from pixmetry.camera.signal import Signal
from pixmetry.core.arrays import Singles

PLACES = 24  # along each side of the frame, for the spread over it


def frame_centre(frame_shape: tuple[int, int]) -> tuple[float, float]:
    """Column and row of the frame's centre."""
    return (frame_shape[1] - 1) / 2, (frame_shape[0] - 1) / 2


def corner_px(frame_shape: tuple[int, int], aspect: float = 1.0) -> float:
    """Distance of the outer pixels' centres in the corners from the frame's centre, in pixels along x; ``aspect``: height over width."""
    x, y = frame_centre(frame_shape)
    return float(np.hypot(x, aspect * y)) or 1.0


def image_shift(pull: Pull, signal: Signal) -> dict[str, np.ndarray]:
    """How far a coordinate map displaces the image at every pixel: ``shift_x_px`` and ``shift_y_px``, shape (n, rows, cols)."""
    x, y = signal.cols[:, None, :].astype(float), signal.rows[:, :, None].astype(float)
    seen_x, seen_y = pull(x, y)
    return {"shift_x_px": np.broadcast_to(x - seen_x, signal.grid.size), "shift_y_px": np.broadcast_to(y - seen_y, signal.grid.size)}


def map_shifts(pull: Pull, probe: Probe) -> tuple[np.ndarray, np.ndarray]:
    """Displacements of targets at `PLACES` × `PLACES` positions at which the target's window fits into the frame; flat arrays."""
    axes = []
    size = min(probe.signal_dn.shape[1:])  # windows of a video line are wider than the estimator needs
    for side in probe.frame_shape:
        margin = min(size // 2 + 1, (side - 1) / 2)
        axes.append(margin + (np.arange(PLACES) + 0.5) / PLACES * (side - 1 - 2 * margin))
    y, x = (v[None] for v in np.meshgrid(*axes, indexing="ij"))
    u, v = x, y
    for _ in range(4):  # the displacement belongs to the place at which the target is seen
        seen_x, seen_y = pull(u, v)
        u, v = u + x - seen_x, v + y - seen_y
    return (u - x).ravel(), (v - y).ravel()


def map_contribution(pull: Pull, probe: Probe, gum_class: str = "G", **kw: Any) -> Contribution:
    """Contribution of a coordinate map to a target anywhere in the frame, before any calibration (propagator P6, first term)."""
    method = "displacement of targets all over the frame, before calibration"
    # the floor: a displaced target has another phase in the pixel, and the estimator another periodic error
    text: dict[str, Any] = {"model_error": 0.12, "floor_px": 2e-3, "method": method} | kw
    return probe.from_shifts(*map_shifts(pull, probe), gum_class, **text)


def factor_verbs(factor: Callable[[Any, np.ndarray, np.ndarray, tuple[int, int]], np.ndarray]) -> dict[str, Any]:
    """The verbs of a source that multiplies the light by ``factor(params, x_px, y_px, frame_shape)``, at most about 1."""

    def over_frame(params: Any, signal: Signal) -> np.ndarray:
        light = factor(params, signal.cols[:, None, :].astype(float), signal.rows[:, :, None].astype(float), signal.frame_shape)
        shading: Singles = np.maximum(light, 1e-3).astype(np.float32)  # cut off just above 0: the correction divides by it
        return shading

    def forward(params: Any, signal: Signal, stream: Any) -> Signal:
        """Multiply the light by the factor."""
        return signal.with_data(signal.data * over_frame(params, signal))

    def correct(params: Any, signal: Signal, maps: Any) -> Signal:
        """Divide by the factor that the parameters give; it needs no map."""
        return signal.with_data(signal.data / over_frame(params, signal))

    def truth(params: Any, signal: Signal, stream: Any) -> dict[str, np.ndarray]:
        """Relative light of every pixel, shape (rows, cols)."""
        return {"light_rel": over_frame(params, signal)[0]}

    def propagate(params: Any, probe: Probe) -> Contribution:
        """Propagator P3: a relative ramp g moves a centroid by g⟨x²⟩; mean and spread over targets anywhere on the frame."""
        return ramp_contribution(lambda x, y: factor(params, x, y, probe.frame_shape), probe)

    return {"forward": forward, "correct": correct, "truth": truth, "propagate": propagate}


def ramp_contribution(factor: Callable[[np.ndarray, np.ndarray], np.ndarray], probe: Probe) -> Contribution:
    """Contribution of a factor ``(x, y) -> light`` that changes slowly over the frame (P3: a ramp g moves a centroid by g⟨x²⟩)."""
    rows, cols = probe.signal_dn.shape[1:]
    ramp_x = (np.arange(cols) - probe.x_px[:, None])[:, None, :] * probe.signal_dn
    ramp_y = (np.arange(rows) - probe.y_px[:, None])[:, :, None] * probe.signal_dn
    (xx, yx), (xy, yy) = probe.field(ramp_x), probe.field(ramp_y)
    even = (np.arange(PLACES) + 0.5) / PLACES
    y, x = np.meshgrid(even * probe.frame_shape[0] - 0.5, even * probe.frame_shape[1] - 0.5, indexing="ij")
    right, left, down, up = (np.log(factor(x + dx, y + dy)) for dx, dy in ((0.5, 0), (-0.5, 0), (0, 0.5), (0, -0.5)))
    gx, gy = (right - left).ravel()[:, None], (down - up).ravel()[:, None]
    method = "linear response of the estimator to the relative gradient, at positions all over the frame"
    return probe.from_shifts(gx * xx + gy * xy, gx * yx + gy * yy, "G", model_error=0.15, method=method)
