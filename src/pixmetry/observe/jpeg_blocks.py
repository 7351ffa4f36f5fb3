"""Traces of a lossy coder in frames: the comb of cosine coefficients that JPEG rounded, and blocks that a video coder repeats.

A decoded JPEG holds, in every block of 8 × 8 pixels, coefficients that were multiples of the quantiser's steps. Rounding of the decoded
pixels to whole numbers adds an error of variance 1/12 to each (the transform is orthonormal). So a coefficient X that is not zero is
distributed about multiples of its step q as a normal law of that variance, and smoothly if there was no step. The likelihoods of all
coefficients of all blocks tell the table (Z. Fan, R. L. de Queiroz, IEEE Trans. Image Process. 12 (2003) 230).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from pixmetry.camera.jpeg_tables import BLOCK, cosines, equivalent_quality, steps, tiles_of
from pixmetry.camera.observations import Observations, StoredBlocks
from pixmetry.core.arrays import Array
from pixmetry.core.number import Estimates
from pixmetry.observe.experiment import PictureGroup

MOST_FRAMES, MOST_BLOCKS = 4, 6000  # that are looked at
ROUNDING = np.sqrt(1 / 12)  # standard deviation of a decoded pixel's rounding
COHERENT, FEW = 2.5, 0.03  # rounding adds up in blocks with few coefficients: by how much, and the share of coefficients
ANY = 0.002  # share that lies anywhere
ZERO = 1.5  # coefficients below are zero but for the rounding of pixels, and tell no step
LEAST_COEFFICIENTS = 60
CLEARLY = 20.0  # logarithm of the likelihood ratio against no coder, above which there was one
LEAST_SHARE = 0.02  # of it, for each coefficient: the finest coder gives 0.05; structure without noise may look like a little
OTHER_TABLE = 100.0  # the same for a table that is none of the usual ones
FREE_PENALTY = 6.0  # of each position, of a table that is none of the usual ones: ln(255) and a little
FINEST = 95  # from here on most steps are 1 or 2
REPEATED = 0.01  # share of blocks that are the same in successive frames
VIDEO_BLOCK = 16
METHOD = "likelihood of the comb of block coefficients (Fan, de Queiroz 2003) over the tables of the Independent JPEG Group"


class FirstFrames:
    """Keeps the first frames of a group: traces of a coder are in each of them."""

    def __init__(self) -> None:
        self.frames: dict[int, np.ndarray] = {}

    def add(self, frame: np.ndarray, index: int) -> None:
        """Keep a copy of it."""
        if index < MOST_FRAMES:
            self.frames[index] = frame.copy()

    def in_order(self) -> list[np.ndarray]:
        """The frames by their index."""
        return [self.frames[k] for k in sorted(self.frames)]


def reduce_patterns(groups: Sequence[PictureGroup], seen: Observations) -> Observations:
    """Find the quality of JPEG in textured frames, and blocks that repeat from frame to frame."""
    sequences = [g.sums.in_order() for g in groups if isinstance(g.sums, FirstFrames)]
    blocks = stored_blocks(sequences, groups[0].bits)
    return replace(seen, blocks=blocks, notes=(*seen.notes, *blocks.notes))


def stored_blocks(sequences: Sequence[Sequence[np.ndarray]], bits: int = 8) -> StoredBlocks:
    """What frames of some sequences tell of the coder that they went through.

    Parameters
    ----------
    sequences : sequence of sequence of ndarray, shape (rows, cols), DN
        Frames that were taken one after the other, of each sequence.
    bits : int
        Of a stored value.

    Returns
    -------
    StoredBlocks
    """
    frames = [f for s in sequences for f in s]
    repeated = [_repeated_share(a, b) for s in sequences for a, b in zip(s[:-1], s[1:], strict=True)]
    share = max((r for r in repeated if np.isfinite(r)), default=float("nan"))
    notes = []
    if share > REPEATED:
        what = f"{100 * share:.0f} % of the blocks of {VIDEO_BLOCK} px are the same, bit by bit, in successive frames"
        notes.append(f"{what}: a video coder or noise reduction repeats them; the frames do not tell its quantiser")
    values = [f.astype(float) for f in frames]
    if bits > 8:
        return _told_nothing("JPEG stores 8 bits, and these frames have more", share, notes)
    if min(f.shape[0] for f in frames) < 3 * BLOCK or min(f.shape[1] for f in frames) < 3 * BLOCK:
        return _told_nothing(f"frames of less than {3 * BLOCK} px hold too few blocks", share, notes)
    looked_at = [_scored(values, offset) for offset in dict.fromkeys(((0, 0), block_offset(values[0])))]
    count, score, offset = max(looked_at, key=lambda one: _best_of(one[1]))
    if count < LEAST_COEFFICIENTS:
        what = f"only {count} block coefficients are not zero (at least {LEAST_COEFFICIENTS}): take frames with texture or noise"
        return _told_nothing(what, share, notes)
    return _quality(score, count, offset, share, notes)


def _scored(values: Sequence[np.ndarray], offset: tuple[int, int]) -> tuple[int, Array, tuple[int, int]]:
    """Number of coefficients that are not zero, and the scores of all steps, of blocks that begin at an offset."""
    tiles = np.concatenate([tiles_of(v[offset[0] :, offset[1] :]) for v in values])
    inside = (tiles.min(axis=(1, 2)) > 0) & (tiles.max(axis=(1, 2)) < 255)  # a clipped block has lost its comb
    tiles = tiles[inside]
    if len(tiles) > MOST_BLOCKS:
        tiles = tiles[np.linspace(0, len(tiles) - 1, MOST_BLOCKS).astype(int)]
    transform = cosines()
    found = transform @ (tiles - 128.0) @ transform.T if len(tiles) else np.zeros((0, BLOCK, BLOCK))
    there = np.abs(found) > ZERO  # where all rows or all columns are alike, their rounding is too
    found = found[there[:, 1:, :].any(axis=(1, 2)) & there[:, :, 1:].any(axis=(1, 2))]
    count = int((np.abs(found) > ZERO).sum()) - int((np.abs(found[:, 0, 0]) > ZERO).sum())
    return count, step_scores(found), offset


def _totals(score: Array) -> Array:
    """Score of the table of each quality 1 … 100."""
    u, v = np.meshgrid(np.arange(BLOCK), np.arange(BLOCK), indexing="ij")
    return np.array([score[u, v, steps(q).astype(int)].sum() for q in range(1, 101)])


def _best_of(score: Array) -> tuple[float, float]:
    """Score of the best usual table if it is clear, then that of any table."""
    usual = float(_totals(score).max())
    return usual if usual > CLEARLY else 0.0, float((score[:, :, 1:].max(axis=2) - FREE_PENALTY).clip(min=0).sum())


def _told_nothing(why: str, share: float, notes: list[str]) -> StoredBlocks:
    fit = replace(Estimates.empty(), reasons={"quality": why})
    return StoredBlocks(fit, np.zeros((BLOCK, BLOCK)), (0, 0), 0.0, 0, share, (*notes, f"the quality of JPEG is not told: {why}"))


def _repeated_share(first: np.ndarray, second: np.ndarray) -> float:
    """Share of blocks that do not change at all, where the others do; NaN where nothing changes (copies, or no noise)."""
    rows, cols = (n // VIDEO_BLOCK * VIDEO_BLOCK for n in first.shape)
    same = first[:rows, :cols] == second[:rows, :cols]
    if not same.size:
        return float("nan")
    whole = same.reshape(rows // VIDEO_BLOCK, VIDEO_BLOCK, cols // VIDEO_BLOCK, VIDEO_BLOCK).all(axis=(1, 3))
    # values that noise hardly changes repeat by chance
    chance = float(same.mean()) ** (VIDEO_BLOCK**2)
    return float("nan") if whole.all() or chance > REPEATED / 10 else float(whole.mean())


def block_offset(image: np.ndarray) -> tuple[int, int]:
    """Row and column of the first block's first pixel: frames may be a part of what was coded.

    Where the blocks are, coefficients are whole numbers but for the rounding of pixels.
    """
    transform = cosines()
    counts = np.zeros((BLOCK, BLOCK))
    for row in range(BLOCK):
        for col in range(BLOCK):
            tiles = tiles_of(image[row:, col:])
            tiles = tiles[:: max(1, len(tiles) // 400)]
            found = (transform @ (tiles - 128.0) @ transform.T).reshape(len(tiles), -1)[:, 1:]
            found = found[np.abs(found) > ZERO]
            counts[row, col] = np.cos(2 * np.pi * found).sum() / np.sqrt(max(len(found), 1))
    best = np.unravel_index(int(np.argmax(counts)), counts.shape)
    return int(best[0]), int(best[1])


def step_scores(found: np.ndarray) -> Array:
    """Logarithm of the likelihood of each step 1 … 255 against no coder, shape (8, 8, 256); [:, :, 0] is 0.

    Parameters
    ----------
    found : ndarray, shape (blocks, 8, 8)
        Coefficients.
    """
    scores = np.zeros((BLOCK, BLOCK, 256))
    for u in range(BLOCK):
        for v in range(BLOCK):
            if u == v == 0:
                continue  # the mean of a block: large, and its comb is finer than 1/8
            x = np.abs(found[:, u, v])
            x = x[x > ZERO]
            if not len(x):
                continue
            largest = int(min(x.max() + 2, 255))
            decay = float(x.mean() - ZERO)  # amplitudes without a coder: an exponential law above the limit
            even = -(x - ZERO) / decay - np.log(decay)
            for q in range(1, largest + 1):
                first = max(1, int(np.ceil(ZERO / q)))
                whole = np.log1p(-np.exp(-q / decay))  # the same law on multiples of the step
                ratio = np.zeros(len(x))
                for k in np.rint(x / q) + np.array([[-1], [0], [1]]):
                    off = x - q * k
                    near = (1 - FEW) * np.exp(-0.5 * (off / ROUNDING) ** 2)
                    near += FEW / COHERENT * np.exp(-0.5 * (off / (COHERENT * ROUNDING)) ** 2)
                    amplitude = np.exp(np.clip(whole - q * (k - first) / decay - even, -50, 50))
                    ratio += np.where(k >= first, near * amplitude, 0.0)
                scores[u, v, q] = np.log((1 - ANY) * ratio / (ROUNDING * np.sqrt(2 * np.pi)) + ANY).sum()
            scores[u, v, largest + 1 :] = len(x) * np.log(ANY)  # a coefficient is not smaller than its step
    return scores


def _quality(score: Array, count: int, offset: tuple[int, int], share: float, notes: list[str]) -> StoredBlocks:
    """The table of the usual ones that fits best; or the steps one by one, if none fits."""
    total = _totals(score)
    told = (score != 0).any(axis=2)
    free = score[:, :, 1:].max(axis=2)
    single = np.where(told & (free > FREE_PENALTY), score[:, :, 1:].argmax(axis=2) + 1, 0)
    alone = float((free[told] - FREE_PENALTY).clip(min=0).sum())
    best = int(total.argmax())
    alone = alone if alone > OTHER_TABLE else 0.0
    if max(total[best], alone) < max(CLEARLY, LEAST_SHARE * count):
        why = "no comb of a quantiser was found: not coded as JPEG, or so finely that the rounding of pixels hides it"
        fit = replace(Estimates.empty(), reasons={"quality": why})
        return StoredBlocks(fit, single, offset, max(float(total[best]), 0.0), count, share, tuple(notes))
    if alone > total[best] + CLEARLY:
        value, u_value = equivalent_quality(single)
        why = "the table is none of the Independent JPEG Group's: the quality whose steps are alike"
        found = Estimates.from_rows([("quality", value, u_value, np.inf, "1")], method=METHOD, reasons={"quality": why})
        return StoredBlocks(found, single, offset, alone, count, share, tuple(notes))
    weight = np.exp(np.clip(total - total[best], -700, 0))
    weight /= weight.sum()
    qualities = np.arange(1, 101)
    mean = float((weight * qualities).sum())
    value = float(round(mean))
    u_value = float(np.sqrt((weight * (qualities - mean) ** 2).sum() + (value - mean) ** 2))
    reasons: dict[str, str] = {}
    lower: frozenset[str] = frozenset()
    if value >= FINEST and u_value > 0.5:
        low = float(qualities[np.searchsorted(np.cumsum(weight), 0.05)])
        value, lower = low, frozenset({"quality"})
        reasons["quality"] = "its steps are 1 or little more, which the rounding of pixels nearly hides: at least"
    fit = Estimates.from_rows([("quality", value, max(u_value, 1e-3), np.inf, "1")], method=METHOD, reasons=reasons, lower_limits=lower)
    return StoredBlocks(fit, steps(int(round(mean))), offset, float(total[best]), count, share, tuple(notes))
