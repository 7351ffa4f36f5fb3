"""Frames that went through a coder of blocks of 8 × 8 pixels (JPEG, MPEG): what it draws is no target."""

from __future__ import annotations

import math
from dataclasses import dataclass
from statistics import NormalDist

import numpy as np
from numpy.typing import ArrayLike

from pixmetry.camera.jpeg_tables import BLOCK, cosines, steps
from pixmetry.core.errors import InputError
from pixmetry.core.random import generator
from pixmetry.locate.detect.targets import Targets

MOST_STEP_DN = 8  # larger steps count as this: those of targets
STEEPER = 1.2  # steps at the borders of blocks over those inside, for a coder to be recognised
LEAST_STEP_DN = 0.02
EVENTFUL = 0.2  # least share of blocks that are not even, for these to be the coder's and not the targets'
CALM = 0.4  # quantile of their heights that is the height of one pattern of the coder
PATTERNS = 5.0  # that add up in a block, at most
LEAST_HEIGHT_DN = 2.5  # of what a coder draws where most blocks are even: their means are rounded to a DN or two
RINGS = 3.5  # patterns of the coarse waves that add up beside a target
PARTS = 16  # of the frame that are looked at
MOST_BLOCKS, FEW_BLOCKS = 500, 100  # whose coefficients are looked at; at first
LEAST_COEFFICIENTS = 60
ZERO = 1.5  # coefficients below are zero but for the rounding of pixels
WHOLE_SIGMA = 4.0  # by which coefficients are nearer to whole numbers than chance brings them
ROUNDING = 0.3  # standard deviation of a coefficient that the rounding of decoded pixels makes, √(1/12) and a little
ANYWHERE = 0.005  # share of coefficients that lie anywhere
LEAST_GAIN = 0.2  # of the logarithm of the likelihood of a coefficient, by a table against none
STANDS_OUT = 3.0  # height of a target over that of one pattern of the coder, from which its blocks are no ground
LEAST_GROUND = 12  # of ground
MOST_GROUND = 2000
SIGMAS_DN = np.geomspace(0.05, 40.0, 90)
UNSEEN = 2.0  # fall of the logarithm of the likelihood at the largest noise of which nothing may be left


@dataclass(frozen=True)
class Coder:
    """A coder of blocks of 8 × 8 pixels that a frame went through.

    Parameters
    ----------
    row, col : int
        Where the first whole block begins.
    steps : ndarray, shape (8, 8), or None
        Of the quantiser, for the orthonormal cosine transform (ITU-T T.81); None where it is not known.
    """

    row: int
    col: int
    steps: np.ndarray | None = None

    def within(self, top: int, left: int) -> Coder:
        """The same coder, for the part of the frame that begins at this row and column."""
        return Coder((self.row - top) % BLOCK, (self.col - left) % BLOCK, self.steps)

    @property
    def pattern_dn(self) -> float:
        """Height of the least that it draws into an even block: one step of its mean, or of the longest waves; 0 where it is not known."""
        if self.steps is None:
            return 0.0
        peak = np.abs(cosines()).max(axis=1)
        return float(max(self.steps[u, v] * peak[u] * peak[v] for u, v in ((0, 0), (0, 1), (1, 0))))

    @property
    def ringing_dn(self) -> float:
        """Height of what it may draw beside a target, into the same block; 0 where its steps are not known."""
        return 0.0 if self.steps is None else RINGS * float(np.median(self.steps[:4, :4])) * float(np.abs(cosines()).max()) ** 2


def checked_steps(steps: ArrayLike) -> np.ndarray:
    """Steps of a quantiser, shape (8, 8).

    Raises
    ------
    InputError
        If they are not 64 numbers from 1 on.
    """
    try:
        table = np.asarray(steps, float)
    except (TypeError, ValueError):
        table = np.empty(0)
    if table.size != BLOCK * BLOCK or not (np.isfinite(table).all() and (table >= 1).all()):
        raise InputError("not the steps of a quantiser", where="jpeg_steps", value=table.shape, allowed="8 × 8 numbers, 1 or more")
    return table.reshape(BLOCK, BLOCK)


def coder_of(frame: np.ndarray) -> Coder | None:
    """Tell whether a frame went through a coder of blocks, which begin at its first pixel or show at their borders; None if not.

    Examples
    --------
    >>> import imagecodecs
    >>> import numpy as np
    >>> from pixmetry.locate.detect.blocks import coder_of
    >>> grey = np.random.default_rng(1).normal(100, 8, (96, 96)).astype(np.uint8)
    >>> coder_of(grey), coder_of(imagecodecs.jpeg_decode(imagecodecs.jpeg_encode(grey, level=50))).steps[0, :3]
    (None, array([16., 11., 10.]))
    """
    if frame.dtype != np.uint8 or min(frame.shape) < 6 * BLOCK:
        return None
    seen = block_origin(frame)
    for row, col in dict.fromkeys(((0, 0), seen or (0, 0))):
        table = _table_of(frame[row:, col:], seen == (row, col))
        if table is not None:
            return Coder(row, col, table)
    return None if seen is None else Coder(*seen)


