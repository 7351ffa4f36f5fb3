"""One target on its way through a camera: its image after every source, and how far its centre has moved so far."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from pixmetry.camera.camera import Camera, load_camera
from pixmetry.camera.conversions import HOLD, LOOK, SAMPLE, LineSources, Link, look
from pixmetry.camera.signal import Kind, Signal
from pixmetry.camera.source import run
from pixmetry.core.arguments import typed
from pixmetry.core.errors import InputError
from pixmetry.core.random import Grid

UNITS = {Kind.PHOTONS: "photons", Kind.ELECTRONS: "electrons", Kind.DN: "DN", Kind.CODES: "DN"}
LEVEL = 0.2  # of the contrast: what stands above it is weighed for the centre
MARGIN_PX = 8  # around the target
DRAW_STRIDE = 1_000_003  # between the seeds of several draws


def _axes(pairs: Mapping[str, tuple[float, float] | None]) -> dict[str, float | None]:
    return {f"{n}_{axis}_px": None if p is None else float(p[k]) for n, p in pairs.items() for k, axis in enumerate("xy")}


@dataclass(frozen=True)
class Step:
    """The target after one source.

    Parameters
    ----------
    name, title, source_id : str
    unit : str
        Of the grey values.
    image, expected : ndarray, shape (rows, cols)
        The window in this frame, and as it is expected of this unit (every temporal draw at its mean).
    origin : (int, int)
        Column and row of the window's first pixel.
    reference : (float, float)
        Where the target's true centre belongs in a frame of this layout, x and y.
    error, expected_error : (float, float) or None
        Centre found less the true one in px: in this frame, and as expected. None where there is no target to be seen.
    moved, expected_moved : (float, float) or None
        What this source added to them, in pixels of its own frame.
    """

    name: str
    title: str
    source_id: str
    unit: str
    image: np.ndarray
    expected: np.ndarray
    origin: tuple[int, int]
    reference: tuple[float, float]
    error: tuple[float, float] | None
    expected_error: tuple[float, float] | None
    moved: tuple[float, float] | None
    expected_moved: tuple[float, float] | None

    def to_record(self) -> dict[str, Any]:
        """Return the plain record; positions in px, x and y apart."""
        pairs = {"error": self.error, "moved": self.moved, "expected_error": self.expected_error, "expected_moved": self.expected_moved}
        images = {"col0": self.origin[0], "row0": self.origin[1], "unit": self.unit, "image": self.image.tolist()}
        return {"name": self.name, "source_id": self.source_id, "title": self.title} | _axes(pairs) | images


@dataclass(frozen=True)
class Spread:
    """What a source moves centres by, over several targets and exposures, in px in x and y.

    Parameters
    ----------
    name, title, source_id : str
    constant : (float, float)
        Mean over the targets.
    place : (float, float)
        Standard deviation from target to target, as expected of this unit; 0 of a scene with one target.
    time : (float, float)
        Standard deviation of single exposures about what is expected.
    """

    name: str
    title: str
    source_id: str
    constant: tuple[float, float]
    place: tuple[float, float]
    time: tuple[float, float]

    def to_record(self) -> dict[str, Any]:
        """Return the plain record; in px, x and y apart."""
        parts = _axes({"constant": self.constant, "place": self.place, "time": self.time})
        return {"name": self.name, "source_id": self.source_id, "title": self.title} | parts

    @property
    def square(self) -> float:
        """Everything together, squared."""
        return float(sum(v**2 for pair in (self.constant, self.place, self.time) for v in pair))


@dataclass(frozen=True)
class Walk:
    """All steps of one target in one frame of one camera; ``spread`` is over ``draws`` targets and exposures."""

    camera: Camera
    target: Mapping[str, Any]
    frame: int
    seed: int
    steps: tuple[Step, ...]
    spread: tuple[Spread, ...] = ()
    draws: int = 1

    def movers(self) -> list[Step]:
        """The sources that moved the centre in this frame, the strongest first."""
        by = [(float(np.hypot(*s.moved)), s) for s in self.steps[1:] if s.moved is not None]
        return [step for px, step in sorted(by, key=lambda pair: -pair[0]) if px > 1e-6]

    def to_record(self) -> dict[str, Any]:
        """Return the plain record, schema ``pixmetry/chain/1``."""
        return {
            "schema": "pixmetry/chain/1",
            "camera": self.camera.name,
            "target": dict(self.target),
            "frame": self.frame,
            "seed": self.seed,
            "draws": self.draws,
            "steps": [s.to_record() for s in self.steps],
            "spread": [s.to_record() for s in self.spread],
        }


@typed
def chain(camera: str | Path | Camera, scene: Any, *, target: int | None = None, frame: int = 0, seed: int = 0, draws: int = 1) -> Walk:
    """Follow one target through a camera.

    Parameters
    ----------
    camera : path, name of a preset, or Camera
    scene : path, mapping or Scene
        With at least one target, or the middle of the frame is shown.
    target : int, optional
        Which of the scene's targets; by default the one nearest to the middle of the frame.
    frame, seed : int
        Of the exposure.
    draws : int
        With more than one, as many exposures, each of the next target of the scene, say what is constant and what varies.

    Returns
    -------
    Walk
        Its first step is the scene itself, seen by full pixels without any error.

    Raises
    ------
    InputError
        If the camera, the scene or the target cannot be used.

    Examples
    --------
    >>> discs = {"x_px": [100.3], "y_px": [80.6], "diameter_px": 7, "blur_px": 0.7, "peak_photons": 9000}
    >>> scene = {"schema": "pixmetry/scene/1", "discs": discs}
    >>> walk = chain("imx264_like", scene, seed=3)
    >>> walk.steps[0].name, len(walk.steps) > 5
    ('scene', True)
    """
    camera = camera if isinstance(camera, Camera) else load_camera(camera)
    if frame < 0:
        raise InputError("no such frame", value=frame, allowed="0 or more")
    if isinstance(scene, str | Path | Mapping):
        from pixmetry.scene.files import build_scene, read_scene

        where = "scene" if isinstance(scene, Mapping) else str(scene)
        scene = build_scene(read_scene(scene), camera.frame_shape, where)
    first = _walk(camera, scene, target, frame, seed)
    if draws < 2 or not first.target["found"]:
        return first
    others = _others(scene, camera, first.target, frame)
    walks = [first]
    for k in range(1, draws):
        try:
            walks.append(_walk(camera, scene, others[k % len(others)], frame, seed + k * DRAW_STRIDE))
        except InputError:  # that target is not in the frame
            continue
    return replace(first, spread=_spread_of(walks), draws=len(walks))


def _others(scene: Any, camera: Camera, chosen: Mapping[str, Any], frame: int) -> list[int]:
    """Numbers of the scene's targets, the nearest to the chosen one first."""
    exposed = camera.signal(scene, Grid(np.array([frame]), np.zeros(1, int), np.zeros(1, int), (1, 1)))
    offered = list(scene.targets(float(exposed.time_s[0] + 0.5 * exposed.exposure_s[0]), frame))
    return np.argsort([np.hypot(t["x_px"] - chosen["x_px"], t["y_px"] - chosen["y_px"]) for t in offered], kind="stable").tolist()


