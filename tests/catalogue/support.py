"""The smallest camera around one source, an independent target and an independent estimator, for the contracts of the catalogue."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np

from pixmetry.camera.camera import Camera, Element
from pixmetry.camera.contribution import Probe
from pixmetry.camera.light import Points
from pixmetry.camera.signal import Kind
from pixmetry.camera.source import Parameters, Source
from pixmetry.core.random import Grid

ETA, K_DN_PER_E = 0.5, 0.01  # of the ideal conversions of this module
SHAPE = (48, 64)
NAME = "source under test"


class Nothing(Parameters):
    """No parameter."""


class Amplitude(Parameters):
    """Of a test source of noise."""

    scale: float = 0.0


def make_source(id: str, forward: Any, consumes: tuple[Kind, ...], **kw: Any) -> Source:
    """A source for tests with the least that a record must hold."""
    parameters = kw.pop("parameters", Nothing)
    why = dict.fromkeys(("forward", "measure", "correct", "propagate", "neutral"), "a source for tests")
    text = dict.fromkeys(("title", "description", "equation", "typical_size", "advice"), "a source for tests")
    return Source(
        id=id,
        forward=forward,
        consumes=consumes,
        parameters=parameters,
        typical=parameters(),
        bound=parameters(),
        gum_class="T",
        references=(),
        reasons=why,
        **text,
        **kw,
    )


def _to_codes(params: Nothing, signal: Any, stream: Any) -> Any:
    return signal.with_data(np.clip(np.floor(signal.data + 0.5), 0, 255).astype(np.uint16), Kind.CODES)


IDEAL = {
    Kind.PHOTONS: make_source(
        "sensor.ideal_conversion",
        lambda p, s, _: s.with_data(s.data * np.float32(ETA), Kind.ELECTRONS),
        (Kind.PHOTONS,),
        produces=Kind.ELECTRONS,
    ),
    Kind.ELECTRONS: make_source(
        "electronics.ideal_gain",
        lambda p, s, _: s.with_data(s.data * np.float32(K_DN_PER_E), Kind.DN),
        (Kind.ELECTRONS,),
        produces=Kind.DN,
    ),
    Kind.DN: make_source("grabber.ideal_adc", _to_codes, (Kind.DN,), produces=Kind.CODES),
}
ORDER = (Kind.PHOTONS, Kind.ELECTRONS, Kind.DN, Kind.CODES)
SAMPLED = {Kind.LIGHT: Kind.PHOTONS, Kind.VIDEO: Kind.DN}  # what the camera makes of a kind that is not sampled yet


def lead_in(kind: Kind) -> list[Element]:
    """Ideal conversions from photons up to a kind."""
    kind = SAMPLED.get(kind, kind)
    return [Element(IDEAL[k].id, IDEAL[k], Nothing()) for k in ORDER[: ORDER.index(kind)]]


def kind_of(source: Source) -> Kind:
    """The earliest kind that a source takes."""
    return next(k for k in (Kind.LIGHT, *ORDER, Kind.VIDEO) if k in source.consumes)


def camera_with(
    source: Source, params: Any = None, *, shape: tuple[int, int] = SHAPE, after: Any = (), before: Any = (), **kw: Any
) -> Camera:
    """Ideal conversions up to the kind that the source takes, then the source, its output being the camera's."""
    element = Element(NAME, source, source.typical if params is None else params)
    return Camera("test", shape, (*lead_in(kind_of(source)), *before, element, *after), **kw)


def to_dn(data: np.ndarray, kind: Kind) -> np.ndarray:
    """Bring the output of a chain to DN by the ideal conversions."""
    factor = {Kind.PHOTONS: ETA * K_DN_PER_E, Kind.ELECTRONS: K_DN_PER_E, Kind.DN: 1.0, Kind.CODES: 1.0}
    return data.astype(float) * factor[SAMPLED.get(kind, kind)]


