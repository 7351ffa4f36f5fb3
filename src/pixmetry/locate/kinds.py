"""What is done for each kind of target: detected, measured, and put into columns with a note on what was chosen."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from pixmetry.core.errors import InputError
from pixmetry.locate.detect.blocks import Coder, coder_of
from pixmetry.locate.detect.limits import Limits, detect_within
from pixmetry.locate.detect.targets import Flag, LeftOut, Positions, Targets
from pixmetry.locate.estimator import Settings
from pixmetry.locate.estimators import BLOB_TEXT, D4SIGMA, SPOTS, are_beams, chosen_estimator, methods, seen_shape
from pixmetry.locate.known_camera import KnownCamera
from pixmetry.locate.lines.line_candidates import LineCandidates
from pixmetry.locate.noise import ROUNDING_DN2, NoiseModel
from pixmetry.locate.noise_correlation import with_correlation, with_own_residuals
from pixmetry.locate.records import LAST

WITH_ARTICLE = {"disc": "a disc", "ellipse": "an ellipse", "ring": "a ring", "spot": "a spot"}
UNSETTLED = "the fit did not converge"
NO_BEAM = "no beam of its own: a lobe of another one, one that fills the frame, or its moments did not come to rest"
FAINTEST_BEAM = 0.1  # height of a beam over that of the frame's strongest
TEMPLATES = ("template", "poisson_gaussian")  # estimators that can do without some pixels
ROWS_ARE = ("asymmetric", "hexagonal")  # every other one shifted by half a step
FAINTEST = 0.05  # height of lines and edges over that of the frame's strongest
LEAST_WAVE_DN = 1.0  # height of the waves that a coder draws, from which one may pass for a slope


class Wanted(NamedTuple):
    """What is asked for of a grid: columns and rows, where they are known, and how the rows lie."""

    size: tuple[int, int] | None
    rows_are: str  # "", "asymmetric", "hexagonal"


@dataclass(frozen=True)
class Task:
    """One frame and the options of `locate` for it."""

    frame: np.ndarray
    kind: str
    estimator: str
    polarity: str
    grid: Wanted | None
    noise: NoiseModel | None
    low_dn: float
    high_dn: float
    aperture_px: float
    light_on: str
    threads: int | None
    planes: str | bool = "auto"
    limits: Limits = Limits()
    unit_dn: float = 1.0  # of the frame's grey values here, where they were made of another size for the arithmetic
    known: KnownCamera | None = None
    defects: np.ndarray | None = None  # bool, shape of the frame: pixels that it shows mended
    jpeg_steps: np.ndarray | None = None  # of the quantiser, shape (8, 8), where the frame is from a JPEG file
    segments: int = 12  # of the rings of coded targets


class Measured(NamedTuple):
    """What is known of a frame: columns, with a row a target; notes on what was chosen; and what was seen and is no row."""

    columns: dict[str, np.ndarray]
    notes: dict[str, Any]
    left_out: LeftOut = LeftOut.of()


class Spots(NamedTuple):
    """Targets that are regions, as they were detected in a frame, and what their measurement needs besides."""

    targets: Targets
    regions: Targets  # all that were seen, of any shape, whole or not
    noise: NoiseModel
    seen: str  # shape of the template that suits them
    why: str
    polarity: str
    left_out: LeftOut
    ground: str  # "dark" or "bright" where targets cover the frame: the parts of it that were taken as their ground
    coder: Coder | None
    blanked: bool  # whether known targets cover so much that no faint ones were looked for


class Seen(NamedTuple):
    """Regions of any shape as they were detected in a frame."""

    regions: Any  # Regions, whole ones
    seen: Any  # Regions, also those that a region of interest cuts
    left_out: LeftOut
    polarity: str
    ground: str  # as of `Spots`
    coder: Coder | None
    blanked: bool


def find_regions(task: Task) -> Seen:
    """Detect what a frame shows."""
    from pixmetry.locate.detect.detection import Detection, detect

    coder = coder_of(task.frame) if task.jpeg_steps is None else Coder(0, 0, task.jpeg_steps)

    def look(part: np.ndarray, top: int, left: int) -> Detection:
        return detect(
            part,
            polarity=task.polarity,
            high_dn=task.high_dn,
            low_dn=task.low_dn,
            threshold_sigma=task.limits.threshold_sigma,
            false_alarms=task.limits.false_alarms,
            coder=None if coder is None else coder.within(top, left),
            threads=task.threads,
        )

    found = detect_within(task.frame, task.limits, look)
    polarity = found.polarities.pop() if len(found.polarities) == 1 else "both"
    return Seen(found.targets, found.seen, found.left_out, polarity, " and ".join(sorted(found.grounds)), coder, found.blanked)


def find_spots(task: Task, found: Seen | None = None) -> Spots:
    """Detect the targets of a frame that have the shape of the kind, and take the noise that is given, or that the frame shows."""
    from pixmetry.locate.detect.detection import seen_at, select

    found = find_regions(task) if found is None else found
    seen_ones, left_out = found.regions, found.left_out
    shape = "ellipse" if task.kind == "coded" else task.kind
    fits = select(seen_ones, shape)
    targets = seen_ones[fits]
    left_out = LeftOut.joined([left_out, seen_at(seen_ones[~fits], f"not the shape of {WITH_ARTICLE[shape]}")])
    seen, why = seen_shape(shape, targets)
    noise = _noise_for(task, seen, targets)  # with the targets' own shape, whatever measures them: what it does not explain is noise
    polarity = found.polarity if len(targets) else "none found"
    return Spots(targets, found.seen, noise, seen, why, polarity, left_out, found.ground, found.coder, found.blanked)


def locate_spots(task: Task) -> Measured:
    """Targets that are regions: discs, ellipses, rings, spots, with or without a code, on a plate or not."""
    found = find_regions(task)
    if task.kind == "spot" and (task.estimator == D4SIGMA or (task.estimator == "auto" and are_beams(found.regions))):
        return locate_beams(task, found)
    targets, regions, noise, seen, why, polarity, left_out, ground, coder, blanked = find_spots(task, found)
    shape = "ellipse" if task.kind == "coded" else task.kind
    estimator, reason = task.estimator, "as was asked for"
    if estimator == "auto":
        shape = seen
        estimator, reason = chosen_estimator(targets, noise, why)
    planes = False if task.kind == "coded" else task.planes  # the rings would pass for slopes
    if planes == "auto" and coder is not None and coder.pattern_dn > LEAST_WAVE_DN:
        planes = "shared"  # a wave of the coder over one target would pass for a slope
    settings = Settings(shape, planes, task.light_on, task.aperture_px, task.threads)
    positions = methods()[estimator].positions(_without_defects(task, estimator), targets, noise, settings)
    positions = _with_defects_flagged(task, targets, positions)
    shared = None if task.known is None else task.known.correlation_at(float(np.median(task.frame)))
    rows, cols = task.frame.shape
    boxes, fitted = task.limits.boxes((rows, cols)), estimator == "template"
    positions, wider, why_wider = with_correlation(
        task.frame, regions, targets, positions, noise, shape, task.aperture_px, coder, shared, boxes, fitted=fitted
    )
    positions = with_own_residuals(task.frame, targets, positions, noise, shape, task.aperture_px)
    columns = _columns(positions, estimator if shape == task.kind else f"{estimator} ({shape})", noise)
    notes = _notes(task, estimator, reason, noise, polarity)
    if wider != 1.0:
        notes["noise_model"] += f"; {why_wider}, u × {wider:.2f}"
    if ground:
        taken = f"its {ground} parts were taken as the ground"
        notes["ground"] = f"targets cover much of the frame; {taken}, and faint targets were not looked for"
    elif blanked:
        notes["ground"] = "the targets cover more than 40 % of the frame; fainter ones than theirs were not looked for"
    settled, whole = settled_ones(positions), np.ones(len(positions), bool)
    if task.kind == "coded":
        columns, whole, caution = _coded(task, positions, columns)
        notes |= {"rings": caution} if caution else {}
    if task.grid is not None:
        from pixmetry.locate.detect.grids import order_grid

        placed = order_grid(
            positions.x_px,
            positions.y_px,
            pattern=task.grid.size,
            asymmetric=task.grid.rows_are == "asymmetric",
            hexagonal=task.grid.rows_are == "hexagonal",
        )
        columns = beside(columns, grid_col=placed.col, grid_row=placed.row)
        count = f"{int(placed.placed[settled].sum())} of {int(settled.sum())} targets placed"
        notes["grid"] = placed.message or f"{placed.cols} x {placed.rows}, {count}"
    return _wanted_ones(task, targets, (settled, whole), Measured(columns, notes, left_out), UNSETTLED)


def _without_defects(task: Task, estimator: str) -> np.ndarray:
    """The frame as an estimator takes it: templates do without the pixels that are defect, others take what mends them."""
    if task.defects is None or not estimator.startswith(TEMPLATES):
        return task.frame
    frame = task.frame.astype(np.float32)
    frame[task.defects] = np.nan
    return frame


def _with_defects_flagged(task: Task, targets: Targets, positions: Positions) -> Positions:
    """Targets with defect pixels within their outline or their light are flagged."""
    if task.defects is None:
        return positions
    row, col = np.nonzero(task.defects)
    reach = 2 * np.nan_to_num(targets.blur_px, nan=1.0) + 1
    inside = (row >= (targets.row_first - reach)[:, None]) & (row < (targets.row_stop + reach)[:, None])
    inside &= (col >= (targets.col_first - reach)[:, None]) & (col < (targets.col_stop + reach)[:, None])
    hit = np.where(inside.any(axis=1), np.uint32(Flag.DEFECT), np.uint32(0))
    return replace(positions, flags=positions.flags | hit)


def _wanted_ones(task: Task, targets: Targets, usable: tuple[np.ndarray, np.ndarray], found: Measured, unsettled: str) -> Measured:
    """The rows that are wanted; all targets were measured, for each is another's neighbour. ``usable``: settled, and no part of one."""
    from pixmetry.locate.detect.detection import seen_at

    settled, whole = usable
    columns = _with_grid_scatter(found.columns, found.notes)
    index, others, place = task.limits.wanted(targets, task.frame.shape)
    good = (whole & settled)[index]
    left_out = LeftOut.joined([found.left_out, others, seen_at(targets[index[(whole & ~settled)[index]]], unsettled)])
    if place is not None:
        numbers = np.full(len(settled), -1)
        numbers[index] = place
        columns = beside(columns, place=numbers)
    return Measured(_only(columns, index[good]), found.notes, left_out)


