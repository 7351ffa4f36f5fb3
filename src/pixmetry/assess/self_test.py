"""The test of a digital twin: it takes the campaign of its camera, and its frames must give the camera's own values."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from pixmetry.camera.camera import Camera
from pixmetry.camera.observations import Observations, StackMoments
from pixmetry.core.errors import InputError, MeasureError
from pixmetry.emva.evaluate import standard_values
from pixmetry.emva.records import Measurement, Results
from pixmetry.emva.reduction import measure_frames
from pixmetry.files import Campaign
from pixmetry.observe.linearity import Linearity
from pixmetry.observe.one_pass import Group
from pixmetry.scene.uniform import Uniform

TEST_SEED = 1_000_000_007  # so that a campaign that was simulated with a small seed has other noise than its twin
TEST_PIXELS = 26_000_000  # of all frames of the self-test together, about
TEST_STACK, TEST_LEVELS = 16, 12  # fewest frames of a stack and levels of each kind that it takes, if the campaign has them
SMALLEST_WINDOW = 64


@dataclass(frozen=True)
class Exposure:
    """Frames of one condition that the twin is to make: as a group of the campaign, with the light that its bright frames saw."""

    kind: str
    role: str
    exposure_s: float
    photons: float | None
    frames: int


@dataclass(frozen=True)
class Compared:
    """One value of the camera and of its twin."""

    name: str
    unit: str
    camera: float
    u_camera: float
    twin: float
    u_twin: float

    @property
    def difference_u(self) -> float:
        """Twin less camera, over the standard uncertainty of the difference."""
        return (self.twin - self.camera) / math.hypot(self.u_camera, self.u_twin)


@dataclass(frozen=True)
class SelfTest:
    """Values of camera and twin.

    Parameters
    ----------
    rows : tuple of Compared
    frames, of : int
        Frames of the twin that were reduced, and of the campaign.
    window : (int, int, int, int), optional
        First row and column, rows and columns of the part of the frames that was compared; None for all of them.
    reason : str
        Why there are no rows.
    """

    rows: tuple[Compared, ...] = ()
    frames: int = 0
    of: int = 0
    window: tuple[int, int, int, int] | None = None
    reason: str = ""

    @property
    def worst(self) -> Compared | None:
        """The value that differs by most u."""
        return max(self.rows, key=lambda row: abs(row.difference_u), default=None)

    def to_record(self) -> dict[str, Any]:
        """The plain record of ``results.json``."""
        rows = [
            {
                "name": r.name,
                "unit": r.unit,
                "camera": r.camera,
                "u_camera": r.u_camera,
                "twin": r.twin,
                "u_twin": r.u_twin,
                "difference_u": r.difference_u,
            }
            for r in self.rows
        ]
        return {"values": rows, "frames": self.frames, "frames_of_campaign": self.of, "window": self.window, "reason": self.reason}


def exposures_of(campaign: Campaign) -> list[Exposure]:
    """The exposures of a campaign."""
    return [Exposure(g.kind, g.role, g.exposure_s, g.photons, len(g.paths)) for g in campaign.field_groups]


def expose(
    twin: Camera, exposures: Sequence[Exposure], light: Sequence[float], seed: int, window: tuple[int, int, int, int] | None = None
) -> Iterator[Group]:
    """The groups of a campaign as the twin makes them; each frame is exposed when it is fetched.

    Parameters
    ----------
    twin : Camera
    exposures : sequence of Exposure
    light : sequence of float
        Photons per pixel of each, 0 in the dark.
    seed : int
        Of the exposures.
    window : (int, int, int, int), optional
        First row and column, rows and columns of the part of the frames that is made.
    """
    first = 0
    for exposure, photons in zip(exposures, light, strict=True):
        make = partial(_frame, twin, Uniform(photons), seed, exposure.exposure_s, window)
        frames = [partial(make, first + k) for k in range(exposure.frames)]
        first += exposure.frames
        yield Group(exposure.kind, exposure.role, exposure.exposure_s, exposure.photons, frames)


def _frame(twin: Camera, scene: Uniform, seed: int, exposure_s: float, window: Any, number: int) -> np.ndarray:
    frame: np.ndarray = twin.expose(scene, [number], seed, window, threads=1, exposure_s=exposure_s).data[0]
    return frame  # on one thread: the reduction fetches several at once


def light_of(exposures: Sequence[Exposure], seen: Observations) -> list[float]:
    """Photons (or electrons, where none were counted) per pixel of each exposure, 0 in the dark: as stated, and what all got beside.

    An exposure that lasts some microseconds longer than its number adds the same light to every level. It is the intercept of a straight
    line through the straightened means over the stated light, weighted as the light repeats, where it is significant.

    Raises
    ------
    MeasureError
        If neither photons nor the camera's response per second are known.
    """
    fit, bright = seen.fit, seen.series.bright
    stated_all = all(e.photons is not None for e in exposures if e.kind == "bright")
    photons = bright.photons if stated_all and "quantum_efficiency" in fit else None
    counted = photons is not None
    if not counted and "responsivity_dn_per_s" not in fit:
        raise MeasureError("the light of the levels is not known", where="digital twin", remedy="give the photons of each level")
    gain = fit["gain_dn_per_e"].value
    per_unit = 1.0 if counted else fit["responsivity_dn_per_s"].value / gain  # photons for a photon, or electrons for a second
    dn = gain * (fit["quantum_efficiency"].value if counted else 1.0)
    stated = per_unit * (bright.exposure_s if photons is None else photons)
    more = _more_light(seen, stated, dn)
    asked = [float(per_unit * (e.photons or 0.0 if counted else e.exposure_s)) for e in exposures]
    return [max(light + more, 0.0) if e.kind == "bright" else 0.0 for e, light in zip(exposures, asked, strict=True)]


def _more_light(seen: Observations, stated: np.ndarray, dn_per_unit: float) -> float:
    """What the bright levels got beside the stated light, in its unit; 0 where it is not significant, or few levels tell no response."""
    fit, bright = seen.fit, seen.series.bright
    linearity = Linearity.of(fit, seen.series.bits)
    use = bright.mean_dn < (0.9 * fit["saturation_dn"].value if "saturation_dn" in fit else math.inf)
    if use.sum() < 4 or linearity is None:
        return 0.0
    lamp = fit["illumination_noise_rel"].value if "illumination_noise_rel" in fit else 1e-3
    above = linearity.straight(bright.mean_dn[use])
    if "dark_current_e_per_s" in fit and "dark_current_e_per_s" not in fit.limits:
        above = above - fit["gain_dn_per_e"].value * fit["dark_current_e_per_s"].value * bright.exposure_s[use]
    weight = 1 / np.hypot(lamp * above, fit["offset_dn"].u)
    design = np.column_stack([stated[use], np.ones(use.sum())]) * weight[:, None]
    inverse = np.linalg.inv(design.T @ design)
    slope, offset = inverse @ design.T @ (weight * above)
    left = weight * above - design @ np.array([slope, offset])
    u = math.sqrt(inverse[1, 1] * max(float(left @ left) / (use.sum() - 2), 1.0))
    return float(offset / dn_per_unit) if abs(offset) > 3 * u else 0.0


def fewer(exposures: Sequence[Exposure], frame_pixels: int, most_pixels: int = TEST_PIXELS) -> list[Exposure]:
    """As many of a campaign's exposures as fit into a number of pixels: stacks of fewer frames, and levels spread evenly over the series.

    Never fewer than `TEST_STACK` frames a stack (or all), nor than `TEST_LEVELS` levels of each kind.
    """
    stacks = [e for e in exposures if e.role == "stack"]
    levels = [sorted((e for e in exposures if e.role == "level" and e.kind == kind), key=_light_key) for kind in ("dark", "bright")]
    if sum(e.frames for e in exposures) * frame_pixels <= most_pixels:
        return list(exposures)
    room = max(most_pixels // frame_pixels, 1)
    each = max(TEST_STACK, room // (2 * max(len(stacks), 1)))
    kept = [replace(e, frames=min(e.frames, each)) for e in stacks]
    count = max(TEST_LEVELS, (room - sum(e.frames for e in kept)) // 4)
    for of_kind in levels:
        if of_kind:
            at = np.unique(np.linspace(0, len(of_kind) - 1, min(count, len(of_kind))).round().astype(int))
            kept += [replace(of_kind[i], frames=min(of_kind[i].frames, 2)) for i in at]
    return kept


def middle_window(frame_shape: tuple[int, int], most_pixels: int = TEST_PIXELS) -> tuple[int, int, int, int] | None:
    """The part of a frame of which the fewest frames of a test fit into a number of pixels, in its middle; None if all of it does."""
    share = math.sqrt(most_pixels / ((2 * TEST_STACK + 4 * TEST_LEVELS) * frame_shape[0] * frame_shape[1]))
    if share >= 1:
        return None
    rows, cols = (min(max(int(share * side), SMALLEST_WINDOW), side) for side in frame_shape)
    return (frame_shape[0] - rows) // 2, (frame_shape[1] - cols) // 2, rows, cols


def _cropped(stack: StackMoments | None, window: tuple[int, int, int, int]) -> StackMoments | None:
    """A stack as if only a window of its frames had been taken; means of rows and columns then hold more of the white noise."""
    if stack is None:
        return None
    row0, col0, rows, cols = window
    part = np.s_[row0 : row0 + rows, col0 : col0 + cols]
    mean, variance, white = stack.mean_map_dn[part], stack.var_map_dn2[part], stack.ms_pixel_dn2
    return replace(
        stack,
        mean_map_dn=mean,
        var_map_dn2=variance,
        mean_dn=float(mean.mean()),
        var_stack_dn2=float(variance.mean(dtype=float)),
        ms_row_dn2=stack.ms_row_dn2 + white * (1 / cols - 1 / stack.shape[1]),
        ms_col_dn2=stack.ms_col_dn2 + white * (1 / rows - 1 / stack.shape[0]),
    )


def _light_key(exposure: Exposure) -> tuple[float, float]:
    return exposure.exposure_s, exposure.photons or 0.0


COMPARED = (
    *("R", "K", "QE", "sigma_y_dark", "sigma_d", "u_p_min", "u_e_sat", "SNR_max", "DR", "LE_min", "LE_max", "u_I_mean", "u_I_var"),
    *("sigma_2_y_stack_dark", "s_2_y_dark", "s_2_y_row_dark", "s_2_y_col_dark", "s_2_y_pixel_dark"),
    *("sigma_2_y_stack", "s_2_y", "s_2_y_row", "s_2_y_col", "s_2_y_pixel", "DSNU1288", "PRNU1288"),
)
# compared only if the twin takes all frames, and the whole of them
BY_LEVEL = ("R", "u_e_sat", "SNR_max", "DR", "LE_min", "LE_max")  # hang on which levels a series has
BY_PLACE = ("R", "QE", "u_p_min", "u_e_sat", "SNR_max", "DR")  # hang on the light, which at one place is not the mean over the frame
BY_FRAME = tuple(f"s_2_y_{part}{kind}" for part in ("row", "col", "pixel") for kind in ("", "_dark"))  # hold row noise over L


def self_test(
    twin: Camera, campaign: Campaign, observations: Observations, standard: Results, seed: int = 1, most_pixels: int = TEST_PIXELS
) -> SelfTest:
    """Simulate the campaign with the twin, reduce the frames like those of the camera, and compare the values of EMVA 1288.

    u of a difference is that of the two values, each of which tells how it would come out of another series of the same camera. Of a large
    campaign the twin takes fewer frames, of large frames a window; what hangs on the number of levels or frames, or on the place, is then
    not compared.
    """
    window = middle_window(campaign.frame_shape, most_pixels)
    wanted = exposures_of(campaign)
    pixels = math.prod(campaign.frame_shape if window is None else window[2:])
    chosen = fewer(wanted, pixels, most_pixels)
    frames, of = sum(e.frames for e in chosen), sum(e.frames for e in wanted)
    left_out = (BY_LEVEL if len(chosen) < len(wanted) else ()) + (BY_FRAME if frames < of else ()) + (BY_PLACE if window else ())
    try:
        light = light_of(chosen, observations)
        (measured,) = measure_frames(expose(twin, chosen, light, seed + TEST_SEED, window), campaign.bits)
        found = standard_values(measured_like(measured, twin), standard.release)
        if window is not None:
            dark, bright = _cropped(observations.dark_stack, window), _cropped(observations.bright_stack, window)
            standard = standard_values(Measurement(observations.series, dark, bright), standard.release)
    except (MeasureError, InputError) as problem:
        return SelfTest(frames=frames, of=of, window=window, reason=str(problem))
    rows = []
    for key in COMPARED:
        ours, theirs = standard.values[key], found.values[key]
        numbers = (ours.value, ours.u, theirs.value, theirs.u)
        limit = any(v.is_limit for v in (ours, theirs))
        if np.isfinite(numbers).all() and ours.u > 0 and not limit and key not in left_out:
            rows.append(Compared(key, ours.unit, *numbers))
    return SelfTest(tuple(rows), frames, of, window)


def measured_like(measured: Measurement, twin: Camera) -> Measurement:
    """The twin's measurement with its pixel area."""
    return measured if twin.pitch_um is None else replace(measured, pixel_area_um2=twin.pitch_um[0] * twin.pitch_um[1])
