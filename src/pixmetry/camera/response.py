"""The response of a camera to light (OECF, ISO 14524): its curves, and the record of what patches of known light tell of them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from pixmetry.core.arrays import Array
from pixmetry.core.number import Estimates

TOES = {"none": 0.0, "bt709": 0.018}  # share of the reference below which a curve is a straight line
LINEAR, CUBIC, POWER, BT709, LOG, KNEE = CURVES = ("linear", "cubic", "power", "bt709", "log", "knee")
BENT = (POWER, BT709, LOG, KNEE)  # curves that a camera applies on purpose


def toe_shape(gamma: float, toe: str) -> tuple[float, float]:
    """Return α and the slope of the toe: y = α x^γ − (α − 1) above the toe, slope · x in it.

    Value and slope are continuous at the joint β: α = 1/(1 − (1 − γ) β^γ), slope = α γ β^(γ−1). For γ = 0.45 and the toe of ITU-R BT.709,
    β = 0.018, these are 1.09914 and 4.507, which it prints as 1.099 and 4.5. Curves of other toes are the same with another reference: only
    γ and the light at the joint shape them. That of sRGB (IEC 61966-2-1: γ = 1/2.4, β = 0.0030) is this one with 0.448 of its reference.
    """
    beta = TOES[toe]
    if not beta:
        return 1.0, 0.0
    alpha = 1 / (1 - (1 - gamma) * beta**gamma)
    return alpha, alpha * gamma * beta ** (gamma - 1)


def toed_power(share: np.ndarray, gamma: float, toe: str) -> np.ndarray:
    """The curve of a share of the reference, 0 to 1 and above; straight below the toe."""
    alpha, slope = toe_shape(gamma, toe)
    positive = np.maximum(share, 0.0)
    above: Array = alpha * positive**gamma - (alpha - 1)
    return np.where(share < TOES[toe], slope * share, above) if TOES[toe] else above


@dataclass(frozen=True)
class Patch:
    """One patch of a chart, or one part of a scene at one exposure.

    Parameters
    ----------
    picture : int
        In which group of frames it is.
    place : int
        Which patch of the chart, or part of the scene; the same in all pictures.
    x, y, cols, rows : int
        Pixels that were used: the first, and how many.
    light_rel : float
        Known light, in any unit: of a patch that of its density or luminance, of a part of a scene the exposure time.
    mean_dn, u_mean_dn : float
        Mean stored value, and its standard uncertainty by noise, fixed pattern and rounding.
    spread_dn2 : float
        Variance of the values of single pixels in single frames.
    var_dn2, frames : float, int
        Temporal variance of a pixel; NaN of a single frame.
    """

    picture: int
    place: int
    x: int
    y: int
    cols: int
    rows: int
    light_rel: float
    mean_dn: float
    u_mean_dn: float
    spread_dn2: float
    var_dn2: float
    frames: int


@dataclass(frozen=True)
class CurveFit:
    """One curve, fitted to all patches: χ², its degrees of freedom, and BIC, by which curves are compared."""

    curve: str
    chi2: float
    dof: int
    bic: float


@dataclass(frozen=True)
class Response:
    """What patches of known light tell of the response.

    Parameters
    ----------
    patches : tuple of Patch
    refused : tuple of str
        Why other patches, or whole pictures, were not used.
    curve : str
        One of `CURVES`; empty if none could be fitted.
    tried : tuple of CurveFit
        The chosen one first.
    level_dn, light_rel, u_light_rel : ndarray, shape (points,)
        The curve: stored values, the light that they stand for (1 for the brightest patch), and its relative standard uncertainty.
    gain_dn_per_e : ndarray, shape (points,)
        Local gain dy/dN from the noise at these levels; NaN where the noise does not tell it.
    fit : Estimates
        Parameters of the curve with their covariance. ``reasons`` tell what is missing.
    choices : mapping
        By source, the setting that is a name: the toe of a curve, the mode of a knee.
    notes : tuple of str
    """

    patches: tuple[Patch, ...]
    refused: tuple[str, ...]
    curve: str = ""
    tried: tuple[CurveFit, ...] = ()
    level_dn: np.ndarray = field(default_factory=lambda: np.zeros(0))
    light_rel: np.ndarray = field(default_factory=lambda: np.zeros(0))
    u_light_rel: np.ndarray = field(default_factory=lambda: np.zeros(0))
    gain_dn_per_e: np.ndarray = field(default_factory=lambda: np.zeros(0))
    fit: Estimates = field(default_factory=Estimates.empty)
    choices: Mapping[str, Mapping[str, str]] = field(default_factory=dict)
    notes: tuple[str, ...] = ()

    @property
    def is_bent(self) -> bool:
        """Whether the camera applies a curve, so that codes are not in proportion to light."""
        return self.curve in BENT

    @property
    def pictures(self) -> int:
        """How many pictures have patches."""
        return len({p.picture for p in self.patches})
