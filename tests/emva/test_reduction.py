"""Frames to measurements: against plain NumPy and SciPy, channel by channel, and with the same bits for any number of threads."""

from __future__ import annotations

import gc
import threading
import weakref
from collections.abc import Callable
from dataclasses import fields, replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from pixmetry.camera.observations import LevelMoments, StackMoments
from pixmetry.core.errors import InputError, MeasureError
from pixmetry.emva.records import Measurement
from pixmetry.emva.reduction import CHANNELS, MOSAICS, measure_frames, phases
from pixmetry.observe.moments import LevelAccumulator, summarize_pair
from pixmetry.observe.one_pass import Group

SHAPE, BITS = (26, 34), 12


def noisy(mean: float, count: int, rng: np.random.Generator, shape: tuple[int, int] = SHAPE) -> list[np.ndarray]:
    """Frames of a smooth ramp with noise that grows with the mean."""
    image = mean * (1 + 0.02 * np.linspace(-1, 1, shape[1]))
    return [np.clip(np.rint(rng.normal(image, 3 + np.sqrt(mean), shape)), 0, 2**BITS - 1).astype(np.uint16) for _ in range(count)]


def series(rng: np.random.Generator, shape: tuple[int, int] = SHAPE, levels: int = 5) -> list[Group]:
    """Levels of two frames (one of three, one of four), and two stacks of one exposure."""
    groups = []
    for i in range(1, levels + 1):
        count = {2: 3, 3: 4}.get(i, 2)
        groups.append(Group("dark", "level", i * 1e-3, 0.0, noisy(20.0 + i, count, rng, shape)))
        groups.append(Group("bright", "level", i * 1e-3, 1000.0 * i, noisy(20.0 + 600 * i, count, rng, shape)))
    groups.append(Group("dark", "stack", 3e-3, 0.0, noisy(23.0, 9, rng, shape)))
    groups.append(Group("bright", "stack", 3e-3, 3000.0, noisy(1823.0, 11, rng, shape)))
    return groups


def same_bits(one: object, other: object) -> bool:
    """Whether two records hold the same numbers, bit for bit."""
    if isinstance(one, np.ndarray):
        return np.array_equal(one, other)
    if hasattr(one, "__dataclass_fields__"):
        return all(same_bits(getattr(one, f.name), getattr(other, f.name)) for f in fields(one))
    return one == other


def test_levels_equal_numpy_and_scipy(rng: np.random.Generator):
    """EMVA 1288 R4.0 eq. 16, 18 and 32 on pairs; the kurtosis of SciPy; shares of the lowest and the highest code."""
    pairs = [np.array(noisy(mean, 2, rng)) for mean in (3.0, 700.0, 4085.0)]
    groups = [Group("bright", "level", 1e-3 * i, 10.0 * i, pair) for i, pair in enumerate(pairs, 1)]
    groups.append(Group("dark", "level", 1e-3, 0.0, noisy(9.0, 2, rng)))
    (m,) = measure_frames(groups, BITS, pixel_area_um2=12.5, photons_u_rel=0.02)
    got = m.transfer.bright
    for i, (y0, y1) in enumerate(pair.astype(float) for pair in pairs):
        d = y0 - y1
        assert got.mean_dn[i] == pytest.approx((y0.mean() + y1.mean()) / 2, rel=1e-14)
        assert got.var_total_dn2[i] == pytest.approx((d**2).mean() / 2 - d.mean() ** 2 / 2, rel=1e-12)
        assert got.spatial_cov_dn2[i] == pytest.approx((y0 * y1).mean() - y0.mean() * y1.mean(), rel=1e-6, abs=1e-8)
        assert got.kurtosis_excess[i] == pytest.approx(stats.kurtosis(d.ravel()), rel=1e-9, abs=1e-12)
        assert got.fraction_min[i] == (pairs[i] == 0).mean() and got.fraction_max[i] == (pairs[i] == 2**BITS - 1).mean()
    assert got.fraction_min[0] > 0 and got.fraction_max[2] > 0
    assert got.photons.tolist() == [10.0, 20.0, 30.0] and (m.pixel_area_um2, m.photons_u_rel) == (12.5, 0.02)
    assert m.dark_stack is None and m.bright_stack is None and "no stacks" in m.notes[0]


