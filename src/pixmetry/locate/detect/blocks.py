"""Frames that went through a coder of blocks of 8 × 8 pixels (JPEG, MPEG): what it draws is no target."""

from __future__ import annotations

import numpy as np

BLOCK = 8
MOST_STEP_DN = 8  # larger steps count as this: those of targets
STEEPER = 1.2  # steps at the borders of blocks over those inside, for a coder to be recognised
LEAST_STEP_DN = 0.02
EVENTFUL = 0.2  # least share of blocks that are not even, for these to be the coder's and not the targets'
CALM = 0.4  # quantile of their heights that is the height of one pattern of the coder
PATTERNS = 5.0  # that add up in a block, at most
LEAST_HEIGHT_DN = 2.5  # of what a coder draws where most blocks are even: their means are rounded to a DN or two
PARTS = 16  # of the frame that are looked at


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


def coder_height_dn(frame: np.ndarray, origin: tuple[int, int], level_dn: np.ndarray) -> float:
    """Return how far from the background what a coder draws into a block may be, in DN.

    Of the noise in a block a coder leaves the few patterns (cosines) that are larger than half their steps, each with the height of its
    step. The usual height of blocks with little in them is that of one pattern.

    Parameters
    ----------
    frame : ndarray, shape (rows, cols)
    origin : (int, int)
        Row and column at which the blocks begin.
    level_dn : ndarray, shape (rows, cols)
        The background.
    """
    row, col = origin
    rows, cols = ((side - at) // BLOCK for side, at in zip(frame.shape, origin, strict=True))
    cut = slice(row, row + BLOCK * rows), slice(col, col + BLOCK * cols)
    height = np.abs(frame[cut] - level_dn[cut]).reshape(rows, BLOCK, cols, BLOCK).max(axis=(1, 3))
    eventful = height[height > 1.5]  # not rounding
    if len(eventful) < EVENTFUL * height.size:
        return LEAST_HEIGHT_DN
    return max(PATTERNS * float(np.quantile(eventful, CALM)), LEAST_HEIGHT_DN)
