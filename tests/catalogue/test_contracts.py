"""What every error source of the catalogue keeps, whatever it models."""

from __future__ import annotations

import re
from functools import cache
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from catalogue.support import NAME, SHAPE, Amplitude, Texture, camera_with, frame_maps, kind_of, make_source, truth_maps
from pixmetry.camera import bands
from pixmetry.camera.camera import Camera, Element
from pixmetry.camera.catalogue import sources
from pixmetry.camera.contribution import CLASSES
from pixmetry.camera.signal import Kind, Signal
from pixmetry.camera.source import Parameters, Source, quantity, run
from pixmetry.core.errors import ChainError, InputError
from pixmetry.core.random import Grid

SOURCES = sources()
SCENE = Texture()
every_source = pytest.mark.parametrize("source", SOURCES.values(), ids=SOURCES.keys())
IN_FRAMES = {i: s for i, s in SOURCES.items() if s.forward is not None}
every_forward = pytest.mark.parametrize("source", IN_FRAMES.values(), ids=IN_FRAMES.keys())
corners = [(0, 0, 9, 7), (-9, -7, 9, 7), (0, -5, 12, 5), (-3, 0, 3, 21), (17, 22, 11, 13), (20, 31, 1, 1)]  # negative: from the far side


def within(window: tuple[int, int, int, int], shape: tuple[int, int]) -> tuple[int, int, int, int]:
    """The window in a frame of this shape."""
    r, c, h, w = window
    return r % shape[0], c % shape[1], h, w


@cache
def whole(source_id: str) -> np.ndarray:
    """Three frames of the smallest camera around a source, with its typical parameters."""
    return camera_with(SOURCES[source_id]).expose(SCENE, 3, seed=11).data


def has_memory(source: Source) -> bool:
    return source.start is not None


@every_forward
def test_neutral_parameters_change_nothing(source: Source) -> None:
    if source.neutral is None:
        pytest.skip(source.reasons["neutral"])
    camera = camera_with(source, source.neutral)
    assert np.array_equal(camera.expose(SCENE, 2).data, camera.switched(off=[NAME]).expose(SCENE, 2).data)


@every_forward
def test_typical_and_bound_parameters_change_something(source: Source) -> None:
    scenes = [SCENE] if kind_of(source) is Kind.CODES else [SCENE, Texture(30.0), Texture(2000.0)]  # the last one fills the wells
    for params in (source.typical, source.bound):
        camera = camera_with(source, params)
        assert any(not np.array_equal(camera.expose(s, 2).data, camera.switched(off=[NAME]).expose(s, 2).data) for s in scenes)


def met_by(source: Source, camera: Camera) -> Signal:
    """Two whole frames as the source meets them."""
    signal = camera.signal(SCENE, Grid.whole([0, 1], SHAPE))
    for link in camera.links:
        if link.name == NAME:
            return signal
        signal, _ = run(link.source, link.params, signal, camera.streams(0).of(link.name))
    raise AssertionError


@every_forward
def test_the_input_is_not_touched_and_the_output_is_of_the_kind_declared(source: Source) -> None:
    camera = camera_with(source)
    signal = met_by(source, camera)
    signal.data.setflags(write=False)
    before = signal.data.copy()
    for streams in (camera.streams(0), camera.streams(0, quiet=True)):
        extra = () if source.start is None else (source.start(source.typical),)
        result = source.forward(source.typical, signal, streams.of(NAME), *extra)
        out = result if source.start is None else result[0]
        assert np.array_equal(signal.data, before)
        assert out.kind == (source.produces or signal.kind)
        assert source.reshape is not None or out.data.shape == signal.data.shape
        assert out.data.dtype == (np.uint16 if out.kind is Kind.CODES else np.float32)
        assert np.isfinite(out.data).all()
        assert not np.shares_memory(out.data, signal.data) or np.array_equal(out.data, before)


@every_forward
def test_darkness_and_strong_light_give_finite_numbers(source: Source) -> None:
    for mean in (0.0, 1.0) + (() if kind_of(source) is Kind.CODES else (1e4,)):
        out = camera_with(source).expose(Texture(mean), 1).data
        assert np.isfinite(out).all()


