"""Accuracy that a camera allows for a target: the bound, the estimators, and their limits, as one plain record."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from pixmetry.core.arguments import choice, number
from pixmetry.core.errors import InputError
from pixmetry.locate.bound import closed_bounds as closed
from pixmetry.locate.bound.fisher import Bound, bound_of, cramer_rao_bound, pixel_noise
from pixmetry.locate.bound.predictions import PixelNoise, Prediction, names_for, predict
from pixmetry.locate.noise import NoiseModel, parse_noise
from pixmetry.locate.template.template_images import Images, axes_of, draw_images, line_length_px

__all__ = ["Bound", "Limit", "Possible", "bound", "cramer_rao_bound"]

SETS = ("position", "light", "shape", "planes")
WITHIN = 1.05  # frames are averaged until the uncertainty is within 5 % of what stays
MOST_FRAMES, VERY_MANY = 10**6, 10**12
LEAST_PHASES = 3  # along an axis: with one or two, the first wave of an S-curve has not its mean square over the pixel
UNKNOWN_PX = 1.0  # a place that is less sure than this is not known
LEFT_OUT = (
    "the noise is Gaussian, independent from pixel to pixel, and of known variance; the information of the variance about the light is "
    "not used",
    "the result is of first order: errors are larger if the noise is as large as the target",
    "not included: geometry, drift, lighting, and targets that differ from the template",
)


@dataclass(frozen=True)
class Limit:
    """One cause of an estimator's uncertainty: a share of its variance, mean over both coordinates and the phases."""

    cause: str
    variance_px2: float
    share: float


@dataclass(frozen=True)
class Possible:
    """What is possible, what estimators give, and what limits.

    Parameters
    ----------
    kind : str
    parameters : dict
        Of the target, without place.
    noise : str
        In words.
    window_px, frames : int
    bounds : dict of str to Bound
        By set of unknowns; that of the question is under ``asked``.
    closed_forms_px : dict of str to float
        Standard deviations in closed form, with what they hold for.
    predictions : tuple of Prediction
    chosen : Prediction
        The estimator whose limits are given.
    limits : tuple of Limit
        Largest first; the shares add up to 1.
    frames_worth : int or None
        So many frames bring the uncertainty within 5 % of what averaging does not remove; None if it goes on falling as 1/√N.
    advice, statements : tuple of str
    """

    kind: str
    parameters: dict[str, float]
    noise: str
    window_px: int
    frames: int
    bounds: dict[str, Bound]
    closed_forms_px: dict[str, float]
    predictions: tuple[Prediction, ...]
    chosen: Prediction
    limits: tuple[Limit, ...]
    frames_worth: int | None
    advice: tuple[str, ...]
    statements: tuple[str, ...]

    @property
    def u_px(self) -> float:
        """The bound of one coordinate for the unknowns that were asked for, mean over the phases."""
        return self.bounds["asked"].place_px[1]

    def to_record(self) -> dict[str, Any]:
        """Plain values for JSON; infinite ones are None."""

        def number(value: float) -> float | None:
            return float(value) if np.isfinite(value) else None

        def of(b: Bound) -> dict[str, Any]:
            names = ("least", "mean", "greatest")
            per = {n: dict(zip(names, map(number, b.u(n)), strict=True)) for n in b.unknowns}
            return {"unknowns": list(b.unknowns), "u_px": dict(zip(names, map(number, b.place_px), strict=True)), "u": per}

        predicted = [
            {"estimator": p.name, "u_px": number(p.u_px), "noise_px": number(p.noise_px), "s_curve_px": number(p.s_curve_px)}
            | {"over_bound": number(p.u_px / self.u_px), "detail": p.detail}
            for p in self.predictions
        ]
        return {
            "schema": "pixmetry/bound/1",
            "origin": "(0, 0) is the centre of the top-left pixel",
            "kind": self.kind,
            "parameters": self.parameters,
            "noise": self.noise,
            "window_px": self.window_px,
            "frames": self.frames,
            "exact_codes": self.bounds["asked"].exact_codes,
            "bounds": {name: of(b) for name, b in self.bounds.items()},
            "closed_forms_px": self.closed_forms_px,
            "predictions": predicted,
            "estimator": self.chosen.name,
            "limits": [vars(x) for x in self.limits],
            "frames_worth": self.frames_worth,
            "advice": list(self.advice),
            "statements": list(self.statements),
        }


