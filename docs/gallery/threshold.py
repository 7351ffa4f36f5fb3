"""The chapter's threshold experiment (Note 8, Fig 3.10): where a centroid is found when grey values up to a threshold are left out.

One frame holds 800 equal targets at random places within their pixels, each in the middle of its own 21 × 21 pixels. The frame is stored
with 8 bits, with and without noise, and every target is located at each threshold, which is a grey value counted from 0.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from gallery.profiles import TOP_DN, gaussian, stored
from pixmetry.core.errors import MeasureError
from pixmetry.core.random import Grid, Stream
from pixmetry.locate.centroids.fixed import FixedCentroid
from pixmetry.locate.detect.detection import detect
from pixmetry.locate.detect.targets import Positions
from pixmetry.locate.noise import NoiseModel
from pixmetry.locate.template.template import fit_template

SIDE = 21  # px, of the square of pixels that a target has to itself
MIDDLE = SIDE // 2
ACROSS, DOWN = 40, 20  # targets in a row and in a column of the frame
COUNT = ACROSS * DOWN
THRESHOLDS_DN = np.arange(0.0, 101.0, 5.0)
STREAM = Stream(310, 310, "handbook.threshold")
CURVES = ("centroid", "squared centroid", "soft centroid", "soft squared centroid")


@dataclass(frozen=True)
class Target:
    """A round target on an even background, and the noise of the camera that sees it.

    Parameters
    ----------
    name : str
    kind : {"disc", "spot"}
        A sharp disc that the lens has blurred, or a Gaussian spot.
    peak_dn, background_dn, noise_dn : float
        Height above the background (of the spot before it is averaged over a pixel), background, and standard deviation of the noise.
    blur_px : float
        Standard deviation of the blur, or of the spot, without the pixel.
    radius_px : float
        Of the disc.
    """

    name: str
    kind: str
    peak_dn: float
    background_dn: float
    noise_dn: float
    blur_px: float
    radius_px: float = 0.0

    def describe(self) -> str:
        """Say it in words."""
        size = f"radius {self.radius_px:g} px, blur σ {self.blur_px:g} px" if self.kind == "disc" else f"σ {self.blur_px:g} px"
        return f"{self.name}, {size}, peak {self.peak_dn:g}, background {self.background_dn:g}, noise σ {self.noise_dn:g} grey values"


DISC = Target("disc", "disc", 150.0, 5.0, 5.0, 0.7, 3.0)
SPOT = Target("Gaussian spot", "spot", 150.0, 0.0, 3.0, 1.5)


@dataclass(frozen=True)
class Scatter:
    """Root mean square of the errors of both coordinates, one value per threshold, and its standard error from the targets' scatter."""

    rms_px: np.ndarray
    u_px: np.ndarray


@dataclass(frozen=True)
class Sweep:
    """What the experiment gives for one target.

    Parameters
    ----------
    target : Target
    threshold_dn : ndarray, shape (m,)
    noisy, quiet : dict of Scatter
        For each of `CURVES`, with noise and without; the targets are the same.
    """

    target: Target
    threshold_dn: np.ndarray
    noisy: dict[str, Scatter]
    quiet: dict[str, Scatter]


def phases() -> tuple[np.ndarray, np.ndarray]:
    """Where in its pixel each target lies, evenly at random within ±0.5 px in x and in y, shape (800,)."""
    phase = STREAM.uniform_unit(2 * COUNT).astype(float) - 0.5
    return phase[:COUNT], phase[COUNT:]


def corners() -> tuple[np.ndarray, np.ndarray]:
    """Column and row of the first pixel of each target's square, shape (800,)."""
    row, col = np.divmod(np.arange(COUNT), ACROSS)
    return SIDE * col, SIDE * row


def places() -> tuple[np.ndarray, np.ndarray]:
    """True x and y of the targets in the frame, shape (800,)."""
    return tuple(corner + MIDDLE + phase for corner, phase in zip(corners(), phases(), strict=True))


