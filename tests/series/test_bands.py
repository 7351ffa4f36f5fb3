"""The same targets in light of several wavelengths: discs drawn with plain NumPy at five points a pixel.

Statistical tests fail by chance at 1e-6 each: 4.9 of the stated u.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from pixmetry.assess.job import measure_sources, observe_campaign
from pixmetry.assess.page.bands import bands_section
from pixmetry.assess.results import bands_record
from pixmetry.camera.group_facts import GroupFacts
from pixmetry.camera.observations import Observations
from pixmetry.core.errors import InputError
from pixmetry.core.progress import no_progress
from pixmetry.files.in_memory import Frames, campaign_of_arrays
from pixmetry.series.bands import _blur_by_diffusion

Z, FINE, RADIUS, SHAPE = 4.9, 5, 4.5, (170, 240)
PLACES = np.array([(25.3 + 47.1 * i, 24.8 + 40.2 * j) for i in range(5) for j in range(4)])


def frames_of(rng: np.random.Generator, scale: float = 0.0, blur: float = 0.6, light: float = 2400.0, count: int = 2, noise: float = 4.0):
    """Frames of twenty discs whose image is larger by ``scale``, 12 bits."""
    y, x = (np.indices((SHAPE[0] * FINE, SHAPE[1] * FINE)) + 0.5) / FINE - 0.5
    fine = np.zeros(y.shape)
    middle = np.array([SHAPE[1] - 1, SHAPE[0] - 1]) / 2
    for cx, cy in middle + (PLACES - middle) * (1 + scale) + [0.13, -0.08]:
        box = tuple(slice(int((v - 8) * FINE), int((v + 8) * FINE)) for v in (cy, cx))
        fine[box] += np.clip((RADIUS - np.hypot(x[box] - cx, y[box] - cy)) * FINE + 0.5, 0, 1)
    seen = 200 + light * gaussian_filter(fine, blur * FINE).reshape(SHAPE[0], FINE, SHAPE[1], FINE).mean(axis=(1, 3))
    return np.clip(np.rint(seen + rng.normal(0, noise, (count, *SHAPE))), 0, 4095).astype(np.uint16)


def observed(*bands: tuple[np.ndarray, float, dict[str, Any]], pitch_um: float | None = 5.0, **optics: float) -> Observations:
    groups = [Frames("bands", f.pop("exposure_s", 0.01), frames, facts=GroupFacts(wavelength_nm=nm, **f)) for frames, nm, f in bands]
    camera = {} if pitch_um is None else {"pitch_um": pitch_um}
    return observe_campaign(campaign_of_arrays(groups, bits=12, name="camera", optics=optics, **camera), no_progress)[1]


def test_lateral_colour_and_focus_follow_from_seven_bands(rng: np.random.Generator) -> None:
    slope, nms = 2e-6, (405.0, 470.0, 530.0, 590.0, 630.0, 740.0, 850.0)
    bands = []
    for nm in nms:
        blur = float(np.hypot(0.5, (nm - 560) / 300))
        bands.append((frames_of(rng, slope * (nm - 550), blur), nm, {"exposure_s": float(rng.uniform(0.01, 0.05)), "band": f"LED {nm:g}"}))
    seen = observed(*bands, f_number=4.0)
    found = seen.bands
    told = found.colour["scale_per_nm"]
    assert abs(told.value - slope) < Z * told.u and told.u < 5e-7
    assert found.wavelength_nm.tolist() == list(nms) and found.names[0] == "LED 405"
    assert found.blur_var_px2[1] - found.blur_var_px2[2] == pytest.approx((90 / 300) ** 2 - (30 / 300) ** 2, abs=0.03)
    assert found.focus_um[-1] == pytest.approx(4 * 4 * 5 * np.sqrt(found.blur_var_px2[-1] - found.blur_var_px2.min()))
    measured, unmeasured = measure_sources(seen)
    assert measured["optics.lateral_colour"]["scale_per_nm"].value == told.value
    assert "filtered" in unmeasured["optics.spectral_filter"]
    assert "allows any length" in unmeasured["sensor.infrared_diffusion"] and "axial colour" in unmeasured["sensor.infrared_diffusion"]
    assert len(bands_record(found)["bands"]) == 7 and "ppb" in str(bands_section(found).parts)


def test_without_lateral_colour_its_slope_is_zero_within_u(rng: np.random.Generator) -> None:
    seen = observed(*((frames_of(rng), nm, {}) for nm in (450.0, 550.0, 650.0, 750.0)))
    told = seen.bands.colour["scale_per_nm"]
    assert abs(told.value) < Z * told.u
    length = measure_sources(seen)[0]["sensor.infrared_diffusion"]["diffusion_length_um"]
    assert length.is_upper_limit and length.value < 5 and "no more blur" in length.reason


def test_a_filter_is_told_by_light_with_and_without_it(rng: np.random.Generator) -> None:
    through = {500.0: 0.9, 600.0: 0.88, 700.0: 0.2, 850.0: 0.05}
    bands = []
    for nm, share in through.items():
        lamp = float(rng.uniform(1500, 3000))
        bands.append((frames_of(rng, light=lamp), nm, {}))
        longer = min(1 / share, 5.0)
        bands.append((frames_of(rng, blur=0.8, light=lamp * share * longer), nm, {"filtered": True, "exposure_s": 0.01 * longer}))
    seen = observed(*bands, f_number=4.0)
    found = seen.bands
    assert found.transmittance == pytest.approx(list(through.values()), rel=0.02)
    told = measure_sources(seen)[0]["optics.spectral_filter"]
    assert told.settings["band"] == "short_pass" and told["peak_rel"].value == pytest.approx(0.9, abs=0.02)
    assert 600 < told["cut_nm"].value < 700 and told["cut_nm"].u == pytest.approx(100 / np.sqrt(12))
    assert told["plate_um"].value == pytest.approx(4 * 4 * 5 * 1.52 / 0.52 * np.sqrt(0.28), rel=0.1)


def test_a_saturated_band_takes_no_part_in_the_thickness_of_a_filter(rng: np.random.Generator) -> None:
    bands = [(frames_of(rng, light=light), nm, {"filtered": f}) for nm in (500.0, 600.0) for f, light in ((False, 2400.0), (True, 2000.0))]
    bands[3] = (frames_of(rng, light=9000.0), *bands[3][1:])
    told = measure_sources(observed(*bands, f_number=4.0))[0]["optics.spectral_filter"]
    assert np.isfinite(told.values).all() and told["plate_um"].value < 100
    full = [(frames_of(rng, light=9000.0), 500.0, {"filtered": f}) for f in (False, True)]
    assert "below saturation" in measure_sources(observed(*full, f_number=4.0))[1]["optics.spectral_filter"]


def test_diffusion_is_told_where_the_lens_was_focused_anew(rng: np.random.Generator) -> None:
    more = float(np.interp(10.0, [7.0, 12.0], _blur_by_diffusion(850.0, RADIUS, 0.6, (5.0, 5.0))[[3, 4]]))
    blurred = frames_of(rng, blur=float(np.sqrt(0.36 + more)))
    seen = observed((frames_of(rng), 530.0, {"refocused": True}), (blurred, 850.0, {"refocused": True}))
    told = measure_sources(seen)[0]["sensor.infrared_diffusion"]
    assert not told.limits and abs(told["diffusion_length_um"].value - 10) < 3 * told["diffusion_length_um"].u
    assert told["wavelength_nm"].value == 850 and "focused anew" in seen.bands.colour.reasons["scale_per_nm"]


def test_one_large_disc_tells_the_scale_by_its_radius(rng: np.random.Generator) -> None:
    def taken(nm: float) -> np.ndarray:
        y, x = (np.indices((100 * 3, 110 * 3)) + 0.5) / 3 - 0.5
        fine = np.clip((30 * (1 + 2e-5 * (nm - 550)) - np.hypot(x - 55.3 - 1e-3 * nm, y - 48.8)) * 3 + 0.5, 0, 1)
        seen = gaussian_filter(fine, 3 * (0.6 + abs(nm - 550) / 800)).reshape(100, 3, 110, 3).mean(axis=(1, 3))
        return np.clip(np.rint(200 + 2000 * seen + rng.normal(0, 5, (3, 100, 110))), 0, 4095).astype(np.uint16)

    found = observed(*((taken(nm), nm, {}) for nm in (450.0, 550.0, 650.0, 750.0))).bands
    told = found.colour["scale_per_nm"]
    assert abs(told.value - 2e-5) < Z * told.u and told.u < 2e-6
    assert found.shift_x_px[3] - found.shift_x_px[0] == pytest.approx(0.3, abs=0.02)


def test_what_bands_cannot_tell_has_a_reason(rng: np.random.Generator) -> None:
    seen = observed((frames_of(rng), 530.0, {}), (rng.integers(190, 210, (2, *SHAPE)).astype(np.uint16), 850.0, {}))
    assert "1 of 2 bands" in seen.failed["bands"] and "1 of 2 bands" in measure_sources(seen)[1]["optics.lateral_colour"]
    one = observed((frames_of(rng), 530.0, {}), (frames_of(rng), 530.0, {"filtered": True}), pitch_um=None).bands
    assert "one wavelength" in one.colour.reasons["scale_per_nm"] and "pitch_um" in one.diffusion.reasons["diffusion_length_um"]
    with pytest.raises(InputError, match="wavelength"):
        campaign_of_arrays([Frames("bands", 0.01, frames_of(rng))], bits=12)
