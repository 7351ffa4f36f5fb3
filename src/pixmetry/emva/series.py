"""The exposure series of EMVA 1288: bright levels in order of their light, each with the dark level of its exposure."""

from __future__ import annotations

import numpy as np

from pixmetry.camera.observations import LevelMoments
from pixmetry.core.arrays import Array, Flags
from pixmetry.core.errors import MeasureError
from pixmetry.emva.files.keys import EQUAL_EXPOSURE
from pixmetry.emva.records import Measurement, Series

MINIMUM_LEVELS = 3
MINIMUM_EXPOSURES = 3  # for a slope of the dark signal


def series_of(m: Measurement) -> Series:
    """Pair the bright levels with the dark ones; exposure sweeps and light sweeps at one exposure alike.

    Parameters
    ----------
    m : Measurement
        Of which ``transfer`` is used.

    Returns
    -------
    Series
        Bright levels in order of their light (photons where they are known, else exposure, else signal), dark levels in order of exposure.
        ``fraction_max`` is of the pixels that are not at the top code in the dark: stuck and hot ones say nothing of saturation.

    Raises
    ------
    MeasureError
        No dark level, or fewer than three bright ones.
    """
    bright, dark = m.transfer.bright, m.transfer.dark
    if dark.mean_dn.size == 0:
        raise MeasureError("no dark level", where="exposure series", remedy="take two dark frames at each exposure of the bright ones")
    if bright.mean_dn.size < MINIMUM_LEVELS:
        raise MeasureError(
            "too few bright levels",
            where="exposure series",
            value=int(bright.mean_dn.size),
            allowed=f"{MINIMUM_LEVELS} or more; EMVA 1288 R4.0 §6.5 asks for 50",
            remedy="take two frames at each of 50 light levels from dark to saturation",
        )
    b, d = bright_order(bright), dark_order(dark)
    hot = min(float(dark.fraction_max.max()), 0.5)
    weights = pairing(bright.exposure_s[b], dark.exposure_s[d])

    def beside(values: Array) -> Array:
        found: Array = weights @ values[d]
        return found

    return Series(
        exposure_s=bright.exposure_s[b],
        photons=None if bright.photons is None else bright.photons[b],
        mean_dn=bright.mean_dn[b],
        var_dn2=bright.var_total_dn2[b],
        spatial_var_dn2=bright.spatial_cov_dn2[b],
        dark_mean_dn=beside(dark.mean_dn),
        dark_var_dn2=beside(dark.var_total_dn2),
        dark_spatial_var_dn2=beside(dark.spatial_cov_dn2),
        fraction_min=bright.fraction_min[b],
        fraction_max=np.clip((bright.fraction_max[b] - hot) / (1 - hot), 0.0, 1.0),
        dark_exposure_s=dark.exposure_s[d],
        own_dark_mean_dn=dark.mean_dn[d],
        own_dark_var_dn2=dark.var_total_dn2[d],
    )


def bright_order(bright: LevelMoments) -> np.ndarray:
    """Indices that sort the bright levels by their light; an exposure that does not vary says nothing of it, for its clock has noise."""
    known = [bright.mean_dn]
    if exposure_varies(bright.exposure_s):
        known.append(bright.exposure_s)
    if bright.photons is not None:
        known.append(bright.photons)
    return np.lexsort(known)


def dark_order(dark: LevelMoments) -> np.ndarray:
    """Indices that sort the dark levels by exposure."""
    return np.argsort(dark.exposure_s, kind="stable")


def exposure_varies(exposure_s: Array) -> bool:
    """Whether these exposures are more than one."""
    return float(np.ptp(exposure_s)) > EQUAL_EXPOSURE * float(np.max(exposure_s))


def first_of_equal(exposure_s: Array) -> Array:
    """For exposures in ascending order: the index of the first of those that are equal to each but for the noise of clocks."""
    first = np.zeros(exposure_s.size, dtype=int)
    for i in range(1, exposure_s.size):
        start = first[i - 1]
        first[i] = start if exposure_s[i] - exposure_s[start] <= EQUAL_EXPOSURE * exposure_s[i] else i
    return first


def count_exposures(exposure_s: Array) -> int:
    """How many different exposures there are; argument in ascending order."""
    return int(np.unique(first_of_equal(exposure_s)).size)


def light_of(series: Series) -> tuple[Array, str] | None:
    """The measure of the light of a level, and its unit: photons, otherwise seconds of exposure; ``None`` if neither is known."""
    if series.photons is not None:
        return series.photons, "photon"
    if exposure_varies(series.exposure_s):
        return series.exposure_s, "s"
    return None


def pairing(bright_s: Array, dark_s: Array) -> Array:
    """Weights of the dark levels for each bright one, shape (bright, dark); each row sums to one.

    The mean of the dark levels of the same exposure; where there is none, the line between the dark levels on either side; beyond the
    shortest and the longest exposure, the straight line through all dark levels, or with fewer than three exposures the nearest level.
    ``dark_s`` is in ascending order.
    """
    first = first_of_equal(dark_s)
    along = dark_s - dark_s.mean()
    weights = np.zeros((bright_s.size, dark_s.size))
    for i, t in enumerate(bright_s):
        gap = np.abs(dark_s - t)
        nearest = int(gap.argmin())
        above = int(np.searchsorted(dark_s, t))
        if gap[nearest] <= max(EQUAL_EXPOSURE * t, 1e-15):
            exact = gap <= 1e-9 * t
            same = exact if exact.any() else first == first[nearest]
            weights[i, same] = 1 / same.sum()
        elif 0 < above < dark_s.size:
            share = (t - dark_s[above - 1]) / (dark_s[above] - dark_s[above - 1])
            weights[i, above - 1 : above + 1] = 1 - share, share
        elif np.unique(first).size >= MINIMUM_EXPOSURES:
            weights[i] = 1 / dark_s.size + (t - dark_s.mean()) * along / (along @ along)
        else:
            same = first == first[nearest]
            weights[i, same] = 1 / same.sum()
    return weights


def without_dark(bright_s: Array, dark_s: Array) -> Flags:
    """Bright levels whose dark values are those of another exposure, as too few tell how these change; shape (bright,), bool."""
    far = np.abs(dark_s[None] - bright_s[:, None]).min(axis=1) > np.maximum(EQUAL_EXPOSURE * bright_s, 1e-15)
    outside: Flags = (bright_s < dark_s.min()) | (bright_s > dark_s.max())
    found: Flags = far & outside & (count_exposures(dark_s) < MINIMUM_EXPOSURES)
    return found
