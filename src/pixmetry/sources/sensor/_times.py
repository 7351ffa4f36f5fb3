"""Shifting the times at which rows look at the scene."""

from __future__ import annotations

import numpy as np

from pixmetry.camera.light import Light


def delayed(light: Light, delay_s: np.ndarray) -> Light:
    """Return the light seen later by so much; ``delay_s`` has shape (n, rows), or (n, 1) where all rows look together."""
    times, weights = light.moments
    times = times + delay_s[:, :, None]
    return light.seen_at(times, np.broadcast_to(weights, times.shape))
