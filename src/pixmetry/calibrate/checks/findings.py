"""Findings of a calibration in sentences, most important first."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from pixmetry.calibrate.bundle.eccentric import Eccentricity
from pixmetry.calibrate.bundle.network import Adjustment, Network
from pixmetry.calibrate.checks.hold_out import WORSE
from pixmetry.calibrate.checks.known_checks import mostly_lost
from pixmetry.calibrate.checks.parts import halves_findings, shared_findings
from pixmetry.calibrate.checks.quality import p_words, plain
from pixmetry.calibrate.records import (
    Contradicted,
    ContradictedControl,
    FTest,
    GrossError,
    HoldOut,
    ImageRecord,
    KnownGroup,
    KnownRecord,
    ParameterTest,
    Tests,
)
from pixmetry.core.arrays import Array
from pixmetry.core.finding import LEVELS, Finding

MISFIT_PX, MISFIT_U = 1.0, 6.0  # rms of residuals, and over the stated uncertainty, from which both say that nothing was calibrated
MISFIT_LOST = 0.3  # share of the image coordinates left out that says so
ORDER = (  # of kinds, among findings of the same level; what is not named here comes between the two parts
    "misfit",
    "start", "determination", "images_left_out", "x_scale_drift", "bad_images", "images_rejected", "correlation", "flatness", "lost_points",
    "known_untested", "gross_scale_bar", "gross_control_point", "lost_control",
    "x_shift", "halves", "shared_errors", "field", "known_uncertainty", "eccentricity", "f_test", "gross_error", None,
    "two_rays", "significance", "variance_components", "residual_grid", "hold_out", "datum", "adjustment",
)  # fmt: skip
SIGNIFICANT = 0.05
RARE = 0.001  # level of tests that were not asked for
CORRELATED = 0.995
THROUGHOUT = 0.5  # of the images of two points: where their names are exchanged in more, it is not these images that are wrong
REJECTED_SHARE = 0.5  # of the image points of an image: it is not single ones that are wrong
TWO_RAY_SHARE = 0.1  # of the free points: those on two rays are worth a sentence
NOTEWORTHY_PX = 0.002  # an eccentricity of this size is worth a sentence
NAMED = 5
LEAST_NOTES = 2
MOST_PATTERNS = 4
MOST = 8  # findings in all, unless there are more warnings
RADIAL = frozenset(("k1", "k2", "k3", "k4", "k5", "d1", "d2", "d3"))


def in_order(findings: Iterable[Finding]) -> tuple[Finding, ...]:
    """Errors and warnings first; then by what matters most for the result, notes no more than a few. The same sentence is said once."""
    rank = {kind: i for i, kind in enumerate(ORDER)}
    unique = dict.fromkeys(findings)
    ordered = sorted(unique, key=lambda f: (-LEVELS.index(f.level), rank.get(f.kind, rank[None])))
    warnings = sum(f.level != "note" for f in ordered)
    return tuple(ordered[: max(MOST, warnings + LEAST_NOTES)])


def findings_of(adjustment: Adjustment, tests: Tests) -> list[Finding]:
    """Findings from the records of one adjustment."""
    images = tests.images or ()
    found = [
        *known_findings(tests.known or KnownRecord(), adjustment.network.unit),
        *lost_control_findings(adjustment),
        *rejected_image_findings(images),
        *lost_findings(adjustment),
        *two_ray_findings(adjustment),
        *parameter_findings(tests.parameters or ()),
        *f_test_findings(tests.f_test or {}),
        *gross_error_findings(tests.gross_errors or (), adjustment, images),
        *drift_findings(images, adjustment),
        *halves_findings(tests.halves or {}),
        *shared_findings(tests.shared_errors or {}),
        Finding("datum", f"Datum: {adjustment.datum}."),
    ]
    return found + [Finding("adjustment", note if note.endswith(".") else f"{note}.") for note in adjustment.notes]


def in_the_shadow(patterns: Iterable[Finding]) -> list[Finding]:
    """The findings on patterns in the residuals, the further ones in one sentence; beside a drift of the x-scale all others are further."""
    from pixmetry.calibrate.checks.patterns import MEANING

    found = list(patterns)
    drift = [f for f in found if f.kind == "x_scale_drift"]
    bad = [replace(f, level="note" if drift else f.level) for f in found if f.kind == "bad_images"]
    others = [f for f in found if f.kind not in ("x_scale_drift", "bad_images")]
    shown = 0 if drift else MOST_PATTERNS
    out = [*drift, *bad, *others[:shown]]
    if len(others) > shown:
        what = "; ".join(dict.fromkeys(MEANING[f.kind][0] for f in others[shown:]))
        if drift:
            text = f"There are other patterns, which the drift of the x-scale alone can cause: {what}."
            out.append(Finding("pattern", text, "Estimate an x-scale for each image, and check again."))
        else:
            out.append(
                Finding(
                    "pattern",
                    f"Residuals show further patterns, with less certainty: {what}.",
                    "Remove the causes of the other patterns first.",
                )
            )
    return out


def parameter_findings(parameters: Sequence[ParameterTest]) -> list[Finding]:
    """Parameters that are not significant, and pairs that cannot be separated."""
    found = []
    for camera in dict.fromkeys(p.camera for p in parameters):
        mine = [p for p in parameters if p.camera == camera]
        weak = [f"{p.name} (p = {p.p_zero:.2f})" for p in mine if p.p_zero is not None and p.p_zero > SIGNIFICANT]
        if weak:
            verb = "is" if len(weak) == 1 else "are"
            text = f"{camera}: {', '.join(weak)} {verb} not significantly different from 0."
            advice = f"Leave {'it out' if len(weak) == 1 else 'them out, one at a time'}, unless other calibrations of this camera need it."
            found.append(Finding("significance", text, advice))
        for a, b, r in _pairs(mine):
            text = f"{camera}: {a} and {b} are completely correlated (r = {r:+.4f}); only their combined effect is determined."
            found.append(Finding("correlation", text, f"Fix one of {a} and {b}, or add images that separate them.", "warning"))
    return found


def _pairs(parameters: Sequence[ParameterTest]) -> list[tuple[str, str, float]]:
    """Pairs with a correlation of almost 1; radial terms among themselves are always close."""
    pairs = {}
    for p in parameters:
        strongest = p.strongest
        if strongest is None or abs(strongest.r) < CORRELATED or {p.name, strongest.with_} <= RADIAL:
            continue
        pairs[frozenset((p.name, strongest.with_))] = (p.name, strongest.with_, strongest.r)
    return list(pairs.values())


def f_test_findings(f_tests: Mapping[str, FTest]) -> list[Finding]:
    """Cameras whose x is noisier than y."""
    found = []
    for camera, test in f_tests.items():
        if test.p_px < RARE:
            advice = "Look for a cause along the rows: line jitter, the grabber's clock, or motion."
            found.append(Finding("f_test", f"{camera}: {test.text}.", advice, "warning"))
    return found


def mostly_rejected(images: Sequence[ImageRecord]) -> list[ImageRecord]:
    """Records of the images that lost more than half of their image points as gross errors."""
    return [i for i in images if i.rejected > REJECTED_SHARE * i.measured]


def misfit_findings(adjustment: Adjustment, covariance_px2: Array) -> list[Finding]:
    """That image coordinates of targets in pictures do not fit the camera: numbers of targets, or what was said of the field, are wrong.

    ``covariance_px2``, shape (n, 3): as they were measured.
    """
    used = adjustment.used & np.isfinite(adjustment.residual_px).all(axis=1)
    if not used.any():
        return []
    rms_px = float(np.sqrt((adjustment.residual_px[used] ** 2).mean()))
    u_px = float(np.sqrt(np.median(covariance_px2[used][:, [0, 2]])))
    lost = float(1 - used.mean())
    if not (rms_px > MISFIT_PX and rms_px > MISFIT_U * u_px) and lost < MISFIT_LOST:
        return []
    size = f"{plain(rms_px, 3)} px rms, {plain(rms_px / u_px, 2)} times their uncertainty"
    what = f"the image coordinates of the targets miss the camera by {size}"
    if lost >= MISFIT_LOST:
        what = f"{100 * lost:.0f} % of the image coordinates of the targets do not fit the camera and were left out"
    text = f"This is no calibration: {what}. Targets were numbered wrongly, or the field is not as stated."
    advice = (
        "Check kind, grid and pitch against the field, and the pictures for parts of another field; "
        "if they are right, the lens is of another model than this one (a fisheye), or the field bends from picture to picture."
    )
    numbers = {"rms_px": rms_px, "u_px": u_px, "left_out_share": lost}
    return [Finding("misfit", text, advice, "error", numbers)]


def rejected_image_findings(images: Sequence[ImageRecord]) -> list[Finding]:
    """Images most of whose image points were rejected: it is hardly the points that are wrong."""
    found = mostly_rejected(images)
    if not found:
        return []
    advice = "Check the camera of these images and the names of their points. If both are right, the images are poor: leave them out."
    if len(found) == 1:
        advice = "Check its camera and the names of its points. If both are right, the image is poor: leave it out."
        text = f"Image {found[0].image}: {found[0].rejected} of {found[0].measured} image points were rejected."
    else:
        named = ", ".join(f"{i.image} ({i.rejected} of {i.measured})" for i in found[:NAMED])
        more = " …" if len(found) > NAMED else ""
        text = f"More than half of the image points of {len(found)} images were rejected: {named}{more}."
    return [Finding("images_rejected", text, advice, "warning")]


def gross_error_findings(errors: Sequence[GrossError], adjustment: Adjustment, images: Sequence[ImageRecord]) -> list[Finding]:
    """Image points that were left out, and what else of the image points took no part."""
    if not errors:
        return []
    network, total = adjustment.network, len(adjustment.used)
    bad = {i.image for i in mostly_rejected(images)}
    single = [e for e in errors if e.image not in bad] or errors
    names = [f"{e.point} in {e.image} ({plain(np.hypot(e.error_x_px, e.error_y_px), 2)} px)" for e in single[:NAMED]]
    more = " …" if len(single) > NAMED else ""
    noun = "image point was left out as a gross error" if len(errors) == 1 else "image points were left out as gross errors"
    text = f"{len(errors)} {noun}, of {total}: {', '.join(names)}{more}.{_swapped_names(errors, network)}"
    posed = adjustment.state.posed[network.image]
    others = {"images that are not oriented": int((~posed).sum())}
    others["points that are not determined"] = total - int(adjustment.used.sum()) - len(errors) - others["images that are not oriented"]
    said = " and ".join(f"{count} of {what}" for what, count in others.items() if count)
    text += f" Not counted here, and not used: {said}." if said else ""
    many = len(errors) > 0.05 * total
    advice = "Check these targets in the images, and their names."
    if many:
        advice = "Check how targets are located and named: this many are not single mistakes."
    return [Finding("gross_error", text, advice, "warning" if many else "note")]


def _swapped_names(errors: Sequence[GrossError], network: Network) -> str:
    pairs = dict.fromkeys((e.image, *sorted((e.point, e.swapped_with))) for e in errors if e.swapped_with is not None)
    if not pairs:
        return ""
    often = Counter((a, b) for _, a, b in pairs)
    always = {pair for pair, count in often.items() if count > 1 and count > THROUGHOUT * _images_of_both(network, *pair)}
    said = [f"{a} and {b} in {often[a, b]} images, more likely in the table of points or in all images" for a, b in always]
    said += [f"{a} and {b} in {image}" for image, a, b in pairs if (a, b) not in always]
    return f" Names seem to be swapped: {'; '.join(said[:NAMED])}{'; …' if len(said) > NAMED else ''}."


def _images_of_both(network: Network, a: str, b: str) -> int:
    one, other = (network.image[network.point == network.points.index(name)] for name in (a, b))
    return len(np.intersect1d(one, other))


def two_ray_findings(adjustment: Adjustment) -> list[Finding]:
    """Points on which one test in two is blind, where they are more than a few."""
    network = adjustment.network
    rays = np.bincount(network.point[adjustment.used], minlength=len(network.points))
    free = ~np.isfinite(network.u_xyz).all(axis=1) & (rays > 0)
    two = int((free & (rays == 2)).sum())
    if two <= TWO_RAY_SHARE * free.sum():
        return []
    text = (
        f"{two} of {int(free.sum())} points are determined by two rays only: an error of an image point along the epipolar line "
        "cannot be detected."
    )
    return [Finding("two_rays", text, "If such a point matters, measure it in a third image.")]


def lost_findings(adjustment: Adjustment) -> list[Finding]:
    """Points that two oriented images or more see, of which nothing is left: of a few rays that contradict each other none can be said
    to be right."""
    network = adjustment.network
    posed = adjustment.state.posed[network.image]
    rays = np.bincount(network.point[posed], minlength=len(network.points))
    lost = np.flatnonzero((rays >= 2) & ~adjustment.state.located)
    if not len(lost):
        return []
    named = ", ".join(network.points[k] for k in lost[:NAMED]) + (" …" if len(lost) > NAMED else "")
    few, verb = ("1 point", "is") if len(lost) == 1 else (f"{len(lost)} points", "are")
    text = f"{few} that two images or more see {verb} not determined: {named}. Too few image points are left that agree with each other"
    ends = np.isin(network.bars.start, lost) | np.isin(network.bars.end, lost)
    if ends.any():
        text += f"; with them go {ends.sum()} of {len(ends)} scale bars"
    advice = "Look at these points in their images: with so few rays it is not clear which one is wrong. One more ray decides."
    return [Finding("lost_points", f"{text}.", advice, "warning")]


def known_findings(known: KnownRecord, unit: str) -> list[Finding]:
    """Bars and control points that the network contradicts, or against which it could not be tested."""
    found = []
    if known.untested:
        text = f"Neither control points nor scale bars could be tested: without them {known.untested}."
        advice = "If one of them is wrong, image points were left out instead: check the values where many are left out."
        found.append(Finding("known_untested", text, advice, "warning"))
    for record, noun, factor in (
        (known.scale_bars, "scale bar", None),
        (known.control_points, "control point", known.control_points.understated),
    ):
        found += [_gross_finding(gross, noun, unit) for gross in _once(record.gross)[:NAMED]]
        group = record.group
        if factor:
            text = (
                f"The {noun}s miss the network by about {factor:.2g} times their stated uncertainties. The uncertainties were "
                "multiplied by this factor."
            )
            found.append(Finding("known_uncertainty", text, "Correct their uncertainties.", "warning"))
        elif group and group.p < RARE and (group.factor > 1 or not record.gross):
            found.append(_group_finding(group, noun))
    fixed = known.fixed_points
    if fixed and fixed.p < RARE:
        miss = plain(fixed.miss, 2)
        text = f"The {fixed.n} fixed points miss the network by about {miss} {unit} together ({p_words(fixed.p)})."
        advice = f"Look for a mistake in their coordinates. If there is none, they are not exact: known: weighted with u = {miss} {unit}."
        found.append(Finding("known_uncertainty", text, advice, "warning"))
    return found


def _swap_of(one: Contradicted) -> str | None:
    return one.swapped_with if isinstance(one, ContradictedControl) else None


def _once(records: Sequence[Contradicted]) -> list[Contradicted]:
    """Of points that exchanged their names, the first coordinate; all others."""
    swapped: set[str] = set()
    out = []
    for record in records:
        point = record.name.rpartition(" ")[0] if _swap_of(record) else ""
        if not point or point not in swapped:
            out.append(record)
        swapped.add(point)
    return out


def _gross_finding(gross: Contradicted, noun: str, unit: str) -> Finding:
    text = f"The {noun} {gross.name} does not agree with the network: it seems wrong by {gross.error:+.4g} {unit}"
    text += f" (test {gross.statistic:.1f}, critical {gross.critical:.1f})."
    if _swap_of(gross):
        text += f" It lies where {_swap_of(gross)} should be: their names seem to be swapped in the table of points."
    advice = f"Check its value, its unit and the names of its points; {_what_was_done(gross)}."
    return Finding(f"gross_{noun.replace(' ', '_')}", text, advice, "warning")


def _what_was_done(gross: Contradicted) -> str:
    if gross.left_out:
        return "it was left out"
    others = gross.rivals
    if not others:
        return "with so few it is not clear which one is wrong, and its weight was reduced"
    named = ", ".join(others[:NAMED]) + (" …" if len(others) > NAMED else "")
    return f"it is not clear whether it is wrong or {'one of ' if len(others) > 1 else ''}{named}, and their weights were reduced"


def _group_finding(group: KnownGroup, noun: str) -> Finding:
    """A group with another scatter than stated; outliers are named before new uncertainties for all."""
    text = f"The {noun}s scatter {np.sqrt(group.factor):.2g} times as much as their stated uncertainties."
    if group.factor <= 1:
        return Finding("known_uncertainty", text, "Correct their uncertainties.", "note")
    largest = "; ".join(f"{one.name}, {abs(one.ratio):.2g} u" for one in group.largest)
    advice = f"Check the largest first: {largest}. If they are right, correct the uncertainties."
    return Finding("known_uncertainty", text, advice, "warning")


def lost_control_findings(adjustment: Adjustment) -> list[Finding]:
    """Known points that nevertheless lost most of their image points."""
    network = adjustment.network
    lost, seen, out = mostly_lost(network, adjustment)
    if not len(lost):
        return []
    named = ", ".join(f"{network.points[k]} ({m} of {n})" for k, n, m in list(zip(lost, seen, out, strict=True))[:NAMED])
    more = " …" if len(lost) > NAMED else ""
    text = f"Most image points of {len(lost)} known point{'s' if len(lost) > 1 else ''} were rejected: {named}{more}."
    advice = "Check their coordinates and names in the table of points before those in the images."
    return [Finding("lost_control", text, advice, "warning")]


def drift_findings(images: Sequence[ImageRecord], adjustment: Adjustment) -> list[Finding]:
    """Findings on the x-scales and x-shifts of the images, if they were estimated."""
    from scipy import stats

    found = []
    scales = [(i.camera, i.x_scale, i.u_x_scale) for i in images]
    shifts = [(i.camera, i.x_shift_px, i.u_x_shift_px) for i in images]
    for key, unit, factor, own in (("x_scale", "ppm", 1e6, scales), ("x_shift_px", "px", 1.0, shifts)):
        for camera in dict.fromkeys(i.camera for i in images):
            mine = [(value, u) for name, value, u in own if name == camera and value is not None and u]
            if len(mine) < 2:
                continue
            value, u = np.array(mine).T
            p = stats.f.sf((value**2 / u**2).sum() / (len(mine) - 1), len(mine) - 1, adjustment.dof)
            low, high, middle = value.min() * factor, value.max() * factor, float(np.median(u)) * factor
            spread = f"from {low:+.3g} to {high:+.3g} {unit} (u of one: {middle:.2g} {unit})"
            if p < SIGNIFICANT:
                text = f"{camera}: the images' {_words(key)} run {spread}, {p_words(p)}: they are needed."
                found.append(Finding(_kind(key), text))
            else:
                text = f"{camera}: the images' {_words(key)} are not significant ({spread}, {p_words(p)})."
                found.append(Finding("significance", text, f"Calibrate without them ({key.removesuffix('_px')} in per_image)."))
    return found


def _words(key: str) -> str:
    return "x-scales" if key == "x_scale" else "x-shifts"


def _kind(key: str) -> str:
    return "x_scale_drift" if key == "x_scale" else "x_shift"


def eccentricity_findings(measured: Network, found: Eccentricity) -> list[Finding]:
    """What was corrected, and what could not be."""
    out = []
    if found.possible_px > NOTEWORTHY_PX:
        text = f"Targets of known size but unknown normal were not corrected for eccentricity; it could reach {found.possible_px:.3g} px."
        level = "warning" if found.possible_px**2 > float(np.median(measured.covariance_px2[:, [0, 2]])) else "note"
        out.append(Finding("eccentricity", text, "Give the normals of the targets.", level))
    if found.largest_px > NOTEWORTHY_PX:
        count = int(found.corrected.sum())
        out.append(Finding("eccentricity", f"{count} image points were corrected for eccentricity, by up to {found.largest_px:.3g} px."))
    return out


def hold_out_findings(record: HoldOut | None, *, free: bool) -> list[Finding]:
    """Images left out that fit much worse than those of the fit, and than noise explains: with the field's points free or not."""
    one = None if record is None else record.free if free else record.fixed
    expected = None if record is None else record.expected_median_px
    if one is None or expected is None or one.left_out_median_px < WORSE * expected:
        return []
    text = (
        f"Images left out of the fit show {plain(one.left_out_rms_px, 3)} px, those in it {plain(one.fit_rms_px, 3)} px (rms). "
        f"Half of the former are above {plain(one.left_out_median_px, 3)} px; with noise alone it would be {plain(expected, 3)} px."
    )
    return [Finding("hold_out", text, "Take more images or fewer parameters.", "warning")]
