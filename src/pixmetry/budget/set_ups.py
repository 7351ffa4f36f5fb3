"""How the frames of each kind are taken, and which kind a source is measured from."""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

from pixmetry.budget.printed_charts import WEDGE_DENSITIES
from pixmetry.camera.catalogue import sources
from pixmetry.camera.observations import Observations
from pixmetry.core.errors import InputError, MeasureError

FLAT = "flat"  # dark and bright frames of an even field
FLAT_STEPS = 12
_KIND = re.compile(r"kind: (\w+)")


@dataclass(frozen=True)
class SetUp:
    """How the frames of one kind are taken.

    Parameters
    ----------
    kind : str
        As in the manifest; `FLAT` for dark and bright frames.
    title, scene, exposure : str
        What the frames show, and how they are exposed.
    usual : str
        The u that so many frames usually give.
    entries : tuple of dict
        Groups of the manifest; ``frames`` is how many each has.
    chart : str
        Name of the chart to print, without its ending; empty without.
    """

    kind: str
    title: str
    scene: str
    exposure: str
    usual: str
    entries: tuple[dict[str, Any], ...]
    chart: str = ""


def _series(kind: str, frames: int, **facts: Any) -> dict[str, Any]:
    return {"kind": kind, **facts, "frames": frames}


SET_UPS = {
    s.kind: s
    for s in (
        SetUp(
            FLAT,
            "Dark and even bright frames",
            "An even field without lens, or a defocused one; the same exposure times once more in the dark.",
            "12 exposure times from 3 % of saturation to saturation; the stacks at half of saturation.",
            "gain to 1 %, dark noise to 2 %",
            (
                *(_series(kind, 2, exposure_s=f"<t{k}>") for k in range(1, FLAT_STEPS + 1) for kind in ("dark", "bright")),
                *(_series(kind, 16, exposure_s="<t half of saturation>", role="stack") for kind in ("dark", "bright")),
            ),
        ),
        SetUp(
            "edge",
            "Slanted edges",
            "The chart in sharpest focus, 20 edges or more in the frame; nothing moves. For the sensor's tilt also at two settings of the "
            "focus to both sides of it, each a group with focus_um.",
            "White at 70 % of saturation.",
            "lens to 0.015 px, pixel width to 0.05 px",
            (_series("edge", 4),),
            "edges",
        ),
        SetUp(
            "line",
            "Thin upright lines",
            "The chart so that its lines are upright within a degree; camera and chart at rest.",
            "Lines at 70 % of saturation.",
            "line jitter to 3 %",
            (_series("line", 16),),
            "lines",
        ),
        SetUp(
            "chart",
            "Step wedge",
            "The wedge in even light, then a white sheet in its place. Measure the densities of your print. "
            "More accurate: one scene at eight exposure times in steps of a factor of 2.",
            "Brightest patch at 90 % of saturation; automatic gain and exposure off.",
            "exponent of the response to 0.02 (0.001 from one scene at eight exposures)",
            (_series("chart", 2, densities=list(WEDGE_DENSITIES), u_light_rel=0.02), _series("chart", 2, white=True)),
            "wedge",
        ),
        SetUp(
            "spots",
            "Bright spots on black",
            "The chart, or holes with a lamp behind them, in the middle third of the frame; the light does not change.",
            "The shortest at half of saturation; the others at 2, 5, 10 and 20 times saturation.",
            "smear to 1 %",
            tuple(_series("spots", 4, exposure_s=f"<t{k}>") for k in range(1, 6)),
            "spots",
        ),
        SetUp(
            "light_off",
            "A light that goes off",
            "An even field with an LED that is switched off between two frames; no frame is missing.",
            "Half of saturation; four bright frames, then 16 dark ones.",
            "share that stays behind to 1e-5",
            (_series("light_off", 20),),
        ),
        SetUp(
            "pattern",
            "Any scene with texture",
            "Files as they are stored, JPEG too.",
            "Between black and saturation.",
            "quality of JPEG exactly",
            (_series("pattern", 2),),
        ),
        SetUp(
            "dark_temperature",
            "Dark frames at several temperatures",
            "Lens capped; five temperatures over 15 K or more, each after half an hour.",
            "Two exposure times at each temperature, the longer as long as the camera allows.",
            "doubling temperature to 3 %",
            tuple(_series("dark", 8, exposure_s=f"<{word}>", temperature_c=f"<T{k}>") for k in range(1, 6) for word in ("short", "long")),
        ),
        SetUp(
            "covered",
            "Light and dark bars beside covered pixels",
            "Any picture with light and dark columns; the covered columns and rows are stored too (camera.covered).",
            "Light columns at 70 % of saturation.",
            "time of the transfer times the leak to 1 %",
            (_series("covered", 4, exposure_s="<t>"),),
        ),
        SetUp(
            "border",
            "Bright field with black borders",
            "A defocused even field; the window of the frame grabber larger than the image.",
            "Half of saturation.",
            "sampling clock to 1e-5 where the clocks beat",
            (_series("border", 8),),
        ),
        SetUp(
            "sequence",
            "A bright patch that comes and goes",
            "Frames in a row without a pause, nothing moves but a bright patch, a quarter of the frame, that comes and goes every 7 to 20 "
            "frames. Once more at a frame rate that is 1 % off. Of a rolling shutter state line_time_us.",
            "Brightest parts at 70 % of saturation, at most 4 ms; the camera's automatic gain as it is in use.",
            "loop of the gain to 1e-3, flicker to 1e-3 of the light",
            tuple(_series("sequence", 80, exposure_s="<t>", interval_s=f"<time from frame to frame {k}>") for k in (1, 2)),
        ),
        SetUp(
            "series",
            "A fixed field over time",
            "The chart, fixed to the camera's base; camera and frame grabber switched on at the first frame.",
            "White at 70 % of saturation; one frame a minute for 90 minutes.",
            "drift to 0.003 px",
            (_series("series", 90, interval_s=60.0, on_for_s=0.0),),
            "dots",
        ),
        SetUp(
            "motion",
            "Moving targets",
            "The chart on a slide or turntable: 100 to 1000 px/s, along x and y, both ways, and once at rest.",
            "Short enough that a target moves less than 4 px while it is exposed.",
            "time of a row, between fields and of the exposure to 0.3 %",
            tuple(_series("motion", 20, interval_s="<time from frame to frame>", exposure_s="<t>") for _ in range(4)),
            "dots",
        ),
        SetUp(
            "bands",
            "The same targets in light of several wavelengths",
            "The chart all over the frame, lit by one narrow-band lamp after the other; camera, lens and chart at rest, not focused anew. "
            "With the filter and without it, if there is one.",
            "White at 70 % of saturation in each light; the exposure may differ.",
            "lateral colour to 1e-7 per nm",
            (
                *(_series("bands", 8, exposure_s=f"<t{k}>", wavelength_nm=f"<nm {k}>") for k in range(1, 5)),
                _series("bands", 8, exposure_s="<t5>", wavelength_nm="<nm 5>", filtered=True),
            ),
            "dots",
        ),
        SetUp(
            "recording",
            "One scene, directly and recorded",
            "The chart, or any scene with sharp upright edges all over; nothing moves. Once directly, once from the recorder, by the same "
            "frame grabber.",
            "White at 70 % of saturation.",
            "quantiser to 1; jitter of a tape to 5 % (3 MHz) to 15 % (4.5 MHz)",
            (_series("recording", 16), _series("recording", 32, recorded=True)),
            "edges",
        ),
        SetUp(
            "views",
            "Targets from several sides",
            "The chart, or the targets of the measurement, from 8 sides up to the most oblique one; or one view, lit from 8 sides.",
            "Targets at 70 % of saturation, 6 px or more across.",
            "slope of the light to 15 %",
            (_series("views", 8, exposure_s="<t>"),),
            "dots",
        ),
        SetUp(
            "speckle",
            "A laser spot on a surface that moves",
            "The laser, the lens and its stop as in the measurement; laser and camera at rest. Between two frames move the surface "
            "sideways, by the size of the spot or more.",
            "Brightest grains below saturation: the mean spot at a tenth of it.",
            "scatter of the centre to 10 %, contrast to 0.02",
            (_series("speckle", 50, wavelength_nm="<nm>"),),
            "laser",
        ),
    )
}


def set_up_of(kind: str) -> SetUp:
    """The set-up of a kind of frames; of one that has none of its own here, how the manifest lists it."""
    plain = SetUp(kind, f"Frames of kind {kind}", "See the manifest's description.", "As described there.", "as described there", ())
    return SET_UPS.get(kind) or replace(plain, entries=(_series(kind, 4),))


@cache
def kind_of(source_id: str) -> str:
    """The kind of frames that a source is measured from, as its own reason names it; `FLAT` for dark and bright frames, empty for none."""
    source = sources().get(source_id)
    if source is None or source.measure is None:
        return ""
    try:
        source.measure(Observations())
    except (MeasureError, InputError) as problem:
        named = _KIND.search(str(problem))
        if named is not None:
            return named.group(1)
        return "" if "calibrat" in str(problem) else FLAT
    return FLAT
