"""The loop that moves the gain from frame to frame, and a lamp that flickers at the same time, fitted to the gain of each frame."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

CHANCE = 1e-3  # of taking noise for a wave of the lamp
LIMIT_CHI2 = 25.0  # by which a limit of the gain must improve the fit
DELAYS = (1, 2, 3)  # frames after which the gain answers
DELAY_CHI2 = 25.0
GAP_CHI2 = 40.0  # by which a frame that is missing must improve it
MOST_GAPS = 3
GOOD_SCATTER = 1.5  # from which on a fit needs no more
STARTS = 3  # of a search that are followed
LEAST_TOLD = 0.2  # u of κ over κ, up to which limits of the gain are believed
LEAST_WAVE = 5.0  # amplitude over its u
WAVE = ("cosine", "sine", "per_frame")


@dataclass(frozen=True)
class LoopFit:
    """The fit of one sequence; logarithms of the gain.

    Parameters
    ----------
    names : tuple of str
        ``start``, ``kappa``, ``push`` (κ times the logarithm of the target), ``cosine``, ``sine``, ``per_frame``, ``lowest``, ``highest``
        as far as they were fitted, then one ``gap`` for each step that is free.
    values, covariance : ndarray
        The scatter of the frames about the fit is in the covariance.
    fitted, lamp : ndarray, shape (frames,)
        Loop and lamp, and the lamp alone.
    chi2 : float
        By the stated u, before the scatter.
    scatter : float
        Root of χ² over its degrees of freedom.
    dof : int
    delay : int
        Frames after which the gain answers.
    gaps : tuple of int
        Steps, by their first frame, that are free.
    """

    names: tuple[str, ...]
    values: np.ndarray
    covariance: np.ndarray
    fitted: np.ndarray
    lamp: np.ndarray
    chi2: float
    scatter: float
    dof: int
    delay: int
    gaps: tuple[int, ...]

    def __getitem__(self, name: str) -> float:
        return float(self.values[self.names.index(name)])

    def u(self, name: str) -> float:
        """Standard uncertainty of a parameter."""
        i = self.names.index(name)
        return float(np.sqrt(self.covariance[i, i]))

    @property
    def has_wave(self) -> bool:
        """Whether a lamp's wave was found."""
        return "cosine" in self.names


@dataclass(frozen=True)
class LoopData:
    """Gains of frames and what drives them.

    Parameters
    ----------
    log_gain, u : ndarray, shape (frames,)
    log_level : ndarray, shape (frames,)
        Logarithm of each frame's mean above black.
    place : ndarray, shape (frames,)
        When the frame was taken, in frame times.
    free : tuple of int
        Steps from frame k to the next of which nothing is known: the mean of frame k is clipped, or frames are missing after it.
    """

    log_gain: np.ndarray
    u: np.ndarray
    log_level: np.ndarray
    place: np.ndarray
    free: tuple[int, ...] = ()


def fit_loop(data: LoopData) -> LoopFit:
    """Fit ln g(k+1) = ln g(k) + κ (ln T − ln m(k)), held within limits where it needs them, and a lamp's wave on top.

    Parameters
    ----------
    data : LoopData

    Returns
    -------
    LoopFit

    Notes
    -----
    The levels m(k) are measured, with the lamp's light in them, so the sum over the levels before a frame is known, and the errors of the
    gains are independent of each other. That is the whole information of a first-order loop that is linear in decibels; differences of
    successive gains would have correlated errors. The wave of the lamp multiplies the frame at once, the loop answers a frame later. Its
    frequency is sought in the periodogram of what is left, and accepted at a chance of `CHANCE` over all frequencies.
    """
    fits = [_fit_of_delay(data, delay) for delay in DELAYS]
    found = fits[0]
    better = min(fits[1:], key=lambda f: f.chi2)
    if found.chi2 - better.chi2 > DELAY_CHI2 * max(better.scatter**2, 1.0):
        found = better
    return _with_gaps(data, found)