def bound(
    kind: str,
    parameters: Mapping[str, float],
    noise: NoiseModel | str,
    unknowns: str | tuple[str, ...] | list[str] = "shape",
    *,
    estimator: str = "template",
    frames: int = 1,
    aperture_px: float = 1.0,
    light_on: str = "surface",
    window_px: int | None = None,
    phases: int = 5,
    rounded: bool = True,
    pattern_dn: float = 0.0,
) -> Possible:
    """Compute how well a target can be located, the errors of estimators, and the causes of the error of one of them.

    Parameters
    ----------
    kind, parameters, unknowns, frames, aperture_px, light_on, window_px, phases, rounded, pattern_dn
        As for `cramer_rao_bound`; but three ``phases`` at least, since what an estimator does over the phase is part of its uncertainty.
    noise : NoiseModel or str
        As for `cramer_rao_bound`, or as the command takes it: ``"read=1.5,gain=0.4,bits=12"``, whose pattern adds to ``pattern_dn``.
    estimator : str
        Whose limits are asked for: one of `pixmetry.locate.bound.predictions.names_for` this kind.

    Returns
    -------
    Possible

    Raises
    ------
    InputError
        If a value cannot be used.

    Examples
    --------
    >>> disc = {"radius_px": 3.5, "blur_px": 0.7, "amplitude_dn": 150.0, "background_dn": 10.0}
    >>> found = bound("disc", disc, "read=1.5,gain=0.4,bits=8", "position")
    >>> 0.005 < found.u_px < 0.05, found.predictions[0].name
    (True, 'template')
    """
    pattern_dn = number(pattern_dn, "pattern_dn", "the fixed pattern cannot be used", least=0, most=1e12, allowed="0 to 1e12 DN")
    if not isinstance(rounded, bool | np.bool_):
        raise InputError("neither rounded nor not", where="rounded", value=rounded, allowed="True, False")
    if isinstance(noise, str):
        noise, own_pattern_dn = parse_noise(noise, rounded)
        pattern_dn = float(np.hypot(pattern_dn, own_pattern_dn))
    images = draw_images(kind, parameters, aperture_px=aperture_px, light_on=light_on, window_px=window_px, phases=phases)
    if phases < LEAST_PHASES:
        what, remedy = "an error over the sub-pixel phase does not show in so few phases", "for the bound alone: cramer_rao_bound"
        raise InputError(what, where="phases", value=phases, allowed=f"{LEAST_PHASES} to 50", remedy=remedy)
    names = names_for(kind)
    choice(estimator, names, "estimator", f"this estimator cannot be predicted for a {kind}")
    pixels = pixel_noise(images, noise, rounded, pattern_dn, frames)
    asked = images.subset(unknowns)
    bounds = {"asked": bound_of(images, pixels, asked, noise, rounded)}
    bounds |= {name: bound_of(images, pixels, images.subset(name), noise, rounded) for name in SETS}
    if not bounds["asked"].place_px[1] < UNKNOWN_PX:
        raise InputError(
            "the image does not determine the position together with the other unknowns",
            where="unknowns",
            value=", ".join(asked),
            remedy="use fewer unknowns, or a target with more contrast within the scale",
        )
    predictions = tuple(predict(name, images, pixels, asked) for name in names)
    chosen = predictions[names.index(estimator)]
    worth = frames_worth(lambda n: predict(estimator, images, replace(pixels, frames=n), asked).u_px)
    return Possible(
        kind=kind,
        parameters={n: v for n, v in images.parameters.items() if n not in images.place},
        noise=noise.describe() + (", rounding included" if rounded else ", not rounded"),
        window_px=images.window_px,
        frames=pixels.frames,
        bounds=bounds,
        closed_forms_px=closed_forms(images, noise, frames),
        predictions=predictions,
        chosen=chosen,
        limits=limits(chosen, images, pixels, asked),
        frames_worth=worth,
        advice=tuple(_advice(predictions, worth, bounds)),
        statements=tuple(_statements(bounds["asked"], rounded)),
    )


def limits(chosen: Prediction, images: Images, pixels: PixelNoise, unknowns: tuple[str, ...]) -> tuple[Limit, ...]:
    """Split an estimator's variance: noise of the pixels with known shape, other unknowns, loss of the estimator, sampling.

    Notes
    -----
    With only the place unknown, the best estimator's variance is the sum of its causes. Other unknowns add to the bound; an estimator adds
    what it is above the bound, and its error without noise.
    """
    place = tuple(n for n in unknowns if n in images.place)
    best = pixels.for_the_best()
    base, full = predict("template", images, best, place), predict("template", images, best, unknowns)
    noise2, full2, base2 = chosen.noise_px**2, full.noise_px**2, base.noise_px**2
    variances = dict(base.parts_px2)
    variances["other unknowns"] = max(min(full2, noise2) - base2, 0.0)
    variances["the estimator: more noise than the best estimator"] = max(noise2 - max(full2, base2), 0.0)
    variances["the estimator: sampling (S-curve)"] = chosen.s_curve_px**2
    total = sum(variances.values())
    found = [Limit(cause, v, v / total) for cause, v in variances.items() if v > 1e-6 * total]
    return tuple(sorted(found, key=lambda x: -x.share))


