"""The video line from slanted edges: low-pass filter, video amplifier, echoes of the cable, and what cannot be told apart.

All that lies between the pixels of an analogue camera and the grabber acts at whole pixels: with the step response S of the line, a sample
is Σ h_k x(n − k), h_k = S(k + ½) − S(k − ½), for pixels are held for one period and read in its middle. Steps along x show it together with
lens and pixel; steps along y show lens and pixel nearly alone. The frequency response of the lens is not periodic, that of h is: this, and
that nothing comes before its cause, part the two.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from itertools import product

import numpy as np

from pixmetry.camera.line import low_pass_poles
from pixmetry.core.arrays import Array
from pixmetry.core.number import Estimates, Number
from pixmetry.observe._edge_kernels import line_taps
from pixmetry.observe.edge_curves import BIN_PX, EdgeCurve, curves_of
from pixmetry.observe.edges import MOST_RIGHT_PX, Region, Spread

SHARPEST_PX2, NEGLIGIBLE = 0.04, 1e-3  # variance of a Gaussian that no lens falls below here; in units of noise
PERIOD_PX = 128.0  # of the square wave that stands for an edge
MOST_FREQUENCY = 3.0  # cycles/px
TAPS = 56
SMALLEST_PATH = 1e-6
APART = 1e-4  # relative: equal poles are moved so far apart; the step response changes by the square of it
FILTERS = tuple(product(("butterworth", "bessel"), (2, 3, 4))) + (("rc", 1), ("rc", 2))
FOUND_CHI2 = 25.0  # by which χ² must rise without a part of the line for it to be there
LARGEST_U_REL = 1 / 3  # of a value that is given
LARGEST_U_A = 0.2  # of a width of the pixel that is given
MISFIT_P = 1e-4  # probability of a larger χ², below which the line is another one
ITERATIONS, CONVERGED = 40, 1e-3  # the last in χ²
MEAN_OF_GAUSSIAN, LARGEST_MEAN = 0.8, 1.6  # of |d| over the standard deviation of d; the largest leaves room for what 100 rows tell of it
STEP_REL = 1e-5  # of differences that stand for derivatives
METHOD = "joint fit of lens, pixel and video line to slanted edges along x and y; the mean of models, by their probability"


# ---- what a line does -------------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class LineModel:
    """Which parts a line has: a low-pass filter of a kind and order, an amplifier of second order, echoes of a cable or an open branch.

    The level of a line without a filter goes straight from one pixel to the next. Read d pixels late or early, it is (1 − |d|) of a pixel
    and |d| of a neighbour: rows that jitter are smoothed at whole pixels by the mean of |d|, which looks like a filter. ``jitter`` is the
    largest mean that is looked for, 0 if none.
    """

    kind: str = "off"
    order: int = 0
    amplifier: bool = False
    echo: str = ""  # of the cable, within the rise of an edge ("near") or behind it ("far"), or of an open branch ("branch")
    jitter: float = 0.0

    @property
    def names(self) -> tuple[str, ...]:
        """Free parameters: frequencies over the pixel clock, delays in pixel periods."""
        low_pass = ("cutoff_rel",) if self.order else ()
        amplifier = ("natural_rel", "damping") if self.amplifier else ()
        jitter = ("neighbour_rel",) if self.jitter else ()
        return low_pass + amplifier + jitter + {"": (), "branch": ("branch_px",)}.get(self.echo, ("ghost_rel", "echo_px"))

    @property
    def parts(self) -> frozenset[str]:
        """Ids of the sources that it needs."""
        told = {"grabber.low_pass": self.order > 0, "electronics.video_amplifier": self.amplifier}
        told |= {"cable.termination": self.echo in ("near", "far"), "cable.t_piece": self.echo == "branch"}
        return frozenset(name for name, there in told.items() if there)

    def limits(self, name: str) -> tuple[float, float]:
        """Range in which a parameter is looked for."""
        if name == "neighbour_rel":
            return 0.0, self.jitter
        low, high = LINE_LIMITS[name]
        if name == "echo_px":
            return (low, NEAR_PX) if self.echo == "near" else (NEAR_PX, high)
        return low, high

    def prior_width(self, name: str, value: float) -> float:
        """One over the density of the prior: log-uniform within the limits, or uniform where they are not above zero."""
        low, high = self.limits(name)
        return high - low if low <= 0 else float(np.log(high / low)) * value

    def holds(self, other: LineModel) -> bool:
        """Whether it is the other model, or that with further parts."""
        same = not other.order or (self.kind, self.order) == (other.kind, other.order)
        return same and self.amplifier >= other.amplifier and self.jitter >= other.jitter and other.echo in ("", self.echo)

    def poles(self, q: dict[str, float]) -> Array:
        """Of the filters, in radians per pixel period."""
        out = [np.zeros(0, complex)]
        if self.order:
            out.append(2 * np.pi * q["cutoff_rel"] * low_pass_poles(self.kind, self.order))
        if self.amplifier:
            root = np.sqrt(complex(q["damping"] ** 2 - 1))
            out.append(2 * np.pi * q["natural_rel"] * np.array([-q["damping"] + root, -q["damping"] - root]))
        poles: Array = np.concatenate(out)
        return poles

    def paths(self, q: dict[str, float]) -> tuple[Array, Array]:
        """Delays in pixel periods and amplitudes of the signal and its echoes."""
        if self.echo in ("near", "far"):
            return paths_of(q["echo_px"], 1 - q["ghost_rel"], 1.0, q["ghost_rel"])
        if self.echo == "branch":  # of matched cable: 2/3 [1 + 2/3 Σ (−1/3)^k]
            return paths_of(q["branch_px"], 2 / 3, 2 / 3, -1 / 3)
        return np.zeros(1), np.ones(1)

    def taps(self, q: dict[str, float]) -> Array:
        """h_0 … h_(TAPS − 1)."""
        delays, amplitudes = self.paths(q)
        poles = _separated(self.poles(q))
        out = np.zeros(TAPS)
        line_taps(poles, residues_of(poles), delays, amplitudes, out)
        return out

    def taps_read(self, q: dict[str, float]) -> Array:
        """h_(−1) … h_(TAPS − 1), smoothed by jitter: rows that are read early have a share of the next pixel."""
        share, taps = q.get("neighbour_rel", 0.0), np.pad(self.taps(q), 1)
        out: Array = (1 - share) * taps[:-1] + 0.5 * share * (taps[1:] + np.append(0.0, taps[:-2]))
        return out

    def delay_px(self, q: dict[str, float]) -> float:
        """How much later the centroid of anything comes: −Σ 1/p of the filters, and the mean of the paths."""
        delays, amplitudes = self.paths(q)
        return float(-(1 / self.poles(q)).sum().real + delays @ amplitudes / amplitudes.sum())

    def row_gain(self, q: dict[str, float]) -> float:
        """By how much the samples of a row move over its delay: the slopes at the sampling times, summed over a step.

        What passes the line at the pixel clock, H(1), folds back: 1 + 2 Σ Re(H(m) e^(iπm)) over m = 1, 2, … of samples in the middle of
        the pixels (Poisson). A line without a filter goes straight from pixel to pixel, and has 1.
        """
        poles = _separated(self.poles(q))
        if not len(poles):
            return 1.0
        delays, amplitudes = self.paths(q)
        first = np.ceil(delays - 0.5) + 0.5 - delays  # from a path's start to the next sample k + ½
        pulses = (-poles * residues_of(poles) * np.exp(np.outer(first, poles)) / (1 - np.exp(poles))).sum(axis=1).real
        return float(amplitudes @ pulses / amplitudes.sum())


def paths_of(delay: float, direct: float, first: float, ratio: float) -> tuple[Array, Array]:
    """A direct path, and echoes ``direct · first · ratio^k`` after k + 1 delays, or ``ratio^k`` after k where ``first`` is 1."""
    if abs(ratio) < 1e-12:
        return np.zeros(1), np.ones(1)
    count = max(1, int(np.ceil(np.log(SMALLEST_PATH) / np.log(abs(ratio)))))
    echoes = direct * (first if first != 1.0 else ratio) * ratio ** np.arange(count)
    echoes[-1] /= 1 - ratio
    return np.asarray(delay * np.arange(count + 1), float), np.asarray(np.append(direct, echoes), float)


def residues_of(poles: Array) -> Array:
    """Π_(j≠i) p_j/(p_j − p_i): with H = Π p_j/(p_j − s) the response to a step is 1 − Σ_i e^(p_i t) of these (partial fractions)."""
    ratio = poles[:, None] - poles[None, :]
    np.fill_diagonal(ratio, 1.0)
    factors = poles[:, None] / ratio
    np.fill_diagonal(factors, 1.0)
    out: Array = factors.prod(axis=0)
    return out


def _separated(poles: Array) -> Array:
    """Poles of which none equal another."""
    out = np.array(poles, complex)
    for i in range(1, len(out)):
        while (np.abs(out[:i] - out[i]) < 0.5 * APART * np.abs(out[i])).any():
            out[i] *= 1 + APART
    return out


# ---- what the edges show ----------------------------------------------------------------------------------------------------------------

OPTICS = ("spread_var_px2", "width_x_px", "width_y_px", "separation_x_px", "separation_y_px")
OPTICS_LOWEST = np.array([2e-3, 0.05, 0.05, 0.02, 0.02])
OPTICS_HIGHEST = np.array([25.0, 1.3, 1.3, 4.0, 4.0])
NEAR_PX = 1.5  # delay of an echo that lies within the rise of an edge
LINE_LIMITS = {
    "cutoff_rel": (0.04, 4.0),
    "natural_rel": (0.04, 4.0),
    "damping": (0.05, 4.0),
    "ghost_rel": (-0.6, 0.6),
    "echo_px": (0.05, 40.0),
    "branch_px": (0.02, 40.0),
}
STARTS = {"cutoff_rel": (0.4,), "natural_rel": (0.4, 0.9), "damping": (0.5,), "ghost_rel": (0.03,), "echo_px": (0.7, 2.0, 4.0, 9.0)}
STARTS |= {"branch_px": (0.5, 3.0, 9.0)}


@lru_cache(maxsize=8)
def _frequencies() -> Array:
    """Of the odd harmonics of the square wave, cycles/px."""
    return np.asarray(np.arange(1, MOST_FREQUENCY * PERIOD_PX, 2) / PERIOD_PX, float)


class _Seen:
    """One curve, whitened, and its model as a linear map of the spectrum of the square wave."""

    def __init__(self, curve: EdgeCurve) -> None:
        self.curve = curve
        nu = _frequencies()
        root = curve.whitener
        wave = np.exp(2j * np.pi * nu * curve.place_px[:, None]) / (1j * np.pi * nu * PERIOD_PX) * np.sinc(BIN_PX * nu)
        wave = wave * np.exp(-2 * np.pi**2 * curve.jitter_px2 * nu**2)
        # share = ½ + 2 Re Σ over positive odd harmonics
        drawn = np.concatenate([root @ (2 * wave.real), -(root @ (2 * wave.imag))], axis=1)
        ones, value = root @ np.ones(len(curve.value)), root @ curve.value
        # what spectra that fall at least as fast as this one can reach; the rest of the curve is noise in every model
        falls = np.tile(np.exp(-2 * np.pi**2 * SHARPEST_PX2 * nu**2), 2)
        basis, size, _ = np.linalg.svd(np.column_stack([drawn * falls, ones]), full_matrices=False)
        basis = basis[:, size > NEGLIGIBLE]
        self.map: Array = np.asarray(basis.T @ drawn, float)
        self.ones, self.value = basis.T @ ones, basis.T @ value
        self.rest = float(value @ value - self.value @ self.value)
        late = 1.0 if curve.across == "x" else -curve.slope
        self.late = np.exp(-2j * np.pi * np.outer(nu * late, np.arange(-1, TAPS)))
        self.main = 0 if curve.across == "x" else 1

    def optics(self, p: Array) -> Array:
        """Frequency response of lens, pixel and plate, real."""
        nu, tilt = _frequencies(), abs(self.curve.slope)
        a, d = p[1:3], p[3:5]
        var = max(p[0] - float(a @ a) / 24 - float(d @ d) / 8, 1e-4)
        out = np.exp(-2 * np.pi**2 * var * (1 + tilt**2) * nu**2)
        out *= np.sinc(a[self.main] * nu) * np.sinc(a[1 - self.main] * nu * tilt)
        if d.any():
            out *= np.cos(np.pi * d[self.main] * nu) * np.cos(np.pi * d[1 - self.main] * nu * tilt)
        return np.asarray(out, float)

    def drawn(self, spectra: np.ndarray) -> Array:
        """Whitened curves of some spectra, shape (k, frequencies)."""
        return np.asarray(self.map @ np.concatenate([spectra.real, spectra.imag], axis=1).T, float)


@dataclass(frozen=True)
class LineFit:
    """A fit of one model: optics, line parameters, and for each curve place, lower level and height; what was held has no covariance."""

    model: LineModel
    optics: Array
    free: tuple[int, ...]  # of the optics
    line: dict[str, float]
    own: Array  # shape (curves, 3)
    covariance: Array  # of the free optics, then of the line's parameters
    chi2: float
    dof: int
    held: tuple[str, ...] = ()  # of the line

    @property
    def occam(self) -> float:
        """−2 ln of the share of its prior range that the data leave to a model (Laplace): a model that fits by many chances counts less.

        Frequencies, damping and delays are taken as log-uniform, the rest as uniform, over the ranges in which they are looked for.
        """
        names = [name for name in self.model.names if name not in self.held]
        fitted = [*range(len(self.free)), *(len(self.free) + self.model.names.index(name) for name in names)]
        _, log_det = np.linalg.slogdet(self.covariance[np.ix_(fitted, fitted)])
        optics = OPTICS_HIGHEST[list(self.free)] - OPTICS_LOWEST[list(self.free)]
        line = [self.model.prior_width(name, self.line[name]) for name in names]
        ranges = np.concatenate([optics, line])
        return float(2 * np.log(ranges).sum() - log_det - len(ranges) * np.log(2 * np.pi))


def fit_model(
    seen: Sequence[_Seen],
    model: LineModel,
    optics: Array,
    free: Sequence[int],
    line: dict[str, float],
    own: Array,
    iterations: int = ITERATIONS,
    held: tuple[str, ...] = (),
) -> LineFit:
    """Levenberg–Marquardt from a start; derivatives of the spectra by differences. What is held of the line stays as it is."""
    names = [name for name in model.names if name not in held]
    k, n = len(free), len(free) + len(names)
    limits = np.array([model.limits(name) for name in names]).reshape(-1, 2)
    lows = np.concatenate([OPTICS_LOWEST[list(free)], limits[:, 0]])
    highs = np.concatenate([OPTICS_HIGHEST[list(free)], limits[:, 1]])

    def normal(p: Array, q: Array, own: Array) -> tuple[float, list[tuple[Array, Array]]]:
        values = line | dict(zip(names, q, strict=True))
        taps = [model.taps_read(values)]
        for name in names:
            step = STEP_REL * max(abs(values[name]), 0.1)
            taps.append((model.taps_read(values | {name: values[name] + step}) - taps[0]) / step)
        chi2, parts = 0.0, []
        for s, (place, low, height) in zip(seen, own, strict=True):
            nu = _frequencies()
            moved = np.exp(-2j * np.pi * nu * place)
            through = (s.late @ np.array(taps).T).T * moved
            lens = s.optics(p)
            spectra = [lens * through[0]]
            for j in free:
                more = p.copy()
                more[j] += STEP_REL
                spectra.append((s.optics(more) - lens) / STEP_REL * through[0])
            spectra += [lens * t for t in through[1:]]
            spectra.append(spectra[0] * (-2j * np.pi * nu))
            drawn = s.drawn(np.array(spectra))
            share = drawn[:, 0] + 0.5 * s.ones
            residual = s.value - low * s.ones - height * share
            chi2 += float(residual @ residual) + s.rest
            jacobian = np.column_stack([height * drawn[:, 1:], s.ones, share])
            parts.append((jacobian.T @ jacobian, jacobian.T @ residual))
        return chi2, parts

    p = optics.copy()
    q = np.array([line[name] for name in names])
    damping = 1e-3
    chi2, parts = normal(p, q, own)
    for _ in range(iterations):
        reduced, right, solved = np.zeros((n, n)), np.zeros(n), []
        for matrix, side in parts:
            damped = matrix + damping * np.diag(np.diag(matrix)) + 1e-12 * np.eye(len(matrix))
            both = np.linalg.solve(damped[n:, n:], np.column_stack([damped[n:, :n], side[n:]]))
            reduced += damped[:n, :n] - damped[:n, n:] @ both[:, :-1]
            right += side[:n] - damped[:n, n:] @ both[:, -1]
            solved.append(both)
        scale = np.sqrt(np.maximum(np.diag(reduced), 1e-300))
        reduced, right = reduced / np.outer(scale, scale), right / scale
        now = np.concatenate([p[list(free)], q])
        step = np.linalg.lstsq(reduced, right, rcond=1e-12)[0] / scale
        stopped = (now + step < lows) | (now + step > highs)
        if stopped.any():  # these go to their limits, the others as is best with that
            step = np.clip(now + step, lows, highs) - now
            rest = right - reduced[:, stopped] @ (step * scale)[stopped]
            step[~stopped] = np.linalg.lstsq(reduced[np.ix_(~stopped, ~stopped)], rest[~stopped], rcond=1e-12)[0] / scale[~stopped]
        # no parameter more than doubles or falls below a half in one step
        trial = np.clip(now + np.clip(step, -0.5 * np.abs(now) - 0.02, np.abs(now) + 0.02), lows, highs)
        taken = trial - now
        new_p = p.copy()
        new_p[list(free)] = trial[:k]
        new_p[0] = max(new_p[0], _of_others(new_p) + 1e-3)
        new_own = own + np.array([both[:, -1] - both[:, :-1] @ taken for both in solved])
        after, tried = normal(new_p, trial[k:], new_own)
        if after <= chi2:
            gone = chi2 - after
            p, q, own, chi2, parts = new_p, trial[k:], new_own, after, tried
            damping = max(damping / 10, 1e-9)
            if gone < CONVERGED:
                break
        else:
            damping *= 10
            if damping > 1e8:
                break
    information = np.zeros((n, n))
    for matrix, _ in parts:
        information += matrix[:n, :n] - matrix[:n, n:] @ np.linalg.solve(matrix[n:, n:] + 1e-12 * np.eye(3), matrix[n:, :n])
    # nothing is known worse than before: a uniform distribution over its range
    widths = np.array([*(highs - lows)[:k], *(model.prior_width(name, value) for name, value in zip(names, q, strict=True))])
    information[np.diag_indices(n)] += 12 / widths**2
    scale = np.sqrt(np.diag(information))
    covariance = np.linalg.pinv(information / np.outer(scale, scale), rcond=1e-10, hermitian=True) / np.outer(scale, scale)
    dof = sum(len(s.curve.value) for s in seen) - n - 3 * len(seen)
    line = {name: line[name] for name in model.names} | dict(zip(names, map(float, q), strict=True))
    fitted = [*range(k), *(k + model.names.index(name) for name in names)]
    whole = np.zeros((k + len(line), k + len(line)))
    whole[np.ix_(fitted, fitted)] = covariance
    return LineFit(model, p, tuple(free), line, own, whole, chi2, max(dof, 1), held)


def _of_others(p: Array) -> float:
    """What aperture and plate have of the variance of the spread, the mean of x and y."""
    return float((p[1] ** 2 + p[2] ** 2) / 24 + (p[3] ** 2 + p[4] ** 2) / 8)


# ---- which model ------------------------------------------------------------------------------------------------------------------------

FAR_CHI2, FAR_TIMES = 100.0, 5.0  # models so far above the best after a few steps are left there
TRIAL_ITERATIONS = 7
SURVIVING = 1e-4  # probability of a model over that of the best, below which it is left out of the mean
CERTAIN = 0.99  # probability that is enough to speak of a part or a kind as known
STARTS_D = (0.6, 1.1)
VALLEY_DELAYS_PX = np.geomspace(0.1, NEAR_PX, 6)  # of an echo within the rise of an edge
VALLEY_STEP, VALLEY_LEAST, VALLEY_CHANGE = 0.02, 1e-3, (1.0, 4.0)  # of its ghost; by how much χ² may change with one
VALLEY_RISE = 16.0  # of χ², where it ends
WORDS = {
    "grabber.low_pass": "low-pass filter",
    "electronics.video_amplifier": "video amplifier",
    "cable.termination": "echo of the cable",
    "cable.t_piece": "open branch",
}
OF_PART = {
    "grabber.low_pass": ("cutoff_rel",),
    "electronics.video_amplifier": ("natural_rel", "damping"),
    "cable.termination": ("ghost_rel", "echo_px"),
    "cable.t_piece": ("branch_px",),
}


@dataclass(frozen=True)
class LineSearch:
    """All models that were fitted; ``scale`` is χ² per degree of freedom of the smallest, or 1 if that is less."""

    fits: tuple[LineFit, ...]
    scale: float
    misfit_p: float
    jitter_px: float  # standard deviation of the rows' places
    valleys: tuple[tuple[LineFit, tuple[tuple[LineFit, float], ...]], ...] = ()  # of a fit: fits along its valley, and their shares

    def spread_of(self, fit: LineFit) -> tuple[tuple[LineFit, float], ...]:
        """Fits that stand for one with all that its model may be, and their shares."""
        return next((along for own, along in self.valleys if own is fit), ((fit, 1.0),))

    @cached_property
    def weights(self) -> tuple[tuple[LineFit, float], ...]:
        """Models with their probabilities, the most probable first; those below `SURVIVING` are left out.

        What the best model may hide, a further part, counts by χ² + 2 k (H. Akaike, IEEE Trans. Autom. Control 19, 1974, 716): every
        camera has an amplifier and a cable, and a part is not less probable because its parameters could have been anything. Another line
        of more parts than the best needs a χ² that is less by 25: a Butterworth filter of third order is an RC stage and an amplifier too.
        """
        costs = np.array([f.chi2 / self.scale + f.occam for f in self.fits])
        best = self.fits[int(np.argmin(costs))]
        for i, f in enumerate(self.fits):
            if f.model.holds(best.model):
                more = len(f.model.names) - len(best.model.names)
                costs[i] = min(costs[i], f.chi2 / self.scale + best.occam + 2 * more)
            elif len(f.model.parts) > len(best.model.parts) and best.chi2 - f.chi2 < FOUND_CHI2 * self.scale:
                costs[i] = np.inf
        raw = np.exp(-0.5 * (costs - costs.min()))
        kept = [(self.fits[i], float(raw[i])) for i in np.argsort(costs) if raw[i] > SURVIVING]
        total = sum(w for _, w in kept)
        return tuple((f, w / total) for f, w in kept)

    @property
    def best(self) -> LineFit:
        """The most probable model."""
        return self.weights[0][0]

    @property
    def rivals(self) -> tuple[LineFit, ...]:
        """Models that are not excluded: the most probable that make up `CERTAIN` of the whole."""
        total, out = 0.0, []
        for fit, weight in self.weights:
            out.append(fit)
            total += weight
            if total > CERTAIN:
                break
        return tuple(out)

    @property
    def jitter_may_smooth(self) -> bool:
        """Whether jitter may be what a filter seems to be: a line without one needs it, and χ² does not exclude that line."""
        most = min(f.chi2 for f in self.fits) + FOUND_CHI2 * self.scale
        unfiltered = [f for f in self.fits if not f.model.order and not f.model.amplifier and f.chi2 < most]
        return bool(unfiltered) and all(f.model.jitter for f in unfiltered)

    def fall(self, part: str) -> float:
        """By how much χ² falls with a part of the line."""
        least = [min(f.chi2 for f in self.fits if (part in f.model.parts) == there) for there in (False, True)]
        return max(least[0] - least[1], 0.0) / self.scale


def fit_line(measured: Sequence[tuple[Region, Spread]], own_clock: bool = False) -> tuple[Estimates, Estimates]:
    """Fit the video line of an analogue camera, and lens and pixel in front of it, to slanted edges; see `line_estimates`.

    Parameters
    ----------
    measured : sequence of (Region, Spread)
        The edges, as `pixmetry.observe.edges.search_edges` finds them in pictures of an analogue camera.
    own_clock : bool
        Whether the grabber samples at another rate than the pixel clock: a sample is then no fixed sum of pixels, and no line is fitted.
    """
    if own_clock:
        told = "the grabber samples by a clock of its own, and what it makes of a pixel changes along the line: sample by the pixel clock"
        return _nothing_of_the_line(told), replace(Estimates.empty(), reasons={"spread_var_px2": told})
    found = search_models(curves_of(measured, MOST_RIGHT_PX))
    if found is not None:
        return line_estimates(found)
    told = "edges along x and along y are needed: those along y show lens and pixel without the line"
    return _nothing_of_the_line(told), replace(Estimates.empty(), reasons={"spread_var_px2": told})


def search_models(curves: Sequence[EdgeCurve]) -> LineSearch | None:
    """Fit all lines that are looked for; None where there are not edges of both directions."""
    if {c.across for c in curves} != {"x", "y"}:
        return None
    seen = [_Seen(c) for c in curves]
    optics = np.array([_start_variance(curves), 0.9, 0.9, 0.0, 0.0])
    found = _search(seen, optics, (0, 1, 2))
    best = min(found, key=lambda f: f.chi2)
    plates = []
    for d in STARTS_D:
        start = best.optics.copy()
        start[3:] = d
        start[0] = max(start[0], _of_others(start) + 0.04)
        plates.append(fit_model(seen, best.model, start, (0, 1, 2, 3, 4), best.line, best.own))
    plate = min(plates, key=lambda f: f.chi2)
    if best.chi2 - plate.chi2 > FOUND_CHI2 * max(plate.chi2 / plate.dof, 1.0):
        found = _search(seen, plate.optics, (0, 1, 2, 3, 4))
    from scipy.special import gammaincc

    least = min(found, key=lambda f: f.chi2)
    misfit_p = float(gammaincc(least.dof / 2, least.chi2 / 2))
    jitter = float(np.sqrt(max(c.jitter_px2 for c in curves)))
    search = LineSearch(tuple(found), max(least.chi2 / least.dof, 1.0), misfit_p, jitter)
    return replace(search, valleys=tuple(_valleys(seen, search)))


def _valleys(seen: Sequence[_Seen], found: LineSearch) -> Iterator[tuple[LineFit, tuple[tuple[LineFit, float], ...]]]:
    """Of each probable model with an echo within the rise of an edge that χ² does not need: all such echoes, by their probability.

    A ghost g after a delay d widens a step by g d² and no more where d is short: what fits is a long curved valley in g and d, at whose
    bottom filter and amplifier change with g. Laplace's method at its lowest point knows nothing of its length. So χ² is followed from
    g = 0 outwards at each of some delays, evenly spaced in their logarithm, with all else fitted. Points weigh by likelihood, by the share
    of the prior that is left to the rest (Laplace), and by the length of the step.
    """
    probable: dict[LineModel, LineFit] = {}
    for fit, _ in found.weights:
        probable.setdefault(fit.model, fit)
    for fit in probable.values():
        bare = min((f for f in found.fits if f.model == replace(fit.model, echo="")), key=lambda f: f.chi2, default=None)
        if fit.model.echo != "near" or bare is None or bare.chi2 - fit.chi2 > FOUND_CHI2 * found.scale:
            continue
        points = [p for delay in map(float, VALLEY_DELAYS_PX) for p in _along_ghost(seen, fit.model, bare, delay, found.scale)]
        costs = np.array([p.chi2 / found.scale + p.occam for p, _ in points])
        shares = np.exp(-0.5 * (costs - costs.min())) * np.array([length for _, length in points])
        yield fit, tuple((p, float(share)) for (p, _), share in zip(points, shares / shares.sum(), strict=True))


def _along_ghost(seen: Sequence[_Seen], model: LineModel, bare: LineFit, delay: float, scale: float) -> list[tuple[LineFit, float]]:
    """Fits with ghosts from 0 to both sides until χ² excludes them, and the length of ghosts that each stands for."""
    held = ("ghost_rel", "echo_px")

    def moved(fit: LineFit, ghost: float) -> LineFit:
        line = fit.line | {"ghost_rel": ghost, "echo_px": delay}
        later = model.delay_px(line) - fit.model.delay_px(fit.line)
        own = fit.own.copy()
        own[:, 0] += [-later if s.main == 0 else s.curve.slope * later for s in seen]
        return fit_model(seen, model, fit.optics, fit.free, line, own, TRIAL_ITERATIONS, held)

    start = moved(bare, 0.0)
    found = [start]
    for sign, limit in zip((-1, 1), model.limits("ghost_rel"), strict=True):
        fit, step = start, VALLEY_STEP
        while abs(fit.line["ghost_rel"]) < abs(limit) and fit.chi2 - start.chi2 < VALLEY_RISE * scale:
            ghost = float(np.clip(fit.line["ghost_rel"] + sign * step, -abs(limit), abs(limit)))
            after = moved(fit, ghost)
            change = abs(after.chi2 - fit.chi2) / scale
            if change > VALLEY_CHANGE[1] and step > VALLEY_LEAST:
                step /= 2
                continue
            found.append(after)
            fit, step = after, 2 * step if change < VALLEY_CHANGE[0] else step
    found.sort(key=lambda f: f.line["ghost_rel"])
    length = np.gradient([f.line["ghost_rel"] for f in found]) if len(found) > 1 else np.ones(1)
    return list(zip(found, map(float, length), strict=True))


def _start_variance(curves: Sequence[EdgeCurve]) -> float:
    """Of steps along y, which the line hardly changes: second moment of the line spread, 2 ∫ z (H(z) − E(z)) dz."""
    own = [c for c in curves if c.across == "y"]
    moments = []
    for c in own:
        middle = float(np.interp(0.5, np.maximum.accumulate(c.value), c.place_px))
        z = c.place_px - middle
        near = np.abs(z) < 5
        moments.append(2 * float((z * ((z > 0) - c.value))[near].sum()) * BIN_PX)
    return float(np.clip(np.median(moments), 0.12, 20))


def _search(seen: Sequence[_Seen], optics: Array, free: Sequence[int]) -> list[LineFit]:
    """All models, those without echoes first, each with all minima that it has; far from the best only a few steps are taken."""
    own = np.array([[0.0, 0.0, 1.0]] * len(seen))
    out: list[LineFit] = []

    def go_on(fit: LineFit) -> LineFit:
        best = min((f.chi2 for f in out), default=np.inf)
        if fit.chi2 > FAR_TIMES * best + FAR_CHI2:
            return fit_model(seen, fit.model, fit.optics, free, fit.line, fit.own, 1)
        return fit_model(seen, fit.model, fit.optics, free, fit.line, fit.own)

    largest = LARGEST_MEAN * float(np.sqrt(max(s.curve.jitter_px2 + 2 * s.curve.u_jitter_px2 for s in seen)))
    for echo in ("", "near", "far", "branch"):
        filtered = [LineModel(kind, order, amplifier, echo) for (kind, order), amplifier in product((("off", 0), *FILTERS), (False, True))]
        for model in (*filtered, LineModel(echo=echo, jitter=largest)):
            if model.order == 2 and model.amplifier:  # two of one kind
                continue
            before = next((f.line for f in out if f.model == replace(model, echo="")), None)
            tried = _from_starts(seen, model, optics, before, own)
            exchanged = model.order and model.amplifier and echo in ("", "near")  # a filter and an amplifier can change places
            out += _distinct([go_on(fit) for fit in tried[: 3 if echo == "far" else 2 if exchanged else 1]])
    least = min(f.chi2 for f in out)
    for fit in [f for f in out if f.chi2 - least < FAR_CHI2 * max(least / f.dof, 1.0)]:  # each without one of its parts, from where it is
        for less in _parts_left_out(fit.model):
            again = fit_model(seen, less, fit.optics, free, {name: fit.line[name] for name in less.names}, fit.own)
            same = [f for f in out if f.model == less]
            out = [f for f in out if f.model != less] + _distinct([*same, again])
    return out


def _distinct(fits: Sequence[LineFit]) -> list[LineFit]:
    """Fits of one model, the best first, without those that are the same minimum again."""
    kept: list[LineFit] = []
    for fit in sorted(fits, key=lambda f: f.chi2):
        u = np.sqrt(np.diag(fit.covariance))[len(fit.free) :]
        q = np.array(list(fit.line.values()))
        if all((np.abs(q - np.array(list(f.line.values()))) > u).any() for f in kept):
            kept.append(fit)
    return kept


def _parts_left_out(model: LineModel) -> list[LineModel]:
    """The model with one part less."""
    options = [replace(model, kind="off", order=0), replace(model, amplifier=False), replace(model, echo=""), replace(model, jitter=0.0)]
    return [m for m in options if m != model]


def _from_starts(seen: Sequence[_Seen], model: LineModel, optics: Array, before: dict[str, float] | None, own: Array) -> list[LineFit]:
    """Fits after a few steps from each start of the line's parameters, with the optics as they are, the best first."""
    names = model.names
    every = STARTS | {"neighbour_rel": (MEAN_OF_GAUSSIAN * model.jitter / LARGEST_MEAN,)}
    options = [[v for v in every[name] if model.limits(name)[0] <= v <= model.limits(name)[1]] for name in names]
    starts = [dict(zip(names, s, strict=True)) for s in product(*options)]
    if before is not None:  # without the echo
        starts += [start | before for start in starts[: len(options[-1])]]
    tried = []
    for values in starts:
        own = own.copy()
        delay = model.delay_px(values)
        own[:, 0] = [-delay if s.main == 0 else s.curve.slope * delay for s in seen]  # so that the middle of the edge stays in its place
        tried.append(fit_model(seen, model, optics, (), values, own, TRIAL_ITERATIONS))
    return sorted(tried, key=lambda f: f.chi2)


