"""Every correction of the catalogue takes its error out of frames that the whole chain of a camera made, by the public function."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile
from click.testing import CliRunner

import pixmetry
from pixmetry.assess.correct import OF_UNIT, Correction
from pixmetry.camera.camera import Camera, load_camera
from pixmetry.camera.catalogue import sources
from pixmetry.camera.overrides import with_source
from pixmetry.cli import main
from pixmetry.core.errors import InputError
from pixmetry.scene.discs import Discs
from pixmetry.scene.uniform import Uniform

SHAPE = (96, 160)
CORRECTING = [i for i, s in sources().items() if s.correct is not None]
# see test_correct_sequence
IN_A_SEQUENCE = ("sensor.image_lag", "processing.temporal_noise_reduction", "electronics.agc", "optics.flicker")
BY_SHIFTS = ("sensor.pixel_aperture",)  # see test_correct_finer
BY_BORDERS = ("electronics.row_noise", "electronics.column_noise")  # see test_covered
X_PX, Y_PX = (v.ravel() + 0.3 + 0.37 * np.arange(v.size) % 1 for v in np.meshgrid(np.arange(20.0, 150, 30), np.arange(20.0, 90, 25)))
DIGITAL, ANALOGUE = "imx264_like", "pulnix_tm6cn_epix_pixelclock"
# Where the bound of a sound camera is lost in the rounding of the preset, or is not of this camera, the error is made larger.
LARGER: dict[str, dict[str, Any]] = {
    "sensor.charge_transfer": {"parallel_cti": 2e-3, "serial_cti": 2e-3},
    "sensor.brighter_fatter": {"area_loss_per_e": 1e-5},
    "sensor.parasitic_light": {"sensitivity_rel": 0.02},
    "sensor.smear": {"transfer_s": 4e-3},
    "sensor.dsnu": {"pixel_std_e": 30.0},
    "sensor.defects": {"dead_fraction": 0.01},
    "electronics.hdr_gain": {"mismatch_rel": 0.2, "column_std_rel": 0.0},
    "grabber.clamp": {"droop_rel": 0.2},
    "grabber.phase_pattern": {"amplitude_dn": 6.0},
    "electronics.supply_pickup": {"amplitude_dn": 6.0},
}
HOSTS = {"sensor.dsnu": DIGITAL, "electronics.nonlinearity": DIGITAL, "sensor.cid_readout": "cid_generic"}
CONSUMED = ("pitch_x_um", "pitch_y_um", "pitch_um", "bits", "reference_dn", "line_time_us", "pixel_time_ns")


def small(name: str) -> Camera:
    """A preset with a small sensor that is stored whole, at its settled temperature."""
    camera = replace(load_camera(name), frame_shape=SHAPE, warm_up_k=0.0)
    whole = ("rows", "cols", "samples", "row_offset", "col_offset", "inactive_rows")

    def stored(params: Any) -> Any:
        return params.model_copy(update={k: 0 for k in whole if k in type(params).model_fields})

    layout = ("grabber.window_offset", "grabber.sampling_clock")
    return replace(camera, chain=tuple(e.with_params(stored(e.params)) if e.source.id in layout else e for e in camera.chain))


@cache
def presets() -> dict[str, set[str]]:
    """Sources of every preset that stores the sensor's own pixels as they are."""
    names = sorted(p.name.removesuffix(".yaml") for p in files("pixmetry.camera").joinpath("presets").iterdir())
    held = {name: {e.source.id for e in load_camera(name).chain} for name in names if "512" not in name and "field" not in name}
    return {name: ids for name, ids in held.items() if "processing.demosaic" not in ids}


def host_of(source_id: str) -> str:
    """A preset that holds the source, and stores the sensor's own pixels."""
    if source_id in HOSTS:
        return HOSTS[source_id]
    source = sources()[source_id]
    own = [name for name, ids in presets().items() if source_id in ids]
    fallback = ANALOGUE if source.applies_to and "digital" not in source.applies_to and "cmos" not in source.applies_to else DIGITAL
    return fallback if fallback in own or not own else own[0]


