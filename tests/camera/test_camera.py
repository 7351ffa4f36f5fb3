"""The camera: what it refuses, and that however it cuts the work, the numbers are the same."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from catalogue.support import IDEAL, Amplitude, Flat, Nothing, Texture, lead_in, make_source
from pixmetry.camera import bands
from pixmetry.camera.camera import Camera, Element, build_camera, load_camera
from pixmetry.camera.catalogue import get_source
from pixmetry.camera.overrides import changed_camera
from pixmetry.camera.signal import Kind, Windows
from pixmetry.core.errors import ChainError, InputError
from pixmetry.core.random import Grid
from pixmetry.sources.cable.termination import SOURCE as TERMINATION
from pixmetry.sources.cable.termination import Termination
from pixmetry.sources.grabber.clamp import SOURCE as CLAMP
from pixmetry.sources.grabber.clamp import Clamp
from pixmetry.sources.sensor.charge_transfer import SOURCE as CHARGE_TRANSFER
from pixmetry.sources.sensor.charge_transfer import ChargeTransfer
from pixmetry.sources.sensor.prnu import SOURCE as PRNU
from pixmetry.sources.sensor.prnu import Prnu
from pixmetry.sources.sensor.shot_noise import SOURCE as SHOT_NOISE
from pixmetry.sources.sensor.shot_noise import ShotNoise

SHAPE = (70, 90)
SCENE = Texture()
TO_ELECTRONS, TO_DN, TO_CODES = (Element(IDEAL[k].id, IDEAL[k], Nothing()) for k in (Kind.PHOTONS, Kind.ELECTRONS, Kind.DN))


def _blur(params: Amplitude, signal: Any, stream: Any) -> Any:
    """Mean of three rows; the frame goes on at its edges as its own last row."""
    data = signal.data
    up = np.concatenate([data[:, :1], data[:, :-1]], axis=1)
    down = np.concatenate([data[:, 1:], data[:, -1:]], axis=1)
    return signal.with_data((up + data + down) / np.float32(3))


def _exact_blur(params: Amplitude, signal: Any, stream: Any) -> Any:
    """The same, and where a window ends within the frame its outermost rows are only context: they are set to a value that would show."""
    out = _blur(params, signal, stream)
    data = out.data.copy()
    data[signal.grid.row0 > 0, 0] = np.nan
    data[signal.grid.row0 + data.shape[1] < signal.frame_shape[0], -1] = np.nan
    return out.with_data(data)


BLUR = make_source(
    "electronics.blur_for_tests", _exact_blur, (Kind.DN,), parameters=Amplitude, context=lambda p, w, f: w.expand(1, 1, 0, 0, f)
)


def noise(name: str, kind: Kind) -> Element:
    def forward(params: Amplitude, signal: Any, stream: Any) -> Any:
        return signal.with_data(stream.add_normal(signal.data, signal.grid, params.scale))

    return Element(name, make_source(f"electronics.{name}", forward, (kind,), parameters=Amplitude), Amplitude(scale=1.0))


def _memory(params: Amplitude, signal: Any, stream: Any, state: float) -> tuple[Any, float]:
    """Adds the mean of the frame before; a frame-wide memory."""
    return signal.with_data(signal.data + np.float32(state)), 0.5 * state + 0.1 * float(signal.data.mean(dtype=float))


MEMORY = make_source(
    "electronics.memory_for_tests", _memory, (Kind.DN,), start=lambda p: 0.0, context=lambda p, w, f: w.full_frame(f), parameters=Amplitude
)

CTI = Element("cti", CHARGE_TRANSFER, ChargeTransfer(parallel_cti=1e-3, trail_px=1.5))
CABLE = Element("cable", TERMINATION, Termination(length_m=5.0, line_ohm=50.0, load_ohm=150.0))
PRNU_ELEMENT = Element("prnu", PRNU, Prnu(pixel_std_rel=0.02, col_std_rel=0.01))
SHOT = Element("shot", SHOT_NOISE, ShotNoise())
LONG = (PRNU_ELEMENT, TO_ELECTRONS, SHOT, CTI, TO_DN, noise("amplifier", Kind.DN), Element("blur", BLUR, Amplitude()), CABLE, TO_CODES)


def camera(*chain: Element, shape: tuple[int, int] = SHAPE, **kw: Any) -> Camera:
    return Camera("test", shape, chain, **kw)


# ---- what is refused -----------------------------------------------------------------------------------------------------------------


def test_a_name_used_twice_is_refused() -> None:
    with pytest.raises(ChainError, match="'sensor.ideal_conversion' is used twice"):
        camera(TO_ELECTRONS, TO_ELECTRONS)


def test_kinds_that_do_not_fit_are_refused() -> None:
    with pytest.raises(ChainError, match="shot cannot follow: it takes electrons and gets photons"):
        camera(SHOT)
    with pytest.raises(ChainError, match=r"electronics.ideal_gain cannot follow: it takes electrons and gets codes"):
        camera(TO_ELECTRONS, Element("gain 1", IDEAL[Kind.ELECTRONS], Nothing()), TO_CODES, TO_DN)


def test_a_declared_order_that_is_broken_is_refused_both_ways() -> None:
    early = Element("early", make_source("sensor.e", lambda p, s, t: s, (Kind.ELECTRONS,), before=("sensor.shot_noise",)), Nothing())
    late = Element("late", make_source("sensor.l", lambda p, s, t: s, (Kind.ELECTRONS,), after=("cable",)), Nothing())
    with pytest.raises(ChainError, match="early must come before shot"):
        camera(TO_ELECTRONS, SHOT, early)
    camera(TO_ELECTRONS, early, SHOT)
    cable = Element("cable", make_source("cable.c", lambda p, s, t: s, (Kind.ELECTRONS,)), Nothing())
    with pytest.raises(ChainError, match="late must come after cable"):
        camera(TO_ELECTRONS, late, cable)
    camera(TO_ELECTRONS, cable, late)


def test_steps_on_codes_of_fewer_bits_than_the_converter_makes_are_refused() -> None:
    """They would take all brighter codes for the highest."""
    dcs = load_camera("dcs420_like")
    for name in ("processing.demosaic", "processing.companding"):
        with pytest.raises(ChainError, match=rf"{name} takes fewer bits than grabber.adc makes"):
            dcs.with_parameters(name, bits=10)
    with pytest.raises(ChainError, match="fewer bits"):
        dcs.with_parameters("grabber.adc", bits=14)
    dcs.with_parameters("processing.companding", bits=14)
    every = {"grabber.adc.bits": 14, "processing.demosaic.bits": 14, "processing.companding.bits": 14}
    assert changed_camera(dcs, every)["grabber.adc"].params.bits == 14
    with pytest.raises(ChainError, match="fewer bits"):
        changed_camera(dcs, {"grabber.adc.bits": 14})


def test_what_is_switched_off_is_not_checked() -> None:
    built = camera(TO_ELECTRONS, SHOT, Element("off", IDEAL[Kind.DN], Nothing(), on=False))
    assert [e.name for e in built.chain if not e.on] == ["off"]


def test_a_frame_without_pixels_and_a_window_outside_are_refused() -> None:
    with pytest.raises(ChainError, match="no pixels"):
        camera(shape=(0, 5))
    for window in ((-1, 0, 5, 5), (0, 0, 71, 5), (0, 89, 1, 2), (0, 0, 0, 5)):
        with pytest.raises(InputError, match="window does not lie in the frame"):
            camera(TO_ELECTRONS).expose(SCENE, window=window)


def test_unknown_names_no_frames_and_unknown_modes_are_refused() -> None:
    chain = camera(TO_ELECTRONS)
    with pytest.raises(InputError, match="no source named 'nothing'"):
        chain.switched(off=["nothing"])
    with pytest.raises(InputError, match="the number of frames is not positive"):
        chain.expose(SCENE, [])
    with pytest.raises(InputError, match="no such mode"):
        chain.expose_windows(SCENE, Grid.whole([0], (5, 5)), mode="fast")
    with pytest.raises(InputError, match="one schedule"):
        chain.expose(SCENE, 2, exposure_s=[0.1, 0.2])
    with pytest.raises(InputError, match="needs the background"):
        camera(TO_ELECTRONS, TO_DN, CABLE).expose_windows(SCENE, Grid.whole([0], (5, 5)), mode="frozen")


# ---- how the work is cut -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("tile", [1, 16 * 90, 48 * 90, 1 << 30])
@pytest.mark.parametrize("length", range(1, len(LONG) + 1))
def test_bands_stitched_together_equal_the_frame_walked_as_a_whole(tile: int, length: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """The oracle calls each ``forward`` on the whole frame, one after the other."""
    chain = camera(*LONG[:length])
    grid = Grid.whole([4], SHAPE)
    signal = chain.signal(SCENE, grid)
    for element in chain.links:
        signal = element.source.forward(element.params, signal, chain.streams(3).of(element.name))
    monkeypatch.setattr(bands, "TILE_PIXELS", tile)
    for threads in (1, 2):
        got = chain.expose(SCENE, [4], seed=3, threads=threads)
        assert np.array_equal(got.data, signal.data) and got.kind == signal.kind
        assert got.data.flags.c_contiguous


def test_windows_of_any_size_equal_the_crops_at_and_off_the_border() -> None:
    chain = camera(*LONG)
    frames = chain.expose(SCENE, 3, seed=3).data
    for row, col, rows, cols in [(0, 0, 70, 90), (0, 0, 1, 1), (69, 89, 1, 1), (33, 0, 4, 90), (0, 41, 70, 3), (15, 16, 17, 18)]:
        got = chain.expose(SCENE, 3, seed=3, window=(row, col, rows, cols)).data
        assert np.array_equal(got, frames[:, row : row + rows, col : col + cols])


def test_a_batch_of_windows_equals_the_crops_of_its_frames(monkeypatch: pytest.MonkeyPatch) -> None:
    """At the border the context is smaller, so entries of several sizes are mixed; tiles cut the batch anywhere."""
    chain = camera(*LONG)
    frames = chain.expose(SCENE, 3, seed=3).data
    rng = np.random.default_rng(1)
    n = 40
    frame, row, col = rng.integers(0, 3, n), rng.choice([0, 1, 30, 60, 61], n), rng.integers(0, 82, n)
    for tile in (1, 9 * 8 * 7, 1 << 30):
        monkeypatch.setattr(bands, "TILE_PIXELS", tile)
        got = chain.expose_windows(SCENE, Grid(frame, row, col, (9, 8)), seed=3)
        want = [frames[f, r : r + 9, c : c + 8] for f, r, c in zip(frame, row, col, strict=True)]
        assert np.array_equal(got, want)
    assert chain.expose_windows(SCENE, Grid([], [], [], (9, 8)), seed=3).shape == (0, 9, 8)


def test_a_schedule_goes_window_by_window() -> None:
    def forward(params: Nothing, signal: Any, stream: Any) -> Any:
        return signal.with_data(signal.data + signal.temperature_c.astype(np.float32)[:, None, None])

    thermometer = Element("thermometer", make_source("sensor.t", forward, (Kind.PHOTONS,)), Nothing())
    row = np.array([0, 60, 5, 61, 0])
    chain = camera(thermometer, TO_ELECTRONS, TO_DN, Element("blur", BLUR, Amplitude()))  # the context at the border has another size
    grid = Grid(np.arange(5), row, row, (9, 9))
    temperature = np.array([1.0, 2.0, 3.0, 4.0, 5.0]) * 1e4
    got = chain.expose_windows(Flat(0.0), grid, temperature_c=temperature)
    assert np.allclose(got, (temperature * 0.5 * 0.01)[:, None, None], rtol=1e-6)


# ---- memory --------------------------------------------------------------------------------------------------------------------------


def test_a_memory_runs_in_order_through_frames_that_were_not_asked_for() -> None:
    """The oracle runs the recursion of the state by hand on noise-free frames."""
    chain = camera(TO_ELECTRONS, TO_DN, Element("memory", MEMORY, Amplitude()), noise("after", Kind.DN))
    plain = chain.switched(off=["memory"]).expose(SCENE, 6, seed=2).data
    clean = camera(TO_ELECTRONS, TO_DN).expose(SCENE, 6).data
    sequence = chain.expose(SCENE, 6, seed=2).data
    state = 0.0
    for k in range(6):
        assert np.allclose(sequence[k] - plain[k], state, atol=1e-4)
        state = 0.5 * state + 0.1 * float(clean[k].mean(dtype=float))
    assert state > 10
    assert np.array_equal(chain.expose(SCENE, [2, 5], seed=2).data, sequence[[2, 5]])
    assert np.array_equal(chain.expose(SCENE, [4], seed=2, window=(3, 4, 5, 6)).data[0], sequence[4, 3:8, 4:10])
    for bad in ([3, 2], [-1, 0], [1, 1]):
        with pytest.raises(InputError, match="rise from 0"):
            chain.expose(SCENE, bad)
    with pytest.raises(InputError, match="memory"):
        chain.expose_windows(SCENE, Grid.whole([0], (5, 5)))


def test_frozen_mode_settles_a_memory_on_the_background() -> None:
    """x = s/2 + m/10 settles at s = m/5 for a background of mean m."""
    chain = camera(TO_ELECTRONS, TO_DN, Element("memory", MEMORY, Amplitude()))
    got = chain.expose_windows(Flat(30.0), Grid.whole([0, 1], (5, 5)), mode="frozen", background=Flat(50.0))
    assert np.allclose(got, 30.0 + 10.0, atol=1e-3)


def test_whole_frames_in_one_batch_of_the_frozen_mode_are_no_sequence() -> None:
    lag = get_source("sensor.image_lag")
    chain = camera(TO_ELECTRONS, Element("lag", lag, lag.typical), shape=(6, 7))
    given: dict[str, Any] = {"mode": "frozen", "background": Flat(30.0)}
    batch = chain.expose_windows(SCENE, Grid.whole([0, 1, 2], (6, 7)), **given)
    for number, seen in enumerate(batch):
        assert np.array_equal(seen, chain.expose_windows(SCENE, Grid.whole([number], (6, 7)), **given)[0])


# ---- frozen against exact ------------------------------------------------------------------------------------------------------------


class Spot(Flat):
    """A bright square far from the frame's border on a flat background."""

    def photons(self, grid: Grid, frame_shape: tuple[int, int], exposure_s: np.ndarray, time_s: np.ndarray) -> np.ndarray:
        rows, cols = grid.row0[:, None, None] + np.arange(grid.shape[0])[:, None], grid.col0[:, None, None] + np.arange(grid.shape[1])
        inside = (abs(rows - 150) < 5) & (abs(cols - 200) < 5)
        return super().photons(grid, frame_shape, exposure_s, time_s) + np.where(inside, 20_000, 0).astype(np.float32)


