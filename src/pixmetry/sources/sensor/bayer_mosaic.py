"""Colour filter mosaic: every pixel looks through one of three colours, in a pattern of two by two."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal

import numpy as np

from pixmetry.camera.contribution import Contribution, Probe
from pixmetry.camera.observations import Observations
from pixmetry.camera.signal import Kind, Signal
from pixmetry.camera.source import Parameters, Source, quantity
from pixmetry.core.errors import MeasureError
from pixmetry.core.number import Estimates
from pixmetry.core.random import Stream

CHANNELS = "RGB"
ALIKE = 0.03  # by which the greens of a sound sensor differ at most
METHOD = "medians of bright less dark stack at the four places of the pattern, in 6 × 6 tiles"
CONFOUNDERS = ("colours of the mosaic: gains of odd rows or columns, which look like a split of the greens",)


class BayerMosaic(Parameters):
    """Where the colours lie, and how much of this scene's light each lets through to its pixels."""

    pattern: Literal["RGGB", "GRBG", "GBRG", "BGGR"] = quantity("RGGB", "1", "colours of pixels (0,0), (0,1), (1,0), (1,1), row by row")
    red: float = quantity(1.0, "1", "share of the photons that red pixels see", ge=0, le=1)
    green: float = quantity(1.0, "1", "share of the photons that green pixels see", ge=0, le=1)
    blue: float = quantity(1.0, "1", "share of the photons that blue pixels see", ge=0, le=1)
    green_split_rel: float = quantity(0.0, "1", "ratio of green pixels in blue rows to those in red rows, minus 1", ge=-0.3, le=0.3)


def factors(params: BayerMosaic) -> np.ndarray:
    """Share of the photons of the four pixels of the pattern, shape (2, 2), float64."""
    share = dict(zip(CHANNELS, (params.red, params.green, params.blue), strict=True))
    cell = np.array([share[c] for c in params.pattern]).reshape(2, 2)
    for row in (0, 1):
        sign = 0.5 if "B" in params.pattern[2 * row : 2 * row + 2] else -0.5
        cell[row, params.pattern[2 * row : 2 * row + 2].index("G")] *= 1 + sign * params.green_split_rel
    return cell


def over_windows(params: BayerMosaic, signal: Signal) -> np.ndarray:
    """The same for every pixel, float32, shape (n, rows, cols)."""
    lines = factors(params).astype(np.float32).T[signal.cols % 2].swapaxes(1, 2)  # rows of the two kinds, (n, 2, cols)
    pattern: np.ndarray = np.ascontiguousarray(lines)[np.arange(len(lines))[:, None], signal.rows % 2]
    return pattern


def forward(params: BayerMosaic, signal: Signal, stream: Stream) -> Signal:
    """Multiply the mean photons by the share of each pixel's colour, by its absolute place."""
    if (factors(params) == 1).all():
        return signal
    return signal.with_data(signal.data * over_windows(params, signal))


def correct(params: BayerMosaic, signal: Signal, maps: Mapping[str, np.ndarray]) -> Signal:
    """Divide every pixel by the share of its colour: for grey scenes that is the frame without a mosaic, with more noise in the weak ones.

    A colour that sees nothing stays as it is.
    """
    share = over_windows(params, signal)
    return signal.with_data(np.divide(signal.data, share, out=np.array(signal.data, np.float32), where=share > 0))


def truth(params: BayerMosaic, signal: Signal, stream: Stream) -> Mapping[str, np.ndarray]:
    """Share of the photons of every pixel of the frame, and its colour (0 red, 1 green, 2 blue)."""
    row, col = np.indices(signal.frame_shape) % 2
    colour = np.array([CHANNELS.index(c) for c in params.pattern], np.uint8).reshape(2, 2)
    return {"mosaic_share": factors(params)[row, col], "colour": colour[row, col]}


