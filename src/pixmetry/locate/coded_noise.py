"""What a coder of blocks (JPEG) does to positions: its rounding is no noise of pixels, and residuals do not tell it.

A coder rounds the cosine coefficients of each block to multiples of their steps (ITU-T T.81). Where the steps are known, templates can be
sent through it: with the noise that was there before, at all places in a block. What comes out moves them by as much as it moves targets.
"""

from __future__ import annotations

import numpy as np

from pixmetry.camera.jpeg_tables import BLOCK
from pixmetry.core.random import generator
from pixmetry.locate.detect.blocks import Coder, coded
from pixmetry.locate.drawn_targets import Drawn, Spread
from pixmetry.locate.noise import NoiseModel

DRAWS = 2  # of noise, at each place in a block
LEAST_FACTOR = 0.02  # of a variance: below, the coder leaves nothing of the target that noise could move, and tells nothing of its place


def coder_spread(one: Drawn, noise: NoiseModel, coder: Coder, sigma_dn: float) -> tuple[Spread, float]:
    """What a coder makes of the covariance of a target, and the variance of the residuals that it leaves over that of the noise model.

    Parameters
    ----------
    one : Drawn
    noise : NoiseModel
        By which its fit was weighted.
    coder : Coder
        With its steps.
    sigma_dn : float
        Noise before it.
    """
    sigma, gain, basis = one.gains(noise)
    side = len(one.mean)
    whole = -(-(side + BLOCK - 1) // BLOCK) * BLOCK
    rng = generator(0, "coded noise")
    images = np.empty((BLOCK * BLOCK * DRAWS, whole, whole))
    places = [(r, c) for r in range(BLOCK) for c in range(BLOCK) for _ in range(DRAWS)]
    for image, (r, c) in zip(images, places, strict=True):
        image[:] = np.pad(one.mean, ((r, whole - side - r), (c, whole - side - c)), mode="edge")
    after = coded(images + rng.normal(0, sigma_dn, images.shape), coder)
    error = np.stack([a[r : r + side, c : c + side] for a, (r, c) in zip(after, places, strict=True)]) - one.mean
    white = np.where(one.mask, error / sigma, 0.0).reshape(len(error), -1)
    moved = white @ gain.reshape(len(gain), -1).T
    factor = (moved**2).mean(axis=0) / (gain**2).sum(axis=(1, 2))
    factor = np.where(factor < LEAST_FACTOR, 1.0, factor)
    left = (white**2).sum(axis=1) - ((white @ basis.reshape(len(basis), -1).T) ** 2).sum(axis=1)
    return Spread(factor, 0.0), float(left.mean()) / max(float(one.mask.sum()) - len(gain), 1.0)