def _spread_of(walks: Sequence[Walk]) -> tuple[Spread, ...]:
    """Mean over the targets, deviation from target to target, and of single exposures about what is expected."""
    found = []
    for position, step in enumerate(walks[0].steps[1:], start=1):
        steps = [w.steps[position] for w in walks]
        seen = [(s.moved, s.expected_moved) for s in steps if s.moved is not None and s.expected_moved is not None]
        if not seen:
            continue
        moved, expected = (np.array(v) for v in zip(*seen, strict=True))
        place = np.std(expected, axis=0, ddof=1) if len(expected) > 1 else np.zeros(2)
        pairs = (expected.mean(axis=0), place, np.sqrt(np.mean((moved - expected) ** 2, axis=0)))
        constant, place_px, time = ((float(p[0]), float(p[1])) for p in pairs)
        found.append(Spread(step.name, step.title, step.source_id, constant, place_px, time))
    return tuple(found)


def _walk(camera: Camera, scene: Any, target: int | None, frame: int, seed: int) -> Walk:
    """Follow one target through one exposure."""
    chosen = _choose(scene, camera, target, frame, seed)
    half = int(np.ceil(0.5 * chosen["size_px"])) + MARGIN_PX
    former = (1.0, 1.0)
    pairs = zip(_images(camera, scene, frame, seed, False), _images(camera, scene, frame, seed, True), strict=True)
    steps: list[Step] = []
    for (link, position, signal), (_, _, quiet) in pairs:
        prefix = replace(camera, chain=camera.active[:position])
        beside_x, beside_y = ([chosen[axis], chosen[axis] + 1.0] for axis in ("x_px", "y_px"))
        (x, x1), (y, y1) = (v.tolist() for v in prefix.layout(beside_x, beside_y, frame))
        scale = (x1 - x, y1 - y)  # pixels of this frame for one of the scene
        window = _window(signal, x, y, half)
        image, expected = (_cut(s, window) for s in (signal, quiet))
        found = [_centre(v, x - window[1], y - window[0]) if chosen["found"] else None for v in (image, expected)]
        error = [None if f is None else (f[0] + window[1] - x, f[1] + window[0] - y) for f in found]
        before = steps[-1] if steps else None
        steps.append(
            Step(
                name="scene" if link is None else link.name,
                title="The scene on ideal pixels" if link is None else link.source.title,
                source_id="" if link is None else link.source.id,
                unit=UNITS[signal.kind],
                image=image,
                expected=expected,
                origin=(window[1], window[0]),
                reference=(x, y),
                error=error[0],
                expected_error=error[1],
                moved=_added(error[0], before.error if before else None, scale, former),
                expected_moved=_added(error[1], before.expected_error if before else None, scale, former),
            )
        )
        former = scale
    return Walk(camera, chosen, frame, seed, tuple(steps))


