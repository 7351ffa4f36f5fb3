"""What an estimator is: run on images by `pixmetry.locate`, propagated by a budget, looked at over the sub-pixel phase.

There are two sides of one thing. A `Method` measures targets that were detected in a frame. An `Estimator` measures windows that hold one
known target each and says how its answer depends on every pixel; `TargetEstimator` makes one of any method, and `FixedCentroid` is what a
program of one's own may do. Whoever propagates errors needs the `Estimator` only.

A new method takes three files: a module with a function ``(frame, targets, noise, settings) -> Positions`` and the tuple ``METHODS`` that
describes it; its line in `estimators.MODULES`; its test. The command line, the budget, `assess --estimator` and S-curves have it then.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar, Protocol

import numpy as np

from pixmetry.core.errors import InputError
from pixmetry.locate.detect.targets import Positions, Targets
from pixmetry.locate.noise import NoiseModel


@dataclass(frozen=True)
class Settings:
    """How targets are measured.

    Parameters
    ----------
    shape : {"disc", "ellipse", "ring", "spot"}
        Of the template.
    planes : {"auto", "shared"} or bool
        Whether slopes of the ground and of the light are among the unknowns; "shared": only where many targets, or most, have them.
    light_on : {"surface", "image"}
        Whether light that falls off acts before the lens's blur or after it.
    aperture_px : float
        Side of the pixel's light-sensitive square.
    threads : int, optional
    """

    shape: str = "disc"
    planes: str | bool = "auto"
    light_on: str = "surface"
    aperture_px: float = 1.0
    threads: int | None = None


@dataclass(frozen=True)
class Method:
    """An estimator of detected targets, as `pixmetry.locate` runs it.

    Parameters
    ----------
    name : str
        On the command line.
    text : str
        What it is, in a line.
    measure : callable (frame, targets, noise, settings) -> Positions
    reach_px : callable (radius_px, edge_px) -> float
        How far beyond a disc's radius it reads; ``edge_px`` is the standard deviation of the edge with the pixel in it.
    knows_aperture : bool
        Whether its uncertainty holds for pixels with gaps too.
    slopes : callable (found, noise, shape, reach_px) -> ndarray, optional
        How x and y change per DN added to each pixel, shape (2, n, rows, cols), for windows of this shape that hold one disc each. By
        default difference quotients, which take a run for every pixel.
    words : str
        Its name in a sentence; by default the name.
    sees_phase : bool
        Whether its error depends on where in its pixel a target lies, even without noise. ``measure`` states this error then: column
        ``s_curve_px``, the standard deviation over the phase, whose square is in the variances. That of a fit of the target's own shape
        does not.
    """

    name: str
    text: str
    measure: Callable[[np.ndarray, Targets, NoiseModel, Settings], Positions]
    reach_px: Callable[[float, float], float]
    knows_aperture: bool = False
    slopes: Callable[[Positions, NoiseModel, tuple[int, int], float], np.ndarray] | None = None
    words: str = ""
    sees_phase: bool = True

    def positions(self, frame: np.ndarray, targets: Targets, noise: NoiseModel, settings: Settings) -> Positions:
        """Measure the targets of a frame, and refuse a covariance that lacks the variance over the sub-pixel phase.

        Raises
        ------
        InputError
            If ``s_curve_px`` is not stated, or its square is not in the variances.
        """
        found = self.measure(frame, targets, noise, settings)
        if not self.sees_phase:
            return found
        remedy = "add its square to the variances, with s_curve_px in more; or say sees_phase=False if it does not depend on the phase"
        if "s_curve_px" not in found.more:
            raise InputError(f"the covariance of {self.name} is without the sub-pixel phase", where="s_curve_px", remedy=remedy)
        least = (1 - 1e-9) * found.more["s_curve_px"] ** 2
        if np.any((found.var_x_px2 < least) | (found.var_y_px2 < least)):
            raise InputError(f"variances of {self.name} are less than those over the sub-pixel phase", where="s_curve_px", remedy=remedy)
        return found


@dataclass(frozen=True)
class KnownTarget:
    """A disc and the camera that sees it, where they are known: sizes in px, heights in DN."""

    diameter_px: float
    blur_px: float
    amplitude_dn: float
    gain_dn_per_e: float
    saturation_dn: float
    bits: int


class Estimator(Protocol):
    """An estimator of one position a window, for windows that hold one target each.

    Coordinates are those of the window: 0 is the centre of the first pixel. NaN stands where there is no position. It is a dataclass, whose
    fields a budget keeps.
    """

    __dataclass_fields__: ClassVar[dict[str, Any]]

    @property
    def name(self) -> str:
        """As on the command line."""

    @property
    def window(self) -> int:
        """Side of the square of pixels that it reads, odd; known by `resolved`."""

    @property
    def background_dn(self) -> float:
        """Grey value that is taken as zero."""

    @property
    def threshold_dn(self) -> float | None:
        """Threshold above the background, where there is one that is known beforehand."""

    @property
    def by_differences(self) -> bool:
        """Whether its gradient takes a run for every pixel."""

    def resolved(self, background_dn: float, noise_dn: float, target: KnownTarget | None = None) -> Any:
        """Return it for a given background, standard deviation of its noise, and target."""

    def as_seen(self, level_dn: Callable[[float], float]) -> Any:
        """Return it with grey values as a camera shows them; ``level_dn`` gives the one of light so much above the background."""

    def locate(self, windows_dn: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return x and y, shape (n,), of windows, shape (n, rows, cols)."""

    def gradient(self, windows_dn: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return how x and y change per DN added to each pixel, two arrays of shape (n, rows, cols)."""

    def describe(self) -> str:
        """Say it in words."""
