"""Frames of targets that all tests of a run share."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache

import numpy as np
import pytest

from chance import rng_of
from locate.target_frames import draw_lattice


@pytest.fixture(scope="session")
def lattice(request: pytest.FixtureRequest) -> Callable[..., tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """`draw_lattice`, each kind drawn once in a run."""

    @lru_cache(64)
    def drawn(radius: float, blur: float, **kw: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        return draw_lattice(rng_of(request, radius, blur, *sorted(kw.items())), radius, blur, **kw)

    return drawn
