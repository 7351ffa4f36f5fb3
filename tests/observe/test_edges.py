"""Slanted edges: found by themselves, measured without bias, refused with the reason."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest

from observe.edge_pictures import one_edge, response, squares, stored
from pixmetry.camera.observations import SlantedEdges
from pixmetry.core.errors import InputError
from pixmetry.core.threads import set_threads
from pixmetry.observe._edge_kernels import find_steps
from pixmetry.observe.edge_fit import fit_edges
from pixmetry.observe.edges import Picture, edge_notes, responses_of, search_edges

LIMIT = 5.5  # u; beyond it once in 3e7
DATA = os.environ.get("PIXMETRY_DATA", "")


def seen(*frames: np.ndarray, top: float = 4095.0) -> SlantedEdges:
    return responses_of(search_edges([Picture("edge", np.asarray(f, np.float32), 1, top) for f in frames]))


def test_all_sides_of_turned_squares_are_found_and_their_response_is_the_closed_form(rng: np.random.Generator):
    """Four edges a square, half of them of either polarity; the e-SFR within 5.5 u + 0.001 (the bins' own error) up to 1 cycle/px.

    A bin's width left uncorrected would be an error of 0.006 at 0.5 cycles/px, 10 u.
    """
    found = seen(stored(squares(rng)))
    assert len(found.edges) == 16 and not found.refused
    assert sorted(e.across for e in found.edges) == ["x"] * 8 + ["y"] * 8
    assert [sum(e.rising for e in found.edges if e.across == axis) for axis in "xy"] == [4, 4]
    low = found.frequency <= 1.0
    truth = response(found.frequency, 0.5)
    for mean in (found.x, found.y):
        assert mean is not None and mean.edges == 8
        u = np.sqrt(np.diag(mean.covariance))
        assert u[found.frequency == 0.5] < 0.004
        assert np.all(np.abs(mean.sfr - truth)[low] < LIMIT * u[low] + 0.001)
    for e in found.edges:
        limit = LIMIT * e.u_angle_deg if e.order == 1 else 0.05  # a higher order is taken by chance where the middle looks bent
        assert abs(abs(e.angle_deg) - 5.0) < limit
        assert abs(e.asymmetry) < LIMIT * e.u_asymmetry
        assert abs(e.low_dn - 200) < 3 and abs(e.high_dn - 1200) < 3 and e.noise_dn == pytest.approx(5.0, rel=0.2)


def test_stated_u_is_the_scatter(rng: np.random.Generator):
    """40 edges: rms of z of SFR50 and of the SFR at 0.2 and 0.5 between 0.5 and 1.6 (chi square of 40: 1e-6 at 0.53 and 1.56)."""
    frames = [stored(one_edge(rng, angle_deg=rng.uniform(3, 9) * rng.choice([-1, 1]), noise=10.0)) for _ in range(40)]
    found = seen(*frames)
    edges = found.edges
    assert len(edges) >= 36 and all("parts of a pixel" in r.reason for r in found.refused)  # a slope near 1/6 or 1/7 repeats too soon
    frequency = seen(frames[0]).frequency
    truth = response(frequency, 0.5)
    half = np.interp(0.5, truth[::-1][-60:], frequency[::-1][-60:])
    z = [np.array([(e.sfr50 - half) / e.u_sfr50 for e in edges])]
    z += [np.array([(e.sfr[k] - truth[k]) / e.u_sfr[k] for e in edges]) for k in (10, 25)]
    for column in z:
        assert 0.5 < np.sqrt(np.mean(column**2)) < 1.6


def test_turned_picture_exchanges_x_and_y(rng: np.random.Generator):
    frame = stored(squares(rng))
    one, other = seen(frame), seen(np.ascontiguousarray(frame.T))
    assert one.x is not None and other.y is not None and one.y is not None and other.x is not None
    np.testing.assert_array_equal(one.x.sfr, other.y.sfr)
    np.testing.assert_array_equal(one.y.covariance, other.x.covariance)


def test_bent_edges_are_followed(rng: np.random.Generator):
    """An edge bowed by 1.2 px: a straight line would lose 0.07 of the SFR at 0.3 cycles/px, which is more than 10 u."""
    (edge,) = seen(stored(one_edge(rng, bend_px=1.2))).edges
    assert edge.order >= 2
    k = int(np.argmin(np.abs(np.linspace(0, 2, 101) - 0.3)))
    assert abs(edge.sfr[k] - response(np.array([0.3]), 0.5)[0]) < LIMIT * edge.u_sfr[k] + 0.002
    assert edge.u_sfr[k] < 0.01


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda rng: one_edge(rng, angle_deg=0.5), "angle is 0.5 degrees"),
        (lambda rng: one_edge(rng, angle_deg=20), "angle is 20"),
        (lambda rng: one_edge(rng, angle_deg=44), "angle is 4"),
        (lambda rng: one_edge(rng, high=5000), "clipped"),
        (lambda rng: one_edge(rng, low=-100), "clipped"),
        (lambda rng: one_edge(rng, shape=(24, 100)), "too short"),
        (lambda rng: one_edge(rng, low=600, high=1600, noise=70.0), "times the noise"),
        (lambda rng: one_edge(rng, shape=(120, 20)), "border"),
        (lambda rng: one_edge(rng) + 12 * np.arange(100), "changes by"),
        (lambda rng: one_edge(rng) + 3 * np.arange(120)[:, None], "along the edge"),
        (lambda rng: one_edge(rng) - np.roll(one_edge(rng, noise=0), 9, axis=1) + 800, "another edge"),
        (lambda rng: one_edge(rng, angle_deg=np.degrees(np.arctan(0.2)), at_px=49.95), "parts of a pixel"),
    ],
)
def test_edges_that_cannot_be_measured_say_why(make, words: str, rng: np.random.Generator):
    found = seen(stored(make(rng)))
    assert not found.edges
    assert any(words in r.reason for r in found.refused), [r.reason for r in found.refused]
    assert edge_notes(found)


def test_pictures_without_edges(rng: np.random.Generator):
    assert edge_notes(None) == []
    for frame in (np.zeros((60, 80)), 500 + 5 * rng.standard_normal((200, 300)), np.ones((1, 1)), np.ones((3, 7)), np.ones((400, 2))):
        found = seen(frame)
        assert not found.edges and not found.refused and not len(found.fit) and "no edge was found" in edge_notes(found)[0]


def test_any_number_of_threads_gives_the_same_bits(rng: np.random.Generator):
    frame = stored(squares(rng))
    try:
        set_threads(1)
        one = seen(frame)
        set_threads(3)
        three = seen(frame)
    finally:
        set_threads(None)
    assert [e.sfr50 for e in one.edges] == [e.sfr50 for e in three.edges]


def test_steps_are_those_of_plain_numpy(rng: np.random.Generator):
    frame = stored(squares(rng, shape=(210, 220))).astype(np.float32)
    total = frame[:-2].astype(float) + frame[1:-1] + frame[2:]
    slope = np.zeros((208, 220))
    slope[:, 2:-2] = (total[:, 3:-1] + total[:, 4:] - total[:, :-4] - total[:, 1:-3]) / 6
    expected = []
    for r, c in zip(*np.nonzero(np.abs(slope) >= 200.0), strict=True):
        if 4 <= c < 216:
            own = np.sign(slope[r, c]) * slope[r, c - 2 : c + 3]
            if own[2] >= own[0] and own[2] >= own[1] and own[2] > own[3] and own[2] > own[4]:
                expected.append((r + 1, c, slope[r, c]))
    row, col, size = np.zeros(9999, np.int64), np.zeros(9999), np.zeros(9999)
    n = find_steps(frame, 0, 210, 200.0, row, col, size)
    assert n == len(expected) and n > 100
    np.testing.assert_array_equal(row[:n], [e[0] for e in expected])
    np.testing.assert_allclose(size[:n], [e[2] for e in expected])
    assert np.all(np.abs(col[:n] - [e[1] for e in expected]) <= 0.5)


@pytest.mark.skipif(not (Path(DATA) / "sfrmat5-edges").is_dir(), reason="PIXMETRY_DATA names no folder with sfrmat5-edges")
@pytest.mark.parametrize(("name", "axis"), [("v_edge", "x"), ("h_edge", "y")])
def test_published_edges_of_sfrmat5(name: str, axis: str):
    """sfrmat5 (P. D. Burns) states 5.38 degrees, SFR50 0.203 and 0.202 cycles/px, sampling efficiency 68 % for its example edges."""
    from pixmetry.files import read_frame

    try:
        frame = read_frame(Path(DATA) / "sfrmat5-edges" / f"{name}.tif")
    except InputError:  # colour, which read_frame refuses: luminance, as sfrmat5 weights it
        import tifffile

        frame = tifffile.imread(Path(DATA) / "sfrmat5-edges" / f"{name}.tif") @ np.array([0.213, 0.715, 0.072])
    found = seen(frame, top=255.0)
    (edge,) = found.edges
    # 68 % there, rounded, with a window that tapers all of the edge and takes a little off every detail
    assert found.fit[f"sampling_efficiency_{axis}"].value == pytest.approx(0.68, abs=0.02)
    assert edge.across == axis
    assert abs(edge.angle_deg) == pytest.approx(5.38, abs=0.05)
    assert edge.sfr50 == pytest.approx(0.2025, abs=0.004) and edge.u_sfr50 < 0.004
    optics = fit_edges(search_edges([Picture("edge", np.asarray(frame, np.float32), 1, 255.0)]).measured)
    assert optics.names == ("spread_var_px2",)  # a colour camera's picture: what was filtered is not taken for the lens
    assert "correlated" in optics.reasons["spread_var_px2"]
