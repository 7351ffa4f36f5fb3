"""All values of one release from one measurement: the same formulas for the measured values and for any number of draws."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from pixmetry.core.arrays import Array
from pixmetry.core.errors import MeasureError, PixmetryError
from pixmetry.emva.files.keys import KEYS, OVER_TEMPERATURES
from pixmetry.emva.general.general import general_evaluation
from pixmetry.emva.general.general_model import Plan, make_plan
from pixmetry.emva.linear_model import is_curved, is_level_free, level_free_values
from pixmetry.emva.records import Measurement, Series
from pixmetry.emva.series import light_of, series_of
from pixmetry.emva.spatial.spatial import snr_total_max, spatial_evaluation
from pixmetry.emva.spatial.spatial_inputs import SpatialInputs
from pixmetry.emva.temporal import dark_line, temporal_values

Values = dict[str, Array]
DARK_VARIANCE = "dark_variance"  # at zero exposure, DN², not held at its least


@dataclass(frozen=True)
class Formulas:
    """One release, applied to one measurement. ``missing`` says by section why its values cannot be had."""

    release: str
    series: Series
    pixel_area_um2: float | None
    stacks: tuple[SpatialInputs, SpatialInputs] | None  # dark, bright
    missing: dict[str, str]
    curved: bool = False  # no linear camera: only General and what is in codes can be had

    @classmethod
    def of(cls, m: Measurement, release: str) -> Formulas:
        """Prepare the series and the stacks, and find the values that the measurement allows."""
        missing = {}
        stacks = None
        try:
            stacks = _stacks(m, release)
            spatial_evaluation(*stacks, stacks[0].vector, stacks[1].vector, release, 1.0)
        except PixmetryError as problem:
            stacks, missing["spatial"] = None, str(problem)
        series = series_of(m)
        if light_of(series) is None:
            missing["general"] = "neither photons nor exposure times give the light of the levels"
        return cls(release, series, m.pixel_area_um2, stacks, missing, is_curved(series))

    @cached_property
    def plan(self) -> Plan:
        """Choices of the General model from the measured series; ``MeasureError`` if the series gives no characteristic curve."""
        return make_plan(self.series)

    @property
    def vectors(self) -> tuple[Array, Array]:
        """The measured statistics of the dark and the bright stack; empty without stacks."""
        return (np.zeros(0), np.zeros(0)) if self.stacks is None else (self.stacks[0].vector, self.stacks[1].vector)

    def at(self, series: Series, dark_vectors: Array, bright_vectors: Array, general: Series | None = None) -> tuple[Values, Values]:
        """Values by key, and for those that are roots of a variance that may be negative, that variance (``DARK_VARIANCE``: of the dark).

        Parameters
        ----------
        series : Series
            Measured values of shape (..., levels).
        dark_vectors, bright_vectors : ndarray, shape (..., 8)
            Not looked at without stacks.
        general : Series, optional
            What the General model is to be applied to, if not to the same.

        Raises
        ------
        MeasureError
            If the exposure series carries no gain.
        """
        values = level_free_values(series) if self.curved else temporal_values(series, self.release, self.pixel_area_um2)
        squares: Values = {DARK_VARIANCE: dark_line(series)[2]}
        if self.stacks is not None and self.curved:
            found, roots = spatial_evaluation(*self.stacks, dark_vectors, bright_vectors, self.release, np.nan)
            values |= {key: value for key, value in found.items() if is_level_free(key)}
            squares |= {key: value for key, value in roots.items() if is_level_free(key)}
        elif self.stacks is not None:
            found, roots = spatial_evaluation(*self.stacks, dark_vectors, bright_vectors, self.release, values["K"])
            values, squares = values | found, squares | roots
            dark_noise_e2 = (values["sigma_y_dark"] / values["K"]) ** 2
            values["SNR_total_max"] = snr_total_max(values["u_e_sat"], dark_noise_e2, squares["DSNU1288"], squares["PRNU1288"])
        if self.release == "4.0" and "general" not in self.missing:
            try:
                found, roots = general_evaluation(series if general is None else general, self.plan)
                values, squares = values | found, squares | roots
            except MeasureError as problem:
                self.missing["general"] = str(problem)
        return values, squares


@dataclass(frozen=True)
class Spread:
    """Spread of the draws by key, for the measured values and for the variances behind roots."""

    u: dict[str, float]
    u_square: dict[str, float]
    dof: dict[str, float]
    shift: dict[str, float]  # mean of the draws less the value of the smooth series


def keys_of(release: str) -> list[str]:
    """The keys that a release has: the public ones always, what 4.0 brought only there."""
    keys = {k: key for k, key in KEYS.items() if k not in OVER_TEMPERATURES}
    return [k for k, key in keys.items() if release == "4.0" or not (key.section == "general" or k in ("LE", "PTC_linearity"))]


def _stacks(m: Measurement, release: str) -> tuple[SpatialInputs, SpatialInputs]:
    if m.dark_stack is None or m.bright_stack is None:
        have = "no dark stack" if m.dark_stack is None else "no bright stack"
        raise MeasureError(have, where="non-uniformity", remedy="take 16 or more dark frames and as many at half of saturation")
    high_pass = release == "4.0"
    return SpatialInputs.of(m.dark_stack, high_pass, m.dark_products), SpatialInputs.of(m.bright_stack, high_pass, m.bright_products)
