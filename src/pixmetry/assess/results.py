"""Results of an assessment: the record of the report and of the files."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from pixmetry.assess.self_test import SelfTest
from pixmetry.budget.monte_carlo import Crop
from pixmetry.budget.records import SUM, Budget
from pixmetry.camera.camera import Camera
from pixmetry.camera.colour_bands import ColourBands
from pixmetry.camera.dark_rows import DarkRows
from pixmetry.camera.frame_sequence import FrameSequences
from pixmetry.camera.observations import (
    ActiveArea,
    BrightSpots,
    CoveredPixels,
    DarkTemperatures,
    EdgeResponse,
    LightSteps,
    LineRows,
    Observations,
    SlantedEdges,
    StackMoments,
    Storage,
    StoredBlocks,
)
from pixmetry.camera.response import Response
from pixmetry.camera.speckle import SpeckleFrames
from pixmetry.camera.views import TargetViews
from pixmetry.core.number import Estimates
from pixmetry.emva.files.json_format import value_record
from pixmetry.emva.records import Results
from pixmetry.files import Campaign
from pixmetry.series.records import drift_record, motion_record, recordings_record

RESULTS_SCHEMA = "pixmetry/results/1"


@dataclass(frozen=True)
class Assessment:
    """All results of one campaign.

    Parameters
    ----------
    campaign : Campaign
    observations : Observations
    estimates : dict of Estimates
        By source, named like its parameters.
    unmeasured : dict of str
        By source, why this campaign could not measure it.
    standard : Results
        The values of EMVA 1288 beside ours.
    camera : Camera
        The digital twin.
    budget : Budget
    provenance : dict
    self_test : SelfTest
        The twin beside the camera.
    crop : Crop, optional
        The target of the budget as the twin shows it.
    """

    campaign: Campaign
    observations: Observations
    estimates: dict[str, Estimates]
    unmeasured: dict[str, str]
    standard: Results
    camera: Camera
    budget: Budget
    provenance: dict[str, Any]
    self_test: SelfTest = SelfTest()
    crop: Crop | None = None

    def to_record(self) -> dict[str, Any]:
        """Return the plain record of ``results.json``."""
        fit = self.observations.fit
        facts, storage = self.campaign.camera, self.observations.storage
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
                "vendor": facts.vendor,
                "model": facts.model,
                "serial_number": facts.serial_number,
                "sensor_cols": facts.sensor_cols,
                "sensor_rows": facts.sensor_rows,
                "first_col": facts.first_col,
                "first_row": facts.first_row,
            },
            "conditions": {
                "operator": self.campaign.operator or None,
                "light_source": self.campaign.optics.light_source,
                "lossless": storage.lossless,
                "lossless_known": storage.known,
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
            "spots": None if self.observations.spots is None else spots_record(self.observations.spots),
            "dark_temperatures": None
            if self.observations.dark_temperatures is None
            else dark_temperatures_record(self.observations.dark_temperatures),
            "light_off": None if self.observations.light_off is None else light_off_record(self.observations.light_off),
            "dark_rows": None if self.observations.dark_rows is None else dark_rows_record(self.observations.dark_rows),
            "sequences": None if self.observations.sequences is None else sequences_record(self.observations.sequences),
            "edges": None if self.observations.edges is None else edges_record(self.observations.edges),
            "blocks": None if self.observations.blocks is None else blocks_record(self.observations.blocks, self.observations.storage),
            "active_area": None if self.observations.area is None else area_record(self.observations.area),
            "response": None if self.observations.response is None else response_record(self.observations.response),
            "series": None if self.observations.drift is None else drift_record(self.observations.drift),
            "motion": None if self.observations.motion is None else motion_record(self.observations.motion),
            "bands": None if self.observations.bands is None else bands_record(self.observations.bands),
            "recording": None if self.observations.recordings is None else recordings_record(self.observations.recordings),
            "views": None if self.observations.views is None else views_record(self.observations.views),
            "speckle": None if self.observations.speckle is None else speckle_record(self.observations.speckle),
            "covered": None if self.observations.covered is None else covered_record(self.observations.covered),
            "lines": None if self.observations.lines is None else lines_record(self.observations.lines),
            "emva1288": {
                "release": self.standard.release,
                "results": {key: value_record(value) for key, value in self.standard.values.items()},
                "notes": list(self.standard.notes),
            },
            "budget": self.budget.to_record(),
            "twin": self.self_test.to_record(),
            "notes": list(self.observations.notes),
            "provenance": self.provenance,
        }

    def verdict_text(self) -> str:
        """Return the standard uncertainty of a coordinate in a sentence."""
        budget = self.budget
        one, many = budget.verdicts[0], budget.verdicts[-1]
        um = budget.um(one)
        size = f" = {um[0]:.2g} µm in x, {um[1]:.2g} µm in y" if um is not None else ""
        texts = [(f"{c.total_px:.2g}", f"{c.calibrated_px:.2g}") for c in (one, many)]
        same = all(total == calibrated for total, calibrated in texts)
        first, mean = (
            f"{total} px{um}" + ("" if same else f" ({left} px after a calibration)")
            for (total, left), um in zip(texts, (size, ""), strict=True)
        )
        return (
            f"the standard uncertainty of one coordinate of a target is {first} in one frame (k = 1)"
            f"{', before and after a calibration' * same}; "
            f"in the mean of {many.frames} frames it is {mean}. {self._by()}"
            f"Target: {budget.target.describe()}; {budget.estimator.describe()}."
        )

    def _by(self) -> str:
        """Origin of the verdict, if it is not the sum of the listed contributions."""
        found = self.budget.headline
        return "" if found is None or found.by == SUM else f"{found.why} "

    def maps(self) -> dict[str, np.ndarray]:
        """Return what was measured pixel by pixel: ``dark_dn`` above black, ``prnu_rel``, ``defects``."""
        seen, fit = self.observations, self.observations.fit
        maps: dict[str, np.ndarray] = {}
        if seen.dark_stack is not None:
            black = fit["offset_dn"].value if "offset_dn" in fit else seen.dark_stack.mean_dn
            maps["dark_dn"] = (seen.dark_stack.mean_map_dn - black).astype(np.float32)
        if seen.defects is not None:
            mask = seen.defects.mask()
            maps["defects"] = mask.astype(np.uint8)
            if seen.dark_stack is not None and seen.bright_stack is not None and seen.spatial_fit is not None:
                gain = 1.0 if seen.taps is None else seen.taps.gain  # of the taps: a source of its own
                maps["prnu_rel"] = _response_map(seen.dark_stack, seen.bright_stack, mask, gain).astype(np.float32)
        return maps


def edges_record(found: SlantedEdges) -> dict[str, Any]:
    """The plain record of slanted edges: counts, values, the mean responses, and every edge in a line."""

    def mean(response: EdgeResponse | None) -> dict[str, Any] | None:
        if response is None:
            return None
        return {"edges": response.edges, "sfr": response.sfr.tolist(), "u": np.sqrt(np.diag(response.covariance)).tolist()}

    names = (
        *("picture", "across", "x_px", "y_px", "angle_deg", "u_angle_deg", "order", "rows", "low_dn", "high_dn", "rising", "noise_dn"),
        *("sfr50", "u_sfr50", "asymmetry", "u_asymmetry"),
    )
    each = [{name: getattr(e, name) for name in names} for e in found.edges]
    return {
        "measured": len(found.edges),
        "refused": [asdict(r) for r in found.refused],
        "values": found.fit.to_records(),
        "optics": _joint_record(found.optics),
        "line": None if found.line is None else _joint_record(found.line),
        "frequency_cycles_per_px": found.frequency.tolist(),
        "x": mean(found.x),
        "y": mean(found.y),
        "edges": [{k: None if isinstance(v, float) and not np.isfinite(v) else v for k, v in e.items()} for e in each],
    }


def _joint_record(found: Estimates) -> dict[str, Any]:
    """The plain record of values that were fitted together."""
    return {
        "estimates": found.to_records(),
        "names": list(found.names),
        "settings": dict(found.settings),
        "covariance": found.covariance.tolist(),
        "confounders": list(found.confounders),
        "not_told": {name: why for name, why in found.reasons.items() if name not in found},
    }


def spots_record(found: BrightSpots) -> dict[str, Any]:
    """The plain record of bright spots."""
    told = [found.level_up_s, found.level_down_s, found.u_level_s]
    return {
        "spots": [asdict(s) for s in found.spots],
        "exposure_s": found.exposure_s.tolist(),
        "peak_dn": found.peak_dn.tolist(),
        "saturated": found.saturated.tolist(),
        "clipped_by_converter": found.clipped,
        **{
            name: [float(v) if np.isfinite(v) else None for v in values]
            for name, values in zip(("level_up_s", "level_down_s", "u_level_s"), told, strict=True)
        },
        "smear_rows": found.smear_rows,
        "smear_store": found.smear_store,
        "streaks": 0 if found.streaks is None else len(found.streaks),
        "values": found.fit.to_records(),
        "not_told": {name: why for name, why in found.fit.reasons.items() if name not in found.fit},
    }


def dark_temperatures_record(found: DarkTemperatures) -> dict[str, Any]:
    """The plain record of the dark current at several temperatures."""
    return {
        "temperature_c": found.temperature_c.tolist(),
        "rate_dn_per_s": found.rate_dn_per_s.tolist(),
        "u_rate_dn_per_s": found.u_rate_dn_per_s.tolist(),
        "reference_c": found.reference_c,
        "values": found.fit.to_records(),
        "not_told": {name: why for name, why in found.fit.reasons.items() if name not in found.fit},
    }


def light_off_record(found: LightSteps) -> dict[str, Any]:
    """The plain record of sequences in which the light went off."""
    each = [
        {
            "bright_frames": s.bright_frames,
            "signal_dn": s.signal_dn,
            "shares": s.shares.tolist(),
            "u_first_two": list(s.u_shares),
            "noise_correlation": s.noise_correlation if np.isfinite(s.u_noise_correlation) else None,
            "levels_dn": s.levels_dn.tolist(),
            "left_dn": s.left_dn.tolist(),
            "u_left_dn": np.sqrt(np.diag(s.left_covariance_dn2)).tolist(),
        }
        for s in found.steps
    ]
    return {"values": found.fit.to_records(), "refused": list(found.refused), "sequences": each}


def dark_rows_record(found: DarkRows) -> dict[str, Any]:
    """The plain record of the rows of dark frames."""
    return {
        "frames": found.frames,
        "line_px": found.line_px,
        "hum": _joint_record(found.hum),
        "flicker": _joint_record(found.flicker),
        "taken_dn2": {name: list(value) for name, value in found.taken.items()},
    }


def sequences_record(found: FrameSequences) -> dict[str, Any]:
    """The plain record of frames in a row: what they tell together, and the gain of each frame."""
    each = [
        {
            "frames": len(s.level_dn),
            "interval_s": s.interval_s or None,
            "exposure_s": s.exposure_s or None,
            "static_share": s.static_share,
            "changes": s.changes,
            "gain_rel": s.gain_rel.tolist(),
            "u_gain_rel": np.sqrt(s.covariance[:, 0, 0]).tolist(),
            "offset_dn": s.offset_dn.tolist(),
            "u_offset_dn": np.sqrt(s.covariance[:, 1, 1]).tolist(),
            "gain_share": s.gain_share if np.isfinite(s.u_gain_share) else None,
            "u_gain_share": s.u_gain_share if np.isfinite(s.u_gain_share) else None,
            "black_moves_dn": s.black_moves_dn,
            "wave": None if s.wave is None else asdict(s.wave),
            "loop": _joint_record(s.loop),
        }
        for s in found.sequences
    ]
    return {"loop": _joint_record(found.loop), "lamp": _joint_record(found.lamp), "refused": list(found.refused), "sequences": each}


def area_record(found: ActiveArea) -> dict[str, Any]:
    """The plain record of the active area in the stored frames."""
    sides = {name: getattr(found, name) for name in ("left", "right", "top", "bottom", "beat", "beat_power")}
    return {
        "values": found.fit.to_records(),
        "not_told": {name: why for name, why in found.fit.reasons.items() if name not in found.fit},
        **{name: float(v) if np.isfinite(v) else None for name, v in sides.items()},
    }


def blocks_record(found: StoredBlocks, storage: Storage) -> dict[str, Any]:
    """The plain record of the traces of a lossy coder."""
    return {
        "values": found.fit.to_records(),
        "not_told": {name: why for name, why in found.fit.reasons.items() if name not in found.fit},
        "steps": found.table.astype(int).tolist(),
        "steps_of_file": None if storage.table is None else list(storage.table),
        "offset_rows_cols": list(found.offset),
        "log_likelihood_ratio": found.score,
        "coefficients": found.coefficients,
        "repeated_share": found.repeated_share if np.isfinite(found.repeated_share) else None,
    }


def response_record(found: Response) -> dict[str, Any]:
    """The plain record of the response to light: its curve, the patches, and why others were refused."""

    def numbers(values: np.ndarray) -> list[float | None]:
        return [float(v) if np.isfinite(v) else None for v in values]

    patches = [{k: None if isinstance(v, float) and not np.isfinite(v) else v for k, v in asdict(p).items()} for p in found.patches]
    return {
        "curve": found.curve or None,
        "tried": [asdict(f) for f in found.tried],
        "estimates": found.fit.to_records(),
        "names": list(found.fit.names),
        "covariance": found.fit.covariance.tolist(),
        "not_told": {name: why for name, why in found.fit.reasons.items() if name not in found.fit},
        "choices": {source: dict(names) for source, names in found.choices.items()},
        "oecf": {
            "level_dn": numbers(found.level_dn),
            "light_rel": numbers(found.light_rel),
            "u_light_rel": numbers(found.u_light_rel),
            "gain_dn_per_e": numbers(found.gain_dn_per_e),
        },
        "patches": patches,
        "refused": list(found.refused),
    }


def covered_record(found: CoveredPixels) -> dict[str, Any]:
    """The plain record of covered columns and rows."""
    trails = [
        {
            "axis": t.axis,
            "transfers": t.transfers,
            "signal_dn": t.signal_dn.tolist(),
            "first_dn": t.first_dn.tolist(),
            "u_first_dn": t.u_first_dn.tolist(),
            "shape": t.shape.tolist(),
            "u_shape": t.u_shape.tolist(),
        }
        for t in found.trails
    ]
    noise = [{"exposure_s": exposure_s, "row_noise_dn": value, "u": u} for exposure_s, value, u in found.row_noise]
    told = {name: why for name, why in found.fit.reasons.items() if name not in found.fit}
    return {"borders": asdict(found.covered), "values": found.fit.to_records(), "not_told": told, "trails": trails, "row_noise": noise}


def bands_record(found: ColourBands) -> dict[str, Any]:
    """The plain record of targets in light of several wavelengths: values, and a line for each band."""

    def number(value: float) -> float | None:
        return float(value) if np.isfinite(value) else None

    columns = (
        *("level_dn_per_s", "u_level_dn_per_s", "blur_var_px2", "u_blur_var_px2", "radius_px", "shift_x_px", "shift_y_px", "scale_rel"),
        *("u_scale_rel", "focus_um"),
    )
    bands = [
        {
            "wavelength_nm": float(found.wavelength_nm[k]),
            "band": found.names[k] or None,
            "filtered": bool(found.filtered[k]),
            "frames": int(found.frames[k]),
            "targets": int(found.targets[k]),
            **{name: number(getattr(found, name)[k]) for name in columns},
        }
        for k in range(len(found.wavelength_nm))
    ]
    through = zip(found.transmittance_nm.tolist(), found.transmittance.tolist(), found.u_transmittance.tolist(), strict=True)
    return {
        "bands": bands,
        "transmittance": [{"wavelength_nm": nm, "value": value, "u": u} for nm, value, u in through],
        "colour": _joint_record(found.colour),
        "diffusion": _joint_record(found.diffusion),
        "filter": _joint_record(found.filter),
    }


def views_record(found: TargetViews) -> dict[str, Any]:
    """The plain record of targets seen or lit from several sides: values, a line for each view and for each target in it."""
    names = (
        *("view", "x_px", "y_px", "gradient_x_per_px", "gradient_y_per_px", "u_gradient_x_per_px", "u_gradient_y_per_px"),
        *("semi_major_px", "semi_minor_px", "centroid_x_px", "centroid_y_px", "predicted_x_px", "predicted_y_px", "amplitude_dn_per_s"),
    )
    columns = [getattr(found, name).tolist() for name in names]
    targets = [
        {n: None if isinstance(v, float) and not np.isfinite(v) else v for n, v in zip(names, row, strict=True)}
        for row in zip(*columns, strict=True)
    ]
    return {
        **_joint_record(found.fit),
        "surface": found.surface,
        "principal_distance_px": found.principal_distance_px,
        "angle_deg": found.angle_deg.tolist(),
        "u_angle_deg": found.u_angle_deg.tolist(),
        "eccentricity_px": None if found.eccentricity_px is None else found.eccentricity_px.tolist(),
        "centroids_explained": None if np.isnan(found.slope) else {"value": found.slope, "u": found.u_slope},
        "targets": targets,
    }


def speckle_record(found: SpeckleFrames) -> dict[str, Any]:
    """The plain record of laser spots on a surface that moves: one for each group of frames, and why others were refused."""
    spots = [
        {
            **_joint_record(s.fit),
            "frames": s.frames,
            "left_out": s.left_out,
            "effective_frames": s.effective_frames,
            "wavelength_nm": s.wavelength_nm,
            "radius_px": s.radius_px,
            "u_located_px": s.u_located_px,
            "scatter_px2": s.scatter_px2.tolist(),
            "predicted_px2": None if s.predicted_px2 is None else s.predicted_px2.tolist(),
            "dof": s.dof,
            "degree_of_path": s.degree,
            "x_px": s.x_px.tolist(),
            "y_px": s.y_px.tolist(),
            "pattern_correlation": s.pattern_correlation.tolist(),
            "stays_rel": s.stays_rel,
            "saturated_rel": s.saturated_rel,
            "noise_rel": s.noise_rel,
            "lags_px": s.lags_px.tolist(),
            "covariance_rel": s.covariance_rel.tolist(),
            "model_rel": s.model_rel.tolist(),
        }
        for s in found.spots
    ]
    return {"spots": spots, "refused": list(found.refused)}


def lines_record(found: LineRows) -> dict[str, Any]:
    """The plain record of the rows of upright lines: what they have in common, and a line for each line."""

    def fitted(fit: Estimates) -> dict[str, Any]:
        told = {name: why for name, why in fit.reasons.items() if name not in fit}
        return {"estimates": fit.to_records(), "names": list(fit.names), "covariance": fit.covariance.tolist(), "not_told": told}

    each = [
        {
            "picture": line.picture,
            "kind": line.kind,
            "x_px": float(np.median(line.place_px)),
            "first_row": int(line.row[0]),
            "rows": len(line.row),
            "frames": len(line.shift_px),
            "height_dn": line.height_dn,
            "noise_dn": line.noise_dn,
            "u_row_px": float(np.sqrt((line.u_px**2).mean())),
            "rms_px": float(line.shift_px.std()),
        }
        for line in found.lines
    ]
    return {"jitter": fitted(found.jitter), "taped": fitted(found.taped), "refused": [asdict(r) for r in found.refused], "lines": each}


def _response_map(dark: StackMoments, bright: StackMoments, mask: np.ndarray, gain: np.ndarray | float) -> np.ndarray:
    """Relative response with the illumination's slow part taken out, shrunk to what is known of it.

    A map averaged over L frames still holds noise of variance t/L. What is predicted best from it is the map times
    s²/(s² + t/L) (the linear predictor of least variance), s² from the split of the stack.
    """
    from pixmetry.observe.surface import fill, fit_surface

    light = fill((bright.mean_map_dn - dark.mean_map_dn) / gain, mask)
    surface = fit_surface(light, 4).values
    relative = light / surface - 1.0
    noise = (bright.ms_pixel_dn2 / bright.n_frames + dark.ms_pixel_dn2 / dark.n_frames) / float(surface.mean()) ** 2
    fixed = max(float(relative.var()) - noise, 0.0)
    response: np.ndarray = 1.0 + relative * (fixed / (fixed + noise))
    return response
