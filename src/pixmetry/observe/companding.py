"""From the codes that occur to the table that they went through, and the variances without the rounding of its wide steps."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, TypeVar

import numpy as np

from pixmetry.camera.code_table import LINEAR, ROOT, TRUNCATED, CodeTable
from pixmetry.camera.observations import CodeHistogram, LevelMoments, PhotonTransfer, StackMoments
from pixmetry.core.errors import MeasureError
from pixmetry.observe.histogram import expected_counts

LEAST_CODES, LEAST_BITS = 24, 4
EXPECTED = 20.0  # pixels; fewer may be none by chance
FILLED = 0.8  # share of a table's codes near the levels that must occur
LEAST_MISSING = 0.1  # share of all codes near the levels that must not
RESOLVED = 0.5  # of a step: with less noise the variance behind hangs on the place of the mean between two steps
NODES, ROUNDS = 15, 8


def find_code_table(histogram: CodeHistogram) -> CodeTable | None:
    """The table of the fewest codes that holds all codes that occur; None where most codes occur, or no table fits.

    Parameters
    ----------
    histogram : CodeHistogram

    Returns
    -------
    CodeTable or None

    Notes
    -----
    A table of b bits leaves at most 2^b codes of those of the camera, and one code beside them refutes it. Codes count as dropped where the
    levels, taken as normal distributions, would have `EXPECTED` pixels there and none is found.
    """
    found = histogram.counts > 0
    if np.count_nonzero(found) < LEAST_CODES or histogram.level_means_dn is None:
        return None
    near = expected_counts(histogram)[0] > EXPECTED
    if np.count_nonzero(near & ~found) < LEAST_MISSING * np.count_nonzero(near):
        return None
    fitting = []
    for law in (TRUNCATED, LINEAR, ROOT):
        for sent in range(LEAST_BITS, histogram.bits + (law == ROOT)):
            table = CodeTable(law, histogram.bits, sent)
            on_table = np.zeros(found.size, bool)
            on_table[table.entries()] = True
            due = near & on_table
            if not (found & ~on_table).any() and np.count_nonzero(due & found) >= FILLED * np.count_nonzero(due):
                fitting.append((np.count_nonzero(on_table), table))
    return min(fitting, key=lambda pair: pair[0])[1] if fitting else None


def before_table(mean_dn: float, var_dn2: float, spread_dn2: float, entries: np.ndarray) -> tuple[float, float]:
    """Mean and temporal variance of the codes before a table, from those behind it.

    Parameters
    ----------
    mean_dn, var_dn2 : float
        Over all pixels; of the variance in time of a pixel.
    spread_dn2 : float
        Variance from pixel to pixel of what they have in every frame.
    entries : ndarray, shape (codes,)
        What becomes of each code.

    Notes
    -----
    Normal noise of variance s² about a pixel's mean is rounded to a code and looked up; the mean over normal pixel means of the variance
    behind is solved for s², and the mean behind for the mean, by turns. That of whole codes, 1/12, is part of the variance before.
    """
    from scipy.special import ndtr

    nodes, weights = np.polynomial.hermite_e.hermegauss(NODES)
    weights = weights / weights.sum()
    table = entries.astype(float)
    mean, var = mean_dn, max(var_dn2, 0.05)
    for _ in range(ROUNDS):
        sigma, pixels = np.sqrt(var), mean + np.sqrt(max(spread_dn2, 0.0)) * nodes
        low = int(max(pixels.min() - 6 * sigma - 1, 0))
        high = int(min(pixels.max() + 6 * sigma + 2, table.size))
        edges = np.arange(low, high + 1) - 0.5
        edges[0], edges[-1] = -np.inf, np.inf
        share = np.diff(ndtr((edges - pixels[:, None]) / sigma), axis=1)
        codes = table[low:high]
        means = share @ codes
        behind = float(weights @ (share @ codes**2 - means**2))
        mean += mean_dn - float(weights @ means)
        var = max(var + var_dn2 - behind, 0.25 * var)
    return mean, var + 1 / 12


L = TypeVar("L", LevelMoments, StackMoments)


def without_steps(
    series: PhotonTransfer, dark: StackMoments | None, bright: StackMoments | None, table: CodeTable
) -> tuple[PhotonTransfer, StackMoments | None, StackMoments | None]:
    """Series and stacks with the means and variances as they were before the table.

    Raises
    ------
    MeasureError
        If the noise of a level is so small against its step that the variance behind hardly depends on that before.
    """
    _refuse_wide_steps(series, table)
    entries = table.entries()
    shape = series.frame_shape

    def even_level(level: LevelMoments) -> LevelMoments:
        columns = (level.mean_dn.tolist(), level.ms_pixel_dn2.tolist(), level.spatial_cov_dn2.tolist())
        found = np.array([before_table(m, v, p, entries) for m, v, p in zip(*columns, strict=True)]).reshape(-1, 2)
        return _moved(replace(level, mean_dn=found[:, 0]), level.ms_pixel_dn2, found[:, 1], shape)

    def even_stack(stack: StackMoments) -> StackMoments:
        spread = float(stack.mean_map_dn.var()) - stack.var_stack_dn2 / stack.n_frames
        mean, var = before_table(stack.mean_dn, stack.ms_pixel_dn2, spread, entries)
        return _moved(replace(stack, mean_dn=mean), stack.ms_pixel_dn2, var, shape)

    stacks = [None if stack is None else even_stack(stack) for stack in (dark, bright)]
    return replace(series, dark=even_level(series.dark), bright=even_level(series.bright)), stacks[0], stacks[1]


def _moved(level: L, behind_dn2: Any, before_dn2: Any, shape: tuple[int, int]) -> L:
    """The mean squares with the white variance before; that of lines changes by its share."""
    return replace(
        level,
        ms_pixel_dn2=before_dn2,
        ms_row_dn2=level.ms_row_dn2 + (before_dn2 - behind_dn2) / shape[1],
        ms_col_dn2=level.ms_col_dn2 + (before_dn2 - behind_dn2) / shape[0],
    )


def _refuse_wide_steps(series: PhotonTransfer, table: CodeTable) -> None:
    levels = [level for level in (series.dark, series.bright) if level.mean_dn.size]
    mean, var = (np.concatenate([getattr(level, name) for level in levels]) for name in ("mean_dn", "ms_pixel_dn2"))
    open_ = mean < 0.98 * 2**series.bits
    step = table.step_dn(mean)[open_]
    noise = np.sqrt(np.maximum(var[open_] - step**2 / 12, 0))
    if (noise < RESOLVED * step).any():
        worst = int(np.argmin(noise / step))
        raise MeasureError(
            f"the codes go through a table of fewer bits ({table.law}, {table.transport_bits} bits), whose steps hide the noise",
            where="photon transfer",
            value=f"noise of {noise[worst]:.2g} DN, steps of {step[worst]:.3g} DN",
            allowed=f"noise of {RESOLVED:g} steps or more",
            remedy="take frames in the full number of bits (Mono12 in place of Mono8), or set a higher gain",
        )
