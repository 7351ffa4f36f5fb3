"""The main job: from a campaign's frames to what the camera does to a target's position."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from pixmetry.budget.budget import Budget, compute_budget
from pixmetry.campaign import Campaign, FrameReader, InputHashes, load_campaign, provenance_record, staged_output, write_json, write_maps
from pixmetry.core.camera import Camera, Element
from pixmetry.core.catalogue import catalogue
from pixmetry.core.errors import MeasureError
from pixmetry.core.estimates import Estimates
from pixmetry.core.observations import Observations
from pixmetry.experiment.emva_linear import fit_emva_linear
from pixmetry.experiment.observe import Group, observe

RESULTS_SCHEMA = "pixmetry/results/1"
DIGITAL_CHAIN = (  # what dark and bright frames can tell of a camera, in the order of the light
    "optics.shading",
    "sensor.quantum_efficiency",
    "sensor.prnu",
    "sensor.dark_current",
    "sensor.defects",
    "sensor.shot_noise",
    "sensor.full_well",
    "sensor.dsnu",
    "electronics.amplifier_noise",
    "electronics.row_noise",
    "electronics.gain",
    "electronics.nonlinearity",
    "grabber.phase_pattern",
    "grabber.adc",
)
LIMIT_RMS = np.sqrt(1 / 3)  # rms of a quantity that is spread evenly between 0 and its upper limit, over that limit

Progress = Callable[[str, int, int], None]


@dataclass(frozen=True)
class Assessment:
    """All that one campaign told of its camera.

    Parameters
    ----------
    campaign : Campaign
    observations : Observations
    estimates : dict of Estimates
        By source, named like its parameters.
    unmeasured : dict of str
        By source, why this campaign could not measure it.
    standard : Estimates
        The linear rule of EMVA 1288 beside ours.
    camera : Camera
        The digital twin.
    budget : Budget
    provenance : dict
    """

    campaign: Campaign
    observations: Observations
    estimates: dict[str, Estimates]
    unmeasured: dict[str, str]
    standard: Estimates
    camera: Camera
    budget: Budget
    provenance: dict[str, Any]

    def to_record(self) -> dict[str, Any]:
        """Return the plain record of ``results.json``."""
        fit = self.observations.photon_transfer_fit
        facts = self.campaign.camera
        return {
            "schema": RESULTS_SCHEMA,
            "camera": {
                "name": facts.name,
                "bits": facts.bits,
                "rows": self.campaign.frame_shape[0],
                "cols": self.campaign.frame_shape[1],
                "pitch_x_um": facts.pitch_x_um,
                "pitch_y_um": facts.pitch_y_um,
                "interface": facts.interface,
                "sensor": facts.sensor,
            },
            "estimates": {source: e.to_records() for source, e in self.estimates.items()},
            "unmeasured": self.unmeasured,
            "photon_transfer": {
                "estimates": fit.to_records(),
                "names": list(fit.names),
                "covariance": fit.covariance.tolist(),
                "confounders": list(fit.confounders),
            },
            "spatial": self.observations.spatial_fit.to_records() if self.observations.spatial_fit is not None else [],
            "emva1288_linear": self.standard.to_records(),
            "budget": self.budget.to_record(),
            "notes": list(self.observations.notes),
            "provenance": self.provenance,
        }

    def maps(self) -> dict[str, np.ndarray]:
        """Return what was measured pixel by pixel: ``dark_dn`` above black, ``prnu_rel``, ``defects``."""
        seen, fit = self.observations, self.observations.photon_transfer_fit
        maps: dict[str, np.ndarray] = {}
        if seen.dark_stack is not None:
            maps["dark_dn"] = (seen.dark_stack.mean_map_dn - fit["offset_dn"].value).astype(np.float32)
        if seen.defects is not None:
            maps["defects"] = seen.defects.mask().astype(np.uint8)
        if seen.dark_stack is not None and seen.bright_stack is not None and seen.spatial_fit is not None:
            maps["prnu_rel"] = _response_map(seen).astype(np.float32)
        return maps

    def write(self, directory: str | Path) -> Path:
        """Write report, results, maps and the twin into a folder, whole or not at all; return the path of the report."""
        from pixmetry.report.page import write_report

        with staged_output(directory) as folder:
            write_json(folder / "results.json", self.to_record())
            write_maps(folder / "maps.zarr.zip", self.maps(), {"camera": self.campaign.camera.name})
            self.camera.save(folder / "camera.yaml")
            write_report(self, folder / "report.html")
        return Path(directory) / "report.html"


def _response_map(seen: Observations) -> np.ndarray:
    """Relative response with the illumination's slow part taken out, shrunk to what is known of it.

    A map averaged over L frames still holds noise of variance t/L. What is predicted best from it is the map times
    s²/(s² + t/L) (the linear predictor of least variance), s² from the split of the stack.
    """
    from pixmetry.experiment.surface import fill, fit_surface

    bright, dark, mask = seen.bright_stack, seen.dark_stack, seen.defects.mask()
    light = fill(bright.mean_map_dn - dark.mean_map_dn, mask)
    surface = fit_surface(light, 4).values
    relative = light / surface - 1.0
    noise = (bright.ms_pixel_dn2 / bright.n_frames + dark.ms_pixel_dn2 / dark.n_frames) / float(surface.mean()) ** 2
    fixed = max(float(relative.var()) - noise, 0.0)
    return 1.0 + relative * (fixed / (fixed + noise))


def assess(
    campaign: str | Path | Campaign | None = None,
    output: str | Path | None = None,
    *,
    target: str = "",
    estimator: str = "",
    trials: int = 4000,
    seed: int = 1,
    progress: Progress | None = None,
    threads: int | None = None,
) -> Assessment:
    """Assess a camera from its dark and bright frames.

    Parameters
    ----------
    campaign : path, Campaign or None
        A manifest, an EMVA 1288 descriptor, a folder with one of them, or None for the packaged example.
    output : path, optional
        Folder for ``report.html``, ``results.json``, ``maps.zarr.zip`` and ``camera.yaml``.
    target, estimator : str
        As on the command line, e.g. ``"disc:diameter=7,blur=0.7,peak=0.6"`` and ``"soft_threshold:sigma=3,window=13"``.
    trials : int
        Windows for each Monte Carlo of the budget.
    seed : int
        Of the Monte Carlo.
    progress : callable, optional
        Called with (what, done, of).
    threads : int, optional

    Returns
    -------
    Assessment

    Raises
    ------
    InputError, MeasureError
        If a file or the campaign cannot be used, or the frames do not carry a photon transfer.
    """
    from pixmetry.budget.probe import parse_estimator, parse_target

    what_target, what_estimator = parse_target(target), parse_estimator(estimator)
    frames = campaign if isinstance(campaign, Campaign) else load_campaign(campaign)
    told = progress or (lambda what, done, of: None)
    hashes, seen = observe_campaign(frames, told, threads)
    estimates, unmeasured = measure_sources(seen)
    camera = digital_twin(frames, estimates, seen)
    budget = compute_budget(
        camera, estimates, frames.camera, what_target, what_estimator, trials=trials, seed=seed, progress=told, unmeasured=unmeasured
    )
    record = provenance_record(hashes, seed=seed, libraries=("numpy", "scipy", "numba"))
    standard = fit_emva_linear(seen.photon_transfer)
    assessment = Assessment(frames, seen, estimates, unmeasured, standard, camera, budget, record)
    if output is not None:
        told("writing the report", 0, 1)
        assessment.write(output)
        told("writing the report", 1, 1)
    return assessment


def observe_campaign(campaign: Campaign, progress: Progress, threads: int | None = None) -> tuple[InputHashes, Observations]:
    """Read every frame once and reduce it."""
    done = 0

    def on_frame() -> None:
        nonlocal done
        done += 1
        progress("reading frames", done, campaign.frame_count)

    reader = FrameReader(campaign, threads=threads, on_frame=on_frame)

    def groups() -> Iterator[Group]:
        for g in campaign.groups:
            yield Group(g.kind, g.role, g.exposure_s, g.photons, reader.frames(g))

    seen = observe(groups(), campaign.bits, campaign.camera.temperature_c)
    for path in {campaign.source_path, campaign.descriptor_path} - {None}:
        reader.hashes.add_file(path)
    return reader.hashes, seen


def measure_sources(observations: Observations) -> tuple[dict[str, Estimates], dict[str, str]]:
    """Ask every source what the observations say of it: estimates, and by source the reason where there are none."""
    estimates, unmeasured = {}, {}
    for source in catalogue().values():
        if source.measure is None:
            unmeasured[source.id] = source.reasons["measure"]
            continue
        try:
            estimates[source.id] = source.measure(observations)
        except MeasureError as problem:
            unmeasured[source.id] = str(problem)
    return estimates, unmeasured


def digital_twin(campaign: Campaign, estimates: dict[str, Estimates], observations: Observations) -> Camera:
    """Build the camera that makes frames like the real ones, from what was measured.

    An upper limit enters by the rms of an even spread between 0 and the limit. Without a photon count the quantum efficiency is 1, and a
    scene's photons are electrons.
    """
    facts, elements = campaign.camera, []
    given = {
        "electronics.nonlinearity": {"reference_dn": float(2**campaign.bits - 1)},
        "grabber.adc": {"bits": campaign.bits},
        "sensor.quantum_efficiency": {"quantum_efficiency": 1.0},
    }
    if facts.temperature_c is not None:
        given["sensor.dark_current"] = {"reference_temperature_c": facts.temperature_c}
    always = ("sensor.shot_noise", *given)
    for source_id in DIGITAL_CHAIN:
        source = catalogue()[source_id]
        if source_id not in estimates and source_id not in always:
            continue
        values = given.get(source_id, {}) | best_values(estimates.get(source_id, Estimates.empty()))
        elements.append(Element(source_id, source, source.make(values, where=f"digital twin, {source_id}")))
    pitch = None if facts.pitch_x_um is None else (facts.pitch_x_um, facts.pitch_y_um or facts.pitch_x_um)
    stack = observations.bright_stack
    exposure = stack.exposure_s if stack is not None else float(np.median(observations.photon_transfer.bright.exposure_s))
    photons_known = "sensor.quantum_efficiency" in estimates
    return Camera(
        name=facts.name,
        frame_shape=campaign.frame_shape,
        chain=tuple(elements),
        pitch_um=pitch,
        exposure_s=exposure,
        temperature_c=20.0 if facts.temperature_c is None else facts.temperature_c,
        facts={
            "interface": facts.interface,
            "bits": campaign.bits,
            "source": f"assessed from {campaign.source_path.name}",
            "photons": "photons" if photons_known else "electrons: no photon count was given, the quantum efficiency is set to 1",
        },
    )


def best_values(estimates: Estimates) -> dict[str, float]:
    """Return values for a simulation: estimates as they are, upper limits by their rms."""
    return {e.name: e.value * (LIMIT_RMS if e.kind == "upper_limit" else 1.0) for e in estimates}
