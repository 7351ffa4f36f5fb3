"""The section of an assessment's page on a laser spot: scatter of its centre, and the grains."""

from __future__ import annotations

import numpy as np

from pixmetry.camera.speckle import SpeckleFrames, SpeckleSpot
from pixmetry.core.number import Number
from pixmetry.report import Column, Section, Table
from pixmetry.report.drawing import BLUE, INK, RED, SOFT, canvas, line
from pixmetry.report.numbers import significant
from pixmetry.report.page import Figure

TITLES = {
    "scatter_x_px": "Scatter of the centre along x",
    "scatter_y_px": "Scatter of the centre along y",
    "contrast_rel": "Contrast of the light, before pixels average it",
    "airy_px": "Size of the grains, λN",
}


def speckle_section(found: SpeckleFrames) -> Section:
    """Sentence, figure and values of each spot."""
    section = Section("Laser spot on a surface that moves", name="speckle")
    if not found.spots:
        return section.add_text(f"Nothing was measured of a laser spot: {found.refused[0]}.")
    for number, spot in enumerate(found.spots, start=1):
        section.add_text(summary_sentence(spot)).add(spot_figure(spot, number))
        rows = [[TITLES[n.name], n, n.reason] for n in spot.fit]
        rows += [[TITLES[n], Number.not_available("1", why), why] for n, why in spot.fit.reasons.items() if n not in spot.fit]
        section.add(Table("What the spot tells", ["Quantity", Column("Value", "number"), "Note"], rows))
    return section


def summary_sentence(spot: SpeckleSpot) -> str:
    """The scatter, its law, and what averaging gains."""
    scatter = float(np.sqrt(max(0.5 * np.trace(spot.scatter_px2), 0.0)))
    text = f"The centre of the spot scatters by {significant(scatter)} px (rms of x and y) over {spot.frames} frames; "
    text += f"the noise of the pixels, {significant(spot.u_located_px)} px, is taken off. "
    if spot.predicted_px2 is not None:
        text += f"Grains of the contrast and size seen make {significant(float(np.sqrt(0.5 * np.trace(spot.predicted_px2))))} px. "
    one = spot.effective_frames < 0.9 * spot.frames
    text += f"The frames count as {significant(spot.effective_frames)} independent ones: " if one else "The frames are independent: "
    return text + f"their mean is known to {significant(scatter / np.sqrt(spot.effective_frames))} px."


def spot_figure(spot: SpeckleSpot, number: int) -> Figure:
    """Centres with the ellipse of two standard deviations, and the covariance of the light of two pixels with its model."""
    with canvas(2.8, ncols=2) as (figure, (left, right)):
        x, y = spot.x_px - spot.path_x_px, spot.y_px - spot.path_y_px
        line(left, x, y, color=BLUE, linestyle="", marker=".", markersize=3)
        turn = np.linspace(0, 2 * np.pi, 90)
        for matrix, colour in ((spot.scatter_px2, INK), (spot.predicted_px2, RED)):
            if matrix is None:
                continue
            values, vectors = np.linalg.eigh(matrix)
            at = vectors @ (2 * np.sqrt(np.maximum(values, 0.0))[:, None] * np.array([np.cos(turn), np.sin(turn)]))
            line(left, at[0], at[1], color=colour, linewidth=0.8, linestyle="-" if colour == INK else "--")
        left.set_aspect("equal", adjustable="datalim")
        left.set_xlabel("x / px")
        left.set_ylabel("y / px")
        if len(spot.lags_px):
            far = np.hypot(*spot.lags_px.T)
            order = np.argsort(far)
            line(right, far[order], spot.covariance_rel[order], color=BLUE, linestyle="", marker=".", markersize=4)
            line(right, far[order], spot.model_rel[order], color=INK, linewidth=0.8)
        right.axhline(0, color=SOFT, linewidth=0.6)
        right.set_xlabel("distance of two pixels / px")
        right.set_ylabel("relative covariance")
        caption = (
            "Left: centres of the spot less its path, with the ellipse of two standard deviations (line; without the located noise) and "
            "that of the law of speckle for these grains (dashed). Right: covariance of the light of two pixels over the mean light, and "
            "the model of a round pupil (line)."
        )
        alt = f"Scatter of the centre of a laser spot, and the size of its grains. {summary_sentence(spot)}"
        return Figure(figure, f"speckle-{number}", alt, caption)