@cache
def camera_with_error(source_id: str) -> tuple[Camera, str]:
    """The whole chain of a preset with one source at its bound, and its name there."""
    camera = small(host_of(source_id))
    if not any(e.source.id == source_id for e in camera.chain):
        camera = with_source(camera, source_id)
    name = next(e.name for e in camera.chain if e.source.id == source_id)
    source, own = sources()[source_id], camera[name].params.model_dump()
    known = {k: own[k] for k in CONSUMED if k in own}
    params = source.make({**source.bound.model_dump(), **known, **LARGER.get(source_id, {})})
    return replace(camera, chain=tuple(replace(e, on=True, params=params) if e.name == name else e for e in camera.chain)), name


def frames_of(camera: Camera, light_rel: float | None, quiet: bool = True) -> np.ndarray:
    """A frame of discs, or of an even field; light as a part of full scale."""
    gain = next(e.params.gain_dn_per_e for e in camera.chain if e.source.id == "electronics.gain")
    bits = next(e.params.bits for e in camera.chain if e.source.id == "grabber.adc")
    efficiency = np.prod([e.params.quantum_efficiency for e in camera.chain if e.source.id == "sensor.quantum_efficiency"])
    full = 2**bits / gain / efficiency
    discs = Discs(X_PX, Y_PX, diameter_px=8.0, peak_photons=0.45 * full, background=Uniform(0.15 * full))
    scene = discs if light_rel is None else Uniform(light_rel * full)
    return camera.expose(scene, 1, seed=3, quiet=quiet).data


def corrected(camera: Camera, frames: np.ndarray, source_id: str, mask: np.ndarray, **kw: Any) -> Correction:
    """By the camera; where the source has maps, with dark frames, an even field and a mask."""
    given: dict[str, Any] = {}
    if source_id in OF_UNIT:
        given = {"dark": frames_of(camera, 0.0), "flat": frames_of(camera, 0.5), "defects": mask}
    return pixmetry.correct(frames, camera, **given, **kw)


def places_of(frames_dn: np.ndarray, threshold: float) -> np.ndarray:
    """Centroids of the discs of one frame over a fixed threshold, shape (discs, 2)."""
    out = []
    for x, y in zip(X_PX, Y_PX, strict=True):
        rows, cols = np.arange(round(y) - 9, round(y) + 10), np.arange(round(x) - 9, round(x) + 10)
        weight = np.maximum(frames_dn[0, rows[0] : rows[-1] + 1, cols[0] : cols[-1] + 1].astype(float) - threshold, 0)
        out.append([(weight.sum(axis=0) * cols).sum(), (weight.sum(axis=1) * rows).sum()] / weight.sum())
    return np.array(out)


@pytest.mark.parametrize("source_id", [i for i in CORRECTING if i not in ("grabber.adc", *IN_A_SEQUENCE, *BY_BORDERS, *BY_SHIFTS)])
def test_every_correction_is_reached_and_takes_its_error_out_of_the_whole_chain(source_id: str) -> None:
    """Against the same camera without the source; both frames are rounded, so that 0.41 DN of difference stay (√(2/12)).

    More than half of the error is taken out, which the catalogue's own contracts hold to what each correction can do. And the discs come
    back to their places, by a centroid over a threshold that knows nothing of the source.
    """
    camera, name = camera_with_error(source_id)
    without = camera.switched(off=[name])
    quiet = source_id != "grabber.phase_pattern"  # its phase is drawn in every frame
    frames, ideal = frames_of(camera, None, quiet), frames_of(without, None, quiet)
    mask = np.zeros(SHAPE, bool)
    if source_id == "sensor.defects":
        told = camera.truth()[name]
        mask = np.any([np.asarray(v, bool) for v in told.values()], axis=0)
        assert mask.any()
    aim = corrected(without, ideal, "" if source_id in OF_UNIT else source_id, mask).frames
    if source_id in OF_UNIT:
        aim = corrected(without, ideal, source_id, np.zeros(SHAPE, bool)).frames
    left = corrected(camera, frames, source_id, mask)
    before = corrected(camera, frames, source_id, mask, skip=[name])
    assert any(s.name == name and s.corrected and s.leaves and s.does for s in left.steps)
    assert left.sources[name].startswith("corrected") and "left out" in before.sources[name]
    rms_before, rms_left = (float(np.sqrt(np.mean((c.frames - aim) ** 2))) for c in (before, left))
    assert rms_before > 1.0  # so that the test can fail
    assert rms_left < np.hypot(0.45, 0.5 * rms_before)
    threshold = 0.75 * float(np.median(aim)) + 0.25 * float(np.percentile(aim, 99))
    true = places_of(aim, threshold)
    px_before, px_left = (float(np.sqrt(np.mean((places_of(c.frames, threshold) - true) ** 2))) for c in (before, left))
    assert px_before > 2e-4  # so that the test can fail
    assert px_left < 0.9 * px_before