def test_frozen_and_exact_mode_differ_by_no_more_than_the_stated_tail() -> None:
    """Charge transfer down the column, then echoes along the row; with shot noise, whose far part the frozen mode leaves out."""
    chain = camera(TO_ELECTRONS, SHOT, CTI, TO_DN, CABLE, shape=(240, 320))
    grid = Grid(np.arange(8), np.arange(138, 146), np.arange(188, 196), (21, 21))
    exact = chain.expose_windows(Spot(50.0), grid, seed=5)
    frozen = chain.expose_windows(Spot(50.0), grid, seed=5, mode="frozen", background=Flat(50.0))
    brightest = exact.max()
    assert 0 < chain.frozen_tail() < 1e-2
    assert np.abs(frozen - exact).max() <= chain.frozen_tail() * brightest + 1e-5 * brightest
    without = chain.switched(off=["cti", "cable"]).expose_windows(Spot(50.0), grid, seed=5)
    assert np.abs(exact - without).max() > 50 * np.abs(frozen - exact).max()  # the effect itself is far larger than what frozen loses


def test_cross_talk_of_whole_rows_and_columns_is_followed_near_a_window() -> None:
    source = get_source("sensor.cid_readout")
    cross = Element(source.id, source, source.make({"row_crosstalk": 0.02, "col_crosstalk": 0.03}))
    chain = Camera("cross-talk", (300, 400), (TO_ELECTRONS, cross))
    grid = Grid(np.zeros(1, np.int64), np.array([138]), np.array([188]), (24, 24))
    exact, frozen, bare = (
        c.expose_windows(Spot(50.0), grid, mode=m, background=Flat(50.0))
        for c, m in ((chain, "exact"), (chain, "frozen"), (chain.switched(off=[source.id]), "exact"))
    )
    assert np.abs(frozen - exact).max() < 1e-6 * exact.max() < 1e-4 * np.abs(exact - bare).max()


