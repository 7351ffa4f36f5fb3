"""The cover glass: rays traced through a plate, printed residuals, and the place of the image."""

from __future__ import annotations

import numpy as np
import pytest

from light_scenes import mapped
from pixmetry.sources.optics.cover_glass import SOURCE, CoverGlass

GLASS = CoverGlass(thickness_um=750.0, principal_distance_mm=8.0)


def moved_um(glass: CoverGlass, angle: float) -> float:
    """How far outwards the image of a chief ray of this angle, to the right of the centre, moves."""
    ideal = 1000 * glass.principal_distance_mm * np.tan(angle) / glass.pitch_x_um
    (x,), (y,) = mapped(SOURCE, glass, [600 + ideal], [500.0], (1001, 1201))
    assert y == 500
    return (x - 600 - ideal) * glass.pitch_x_um


@pytest.mark.parametrize(("degrees", "micrometres"), [(10.0, 0.75), (20.0, 6.3)])
def test_what_focusing_leaves_of_three_quarters_of_a_millimetre(degrees, micrometres):
    assert moved_um(GLASS, np.radians(degrees)) == pytest.approx(-micrometres, rel=0.01)


def traced_um(angle: float, thickness_um: float, index: float) -> float:
    """Where a ray crosses the plane in which paraxial rays meet, with the plate less without it; Snell's law by vectors."""
    ray, normal = np.array([np.sin(angle), np.cos(angle)]), np.array([0.0, 1.0])

    def to_paraxial_focus(through: float) -> float:
        turned = ray / through
        inside = turned + (np.sqrt(1 - turned[0] ** 2) - turned[1]) * normal
        depth = 20_000.0  # from the front of the plate to the focus without it
        at = thickness_um * inside[0] / inside[1]
        return at + (depth + thickness_um * (1 - 1 / through) - thickness_um) * np.tan(angle)

    return to_paraxial_focus(index) - to_paraxial_focus(1.0)


@pytest.mark.parametrize("index", [1.3, 1.5, 1.8])
def test_it_is_a_ray_through_a_plate(index):
    glass = GLASS.model_copy(update={"index": index})
    for angle in (0.02, 0.2, 0.5, 0.8):
        assert moved_um(glass, angle) == pytest.approx(traced_um(angle, 750.0, index), rel=1e-5, abs=1e-6)


def test_the_image_lies_nearer_to_the_centre():
    """At 30° to the right of the centre, and aslant; on square pixels the direction stays."""
    square = GLASS.model_copy(update={"pitch_x_um": 8.0, "pitch_y_um": 8.0})
    ideal = 1000 * np.tan(np.radians(30.0))  # px: 8 mm over 8 µm
    x, y = mapped(SOURCE, square, [600 + ideal, 600 + 0.6 * ideal], [500.0, 500 + 0.8 * ideal], (1001, 1201))
    moved = traced_um(np.radians(30.0), 750.0, 1.5) / 8.0
    assert x == pytest.approx([600 + ideal + moved, 600 + 0.6 * (ideal + moved)], abs=1e-6)
    assert y == pytest.approx([500.0, 500 + 0.8 * (ideal + moved)], abs=1e-6)
    assert moved < -2
