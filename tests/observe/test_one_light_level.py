"""Gain of one light level beside dark frames: its uncertainty holds the scatter of both."""

from __future__ import annotations

import numpy as np
from scipy import stats

from pixmetry import Frames, campaign_of_arrays
from pixmetry.assess.job import observe_campaign

CAMERAS = 100


def test_u_of_a_gain_holds_the_noise_of_the_dark_frames_too() -> None:
    """Two dark frames whose variance is as large as the light's. Σz² of 100 cameras: fails by chance once in 1e6, and finds u that is 1.6
    times too small, as it is without the dark frames' part, in 98 of 100 runs.
    """
    gain, z = 0.5, []
    for seed in range(CAMERAS):
        rng = np.random.default_rng(seed)
        dark = np.rint(rng.normal(100, 10, (2, 32, 32))).astype(np.uint16)
        bright = np.rint(100 + gain * rng.poisson(200, (4, 32, 32)) + rng.normal(0, 10, (4, 32, 32))).astype(np.uint16)
        campaign = campaign_of_arrays([Frames("dark", 0.01, dark), Frames("bright", 0.01, bright)], bits=16)
        found = observe_campaign(campaign, lambda what, done, of: None)[1].photon_transfer_fit["gain_dn_per_e"]
        z.append((found.value - gain) / found.u)
    assert stats.chi2.ppf(5e-7, CAMERAS) < float(np.square(z).sum()) < stats.chi2.isf(5e-7, CAMERAS)
