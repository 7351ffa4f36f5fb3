"""Simulated networks measured again and again with new noise, and adjusted."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from calibrate.networks import Simulated, predicted
from pixmetry.calibrate.bundle.bundle import adjust
from pixmetry.calibrate.bundle.network import Adjustment, Network

NOISE_PX = 0.04


def measured_again(rng: np.random.Generator, simulated: Simulated, exact: np.ndarray | None = None, noise_px: float = NOISE_PX) -> Network:
    """The same network with other noise. ``exact``: its true image coordinates, which take a while to compute."""
    exact = predicted(simulated.network, simulated.truth) if exact is None else exact
    x, y = (exact + noise_px * rng.standard_normal(exact.shape)).T
    return replace(simulated.network, x_px=x, y_px=y)


def shifted(network: Network, dx: np.ndarray | float = 0.0, dy: np.ndarray | float = 0.0) -> Network:
    """Something added to what was measured."""
    return replace(network, x_px=network.x_px + dx, y_px=network.y_px + dy)


def adjusted(network: Network, simulated: Simulated, **options) -> Adjustment:
    """Adjusted from the true values on."""
    return adjust(network, simulated.truth, redundancy=True, **options)
