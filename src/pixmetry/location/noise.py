"""How noisy a grey value is: the variance that weights a fit, and the ends of the scale at which values pile up."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pixmetry.core.errors import InputError


@dataclass(frozen=True)
class NoiseModel:
    """Temporal variance of a pixel as a function of its mean grey value, and the scale's ends.

    ``variance = constant_dn2 + slope_dn · s + (pattern_rel · s)²`` with ``s = max(level − black_dn, 0)``.

    Parameters
    ----------
    constant_dn2 : float
        Variance without light in DN², rounding (1/12) included.
    slope_dn : float
        Variance per DN of light: the gain K in DN per electron (EMVA 1288, photon transfer).
    pattern_rel : float
        Standard deviation of the pixels' sensitivity (PRNU), where it is to count as noise.
    black_dn : float
        Grey value without light.
    low_dn, high_dn : float
        Grey values at which the scale ends: what lies beyond is stored as this.
    origin : str
        Where it is from: "camera", "image", or "given".

    Raises
    ------
    InputError
        If a variance is negative or not finite, or the scale's ends are not in order.
    """

    constant_dn2: float
    slope_dn: float = 0.0
    pattern_rel: float = 0.0
    black_dn: float = 0.0
    low_dn: float = -np.inf
    high_dn: float = np.inf
    origin: str = "given"

    def __post_init__(self) -> None:
        for name in ("constant_dn2", "slope_dn", "pattern_rel"):
            value = getattr(self, name)
            if not (np.isfinite(value) and value >= 0):
                raise InputError(f"{name} cannot be used", where="noise", value=value, allowed="0 or more")
        if not np.isfinite(self.black_dn) or not self.low_dn < self.high_dn:
            raise InputError(
                "the scale of grey values is upside down", where="noise", value=(self.low_dn, self.high_dn), allowed="low_dn < high_dn"
            )

    def variance_dn2(self, level_dn: np.ndarray | float) -> np.ndarray:
        """Return the variance at given mean grey values; same shape, DN²."""
        light = np.maximum(np.asarray(level_dn, float) - self.black_dn, 0.0)
        return self.constant_dn2 + self.slope_dn * light + (self.pattern_rel * light) ** 2

    def describe(self) -> str:
        """Say it in words."""
        text = f"{self.origin}: variance {self.constant_dn2:.4g} DN²"
        if self.slope_dn:
            text += f" + {self.slope_dn:.4g} DN per DN of light above {self.black_dn:.4g}"
        if self.pattern_rel:
            text += f", sensitivities ±{self.pattern_rel:.2%}"
        return text
