"""From the noise at the four places of the mosaic to the demosaicking that made it.

Interpolated pixels have less noise than original ones, so that the variance has a period of two pixels. The autocovariance at each place is
a sum over the raw pixels that both partners hold, with one unknown variance for each colour: linear in these, for every method.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np

from pixmetry.camera.mosaic_weights import BILINEAR, LUMA, MALVAR, output_weights
from pixmetry.camera.noise_covariance import REACH, NoiseCovariance
from pixmetry.core.arrays import Array

METHODS, OUTPUTS = (BILINEAR, MALVAR), {"green": ("RGGB", "GRBG"), "red": ("RGGB", "GRBG", "GBRG", "BGGR"), "luma": ("RGGB", "GRBG")}
WORTH = 1.5  # by how much a method that mixes colours must fit better: without noise in the others it is the plain one
FOUND_Z = 8.0  # of the variances of the four places against their mean
LEFT_OVER = 0.03  # of the covariances, root of their sum of squares over that of all, that a method may leave beside the scatter
SCATTERS = 2.0  # of the scatter's expected root, that a right method may leave: few squares make most of the sum


@dataclass(frozen=True)
class Mosaic:
    """A demosaicking that explains the noise.

    Parameters
    ----------
    method, output, pattern : str
    original : ndarray, shape (2, 2), bool
        Places whose pixels are stored as they are; of the luminance none.
    """

    method: str
    output: str
    pattern: str
    original: np.ndarray


def find_mosaic(shot_dn2: np.ndarray, dark_dn2: np.ndarray, pixels: float) -> Mosaic | None:
    """The method, stored colour and place of the colours that explain the noise; None where its variance has no period of two pixels.

    Parameters
    ----------
    shot_dn2, dark_dn2 : ndarray, shape (2, 2, 5, 9)
        Autocovariance of the shot noise, and of the dark, at the four places; see `NoiseCovariance`.
    pixels : float
        Number of pixels that the first is the mean of, over all places.
    """
    variances = shot_dn2[:, :, 0, REACH]
    u = variances.mean() * np.sqrt(8 / pixels)
    if np.abs(variances - variances.mean()).max() < FOUND_Z * u:
        return None
    scatter = float(np.sqrt(_scatter_dn4(shot_dn2 + dark_dn2, pixels)) / np.linalg.norm(shot_dn2))
    best, found = np.inf, None
    for method in METHODS:
        for output, patterns in OUTPUTS.items():
            for pattern in patterns:
                design, original = _design(method, output, pattern)
                values = np.maximum(np.linalg.lstsq(design, shot_dn2.ravel(), rcond=1e-8)[0], 0.0)
                left = float(np.linalg.norm(shot_dn2.ravel() - design @ values) / np.linalg.norm(shot_dn2))
                fewest = method == BILINEAR and output != "luma"  # colours in the noise of one pixel
                if left * (1.0 if fewest else WORTH) < best:
                    best, found = left, Mosaic(method, output, pattern, original)
    return found if best < np.hypot(LEFT_OVER, SCATTERS * scatter) else None


def _scatter_dn4(covariance_dn2: np.ndarray, pixels: float) -> float:
    """Expected sum of squares of what is measured of an autocovariance by place, shape (2, 2, 5, 9), over its true values.

    Bartlett's formula, Σ c(h) c'(h) + c(h + k) c'(h − k), over the distances h from one pixel of a place to another: noise that
    neighbours share scatters more than white noise of its variance.
    """

    def at(r: int, c: int, j: int, i: int) -> float:
        """Covariance of a pixel at a place with that (j, i) from it."""
        if j < 0:
            r, c, j, i = (r + j) % 2, (c + i) % 2, -j, -i
        return float(covariance_dn2[r, c, j, i + REACH]) if j <= REACH and abs(i) <= REACH else 0.0

    apart = [2 * n for n in range(-(REACH // 2), REACH // 2 + 1)]
    total = 0.0
    for r, c, j, i in np.ndindex(2, 2, REACH + 1, 2 * REACH + 1):
        i -= REACH
        other = (r + j) % 2, (c + i) % 2
        total += sum(at(r, c, y, x) * at(*other, y, x) + at(r, c, y + j, x + i) * at(*other, y - j, x - i) for y in apart for x in apart)
    return 4 * total / pixels


@cache
def _design(method: str, output: str, pattern: str) -> tuple[np.ndarray, np.ndarray]:
    """Autocovariance for a variance of 1 of the raw pixels of each colour, shape (180, colours); and which places are original."""
    shares = LUMA if output == "luma" else {output[0].upper(): 1.0}
    weights = output_weights(method, pattern, shares, dict.fromkeys("RGB", 1.0))
    reach = 2
    columns = []
    for colour in "RGB":
        own = np.zeros((2, 2, REACH + 1, 2 * REACH + 1))
        for r, c, j, i in np.ndindex(own.shape):
            here, there = weights[r, c], weights[(r + j) % 2, (c + i - REACH) % 2]
            for a, b in np.ndindex(here.shape):
                x, y = a - j, b - (i - REACH)
                if 0 <= x < 5 and 0 <= y < 5 and pattern[2 * ((r + a - reach) % 2) + (c + b - reach) % 2] == colour:
                    own[r, c, j, i] += here[a, b] * there[x, y]
        if own.any():
            columns.append(own.ravel())
    original = np.array([[np.count_nonzero(weights[r, c]) == 1 for c in (0, 1)] for r in (0, 1)])
    return np.stack(columns, axis=1), original


def shot_of_places(seen: NoiseCovariance, bright: np.ndarray, dark: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
    """Autocovariance of the shot noise, and of the dark, at the four places, shape (2, 2, 5, 9), DN²; independent pixels of the first."""
    pairs = seen.n_pairs.astype(float)
    black: Array = np.average(seen.covariance_dn2[dark], axis=0, weights=pairs[dark])
    light = seen.covariance_dn2[bright]
    total = light.mean(axis=(1, 2))[:, 0, REACH]
    pixels = pairs[bright] * np.prod(seen.frame_shape)
    independent = float(total.sum() ** 2 / (total**2 / pixels).sum())
    return _whole(light.mean(axis=0) - black, seen.frame_shape), _whole(black, seen.frame_shape), independent


def _whole(covariance_dn2: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """The same with the variances of the four places as they were before the means of rows and columns were taken out.

    That takes 2 A − Ā from a pixel's variance, over the length of the line, if A is the sum of its covariances along the line and Ā the
    mean of A over all places; `LagProducts.covariance_dn2` has put Ā back.
    """
    whole = covariance_dn2.copy()
    along = covariance_dn2[:, :, 0].sum(axis=2)
    down = covariance_dn2[:, :, :, REACH].sum(axis=2)
    for j in range(1, REACH + 1):
        down = down + np.roll(covariance_dn2[:, :, j, REACH], j, axis=0)
    whole[:, :, 0, REACH] += 2 * (along - along.mean()) / shape[1] + 2 * (down - down.mean()) / shape[0]
    return whole
