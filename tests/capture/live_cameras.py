"""A camera in the process: electrons by Poisson's law, faults where they are wanted, and an operator who does as asked."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from pixmetry.capture.camera import Grabbed

GAIN_DN_PER_E, BLACK_DN, DARK_NOISE_E, RATE_E_PER_S = 0.25, 60.0, 8.0, 1.6e6
SHAPE = (48, 64)


class LiveDouble:
    """A 12-bit camera; ``faults`` says by the counter of all frames that it ever sent what is wrong with one."""

    name, serial_number, bits, sets_exposure, exposure_range_s = "double", "0042", 12, True, (1e-5, 1.0)

    def __init__(self, rng: np.random.Generator, faults: Mapping[int, str] | None = None, flicker_rel: float = 0.0) -> None:
        self.rng, self.faults, self.flicker_rel = rng, dict(faults or {}), flicker_rel
        self.capped, self.exposure_s, self.sent, self.number = False, 0.01, 0, 0
        self.kept: list[np.ndarray] = []  # every good frame that was sent in a run
        self.latest: Grabbed | None = None
        self.after: Callable[[int], None] = lambda sent: None
        self.period_s = 0.02

    def set_exposure(self, exposure_s: float) -> float:
        self.exposure_s = exposure_s
        return exposure_s

    def start(self) -> None:
        self.number, self.latest = 0, None

    def stop(self) -> None:
        pass

    def close(self) -> None:
        pass

    def picture(self) -> np.ndarray:
        light = 0.0 if self.capped else RATE_E_PER_S * self.exposure_s * (1 + self.flicker_rel * self.rng.normal())
        electrons = self.rng.poisson(light, SHAPE) + self.rng.normal(0, DARK_NOISE_E, SHAPE)
        return np.clip(np.rint(BLACK_DN + GAIN_DN_PER_E * electrons), 0, 4095).astype(np.uint16)

    def frame(self, timeout_s: float) -> Grabbed | None:
        self.sent += 1
        self.after(self.sent)
        fault = self.faults.get(self.sent, "")
        if fault.startswith("lost"):
            self.number += int(fault[4:] or 1)
        self.number += 1
        told: dict[str, Any] = {"number": self.number, "time_s": 100 + self.period_s * self.number, "temperature_c": 31.5}
        if fault == "doubled" and self.latest is not None:
            self.number -= 1
            return self.latest
        if fault == "copied" and self.latest is not None:
            return Grabbed(self.latest.array, **told)
        if fault == "incomplete":
            return Grabbed(None, complete=False, why="packets are missing")
        if fault == "short":
            return Grabbed(self.picture()[:-3], **told)
        if fault == "wild":
            return Grabbed(self.picture() | np.uint16(0x8000), **told)
        if fault == "silent":
            self.number -= 1
            return None
        array = self.picture()
        self.kept.append(array)
        self.latest = Grabbed(array, **told)
        return self.latest


class Obedient:
    """An operator who caps and uncaps the lens as asked."""

    def __init__(self, camera: Any, numbers: Mapping[str, float] | None = None) -> None:
        self.camera, self.numbers = camera, dict(numbers or {})
        self.asked: list[str] = []

    def ready(self, what: str) -> None:
        self.asked.append(what)
        self.camera.capped = what.startswith("Cap ")

    def number(self, key: str, what: str) -> float:
        return self.numbers[key]
