"""A laser spot on a surface that moves: speckle made with plain NumPy by the Fourier transform of a random surface.

Statistical tests fail by chance at 1e-6 each: 4.9 of the stated u, or the χ² interval of the scatter.
"""

from __future__ import annotations

import io
from functools import lru_cache

import numpy as np
import pytest
from scipy.stats import chi2

from pixmetry.assess.job import measure_sources, observe_campaign
from pixmetry.assess.page.speckle import speckle_section
from pixmetry.assess.results import speckle_record
from pixmetry.camera.camera import Camera, Element, in_order
from pixmetry.camera.catalogue import get_source
from pixmetry.camera.group_facts import GroupFacts
from pixmetry.camera.observations import Observations
from pixmetry.core.progress import no_progress
from pixmetry.files.in_memory import Frames, campaign_of_arrays
from pixmetry.observe.laser_spots import SpotCrops, find_spot
from pixmetry.scene.picture import Picture
from pixmetry.scene.speckle import Speckle
from pixmetry.scene.uniform import Uniform

Z = 4.9
FINE = 3  # points along a pixel
GRAIN, RADIUS, SIDE = 2.2, 12.0, 64
LAW = GRAIN / (np.sqrt(2) * np.pi)


@lru_cache(maxsize=4)
def patterns(seed: int, frames: int, alike: float = 0.0, stays: float = 0.0, grain: float = GRAIN, radius: float = RADIUS) -> np.ndarray:
    """Light of a Gaussian spot exp(−2 r²/w²), mean 1 in its middle: a surface of random amplitudes, cut off by a round pupil.

    The amplitudes of successive frames correlate by √alike, of all frames by ``stays``: their light by alike, and by stays².
    """
    rng = np.random.default_rng(seed)
    n = SIDE * FINE
    f = np.fft.fftfreq(n, 1 / FINE)
    pupil = np.hypot(f[:, None], f) <= 0.5 / grain
    at = (np.arange(n) + 0.5) / FINE - 0.5 - (SIDE - 1) / 2
    beam = np.exp(-(at**2 + at[:, None] ** 2) / radius**2)

    def surface() -> np.ndarray:
        return (rng.normal(size=(n, n)) + 1j * rng.normal(size=(n, n))) / np.sqrt(2)

    fixed, last, out = surface(), surface(), []
    for _ in range(frames):
        last = np.sqrt(alike) * last + np.sqrt(1 - alike) * surface()
        seen = np.fft.ifft2(np.fft.fft2(beam * (np.sqrt(1 - stays) * last + np.sqrt(stays) * fixed)) * pupil)
        light = np.abs(seen) ** 2 / pupil.mean()
        out.append(light.reshape(SIDE, FINE, SIDE, FINE).mean(axis=(1, 3)))
    return np.array(out)


def recorded(rng: np.random.Generator, light: np.ndarray, peak_e: float = 4000.0, bits: int = 12, full: float = 10.0) -> np.ndarray:
    """Stored values of a linear camera whose scale ends at ``full`` times the mean peak."""
    gain = 0.96 * 2**bits / (full * peak_e)
    noisy = rng.poisson(peak_e * light) + rng.normal(0, 10, light.shape)
    return np.clip(np.rint(0.03 * 2**bits + gain * noisy), 0, 2**bits - 1).astype(np.uint16)


def observed(frames: np.ndarray, bits: int = 12, wavelength_nm: float | None = 660.0, **camera: object) -> Observations:
    group = Frames("speckle", None, frames, facts=GroupFacts(wavelength_nm=wavelength_nm))
    return observe_campaign(campaign_of_arrays([group], bits=bits, name="laser", **camera), no_progress)[1]


def assert_scatter_is(seen: Observations, law_px: float, low: float = 0.85, high: float = 1.05) -> None:
    """The mean of the variances along x and y, within the χ² interval of its degrees of freedom and 15 % below the law of many grains."""
    spot = seen.speckle.spots[0]
    found = 0.5 * float(np.trace(spot.scatter_px2)) / law_px**2
    least, most = (chi2.ppf(p, 2 * spot.dof) / (2 * spot.dof) for p in (5e-7, 1 - 5e-7))
    assert low**2 * least < found < high**2 * most


