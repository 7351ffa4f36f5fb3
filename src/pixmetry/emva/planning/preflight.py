"""A look at a few frames before a long series: is the camera set so that a test by EMVA 1288 makes sense?"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from pixmetry.core.errors import InputError, MeasureError
from pixmetry.core.finding import Finding, finding_lines
from pixmetry.emva.files.keys import FIT_RANGE, QUANTISATION_DN2
from pixmetry.emva.planning.known_camera import KnownCamera
from pixmetry.emva.planning.preflight_checks import (
    CODE_CHECKS,
    FLICKER_FRAMES,
    LIGHT_CHECKS,
    Check,
    Frames,
    Group,
    flattened,
    flicker_rel,
    reduce_frames,
)
from pixmetry.emva.reduction import phases
from pixmetry.files import Campaign, FrameReader
from pixmetry.files.records import FrameGroup
from pixmetry.files.strict_json import plain
from pixmetry.observe.one_pass import Part
from pixmetry.observe.stack import choose_stacks
from pixmetry.observe.surface import cross_strata

VERDICTS = ("ok", "not judged", "warn", "fail")


class BrightLevel(NamedTuple):
    """Frames at one light level."""

    exposure_s: float | None
    photons: float | None
    frames: Iterable[np.ndarray]


@dataclass(frozen=True)
class Preflight:
    """Checks of a few frames, and the reduced data of the frames."""

    checks: tuple[Check, ...]
    frames: Frames

    @property
    def verdict(self) -> str:
        """The worst of the checks: ok, warn or fail."""
        worst = max((c.verdict for c in self.checks), key=VERDICTS.index)
        return "ok" if worst == "not judged" else worst

    @property
    def findings(self) -> tuple[Finding, ...]:
        """What the checks found that are not ok."""
        return tuple(c.finding for c in self.checks if c.finding is not None)

    def __getitem__(self, name: str) -> Check:
        return {c.name: c for c in self.checks}[name]


def preflight(dark_frames: Iterable[np.ndarray], bright_levels: Sequence[BrightLevel | tuple[Any, Any, Any]], bits: int) -> Preflight:
    """Check a few frames; frames are taken one at a time.

    Parameters
    ----------
    dark_frames : iterable of ndarray, shape (rows, cols), uint8 or uint16
        Two or more, better four.
    bright_levels : sequence of BrightLevel
        Frames of an evenly lit field, two or more each: one level near half of saturation, or several in any order.
    bits : int
        Bits of a stored code.

    Returns
    -------
    Preflight
        A check on noise raises a false alarm in a good camera once in a million.

    Raises
    ------
    InputError
        No bright level, fewer than two frames in one, frames of different shapes, or codes above the bits.
    """
    if not bright_levels:
        raise InputError("no bright frames", where="preflight", remedy="add two or more of an evenly lit field near half of saturation")
    dark = reduce_frames(dark_frames, bits, what="dark frames")
    bright = [reduce_frames(frames, bits, s, p, "bright frames") for s, p, frames in bright_levels]
    for group in bright:
        if group.shape != dark.shape:
            raise InputError("bright and dark frames differ in shape", where="preflight", value=group.shape, allowed=str(dark.shape))
    frames = Frames(dark, tuple(sorted(bright, key=lambda g: g.mean_dn)))
    return Preflight(tuple(check(frames) for check in (*CODE_CHECKS, *LIGHT_CHECKS)), frames)


def preflight_record(result: Preflight) -> dict[str, Any]:
    """The checks as plain data, ready for JSON; ``null`` is a number that is not known."""
    checks = [{key: plain(item) for key, item in vars(c).items()} for c in result.checks]
    frames = {"dark": result.frames.dark.n_frames, "bright": [g.n_frames for g in result.frames.bright]}
    findings = [finding.to_record() for finding in result.findings]
    return {"verdict": result.verdict, "frames": frames, "checks": checks, "findings": findings}


def preflight_text(result: Preflight) -> str:
    """The checks as a table, with explanations below it."""
    dark, bright = result.frames.dark, result.frames.bright
    levels = f"{sum(g.n_frames for g in bright)} bright frames at {len(bright)} level{'s'[: len(bright) > 1]}"
    lines = [f"Preflight of {dark.n_frames} dark and {levels}: {result.verdict}", ""]
    for c in result.checks:
        value, spread = _numbers(c.value, c.u)
        lines.append(f"  {c.verdict:<11}{c.title:<44}{value:>9} {spread:<10}{c.unit:<6}{c.limit}")
    for finding in result.findings:
        lines += ["", *finding_lines(finding)]
    return "\n".join(lines) + "\n"


def _numbers(value: float, u: float) -> tuple[str, str]:
    """A value to the last digit of its u, and the u, of one digit."""
    if math.isnan(value):
        return "", ""
    if u > 0 and (places := max(-math.floor(math.log10(u)), 0)) < 8:
        return f"{value:.{places}f}".replace("-", "−"), f"± {u:.{places}f}"
    text = f"{value:.0f}" if value == round(value) else f"{value:.3g}"
    return text.replace("-", "−"), "± 0" if u == 0 else ""


def camera_from_preflight(result: Preflight, **more: Any) -> KnownCamera:
    """A first idea of the camera, to plan the test with; ``more`` are further fields of ``KnownCamera``.

    Notes
    -----
    K is the slope of the standard (R4.0 eq. 50) over the levels up to 70 % of the range; saturation is the highest code, or the mean of
    the brightest level where its noise tells that the pixels are full below that. Patterns are the mean squares of the mean maps less
    the noise in them. The scatter of the light is that of the frame means.

    Raises
    ------
    MeasureError
        If the variance does not grow with the light.
    """
    frames = result.frames
    dark, usable = frames.dark, frames.unsaturated
    top = frames.top_dn - dark.mean_dn
    fitted = [g for g in usable if g.mean_dn - dark.mean_dn <= FIT_RANGE * top] or list(usable[:1])
    if not fitted:
        raise MeasureError("every bright level is saturated", where="preflight", remedy="take frames near half of saturation")
    x = np.array([g.mean_dn - dark.mean_dn for g in fitted])
    y = np.array([g.squares.pixel_dn2 - dark.squares.pixel_dn2 for g in fitted])
    gain = float(x @ y / (x @ x))
    if not (gain > 0 and (x > 0).all()):
        raise MeasureError("the variance does not grow with the light", where="preflight", value=gain, remedy="see the failed checks")
    rows, cols = dark.shape
    lines = [max(dark.squares.row_dn2 - dark.squares.pixel_dn2 / cols, 0.0), max(dark.squares.col_dn2 - dark.squares.pixel_dn2 / rows, 0.0)]
    dsnu = (_parts(dark.mean_map_dn, dark) / gain).tolist()
    facts: dict[str, Any] = {
        "gain_dn_per_e": gain,
        "dark_noise_e": math.sqrt(max(dark.squares.pixel_dn2 - QUANTISATION_DN2, 0.0)) / gain,
        "row_noise_e": math.sqrt(lines[0]) / gain,
        "col_noise_e": math.sqrt(lines[1]) / gain,
        "saturation_e": top / gain,
        **dict(zip(("dsnu_pixel_e", "dsnu_row_e", "dsnu_col_e"), dsnu, strict=True)),
        "light_scatter_rel": max((flicker_rel(g, dark) for g in usable if g.n_frames >= FLICKER_FRAMES), default=0.0),
    }
    light = flattened(frames)
    if light is not None:
        prnu = (_parts(light.residual_dn, light.group, dark) / light.signal_dn).tolist()
        facts |= dict(zip(("prnu_pixel_rel", "prnu_row_rel", "prnu_col_rel"), prnu, strict=True))
    timed = usable[-1]
    if timed.exposure_s:
        facts["exposure_sat_s"] = timed.exposure_s * top / (timed.mean_dn - dark.mean_dn)
    if timed.photons:
        facts["quantum_efficiency"] = (timed.mean_dn - dark.mean_dn) / gain / timed.photons
    return KnownCamera(**{"rows": rows, "cols": cols, "bits": dark.bits, **facts, **more})


def _parts(image: np.ndarray, *noisy: Group) -> np.ndarray:
    """Standard deviations of pixel, row and column pattern of an image, its temporal noise taken off; zero where that is more."""
    rows, cols = image.shape
    strata = cross_strata(image, image)
    squares = np.array([strata.pixel, strata.row, strata.col]) / [(rows - 1) * (cols - 1), rows - 1, cols - 1]
    for g in noisy:
        squares -= np.array([g.squares.pixel_dn2, cols * g.squares.row_dn2, rows * g.squares.col_dn2]) / g.n_frames
    return np.sqrt(np.maximum([squares[0], (squares[1] - squares[0]) / cols, (squares[2] - squares[0]) / rows], 0.0))


LEVELS, FRAMES = 6, 16  # at most
REACH = 0.7  # of the brightest level's signal


class Look(NamedTuple):
    """Properties of a group from its first frame, for the choice of a stack."""

    exposure_s: float
    n_frames: int
    mean_dn: float
    fraction_max: float


def preflight_campaign(campaign: Campaign, bayer: str | None = None) -> dict[str, Preflight]:
    """Look at a few frames of a campaign, by channel: of the stacks that a test would take where there are any, and of some levels.

    A series goes through saturation on purpose: the levels that are looked at lie well below the brightest one, but for that one.

    Parameters
    ----------
    campaign : Campaign
    bayer : str, optional
        Colour filter; by default that of the campaign's camera.

    Raises
    ------
    InputError, MeasureError
        As from `pixmetry.emva.planning.preflight.preflight`.
    """
    reader = FrameReader(campaign)
    with campaign.named_in_errors():
        return {channel: _preflight(reader, part) for channel, part in phases(bayer or campaign.camera.cfa).items()}


def preflight_frames(
    dark: Callable[[], Iterable[np.ndarray]], bright: Sequence[Callable[[], Iterable[np.ndarray]]], bits: int, bayer: str | None = None
) -> dict[str, Preflight]:
    """Look at frames of unknown exposures, by channel; each function reads the frames of one condition from their beginning."""
    return {
        channel: preflight(_channels(dark(), part), [BrightLevel(None, None, _channels(level(), part)) for level in bright], bits)
        for channel, part in phases(bayer).items()
    }


def _channels(frames: Iterable[np.ndarray], part: Part) -> Iterator[np.ndarray]:
    return (np.ascontiguousarray(part(frame)) for frame in frames)


def _preflight(reader: FrameReader, part: Part) -> Preflight:
    campaign, look = reader.campaign, partial(_look, reader, part)
    darks, brights = campaign.stacks("dark"), campaign.stacks("bright")
    d, b = choose_stacks([look(g) for g in darks], [look(g) for g in brights])
    levels = sorted((g for g in campaign.levels("bright") if g.role == "level"), key=lambda g: g.photons or g.exposure_s)
    black = campaign.levels("dark")
    black_dn = look(black[0]).mean_dn if black else 0.0
    some = [*_below_saturation(levels, lambda g: look(g).mean_dn - black_dn), *([] if b is None else [brights[b]]), *levels[-1:]]
    exposure_s = some[len(some) // 2].exposure_s if some else 0.0
    dark = darks[d] if d is not None else min(black, key=lambda g: abs(g.exposure_s - exposure_s), default=None)

    def frames(group: FrameGroup) -> Iterator[np.ndarray]:
        return _channels(reader.frames(replace(group, paths=group.paths[:FRAMES])), part)

    darkness = iter(()) if dark is None else frames(dark)
    return preflight(darkness, [BrightLevel(g.exposure_s, g.photons, frames(g)) for g in some], campaign.bits)


def _look(reader: FrameReader, part: Part, group: FrameGroup) -> Look:
    frame = part(reader.fetch(group.paths[0]))
    return Look(group.exposure_s, len(group.paths), float(frame.mean()), float((frame == 2**reader.campaign.bits - 1).mean()))


def _below_saturation(levels: Sequence[FrameGroup], signal_dn: Callable[[FrameGroup], float]) -> list[FrameGroup]:
    """Some levels, evenly spaced among those well below the brightest; the levels go from dark to bright."""
    if not levels:
        return []
    below = levels[: bisect_right(levels[:-1], REACH * signal_dn(levels[-1]), key=signal_dn)]
    return [below[i] for i in sorted({round(i) for i in np.linspace(0, len(below) - 1, LEVELS)})] if below else []
