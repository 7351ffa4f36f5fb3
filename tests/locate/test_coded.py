"""Coded targets drawn by brute force in perspective: read right or not at all; and their combinatorics against a count by hand."""

from __future__ import annotations

import re
from math import comb
from xml.etree import ElementTree

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from pixmetry.core.errors import InputError
from pixmetry.locate.detect.coded import code_svg, codes, least_rotation, read_codes, ring_members


def printed(u: np.ndarray, v: np.ndarray, number: int, bits: int = 12) -> np.ndarray:
    """Where a target of disc radius 1 at the origin is printed: a disc to 1, segments from 2 to 3, bit k from k/12 of a turn on."""
    radius, turn = np.hypot(u, v), np.arctan2(v, u) / (2 * np.pi) % 1
    segment = np.minimum((turn * bits).astype(int), bits - 1)
    return (radius < 1) | ((radius > 2) & (radius < 3) & ((number >> segment) & 1 == 1))


def drawn(number: int, to_image: np.ndarray, shape: tuple[int, int], blur: float = 0.7, fine: int = 6, bits: int = 12) -> np.ndarray:
    """Share of light, 0 … 1, of a target whose plane a homography maps into the image."""
    rows, cols = shape
    down, across = ((np.arange(n * fine) + 0.5) / fine - 0.5 for n in shape)
    back = np.linalg.inv(to_image)
    x, y = np.meshgrid(across, down)
    w = back[2, 0] * x + back[2, 1] * y + back[2, 2]
    u, v = (back[0, 0] * x + back[0, 1] * y + back[0, 2]) / w, (back[1, 0] * x + back[1, 1] * y + back[1, 2]) / w
    return gaussian_filter(printed(u, v, number, bits).astype(float), blur * fine).reshape(rows, fine, cols, fine).mean(axis=(1, 3))


def view(rng, radius: float, tilt_deg: float, near: float = 0.01) -> tuple[np.ndarray, tuple[float, float, float]]:
    """A homography for a target at a random turn and tilt axis, ``near`` = radius over distance; its disc's half axes and angle."""
    turn, axis = rng.uniform(0, 2 * np.pi, 2)
    c, s = np.cos(np.radians(tilt_deg)), np.sin(np.radians(tilt_deg))

    def about(angle: float) -> np.ndarray:
        return np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])

    affine = radius * about(axis) @ np.diag([1, c]) @ about(turn)
    fall = near * s * about(turn)[1]
    u, axes, _ = np.linalg.svd(affine)
    homography = np.eye(3)
    homography[:2, :2], homography[2, :2] = affine, fall
    return homography, (axes[0], axes[1], float(np.degrees(np.arctan2(u[1, 0], u[0, 0]))))


def read(rng, number: int, radius: float, tilt: float, *, noise=3.0, blur=0.7, contrast=170.0, slope=0.0, bits=12):
    """Draw one target, give the reader its ellipse as badly as a rough detection does (0.15 px), and read it."""
    homography, (a, b, angle) = view(rng, radius, tilt)
    side = int(2 * np.ceil(3.8 * radius + 5) + 1)
    middle = side / 2 + rng.uniform(-0.5, 0.5, 2)
    shift = np.eye(3)
    shift[:2, 2] = middle
    picture = drawn(number, shift @ homography, (side, side), blur, bits=bits)
    grey = 100 - contrast / 2 + contrast * picture + slope * (np.arange(side) - side / 2) + rng.normal(0, noise, picture.shape)
    frame = np.clip(np.rint(grey), 0, 255).astype(np.uint8)
    off = rng.normal(0, 0.15, 4)
    given = (middle[0] + off[0], middle[1] + off[1], a + off[2], b + off[3], angle, 0.95 * contrast)
    found = read_codes(frame, *(np.array([v]) for v in given), bits=bits)
    return int(found.number[0]), float(found.margin[0])