def locate_blobs(task: Task) -> Measured:
    """Regions of any shape."""
    from pixmetry.locate.centroids.light_moments import blob_positions

    found_regions = find_regions(task)
    targets, left_out, polarity = found_regions.regions, found_regions.left_out, found_regions.polarity
    noise = _smooth_noise(task, targets)
    positions = blob_positions(task.frame, targets, noise, threads=task.threads)
    positions = _with_defects_flagged(task, targets, positions)
    notes = _notes(task, "light_centroid", BLOB_TEXT, noise, polarity if len(targets) else "none found")
    found = Measured(_columns(positions, "light_centroid", noise), notes, left_out)
    return _wanted_ones(task, targets, (settled_ones(positions), np.ones(len(targets), bool)), found, UNSETTLED)


def locate_beams(task: Task, found: Seen) -> Measured:
    """Spots as beams, with their widths and azimuth."""
    from pixmetry.locate.centroids.light_moments import beam_positions
    from pixmetry.locate.detect.detection import seen_at

    height = np.abs(found.regions.amplitude_dn)
    strong = height >= FAINTEST_BEAM * height.max(initial=0.0)
    faint = seen_at(found.regions[~strong], f"lower than 1/{1 / FAINTEST_BEAM:.0f} of the strongest")
    targets = found.regions[strong]
    noise = _smooth_noise(task, targets)
    positions = beam_positions(task.frame, targets, noise, aperture_px=task.aperture_px, threads=task.threads)
    positions = _with_defects_flagged(task, targets, positions)
    settled = settled_ones(positions)
    reason = "as was asked for" if task.estimator == D4SIGMA else "the spots are large or elliptic: beams, with widths by ISO 11146"
    notes = _notes(task, D4SIGMA, reason, noise, found.polarity if settled.any() else "none found")
    measured = Measured(_columns(positions, D4SIGMA, noise), notes, LeftOut.joined([found.left_out, faint]))
    return _wanted_ones(task, targets, (settled, np.ones(len(targets), bool)), measured, NO_BEAM)


