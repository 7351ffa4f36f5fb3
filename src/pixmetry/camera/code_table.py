"""Tables of codes for transport in fewer bits: what becomes of each code, and how wide its steps are."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pixmetry.core.arrays import Array

OFF, TRUNCATED, LINEAR, ROOT = "off", "truncated", "linear", "root"


@dataclass(frozen=True)
class CodeTable:
    """A law of companding, the bits of the codes, and those during transport."""

    law: str
    bits: int
    transport_bits: int

    def entries(self) -> np.ndarray:
        """What becomes of each code, uint16, shape (2^bits,)."""
        code = np.arange(2**self.bits)
        lost = self.bits - self.transport_bits
        if self.law == OFF or (lost <= 0 and self.law != ROOT):
            return code.astype(np.uint16)
        if self.law == TRUNCATED:
            return (code >> lost << lost).astype(np.uint16)
        top, way = 2**self.bits - 1, 2**self.transport_bits - 1
        power = 0.5 if self.law == ROOT else 1.0
        sent = np.floor(way * (code / top) ** power + 0.5)
        return np.floor(top * (sent / way) ** (1 / power) + 0.5).astype(np.uint16)

    def step_dn(self, level_dn: np.ndarray) -> np.ndarray:
        """Width of the step at a level: the inverse of the curve's slope, at least 1."""
        top, way = 2.0**self.bits - 1, 2.0**self.transport_bits - 1
        if self.law == OFF:
            return np.ones_like(level_dn)
        if self.law == ROOT:
            step: Array = np.maximum(2 * np.sqrt(np.maximum(level_dn, 0) * top) / way, 1.0)
            return step
        if self.law == TRUNCATED:
            return np.full_like(level_dn, 2.0 ** max(self.bits - self.transport_bits, 0))
        return np.full_like(level_dn, max(top / way, 1.0))