def test_batches_are_bounded_by_what_windows_need(monkeypatch: pytest.MonkeyPatch) -> None:
    """Windows that need whole columns are run a few at a time, and are the same."""
    chain = camera(TO_ELECTRONS, CTI, TO_DN)
    grid = Grid(np.arange(40), np.arange(40) % 30, np.arange(40) % 50, (8, 8))
    together = chain.expose_windows(SCENE, grid)
    monkeypatch.setattr("pixmetry.camera.camera.MOST_PIXELS", 3 * SHAPE[0] * 8)
    assert np.array_equal(chain.expose_windows(SCENE, grid), together)


def test_frozen_mode_takes_the_far_part_from_the_background() -> None:
    """Half of what lies 10 px to the left is added, of which a near context of 3 px sees nothing: on the background itself it is exact."""

    def forward(params: Amplitude, signal: Any, stream: Any) -> Any:
        late = signal.data[:, :, np.maximum(np.arange(signal.data.shape[2]) - 10, 0)]
        return signal.with_data(signal.data + np.float32(0.5) * late)

    far = {"context": lambda p, w, f: w.full_rows(f), "near": lambda p: (0, 0, 3, 0), "tail": lambda p: 0.5}
    chain = camera(TO_ELECTRONS, TO_DN, Element("far", make_source("electronics.far", forward, (Kind.DN,), **far), Nothing()))
    scene = Texture()
    grid = Grid(np.zeros(3), [0, 20, 61], [5, 40, 81], (9, 9))
    exact, frozen = (chain.expose_windows(scene, grid, mode=m, background=scene) for m in ("exact", "frozen"))
    assert np.allclose(frozen, exact, rtol=1e-5)
    assert chain.frozen_tail() == 0.5