def _smooth_noise(task: Task, targets: Targets) -> NoiseModel:
    """The given noise model, or that of the image where its targets have no shape that is known."""
    from pixmetry.locate.centroids.light_moments import beam_noise

    own = beam_noise(task.frame, targets) if task.noise is None else task.noise
    return replace(own, low_dn=max(task.low_dn, own.low_dn), high_dn=min(task.high_dn, own.high_dn))


def locate_lines(task: Task) -> Measured:
    """Lines, edges, and crosses of two lines."""
    from pixmetry.locate.lines.line_detection import find_edges, find_lines

    if task.kind == "edge":
        found = find_edges(task.frame, noise=task.noise, threads=task.threads)
    else:
        found = find_lines(task.frame, polarity=task.polarity, noise=task.noise, threads=task.threads)
    height = np.abs(found.amplitude_dn)
    real = height >= FAINTEST * height.max(initial=0.0)  # beside a strong one, what a coder or a halo draws is no line
    left_out = [_lines_at(found[~real], f"lower than 1/{1 / FAINTEST:.0f} of the strongest")]
    found = found[real]
    noise = _noise_for(task, task.kind, found.sigma_dn)
    estimator, reason = ("template", methods()["template"].text) if task.estimator == "auto" else (task.estimator, "as was asked for")
    if task.kind == "cross":
        from pixmetry.locate.lines.crosses import cross_positions, crossings

        crosses = crossings(found, task.frame.shape)
        positions = cross_positions(task.frame, crosses, noise, aperture_px=task.aperture_px, threads=task.threads)
        settled = settled_ones(positions)
        left_out.append(LeftOut.of(crosses.x_px[~settled], crosses.y_px[~settled], UNSETTLED))
    else:
        from pixmetry.locate.lines.lines import line_positions

        positions = line_positions(task.frame, found, noise, task.kind, estimator, aperture_px=task.aperture_px, threads=task.threads)
        settled = settled_ones(positions)
        left_out.append(_lines_at(found[~settled], UNSETTLED))
    columns = _only(_columns(_with_variance_factor(positions, noise), estimator, noise), settled)
    notes = _notes(task, estimator, reason if len(positions) else f"no {task.kind} was found", noise, _polarity(positions))
    return Measured(columns, notes, LeftOut.joined(left_out))