def test_stacks_equal_numpy(rng: np.random.Generator):
    """EMVA 1288 R4.0 eq. 33, 34 and 65."""
    groups = series(rng)
    (m,) = measure_frames(groups, BITS)
    assert m.bright_stack_photons == 3000.0 and m.notes == ()
    for stack, group in ((m.dark_stack, groups[-2]), (m.bright_stack, groups[-1])):
        y = np.array(group.frames, dtype=float)
        np.testing.assert_allclose(stack.mean_map_dn, y.mean(axis=0), rtol=1e-14)
        np.testing.assert_allclose(stack.var_map_dn2, y.var(axis=0, ddof=1), rtol=1e-6)
        assert stack.var_stack_dn2 == pytest.approx(y.var(axis=0, ddof=1).mean(), rel=1e-12)
        assert stack.mean_dn == pytest.approx(y.mean(), rel=1e-14) and stack.n_frames == len(y)


@settings(deadline=None, max_examples=40)
@given(
    rows=st.integers(2, 9),
    cols=st.integers(2, 13),
    seed=st.integers(0, 2**32 - 1),
    bits=st.sampled_from([1, 8, 12, 16]),
    few=st.booleans(),
)
def test_a_pair_is_reduced_like_any_level_to_the_bit(rows, cols, seed, bits, few):
    """The short way for two frames against the general one; few values at both ends make the largest differences."""
    rng = np.random.default_rng(seed)
    codes = rng.choice([0, 1, 2**bits - 1], (2, rows, cols)) if few else rng.integers(0, 2**bits, (2, rows, cols))
    frames = codes.astype(np.uint8 if bits <= 8 else np.uint16)
    general = LevelAccumulator(bits)
    for frame in frames:
        general.add(frame)
    assert same_bits(summarize_pair(frames[0], frames[1], bits), general.summary())


def test_powers_of_differences_are_exact(rng: np.random.Generator):
    """The largest differences that 16 bits allow, whose fourth powers need 64 bits each, beside Python's integers."""
    frames = rng.choice([0, 1, 65535], (2, 40, 60)).astype(np.uint16)
    d = frames[1].astype(object) - frames[0].astype(object)
    n, s = d.size, [(d**k).sum() for k in range(5)]
    m2 = n * s[2] - s[1] ** 2
    m4 = n**3 * s[4] - 4 * n**2 * s[1] * s[3] + 6 * n * s[1] ** 2 * s[2] - 3 * s[1] ** 4
    assert summarize_pair(frames[0], frames[1], 16).kurtosis_excess == m4 / m2**2 - 3


@pytest.mark.parametrize("cfa", [None, "GRBG"])
def test_same_bits_for_any_number_of_threads(cfa, rng: np.random.Generator):
    groups = series(rng)
    lazy = [Group(g.kind, g.role, g.exposure_s, g.photons, [fetched(frame) for frame in g.frames]) for g in groups]
    alone = measure_frames(groups, BITS, cfa=cfa, threads=1)
    for threads, given_groups in ((2, lazy), (5, lazy), (3, groups)):
        for one, other in zip(alone, measure_frames(given_groups, BITS, cfa=cfa, threads=threads), strict=True):
            assert same_bits(one, other)


def fetched(frame: np.ndarray) -> Callable[[], np.ndarray]:
    return frame.copy


def test_no_more_frames_are_held_than_are_in_work(rng: np.random.Generator):
    lock, alive, most = threading.Lock(), 0, 0

    def gone() -> None:
        nonlocal alive
        with lock:
            alive -= 1

    def fetch(frame: np.ndarray) -> np.ndarray:
        nonlocal alive, most
        copy = frame.copy()
        with lock:
            alive += 1
            most = max(most, alive)
        weakref.finalize(copy, gone)
        return copy

    frame = noisy(500.0, 1, rng)[0]
    other = noisy(500.0, 1, rng)[0]
    levels = [Group(kind, "level", 1e-3 * i, float(i), noisy(30.0 * i, 2, rng)) for i in (1, 2, 3) for kind in ("dark", "bright")]
    long = [Group(kind, "stack", 1e-3, 1.0, [lambda k=k: fetch((frame, other)[k % 2]) for k in range(100)]) for kind in ("dark", "bright")]
    gc.collect()
    for threads in (1, 3):
        alive = most = 0
        measure_frames([*levels, *long], BITS, threads=threads)
        assert most <= 2 * threads + 2  # two in each thread's hands; a thread may go on before its last two are released