# ---- what is told -----------------------------------------------------------------------------------------------------------------------


def line_estimates(found: LineSearch) -> tuple[Estimates, Estimates]:
    """The line, and lens and pixel in front of it.

    Returns
    -------
    line : Estimates
        ``delay_px``: how much later the centroid of anything comes. ``row_gain``: by how much the samples of a row move over its delay
        (`LineModel.row_gain`). Of a part that every model needs which the edges allow, its
        parameters: frequencies over the pixel clock (``cutoff_rel``, ``natural_rel``), ``damping``, ``ghost_rel`` (amplitude of an echo
        over the one before), ``echo_px`` and ``branch_px`` (delays). ``settings`` has kind and order of the filter. ``reasons`` say why
        others are missing. Empty where no line fits, and where jitter of the rows may be what smooths the edges.
    optics : Estimates
        ``spread_var_px2``; ``sigma_px``, ``width_x_px``, ``width_y_px`` and separations as far as they are told.

    Notes
    -----
    Values are means over the models, weighted by their probabilities (χ² and the share of the prior range that is left, by Laplace's
    method), their covariance Σ w (C + d dᵀ) with d from the mean (J. A. Hoeting et al., Statistical Science 14, 1999, 382). So what
    another part could hide is in u. A model with an echo within the rise of an edge, which the edges do not need, counts by all echoes
    that fit (`_valleys`).
    """
    if found.misfit_p < MISFIT_P:
        best = found.best
        told = (
            f"no line that was tried describes the edges (χ² {best.chi2:.0f} for {best.dof} degrees of freedom): another filter, a grabber "
            "that samples at another rate than the pixel clock, gamma, or a lens that is no Gaussian"
        )
        return _nothing_of_the_line(told), replace(Estimates.empty(), reasons={"spread_var_px2": told})
    present = [p for p in OF_PART if all(p in f.model.parts for f in found.rivals) and found.fall(p) > FOUND_CHI2]
    kinds = {(f.model.kind, f.model.order) for f in found.rivals}
    names = tuple(name for part in present for name in OF_PART[part])
    values, covariance = _mean_of_models(found, names)
    optics, line = _split(found, names, values, covariance)
    if found.jitter_may_smooth:
        told = (
            f"rows jitter by {found.jitter_px:.3f} px, which smooths edges as a filter does: a line without a filter is not excluded; "
            "take frames with the pixel clock, or measure the jitter with lines (kind: line)"
        )
        return _nothing_of_the_line(told), optics
    delay = line["delay_px"]
    reasons: dict[str, str] = {}
    left_out: list[str] = []
    for part, own in OF_PART.items():
        why = ""
        if part not in present:
            why = _reason_of_absence(found, part, delay)
        elif part == "grabber.low_pass" and len(kinds) > 1:
            why = f"there is one, and the edges do not tell its kind ({', '.join(sorted(map(_kind_words, kinds)))}); {_delay_words(delay)}"
        else:
            bad = [name for name in own if line[name].u > LARGEST_U_REL * abs(line[name].value)]
            if bad:
                u = ", ".join(f"{name} {line[name].value:.3g} ± {line[name].u:.2g}" for name in own)
                why = f"there is one, and the edges hardly tell it apart from the rest of the line ({u}); {_delay_words(delay)}; {NEEDED}"
        if why:
            reasons |= dict.fromkeys(own, why)
            left_out += list(own)
    line = line.select([name for name in line.names if name not in left_out])
    settings: dict[str, str | int] = {"kind": found.best.model.kind, "order": found.best.model.order} if "cutoff_rel" in line else {}
    return replace(line, reasons=reasons, settings=settings, confounders=_correlated(line)), optics


