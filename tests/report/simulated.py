"""An assessment of a simulated camera, made without the pipeline: frames by plain NumPy, a budget with chosen numbers."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path

import numpy as np

from pixmetry.assess.results import Assessment
from pixmetry.budget.advice import advise
from pixmetry.budget.combine import combine
from pixmetry.budget.job import Budget, BudgetRow, Interaction
from pixmetry.budget.monte_carlo import Axis, MonteCarlo
from pixmetry.budget.probe import Facts, Target
from pixmetry.camera.catalogue import get_source
from pixmetry.camera.contribution import Contribution
from pixmetry.camera.observations import Observations
from pixmetry.emva.evaluate import standard_values
from pixmetry.emva.records import Measurement
from pixmetry.files.records import CameraFacts, Campaign, FrameGroup, OpticsFacts
from pixmetry.locate.centroids.fixed import FixedCentroid
from pixmetry.observe.observe import Group, observe

GAIN, NOISE_E, OFFSET, BITS, SHAPE = 0.25, 12.0, 40.0, 12, (96, 120)
LEVELS, STACK = 14, 16
TOP_E = (2**BITS - 1 - OFFSET) / GAIN


@lru_cache(maxsize=2)
def observations(with_stacks: bool = True) -> Observations:
    """What frames of a known camera are reduced to."""
    rng = np.random.default_rng(20240611)
    response = 1 + 0.01 * rng.standard_normal(SHAPE)
    dark_map = 0.5 * rng.standard_normal(SHAPE)

    def frames(share: float, count: int) -> list[np.ndarray]:
        electrons = rng.poisson(share * TOP_E * response, (count, *SHAPE)) + NOISE_E * rng.standard_normal((count, *SHAPE))
        linear = GAIN * electrons
        stored = OFFSET + dark_map + linear * (1 - 0.02 * linear / 2**BITS)
        return list(np.clip(np.rint(stored), 0, 2**BITS - 1).astype(np.uint16))

    exposures = 0.001 * np.arange(1, LEVELS + 1)
    groups = [Group("dark", "level", t, 0.0, frames(0.0, 2)) for t in exposures]
    groups += [Group("bright", "level", t, None, frames(1.1 * t / exposures[-1], 2)) for t in exposures]
    if with_stacks:
        groups += [Group("dark", "stack", 0.007, 0.0, frames(0.0, STACK)), Group("bright", "stack", 0.007, None, frames(0.55, STACK))]
    return observe(groups, BITS)


def campaign(pitch_um: float | None = 7.4, name: str = "Simulated <camera> & co.") -> Campaign:
    """A campaign record with the facts of these frames; its files do not exist."""
    groups = tuple(
        FrameGroup(kind, 0.001 * (k + 1), None, tuple(Path(f"{kind}{k}_{i}.png") for i in range(2)), "level")
        for kind in ("dark", "bright")
        for k in range(LEVELS)
    )
    facts = CameraFacts(name, BITS, pitch_um, pitch_um, sensor="cmos")
    words = {"licence": "CC0, made for a test", "notes": "A note of the campaign."}
    return Campaign(facts, OpticsFacts(), groups, SHAPE, "uint16", Path("campaign.yaml"), **words)


PITCH_UM = 7.4
# source, status, u_x, u_y, bias_x, bias_y in px, class
CONTRIBUTIONS = (
    ("sensor.shot_noise", "modelled", 0.03, 0.02, 0.0, 0.0, "T"),
    ("sensor.prnu", "measured", 0.0, 0.0, 0.0, 0.02, "F"),
    ("electronics.row_noise", "measured", 0.04, 0.01, 0.0, 0.0, "Tr"),
    ("storage.jpeg", "accepted", 0.12, 0.04, 0.0, 0.0, "F"),
)


def budget(pitch_um: float | None = PITCH_UM) -> Budget:
    """A budget of chosen numbers: (0.05, 0.03) px measured and modelled, (0.13, 0.05) px with what is accepted."""
    rows = []
    for source_id, status, ux, uy, bx, by, gum_class in CONTRIBUTIONS:
        c = Contribution(ux, uy, gum_class, bx, by)
        simulated = None if status == "accepted" else monte_carlo(ux, uy, bx, by, (source_id,))
        title = get_source(source_id).title
        rows.append(BudgetRow(source_id, source_id, title, status, c, 0.1 * c.total_px, simulated, 0.25, 0.5 * c.total_px, "a reason"))
    rows.append(BudgetRow("cable.termination", "cable.termination", "Cable", "not applicable", reason="only in a camera that is analogue"))
    rows.sort(key=lambda r: (r.status == "accepted", -r.total_px))
    decided = [r.contribution for r in rows if r.status in ("measured", "modelled")]
    everything = [r.contribution for r in rows if r.contribution is not None]
    one, every = (tuple(combine(c, frames=n) for n in (1, 4, 16, 64)) for c in (decided, everything))
    facts = Facts(0.1, 0.25, 4000.0, 3.0, BITS, 0.007, 20.0, SHAPE)
    pitch = None if pitch_um is None else (pitch_um, pitch_um)
    interaction = Interaction(monte_carlo(0.0505, 0.0305, 0.0, 0.0, ("all",)), 0.0412, 0.0004)
    estimator = FixedCentroid().resolved(80.0, 3.0)
    return Budget("simulated", Target(), estimator, facts, pitch, tuple(rows), one, every, advise(rows, one[0], every[0]), interaction)


def monte_carlo(ux: float, uy: float, bx: float, by: float, names: tuple[str, ...]) -> MonteCarlo:
    """A result of a Monte Carlo with standard errors of two percent."""
    x, y = (Axis(b, u, u, 0.0, 0.02 * u, 0.02 * u, 0.02 * u, 0.0) for b, u in ((bx, ux), (by, uy)))
    return MonteCarlo(x, y, names, 8, 64, 2, 0, "frozen", 0.0)


def assessment(pitch_um: float | None = PITCH_UM, with_stacks: bool = True) -> Assessment:
    """All of it together, as the pipeline would hand it to the report."""
    seen = observations(with_stacks)
    fit = seen.photon_transfer_fit
    record = {
        "schema": "pixmetry/provenance/1",
        "pixmetry": "0.0",
        "python": "3.11",
        "libraries": {"numpy": "2.0"},
        "platform": "Linux x86_64",
        "time_utc": "2024-06-11T12:00:00+00:00",
        "command": ["pixmetry", "assess", "campaign.yaml"],
        "seed": 5,
        "inputs": [{"name": f"bright{k}.png", "sha256": f"{k:064x}", "size_bytes": 1000 + k} for k in range(7)],
    }
    return Assessment(
        campaign=campaign(pitch_um),
        observations=seen,
        estimates={"electronics.gain": fit.select(["gain_dn_per_e"])},
        unmeasured={"storage.jpeg": "the files do not tell how strongly they were compressed"},
        standard=standard_values(Measurement(seen.photon_transfer, seen.dark_stack, seen.bright_stack), "3.1"),
        camera=None,
        budget=budget(pitch_um),
        provenance=record,
    )
