"""Least-squares templates: discs, ellipses, rings and Gaussian spots, blurred, averaged over the pixels and fitted to grey values."""

from __future__ import annotations

from functools import partial

import numpy as np

from pixmetry.core.errors import InputError
from pixmetry.core.threads import map_tiles
from pixmetry.locate.detect.targets import Flag, Positions, Targets
from pixmetry.locate.estimator import Method, Settings
from pixmetry.locate.noise import NoiseModel
from pixmetry.locate.template.image_noise import noise_from_image
from pixmetry.locate.template.template_fit import KINDS, Fitted, Windows, run_fit, with_second_start, without_outliers

__all__ = ["KINDS", "LIGHT_ON", "PARAMETERS", "PLANES", "choose_planes", "fit_template", "model", "noise_from_image"]

_LAST = ("blur_px", "amplitude_dn", "background_dn")
PARAMETERS = {
    "disc": ("x_px", "y_px", "radius_px", *_LAST),
    "ellipse": ("x_px", "y_px", "shape_xx_px", "shape_yy_px", "shape_xy_px", *_LAST),
    "ring": ("x_px", "y_px", "radius_px", "inner_radius_px", *_LAST),
    "spot": ("x_px", "y_px", *_LAST),
}
PLANES = ("background_x_dn_per_px", "background_y_dn_per_px", "light_x_per_px", "light_y_per_px")
LIGHT_ON = ("surface", "image")
LIKELIHOODS = ("least_squares", "poisson_gaussian")
RATE_FALL = {2: 13.82, 4: 18.47}  # fall of χ² by 2 or 4 unknowns that chance exceeds once in 1000 targets
DROP_FALL = 5.99  # fall by 2 unknowns that chance exceeds once in 20
MEDIAN_FALL = {2: (1.386, 2.0), 4: (3.357, 3.19)}  # median of χ² with 2 or 4 degrees, and its standard deviation times √n
POOL = 20  # targets from which their falls are also looked at together
POOLED_SIGMA = 5.0
NEIGHBOURS = 8  # targets around one that must agree with it on a plane
AUTO = ("auto", "shared")
PIECES = 8  # of the work
FAR_OUT = 25.0  # times the usual
POOR_SIGMA = 5.5
FAINT_SHARE = 0.15  # of the blur: uncertainty from which the covariance of first order is too small
SHARP_SPOT_PX = 0.6  # blur of a spot below which its place depends on what a point's image is, which pixels do not resolve
SHARP_PX = 0.3  # blur below which a template's position begins to depend on the exact shape of the pixel


def model(
    kind: str, parameters: np.ndarray, rows: int, cols: int, *, aperture_px: float = 1.0, light_on: str = "surface"
) -> tuple[np.ndarray, np.ndarray]:
    """Return the grey values of a target in a window whose first pixel is (0, 0), and their derivatives; exact to 2e-5 of the amplitude.

    Parameters
    ----------
    kind : {"disc", "ellipse", "ring", "spot"}
    parameters : array_like
        In the order of ``PARAMETERS[kind]``; the four of `PLANES` may follow. The outline of an ellipse is c + S (cos t, sin t) with the
        symmetric matrix S of its ``shape_``; the amplitude of a spot is its peak before the average over the pixel.
    rows, cols : int
        Size of the window.
    aperture_px : float
        Side of a pixel's square aperture; 0 samples at its centre.
    light_on : {"surface", "image"}
        Whether the light that falls off acts on the target's surface, before the blur, or on the pixels. A spot knows only the latter.

    Returns
    -------
    mean : ndarray, shape (rows, cols), float64
        In DN.
    jacobian : ndarray, shape (number of parameters given, rows, cols), float64

    Raises
    ------
    InputError
        If the kind is unknown, or the parameters do not describe a target.
    """
    from pixmetry.locate.template._template_kernels import mean_images

    _check(kind, light_on, aperture_px)
    given = np.asarray(parameters, float).ravel()
    names = (*PARAMETERS[kind], *PLANES)
    if len(given) not in (len(names), len(names) - 4) or not np.isfinite(given).all():
        raise InputError(f"parameters that are not those of a {kind}", value=given.tolist(), allowed=", ".join(names))
    full = np.zeros(len(names))
    full[: len(given)] = given
    _check_shape(kind, full)
    images = mean_images(KINDS.index(kind), full, int(rows), int(cols), float(aperture_px), light_on == "surface")
    return images[0, :, :cols].copy(), images[1 : len(given) + 1, :, :cols].copy()