def _lines_at(lines: LineCandidates, reason: str) -> LeftOut:
    middle = 0.5 * (lines.x1_px + lines.x2_px), 0.5 * (lines.y1_px + lines.y2_px)
    return LeftOut.of(*middle, reason, 0.5 * lines.length_px, lines.amplitude_dn)


def _with_variance_factor(positions: Positions, noise: NoiseModel) -> Positions:
    """Covariances times the a posteriori variance factor (median χ²/dof) where the noise was measured in the image beside the targets.

    Noise that rises with the light is seen there only through the residuals. A noise model that was given stands as it is.
    """
    chi2 = positions.more.get("chi2_per_dof", np.empty(0))
    factor = max(1.0, float(np.nanmedian(chi2))) if noise.origin == "image" and np.isfinite(chi2).any() else 1.0
    scaled = {name: v * factor for name, v in positions.more.items() if name.startswith(("var_", "cov_"))}
    return replace(
        positions,
        var_x_px2=positions.var_x_px2 * factor,
        cov_xy_px2=positions.cov_xy_px2 * factor,
        var_y_px2=positions.var_y_px2 * factor,
        more={**positions.more, **scaled},
    )


def _polarity(positions: Positions) -> str:
    signs = np.sign(positions.more.get("amplitude_dn", np.empty(0)))
    return "none found" if not len(positions) else "bright" if (signs > 0).all() else "dark" if (signs < 0).all() else "both"