@pytest.mark.parametrize("bits", [6, 8, 12, 14])
def test_there_are_as_many_codes_as_burnside_counts(bits: int) -> None:
    """Necklaces with an even number of ones, by Burnside's lemma over the rotations, less the empty and the full ring."""
    fixed = 0
    for turn in range(bits):
        cycles = np.gcd(turn, bits)
        length = bits // cycles
        fixed += sum(comb(int(cycles), ones) for ones in range(cycles + 1) if ones * length % 2 == 0)
    assert len(codes(bits)) == fixed // bits - 2
    assert len(codes()) == 178


def test_no_single_misread_segment_makes_another_code() -> None:
    known = set(codes())
    for number in known:
        for bit in range(12):
            assert int(least_rotation(np.array([number ^ (1 << bit)]))[0]) not in known


def test_a_number_does_not_depend_on_where_the_ring_begins() -> None:
    words = np.arange(4096)
    by_hand = [min(int(f"{w:012b}"[k:] + f"{w:012b}"[:k], 2) for k in range(12)) for w in range(4096)]
    assert least_rotation(words).tolist() == by_hand


@pytest.mark.parametrize(("radius", "tilt"), [(4.5, 0), (5.5, 30), (6.5, 45), (9, 60), (12, 60), (25, 50)])
def test_every_target_is_read_right(radius: float, tilt: float, rng: np.random.Generator) -> None:
    """Random codes, turns and phases, both polarities, noise 3 of 170; smaller half axes from 4.5 px (margins from 0.6)."""
    for number in rng.choice(codes(), 12):
        found, margin = read(rng, int(number), radius, tilt, contrast=float(rng.choice([-170, 170])))
        assert found == number and margin > 0.3


def test_all_codes_are_read_right(rng: np.random.Generator) -> None:
    assert [read(rng, number, 5.0, 20.0)[0] for number in codes()] == list(codes())


def test_uneven_light_and_weak_contrast(rng: np.random.Generator) -> None:
    for number in rng.choice(codes(), 10):
        assert read(rng, int(number), 6.0, 30.0, contrast=60.0, noise=4.0, slope=0.6)[0] == number


def test_targets_too_small_to_be_read_are_not_read_wrong(rng: np.random.Generator) -> None:
    """Half axes of 1 … 3 px, where segments run together: of 300 at most 8 wrong (a rate of 1 % gives more once in 300)."""
    wrong = 0
    for number in rng.choice(codes(), 300):
        found, _ = read(rng, int(number), rng.uniform(1, 3), rng.uniform(0, 60), noise=5.0, blur=0.8)
        wrong += found not in (-1, number)
    assert wrong <= 8


