"""Frames in a row of one scene: the factor and the black of each against their mean, and what moves them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from pixmetry.camera.frame_sequence import FrameSequence, FrameSequences, LampWave
from pixmetry.camera.observations import Observations
from pixmetry.core.errors import MeasureError
from pixmetry.core.number import ONE_SIDED_95, Estimates
from pixmetry.observe.experiment import PictureGroup
from pixmetry.observe.gain_loop import LoopData, LoopFit, fit_loop
from pixmetry.observe.lamp_wave import lamp_estimates, row_wave

LEAST_BLOCK_PX, MOST_BLOCKS = 8, 64  # side of a block, and blocks along a side of the frame
SEGMENTS = 8  # of a row
SAMPLES = 6000  # pixels that are kept of every frame
LEAST_FRAMES = 12
LEAST_STATIC = 0.1  # share of the frame
LEAST_CHANGES, LEAST_CHANGE = 3, 0.05  # of the scene, and its size over the mean
MOST_LEFT = 0.1  # of the movement of the gain, by a fit that is believed
MOST_BLACK_DN = 5.0  # u of black, for a target
LEAST_KAPPA = 0.02  # a loop that is slower takes hundreds of frames to settle
FOUND = 3.5  # u from which a loop counts as found
KNOWN_SHARE = 0.15  # u of the gain's share in the changes, up to which gain and exposure are told apart
MOST_CLIPPED = 1e-3  # share of a frame's pixels
LEAST_LIGHT = 0.02  # of a frame over the median of all
MOST_PAUSE = 100  # frame times, after which another sequence begins
MOST_ROUNDS = 40  # of factors and bands in turn
MOST_U_FACTOR = 0.01  # u of the factor of a frame
MOVES = 5.0  # u beyond which gains, and the black, are said to move
BLACK_CHANCE = 1e-4
METHOD = "factor of each frame on what does not change in the scene, over the means of the frames before it"
SWITCH_GAIN = "take 40 frames or more in a row in which a bright patch, a quarter of the frame, comes and goes every 7 to 20 frames"
WHOLE_FRAME = "of the mean of these frames; a loop that weighs the middle more, or sees more than this window, has its own target"
ONLY_STAYS = "only {:.0f} % of the frame stays as it is from frame to frame"
AT_REST = "keep camera and scene at rest; only a patch of at most half of the frame may change"
NO_ORDER = "list the frames in the order in which they were taken"


@dataclass
class SequenceSums:
    """What is kept of each frame of a sequence, by its index: means of blocks and of parts of rows, and single pixels."""

    blocks: dict[int, np.ndarray] = field(default_factory=dict)  # float64, DN
    lowest: dict[int, np.ndarray] = field(default_factory=dict)
    highest: dict[int, np.ndarray] = field(default_factory=dict)
    rows: dict[int, np.ndarray] = field(default_factory=dict)  # shape (rows, segments)
    pixels: dict[int, np.ndarray] = field(default_factory=dict)
    means: dict[int, float] = field(default_factory=dict)
    codes: dict[int, tuple[int, float, float]] = field(default_factory=dict)  # highest code, shares of pixels there and at 0
    bits: int = 0  # all that are set in any code

    def add(self, frame: np.ndarray, index: int) -> None:
        """Add the frame of this index."""
        parts = _in_blocks(frame)
        self.blocks[index] = parts.mean(axis=(1, 3), dtype=float)
        self.lowest[index], self.highest[index] = parts.min(axis=(1, 3)), parts.max(axis=(1, 3))
        self.rows[index] = _row_means(frame)
        self.pixels[index] = frame[sample_places(frame.shape)].copy()
        self.means[index] = float(frame.mean(dtype=float))
        top = int(frame.max())
        self.codes[index] = (top, float(np.mean(frame == top)), float(np.mean(frame == 0)))
        self.bits |= int(np.bitwise_or.reduce(frame, axis=None))

    def top(self, bits: int) -> int:
        """The code at which the scale ends: below 2^bits − 1 where codes are shifted to the left, or where the converter has fewer bits."""
        step = self.bits & -self.bits or 1
        highest = max(code for code, _, _ in self.codes.values())
        full = max(share for code, share, _ in self.codes.values() if code == highest) > MOST_CLIPPED
        return highest if full and (highest + step) & (highest + step - 1) == 0 else 2**bits - step


def _in_blocks(frame: np.ndarray) -> np.ndarray:
    """The frame as blocks, shape (blocks down, rows of one, blocks across, columns of one)."""
    tall, wide = (block_px(n) for n in frame.shape)
    rows, cols = frame.shape[0] // tall, frame.shape[1] // wide
    return frame[: rows * tall, : cols * wide].reshape(rows, tall, cols, wide)


def _row_means(frame: np.ndarray) -> np.ndarray:
    """Means of parts of the rows, shape (rows, segments)."""
    return np.stack([part.mean(axis=1, dtype=float) for part in np.array_split(frame, SEGMENTS, axis=1)], axis=1)


@dataclass(frozen=True)
class FrameLight:
    """What is kept of a frame to follow its factor: means of blocks and of parts of rows, DN above black; which blocks are not clipped."""

    blocks: np.ndarray
    rows: np.ndarray
    usable: np.ndarray

    @classmethod
    def of(cls, frame_dn: np.ndarray, clipped: np.ndarray) -> FrameLight:
        """Of a frame above black and the mask of its clipped pixels, shape (rows, cols) both."""
        usable: np.ndarray = np.logical_not(_in_blocks(clipped).any(axis=(1, 3)))
        return cls(_in_blocks(frame_dn).mean(axis=(1, 3), dtype=float), _row_means(frame_dn), usable)


@dataclass(frozen=True)
class FrameFactors:
    """Factors of frames in a row against the mean of all.

    Parameters
    ----------
    factor_rel : ndarray, shape (frames, rows)
        Gain, exposure and lamp as one; 1 for frames without light.
    u_rel : ndarray, shape (frames,)
    bands : LampWave or None
        The part of it that differs from row to row.
    static_share : float
        Share of the frame that tells it.
    """

    factor_rel: np.ndarray
    u_rel: np.ndarray
    bands: LampWave | None
    static_share: float


def factors_of_frames(frames: Sequence[FrameLight]) -> FrameFactors:
    """Factor of each frame of a sequence without gaps against the mean of all, by the parts of the scene that do not change.

    Raises
    ------
    MeasureError
        With fewer than `LEAST_FRAMES` frames, or where too little of the scene stays as it is.

    Examples
    --------
    >>> import numpy as np
    >>> from pixmetry.observe.sequence import FrameLight, factors_of_frames
    >>> scene, gain = 100 + np.arange(64.0 * 64).reshape(64, 64) / 40, 1 + 0.1 * np.sin(np.arange(16))
    >>> found = factors_of_frames([FrameLight.of(g * scene, np.zeros((64, 64), bool)) for g in gain])
    >>> bool(np.allclose(found.factor_rel[:, 0], gain / gain.mean()))
    True
    """
    if len(frames) < LEAST_FRAMES:
        raise MeasureError(f"{len(frames)} frames, {LEAST_FRAMES} are needed", remedy=f"give {LEAST_FRAMES - len(frames)} frames more")
    blocks, rows = np.array([f.blocks.ravel() for f in frames]), np.array([f.rows for f in frames])
    levels = blocks.mean(axis=1)
    lit = levels > LEAST_LIGHT * np.median(levels)
    if lit.sum() < LEAST_FRAMES or np.median(levels) <= 0:
        raise MeasureError("the frames show no light", remedy="give frames of a lit scene")
    usable = np.all([f.usable.ravel() for f, light in zip(frames, lit, strict=True) if light], axis=0)
    if usable.mean() < LEAST_STATIC:
        raise MeasureError("nearly all of the frame is clipped in some frames", remedy="take less light")
    place, row = np.flatnonzero(lit).astype(float), np.arange(rows.shape[1])
    wave = _bands(rows[lit], blocks[lit], usable, frames[0].blocks.shape, place, (0.0, 0.0), 0.0)
    bands = None if wave is None or wave.of_fields else wave
    light = np.ones((int(lit.sum()), rows.shape[1])) if bands is None else bands.light(place, row)
    even = blocks[lit] / _by_block(light, frames[0].blocks.shape)
    static = static_blocks(even, usable)
    if static.mean() < LEAST_STATIC:
        raise MeasureError(ONLY_STAYS.format(100 * static.mean()), remedy=AT_REST)
    found = _factors(even, static, 0.0)
    if float(np.median(found.covariance[:, 0, 0])) > MOST_U_FACTOR**2:
        what = f"their factors are known to {float(np.sqrt(np.median(found.covariance[:, 0, 0]))):.1g} only"
        raise MeasureError(what, remedy=f"{AT_REST}; or take more light")
    factor, u = np.ones((len(frames), rows.shape[1])), np.zeros(len(frames))
    factor[lit], u[lit] = found.gain[:, None] * light, np.sqrt(found.covariance[:, 0, 0])
    return FrameFactors(factor, u, bands, float(static.mean()))


def block_px(side: int) -> int:
    """Side of a block along a side of the frame; even, so that all places of a mosaic count the same."""
    return min(max(LEAST_BLOCK_PX, 2 * int(np.ceil(side / MOST_BLOCKS / 2))), side)


def sample_places(shape: tuple[int, ...]) -> tuple[slice, slice]:
    """Every so many rows and columns; an odd number, so that all places of a mosaic are met."""
    step = max(1, int(np.sqrt(shape[0] * shape[1] / SAMPLES)))
    step += 1 - step % 2
    return slice(None, None, step), slice(None, None, step)


def reduce_sequences(groups: Sequence[PictureGroup], seen: Observations) -> Observations:
    """Follow gain and black of every sequence, and fit loop and lamp to them."""
    dark = dark_level(seen)
    of_rows = seen.dark_rows
    hum = of_rows.hum["per_row"].value if of_rows is not None and "per_row" in of_rows.hum else 0.0
    found, refused = [], []
    stretches = [(group, order) for group in groups for order in _stretches(group)]
    for number, (group, order) in enumerate(stretches, start=1):
        try:
            found.append(sequence_of(group, dark, order, hum))
        except MeasureError as problem:
            refused.append(f"sequence {number} of {len(stretches)}: {problem.what}" + (f" ({problem.remedy})" if problem.remedy else ""))
    loop = loop_of_all(found, refused, seen)
    lamp = lamp_estimates(found, refused, seen)
    sequences = FrameSequences(tuple(found), tuple(refused), loop, lamp)
    notes = [f"Frames in a row: {why}" for why in refused]
    notes += list(dict.fromkeys(f"Frames in a row: {note}" for s in found for note in s.notes))
    return replace(seen, sequences=sequences, notes=(*seen.notes, *notes))


def dark_level(seen: Observations) -> tuple[float, float] | None:
    """Level of the dark frames and its u, which holds that noise below 0 is cut off; None without them."""
    fit, transfer = seen.photon_transfer_fit, seen.photon_transfer
    clipped = 0.0
    if seen.histogram is not None and seen.histogram.dark_counts.any():
        clipped = float(seen.histogram.dark_counts[0] / seen.histogram.dark_counts.sum())
    if fit is not None and "offset_dn" in fit:
        level, u = fit["offset_dn"].value, fit["offset_dn"].u
    elif transfer is None or not transfer.dark.mean_dn.size:
        return None
    else:
        level, u = float(transfer.dark.mean_dn.mean()), float(max(np.ptp(transfer.dark.mean_dn), 0.05))
    return level, float(np.hypot(u, 2 * clipped * max(level, 1.0)))


@dataclass(frozen=True)
class _Factors:
    """Factor and offset of each frame against the mean of all: frame = gain × mean + offset; covariance (frames, 2, 2)."""

    gain: np.ndarray
    offset: np.ndarray
    covariance: np.ndarray


def _stretches(group: PictureGroup) -> list[np.ndarray]:
    """Frames, by their index, between long pauses."""
    assert isinstance(group.sums, SequenceSums)
    order, times = np.arange(len(group.sums.means)), group.facts.times_s
    if times is None or len(times) < 2:
        return [order]
    steps = np.diff(times)
    return np.split(order, np.flatnonzero(steps > MOST_PAUSE * np.median(steps)) + 1)


def sequence_of(group: PictureGroup, dark: tuple[float, float] | None, order: np.ndarray, hum_per_row: float = 0.0) -> FrameSequence:
    """What the frames of one sequence tell, given by their index in the group, the level of dark frames and the hum in their rows.

    Raises
    ------
    MeasureError
        If it has too few frames, or too little of the scene stays as it is.
    """
    sums = group.sums
    assert isinstance(sums, SequenceSums)
    top, given = sums.top(group.bits), order
    if len(given) < LEAST_FRAMES:
        raise MeasureError(f"{len(given)} frames, {LEAST_FRAMES} are needed", remedy=f"take {LEAST_FRAMES - len(given)} frames more")
    levels = np.array([sums.means[i] for i in given])
    if dark is not None and levels.max() - dark[0] < max(10 * dark[1], 3.0, 0.005 * top):
        raise MeasureError("the frames show no light", remedy="dark frames in a row belong into a group of kind dark")
    inside = np.array([(sums.highest[i] < top) & (sums.lowest[i] > 0) for i in given]).reshape(len(given), -1)
    order = given[(inside.mean(axis=1) >= LEAST_STATIC) & _shows_light(levels, np.array([sums.blocks[i].std() for i in given]), dark)]
    count = len(order)
    usable = np.asarray(inside[np.isin(given, order)].all(axis=0))
    if count < LEAST_FRAMES or usable.mean() < LEAST_STATIC:
        what = "nearly all of the frame is clipped at an end of the scale, or dark, in some frames"
        raise MeasureError(what, remedy="take less light, or raise the black level")
    levels = np.array([sums.means[i] for i in order])
    blocks = np.array([sums.blocks[i] for i in order]).reshape(count, -1)
    place, gaps, interval = _places(group, order)
    row_means = np.array([sums.rows[i] for i in order])
    wave = _bands(row_means, blocks, usable, sums.blocks[0].shape, place, dark, hum_per_row)
    bands = None if wave is None or wave.of_fields else wave  # blocks hold as many odd rows as even ones
    if bands is not None and dark is not None:
        light = bands.light(place, np.arange(row_means.shape[1]))
        blocks = dark[0] + (blocks - dark[0]) / _by_block(light, sums.blocks[0].shape)
    static = static_blocks(blocks, usable)
    if static.mean() < LEAST_STATIC:
        raise MeasureError(ONLY_STAYS.format(100 * static.mean()), remedy=AT_REST)
    free = _factors(blocks, static)
    black, moves = _black_of(free)
    notes = []
    if count < len(given):
        notes.append(f"{len(given) - count} of {len(given)} frames are left out: they show no light, or are clipped nearly everywhere")
    if black is not None and dark is not None and abs(black[0] - dark[0]) > 4 * np.hypot(black[1], dark[1]) + 0.5:
        both = f"black is {black[0]:.2f} DN in the sequence and {dark[0]:.2f} DN in the dark frames"
        notes.append(f"{both}: the black level follows the scene")
    elif dark is not None:
        black = dark if black is None else _mean_of(black, dark)
    if moves:
        how = f"black moves by {moves:.2g} DN from frame to frame (standard deviation)"
        notes.append(f"{how}: an automatic black level, or a clamp that settles")
    factors = free if moves or black is None else _factors(blocks, static, black[0])
    if not moves and black is not None and float(np.median(factors.covariance[:, 0, 0])) > MOST_U_FACTOR**2:
        raise MeasureError("the frames are too dark, or too noisy, to follow their gain", remedy="take more light")
    codes = [sums.codes[i] for i in order]
    full = [share if code >= top else 0.0 for code, share, _ in codes]
    unknown = [k for k in range(count - 1) if full[k] > MOST_CLIPPED or codes[k][2] > MOST_CLIPPED]
    told = _black_or_bound(black, blocks, static)
    fit = _loop_fit(factors, levels, told[0], place, (*gaps, *unknown))
    scene = (levels - told[0]) / factors.gain
    pixels = np.array([sums.pixels[i] for i in order], dtype=float)
    if bands is not None:
        sampled = np.arange(row_means.shape[1])[sample_places(group.moments.shape)[0]]
        pixels = told[0] + (pixels - told[0]) / bands.light(place, sampled)[:, :, None]
    if missing := [k for k in fit.gaps if k not in unknown and k >= fit.delay - 1]:
        after = ", ".join(str(order[k] + 1) for k in missing)
        notes.append(f"frames are missing after frame {after}: the loop is not followed over these steps")
    share, u_share, noise_gain = gain_share(pixels.reshape(count, -1), factors, np.exp(fit.lamp), told[0])
    changes = _changes(scene)
    moved = _fit_of_moved_black(factors, blocks, static, levels, told, place, (*gaps, *unknown), fit, fixed=factors is not free)
    loop, more = loop_estimates(fit, moved, factors, (levels, told), changes, (share, u_share), unknown, noise_gain)
    return FrameSequence(
        interval_s=interval,
        exposure_s=group.exposure_s,
        level_dn=levels,
        gain_rel=factors.gain,
        offset_dn=factors.offset,
        covariance=factors.covariance,
        fitted_rel=np.exp(fit.fitted),
        scene_rel=scene / scene.mean(),
        static_share=float(static.mean()),
        changes=changes,
        gain_share=share,
        u_gain_share=u_share,
        black_moves_dn=moves,
        wave=wave or _wave_of(fit),
        loop=loop,
        notes=(*notes, *more),
    )


def _bands(
    rows: np.ndarray,
    blocks: np.ndarray,
    usable: np.ndarray,
    shape: tuple[int, ...],
    place: np.ndarray,
    dark: tuple[float, float] | None,
    hum_per_row: float,
) -> LampWave | None:
    """Bands of a lamp over the rows, sought where the frame is roughly as it always is.

    Factors and bands are found in turn.

    Raises
    ------
    MeasureError
        If there are bands and black is not known: their depth, and the gains behind them, hang on it.
    """
    _, off = _median_factors(blocks, usable)
    about = usable & (off <= 3 * np.median(off[usable]))
    black = dark[0] if dark is not None else _black_or_bound(None, blocks, usable)[0]
    wave: LampWave | None = None
    free, mean = blocks, rows.mean(axis=0)
    for _ in range(MOST_ROUNDS):
        found = _factors(free, about)
        if dark is not None and float(np.median(found.covariance[:, 0, 0])) > MOST_U_FACTOR**2:
            found = _factors(free, about, black)  # an even scene does not tell a factor from an offset
        before, wave = wave, row_wave(rows, mean, found.gain, found.offset, black, about.reshape(shape), place, wave, hum_per_row)
        if wave is None or wave.of_fields:
            return wave
        if before is not None and abs(wave.amplitude_rel - before.amplitude_rel) < 0.1 * wave.u_amplitude_rel:
            break
        if dark is None:
            raise MeasureError("the light makes bands over the rows, and black is not known", remedy="add dark frames (kind: dark)")
        light = wave.light(place, np.arange(rows.shape[1]))
        free = black + (blocks - black) / _by_block(light, shape)
        still = static_blocks(free, usable)
        about = still if still.mean() > LEAST_STATIC else about
        mean = black + ((rows - black) / light[:, :, None]).mean(axis=0)
    return wave


def _by_block(light: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """Mean over the rows of each block, shape (frames, blocks), of a light by rows, (frames, rows)."""
    tall = block_px(light.shape[1])
    means = light[:, : shape[0] * tall].reshape(len(light), shape[0], tall).mean(axis=2)
    return np.repeat(means, shape[1], axis=1)


def _median_factors(blocks: np.ndarray, usable: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Median over the blocks of each frame over the mean of all, and how far each block is off it, over the frames."""
    mean = blocks.mean(axis=0)
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = np.where(mean > 0, blocks / mean, 1.0)
    gain = np.median(ratio[:, usable], axis=1)
    return gain, (ratio / gain[:, None]).std(axis=0)