def test_frozen_mode_keeps_the_noise_and_the_drift_of_a_source_that_looks_far() -> None:
    """A clamp looks along the row for its droop, and adds noise of the row and a drift with temperature: of these nothing is far."""
    clamp = Clamp(noise_dn=1.0, droop_rel=0.01, drift_dn_per_k=0.5)
    chain = camera(TO_ELECTRONS, TO_DN, Element("clamp", CLAMP, clamp), shape=(40, 200), warm_up_k=10.0, warm_up_s=0.1)
    grid = Grid(np.arange(8), np.arange(4, 12), np.arange(55, 63), (9, 9))
    exact, frozen = (chain.expose_windows(Flat(50.0), grid, seed=3, mode=m, background=Flat(50.0)) for m in ("exact", "frozen"))
    assert exact.mean(axis=2).std(axis=1).min() > 0.3 and np.ptp(exact.mean(axis=(1, 2))) > 1
    assert np.allclose(frozen, exact, atol=1e-4)


def test_the_schedule_of_the_frozen_mode() -> None:
    """A function of time is as good as a number; exposures that differ have no one background."""
    chain = camera(TO_ELECTRONS, CTI, TO_DN, shape=(40, 50))
    grid = Grid(np.arange(2), np.array([5, 6]), np.array([5, 6]), (9, 9))
    given: dict[str, Any] = {"grid": grid, "mode": "frozen", "background": SCENE}
    same = chain.expose_windows(SCENE, **given, temperature_c=25.0)
    assert np.array_equal(chain.expose_windows(SCENE, **given, temperature_c=lambda t: 25.0 + 0 * t), same)
    assert np.array_equal(chain.expose_windows(SCENE, **given, exposure_s=np.full(2, 0.01)), same)
    with pytest.raises(InputError, match="one schedule"):
        chain.expose_windows(SCENE, **given, exposure_s=np.array([0.01, 0.02]))