def _nothing_of_the_line(told: str) -> Estimates:
    every = {name: told for names in OF_PART.values() for name in names} | {"delay_px": told}
    return replace(Estimates.empty(), reasons=every)


NEEDED = "take the same edges with the filter of the grabber switched off"


def _mean_of_models(found: LineSearch, names: Sequence[str]) -> tuple[Array, Array]:
    """Mean and covariance of (free optics, σ, these parameters, gain of a row's delay, delay) over the models."""
    each, covariances, weights = [], [], []
    spread = [(f, weight * share) for fit, weight in found.weights for f, share in found.spread_of(fit)]
    for fit, weight in spread:
        if not set(names) <= set(fit.model.names):  # improbable: a part that is told is in all rivals
            continue
        value, jacobian = _values(fit, names)
        each.append(value)
        covariances.append(jacobian @ fit.covariance @ jacobian.T * found.scale)
        weights.append(weight)
    mean = np.average(each, axis=0, weights=weights)
    total = sum(w * (c + np.outer(v - mean, v - mean)) for v, c, w in zip(each, covariances, weights, strict=True))
    out = np.asarray(total, float) / sum(weights)
    # a simpler line that χ² does not exclude may have another delay: pulses that are one pixel late look like none, of a bare line
    most = min(f.chi2 for f in found.fits) + FOUND_CHI2 * found.scale
    simpler = [f for f in found.fits if f.chi2 < most and len(f.model.names) < len(found.best.model.names)]
    for at, of in ((-1, LineModel.delay_px), (-2, LineModel.row_gain)):
        out[at, at] += max((np.square(of(f.model, f.line) - mean[at]) for f in simpler), default=0.0) / 3
    return np.asarray(mean, float), out