def test_the_converter_is_undone() -> None:
    camera, name = camera_with_error("grabber.adc")
    plain = camera.with_parameters(name, offset_dn=0.0, gain_error_rel=0.0, dnl_std_lsb=0.0)
    plain, camera = (c.with_parameters(name, bits=12) if name in c else c for c in (plain, camera))
    aim = pixmetry.correct(frames_of(plain, None), plain).frames
    found = pixmetry.correct(frames_of(camera, None), camera)
    raw = frames_of(camera, None).astype(float) - frames_of(plain, None)
    assert np.sqrt(np.mean(raw**2)) > 2 > 4 * np.sqrt(np.mean((found.frames - aim) ** 2)) - 2
    assert found.sources[name] == "corrected"


def test_every_correction_says_what_it_leaves() -> None:
    assert [i for i in CORRECTING if not sources()[i].leaves] == []
    assert [i for i, s in sources().items() if s.leaves and s.correct is None] == []


def test_the_noise_of_a_correction_is_what_it_does_to_noisy_frames(rng: np.random.Generator) -> None:
    """Frames with noise of 20 DN of our own draws; the spread over 40 frames, to 6 standard errors of its mean over the pixels (0.0009)."""
    camera, name = camera_with_error("optics.vignetting")
    plain = camera.switched(on=[name, "grabber.adc", "electronics.gain"])
    level = np.full(SHAPE, 2000.0)
    frames = np.rint(level + 20 * rng.standard_normal((40, *SHAPE))).astype(np.uint16)
    found = pixmetry.correct(frames, plain)
    step = next(s for s in found.steps if s.name == name)
    spread = np.sqrt(np.mean(found.frames.var(axis=0, ddof=1)))
    assert step.noise_rel > 1.05
    assert spread / 20 == pytest.approx(step.noise_rel, rel=0.02)


def test_what_a_description_lacks_is_told_with_the_way_to_supply_it() -> None:
    camera = small(DIGITAL)
    found = pixmetry.correct(frames_of(camera, None), camera)
    for source_id, option in (("sensor.dsnu", "--dark"), ("sensor.prnu", "--flat")):
        assert option in found.sources[source_id]
    assert (
        "left out, as asked"
        in pixmetry.correct(frames_of(camera, None), camera, skip=["electronics.nonlinearity"]).sources["electronics.nonlinearity"]
    )
    with pytest.raises(InputError, match=r"no source named 'sensor\.tilt'"):
        pixmetry.correct(frames_of(camera, None), camera, only=["sensor.tilt"])
    with pytest.raises(InputError, match="no frames of this camera"):
        pixmetry.correct(frames_of(camera, None), camera, dark=np.zeros((4, 5), np.uint16))
    with pytest.raises(InputError, match="hold no light"):
        pixmetry.correct(frames_of(camera, None), camera, dark=frames_of(camera, 0.5), flat=frames_of(camera, 0.0))
    sheet = pixmetry.load_camera("imx250")
    listed = pixmetry.correct(np.full(sheet.output_shape, 1000, np.uint16), sheet).sources
    assert "only typical" in listed["electronics.nonlinearity"] and listed["grabber.adc"] == "corrected by typical parameters"


