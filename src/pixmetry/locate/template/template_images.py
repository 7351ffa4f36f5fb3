"""Noise-free images of one target at a lattice of places within the pixel, with their derivatives by every parameter."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from pixmetry.core.arguments import choice, number, whole_number
from pixmetry.core.errors import InputError
from pixmetry.locate.lines import lines
from pixmetry.locate.template import template
from pixmetry.locate.template.template import PARAMETERS, PLANES, model

AXES = ("semi_major_px", "semi_minor_px", "angle_deg")
KINDS = (*template.KINDS, "line", "edge")
LINE = ("offset_px", "angle_deg", "blur_px", "width_px", "amplitude_dn", "background_dn")
LINE_PLANES = ("across_dn_per_px", "along_dn_per_px", "taper_per_px")
CALLED = {"blur_px": "sigma_px"}  # by the model of lines
LARGEST_WINDOW_PX = 401
REACH = 4.0  # standard deviations of the edge, the pixel included, that belong to the target; and two pixels more


@dataclass(frozen=True)
class Images:
    """One target, seen at p phases; the n pixels of the window in one axis.

    Parameters
    ----------
    kind : str
    place : tuple of str
        The parameters that say where it is: x_px and y_px, or the offset of a line.
    parameters : dict
        All parameters in the order of the derivatives; those of the place are 0.
    phases_px : ndarray, shape (p, 2)
        Place within the pixel.
    mean : ndarray, shape (p, n)
        Grey values, not cut off at the ends of the scale.
    jacobian : ndarray, shape (p, k, n)
    lever : ndarray, shape (p, place, n)
        Pixel less target, along each coordinate of the place.
    distance : ndarray, shape (p, n)
        From the centre, or from the line.
    window_px : int
        Side of the square window; for a line its width.
    aperture_px : float
    """

    kind: str
    place: tuple[str, ...]
    parameters: dict[str, float]
    phases_px: np.ndarray
    mean: np.ndarray
    jacobian: np.ndarray
    lever: np.ndarray
    distance: np.ndarray
    window_px: int
    aperture_px: float

    @property
    def names(self) -> tuple[str, ...]:
        """Of the parameters."""
        return tuple(self.parameters)

    def subset(self, unknowns: str | tuple[str, ...] | list[str]) -> tuple[str, ...]:
        """The unknowns as names, in order: from names, or one of position, light, shape, planes.

        Raises
        ------
        InputError
            If there is no such parameter, or the place is not among them.
        """
        sets = {
            "position": self.place,
            "light": (*self.place, "amplitude_dn", "background_dn"),
            "shape": tuple(n for n in self.names if n not in (*PLANES, *LINE_PLANES)),
            "planes": self.names,
        }
        if not isinstance(unknowns, str) and not (isinstance(unknowns, tuple | list) and all(isinstance(n, str) for n in unknowns)):
            allowed = "position, light, shape, planes, or names of parameters"
            raise InputError("no unknowns", where="unknowns", value=unknowns, allowed=allowed)
        if isinstance(unknowns, str):
            unknowns = sets.get(unknowns.strip()) or tuple(part.strip() for part in unknowns.split(",") if part.strip())
        unknown = [n for n in unknowns if n not in self.names]
        if unknown:
            allowed = f"position, light, shape, planes, or some of {', '.join(self.names)}"
            raise InputError(f"a {self.kind} has no such parameter", where="unknowns", value=", ".join(unknown), allowed=allowed)
        if not set(self.place) & set(unknowns):
            raise InputError("the position is not among the unknowns", where="unknowns", allowed=f"{' and '.join(self.place)} among them")
        return tuple(n for n in self.names if n in unknowns)

    def columns(self, unknowns: tuple[str, ...]) -> np.ndarray:
        """Derivatives by these parameters, shape (p, k, n)."""
        return self.jacobian[:, [self.names.index(n) for n in unknowns]]


def draw_images(
    kind: str,
    parameters: Mapping[str, float],
    *,
    aperture_px: float = 1.0,
    light_on: str = "surface",
    window_px: int | None = None,
    phases: int = 5,
) -> Images:
    """See a target at ``phases`` × ``phases`` places within the pixel.

    Parameters
    ----------
    kind : {"disc", "ellipse", "ring", "spot", "line", "edge"}
    parameters : mapping of str to float
        By the names of `pixmetry.locate.template.template.PARAMETERS`; no place is needed. An ellipse may be given by semi_major_px,
        semi_minor_px and angle_deg. A line or edge has blur_px, amplitude_dn, background_dn, length_px and angle_deg (90: along y), a line
        that is a bar also width_px.
    aperture_px, light_on
        As for `pixmetry.locate.template.template.model`.
    window_px : int, optional
        Side of the window, odd; for a line its width. By default the target with four standard deviations of its edge and two pixels
        around it.
    phases : int

    Raises
    ------
    InputError
        If a value cannot be used.
    """
    choice(kind, KINDS, "kind", "no such kind of target")
    choice(light_on, ("surface", "image"), "light_on", "light cannot act there")
    aperture_px = number(aperture_px, "aperture_px", "the pixel's aperture cannot be used", least=0, most=1, allowed="0 to 1")
    phases = whole_number(phases, "phases", "the number of phases cannot be used", least=1, most=50, allowed="1 to 50")
    parameters = _numbers(parameters)
    lattice = (np.arange(phases) + 0.5) / phases - 0.5
    places = np.stack([v.ravel() for v in np.meshgrid(lattice, lattice)], axis=1)
    if kind in ("line", "edge"):
        return _line_images(kind, parameters, aperture_px, window_px, places)
    values = _checked(kind, _outline_of(parameters) if kind == "ellipse" else parameters, PARAMETERS[kind], PLANES)
    outer = values.get("radius_px", max(values.get("shape_xx_px", 0.0), values.get("shape_yy_px", 0.0)))
    side = _side(outer, values["blur_px"], aperture_px, window_px)
    rest = list(values.values())[2:]
    drawn = [model(kind, np.array([*(side // 2 + p), *rest]), side, side, aperture_px=aperture_px, light_on=light_on) for p in places]
    mean = np.stack([m.ravel() for m, _ in drawn])
    jacobian = np.stack([j.reshape(len(j), -1) for _, j in drawn])
    pixel = np.arange(side) - side // 2
    dx, dy = (v.ravel() for v in np.meshgrid(pixel, pixel))
    lever = np.stack([dx, dy]) - places[:, :, None]
    distance = np.hypot(lever[:, 0], lever[:, 1])
    return Images(kind, ("x_px", "y_px"), values, places, mean, jacobian, lever, distance, side, aperture_px)


def axes_of(parameters: Mapping[str, float]) -> tuple[float, float, float]:
    """Half axes and angle in degrees of an ellipse with the outline c + S (cos t, sin t)."""
    values, vectors = np.linalg.eigh(
        [[parameters["shape_xx_px"], parameters["shape_xy_px"]], [parameters["shape_xy_px"], parameters["shape_yy_px"]]]
    )
    return float(values[1]), float(values[0]), float(np.rad2deg(np.arctan2(vectors[1, 1], vectors[0, 1])))


def line_length_px(images: Images) -> float:
    """Length over which a line is seen: pixels over the window's width."""
    return float(images.mean.shape[1] / images.window_px)


