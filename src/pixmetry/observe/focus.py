"""The focus over the frame, from the same edges at several settings of the focus: tilt and unflatness of the sensor, f-number.

Where the sensor lies z behind the image of the chart and is moved by δ, the blur's variance grows by ((z + δ)/4N)² along each axis: a
parabola over δ at every edge. Its vertex tells z with its sign; its curvature, the same everywhere, the f-number. What lens, pixel and
electronics do besides is the same at all settings: a constant of each edge.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from pixmetry.camera.observations import FocusOverFrame, SlantedEdge
from pixmetry.camera.stated import StatedFacts
from pixmetry.core.arrays import Array
from pixmetry.core.number import Estimates

LEAST_SETTINGS = 3  # of which each edge shows a parabola
LEAST_EDGES = 9
NEAR_PX = 12.0  # by which an edge may move from one setting to another
LEVEL, LEAST_LEVEL = 0.6, 0.1  # response at which the blur is read, on average; below the other an edge tells nothing
LEAST_SPREAD = 0.2  # of the frame, standard deviation of the edges' places along x and y
CURVED = 5.0  # u of the curvature, from which on there is one
TILT, SHAPES = ("tilt_x_deg", "tilt_y_deg"), ("bow_x_um", "bow_y_um", "twist_um")
METHOD = "blur of slanted edges over the focus setting, a parabola at every edge"


@dataclass(frozen=True)
class _Reading:
    """One edge at one setting: which edge it is, and −ln of its response over 2π²ν², px²."""

    edge: int
    focus_um: float
    v_px2: float
    u_px2: float


def focus_of(
    edges: Sequence[SlantedEdge], frequency: Array, focus_um: Sequence[float], frame_shape: tuple[int, int], stated: StatedFacts
) -> FocusOverFrame:
    """Fit the focus over the frame.

    Parameters
    ----------
    edges : sequence of SlantedEdge
    frequency : ndarray
        Of their response, cycles/px.
    focus_um : sequence of float
        Of each picture: how far the sensor was from the lens beyond its first place, µm; NaN: not told.
    frame_shape : (int, int)
    stated : StatedFacts

    Returns
    -------
    FocusOverFrame

    Notes
    -----
    Linear least squares of v = A_e + q δ² + 2 q δ z(x, y), weighted by the response's u, with the scatter about it; then z and all that
    follows, with the covariance carried on. Each direction of the edges has a focus and a curvature of its own (astigmatism). A field
    that is curved as the square of the radius is the lens's, and is left out of the bow.
    """
    readings, places, across = _readings(edges, frequency, focus_um)
    settings = tuple(sorted({float(f) for f in focus_um if np.isfinite(f)}))
    empty = FocusOverFrame(settings, places, across, np.zeros(len(places)), np.zeros(len(places)), Estimates.empty())
    if stated.pitch_x_um is None:
        return _untold(empty, "the pixel pitch is not stated (pitch_um)")
    if len(settings) < LEAST_SETTINGS:
        return _untold(empty, f"{len(settings)} settings of the focus; three or more are needed, with the best focus between them")
    if len(places) < LEAST_EDGES or (places.std(axis=0) < LEAST_SPREAD * np.array(frame_shape[::-1])).any():
        what = f"{len(places)} edges are seen at three settings or more"
        return _untold(empty, f"{what}; {LEAST_EDGES} or more all over the frame are needed")
    pitch = stated.pitch_x_um, stated.pitch_y_um or stated.pitch_x_um
    return _fitted(empty, readings, frame_shape, pitch)


def _untold(empty: FocusOverFrame, reason: str) -> FocusOverFrame:
    return replace(empty, fit=replace(Estimates.empty(), reasons=dict.fromkeys((*TILT, *SHAPES), reason)))


def _readings(edges: Sequence[SlantedEdge], frequency: Array, focus_um: Sequence[float]) -> tuple[list[_Reading], Array, tuple[str, ...]]:
    """The blur of every edge that several settings show, its place, and its direction."""
    used = [e for e in edges if np.isfinite(focus_um[e.picture])]
    at = {axis: _frequency([e.sfr for e in used if e.across == axis], frequency) for axis in "xy"}
    known: list[tuple[str, float, float]] = []
    found: list[_Reading] = []
    for e in used:
        near = [k for k, (axis, x, y) in enumerate(known) if axis == e.across and np.hypot(x - e.x_px, y - e.y_px) < NEAR_PX]
        k = near[0] if near else len(known)
        if not near:
            known.append((e.across, e.x_px, e.y_px))
        response, u = e.sfr[at[e.across]], e.u_sfr[at[e.across]]
        if response < LEAST_LEVEL or not u > 0:
            continue
        scale = 2 * (np.pi * frequency[at[e.across]]) ** 2
        found.append(_Reading(k, float(focus_um[e.picture]), float(-np.log(response) / scale), float(u / response / scale)))
    settings = {k: {r.focus_um for r in found if r.edge == k} for k in range(len(known))}
    kept = [k for k in range(len(known)) if len(settings[k]) >= LEAST_SETTINGS]
    number = {k: i for i, k in enumerate(kept)}
    places = np.array([known[k][1:] for k in kept], float).reshape(-1, 2)
    return [replace(r, edge=number[r.edge]) for r in found if r.edge in number], places, tuple(known[k][0] for k in kept)


def _frequency(responses: Sequence[Array], frequency: Array) -> int:
    """Where the mean response falls to the level: there the blur's variance is told best."""
    if not responses:
        return 1
    mean = np.asarray(np.mean(responses, axis=0))
    return max(int(np.argmax(mean < LEVEL)), 1)


