"""An assessment of a simulated camera, made without the pipeline: frames by plain NumPy, a budget with chosen numbers."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path

import numpy as np

from pixmetry.campaign.records import CameraFacts, Campaign, FrameGroup, OpticsFacts
from pixmetry.core.observations import Observations
from pixmetry.experiment.observe import Group, observe

GAIN, NOISE_E, OFFSET, BITS, SHAPE = 0.25, 12.0, 40.0, 12, (96, 120)
LEVELS, STACK = 14, 16
TOP_E = (2**BITS - 1 - OFFSET) / GAIN


@lru_cache(maxsize=2)
def observations(with_stacks: bool = True) -> Observations:
    """What frames of a known camera are reduced to."""
    rng = np.random.default_rng(20240611)
    response = 1 + 0.01 * rng.standard_normal(SHAPE)
    dark_map = 0.5 * rng.standard_normal(SHAPE)

    def frames(share: float, count: int) -> list[np.ndarray]:
        electrons = rng.poisson(share * TOP_E * response, (count, *SHAPE)) + NOISE_E * rng.standard_normal((count, *SHAPE))
        linear = GAIN * electrons
        stored = OFFSET + dark_map + linear * (1 - 0.02 * linear / 2**BITS)
        return list(np.clip(np.rint(stored), 0, 2**BITS - 1).astype(np.uint16))

    exposures = 0.001 * np.arange(1, LEVELS + 1)
    groups = [Group("dark", "level", t, 0.0, frames(0.0, 2)) for t in exposures]
    groups += [Group("bright", "level", t, None, frames(1.1 * t / exposures[-1], 2)) for t in exposures]
    if with_stacks:
        groups += [Group("dark", "stack", 0.007, 0.0, frames(0.0, STACK)), Group("bright", "stack", 0.007, None, frames(0.55, STACK))]
    return observe(groups, BITS)


def campaign(pitch_um: float | None = 7.4, name: str = "Simulated <camera> & co.") -> Campaign:
    """A campaign record with the facts of these frames; its files do not exist."""
    groups = tuple(
        FrameGroup(kind, 0.001 * (k + 1), None, tuple(Path(f"{kind}{k}_{i}.png") for i in range(2)), "level")
        for kind in ("dark", "bright")
        for k in range(LEVELS)
    )
    facts = CameraFacts(name, BITS, pitch_um, pitch_um, sensor="cmos")
    return Campaign(facts, OpticsFacts(), groups, SHAPE, "uint16", Path("campaign.yaml"), licence="CC0, made for a test", notes="A note of the campaign.")
