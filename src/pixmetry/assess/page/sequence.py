"""The sections of an assessment's page on frames in a row (the gain of each, and what moves it) and on the rows of dark frames."""

from __future__ import annotations

import numpy as np

from pixmetry.camera.dark_rows import DarkRows
from pixmetry.camera.frame_sequence import FrameSequence, FrameSequences
from pixmetry.core.number import Number
from pixmetry.report import Column, Points, Section, Table
from pixmetry.report.drawing import BLUE, INK, SOFT, canvas, line
from pixmetry.report.numbers import printed_number, significant
from pixmetry.report.page import Figure


def sequence_section(found: FrameSequences) -> Section:
    """Sentences, a figure of each sequence's gain, and a table."""
    section = Section("Frames in a row", name="sequence").add_text(loop_sentence(found)).add_text(lamp_sentence(found))
    for number, sequence in enumerate(found.sequences, start=1):
        section.add(gain_figure(sequence, number))
    if found.sequences:
        columns: list[Column | str] = [Column(name, "right") for name in ("Sequence", "Frames", "At rest / %", "Changes of the scene")]
        columns += [Column(name, "right") for name in ("κ", "Target / DN", "Share of gain", "Swing of the light / %")]
        section.add(Table("Sequences", columns, [_row(s, k) for k, s in enumerate(found.sequences, start=1)]))
    if found.refused:
        section.add(Points([f"Not measured: {why}." for why in found.refused]))
    return section


def _row(s: FrameSequence, number: int) -> list[str]:
    def told(name: str) -> str:
        return printed_number(s.loop[name]).joined() if name in s.loop else "–"

    share = printed_number(Number(s.gain_share, s.u_gain_share)).joined() if np.isfinite(s.u_gain_share) else "–"
    swing = "–" if s.wave is None else printed_number(Number(100 * s.wave.amplitude_rel, 100 * s.wave.u_amplitude_rel)).joined()
    counts = [str(number), str(len(s.level_dn)), significant(100 * s.static_share), str(s.changes)]
    return [*counts, told("kappa"), told("target_dn"), share, swing]


def loop_sentence(found: FrameSequences) -> str:
    """Whether the gain follows the scene."""
    loop = found.loop
    if "kappa" not in loop:
        return f"Whether the gain follows the scene is not told: {loop.reasons['kappa']}."
    kappa = loop["kappa"]
    if kappa.value == 0:
        return f"The gain does not follow the scene: {kappa.reason}."
    if kappa.is_limit:
        return f"No gain is seen that follows the scene; κ is {printed_number(kappa).joined()}."
    target = printed_number(loop["target_dn"]).joined()
    ends = (("lowest_db", "below"), ("highest_db", "above"))
    limits = "".join(f", not {word} {printed_number(loop[name]).joined()} dB" for name, word in ends if name in loop)
    text = f"The gain follows the scene: each frame removes a part κ = {printed_number(kappa).joined()} of the deviation from {target} DN"
    return f"{text}{limits}. Dark and bright frames for the photon transfer must be taken with the gain locked."


def lamp_sentence(found: FrameSequences) -> str:
    """What the light does."""
    lamp = found.lamp
    if "depth_rel" not in lamp:
        return f"Flicker of the light is not told: {lamp.reasons['depth_rel']}."
    depth = lamp["depth_rel"]
    if depth.is_limit:
        return f"The light does not flicker: the depth is {printed_number(depth).joined()} ({depth.reason})."
    return f"The light flickers at {printed_number(lamp['frequency_hz']).joined()} Hz with a depth of {printed_number(depth).joined()}."


def gain_figure(s: FrameSequence, number: int) -> Figure:
    """Factor of each frame, the fit, and the light of the scene."""
    with canvas(2.6) as (figure, axes):
        frame = np.arange(1, len(s.gain_rel) + 1)
        line(axes, frame, s.scene_rel, color=SOFT, linewidth=0.8, linestyle=":")
        line(axes, frame, s.fitted_rel, color=INK, linewidth=0.8)
        line(axes, frame, s.gain_rel, color=BLUE, marker="o", markersize=2.5, linewidth=0)
        axes.set_xlabel("frame")
        axes.set_ylabel("over the mean")
        caption = (
            f"Sequence {number}. Dots: factor of each frame on what does not change in the scene. Line: loop of the gain, with the lamp. "
            "Dotted: light of the scene."
        )
        alt = f"Gain of each of {len(frame)} frames over their mean, with the fitted loop, and the light of the scene that drives it."
        return Figure(figure, f"sequence-{number}", alt, caption)


def dark_rows_section(found: DarkRows) -> Section:
    """Sentences on hum and 1/f noise, and the spectrum of the rows."""
    section = Section("Rows of dark frames", name="dark-rows").add_text(hum_sentence(found)).add_text(flicker_noise_sentence(found))
    return section.add(spectrum_figure(found))


def hum_sentence(found: DarkRows) -> str:
    """Whether a hum is in the rows."""
    hum = found.hum
    if "amplitude_dn" not in hum:
        return f"Hum is not told: {hum.reasons['amplitude_dn']}."
    size = printed_number(hum["amplitude_dn"]).joined()
    if hum.limits:
        return f"The rows show no hum; its amplitude is {size} DN."
    at = f"{printed_number(hum['per_row']).joined()} cycles a row"
    hertz = f", {printed_number(hum['frequency_hz']).joined()} Hz" if "frequency_hz" in hum else ""
    return f"A hum of {size} DN lies over the rows, {at}{hertz} ({hum.reasons['frequency_hz']})."


def flicker_noise_sentence(found: DarkRows) -> str:
    """Whether the noise goes as 1/f along the read-out."""
    flicker = found.flicker
    if "rms_dn" not in flicker:
        return f"1/f noise is not told: {flicker.reasons['rms_dn']}."
    size = printed_number(flicker["rms_dn"]).joined()
    if flicker.limits:
        return f"The spectra need no 1/f noise; it is {size} DN ({flicker['rms_dn'].reason})."
    corner = printed_number(flicker["corner_rel"]).joined()
    return f"The 1/f noise along the read-out is {size} DN ({flicker['rms_dn'].reason}), up to {corner} of the pixel clock."


def spectrum_figure(found: DarkRows) -> Figure:
    """Spectrum of the means of rows, from frame to frame."""
    with canvas(2.4) as (figure, axes):
        line(axes, found.frequency[1:], found.power_dn2[1:], color=BLUE, linewidth=0.8)
        line(axes, found.frequency[1:], found.fitted_dn2[1:], color=INK, linewidth=0.8, linestyle="--")
        axes.set_yscale("log")
        axes.set_xlabel("cycles a row")
        axes.set_ylabel("power / DN²")
        caption = "Spectrum of the means of dark rows, without a hum that was found. Dashed: fit of white noise, row noise and 1/f noise."
        alt = f"Spectrum of the means of dark rows. {hum_sentence(found)} {flicker_noise_sentence(found)}"
        return Figure(figure, "dark-rows-spectrum", alt, caption)