def fit_template(
    frame: np.ndarray,
    targets: Targets,
    noise: NoiseModel,
    kind: str = "disc",
    *,
    likelihood: str = "least_squares",
    background_plane: str | bool = "auto",
    light_plane: str | bool = "auto",
    light_on: str = "surface",
    aperture_px: float = 1.0,
    threads: int | None = None,
) -> Positions:
    """Fit a template to every target by weighted least squares or by the likelihood of Poisson numbers with normal read noise.

    Parameters
    ----------
    frame : ndarray, shape (rows, cols), uint8, uint16 or float32
    targets : Targets
        Start values.
    noise : NoiseModel
        Weights are 1/variance at the fitted mean, and the mean is that of the clipped value where the scale ends; an integer frame's scale
        ends at the range of its type at the latest.
    kind : {"disc", "ellipse", "ring", "spot"}
    likelihood : {"least_squares", "poisson_gaussian"}
        With weights from the fitted mean, least squares solves the likelihood equations of a Poisson number shifted by the read noise's
        variance (Huang et al. 2013). ``poisson_gaussian`` uses the exact likelihood (Snyder et al. 1995) where the mean is below 60
        electrons and the read noise below 3; it is the same as least squares where the noise does not depend on the level.
    background_plane, light_plane : {"auto", "shared"} or bool
        A slope of the background, and of the light on the target, among the unknowns; see Notes. "shared": as "auto", but only where most
        targets ask for one, or 20 that are judged together: what is in one place alone may be the wave of a coder, and no light.
        A spot knows no light plane: to first order it is a shift.
    light_on : {"surface", "image"}
        See `model`.
    aperture_px : float
        Side of a pixel's square aperture.
    threads : int, optional

    Returns
    -------
    Positions
        With the unknowns and their standard uncertainties (``u_``) in ``more``, ``chi2_per_dof``, ``dof`` and ``steps``.

    Raises
    ------
    InputError
        If an option is unknown.

    Notes
    -----
    "auto" looks for planes by the fall of χ² that they would bring: for a single target where chance brings it once in 1000; for all
    of them where the median fall of at least 20 targets stands 5 standard deviations above that of chance (3e-7). Falls are divided by the
    median χ² per degree of freedom where that exceeds 1. Planes are fitted only where they also predict pixels that were held back
    (`predicted`). A slope too small to be seen, which shifts the position by up to about two standard uncertainties, is not in the
    covariance of a single target.

    References
    ----------
    W. Förstner, Int. Arch. Photogrammetry 24-III, 176 (1982) and A. W. Gruen, S. Afr. J. Photogrammetry 14(3), 175 (1985), for
    least-squares matching. D. L. Snyder et al., J. Opt. Soc. Am. A 12(2), 272 (1995); F. Huang et al., Nature Methods 10, 653 (2013).
    """
    _check(kind, light_on, aperture_px)
    if likelihood not in LIKELIHOODS:
        raise InputError("no such likelihood", value=likelihood, allowed=", ".join(LIKELIHOODS))
    for name, value in (("background_plane", background_plane), ("light_plane", light_plane)):
        if value not in (*AUTO, True, False):
            raise InputError(f"{name} is neither on nor off", value=value, allowed='"auto", "shared", True, False')
    single = "shared" not in (background_plane, light_plane)
    background_plane, light_plane = ("auto" if value in AUTO else value for value in (background_plane, light_plane))
    if kind == "spot":
        if light_plane is True:
            raise InputError("light that falls off over a Gaussian spot cannot be distinguished from a shift", allowed="light_plane=False")
        light_plane = False
    surface, exact = light_on == "surface", likelihood == "poisson_gaussian"
    windows = Windows.of(frame, targets, noise, kind, aperture_px, surface, exact)
    everyone = np.arange(len(targets))
    auto = "auto" in (background_plane, light_plane)
    on_ground, on_light = np.full(len(targets), background_plane is True), np.full(len(targets), light_plane is True)
    options = (background_plane is True and not auto, light_plane is True and not auto, auto)
    result = run_fit(windows, everyone, windows.start, *options, threads)
    result = with_second_start(windows, targets, everyone, result, options, threads)
    if auto:
        on_ground, on_light = choose_planes(result.falls, result.chi2_per_dof, background_plane, light_plane)
        start = np.where(result.at_rest[:, None], result.parameters, windows.start)
        for ground, light in ((True, True), (True, False), (False, True)):  # what one does not believe is left to the next
            again = np.flatnonzero((on_ground == ground) & (on_light == light))
            if not len(again):
                continue
            free = ground and background_plane == "auto", light and light_plane == "auto"  # the other one is wanted in any case
            if any(free):
                there, other = predicted(windows, targets, result, again, (ground, light), threads)
                if not (single or (there.all() if len(again) >= POOL else 2 * there.sum() > len(targets))):
                    there = np.zeros_like(there)
                on_ground[again[~there]], on_light[again[~there]] = other[0] or ground and not free[0], other[1] or light and not free[1]
                again = again[there]
            if not len(again):
                continue
            sloped = run_fit(windows, again, start, ground, light, False, threads)
            result = result.put(again, sloped)
    result, lone = without_outliers(windows, result, on_ground, on_light, threads)
    return _positions(kind, targets, result, windows.noise, (on_ground, on_light, lone))


