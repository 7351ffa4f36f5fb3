"""What a series is: its frames, and the motion of their image."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from pixmetry.camera.drift_series import DriftSeries
from pixmetry.camera.motion_series import MotionSeries
from pixmetry.camera.recordings import Recordings

SERIES_SCHEMA = "pixmetry/series/1"


@dataclass(frozen=True)
class Series:
    """A series and the motion of its image.

    Parameters
    ----------
    drift : DriftSeries
    frames : tuple of str
        Names, in order of time.
    frame_shape : (int, int)
    notes : tuple of str
    provenance : dict
    """

    drift: DriftSeries
    frames: tuple[str, ...]
    frame_shape: tuple[int, int]
    notes: tuple[str, ...] = ()
    provenance: dict[str, Any] = field(default_factory=dict)

    def to_record(self) -> dict[str, Any]:
        """Return the plain record of ``series.json``."""
        return {
            "schema": SERIES_SCHEMA,
            "rows": self.frame_shape[0],
            "cols": self.frame_shape[1],
            **drift_record(self.drift),
            "names": list(self.frames),
            "notes": list(self.notes),
            "provenance": self.provenance,
        }


def drift_record(drift: DriftSeries) -> dict[str, Any]:
    """The plain record of the motion of an image."""
    return {
        "targets": drift.targets,
        "location_factor": drift.location_factor,
        "estimates": drift.fit.to_records(),
        "names_of_covariance": list(drift.fit.names),
        "covariance": drift.fit.covariance.tolist(),
        "confounders": list(drift.fit.confounders),
        "not_told": {name: why for name, why in drift.fit.reasons.items() if name not in drift.fit},
        "stable": drift.stable.to_record(),
        "tolerance_px": drift.tolerance_px,
        "focus": drift.focus.to_record(),
        "blur_px2": drift.blur_px2.tolist(),
        "u_blur_px2": drift.u_blur_px2.tolist(),
        "modes": list(drift.modes),
        "time_s": drift.time_s.tolist(),
        "motion": drift.values.tolist(),
        "u_motion": drift.u.tolist(),
        "curve": drift.fitted.tolist(),
        "from_settled_px": drift.from_settled_px.tolist(),
        "u_from_settled_px": drift.u_from_settled_px.tolist(),
    }


def motion_record(motion: MotionSeries) -> dict[str, Any]:
    """The plain record of frames of moving targets."""
    return {
        "frames": motion.frames,
        "targets": motion.targets,
        "estimates": motion.fit.to_records(),
        "not_told": {name: why for name, why in motion.fit.reasons.items() if name not in motion.fit},
        "speed_px_s": motion.speed_px_s.tolist(),
        "lag_px": motion.lag_px.tolist(),
        "u_lag_px": motion.u_lag_px.tolist(),
        "shear": motion.shear.tolist(),
        "u_shear": motion.u_shear.tolist(),
        "stated_exposure_s": motion.stated_exposure_s,
        "names_of_covariance": list(motion.fit.names),
        "covariance": motion.fit.covariance.tolist(),
        "confounders": list(motion.fit.confounders),
    }


def recordings_record(found: Recordings) -> dict[str, Any]:
    """The plain record of a scene that was seen directly and recorded."""

    def plain(values: np.ndarray) -> list[float | None]:
        return [float(v) if np.isfinite(v) else None for v in values]

    return {
        "direct_frames": found.direct_frames,
        "recorded_frames": found.recorded_frames,
        "estimates": found.fit.to_records(),
        "settings": dict(found.fit.settings),
        "not_told": {name: why for name, why in found.fit.reasons.items() if name not in found.fit},
        "row_jitter_recorded": found.played.to_records(),
        "row_jitter_direct": found.direct.to_records(),
        "frequency_per_px": found.frequency.tolist(),
        "transfer": plain(found.transfer),
        "u_transfer": plain(found.u_transfer),
        "difference_dn2": plain(found.difference_dn2),
        "direct_difference_dn2": found.direct_difference_dn2,
        "row_shift_px": plain(found.step_px),
    }
