"""The page of a series, and the section of it on the page of an assessment."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from pixmetry.camera.drift_series import DIGITAL, DriftSeries
from pixmetry.camera.motion_series import MotionSeries
from pixmetry.camera.recordings import Recordings
from pixmetry.core.number import LOWER_LIMIT, Estimates, Number
from pixmetry.report import Column, Page, Section, Table
from pixmetry.report.drawing import BLUE, GRID, INK, RED, SOFT, canvas, line
from pixmetry.report.numbers import printed_number, significant
from pixmetry.report.page import Answer, Figure, Reading, Text
from pixmetry.report.provenance import provenance_section

if TYPE_CHECKING:
    from pixmetry.series.records import Series

WORDS = {
    "shift_x_px": "Shift along x, from switching on to settled",
    "shift_y_px": "Shift along y",
    "scale_rel": "Change of scale",
    "rotation_rad": "Rotation, from x to y",
    "fast_share": "Share that settles fast",
    "fast_s": "Fast time constant",
    "slow_s": "Slow time constant",
    "scale_error_rel": "Frame grabber: error of its clock when switched on",
    "scale_tau_s": "Frame grabber: time constant of the clock",
    "delay_ns": "Frame grabber: delay of the lines when switched on",
    "delay_tau_s": "Frame grabber: time constant of the delay",
    "shift_std_px": "Scatter of the whole image from frame to frame, along each axis",
    "roll_std_rad": "Scatter of its rotation",
    "field_period_s": "Time between even and odd rows",
    "row_time_s": "Time from row to row",
    "jitter_s": "Scatter of the time of exposure",
    "exposure_s": "Length of the even exposure that blurs as much",
    "rows_swapped_px": "Odd rows less even rows at rest",
    "separation_s": "Time between the two pulses of light",
    "ambient_share": "Share of steady light beside the pulses",
    "noise_ratio": "Temporal variance, recorded over direct",
    "frame_correlation": "Correlation of the recorded noise from frame to frame, less that of the direct one",
    "group": "Frames from one picture coded by itself to the next",
    "quality": "Quantiser of the coder",
    "bandwidth_rel": "Bandwidth (−3 dB)",
    "noise_dn": "Noise that the tape adds",
    "head_switch_px": "Step of the rows where the heads switch",
    "white_px": "Jitter of the rows, independent from row to row",
    "loop_px": "Jitter of the rows, alike in neighbouring rows",
    "loop_rows": "Rows of a field over which it is alike",
}
TITLES = {
    "shift_x_px": "shift x / px",
    "shift_y_px": "shift y / px",
    "scale_rel": "scale / 1e-6",
    "rotation_rad": "rotation / µrad",
    "affinity_rel": "x scale / 1e-6",
    "shear_rel": "shear / 1e-6",
}
SIGNIFICANT = 3.0  # u, from which on a change of focus is told
FOOTER = "Standard uncertainties (k = 1). x runs along rows, y along columns; the image turns about the frame's centre."


def page_of(found: Series) -> Page:
    """The page of a series."""
    drift = found.drift
    rows, cols = found.frame_shape
    facts = [
        ("Frames", f"{found.frames[0]} to {found.frames[-1]}, {cols} × {rows} pixels"),
        ("Time", f"{_minutes(drift.time_s[0])} to {_minutes(drift.time_s[-1])} after switching on"),
        ("Targets", str(drift.targets)),
    ]
    page = Page(f"{len(found.frames)} frames", "motion of the image over time", "pixmetry series of a fixed field", facts, FOOTER)
    verdict = page.add_section("Is the camera stable?", name="verdict")
    far, u = (float(v[-1]) for v in (drift.from_settled_px, drift.u_from_settled_px))
    now = Reading("still to go at the end", f"{significant(far, 2)} px", f"± {significant(u, 1)} px")
    verdict.add(Answer([Text(stable_sentence(drift)), [now]]))
    for note in found.notes:
        verdict.add_text(note, style="small soft")
    page.sections.append(drift_section(drift, own_page=True))
    if (origin := provenance_section(found.provenance)) is not None:
        page.sections.append(origin)
    return page


def stable_sentence(drift: DriftSeries) -> str:
    """When the camera is stable, in a sentence."""
    stable, limit = drift.stable, f"{drift.tolerance_px:g} px"
    if not stable.is_available:
        return f"Whether the image stays within {limit} of where it settles is not told: {stable.reason}."
    if stable.kind == LOWER_LIMIT:
        return f"After {_minutes(stable.value)} the image is not yet within {limit} of where it settles, and the series ends there."
    if stable.u == 0:
        return f"The image stays within {limit} of its place from the first frame on."
    u = significant(stable.u / 60, 2)
    extrapolated = f" ({stable.reason})" if stable.reason else ""
    when = f"From {significant(stable.value / 60, 3)} ± {u} min after switching on"
    return f"{when}, every point stays within {limit} of where it settles{extrapolated}."


def outlook_sentence(drift: DriftSeries) -> str:
    """How far the image still is from where it settles, and in how many minutes it will be near enough, in a sentence."""
    stable, last = drift.stable, float(drift.time_s[-1])
    far, u = (float(v[-1]) for v in (drift.from_settled_px, drift.u_from_settled_px))
    if not stable.is_available or stable.kind == LOWER_LIMIT or not np.isfinite(far + u):
        return stable_sentence(drift)
    still = f"{significant(far, 2)} ± {significant(u, 1)} px to go"
    if stable.value <= last:
        return f"{still}. {stable_sentence(drift)}"
    minutes, u_min = (stable.value - last) / 60, stable.u / 60
    return f"{still}; stable (within {drift.tolerance_px:g} px) in {significant(minutes, 2)} ± {significant(u_min, 1)} min"


def focus_sentence(drift: DriftSeries) -> str:
    """Whether the focus changes, in a sentence."""
    change = drift.focus
    told = f"{printed_number(change).joined()} from the first to the last fifth of the frames"
    if abs(change.value) > SIGNIFICANT * change.u:
        return f"The focus changes: the variance of the targets' blur grows by {told}. The scale may follow it."
    return f"No change of focus is seen: the variance of the targets' blur changes by {told}."


def drift_section(drift: DriftSeries, *, own_page: bool = False) -> Section:
    """Figure and values of a series."""
    section = Section("Motion of the image while the camera warms up", name="series")
    if not own_page:
        section.add_text(stable_sentence(drift))
    if drift.location_factor > 1.2:
        section.add_text(
            f"Single targets scatter {drift.location_factor:.2g} times more about the motion of the field than the uncertainty of their "
            "positions says. All uncertainties here are enlarged by that factor.",
            style="small soft",
        )
    section.add(motion_figure(drift))
    if drift.focus.is_available:
        section.add_text(focus_sentence(drift))
    section.add(_told(drift.fit))
    return section


def motion_section(motion: MotionSeries) -> Section:
    """Figure and values of frames of moving targets."""
    speed = float(np.nanmax(np.linalg.norm(motion.speed_px_s, axis=1)))
    text = f"{motion.targets} targets in {motion.frames} frames, at up to {significant(speed)} px/s. "
    text += "Times are in proportion to the stated time between frames."
    section = Section("Moving targets", name="motion").add_text(text)
    section.add(lag_figure(motion), _told(motion.fit))
    return section


def recordings_section(found: Recordings) -> Section:
    """Figure and values of a scene that was seen directly and recorded."""
    section = Section("The recorder", name="recording")
    text = f"One scene in {found.direct_frames} frames directly and in {found.recorded_frames} recorded ones."
    section.add_text(text).add(recordings_figure(found), _told(found.fit))
    if len(found.played):
        section.add(_told(_known(found.played), "What the rows do behind the recorder"))
        section.add(_told(_known(found.direct), "What the rows do directly"))
    return section


def _known(fit: Estimates) -> Estimates:
    return fit.select([name for name in fit.names if name in WORDS])


def recordings_figure(found: Recordings) -> Figure:
    """Contrast after over before the recorder, and the difference of each frame to the one before."""
    with canvas(2.6, ncols=2) as (figure, (left, right)):
        left.errorbar(found.frequency, found.transfer, 2 * found.u_transfer, color=BLUE, fmt=".", markersize=3, elinewidth=0.6)
        left.axhline(1.0, color=GRID, linewidth=0.7)
        left.set_xlabel("frequency along the rows / cycles/px")
        left.set_ylabel("contrast, recorded over direct")
        left.set_ylim(bottom=0)
        frames = np.arange(1, found.difference_dn2.size + 1)
        line(right, frames, found.difference_dn2, color=BLUE, marker=".", markersize=3)
        right.axhline(found.direct_difference_dn2, color=RED, linewidth=0.7, linestyle="--")
        right.set_xlabel("frame")
        right.set_ylabel("half the mean square of the difference / DN²")
        right.set_ylim(bottom=0)
        caption = (
            "Left: how much contrast the recorder leaves, with ± 2 u. Right: difference of each recorded frame to the one before; the "
            "dashed line is that of the frames which came directly. A coder freezes noise until the next picture that is coded by itself."
        )
        return Figure(figure, "recording", "Contrast and noise behind the recorder, over those of the direct frames.", caption)


def _told(fit: Estimates, title: str = "What the series tells") -> Table:
    """Values, limits, and why others are not there."""
    rows: list[list[Any]] = [[WORDS[number.name], number, number.reason] for number in fit]
    rows += [[WORDS[name], Number.not_available("1", why), why] for name, why in untold(fit).items()]
    return Table(title, ["Quantity", Column("Value", "number"), "Note"], rows)


def untold(fit: Estimates) -> dict[str, str]:
    """Why quantities are not told, by name; nothing of a frame grabber that a digital camera has not."""
    return {name: why for name, why in fit.reasons.items() if name not in fit and name in WORDS and why != DIGITAL}


def lag_figure(motion: MotionSeries) -> Figure:
    """Lag of the odd rows, and shear and stretch of the picture, against the velocity."""
    with canvas(2.6, ncols=2) as (figure, (left, right)):
        for k, (axis, colour) in enumerate((("x", BLUE), ("y", RED))):
            style = {"color": colour, "fmt": ".", "markersize": 3, "elinewidth": 0.6}
            left.errorbar(motion.speed_px_s[:, k], motion.lag_px[:, k], 2 * motion.u_lag_px[:, k], label=f"along {axis}", **style)
            right.errorbar(motion.speed_px_s[:, k], 1e3 * motion.shear[:, k], 2e3 * motion.u_shear[:, k], **style)
        left.set_xlabel("velocity / px/s")
        left.set_ylabel("odd rows less even / px")
        left.legend(loc="best")
        right.set_xlabel("velocity / px/s")
        right.set_ylabel("shear, stretch / px per 1000 rows")
        caption = (
            "Left: how far a target in the odd rows lies from its place in the even ones; the slope is the time between the fields. Right: "
            "shear (along x) and stretch (along y) of the picture of the plate; the slope is the time from row to row. Bars are ± 2 u."
        )
        return Figure(figure, "motion", "Lag of the odd rows and shear of the picture against the velocity of the targets.", caption)


def motion_figure(drift: DriftSeries) -> Figure:
    """Modes over time with the fitted curves, and the distance to where the farthest corner settles."""
    minutes = drift.time_s / 60
    count = len(drift.modes)
    with canvas(1.15 * count + 1.5, nrows=count + 1, sharex=True) as (figure, axes):
        for k, mode in enumerate(drift.modes):
            factor = 1.0 if mode.endswith("px") else 1e6
            top = axes[k]
            top.fill_between(minutes, *(factor * (drift.values[:, k] + s * 2 * drift.u[:, k]) for s in (-1, 1)), color=GRID, linewidth=0)
            line(top, minutes, factor * drift.values[:, k], color=SOFT, linewidth=0.5, marker=".", markersize=2)
            line(top, minutes, factor * drift.fitted[:, k], color=BLUE)
            top.set_ylabel(TITLES[mode])
        low = axes[count]
        u = drift.u_from_settled_px
        least, most = np.maximum(drift.from_settled_px - 2 * u, 0), drift.from_settled_px + 2 * u
        low.fill_between(minutes, least, most, color=BLUE, alpha=0.2, linewidth=0)
        line(low, minutes, drift.from_settled_px, color=BLUE)
        low.axhline(drift.tolerance_px, color=RED, linewidth=0.7, linestyle="--")
        if drift.stable.is_available and drift.stable.value <= drift.time_s[-1]:
            low.axvline(drift.stable.value / 60, color=INK, linewidth=0.6, linestyle=":")
        low.set_ylim(bottom=0)
        low.set_ylabel("to settle / px")
        low.set_xlabel("minutes after switching on")
        caption = (
            "Motion of the field of targets: dots with ± 2 u (grey), fitted curve (blue). Below: how far the farthest corner still is from "
            "where it settles, with ± 2 u; the dashed line is the tolerance."
        )
        return Figure(figure, "series", f"Motion of the image over {drift.time_s.size} frames. {stable_sentence(drift)}", caption)


def _minutes(seconds: float) -> str:
    return f"{significant(float(seconds) / 60, 3)} min"
