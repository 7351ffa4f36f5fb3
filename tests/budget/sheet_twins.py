"""A camera of a data sheet's type: drawn within what cameras of one type differ by, simulated, assessed, and budgeted beside its sheet."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

import pixmetry
from pixmetry.budget.answer import rms
from pixmetry.budget.camera_budget import CameraBudget
from pixmetry.budget.parameters import UNSTATED_U_REL, told_values
from pixmetry.budget.table import TYPICAL, SourceRow
from pixmetry.camera.camera import Camera, Element, load_camera

SHAPE = (96, 128)
DRAWN = ("electronics.gain", "sensor.full_well", "electronics.amplifier_noise", "sensor.dark_current", "sensor.quantum_efficiency")
ROWS = ("sensor.shot_noise", "electronics.amplifier_noise", "sensor.prnu", "sensor.dsnu", "sensor.dark_current", "grabber.adc")


@dataclass(frozen=True)
class Twin:
    """Budgets of a sheet and of an assessed camera of its type."""

    name: str
    sheet: CameraBudget
    assessed: CameraBudget

    def ratio(self) -> float:
        """Total after the calibration of the assessed camera over the sheet's."""
        return rms(self.assessed.one.after_px) / rms(self.sheet.one.after_px)

    def totals_overlap(self) -> bool:
        """Whether the intervals of the totals overlap."""
        ends = [(rms(b.one.least_px), rms(b.one.most_px)) for b in (self.sheet, self.assessed)]
        return max(low for low, _ in ends) <= min(high for _, high in ends)

    def rows(self, ids: Sequence[str] = ROWS) -> list[tuple[SourceRow, SourceRow]]:
        """Rows of these sources that count in both."""
        found = [{r.source_id: r for r in b.rows} for b in (self.sheet, self.assessed)]
        return [(found[0][i], found[1][i]) for i in ids if found[0][i].counts and found[1][i].counts]


def ends_px(row: SourceRow) -> tuple[float, float]:
    """The interval of a row: of a typical value from nothing to its bound, else as far below as above."""
    return (0.0 if row.status == TYPICAL else 2 * row.after_px - row.largest_px), row.largest_px


def unit_of(sheet: Camera, rng: np.random.Generator, reach: float = 3**0.5) -> Camera:
    """A camera of this type: each of its numbers drawn evenly within so many `UNSTATED_U_REL` of what the sheet tells, or is usual."""

    def drawn(element: Element) -> Element:
        if element.source.id not in DRAWN:
            return element
        own = element.params.model_dump()
        numbers = {n: v for n, v in told_values(element).items() if "temperature" not in n}
        told = {n: v * (1 + UNSTATED_U_REL * rng.uniform(-reach, reach)) for n, v in numbers.items()}
        return replace(element, params=element.source.make({**own, **told}))

    return replace(sheet, chain=tuple(drawn(e) for e in sheet.chain), unit_seed=int(rng.integers(1, 2**31)))


def twin_of(name: str, folder: Path, rng: np.random.Generator, reach: float = 3**0.5) -> Twin:
    """Simulate the test of a camera of a sheet's type on a crop of the sensor, assess it, and budget both for one exposure time."""
    sheet = replace(load_camera(name), frame_shape=SHAPE)
    unit = unit_of(sheet, rng, reach)
    well_e = unit["sensor.full_well"].params.full_well_e
    full = well_e / unit["sensor.quantum_efficiency"].params.quantum_efficiency
    scene = {
        "schema": "pixmetry/scene/1",
        "photon_transfer": {"levels": 20, "brightest_photons": 1.15 * full, "longest_exposure_s": 0.01, "stack_frames": 16},
    }
    pixmetry.simulate(unit, scene, folder / "series", seed=int(rng.integers(1, 2**31)))
    pixmetry.assess(folder / "series" / "campaign.yaml", folder / "result", trials=0)
    assessed = replace(load_camera(folder / "result" / "camera.yaml"), exposure_s=sheet.exposure_s)
    return Twin(name, pixmetry.budget(sheet), pixmetry.budget(assessed))