def locate_chessboard(task: Task) -> Measured:
    """Inner corners of a chessboard of a given size."""
    from pixmetry.locate.detect.background import background
    from pixmetry.locate.template.corners import chessboard_reach_px, find_chessboard, measured_corners

    assert task.grid is not None and task.grid.size is not None  # of a chessboard it is asked for
    found = find_chessboard(task.frame, task.grid.size)
    noise = _noise_for(task, "corner", background(task.frame, low_dn=task.low_dn, high_dn=task.high_dn, threads=task.threads).sigma_dn)
    reach = chessboard_reach_px(found) if len(found) else 0.0
    positions, noise = measured_corners(task.frame, found, reach, noise, aperture_px=task.aperture_px, threads=task.threads)
    columns = _columns(positions, "template", noise)
    reason = found.message or "two crossing edges, integrated over the pixel; at the Cramér–Rao bound"
    columns = beside(columns, grid_col=found.col, grid_row=found.row)
    settled = settled_ones(positions)
    left_out = LeftOut.of(found.x_px[~settled], found.y_px[~settled], UNSETTLED)
    notes = _notes(task, "template", reason, noise, "none found" if found.message else "both")
    return Measured(_with_grid_scatter(_only(columns, settled), notes), notes, left_out)


def _with_grid_scatter(columns: dict[str, np.ndarray], notes: dict[str, Any]) -> dict[str, np.ndarray]:
    """The columns with variances that hold how far the targets of a grid scatter, where this is more than was stated."""
    from pixmetry.locate.grid_scatter import grid_scatter

    if "grid_col" not in columns:
        return columns
    mean = 0.5 * (columns["var_x_px2"] + columns["var_y_px2"])
    found = grid_scatter(columns["x_px"], columns["y_px"], mean, columns["grid_col"], columns["grid_row"])
    if found is None:
        return columns
    notes["grid_scatter"] = f"{found.scatter_px:.2g} px against neighbours, {found.stated_px:.2g} px stated"
    if not found.added_px:
        return columns
    notes["grid_scatter"] += f"; {found.added_px:.2g} px added to the uncertainties"
    wider = {name: columns[name] + found.added_px**2 for name in ("var_x_px2", "var_y_px2")}
    flags = {"flags": columns["flags"] | np.uint32(Flag.GRID_SCATTER)}
    return beside(columns | wider | flags, grid_scatter_px=np.full(len(mean), found.added_px))


def _noise_for(task: Task, kind: str, targets: Targets | np.ndarray) -> NoiseModel:
    """The given noise model, with the ends of the scale; otherwise the noise of the image, at targets or from the spread beside them."""
    if task.noise is not None:
        given = replace(task.noise, low_dn=max(task.low_dn, task.noise.low_dn), high_dn=min(task.high_dn, task.noise.high_dn))
        if not isinstance(targets, Targets) or not len(targets):
            return given
        from pixmetry.locate.template.image_noise import row_shifts_from_image

        return row_shifts_from_image(task.frame, targets, given, kind, aperture_px=task.aperture_px, threads=task.threads)
    if isinstance(targets, Targets) and len(targets):
        from pixmetry.locate.template.image_noise import noise_from_image

        return noise_from_image(
            task.frame,
            targets,
            kind,
            low_dn=task.low_dn,
            high_dn=task.high_dn,
            aperture_px=task.aperture_px,
            threads=task.threads,
        )
    least = ROUNDING_DN2 if task.frame.dtype.kind == "u" else 1e-12
    sigma = 0.0 if isinstance(targets, Targets) or not len(targets) else float(np.median(targets))
    return NoiseModel(max(sigma**2, least), low_dn=task.low_dn, high_dn=task.high_dn, origin="image")


def _columns(positions: Positions, estimator: str, noise: NoiseModel) -> dict[str, np.ndarray]:
    n = len(positions)
    return {
        "target": np.arange(n),
        "x_px": positions.x_px,
        "y_px": positions.y_px,
        "var_x_px2": positions.var_x_px2,
        "cov_xy_px2": positions.cov_xy_px2,
        "var_y_px2": positions.var_y_px2,
        **positions.more,
        "estimator": np.full(n, estimator),
        "noise_model": np.full(n, noise.origin),
        "flags": positions.flags,
    }


def _notes(task: Task, estimator: str, reason: str, noise: NoiseModel, polarity: str) -> dict[str, Any]:
    return {"polarity": polarity, "estimator": estimator, "reason": reason, "noise_model": noise.times(task.unit_dn).describe()}


