"""Cameras in front of turned squares: what a real one would store of 20 slanted edges."""

from __future__ import annotations

import numpy as np

from pixmetry.camera.camera import Camera, Element, in_order
from pixmetry.camera.catalogue import get_source
from pixmetry.observe.edges import Picture
from pixmetry.scene.outlines import polygon
from pixmetry.scene.picture import Picture as Scene
from pixmetry.scene.shapes import Shapes
from pixmetry.scene.uniform import Uniform

CELL, SIDE = 172, 126.0
HEIGHT_DN, LOW_DN = 150.0, 40.0


def clean_squares(
    rng: np.random.Generator, sources: dict[str, dict[str, object]], cells: tuple[int, int] = (1, 5), angle_deg: float = 5.0
) -> np.ndarray:
    """Squares turned by 5 degrees, one a cell, through some sources in front of the pixels: mean values in DN, without noise."""
    turn = np.radians(angle_deg)
    outlines = []
    for i in range(cells[0]):
        for j in range(cells[1]):
            x, y = CELL * (j + 0.5) + rng.uniform(-0.5, 0.5), CELL * (i + 0.5) + rng.uniform(-0.5, 0.5)
            u, v = 0.5 * SIDE * np.array([-1, 1, 1, -1]), 0.5 * SIDE * np.array([-1, -1, 1, 1])
            corner_x, corner_y = x + u * np.cos(turn) - v * np.sin(turn), y + u * np.sin(turn) + v * np.cos(turn)
            outlines.append(polygon(corner_x, corner_y, HEIGHT_DN))
    found = {name: get_source(name) for name in sources}
    chain = tuple(Element(s.id, s, s.parameters(**sources[s.id])) for s in in_order(found.values()))
    camera = Camera("squares", (cells[0] * CELL, cells[1] * CELL), chain)
    light = camera.expose(Scene((Shapes.of(outlines),), Uniform(LOW_DN)), 1).data[0]
    return np.asarray(light, float)


def stored_picture(rng: np.random.Generator, clean: np.ndarray, noise_dn: float = 1.5) -> Picture:
    """A frame of 8 bits with white noise, as a picture of edges."""
    frame = np.clip(np.rint(clean + noise_dn * rng.standard_normal(clean.shape)), 0, 255).astype(np.float32)
    return Picture("edge", frame, 1, 255.0)


DIGITISED: dict[str, dict[str, object]] = {  # what stands in every chain behind the light, here
    "sensor.quantum_efficiency": {"quantum_efficiency": 1.0},
    "sensor.shot_noise": {},
    "sensor.prnu": {"pixel_std_rel": 0.004},
    "electronics.gain": {"gain_dn_per_e": 0.02},
    "electronics.amplifier_noise": {"white_e": 60.0},
    "grabber.adc": {"bits": 8, "offset_dn": 5.0},
}


def stored_squares(rng: np.random.Generator, sources: dict[str, dict[str, object]], cells: int = 5, seed: int = 1) -> Picture:
    """A frame of 8 bits of five turned squares in a row, 40 px off its left side, through a camera's whole chain."""
    turn, electrons = np.radians(5.0), 50.0
    outlines = []
    for j in range(cells):
        x, y = 40 + CELL * (j + 0.5) + rng.uniform(-0.5, 0.5), 0.5 * CELL + rng.uniform(-0.5, 0.5)
        u, v = 0.5 * SIDE * np.array([-1, 1, 1, -1]), 0.5 * SIDE * np.array([-1, -1, 1, 1])
        corner_x, corner_y = x + u * np.cos(turn) - v * np.sin(turn), y + u * np.sin(turn) + v * np.cos(turn)
        outlines.append(polygon(corner_x, corner_y, electrons * HEIGHT_DN))
    values = DIGITISED | sources
    chain = tuple(Element(s.id, s, s.parameters(**values[s.id])) for s in in_order(get_source(name) for name in values))
    camera = Camera("squares", (CELL, 70 + cells * CELL), chain, unit_seed=seed)
    codes = camera.expose(Scene((Shapes.of(outlines),), Uniform(electrons * LOW_DN)), 1).data[0]
    return Picture("edge", np.asarray(codes, np.float32), 1, 255.0)