def test_what_is_no_coded_target_has_no_code(rng: np.random.Generator) -> None:
    """Plain discs, rings, discs among others, chessboard corners, noise: of 2000 at most 9 are taken for codes.

    Two thirds of one on average (22 in 33 runs, all of them in the crowd): even of one, ten come by chance once in 10⁷ runs.
    """
    size = 600
    row, col = np.indices((size, size)).astype(float)
    x, y = rng.uniform(30, size - 30, (2, 400))
    crowd = np.zeros((size, size))
    for cx, cy in zip(x, y, strict=True):
        crowd = np.maximum(crowd, np.clip(5.5 - np.hypot(col - cx, row - cy), 0, 1))
    taken = 0
    for picture in (
        crowd,
        np.clip(5.5 - np.hypot(col % 40 - 20, row % 40 - 20), 0, 1),
        np.clip(5.5 - np.hypot(col % 40 - 20, row % 40 - 20), 0, 1) + (np.abs(np.hypot(col % 40 - 20, row % 40 - 20) - 12.5) < 2.5),
        ((col // 12 + row // 12) % 2),
        gaussian_filter(rng.normal(0, 1, (size, size)), 3) * 8,
    ):
        frame = (30 + 170 * gaussian_filter(picture.astype(float), 0.8) + rng.normal(0, 3, picture.shape)).astype(np.float32)
        px, py = (x, y) if picture is crowd else (np.round(x / 40) * 40 - 20, np.round(y / 40) * 40 - 20)
        five = np.full(400, 5.0)
        found = read_codes(frame, px, py, five, five, np.zeros(400), np.full(400, 170.0))
        taken += (found.number >= 0).sum()
    assert taken <= 9


def test_the_same_number_in_every_view(rng: np.random.Generator) -> None:
    number = int(rng.choice(codes()))
    assert {read(rng, number, rng.uniform(6, 15), rng.uniform(0, 55))[0] for _ in range(15)} == {number}


def test_other_rings(rng: np.random.Generator) -> None:
    for bits, radius in ((8, 4.0), (14, 6.0)):
        number = int(rng.choice(codes(bits)))
        assert read(rng, number, radius, 20.0, bits=bits)[0] == number


def test_segments_are_known_as_parts_of_their_target(rng: np.random.Generator) -> None:
    """Centres of the segments of a ring under 50° of tilt, a neighbour outside it, and a target without a code."""
    homography, (a, b, angle) = view(rng, 8.0, 50.0, near=0.0)
    turns = (np.arange(12) + 0.5) / 12 * 2 * np.pi
    segments = (homography[:2, :2] @ (2.5 * np.stack([np.cos(turns), np.sin(turns)]))).T + 100
    outside = homography[:2, :2] @ [3.4, 0] + 100
    place = np.vstack([[100, 100], segments, outside, [300, 300], [303, 300]])
    n = len(place)
    member = ring_members(*place.T, np.full(n, a), np.full(n, b), np.full(n, angle), np.where(np.arange(n) == 0, 3, -1))
    assert member.tolist() == [False] + [True] * 12 + [False] * 3


def test_a_ring_that_leaves_the_frame_has_no_code(rng: np.random.Generator) -> None:
    homography, (a, b, angle) = view(rng, 6.0, 0.0)
    shift = np.eye(3)
    shift[:2, 2] = 12, 30
    frame = np.rint(200 * drawn(15, shift @ homography, (60, 60))).astype(np.uint8)
    found = read_codes(frame, np.array([12.0]), np.array([30.0]), np.array([a]), np.array([b]), np.array([angle]), np.array([200.0]))
    assert found.number[0] == -1 and np.isnan(found.margin[0])
    none = read_codes(frame, *(np.empty(0),) * 6)
    assert len(none.number) == len(none.margin) == 0
    bad = read_codes(frame, *(np.array([v]) for v in (np.nan, 30.0, a, b, angle, 0.0)))
    assert bad.number[0] == -1


@pytest.mark.parametrize("bright", [True, False])
def test_the_drawing_for_print_shows_the_code(bright: bool) -> None:
    """The SVG's own shapes, tested point by point, are those of the scheme: disc 1, ring 2 … 3, and nothing else within 4."""
    number = 1919
    root = ElementTree.fromstring(code_svg(number, 20.0, bright=bright))
    assert root.get("width") == "80mm" and root.get("viewBox") == "-40 -40 80 80"
    space = "{http://www.w3.org/2000/svg}"
    assert root.find(f"{space}rect").get("fill") == ("black" if bright else "white")
    assert root.find(f".//{space}circle").get("r") == "10"
    turns = []
    for path in root.iter(f"{space}path"):
        n = [float(v) for v in re.findall(r"-?[\d.]+", path.get("d"))]
        (x0, y0), (x1, y1) = n[0:2], n[2:4]
        assert np.hypot(x0, y0) == pytest.approx(20, abs=1e-4) and np.hypot(x1, y1) == pytest.approx(30, abs=1e-4)
        turns.append(round(np.degrees(np.arctan2(y0, x0)) % 360 / 30))
    assert sum(1 << t for t in turns) == number
    assert f">{number}</text>" in code_svg(number) and "</text>" not in code_svg(number, label=False)


def test_what_cannot_be_printed_or_asked_for() -> None:
    for number in (0, 1, 4095, -1, 6):  # none, odd, all, no number, not the least rotation
        with pytest.raises(InputError, match="not a code"):
            code_svg(number)
    with pytest.raises(InputError, match="no size"):
        code_svg(3, 0.0)
    with pytest.raises(InputError, match="ring"):
        codes(4)