def _line_images(kind: str, parameters: Mapping[str, float], aperture: float, window: int | None, places: np.ndarray) -> Images:
    given = {"length_px": 40.0, "angle_deg": 90.0, **parameters}
    length = float(given.pop("length_px"))
    if not 2 <= length <= 10_000:
        raise InputError("the length cannot be used", where="length_px", value=length, allowed="2 to 10000 px")
    bar = kind == "line" and "width_px" in given
    names = tuple(n for n in LINE if n != "width_px" or bar)
    values = _checked(kind, given, names, LINE_PLANES)
    width = _side(0.5 * values.get("width_px", 0.0), values["blur_px"], aperture, window)
    angle = np.deg2rad(values["angle_deg"])
    c, s = np.cos(angle), np.sin(angle)
    reach = int(np.ceil(0.5 * (length + width))) + 1
    pixel = np.arange(-reach, reach + 1)
    col, row = (v.ravel() for v in np.meshgrid(pixel, pixel))
    along, across = c * col + s * row, -s * col + c * row
    inside = (np.abs(across) < 0.5 * width) & (along >= -0.5 * length) & (along < 0.5 * length)
    col, row, across = col[inside], row[inside], across[inside]
    section = "edge" if kind == "edge" else "bar" if bar else "gaussian"
    told = {CALLED.get(n, n): v for n, v in values.items()}
    picked = [lines.PARAMETERS.index(CALLED.get(n, n)) for n in values]
    drawn = [lines.line_model(section, told, row[:, None], col[:, None], about=tuple(p), aperture_px=aperture) for p in places]
    mean = np.stack([m.ravel() for m, _ in drawn])
    jacobian = np.stack([j.reshape(len(j), -1)[picked] for _, j in drawn])
    shift = places @ np.array([-s, c])
    lever = (across - shift[:, None])[:, None]
    return Images(kind, ("offset_px",), values, places, mean, jacobian, lever, np.abs(lever[:, 0]), width, aperture)