@dataclass(frozen=True)
class Texture:
    """A smooth uneven scene that is a function of the absolute pixel and of the frame, between 20 and 200 DN of the ideal camera."""

    mean_dn: float = 110.0
    contrast: float = 0.8
    moving = True
    smooth_px = 2.0

    def radiance(self, at: Points) -> np.ndarray:
        wave = np.sin(0.31 * at.y_px + 0.7 * (at.frame % 7)) * np.cos(0.23 * at.x_px)
        return self.mean_dn / (ETA * K_DN_PER_E) * (1 + self.contrast * wave)

    def photons(self, grid: Grid, frame_shape: tuple[int, int], exposure_s: np.ndarray, time_s: np.ndarray) -> np.ndarray:
        rows = grid.row0[:, None, None] + np.arange(grid.shape[0])[:, None]
        cols = grid.col0[:, None, None] + np.arange(grid.shape[1])
        wave = np.sin(0.31 * rows + 0.7 * (grid.frame % 7)[:, None, None]) * np.cos(0.23 * cols)
        return (self.mean_dn / (ETA * K_DN_PER_E) * (1 + self.contrast * wave)).astype(np.float32)


@dataclass(frozen=True)
class Flat:
    """The same light everywhere, in DN of the ideal camera."""

    level_dn: float
    smooth_px = 100.0  # no detail that would need many points in a pixel

    def radiance(self, at: Points) -> np.ndarray:
        return np.full(at.x_px.shape, self.level_dn / (ETA * K_DN_PER_E))

    def photons(self, grid: Grid, frame_shape: tuple[int, int], exposure_s: np.ndarray, time_s: np.ndarray) -> np.ndarray:
        return np.full(grid.size, self.level_dn / (ETA * K_DN_PER_E), np.float32)


# ---- a target and an estimator of their own ------------------------------------------------------------------------------------------

HALF = 9  # px from the anchor pixel of a disc to the edge of its tile
SUB = 6  # sub-samples a pixel and axis


