"""Frames in which the light goes off: what the first dark frames still show of the last bright one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from pixmetry.camera.noise_covariance import successive_correlation
from pixmetry.camera.observations import LightStep, LightSteps, Observations
from pixmetry.core.errors import MeasureError
from pixmetry.core.number import ONE_SIDED_95, Estimates
from pixmetry.observe.experiment import PictureGroup
from pixmetry.observe.noise_covariance import FrameSuccession, white_square
from pixmetry.observe.photon_transfer_levels import core_spread_dn2
from pixmetry.observe.photon_transfer_model import rounding_error_vars

BLOCK_PX = 8
SETTLED = 4  # dark frames after the step that may hold what the light left; the later ones are the reference
LEAST_REFERENCE = 4
SIGNIFICANT = 4.0
AGREES = 0.99995  # quantile up to which two shares agree
FOUND = 0.999  # probability with which nothing is taken for nothing
BINS = 8  # levels of light that are kept of one sequence
LEAST_ZERO = 1e-3  # share of dark pixels at code 0
LEAST_SIGNAL = 10.0  # of a block, over its noise
POCKET_RANGE = 3.0  # of light, over which a pocket shows as no share
LEAST_MEMORY = 0.005
LEAST_NOISE_DN2 = 0.16  # below, rounding hides what frames have in common
NO_STEP, SWITCH = "no frame is followed by a much darker one", "switch the light off while frames are taken"
LIKE_LAG = "temporal noise reduction leaves the same share; the noise of the dark frames is too small, or too little seen, to tell"
METHOD = "first dark frame over the last bright one, block by block of 8 × 8 pixels"


@dataclass
class BlockMeans:
    """Means of blocks of 8 × 8 pixels of every frame, by its index, and the differences of frames one and two apart."""

    means: dict[int, np.ndarray] = field(default_factory=dict)  # each of shape (rows // 8, cols // 8), float64, DN
    highest: dict[int, np.ndarray] = field(default_factory=dict)  # largest code of each block
    share_zero: dict[int, float] = field(default_factory=dict)
    squares: dict[tuple[int, int], float] = field(default_factory=dict)  # by first frame and distance, DN²
    _succession: FrameSuccession = field(default_factory=lambda: FrameSuccession(first=0, most=10**6))

    def add(self, frame: np.ndarray, index: int) -> None:
        """Add the frame of this index."""
        rows, cols = (max(n // BLOCK_PX, 1) for n in frame.shape)
        side = [min(BLOCK_PX, n) for n in frame.shape]
        blocks = frame[: rows * side[0], : cols * side[1]].reshape(rows, side[0], cols, side[1])
        self.means[index] = blocks.mean(axis=(1, 3), dtype=float)
        self.highest[index] = blocks.max(axis=(1, 3))
        self.share_zero[index] = float(np.mean(frame == 0))
        for key, first, second in self._succession.due(index, frame):
            self.squares[key] = white_square(first, second)


def reduce_light_off(groups: Sequence[PictureGroup], seen: Observations) -> Observations:
    """Find the step of every sequence, and the share of the last bright frame that the first dark one still shows."""
    steps, refused = [], []
    dnl = 0.0 if seen.code_errors is None or "dnl_rms_lsb" not in seen.code_errors.fit else seen.code_errors.fit["dnl_rms_lsb"].value
    spread = core_spread_dn2(seen.dark_stack)
    for number, group in enumerate(groups, start=1):
        try:
            steps.append(step_of(group, dnl, spread))
        except MeasureError as problem:
            refused.append(f"sequence {number} of {len(groups)}: {problem.what}" + (f" ({problem.remedy})" if problem.remedy else ""))
    bend = seen.bend_rel(max((s.signal_dn for s in steps), default=0.0))
    found = LightSteps(tuple(steps), tuple(refused), fit_of_steps(steps, refused, bend))
    return replace(seen, light_off=found, notes=(*seen.notes, *(f"Light that goes off: {why}" for why in refused)))


def step_of(group: PictureGroup, dnl_lsb: float = 0.0, spread_dn2: float = 0.0) -> LightStep:
    """The step of one sequence, behind a converter whose code widths scatter so, with pixels whose dark values differ by so much.

    Raises
    ------
    MeasureError
        If there is none, or too few frames follow it, or they are clipped.
    """
    assert isinstance(group.sums, BlockMeans)
    sums, count = group.sums, len(group.sums.means)
    if count < 2:
        raise MeasureError("one frame shows no step", remedy="list all frames of the sequence, in the order in which they were taken")
    frames = np.array([sums.means[i] for i in range(count)]).reshape(count, -1)
    level = frames.mean(axis=1)
    last = int(np.argmax(level[:-1] - level[1:]))
    n = count - last - 1 - SETTLED
    falls = level[:-1] - level[1:]
    usual = float(np.median(np.abs(np.delete(falls, last)))) if count > 2 else 0.0
    if falls[last] <= LEAST_SIGNAL * usual:
        raise MeasureError(NO_STEP, remedy=SWITCH)
    if n < LEAST_REFERENCE:
        what = f"{n + SETTLED} frames follow the step, {SETTLED + LEAST_REFERENCE} are needed"
        raise MeasureError(what, remedy=f"take {LEAST_REFERENCE - n} frames more after the light is off")
    reference = frames[last + 1 + SETTLED :]
    if max(sums.share_zero[i] for i in range(last + 1, count)) > LEAST_ZERO:
        raise MeasureError("the dark frames are clipped at code 0", remedy="raise the black level")
    black = reference.mean(axis=0)
    full = sums.highest[last].ravel() >= 2**group.bits - 1
    noise = float(reference.std(axis=0, ddof=1).mean())
    lit = ~full & (frames[last] - black > LEAST_SIGNAL * noise)
    if lit.sum() < BINS:
        if full.mean() > 0.5:
            raise MeasureError("the last bright frame is saturated", remedy="take less light")
        raise MeasureError(NO_STEP, remedy=SWITCH)
    signal, left = (frames[last] - black)[lit], (frames[last + 1 :] - black)[:, lit]
    weights = signal / (signal @ signal)
    shares = left @ weights
    white = float(np.mean(reference[:, lit].var(axis=0, ddof=1)))  # of the mean of a block
    spread = float(weights @ weights)
    common2 = max(float(np.var(shares[SETTLED:], ddof=1)) - white * spread, 0.0)
    least = 1 / 12 / BLOCK_PX**2  # of the rounding, where there is no noise
    own = [max(float(np.var(left[k] - shares[k] * signal, ddof=1)), least) for k in (0, 1)]
    converter = _Converter(float(white * BLOCK_PX**2) + spread_dn2, dnl_lsb)
    steps2 = [float(converter.covariance_dn2(np.array([shares[k] * signal.mean()]))[0, 0]) / float(signal.mean()) ** 2 for k in (0, 1)]
    u = [float(np.sqrt(v * spread + common2 * (1 + 1 / n) + of_steps)) for v, of_steps in zip(own, steps2, strict=True)]
    memory, u_memory = _noise_memory(sums, last + 1 + SETTLED, group.moments.shape)
    levels, means, covariance = _levels(signal, left[0], own[0], common2 * (1 + 1 / n) / float(weights.sum()) ** 2)
    return LightStep(
        bright_frames=last + 1,
        signal_dn=float(signal.mean()),
        shares=shares,
        u_shares=(u[0], u[1]),
        dof=float(n - 1) if common2 > own[0] * spread else float(lit.sum()),
        noise_correlation=memory,
        u_noise_correlation=u_memory,
        levels_dn=levels,
        left_dn=means,
        left_covariance_dn2=covariance + converter.covariance_dn2(means),
    )


@dataclass(frozen=True)
class _Converter:
    """A converter's error of the mean of many values, that scatter by ``variance_dn2`` over codes of unequal width."""

    variance_dn2: float
    dnl_lsb: float

    def covariance_dn2(self, raised_dn: np.ndarray) -> np.ndarray:
        """Of the errors of levels that are raised so much over black, less that of black: errors e^(−d²/4σ²) alike a distance d apart."""
        var = float(rounding_error_vars(np.array(self.variance_dn2), 0.0, self.dnl_lsb)[0])
        four = 4 * max(self.variance_dn2, 1 / 12)
        alike = np.exp(-((raised_dn[:, None] - raised_dn) ** 2) / four)
        black = np.exp(-(raised_dn**2) / four)
        return var * (alike - black[:, None] - black + 1)


