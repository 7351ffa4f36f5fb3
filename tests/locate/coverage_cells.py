"""Do positions keep what their covariance promises? Discs at known places, located by `pixmetry.locate`, compared with the truth."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
from scipy import stats
from scipy.spatial import cKDTree

from locate import rendered
from pixmetry.locate.detect.targets import Flag
from pixmetry.locate.job import locate
from pixmetry.locate.noise import NoiseModel

UNSURE = Flag.FAINT | Flag.NOT_CONVERGED  # the table itself says that the covariance is not to be relied on


@dataclass(frozen=True)
class Case:
    """A kind of disc and the camera that sees it, in pixels and DN; each disc of a frame has a random sub-pixel place."""

    radius: float = 4.0
    blur: float = 0.7
    read_dn: float = 1.5
    gain_dn_per_e: float = 0.0
    amplitude: float = 170.0
    background: float = 10.0
    bits: int | None = 8
    slope: tuple[float, float] = (0.0, 0.0)
    light: tuple[float, float] = (0.0, 0.0)
    light_on: str = "surface"

    def __str__(self) -> str:
        text = f"R {self.radius:g}, blur {self.blur:g}, noise {self.read_dn:g}"
        if self.gain_dn_per_e:
            text += f", {self.gain_dn_per_e:g} DN/e"
        text += f", height {self.amplitude:g}"
        for name in ("slope", "light"):
            if any(getattr(self, name)):
                text += f", {name} {getattr(self, name)}" + (f" on {self.light_on}" if name == "light" else "")
        return text

    def variance_dn2(self, level: np.ndarray) -> np.ndarray:
        """Variance of a grey value against its mean; rounding in it."""
        light = np.maximum(level - self.black_dn, 0.0)
        return self.read_dn**2 + self.gain_dn_per_e * light + (1 / 12 if self.bits else 0.0)

    @property
    def black_dn(self) -> float:
        """The level without light, where there is shot noise."""
        return 0.5 * min(self.background, self.background + self.amplitude)

    def noise(self) -> NoiseModel:
        """The camera's own noise model, for an estimator that is told it."""
        scale = {} if self.bits is None else {"low_dn": 0.0, "high_dn": 2.0**self.bits - 1}
        constant = float(self.variance_dn2(np.array(self.black_dn)))
        return NoiseModel(constant, self.gain_dn_per_e, black_dn=self.black_dn if self.gain_dn_per_e else 0.0, origin="camera", **scale)

    def image(self, x: float, y: float, at: rendered.Window, **other: float) -> np.ndarray:
        """Mean grey values of the target alone, above the background."""
        c = replace(self, **other)
        return c.amplitude * rendered.disc(x, y, c.radius, c.blur, at, light=c.light, light_on=c.light_on)

    def least_var(self, x: float = 0.2, y: float = 0.3) -> float:
        """Cramér–Rao bound of a coordinate (mean of x and y), px²; unknown: place, height, background, radius, blur."""
        at = rendered.window(0, 0, self.radius + 6 * self.blur + 1)

        def mean(p: np.ndarray) -> np.ndarray:
            return p[3] + self.image(p[0], p[1], at, amplitude=p[2], radius=p[4], blur=p[5], light=(0.0, 0.0))

        c = rendered.bound(mean, (x, y, self.amplitude, self.background, self.radius, self.blur), self.variance_dn2)
        return 0.5 * (c[0, 0] + c[1, 1])


@dataclass
class Frame:
    """Mean image of discs on a grid, each moved by a random part of a pixel, and where they are."""

    case: Case
    mean: np.ndarray
    x: np.ndarray
    y: np.ndarray

    def exposed(self, rng: np.random.Generator) -> np.ndarray:
        """One exposure."""
        c = self.case
        return rendered.expose(self.mean, rng, read_dn=c.read_dn, gain_dn_per_e=c.gain_dn_per_e, black_dn=c.black_dn, bits=c.bits)


def make_frame(case: Case, rng: np.random.Generator, count: int) -> Frame:
    """Render a frame with count discs or a few less, as many in a row as in a column."""
    side = max(2, int(np.sqrt(count)))
    pitch = int(2 * (case.radius + 5.5 * case.blur)) + 10
    cells = (np.arange(side) + 0.5) * pitch
    x, y = (c.ravel() + rng.uniform(-1, 1, side * side) for c in np.meshgrid(cells, cells))
    shape = (side * pitch, side * pitch)
    images = []
    for px, py in zip(x, y, strict=True):
        at = rendered.window(px, py, case.radius + 5.5 * case.blur + 1, shape)
        images.append((at, case.image(px, py, at)))
    middle = (side * pitch - 1) / 2
    ground = case.background + case.slope[0] * (np.arange(shape[1]) - middle) + case.slope[1] * (np.arange(shape[0])[:, None] - middle)
    return Frame(case, rendered.planted(shape, ground, 1.0, images), x, y)