def choose_planes(
    falls: np.ndarray, chi2_per_dof: np.ndarray, background_plane: str | bool, light_plane: str | bool
) -> tuple[np.ndarray, np.ndarray]:
    """Choose the planes of every target from the expected falls of χ² with the background's, the light's and both; shape (n, 3)."""
    good = np.isfinite(falls).all(axis=1) & np.isfinite(chi2_per_dof)
    ground, light, both = (falls / max(1.0, float(np.median(chi2_per_dof[good])) if good.any() else 1.0)).T
    off = np.zeros(len(falls), bool)
    if background_plane != "auto":
        given = ground if background_plane else 0.0
        return np.full(len(falls), background_plane), good & _significant((both if background_plane else light) - given, good, 2)
    if light_plane != "auto":
        given = light if light_plane else 0.0
        return good & _significant((both if light_plane else ground) - given, good, 2), np.full(len(falls), light_plane)
    any_ = good & _significant(both, good, 4)
    if not any_.any():
        return off, off.copy()
    pooled = any_.mean() > 0.5
    need_ground, need_light = both - light, both - ground
    if pooled:
        need_ground, need_light = np.full(len(falls), np.median(need_ground[good])), np.full(len(falls), np.median(need_light[good]))
        needed = MEDIAN_FALL[2][0] * (1 + 4 / np.sqrt(good.sum()))
    else:
        needed = DROP_FALL
    on_ground = any_ & ((need_ground > needed) | ((need_light <= needed) & (ground >= light)))
    on_light = any_ & ((need_light > needed) | ((need_ground <= needed) & (light > ground)))
    return on_ground, on_light


