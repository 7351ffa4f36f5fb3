"""What a calibration returns: the adjustment that stands, what must be known about it, and the records of its tests.

A record is written to JSON field by field (`record_of`), and read back by the types of its fields (`read_record`): a part that was not
made is left out, so is what belongs to the search alone.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import MISSING, dataclass, field, fields, is_dataclass
from html import escape
from types import NoneType, UnionType
from typing import Any, Literal, TypeVar, get_args, get_origin, get_type_hints

import numpy as np

from pixmetry.calibrate.bundle.network import Adjustment, Network
from pixmetry.calibrate.tables import TABLES
from pixmetry.core.data_frame import data_frame
from pixmetry.core.errors import InputError
from pixmetry.core.finding import Finding

Axis = Literal["x", "y"]
R = TypeVar("R")


def _if_made() -> Any:
    """A field that is left out of the JSON where it is None."""
    return field(default=None, metadata={"if_made": True})


def _joined(axis: str = "") -> Any:
    """A record whose fields stand among those of its owner, with the axis in their names: ``sigma_px`` as ``sigma_x_px``."""
    return field(default=None, metadata={"joined": True, "axis": axis})


def record_of(value: Any) -> dict[str, Any]:
    """A record as a mapping of its fields, and those that it holds likewise; arrays and numbers are left as they are.

    Examples
    --------
    >>> record_of(Strongest("p1", -0.8))
    {'with': 'p1', 'r': -0.8}
    >>> record_of(HoldOut(None, None, 5, None, "not made"))  # what noise alone would show was not asked for
    {'fixed': None, 'free': None, 'folds': 5, 'p': None, 'text': 'not made'}
    """
    record: dict[str, Any] = {}
    for one in fields(value):
        own, rule = getattr(value, one.name), one.metadata
        if rule.get("joined"):
            record |= {} if own is None else {_along(key, rule["axis"]): part for key, part in record_of(own).items()}
        elif not rule.get("internal") and not (rule.get("if_made") and own is None):
            record[one.name.rstrip("_")] = _mapped(own)
    return record


def _mapped(value: Any) -> Any:
    if is_dataclass(value):
        return record_of(value)
    if isinstance(value, Mapping):
        return {key: _mapped(part) for key, part in value.items()}
    return [_mapped(part) for part in value] if isinstance(value, tuple) else value


def _along(key: str, axis: str) -> str:
    if not axis:
        return key
    return f"{key.removesuffix('_px')}_{axis}_px" if key.endswith("_px") else f"{key}_{axis}"


def read_record(kind: type[R], record: Mapping[str, Any]) -> R:
    """A record out of what `record_of` made of it, as JSON holds that; what is missing in an old file is None.

    Examples
    --------
    >>> read_record(ParameterTest, {"name": "k1", "value": 0.1, "u": None, "strongest": {"with": "k2", "r": -0.9}})
    ParameterTest(camera=None, name='k1', value=0.1, u=nan, unit=None, p_zero=None, strongest=Strongest(with_='k2', r=-0.9), fixed=False)
    """
    made: R = _read_fields(kind, lambda key: record.get(key, MISSING))
    return made


def _read_fields(kind: Any, of: Callable[[str], Any]) -> Any:
    hints, found = get_type_hints(kind), {}
    for one in fields(kind):
        if one.metadata.get("joined"):
            inner = next(part for part in (get_args(hints[one.name]) or (hints[one.name],)) if part is not NoneType)
            axis = one.metadata["axis"]
            joined = _read_fields(inner, lambda key, axis=axis: of(_along(key, axis)))  # type: ignore[misc]
            there = any(of(_along(part.name.rstrip("_"), axis)) is not MISSING for part in fields(inner))
            found[one.name] = joined if there else None
        elif (value := of(one.name.rstrip("_"))) is not MISSING:
            found[one.name] = _read(hints[one.name], value)
        elif one.default is MISSING and one.default_factory is MISSING:
            found[one.name] = _read(hints[one.name], None)
    return kind(**found)


def _read(kind: Any, value: Any) -> Any:
    """A value of one type; of numbers, None is NaN."""
    origin, inner = get_origin(kind), get_args(kind)
    if origin is UnionType:
        return None if value is None else _read(next(part for part in inner if part is not NoneType), value)
    if value is None:
        return float("nan") if kind is float else None
    if kind is float:
        return float(value)  # also of "inf"
    if is_dataclass(kind):
        return _read_fields(kind, lambda key: value.get(key, MISSING))
    if kind is np.ndarray:
        return np.array(value, float)
    if origin is tuple:
        return tuple(_read(inner[0], part) for part in value)
    return {key: _read(inner[1], part) for key, part in value.items()} if origin is Mapping else value


@dataclass(frozen=True)
class Strongest:
    """The parameter that another one is most correlated with.

    Parameters
    ----------
    with_ : str
    r : float
    """

    with_: str
    r: float


@dataclass(frozen=True)
class ParameterTest:
    """An estimated interior parameter.

    Parameters
    ----------
    camera, name : str
    value, u : float
    unit : str
    p_zero : float or None
        Of the two-sided t-test against 0; None for c, xp and yp.
    strongest : Strongest or None
        Interior parameter of the same camera with the largest correlation; None if alone.
    fixed : bool
        Whether it was held; records of tests are of estimated ones only.
    """

    camera: str
    name: str
    value: float
    u: float
    unit: str
    p_zero: float | None = None
    strongest: Strongest | None = None
    fixed: bool = field(default=False, metadata={"internal": True})


@dataclass(frozen=True)
class GroupTest:
    """Joint F-test against 0 of parameters that can stand for each other, as the radial ones can.

    Parameters
    ----------
    camera, group : str
    names : tuple of str
    f : float
    dof : (int, int)
        Of numerator and denominator.
    p : float
    """

    camera: str
    group: str
    names: tuple[str, ...]
    f: float
    dof: tuple[int, int]
    p: float


@dataclass(frozen=True)
class Vision:
    """A camera in the words of computer vision, in px, with standard uncertainties."""

    fx: float
    fy: float
    skew: float
    cx: float
    cy: float
    u_fx: float
    u_fy: float
    u_skew: float
    u_cx: float
    u_cy: float

    @property
    def rows(self) -> tuple[tuple[str, float, float], ...]:
        """Name, value and uncertainty of each."""
        values, u = (self.fx, self.fy, self.skew, self.cx, self.cy), (self.u_fx, self.u_fy, self.u_skew, self.u_cx, self.u_cy)
        return tuple(zip(("fx", "fy", "skew", "cx", "cy"), values, u, strict=True))


@dataclass(frozen=True)
class Correlations:
    """Correlations of the interior parameters of a camera.

    Parameters
    ----------
    names : tuple of str
    matrix : ndarray, shape (names, names)
    """

    names: tuple[str, ...]
    matrix: np.ndarray


@dataclass(frozen=True)
class PoseCorrelation:
    """Correlation ``r`` of an interior parameter ``a`` (``"camera:c"``) with one of a pose ``b`` (``"image:Z0"``)."""

    a: str
    b: str
    r: float


@dataclass(frozen=True)
class AxisResidual:
    """Residuals of x or of y; ``rms_um`` is None without a pitch, ``dof`` is None where there are no redundancy numbers."""

    rms_px: float
    rms_um: float | None
    dof: float | None


@dataclass(frozen=True)
class CameraResiduals:
    """Residuals of the image coordinates of a camera.

    Parameters
    ----------
    n : int
        Image points.
    rms_x_px, rms_y_px : float
    rms_x_um, rms_y_um : float or None
        None without a pitch.
    dof_x, dof_y : float or None
        Degrees of freedom: sums of redundancy numbers, what the adjustment has left of n.
    noise_x_px, noise_y_px : float or None
        rms that the given covariances alone would leave, √(Σ r s² / n); None where they were a guess.
    systematic_x_px, systematic_y_px : float or None
        What is left over besides (`pixmetry.calibrate.checks.residual_grid.systematic_rest`).
    typical_x_px, typical_y_px : float or None
        rms of the residuals over their uncertainties, times the median of these: the rms where all are alike, and not that of a few image
        points that are known to be poor.
    """

    n: int
    rms_x_px: float
    rms_y_px: float
    rms_x_um: float | None
    rms_y_um: float | None
    dof_x: float | None
    dof_y: float | None
    noise_x_px: float | None = None
    noise_y_px: float | None = None
    systematic_x_px: float | None = None
    systematic_y_px: float | None = None
    typical_x_px: float | None = None
    typical_y_px: float | None = None

    @property
    def typical(self) -> dict[Axis, AxisResidual]:
        """What a typical image point leaves, axis by axis; the rms where the record is without it."""
        return {axis: self._typical(one, getattr(self, f"typical_{axis}_px")) for axis, one in self.axes.items()}

    @staticmethod
    def _typical(one: AxisResidual, px: float | None) -> AxisResidual:
        if px is None or not one.rms_px > 0:
            return one
        return AxisResidual(px, None if one.rms_um is None else one.rms_um * px / one.rms_px, one.dof)

    @property
    def axes(self) -> dict[Axis, AxisResidual]:
        """The same, axis by axis."""
        return {
            "x": AxisResidual(self.rms_x_px, self.rms_x_um, self.dof_x),
            "y": AxisResidual(self.rms_y_px, self.rms_y_um, self.dof_y),
        }


@dataclass(frozen=True)
class SharedByCamera:
    """Errors that the image points of a camera have in common, and the uncertainties of its parameters with and without them.

    Parameters
    ----------
    kinds : tuple of str
        Out of ``"image"`` (in one image), ``"frame"`` (at one place of the frame, in all images), ``"view"`` (in images from similar
        directions), ``"oblique"`` (of targets seen obliquely).
    rms_px, p : ndarray, shape (kinds,)
        Of a coordinate; of an F-test against independent errors.
    independent_px : float
        rms of what is independent from point to point.
    found : bool
        Whether any is significant, and the uncertainties hold all of them.
    names : tuple of str
        Of the estimated parameters.
    u, u_independent, dof : ndarray, shape (names,)
        As stated; as if all errors were independent; effective degrees of freedom of the former.
    """

    kinds: tuple[str, ...]
    rms_px: np.ndarray
    p: np.ndarray
    independent_px: float
    found: bool
    names: tuple[str, ...]
    u: np.ndarray
    u_independent: np.ndarray
    dof: np.ndarray

    @property
    def widened(self) -> np.ndarray:
        """Stated uncertainties over those of independent errors."""
        return np.divide(self.u, self.u_independent, out=np.ones(len(self.u)), where=self.u_independent > 0)


@dataclass(frozen=True)
class Halves:
    """A camera calibrated from two halves of the images.

    Parameters
    ----------
    by : str
        How they were divided, in words.
    images : tuple of int
        In each half.
    names : tuple of str
    difference, u : ndarray, shape (names,)
        First half less the second; u holds what the halves do not share, with the variances that all images tell.
    f, dof : float
        Squared difference by its joint covariance, over the number of parameters; degrees of freedom of that covariance.
    p : float
        How often chance alone makes such a difference.
    """

    by: str
    images: tuple[int, ...]
    names: tuple[str, ...]
    difference: np.ndarray
    u: np.ndarray
    f: float
    dof: float
    p: float

    @property
    def ratio(self) -> np.ndarray:
        """Differences over their uncertainties."""
        return np.divide(self.difference, self.u, out=np.zeros(len(self.u)), where=self.u > 0)

    @property
    def largest(self) -> tuple[str, float]:
        """The parameter that differs most, and by how many u."""
        k = int(np.argmax(np.abs(self.ratio)))
        return self.names[k], float(abs(self.ratio[k]))


@dataclass(frozen=True)
class Jackknife:
    """Parameters of a camera with each part of the images left out in turn.

    Parameters
    ----------
    folds : int
        Number of parts; one less are the degrees of freedom of
    u : ndarray, shape (names,)
        Standard uncertainties by the jackknife, which takes images as independent and nothing else: it is not told what all have in common.
    names : tuple of str
    stated : ndarray, shape (names,)
        Standard uncertainties as stated.
    """

    folds: int
    names: tuple[str, ...]
    u: np.ndarray
    stated: np.ndarray

    @property
    def ratio(self) -> float:
        """rms over the parameters of the one over the other."""
        some = self.stated > 0
        return float(np.sqrt(np.mean((self.u[some] / self.stated[some]) ** 2))) if some.any() else 0.0


@dataclass(frozen=True)
class FTest:
    """One-sided F-test whether x is noisier than y.

    Parameters
    ----------
    ratio_px2, p_px : float
        Of the variances in px².
    ratio_um2, p_um : float or None
        In µm²; None without a pitch.
    dof_x, dof_y : float
    critical_95 : float
        Ratio that chance exceeds in 5 %.
    side, text : str
    """

    ratio_px2: float
    p_px: float
    ratio_um2: float | None
    p_um: float | None
    dof_x: float
    dof_y: float
    critical_95: float
    side: str
    text: str


@dataclass(frozen=True)
class GrossError:
    """An image point that was left out.

    Parameters
    ----------
    image, point : str
    residual_x_px, residual_y_px, error_x_px, error_y_px : float
        Residual and estimated error.
    statistic, critical : float
    swapped_with : str or None
        Point of the same image that it seems to have exchanged its name with.
    """

    image: str
    point: str
    residual_x_px: float
    residual_y_px: float
    error_x_px: float
    error_y_px: float
    statistic: float
    critical: float
    swapped_with: str | None = None


@dataclass(frozen=True)
class ImageRecord:
    """One image.

    Parameters
    ----------
    image, camera : str
    oriented : bool
    n, rejected, measured : int
        Image points used, rejected (0 of an image that is not oriented: it took no part), and all.
    rms_x_px, rms_y_px : float or None
        Of the residuals; None without points.
    time_s : float or None
    x_scale, u_x_scale, x_shift_px, u_x_shift_px : float or None
        The image's own, where they were estimated.
    """

    image: str
    camera: str
    oriented: bool
    n: int
    rejected: int
    measured: int
    rms_x_px: float | None
    rms_y_px: float | None
    time_s: float | None
    x_scale: float | None = None
    u_x_scale: float | None = None
    x_shift_px: float | None = None
    u_x_shift_px: float | None = None


@dataclass(frozen=True)
class DistortionCurves:
    """Distortion against the radius, in the unit of the image plane and in px along x, shape (radii,); None where it was not made.

    Parameters
    ----------
    unit : str
    radius, radius_px : ndarray
    radial, u_radial, radial_px, u_radial_px : ndarray
    balanced, u_balanced, balanced_px, u_balanced_px : ndarray
        The same lens with the principal distance ``balanced_c``.
    tangential, u_tangential, tangential_px, u_tangential_px : ndarray
        √(p1² + p2²) r².
    balanced_c, u_balanced_c : float
    """

    unit: str
    radius: np.ndarray
    radius_px: np.ndarray | None = _if_made()
    radial: np.ndarray | None = _if_made()
    u_radial: np.ndarray | None = _if_made()
    radial_px: np.ndarray | None = _if_made()
    u_radial_px: np.ndarray | None = _if_made()
    balanced: np.ndarray | None = _if_made()
    u_balanced: np.ndarray | None = _if_made()
    balanced_px: np.ndarray | None = _if_made()
    u_balanced_px: np.ndarray | None = _if_made()
    tangential: np.ndarray | None = _if_made()
    u_tangential: np.ndarray | None = _if_made()
    tangential_px: np.ndarray | None = _if_made()
    u_tangential_px: np.ndarray | None = _if_made()
    balanced_c: float | None = _if_made()
    u_balanced_c: float | None = _if_made()

    @property
    def radial_curve(self) -> Curve | None:
        """The radial curve in one piece."""
        return None if self.radial is None else Curve(self.radial, self.u_radial, self.radial_px, self.u_radial_px)

    @property
    def balanced_curve(self) -> Curve | None:
        """The balanced curve in one piece."""
        return None if self.balanced is None else Curve(self.balanced, self.u_balanced, self.balanced_px, self.u_balanced_px)

    @property
    def tangential_curve(self) -> Curve | None:
        """The tangential curve in one piece."""
        return None if self.tangential is None else Curve(self.tangential, self.u_tangential, self.tangential_px, self.u_tangential_px)


@dataclass(frozen=True)
class Curve:
    """Values and standard uncertainties, shape (radii,), in the unit of the image plane and in px; None: not made."""

    value: np.ndarray
    u: np.ndarray | None
    value_px: np.ndarray | None
    u_px: np.ndarray | None


@dataclass(frozen=True)
class ProjectionMap:
    """Standard uncertainty of an image coordinate with which the calibration tells where a direction is imaged.

    Parameters
    ----------
    x_px : ndarray, shape (cols,)
    y_px : ndarray, shape (rows,)
    u_px, u_raw_px : ndarray, shape (rows, cols)
        Without and with what a rotation of the camera would take up; NaN where the distortion has no inverse.
    """

    x_px: np.ndarray
    y_px: np.ndarray
    u_px: np.ndarray
    u_raw_px: np.ndarray


@dataclass(frozen=True)
class AxisComponent:
    """Standard deviation of x or of y by variance components.

    Parameters
    ----------
    sigma_px, u_sigma_px : float
        Of a typical image point: the median.
    given_px : float
        As given before.
    beyond_px, u_beyond_px : float or None
        Added to what was given; None where a factor was estimated instead.
    factor, dof : float
    estimated : bool
        False: too little redundancy, the size is that of all image points together.
    """

    sigma_px: float
    u_sigma_px: float
    given_px: float
    beyond_px: float | None
    u_beyond_px: float | None
    factor: float
    dof: float
    estimated: bool


@dataclass(frozen=True)
class CameraComponents:
    """Variance components of a camera.

    Parameters
    ----------
    iterations : int
    common : bool
        Whether x and y have one size,
    by_axis : bool
        though two were asked for.
    x, y : AxisComponent
    """

    iterations: int
    common: bool
    by_axis: bool
    x: AxisComponent = _joined("x")
    y: AxisComponent = _joined("y")

    @property
    def axes(self) -> dict[Axis, AxisComponent]:
        """Both by name."""
        return {"x": self.x, "y": self.y}


@dataclass(frozen=True)
class HeldRms:
    """rms of residuals of a coordinate in the fit and in images left out of it, and the median size of the latter."""

    fit_rms_px: float
    left_out_rms_px: float
    left_out_median_px: float


@dataclass(frozen=True)
class HoldOut:
    """Images left out of the fit.

    Parameters
    ----------
    fixed, free : HeldRms or None
        With the points as given, and with them free.
    folds : int
    p : float or None
        How often chance alone lets the left-out rms fall so much from one to the other; None without both.
    text : str
    expected_median_px : float or None
        What noise alone would show, where images left out fit much worse.
    """

    fixed: HeldRms | None
    free: HeldRms | None
    folds: int
    p: float | None
    text: str
    expected_median_px: float | None = _if_made()

    @property
    def parts(self) -> dict[str, HeldRms]:
        """Those of ``fixed`` and ``free`` that were made."""
        return {name: part for name, part in (("fixed", self.fixed), ("free", self.free)) if part is not None}


@dataclass(frozen=True)
class Moved:
    """How far freeing the points of a field moved principal point and distance (free less fixed), with the formal uncertainties of the
    fixed solution (None: not estimated)."""

    moved_c_px: float
    u_c_px: float | None
    moved_xp_px: float
    u_xp_px: float | None
    moved_yp_px: float
    u_yp_px: float | None

    @property
    def by_name(self) -> dict[str, tuple[float, float | None]]:
        """Move and formal u of each parameter."""
        return {"xp": (self.moved_xp_px, self.u_xp_px), "yp": (self.moved_yp_px, self.u_yp_px), "c": (self.moved_c_px, self.u_c_px)}


@dataclass(frozen=True)
class FieldPoints:
    """Points of a field after the best similarity.

    Parameters
    ----------
    names : tuple of str
    xyz : ndarray, shape (points, 3)
        Nominal; NaN: not given.
    axes : ndarray, shape (3, 3)
        Rows: directions of dx, dy, dz; of a plane, z is its normal.
    dx, u_dx, dy, u_dy, dz, u_dz : ndarray, shape (points,)
        Deviations.
    """

    names: tuple[str, ...]
    xyz: np.ndarray
    axes: np.ndarray
    dx: np.ndarray
    u_dx: np.ndarray
    dy: np.ndarray
    u_dy: np.ndarray
    dz: np.ndarray
    u_dz: np.ndarray


@dataclass(frozen=True)
class FieldDeviations:
    """How far the points of a field lie from their nominal places.

    Parameters
    ----------
    shape : {"plane", "volume"}
    unit : str
    p_flat : float or None
        Of a plane: how often chance makes such deviations from the best plane.
    rms_in_plane, peak_in_plane : float or None
    rms, peak : float
        Of the deviations from the best plane; of a volume from the nominal coordinates, in 3-D.
    u : float
        rms uncertainty of these deviations.
    points : FieldPoints
    """

    shape: str
    unit: str
    p_flat: float | None
    rms_in_plane: float | None
    peak_in_plane: float | None
    rms: float
    peak: float
    u: float
    points: FieldPoints


@dataclass(frozen=True)
class FieldComparison:
    """A field with its points fixed and free.

    Parameters
    ----------
    f, dof, p
        F-test of the given coordinates.
    deviations : FieldDeviations
    first : Moved
        Of the first camera.
    cameras : dict
        `Moved` of each.
    """

    f: float
    dof: tuple[int, int]
    p: float
    deviations: FieldDeviations = _joined()
    first: Moved = _joined()
    cameras: Mapping[str, Moved] = field(default_factory=dict)


@dataclass(frozen=True)
class FieldTest:
    """Whether a test field is what it is said to be.

    Parameters
    ----------
    verdict : {"fixed", "free"}
    compared : FieldComparison or None
        None where free points could not be tried or judged.
    text : str
    """

    verdict: str
    compared: FieldComparison | None = _joined()
    text: str = ""


@dataclass(frozen=True)
class ByImage:
    """A value for each image, of sum 0, with its uncertainty; ``alone``: the one image that differs from all others, if it is one."""

    images: tuple[str, ...]
    values: np.ndarray
    u: np.ndarray
    alone: str | None


@dataclass(frozen=True)
class Outstanding:
    """Images that stand out by their residuals.

    Parameters
    ----------
    images_out : tuple of str
    rms_px : list of (float, float)
        In x and y.
    rejected : list of int
        Number of their image points that were rejected.
    times_median : list of float
        How their weighted residuals compare with the median of the images, rejected ones counted.
    """

    images_out: tuple[str, ...]
    rms_px: list[list[float]]
    rejected: list[int]
    times_median: list[float]


@dataclass(frozen=True)
class Pattern:
    """A pattern that was looked for in the residuals.

    Parameters
    ----------
    name, camera : str
    amplitude_px : float
    u_px : float or None
        None where the amplitude is an rms over several terms.
    p : float
    period_px : float or None
        Of waves.
    by_image : ByImage or None
    outstanding : Outstanding or None
    level : float
        At which the pattern is held significant.
    significant : bool
    source : str
        Of the catalogue of error sources; empty: none.
    text, advice : str
    causes : tuple of str
        What may have made it, in words; of several one.
    gain : float
        What it explains beside the patterns that were chosen before, as a difference of Schwarz's criterion (see
        `pixmetry.calibrate.checks.causes`); above 10 its cause is named alone if no other explains the same as well.
    confirmed : bool
        Whether its cause was measured, with all that residuals have in common in its uncertainty.
    behind : str
        The pattern beside which it explains least, where it explains too little beside those chosen for its number of terms; empty: none.
    left : bool
        Whether it is nevertheless significant beside those chosen: they do not explain all of it.
    p_alike : float or None
        Of a scale of x for each image: how often chance alone makes it explain so much more than a shear of each image, which no clock
        makes; None of other patterns.
    """

    name: str
    camera: str
    amplitude_px: float
    u_px: float | None
    p: float
    period_px: float | None = _if_made()
    by_image: ByImage | None = _joined()
    outstanding: Outstanding | None = _joined()
    level: float = np.nan
    significant: bool = False
    source: str = ""
    text: str = ""
    advice: str = ""
    causes: tuple[str, ...] = ()
    gain: float = 0.0
    behind: str = ""
    left: bool = False
    confirmed: bool = False
    p_alike: float | None = _if_made()

    @property
    def alone(self) -> str | None:
        """The one image that differs from all others."""
        return None if self.by_image is None else self.by_image.alone


@dataclass(frozen=True)
class HeightMap:
    """Height of a sensor's surface over its plane, as the residuals show it: without what lens and poses take up.

    Heights are in pixels along x; positive is farther from the lens. They stand for displacements along the radius from the middle of the
    frame, as rays from the principal distance make them.

    Parameters
    ----------
    across, down : tuple of int, length k
        Degrees of the Legendre polynomials along x and along y.
    coefficients_px : ndarray, shape (k,)
    covariance_px2 : ndarray, shape (k, k)
        Of the combinations that are told; 0 for the others, whose coefficients are left at 0.
    told : ndarray, shape (k, k)
        What is told of any coefficients: this matrix times these.
    rank : int
        Number of combinations that are told.
    dof : float
    gain : float
        As of `Pattern`, of the height beside all else.
    p : float
        Of an F-test of the height, and
    p_turned : float
        of displacements of the same shapes across the radius, which no height makes.
    scatter_factor : float
        Scatter of the images' contributions over what independent residuals would give; above 1, u is larger by it.
    common_px : float
        What residuals have in common in one cell of the frame; it is in u.
    effective : float
        Number of independent residuals that tell as much.
    lens_names, lens_change : tuple of str, ndarray, shape (names, k)
        By how much the camera's parameters change for a coefficient of 1 px, because they had taken up a part of the height.
    x_px, y_px, height_px, u_px : ndarray
        The map, and its standard uncertainty, shape (rows, cols).
    found : bool
        Whether it is what explains the residuals.
    rivals : tuple of str
        Patterns that explain them as well.
    """

    across: tuple[int, ...]
    down: tuple[int, ...]
    coefficients_px: np.ndarray
    covariance_px2: np.ndarray
    told: np.ndarray
    rank: int
    dof: float
    gain: float
    p: float
    p_turned: float
    scatter_factor: float
    common_px: float
    effective: float
    lens_names: tuple[str, ...]
    lens_change: np.ndarray
    x_px: np.ndarray
    y_px: np.ndarray
    height_px: np.ndarray
    u_px: np.ndarray
    found: bool = False
    rivals: tuple[str, ...] = ()


@dataclass(frozen=True)
class Seams:
    """Steps between equal fields of the frame, as of a sensor that is exposed in several steps.

    Parameters
    ----------
    fields_x, fields_y : int
        Of the partition that explains most.
    std_px, u_std_px, dof : float
        Standard deviation of a field's place along each axis.
    limit_px : float
        One-sided 95 % limit of it.
    gain : float
        As of `Pattern`.
    found : bool
        Whether it is what explains the residuals.
    steps_px, u_steps_px : ndarray, shape (fields, 2)
        Displacement of each field, row by row, without what lens and poses take up.
    """

    fields_x: int
    fields_y: int
    std_px: float
    u_std_px: float
    dof: float
    limit_px: float
    gain: float
    found: bool
    steps_px: np.ndarray
    u_steps_px: np.ndarray


@dataclass(frozen=True)
class ImageScales:
    """Scale of x of each image, less their mean, and its decay with time.

    Parameters
    ----------
    images : tuple of str
    values, u : ndarray, shape (images,)
    time_s : ndarray, shape (images,), or None
        After the first image; None where the images have no times.
    p_differ : float
        Of an F-test of different scales against one.
    p_left : float or None
        Of an F-test of what a decay leaves; None without times.
    gain : float
        Of the decay, as of `Pattern`.
    start, tau_s : float
        Scale error of the first image, and time constant of its decay.
    covariance : ndarray, shape (2, 2), or None
        Of both.
    dof : float
        Of their u: few where it is the scatter of the images about the decay.
    """

    images: tuple[str, ...]
    values: np.ndarray
    u: np.ndarray
    time_s: np.ndarray | None
    p_differ: float
    p_left: float | None
    gain: float = 0.0
    start: float = 0.0
    tau_s: float = np.nan
    covariance: np.ndarray | None = None
    dof: float = np.nan


@dataclass(frozen=True)
class FieldSources:
    """What the residuals of a camera tell of its error sources; None: nothing."""

    height: HeightMap | None = None
    seams: Seams | None = None
    scales: ImageScales | None = None

    @property
    def confirmed(self) -> tuple[str, ...]:
        """Names of the patterns whose cause was found."""
        found = {"unflatness": self.height is not None and self.height.found, "seams": self.seams is not None and self.seams.found}
        return tuple(name for name, yes in found.items() if yes)


@dataclass(frozen=True)
class ResidualGrid:
    """Correction grid for what no parameter explains; bilinear between its nodes.

    Parameters
    ----------
    x_px : ndarray, shape (cols,)
    y_px : ndarray, shape (rows,)
        Nodes.
    dx_px, dy_px : ndarray, shape (rows, cols)
        Measured less computed: subtract them from what is measured.
    u_px : ndarray, shape (rows, cols)
        Of a value.
    n : ndarray of int, shape (rows, cols)
        Image points about each node.
    rms_without_px, rms_with_px : float
        Of a coordinate, in images left out.
    p : float
        Of the fall from one to the other.
    """

    x_px: np.ndarray
    y_px: np.ndarray
    dx_px: np.ndarray
    dy_px: np.ndarray
    u_px: np.ndarray
    n: np.ndarray
    rms_without_px: float
    rms_with_px: float
    p: float


@dataclass(frozen=True)
class Sizes:
    """What took part, and what was given.

    Parameters
    ----------
    images : int
        Oriented.
    points : int
        Determined, with image points used.
    observations : int
        Image points used.
    images_given, points_given, observations_given : int
        All that was measured.
    """

    images: int
    points: int
    observations: int
    images_given: int
    points_given: int
    observations_given: int

    @property
    def pairs(self) -> tuple[tuple[int, int], ...]:
        """What took part with what was given: of images, points and image points."""
        given = (self.images_given, self.points_given, self.observations_given)
        return tuple(zip((self.images, self.points, self.observations), given, strict=True))


@dataclass(frozen=True)
class BarRecord:
    """A scale bar: known length, u as it was stated, known less computed, redundancy number."""

    name: str
    length: float
    u: float
    residual: float
    redundancy: float


@dataclass(frozen=True)
class NetworkRecord:
    """What the network is made of.

    Parameters
    ----------
    sizes : Sizes
    redundancy : int
    sigma0 : float
    rays_per_point : float
        Mean; with
    rays_least, rays_most : int
    datum, unit : str
    scale_bars : tuple of BarRecord
    """

    sizes: Sizes = _joined()
    redundancy: int = 0
    sigma0: float = np.nan
    rays_per_point: float = np.nan
    rays_least: int = 0
    rays_most: int = 0
    datum: str = ""
    unit: str = ""
    scale_bars: tuple[BarRecord, ...] = ()


@dataclass(frozen=True)
class Ratio:
    """A known value's residual over its stated uncertainty."""

    name: str
    ratio: float