def _fitted(
    empty: FocusOverFrame, readings: Sequence[_Reading], frame_shape: tuple[int, int], pitch_um: tuple[float, float]
) -> FocusOverFrame:
    rows, cols = frame_shape
    of = np.array([r.edge for r in readings])
    focus, v, u = (np.array([getattr(r, name) for r in readings]) for name in ("focus_um", "v_px2", "u_px2"))
    focus = focus - focus.mean()
    shapes, names = _shapes(empty, frame_shape, pitch_um)
    constant = (of[:, None] == np.arange(len(empty.places_px))).astype(float)
    design = np.hstack([constant, focus[:, None] ** 2, 2 * focus[:, None] * shapes[of]]) / u[:, None]
    size = np.linalg.norm(design, axis=0)
    normal = (design / size).T @ (design / size)
    power = np.linalg.eigvalsh(normal)
    dof = len(v) - design.shape[1]
    if power[0] < 1e-9 or dof < 1:
        return _untold(empty, "the edges do not tell a plane and its bending from each other; show more of them all over the frame")
    inverse = np.linalg.inv(normal) / np.outer(size, size)
    solved = inverse @ (design.T @ (v / u))
    chi2 = float(((v / u - design @ solved) ** 2).sum())
    edges = len(empty.places_px)
    covariance = inverse[edges:, edges:] * max(chi2 / dof, 1.0)
    q, b = float(solved[edges]), solved[edges + 1 :]
    if q < CURVED * np.sqrt(covariance[0, 0]):
        return _untold(empty, "the blur does not grow on both sides of a best focus; take settings farther apart, to both sides")
    height = b / q  # µm
    slope = np.hstack([-height[:, None] / q, np.eye(len(b)) / q])
    of_height = slope @ covariance @ slope.T
    z, u_z = shapes @ height, np.sqrt(np.einsum("ij,jk,ik->i", shapes, of_height, shapes))
    f_number = 1 / (4 * np.sqrt(q * pitch_um[0] * pitch_um[1]))
    jacobian, values, told, units = [], [], [], []
    for name, half_um in zip(("plane_x", "plane_y"), (cols / 2 * pitch_um[0], rows / 2 * pitch_um[1]), strict=True):
        i = names.index(name)
        t = height[i] / half_um
        values.append(float(np.degrees(np.arctan(t))))
        jacobian.append(np.degrees(slope[i] / half_um / (1 + t**2)))
    told, units = [*TILT], ["deg", "deg"]
    if "bend" in names:
        i, (bow_x, bow_y) = names.index("bend"), _bend(frame_shape, pitch_um)
        values += [bow_x * height[i], bow_y * height[i], height[names.index("twist")]]
        jacobian += [bow_x * slope[i], bow_y * slope[i], slope[names.index("twist")]]
        told, units = [*told, *SHAPES], [*units, "µm", "µm", "µm"]
    values.append(f_number)
    jacobian.append(np.r_[-0.5 * f_number / q, np.zeros(len(b))])
    j = np.array(jacobian)
    fit = Estimates(
        (*told, "f_number"), np.array(values), j @ covariance @ j.T, np.full(len(values), float(dof)), (*units, "1"),
        method=METHOD, confounders=("a decentred lens, which tilts its image",),
        reasons={
            "bow_x_um": "without what is curved as the square of the radius, which is the lens's",
            "tilt_x_deg": "against the image of the chart: its own tilt is in it, as the lens images it",
        } | ({} if "bend" in names else dict.fromkeys(SHAPES, "needs edges of both directions: astigmatism bends their foci apart")),
    )  # fmt: skip
    return replace(empty, z_um=np.asarray(z), u_z_um=np.asarray(u_z), fit=fit)


def _bend(frame_shape: tuple[int, int], pitch_um: tuple[float, float]) -> tuple[float, float]:
    """Bow along x and along y of a surface without a part that is curved as the square of the radius, of unit size."""
    x, y = (frame_shape[1] * pitch_um[0]) ** 2, (frame_shape[0] * pitch_um[1]) ** 2
    size = float(np.hypot(x, y))
    return y / size, -x / size


def _shapes(empty: FocusOverFrame, frame_shape: tuple[int, int], pitch_um: tuple[float, float]) -> tuple[Array, list[str]]:
    """Shapes of the height at the edges' places, shape (edges, shapes), and their names."""
    rows, cols = frame_shape
    u, v = (2 * empty.places_px[:, 0] + 1) / cols - 1, (2 * empty.places_px[:, 1] + 1) / rows - 1
    upright = np.array([axis == "x" for axis in empty.across])
    both = bool(upright.any() and not upright.all())
    bow_x, bow_y = _bend(frame_shape, pitch_um)
    p2 = 1.5 * u**2 - 0.5, 1.5 * v**2 - 0.5
    round_ = (u * cols * pitch_um[0]) ** 2 + (v * rows * pitch_um[1]) ** 2
    round_ = round_ / max(float(round_.max()), 1e-12)
    columns = {"plane_x": u, "plane_y": v}
    for axis, mine in (("x", upright), ("y", ~upright)):
        if mine.any():
            columns |= {f"focus_{axis}": mine.astype(float), f"round_{axis}": mine * round_}
    if both:
        sign = np.where(upright, 1.0, -1.0)
        bent = bow_x * p2[0] + bow_y * p2[1]
        columns |= {"bend": bent, "twist": u * v, "astigmatic_bend": sign * bent, "astigmatic_twist": sign * u * v}
    return np.stack(list(columns.values()), axis=1), list(columns)
