"""Frames of codes, targets drawn by sub-sampling, and a centroid, for the tests of the processing."""

from __future__ import annotations

import numpy as np

from pixmetry.camera.signal import Kind, Signal
from source_signals import signal

SUB = 8


def codes(frames: np.ndarray, **place) -> Signal:
    """Frames (n, rows, cols), or one frame, of whole numbers."""
    frames = np.asarray(frames)
    frames = frames[None] if frames.ndim == 2 else frames
    return signal(frames, Kind.CODES, **place).with_data(frames.astype(np.uint16))


def disc(x: float, y: float, diameter: float, size: int = 25, blur: float = 0.7, peak: float = 150.0) -> np.ndarray:
    """Disc under a Gaussian blur, integrated over pixels by 8 × 8 points; the centre is given from the middle pixel."""
    from scipy.ndimage import gaussian_filter

    at = (np.arange(size * SUB) + 0.5) / SUB - size / 2
    r = np.hypot(at - x, at[:, None] - y)
    fine = gaussian_filter(np.clip((diameter / 2 - r) * SUB + 0.5, 0, 1), blur * SUB)
    return peak * fine.reshape(size, SUB, size, SUB).mean(axis=(1, 3))


def soft_centroid(image: np.ndarray, threshold: float, radius: float = 9.0) -> tuple[float, float]:
    """Centre of what stands above the threshold within a round window about the middle pixel, from there."""
    axis = np.arange(len(image)) - len(image) // 2
    weight = np.maximum(image - threshold, 0) * (np.hypot(axis, axis[:, None]) <= radius)
    return float((weight * axis).sum() / weight.sum()), float((weight * axis[:, None]).sum() / weight.sum())