@dataclass(frozen=True)
class KnownGroup:
    """Variance factor of bars or control points (squared errors over squared stated uncertainties).

    Parameters
    ----------
    factor, dof : float
    p : float
        How surely it is not 1: two-sided F-test against the image coordinates.
    n : int
    largest : tuple of Ratio
    """

    factor: float
    dof: float
    p: float
    n: int
    largest: tuple[Ratio, ...]


@dataclass(frozen=True)
class Contradicted:
    """A known value that the network contradicts.

    Parameters
    ----------
    name : str
    residual, error : float
        Known less computed; estimated error.
    statistic, critical : float
        Of a normal test.
    left_out : bool
        False: it weighs less now.
    rivals : tuple of str, optional
        Those of which one may be wrong instead; None where none was looked for.
    axes : tuple of int
        Of a control point: those that were left out with the one named.
    """

    name: str
    residual: float
    error: float
    statistic: float
    critical: float
    left_out: bool = False
    rivals: tuple[str, ...] | None = _if_made()
    axes: tuple[int, ...] = field(default=(), metadata={"internal": True})


@dataclass(frozen=True)
class ContradictedControl(Contradicted):
    """The same of a control point; ``swapped_with``: the other one with which it seems to have exchanged its name."""

    swapped_with: str | None = None


