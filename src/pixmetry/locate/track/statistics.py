"""What tracked targets say of themselves: how well they repeat, what their stated uncertainty says of that, drift, Allan deviation."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from pixmetry.locate.track._statistics_kernels import OCTAVES, Sums, accumulate

SECOND = 6.0  # variance of a second difference of white noise, over that of the noise
SHARED = 1.944  # second differences of white noise that are worth one alone: 1 + 2 (16 + 1)/36, by their correlations −4/6 and 1/6
CLEAR_SIGMA = 5.0  # by which a scatter must differ from what is stated (6e-7 by chance)
LEAST_RATIO = 1.1  # and the ratio of the standard deviations
LEAST_FRAMES = 20


@dataclass(frozen=True)
class TrackStatistics:
    """How tracked targets behaved over the frames; arrays of shape (n,), a number for each target, NaN where there are too few frames.

    Parameters
    ----------
    frames : ndarray of int
        In which the target was found, alone and whole: not as one region with another target, nor cut by a border that it has reached.
    mean_x_px, mean_y_px : ndarray
    std_x_px, std_y_px : ndarray
        Standard deviation of all positions: noise and motion.
    repeat_x_px, repeat_y_px : ndarray
        Standard deviation of the noise alone, from second differences of positions that follow each other, Σ (x₋₁ − 2 x₀ + x₁)² / 6n,
        without what is common to all targets (of eight and more). Steady motion has no part in it.
    stated_x_px, stated_y_px : ndarray
        Root mean square of the stated standard uncertainty.
    s_curve_px : ndarray
        The part of it that is over the sub-pixel phase: it does not show where a target rests.
    drift_x_px, drift_y_px : ndarray
        Slope of a straight line through all positions, px per unit of time (frame, or second where times are given).
    u_drift_x_px, u_drift_y_px : ndarray
        From the scatter about that line.
    told_x, told_y : ndarray of int
        1 where the scatter is greater than the stated uncertainty, −1 where it is less than its random part, by 5 standard deviations and
        a tenth; else 0.
    common_x_px, common_y_px : float
        Standard deviation, from second differences, of what is common to all targets; NaN where they are few.
    tau_frames : ndarray, shape (m,)
        Averaging times, 1, 2, 4, …
    allan_x_px, allan_y_px : ndarray, shape (m,)
        Allan deviation over these, root mean square over the targets.

    References
    ----------
    D. W. Allan, Proc. IEEE 54(2), 221 (1966). J. von Neumann, R. H. Kent, H. R. Bellinson, B. I. Hart, Ann. Math. Stat. 12(2), 153 (1941),
    for the variance from differences.
    """

    frames: np.ndarray
    mean_x_px: np.ndarray
    mean_y_px: np.ndarray
    std_x_px: np.ndarray
    std_y_px: np.ndarray
    repeat_x_px: np.ndarray
    repeat_y_px: np.ndarray
    stated_x_px: np.ndarray
    stated_y_px: np.ndarray
    s_curve_px: np.ndarray
    drift_x_px: np.ndarray
    drift_y_px: np.ndarray
    u_drift_x_px: np.ndarray
    u_drift_y_px: np.ndarray
    told_x: np.ndarray
    told_y: np.ndarray
    common_x_px: float
    common_y_px: float
    tau_frames: np.ndarray
    allan_x_px: np.ndarray
    allan_y_px: np.ndarray

    def columns(self) -> dict[str, np.ndarray]:
        """The columns of the table of targets, by name."""
        n = len(self.frames)
        arrays = {name: value for name, value in vars(self).items() if isinstance(value, np.ndarray) and name not in OF_TIMES}
        return {"target": np.arange(n), **arrays}

    def to_record(self) -> dict[str, Any]:
        """Plain record; None where there is no value."""

        def plain(values: Any) -> Any:
            return [v if not isinstance(v, float) or math.isfinite(v) else None for v in np.atleast_1d(values).tolist()]

        common = {name: plain(getattr(self, name))[0] for name in ("common_x_px", "common_y_px")}
        columns = {name: plain(values) for name, values in self.columns().items()}
        return {"targets": columns, **common, **{name: plain(getattr(self, name)) for name in OF_TIMES}}


OF_TIMES = ("tau_frames", "allan_x_px", "allan_y_px")


class Statistics:
    """Sums over frames, and what follows from them; the memory does not grow with the frames."""

    def __init__(self, n: int) -> None:
        ints = np.int64
        self.sums = Sums(
            seen=np.zeros(n, ints), run=np.zeros(n, ints), first=np.zeros((n, 2)), place=np.zeros((n, 2, 3)), time=np.zeros((n, 2)),
            stated=np.zeros((n, 2)), phase=np.zeros(n), last=np.zeros((n, 2, 2)), second=np.zeros((n, 2)), seconds=np.zeros(n, ints),
            common=np.zeros(3), half=np.zeros((n, 2, OCTAVES)), mean=np.zeros((n, 2, OCTAVES)), state=np.zeros((n, OCTAVES), ints),
            allan=np.zeros((n, 2, OCTAVES)), allans=np.zeros((n, OCTAVES), ints),
        )  # fmt: skip
        self._start: float | None = None

    def add(self, time: float, result: np.ndarray, s_curve_px: np.ndarray, found: np.ndarray) -> None:
        """Add the positions of a frame; ``result`` (n, 5 or more): x, y, var x, cov, var y."""
        self._start = time if self._start is None else self._start
        accumulate(self.sums, time - self._start, result, s_curve_px, found)  # seconds since 1970 have no digits left in their squares

    def result(self) -> TrackStatistics:
        """What the frames so far say."""
        s = self.sums
        with np.errstate(divide="ignore", invalid="ignore"):
            n = np.where(s.seen > 0, s.seen, np.nan)[:, None]
            mean = s.place[:, :, 0] / n
            spread = s.place[:, :, 1] / n - mean**2
            std = np.sqrt(np.maximum(spread * n / np.where(n > 1, n - 1, np.nan), 0.0))
            t = s.time[:, :1] / n
            times = s.time[:, 1:] / n - t**2
            slope = (s.place[:, :, 2] / n - t * mean) / np.where(times > 0, times, np.nan)
            about = np.maximum(spread - slope**2 * times, 0.0) * n / np.where(n > 2, n - 2, np.nan)
            u_slope = np.sqrt(about / (n * times))
            differences = np.where(s.seconds > 0, s.seconds, np.nan)[:, None]
            repeat = s.second / (SECOND * differences)
            stated, phase = s.stated / n, s.phase / s.seen
            common = np.sqrt(s.common[:2] / (SECOND * s.common[2])) if s.common[2] else np.full(2, np.nan)
            used = np.flatnonzero(s.allans.sum(axis=0))
            allan = np.sqrt(s.allan[:, :, used].sum(axis=0) / (2 * s.allans[:, used].sum(axis=0)))
        told = [_told(repeat[:, k], stated[:, k], phase, s.seconds) for k in (0, 1)]
        pairs = zip(
            ("mean", "std", "repeat", "stated", "drift", "u_drift"),
            (s.first + mean, std, np.sqrt(repeat), np.sqrt(stated), slope, u_slope),
            strict=True,
        )
        columns = {f"{name}_{axis}_px": np.ascontiguousarray(values[:, k]) for name, values in pairs for k, axis in enumerate("xy")}
        return TrackStatistics(
            frames=s.seen.copy(),
            **columns,
            s_curve_px=np.sqrt(phase),
            told_x=told[0],
            told_y=told[1],
            common_x_px=float(common[0]),
            common_y_px=float(common[1]),
            tau_frames=2**used,
            allan_x_px=allan[0],
            allan_y_px=allan[1],
        )


def _told(repeat: np.ndarray, stated: np.ndarray, phase: np.ndarray, seconds: np.ndarray) -> np.ndarray:
    """1 where a scatter is clearly greater than what is stated, −1 where it is clearly less than its random part."""
    enough = seconds >= LEAST_FRAMES
    with np.errstate(divide="ignore", invalid="ignore"):
        reach = np.exp(np.sqrt(CLEAR_SIGMA**2 * 2 * SHARED / np.maximum(seconds, 1))) * LEAST_RATIO**2
        over, under = enough & (repeat > reach * stated), enough & (repeat * reach < stated - phase)
    return over.astype(int) - under.astype(int)


def disagreements(found: TrackStatistics, noise_from: str) -> tuple[str, ...]:
    """Say which targets scatter more or less than their stated uncertainty tells; ``noise_from``: origin of the noise model."""
    sentences = []
    for side, words, why in (
        (1, "more than its stated uncertainty", "it moves or its light flickers by itself, or it is not as the estimator takes it to be"),
        (-1, "less than the random part of its stated uncertainty", f"the noise model ({noise_from}) has too much noise"),
    ):
        for axis in ("x", "y"):
            told = np.flatnonzero(getattr(found, f"told_{axis}") == side)
            if not len(told):
                continue
            repeat, stated = getattr(found, f"repeat_{axis}_px")[told], getattr(found, f"stated_{axis}_px")[told]
            worst = int(np.argmax(np.abs(np.log(repeat / stated))))
            ratio = repeat[worst] / stated[worst]
            text = f"target {told[worst]} repeats to {repeat[worst]:.2g} px in {axis}, {words} ({stated[worst]:.2g} px; ratio {ratio:.2f})"
            more = f"; so do {len(told) - 1} others of {len(found.frames)}" if len(told) > 1 else ""
            sentences.append(f"{text}{more}: {why}")
    return tuple(sentences)
