"""Where the response of a camera ends: at the top code, or on a plateau below it, as a full well makes one."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pixmetry.emva.files.rules import SATURATED_FRACTION
from pixmetry.emva.records import Series

SATURATED_DEVIATE = 2.24  # 1.25 % of the pixels on a plateau below it: about there the variance is largest, which is what ends a 3.1 series
SEEN_FRACTION, SEEN_DEVIATE = 0.01, 2.24  # a little more shows hardly in mean and variance; draws choose among these levels
FLAT = 0.1  # of the steepest rise of the response over the logarithm of the light
CHORD, END_CHORD = 1.1, 1.019  # ratios of light over which a rise is read, so that scatter of the light does not matter
COLLAPSED, STEEPEST_FALL = 0.5, 3  # a variance below half of what it may fall to by a bend, p^-3 of the light: the level is on a plateau
NEAR = 1.5  # ratio of light within which levels have about the same noise


@dataclass(frozen=True)
class ResponseEnd:
    """What ends a series whose levels are in order of their light."""

    seen: int  # number of levels that follow the response
    clips: bool  # the top code ends it
    plateau_dn: float = np.inf  # mean of the saturated levels, where there are such below the top code
    noise_dn: float = 0.0  # of the pixels before the plateau, in time and space

    @property
    def found(self) -> bool:
        """Whether the series reaches its end."""
        return self.clips or bool(np.isfinite(self.plateau_dn))

    def saturation(self, mean_dn: np.ndarray, fraction_max: np.ndarray) -> np.ndarray:
        """Highest level with few enough pixels at the end, shape (...); arguments of shape (..., levels)."""
        below = (fraction_max <= SATURATED_FRACTION) & (self.plateau_dn - mean_dn >= SATURATED_DEVIATE * self.noise_dn)
        below = below[..., : self.seen]
        return np.where(below.any(axis=-1), self.seen - 1 - np.argmax(below[..., ::-1], axis=-1), 0)


def end_of(series: Series, light: np.ndarray) -> tuple[np.ndarray, ResponseEnd]:
    """The lit levels of one series (no draws) in order of their light, as indices, and what ends them; light of shape (levels,)."""
    order = np.argsort(light, kind="stable")
    order = order[light[order] > 0]
    known = (light, series.mean_dn, series.var_dn2, series.spatial_var_dn2, series.fraction_max)
    return order, find_end(*(np.asarray(values, dtype=float)[order] for values in known))


def find_end(light: np.ndarray, mean_dn: np.ndarray, var_dn2: np.ndarray, spatial_dn2: np.ndarray, fraction_max: np.ndarray) -> ResponseEnd:
    """Find the end of the response in one series; arrays of shape (levels,), in rising order of light.

    Notes
    -----
    Whatever its form, a response goes on rising with the logarithm of the light, until nothing more is stored. A plateau is found where
    the mean rises no more, or from a last level whose variance has collapsed. A pixel is on it when its noise takes it there, so a level's
    share of such pixels is the normal tail beyond the plateau; at the top code they are counted.
    """
    open_levels = np.flatnonzero(fraction_max <= SEEN_FRACTION)
    end = ResponseEnd(int(open_levels[-1]) + 1 if open_levels.size else 0, bool((fraction_max > SATURATED_FRACTION).any()))
    once, place = np.unique(light, return_inverse=True)
    if once.size < 3 or fraction_max[-1] >= 0.5:
        return end
    mean, var, spatial = (np.bincount(place, values) / np.bincount(place) for values in (mean_dn, var_dn2, spatial_dn2))
    log, last = np.log(once), once.size - 1
    lower = np.searchsorted(log, log[1:] - np.log(CHORD), side="right") - 1
    lower = np.maximum(lower, 0)
    steepest = ((mean[1:] - mean[lower]) / (log[1:] - log[lower])).max()
    flat = mean[last] - mean[:last] < FLAT * steepest * (log[last] - log[:last])
    far = log[:last] <= log[last] - np.log(END_CHORD)
    expected = (var * (once / once[last]) ** STEEPEST_FALL)[once >= once[last] / NEAR].max()
    if not flat[far][-1:].any() and not var[last] < COLLAPSED * expected:
        return end
    first = last if flat.all() or not flat.any() else int(np.flatnonzero(~flat)[-1]) + 1
    near = np.arange(once.size) >= min(np.searchsorted(once, once[first] / NEAR), max(first - 2, 0))
    noise = float(np.sqrt((var + np.maximum(spatial, 0.0))[near].max()))
    free = np.flatnonzero(mean[last] - mean_dn >= SEEN_DEVIATE * noise)
    seen = int(free[-1]) + 1 if free.size else 0
    return ResponseEnd(min(seen, end.seen), end.clips, float(mean[last]), noise)
