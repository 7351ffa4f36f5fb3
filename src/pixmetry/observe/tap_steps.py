"""Steps of the gain at the borders of equal parts of the frame, and stripes of odd columns, in the columns of a flat field."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from pixmetry.camera.observations import StackMoments, TapSteps
from pixmetry.core.arrays import Array
from pixmetry.core.number import ONE_SIDED_95, Estimates
from pixmetry.observe.noise_filter import unseen_rms
from pixmetry.observe.surface import orthonormal_polynomials

SIDE_COLS = 8  # columns on each side of a border
LEAST_COLS, MOST_CLIPPED, FOUND_Z = 96, 0.002, 5.0
AT_BORDER_Z, ALIKE_Z = 2.0, 4.0  # u of a step at the borders, and of its difference to that of all columns
TAPS = (2, 3, 4, 6, 8)  # that are looked for
LARGEST_UNSEEN, TAPS_PRESENT = 0.02, 0.1  # relative step between two taps, and the chance of one, before anything is measured
LIGHT_DEGREE = 4  # of the light along the columns, as of the surface that is taken from a flat field
LAGS = 4  # columns over which what is left may be correlated
METHOD = "column medians of bright less dark stack: steps at the borders of equal parts, and odd columns against even ones"
CONFOUNDERS = ("gain of the taps: the columns' own pattern (PRNU), which holds the stripes too; a step of the light exactly at a border",)


def find_taps(dark: StackMoments, bright: StackMoments, mosaic: bool) -> TapSteps:
    """Steps at the borders of two, three, four … taps, and stripes of odd columns.

    Parameters
    ----------
    dark, bright : StackMoments
    mosaic : bool
        Whether the pixels have colours: stripes of odd columns are then the colours'.

    Returns
    -------
    TapSteps

    Notes
    -----
    The size of a step comes from all columns together: least squares of the steps, the stripes and a polynomial of the light, with the
    scatter that is left, and its correlation from column to column. A light that is no polynomial could look like steps. So they must
    also show at the borders themselves: what straight lines through `SIDE_COLS` columns on either side leave between them agrees with
    the size, within what the same rule finds at places that are no border, and is twice that.
    """
    light = bright.mean_map_dn - dark.mean_map_dn
    cols = light.shape[1]
    if cols < LEAST_COLS or bright.fraction_max > MOST_CLIPPED or np.median(light) <= 0:
        return TapSteps(Estimates.empty(), np.ones(cols))
    means = np.median(light, axis=0)
    means = means / means.mean()
    parity = np.arange(cols) % 2 - 0.5
    basis = np.asarray(orthonormal_polynomials(cols, LIGHT_DEGREE)[0], float)
    odd_even, var_odd_even = 0.0, 0.0
    if not mosaic:
        values, covariance = _fitted(means, basis, [parity])
        odd_even, var_odd_even = float(values[0]), float(covariance[0, 0])
    found, dof = _borders(means - odd_even * parity)
    limits, reasons = set(), {}
    taps, step, u_step, told, unseen = 2, 0.0, 0.0, False, 0.0
    for number, (near, u_near) in found.items():
        side = _sides(cols, number)
        values, covariance = _fitted(means, basis, [side] if mosaic else [side, parity])
        size, u = float(values[0]), float(np.sqrt(covariance[0, 0]))
        unseen = unseen_rms(abs(size), u, LARGEST_UNSEEN, present=TAPS_PRESENT) if number == 2 else unseen
        seen = abs(near) > AT_BORDER_Z * u_near and abs(near - size) < ALIKE_Z * u_near
        if seen and abs(size) > FOUND_Z * u and abs(size) * u_step >= abs(step) * u:
            taps, step, u_step, told = number, size, u, True
            if not mosaic:
                odd_even, var_odd_even = float(values[1]), float(covariance[1, 1])
    if not told:
        step, u_step = found[2]
        step = abs(step) + ONE_SIDED_95 * u_step
        limits.add("step_rel")
        why = f"no border of {', '.join(map(str, found))} taps stands out of the columns; 95 % limit for two taps"
        reasons["step_rel"] = why
    u_odd_even = float(np.sqrt(var_odd_even))
    gain = np.ones(cols)
    if told:
        gain = gain + step * _sides(cols, taps)
    rows = [("step_rel", step, u_step, float(cols - LIGHT_DEGREE - 3) if told else dof, "1")]
    if not mosaic:
        if abs(odd_even) < FOUND_Z * u_odd_even:
            odd_even = abs(odd_even) + ONE_SIDED_95 * u_odd_even
            limits.add("odd_even_rel")
            reasons["odd_even_rel"] = "odd and even columns do not differ by more than their own pattern; 95 % limit of its size"
        else:
            gain = gain + odd_even * parity
        rows.append(("odd_even_rel", odd_even, u_odd_even, float(cols - LIGHT_DEGREE - 2), "1"))
    if told:
        rows.append(("taps", float(taps), 0.0, np.inf, "1"))
    fit = Estimates.from_rows(rows, method=METHOD, confounders=CONFOUNDERS, limits=frozenset(limits), reasons=reasons)
    return TapSteps(fit, gain, 0.0 if told else unseen)


def _sides(cols: int, taps: int) -> Array:
    """−½ and ½ in turn from tap to tap, shape (cols,)."""
    return np.asarray((np.arange(cols) * taps // cols) % 2 - 0.5, float)


def _fitted(means: Array, basis: Array, patterns: Sequence[Array]) -> tuple[Array, Array]:
    """Sizes of patterns beside the light, and their covariance."""
    design = np.column_stack([*patterns, basis])
    inverse = np.linalg.inv(design.T @ design)
    values = inverse @ (design.T @ means)
    left = means - design @ values
    size = 1.4826 * float(np.median(np.abs(left)))
    left = np.clip(left, -4 * size, 4 * size)  # single columns that are off
    var = float(left @ left) / max(len(means) - design.shape[1], 1)
    lags = [float(left[k:] @ left[:-k]) / max(float(left @ left), 1e-300) for k in range(1, LAGS + 1)]
    k = len(patterns)
    meat = design.T @ design
    for lag, r in enumerate(lags, 1):
        if abs(r) > 3 / np.sqrt(len(means)):
            beside = r * (design[lag:].T @ design[:-lag])
            meat = meat + beside + beside.T
    own = np.diag(np.maximum(np.diag(inverse @ meat @ inverse), np.diag(inverse)))[:k, :k]  # never less than of independent columns
    return np.asarray(values[:k], float), np.asarray(own * var, float)


def _borders(even: Array) -> tuple[dict[int, tuple[float, float]], float]:
    """Step at the borders and its scatter, by number of taps; degrees of freedom of that."""
    cols = len(even)
    at = np.arange(SIDE_COLS, cols - SIDE_COLS + 1)
    jumps = np.array([_jump(even[c - SIDE_COLS : c + SIDE_COLS]) for c in at])
    borders = {taps: [-(-k * cols // taps) for k in range(1, taps)] for taps in TAPS if cols // taps >= 3 * SIDE_COLS}
    near = np.array([min(abs(c - b) for part in borders.values() for b in part) < SIDE_COLS for c in at])
    quiet = jumps[~near] if np.count_nonzero(~near) > 4 * SIDE_COLS else jumps
    scatter = 1.4826 * float(np.median(np.abs(quiet - np.median(quiet))))
    found = {}
    for taps, places in borders.items():
        signs = np.where(np.arange(len(places)) % 2, -1.0, 1.0)
        found[taps] = float(np.mean(signs * jumps[np.array(places) - SIDE_COLS])), scatter / float(np.sqrt(len(places)))
    return found, max(quiet.size / (2 * SIDE_COLS), 2.0)


def _jump(values: Array) -> float:
    """What straight lines through the two halves leave between them, over their mean."""
    half = len(values) // 2
    x = np.arange(half) - (half - 1) / 2
    left, right = (part.mean() + (part @ x) / (x @ x) * reach for part, reach in ((values[:half], half / 2), (values[half:], -half / 2)))
    return float(right - left)


def evened(dark: StackMoments, bright: StackMoments, taps: TapSteps) -> StackMoments:
    """The bright stack with the light of all columns at one gain; noise is left as it is."""
    if not (taps.gain != 1).any():
        return bright
    return replace(bright, mean_map_dn=dark.mean_map_dn + (bright.mean_map_dn - dark.mean_map_dn) / taps.gain)


def with_steps_in_slope(spatial: Estimates, taps: TapSteps) -> Estimates:
    """The gradient of the light along x, and the columns' own pattern, with what steps may do to them.

    A step that was taken off is wrong by its u. One between two taps that was not found may be there with the size that the columns fit
    best: it is part of the gradient, and what the light does not take up of it is part of the scatter of the columns.
    """
    u = taps.unseen_rel
    number = 2
    if "step_rel" in taps.fit and "step_rel" not in taps.fit.limits:
        u, number = taps.fit["step_rel"].u, round(taps.fit["taps"].value)
    if not u:
        return spatial
    cols, covariance = len(taps.gain), spatial.covariance.copy()
    basis, slopes = orthonormal_polynomials(cols, LIGHT_DEGREE)
    side = _sides(cols, number)
    if "shading_x_per_px" in spatial:
        at = spatial.index("shading_x_per_px")
        covariance[at, at] += (float(slopes @ (basis.T @ side)) * u) ** 2
    if taps.unseen_rel and "prnu_col_rel" in spatial:
        left, found = side - basis @ (basis.T @ side), spatial["prnu_col_rel"]
        covariance[spatial.index("prnu_col_rel"), spatial.index("prnu_col_rel")] += (
            0.0 if found.is_limit else (float(left @ left) / cols * u**2 / (2 * found.value)) ** 2
        )
    return replace(spatial, covariance=covariance)