def test_progress_counts_every_frame_once(rng: np.random.Generator):
    groups = series(rng)
    counts = []
    measure_frames(groups, BITS, on_frames=counts.append)
    assert sum(counts) == sum(len(g.frames) for g in groups)


@pytest.mark.parametrize("mosaic", MOSAICS)
@pytest.mark.parametrize("shape", [(6, 8), (7, 9)])
def test_phases_take_the_pixels_of_their_colour(mosaic, shape):
    """Each pixel is marked by its colour letter, walking over the frame; green is told apart by the other colour of its row."""
    letters = np.array([[mosaic[2 * (r % 2) + c % 2] for c in range(shape[1])] for r in range(shape[0])])
    whole_rows, whole_cols = shape[0] // 2 * 2, shape[1] // 2 * 2
    found = phases(mosaic)
    assert tuple(found) == CHANNELS
    place = np.arange(letters.size).reshape(shape)
    for channel, part in found.items():
        row_has = {"Gr": "R", "Gb": "B"}.get(channel, "")
        want = [
            place[r, c]
            for r in range(whole_rows)
            for c in range(whole_cols)
            if letters[r, c] == channel[0] and (not row_has or row_has in letters[r])
        ]
        assert part(place).ravel().tolist() == want and part(place).shape == (whole_rows // 2, whole_cols // 2)


def test_a_channel_is_the_camera_of_its_pixels(rng: np.random.Generator):
    """Frames of odd sides, cut by hand with other means, reduced as a camera of their own: the same bits."""
    groups = series(rng, (27, 35))
    by_hand = {"R": (1, 0), "Gr": (1, 1), "Gb": (0, 0), "B": (0, 1)}
    measured = measure_frames(groups, BITS, cfa="GBRG")
    assert [m.channel for m in measured] == list(CHANNELS)
    for m in measured:
        row, col = by_hand[m.channel]
        index = np.ix_(range(row, 26, 2), range(col, 34, 2))
        own = [Group(g.kind, g.role, g.exposure_s, g.photons, [frame[index] for frame in g.frames]) for g in groups]
        (alone,) = measure_frames(own, BITS)
        assert same_bits(m.transfer, alone.transfer) and same_bits(m.bright_stack, alone.bright_stack)
        assert m.transfer.frame_shape == (13, 17)


def brightness(m: Measurement) -> list[float]:
    return [stack.mean_dn for stack in (m.dark_stack, m.bright_stack) if isinstance(stack, StackMoments)]


def test_which_stacks_are_taken_and_what_is_said(rng: np.random.Generator):
    levels = series(rng)[:-2]

    def stack(kind: str, exposure_s: float, mean: float, count: int = 9) -> Group:
        return Group(kind, "stack", exposure_s, mean if kind == "bright" else 0.0, noisy(mean, count, rng))

    swept = [stack("dark", 1e-3, 20.0), *(stack("bright", 1e-3, mean) for mean in (400.0, 1600.0, 4095.0))]
    (m,) = measure_frames([*levels, *swept], BITS)
    # of one exposure: the brightest that is not saturated; means of 9 frames of 884 pixels to 6 standard deviations
    assert brightness(m) == [pytest.approx(mean, abs=6 * (3 + np.sqrt(mean)) / np.sqrt(9 * 884)) for mean in (20.0, 1600.0)]
    assert m.bright_stack_photons == 1600.0
    (m,) = measure_frames([*levels, stack("dark", 1e-3, 20.0), stack("bright", 3e-3, 1600.0)], BITS)
    assert m.bright_stack is None and m.bright_stack_photons is None and "PRNU is not measured" in m.notes[0]
    (m,) = measure_frames([*levels, stack("bright", 3e-3, 1600.0)], BITS)
    assert m.dark_stack is None and "no stack of dark frames" in m.notes[0]


def test_exchanged_frames_are_refused(rng: np.random.Generator):
    """Bright and dark exchanged; a channel that sees nothing of the light is not."""
    groups = series(rng)
    other = {"dark": "bright", "bright": "dark"}
    with pytest.raises(MeasureError, match="bright levels are darker than the dark ones"):
        measure_frames([replace(g, kind=other[g.kind], photons=None if g.kind == "dark" else 0.0) for g in groups], BITS)
    blind = [replace(g, frames=noisy(20.0, 2, rng)) if g.kind == "bright" else g for g in groups if g.role == "level"]
    assert measure_frames(blind, BITS)[0].transfer.bright.mean_dn.max() < 30


def test_a_pair_of_two_lights_is_named(rng: np.random.Generator):
    """Levels 5 and 6 each with one frame of the other; light that flickers by 0.3 % from frame to frame is not.

    The flicker of the pairs is spread as evenly as a normal distribution, and the frames are so large that noise does not cover it: of 12
    pairs that are drawn, or of small frames, the median, by which the flicker is known, is far too small once in 200 runs.
    """
    shape = (104, 136)
    dark = [Group("dark", "level", i * 1e-3, 0.0, noisy(20.0, 2, rng, shape)) for i in range(1, 13)]
    evenly = 0.003 * np.sqrt(2) * stats.norm.ppf((np.arange(12) + 0.5) / 12)

    def pair(i: int, other: int, off: float) -> list[np.ndarray]:
        return [noisy(20.0 + 250 * k * (1 + change), 1, rng, shape)[0] for k, change in ((i, off / 2), (other, -off / 2))]

    swapped = {5: 6, 6: 5}
    for others, named in ((swapped, [5, 6]), ({}, [])):
        off = rng.permutation(evenly)
        bright = [Group("bright", "level", i * 1e-3, 1000.0 * i, pair(i, others.get(i, i), off[i - 1])) for i in range(1, 13)]
        notes = [note for note in measure_frames([*dark, *bright], BITS)[0].notes if "under different light" in note]
        assert [int(note.split("level ")[1].split()[0]) for note in notes] == named


def test_levels_of_full_pixels_below_the_top_code_are_no_copies(rng: np.random.Generator):
    groups = [g for g in series(rng) if g.role == "level"]
    full = np.full(SHAPE, 3000, np.uint16)
    (m,) = measure_frames([*groups, Group("bright", "level", 9e-3, 9000.0, [full, full.copy()])], BITS)
    assert m.transfer.bright.mean_dn[-1] == 3000 and m.transfer.bright.var_total_dn2[-1] == 0
    (pattern, _) = noisy(1500.0, 2, rng)
    with pytest.raises(MeasureError, match="identical"):
        measure_frames([*groups, Group("bright", "level", 9e-3, 9000.0, [pattern, pattern.copy()])], BITS)


def test_what_cannot_be_measured_is_refused(rng: np.random.Generator):
    groups = series(rng)
    for kind in ("dark", "bright"):
        (m,) = measure_frames([g for g in groups if g.kind != kind or g.role == "stack"], BITS)
        stacks = [len(g.frames) for g in groups if (g.kind, g.role) == (kind, "stack")]
        assert getattr(m.transfer, kind).n_frames.tolist() == stacks
    full = np.full(SHAPE, 2**BITS - 1, np.uint16)
    white = [Group(g.kind, g.role, g.exposure_s, g.photons, [full] * 2) if g.kind == "bright" else g for g in groups]
    with pytest.raises(MeasureError, match="all bright levels are saturated"):
        measure_frames(white, BITS)
    copied = [*groups[:-2], Group("bright", "level", 9e-3, 9e3, [groups[1].frames[0]] * 2)]
    with pytest.raises(MeasureError, match="identical"):
        measure_frames(copied, BITS)
    with pytest.raises(InputError, match="no such colour filter"):
        measure_frames(groups, BITS, cfa="RGBG")
    with pytest.raises(InputError, match="above the stated number of bits"):
        measure_frames(groups, 8)
    with pytest.raises(InputError, match="another shape"):
        measure_frames([Group("dark", "level", 1e-3, 0.0, [full, full[1:]])], BITS)
    with pytest.raises(MeasureError, match="too small"):
        measure_frames([Group("dark", "level", 1e-3, 0.0, [full[:1], full[:1]])], BITS)


def test_levels_do_not_hold_their_codes(rng: np.random.Generator):
    """What is kept of a level does not grow with the number of codes."""
    (m,) = measure_frames(series(rng), BITS)
    assert all(getattr(m.transfer.bright, f.name).shape == (5,) for f in fields(LevelMoments))