def light(target: Target, x_px: np.ndarray, y_px: np.ndarray) -> np.ndarray:
    """Mean grey values, averaged over each pixel, of squares with a target at (x, y) from the middle of the middle pixel.

    Returns
    -------
    ndarray, shape (n, 21, 21), float64
        Not yet stored.
    """
    if target.kind == "spot":
        across, down = (gaussian(np.arange(SIDE) - MIDDLE - v[:, None], target.blur_px) for v in (x_px, y_px))
        return target.background_dn + target.peak_dn * down[:, :, None] * across[:, None, :]
    from pixmetry.scene.discs import Discs
    from pixmetry.scene.uniform import Uniform

    x, y = (MIDDLE + np.asarray(v, float)[:, None] for v in (x_px, y_px))
    scene = Discs(x, y, 2 * target.radius_px, target.blur_px, target.peak_dn, Uniform(target.background_dn), per_frame=True)
    n = len(x_px)
    return scene.photons(Grid.whole(range(n), (SIDE, SIDE)), (SIDE, SIDE), np.ones(n), np.zeros(n)).astype(float)


def tiles(frame: np.ndarray) -> np.ndarray:
    """The targets' own squares of pixels, shape (800, 21, 21)."""
    return frame.reshape(DOWN, SIDE, ACROSS, SIDE).swapaxes(1, 2).reshape(COUNT, SIDE, SIDE)


@lru_cache(maxsize=8)
def frame_of(target: Target, noisy: bool = True) -> np.ndarray:
    """The stored frame, shape (420, 840), uint8: noise is added, then the value is rounded, then cut off at 0 and 255."""
    level = light(target, *phases()).reshape(DOWN, ACROSS, SIDE, SIDE).swapaxes(1, 2).reshape(DOWN * SIDE, ACROSS * SIDE)
    if noisy:
        level = level + target.noise_dn * STREAM.normal(Grid.whole([0], level.shape))[0]
    frame = stored(level).astype(np.uint8)
    frame.flags.writeable = False
    return frame


def scatter(x_px: np.ndarray, y_px: np.ndarray) -> tuple[float, float]:
    """Root mean square of the errors of x and y together, and its standard error, from positions in the frame."""
    true_x, true_y = places()
    square = ((x_px - true_x) ** 2 + (y_px - true_y) ** 2) / 2
    rms = float(np.sqrt(square.mean()))
    return rms, float(square.std(ddof=1) / np.sqrt(len(square)) / (2 * rms))


def centroids(windows: np.ndarray, curve: str, threshold_dn: float, window: int = SIDE) -> tuple[np.ndarray, np.ndarray]:
    """x and y in each square by one of `CURVES`: grey values up to the threshold are left out, and with "soft" it is taken from the others.

    The squared centroid takes the squares of the grey values that are left.
    """
    values = np.asarray(windows, float)
    if "squared" not in curve:
        name = "soft_threshold" if "soft" in curve else "hard_threshold"
        return FixedCentroid(name, window, threshold_dn=threshold_dn).locate(values)
    values = np.where(values > threshold_dn, values - (threshold_dn if "soft" in curve else 0.0), 0.0)
    return FixedCentroid("squared_centroid", window).locate(values)


def located(windows: np.ndarray, curve: str, threshold_dn: float, window: int = SIDE) -> tuple[np.ndarray, np.ndarray]:
    """x and y of all targets in the frame; see `centroids`."""
    return tuple(first + at for first, at in zip(corners(), centroids(windows, curve, threshold_dn, window), strict=True))


def against_phase(target: Target, curve: str, threshold_dn: float, phase_px: np.ndarray) -> np.ndarray:
    """Error in x, without noise and rounding, of targets at these places in x and in the middle of a pixel in y; shape as ``phase_px``."""
    windows = stored(light(target, phase_px, np.zeros_like(phase_px)), "unquantised")
    return centroids(windows, curve, threshold_dn)[0] - MIDDLE - phase_px


@lru_cache(maxsize=4)
def sweep(target: Target) -> Sweep:
    """Run the experiment: every curve at every threshold, with noise and without."""
    found = []
    for noisy in (True, False):
        windows = tiles(frame_of(target, noisy))
        each = {c: np.array([scatter(*located(windows, c, t)) for t in THRESHOLDS_DN]).T for c in CURVES}
        found.append({c: Scatter(*values) for c, values in each.items()})
    return Sweep(target, THRESHOLDS_DN, *found)


