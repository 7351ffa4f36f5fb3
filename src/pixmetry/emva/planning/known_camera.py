"""Known values of a camera and its light before a test: given, or from the results of an earlier test."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from pixmetry.core.errors import InputError
from pixmetry.core.number import Number
from pixmetry.emva.files.keys import QUANTISATION_DN2
from pixmetry.emva.spatial.high_pass import MINIMUM_SIDE


@dataclass(frozen=True)
class KnownCamera:
    """What is known of a camera and its light before the test. Standard deviations; ``_rel`` 0.01 is 1 %.

    ``dark_noise_e`` is that of single pixels; ``row_noise_e`` and ``col_noise_e`` are temporal too. ``light_scatter_rel`` is the scatter
    of the light from level to level beyond its stated value, ``var_excess_rel`` that of a level's temporal variance beyond sampling.
    ``coherence`` is the variance of the mean square of the noise left in a mean dark image, over that of white noise. ``exposure_sat_s``
    is the exposure time at which the light of the test saturates the camera (where the light is swept: the one exposure time).
    """

    rows: int
    cols: int
    bits: int
    gain_dn_per_e: float
    dark_noise_e: float
    saturation_e: float
    dsnu_pixel_e: float = 0.0
    dsnu_row_e: float = 0.0
    dsnu_col_e: float = 0.0
    prnu_pixel_rel: float = 0.0
    prnu_row_rel: float = 0.0
    prnu_col_rel: float = 0.0
    row_noise_e: float = 0.0
    col_noise_e: float = 0.0
    dark_current_e_per_s: float = 0.0
    quantum_efficiency: float | None = None
    light_scatter_rel: float = 0.0
    var_excess_rel: float = 0.0
    coherence: float = 1.0
    exposure_sat_s: float | None = None
    frame_rate_hz: float | None = None

    def __post_init__(self) -> None:
        for name in ("rows", "cols", "bits", "gain_dn_per_e", "saturation_e", "quantum_efficiency", "exposure_sat_s", "frame_rate_hz"):
            value = getattr(self, name)
            if value is not None and not (math.isfinite(value) and value > 0):
                raise InputError(f"{name} cannot be used", where="camera to plan for", value=value, allowed="a number above 0")
        for name, value in vars(self).items():
            if value is not None and not (math.isfinite(value) and value >= 0):
                raise InputError(f"{name} cannot be used", where="camera to plan for", value=value, allowed="0 or a number above 0")
        if min(self.rows, self.cols) < MINIMUM_SIDE:
            allowed = f"{MINIMUM_SIDE} rows and columns or more"
            raise InputError("frames are too small for the high-pass of EMVA 1288 R4.0", value=(self.rows, self.cols), allowed=allowed)

    @property
    def values(self) -> dict[str, float]:
        """The values that the test will find, by key, in the key's unit."""
        # the standard's σ_d holds the noise of rows and columns too
        found = {"K": self.gain_dn_per_e, "sigma_d": math.hypot(self.dark_noise_e, self.row_noise_e, self.col_noise_e)}
        if self.quantum_efficiency is not None:
            found |= {"R": self.gain_dn_per_e * self.quantum_efficiency, "QE": 100 * self.quantum_efficiency}
        for name, (pixel, row, col), scale in (
            ("DSNU1288", (self.dsnu_pixel_e, self.dsnu_row_e, self.dsnu_col_e), 1.0),
            ("PRNU1288", (self.prnu_pixel_rel, self.prnu_row_rel, self.prnu_col_rel), 100.0),
        ):
            parts = {"": math.hypot(pixel, row, col), "_pixel": pixel, "_row": row, "_col": col}
            found |= {name + part: scale * value for part, value in parts.items()}
        return found

    def dark_var_dn2(self, exposure_s: np.ndarray | float = 0.0) -> Any:
        """White temporal variance in the dark, DN², quantisation with it."""
        return self.gain_dn_per_e**2 * (self.dark_noise_e**2 + self.dark_current_e_per_s * exposure_s) + QUANTISATION_DN2


def camera_from_results(values: Mapping[str, Any], rows: int, cols: int, bits: int, **more: Any) -> KnownCamera:
    """Take the results of a test as known values.

    Parameters
    ----------
    values : mapping
        By key: ``Number``, the object of a JSON file (``{"value": …, "u": …}``) or a number.
    rows, cols, bits : int
    more
        Further fields of ``KnownCamera``, such as ``exposure_sat_s``; they come before what is in ``values``.

    Raises
    ------
    InputError
        If K, dark noise or saturation are missing.
    """
    found = {key: number_in(value) for key, value in values.items()}
    for key in ("K", "sigma_d", "u_e_sat"):
        if not found.get(key, math.nan) > 0:
            remedy = "give the value, or measure it from a few frames (preflight)"
            raise InputError("the results lack a value that the plan needs", where=key, value=found.get(key), remedy=remedy)
    facts: dict[str, Any] = {
        "rows": rows,
        "cols": cols,
        "bits": bits,
        "gain_dn_per_e": found["K"],
        "saturation_e": found["u_e_sat"],
        "dark_current_e_per_s": max(found.get("u_I_mean", 0.0), 0.0),
        "quantum_efficiency": found["QE"] / 100 if found.get("QE", 0.0) > 0 else None,
    }
    for part in ("pixel", "row", "col"):
        facts[f"dsnu_{part}_e"] = found.get(f"DSNU1288_{part}", 0.0)
        facts[f"prnu_{part}_rel"] = found.get(f"PRNU1288_{part}", 0.0) / 100
    facts = {name: 0.0 if isinstance(v, float) and math.isnan(v) else v for name, v in facts.items()}
    lines = math.hypot(more.get("row_noise_e", 0.0), more.get("col_noise_e", 0.0))
    facts["dark_noise_e"] = math.sqrt(max(found["sigma_d"] ** 2 - lines**2, 0.0))
    return KnownCamera(**{**facts, **more})


def number_in(value: Any, name: str = "value") -> float:
    """The number in a value of a data sheet; an upper limit L counts as L/√3."""
    if isinstance(value, Number):
        return value.representative if name == "value" else float(getattr(value, name, math.nan))
    if not isinstance(value, Mapping):
        return float(value) if name == "value" and isinstance(value, int | float) else math.nan
    number = value.get(name)
    number = math.nan if number is None else float(number)
    return number / math.sqrt(3) if name == "value" and value.get("is_limit") else number


def first_to_saturate(cameras: Mapping[str, KnownCamera]) -> str:
    """The channel of a camera that saturates first; the series is planned for it."""

    def order(channel: str) -> tuple[float, float]:
        camera = cameras[channel]
        photons = camera.saturation_e / camera.quantum_efficiency if camera.quantum_efficiency else math.inf
        return camera.exposure_sat_s or math.inf, photons

    return min(cameras, key=order)
