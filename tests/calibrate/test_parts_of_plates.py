"""Plates of dots that are larger than the pictures, numbered by the marks among their dots."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from calibrate.test_calibration_images import Paint, View, dots
from pixmetry.calibrate.images import images
from pixmetry.calibrate.images.images import observations_of
from pixmetry.calibrate.images.looks import SAMPLES, Looks, by_marks, laid_on, round_steps
from pixmetry.calibrate.images.parts import numbered_parts
from pixmetry.calibrate.images.targets import Wanted
from pixmetry.core.errors import InputError, MeasureError

PLATE = (16, 13)  # columns, rows
HOLLOW = {(6, 5), (10, 5), (6, 8)}  # (col, row)
ROLLS = (0.0, 95.0, 185.0)
NONE = np.zeros(0, int)


def plate(hollow: set[tuple[int, int]]) -> Paint:
    """Dark dots of 0.5 of the pitch, some with a white middle of half their diameter."""
    whole = dots(*PLATE, radius=0.25)

    def paint(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        light = whole(x, y)
        for i, j in hollow:
            light = np.where(np.hypot(x - i, y - j) < 0.125, 1.0, light)
        return light

    return paint


def views_of(rolls: tuple[float, ...]) -> list[View]:
    """Each shows about a third of the plate, another one each time."""
    return [View((7.5 + 0.4 * k, 6.5 - 0.3 * k), 14.0, roll, 10 - 7 * k, -12 + 8 * k) for k, roll in enumerate(rolls)]


def assert_numbered_alike(views: list[View], image: np.ndarray, xy_px: np.ndarray, numbers: np.ndarray) -> None:
    """Numbers, x and y, are those of the plate, counted from the first row and column that is seen."""
    back = np.stack([np.linalg.inv(view.homography) for view in views])[image]
    ray = np.einsum("nij,nj->ni", back, np.column_stack([xy_px, np.ones(len(xy_px))]))
    away = ray[:, :2] / ray[:, 2:] - numbers
    assert np.abs(away - np.rint(away[0])).max() < 0.1  # of the pitch, with the eccentricity
    assert len(numbers) > 150 and numbers.min() == 0


def test_parts_are_numbered_alike_by_hollow_dots(rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch) -> None:
    """Rolled by 0, 95 and 185 degrees: numbers are those of the plate, with its size and without."""
    views, kept = views_of(ROLLS), []
    monkeypatch.setattr(images, "numbered_parts", lambda seen, *more: (kept.extend(seen), numbered_parts(seen, *more))[1])
    found = observations_of([view.frame(plate(HOLLOW), rng, sub=1) for view in views], "dots", grid=PLATE, pitch=1.0)
    assert_numbered_alike(views, found.image, np.column_stack([found.x_px, found.y_px]), found.xyz[found.point, :2])
    assert len(found.images) == 3 and "parts of the plate" in found.findings[0].text and not found.left_out
    any_size, _, _ = numbered_parts(kept, Wanted("dots"))
    assert not any(one.reason for one in any_size)
    image = np.repeat(np.arange(3), [len(one.keys) for one in any_size])
    x, y, keys = (np.concatenate([getattr(one, name) for one in any_size]) for name in ("x_px", "y_px", "keys"))
    assert_numbered_alike(views, image, np.column_stack([x, y]), keys[:, ::-1])
    for few in (kept[:2], [kept[0], replace(kept[1], looks=replace(kept[1].looks, row=NONE, col=NONE)), kept[2]]):
        with pytest.raises(InputError, match="cannot be numbered alike: .* 3 marks .* 3 images"):  # two agree, which may be by chance
            numbered_parts(few, Wanted("dots"))


def test_parts_without_marks_are_refused(rng: np.random.Generator) -> None:
    frames = [view.frame(plate(set()), rng, sub=1) for view in views_of(ROLLS[:2])]
    with pytest.raises(InputError, match="several images of any part of a plate cannot be numbered alike: .* 3 marks"):
        observations_of(frames, "dots", grid="any", pitch=1.0)
    with pytest.raises(MeasureError, match="dots were seen: a grid of .* not 16 × 13"):
        observations_of(frames[:1], "dots", grid=PLATE, pitch=1.0, least_images=1)


def cut(marks: dict[tuple[int, int], np.ndarray], corner: tuple[int, int], size: tuple[int, int], quarters: int) -> Looks:
    """What a picture shows of a plate with these marks: rows and columns from a corner on, counted from another one."""
    away = np.zeros((40, 40, SAMPLES, SAMPLES))
    for at, look in marks.items():
        away[at] = look
    away = away[corner[0] : corner[0] + size[0], corner[1] : corner[1] + size[1]]
    return Looks(np.ones(size, bool), *np.nonzero(away.any(axis=(2, 3))), away).turned(quarters)


def test_no_part_is_laid_where_it_does_not_belong(rng: np.random.Generator) -> None:
    """Three equal marks on a plate of 12 × 14 cells, and 150 windows of it, turned at will, half of them with a mark of another look, some
    with one of theirs covered: each is laid where it was cut, or not at all; three marks that are seen undisturbed always decide."""
    ring = np.fromfunction(lambda r, c: np.hypot(r - 5.5, c - 5.5) < 3, (SAMPLES, SAMPLES)).astype(float)
    marks = {(4, 4): ring, (4, 9): ring, (7, 4): ring}
    whole = cut(marks, (0, 0), (12, 14), 0)
    decided = 0
    for _ in range(150):
        size, quarters = (int(rng.integers(4, 10)), int(rng.integers(4, 12))), int(rng.integers(4))
        corner = (int(rng.integers(0, 13 - size[0])), int(rng.integers(0, 15 - size[1])))
        noisy = {at: look + 0.1 * rng.normal(size=look.shape) for at, look in marks.items()}
        disturbed = rng.random() < 0.5
        if disturbed:
            noisy[int(rng.integers(12)), int(rng.integers(14))] = rng.normal(0, 0.3, ring.shape)
            if rng.random() < 0.3:
                noisy[4, 9] = rng.normal(0, 0.3, ring.shape)
        way = laid_on(whole, cut(noisy, corner, size, quarters), range(4), shifted=True)
        if way is not None:
            assert (way.quarters + quarters) % 4 == 0 and way.shift == corner
            decided += 1
        elif not disturbed:
            assert sum(0 <= r - corner[0] < size[0] and 0 <= c - corner[1] < size[1] for r, c in marks) < 3
    assert decided > 20


def test_clutter_that_agrees_between_two_pictures_numbers_none() -> None:
    """The fourth picture shows two of three rings, turned by half a turn, and a blot where the third one is then expected, which has the
    look of a blot on the first picture, or of a ring that is filled: two pictures agree on a wrong place, and the others do not."""
    r, c = np.indices((SAMPLES, SAMPLES))
    ring, blot = (np.hypot(r - 5.5, c - 5.5) < 2).astype(float), (r > 7).astype(float)
    marks = {(4, 4): ring, (4, 8): ring, (7, 4): ring}
    first = cut(marks | {(3, 6): blot}, (2, 2), (9, 9), 0)
    others = [cut(marks, (2, 2), (8, 9), 1), cut(marks, (1, 3), (9, 8), 3)]
    two = {(4, 4): ring, (4, 8): ring, (5, 6): np.rot90(blot, 2)}
    fourth = cut(two, (2, 2), (5, 9), 2)  # without the third ring
    ways = by_marks([first, *others, fourth], range(4), shifted=True)
    assert [None if way is None else way.quarters for way in ways] == [0, 3, 1, None]
    assert by_marks([first, fourth], range(4), shifted=True) == [None, None]
    assert by_marks([first, others[0], fourth], range(4), shifted=True) == [None] * 3
    filled = {(4, 4): ring, (4, 8): ring, (1, 8): (np.hypot(r - 5.5, c - 5.5) < 4).astype(float)}
    assert laid_on(first, cut(filled, (1, 2), (6, 9), 2), range(4), shifted=True) is None


@pytest.mark.parametrize("change", [[[1, 0], [1, 1]], [[1, -1], [0, 1]], [[2, 1], [1, 1]]])
def test_steps_along_a_diagonal_are_told_by_the_dots(change: list[list[int]], rng: np.random.Generator) -> None:
    """Cells counted along a diagonal, seen through an affine map: the images of circles tell the true steps, up to quarters of a turn."""
    cells = np.stack(np.meshgrid(np.arange(6), np.arange(8), indexing="ij"), axis=-1).reshape(-1, 2)
    affine = np.array([[30.0, 8.0], [-12.0, 14.0]]) @ np.array([[0, 1], [1, 0]])
    places = cells @ affine.T + rng.normal(0, 0.05, (48, 2))
    shapes = np.tile(affine @ affine.T, (48, 1, 1))
    found = round_steps(cells @ np.array(change).T, places, shapes) @ np.array(change)
    assert np.abs(found).sum() == 2 and round(np.linalg.det(found)) == 1
