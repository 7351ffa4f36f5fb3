"""Eccentricity: what is located is the centre of area of a target's image, and that is not the image of the target's centre.

Perspective and the distortion over the target shift the centre of area. The shift is predicted from the full camera model by integrals
along the outline (Green's theorem), with a quadrature that converges exponentially in its number of nodes: equally spaced ones around a
circle, Gauss–Legendre ones along the sides of a square. It needs the target's size and the normal of its plane.

References
----------
J. Heikkilä, IEEE PAMI 22 (2000) 1066–1077 (circles in perspective; the distortion is treated there as constant over the target, here not).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from pixmetry.calibrate.bundle._model_kernels import Cameras, Outline, Targets, Views, area_centres
from pixmetry.calibrate.bundle.network import Network, State
from pixmetry.core.arrays import Array

CIRCLE_NODES = 20
SIDE_NODES = 6  # of each side of a square
FLAT = 0.01  # a field whose points lie this close to a plane (rms, as a part of their extent) lends its normal to its targets
WORST_TILT = np.pi / 4  # between a target's normal and the ray: there the shift of a circle is largest

Shape = Literal["circle", "square"]


@dataclass(frozen=True)
class Eccentricity:
    """Predicted shifts from the images of centres to the centres of area.

    Parameters
    ----------
    shift_px : ndarray, shape (n, 2)
        To subtract from what was measured; 0 where nothing is known about the target.
    corrected : ndarray of bool, shape (n,)
    possible_px : float
        Largest shift that targets of known size but unknown normal could have; 0 if there are none.
    """

    shift_px: np.ndarray
    corrected: np.ndarray
    possible_px: float

    @property
    def largest_px(self) -> float:
        """Largest shift that was predicted."""
        return float(np.hypot(*self.shift_px.T).max(initial=0.0))


def eccentricity(network: Network, state: State, shape: Shape = "circle") -> Eccentricity:
    """Predict the shifts of all image coordinates of targets with a size.

    Parameters
    ----------
    network : Network
        ``diameter`` is the side of a square. Without a ``normal`` a target takes that of the field if this is flat.
    state : State
    shape : {"circle", "square"}
        The sides of a square run along the object's x and y axes, as seen along its normal.
    """
    n = len(network)
    shift, corrected = np.zeros((n, 2)), np.zeros(n, bool)
    if network.diameter is None:
        return Eccentricity(shift, corrected, 0.0)
    seen = np.isfinite(network.diameter[network.point]) & state.located[network.point]
    seen &= state.posed[network.image]
    normal = normals(network, state)[network.point]
    known = seen & np.isfinite(normal).all(axis=1)
    shift[known] = predicted(network, state, np.flatnonzero(known), normal[known], shape)
    corrected[known] = np.isfinite(shift[known]).all(axis=1)
    shift[~corrected] = 0.0
    return Eccentricity(shift, corrected, _possible(network, state, np.flatnonzero(seen & ~known), shape))


def without_eccentricity(network: Network, found: Eccentricity) -> Network:
    """The network with image coordinates of the targets' centres."""
    return replace(network, x_px=network.x_px - found.shift_px[:, 0], y_px=network.y_px - found.shift_px[:, 1])


def predicted(network: Network, state: State, rows: np.ndarray, normal: np.ndarray, shape: Shape = "circle") -> np.ndarray:
    """Shifts of some image coordinates, px, shape (rows, 2), for targets across ``normal`` (unit vectors, shape (rows, 3))."""
    assert network.diameter is not None  # the rows are those of circles
    first = _along_x(normal)
    image, point = network.image[rows].astype(np.int64), network.point[rows]
    camera = network.camera_of[image].astype(np.int64)
    targets = Targets(image, camera, state.xyz[point], first, np.cross(normal, first), network.diameter[point] / 2)
    form = np.array([camera.form for camera in network.cameras], np.int64)
    cameras = Cameras(state.interior, form, np.array([camera.sensor.per_px for camera in network.cameras]))
    shift = area_centres(targets, Views(state.rotation, state.position), cameras, outline(shape))
    shift[:, 0] *= 1.0 + state.x_scale[image]
    return shift


def outline(shape: Shape) -> Outline:
    """Outline of a target of radius (half a side) 1."""
    if shape == "circle":
        t = 2 * np.pi * np.arange(CIRCLE_NODES) / CIRCLE_NODES
        return Outline(np.column_stack([np.cos(t), np.sin(t)]), np.column_stack([-np.sin(t), np.cos(t)]) * (2 * np.pi / CIRCLE_NODES))
    node, weight = np.polynomial.legendre.leggauss(SIDE_NODES)
    one, none = np.ones(SIDE_NODES), np.zeros(SIDE_NODES)
    place = [(one, node), (-node, one), (-one, -node), (node, -one)]
    step = [(none, weight), (-weight, none), (none, -weight), (weight, none)]
    return Outline(np.concatenate([np.column_stack(p) for p in place]), np.concatenate([np.column_stack(s) for s in step]))


def normals(network: Network, state: State) -> np.ndarray:
    """Unit normals of the targets, shape (points, 3): those given, else that of the field if it is flat, else NaN."""
    normal = np.full((len(network.points), 3), np.nan)
    if network.normal is not None:
        normal = network.normal / np.linalg.norm(network.normal, axis=1, keepdims=True)
    missing = ~np.isfinite(normal).all(axis=1)
    known = state.located
    if missing.any() and known.sum() >= 4:
        spread = np.linalg.svd(state.xyz[known] - state.xyz[known].mean(axis=0), full_matrices=False)
        if spread[1][2] < FLAT * spread[1][1]:
            normal[missing] = spread[2][2]
    return normal


def _along_x(normal: Array) -> Array:
    """Unit vectors across the normals, along the object's x axis as far as they can be (its y axis where a normal is along x)."""
    axis = np.where((np.abs(normal[:, :1]) < 0.9), [[1.0, 0.0, 0.0]], [[0.0, 1.0, 0.0]])
    flat = axis - (axis * normal).sum(axis=1, keepdims=True) * normal
    of_unit_length: Array = flat / np.linalg.norm(flat, axis=1, keepdims=True)
    return of_unit_length


def _possible(network: Network, state: State, rows: np.ndarray, shape: Shape) -> float:
    if not len(rows):
        return 0.0
    ray = state.xyz[network.point[rows]] - state.position[network.image[rows]]
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    first = _along_x(ray)
    second = np.cross(ray, first)
    largest = 0.0
    for turn in np.arange(8) * np.pi / 4:
        normal = np.cos(WORST_TILT) * ray + np.sin(WORST_TILT) * (np.cos(turn) * first + np.sin(turn) * second)
        shift = predicted(network, state, rows, normal, shape)
        largest = max(largest, float(np.nanmax(np.hypot(*shift.T), initial=0.0)))
    return largest