def _fit_of_delay(data: LoopData, delay: int) -> LoopFit:
    """The best fit for one delay: without limits, or with those that it needs; with a wave if one is found."""
    gaps = tuple(sorted({*range(delay - 1), *data.free}))
    found: LoopFit | None = None
    for limits in ((), ("highest",), ("lowest",), ("lowest", "highest")):
        if found is not None and (found.scatter < GOOD_SCATTER or (delay > 1 and limits)):
            break
        own = min((_fit(data, names, delay, gaps, start) for names, start in _starts(data, delay, gaps, limits)), key=lambda f: f.chi2)
        own = _with_wave(data, own)
        if limits and own.u("kappa") > LEAST_TOLD * abs(own["kappa"]):
            continue
        if found is None or found.chi2 - own.chi2 > LIMIT_CHI2 * (len(limits) - _limits_in(found)) * max(own.scatter**2, 1.0):
            found = own
    assert found is not None
    return found


def _limits_in(found: LoopFit) -> int:
    return sum(name in found.names for name in ("lowest", "highest"))


def _starts(data: LoopData, delay: int, gaps: tuple[int, ...], limits: tuple[str, ...]) -> list[tuple[tuple[str, ...], dict[str, float]]]:
    """Names and first values for a fit: the best loops of a coarse search with and without the strongest wave in what they leave."""
    gain, levels = data.log_gain, data.log_level
    span = max(float(np.ptp(gain)), 1e-3)
    highs = gain.max() - span * np.array([0.0, 0.05, 0.15]) if "highest" in limits else np.array([np.inf])
    lows = gain.min() + span * np.array([0.0, 0.05, 0.15]) if "lowest" in limits else np.array([-np.inf])
    kappas = np.geomspace(0.01, 1.2, 25)
    targets = np.linspace(levels.min() - 0.5, levels.max() + 0.7, 49)
    kappa, target, low, high = (v.ravel() for v in np.meshgrid(kappas, targets, lows, highs, indexing="ij"))
    path = np.empty((len(kappa), len(gain)))
    path[:, 0] = gain[0]
    for k in range(len(gain) - 1):
        step = gain[k + 1] - gain[k] if k in gaps else kappa * (target - levels[k - delay + 1])
        path[:, k + 1] = np.minimum(np.maximum(path[:, k] + step, low), high)
    left = gain - path
    left -= left.mean(axis=1, keepdims=True)
    total = (left**2).sum(axis=1)
    waves = np.abs(np.fft.rfft(left, 2 * len(gain), axis=1)[:, 2:]) ** 2 * 2 / len(gain)
    out: list[tuple[tuple[str, ...], dict[str, float]]] = []
    for with_wave, best in (
        (w, b) for c, w in ((total, False), (total - waves.max(axis=1), True)) for b in _lowest(c, kappa, target, STARTS if limits else 1)
    ):
        start = {"start": float(gain[0]), "kappa": kappa[best], "push": kappa[best] * target[best]}
        start |= {name: float(v[best]) for name, v in (("lowest", low), ("highest", high)) if name in limits}
        start |= {f"gap {i}": float(gain[i + 1] - gain[i]) for i in gaps}
        if with_wave:
            start["per_frame"] = (int(np.argmax(waves[best])) + 2) / (2 * len(gain))
            start |= _phases_of(data, left[best], start["per_frame"])
        out.append(((*limits, *(WAVE if with_wave else ())), start))
    return out


def _lowest(cost: np.ndarray, kappa: np.ndarray, target: np.ndarray, count: int) -> list[int]:
    """Places of the lowest costs that are apart in κ or target."""
    chosen: list[int] = []
    for i in np.argsort(cost)[:500].tolist():
        if all(abs(np.log(kappa[i] / kappa[j])) > 0.3 or abs(target[i] - target[j]) > 0.1 for j in chosen):
            chosen.append(i)
        if len(chosen) == count:
            break
    return chosen


def _phases_of(data: LoopData, left: np.ndarray, per_frame: float) -> dict[str, float]:
    """Cosine and sine of a wave of this frequency."""
    angle = 2 * np.pi * per_frame * data.place
    c, s = np.linalg.lstsq(np.stack([np.cos(angle), np.sin(angle)], axis=1), left, rcond=None)[0].tolist()
    return {"cosine": c, "sine": s}