def predicted(
    windows: Windows, targets: Targets, plain: Fitted, which: np.ndarray, planes: tuple[bool, bool], threads: int | None
) -> tuple[np.ndarray, tuple[bool, bool]]:
    """Whether planes that some pixels of a target ask for are also those of pixels that were held back; shape (n,), bool.

    Where not, the second answer says which plane of two remains to be tried.

    The planes of either half of the pixels move the place by a and b. The mean of a·b is the square of the bias that they take away,
    whatever the noise is; that of |a − b|²/4 is the noise that they add. Planes are fitted where the former is larger: noise that is
    correlated over pixels brings a fall of χ², but no shift on which the halves agree. Many targets are judged together. Their planes must
    then be light, not a halo that a lens, a coder or a filter puts on one side of every target: neighbours in the frame have the same,
    the background's map has its slopes, and the flat inside of the targets slopes as their edges say.
    """
    from scipy.spatial import cKDTree

    from pixmetry.locate.template._template_kernels import held_back

    model = windows.model

    def piece(part: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        return held_back(windows.frame, model, plain.parameters, planes, part, windows.about)

    pieces = map_tiles(piece, np.array_split(which, min(PIECES, len(which))), threads)
    moved, slopes, inside = (np.concatenate(v, axis=1) for v in zip(*pieces, strict=True))
    both, apart = (moved[0] * moved[1]).sum(axis=1), ((moved[0] - moved[1]) ** 2).sum(axis=1) / 4
    alone: np.ndarray = both > apart  # False where a half tells nothing
    good = np.isfinite(both)
    none = (False, False)
    if good.sum() < POOL:
        return alone, none
    usual_fall = max(1.0, float(np.median(plain.falls[which, 2])) / MEDIAN_FALL[4][0])
    alone &= plain.falls[which, 2] > RATE_FALL[4] * usual_fall  # what stands out from the falls that all have
    good &= both + apart < FAR_OUT * np.median((both + apart)[good])  # a dot under dirt has no voice
    light_only = (False, planes[0] and planes[1])
    if both[good].mean() < apart[good].mean():
        return alone, light_only
    shift = 0.5 * (moved[0] + moved[1])[good]
    place = plain.parameters[which[good], :2]
    usual = np.median(shift[cKDTree(place).query(place, NEIGHBOURS + 1)[1][:, 1:]], axis=1)
    if (shift * usual).sum() < ((shift - usual) ** 2).sum():
        return alone, light_only
    part, chosen = targets[which[good]], slopes[:, good]
    there = np.stack([part.background_x_dn_per_px, part.background_y_dn_per_px], axis=1)
    bright = np.maximum(part.background_dn - max(windows.noise.black_dn, 0.0), 0.0)[:, None]
    dark = np.median(bright[:, 0] + part.amplitude_dn) < 0.5 * np.median(bright)  # the ground is what has the light
    if planes[0] and not _explains(there, chosen[:, :, :2]):
        return alone, light_only
    if planes[1]:
        on_core = _explains(inside[1, good], np.stack([inside[0, good]] * 2))
        if not on_core or (dark and not _explains(there, chosen[:, :, 2:] * bright)):
            return alone, (planes[0], False)
    return np.ones(len(which), bool), none


def _explains(there: np.ndarray, slopes: np.ndarray) -> bool:
    """Whether slopes that are known from elsewhere, shape (n, 2), are at least half of those of two halves of the pixels, (2, n, 2)."""
    told = np.isfinite(there).all(axis=1) & np.isfinite(slopes).all(axis=(0, 2))
    mean = 0.5 * (slopes[0] + slopes[1])
    return bool((there * mean)[told].sum() > 0.5 * (slopes[0] * slopes[1])[told].sum())


def _significant(fall: np.ndarray, good: np.ndarray, degrees: int) -> np.ndarray:
    middle, width = MEDIAN_FALL[degrees]
    count = int(good.sum())
    if count >= POOL and np.median(fall[good]) > middle + POOLED_SIGMA * width / np.sqrt(count):
        return good.copy()
    planes: np.ndarray = np.nan_to_num(fall) > RATE_FALL[degrees]
    return planes


def _check(kind: str, light_on: str, aperture_px: float) -> None:
    if kind not in KINDS:
        raise InputError("no such kind of template", value=kind, allowed=", ".join(KINDS))
    if light_on not in LIGHT_ON:
        raise InputError("light that acts nowhere", value=light_on, allowed=", ".join(LIGHT_ON))
    if not 0 <= aperture_px <= 4:
        raise InputError("an impossible aperture of a pixel", value=aperture_px, allowed="0 … 4 px")


def _check_shape(kind: str, p: np.ndarray) -> None:
    names = dict(zip(PARAMETERS[kind], p.tolist(), strict=False))
    good = names["blur_px"] > 0
    if kind == "disc":
        good &= names["radius_px"] > 0
    elif kind == "ring":
        good &= names["radius_px"] > names["inner_radius_px"] > 0
    elif kind == "ellipse":
        xx, yy, xy = p[2:5]
        good &= bool(xx > 0 and xx * yy > xy * xy)
    if not good:
        raise InputError(f"this {kind} cannot be computed", value=names, allowed="sizes and blur above 0, an outline that encloses an area")


def _positions(kind: str, targets: Targets, result: Fitted, noise: NoiseModel, marks: tuple[np.ndarray, ...]) -> Positions:
    """The table of fits; ``marks``: which have planes of the background and of the light, and lost pixels that stand out."""
    on_ground, on_light, lone = marks
    names = (*PARAMETERS[kind], *PLANES)
    poor = result.chi2_per_dof > 1 + POOR_SIGMA * np.sqrt(2 / np.maximum(result.dof, 1))
    jitter = noise.row_shift_px > 0 or noise.field_shift_px > 0  # which is in the covariance, and in the residuals
    wider = np.where(poor & (not jitter), result.chi2_per_dof, 1.0)  # residuals that are larger than the noise count as noise
    p, u = result.parameters, np.sqrt(result.variance * wider[:, None])
    more = {name: p[:, j] for j, name in enumerate(names) if j > 1 and not name.startswith("shape_")}
    more |= {f"u_{name}": u[:, j] for j, name in enumerate(names) if j > 1 and not name.startswith("shape_")}
    if kind == "ellipse":
        xx, yy, xy = p[:, 2:5].T
        half, spread = 0.5 * (xx + yy), np.hypot(0.5 * (xx - yy), xy)
        more |= {"semi_major_px": half + spread, "semi_minor_px": half - spread, "angle_deg": np.rad2deg(0.5 * np.arctan2(2 * xy, xx - yy))}
    more |= {"chi2_per_dof": result.chi2_per_dof, "dof": result.dof, "steps": result.steps}
    worst = np.sqrt(result.noise_var_px2)
    flags = targets.flags.astype(np.uint32)
    for flag, where in (
        (Flag.NOT_CONVERGED, ~result.at_rest | (worst > np.maximum(targets.semi_major_px, 1.0))),  # beyond its own size: no place at all
        (Flag.BORDER, result.cut),
        (Flag.SATURATED, result.at_top > 0),
        (Flag.CLIPPED_AT_BLACK, result.at_bottom > 0),
        (Flag.GRADIENT, on_light),
        (Flag.UNEVEN_BACKGROUND, on_ground),
        (Flag.POOR_FIT, poor),
        (Flag.DEFECT, lone),
        (Flag.UNDER_SAMPLED, more["blur_px"] < (SHARP_SPOT_PX if kind == "spot" else SHARP_PX)),
        (Flag.FAINT, worst > FAINT_SHARE * np.hypot(more["blur_px"], 0.29)),
    ):
        flags[where] |= np.uint32(flag)
    var_x, cov_xy, var_y = (result.covariance * wider[:, None]).T.copy()
    if kind == "spot" and (more["blur_px"] < SHARP_SPOT_PX).any():
        from pixmetry.locate.template.spot_shape import shape_error_px

        shape = shape_error_px(more["blur_px"])
        var_x, var_y = var_x + shape**2, var_y + shape**2
    return Positions(p[:, 0].copy(), p[:, 1].copy(), var_x, cov_xy, var_y, flags, more)


def _reach_px(radius_px: float, edge_px: float) -> float:
    return 3.5 * edge_px + 1.0


def _measure(likelihood: str, frame: np.ndarray, targets: Targets, noise: NoiseModel, how: Settings) -> Positions:
    return fit_template(
        frame,
        targets,
        noise,
        how.shape,
        likelihood=likelihood,
        background_plane=how.planes,
        light_plane=how.planes,
        light_on=how.light_on,
        aperture_px=how.aperture_px,
        threads=how.threads,
    )


def _slopes(found: Positions, noise: NoiseModel, shape: tuple[int, int], reach_px: float) -> np.ndarray:
    """How x and y of fitted discs change per DN added to each pixel: rows of (JᵀWJ)⁻¹JᵀW, W one over the variances."""
    rows, cols = shape
    out = np.zeros((2, len(found), rows, cols))
    for k in range(len(found)):
        values = [found.x_px[k], found.y_px[k], *(found.more[name][k] for name in PARAMETERS["disc"][2:])]
        if not np.isfinite(values).all():
            out[:, k] = np.nan
            continue
        mean, jacobian = model("disc", np.array(values), rows, cols)
        y, x = np.ogrid[:rows, :cols]
        near = np.hypot(x - values[0], y - values[1]) <= reach_px
        columns = jacobian[:, near] / np.sqrt(noise.variance_dn2(mean[near]))
        scale = np.sqrt((columns**2).sum(axis=1, keepdims=True))
        gain = np.linalg.pinv((columns / scale).T, rcond=1e-9) / scale / np.sqrt(noise.variance_dn2(mean[near]))
        out[:, k, near] = gain[:2]
    return out


METHODS = (
    Method(
        "template",
        "least squares with the target's own shape, integrated over the pixel; at the Cramér–Rao bound",
        partial(_measure, "least_squares"),
        _reach_px,
        knows_aperture=True,
        slopes=_slopes,
        words="template fit",
        sees_phase=False,
    ),
    Method(
        "poisson_gaussian",
        "maximum likelihood with the same shape; for few electrons",
        partial(_measure, "poisson_gaussian"),
        _reach_px,
        knows_aperture=True,
        slopes=_slopes,
        words="template fit with the likelihood of few electrons",
        sees_phase=False,
    ),
)