@every_forward
@pytest.mark.parametrize("window", corners)
def test_a_window_equals_the_crop(source: Source, window: tuple[int, int, int, int]) -> None:
    camera = camera_with(source)
    r, c, h, w = within(window, camera.output_shape)
    got = camera.expose(SCENE, 3, seed=11, window=(r, c, h, w)).data
    assert np.array_equal(got, whole(source.id)[:, r : r + h, c : c + w])


@every_forward
def test_windows_in_one_batch_equal_windows_one_by_one_and_the_crops(source: Source) -> None:
    if has_memory(source):
        pytest.skip("single windows of a source with a memory are refused in this mode")
    camera = camera_with(source)
    rows, cols = camera.output_shape
    frame, row = np.array([0, 2, 1, 0, 2, 1]), np.array([0, rows - 11, 5, rows // 3, rows - 11, 0])
    col = np.array([0, cols - 11, 17, cols - 11, 0, cols // 2 - 2])
    batch = camera.expose_windows(SCENE, Grid(frame, row, col, (11, 11)), seed=11)
    for i, (f, r, c) in enumerate(zip(frame, row, col, strict=True)):
        one = camera.expose_windows(SCENE, Grid(frame[i : i + 1], row[i : i + 1], col[i : i + 1], (11, 11)), seed=11)
        assert np.array_equal(batch[i], one[0])
        assert np.array_equal(batch[i], whole(source.id)[f, r : r + 11, c : c + 11])


@every_forward
def test_threads_and_tiles_do_not_matter(source: Source, monkeypatch: pytest.MonkeyPatch) -> None:
    camera = camera_with(source)
    monkeypatch.setattr(bands, "TILE_PIXELS", 16 * SHAPE[1])
    for threads in (1, 2):
        assert np.array_equal(camera.expose(SCENE, 3, seed=11, threads=threads).data, whole(source.id))


@every_forward
def test_some_frames_equal_the_slice_of_the_sequence(source: Source) -> None:
    camera = camera_with(source)
    sequence = camera.expose(SCENE, 6, seed=11).data
    assert np.array_equal(camera.expose(SCENE, [3, 4], seed=11).data, sequence[3:5])
    assert np.array_equal(whole(source.id), sequence[:3])


class Recorder:
    """A noise source of amplitude 0 that keeps what it draws, by frame and row; bands of columns are put together."""

    def __init__(self, id: str, kind: Kind) -> None:
        self.drawn: dict[tuple[int, int], np.ndarray] = {}

        def forward(params: Amplitude, signal: Any, stream: Any) -> Any:
            noise = stream.normal(signal.grid)
            for i, frame in enumerate(signal.grid.frame):
                for j, row in enumerate(signal.rows[i]):
                    line = self.drawn.setdefault((int(frame), int(row)), np.full(signal.frame_shape[1], np.nan, np.float32))
                    line[signal.cols[i]] = noise[i, j]
            return signal.with_data((signal.data + params.scale * noise).astype(signal.data.dtype))

        self.source = make_source(id, forward, (kind,), parameters=Amplitude)
        self.element = Element(id, self.source, Amplitude())


@every_forward
def test_switching_it_off_changes_no_draw_of_others_nor_they_its_own(source: Source) -> None:
    """Sharp: the very numbers that a noise source before it and one after it draw, and its own output, bit for bit."""
    first, last = (
        Recorder(f"{source.stage}.recorder_{name}", kind)
        for name, kind in (("a", kind_of(source)), ("b", source.produces or kind_of(source)))
    )
    alone = camera_with(source)
    full = camera_with(source, before=[first.element], after=[last.element])
    assert np.array_equal(full.expose(SCENE, 3, seed=11).data, alone.expose(SCENE, 3, seed=11).data)
    drawn = [dict(r.drawn) for r in (first, last)]
    for recorder in (first, last):
        recorder.drawn.clear()
    if source.produces is None:
        full.switched(off=[NAME]).expose(SCENE, 3, seed=11)
    else:
        camera_with(source, before=[first.element]).switched(off=[NAME]).expose(SCENE, 3, seed=11)
        drawn[1] = {}
    for recorder, before in zip((first, last), drawn, strict=True):
        assert source.reshape is not None or recorder.drawn.keys() == before.keys()
        for key in recorder.drawn.keys() & before.keys():
            known = ~np.isnan(before[key]) & ~np.isnan(recorder.drawn[key])  # rows and columns that nobody asked for were not drawn
            assert known.any() and np.array_equal(recorder.drawn[key][known], before[key][known])
            assert source.reshape is not None or known.all()


@every_forward
def test_exposures_and_units_are_told_apart(source: Source) -> None:
    """Another exposure seed leaves the quiet frame alone; the same seeds give the same bits again."""
    camera = camera_with(source)
    quiet = camera.expose(SCENE, 2, seed=1, quiet=True).data
    assert np.array_equal(quiet, camera.expose(SCENE, 2, seed=2, quiet=True).data)
    assert np.array_equal(camera.expose(SCENE, 3, seed=11).data, whole(source.id))


class Ranged(Parameters):
    """One number for each way to end a range, and a whole one."""

    at_least: float = quantity(1.0, "1", "from 1 on", ge=1.0)
    above: float = quantity(2.0, "1", "above 0.5", gt=0.5)
    at_most: float = quantity(1.0, "1", "up to 3", le=3.0)
    below: float = quantity(1.0, "1", "below 4.5", lt=4.5)
    count: int = quantity(2, "1", "from 1 to 9", ge=1, le=9)


RANGED = make_source("sensor.ranged", None, (Kind.ELECTRONS,), parameters=Ranged)


@every_source
def test_its_parameters_are_checked_by_the_one_base(source: Source) -> None:
    """What the base refuses is tested once, below; no source has rules of its own."""
    assert issubclass(source.parameters, Parameters)
    assert dict(source.parameters.model_config) == dict(Parameters.model_config)
    assert {type(one) for one in (source.typical, source.bound, source.make({}))} == {source.parameters}


def test_the_base_refuses_unknown_keys_and_what_is_not_finite() -> None:
    assert Parameters.model_config == {"extra": "forbid", "frozen": True, "allow_inf_nan": False}


@pytest.mark.parametrize(
    ("name", "value", "bound"),
    [("at_least", 0.9, 1.0), ("above", 0.5, 0.5), ("at_most", 3.1, 3.0), ("below", 4.5, 4.5), ("count", 0, 1.0), ("count", 10, 9.0)],
)
def test_numbers_out_of_range_are_refused_with_the_range(name: str, value: float, bound: float) -> None:
    with pytest.raises(InputError) as caught:
        RANGED.make({name: value})
    assert name in str(caught.value) and "allowed" in str(caught.value)
    assert bound in [float(n) for n in re.findall(r"[-+]?\d+(?:\.\d+)?(?:e[-+]?\d+)?", caught.value.allowed)]


@pytest.mark.parametrize("name", Ranged.model_fields)
@pytest.mark.parametrize("value", [float("nan"), float("inf"), "7 px"])
def test_what_is_no_finite_number_is_refused(name: str, value: Any) -> None:
    with pytest.raises(InputError, match=name):
        RANGED.make({name: value})


def test_unknown_keys_are_refused() -> None:
    with pytest.raises(InputError, match="no_such_key"):
        RANGED.make({"no_such_key": 1})


@every_source
def test_the_record_is_complete(source: Source) -> None:
    for name in ("title", "description", "equation", "typical_size", "advice"):
        assert getattr(source, name).strip(), f"{source.id} lacks its {name}"
    assert source.references and all(r.strip() for r in source.references)
    assert source.gum_class in CLASSES
    assert 0 <= source.stars <= 5
    assert source.parameters.__doc__
    for name, info in source.parameters.model_fields.items():
        assert info.description, f"{source.id}: {name} has no description"
        assert source.units[name], f"{source.id}: {name} has no unit"
        if info.annotation in (int, float):
            assert info.metadata, f"{source.id}: {name} has no range"
    for verb, reason in source.reasons.items():
        assert len(reason) > 10 and (verb == "neutral" or getattr(source, verb) is None), f"{source.id}: {verb}"
    for verb in ("forward", "measure", "correct", "propagate", "context"):
        function = getattr(source, verb)
        assert function is None or function.__doc__ or verb == "context", f"{source.id}: {verb} has no docstring"


@every_source
def test_parameters_survive_the_camera_file(source: Source) -> None:
    for params in (source.typical, source.bound):
        assert source.make(params.model_dump(mode="json")) == params


@every_forward
def test_correct_lowers_the_error_of_forward(source: Source) -> None:
    """The root mean square over a gently uneven frame, with the true parameters, noise-free maps of the unit, and what frames tell.

    Draws, which nothing corrects, are at their means, unless they are all that there is (a wave of any phase).
    """
    if source.correct is None:
        pytest.skip(source.reasons["correct"])
    if source.id == "sensor.pixel_aperture":
        pytest.skip("makes one finer image of several shifted frames: tests/assess/test_correct_finer.py")
    camera, scene, exposure_s = camera_with(source, shape=(96, 128)), Texture(contrast=0.01), 0.01
    if has_memory(source) or source.id == "optics.flicker":  # what differs from frame to frame
        scene, exposure_s = Texture(60.0), 0.003
    signal = camera.switched(off=[NAME]).expose(scene, 4, exposure_s=exposure_s)
    out = camera.expose(scene, 4, quiet=True, exposure_s=exposure_s)
    if np.array_equal(out.data, signal.data):
        out = camera.expose(scene, 4, exposure_s=exposure_s)
    untouched = out.data.copy()
    maps = {**truth_maps(source, source.typical, camera.frame_shape), **frame_maps(out.data, signal.data)}
    corrected = source.correct(source.typical, out, maps)
    assert np.array_equal(out.data, untouched)
    assert corrected.data.shape == out.data.shape and np.isfinite(corrected.data).all()

    def error(data: np.ndarray) -> float:
        return float(np.sqrt(np.mean((data.astype(float) - signal.data) ** 2)))

    assert error(corrected.data) < 0.9 * error(out.data)


@every_forward
@settings(max_examples=12, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_any_window_of_any_frame_equals_the_crop(source: Source, data: st.DataObject) -> None:
    rows, cols = data.draw(st.integers(1, 40), "rows"), data.draw(st.integers(1, 40), "cols")
    camera = camera_with(source, shape=(rows, cols))
    rows, cols = camera.output_shape
    r, c = data.draw(st.integers(0, rows - 1), "row"), data.draw(st.integers(0, cols - 1), "col")
    h, w = data.draw(st.integers(1, rows - r), "height"), data.draw(st.integers(1, cols - c), "width")
    frame = data.draw(st.integers(0, 3 if has_memory(source) else 10**6), "frame")
    full = camera.expose(SCENE, [frame], seed=3).data[0]
    assert np.array_equal(camera.expose(SCENE, [frame], seed=3, window=(r, c, h, w)).data[0], full[r : r + h, c : c + w])


@every_forward
def test_what_it_tells_of_itself_is_finite_and_fits_the_frame(source: Source) -> None:
    if source.truth is None:
        return
    camera = camera_with(source)
    told = camera.truth(frame=1, seed=11)[NAME]
    link = next(e for e in camera.links if e.name == NAME)
    assert told
    for name, values in told.items():
        assert np.isfinite(values).all(), name
        assert values.shape[-2:] in (link.shape, link.shape_out) or values.shape[-1] in (*link.shape, *link.shape_out), (name, values.shape)
    again = camera.truth(frame=1, seed=11)[NAME]
    assert all(np.array_equal(v, again[n]) for n, v in told.items())


@every_source
def test_it_stands_in_a_camera_or_says_why_not(source: Source) -> None:
    source.parameters()  # every parameter has a default
    assert source.consumes and set(source.consumes) <= set(Kind)
    if source.forward is not None:
        assert isinstance(camera_with(source), Camera)
        return
    with pytest.raises(ChainError, match=re.escape(source.reasons["forward"])):
        camera_with(source)
