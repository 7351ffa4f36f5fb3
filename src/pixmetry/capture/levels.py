"""Levels of the frames while they are taken: black level, saturation, evenness, and light that changes from frame to frame."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from pixmetry.core.finding import WARNING, Finding

BLOCKS = 8  # along each side of a frame
CUT_SHARE = 1e-3  # of the pixels of a dark frame that may be 0
FULL_SHARE = 1e-3  # of the pixels of a bright frame that may be at the top
LEAK_REL = 0.25  # of the scale: a dark frame as bright as that is not dark
EVEN_REL = 0.03  # EMVA 1288 Release 4.0, section 6.2: variation of the light over the sensor
FLICKER_REL = 1e-3  # of the light, from which on flicker is told
CHANCE = 1e-6  # of a false alarm of flicker, for each group


@dataclass(frozen=True)
class Level:
    """One frame: ``mean_dn``; shares of pixels at 0 and at the top; ``high_dn``, above which is a thousandth of the pixels; ``blocks`` are
    means of its parts, shape (8, 8)."""

    mean_dn: float
    zero: float
    full: float
    high_dn: float
    blocks: np.ndarray

    @classmethod
    def of(cls, frame: np.ndarray, bits: int) -> Level:
        """The level of a frame of integers."""
        counts = np.bincount(frame.ravel(), minlength=1 << bits)
        total = np.cumsum(counts)
        high = int(np.searchsorted(total, math.ceil(0.999 * frame.size)))
        rows, cols = (np.linspace(0, n, BLOCKS + 1).astype(int)[:-1] for n in frame.shape)
        sums = np.add.reduceat(np.add.reduceat(frame, rows, axis=0, dtype=np.int64), cols, axis=1)
        sizes = np.outer(np.diff([*rows, frame.shape[0]]), np.diff([*cols, frame.shape[1]]))
        zero, full = (float(counts[at] / frame.size) for at in (0, (1 << bits) - 1))
        return cls(float(sums.sum() / frame.size), zero, full, float(high), sums / sizes)


class GroupLevels:
    """Levels of the frames of one group, and what is wrong with them.

    Parameters
    ----------
    kind : str
        Of the group, as in a manifest.
    bits : int
    to_the_top : bool
        Whether its frames may be saturated: the last of a photon-transfer series, and spots.
    black_dn : float, optional
        Mean of dark frames, if it is known; only what is above it is light.
    """

    def __init__(self, kind: str, bits: int, *, to_the_top: bool = False, black_dn: float | None = None) -> None:
        self.kind, self.bits, self.to_the_top, self.black_dn = kind, bits, to_the_top, black_dn
        self.levels: list[Level] = []
        self._latest: np.ndarray | None = None
        self._variance: list[float] = []  # of a pixel in time, from differences of neighbours in time

    def add(self, frame: np.ndarray) -> Level:
        """Take a frame."""
        level = Level.of(frame, self.bits)
        if self._latest is not None and self._latest.shape == frame.shape:
            difference = frame.astype(np.int32) - self._latest
            self._variance.append(0.5 * float(difference.var()))
        self._latest = frame
        self.levels.append(level)
        return level

    @property
    def mean_dn(self) -> float:
        """Mean of all frames; NaN without any."""
        return float(np.mean([level.mean_dn for level in self.levels])) if self.levels else math.nan

    @property
    def flicker(self) -> tuple[float, float]:
        """Scatter of the light from frame to frame beyond the pixels' noise, over the light; and the chance of it without flicker."""
        from scipy.special import gammaincc

        means = np.array([level.mean_dn for level in self.levels])
        light = float(means.mean()) - (self.black_dn or 0.0) if means.size else 0.0
        if means.size < 2 or not self._variance or light <= 0 or self._latest is None:
            return math.nan, 1.0
        scatter, noise = float(means.var(ddof=1)), float(np.mean(self._variance)) / self._latest.size
        dof = means.size - 1
        chance = float(gammaincc(0.5 * dof, 0.5 * dof * scatter / noise)) if noise > 0 else 0.0 if scatter > 0 else 1.0
        return math.sqrt(max(scatter - noise, 0.0)) / light, chance

    @property
    def uneven_rel(self) -> float:
        """Half of the range of the parts' light over its mean; NaN without light."""
        blocks = np.mean([level.blocks for level in self.levels], axis=0) - (self.black_dn or 0.0)
        mean = float(blocks.mean())
        return float(np.ptp(blocks)) / (2 * mean) if mean > 0 else math.nan

    def findings(self) -> list[Finding]:
        """What is wrong with the levels so far."""
        if not self.levels:
            return []
        top, found = (1 << self.bits) - 1, []
        zero, full = (float(np.mean([getattr(level, name) for level in self.levels])) for name in ("zero", "full"))

        def warn(kind: str, text: str, advice: str, **numbers: float) -> None:
            found.append(Finding(kind, text, advice, WARNING, numbers))

        if self.kind in ("dark", "dark_temperature"):
            if zero > CUT_SHARE:
                warn("black_cut", f"{100 * zero:.2g} % of the dark pixels are 0.", "Raise the camera's black level.", share=zero)
            if self.mean_dn > LEAK_REL * top:
                warn("light_leak", f"Dark frames have a mean of {self.mean_dn:.4g} DN.", "Cap the lens.", mean_dn=self.mean_dn)
            return found
        if full > FULL_SHARE and not self.to_the_top:
            warn("saturated", f"{100 * full:.2g} % of the pixels are at the top.", "Lower exposure, light or gain.", share=full)
        if self.kind != "bright":
            return found
        size, chance = self.flicker
        if size > FLICKER_REL and chance < CHANCE and full < 0.5:
            warn(
                "flicker",
                f"The light changes by {100 * size:.2g} % from frame to frame.",
                "Use a lamp on direct current.",
                flicker_rel=size,
            )
        if self.uneven_rel > EVEN_REL and full < 0.5:
            text = f"The light varies by {100 * self.uneven_rel:.2g} % over the frame; EMVA 1288 asks for {100 * EVEN_REL:g} %."
            warn("uneven", text, "Take the lens off, or an integrating sphere.", uneven_rel=self.uneven_rel)
        return found
