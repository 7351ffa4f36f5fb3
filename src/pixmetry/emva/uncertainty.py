"""How an exposure series would scatter if the same camera were measured again: draws from its noise, and bootstrap draws.

The causes and their sizes are those of ``pixmetry.emva.scatter``.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import replace
from statistics import NormalDist

import numpy as np

from pixmetry.core.arrays import Array
from pixmetry.core.random import Generator
from pixmetry.emva.records import Series
from pixmetry.emva.scatter import Scatter

MOVED = (
    "mean_dn",
    "var_dn2",
    "spatial_var_dn2",
    "dark_mean_dn",
    "dark_var_dn2",
    "dark_spatial_var_dn2",
    "own_dark_mean_dn",
    "own_dark_var_dn2",
)


def draw_blocks(s: Scatter, blocks: Iterable[tuple[int, Iterable[str]]], rng: Generator) -> Series:
    """Draws of the series by normal noise of the sizes that ``scatter_of`` finds, about its smooth centre.

    Parameters
    ----------
    s : Scatter
    blocks : iterable of (int, iterable of str)
        Numbers of draws and which causes act in them, of ``GROUPS``; one block after the other.
    rng : numpy.random.Generator

    Returns
    -------
    Series
        Measured values of shape (draws of all blocks, levels), or (1, levels) where nothing moves them.
    """
    plan = [(n, frozenset(groups)) for n, groups in blocks]
    total = sum(n for n, _ in plan)

    def noise(group: str, u: Array) -> Array:
        if not any(group in on for _, on in plan):
            return np.zeros((1, u.size))
        out = np.zeros((total, u.size))
        first = 0
        for n, on in plan:
            if group in on:
                rng.standard_normal(out=out[first : first + n])
            first += n
        out *= u
        return out

    return _moved(
        s,
        light=noise("light", s.u_light),
        variance=noise("variance", s.u_variance),
        dark_mean=noise("dark_mean", s.u_dark_mean),
        dark_variance=noise("dark_variance", s.u_dark_variance),
        spatial=noise("spatial", s.u_spatial),
        dark_spatial=noise("spatial", s.u_dark_spatial),
        counts=noise("counts", np.ones(_ends_in_sight(s).size)),
    )


def add_wave(vectors: Array, s: Scatter, frames: int, rng: Generator) -> Array:
    """Draws of a dark stack's statistics (``SpatialInputs.draws``) with what a wave through the frames adds to their scatter.

    A wave that moves from frame to frame (interference on the video signal) makes the product of two frames scatter: p cos Δφ for a wave
    of variance p. The temporal variance of a pair is σ² less that product, so the dark levels show its size. The mean image of L frames
    holds the mean of L(L − 1)/2 such products.
    """
    out = vectors.copy()
    out[:, 1] += rng.standard_normal(out.shape[0]) * s.wave_dn2 * math.sqrt(2 / (frames * (frames - 1)))
    return out


def about(draws: Series, centre: Series, measured: Series) -> Series:
    """The same draws about the measured series instead of the smooth one.

    For values that choose how to smooth from the scatter of the levels: the smooth series has none.
    """
    return replace(draws, **{k: getattr(draws, k) + (getattr(measured, k) - getattr(centre, k)) for k in MOVED})


def bootstrap_series(s: Scatter, draws: int, rng: Generator) -> Series:
    """Draws of the series by its own residuals: a residual bootstrap (Efron & Tibshirani 1993, §9.4), a level being the unit.

    The residuals of light and variance of a level, each over its standard deviation, are given together to a level drawn at random; those
    of a dark level likewise. What has no residuals (``spatial``, ``counts``) is drawn as in :func:`draw_blocks`.

    Notes
    -----
    Two frames at a level cannot be resampled one by one: half of all resamples would hold one frame twice, with no variance at all.
    """
    bright = rng.integers(s.z_light.size, size=(draws, s.u_light.size))
    dark = rng.integers(s.z_dark_mean.size, size=(draws, s.u_dark_mean.size))
    return _moved(
        s,
        light=s.z_light[bright] * s.u_light,
        variance=s.z_variance[bright] * s.u_variance,
        dark_mean=s.z_dark_mean[dark] * s.u_dark_mean,
        dark_variance=s.z_dark_variance[dark] * s.u_dark_variance,
        spatial=rng.standard_normal((draws, s.u_spatial.size)) * s.u_spatial,
        dark_spatial=rng.standard_normal((draws, s.u_dark_spatial.size)) * s.u_dark_spatial,
        counts=rng.standard_normal((draws, _ends_in_sight(s).size)),
    )


def _moved(
    s: Scatter,
    light: Array,
    variance: Array,
    dark_mean: Array,
    dark_variance: Array,
    spatial: Array,
    dark_spatial: Array,
    counts: Array,
) -> Series:
    """The centre with these changes: of the level means by the light, of the variances for themselves, of the dark levels."""
    c = s.centre
    own_mean, own_var = c.own_dark_mean_dn + dark_mean, c.own_dark_var_dn2 + dark_variance
    relative = np.divide(light, c.mean_dn - c.dark_mean_dn, out=np.zeros_like(light), where=s.light_slope != 0)
    return replace(
        c,
        mean_dn=c.mean_dn + light,
        var_dn2=np.maximum(c.var_dn2 + variance + s.light_slope * light, 0.0),
        spatial_var_dn2=c.spatial_var_dn2 * (1 + relative) ** 2 + spatial - s.spatial_share * variance,
        dark_mean_dn=_beside(own_mean, s.weights),
        dark_var_dn2=_beside(own_var, s.weights),
        dark_spatial_var_dn2=_beside(s.own_dark_spatial_dn2 + dark_spatial - s.dark_spatial_share * dark_variance, s.weights),
        fraction_max=_top_shares(s, light, counts),
        own_dark_mean_dn=own_mean,
        own_dark_var_dn2=own_var,
    )


def _beside(own: Array, weights: Array) -> Array:
    """Dark values for the bright levels; a plain look-up where each has one dark level of its own."""
    one = weights.argmax(axis=1)
    if (weights[np.arange(one.size), one] == 1).all():
        return own[:, one]
    return own @ weights.T


def _ends_in_sight(s: Scatter) -> np.ndarray:
    """Levels whose share of pixels at the top code is neither next to nothing nor nearly all: elsewhere no rule depends on it."""
    return np.flatnonzero((s.centre.fraction_max > 0) & (s.centre.fraction_max < 0.5))


def _top_shares(s: Scatter, light: Array, counts: Array) -> Array:
    """Share of pixels at the top code when the light moves: the normal tail moves with it, and the count scatters."""
    share, moving = s.centre.fraction_max, _ends_in_sight(s)
    draws = max(light.shape[0], counts.shape[0])
    if not moving.size or draws == 1:
        return share
    out = np.repeat(share[None], draws, axis=0)
    for column, k in enumerate(moving):
        width = math.sqrt(max(s.centre.var_dn2[k] + max(s.centre.spatial_var_dn2[k], 0.0), 1e-12))
        deviate = NormalDist().inv_cdf(share[k]) + light[:, k] / width
        tail = np.array([math.erfc(-z / math.sqrt(2)) for z in deviate]) / 2
        out[:, k] = np.clip(tail + counts[:, column] * math.sqrt(share[k] / s.pixels[k]), 0.0, 1.0)
    return out
