"""The estimators of `pixmetry locate` on windows of one target each: what a budget propagates is what is run on images."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from pixmetry.core.errors import InputError
from pixmetry.locate.centroids.estimators import LAWS, PREFIX, Estimator, split_text
from pixmetry.locate.detect.targets import Flag, Positions, Targets
from pixmetry.locate.noise import ROUNDING_DN2, NoiseModel

FITS = ("template", "poisson_gaussian")
MOMENTS = ("soft_threshold", "squared_centroid", "centroid", "hard_threshold", "windowed_centroid")
OPERATORS = ("gaussian", "ellipse_edges", "forstner", "perimeter")
AUTO = "auto"
FEW_ELECTRONS = 50.0  # at a target's peak: below, the errors of a grey value are visibly no normal ones
MARGIN_PX = 2.0  # around what an estimator reads of a disc: half a pixel of phase, and rounding up


@dataclass(frozen=True)
class TargetEstimator:
    """An estimator of `pixmetry.locate` for discs, run on windows that hold one target each.

    It is the same code: `template.fit_template` without slopes of ground and light, `moments.moment_positions`,
    `operators.operator_positions`. Only the search for targets is left out; size, blur, height and noise are those that are known.

    Parameters
    ----------
    name : str
        ``auto``, or one of `FITS`, `MOMENTS`, `OPERATORS`. ``auto`` becomes the template, with the likelihood of few electrons where the
        target has few.
    radius_px, blur_px, amplitude_dn : float, optional
        Of the target; known by `resolved`.
    background_dn, noise_dn, slope_dn : float
        Grey value of the ground, standard deviation of its noise, and variance per DN of light above it.
    high_dn, bits : float and int, optional
        Where the scale ends, for windows of floats and for those of whole numbers.

    Raises
    ------
    InputError
        If the name is unknown.
    """

    name: str = AUTO
    radius_px: float | None = None
    blur_px: float | None = None
    amplitude_dn: float | None = None
    background_dn: float = 0.0
    noise_dn: float = 0.0
    slope_dn: float = 0.0
    high_dn: float | None = None
    bits: int | None = None

    def __post_init__(self) -> None:
        if self.name not in (AUTO, *FITS, *MOMENTS, *OPERATORS):
            raise InputError("no such estimator", value=self.name, allowed=", ".join((AUTO, *FITS, *MOMENTS, *OPERATORS)))

    def resolved(
        self,
        background_dn: float,
        noise_dn: float,
        *,
        diameter_px: float,
        blur_px: float,
        amplitude_dn: float,
        gain_dn_per_e: float,
        saturation_dn: float,
        bits: int,
    ) -> TargetEstimator:
        """Return it for a given target and camera."""
        few = amplitude_dn < FEW_ELECTRONS * gain_dn_per_e
        name = self.name if self.name != AUTO else FITS[1] if few else FITS[0]
        size = {"radius_px": diameter_px / 2, "blur_px": blur_px, "amplitude_dn": amplitude_dn}
        noise = {"background_dn": background_dn, "noise_dn": max(noise_dn, ROUNDING_DN2**0.5), "slope_dn": gain_dn_per_e}
        return TargetEstimator(name, **size, **noise, high_dn=saturation_dn, bits=bits)

    def as_seen(self, level_dn: Callable[[float], float]) -> TargetEstimator:
        """Return it with ground and height as a camera shows them; ``level_dn`` gives the grey value of light so much above the ground."""
        radius, _, amplitude = self._size()
        ground = level_dn(0.0)
        height = level_dn(amplitude) - ground
        return replace(self, background_dn=ground, amplitude_dn=height, slope_dn=self.slope_dn * abs(height / amplitude))

    @property
    def threshold_dn(self) -> None:
        """It has none that is known beforehand."""
        return None

    @property
    def window(self) -> int:
        """Side of the square of pixels that it reads, odd."""
        radius, edge, _ = self._size()
        reach = 3.5 * edge + 1.0 if self.name in FITS else max(4 * edge, 1.0) + 5 + 0.5 * radius
        return 2 * int(np.ceil(radius + reach + MARGIN_PX)) + 1

    def describe(self) -> str:
        """Say it in words."""
        what = {"template": "template fit", "poisson_gaussian": "template fit with the likelihood of few electrons"}
        return f"{what.get(self.name, self.name.replace('_', ' '))}, as pixmetry locate runs it"

    def locate(self, windows_dn: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Estimate one position a window.

        Parameters
        ----------
        windows_dn : ndarray, shape (n, rows, cols)
            Grey values; the target lies within a pixel of pixel ``(rows // 2, cols // 2)``.

        Returns
        -------
        x, y : ndarray, shape (n,), float64
            In window coordinates: 0 is the centre of the first pixel. NaN where the estimator found no rest.

        Raises
        ------
        InputError
            If the windows are too small, or the target is not known.
        """
        found = self._positions(windows_dn)
        return found.x_px, found.y_px

    def covariance(self, windows_dn: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Variances of x and y that the estimator states for each window, shape (n,), px²."""
        found = self._positions(windows_dn)
        return found.var_x_px2, found.var_y_px2

    def gradient(self, windows_dn: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return how the estimated x and y change per DN added to each pixel, two arrays of shape (n, rows, cols), float64.

        Notes
        -----
        Of a fit the rows of (JᵀWJ)⁻¹JᵀW at its result, W one over the variances. Of the others the difference quotient over ± one
        standard deviation of each pixel's noise, so that what a threshold does to that noise is in it.
        """
        return self._of_fit(windows_dn) if self.name in FITS else self._by_differences(windows_dn)

    def _of_fit(self, windows_dn: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        from pixmetry.locate.template.template import PARAMETERS, model

        n, rows, cols = windows_dn.shape
        found, noise = self._positions(windows_dn), self._noise(windows_dn.dtype)
        out = np.zeros((2, n, rows, cols))
        reach = 0.5 * (self.window - 1) - MARGIN_PX + 0.5
        for k in range(n):
            values = [found.x_px[k], found.y_px[k], *(found.more[name][k] for name in PARAMETERS["disc"][2:])]
            if not np.isfinite(values).all():
                out[:, k] = np.nan
                continue
            mean, jacobian = model("disc", np.array(values), rows, cols)
            y, x = np.ogrid[:rows, :cols]
            near = np.hypot(x - values[0], y - values[1]) <= reach
            columns = jacobian[:, near] / np.sqrt(noise.variance_dn2(mean[near]))
            scale = np.sqrt((columns**2).sum(axis=1, keepdims=True))
            gain = np.linalg.pinv((columns / scale).T, rcond=1e-9) / scale / np.sqrt(noise.variance_dn2(mean[near]))
            out[:, k, near] = gain[:2]
        return out[0], out[1]

    def _by_differences(self, windows_dn: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        data = np.asarray(windows_dn, float)
        noise, half = self._noise(data.dtype), self.window // 2
        rows, cols = (slice(side // 2 - half, side // 2 + half + 1) for side in data.shape[1:])
        out = np.zeros((2, *data.shape))
        for k, image in enumerate(data):
            at = np.stack(np.meshgrid(np.arange(image.shape[0])[rows], np.arange(image.shape[1])[cols], indexing="ij"), -1).reshape(-1, 2)
            step = np.sqrt(noise.variance_dn2(image[at[:, 0], at[:, 1]]))
            moved = []
            for sign in (1, -1):
                changed = np.repeat(image[None], len(at), axis=0)
                changed[np.arange(len(at)), at[:, 0], at[:, 1]] += sign * step
                moved.append(self.locate(changed))
            for axis in (0, 1):
                out[axis, k, at[:, 0], at[:, 1]] = np.nan_to_num(moved[0][axis] - moved[1][axis]) / (2 * step)
        return out[0], out[1]

    def _size(self) -> tuple[float, float, float]:
        """Radius, standard deviation of the edge with the pixel in it, and height."""
        if self.radius_px is None or self.blur_px is None or self.amplitude_dn is None:
            raise InputError("an estimator for a target that is not known", remedy="call resolved() first")
        return self.radius_px, float(np.hypot(self.blur_px, 12**-0.5)), self.amplitude_dn

    def _noise(self, dtype: np.dtype) -> NoiseModel:
        high = np.inf if self.high_dn is None else self.high_dn
        if np.dtype(dtype).kind in "ui":
            high = np.inf if self.bits is None else 2.0**self.bits - 1
        low = 0.0 if np.dtype(dtype).kind in "ui" else -np.inf
        return NoiseModel(self.noise_dn**2, self.slope_dn, black_dn=self.background_dn, low_dn=low, high_dn=high)

    def _positions(self, windows_dn: np.ndarray) -> Positions:
        """Run the estimator on all windows, laid one below the other in one image; places in the windows' own coordinates."""
        data = np.ascontiguousarray(windows_dn, windows_dn.dtype if windows_dn.dtype in (np.uint8, np.uint16) else np.float32)
        n, rows, cols = data.shape
        if min(rows, cols) < self.window:
            least = f"at least {self.window} × {self.window} px"
            raise InputError("the estimator's window does not fit", value=(rows, cols), allowed=least)
        targets, noise = self._targets(data), self._noise(data.dtype)
        found = _RUN[self.name](data.reshape(n * rows, cols), targets, noise, self.name)
        lost = (found.flags & np.uint32(Flag.NOT_CONVERGED)) > 0
        x, y = np.where(lost, np.nan, found.x_px), np.where(lost, np.nan, found.y_px - rows * np.arange(n))
        return replace(found, x_px=x, y_px=y)

    def _targets(self, data: np.ndarray) -> Targets:
        """The targets as a search would find them: rough centres from the images, the rest from what is known."""
        from pixmetry.locate.centroids.moments import half_height_radius

        n, rows, cols = data.shape
        radius, edge, amplitude = self._size()
        y, x = np.arange(rows)[:, None], np.arange(cols)
        near = np.hypot(x - cols // 2, y - rows // 2) <= radius + 1.5
        above = (data > self.background_dn + 0.5 * amplitude) & near
        count, sides = above.sum(axis=(1, 2)), ((x, cols), (y, rows))
        rough = [np.where(count > 0, (above * at).sum(axis=(1, 2)) / np.maximum(count, 1), side // 2) for at, side in sides]
        one, none = np.ones(n), np.zeros(n)
        half = float(half_height_radius(radius, edge))
        x_px, y_px = rough[0], rough[1] + rows * np.arange(n)
        top, bottom, left, right = (np.rint(v).astype(np.int64) for v in (y_px - half, y_px + half + 1, x_px - half, x_px + half + 1))
        return Targets(
            x_px, y_px, half * one, half * one, none, edge * one, amplitude * one, self.background_dn * one, none, none,
            self.noise_dn * one, top, bottom, left, right, np.zeros(n, np.uint32),
        )  # fmt: skip


def _fit(frame: np.ndarray, targets: Targets, noise: NoiseModel, name: str) -> Positions:
    from pixmetry.locate.template.template import fit_template

    likelihood = "least_squares" if name == "template" else name
    return fit_template(frame, targets, noise, likelihood=likelihood, background_plane=False, light_plane=False)


def _moment(frame: np.ndarray, targets: Targets, noise: NoiseModel, name: str) -> Positions:
    from pixmetry.locate.centroids.moments import moment_positions

    return moment_positions(frame, targets, noise, name)


def _operator(frame: np.ndarray, targets: Targets, noise: NoiseModel, name: str) -> Positions:
    from pixmetry.locate.centroids.operators import operator_positions

    return operator_positions(frame, targets, noise, name)


_RUN = {**dict.fromkeys(FITS, _fit), **dict.fromkeys(MOMENTS, _moment), **dict.fromkeys(OPERATORS, _operator)}


def parse_estimator(text: str) -> Estimator | TargetEstimator:
    """Read an estimator: a name of `TargetEstimator`, or ``fixed_…:key=value,…``, as in ``fixed_soft_threshold:sigma=3,window=13``.

    Raises
    ------
    InputError
        If name, key or value cannot be used.
    """
    name, _, rest = (part.strip() for part in text.partition(":"))
    if name in (AUTO, *FITS, *MOMENTS, *OPERATORS):
        if rest:
            fixed = f"; for a fixed square of pixels take {PREFIX}{name}:{rest}" if name in LAWS else ""
            what = f"{name} has no settings: it chooses window and threshold by target and noise, as in pixmetry locate"
            raise InputError(what, where="estimator", value=rest, remedy=f"name it alone{fixed}")
        return TargetEstimator(name)
    if not name.startswith(PREFIX) or name.removeprefix(PREFIX) not in LAWS:
        known = (AUTO, *FITS, *MOMENTS, *OPERATORS, *(PREFIX + law for law in LAWS))
        raise InputError("no such estimator", where="estimator", value=name, allowed=", ".join(known))
    _, values = split_text(text, {"sigma": "sigma", "threshold": "threshold_dn", "window": "window"}, "estimator")
    window = values.pop("window", 13)
    if window != int(window):
        raise InputError("the estimator's window is not a whole number", where="estimator", value=window, allowed="an odd number of pixels")
    return Estimator(name.removeprefix(PREFIX), window=int(window), **values)