def _values(fit: LineFit, names: Sequence[str]) -> tuple[Array, Array]:
    """(free optics, σ, parameters, gain of a row's delay, delay) of a fit, and their derivatives by what was free."""
    k, own = len(fit.free), fit.model.names

    def at(x: Array) -> Array:
        p = fit.optics.copy()
        p[list(fit.free)] = x[:k]
        q = dict(zip(own, x[k:], strict=True))
        sigma = np.sqrt(max(p[0] - _of_others(p), 1e-3))
        return np.array([*x[:k], sigma, *(q[name] for name in names), fit.model.row_gain(q), fit.model.delay_px(q)])

    x = np.array([*fit.optics[list(fit.free)], *(fit.line[name] for name in own)])
    here = at(x)
    steps = np.diag(STEP_REL * np.maximum(np.abs(x), 0.1))
    jacobian = np.array([(at(x + step) - here) / step.sum() for step in steps]).T
    return here, np.asarray(jacobian.reshape(len(here), len(x)), float)


def _split(found: LineSearch, names: Sequence[str], values: Array, covariance: Array) -> tuple[Estimates, Estimates]:
    """Optics and line as estimates."""
    free = found.best.free
    labels = (*(OPTICS[j] for j in free), "sigma_px", *names, "row_gain", "delay_px")
    dof = np.full(len(labels), float(found.best.dof))
    units = tuple("px²" if name == OPTICS[0] else "px" if name.endswith("_px") else "1" for name in labels)
    whole = Estimates(labels, values, covariance, dof, units, METHOD)
    optics = whole.select(labels[: len(free) + 1])
    line = whole.select(labels[len(free) + 1 :])
    hidden = [name for name in ("width_x_px", "width_y_px") if optics[name].u > LARGEST_U_A]
    if not hidden:
        return replace(optics, confounders=_correlated(optics)), line
    u = max(optics[name].u for name in hidden)
    why = f"the blur hides the aperture (u would be {u:.2f} px): focus better, or take more edges with less noise"
    kept = [name for name in optics.names if name not in (*hidden, "sigma_px")]
    return replace(optics.select(kept), reasons=dict.fromkeys((*hidden, "sigma_px"), why)), line