def _levels(signal: np.ndarray, left: np.ndarray, block_var: float, common_var: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Means over blocks of like light: light, what was left of it, and its covariance."""
    edges = np.geomspace(signal.min(), signal.max() * (1 + 1e-9), BINS + 1) if signal.max() > 1.5 * signal.min() else np.array([0, np.inf])
    place = np.digitize(signal, edges) - 1
    used = [k for k in range(len(edges) - 1) if np.any(place == k)]
    levels, means = (np.array([v[place == k].mean() for k in used]) for v in (signal, left))
    counts = np.array([np.sum(place == k) for k in used])
    return levels, means, np.diag(block_var / counts) + common_var


def _noise_memory(sums: BlockMeans, first: int, shape: tuple[int, int]) -> tuple[float, float]:
    """Share of the frame before that dark frames hold, by their noise, and its u; infinite where there is no noise to see it."""
    pairs = [np.array([v for (i, lag), v in sums.squares.items() if lag == wanted and i >= first]) for wanted in (1, 2)]
    if min(len(p) for p in pairs) == 0 or pairs[0].mean() < LEAST_NOISE_DN2:
        return 0.0, float("inf")
    return successive_correlation(pairs[0].mean(), pairs[1].mean(), len(pairs[0]) + 1, shape[0] * shape[1])


def _not_a_share(steps: Sequence[LightStep]) -> int | None:
    """The step whose second frame shows most clearly something else than the square of what the first shows; None where all agree.

    A pocket leaves more than the square, too: a charge, of which the share falls as the light grows.
    """
    from scipy.special import stdtrit

    excess = np.array([s.shares[1] - s.shares[0] ** 2 for s in steps])
    u = np.array([np.hypot(s.u_shares[1], 2 * s.shares[0] * s.u_shares[0]) for s in steps])
    light = np.array([s.signal_dn for s in steps])
    centred = np.log(light) - np.average(np.log(light), weights=u**-2)
    slope, information = float((centred * excess / u**2).sum()), float((centred**2 / u**2).sum())
    pocket = light.max() > POCKET_RANGE * light.min() and slope < -SIGNIFICANT * np.sqrt(information)
    limit = stdtrit([s.dof for s in steps], AGREES) * u
    wrong = np.abs(excess) > limit if not pocket else excess < -limit
    return int(np.argmax(np.abs(excess / u) * wrong)) if wrong.any() else None


def fit_of_steps(steps: Sequence[LightStep], refused: Sequence[str], bend_rel: float = 0.0) -> Estimates:
    """``left_rel``, the share of a frame that the next one shows, of a response that bends so much; without a value the reason."""
    from scipy.special import stdtrit

    if not steps:
        return replace(Estimates.empty(), reasons={"left_rel": refused[0]})
    reduced = [s for s in steps if s.noise_correlation > max(3.5 * s.u_noise_correlation, LEAST_MEMORY)]
    if reduced:
        alpha = np.mean([s.noise_correlation for s in reduced])
        why = f"the noise of dark frames, too, holds a share of {alpha:.2g} of the frame before: temporal noise reduction; switch it off"
        return replace(Estimates.empty(), reasons={"left_rel": why})
    first, second = (np.array([s.shares[k] for s in steps]) for k in (0, 1))
    u_first = np.array([s.u_shares[0] for s in steps])
    weights = u_first**-2
    value, u = float(weights @ first / weights.sum()), float(weights.sum() ** -0.5)
    if (at := _not_a_share(steps)) is not None:
        told = f"the frames after the light went off hold {first[at]:.2g} and {second[at]:.2g} of it"
        why = f"{told}: a share that stays behind leaves its square in the second; the light went off during a frame, or decays slowly"
        return replace(Estimates.empty(), reasons={"left_rel": why})
    dof = float(min(s.dof for s in steps)) if len(steps) == 1 else float(sum(s.dof for s in steps))
    confounders = []
    if any(SIGNIFICANT * s.u_noise_correlation > first[k] for k, s in enumerate(steps)) and value > SIGNIFICANT * u:
        confounders = [LIKE_LAG]
    if value < float(stdtrit(dof, FOUND)) * u:
        limit = max(value, 0.0) + ONE_SIDED_95 * u
        rows = [("left_rel", limit, u, dof, "1")]
        none = {"left_rel": "not significantly above zero; 95 % upper limit"}
        return Estimates.from_rows(rows, method=METHOD, limits=frozenset({"left_rel"}), reasons=none)
    chi2 = float((((first - value) / u_first) ** 2).sum())
    reasons = {}
    if len(steps) > 1 and chi2 > len(steps) - 1 + SIGNIFICANT * np.sqrt(2 * (len(steps) - 1)):
        u *= float(np.sqrt(chi2 / (len(steps) - 1)))
        dof = float(len(steps) - 1)
        reasons["left_rel"] = f"the sequences differ, from {first.min():.2g} to {first.max():.2g}: it is no fixed share; u holds that"
    u, dof = float(np.hypot(u, bend_rel * value)), dof if bend_rel * value < u else np.inf
    return Estimates.from_rows([("left_rel", value, u, dof, "1")], method=METHOD, confounders=tuple(confounders), reasons=reasons)
