"""The same targets in light of several wavelengths: scale, place, blur and light of each, with and without a filter.

Targets are matched from band to band. The scale of the field by the wavelength is lateral colour; the blur by the wavelength is focus and,
in the infrared, charge that diffuses. Light with a filter over that without it, at one wavelength, is free of lamp and sensor.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from pixmetry.camera.colour_bands import ColourBands
from pixmetry.camera.stated import StatedFacts
from pixmetry.core.arrays import Array
from pixmetry.core.errors import MeasureError
from pixmetry.core.number import ONE_SIDED_95, Estimates
from pixmetry.core.threads import imap_tiles, single_threaded_blas
from pixmetry.locate.detect.targets import Flag
from pixmetry.locate.job import locate
from pixmetry.series.modes import field_motion
from pixmetry.series.track import FrameTargets, follow_targets
from pixmetry.sources.sensor.infrared_diffusion import InfraredDiffusion, transfer

USELESS = Flag.NOT_CONVERGED | Flag.BORDER
FULL = Flag.SATURATED | Flag.CLIPPED_AT_BLACK
INFRARED_NM = 700.0  # light above which is absorbed so deep that its charge diffuses
SIGNIFICANT, MISFIT = 3.0, 2.0
SIDE_PX, FINE = 48, 4  # of the picture of a disc with diffusion, and its points along a pixel
LENGTHS_UM = np.array([0.0, 2.0, 4.0, 7.0, 12.0, 20.0, 35.0, 60.0, 100.0])
LAMP_U = 0.003  # relative, of the light of a lamp from one band to the next, and of an exposure
PLATE_U = 0.1  # relative, of the variance of a defocused disc, which is no Gaussian blur
MODEL_U = 0.1  # relative, of the blur that a diffusion length makes, by the depth of the depleted layer and the shape of the template
RADIUS_U_PX = 0.005  # of a fitted disc, whose edge a response that bends moves by as much as it is blurred
COLOUR = "scale of the field of matched targets, or radius of one or two discs, over the wavelength; weighted straight line"
DEEPER = "light with a filter over that without it, at each wavelength; blur of the targets"
BLURRED = "blur of the targets in the infrared against that of visible light; a disc with diffusion is measured in the same way"
MOVED = "a lens that is focused anew, or targets that come nearer, between two bands scale the image as lateral colour does"
FOCUS = "a focus that depends on the wavelength (axial colour) blurs as diffusion does"


@dataclass(frozen=True)
class Band:
    """The frames of one band: places with covariances by frame, and of all targets in all frames blur, radius and light."""

    wavelength_nm: float
    name: str
    filtered: bool
    refocused: bool
    exposure_s: float
    frames: tuple[FrameTargets, ...]
    blur_var: Array
    radius: Array
    level: Array
    saturated: int


def find_band(
    frames: Sequence[tuple[str, Callable[[], np.ndarray]]], wavelength_nm: float, *, name: str = "", filtered: bool = False,
    refocused: bool = False, exposure_s: float = 0.0, on_frames: Callable[[int], object] | None = None, **options: Any,
) -> Band:  # fmt: skip
    """Find the targets of all frames of a band.

    Raises
    ------
    InputError
        If a frame or an option cannot be used.
    """

    def work(item: tuple[str, Callable[[], np.ndarray]]) -> tuple[FrameTargets, Array, int]:
        found = locate(item[1](), name=item[0], threads=1, **{"kind": "disc", **options})
        c = {k: np.asarray(v, float) for k, v in found.columns.items() if np.asarray(v).dtype.kind in "fiu"}
        if not len(c["x_px"]) or "blur_px" not in c:
            return FrameTargets(item[0], 0.0, np.zeros((0, 2)), np.zeros((0, 2, 2))), np.zeros((0, 3)), 0
        flags = c["flags"].astype(int)
        good = (flags & int(USELESS) == 0) & np.isfinite(c["x_px"] + c["blur_px"]) & (c["var_x_px2"] > 0) & (c["var_y_px2"] > 0)
        plain = good & (flags & int(FULL) == 0)
        covariance = np.stack([c[n] for n in ("var_x_px2", "cov_xy_px2", "cov_xy_px2", "var_y_px2")], axis=1).reshape(-1, 2, 2)
        radius = c["radius_px"] if "radius_px" in c else np.sqrt(c["semi_major_px"] * c["semi_minor_px"])
        place = np.column_stack([c["x_px"], c["y_px"]])
        each = np.column_stack([c["blur_px"] ** 2, radius, np.abs(c["amplitude_dn"])])[plain]
        return FrameTargets(item[0], 0.0, place[good], covariance[good]), each, int((good & ~plain).sum())

    targets, values, full = [], [], 0
    for one, each, saturated in imap_tiles(work, list(frames)):
        targets.append(one)
        values.append(each)
        full += saturated
        if on_frames is not None:
            on_frames(1)
    blur, radius, level = np.concatenate(values).T
    return Band(wavelength_nm, name, filtered, refocused, exposure_s, tuple(targets), blur, radius, level, full)


def bands_of(bands: Sequence[Band], frame_shape: tuple[int, int], stated: StatedFacts) -> ColourBands:
    """What the bands tell together.

    Parameters
    ----------
    bands : sequence of Band
    frame_shape : (int, int)
    stated : StatedFacts
        f-number and pitch, without which focus and diffusion are told in pixels only.

    Returns
    -------
    ColourBands

    Raises
    ------
    MeasureError
        With targets in less than two bands.
    """
    shown = sorted((b for b in bands if any(len(f.positions_px) for f in b.frames)), key=lambda b: (b.filtered, b.wavelength_nm))
    if len(shown) < 2:
        what = f"{len(shown)} of {len(bands)} bands shows targets"
        remedy = "show round targets in light of two wavelengths or more, or with and without the filter"
        raise MeasureError(what, where="bands", remedy=remedy)
    nm, filtered = np.array([b.wavelength_nm for b in shown]), np.array([b.filtered for b in shown])
    notes = [f"{b.wavelength_nm:g} nm: {b.saturated} targets are saturated; they serve for places alone" for b in shown if b.saturated]
    blur, u_blur = _means([b.blur_var for b in shown])
    level, u_level = _means([b.level / (b.exposure_s or 1.0) for b in shown])
    radius = _means([b.radius for b in shown])[0]
    shift, scale, u_scale, why = _scales(shown, frame_shape)
    colour = _colour(shown, nm, scale, u_scale, why, notes)
    diffusion, long_nm = _diffusion(shown, nm, filtered, blur, u_blur, radius, stated)
    timed = all(b.exposure_s > 0 for b in shown) or len({b.exposure_s for b in shown}) == 1
    through = _through(nm, filtered, level, u_level) if timed else np.zeros((3, 0))
    if not timed:
        notes.append("some bands state no exposure: light is not compared")
    found = _filter(through, nm, filtered, blur, u_blur, stated, any(b.refocused for b in shown))
    per_um = None if stated.f_number is None or stated.pitch_x_um is None else 4 * stated.f_number * stated.pitch_x_um
    sharp = np.min(blur[np.isfinite(blur)], initial=np.inf)
    focus = np.full(len(shown), np.nan) if per_um is None else per_um * np.sqrt(np.maximum(blur - sharp, 0.0))
    return ColourBands(
        wavelength_nm=nm, filtered=filtered, names=tuple(b.name for b in shown), frames=np.array([len(b.frames) for b in shown]),
        targets=np.array([max(len(f.positions_px) for f in b.frames) for b in shown]), level_dn_per_s=level, u_level_dn_per_s=u_level,
        blur_var_px2=blur, u_blur_var_px2=u_blur, radius_px=radius, shift_x_px=shift[:, 0], shift_y_px=shift[:, 1], scale_rel=scale,
        u_scale_rel=u_scale, focus_um=focus, transmittance_nm=through[0], transmittance=through[1], u_transmittance=through[2],
        colour=colour, diffusion=diffusion, filter=found, long_nm=long_nm, notes=tuple(notes),
    )  # fmt: skip


def _means(values: Sequence[Array]) -> tuple[Array, Array]:
    """Mean of each band, and its u by the scatter; NaN where nothing is."""
    mean = np.array([v.mean() if len(v) else np.nan for v in values])
    u = np.array([v.std(ddof=1) / np.sqrt(len(v)) if len(v) > 1 else np.nan for v in values])
    known = u[np.isfinite(u)]
    return mean, np.where(np.isfinite(u), u, known.max() if known.size else np.nan)


def _scales(shown: Sequence[Band], frame_shape: tuple[int, int]) -> tuple[Array, Array, Array, str]:
    """Shift, scale and its u of each band against the mean of all; or why they are not told."""
    count = len(shown)
    nothing = np.full((count, 2), np.nan), np.full(count, np.nan), np.full(count, np.nan)
    frames = [f for b in shown for f in b.frames]
    of = np.concatenate([np.full(len(b.frames), k) for k, b in enumerate(shown)])
    frames = frames + frames if len(frames) < 3 else frames  # the same twice, to be told apart below by their number
    twice = len(frames) // len(of)
    of = np.tile(of, twice)
    centre = 0.5 * (frame_shape[1] - 1), 0.5 * (frame_shape[0] - 1)
    try:
        places, covariance = follow_targets(frames)
    except MeasureError as problem:
        return *nothing, str(problem.what)
    try:
        motion = field_motion(places, covariance, centre)
    except MeasureError as problem:  # one or two discs: their own size
        moved = np.nanmean(places - np.nanmean(places, axis=0), axis=1)
        shift = np.array([np.nanmean(moved[of == k], axis=0) for k in range(count)])
        radius, u_radius = _means([b.radius for b in shown])
        if not np.isfinite(radius + u_radius).all():
            return shift, *nothing[1:], str(problem.what)
        whole = float(radius.mean())
        return shift, radius / whole - 1, np.hypot(u_radius, RADIUS_U_PX) / whole, ""
    at = [motion.modes.index(m) for m in ("shift_x_px", "shift_y_px", "scale_rel")]
    shift, scale, u = nothing
    for k in range(count):
        own = motion.used & (of == k)
        if not own.any():
            continue
        values = motion.values[own][:, at]
        shift[k], scale[k] = values[:, :2].mean(axis=0), values[:, 2].mean()
        number = own.sum() / twice
        noise = motion.covariance[own][:, at[2], at[2]].mean() * max(1.0, motion.location_factor * np.sqrt(twice)) ** 2 / number
        scatter = values[:, 2].var(ddof=1) / number if number > 2 else 0.0
        u[k] = np.sqrt(max(noise, scatter))
    return shift, scale, u, ""


def _colour(shown: Sequence[Band], nm: Array, scale: Array, u: Array, why: str, notes: list[str]) -> Estimates:
    """Change of the scale per nanometre."""
    plain = np.array([not b.filtered for b in shown]) & np.isfinite(scale)
    if why:
        pass
    elif any(b.refocused for b in shown):
        why = "the lens was focused anew for each band, which scales the image as well"
    elif len(set(nm[plain])) < 2:
        why = "one wavelength only: a change of scale is then the same as another principal distance"
    if why:
        return replace(Estimates.empty(), reasons={"scale_per_nm": why})
    x, y, s = nm[plain] - nm[plain].mean(), scale[plain], u[plain]
    basis = np.column_stack([np.ones_like(x), x]) / s[:, None]
    cofactor = np.linalg.inv(basis.T @ basis)
    found = cofactor @ (basis.T @ (y / s))
    left = y / s - basis @ found
    dof = len(x) - 2
    factor = float(np.sqrt((left**2).sum() / dof)) if dof else 1.0
    value, u_value = float(found[1]), float(np.sqrt(cofactor[1, 1])) * max(1.0, factor)
    reasons = {"scale_per_nm": "mean_nm and reference_nm are those of your light and of your calibration"}
    if factor > MISFIT:
        off = float(np.abs(left * s).max())
        reasons["scale_per_nm"] = f"the scale is no straight line of the wavelength (up to {off:.1e} off): u holds that"
        notes.append(f"lateral colour is no straight line of the wavelength: the scale is up to {off:.1e} off it")
    wide = float(dof) if factor > 1 and dof else np.inf
    return Estimates.from_rows([("scale_per_nm", value, u_value, wide, "1/nm")], method=COLOUR, confounders=(MOVED,), reasons=reasons)


def _through(nm: Array, filtered: np.ndarray, level: Array, u: Array) -> Array:
    """Wavelengths, light with the filter over that without it, and its u, shape (3, n)."""
    rows = []
    for k in np.flatnonzero(filtered & np.isfinite(level)):
        for j in np.flatnonzero(~filtered & (np.abs(nm - nm[k]) < 0.5) & np.isfinite(level)):
            value = level[k] / level[j]
            rows.append((nm[k], value, value * np.sqrt((u[k] / level[k]) ** 2 + (u[j] / level[j]) ** 2 + 2 * LAMP_U**2)))
    return np.array(rows).reshape(-1, 3).T


def _filter(through: Array, nm: Array, filtered: np.ndarray, blur: Array, u_blur: Array, stated: StatedFacts, refocused: bool) -> Estimates:
    """Transmittance in the band, where it ends, and the thickness of the plate."""
    if not filtered.any():
        return replace(Estimates.empty(), reasons={"peak_rel": "no band is stated as filtered (filtered: true)"})
    if not through.shape[1]:
        why = "no wavelength is seen both with the filter and without it, by targets below saturation and at a stated exposure"
        return replace(Estimates.empty(), reasons={"peak_rel": why})
    at, value, u = through
    best = int(np.argmax(value))
    rows = [("peak_rel", float(min(value[best], 1.0)), float(u[best]), np.inf, "1")]
    reasons, settings = {}, {"band": "none"}
    blocked = np.flatnonzero((at > at[best]) & (value < 0.5 * value[best]))
    passing = np.flatnonzero((value > 0.5 * value[best]) & (at < (at[blocked].min() if blocked.size else np.inf)))
    shut_below = ((at < at[best]) & (value < 0.5 * value[best])).any()
    if blocked.size and not shut_below:
        low, high = float(at[passing].max()), float(at[blocked].min())
        rows.append(("cut_nm", 0.5 * (low + high), (high - low) / np.sqrt(12), np.inf, "nm"))
        reasons["cut_nm"] = f"it passes {low:g} nm and stops {high:g} nm: anywhere between"
        settings = {"band": "short_pass"}
    else:
        reasons["cut_nm"] = "it also stops shorter wavelengths: a band pass" if shut_below else "it passes all wavelengths that were taken"
    fit = Estimates.from_rows(rows, method=DEEPER, reasons=reasons, settings=settings)
    return fit if refocused else fit.join(_plate(nm, filtered, blur, u_blur, stated))


def _plate(nm: Array, filtered: np.ndarray, blur: Array, u: Array, stated: StatedFacts) -> Estimates:
    """Thickness of a plate of index 1.52 with which the lens was not focused, from the blur with it less that without it."""
    if stated.f_number is None or stated.pitch_x_um is None:
        return replace(Estimates.empty(), reasons={"plate_um": "needs f_number and pitch_um"})
    seen = np.isfinite(blur) & np.isfinite(u)
    pairs = [(k, j) for k in np.flatnonzero(filtered & seen) for j in np.flatnonzero(~filtered & seen) if abs(nm[k] - nm[j]) < 0.5]
    if not pairs:
        return replace(Estimates.empty(), reasons={"plate_um": "no wavelength has two unsaturated targets with the filter and without it"})
    weight = np.array([1 / (u[k] ** 2 + u[j] ** 2) for k, j in pairs])
    more = float(np.array([blur[k] - blur[j] for k, j in pairs]) @ weight / weight.sum())
    u_more = float(weight.sum() ** -0.5)
    to_um = 4 * stated.f_number * stated.pitch_x_um * 1.52 / 0.52
    known = [("f_number", stated.f_number, 0.0, np.inf, "1"), ("pitch_um", stated.pitch_x_um, 0.0, np.inf, "µm")]
    if more < SIGNIFICANT * u_more:
        limit = to_um * float(np.sqrt(max(more, 0.0) + ONE_SIDED_95 * u_more))
        row = ("plate_um", limit, to_um**2 * u_more / (2 * limit), np.inf, "µm")
        why = {"plate_um": "the filter does not blur the image; 95 % upper limit, without the filter in sharpest focus"}
        return Estimates.from_rows([row, *known], method=DEEPER, limits=frozenset({"plate_um"}), reasons=why)
    value, u_more = to_um * float(np.sqrt(more)), float(np.hypot(u_more, PLATE_U * more))
    why = {"plate_um": "for the lens in sharpest focus without the filter, and an index of 1.52"}
    return Estimates.from_rows([("plate_um", value, to_um**2 * u_more / (2 * value), np.inf, "µm"), *known], method=DEEPER, reasons=why)


def _diffusion(
    shown: Sequence[Band], nm: Array, filtered: np.ndarray, blur: Array, u: Array, radius: Array, stated: StatedFacts
) -> tuple[Estimates, float]:
    """Diffusion length from the blur in the longest infrared band against that of the sharpest visible one."""
    usable = ~filtered & np.isfinite(blur) & np.isfinite(u)
    far, near = np.flatnonzero(usable & (nm >= INFRARED_NM)), np.flatnonzero(usable & (nm < INFRARED_NM))
    if not far.size or not near.size or stated.pitch_x_um is None:
        why = "needs a band below 700 nm and one above" if stated.pitch_x_um is not None else "needs pitch_um"
        return replace(Estimates.empty(), reasons={"diffusion_length_um": why}), float("nan")
    k, j = far[int(np.argmax(nm[far]))], near[int(np.argmin(blur[near]))]
    more, u_more = float(blur[k] - blur[j]), float(np.hypot(u[k], u[j]))
    pitch = stated.pitch_x_um, stated.pitch_y_um or stated.pitch_x_um
    table = _blur_by_diffusion(float(nm[k]), float(radius[j]), float(np.sqrt(blur[j])), pitch)
    rises = np.maximum.accumulate(table)

    def length(extra: float) -> float:
        return float(np.interp(extra, rises, LENGTHS_UM))

    told = shown[k].refocused and shown[j].refocused
    if not told or more < SIGNIFICANT * u_more:
        limit = length(max(more, 0.0) * (1 + ONE_SIDED_95 * MODEL_U) + ONE_SIDED_95 * u_more)
        if limit >= LENGTHS_UM[-1] or limit <= 0:
            why = f"the blur at {nm[k]:g} nm allows any length: {FOCUS}; focus anew at each wavelength (refocused: true)"
            return replace(Estimates.empty(), reasons={"diffusion_length_um": why}), float(nm[k])
        other = f"{FOCUS}: focus anew at each wavelength (refocused: true)"
        none = "no more blur in the infrared" if more < SIGNIFICANT * u_more else other
        row = ("diffusion_length_um", limit, limit / 6, np.inf, "µm")
        reasons = {"diffusion_length_um": f"95 % upper limit: {none}"}
        names = frozenset({"diffusion_length_um"})
        return Estimates.from_rows([row], method=BLURRED, limits=names, reasons=reasons, confounders=(FOCUS,)), float(nm[k])
    value = length(more)
    spread = np.hypot(u_more, MODEL_U * more)
    u_value = 0.5 * (length(more + spread) - length(max(more - spread, 0.0)))
    if value >= LENGTHS_UM[-1]:
        why = "the image in the infrared is blurrier than any diffusion makes it"
        return replace(Estimates.empty(), reasons={"diffusion_length_um": why}), float(nm[k])
    return Estimates.from_rows([("diffusion_length_um", value, u_value, np.inf, "µm")], method=BLURRED), float(nm[k])


def _blur_by_diffusion(wavelength_nm: float, radius: float, blur_px: float, pitch: tuple[float, float]) -> Array:
    """Variance that the template finds more of a disc of that radius and blur, for each of `LENGTHS_UM`, shape (lengths,)."""
    radius = min(radius, 0.3 * SIDE_PX)
    at = (np.arange(SIDE_PX * FINE) + 0.5) / FINE - 0.5 * SIDE_PX - 0.13
    fine = np.clip((radius - np.hypot(at, at[:, None])) * FINE + 0.5, 0.0, 1.0)
    f = np.fft.fftfreq(SIDE_PX * FINE, 1 / FINE)
    fx, fy = f[None, :], f[:, None]
    seen = np.fft.fft2(fine) * np.exp(-2 * (np.pi * blur_px) ** 2 * (fx**2 + fy**2)) * np.sinc(fx) * np.sinc(fy)
    found = []
    for length in LENGTHS_UM:
        params = InfraredDiffusion(wavelength_nm=wavelength_nm, diffusion_length_um=float(length), pitch_x_um=pitch[0], pitch_y_um=pitch[1])
        spread = transfer(params, fx, fy) if length else 1.0
        light = np.fft.ifft2(seen * spread).real[FINE // 2 :: FINE, FINE // 2 :: FINE]
        frame = (1000 + 20000 * light).astype(np.float32)
        target = locate(frame, kind="disc", noise="read=20,gain=0.001,black=0", threads=1)
        blur = np.asarray(target.columns["blur_px"], float)
        found.append(float(blur[0] ** 2) if len(blur) else np.nan)
    variances = np.array(found) - found[0]
    good = np.isfinite(variances)
    return np.interp(LENGTHS_UM, LENGTHS_UM[good], variances[good])


def measure_bands(
    groups: Sequence[tuple[Sequence[tuple[str, Callable[[], np.ndarray]]], dict[str, Any]]], frame_shape: tuple[int, int],
    stated: StatedFacts, **options: Any,
) -> ColourBands:  # fmt: skip
    """Measure groups of frames, each with the keywords of `find_band`.

    Raises
    ------
    InputError, MeasureError
        If a frame cannot be used, or less than two bands show targets.
    """
    found = [find_band(frames, **about, **options) for frames, about in groups]
    with single_threaded_blas():
        return bands_of(found, frame_shape, stated)