def _reason_of_absence(found: LineSearch, part: str, delay: Number) -> str:
    """Why a part is not given: the edges do not need it, or another one does as well."""
    if part not in found.best.model.parts and found.fall(part) < FOUND_CHI2 and not _exchanged(found, part):
        fall = f"χ² falls by {found.fall(part):.0f} with it, and by {FOUND_CHI2:g} or more where it is seen"
        return f"the edges do not need it: {fall}"
    most = min(f.chi2 for f in found.fits) + FOUND_CHI2 * found.scale
    others = sorted({WORDS[p] for f in found.fits if part not in f.model.parts and f.chi2 < most for p in f.model.parts})
    apart = f"not separable from {' and '.join(others)}" if others else "not separable from a line without it"
    return f"{apart}; {_delay_words(delay)}; {NEEDED}"


def _exchanged(found: LineSearch, part: str) -> bool:
    """Whether the part can stand for another one: a fit that has it lacks one of the best, and is not excluded by χ²."""
    most = min(f.chi2 for f in found.fits) + FOUND_CHI2 * found.scale
    return any(part in f.model.parts and found.best.model.parts - f.model.parts and f.chi2 < most for f in found.fits)


def _delay_words(delay: Number) -> str:
    return f"the whole line delays by {delay.value:.3f} ± {delay.u:.3f} px"


def _kind_words(kind: tuple[str, int]) -> str:
    return "none" if not kind[1] else f"{kind[0]} of order {kind[1]}"


def _correlated(found: Estimates) -> tuple[str, ...]:
    """Pairs of values that are hardly told apart."""
    scale = np.outer(found.u, found.u)
    correlation = np.divide(found.covariance, scale, out=np.zeros_like(scale), where=scale > 0)
    pairs = [(i, j) for i in range(len(found)) for j in range(i) if abs(correlation[i, j]) > 0.9]
    told = [f"{found.names[j]} and {found.names[i]} from slanted edges are correlated by {correlation[i, j]:+.2f}" for i, j in pairs]
    return tuple(text for text in told if not any(name in text for name in ("delay_px", "row_gain", "spread_var")))
