"""The section of an assessment's page on frames in a row: the gain of each, and what moves it."""

from __future__ import annotations

import numpy as np

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
