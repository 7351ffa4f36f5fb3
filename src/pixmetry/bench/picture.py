"""The target as the camera stores it: pixels, true and found place, with a source and without; flat and dark fields; the line of video."""

from __future__ import annotations

import base64
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from pixmetry.bench.state import Layout
from pixmetry.budget.monte_carlo import missed
from pixmetry.camera.kept_steps import KeptSteps
from pixmetry.core.errors import InputError
from pixmetry.locate.detect.targets import Flag
from pixmetry.locate.job import locate
from pixmetry.simulate.job import stored_bits

FARTHEST_PX = 8.0  # from the true place, or the radius of the target: what is found beyond is something else


@dataclass(frozen=True)
class Picture:
    """Stored grey values of a part of the frame.

    Parameters
    ----------
    codes : ndarray of uint8 or uint16, shape (rows, cols)
    row0, col0 : int
        Of its first pixel in the frame.
    bits : int
    """

    codes: np.ndarray
    row0: int
    col0: int
    bits: int

    def to_record(self) -> dict[str, Any]:
        """Return the plain record: the codes as base64 of little-endian numbers."""
        codes = self.codes.astype("<u2")
        return {
            "rows": self.codes.shape[0],
            "cols": self.codes.shape[1],
            "row0": self.row0,
            "col0": self.col0,
            "bits": self.bits,
            "data": base64.b64encode(codes.tobytes()).decode("ascii"),
        }


@dataclass(frozen=True)
class Found:
    """The target as `pixmetry.locate` finds it, beside where it truly is; x and y, in px of the frame.

    Parameters
    ----------
    true_px : (float, float) or None
        None if the scene has no target.
    found_px : (float, float) or None
        None if no target was found near the true place.
    covariance_px2 : (float, float, float) or None
        Of x, of x with y, of y.
    flags : str
    reason : str
        Why there is none.
    """

    true_px: tuple[float, float] | None
    found_px: tuple[float, float] | None = None
    covariance_px2: tuple[float, float, float] | None = None
    flags: str = ""
    reason: str = ""

    @property
    def error_px(self) -> tuple[float, float] | None:
        """Found less true."""
        found, true = self.found_px, self.true_px
        return None if found is None or true is None else (found[0] - true[0], found[1] - true[1])

    def to_record(self) -> dict[str, Any]:
        """Return the plain record."""
        return {
            "true_px": self.true_px,
            "found_px": self.found_px,
            "covariance_px2": self.covariance_px2,
            "u_px": None if self.covariance_px2 is None else float(np.sqrt(0.5 * (self.covariance_px2[0] + self.covariance_px2[2]))),
            "error_px": self.error_px,
            "flags": self.flags,
            "reason": self.reason,
        }


def picture_of(layout: Layout, kept: KeptSteps, quiet: bool = False, go_on: Callable[[], None] | None = None) -> Picture:
    """The window of the state's frame; ``quiet``: every temporal draw at its mean; ``go_on`` as of `KeptSteps.window`.

    Raises
    ------
    InputError
        If the target lies outside of the frame, or the camera makes no codes.
    """
    bits, window = stored_bits(layout.camera), layout.window
    codes = kept.window(layout.camera, layout.seen, repr(layout.scene), window, layout.state.seed, quiet, go_on).data[0]
    return Picture(codes.astype(np.uint8 if bits <= 8 else np.uint16), window[0], window[1], bits)


def found_in(picture: Picture, layout: Layout, true_px: tuple[float, float] | None) -> Found:
    """The target in a picture, as ``pixmetry locate`` finds it in the window as a file."""
    if true_px is None:
        return Found(None, reason="the scene has no target")
    try:
        found = locate(picture.codes, estimator=layout.state.estimator, bits=picture.bits)
    except InputError as problem:
        return Found(true_px, reason=str(problem))
    x, y = found.columns["x_px"] + picture.col0, found.columns["y_px"] + picture.row0
    if not len(x):
        return Found(true_px, reason="no target is found in this picture")
    far = np.hypot(x - true_px[0], y - true_px[1])
    k = int(np.argmin(far))
    if far[k] > max(FARTHEST_PX, 0.5 * layout.setting.target.diameter_px):
        return Found(true_px, reason="no target is found near the true place")
    c = found.columns
    covariance = tuple(float(c[name][k]) for name in ("var_x_px2", "cov_xy_px2", "var_y_px2"))
    return Found(true_px, (float(x[k]), float(y[k])), covariance, Flag(int(c["flags"][k])).words())  # type: ignore[arg-type]


def without_chosen(layout: Layout) -> Layout | None:
    """The same without the chosen source, or with an ideal one where no frame is made without; None where none is chosen."""
    name = layout.state.chosen
    if name not in layout.camera or not layout.camera[name].on:
        return None
    return replace(layout, camera=missed(layout.camera, [name]))