def _path(names: tuple[str, ...], values: np.ndarray, data: LoopData, delay: int, gaps: tuple[int, ...]) -> np.ndarray:
    """Logarithm of the gain of each frame by the model, without the lamp."""
    told = dict(zip(names, values.tolist(), strict=False))
    free = dict(zip(gaps, values[len(values) - len(gaps) :].tolist(), strict=True))
    low, high = told.get("lowest", -np.inf), told.get("highest", np.inf)
    kappa, push, gain = told["kappa"], told["push"], told["start"]
    levels = data.log_level.tolist()
    out = [gain]
    for k in range(len(levels) - 1):
        step = free[k] if k in free else push - kappa * levels[k - delay + 1]
        gain = min(max(gain + step, low), high)
        out.append(gain)
    return np.array(out)


def _model(names: tuple[str, ...], values: np.ndarray, data: LoopData, delay: int, gaps: tuple[int, ...]) -> np.ndarray:
    out = _path(names, values, data, delay, gaps)
    if "cosine" in names:
        c, s, f = (values[names.index(n)] for n in ("cosine", "sine", "per_frame"))
        angle = 2 * np.pi * f * data.place
        out = out + np.log1p(np.clip(c * np.cos(angle) + s * np.sin(angle), -0.99, None))
    return out


def _slopes(names: tuple[str, ...], values: np.ndarray, data: LoopData, delay: int, gaps: tuple[int, ...]) -> np.ndarray:
    """Derivatives of `_model` by its parameters, shape (frames, parameters)."""
    at = {name: i for i, name in enumerate(names)}
    path = _path(names, values, data, delay, gaps)
    out = np.zeros((len(path), len(names)))
    out[0, at["start"]] = 1.0
    free = {k: at[f"gap {k}"] for k in gaps}
    ends = [(values[at[name]], at[name]) for name in ("lowest", "highest") if name in at]
    for k in range(len(path) - 1):
        out[k + 1] = out[k]
        if k in free:
            out[k + 1, free[k]] += 1.0
        else:
            out[k + 1, at["push"]] += 1.0
            out[k + 1, at["kappa"]] -= data.log_level[k - delay + 1]
        for end, i in ends:
            if path[k + 1] == end:
                out[k + 1] = 0.0
                out[k + 1, i] = 1.0
    if "cosine" in at:
        c, s, f = (values[at[n]] for n in WAVE)
        angle = 2 * np.pi * f * data.place
        wave = c * np.cos(angle) + s * np.sin(angle)
        inside = np.where(wave > -0.99, 1 / (1 + np.maximum(wave, -0.99)), 0.0)
        out[:, at["cosine"]] = np.cos(angle) * inside
        out[:, at["sine"]] = np.sin(angle) * inside
        out[:, at["per_frame"]] = 2 * np.pi * data.place * (s * np.cos(angle) - c * np.sin(angle)) * inside
    return out


def _fit(data: LoopData, names: tuple[str, ...], delay: int, gaps: tuple[int, ...], start: dict[str, float]) -> LoopFit:
    """Least squares of start, κ and push with the parameters named; ``start`` holds values to begin with."""
    from scipy.optimize import least_squares

    every = ("start", "kappa", "push", *names, *(f"gap {k}" for k in gaps))
    first = np.array([start.get(n, 0.0) for n in every])
    scale = np.array([0.01 if n in ("cosine", "sine") else 1e-3 if n == "per_frame" else 0.1 for n in every])
    root = 1.0 / data.u

    def left(values: np.ndarray) -> np.ndarray:
        return np.asarray((_model(every, values, data, delay, gaps) - data.log_gain) * root)

    def slopes(values: np.ndarray) -> np.ndarray:
        return np.asarray(_slopes(every, values, data, delay, gaps) * root[:, None])

    found = least_squares(left, first, slopes, x_scale=scale, method="trf", max_nfev=200)
    frames = len(data.u)
    chi2, dof = float(2 * found.cost), max(frames - len(every), 1)
    scatter = float(np.sqrt(max(chi2 / dof, 1.0)))
    covariance = inverse_of(found.jac) * scatter**2 * _memory(found.fun)
    fitted = _model(every, found.x, data, delay, gaps)
    return LoopFit(every, found.x, covariance, fitted, fitted - _path(every, found.x, data, delay, gaps), chi2, scatter, dof, delay, gaps)


