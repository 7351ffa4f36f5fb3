"""The estimators that there are for each kind of target, by name, and which of them suits the targets of a frame."""

from __future__ import annotations

from functools import cache
from importlib import import_module

import numpy as np

from pixmetry.core.arguments import choice
from pixmetry.locate.detect.targets import Flag, Targets
from pixmetry.locate.estimator import Method
from pixmetry.locate.noise import NoiseModel

MODULES = (  # each has the tuple METHODS
    "pixmetry.locate.template.template",
    "pixmetry.locate.centroids.moments",
    "pixmetry.locate.centroids.operators",
)
AUTO = "auto"
AUTO_TEXT = "chooses shape and likelihood of the template from the image, and states the reason"
ROWS = {
    "template": "the whole line by least squares, integrated over the pixel; at the Cramér–Rao bound",
    "row_squared_centroid": "squared centroid of each row (or column), then a straight line through them",
    "row_centroid": "centroid of each row (or column), then a straight line through them",
    "row_soft_threshold": "centroid above a threshold of each row (or column), then a straight line through them",
    "row_template": "a profile fitted to each row (or column), then a straight line through them",
}
D4SIGMA, BLOB = "d4sigma", "light_centroid"
D4SIGMA_TEXT = "first and second moments in three times the width (ISO 11146): centroid, two widths, azimuth and ellipticity of a beam"
BLOB_TEXT = "centroid of the light of a region of any shape"
MOST_LOBES = 6  # regions of one beam, or of a few: more may be a field of spots
LOBES_APART, BEAMS_APART = 3.0, 10.0  # distances, over half the width at half height: of the lobes of one beam; of apertures of two
BEAM_PX, BEAM_RATIO = 4.0, 0.8  # half the width of spots at half height from which, ratio of their axes below which they are beams
SPOTS = ("disc", "ellipse", "ring", "spot")
KINDS = (*SPOTS, "blob", "line", "edge", "cross", "chessboard", "coded")
FEW_ELECTRONS = 50.0  # at a target's peak: below, the errors of a grey value are visibly no normal ones
TILTED, TILTED_PX = 0.91, 0.3  # ratio of the axes below which, difference of half axes above which discs are fitted as ellipses
LARGE_PX = 2.0  # radius from which that ratio can be told from a look at the region


@cache
def methods() -> dict[str, Method]:
    """The methods that measure targets which are regions, by name.

    Examples
    --------
    >>> from pixmetry.locate.estimators import methods
    >>> methods()["centroid"].text
    'centroid of grey values above the background; best for small targets with shot noise'
    """
    return {method.name: method for module in MODULES for method in import_module(module).METHODS}


def estimators(kind: str) -> dict[str, str]:
    """Return the estimators for a kind of target, each with a description in one line.

    Raises
    ------
    InputError
        If there is no such kind.

    Examples
    --------
    >>> from pixmetry.locate.estimators import estimators
    >>> list(estimators("line"))[:2]
    ['auto', 'template']
    """
    choice(kind, KINDS, "kind", "no such kind of target")
    if kind == "blob":
        return {AUTO: AUTO_TEXT, BLOB: BLOB_TEXT}
    if kind == "spot":
        return {AUTO: AUTO_TEXT} | {name: method.text for name, method in methods().items()} | {D4SIGMA: D4SIGMA_TEXT}
    if kind in SPOTS or kind == "coded":
        return {AUTO: AUTO_TEXT} | {name: method.text for name, method in methods().items()}
    if kind == "line":
        return {AUTO: AUTO_TEXT, **ROWS}
    return {AUTO: AUTO_TEXT, "template": "least squares with the target's own shape, integrated over the pixel"}


def seen_shape(kind: str, targets: Targets) -> tuple[str, str]:
    """Choose the shape of the template for the targets of one frame, and say why: discs that are seen tilted are ellipses."""
    large = (targets.semi_major_px > LARGE_PX) & ((targets.flags & Flag.BORDER) == 0)
    if kind != "disc" or not large.any():
        return kind, "at the Cramér–Rao bound for every size and noise"
    major, minor = targets.semi_major_px[large], targets.semi_minor_px[large]
    flat = float(np.median(minor / major))
    if flat < TILTED or float(np.median(major - minor)) > TILTED_PX:
        return "ellipse", f"the discs appear as ellipses, axes 1 : {flat:.2f}"
    return kind, "at the Cramér–Rao bound for every size and noise"


def are_beams(targets: Targets) -> bool:
    """Whether spots are beams of light, whose widths and azimuth are asked for, and no blurred points: large, or longer than wide.

    Many that stand apart, but not as far as the apertures of beams reach, are a field of spots.
    """
    from scipy.spatial import cKDTree

    if not len(targets):
        return False
    strong = np.abs(targets.amplitude_dn) >= 0.2 * np.abs(targets.amplitude_dn).max()
    major, minor = float(np.median(targets.semi_major_px[strong])), float(np.median(targets.semi_minor_px[strong]))
    if np.count_nonzero(strong) > MOST_LOBES:
        place = np.stack([targets.x_px, targets.y_px], axis=1)[strong]
        nearest = float(np.median(cKDTree(place).query(place, 2)[0][:, 1]))
        if LOBES_APART * major < nearest < BEAMS_APART * major:
            return False
    return minor > BEAM_PX or (minor < BEAM_RATIO * major and minor > LARGE_PX)


def chosen_estimator(targets: Targets, noise: NoiseModel, why: str) -> tuple[str, str]:
    """Choose the estimator for the targets of one frame, and say why; ``why`` is what `seen_shape` says.

    The template is at the Cramér–Rao bound for every size and noise (that is what the other rules would trade for speed), so what is to
    be chosen is its shape and its likelihood.
    """
    if not len(targets):
        return "template", "no target was found"
    known = noise.slope_dn and noise.slope_clear
    electrons = float(np.median(np.abs(targets.amplitude_dn))) / noise.slope_dn if known else np.inf
    if electrons < FEW_ELECTRONS:
        return "poisson_gaussian", f"{electrons:.0f} electrons at the peak: grey values are not normally distributed; {why}"
    return "template", why
