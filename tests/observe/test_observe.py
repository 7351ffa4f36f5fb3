"""Which of several stacks belong together: exposures of dark and bright frames are paired, not frame counts."""

from __future__ import annotations

import numpy as np
import pytest

from pixmetry.camera.observations import Observations
from pixmetry.observe.observe import Group, observe

SHAPE, GAIN, FULL_E = (48, 64), 0.25, 14000.0
PRNU, DARK_E_PER_S = 0.01, 2000.0


def camera(seed: int):
    """Frames of a camera with 1 % PRNU and a dark current that differs by 60 % from pixel to pixel; full scale in 10 ms of light."""
    rng = np.random.default_rng(seed)
    response = 1 + PRNU * rng.standard_normal(SHAPE)
    dark = DARK_E_PER_S * np.maximum(1 + 0.6 * rng.standard_normal(SHAPE), 0)

    def frames(exposure_s: float, lit: bool, count: int) -> list[np.ndarray]:
        mean_e = dark * exposure_s + (FULL_E * exposure_s / 0.01 * response if lit else 0)
        electrons = rng.poisson(mean_e, (count, *SHAPE)) + 8 * rng.standard_normal((count, *SHAPE))
        return list(np.clip(np.rint(60 + GAIN * electrons), 0, 4095).astype(np.uint16))

    return frames


def seen(rng: np.random.Generator, stacks: list[tuple[str, float, int]]) -> Observations:
    """Reduce an exposure series to 10 ms and stacks of (kind, exposure, frames)."""
    frames = camera(int(rng.integers(2**31)))
    exposures = 0.001 * np.arange(1, 11)
    groups = [Group(kind, "level", t, None, frames(t, kind == "bright", 2)) for kind in ("dark", "bright") for t in exposures]
    groups += [Group(kind, "stack", t, None, frames(t, kind == "bright", n)) for kind, t, n in stacks]
    return observe(groups, 12)


@pytest.mark.parametrize("long_first", [True, False])
def test_more_dark_frames_of_another_exposure_change_nothing(long_first, rng: np.random.Generator):
    """PRNU as planted within 10 % (3072 pixels: 1.3 %, 7 u at 1e-6); with the dark map of 0.2 s (60 DN of fixed pattern) 3.5 %."""
    stacks = [("dark", 0.2, 24), ("dark", 0.005, 16), ("bright", 0.005, 16)]
    got = seen(rng, stacks if long_first else stacks[::-1])
    assert got.dark_stack.exposure_s == got.bright_stack.exposure_s == 0.005
    assert got.spatial_fit["prnu_pixel_rel"].value == pytest.approx(PRNU, rel=0.1)
    assert got.dark_spectra is not None and got.bright_spectra is not None
    assert not any("exposure" in note for note in got.notes)


def test_of_several_pairs_the_longest_that_is_not_saturated(rng: np.random.Generator):
    kinds = ("dark", "bright")
    got = seen(rng, [(kind, t, n) for t, n in ((0.002, 20), (0.006, 12), (0.02, 30)) for kind in kinds])
    assert got.dark_stack.exposure_s == got.bright_stack.exposure_s == 0.006


def test_of_one_exposure_the_most_frames(rng: np.random.Generator):
    got = seen(rng, [("dark", 0.005, 9), ("dark", 0.005, 12), ("bright", 0.005, 16), ("bright", 0.005, 10)])
    assert (got.dark_stack.n_frames, got.bright_stack.n_frames) == (12, 16)


def test_clocks_that_round_are_a_pair(rng: np.random.Generator):
    got = seen(rng, [("dark", 0.005, 10), ("bright", 0.005004, 10)])
    assert got.spatial_fit is not None


def test_without_a_pair_it_refuses_and_says_what_to_take(rng: np.random.Generator):
    """The nearest dark stack serves for what the dark tells alone."""
    got = seen(rng, [("dark", 0.2, 24), ("dark", 0.007, 16), ("bright", 0.005, 16)])
    assert got.dark_stack.exposure_s == 0.007
    assert got.bright_stack is None and got.bright_spectra is None
    assert {name.split("_")[0] for name in got.spatial_fit.names} == {"dsnu"}
    assert got.defects is not None
    assert [note for note in got.notes if "dark 0.007 s, bright 0.005 s" in note and "dark frames at 0.005 s" in note]


def test_one_kind_alone(rng: np.random.Generator):
    got = seen(rng, [("dark", 0.005, 9), ("dark", 0.2, 12)])
    assert got.dark_stack.n_frames == 12 and {name.split("_")[0] for name in got.spatial_fit.names} == {"dsnu"}
    assert any("no stack of bright frames" in note for note in got.notes)
    got = seen(rng, [("bright", 0.005, 9)])
    assert got.bright_stack is not None and got.dark_stack is None
    assert any("no stack of dark frames" in note for note in got.notes)
