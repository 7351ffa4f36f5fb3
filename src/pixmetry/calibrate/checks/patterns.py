"""Patterns in the residuals, each a hypothesis with its test and its amplitude, and the error source that makes it."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from pixmetry.calibrate.bundle.network import Adjustment
from pixmetry.calibrate.checks.added_terms import AddedTerms, Terms, whitening
from pixmetry.calibrate.checks.causes import Candidate, Place, causes_of, places_of
from pixmetry.calibrate.checks.field_sources import LAYOUTS, PLAIN, field_sources, field_terms, height_terms
from pixmetry.calibrate.checks.quality import p_words, redundancy_of
from pixmetry.calibrate.records import ByImage, FieldSources, Outstanding, Pattern
from pixmetry.core.arrays import Array
from pixmetry.core.errors import MeasureError
from pixmetry.core.finding import Finding
from pixmetry.core.threads import single_threaded_blas

HATS = 8  # nodes of a piecewise linear curve
FIELD_NODES = (6, 5)  # of a piecewise linear field, along x and y
LONGEST_WAVE = 0.25  # of the frame; what is longer is a curve
BINS_PER_PX = 4
DRIFT = ("x_scale_trend", "x_scale_by_image")
WORST = 5.0  # times the median rms: what a rejected image point counts at most
OUTSTANDING = 2.5  # times the median rms of the images: such an image is looked at by itself
RARE = 0.001
RARE_ALIKE = 0.01  # level at which a scale of x explains more than a shear
ALIKE = 0.001  # level at which images differ, but for one of them
FEW_OF = 3  # they are no more than one image in so many
NAMED = 5
ON_DIGITAL_ADVICE = "check that the pictures are as the camera stored them, and that nothing moves while they are taken"
MANY = 200  # a test needs so many image points of a camera

# what is seen; the error source in the catalogue; what to do
MEANING = {
    "radius": ("radial residuals depend on the radius", "optics.distortion", "estimate k4 and k5, or correct by a residual grid"),
    "unflatness": (
        "radial residuals depend on the position in the frame, not only on the radius",
        "sensor.unflatness",
        "correct by the height that camera.yaml then holds, or by a residual grid; with another focal length the shifts must change as "
        "1 over it",
    ),
    "field": ("residuals depend on the position in the frame", "sensor.pixel_geometry", "correct by a residual grid"),
    "seams": (
        "residuals jump from one part of the frame to the next",
        "sensor.pixel_geometry",
        "correct by a residual grid, and keep targets away from the seams",
    ),
    "rows_x": (
        "x residuals depend on the row",
        "grabber.line_jitter",
        "do not use the first rows, where the clock still settles, or correct by a residual grid",
    ),
    "columns_x": (
        "x residuals depend on the column",
        "grabber.sampling_clock",
        "sample with the camera's pixel clock, or correct by a residual grid",
    ),
    "wave_xx": (
        "x residuals are periodic along the row",
        "grabber.phase_pattern",
        "average images, or remove the interference; if the period is that of the targets, check how they are located",
    ),
    "wave_xy": (
        "x residuals are periodic down the column",
        "grabber.line_jitter",
        "compare the fields; average images; if the period is that of the targets, check how they are located",
    ),
    "wave_yy": (
        "y residuals are periodic down the column",
        "sensor.pixel_geometry",
        "use larger targets; if the period is that of the targets, check how they are located",
    ),
    "phase_x": (
        "x residuals depend on the sub-pixel phase",
        "sensor.pixel_aperture",
        "use larger or softer targets, or an estimator without this bias",
    ),
    "phase_y": (
        "y residuals depend on the sub-pixel phase",
        "sensor.pixel_aperture",
        "use larger or softer targets, or an estimator without this bias",
    ),
    "x_scale_trend": (
        "the scale of x drifts from the first image to the last",
        "grabber.clock_warm_up",
        "estimate an x-scale for each image",
    ),
    "x_scale_by_image": ("the scale of x differs from image to image", "grabber.clock_warm_up", "estimate an x-scale for each image"),
    "x_shift_by_image": ("x is shifted from image to image", "grabber.clock_warm_up", "estimate an x-shift for each image"),
    "principal_point_trend": ("the image shifts from the first image to the last", "sensor.mount_drift", "wait until the camera is warm"),
    "principal_distance_trend": (
        "the image grows or shrinks from the first image to the last",
        "sensor.thermal_expansion",
        "wait until the camera is warm, and lock the lens",
    ),
    "image_rms": ("residuals are larger in some images than in others", "", "check the worst images: focus, movement, light"),
}


@dataclass(frozen=True)
class _Seen:
    """Observations of one camera, in the order of the rows of the terms."""

    adjustment: Adjustment
    terms: AddedTerms
    camera: int
    mine: np.ndarray  # which of the rows
    x: np.ndarray
    y: np.ndarray
    image: np.ndarray

    def tested(
        self, name: str, amplitude_px: float, u_px: float | None, p: float, columns: Any = None, *, out_of: int = 1, **more: Any
    ) -> _Tested:
        """What was found of a pattern, before it is held against a level."""
        pattern = Pattern(name, self.adjustment.network.cameras[self.camera].name, amplitude_px, u_px, p, **more)
        return _Tested(pattern, None if columns is None else Candidate(name, columns, out_of))

    def along(self, x: np.ndarray | None, y: np.ndarray | None) -> np.ndarray:
        """Terms, shape (m, 2, k), from columns, shape (rows of this camera, k), of what they add to x and to y."""
        parts = [(axis, part) for axis, part in enumerate((x, y)) if part is not None]
        out = np.zeros((len(self.mine), 2, parts[0][1].shape[1]))
        for axis, part in parts:
            out[self.mine, axis] = part
        return out


@dataclass(frozen=True)
class _Tested:
    """A pattern, and the terms that make it; None: it is of no terms."""

    pattern: Pattern
    candidate: Candidate | None


@dataclass(frozen=True)
class Searched:
    """Patterns in the residuals, and by camera what they tell of error sources."""

    patterns: tuple[Pattern, ...]
    sources: Mapping[str, FieldSources] = field(default_factory=dict)


def residual_patterns(adjustment: Adjustment, level: float = 0.01) -> tuple[Pattern, ...]:
    """The patterns of `searched_residuals` alone."""
    return searched_residuals(adjustment, level).patterns


@single_threaded_blas()
def searched_residuals(adjustment: Adjustment, level: float = 0.01) -> Searched:
    """Test the residuals for patterns, each as if it had been estimated with everything else (see `added_terms`).

    Parameters
    ----------
    adjustment : Adjustment
    level : float
        Of all tests together: each is held against the level over their number (Bonferroni), which is given as ``level``.

    Returns
    -------
    tuple of Pattern
        Amplitudes: of waves and phases their own; of trends the change from the first image to the last, at the edge of the frame; of
        curves, fields and images the rms of what the residuals show of them, less the part that noise alone makes; of ``image_rms`` the
        largest rms of an image, in x or in y.
    """
    terms, network = AddedTerms(adjustment), adjustment.network
    seen = [one for k in range(len(network.cameras)) if (one := _seen_by(adjustment, terms, k)) is not None]
    tested = [list(_tests(one)) for one in seen]
    count = sum(len(found) for found in tested)
    patterns: list[Pattern] = []
    sources: dict[str, FieldSources] = {}
    for one, found in zip(seen, tested, strict=True):
        camera = network.cameras[one.camera]
        judged = [replace(t.pattern, level=level / count, significant=bool(t.pattern.p < level / count)) for t in found]
        shown = [t.candidate for t, p in zip(found, judged, strict=True) if p.significant and t.candidate is not None]
        places = places_of(terms, shown)
        by_name = {candidate.name: candidate for candidate in shown}
        chosen = {name: (by_name[name], place) for name, place in places.items() if not place.behind}
        rest = places.get("field")
        left = rest is not None and (not rest.behind or rest.p_left < level / count)
        told = sources[camera.name] = field_sources(terms, one.camera, one.mine, one.x, one.y, one.image, chosen, left=left)
        patterns += [replace(_worded(p, places, camera.interface), confirmed=p.name in told.confirmed) for p in judged]
    return Searched(tuple(patterns), sources)


def _seen_by(adjustment: Adjustment, terms: AddedTerms, k: int) -> _Seen | None:
    """The observations of a camera; None where they are too few."""
    network, rows = adjustment.network, terms.rows
    mine = network.camera_of[network.image[rows]] == k
    if mine.sum() < MANY:
        return None
    place = rows[mine]
    # places are the computed ones: measured ones hold the noise that is tested
    x, y = network.x_px[place] - adjustment.residual_px[place, 0], network.y_px[place] - adjustment.residual_px[place, 1]
    return _Seen(adjustment, terms, k, mine, x, y, network.image[place])


def _worded(found: Pattern, places: Mapping[str, Place], interface: str | None) -> Pattern:
    """The pattern with its possible causes, its sentence and its advice."""
    what, source, advice = MEANING[found.name]
    number = f"{found.amplitude_px:.4f} px" if found.u_px is None else f"{found.amplitude_px:.4f} ± {found.u_px:.4f} px"
    period = "" if found.period_px is None else f", period {found.period_px:.3g} px"
    place = places.get(found.name, Place(0.0))
    rivals = [cause for name in place.rivals for cause in causes_of(name, MEANING[name][1], interface)]
    causes = tuple(dict.fromkeys((*causes_of(found.name, source, interface), *rivals)))
    if interface == "digital" and source.startswith("grabber."):
        advice = ON_DIGITAL_ADVICE
    if found.p_alike is not None and found.p_alike > RARE_ALIKE and interface != "analogue":
        causes = tuple(cause for cause in causes if not cause.source.startswith("grabber."))
        advice = "see that nothing moves while a picture is taken, and that the board is stiff; a shear of the images is as large as this"
    if found.alone:
        what, causes = f"{what}, but only that of {found.alone} differs from all others", ()
        advice = "check this image: focus, movement, light, names of points"
    text = f"{what}: {number}{period}, {p_words(found.p)}" if found.significant else f"not found: {what} ({p_words(found.p)})"
    return replace(
        found,
        source=causes[0].source if causes else "",
        causes=tuple(cause.text for cause in causes),
        gain=place.gain,
        behind=place.behind,
        left=place.p_left < found.level,
        text=text,
        advice=advice,
    )


def searched_without_bad_images(adjustment: Adjustment, adjust: Callable[..., Adjustment]) -> Searched:
    """`searched_residuals`; if few images stand out by their residuals, of an adjustment without them, but for ``image_rms``."""
    found = searched_residuals(adjustment)
    bad = [name for one in found.patterns if one.significant and one.outstanding for name in one.outstanding.images_out]
    if not bad:
        return found
    network = adjustment.network
    used = adjustment.used & ~np.isin(network.image, np.flatnonzero(np.isin(network.images, bad)))
    try:
        again = searched_residuals(adjust(network, adjustment.state, used=used, redundancy=True))
    except MeasureError:  # the network hangs on them
        return found
    patterns = (*(p for p in again.patterns if p.name != "image_rms"), *(p for p in found.patterns if p.name == "image_rms"))
    return replace(again, patterns=patterns)


def _along_rows_only(one: Pattern) -> bool:
    """Whether a scale of x is what changes in the images, as a clock or a resampling makes it: not of one image alone, or beside a shear of
    the images as large."""
    return not one.alone and (one.p_alike is None or one.p_alike < RARE_ALIKE)


def pattern_findings(patterns: Sequence[Pattern]) -> tuple[Finding, ...]:
    """A warning for each significant pattern, the surest first; what another one explains is said with that."""
    several = len({one.camera for one in patterns}) > 1
    out = []
    significant = sorted((one for one in patterns if one.significant), key=lambda one: one.p)
    for one in significant:
        where = f"{one.camera}: " if several else ""
        if one.outstanding:
            out.append(_bad_images(one.outstanding, where))
            continue
        kind = "x_scale_drift" if one.name in DRIFT and _along_rows_only(one) else one.name
        if one.behind and not (kind == "x_scale_drift" and one.behind in DRIFT):
            continue
        caused = f" ({words})" if (words := cause_words(one)) else ""
        more = [p for p in significant if p.behind == one.name and p.camera == one.camera and not {p.name, one.name} <= {*DRIFT}]
        explained, rest = ([MEANING[p.name][0] for p in more if p.left == left] for left in (False, True))
        also = f". It also explains that {'; that '.join(explained)}" if explained else ""
        also += f". It does not explain all of the following, which are seen too: {'; '.join(rest)}" if rest else ""
        out.append(Finding(kind, f"{where}{one.text}{caused}{also}", one.advice[0].upper() + one.advice[1:] + ".", "warning"))
    return tuple(out)


def cause_words(one: Pattern) -> str:
    """What may have made a pattern, in words; empty where nothing is known."""
    if not one.causes:
        return ""
    if len(one.causes) > 1:
        return f"one of: {'; '.join(one.causes)}"
    return f"{'likely' if one.confirmed else 'possible'} cause: {one.causes[0]}"


def _bad_images(bad: Outstanding, where: str) -> Finding:
    found = list(zip(bad.images_out, bad.rms_px, bad.rejected, bad.times_median, strict=True))
    named = ", ".join(f"{name} ({_size(rms_px, rejected, times)})" for name, rms_px, rejected, times in found[:NAMED])
    more = " …" if len(found) > NAMED else ""
    few = "1 image has residuals" if len(found) == 1 else f"{len(found)} images have residuals"
    text = f"{where}{few} much larger than the others: {named}{more}. Patterns in the residuals were searched without"
    it = "it" if len(found) == 1 else "them"
    advice = f"Check {it}: focus, movement, light, names of points. If nothing helps, leave {it} out."
    return Finding("bad_images", f"{text} {it}.", advice, "warning")


def _size(rms_px: Sequence[float], rejected: int, times: float) -> str:
    """Residuals of one image: their rms as the figures show it, and what they are with its rejected image points counted."""
    size = f"rms {rms_px[0]:.2g} px in x and {rms_px[1]:.2g} px in y"
    if rejected:
        return f"{size}, but {rejected} rejected; with {'it' if rejected == 1 else 'them'} {times:.1f} times the median"
    return f"{size}, {times:.1f} times the median"


def _tests(seen: _Seen) -> Iterator[_Tested]:
    sensor = seen.adjustment.network.cameras[seen.camera].sensor
    xp, yp = seen.adjustment.state.interior[seen.camera, 1:3]
    dx, dy = seen.x - xp, seen.y - yp
    radius = np.hypot(dx, dy)
    outward = np.stack([dx, dy], axis=1) / np.maximum(radius, 1e-9)[:, None]
    hats = _hats(radius, 0.0, radius.max(), HATS)
    yield _group(seen, "radius", seen.along(hats * outward[:, :1], hats * outward[:, 1:]))
    yield _unflatness(seen, sensor.cols, sensor.rows)
    cells = _field(seen.x, seen.y, sensor.cols, sensor.rows)
    nothing = np.zeros_like(cells)
    yield _group(seen, "field", seen.along(np.hstack([cells, nothing]), np.hstack([nothing, cells])))
    yield _seams(seen, sensor.cols, sensor.rows)
    yield _group(seen, "rows_x", seen.along(_hats(seen.y, 0, sensor.rows - 1, HATS), None))
    yield _group(seen, "columns_x", seen.along(_hats(seen.x, 0, sensor.cols - 1, HATS), None))
    for name, place, axis, size in (
        ("wave_xx", seen.x, 0, sensor.cols),
        ("wave_xy", seen.y, 0, sensor.rows),
        ("wave_yy", seen.y, 1, sensor.rows),
    ):
        yield _wave(seen, name, place, axis, size)
    yield _harmonic(seen, "phase_x", seen.x, 0, 1.0)
    yield _harmonic(seen, "phase_y", seen.y, 1, 1.0)
    yield from _over_images(seen, dx, dy)


def _hats(values: np.ndarray, low: float, high: float, nodes: int) -> np.ndarray:
    """Piecewise linear functions, each 1 at its node and 0 at the others, shape (n, nodes)."""
    at = np.clip((values - low) / (high - low) * (nodes - 1), 0, nodes - 1)
    return np.maximum(0.0, 1.0 - np.abs(at[:, None] - np.arange(nodes)))


def _field(x: Array, y: Array, cols: int, rows: int) -> Array:
    across, down = _hats(x, 0, cols - 1, FIELD_NODES[0]), _hats(y, 0, rows - 1, FIELD_NODES[1])
    products: Array = across[:, :, None] * down[:, None, :]
    return products.reshape(len(x), -1)


def _group(seen: _Seen, name: str, columns: Any) -> _Tested:
    found = seen.terms.test(columns)
    return seen.tested(name, _visible(seen, found, columns), None, found.p, columns)


def _unflatness(seen: _Seen, cols: int, rows: int) -> _Tested:
    """Shapes of a surface of up to the fourth degree; as an explanation, bow, twist and skew alone where these do."""
    tested = _group(seen, "unflatness", seen.along(*height_terms(seen.x, seen.y, cols, rows)))
    few = Candidate("few", seen.along(*height_terms(seen.x, seen.y, cols, rows, PLAIN)))
    assert tested.candidate is not None
    if next(iter(places_of(seen.terms, [few, tested.candidate]))) == "few":
        return replace(tested, candidate=replace(few, name="unflatness"))
    return tested


def _seams(seen: _Seen, cols: int, rows: int) -> _Tested:
    """The best of all partitions of the frame into equal fields, each displaced as a whole; p is that of the best of so many."""
    tested = [(seen.terms.test(columns := seen.along(*field_terms(seen.x, seen.y, cols, rows, layout))), columns) for layout in LAYOUTS]
    found, columns = min(tested, key=lambda one: (one[0].p, -one[0].f))
    return seen.tested("seams", _visible(seen, found, columns), None, min(1.0, len(LAYOUTS) * found.p), columns, out_of=len(LAYOUTS))


def _visible(seen: _Seen, found: Terms, columns: Any) -> float:
    """Rms, px, of what the residuals show of a group of terms, over the coordinates that it touches, less what noise makes of it."""
    from scipy import sparse

    touched = columns.getnnz(axis=1) > 0 if sparse.issparse(columns) else (columns != 0).any(axis=2).ravel()
    px2 = seen.adjustment.network.covariance_px2[seen.terms.rows][:, [0, 2]].ravel()[touched].mean()
    return float(np.sqrt(max(found.fall - found.k * found.variance, 0.0) / touched.sum() * px2)) if found.k else 0.0


def _harmonic(seen: _Seen, name: str, place: np.ndarray, axis: int, per_px: float, out_of: int = 1, **more: Any) -> _Tested:
    angle = 2 * np.pi * per_px * place
    columns = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    along = seen.along(columns, None) if axis == 0 else seen.along(None, columns)
    found = seen.terms.test(along)
    amplitude = float(np.hypot(*found.values))
    unit = found.values / amplitude if amplitude > 0 else np.array([1.0, 0.0])
    u, p = float(np.sqrt(unit @ found.covariance @ unit)), min(1.0, found.p * out_of)
    return seen.tested(name, amplitude, u, p, along, out_of=out_of, **more)


def _wave(seen: _Seen, name: str, place: np.ndarray, axis: int, size: int) -> _Tested:
    """The strongest of all waves from a period of 2 px to a quarter of the frame; p is that of the best of so many (Bonferroni)."""
    residual = seen.adjustment.residual_px[seen.terms.rows[seen.mine], axis]
    length = 2 * BINS_PER_PX * size
    bins = np.clip(np.floor((place + 0.5) * BINS_PER_PX).astype(int), 0, length - 1)
    power = np.abs(np.fft.rfft(np.bincount(bins, residual, length))) ** 2
    per_px = np.arange(len(power)) / (2 * size)
    allowed = (per_px <= 0.5) & (per_px >= 1 / (LONGEST_WAVE * size))
    best = per_px[np.argmax(np.where(allowed, power, -1.0))]
    return _harmonic(seen, name, place, axis, best, int(allowed.sum()), period_px=float(1 / best))


def _over_images(seen: _Seen, dx: np.ndarray, dy: np.ndarray) -> Iterator[_Tested]:
    network = seen.adjustment.network
    images = np.unique(seen.image)
    if len(images) < 3:
        return
    sensor = network.cameras[seen.camera].sensor
    when = np.arange(len(network.images), dtype=float) if network.time_s is None else network.time_s
    first, last = when[images].min(), when[images].max()
    time = ((when[seen.image] - first) / (last - first) - 0.5 if last > first else np.zeros(len(seen.image)))[:, None]
    from_origin = seen.x[:, None] - network.scale_origin_px
    edge = max(abs(network.scale_origin_px), abs(sensor.cols - 1 - network.scale_origin_px))
    if "x_scale" not in network.per_image:
        if last > first:
            yield _trend(seen, "x_scale_trend", seen.along(time * from_origin, None), edge)
        middle = (sensor.rows - 1) / 2
        yield _by_image(seen, "x_scale_by_image", images, from_origin[:, 0], alike=seen.y - middle)
    if "x_shift" not in network.per_image:
        yield _by_image(seen, "x_shift_by_image", images, np.ones(len(dx)))
    if last > first:
        shift = np.hstack([time, np.zeros_like(time)]), np.hstack([np.zeros_like(time), time])
        yield _trend(seen, "principal_point_trend", seen.along(*shift), 1.0)
        corner = float(np.hypot(sensor.cols, sensor.rows)) / 2
        yield _trend(seen, "principal_distance_trend", seen.along(time * dx[:, None], time * dy[:, None]), corner)
    yield _image_rms(seen, images)


def _trend(seen: _Seen, name: str, columns: np.ndarray, edge_px: float) -> _Tested:
    found = seen.terms.test(columns)
    size = float(np.linalg.norm(found.values))
    unit = found.values / size if size > 0 else np.eye(len(found.values))[0]
    u = float(np.sqrt(unit @ found.covariance @ unit)) if found.k else np.inf
    return seen.tested(name, size * edge_px, u * edge_px, found.p, columns)


def _by_image(seen: _Seen, name: str, images: np.ndarray, x: np.ndarray, alike: np.ndarray | None = None) -> _Tested:
    """A value for each image, of sum 0: what is common to all belongs to affinity and principal point; ``alike``: displacements of x that
    the same images would show if something else deformed them."""
    from scipy import sparse, stats

    def of(values: np.ndarray) -> Any:
        rows = 2 * np.flatnonzero(seen.mine)
        return sparse.csr_matrix((values, (rows, np.searchsorted(images, seen.image))), shape=(2 * len(seen.mine), len(images)))

    columns = of(x)
    contrasts = np.linalg.svd(np.eye(len(images)) - 1 / len(images))[0][:, :-1]
    found = seen.terms.test(columns, contrasts)
    u = np.sqrt(np.maximum(np.einsum("ij,jk,ik->i", contrasts, found.covariance, contrasts), 0.0))
    names, values = tuple(seen.adjustment.network.images[i] for i in images), contrasts @ found.values
    alone = int(np.argmax(np.abs(values) / np.maximum(u, 1e-300)))
    by_image = ByImage(names, values, u, names[alone] if _alone(values, u, alone, found.dof) else None)
    steps = columns[:, :-1] - columns[:, 1:]  # of sum 0 too, and sparse
    p_alike = None
    if alike is not None:
        other = seen.terms.test(of(alike), contrasts)
        p_alike = float(stats.f.sf(found.f / max(other.f, 1.0), max(found.k, 1), max(other.k, 1)))
    return seen.tested(name, _visible(seen, found, columns), None, found.p, steps, by_image=by_image, p_alike=p_alike)


def _alone(values: np.ndarray, u: np.ndarray, one: int, dof: float) -> bool:
    """Whether the images other than one do not differ among themselves."""
    from scipy import stats

    rest = np.delete(np.arange(len(values)), one)
    weight = 1 / np.maximum(u[rest], 1e-300) ** 2
    off = values[rest] - weight @ values[rest] / weight.sum()
    return bool(len(rest) > 1 and stats.f.sf(weight @ off**2 / (len(rest) - 1), len(rest) - 1, dof) > ALIKE)


def _rejected(seen: _Seen, most: float) -> tuple[np.ndarray, np.ndarray]:
    """By image of the network: weighted squares of rejected image points, no coordinate more than so much, squared, and their number."""
    network = seen.adjustment.network
    rows = ~seen.adjustment.used & np.isfinite(seen.adjustment.residual_px).all(axis=1)
    rows &= network.camera_of[network.image] == seen.camera
    white = np.einsum("nij,nj->ni", whitening(network.covariance_px2[rows]), seen.adjustment.residual_px[rows])
    squares, count = np.minimum(white**2, most**2).sum(axis=1), np.full(rows.sum(), 2.0)
    image, images = network.image[rows], len(network.images)
    return np.bincount(image, squares, images), np.bincount(image, count, images)


def _image_rms(seen: _Seen, images: np.ndarray) -> _Tested:
    """Bartlett's test of equal variances, with the redundancy of each image (Proc. R. Soc. A 160 (1937) 268–282)."""
    from scipy import stats

    squares = seen.terms.whitened_squares()[seen.mine]
    place = np.searchsorted(images, seen.image)
    total = np.bincount(place, squares)
    dof = np.bincount(place, redundancy_of(seen.adjustment)[seen.terms.rows[seen.mine]].sum(axis=1))
    good = (dof > 2) & (total > 0)
    total, dof = total[good], dof[good]
    pooled = total.sum() / dof.sum()
    statistic = dof.sum() * np.log(pooled) - np.sum(dof * np.log(total / dof))
    correction = 1 + (np.sum(1 / dof) - 1 / dof.sum()) / (3 * (len(dof) - 1)) if len(dof) > 1 else 1.0
    p = float(stats.chi2.sf(statistic / correction, len(dof) - 1)) if len(dof) > 1 else 1.0
    residual_px = seen.adjustment.residual_px[seen.terms.rows[seen.mine]]
    rms_px = np.sqrt(np.stack([np.bincount(place, axis**2) / np.bincount(place) for axis in residual_px.T], axis=1))[good]
    found = seen.tested("image_rms", float(rms_px.max()), None, p)
    middle = float(np.median(np.sqrt(total / dof)))
    squares, coordinates = (part[images[good]] for part in _rejected(seen, WORST * middle))
    total, dof = total + squares, dof + coordinates
    rms = np.sqrt(total / dof)
    out = np.flatnonzero(rms > OUTSTANDING * middle)
    rest = np.setdiff1d(np.arange(len(dof)), out)
    out = out[stats.f.sf(rms[out] ** 2 / (total[rest].sum() / dof[rest].sum()), dof[out], dof[rest].sum()) < RARE / len(dof)]
    if 0 < len(out) <= len(dof) / FEW_OF:
        out = out[np.argsort(-rms[out])]
        names = tuple(seen.adjustment.network.images[i] for i in images[good][out])
        rejected = (coordinates[out] / 2).astype(int).tolist()
        outstanding = Outstanding(names, rms_px[out].tolist(), rejected, (rms[out] / middle).tolist())
        return replace(found, pattern=replace(found.pattern, outstanding=outstanding))
    return found