@pytest.mark.parametrize(("row", "col", "shape"), [(-1, 0, (9, 9)), (0, 82, (9, 9)), (62, 0, (9, 9)), (0, 0, (0, 5))])
def test_windows_outside_the_frame_are_refused(row: int, col: int, shape: tuple[int, int]) -> None:
    chain = camera(TO_ELECTRONS, CTI, TO_DN)
    for mode in ("exact", "frozen"):
        with pytest.raises(InputError, match="does not lie in the frame"):
            chain.expose_windows(SCENE, Grid(np.zeros(1), [row], [col], shape), mode=mode, background=SCENE)


@pytest.mark.parametrize("exposure", [-0.01, float("nan"), float("inf")])
def test_exposure_times_that_are_none_are_refused(exposure: float) -> None:
    with pytest.raises(InputError, match="exposure"):
        camera(TO_ELECTRONS).expose(SCENE, exposure_s=exposure)


def test_an_order_that_the_kinds_leave_no_choice_about_is_not_asked_for() -> None:
    """Vignetting comes before the sensor, in photons; the sensor's pixels have their shape before there are photons."""
    ids = ("sensor.pixel_aperture", "optics.vignetting", "sensor.quantum_efficiency")
    chain = [Element(i, get_source(i), get_source(i).typical) for i in ids]
    assert Camera("with vignetting", SHAPE, chain).expose(SCENE).data.shape == (1, *SHAPE)
    with pytest.raises(ChainError, match="must come"):
        camera(TO_ELECTRONS, Element("shot", SHOT_NOISE, ShotNoise()), Element("dark", get_source("sensor.dark_current"), Nothing()))