def inverse_of(jacobian: np.ndarray) -> np.ndarray:
    """Covariance of the parameters; large, not small, for what the data do not tell."""
    scale = np.maximum(np.linalg.norm(jacobian, axis=0), 1e-6)
    lengths, directions = np.linalg.eigh((jacobian / scale).T @ (jacobian / scale))
    return np.asarray((directions / np.maximum(lengths, 1e-12)) @ directions.T / np.outer(scale, scale))


def _memory(residuals: np.ndarray) -> float:
    """Factor on variances for residuals that are alike from frame to frame: (1 + r)/(1 − r) of a significant correlation r."""
    r = float(residuals[1:] @ residuals[:-1] / max(residuals @ residuals, 1e-300))
    return (1 + r) / (1 - r) if 3 / np.sqrt(len(residuals)) < r < 1 else 1.0


def _with_wave(data: LoopData, found: LoopFit) -> LoopFit:
    """The fit with the strongest wave in what it leaves if that is significant, and without one if not."""
    from scipy.special import fdtrc

    frames, begin = len(data.u), dict(zip(found.names, found.values.tolist(), strict=True))
    extra = tuple(n for n in found.names if n in ("lowest", "highest"))
    plain = _fit(data, extra, found.delay, found.gaps, begin) if found.has_wave else found
    left = data.log_gain - plain.fitted
    trial = np.arange(2, 2 * frames) / (4 * frames)  # ½ cycle over the sequence at least, in steps of a quarter of a bin
    power = [abs(np.exp(-2j * np.pi * f * data.place) @ left) for f in trial]
    start = {**dict(zip(plain.names, plain.values.tolist(), strict=True)), "per_frame": float(trial[int(np.argmax(power))])}
    start |= _phases_of(data, left, start["per_frame"])
    searched = _fit(data, (*extra, *WAVE), found.delay, found.gaps, start)
    found = min(searched, found, key=lambda f: f.chi2) if found.has_wave else searched
    dof = max(frames - len(found.names), 1)
    ratio = (plain.chi2 - found.chi2) / len(WAVE) / max(found.chi2 / dof, 1e-300)
    i = [found.names.index(n) for n in ("cosine", "sine")]
    size2, u2 = float(found.values[i] @ found.values[i]), float(np.trace(found.covariance[np.ix_(i, i)])) / 2
    lawful = 0.5 / frames < found["per_frame"] < 0.5 + 0.25 / frames and LEAST_WAVE**2 * u2 < size2 < 1
    return found if lawful and float(fdtrc(len(WAVE), dof, max(ratio, 0.0))) * frames / 2 < CHANCE else plain


def _with_gaps(data: LoopData, found: LoopFit) -> LoopFit:
    """The fit with steps set free where frames are missing: where one alone explains most of what is left."""
    extra = tuple(n for n in found.names if n in ("lowest", "highest", *WAVE))
    for _ in range(MOST_GAPS):
        if found.scatter < 3 or found["kappa"] < 5 * found.u("kappa"):
            return found
        begin = dict(zip(found.names, found.values.tolist(), strict=True))
        jumps = np.abs(np.diff(data.log_gain - found.fitted))
        tried = []
        for k in np.argsort(jumps)[::-1][:3].tolist():
            if k not in found.gaps:
                gaps = tuple(sorted((*found.gaps, k)))
                tried.append(_fit(data, extra, found.delay, gaps, {**begin, f"gap {k}": float(np.diff(data.log_gain)[k])}))
        best = min(tried, key=lambda f: f.chi2, default=found)
        if found.chi2 - best.chi2 < max(GAP_CHI2, 0.5 * found.chi2):
            return found
        found = best
        found = _with_wave(data, found)
    return found