def _choose(scene: Any, camera: Camera, target: int | None, frame: int, seed: int) -> dict[str, Any]:
    """The target to follow: its place and size in the scene's plane."""
    rows, cols = camera.frame_shape
    exposed = camera.signal(scene, Grid(np.array([frame]), np.zeros(1, int), np.zeros(1, int), (1, 1)))
    time = float(exposed.time_s[0] + 0.5 * exposed.exposure_s[0])
    offered = list(scene.targets(time, frame)) if hasattr(scene, "targets") else []
    if target is not None and not 0 <= target < len(offered):
        allowed = f"0 to {len(offered) - 1}" if offered else "a scene with targets"
        raise InputError("the scene has no such target", value=target, allowed=allowed)
    if not offered:
        return {"x_px": 0.5 * (cols - 1), "y_px": 0.5 * (rows - 1), "size_px": 24.0, "found": False, "kind": "none"}
    if target is None:
        target = int(np.argmin([np.hypot(t["x_px"] - 0.5 * (cols - 1), t["y_px"] - 0.5 * (rows - 1)) for t in offered]))
    one = offered[target]
    (x,), (y,) = camera.true_positions(one["x_px"], one["y_px"], frame, seed)
    out_rows, out_cols = camera.output_shape
    if not (-0.5 <= x <= out_cols - 0.5 and -0.5 <= y <= out_rows - 0.5):
        place = f"x {one['x_px']:g}, y {one['y_px']:g} px"
        allowed = f"a position within the frame of {out_cols} x {out_rows} pixels"
        remedy = "choose another with --target, or move it"
        raise InputError(f"target {target} lies outside of the frame", value=place, allowed=allowed, remedy=remedy)
    size = float(min(one.get("size_px") or one.get("diameter_px") or 12.0, 200.0))
    return {**one, "number": target, "size_px": size, "found": True}