@dataclass(frozen=True)
class KnownBars:
    """Scale bars against the network: variance factor (None without redundancy), those contradicted, and the stated uncertainties, by
    name, of those that weigh less now."""

    group: KnownGroup | None = None
    gross: tuple[Contradicted, ...] = ()
    raised: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class KnownControl:
    """Weighted control points likewise; ``understated``: by how much their uncertainties were raised, or None."""

    group: KnownGroup | None = None
    gross: tuple[ContradictedControl, ...] = ()
    raised: Mapping[str, float] = field(default_factory=dict)
    understated: float | None = None


@dataclass(frozen=True)
class FixedPoints:
    """Whether the fixed points of a network with free ones beside them fit it together.

    Parameters
    ----------
    n : int
    f : float
    dof : (int, int)
    p : float
    miss : float
        Standard deviation of a coordinate that would explain it.
    """

    n: int
    f: float
    dof: tuple[int, int]
    p: float
    miss: float


@dataclass(frozen=True)
class KnownRecord:
    """Bars and control points against the network; ``untested``: why nothing of this could be tested, or None."""

    scale_bars: KnownBars = field(default_factory=KnownBars)
    control_points: KnownControl = field(default_factory=KnownControl)
    untested: str | None = None
    fixed_points: FixedPoints | None = None