def _side(outer: float, blur: float, aperture: float, window: int | None) -> int:
    reach = outer + REACH * np.hypot(blur, aperture / np.sqrt(12)) + 2
    if window is not None:
        allowed = f"an odd number of pixels from 3 to {LARGEST_WINDOW_PX}"
        window = whole_number(window, "window_px", "the window cannot be used", least=3, most=LARGEST_WINDOW_PX, allowed=allowed)
    elif not reach < LARGEST_WINDOW_PX:
        raise InputError("the target is too large", where="parameters", value=float(outer), allowed=f"windows to {LARGEST_WINDOW_PX} px")
    side = 2 * int(np.ceil(reach)) + 1 if window is None else window
    if side % 2 == 0 or not 3 <= side <= LARGEST_WINDOW_PX:
        what = "the window cannot be used" if window is not None else "the target is too large"
        raise InputError(what, where="window_px", value=side, allowed=f"an odd number of pixels from 3 to {LARGEST_WINDOW_PX}")
    return side


def _numbers(parameters: Mapping[str, float]) -> dict[str, float]:
    """The parameters of a target as numbers by name."""
    if not isinstance(parameters, Mapping) or not all(isinstance(name, str) for name in parameters):
        allowed = 'names and numbers, such as {"radius_px": 3.5, "blur_px": 0.7, "amplitude_dn": 150.0}'
        raise InputError("no parameters of a target", where="parameters", value=parameters, allowed=allowed)
    return {n: number(v, "parameters", f"{n} cannot be used", allowed="a finite number") for n, v in parameters.items()}


def _checked(kind: str, parameters: Mapping[str, float], own: tuple[str, ...], planes: tuple[str, ...]) -> dict[str, float]:
    """All parameters in order: those that are given, and 0 for place, planes and background."""
    names = (*own, *planes)
    unknown = [n for n in parameters if n not in names]
    if unknown:
        raise InputError(f"a {kind} has no such parameter", where="parameters", value=", ".join(unknown), allowed=", ".join(names))
    free = dict.fromkeys(("x_px", "y_px", "offset_px", "background_dn", *planes), 0.0)
    missing = [n for n in names if n not in parameters and n not in free]
    if missing:
        raise InputError(f"a {kind} needs more parameters", where="parameters", remedy=f"give {', '.join(missing)}")
    values = {n: float(parameters.get(n, free.get(n, 0.0))) for n in names}
    for name, value in values.items():
        length = name in ("blur_px", "radius_px", "inner_radius_px", "width_px", "shape_xx_px", "shape_yy_px")
        if not np.isfinite(value) or (length and value <= 0) or (name == "amplitude_dn" and value == 0):
            allowed = "above 0" if length else "not 0" if name == "amplitude_dn" else "a finite number"
            raise InputError(f"{name} cannot be used", where="parameters", value=value, allowed=allowed)
    return values | dict.fromkeys([n for n in ("x_px", "y_px", "offset_px") if n in values], 0.0)


def _outline_of(parameters: Mapping[str, float]) -> Mapping[str, float]:
    """Half axes and angle as the symmetric matrix of the outline."""
    if not set(AXES) & set(parameters):
        return parameters
    rest = {n: v for n, v in parameters.items() if n not in AXES}
    major, minor = (float(parameters.get(n, np.nan)) for n in AXES[:2])
    angle = np.deg2rad(float(parameters.get("angle_deg", 0.0)))
    if not (np.isfinite(angle) and 0 < minor <= major < np.inf):
        allowed = "0 < semi_minor_px <= semi_major_px"
        raise InputError("an ellipse cannot be drawn", where="parameters", value=(major, minor), allowed=allowed)
    c, s = np.cos(angle), np.sin(angle)
    across = {"shape_xx_px": major * c**2 + minor * s**2, "shape_yy_px": major * s**2 + minor * c**2}
    return rest | across | {"shape_xy_px": (major - minor) * c * s}