@lru_cache(maxsize=1)
def _profile() -> tuple[np.ndarray, np.ndarray]:
    """A disc of 7 px and height 1 under a Gaussian blur of 0.7 px, against radius; the blur is applied to a fine raster, axis by axis."""
    step = 1 / 16
    axis = np.arange(-10, 10 + step / 2, step)
    fine = np.arange(-10, 10 + step / 2, step / 4)
    inside = (fine[:, None] ** 2 + fine[None, :] ** 2 <= 3.5**2).astype(float)
    gauss = np.exp(-((axis[:, None] - fine[None, :]) ** 2) / (2 * 0.7**2))
    gauss /= gauss.sum(axis=1, keepdims=True)
    middle = gauss[len(axis) // 2]
    return axis[len(axis) // 2 :], (gauss @ (inside @ middle))[len(axis) // 2 :]


def disc_tile(dx: float, dy: float) -> np.ndarray:
    """The disc integrated over pixels, its centre at (dx, dy) from that of the middle pixel; shape (2 HALF + 1, 2 HALF + 1)."""
    radius, height = _profile()
    at = np.arange(-HALF * SUB - (SUB - 1) / 2, HALF * SUB + SUB / 2) / SUB
    r = np.hypot(at[:, None] - dy, at[None, :] - dx)
    values = np.interp(r, radius, height, right=0.0)
    n = 2 * HALF + 1
    return values.reshape(n, SUB, n, SUB).mean(axis=(1, 3))


@dataclass(frozen=True)
class Targets:
    """One disc of 150 DN in every frame, on a background of 10 DN of the ideal camera; frame k has its centre at (x[k], y[k])."""

    x_px: np.ndarray
    y_px: np.ndarray
    peak_dn: float = 150.0
    background_dn: float = 10.0
    moving = True
    smooth_px = 0.7

    def radiance(self, at: Points) -> np.ndarray:
        radius, height = _profile()
        r = np.hypot(at.x_px - self.x_px[at.frame], at.y_px - self.y_px[at.frame])
        return (self.background_dn + self.peak_dn * np.interp(r, radius, height, right=0.0)) / (ETA * K_DN_PER_E)

    def photons(self, grid: Grid, frame_shape: tuple[int, int], exposure_s: np.ndarray, time_s: np.ndarray) -> np.ndarray:
        out = np.full(grid.size, self.background_dn, float)
        rows, cols = grid.shape
        for i, frame in enumerate(grid.frame):
            x, y = self.x_px[frame], self.y_px[frame]
            r0, c0 = int(np.rint(y)) - HALF - int(grid.row0[i]), int(np.rint(x)) - HALF - int(grid.col0[i])
            ra, rb, ca, cb = max(r0, 0), min(r0 + 2 * HALF + 1, rows), max(c0, 0), min(c0 + 2 * HALF + 1, cols)
            if ra < rb and ca < cb:
                tile = _tile(float(x - np.rint(x)), float(y - np.rint(y)))
                out[i, ra:rb, ca:cb] += self.peak_dn * tile[ra - r0 : rb - r0, ca - c0 : cb - c0]
        return (out / (ETA * K_DN_PER_E)).astype(np.float32)


_tile = lru_cache(maxsize=4096)(disc_tile)


def soft_centroid(window: np.ndarray, threshold: float) -> tuple[np.ndarray, np.ndarray]:
    """Centroid of max(I − T, 0) in windows (n, rows, cols), in window coordinates."""
    weight = np.maximum(window - threshold, 0.0)
    total = weight.sum(axis=(1, 2))
    y = (weight.sum(axis=2) * np.arange(window.shape[1])).sum(axis=1) / total
    x = (weight.sum(axis=1) * np.arange(window.shape[2])).sum(axis=1) / total
    return x, y


def probe_of(windows_dn: np.ndarray, x: np.ndarray, y: np.ndarray, threshold: float, background: float, shape: tuple[int, int]) -> Probe:
    """The probe of noise-free windows for the soft centroid; its gradient is 1[I > T](x_i − x̂)/Σ(I − T)₊."""
    x_hat, y_hat = soft_centroid(windows_dn, threshold)
    weight = np.maximum(windows_dn - threshold, 0.0)
    share = (weight > 0) / weight.sum(axis=(1, 2), keepdims=True)
    return Probe(
        signal_dn=windows_dn,
        background_dn=background,
        x_px=x,
        y_px=y,
        x_hat_px=x_hat,
        y_hat_px=y_hat,
        gx=share * (np.arange(windows_dn.shape[2]) - x_hat[:, None, None]),
        gy=share * (np.arange(windows_dn.shape[1])[:, None] - y_hat[:, None, None]),
        gain_dn_per_e=K_DN_PER_E,
        exposure_s=0.01,
        temperature_c=20.0,
        bits=8,
        frame_shape=shape,
        locate=lambda changed_dn: soft_centroid(changed_dn, threshold),
    )


def truth_maps(source: Source, params: Any, shape: tuple[int, int], seed: int = 0) -> Mapping[str, np.ndarray]:
    """What an ideal assessment would know of this unit pixel by pixel, from noise-free frames with and without the source."""
    with_it = camera_with(source, params, shape=shape)
    without = camera_with(source, params, shape=shape).switched(off=[NAME])

    def frame(camera: Camera, level: float) -> np.ndarray:
        return camera.expose(Flat(level), quiet=True, seed=seed).data[0].astype(float)

    dark = frame(with_it, 0.0) - frame(without, 0.0)
    response = (frame(with_it, 120.0) - frame(with_it, 0.0)) / (frame(without, 120.0) - frame(without, 0.0))
    spread = 1.4826 * np.median(np.abs(dark - np.median(dark))) + 1e-9
    defects = (np.abs(dark - np.median(dark)) > 8 * spread) | (np.abs(response - np.median(response)) > 0.2)
    return {"dark_dn": dark, "prnu_rel": response / response.mean(), "defects": defects}


def frame_maps(with_it: np.ndarray, without: np.ndarray) -> Mapping[str, np.ndarray]:
    """What an ideal look at these very frames would know of them, shape (n, rows, cols) both: offsets of rows and columns, factors."""
    added, factor = with_it.astype(float) - without, with_it.astype(float) / np.maximum(without, 1e-9)
    return {"row_offset_dn": added.mean(axis=2), "column_offset_dn": added.mean(axis=1), "factor_rel": factor.mean(axis=2)}