@dataclass(frozen=True)
class EccentricityRecord:
    """How many image points were corrected for eccentricity, by how much at most, and how large it may be where it could not be."""

    corrected: int
    largest_px: float
    possible_px: float


@dataclass(frozen=True)
class CheckedPoint:
    """A check point; X, Y, Z each, NaN: not known.

    Parameters
    ----------
    name : str
    given, u_given, found, u_found : ndarray, shape (3,)
        Found in the stated datum.
    difference, u_difference, ratio : ndarray, shape (3,)
        Given less found, and that over its uncertainty.
    images : int
    """

    name: str
    given: np.ndarray
    u_given: np.ndarray
    found: np.ndarray
    u_found: np.ndarray
    difference: np.ndarray
    u_difference: np.ndarray
    ratio: np.ndarray
    images: int


@dataclass(frozen=True)
class WorstPoint:
    """The coordinate of a check point with the largest ratio, and the critical value of that."""

    name: str
    axis: str
    difference: float
    ratio: float
    critical: float


@dataclass(frozen=True)
class CheckRecord:
    """Check points beside an adjustment.

    Parameters
    ----------
    unit : str
    datum_parameters : int
        How many were fitted to the check points.
    n : int
        Coordinates.
    dof : int
    level : float
        Of the tests.
    rms, expected_rms : tuple of float
        Of X, Y, Z.
    chi2, p : float or None
        Of all together (of an F-distribution: the image coordinates tell the variance); None where they tell nothing.
    worst : WorstPoint or None
    text : str
    points : tuple of CheckedPoint
    """

    unit: str
    datum_parameters: int
    n: int
    dof: int
    level: float
    rms: tuple[float, ...]
    expected_rms: tuple[float, ...]
    chi2: float | None
    p: float | None
    worst: WorstPoint | None
    text: str
    points: tuple[CheckedPoint, ...]