def test_pixels_that_a_grabber_sampled_anew_are_not_taken_for_the_sensors() -> None:
    camera = load_camera("pulnix_tm6cn_epix_512")
    found = pixmetry.correct(np.full(camera.output_shape, 90, np.uint8), camera).sources
    for source_id in ("sensor.charge_transfer", "sensor.smear", "electronics.supply_pickup"):
        assert "not those of the sensor" in found[source_id]
    assert found["electronics.nonlinearity"] == "corrected, as far as it is not changed since by the video line"
    assert found["cable.termination"] == "corrected"
    colour = load_camera("dcs420_like")
    told = pixmetry.correct(np.full(colour.output_shape, 90, np.uint8), colour).sources
    assert "processing.demosaic has changed the pixels" in told["sensor.bayer_mosaic"]


def test_dark_frames_take_the_fixed_pattern_of_a_grabber_out_of_its_samples() -> None:
    """In stored pixels, whatever clock took them: 4 DN of settling at the top are left to the rounding."""
    camera = replace(load_camera("pulnix_tm6cn_epix_512"), warm_up_k=0.0)
    dark, frame = (camera.expose(Uniform(level), 1, quiet=True).data for level in (0.0, 20000.0))
    plain, found = (pixmetry.correct(frame, camera, dark=d) for d in (None, dark))
    top, middle = (float(np.ptp(c.frames[0, :120].mean(axis=1))) for c in (plain, found))
    assert found.sources["sensor.dsnu"] == "corrected" and top > 2.5 > 1.0 > middle


def test_values_at_the_ends_of_the_range_are_marked() -> None:
    camera = small(DIGITAL)
    frame = frames_of(camera, None)[0]
    frame[3, 4], frame[5, 6] = 0, 4095
    found = pixmetry.correct(frame, camera)
    assert found.clipped_pixels == 2 and found.clipped[0, 3, 4] and found.clipped[0, 5, 6]


def test_the_command_lists_and_corrects(tmp_path: Path) -> None:
    camera = small(DIGITAL)
    camera.save(tmp_path / "camera.yaml")
    for folder, frames in (("frames", frames_of(camera, None)), ("dark", frames_of(camera, 0.0)), ("flat", frames_of(camera, 0.5))):
        (tmp_path / folder).mkdir()
        tifffile.imwrite(tmp_path / folder / "a.tif", frames[0])

    def run(*arguments: object) -> tuple[int, str]:
        done = CliRunner().invoke(main, ["correct", *map(str, arguments)])
        return done.exit_code, done.output

    known = ("--with", tmp_path / "camera.yaml", "--dark", tmp_path / "dark", "--flat", tmp_path / "flat")
    code, said = run("--list", *known)
    assert code == 0 and "sensor.prnu: corrected (noise ×" in said and "Left: " in said, said
    code, said = run(tmp_path / "frames", *known, "--skip", "electronics.nonlinearity", "-o", tmp_path / "out")
    assert code == 0 and "electronics.nonlinearity: not corrected: left out" in said, said
    by_hand = pixmetry.correct(
        frames_of(camera, None), camera, dark=frames_of(camera, 0.0), flat=frames_of(camera, 0.5), skip=["electronics.nonlinearity"]
    )
    assert np.array_equal(tifffile.imread(tmp_path / "out" / "a.tif"), by_hand.frames[0])
    assert run(tmp_path / "frames", *known)[0] == 2 and run(*known, "-o", tmp_path / "x")[0] == 2
    code, said = run(tmp_path / "frames", "--with", tmp_path / "camera.yaml", "--set", "sensor.smear.store=sideways", "-o", tmp_path / "y")
    assert code == 2 and "sensor.smear" in said
