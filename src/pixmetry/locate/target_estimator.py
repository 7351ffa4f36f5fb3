"""The estimators of `pixmetry locate` on windows of one target each: a budget propagates the same code that runs on images."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from pixmetry.core.errors import InputError
from pixmetry.locate.centroids.fixed import LAWS, PREFIX, FixedCentroid
from pixmetry.locate.centroids.moments import half_height_radius
from pixmetry.locate.detect.targets import Flag, Positions, Targets
from pixmetry.locate.estimator import Estimator, KnownTarget, Method, Settings
from pixmetry.locate.estimators import AUTO, FEW_ELECTRONS, methods
from pixmetry.locate.noise import ROUNDING_DN2, NoiseModel, split_text

MARGIN_PX = 2.0  # around what an estimator reads of a disc: half a pixel of phase, and rounding up


@dataclass(frozen=True)
class TargetEstimator:
    """An estimator of `pixmetry.locate` for discs, run on windows that hold one target each.

    It is the same code, without slopes of ground and light among a fit's unknowns. Only the search for targets is left out; size, blur,
    height and noise are those that are known.

    Parameters
    ----------
    name : str
        ``auto``, or one of `estimators.methods`. ``auto`` becomes the template, with the likelihood of few electrons where the
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
        if self.name != AUTO and self.name not in methods():
            raise InputError("no such estimator", value=self.name, allowed=", ".join((AUTO, *methods())))

    @property
    def method(self) -> Method:
        """What it runs.

        Raises
        ------
        InputError
            Where ``auto`` was not resolved.
        """
        if self.name == AUTO:
            raise InputError("the estimator needs a target", remedy="call resolved() first")
        return methods()[self.name]

    def resolved(self, background_dn: float, noise_dn: float, target: KnownTarget | None = None) -> TargetEstimator:
        """Return it for a given target and camera."""
        if target is None:
            raise InputError("the estimator needs a target", remedy="say what target it is")
        few = target.amplitude_dn < FEW_ELECTRONS * target.gain_dn_per_e
        name = self.name if self.name != AUTO else "poisson_gaussian" if few else "template"
        return TargetEstimator(
            name,
            radius_px=target.diameter_px / 2,
            blur_px=target.blur_px,
            amplitude_dn=target.amplitude_dn,
            background_dn=background_dn,
            noise_dn=max(noise_dn, ROUNDING_DN2**0.5),
            slope_dn=target.gain_dn_per_e,
            high_dn=target.saturation_dn,
            bits=target.bits,
        )

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
        return 2 * int(np.ceil(radius + self.method.reach_px(radius, edge) + MARGIN_PX)) + 1

    @property
    def by_differences(self) -> bool:
        """Whether its gradient takes a run for every pixel."""
        return self.name != AUTO and self.method.slopes is None

    def describe(self) -> str:
        """Say it in words."""
        words = self.name if self.name == AUTO else self.method.words or self.name.replace("_", " ")
        return f"{words}, as pixmetry locate runs it"

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
        if self.method.slopes is None:
            return self._by_differences(windows_dn)
        reach = 0.5 * (self.window - 1) - MARGIN_PX + 0.5
        found, noise = self._positions(windows_dn), self._noise(windows_dn.dtype)
        slopes = self.method.slopes(found, noise, (windows_dn.shape[1], windows_dn.shape[2]), reach)
        return slopes[0], slopes[1]

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
            raise InputError("the estimator needs a target", remedy="call resolved() first")
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
        found = self.method.positions(data.reshape(n * rows, cols), targets, noise, Settings(planes=False))
        lost = (found.flags & np.uint32(Flag.NOT_CONVERGED)) > 0
        x, y = np.where(lost, np.nan, found.x_px), np.where(lost, np.nan, found.y_px - rows * np.arange(n))
        return replace(found, x_px=x, y_px=y)

    def _targets(self, data: np.ndarray) -> Targets:
        """The targets as after detection: rough centres from the images, other values from the known target."""
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


def parse_estimator(text: str) -> Estimator:
    """Read an estimator: a name of `TargetEstimator`, or ``fixed_…:key=value,…``, as in ``fixed_soft_threshold:sigma=3,window=13``.

    Raises
    ------
    InputError
        If name, key or value cannot be used.
    """
    name, _, rest = (part.strip() for part in text.partition(":"))
    if name == AUTO or name in methods():
        if rest:
            fixed = f"; for a fixed square of pixels take {PREFIX}{name}:{rest}" if name in LAWS else ""
            what = f"{name} has no settings: it chooses window and threshold from target and noise, as in pixmetry locate"
            raise InputError(what, where="estimator", value=rest, remedy=f"name it alone{fixed}")
        return TargetEstimator(name)
    if not name.startswith(PREFIX) or name.removeprefix(PREFIX) not in LAWS:
        known = (AUTO, *methods(), *(PREFIX + law for law in LAWS))
        raise InputError("no such estimator", where="estimator", value=name, allowed=", ".join(known))
    _, values = split_text(text, {"sigma": "sigma", "threshold": "threshold_dn", "window": "window"}, "estimator")
    window = values.pop("window", 13)
    if window != int(window):
        raise InputError("the estimator's window is not a whole number", where="estimator", value=window, allowed="an odd number of pixels")
    return FixedCentroid(name.removeprefix(PREFIX), window=int(window), **values)