@dataclass(frozen=True)
class RigCamera:
    """A camera of a rig against its reference, with standard uncertainties.

    Parameters
    ----------
    camera, reference : str
    rotation : ndarray, shape (3, 3)
        Takes directions of the reference's frame to that of the camera.
    rotation_deg, u_rotation_deg : ndarray, shape (3,)
        Its rotation vector; uncertainties of small rotations about the axes of the camera.
    position, u_position : ndarray, shape (3,)
        Projection centre in the frame of the reference, in the unit of the object.
    baseline, u_baseline, angle_deg, u_angle_deg : float
        Lengths of the two.
    """

    camera: str
    reference: str
    rotation: np.ndarray
    rotation_deg: np.ndarray
    u_rotation_deg: np.ndarray
    position: np.ndarray
    u_position: np.ndarray
    baseline: float
    u_baseline: float
    angle_deg: float
    u_angle_deg: float


@dataclass(frozen=True)
class EpipolarRecord:
    """Distances of image points from epipolar lines, in images without distortion.

    Parameters
    ----------
    first, second : str
        Cameras.
    n : int
        Points seen by both at one instant.
    rms_px, u_rms_px : float
    expected_px : float
        By the noise of the image coordinates alone.
    """

    first: str
    second: str
    n: int
    rms_px: float
    u_rms_px: float
    expected_px: float