def _table_of(frame: np.ndarray, thorough: bool) -> np.ndarray | None:
    """Steps of a JPEG whose blocks begin at the first pixel: the Independent JPEG Group's that its coefficients fit; None where none do.

    Decoded coefficients are whole multiples of their steps, but for the rounding of the pixels (Z. Fan, R. L. de Queiroz, IEEE Trans. Image
    Process. 12, 230 (2003)). ``thorough``: all blocks are looked at, for few may have anything in them.
    """
    rows, cols = (side // BLOCK for side in frame.shape)
    blocks = frame[: rows * BLOCK, : cols * BLOCK].reshape(rows, BLOCK, cols, BLOCK).swapaxes(1, 2)
    for most in (FEW_BLOCKS, MOST_BLOCKS):
        apart = 1 if thorough else max(1, int(math.sqrt(rows * cols / (4 * most))))
        tiles = blocks[::apart, ::apart].reshape(-1, BLOCK, BLOCK)
        low, high = tiles.min(axis=(1, 2)), tiles.max(axis=(1, 2))
        tiles = tiles[(high - low > 2) & (low > 0) & (high < 255)]  # a clipped block has lost its comb
        span = (high.astype(int) - low)[(high - low > 2) & (low > 0) & (high < 255)]
        tiles = tiles[np.argsort(-span, kind="stable")[:most]]  # of waves along one side alone, the rounding of pixels adds up
        found = (cosines() @ (tiles - 128.0) @ cosines().T).reshape(len(tiles), BLOCK * BLOCK)
        found[:, 0] = 0.0  # the means lie on a finer comb
        block, at = np.nonzero(np.abs(found) > ZERO)
        values = np.abs(found[block, at])
        n = len(values)
        if not thorough and np.cos(2 * np.pi * values).sum() < WHOLE_SIGMA * math.sqrt(n / 2):
            return None
    if n < LEAST_COEFFICIENTS:
        return None
    best, largest = None, LEAST_GAIN * n
    for quality in range(1, 101):
        step = steps(quality).ravel()[at].astype(float)
        off = values - step * np.rint(values / step)
        near = step / (ROUNDING * np.sqrt(2 * np.pi)) * np.exp(-0.5 * (off / ROUNDING) ** 2)
        gain = float(np.log((1 - ANYWHERE) * np.where(values > 0.5 * step, near, 0.0) + ANYWHERE).sum())
        if gain > largest:
            best, largest = quality, gain
    return None if best is None else steps(best).astype(float)


def block_origin(frame: np.ndarray) -> tuple[int, int] | None:
    """Return the row and the column at which blocks of 8 × 8 pixels begin, or None where there are none.

    Where a coder has rounded the patterns of each block away, grey values change less inside blocks than from block to block.

    Examples
    --------
    >>> import numpy as np
    >>> from pixmetry.locate.detect.blocks import block_origin
    >>> level = np.random.default_rng(1).integers(90, 110, (20, 20))
    >>> block_origin(np.repeat(np.repeat(level, 8, axis=0), 8, axis=1)[3:, 6:].astype(np.uint8))
    (5, 2)
    """
    rows, cols = frame.shape
    if frame.dtype != np.uint8 or min(rows, cols) < 6 * BLOCK:
        return None
    origin = []
    few = np.unique(np.linspace(0, rows - 1, min(PARTS * BLOCK, rows)).astype(int))
    for rolled in (frame, frame[few].T):
        count = (rolled.shape[0] - 1) // BLOCK
        first = np.unique(np.linspace(0, count - 1, min(PARTS, count)).astype(int)) * BLOCK
        pairs = (first[:, None] + np.arange(BLOCK)).ravel()
        steps = np.abs(rolled[pairs + 1].astype(np.int16) - rolled[pairs].astype(np.int16))
        mean = np.minimum(steps, MOST_STEP_DN).mean(axis=1).reshape(len(first), BLOCK).mean(axis=0)
        steepest = int(np.argmax(mean))
        others = np.delete(mean, steepest)
        if mean[steepest] < max(STEEPER * float(others.max()), LEAST_STEP_DN):
            return None
        origin.append((steepest + 1) % BLOCK)
    return origin[0], origin[1]


def noise_before(frame: np.ndarray, coder: Coder, regions: Targets, boxes: list[tuple[int, int, int, int]] | None = None) -> float:
    """Standard deviation of the noise that went into a coder, DN, from blocks of ground; NaN where there are too few.

    A coefficient of white noise is 0 after rounding with the probability 2Φ(q/2σ) − 1. Where all are 0 the noise is anything between 0 and
    a limit: then the root mean square of that. ``boxes``: where the regions were looked for, if not everywhere.
    """
    assert coder.steps is not None
    rows, cols = ((side - at) // BLOCK for side, at in zip(frame.shape, (coder.row, coder.col), strict=True))
    ground = np.zeros((rows, cols), bool)
    for top, bottom, left, right in boxes or [(0, frame.shape[0], 0, frame.shape[1])]:
        down, across = (max(-(-(v - at) // BLOCK), 0) for v, at in ((top, coder.row), (left, coder.col)))
        ground[down : max((bottom - coder.row) // BLOCK, 0), across : max((right - coder.col) // BLOCK, 0)] = True
    reach = 4 * np.nan_to_num(regions.blur_px, nan=1.0) + 1
    box = [(v - at) / BLOCK for v, at in (
        (regions.row_first - reach, coder.row), (regions.row_stop + reach, coder.row), (regions.col_first - reach, coder.col),
        (regions.col_stop + reach, coder.col),
    )]  # fmt: skip
    ends = np.stack([np.floor(box[0]), np.ceil(box[1]), np.floor(box[2]), np.ceil(box[3])])
    for first, stop, begin, end in np.maximum(ends, 0).T.astype(int):
        ground[first:stop, begin:end] = False
    at = np.argwhere(ground)
    if len(at) < LEAST_GROUND:
        return math.nan
    at = at[:: -(-len(at) // MOST_GROUND)] * BLOCK + (coder.row, coder.col)
    tiles = np.stack([frame[r : r + BLOCK, c : c + BLOCK] for r, c in at]).astype(float)
    found = np.abs(cosines() @ tiles @ cosines().T).reshape(len(tiles), -1)[:, 1:]
    step = coder.steps.ravel()[1:]
    there = (found > 0.5 * np.maximum(step, 2.0)).sum(axis=0)
    survive = np.array([[2 * NormalDist().cdf(-max(q, 1.0) / (2 * s)) for q in step] for s in SIGMAS_DN]).clip(1e-300, 1 - 1e-12)
    likelihood = (there * np.log(survive) + (len(tiles) - there) * np.log1p(-survive)).sum(axis=1)
    if there.any():
        return float(SIGMAS_DN[np.argmax(likelihood)])
    return float(SIGMAS_DN[np.flatnonzero(likelihood > -UNSEEN)[-1]]) / math.sqrt(3)


def coded(image: np.ndarray, coder: Coder) -> np.ndarray:
    """Images of whole blocks, shape (n, rows, cols), after the coder: rounded, transformed, quantised, and back."""
    n, rows, cols = image.shape
    tiles = np.clip(np.rint(image), 0, 255).reshape(n, rows // BLOCK, BLOCK, cols // BLOCK, BLOCK).swapaxes(2, 3) - 128.0
    wave = cosines()
    steps = coder.steps
    back = wave.T @ (steps * np.rint(wave @ tiles @ wave.T / steps)) @ wave
    out: np.ndarray = np.clip(np.rint(back + 128.0), 0, 255).swapaxes(2, 3).reshape(n, rows, cols)
    return out


def coder_height_dn(frame: np.ndarray, coder: Coder, level_dn: np.ndarray, targets: Targets) -> float:
    """Return how far from the background what a coder draws into a block may be, in DN.

    Where the steps are known, blocks of noise alone are sent through it. Else: of the noise in a block a coder leaves the few patterns
    (cosines) that are larger than half their steps, each with the height of its step. The usual height of blocks with little in them is
    that of one pattern.

    Parameters
    ----------
    frame : ndarray, shape (rows, cols)
    coder : Coder
    level_dn : ndarray, shape (rows, cols)
        The background.
    targets : Targets
        That were seen in the frame; the clear ones are no ground.
    """
    rows, cols = ((side - at) // BLOCK for side, at in zip(frame.shape, (coder.row, coder.col), strict=True))
    if coder.steps is not None:
        sigma = noise_before(frame, coder, targets[np.abs(targets.amplitude_dn) > STANDS_OUT * coder.pattern_dn])
        if not np.isfinite(sigma):  # targets leave no ground: what stands beside them is no pattern of noise
            return max(LEAST_HEIGHT_DN, 2 * coder.pattern_dn)
        rng = generator(0, "coder height")
        many = min(rows * cols, MOST_GROUND)
        level = rng.uniform(0, coder.steps[0, 0] / BLOCK, (many, 1, 1)) + 128.0
        drawn = coded(level + rng.normal(0, sigma, (many, BLOCK, BLOCK)), coder) - level
        plateau = 0.5 * coder.steps[0, 0] / BLOCK  # by which the blocks that make most of the ground may be off themselves
        return max(1.0 + float(plateau) + float(np.abs(drawn).max()), LEAST_HEIGHT_DN)
    cut = slice(coder.row, coder.row + BLOCK * rows), slice(coder.col, coder.col + BLOCK * cols)
    height = np.abs(frame[cut] - level_dn[cut]).reshape(rows, BLOCK, cols, BLOCK).max(axis=(1, 3))
    eventful = height[height > 1.5]  # not rounding
    if len(eventful) < EVENTFUL * height.size:
        return max(LEAST_HEIGHT_DN, coder.pattern_dn)
    return max(PATTERNS * float(np.quantile(eventful, CALM)), LEAST_HEIGHT_DN)
