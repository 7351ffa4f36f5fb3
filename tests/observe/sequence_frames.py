"""Frames in a row by a camera written here without the package: a gain or an exposure that follows the scene, a lamp, hum, 1/f noise."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pixmetry import Frames
from pixmetry.camera.group_facts import GroupFacts


@dataclass(frozen=True)
class Scene:
    """What the frames show: ``patch`` is its light over that of the rest, 0 for none; ``period`` the frames of its coming and going."""

    patch: float = 2.0
    period: int = 10
    contrast: float = 0.6
    shape: tuple[int, int] = (96, 128)

    def light(self, frame: int) -> np.ndarray:
        """Light of a frame, over that of its brightest part that stays."""
        y, x = np.mgrid[: self.shape[0], : self.shape[1]]
        still = 1 - self.contrast * (0.5 + 0.25 * np.sin(x / 9.0) + 0.25 * np.cos(y / 7.0))
        if self.patch and (frame // (self.period // 2)) % 2:
            still[self.shape[0] // 4 : 3 * self.shape[0] // 4, self.shape[1] // 4 : 3 * self.shape[1] // 4] *= self.patch
        return still


@dataclass(frozen=True)
class Loop:
    """A loop that is linear in decibels; ``exposes``: the exposure follows, and the gain stays."""

    kappa: float = 0.3
    target_dn: float = 700.0
    lowest: float = 0.0
    highest: float = np.inf
    exposes: bool = False
    delay: int = 1


@dataclass(frozen=True)
class Lamp:
    """A sine about its mean, in frames of a period, with rows that are read one after the other."""

    depth: float = 0.0
    hertz: float = 100.0
    phase: float = 0.7
    noise: float = 0.0


@dataclass(frozen=True)
class Body:
    """The rest of the camera."""

    gain: float = 0.4
    read_e: float = 8.0
    behind_dn: float = 0.5
    black: float = 32.0
    prnu: float = 0.01
    bits: int = 12
    exposure_s: float = 0.004
    period_s: float = 0.04
    row_s: float = 0.0
    black_wander_dn: float = 0.0
    hum_dn: float = 0.0
    hum_hertz: float = 350.0
    light_e: float = 3000.0


def sequence(
    rng: np.random.Generator,
    frames: int,
    loop: Loop | None = None,
    lamp: Lamp | None = None,
    body: Body | None = None,
    scene: Scene | None = None,
) -> np.ndarray:
    """Stored values, shape (frames, rows, cols)."""
    loop, lamp, body, scene = loop or Loop(kappa=0.0), lamp or Lamp(), body or Body(), scene or Scene()
    rows, cols = scene.shape
    pattern = 1 + body.prnu * rng.standard_normal(scene.shape)
    factor, out, seen = min(max(1.0, loop.lowest), loop.highest), [], []
    row = np.arange(rows)
    for k in range(frames):
        start = k * body.period_s + row * body.row_s
        angle = 2 * np.pi * lamp.hertz * (start + body.exposure_s / 2) + lamp.phase
        lit = 1 + lamp.depth * np.sinc(lamp.hertz * body.exposure_s) * np.cos(angle) + lamp.noise * rng.standard_normal()
        gain, exposed = (1.0, factor) if loop.exposes else (factor, 1.0)
        electrons = rng.poisson(body.light_e * exposed * scene.light(k) * pattern * lit[:, None]) + body.read_e * rng.standard_normal(
            scene.shape
        )
        signal = body.gain * gain * electrons
        hum = body.hum_dn * np.sin(2 * np.pi * body.hum_hertz * start + 1.3)
        dn = (
            signal
            + hum[:, None]
            + body.black
            + body.black_wander_dn * rng.standard_normal()
            + body.behind_dn * rng.standard_normal(scene.shape)
        )
        out.append(np.rint(np.clip(dn, 0, 2**body.bits - 1)).astype(np.uint16))
        seen.append(float(signal.mean()))
        if len(seen) >= loop.delay and loop.kappa:
            factor = float(np.clip(factor * (loop.target_dn / seen[-loop.delay]) ** loop.kappa, loop.lowest, loop.highest))
    return np.array(out)


def dark_frames(rng: np.random.Generator, frames: int, body: Body | None = None, shape: tuple[int, int] = (96, 128)) -> np.ndarray:
    """Dark frames in a row."""
    return _dark(rng, frames, body or Body(), shape)


def _dark(rng: np.random.Generator, frames: int, body: Body, shape: tuple[int, int]) -> np.ndarray:
    start = np.arange(frames)[:, None] * body.period_s + np.arange(shape[0]) * body.row_s
    hum = body.hum_dn * np.sin(2 * np.pi * body.hum_hertz * start + 0.4)
    noise = np.hypot(body.gain * body.read_e, body.behind_dn) * rng.standard_normal((frames, *shape))
    return np.rint(np.clip(body.black + hum[:, :, None] + noise, 0, 2**body.bits - 1)).astype(np.uint16)


def flats(rng: np.random.Generator, body: Body | None = None, shape: tuple[int, int] = (96, 128)) -> list[Frames]:
    """Dark and bright levels with the gain locked, and a stack of each."""
    body = body or Body()
    out = []
    for k in range(1, 11):
        light = np.full((2, *shape), 0.95 * (2**body.bits - 1 - body.black) / body.gain * k / 10)
        dn = (
            body.black
            + body.gain * (rng.poisson(light) + body.read_e * rng.standard_normal(light.shape))
            + body.behind_dn * rng.standard_normal(light.shape)
        )
        out.append(Frames("bright", 0.001 * k, np.rint(np.clip(dn, 0, 2**body.bits - 1)).astype(np.uint16)))
        out.append(Frames("dark", 0.001 * k, _dark(rng, 2, body, shape)))
    return out


def taken(data: np.ndarray, body: Body | None = None, **facts) -> Frames:
    """The group of a sequence."""
    body = body or Body()
    return Frames("sequence", body.exposure_s, data, facts=GroupFacts(**({"interval_s": body.period_s} | facts)))