def _mean_of(one: tuple[float, float], other: tuple[float, float]) -> tuple[float, float]:
    """Two values of the same, with u, by their weights."""
    w, v = one[1] ** -2, max(other[1], 1e-6) ** -2
    return (one[0] * w + other[0] * v) / (w + v), (w + v) ** -0.5


def static_blocks(blocks: np.ndarray, usable: np.ndarray) -> np.ndarray:
    """Blocks that follow the others by a common factor and offset in every frame, bool, shape (blocks,).

    Begun with the half that follows the median best; then all are taken whose scatter about the common law is that of blocks of like
    light. A patch that changes in a part of the frame, and what is next to it, stays out.
    """
    count = len(blocks)
    mean = blocks.mean(axis=0)
    _, off = _median_factors(blocks, usable)
    static = usable & (off <= np.median(off[usable]))
    for _ in range(12):
        found = _factors(blocks, static)
        left = blocks - found.gain[:, None] * mean - found.offset[:, None]
        scatter = (left**2).sum(axis=0) / max(count - 2, 1)
        usual = _usual_scatter(mean, scatter, static)
        now = usable & (scatter < usual * (1 + 7 * np.sqrt(2 / count)))
        if (now == static).all() or now.sum() < 4:
            break
        static = now
    return static


def _usual_scatter(mean: np.ndarray, scatter: np.ndarray, static: np.ndarray) -> np.ndarray:
    """Median scatter of the static blocks of like light, straight in between, for all blocks."""
    order = np.argsort(mean[static])
    parts = np.array_split(order, max(1, min(8, static.sum() // 16)))
    x = np.array([np.median(mean[static][p]) for p in parts])
    y = np.array([np.median(scatter[static][p]) for p in parts])
    return np.asarray(np.interp(mean, x, y))


def _factors(blocks: np.ndarray, static: np.ndarray, black: float | None = None) -> _Factors:
    """Regress each frame on the mean of all, over the static blocks; with a known black through it."""
    mean, own = blocks[:, static].mean(axis=0), blocks[:, static]
    scatter = own - mean * (own.mean(axis=1) / mean.mean())[:, None]
    weight = 1.0 / np.maximum(_usual_scatter(mean, scatter.var(axis=0) + 1e-6, np.ones(len(mean), bool)), 1e-6)
    if black is not None:
        x = mean - black
        norm = float((weight * x * x).sum())
        gain = ((own - black) * (weight * x)).sum(axis=1) / norm
        left = own - black - gain[:, None] * x
        factor = (left**2 * weight).sum(axis=1) / max(len(x) - 1, 1)
        covariance = np.zeros((len(own), 2, 2))
        covariance[:, 0, 0] = factor / norm
        return _Factors(gain, black * (1 - gain), covariance)
    design = np.stack([mean, np.ones_like(mean)], axis=1)
    normal = design.T @ (weight[:, None] * design)
    inverse = np.linalg.pinv(normal, rcond=1e-15, hermitian=True)
    values = (own * weight) @ design @ inverse
    left = own - values @ design.T
    factor = (left**2 * weight).sum(axis=1) / max(len(mean) - 2, 1)
    return _Factors(values[:, 0], values[:, 1], factor[:, None, None] * inverse)


def _black_of(found: _Factors) -> tuple[tuple[float, float] | None, float]:
    """Black as the slope of the offsets on 1 − gain, with its u, and by how much it moves; no black where the gains do not move.

    A factor on the light about black B gives y = g (s − B) + B: an offset B (1 − g).
    """
    from scipy.special import chdtrc

    x, y, c = 1 - found.gain, found.offset, found.covariance
    u_gain = np.sqrt(c[:, 0, 0])
    black = 0.0
    for _ in range(4):
        var = np.maximum(c[:, 1, 1] + black**2 * c[:, 0, 0] + 2 * black * c[:, 0, 1], 1e-12)
        norm = float((x * x / var).sum())
        black = float((x * y / var).sum() / max(norm, 1e-300))
    chi2, dof = float(((y - black * x) ** 2 / var).sum()), len(x) - 2
    excess = float(np.sqrt(max(np.average((y - black * x) ** 2 - var, weights=1 / var), 0.0)))
    moves = excess if chdtrc(dof, chi2) < BLACK_CHANCE and excess > 0.05 else 0.0
    scatter = np.sqrt(max(chi2 / dof, 1.0))
    if np.sqrt(np.mean(x * x)) < MOVES * np.median(u_gain) or norm <= 0 or scatter / np.sqrt(norm) > 3.0:
        return None, moves
    return (black, float(scatter / np.sqrt(norm))), moves


def _black_or_bound(black: tuple[float, float] | None, blocks: np.ndarray, static: np.ndarray) -> tuple[float, float]:
    """Black with its u; where it is not told, half of the darkest level with that for its u."""
    if black is not None:
        return black
    darkest = float(blocks[:, static].min())
    return 0.5 * darkest, 0.5 * darkest


def _shows_light(levels: np.ndarray, contrasts: np.ndarray, dark: tuple[float, float] | None) -> np.ndarray:
    """Which frames show the scene: by their light, where black is known, and by the contrast of their blocks."""
    light = levels - (0.0 if dark is None else dark[0])
    lit: np.ndarray = (light > LEAST_LIGHT * np.median(light)) & (contrasts >= LEAST_LIGHT * np.median(contrasts))
    return lit


def _places(group: PictureGroup, order: np.ndarray) -> tuple[np.ndarray, list[int], float]:
    """When frames were taken, in frame times; steps over which frames are missing; time of a frame, 0 where it was not said."""
    place, interval = (order - order[0]).astype(float), group.facts.interval_s or 0.0
    if group.facts.times_s is not None:
        times = np.array(group.facts.times_s)
        if (np.diff(times) <= 0).any():
            raise MeasureError("the times of the frames do not rise", remedy=NO_ORDER)
        interval = float(np.median(np.diff(times[order])))
        place = (times[order] - times[order[0]]) / interval
    return place, np.flatnonzero(np.diff(place) > 1.5).tolist(), interval


def _loop_fit(factors: _Factors, levels: np.ndarray, black: float, place: np.ndarray, free: tuple[int, ...]) -> LoopFit:
    gain = np.maximum(factors.gain, 1e-6)
    u = np.maximum(np.sqrt(factors.covariance[:, 0, 0]) / gain, 1e-7)
    above = np.log(np.maximum(levels - black, 1e-3))
    return fit_loop(LoopData(np.log(gain), u, above, place, tuple(sorted(set(free)))))


def _fit_of_moved_black(
    factors: _Factors,
    blocks: np.ndarray,
    static: np.ndarray,
    levels: np.ndarray,
    black: tuple[float, float],
    place: np.ndarray,
    free: tuple[int, ...],
    fit: LoopFit,
    fixed: bool,
) -> np.ndarray:
    """By how much the parameters of a loop change with black by its u; zeros where that is another loop."""
    if black[1] > MOST_BLACK_DN:
        return np.zeros(len(fit.values))
    other = _factors(blocks, static, black[0] + black[1]) if fixed else factors
    moved = _loop_fit(other, levels, black[0] + black[1], place, free)
    return moved.values - fit.values if moved.names == fit.names else np.zeros(len(fit.values))


def _wave_of(fit: LoopFit) -> LampWave | None:
    """The wave in the light of whole frames."""
    if not fit.has_wave:
        return None
    c, s = fit["cosine"], fit["sine"]
    i = [fit.names.index(n) for n in ("cosine", "sine")]
    amplitude = float(np.hypot(c, s))
    slope = np.array([c, s]) / amplitude
    u = float(np.sqrt(slope @ fit.covariance[np.ix_(i, i)] @ slope))
    return LampWave(amplitude, u, fit["per_frame"], fit.u("per_frame"))


def _changes(scene: np.ndarray) -> int:
    """How often the scene goes through the middle of its range, by a quarter of it at least."""
    low, high = np.percentile(scene, [5, 95])
    if not high - low > LEAST_CHANGE * abs(scene.mean()):
        return 0
    state, changes = 0, 0
    for value in ((scene - low) / (high - low)).tolist():
        now = 1 if value > 0.75 else -1 if value < 0.25 else state
        changes += state != 0 and now != state
        state = now
    return changes


def gain_share(pixels: np.ndarray, factors: _Factors, lamp: np.ndarray, black: float) -> tuple[float, float, tuple[float, float] | None]:
    """Share of the changes that is gain, by the noise of single pixels; its u; if all is, the gain in DN/e- at a factor of 1 with its u.

    A factor g l, l of the lamp, of which g^q is gain and the rest exposure, gives noise of the variance g^(2q) d² + K g^(1+q) l s, where s
    is the light; noise behind the gain adds a constant.
    """
    from scipy.optimize import least_squares

    not_told = (0.0, float("inf"), None)
    own = np.maximum(factors.gain / lamp, 1e-6)[:, None]
    if float(np.log(own).std()) < 0.03:
        return not_told
    count, g = len(pixels), factors.gain[:, None]
    mean = (g * (pixels - factors.offset[:, None])).sum(axis=0) / float((g * g).sum())
    left = pixels - g * mean - factors.offset[:, None]
    scatter = left.var(axis=0)
    usual = _usual_scatter(mean, scatter, scatter < 3 * np.median(scatter))
    keep = (pixels.max(axis=0) < pixels.max()) & (mean > 0) & (scatter < 2.5 * usual)
    if keep.sum() < 200:
        return not_told
    edges = np.quantile(mean[keep], np.linspace(0, 1, 5))
    part = np.clip(np.digitize(mean[keep], edges) - 1, 0, 3)
    used = [j for j in range(4) if np.sum(part == j) > 20]
    light = np.array([mean[keep][part == j].mean() for j in used]) - black
    var = np.array([[left[k, keep][part == j].var() for j in used] for k in range(count)])
    var = var / (1 - g * g / (g * g).sum())  # what the frame itself gave to the mean
    n = np.array([np.sum(part == j) for j in used])

    def model(p: np.ndarray) -> np.ndarray:
        dark, slope, share, behind = p
        return np.asarray(np.maximum(own ** (2 * share) * dark + slope * own ** (1 + share) * lamp[:, None] * light + behind, 1e-6))

    weight = np.sqrt(n / 2) / np.maximum(var.mean(axis=0), 1e-9)
    begin = max(float(np.median(var.mean(axis=0) / np.maximum(light, 1.0))), 1e-6)
    first = np.array([1.0, begin, 0.5, 0.5])
    bounds = [0, 1e-9, -1, 0], [np.inf, np.inf, 2, np.inf]
    for _ in range(3):
        found = least_squares(lambda p, w: ((model(p) - var) * w).ravel(), first, bounds=bounds, x_scale=[1, begin, 0.1, 1], args=(weight,))
        weight, first = np.sqrt(n / 2) / model(found.x), found.x
    scale = max(2 * found.cost / max(var.size - 4, 1), 1.0)
    covariance = np.linalg.pinv(found.jac.T @ found.jac, hermitian=True) * scale
    u = float(np.sqrt(covariance[2, 2]))
    if not 0 < u < 1:
        return not_told
    own_gain = least_squares(
        lambda p: ((model(np.array([p[0], p[1], 1.0, p[2]])) - var) * weight).ravel(),
        first[[0, 1, 3]],
        bounds=([0, 1e-9, 0], np.inf),
        x_scale=[1, begin, 1],
    )
    of_gain = np.linalg.pinv(own_gain.jac.T @ own_gain.jac, hermitian=True) * scale
    return float(found.x[2]), u, (float(own_gain.x[1]), float(np.sqrt(of_gain[1, 1])))


def loop_estimates(
    fit: LoopFit,
    moved: np.ndarray,
    factors: _Factors,
    level: tuple[np.ndarray, tuple[float, float]],
    changes: int,
    share: tuple[float, float],
    unknown: Sequence[int],
    noise_gain: tuple[float, float] | None,
) -> tuple[Estimates, tuple[str, ...]]:
    """What one sequence tells of a loop: ``kappa``, ``target_dn``, ``black_dn``, and gains at its limits; and notes."""
    levels, (black, u_black) = level
    covariance = fit.covariance + np.outer(moved, moved)
    at = {n: i for i, n in enumerate(fit.names)}
    kappa, u_kappa = fit["kappa"], float(np.sqrt(covariance[at["kappa"], at["kappa"]]))
    reasons, notes = {}, []
    if len(unknown):
        notes.append(f"{len(unknown)} frames are clipped in part: what they ask of the gain is not known, and is not used")
    still = kappa < max(FOUND * u_kappa, LEAST_KAPPA)
    if changes < LEAST_CHANGES:
        more = f"the scene changes {changes} times between dark and bright, {LEAST_CHANGES} are needed"
        reasons["kappa"] = f"{'the scene does not change' if changes == 0 else more}: {SWITCH_GAIN}"
        return replace(Estimates.empty(), reasons=reasons), tuple(notes)
    if u_kappa > 0.3 or (still and kappa + ONE_SIDED_95 * u_kappa > 0.3):
        reasons["kappa"] = f"too few frames, or the scene changes too little: kappa is known to {u_kappa:.2g} only ({SWITCH_GAIN})"
        return replace(Estimates.empty(), reasons=reasons), tuple(notes)
    dof = float(fit.dof)
    if still:
        limit = max(kappa, 0.0) + ONE_SIDED_95 * u_kappa
        rows = [("kappa", limit, u_kappa, dof, "1")]
        why = {"kappa": "the gain does not follow the scene; 95 % upper limit"}
        return Estimates.from_rows(rows, method=METHOD, limits=frozenset({"kappa"}), reasons=why), tuple(notes)
    if fit.delay > 1:
        what = f"the gain answers {fit.delay} frames later: no loop that acts on the next frame, as the source describes it"
        reasons["kappa"] = f"{what}; κ is {kappa:.3f} ± {u_kappa:.3f} of such a loop"
        return replace(Estimates.empty(), reasons=reasons), tuple(notes)
    if u_black > MOST_BLACK_DN:
        reasons["kappa"] = f"the gain follows the scene (κ about {kappa:.2g}), but black is not known: add dark frames (kind: dark)"
        return replace(Estimates.empty(), reasons=reasons), tuple(notes)
    swing = np.log(factors.gain) - fit.lamp
    left = float(np.std(np.log(factors.gain) - fit.fitted) / max(np.std(swing), 1e-12))
    if left > MOST_LEFT:
        reasons["kappa"] = f"the gain moves, but not as a loop of first order: {100 * left:.0f} % of its movement is left by the best fit"
        return replace(Estimates.empty(), reasons=reasons), tuple(notes)
    if fit.scatter > 5:
        notes.append(f"gains scatter about the loop by {fit.scatter:.0f} u of theirs: steps of the gain, or another law; u holds that")
    target = float(np.exp(fit["push"] / kappa))
    i = [at["push"], at["kappa"]]
    slopes = np.array([[0.0, 1.0], [target / kappa, -target * np.log(target) / kappa]])
    joint = np.zeros((3, 3))
    joint[:2, :2] = slopes @ covariance[np.ix_(i, i)] @ slopes.T
    joint[2, 2] = u_black**2
    joint[:2, 2] = joint[2, :2] = slopes @ moved[i] * u_black
    names, values, units, dofs = ["kappa", "target_dn", "black_dn"], [kappa, target, black], ["1", "DN", "DN"], [dof, dof, dof]
    for name in ("lowest", "highest"):
        if name in at:
            names.append(f"{name}_rel")
            values.append(float(np.exp(fit[name])))
            units.append("1")
            dofs.append(dof)
            joint = np.pad(joint, ((0, 1), (0, 1)))
            joint[-1, -1] = float(values[-1] ** 2 * covariance[at[name], at[name]])
    if noise_gain is not None:
        names.append("gain_dn_per_e")
        values.append(noise_gain[0])
        units.append("DN/e-")
        dofs.append(np.inf)
        joint = np.pad(joint, ((0, 1), (0, 1)))
        joint[-1, -1] = noise_gain[1] ** 2
    alike = "an exposure that follows the scene: the noise of these frames does not tell it from a gain"
    confounders = () if share[1] < KNOWN_SHARE else (alike,)
    found = Estimates(tuple(names), np.array(values), joint, np.array(dofs), tuple(units), METHOD, confounders, reasons=reasons)
    return found, tuple(notes)


def loop_of_all(found: Sequence[FrameSequence], refused: Sequence[str], seen: Observations) -> Estimates:
    """``kappa``, ``target_dn`` and limits in dB of all sequences together, or the reason why they are not told."""
    told = [s for s in found if "kappa" in s.loop]
    if not told:
        causes = [*(s.loop.reasons["kappa"] for s in found if "kappa" in s.loop.reasons), *refused]
        return replace(Estimates.empty(), reasons={"kappa": causes[0] if causes else f"no sequence: {SWITCH_GAIN}"})
    moving = [s for s in told if not s.loop.limits]
    if not moving:
        best = min(told, key=lambda s: s.loop["kappa"].value)
        limit = best.loop["kappa"].value
        if limit < LEAST_KAPPA:
            slow = f"a loop slower than {LEAST_KAPPA:g} takes hundreds of frames to settle"
            locked = f"the gain stays as it is: κ is below {limit:.2g} (95 %), and {slow}"
            stuck = ("a gain that stays at its limit in light like this",)
            return Estimates.from_rows([("kappa", 0.0, 0.0, np.inf, "1")], method=METHOD, confounders=stuck, reasons={"kappa": locked})
        row = ("kappa", max(limit, LEAST_KAPPA * 3**0.5 * 1.001), best.loop.u[0], float(best.loop.dof[0]), "1")
        return Estimates.from_rows([row], method=METHOD, limits=frozenset({"kappa"}), reasons=dict(best.loop.reasons))
    exposed = next((s for s in moving if s.u_gain_share < KNOWN_SHARE and s.gain_share < 1 - max(3 * s.u_gain_share, 0.1)), None)
    if exposed is not None:
        share = f"{100 * max(exposed.gain_share, 0.0):.0f} % ± {100 * exposed.u_gain_share:.0f} %"
        both = "the exposure follows the scene, not the gain" if exposed.gain_share < 0.2 else "gain and exposure follow the scene together"
        kappa = exposed.loop["kappa"]
        why = f"{both}: by the noise, {share} of the change in decibels is gain (the loop's κ is {kappa.value:.3f} ± {kappa.u:.3f})"
        return replace(Estimates.empty(), reasons={"kappa": why})
    value, covariance, dof, reasons = mean_of_loops([s.loop for s in moving])
    if value[0] > 1:
        return replace(Estimates.empty(), reasons={"kappa": f"the loop overshoots, κ = {value[0]:.3g}: the source describes 0 to 1"})
    reasons = {"target_dn": WHOLE_FRAME, **reasons}
    confounders = tuple(dict.fromkeys(c for s in moving for c in s.loop.confounders))
    joint = Estimates(("kappa", "target_dn"), value, covariance, dof, ("1", "DN"), METHOD, confounders, reasons=reasons)
    return joint.join(_limits_db(moving, seen))


def mean_of_loops(parts: Sequence[Estimates]) -> tuple[np.ndarray, np.ndarray, np.ndarray, dict[str, str]]:
    """κ and target by their inverse covariances; widened, with a reason, where they differ by more than that (Birge's ratio).

    What black adds to their errors is the same in all sequences, and no mean makes it smaller.
    """
    from scipy.special import chdtrc

    names = ("kappa", "target_dn")
    told = [p.select((*names, "black_dn")).covariance for p in parts]
    values, common = [p.select(names).values for p in parts], [c[:2, 2] / max(float(np.sqrt(c[2, 2])), 1e-300) for c in told]
    inverses = [np.linalg.inv(c[:2, :2]) for c in told]
    mean = np.linalg.inv(sum(inverses))
    value = mean @ sum(i @ v for i, v in zip(inverses, values, strict=True))
    chi2 = float(sum((v - value) @ i @ (v - value) for i, v in zip(inverses, values, strict=True)))
    free, reasons, widened = 2 * (len(parts) - 1), {}, 1.0
    if free and chdtrc(free, chi2) < 1e-3:
        widened = chi2 / free
        reasons = dict.fromkeys(names, f"{len(parts)} sequences differ by more than their u: u holds that")
    each = [mean @ i for i in inverses]
    own = sum(w @ (c[:2, :2] - np.outer(b, b)) @ w.T for w, c, b in zip(each, told, common, strict=True))
    shared = sum(w @ b for w, b in zip(each, common, strict=True))
    dof = np.sum([p.select(names).dof for p in parts], axis=0)
    return value, widened * (own + np.outer(shared, shared)), dof, reasons


def _limits_db(moving: Sequence[FrameSequence], seen: Observations) -> Estimates:
    """Gains at the limits of the loop in dB over that of the photon transfer; without them the reasons."""
    fit, reasons, rows = seen.photon_transfer_fit, {}, []
    for name, sign in (("lowest", -1), ("highest", 1)):
        of_it = [s for s in moving if f"{name}_rel" in s.loop]
        if not of_it:
            reached = max(sign * float(np.log(s.gain_rel).max() if sign > 0 else np.log(s.gain_rel).min()) for s in moving)
            less = "" if sign > 0 else "-"
            reasons[f"{name}_db"] = f"the gain reached no such limit (it went to {less}{20 * reached / np.log(10):.1f} dB of its mean)"
            continue
        s = of_it[0]
        rel = s.loop[f"{name}_rel"]
        if "gain_dn_per_e" not in s.loop or fit is None or "gain_dn_per_e" not in fit:
            what = f"the limit is {20 * np.log10(rel.value):.2f} dB from the mean gain of the sequence"
            reasons[f"{name}_db"] = f"{what}; over the camera's gain it needs the gain of the photon transfer and noise in the sequence"
            continue
        own, base = s.loop["gain_dn_per_e"], fit["gain_dn_per_e"]
        ratio = rel.value * own.value / base.value
        u = float(np.linalg.norm([n.u / n.value for n in (rel, own, base)]))
        value, u_db = 20 * float(np.log10(ratio)), 20 / float(np.log(10)) * u
        if sign * value < -3 * u_db:
            reasons[f"{name}_db"] = f"the limit lies {value:.2f} dB from the gain of the photon transfer, on its other side"
            continue
        rows.append((f"{name}_db", sign * max(sign * value, 0.0), u_db, np.inf, "dB"))
    return replace(Estimates.from_rows(rows, method=METHOD), reasons=reasons) if rows else replace(Estimates.empty(), reasons=reasons)
