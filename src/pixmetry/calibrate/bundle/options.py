"""How a calibration is done."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from pixmetry.calibrate.bundle.network import PER_IMAGE_NAMES
from pixmetry.core.errors import ParameterError

CHOICES = {
    "field": ("auto", "fixed", "free"),
    "loss": ("none", "huber", "cauchy"),
    "control": ("tested", "as_stated"),
    "target": ("circle", "square"),
}
SWITCHES = ("snoop", "variance_components", "eccentricity", "residual_grid", "a_priori", "shared_errors", "patterns")
TYPES: tuple[tuple[str, tuple[type, ...], str], ...] = (
    *((name, (bool, np.bool_), "true or false") for name in SWITCHES),
    *((name, (int, np.integer), "a whole number") for name in ("folds", "max_iterations")),
    *((name, (int, float, np.integer, np.floating), "a number") for name in ("loss_scale", "false_alarms")),
)


@dataclass(frozen=True)
class Options:
    """How a calibration is done. Which interior parameters are estimated stands in the cameras of the network.

    Parameters
    ----------
    field : {"auto", "fixed", "free"}
        What becomes of the known coordinates of a test field that are said to be exact. ``"free"`` estimates them, with the known ones as
        start values and datum; ``"auto"`` does so where images left out of the fit show that it is better.
    loss : {"huber", "cauchy", "none"}
        Of the first pass, before gross errors are found.
    loss_scale : float
        Standard deviations beyond which this loss holds an observation down.
    snoop : bool
        Look for gross errors.
    false_alarms : float
        Number of good image points that may be expected to be rejected in one adjustment, above 0.
    control : {"tested", "as_stated"}
        What becomes of control points (weighted ones, and a few fixed ones beside free points) and of scale bars that the network
        contradicts. ``"tested"`` leaves them out one by one, or raises their uncertainties where these are stated too small, and says it;
        ``"as_stated"`` keeps all of them with the uncertainties that they came with, and only says what contradicts them.
    variance_components : bool
        Estimate the standard deviations of x and of y of each camera, and weigh by them: what image coordinates scatter beyond covariances
        that they came with is added to these; smaller or guessed ones are multiplied. Without it, covariances keep their ratios; beside
        scale bars or control points, which stand as stated, they get one common factor.
    eccentricity : bool
        Correct the images of targets whose size is known.
    target : {"circle", "square"}
        Their shape; the ``diameter`` of a square is its side.
    per_image : tuple of str, optional
        Out of ``"x_scale"`` and ``"x_shift"``; None keeps what the network says.
    folds : int
        Of the images, for the test with images left out of the fit; 0: no such test.
    residual_grid : bool
        Make a correction grid of what the parameters leave over.
    a_priori : bool
        Take the covariance that the image coordinates came with as true: no variance components, and uncertainties are not scaled by
        sigma0.
    shared_errors : bool
        Look for errors that image points have in common, and let the uncertainties hold them where they are significant. Without it, all
        errors are taken as independent.
    patterns : bool
        Search what the residuals hold for patterns, and what these tell of error sources.
    max_iterations : int
        Of one adjustment.

    Raises
    ------
    ParameterError
        If an option cannot be used.
    """

    field: Literal["auto", "fixed", "free"] = "auto"
    loss: Literal["huber", "cauchy", "none"] = "huber"
    loss_scale: float = 2.5
    snoop: bool = True
    false_alarms: float = 0.01
    control: Literal["tested", "as_stated"] = "tested"
    variance_components: bool = True
    eccentricity: bool = True
    target: Literal["circle", "square"] = "circle"
    per_image: tuple[str, ...] | None = None
    folds: int = 5
    residual_grid: bool = False
    a_priori: bool = False
    shared_errors: bool = True
    patterns: bool = True
    max_iterations: int = 100

    def __post_init__(self) -> None:
        for name, kinds, allowed in TYPES:
            value = getattr(self, name)
            if not isinstance(value, kinds) or (isinstance(value, bool) and bool not in kinds) or value != value:
                raise ParameterError("cannot be used", where=name, value=value, allowed=allowed)
        if self.max_iterations < 1:
            raise ParameterError("not a number of iterations", where="max_iterations", value=self.max_iterations, allowed="1 and more")
        if isinstance(self.per_image, str):
            raise ParameterError("one text", where="per_image", value=self.per_image, allowed='a tuple of names, such as ("x_scale",)')
        for name, choices in CHOICES.items():
            if getattr(self, name) not in choices:
                raise ParameterError("no such choice", where=name, value=getattr(self, name), allowed=", ".join(choices))
        if not set(self.per_image or ()) <= set(PER_IMAGE_NAMES):
            allowed = ", ".join(PER_IMAGE_NAMES)
            raise ParameterError("no such parameter of an image", where="per_image", value=self.per_image, allowed=allowed)
        if not self.loss_scale > 0:
            raise ParameterError("not a scale of a loss", where="loss_scale", value=self.loss_scale, allowed="above 0")
        if not 0 < self.false_alarms < 100:
            raise ParameterError("not a number of false alarms", where="false_alarms", value=self.false_alarms, allowed="0 … 100")
        if self.folds == 1 or self.folds < 0:
            raise ParameterError("not a number of folds", where="folds", value=self.folds, allowed="0, or 2 and more")
