"""How noisy a grey value is: the variance that weights a fit, and the ends of the scale at which values pile up."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from pixmetry.core.errors import InputError
from pixmetry.locate._noise_kernels import Noise, variances_dn2
from pixmetry.locate.centroids.estimators import split_text

ROUNDING_DN2 = 1 / 12  # variance of rounding to whole numbers
LEAST_DN2 = 1e-12  # a noise model without noise still weights all pixels alike
KEYS = {"read": "read_dn", "gain": "slope_dn", "prnu": "pattern_rel", "dsnu": "pattern_dn", "black": "black_dn", "bits": "bits"}


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
    slope_clear : bool
        Whether the slope is shot noise for certain; False where an image had so few pixels to tell it that it may be a shape that does not
        fit.
    row_shift_px, field_shift_px : float
        Standard deviation of the shift of each row along x by itself (line jitter), and of what neighbouring rows of a field share.

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
    slope_clear: bool = True
    row_shift_px: float = 0.0
    field_shift_px: float = 0.0

    def __post_init__(self) -> None:
        for name in ("constant_dn2", "slope_dn", "pattern_rel", "row_shift_px", "field_shift_px"):
            value = getattr(self, name)
            if not (np.isfinite(value) and value >= 0):
                raise InputError(f"{name} cannot be used", where="noise", value=value, allowed="0 or more")
        if not np.isfinite(self.black_dn) or not self.low_dn < self.high_dn:
            raise InputError(
                "the scale of grey values is upside down", where="noise", value=(self.low_dn, self.high_dn), allowed="low_dn < high_dn"
            )

    def variance_dn2(self, level_dn: np.ndarray | float) -> np.ndarray:
        """Return the variance at given mean grey values; same shape, DN²."""
        return variances_dn2(np.maximum(np.asarray(level_dn, float) - self.black_dn, 0.0), self)

    def numbers(self, dtype: np.dtype | None = None) -> Noise:
        """Return the model as kernels read it; the range of an integer type, where one is given, ends the scale too."""
        low, high = float(self.low_dn), float(self.high_dn)
        if dtype is not None and np.issubdtype(dtype, np.integer):
            low, high = max(low, float(np.iinfo(dtype).min)), min(high, float(np.iinfo(dtype).max))
        law = max(float(self.constant_dn2), LEAST_DN2), float(self.slope_dn), float(self.pattern_rel), float(self.black_dn)
        return Noise(*law, low, high, float(self.row_shift_px) ** 2, float(self.field_shift_px) ** 2)

    def describe(self) -> str:
        """Say it in words."""
        text = f"{self.origin}: variance {self.constant_dn2:.4g} DN²"
        if self.slope_dn:
            text += f" + {self.slope_dn:.4g} DN per DN of light above {self.black_dn:.4g}"
        if self.pattern_rel:
            text += f", sensitivities ±{self.pattern_rel:.2%}"
        if self.row_shift_px or self.field_shift_px:
            text += f"; rows shifted against each other by {np.hypot(self.row_shift_px, self.field_shift_px):.2g} px"
        return text


def parse_noise(text: str, rounded: bool = True) -> tuple[NoiseModel, float]:
    """Read a noise model from ``key=number,…``, as in ``read=1.5,gain=0.01,black=16,bits=8``.

    ``read`` is the standard deviation without light in DN, without rounding; ``gain`` is K in DN per electron; ``prnu`` and ``dsnu`` are
    the spreads of sensitivities (relative) and offsets (DN); ``black`` is the grey value without light; ``bits`` say where the scale ends.

    Returns
    -------
    NoiseModel
        Rounding (1/12 DN²) added to the constant if the values are ``rounded``.
    float
        ``dsnu`` in DN, which is not in the model.

    Raises
    ------
    InputError
        If a key or number cannot be used.
    """
    _, values = split_text(":" + text, KEYS, "noise")
    read, pattern, bits = values.pop("read_dn", 0.0), values.pop("pattern_dn", 0.0), values.pop("bits", None)
    if read < 0:
        raise InputError("the read noise cannot be used", where="noise", value=read, allowed="0 or more")
    if bits is not None and (bits != int(bits) or not 1 <= bits <= 32):
        raise InputError("the bits cannot be used", where="noise", value=bits, allowed="1 to 32")
    if bits is not None:
        values |= {"low_dn": 0.0, "high_dn": 2.0 ** int(bits) - 1}
    told: dict[str, Any] = dict(values)
    return NoiseModel(read**2 + (ROUNDING_DN2 if rounded else 0.0), **told), pattern
