"""One source of chance: every test draws from a stream of its own, and ``pytest --seed N`` repeats what a run drew.

A run has one seed: fresh, or that of ``--seed``. Each test and each wider fixture derives its stream from this seed and its own name, so
that one test alone draws what it drew in the whole run, whatever ran before it and on whichever worker.
"""

from __future__ import annotations

import hashlib

import numpy as np
import pytest


def rng_of(request: pytest.FixtureRequest, *names: object) -> np.random.Generator:
    """The stream of the test or of the wider fixture that asks: the same for the same seed, node, fixture, parameter and names."""
    name = (request.node.nodeid, request.fixturename, getattr(request, "param_index", 0), *names)
    digest = hashlib.sha256(repr(name).encode()).digest()
    return np.random.default_rng([request.config.getoption("seed"), int.from_bytes(digest)])