@dataclass(frozen=True)
class RigidTest:
    """F-test whether the cameras of a rig stood still against each other.

    Parameters
    ----------
    f : float
    dof : (int, int)
    p : float
    scatter, expected, scatter_deg, expected_deg : float
        rms of the differences of the relative poses, instant by instant, from those of the rig, and what noise explains of it.
    worst : str
        Image whose relative pose differs most, by its uncertainty.
    """

    f: float
    dof: tuple[int, int]
    p: float
    scatter: float
    expected: float
    scatter_deg: float
    expected_deg: float
    worst: str


@dataclass(frozen=True)
class RigRecord:
    """Cameras that stand still against each other.

    Parameters
    ----------
    instants : int
        With images of two cameras or more.
    unit : str
    cameras : tuple of RigCamera
    covariance : ndarray, shape (6 n, 6 n)
        Camera by camera: small rotations about its axes, rad, then its position.
    widened : float
        Factor on all uncertainties, because instants scatter by more than noise.
    epipolar : tuple of EpipolarRecord
    rigid : RigidTest or None
    unjoined : tuple of str
        Cameras that no chain of common instants joins to the reference of the first of ``cameras``.
    """

    instants: int
    unit: str
    cameras: tuple[RigCamera, ...]
    covariance: np.ndarray
    epipolar: tuple[EpipolarRecord, ...] = ()
    rigid: RigidTest | None = None
    widened: float = 1.0
    unjoined: tuple[str, ...] = ()

    def frames(self) -> dict[str, tuple[np.ndarray, np.ndarray]]:
        """Rotation and projection centre of each camera in the frame of the first reference, which is the first of them."""
        if not self.cameras:
            return {}
        root = self.cameras[0].reference
        return {root: (np.eye(3), np.zeros(3))} | {
            one.camera: (one.rotation, one.position) for one in self.cameras if one.reference == root
        }