def _images(camera: Camera, scene: Any, frame: int, seed: int, quiet: bool) -> Iterator[tuple[Link | None, int, Signal]]:
    """The whole frame after every source: the source, how many of the camera's were run, and the frame as numbers."""
    streams = camera.streams(seed, quiet)
    states: dict[str, Any] = {}
    if any(link.remembers for link in camera.links):
        for number in range(frame):
            for _ in _run(camera, scene, number, streams, states):
                pass
    first = camera.signal(scene, Grid.whole([frame], camera.frame_shape))
    yield None, 0, look(first)
    done = 0
    for link, signal, on_line in _run(camera, scene, frame, streams, states):
        if link.source in (LOOK, HOLD, SAMPLE):
            continue
        done += 1
        if signal.kind is Kind.LIGHT:
            signal = look(signal)
        elif signal.kind is Kind.VIDEO:
            params = LineSources(tuple(on_line), camera.pixel_clock_hz)
            signal, _ = run(SAMPLE, params, signal, streams.of(SAMPLE.id))
        yield link, done, signal


def _run(camera: Camera, scene: Any, frame: int, streams: Any, states: dict[str, Any]) -> Iterator[tuple[Link, Signal, list[Link]]]:
    signal = camera.signal(scene, Grid.whole([frame], camera.frame_shape))
    on_line: list[Link] = []
    for link in camera.links:
        signal, states[link.name] = run(link.source, link.params, signal, streams.of(link.name), states.get(link.name))
        on_line = [*on_line, link] if link.source.consumes == (Kind.VIDEO,) else []
        yield link, signal, on_line


def _window(signal: Signal, x: float, y: float, half: int) -> tuple[int, int, int, int]:
    """First row and column, rows and columns of a window about a place, inside the frame."""
    rows, cols = signal.data.shape[1:]
    r0 = int(np.clip(np.rint(y) - half, 0, max(rows - 2 * half - 1, 0)))
    c0 = int(np.clip(np.rint(x) - half, 0, max(cols - 2 * half - 1, 0)))
    return r0, c0, min(2 * half + 1, rows), min(2 * half + 1, cols)


def _cut(signal: Signal, window: tuple[int, int, int, int]) -> np.ndarray:
    r, c, h, w = window
    return signal.data[0, r : r + h, c : c + w].astype(float)


def _centre(image: np.ndarray, x: float, y: float) -> tuple[float, float] | None:
    """Centroid of what stands out of the background by more than `LEVEL` of the contrast, near a place; bright or dark targets.

    Of the connected regions, the one that lies nearest to the place. None if nothing stands out.
    """
    from scipy.ndimage import center_of_mass, label

    border = np.concatenate([image[0], image[-1], image[1:-1, 0], image[1:-1, -1]])
    background = float(np.median(border))
    scatter = 1.4826 * float(np.median(np.abs(border - background)))
    height = image - background
    at = slice(max(int(y) - 2, 0), int(y) + 4), slice(max(int(x) - 2, 0), int(x) + 4)
    core = height[at] if height[at].size else height
    if abs(np.median(core)) < abs(core.flat[np.argmax(np.abs(core))]) * 0.25:  # a ring or a small target: its strongest pixels count
        core = height
    peak = float(core.flat[np.argmax(np.abs(core))])
    height = height * np.sign(peak)
    if abs(peak) <= 5 * scatter or peak == 0:
        return None
    regions, count = label(height > LEVEL * abs(peak))
    weight = np.maximum(height - LEVEL * abs(peak), 0.0)
    centres = np.array(center_of_mass(weight, regions, range(1, count + 1)))[:, ::-1]
    distance = np.hypot(*(centres - (x, y)).T) / np.sqrt(np.bincount(regions.ravel())[1:])  # in sizes of the region
    best = centres[np.argmin(distance)]
    return float(best[0]), float(best[1])


def _added(now: Any, before: Any, scale: tuple[float, float], former: tuple[float, float]) -> tuple[float, float] | None:
    """What came on top of an error that was already there, carried into a frame of another pixel size."""
    if now is None or before is None:
        return None
    return now[0] - before[0] * scale[0] / former[0], now[1] - before[1] * scale[1] / former[1]