def _coded(task: Task, positions: Positions, columns: dict[str, np.ndarray]) -> tuple[dict[str, np.ndarray], np.ndarray, str]:
    """The columns with each target's code, and which targets are no segments of a ring; a target that was lost has the code −1.

    Last, a sentence where the targets rather have other rings.
    """
    from pixmetry.locate.detect.coded import other_rings, read_codes, ring_members

    x, y, more = positions.x_px, positions.y_px, positions.more
    major, minor, angle = more["semi_major_px"], more["semi_minor_px"], more["angle_deg"]
    ellipses = x, y, major, minor, angle, more["amplitude_dn"]
    codes = read_codes(task.frame, *ellipses, bits=task.segments, threads=task.threads)
    other, count = other_rings(task.frame, *ellipses, codes.number, task.segments, task.threads)
    read = int((codes.number >= 0).sum())
    caution = f"{count} targets have codes of {other}, {read} of RING_{task.segments}: ask for dictionary {other}" if other else ""
    whole = ~ring_members(x, y, major, minor, angle, codes.number)
    return beside(columns, code=codes.number, code_margin=codes.margin), whole, caution


def settled_ones(positions: Positions) -> np.ndarray:
    """Which positions may be used: those that are there, of fits that converged; shape (n,), bool."""
    there = np.isfinite(positions.x_px) & np.isfinite(positions.y_px) & np.isfinite(positions.var_x_px2) & np.isfinite(positions.var_y_px2)
    settled: np.ndarray = there & (positions.flags & np.uint32(Flag.NOT_CONVERGED) == 0)
    return settled


def _only(columns: dict[str, np.ndarray], which: np.ndarray) -> dict[str, np.ndarray]:
    """Some rows of the columns, numbered anew; by mask or index."""
    rows = {name: values[which] for name, values in columns.items()}
    return rows | {"target": np.arange(len(rows["x_px"]))}


def beside(columns: dict[str, np.ndarray], **more: np.ndarray) -> dict[str, np.ndarray]:
    """The columns with some more before the last three."""
    first = {name: values for name, values in columns.items() if name not in LAST}
    return {**first, **more, **{name: columns[name] for name in LAST}}


def in_units(found: Measured, unit_dn: float) -> Measured:
    """Heights, levels and slopes in units of the grey values that were given."""
    if unit_dn == 1:
        return found
    columns = {name: values * unit_dn if "_dn" in name else values for name, values in found.columns.items()}
    return found._replace(columns=columns, left_out=replace(found.left_out, amplitude_dn=found.left_out.amplitude_dn * unit_dn))


def wanted_grid(grid: str | tuple[int, int] | None, kind: str) -> Wanted | None:
    """Read what is said of a grid: its size, ``any``, and how its rows lie, as in ``9x6``, ``any``, ``hexagonal``, ``9x6:hexagonal``.

    Raises
    ------
    InputError
        If it is none, or targets of this kind form none.
    """
    if kind == "chessboard" and grid is None:
        raise InputError("the size of the chessboard is missing", where="grid", allowed="COLSxROWS of its inner corners, such as 9x6")
    if grid is not None and kind not in (*SPOTS, "chessboard"):
        raise InputError(f"targets of kind {kind} form no grid", where="grid", allowed="disc, ellipse, ring, spot, chessboard")
    if grid is None:
        return None
    if not isinstance(grid, str | Sequence | np.ndarray):
        raise InputError("not the size of a grid", where="grid", value=grid, allowed="COLSxROWS, such as 9x6, or (cols, rows)")
    text, _, rows_are = grid.lower().partition(":") if isinstance(grid, str) else ("", "", "")
    if text in ROWS_ARE:
        text, rows_are = "any", text
    if kind != "chessboard" and text == "any" and rows_are in ("", *ROWS_ARE):
        return Wanted(None, rows_are)
    try:
        size = tuple(text.split("x")) if isinstance(grid, str) else tuple(grid)
        cols, rows = (int(v) for v in size)
    except (TypeError, ValueError, OverflowError):
        cols = rows = 0
    if cols < 2 or rows < 2 or (rows_are and (kind == "chessboard" or rows_are not in ROWS_ARE)):
        allowed = "COLSxROWS, such as 9x6, both at least 2"
        if kind != "chessboard":
            allowed += "; or any; with :hexagonal or :asymmetric where every other row is shifted by half a step"
        raise InputError("not the size of a grid", where="grid", value=grid, allowed=allowed)
    return Wanted((cols, rows), rows_are)