def test_quiet_draws_are_arrays_of_their_own() -> None:
    """A source may go on in place with what a draw gave it."""
    grid, data = Grid.whole([0, 1], (3, 4)), np.ones((2, 3, 4), np.float32)
    quiet = camera().streams(0, quiet=True).of("any")
    for drawn in (quiet.poisson(data, grid), quiet.add_normal(data, grid, 3.0), quiet.add_normal(data[:1], grid, 3.0)):
        assert np.array_equal(drawn, data) and not np.shares_memory(drawn, data)
        assert drawn.flags.writeable


def test_frozen_mode_is_exact_without_far_context() -> None:
    chain = camera(PRNU_ELEMENT, TO_ELECTRONS, SHOT, TO_DN)
    grid = Grid([0, 1], [0, 61], [5, 82], (9, 8))
    assert chain.frozen_tail() == 0
    assert np.array_equal(chain.expose_windows(SCENE, grid, mode="frozen"), chain.expose_windows(SCENE, grid))


# ---- variants, quiet frames, files ---------------------------------------------------------------------------------------------------


def test_switching_keeps_what_is_essential() -> None:
    gain = Element(
        "gain", make_source("electronics.g", IDEAL[Kind.ELECTRONS].forward, (Kind.ELECTRONS,), produces=Kind.DN, essential=True), Nothing()
    )
    first = Element(
        "eta", make_source("sensor.q", IDEAL[Kind.PHOTONS].forward, (Kind.PHOTONS,), produces=Kind.ELECTRONS, essential=True), Nothing()
    )
    chain = camera(first, SHOT, gain, CABLE)
    assert [e.name for e in chain.switched(on=["cable"]).active] == ["eta", "gain", "cable"]
    assert [e.name for e in chain.switched(off=["cable"]).active] == ["eta", "shot", "gain"]
    assert [e.name for e in chain.switched(off=["cable"]).switched(on=["cable"]).active] == ["eta", "gain"]
    assert "cable" in chain and "ghost" not in chain


def test_parameters_are_validated_when_they_are_changed() -> None:
    chain = camera(PRNU_ELEMENT)
    assert chain.with_parameters("prnu", pixel_std_rel=0.1)["prnu"].params == Prnu(pixel_std_rel=0.1, col_std_rel=0.01)
    with pytest.raises(InputError, match="pixel_std_rel"):
        chain.with_parameters("prnu", pixel_std_rel=-1)


def test_a_source_that_does_not_act_on_frames_is_refused() -> None:
    estimator = Element("estimator", make_source("processing.e", None, (Kind.ELECTRONS,)), Nothing())
    with pytest.raises(ChainError, match="estimator cannot stand in a camera: a source for tests"):
        camera(TO_ELECTRONS, estimator)


def test_the_quiet_frame_is_the_mean_of_many() -> None:
    """400 frames of Poisson noise and noise of 1 DN; no pixel of 6300 is off by more than 6.5 σ/√400 (false failure 5e-7, both tails)."""
    chain = camera(PRNU_ELEMENT, TO_ELECTRONS, SHOT, TO_DN, noise("amplifier", Kind.DN))
    quiet = chain.expose(Flat(100.0), quiet=True, seed=1).data[0]
    mean = np.mean([s.data[0] for s in chain.iter_frames(Flat(100.0), range(400), seed=9)], axis=0, dtype=float)
    sigma = np.sqrt(quiet * 0.01 + 1.0)
    z = (mean - quiet) / sigma * 20
    assert np.abs(z).max() < 6.5
    assert quiet.std() > 1  # the fixed pattern is in it
    assert np.array_equal(quiet, chain.expose(Flat(100.0), quiet=True, seed=2).data[0])


