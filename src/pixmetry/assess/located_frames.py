"""What the frames tell in which targets are located: over time, from several sides, in several colours, directly and recorded."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from pixmetry.camera.observations import Observations
from pixmetry.core.errors import MeasureError
from pixmetry.files import Campaign
from pixmetry.files.records import FrameGroup
from pixmetry.series.bands import measure_bands
from pixmetry.series.job import measure_motion, measure_recordings, measure_series
from pixmetry.series.views import measure_views

Fetch = Callable[[Path], np.ndarray]
OnFrames = Callable[[int], object]


def with_located(seen: Observations, campaign: Campaign, fetch: Fetch, on_frames: OnFrames) -> Observations:
    """Add what each of these kinds of frames tells, or why it tells nothing: the rest of the campaign is measured all the same."""
    for kind, (what, add) in READERS.items():
        groups = [g for g in campaign.groups if g.kind == kind]
        try:
            seen = add(seen, campaign, groups, fetch, on_frames) if groups else seen
        except MeasureError as problem:
            seen = replace(seen, failed={**seen.failed, kind: problem.what}, notes=(*seen.notes, f"{what} tell nothing: {problem}"))
    return seen


def _times(group: FrameGroup) -> Sequence[float]:
    """Seconds of the frames of a group, as stated."""
    return group.facts.times_s or [k * (group.facts.interval_s or 1.0) for k in range(len(group.paths))]


def _with_series(seen: Observations, campaign: Campaign, groups: Sequence[FrameGroup], fetch: Fetch, on_frames: OnFrames) -> Observations:
    """What the longest series of a fixed field tells."""
    group = max(groups, key=lambda g: len(g.paths))
    others = f"of {len(groups)} series the one of the most frames is used" if len(groups) > 1 else ""
    on_for_s = group.facts.on_for_s or 0.0
    frames = [(path.name, on_for_s + time, partial(fetch, path)) for path, time in zip(group.paths, _times(group), strict=True)]
    order = sorted(range(len(frames)), key=lambda k: frames[k][1])
    told = group.facts.temperatures_c
    found = measure_series(
        [frames[k] for k in order],
        analogue=campaign.camera.interface == "analogue",
        pixel_clock_mhz=campaign.camera.pixel_clock_mhz,
        temperatures_c=None if told is None else [told[k] for k in order],
        progress=lambda what, done, of: (on_frames(1), None)[1],
        bits=campaign.bits,
    )
    return replace(seen, drift=found.drift, notes=(*seen.notes, *filter(None, (others, *found.notes))))


def _with_motion(seen: Observations, campaign: Campaign, groups: Sequence[FrameGroup], fetch: Fetch, on_frames: OnFrames) -> Observations:
    """What frames of moving targets tell; each group is a run of frames that were taken one after the other."""
    runs = [[(path.name, time, partial(fetch, path)) for path, time in zip(g.paths, _times(g), strict=True)] for g in groups]
    exposures, pulsed = [g.exposure_s for g in groups], [bool(g.facts.pulsed) for g in groups]
    found = measure_motion(runs, campaign.frame_shape, exposures_s=exposures, pulsed=pulsed, on_frames=on_frames, bits=campaign.bits)
    return replace(seen, motion=found)


def _with_recordings(
    seen: Observations, campaign: Campaign, groups: Sequence[FrameGroup], fetch: Fetch, on_frames: OnFrames
) -> Observations:
    """What a scene tells of a recorder, directly and recorded; of several groups the longest of each."""
    sides = [max((g.paths for g in groups if bool(g.facts.recorded) is played), key=len, default=()) for played in (False, True)]
    fetches = [[partial(fetch, path) for path in paths] for paths in sides]
    analogue = campaign.camera.interface == "analogue"
    return replace(seen, recordings=measure_recordings(*fetches, analogue=analogue, bits=campaign.bits, on_frames=on_frames))


def _with_views(seen: Observations, campaign: Campaign, groups: Sequence[FrameGroup], fetch: Fetch, on_frames: OnFrames) -> Observations:
    """What frames of targets that are seen or lit from several sides tell; each frame is a view."""
    frames = [(path.name, g.exposure_s, partial(fetch, path)) for g in groups for path in g.paths]
    stated, focal = campaign.stated, campaign.optics.focal_length_mm
    pitch = stated.pitch_x_um
    distance = None if pitch is None or focal is None else 1e3 * focal / pitch
    ratio = 1.0 if pitch is None or stated.pitch_y_um is None else stated.pitch_y_um / pitch
    found = measure_views(frames, distance, ratio, _shading(seen), on_frames=on_frames, bits=campaign.bits)
    return replace(seen, views=found, notes=(*seen.notes, *(f"Views of targets: {n}" for n in found.notes)))


def _with_bands(seen: Observations, campaign: Campaign, groups: Sequence[FrameGroup], fetch: Fetch, on_frames: OnFrames) -> Observations:
    """What frames of the same targets in light of several wavelengths tell; each group is a band."""
    bands = [
        (
            [(path.name, partial(fetch, path)) for path in g.paths],
            {
                "wavelength_nm": g.facts.wavelength_nm,
                "name": g.facts.band or "",
                "filtered": bool(g.facts.filtered),
                "refocused": bool(g.facts.refocused),
                "exposure_s": g.exposure_s,
                "on_frames": on_frames,
            },
        )
        for g in groups
    ]
    found = measure_bands(bands, campaign.frame_shape, campaign.stated, bits=campaign.bits)
    return replace(seen, bands=found, notes=(*seen.notes, *(f"Bands: {n}" for n in found.notes)))


def _shading(seen: Observations) -> float:
    """Largest relative slope of an even field, 1/px; 0 where it was not measured."""
    fit = seen.spatial_fit
    names = [n for n in ("gradient_x_per_px", "gradient_y_per_px") if fit is not None and n in fit]
    return max((abs(fit[n].value) for n in names), default=0.0) if fit is not None else 0.0


READERS = {  # by kind of frames: what a note calls them, and who adds what they tell
    "series": ("the frames of a fixed field", _with_series),
    "motion": ("the frames of moving targets", _with_motion),
    "recording": ("the recordings", _with_recordings),
    "views": ("the views of targets", _with_views),
    "bands": ("the bands", _with_bands),
}