@dataclass(frozen=True)
class Fitted:
    """What the least-squares template gives, which has no threshold.

    Parameters
    ----------
    rms_px, u_px : float
        Root mean square error with noise, and its standard error.
    quiet_px : float
        The same without noise.
    stated_px : float
        Standard deviation that the fit itself states, root mean square over the targets.
    """

    rms_px: float
    u_px: float
    quiet_px: float
    stated_px: float


def fitted_positions(target: Target, noisy: bool = True) -> Positions:
    """All targets of a frame by detection and the least-squares template, which has no threshold; in the order of `places`.

    Told to the fit: the noise's variance, with 1/12 for the rounding, that the scale ends at 0 and 255, and that background and light are
    even.

    Raises
    ------
    MeasureError
        If not every square of the frame has its one target.
    """
    frame = frame_of(target, noisy)
    targets = detect(frame, polarity="bright", low_dn=0.0, high_dn=TOP_DN).targets
    tile = np.rint((targets.y_px - MIDDLE) / SIDE) * ACROSS + np.rint((targets.x_px - MIDDLE) / SIDE)
    order = np.argsort(tile)
    if not np.array_equal(tile[order], np.arange(COUNT)):
        raise MeasureError("not every target was detected once", where="handbook", value=len(tile), allowed=str(COUNT))
    noise = NoiseModel((target.noise_dn**2 if noisy else 0.0) + 1 / 12, low_dn=0.0, high_dn=TOP_DN)
    return fit_template(frame, targets[order], noise, target.kind, background_plane=False, light_plane=False)


@lru_cache(maxsize=4)
def fitted(target: Target) -> Fitted:
    """Errors of the template over the same targets."""
    seen, quiet = fitted_positions(target), fitted_positions(target, False)
    stated = float(np.sqrt(np.mean((seen.var_x_px2 + seen.var_y_px2) / 2)))
    return Fitted(*scatter(seen.x_px, seen.y_px), scatter(quiet.x_px, quiet.y_px)[0], stated)


@dataclass(frozen=True)
class Parts:
    """Errors of one curve over many frames of the same targets, one value per threshold.

    Parameters
    ----------
    random_px : ndarray
        Standard deviation from frame to frame, which the mean of N frames lowers by √N.
    lasting_px : ndarray
        Root mean square of what the mean of endless frames would still be off.
    """

    random_px: np.ndarray
    lasting_px: np.ndarray


@lru_cache(maxsize=8)
def parts(target: Target, curve: str, frames: int = 16) -> Parts:
    """Part the error with noise into what changes from frame to frame and what stays."""
    level, phase = light(target, *phases()), np.stack(phases())
    shape = (DOWN * SIDE, ACROSS * SIDE)
    errors = np.empty((frames, len(THRESHOLDS_DN), 2, COUNT))
    for k in range(frames):
        windows = stored(level + target.noise_dn * tiles(STREAM.normal(Grid.whole([k], shape))[0]))
        for j, threshold in enumerate(THRESHOLDS_DN):
            errors[k, j] = np.stack(centroids(windows, curve, threshold)) - MIDDLE - phase
    random = errors.var(axis=0, ddof=1).mean(axis=(1, 2))
    lasting = (errors.mean(axis=0) ** 2).mean(axis=(1, 2)) - random / frames  # the mean of so many frames still holds some noise
    return Parts(np.sqrt(random), np.sqrt(np.maximum(lasting, 0.0)))


def without_threshold(target: Target, windows_px: tuple[int, ...] = (13, 15, 17, 21)) -> dict[int, tuple[float, float]]:
    """Scatter of the plain centroid without any threshold against the side of the square that it sums over."""
    seen = tiles(frame_of(target))
    return {side: scatter(*located(seen, "centroid", 0.0, side)) for side in windows_px}


def rise(found: Sweep, curve: str, first_dn: float = 60.0) -> tuple[float, float]:
    """Slope of a curve from ``first_dn`` on in px per grey value (least squares), and its standard error from that of the points.

    The targets are the same at every threshold, so that neighbouring points err alike; the standard error takes them for independent.
    """
    use = found.threshold_dn >= first_dn
    t, seen = found.threshold_dn[use], found.noisy[curve]
    lever = (t - t.mean()) / ((t - t.mean()) ** 2).sum()
    return float(lever @ seen.rms_px[use]), float(np.sqrt(lever**2 @ seen.u_px[use] ** 2))
