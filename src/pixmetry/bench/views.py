"""Other looks at a state: even fields, the video of a line, the hour after switching on, a way over a pixel, when the rows are exposed."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from pixmetry.bench.picture import Picture, found_in, picture_of
from pixmetry.bench.state import BenchState, Layout, Shelf
from pixmetry.budget.setting import Setting
from pixmetry.camera.camera import NOWHERE
from pixmetry.camera.conversions import LineSources
from pixmetry.camera.kept_steps import KeptSteps
from pixmetry.camera.signal import Kind
from pixmetry.core.errors import InputError
from pixmetry.core.random import Grid
from pixmetry.scene.uniform import Uniform
from pixmetry.simulate.job import stored_bits

FLAT_REL = 0.5  # of saturation: light of the even field
HOUR_MIN = 60
FINE = 8  # points of the video for a sample
PLACES = 13  # over a pixel
TAILS = (0.5, 99.5)  # percentiles between which an even field is stretched


def even_fields(layout: Layout, kept: KeptSteps) -> dict[str, Any]:
    """The window of an even field at half of saturation, and of a dark one, each with the grey values between which it is stretched."""
    return {
        "flat": _even(layout, kept, FLAT_REL * layout.full_photons),
        "dark": _even(layout, kept, 0.0),
    }


def _even(layout: Layout, kept: KeptSteps, photons: float) -> dict[str, Any]:
    window, bits = layout.window, stored_bits(layout.camera)
    codes = kept.window(layout.camera, Uniform(photons), f"even {photons!r}", window, layout.state.seed).data[0]
    low, high = (float(v) for v in np.percentile(codes, TAILS))
    picture = Picture(codes.astype(np.uint8 if bits <= 8 else np.uint16), window[0], window[1], bits)
    words = {"mean_dn": float(codes.mean(dtype=float)), "std_dn": float(codes.std(dtype=float))}
    return {"picture": picture.to_record(), "stretched": [low, max(high, low + 1.0)], **words}


def video_line(layout: Layout, kept: KeptSteps) -> dict[str, Any]:
    """The video of the row through the target against time in µs, jitter and noise of the line at their means, and the codes stored of it.

    Raises
    ------
    InputError
        If the camera has no analogue line.
    """
    camera = layout.camera
    analogue = [i for i, e in enumerate(camera.active) if Kind.VIDEO in e.source.consumes]
    if not analogue:
        raise InputError(
            f"{camera.name} has no analogue video line: its pixels are stored as they are", remedy="choose a camera with a grabber"
        )
    ahead = replace(camera, chain=camera.active[: analogue[0]])
    rows, cols = ahead.output_shape
    row = int(np.clip(round(layout.place[1]), 0, rows - 1))
    pixels = kept.window(ahead, layout.seen, repr(layout.scene), (row, 0, 1, cols), layout.state.seed)
    links = tuple(e for e in camera.links if Kind.VIDEO in e.source.consumes and e.source.produces is None)
    line = LineSources(links, camera.pixel_clock_hz, cols).line_at(pixels).limited()
    fine = replace(line, sample_clock_hz=FINE * line.sample_clock_hz, samples=None, noise=())
    middle = float(line.placed(np.array([layout.place[0]]))[0])
    first = max(int(middle) - 24, 0)
    grid = Grid(pixels.grid.frame, pixels.grid.row0, np.array([FINE * first]), (1, FINE * 49))
    seen = fine.read(pixels.data, pixels.grid.col0, grid)[0, 0]
    at_us = 1e6 * ((grid.col0[0] + np.arange(seen.size) + 0.5) / fine.sample_clock_hz + line.start_s)
    sampled_us = 1e6 * ((first + np.arange(49) + 0.5) / line.sample_clock_hz + line.start_s)
    codes = picture_of(layout, kept)
    own = codes.codes[_row_in(codes, layout.middle_px[1])]
    columns = range(first - codes.col0, first - codes.col0 + 49)
    stored = [int(own[c]) if 0 <= c < len(own) else None for c in columns]
    return {
        "video_us": at_us.tolist(),
        "video_dn": seen.tolist(),
        "pixel_us": (1e6 * (np.arange(cols) + 0.5) / camera.pixel_clock_hz).tolist(),
        "pixel_dn": pixels.data[0, 0].tolist(),
        "sample_us": sampled_us.tolist(),
        "stored_dn": stored,
    }


def _row_in(picture: Picture, y_px: float) -> int:
    return int(np.clip(round(float(y_px)) - picture.row0, 0, picture.codes.shape[0] - 1))


def hour(layout: Layout) -> dict[str, Any]:
    """Where the target is seen in the first hour after camera and grabber were switched on, less where it is seen at its end."""
    place, seed, scenario = layout.place, layout.state.seed, layout.scenario
    seen, warm = [], []
    for minute in range(HOUR_MIN + 1):
        state = scenario.state.model_copy(update={"camera_on_min": float(minute), "grabber_on_min": float(minute)})
        camera = Setting(layout.setting.described, scenario.model_copy(update={"state": state})).camera
        x, y = camera.true_positions(*place, 0, seed)
        seen.append((float(x[0]), float(y[0])))
        warm.append(camera.temperature_c)
    moved = np.array(seen) - seen[-1]
    return {
        "minutes": list(range(HOUR_MIN + 1)),
        "x_px": moved[:, 0].tolist(),
        "y_px": moved[:, 1].tolist(),
        "temperature_c": warm,
        "now_min": [scenario.state.camera_on_min, scenario.state.grabber_on_min],
    }


def over_a_pixel(shelf: Shelf, state: BenchState, kept: KeptSteps, go_on: Callable[[], None]) -> dict[str, Any]:
    """Error of the chosen estimator, and of the template, while the target goes over a pixel along x; every temporal draw at its mean.

    ``go_on`` is called now and then; it raises to end the work.

    Raises
    ------
    InputError
        If the scene is that of a file.
    """
    if state.scene is not None:
        raise InputError("the targets of a scene file stay where they are", remedy="use one target in place of the scene")
    layout = shelf.laid_out(state)
    x0, y0 = layout.place
    places = np.linspace(-0.5, 0.5, PLACES)
    names = list(dict.fromkeys([state.estimator, "template"]))
    errors: dict[str, list[float | None]] = {name: [] for name in names}
    for dx in places:
        one = shelf.laid_out(state.model_copy(update={"x_px": float(round(x0) + dx), "y_px": y0, "side_px": 64}))
        picture = picture_of(one, kept, quiet=True, go_on=go_on)
        for name in names:
            target = found_in(picture, replace(one, state=one.state.model_copy(update={"estimator": name})), one.true_px)
            errors[name].append(None if target.error_px is None else target.error_px[0])
    found = {name: [v for v in values if v is not None] for name, values in errors.items()}
    ranges = {name: float(np.ptp(values)) if values else None for name, values in found.items()}
    return {"place_px": places.tolist(), "errors_px": errors, "range_px": ranges}


def exposed_rows(layout: Layout) -> dict[str, Any]:
    """When each row of the window is exposed, ms from the start of the frame, and where the target is meanwhile.

    The middle of a row's exposure is told by the sources that let rows look at other times.
    """
    camera = layout.camera
    row0, _, height, _ = layout.window
    signal = camera.signal(NOWHERE, Grid.whole([0], camera.frame_shape))
    rows = camera.frame_shape[0]
    delay, length = np.zeros(rows), np.full(rows, camera.exposure_s)
    streams = camera.streams(layout.state.seed)
    for e in camera.active:
        if e.source.truth is None or e.source.stage != "sensor":
            continue
        told = e.source.truth(e.params, signal, streams.of(e.name)) if e.source.id in ("sensor.interlace", "sensor.rolling_shutter") else {}
        delay = delay + np.asarray(told.get("delay_s", np.zeros((1, rows))))[0]
        length = length * np.asarray(told.get("exposure_rel", np.ones((1, rows))))[0]
    last = min(row0 + height, rows)
    begin = delay[row0:last] + 0.5 * (camera.exposure_s - length[row0:last])
    end = begin + length[row0:last]
    times = np.linspace(float(begin.min()), float(end.max()), 25)
    path = []
    for t in times:
        path.append(layout.target_at(float(t)) or layout.place)
    return {
        "row0": row0,
        "begin_ms": (1e3 * begin).tolist(),
        "end_ms": (1e3 * end).tolist(),
        "time_ms": (1e3 * times).tolist(),
        "path_px": path,
        "moves": len(set(path)) > 1,
        "diameter_px": layout.setting.target.diameter_px,
    }
