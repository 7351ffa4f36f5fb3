"""Disc targets, blurred by the optics and integrated over each pixel; only what a window needs is rendered."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from pixmetry.camera.light import Points
from pixmetry.core.arrays import Array, Singles
from pixmetry.core.errors import ParameterError
from pixmetry.core.random import Grid
from pixmetry.scene._kernels import add_discs, see_discs
from pixmetry.scene.motion import Motion
from pixmetry.scene.shapes import Shapes
from pixmetry.scene.uniform import Uniform

REACH = 5.0  # blur standard deviations beyond which a disc's edge is taken as 0 (2.9e-7 of its height)
STEP = 1 / 256  # px: spacing of the radial profile; linear interpolation is good to 1e-5 of the height down to the smallest blur
SMALLEST_BLUR_PX = 0.05
FEW = 8  # discs in a frame that every point looks at, rather than at those near it


@lru_cache(maxsize=64)
def radial_profile(diameter_px: float, blur_px: float) -> np.ndarray:
    """A disc of height 1 convolved with a round Gaussian, against radius at spacing `STEP`.

    The convolution at distance ρ is ∫₀^R (r/s²) exp(−(r² + ρ²)/2s²) I₀(rρ/s²) dr (polar form of the two-dimensional integral; known as
    1 − Q₁, Marcum's function): here by the non-central χ² distribution with two degrees of freedom.
    """
    from scipy.special import chndtr

    radius = 0.5 * diameter_px
    rho = np.arange(0.0, radius + REACH * blur_px + 1.0 + 2 * STEP, STEP)
    profile: Array = chndtr((radius / blur_px) ** 2, 2, np.maximum((rho / blur_px) ** 2, 1e-300))
    return profile


@dataclass(frozen=True)
class Discs:
    """Bright (or dark) discs on a background, standing still or with one place per frame.

    Parameters
    ----------
    x_px, y_px : array_like, shape (k,), or (frames, k) with ``per_frame``
        Centres in absolute pixels.
    diameter_px, blur_px : float
        Diameter of the sharp disc, and standard deviation of the Gaussian blur of the optics (at least 0.05 px).
    peak_photons : float or array_like, shape (k,)
        Height above the background, in photons per pixel and exposure (negative for a dark disc).
    background : Uniform
    per_frame : bool
        The first axis of the centres is the frame number (beyond its end it repeats).
    """

    x_px: np.ndarray
    y_px: np.ndarray
    diameter_px: float = 7.0
    blur_px: float = 0.7
    peak_photons: float = 1000.0
    background: Uniform = field(default_factory=Uniform)
    per_frame: bool = False

    def __post_init__(self) -> None:
        for name in ("x_px", "y_px"):
            object.__setattr__(self, name, np.atleast_1d(np.asarray(getattr(self, name), float)))
        if self.x_px.shape != self.y_px.shape or not (np.isfinite(self.x_px).all() and np.isfinite(self.y_px).all()):
            raise ParameterError("the centres of the discs are not usable", where="discs", allowed="finite x_px and y_px, equally many")
        if not (0 < self.diameter_px <= 1000 and SMALLEST_BLUR_PX <= self.blur_px <= 100):
            raise ParameterError(
                "a disc cannot be rendered",
                where="discs",
                value={"diameter_px": self.diameter_px, "blur_px": self.blur_px},
                allowed=f"diameter 0 to 1000 px, blur {SMALLEST_BLUR_PX} to 100 px",
            )

    def centres(self, frame: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Centres in each of these frames, shape (n, k) each."""
        if self.per_frame:
            x, y = (v.reshape(len(v), -1)[frame % len(v)] for v in (self.x_px, self.y_px))
        else:
            x, y = (np.broadcast_to(v.ravel(), (len(frame), v.size)) for v in (self.x_px, self.y_px))
        return x, y

    def photons(self, grid: Grid, frame_shape: tuple[int, int], exposure_s: np.ndarray, time_s: np.ndarray) -> np.ndarray:
        """Photons per pixel, shape (n, rows, cols), float32."""
        out = self.background.photons(grid, frame_shape, exposure_s, time_s).copy()
        profile = radial_profile(float(self.diameter_px), float(self.blur_px))
        outer = 0.5 * self.diameter_px + REACH * self.blur_px
        inner = max(0.0, 0.5 * self.diameter_px - REACH * self.blur_px)
        x, y = self.centres(grid.frame)
        touches = (
            (x > grid.col0[:, None] - outer - 1)
            & (x < grid.col0[:, None] + grid.shape[1] + outer)
            & (y > grid.row0[:, None] - outer - 1)
            & (y < grid.row0[:, None] + grid.shape[0] + outer)
        )
        entry, which = np.nonzero(touches)
        scale = self.background.photons_scale(exposure_s)
        peak = np.broadcast_to(np.asarray(self.peak_photons, float), (x.shape[1],))[which] * scale[entry]
        split = 1 if self.blur_px >= 0.5 else int(np.ceil(0.5 / self.blur_px))
        add_discs(out, x[entry, which], y[entry, which], entry, grid.row0, grid.col0, profile, STEP, inner, outer, peak, split)
        light: Singles = np.maximum(out, 0, out=out)
        return light

    @property
    def moving(self) -> bool:
        """Whether the centres change from frame to frame."""
        return self.per_frame

    @property
    def smooth_px(self) -> float:
        """Own blur of the discs."""
        return self.blur_px

    def radiance(self, at: Points) -> np.ndarray:
        """Photons per pixel at points, float64."""
        return self.averaged(at, np.float64(0), np.float64(0))

    def averaged(self, at: Points, width_px: ArrayLike, height_px: ArrayLike) -> np.ndarray:
        """The same, averaged over an upright box of this size about each point."""
        exposure = np.broadcast_to(np.asarray(at.exposure_s, float), at.x_px.shape)
        scale = self.background.photons_scale(exposure.ravel()).reshape(exposure.shape)
        width, height = (np.broadcast_to(v, at.x_px.shape) for v in (width_px, height_px))
        out = self.background.radiance(at)
        blur = float(np.hypot(self.blur_px, at.blur_px))
        if self._count <= FEW and max(np.max(width, initial=0.0), np.max(height, initial=0.0)) <= 2 * blur:
            out = out + scale * self._few(at, width, height, blur)
        else:
            for shapes, which in self._seen(at):
                out[which] += scale[which] * shapes.sums(at.take(which), width[which], height[which], False)[0]
        light: Array = np.maximum(out, 0.0)
        return light

    @property
    def _count(self) -> int:
        """How many discs there are in a frame."""
        return self.x_px.size // (len(self.x_px) if self.per_frame else 1)

    def _few(self, at: Points, width: np.ndarray, height: np.ndarray, blur_px: float) -> np.ndarray:
        """Light of a few discs by their radial profile."""
        count = self._count
        cx, cy = (np.ascontiguousarray(v.reshape(-1, count)) for v in (self.x_px, self.y_px))
        row = np.broadcast_to(at.frame, at.x_px.shape).ravel() % len(cx)
        peak = np.array(np.broadcast_to(np.asarray(self.peak_photons, float), count))
        out = np.zeros(at.x_px.size)
        outer = 0.5 * self.diameter_px + REACH * blur_px
        x, y, wide, high = (np.ascontiguousarray(v, float).ravel() for v in (at.x_px, at.y_px, width, height))
        see_discs(out, x, y, wide, high, row, cx, cy, peak, radial_profile(float(self.diameter_px), blur_px), STEP, outer, blur_px)
        return out.reshape(at.x_px.shape)

    def detailed(self, at: Points, reach_px: ArrayLike) -> np.ndarray:
        """Where an edge may be seen within a reach of each point."""
        out, reach = np.zeros(at.x_px.shape, bool), np.broadcast_to(reach_px, at.x_px.shape)
        for shapes, which in self._seen(at):
            out[which] = shapes.detailed(at.take(which), reach[which])
        return out

    def targets(self, time_s: float = 0.0, frame: int = 0) -> list[dict[str, Any]]:
        """True places of the discs in a frame."""
        x, y = self.centres(np.array([frame]))
        places = zip(x[0], y[0], strict=True)
        return [{"kind": "disc", "x_px": float(a), "y_px": float(b), "diameter_px": self.diameter_px} for a, b in places]

    def layer(self, motion: Motion) -> Shapes:
        """The discs of one frame without their background, as shapes that move."""
        x, y = self.centres(np.zeros(1, np.int64))
        return replace(self._shapes(x, y, motion), told=self.targets())

    def _seen(self, at: Points) -> list[tuple[Shapes, Any]]:
        """Discs with the points that see them; one disc a frame is a disc that moves."""
        if not self.per_frame:
            return [(self._still, ...)]
        if self._count == 1:
            return [(self._one, ...)]
        frame = np.broadcast_to(at.frame, at.x_px.shape)
        return [(self._shapes(*self.centres(np.array([f]))), frame == f) for f in np.unique(frame)]

    @cached_property
    def _still(self) -> Shapes:
        return self._shapes(*self.centres(np.zeros(1, np.int64)))

    @cached_property
    def _one(self) -> Shapes:
        zero = np.zeros((1, 1))
        return self._shapes(zero, zero, Motion(table_px=np.stack([self.x_px.ravel(), self.y_px.ravel()], axis=1)))

    def _shapes(self, x: np.ndarray, y: np.ndarray, motion: Motion | None = None) -> Shapes:
        radius, zero = np.full(x.size, 0.5 * self.diameter_px), np.zeros(x.size)
        oval = np.stack([x.ravel(), y.ravel(), radius, zero, zero, radius], axis=1)
        peak = np.broadcast_to(np.asarray(self.peak_photons, float), x.size)
        return Shapes.of_ovals(oval, peak, self.blur_px, motion or Motion())
