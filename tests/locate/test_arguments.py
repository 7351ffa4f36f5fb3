"""Every keyword of `locate`, `bound` and `Tracker` refuses what it cannot be with one InputError, whose text has the keyword's name."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from pixmetry import Tracker, bound, locate
from pixmetry.core.errors import InputError

NOT_NUMBERS: list[Any] = ["x", [], [1, 2], {}, np.nan, np.inf, -1, 1 + 2j, np.array([1.0, np.nan]), np.zeros((3, 3)), object()]
NOT_WORDS: list[Any] = [5, 1.5, np.nan, "", "x", [], ["a"], {}, None, np.array([]), np.zeros((2, 2)), object()]
WRONG: dict[str, list[Any]] = {
    "kind": NOT_WORDS,
    "estimator": NOT_WORDS,
    "polarity": NOT_WORDS,
    "light_on": NOT_WORDS,
    "dictionary": NOT_WORDS,
    "planes": [v for v in NOT_WORDS if v is not None],
    "grid": [5, 1.5, np.nan, True, {}, "x", [], (1, 2, 3), np.array(3), object(), 10**30],
    "noise": [5, np.nan, [], {}, np.zeros(3), object(), "read=x"],
    "with_": [5, np.nan, [], {}, np.zeros(3), object()],
    "bits": [*NOT_NUMBERS, 0, 17, 1.5],
    "aperture_px": [*NOT_NUMBERS, None, 2],
    "rois": [5, np.nan, object(), "x", [], [5], [[0, 0, 9]], [[0, 0, 1e300, 3]], [[0, 0, 999, 3]], np.array(3)],
    "mask": [5, "x", [], np.zeros((3, 3)), np.full((60, 80), np.nan)],
    "places_px": [5, "x", [], [1], [[np.nan, 1.0]], ["a", "b"], object()],
    "diameter_px": [5, "x", [], (3, 2), (np.nan, 1), (1, 2, 3), np.array(3), object()],
    "contrast_dn": [5, "x", [], (3, 2), (np.nan, 1), (1, 2, 3), np.array(3), object()],
    "threshold_sigma": [*NOT_NUMBERS, None, 0],
    "false_alarms": [*NOT_NUMBERS, None, 0],
    "jpeg_steps": [5, "x", [], np.zeros((8, 8)), np.full((8, 8), np.nan), object()],
    "threads": ["x", [], {}, 0, -1, 1.5, np.nan, object()],
    "name": [5, [], None, object()],
    "search_px": [*NOT_NUMBERS, 0],
    "time": [v for v in NOT_NUMBERS if not isinstance(v, int)],
}  # fmt: skip
DISC = {"radius_px": 3.5, "blur_px": 0.7, "amplitude_dn": 150.0, "background_dn": 10.0}
WRONG_FOR_BOUND: dict[str, list[Any]] = {
    "kind": NOT_WORDS,
    "estimator": NOT_WORDS,
    "light_on": NOT_WORDS,
    "parameters": [5, None, "x", [], {}, {3: 4}, *({**DISC, "radius_px": v} for v in (*NOT_NUMBERS, None, 1e300))],
    "noise": [5, np.nan, [], None, np.zeros(3), object(), "read=x"],
    "unknowns": [5, None, "x", [], [1], np.array(3), object()],
    "frames": [*NOT_NUMBERS, None, 0, 1.5],
    "phases": [*NOT_NUMBERS, None, 0, 2, 51],
    "aperture_px": [*NOT_NUMBERS, None, 2],
    "window_px": [*NOT_NUMBERS, 0, 4, 10**30],
    "pattern_dn": [*NOT_NUMBERS, None, 1e300],
    "rounded": [5, None, "x", [], object()],
}


@pytest.fixture(scope="module")
def frame() -> np.ndarray:
    """One disc, with a little noise."""
    y, x = np.indices((60, 80))
    disc = 20 + 150 / (1 + np.exp(4 * (np.hypot(x - 24.3, y - 18.6) - 4)))
    return np.rint(disc + np.random.default_rng(0).normal(0, 1, x.shape)).astype(np.uint8)


@pytest.mark.parametrize("keyword", [k for k in WRONG if k not in ("search_px", "time")])
def test_locate_names_the_keyword_that_it_cannot_use(keyword: str, frame: np.ndarray) -> None:
    for value in WRONG[keyword]:
        with pytest.raises(InputError) as refused:
            locate(frame, **{keyword: value})
        assert keyword in str(refused.value), value


@pytest.mark.parametrize("keyword", ["rois", "kind", "estimator", "polarity", "noise", "bits", "search_px", "time", "threads"])
def test_the_tracker_names_the_keyword_that_it_cannot_use(keyword: str, frame: np.ndarray) -> None:
    for value in WRONG[keyword]:
        with pytest.raises(InputError) as refused:
            Tracker(frame, **{keyword: value})
        assert keyword in str(refused.value), value


@pytest.mark.parametrize("keyword", list(WRONG_FOR_BOUND))
def test_bound_names_the_keyword_that_it_cannot_use(keyword: str) -> None:
    usual: dict[str, Any] = {"kind": "disc", "parameters": DISC, "noise": "read=1.5,gain=0.4,bits=8", "phases": 3}
    for value in WRONG_FOR_BOUND[keyword]:
        with pytest.raises(InputError) as refused:
            bound(**{**usual, keyword: value})
        assert keyword in str(refused.value), value


def test_what_is_followed_are_frames(frame: np.ndarray) -> None:
    tracker = Tracker(frame)
    for frames in (5, None, np.array(3), np.zeros((3, 3)), ["x"]):
        with pytest.raises(InputError, match="frame"):
            list(tracker.follow(frames))  # type: ignore[arg-type]
    with pytest.raises(InputError, match="time"):
        tracker.update(frame, time="now")  # type: ignore[arg-type]
    assert tracker.update(frame).found.all()


def test_a_place_beyond_all_numbers_has_no_target(frame: np.ndarray) -> None:
    found = locate(frame, places_px=[(24, 19), (1e300, 1e300)])
    assert len(found) == 1 and "no target at a given place" in found.left_out.reason