def test_another_unit_has_other_fixed_patterns_and_another_exposure_seed_has_not() -> None:
    chain = camera(PRNU_ELEMENT, unit_seed=1)
    other = camera(PRNU_ELEMENT, unit_seed=2)
    assert np.array_equal(chain.expose(SCENE, seed=1).data, chain.expose(SCENE, seed=2).data)
    assert not np.array_equal(chain.expose(SCENE).data, other.expose(SCENE).data)


def test_a_camera_survives_its_file(tmp_path: Path) -> None:
    chain = [
        {"source": "sensor.prnu", "parameters": {"pixel_std_rel": 0.02}},
        {"source": "sensor.prnu", "name": "more", "enabled": False, "parameters": {}},
    ]
    record = {"schema": "pixmetry/camera/1", "name": "c", "rows": 8, "cols": 9, "pitch_x_um": 5.0, "unit_seed": 4, "chain": chain}
    first = build_camera(record)
    assert first.pitch_um == (5.0, 5.0)
    first.save(tmp_path / "c.yaml")
    second = load_camera(tmp_path / "c.yaml")
    assert second == first
    assert np.array_equal(first.expose(SCENE).data, second.expose(SCENE).data)
    with pytest.raises(InputError, match="no such camera"):
        load_camera(tmp_path / "none.yaml")
    with pytest.raises(InputError, match=r"chain\[0\].*pixel_std_rel"):
        build_camera(record | {"chain": [{"source": "sensor.prnu", "parameters": {"pixel_std_rel": -1}}]})


def test_sources_that_have_the_cameras_pitch_follow_it() -> None:
    chain = [
        {"source": "sensor.tilt"},
        {"source": "sensor.unflatness", "parameters": {"pitch_x_um": 7.0}},
        {"source": "sensor.quantum_efficiency"},
    ]
    record = {"schema": "pixmetry/camera/1", "name": "c", "rows": 8, "cols": 9, "pitch_x_um": 5.0, "chain": chain}
    made = changed_camera(build_camera(record), {"pitch_x_um": 6.0})
    assert made.pitch_um == (6.0, 5.0)
    assert made == replace(build_camera(record | {"pitch_x_um": 6.0, "pitch_y_um": 5.0}), name="c")
    assert made["sensor.tilt"].params.pitch_x_um == 6.0 and made["sensor.unflatness"].params.pitch_x_um == 7.0


# ---- signals -------------------------------------------------------------------------------------------------------------------------


def test_crops_with_and_without_a_common_offset() -> None:
    frame = camera(*lead_in(Kind.ELECTRONS)).expose(SCENE, 2)
    same = frame.crop(Windows(np.array([3, 3]), np.array([4, 4]), np.array([5, 5]), np.array([6, 6])))
    other = frame.crop(Windows(np.array([3, 9]), np.array([4, 0]), np.array([5, 5]), np.array([6, 6])))
    assert np.array_equal(same.data, frame.data[:, 3:8, 4:10])
    assert np.array_equal(other.data, [frame.data[0, 3:8, 4:10], frame.data[1, 9:14, 0:6]])
    assert other.rows.tolist() == [[3, 4, 5, 6, 7], [9, 10, 11, 12, 13]] and other.cols[1].tolist() == [0, 1, 2, 3, 4, 5]


def test_windows_widened_to_blocks_stay_in_the_frame() -> None:
    wide = Windows.one(9, 70, 8, 15).aligned(8, 8, (70, 90))
    assert [int(v[0]) for v in (wide.row0, wide.col0, wide.rows, wide.cols)] == [8, 64, 16, 24]
    wide = Windows.one(66, 85, 1, 1).aligned(8, 8, (70, 90))
    assert [int(v[0]) for v in (wide.row0, wide.col0, wide.rows, wide.cols)] == [64, 80, 6, 8]


def test_the_whole_catalogue_has_an_order() -> None:
    """Tape is of the stage of storage, yet plays before the grabber; in-camera processing comes before the codecs."""
    from pixmetry.camera.camera import in_order
    from pixmetry.camera.catalogue import sources

    names = [s.id for s in in_order([s for s in sources().values() if s.forward is not None])]
    assert len(names) == sum(s.forward is not None for s in sources().values())
    for first, then in (
        ("optics.point_spread", "sensor.quantum_efficiency"),
        ("cable.termination", "storage.tape"),
        ("storage.tape", "grabber.sampling_clock"),
        ("grabber.adc", "processing.demosaic"),
        ("processing.demosaic", "storage.jpeg"),
    ):
        assert names.index(first) < names.index(then)
