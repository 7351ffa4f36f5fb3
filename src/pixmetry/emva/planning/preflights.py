"""A preflight of a campaign's frames: which of them it looks at; of a mosaic camera phase by phase."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import numpy as np

from pixmetry.emva.planning.preflight import BrightLevel, Preflight, preflight
from pixmetry.emva.reduction import phases
from pixmetry.files import Campaign, FrameReader
from pixmetry.files.records import FrameGroup
from pixmetry.observe.one_pass import Part
from pixmetry.observe.stack import choose_stacks

LEVELS, FRAMES = 6, 16  # at most
REACH = 0.7  # of the brightest level's signal


class Look(NamedTuple):
    """What the first frame of a group tells of it, as far as a stack is chosen by it."""

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
        channel: preflight(_parts(dark(), part), [BrightLevel(None, None, _parts(level(), part)) for level in bright], bits)
        for channel, part in phases(bayer).items()
    }


def _parts(frames: Iterable[np.ndarray], part: Part) -> Iterator[np.ndarray]:
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
        return _parts(reader.frames(replace(group, paths=group.paths[:FRAMES])), part)

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