@dataclass(frozen=True)
class LineRecord:
    """A straight line.

    Parameters
    ----------
    image, line : str
    axis : {"x", "y"}
        "x": it runs along y and tells about x.
    angle_deg : float
    n : int
        Positions used.
    rms_px, dof : float
    """

    image: str
    line: str
    axis: str
    angle_deg: float
    n: int
    rms_px: float
    dof: float


@dataclass(frozen=True)
class LinesFTest:
    """One-sided F-test of positions along x against those along y; mappings by "positions", "effective", "lines": how they are counted.

    Parameters
    ----------
    ratio_px2, ratio_um2 : float
        Of the variances; in µm² None without a pitch.
    dof : mapping of (float, float)
    critical_95, p_px, p_um : mapping of float
    side, text : str
    """

    ratio_px2: float
    ratio_um2: float | None
    dof: Mapping[str, tuple[float, float]]
    critical_95: Mapping[str, float]
    p_px: Mapping[str, float]
    p_um: Mapping[str, float] | None
    side: str
    text: str


@dataclass(frozen=True)
class Tests:
    """Records of the tests of a calibration; None: not made. Mappings are by the names of the cameras.

    Parameters
    ----------
    field : FieldTest
    hold_out : HoldOut
    parameters : tuple of ParameterTest
    parameter_groups : tuple of GroupTest
    vision, correlations, residuals, f_test, curves, projection, variance_components, residual_grid : mapping
        Of `Vision`, `Correlations`, `CameraResiduals`, `FTest`, `DistortionCurves`, `ProjectionMap`, `CameraComponents`, `ResidualGrid`.
    field_sources : mapping
        Of `FieldSources`.
    shared_errors, halves, jackknife : mapping
        Of `SharedByCamera`, of tuples of `Halves`, of `Jackknife`.
    correlations_with_poses : tuple of PoseCorrelation
    gross_errors : tuple of GrossError
        Largest statistic first.
    patterns : tuple of Pattern
    images : tuple of ImageRecord
    network : NetworkRecord
    known : KnownRecord
    eccentricity : EccentricityRecord
    check_points : CheckRecord
    rig : RigRecord
    """

    __test__ = False  # no class of tests for pytest

    field: FieldTest | None = _if_made()
    hold_out: HoldOut | None = _if_made()
    parameters: tuple[ParameterTest, ...] | None = _if_made()
    parameter_groups: tuple[GroupTest, ...] | None = _if_made()
    vision: Mapping[str, Vision] | None = _if_made()
    correlations: Mapping[str, Correlations] | None = _if_made()
    correlations_with_poses: tuple[PoseCorrelation, ...] | None = _if_made()
    residuals: Mapping[str, CameraResiduals] | None = _if_made()
    f_test: Mapping[str, FTest] | None = _if_made()
    gross_errors: tuple[GrossError, ...] | None = _if_made()
    patterns: tuple[Pattern, ...] | None = _if_made()
    field_sources: Mapping[str, FieldSources] | None = _if_made()
    images: tuple[ImageRecord, ...] | None = _if_made()
    curves: Mapping[str, DistortionCurves] | None = _if_made()
    projection: Mapping[str, ProjectionMap] | None = _if_made()
    network: NetworkRecord | None = _if_made()
    known: KnownRecord | None = _if_made()
    variance_components: Mapping[str, CameraComponents] | None = _if_made()
    eccentricity: EccentricityRecord | None = _if_made()
    residual_grid: Mapping[str, ResidualGrid] | None = _if_made()
    shared_errors: Mapping[str, SharedByCamera] | None = _if_made()
    halves: Mapping[str, tuple[Halves, ...]] | None = _if_made()
    jackknife: Mapping[str, Jackknife] | None = _if_made()
    check_points: CheckRecord | None = _if_made()
    rig: RigRecord | None = _if_made()

    @property
    def made(self) -> bool:
        """Whether any test was made."""
        return any(getattr(self, one.name) is not None for one in fields(self))