@dataclass
class Outcome:
    """Errors and stated covariances of matched positions, over all frames."""

    wanted: int = 0
    false: int = 0
    unsure: int = 0
    rows: list[np.ndarray] = field(default_factory=list)

    @property
    def table(self) -> np.ndarray:
        """Shape (7, n): error in x and y, true x and y, variance of x, covariance, variance of y."""
        return np.concatenate(self.rows, axis=1) if self.rows else np.zeros((7, 0))

    @property
    def missed(self) -> int:
        """How many targets have no position."""
        return self.wanted - self.unsure - self.table.shape[1]

    @property
    def errors(self) -> np.ndarray:
        """Errors in x and y, shape (2, n)."""
        return self.table[:2]

    @property
    def z(self) -> np.ndarray:
        """Errors in whitened coordinates, shape (2 n,): independent N(0, 1) if the covariance is right; NaN where it is none."""
        dx, dy, _, _, vx, c, vy = self.table
        with np.errstate(invalid="ignore", divide="ignore"):
            return np.concatenate([dx / np.sqrt(vx), (dy - c / vx * dx) / np.sqrt(vy - c**2 / vx)])

    def rms_over(self, least_var: float) -> float:
        """Rms error of a coordinate over the root of a variance."""
        return float(np.sqrt((self.errors**2).mean() / least_var))

    def shares(self) -> tuple[float, float]:
        """Shares of coordinates within one and two standard uncertainties."""
        z = np.abs(self.z)
        return float((z < 1).mean()), float((z < 2).mean())


Locator = Callable[..., object]


def collect(frame: Frame, rng: np.random.Generator, estimator: str, draws: int = 1, locator: Locator = locate, **options) -> Outcome:
    """Expose a frame several times, locate, and match with the truth; what is flagged as unsure is counted and left out."""
    return collect_all(frame, rng, (estimator,), draws, locator, **options)[estimator]


def collect_all(
    frame: Frame, rng: np.random.Generator, estimators: tuple[str, ...], draws: int = 1, locator: Locator = locate, **options
) -> dict[str, Outcome]:
    """The same for several estimators on the same exposures."""
    tree = cKDTree(np.stack([frame.x, frame.y], axis=1))
    outcomes = {name: Outcome() for name in estimators}
    for _ in range(draws):
        image = frame.exposed(rng)
        for name in estimators:
            add(outcomes[name], locator(image, kind="disc", estimator=name, **options), frame, tree)
    return outcomes


def add(out: Outcome, table, frame: Frame, tree: cKDTree | None = None) -> None:
    """Match one table with the truth and append it."""
    tree = tree or cKDTree(np.stack([frame.x, frame.y], axis=1))
    out.wanted += len(frame.x)
    good = np.isfinite(table.x_px) & np.isfinite(table.y_px)
    distance, index = tree.query(np.stack([table.x_px[good], table.y_px[good]], axis=1)) if good.any() else (np.zeros(0), np.zeros(0, int))
    near = distance < max(1.5, 0.6 * frame.case.radius)
    order = np.flatnonzero(near)[np.argsort(distance[near])]
    order = order[np.unique(index[order], return_index=True)[1]]
    rows = np.flatnonzero(good)[order]
    out.false += int(good.sum()) - len(rows)
    unsure = (np.asarray(table.flags)[rows] & int(UNSURE)) != 0
    out.unsure += int(unsure.sum())
    rows, true = rows[~unsure], index[order][~unsure]
    x, y = frame.x[true], frame.y[true]
    parts = (table.x_px[rows] - x, table.y_px[rows] - y, x, y, table.var_x_px2[rows], table.cov_xy_px2[rows], table.var_y_px2[rows])
    out.rows.append(np.array(parts, float))


def departures(z: np.ndarray, rate: float) -> list[str]:
    """What says that z is no sample of N(0, 1), at a false-failure rate for all three tests together: mean, variance, distribution.

    Of n values the mean test misses half of the biases of k/√n standard deviations, the variance test half of the errors of the standard
    deviation by a share k/√(2n), with k = 5.1 at a rate of 1e-6 (`smallest`).
    """
    n, each, said = len(z), rate / 3, []
    if n == 0 or not np.isfinite(z).all():
        return ["no values, or values that are not finite"]
    if 2 * stats.norm.sf(abs(z.mean()) * np.sqrt(n)) < each:
        said.append(f"mean {z.mean():+.3f}")
    square = (z**2).sum()
    if 2 * min(stats.chi2.sf(square, n), stats.chi2.cdf(square, n)) < each:
        said.append(f"standard deviation {np.sqrt(square / n):.3f}")
    if stats.kstest(z, "norm").pvalue < each:
        said.append(f"distribution {stats.kstest(z, 'norm').statistic:.3f} from normal")
    return said


def smallest(n: int, rate: float) -> tuple[float, float]:
    """Bias in standard deviations, and relative error of the standard deviation, of which `departures` misses half."""
    k = stats.norm.isf(rate / 6)
    return k / np.sqrt(n), k / np.sqrt(2 * n)


def under_covered(z: np.ndarray, rate: float) -> list[str]:
    """Whether fewer values than promised lie within 1 and 2 standard deviations, at a false-failure rate for both together."""
    if not np.isfinite(z).all():
        return [f"{int((~np.isfinite(z)).sum())} covariances that are none"]
    said = []
    for k in (1, 2):
        inside, nominal = int((np.abs(z) < k).sum()), 1 - 2 * stats.norm.sf(k)
        if stats.binom.cdf(inside, len(z), nominal) < rate / 2:
            said.append(f"{inside / len(z):.1%} within {k} u, {nominal:.1%} promised")
    return said


def phase_bias(outcome: Outcome, bins: int = 10) -> tuple[np.ndarray, np.ndarray]:
    """Mean error per bin of the sub-pixel phase (x against x, y against y), and its standard error."""
    dx, dy, x, y = outcome.table[:4]
    error, phase = np.concatenate([dx, dy]), np.concatenate([x, y]) % 1.0
    number = np.minimum((phase * bins).astype(int), bins - 1)
    count = np.bincount(number, minlength=bins)
    mean = np.bincount(number, error, bins) / count
    return mean, np.sqrt(np.maximum(np.bincount(number, error**2, bins) / count - mean**2, 0) / count)