def frames_worth(u_of: Callable[[int], float]) -> int | None:
    """Least number of frames that brings an uncertainty within 5 % of that of very many; None if it goes on as 1/√N.

    Parameters
    ----------
    u_of : callable
        Uncertainty of the mean of so many frames.
    """
    enough = WITHIN * u_of(VERY_MANY)
    low, high = 0, 1
    while u_of(high) > enough:
        low, high = high, 2 * high
        if high > MOST_FRAMES:
            return None
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (low, middle) if u_of(middle) <= enough else (middle, high)
    return high


def closed_forms(images: Images, noise: NoiseModel, frames: int = 1) -> dict[str, float]:
    """Closed forms for this target and noise; each name states the assumptions."""
    p, a, gain = images.parameters, images.aperture_px, noise.slope_dn
    amplitude, blur, ground = p["amplitude_dn"], p["blur_px"], p["background_dn"]
    edge = float(np.sqrt(noise.variance_dn2(ground + amplitude / 2) / frames))
    if images.kind == "disc":
        return {"edge formula, disc much larger than its blur": closed.disc_edge(p["radius_px"], blur, amplitude, edge, a)}
    if images.kind == "ring":
        return {"edge formula, both circles far apart": closed.ring_edge(p["radius_px"], p["inner_radius_px"], blur, amplitude, edge, a)}
    if images.kind == "ellipse":
        x, y = closed.ellipse_edge(*axes_of(p), blur, amplitude, edge, a)
        return {"edge formula, ellipse much larger than its blur, x": x, "the same, y": y}
    sigma = float(np.sqrt(noise.variance_dn2(ground) / frames))
    if images.kind in ("line", "edge"):
        return _line_forms(images, sigma, edge, gain / frames)
    out = {"additive noise of the background alone": closed.spot_read(blur, amplitude, sigma, a)}
    if gain > 0 and amplitude > 0:
        electrons = 2 * np.pi * blur**2 * amplitude / gain * frames
        out["shot noise alone"] = closed.spot_shot(blur, electrons, a)
        out["both (Mortensen et al. 2010)"] = closed.spot_mixed(blur, electrons, float(noise.variance_dn2(ground)) / gain**2 * frames, a)
    return out


def _line_forms(images: Images, sigma: float, sigma_edge: float, gain: float) -> dict[str, float]:
    p, a, length = images.parameters, images.aperture_px, line_length_px(images)
    blur, amplitude = p["blur_px"], p["amplitude_dn"]
    if images.kind == "edge" or "width_px" in p:
        edges = 2.0 if images.kind == "line" else 1.0
        name = "edge formula" if images.kind == "edge" else "edge formula, both sides of a bar that is wide against its blur"
        return {name: closed.edge_read(blur, amplitude, sigma_edge, edges * length, a)}
    out = {"additive noise of the background alone": closed.line_read(blur, amplitude, sigma, length, a)}
    if gain > 0 and amplitude > 0:
        out["shot noise alone"] = closed.line_shot(blur, np.sqrt(2 * np.pi) * blur * amplitude / gain, length, a)
    return out


def _advice(predictions: tuple[Prediction, ...], worth: int | None, bounds: dict[str, Bound]) -> list[str]:
    out = []
    two = sorted((p for p in predictions if p.name.removeprefix("row_") in ("centroid", "squared_centroid")), key=lambda p: p.u_px)
    if two:
        better, other = two
        out.append(
            f"of the two classical centroids, each in its best window, the {better.name.replace('_', ' ')} is better here: "
            f"{better.u_px:.2g} px against {other.u_px:.2g} px"
        )
    if worth is None:
        out.append("averaging N frames lowers all of this as 1/√N")
    else:
        out.append(f"averaging more than {worth} frames gains little: fixed errors of the sensor and of the sampling remain")
    light, planes = bounds["light"].place_px[1], bounds["planes"].place_px[1]
    if np.isfinite(planes) and planes > 1.2 * light:
        out.append(f"unknown slopes of background and light make the result {planes / light:.2g} × as large: fit them only if needed")
    return out


def _statements(asked: Bound, rounded: bool) -> list[str]:
    if not rounded:
        how = "grey values are assumed not to be rounded"
    elif asked.exact_codes:
        how = "some pixels have less than 0.4 DN of noise: the exact likelihood of the codes is used, and the sub-pixel phase matters"
    else:
        how = "rounding counts as noise of 1/12 DN², which holds for 0.4 DN of noise or more"
    return [how, *LEFT_OUT]