def test_scatter_contrast_and_grains_are_those_of_the_light(rng: np.random.Generator) -> None:
    seen = observed(recorded(rng, patterns(1, 40)), pitch_um=5.0)
    spot, fit = seen.speckle.spots[0], seen.speckle.fit
    assert_scatter_is(seen, LAW)
    assert abs(fit["contrast_rel"].value - 1) < Z * fit["contrast_rel"].u and fit["contrast_rel"].u < 0.04
    assert abs(fit["airy_px"].value - GRAIN) < Z * fit["airy_px"].u and fit["airy_px"].u < 0.15
    assert 0.5 * np.trace(spot.predicted_px2) == pytest.approx(LAW**2, rel=0.3)
    assert spot.effective_frames > 30 and spot.degree == 0 and spot.u_located_px < 0.04 and not spot.notes
    found = measure_sources(seen)[0]["scene.speckle"]
    assert abs(found["f_number"].value - GRAIN * 5000 / 660) < Z * found["f_number"].u
    assert "product" in found["f_number"].reason and any("points" in c for c in found.confounders)
    record = speckle_record(seen.speckle)["spots"][0]
    assert record["frames"] == 40 and len(record["lags_px"]) == len(record["model_rel"]) > 5
    assert "independent" in str(speckle_section(seen.speckle).parts)


@pytest.mark.parametrize("alike, stays, told", [(0.7, 0.0, "successive frames are alike"), (0.0, 0.7, "same in all frames")])
def test_a_surface_that_moves_too_little_scatters_the_centre_as_much(alike: float, stays: float, told: str, rng) -> None:
    seen = observed(recorded(rng, patterns(2, 40, alike, stays)))
    spot = seen.speckle.spots[0]
    assert_scatter_is(seen, LAW, 0.7, 1.25)
    assert any(told in note for note in spot.notes) and spot.effective_frames < 20
    usual = spot.fit["scatter_x_px"].value / np.sqrt(2 * 39)
    assert spot.fit["scatter_x_px"].u > 1.05 * usual


def test_a_surface_at_rest_tells_nothing(rng: np.random.Generator) -> None:
    seen = observed(recorded(rng, np.repeat(patterns(1, 40)[:1], 12, axis=0)))
    assert "same in all frames" in seen.speckle.refused[0] and "move the surface" in seen.speckle.refused[0]
    assert "same in all frames" in measure_sources(seen)[1]["scene.speckle"]
    assert "Nothing was measured" in str(speckle_section(seen.speckle).parts)


def test_spots_of_cameras_in_general_are_read(rng: np.random.Generator) -> None:
    """8 bits, a ground that is not even, hot pixels, a spot that drifts over a larger frame."""
    light = patterns(1, 40)
    frames = np.zeros((40, 160, 220))
    y, x = np.mgrid[:160, :220]
    ground = 0.2 + 0.3 * x / 220 + 0.2 * (y / 160) ** 2
    for k, part in enumerate(light):
        col = 20 + 3 * k
        frames[k] = ground
        frames[k, 60 : 60 + SIDE, col : col + SIDE] += part
    frames[:, 10, 30], frames[:, 150, 200] = 8.0, 9.0
    seen = observed(recorded(rng, frames, bits=8), bits=8)
    spot = seen.speckle.spots[0]
    assert spot.frames == 40 and spot.degree >= 1
    assert_scatter_is(seen, LAW, 0.8, 1.1)
    assert abs(seen.speckle.fit["airy_px"].value - GRAIN) < Z * seen.speckle.fit["airy_px"].u


def test_pictures_stored_as_jpeg_are_read(rng: np.random.Generator) -> None:
    from PIL import Image

    frames = []
    for frame in recorded(rng, patterns(1, 40), bits=8):
        stored = io.BytesIO()
        Image.fromarray(frame.astype(np.uint8)).save(stored, "JPEG", quality=92)
        frames.append(np.asarray(Image.open(stored)))
    seen = observed(np.array(frames), bits=8)
    assert_scatter_is(seen, LAW)
    assert seen.speckle.fit["contrast_rel"].value == pytest.approx(1.0, abs=0.1)


def test_a_saturated_core_is_said_and_the_rest_tells_the_grains(rng: np.random.Generator) -> None:
    seen = observed(recorded(rng, patterns(1, 40), full=2.5))
    spot = seen.speckle.spots[0]
    assert spot.saturated_rel > 0.01 and any("saturated" in note for note in spot.notes)
    assert abs(spot.fit["airy_px"].value - GRAIN) < Z * spot.fit["airy_px"].u + 0.1 * GRAIN


