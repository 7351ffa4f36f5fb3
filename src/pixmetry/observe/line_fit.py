"""The video line from slanted edges: low-pass filter, video amplifier, echoes of the cable, and what cannot be told apart.

All that lies between the pixels of an analogue camera and the grabber acts at whole pixels: with the step response S of the line, a sample
is Σ h_k x(n − k), h_k = S(k + ½) − S(k − ½), for pixels are held for one period and read in its middle. Steps along x show it together with
lens and pixel; steps along y show lens and pixel nearly alone. The frequency response of the lens is not periodic, that of h is: this, and
that nothing comes before its cause, part the two.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import product

import numpy as np

from pixmetry.camera.line import low_pass_poles
from pixmetry.core.arrays import Array
from pixmetry.observe._edge_kernels import line_taps
from pixmetry.observe.edge_curves import BIN_PX, EdgeCurve

PERIOD_PX = 128.0  # of the square wave that stands for an edge
MOST_FREQUENCY = 3.0  # cycles/px
TAPS = 56
SMALLEST_PATH = 1e-6
APART = 1e-4  # relative: equal poles are moved so far apart; the step response changes by the square of it
FILTERS = tuple(product(("butterworth", "bessel"), (2, 3, 4))) + (("rc", 1), ("rc", 2))
FOUND_CHI2 = 25.0  # by which χ² must rise without a part of the line for it to be there
LARGEST_U_REL = 1 / 3  # of a value that is given
MISFIT_P = 1e-4  # probability of a larger χ², below which the line is another one
ITERATIONS, CONVERGED = 40, 1e-3  # the last in χ²
STEP_REL = 1e-5  # of differences that stand for derivatives
METHOD = "joint fit of lens, pixel and video line to slanted edges along x and y; models weighted by χ² + 2 parameters (AIC)"


# ---- what a line does -------------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class LineModel:
    """Which parts a line has: a low-pass filter of a kind and order, an amplifier of second order, echoes of a cable or an open branch."""

    kind: str = "off"
    order: int = 0
    amplifier: bool = False
    echo: str = ""  # "", "cable" or "branch"

    @property
    def names(self) -> tuple[str, ...]:
        """Free parameters: frequencies over the pixel clock, delays in pixel periods."""
        low_pass = ("cutoff_rel",) if self.order else ()
        amplifier = ("natural_rel", "damping") if self.amplifier else ()
        return low_pass + amplifier + {"": (), "cable": ("ghost_rel", "echo_px"), "branch": ("branch_px",)}[self.echo]

    @property
    def parts(self) -> frozenset[str]:
        """Ids of the sources that it needs."""
        told = {"grabber.low_pass": self.order > 0, "electronics.video_amplifier": self.amplifier}
        told |= {"cable.termination": self.echo == "cable", "cable.t_piece": self.echo == "branch"}
        return frozenset(name for name, there in told.items() if there)

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
        if self.echo == "cable":
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

    def delay_px(self, q: dict[str, float]) -> float:
        """How much later the centroid of anything comes: −Σ 1/p of the filters, and the mean of the paths."""
        delays, amplitudes = self.paths(q)
        return float(-(1 / self.poles(q)).sum().real + delays @ amplitudes / amplitudes.sum())


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
LINE_LIMITS = {
    "cutoff_rel": (0.04, 4.0),
    "natural_rel": (0.04, 4.0),
    "damping": (0.05, 4.0),
    "ghost_rel": (-0.6, 0.6),
    "echo_px": (0.05, 40.0),
    "branch_px": (0.02, 40.0),
}
STARTS = {"cutoff_rel": (0.4,), "natural_rel": (0.4, 0.9), "damping": (0.6,), "ghost_rel": (0.03,), "echo_px": (0.8, 3.0, 9.0)}
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
        self.map = np.asarray(np.concatenate([root @ (2 * wave.real), -(root @ (2 * wave.imag))], axis=1), float)
        self.ones = root @ np.ones(len(curve.value))
        self.value = root @ curve.value
        late = 1.0 if curve.across == "x" else -curve.slope
        self.late = np.exp(-2j * np.pi * np.outer(nu * late, np.arange(TAPS)))
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
    """A fit of one model: optics, line parameters, and for each curve place, lower level and height."""

    model: LineModel
    optics: Array
    free: tuple[int, ...]  # of the optics
    line: dict[str, float]
    own: Array  # shape (curves, 3)
    covariance: Array  # of the free optics, then of the line's parameters
    chi2: float
    dof: int

    @property
    def cost(self) -> float:
        """χ² and two for each parameter (H. Akaike, IEEE Trans. Autom. Control 19, 1974, 716)."""
        return self.chi2 + 2 * len(self.model.names)


def fit_model(
    seen: Sequence[_Seen],
    model: LineModel,
    optics: Array,
    free: Sequence[int],
    line: dict[str, float],
    own: Array,
    iterations: int = ITERATIONS,
) -> LineFit:
    """Levenberg–Marquardt from a start; derivatives of the spectra by differences."""
    names = model.names
    k, n = len(free), len(free) + len(names)
    lows = np.array([*OPTICS_LOWEST[list(free)], *(LINE_LIMITS[name][0] for name in names)])
    highs = np.array([*OPTICS_HIGHEST[list(free)], *(LINE_LIMITS[name][1] for name in names)])

    def normal(p: Array, q: Array, own: Array) -> tuple[float, list[tuple[Array, Array]]]:
        values = dict(zip(names, q, strict=True))
        taps = [model.taps(values)]
        for name, value in values.items():
            step = STEP_REL * max(abs(value), 0.1)
            taps.append((model.taps(values | {name: value + step}) - taps[0]) / step)
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
            chi2 += float(residual @ residual)
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
        step = np.linalg.lstsq(reduced / np.outer(scale, scale), right / scale, rcond=1e-12)[0] / scale
        now = np.concatenate([p[list(free)], q])
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
    scale = np.sqrt(np.maximum(np.diag(information), 1e-300))
    covariance = np.linalg.pinv(information / np.outer(scale, scale), rcond=1e-10, hermitian=True) / np.outer(scale, scale)
    dof = sum(len(s.value) for s in seen) - n - 3 * len(seen)
    line = dict(zip(names, map(float, q), strict=True))
    return LineFit(model, p, tuple(free), line, own, np.asarray(covariance, float), chi2, max(dof, 1))


def _of_others(p: Array) -> float:
    """What aperture and plate have of the variance of the spread, the mean of x and y."""
    return float((p[1] ** 2 + p[2] ** 2) / 24 + (p[3] ** 2 + p[4] ** 2) / 8)


# ---- which model ------------------------------------------------------------------------------------------------------------------------

FAR_CHI2 = 150.0  # models so far above the best after a few steps are left there
TRIAL_ITERATIONS = 7
SURVIVING = 1e-4  # weight of a model, below which it is left out of the mean
STARTS_D = (0.6, 1.1)
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
UNITS = {"delay_px": "px", "echo_px": "px", "branch_px": "px"}


@dataclass(frozen=True)
class LineSearch:
    """All models that were fitted, the best first; ``scale`` is χ² per degree of freedom of the best, or 1 if that is less."""

    fits: tuple[LineFit, ...]
    scale: float
    misfit_p: float

    @property
    def best(self) -> LineFit:
        """The model of the smallest χ² + 2 parameters."""
        return self.fits[0]

    @property
    def rivals(self) -> tuple[LineFit, ...]:
        """Models that the edges do not exclude: χ² within `FOUND_CHI2` of the smallest."""
        least = min(f.chi2 for f in self.fits)
        return tuple(f for f in self.fits if f.chi2 - least <= FOUND_CHI2 * self.scale)

    @property
    def weights(self) -> tuple[tuple[LineFit, float], ...]:
        """Models with their weights, e^(−(χ² + 2 parameters)/2), of sum 1."""
        raw = [np.exp(-0.5 * (f.cost - self.best.cost) / self.scale) for f in self.rivals]
        kept = [(f, float(w)) for f, w in zip(self.rivals, raw, strict=True) if w > SURVIVING]
        total = sum(w for _, w in kept)
        return tuple((f, w / total) for f, w in kept)


def search_models(curves: Sequence[EdgeCurve]) -> LineSearch | None:
    """Fit all lines that are looked for; None where there are not edges of both directions."""
    if {c.across for c in curves} != {"x", "y"}:
        return None
    seen = [_Seen(c) for c in curves]
    optics = np.array([_start_variance(curves), 0.8, 0.8, 0.0, 0.0])
    found = _search(seen, optics, (0, 1, 2))
    best = found[0]
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
    return LineSearch(tuple(found), max(least.chi2 / least.dof, 1.0), float(gammaincc(least.dof / 2, least.chi2 / 2)))


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
    """All models, those without echoes first; of models that are far from the best only a few steps are taken."""
    own = np.array([[0.0, 0.0, 1.0]] * len(seen))
    out: list[LineFit] = []
    for echo in ("", "cable", "branch"):
        for (kind, order), amplifier in product((("off", 0), *FILTERS), (False, True)):
            model = LineModel(kind, order, amplifier, echo)
            before = next((f.line for f in out if f.model == replace(model, echo="")), None)
            fit = _from_starts(seen, model, optics, free, before, own)
            best = min((f.chi2 for f in out), default=np.inf)
            if fit.chi2 - best < FAR_CHI2 * max(best / fit.dof, 1.0):
                fit = fit_model(seen, model, fit.optics, free, fit.line, fit.own)
            out.append(fit)
    least = min(f.chi2 for f in out)
    for fit in [f for f in out if f.chi2 - least < FAR_CHI2 * max(least / f.dof, 1.0)]:  # each without one of its parts, from where it is
        for less in _parts_left_out(fit.model):
            place = next(i for i, f in enumerate(out) if f.model == less)
            again = fit_model(seen, less, fit.optics, free, {name: fit.line[name] for name in less.names}, fit.own)
            if again.chi2 < out[place].chi2:
                out[place] = again
    return sorted(out, key=lambda f: f.cost)


def _parts_left_out(model: LineModel) -> list[LineModel]:
    """The model with one part less."""
    options = [replace(model, kind="off", order=0), replace(model, amplifier=False), replace(model, echo="")]
    return [m for m in options if m != model]


def _from_starts(
    seen: Sequence[_Seen], model: LineModel, optics: Array, free: Sequence[int], before: dict[str, float] | None, own: Array
) -> LineFit:
    """The fit from the start of the line's parameters that leads to the smallest χ² after a few steps."""
    names = model.names
    starts = [dict(zip(names, s, strict=True)) for s in product(*(STARTS[name] for name in names))]
    if before is not None:  # without the echo
        starts += [start | before for start in starts[: len(STARTS["echo_px"])]]
    tried = []
    for values in starts:
        own = own.copy()
        delay = model.delay_px(values)
        own[:, 0] = [-delay if s.main == 0 else s.curve.slope * delay for s in seen]  # so that the middle of the edge stays in its place
        tried.append(fit_model(seen, model, optics, free, values, own, TRIAL_ITERATIONS))
    return min(tried, key=lambda f: f.chi2)