@dataclass(frozen=True, repr=False)
class Calibration:
    """What a calibration hands to its user, its report and its files.

    Parameters
    ----------
    adjustment : Adjustment
        The one that stands.
    findings : tuple of Finding
        What the reader must know, most important first.
    tests : Tests
    grids : mapping
        Of `ResidualGrid`, by camera name.
    provenance : mapping
        Inputs with their hashes, options, version.
    given : Network, optional
        What was calibrated, before weights and corrections: `pixmetry.calibrate.job.solve_again` starts from it.
    """

    adjustment: Adjustment
    findings: tuple[Finding, ...] = ()
    tests: Tests = field(default_factory=Tests)
    grids: Mapping[str, ResidualGrid] = field(default_factory=dict)
    provenance: Mapping[str, Any] = field(default_factory=dict)
    given: Network | None = None

    def __repr__(self) -> str:
        a = self.adjustment
        posed = int(a.state.posed.sum())
        warnings = sum(finding.level != "note" for finding in self.findings)
        cameras = ", ".join(camera.name for camera in a.network.cameras)
        used = f"{posed} images, {int(a.used.sum())} image points"
        return f"<Calibration of {cameras}: {used}, sigma0 {a.sigma0:.4g} with {a.dof} degrees of freedom, {warnings} warnings>"

    def _repr_html_(self) -> str:
        """Parameters and findings for a notebook."""
        columns = self.columns("parameters")
        rows = [row for row in zip(*columns.values(), strict=True) if row[2] or row[5]]
        cells = "".join(
            f"<tr><td>{escape(camera)}</td><td>{name}</td><td>{value:.8g}</td><td>{f'± {u:.2g}' if estimated else 'held'}</td>"
            f"<td>{escape(unit)}</td></tr>"
            for camera, name, value, u, unit, estimated in rows
        )
        found = "".join(f"<li>{escape(finding.level)}: {escape(finding.text)}</li>" for finding in self.findings)
        return f"<p>{escape(repr(self).strip('<>'))}</p><table>{cells}</table><ul>{found}</ul>"

    def columns(self, table: Literal["parameters", "points", "poses", "residuals"]) -> dict[str, Any]:
        """A table of the results as columns by name: interior parameters, object points, poses, or image coordinates with their residuals.

        Raises
        ------
        InputError
            If there is no such table.
        """
        if table not in TABLES:
            raise InputError("no such table of a calibration", where="table", value=table, allowed=", ".join(TABLES))
        return TABLES[table](self.adjustment)

    def to_dataframe(self, table: Literal["parameters", "points", "poses", "residuals"] = "parameters") -> Any:
        """The same as a `pandas.DataFrame`, a row for each parameter, point, image or image coordinate; see `columns`.

        Raises
        ------
        InputError
            If there is no such table, or pandas is not installed.
        """
        return data_frame(self.columns(table))