def test_light_without_speckle_gives_limits(rng: np.random.Generator) -> None:
    mean = patterns(1, 40).mean(axis=0)
    smooth = np.exp(-2 * np.square(np.indices(mean.shape) - (SIDE - 1) / 2).sum(axis=0) / RADIUS**2)
    seen = observed(recorded(rng, np.repeat(smooth[None], 30, axis=0)))
    spot = seen.speckle.spots[0]
    assert spot.fit["scatter_x_px"].value < 0.03
    estimates, unmeasured = measure_sources(seen)
    assert "scene.speckle" not in estimates and "scene.speckle" in unmeasured


def test_frames_that_tell_nothing_say_why(rng: np.random.Generator) -> None:
    light = patterns(1, 40)
    for frames, why in (
        (light[:5], "5 frames show a spot"),
        (np.zeros((10, SIDE, SIDE)), "10 show none"),
        (light[:12, :, 24:], "border"),
    ):
        seen = observed(recorded(rng, frames))
        assert why in seen.speckle.refused[0] and any(why in note for note in seen.notes)
    assert find_spot(np.zeros((6, 6))) is None


def test_spots_without_grains_say_why(rng: np.random.Generator) -> None:
    """A spot of 1 px is small, not saturated; copies tell nothing; a response that bends makes more contrast than there is."""
    at = np.indices((SIDE, SIDE)) - (SIDE - 1) / 2
    small = recorded(rng, np.repeat(np.exp(-2 * np.square(at).sum(axis=0))[None], 12, axis=0))
    assert "too small" in measure_sources(observed(small))[1]["scene.speckle"]
    light = patterns(1, 40)
    assert "same picture" in observed(np.repeat(recorded(rng, light[:1]), 9, axis=0)).speckle.refused[0]
    assert "at most 1" in measure_sources(observed(recorded(rng, 0.3 * light**1.5)))[1]["scene.speckle"]


def test_frames_beyond_the_memory_are_the_last_ones_whatever_the_order(rng: np.random.Generator, monkeypatch) -> None:
    frames = recorded(rng, patterns(1, 40)[:8])
    kept = []
    for order in (range(8), (7, 3, 0, 6, 1, 2, 5, 4)):
        crops = SpotCrops()
        monkeypatch.setattr("pixmetry.observe.laser_spots.LARGEST_BYTES", 5 * frames[0].nbytes)
        for index in order:
            crops.add(frames[index], index)
        kept.append(sorted(crops.kept))
        assert crops.left_out == 8 - len(crops.kept) > 0
    assert kept[0] == kept[1] == list(range(len(kept[0])))


def test_grains_smaller_than_pixels_need_the_f_number(rng: np.random.Generator) -> None:
    frames = recorded(rng, patterns(3, 30, grain=0.4))
    assert "smaller than the pixels" in measure_sources(observed(frames))[1]["scene.speckle"]
    group = Frames("speckle", None, frames, facts=GroupFacts(wavelength_nm=500.0))
    campaign = campaign_of_arrays([group], bits=12, name="laser", pitch_um=5.0, optics={"f_number": 4.0})
    found = measure_sources(observe_campaign(campaign, no_progress)[1])[0]["scene.speckle"]
    assert found["contrast_rel"].value == pytest.approx(1.0, abs=0.2) and found["f_number"].value == 4.0


def test_the_chapters_law_of_speckle_by_frames(seed: int) -> None:
    """Note 3: 0.67 µm, f/16, 8.6 µm pixels make C λN/(√2 π) = 0.281 px; a spot of few grains up to a tenth less."""
    finest = 0.67 * 16 / 8.6
    chain = {
        "sensor.quantum_efficiency": {"quantum_efficiency": 1.0},
        "sensor.prnu": {"pixel_std_rel": 0.01},
        "sensor.shot_noise": {},
        "electronics.amplifier_noise": {"white_e": 20.0},
        "electronics.gain": {"gain_dn_per_e": 0.1},
        "grabber.adc": {"bits": 12, "offset_dn": 60.0},
    }
    elements = tuple(Element(s.id, s, s.parameters(**chain[s.id])) for s in in_order(map(get_source, chain)))
    camera = Camera("chapter", (72, 72), elements, unit_seed=seed)
    spot = Speckle(35.2, 35.9, 9.0, 3000.0, finest, seed=seed)
    frames = camera.expose(Picture((spot,), Uniform(0.0)), 60, seed=seed).data.astype(np.uint16)
    seen = observed(frames, wavelength_nm=670.0, pitch_um=8.6)
    assert_scatter_is(seen, 0.2806, 0.88, 1.03)
    found = measure_sources(seen)[0]["scene.speckle"]
    assert abs(found["f_number"].value - 16) < Z * found["f_number"].u