def measure(observations: Observations) -> Estimates:
    """Read the light of the four places off the stacks of a flat field; the largest counts as 1.

    The two places of green are the diagonal whose pixels differ less; where both differ by less than `ALIKE`, the brighter one. Of the
    other two the brighter is called red: flat fields of unknown light do not tell red from blue, and the pattern of gains is the same.
    """
    where, cells = "sensor.bayer_mosaic", observations.colour_cells
    if observations.dark_stack is None or observations.bright_stack is None:
        raise MeasureError("needs a stack of dark and one of bright frames", where=where, remedy="take 16 or more of each")
    if cells is None:
        what = "not found: the four places of a pattern of two by two see the same light, or rows or columns alone differ"
        raise MeasureError(what, where=where)
    mean = cells.mean
    apart = [abs(np.log(mean[0, k] / mean[1, 1 - k])) for k in (0, 1)]  # on the diagonals that begin at (0, 0) and at (0, 1)
    bright = [float(np.sqrt(mean[0, k] * mean[1, 1 - k])) for k in (0, 1)]
    green = int(np.argmax(bright)) if max(apart) < ALIKE else int(np.argmin(apart))
    other = [(0, 1 - green), (1, green)]
    red, blue = sorted(other, key=lambda at: -mean[at])
    in_red, in_blue = ((at[0], green if at[0] == 0 else 1 - green) for at in (red, blue))
    pattern = {red: "R", blue: "B", in_red: "G", in_blue: "G"}
    shares = {"red": _weights(red), "green": 0.5 * (_weights(in_red) + _weights(in_blue)), "blue": _weights(blue)}
    logs = np.log(mean).ravel()
    top = max(shares.values(), key=lambda share: float(share @ logs))
    ratios = {name: share - top for name, share in shares.items()} | {"green_split_rel": _weights(in_blue) - _weights(in_red)}
    gradients = np.array(list(ratios.values()))
    values = np.exp(gradients @ logs)
    covariance = values[:, None] * (gradients @ cells.log_covariance @ gradients.T) * values
    values[3] -= 1
    order = "".join(pattern[r, c] for r in (0, 1) for c in (0, 1))
    named = f"pattern {order}, if the brighter of the two is red: the colour of the light is not known"
    reasons = {"red": f"in this light; {named}", "blue": f"in this light; {named}", "green": "in this light"}
    return Estimates(
        names=tuple(ratios),
        values=values,
        covariance=covariance,
        dof=np.full(4, float(cells.dof)),
        units=("1",) * 4,
        method=METHOD,
        confounders=CONFOUNDERS,
        reasons=reasons,
        settings={"pattern": order},
    )


def _weights(at: tuple[int, int]) -> np.ndarray:
    """1 at a place of the pattern, of four row by row."""
    weights: np.ndarray = (np.arange(4) == 2 * at[0] + at[1]).astype(float)
    return weights


def propagate(params: BayerMosaic, probe: Probe) -> Contribution:
    """The estimator on the mosaic, with the target at each of the four places in the pattern; its level is brought back to the median's."""
    cell = factors(params)
    level = float(np.median(cell))
    rows, cols = probe.signal_dn.shape[1:]
    shifts = []
    for row in (0, 1):
        for col in (0, 1):
            share = np.roll(cell, (row, col), axis=(0, 1))[np.arange(rows)[:, None] % 2, np.arange(cols) % 2]
            shifts.append(probe.moved(probe.signal_dn * share / level))
    dx, dy = (np.concatenate([s[a] for s in shifts]) for a in (0, 1))
    return probe.from_shifts(dx, dy, "F", model_error=0.3, method="the estimator on the unbalanced mosaic, over its four positions")


SOURCE = Source(
    id="sensor.bayer_mosaic",
    title="Colour filter mosaic",
    description="Pixels of the three colours respond differently even to a grey scene. This is a checkered gain, which colour balancing "
    "removes.",
    parameters=BayerMosaic,
    consumes=(Kind.PHOTONS,),
    before=("sensor.quantum_efficiency", "sensor.dark_current", "sensor.shot_noise"),
    neutral=BayerMosaic(),
    typical=BayerMosaic(red=0.8, green=0.9, blue=0.6),
    bound=BayerMosaic(red=0.6, green=1.0, blue=0.4, green_split_rel=0.02),
    forward=forward,
    measure=measure,
    correct=correct,
    propagate=propagate,
    truth=truth,
    option="a colour mosaic",
    gum_class="F",
    equation="µ' = µ τ_colour(row mod 2, col mod 2)",
    typical_size="0.01 px unbalanced on a disc of 7 px; none for a grey scene once the colours are balanced",
    references=("B. E. Bayer, US patent 3 971 065, 1976", "H. S. Malvar, L. He, R. Cutler, ICASSP 2004 (layout of the mosaic)"),
    leaves="the colour of scenes that are not grey, as a pattern of the mosaic; more noise in the weak colours",
    advice="Use a monochrome sensor. Otherwise balance the colours of the raw mosaic, and locate targets in it without interpolation.",
)
