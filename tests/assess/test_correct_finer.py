"""Frames shifted by parts of a pixel, put together on a finer grid: against the closed form of gratings behind a rectangle."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile
from click.testing import CliRunner

import pixmetry
from pixmetry.camera.camera import Camera, build_camera
from pixmetry.camera.finer_grid import ShiftedFrames, finest, lost_bands
from pixmetry.cli import main
from pixmetry.core.errors import InputError, MeasureError
from pixmetry.observe.frame_shifts import frame_shifts
from pixmetry.scene.discs import Discs
from pixmetry.scene.motion import Motion
from pixmetry.scene.picture import Picture
from pixmetry.scene.shapes import Sine
from pixmetry.scene.uniform import Uniform

SHAPE = (64, 72)
QUARTERS = np.array([[i / 4, j / 4] for j in range(4) for i in range(4)])
GAIN, BLACK = 0.1, 16.0


def camera_of(fill: float, **changes: Any) -> Camera:
    chain = [("sensor.pixel_aperture", {"width_x_px": fill, "width_y_px": fill, **changes}),
             ("sensor.quantum_efficiency", {"quantum_efficiency": 1.0}), ("sensor.shot_noise", {}),
             ("electronics.gain", {"gain_dn_per_e": GAIN}), ("grabber.adc", {"bits": 12, "offset_dn": BLACK})]  # fmt: skip
    return build_camera({"schema": "pixmetry/camera/1", "name": "fine", "rows": SHAPE[0], "cols": SHAPE[1], "pitch_x_um": 8.0,
                         "pitch_y_um": 6.0, "chain": [{"source": s, "parameters": p} for s, p in chain]})  # fmt: skip


def gratings(shifts: np.ndarray, fill: float, waves: list[tuple[float, float, float, float]]) -> np.ndarray:
    """Frames of waves (cycles per pixel along x and y, amplitude, phase) on 1000, behind a square of this width, in closed form."""
    out = np.full((len(shifts), *SHAPE), 1000.0)
    for k, (sx, sy) in enumerate(shifts):
        x, y = np.arange(SHAPE[1]) - sx, (np.arange(SHAPE[0]) - sy)[:, None]
        for fx, fy, amplitude, phase in waves:
            out[k] += amplitude * np.sinc(fill * fx) * np.sinc(fill * fy) * np.cos(2 * np.pi * (fx * x + fy * y) + phase)
    return out


def amplitude(image: np.ndarray, grid: ShiftedFrames, fx: float, fy: float) -> complex:
    """Of a wave in the finer image, by least squares with a level, away from the border."""
    a, (mx, my) = grid.area, grid.finer
    x = (np.arange(a.cols * mx) + 0.5) / mx - 0.5 + a.col0
    y = (np.arange(a.rows * my) + 0.5) / my - 0.5 + a.row0
    wave = np.exp(2j * np.pi * (fx * x + fy * y[:, None]))[6:-6, 6:-6].ravel()
    rows = np.stack([wave.real, -wave.imag, np.ones(wave.size)], axis=1)
    found, *_ = np.linalg.lstsq(rows, image[6:-6, 6:-6].ravel(), rcond=None)
    return complex(found[0], found[1])


@pytest.mark.parametrize("fill", [0.25, 0.5, 1.0])
def test_gratings_come_back_with_the_contrast_of_the_finer_pixel(fill: float, rng: np.random.Generator) -> None:
    """Frequencies up to nearly 2 cycles per pixel, four times what one frame shows: where the area leaves a tenth, all of it comes back.

    The wave at 1.02 cycles per pixel stands by the zero of a full pixel and stays lost there. Shifts that are off even steps by 0.05 px
    serve as well.
    """
    shifts = QUARTERS + rng.uniform(-0.05, 0.05, QUARTERS.shape)
    waves = [(0.31, 0.12, 100.0, 0.3), (1.5, 0.0, 100.0, 1.0), (0.2, 1.31, 100.0, 2.0), (1.02, 0.0, 100.0, 0.7)]
    grid = ShiftedFrames(shifts, (4, 4), SHAPE)
    found = pixmetry_image(gratings(shifts, fill, waves), camera_of(fill), shifts)
    for fx, fy, size, phase in waves:
        lost = abs(np.sinc(fill * fx) * np.sinc(fill * fy)) < 0.1
        wanted = 0.0 if lost else size * np.sinc(fx / 4) * np.sinc(fy / 4)
        # a lost wave leaves (H/0.1)² of itself, and the border disturbs what is near it: 2 % of a wave
        allowed = size * (np.sinc(fill * fx) * np.sinc(fill * fy) / 0.1) ** 2 + 2.0 if lost else 2.0
        assert abs(amplitude(found, grid, fx, fy) - wanted * np.exp(1j * phase)) < allowed, (fx, fy)


def pixmetry_image(frames: np.ndarray, camera: Camera, shifts: np.ndarray) -> np.ndarray:
    from pixmetry.assess.finer import finer_image

    return np.asarray(finer_image(frames, camera, shifts, 4).image_dn, float)


def test_an_area_beside_the_pixel_centre_is_moved_back() -> None:
    waves = [(1.3, 0.4, 100.0, 0.5)]
    frames = gratings(QUARTERS - [0.2, -0.1], 0.5, waves)  # the rectangle sees what lies 0.2 px to the right
    found = pixmetry_image(frames, camera_of(0.5, offset_x_px=0.2, offset_y_px=-0.1), QUARTERS)
    wanted = 100 * np.sinc(1.3 / 4) * np.sinc(0.1) * np.exp(0.5j)
    assert abs(amplitude(found, ShiftedFrames(QUARTERS, (4, 4), SHAPE), 1.3, 0.4) - wanted) < 2.0


@pytest.mark.parametrize("offset", [(20.0, 0.0), (-30.0, 5.0), (100.0, -40.0)])
def test_shifts_that_are_told_from_another_place_move_the_origin_alone(offset: tuple[float, float]) -> None:
    """Of a stage whose zero is elsewhere: the finer pixels were those beyond the frame, or none."""
    waves = [(0.31, 0.12, 100.0, 0.3), (1.5, 0.0, 100.0, 1.0)]
    found = pixmetry_image(gratings(QUARTERS + offset, 0.5, waves), camera_of(0.5), QUARTERS + offset)
    for fx, fy, size, phase in waves:
        wave = amplitude(found, ShiftedFrames(QUARTERS + offset, (4, 4), SHAPE), fx, fy)
        assert abs(wave - size * np.sinc(fx / 4) * np.sinc(fy / 4) * np.exp(1j * phase)) < 2.0


@pytest.mark.parametrize(("fill", "finer"), [(0.25, (4, 4)), (1.0, (4, 4)), (0.5, (3, 3)), (1.0, (4, 1))])
def test_noise_of_the_finer_image_is_as_stated(fill: float, finer: tuple[int, int], rng: np.random.Generator) -> None:
    """White noise of 5: the finer pixels scatter by 5 × noise_rel, and what is left over tells the 5.

    The scatter of a variance follows from the spectrum of the noise, 2 ΣP²/(ΣP)², over the share of the image that is left: six standard
    errors (chance 1e-8), and 3 % for the shifts, which are not even. That is 5 % to 14 %; a grid step too much or too little in the
    propagation makes a third.
    """
    from pixmetry.assess.finer import finer_image

    shifts = np.tile(QUARTERS, (3, 1)) + rng.uniform(-0.1, 0.1, (48, 2))  # any such are parted, at 1.22 of the noise or less
    found = finer_image(rng.normal(100, 5, (48, *SHAPE)), camera_of(fill), shifts, finer)
    fx, fy = (m * np.fft.fftfreq(m * n) for m, n in zip(finer, SHAPE[::-1], strict=True))
    aperture = np.outer(np.sinc(fill * fy), np.sinc(fill * fx))
    wanted = np.outer(np.sinc(fy / finer[1]), np.sinc(fx / finer[0]))
    power = (wanted * np.where(np.abs(aperture) < 0.1, aperture / 0.01, 1 / np.where(aperture == 0, 1, aperture))) ** 2
    error = np.sqrt(0.5 * (power**2).sum() / power.sum() ** 2 * power.size / found.image_dn.size)
    assert found.image_dn.std() == pytest.approx(5 * found.noise_rel, rel=0.03 + 6 * error)
    assert found.residual_dn == pytest.approx(5, rel=0.02)


@pytest.mark.parametrize(("fill", "places"), [(0.25, [0.0, 0.2, 0.4]), (1.0, [0.0, 0.2, 0.4]), (1.0, [0.0, 0.2, 0.55])])
def test_noise_behind_uneven_shifts_is_that_of_what_single_pixels_do(fill: float, places: list[float]) -> None:
    """Squares of the image of one bright pixel, of each frame in turn; the border cuts off what lies far from it (1 %).

    With the mean over the parted frequencies the noise was 5 % off: the middle ones are less certain, and the area raises the others.
    """
    shifts, side = np.array([[place, 0.0] for place in places]), 128
    grid = ShiftedFrames(shifts, (3, 1), (side, side))
    square = 0.0
    for k in range(3):
        frames = np.zeros((3, side, side))
        frames[k, side // 2, side // 2] = 1.0
        square += float((grid.restored(frames, lambda fx, fy: np.sinc(fill * fx) * np.sinc(fill * fy))[0] ** 2).sum()) / 3
    assert grid.noise_rel(lambda fx, fy: np.sinc(fill * fx) * np.sinc(fill * fy)) == pytest.approx(np.sqrt(square), rel=0.01)


def test_what_cannot_be_restored_is_told() -> None:
    """A full pixel loses what lies about 1 and 2 cycles per pixel: sin πν = ± πν/10 at 0.908, 1.114 and 1.808, by bisection."""
    (low, high), (second, end) = lost_bands(np.sinc, 4)
    assert (low, high, second, end) == pytest.approx((0.9079, 1.1138, 1.8077, 2), abs=0.003)
    assert not lost_bands(lambda f: np.sinc(0.25 * f), 4)
    found = pixmetry.correct(frames_of(camera_of(1.0), QUARTERS), camera_of(1.0), shifts=QUARTERS)
    assert "not restored along x: 0.91 to 1.1" in found.sources["sensor.pixel_aperture"]
    assert found.finer is not None and found.finer.finer == (4, 4) and found.frames is not None and len(found.frames) == 1


def moved(shifts: np.ndarray) -> Motion:
    return Motion(table_px=np.asarray(shifts, float))


def frames_of(camera: Camera, shifts: np.ndarray, period_px: float = 1 / 1.5, seed: int = 1) -> np.ndarray:
    scene = Picture((Sine(period_px, 0.0, 30.0, 20000.0, 0.9, motion=moved(shifts)),), Uniform(0.0))
    return np.asarray(camera.expose(scene, len(shifts), seed=seed).data)


@pytest.mark.parametrize("fill", [0.25, 0.5, 1.0])
def test_the_whole_chain_gives_back_a_grating_of_one_and_a_half_cycles(fill: float, seed: int) -> None:
    """Photons, their noise, the aperture and the converter on: contrast 0.9 · sinc(1.5/4), within 0.02 (noise 0.002, border 0.01)."""
    camera = camera_of(fill)
    found = pixmetry.correct(frames_of(camera, QUARTERS, seed=seed), camera, shifts=QUARTERS)
    assert found.frames is not None
    image = found.frames[0].astype(float)
    wave = abs(amplitude(image, ShiftedFrames(QUARTERS, (4, 4), SHAPE), 1.5, 0.0))
    assert wave / image.mean() == pytest.approx(0.9 * np.sinc(1.5 / 4), abs=0.02)


def test_shifts_are_found_within_their_u(rng: np.random.Generator) -> None:
    """Forty blobs of σ = 1 px in noise: 22 coordinates with no error beyond 8 u, and a rms between 0.3 u and 3 u.

    u has some 30 degrees of freedom (blobs), and the noise of the first frame is common to all: with t₃₀ 8 u is a chance of 1e-8.
    """
    true = np.vstack([[0, 0], rng.uniform(-3, 3, (11, 2))])
    x, y = np.meshgrid(np.arange(96.0), np.arange(80.0))
    places = rng.uniform(8, 72, (40, 2))
    frames = []
    for sx, sy in true:
        image = sum(2000 * np.exp(-((x - px - sx) ** 2 + (y - py - sy) ** 2) / 2) for px, py in places)
        frames.append(image + rng.normal(0, 5, x.shape))
    found = frame_shifts(np.array(frames))
    z = (found.shifts_px[1:] - true[1:]) / found.u_px[1:]
    assert np.abs(z).max() < 8 and 0.3 < np.sqrt(np.mean(z**2)) < 3
    assert found.u_px.max() < 0.01


def test_a_frame_without_detail_tells_no_shift(rng: np.random.Generator) -> None:
    with pytest.raises(MeasureError, match="does not tell its shift"):
        frame_shifts(np.full((2, 40, 40), 7.0))


def test_the_command_writes_a_finer_image_that_later_steps_read(tmp_path: Path, seed: int) -> None:
    """A disc at a known place, sixteen frames on disk, shifts found: `locate` finds it in the finer image, and its size with it."""
    camera = camera_of(0.5)
    camera.save(tmp_path / "camera_file.yaml")
    (tmp_path / "frames").mkdir()
    for k, (sx, sy) in enumerate(QUARTERS):
        scene = Discs(np.array([30.3 + sx, 46.1 + sx]), np.array([28.6 + sy, 36.2 + sy]), 6.0, 0.6, 15000.0, Uniform(3000.0))
        tifffile.imwrite(tmp_path / "frames" / f"{k:02d}.tif", camera.expose(scene, [k], seed=seed).data[0])
    runner, out = CliRunner(), tmp_path / "out"
    command = ["correct", str(tmp_path / "frames"), "--with", str(tmp_path / "camera_file.yaml"), "--shifts", "found", "-o", str(out)]
    result = runner.invoke(main, command)
    assert result.exit_code == 0, result.output
    assert "pitch 2 × 1.5 µm" in result.output and "4 × 4 times as fine" in result.output
    record = json.loads((out / "correction.json").read_text())["finer"]
    assert record["pitch_um"] == [2.0, 1.5] and np.abs(np.array(record["shifts_px"]) - QUARTERS).max() < 0.02
    fine = pixmetry.load_camera(out / "camera.yaml")
    image = tifffile.imread(out / "finer.tif")
    assert fine.pitch_um == (2.0, 1.5) and fine.frame_shape == image.shape
    located = pixmetry.locate(image, noise=str(out / "camera.yaml"))
    x = np.sort(np.asarray(located.x_px)) / 4 + record["origin_x_px"]
    assert x == pytest.approx([30.3, 46.1], abs=0.02)  # u of a shift is 0.003 px; half of a finer pixel is 0.125 px


def test_a_table_of_shifts_is_read(tmp_path: Path) -> None:
    table = tmp_path / "shifts.csv"
    rows = "\n".join(f"{k},{x},{y},0.002" for k, (x, y) in enumerate(QUARTERS))
    table.write_text(f"# of the stage\nframe,shift_x_px,shift_y_px,u_shift_px\n{rows}\n")
    camera = camera_of(0.5)
    frames = frames_of(camera, QUARTERS)
    found, same = pixmetry.correct(frames, camera, shifts=table), pixmetry.correct(frames, camera, shifts=QUARTERS)
    assert found.frames is not None and same.frames is not None and np.array_equal(found.frames, same.frames)
    assert found.finer is not None and found.finer.u_shifts_px.max() == 0.002 and "u of the shifts" in found.finer.text
    table.write_text("shift_x_px,shift_y_px,u_shift_px\n" + "0,0,nan\n" * 16)
    with pytest.raises(InputError, match="no uncertainty"):
        pixmetry.correct(frames, camera, shifts=table)
    table.write_text("x,y\n0,0\n")
    with pytest.raises(InputError, match="no column shift_x_px"):
        pixmetry.correct(frames, camera, shifts=table)


@pytest.mark.parametrize(
    ("shifts", "finer", "words"),
    [
        (QUARTERS[:15], 4, "every frame"),
        (np.zeros((16, 2)), None, "no finer grid"),
        (np.zeros((16, 2)), 2, "do not part"),
        (QUARTERS, 5, "no such finer grid"),
        (QUARTERS, "4x4x4", "no such finer grid"),
        (QUARTERS, 2.5, "no such finer grid"),
        ([["a", "b"]] * 16, 4, "no shifts"),
        (QUARTERS * 101, 4, "too small"),
        (np.full((16, 2), np.nan), 4, "every frame"),
    ],
)
def test_shifts_that_cannot_be_used_are_refused(shifts: np.ndarray, finer: Any, words: str) -> None:
    frames = np.full((16, *SHAPE), 100, np.uint16)
    with pytest.raises(InputError, match=words):
        pixmetry.correct(frames, camera_of(0.5), shifts=shifts, finer=finer)


def test_values_that_are_no_pixels_of_the_sensor_give_no_finer_grid() -> None:
    """Of a colour mosaic, of a grabber with a clock of its own, of one that stores single fields."""
    no_pixels = "those of the sensor"
    for name, why in (("dcs420_like", "colours of their own"), ("pulnix_tm6cn_epix_512", no_pixels), ("sony_xc8500_field", no_pixels)):
        camera = pixmetry.load_camera(name)
        frames = np.full((4, *camera.output_shape), 100, np.uint8)
        with pytest.raises(InputError, match=why):
            pixmetry.correct(frames, camera, shifts=QUARTERS[:4])


def test_fewer_frames_give_a_coarser_grid() -> None:
    assert finest(QUARTERS[:4], SHAPE) == (4, 1)
    assert finest(np.array([[0, 0], [0.5, 0], [0, 0.5], [0.5, 0.5]]), SHAPE) == (2, 2)
    with pytest.raises(InputError, match="too few frames"):
        pixmetry.correct(np.full((4, *SHAPE), 100, np.uint16), camera_of(0.5), shifts=QUARTERS[:4], finer=3)


def test_a_single_frame_is_left_as_it_is_and_the_reason_told() -> None:
    camera = camera_of(0.5)
    found = pixmetry.correct(np.full(SHAPE, 100, np.uint16), camera)
    assert "--shifts" in found.sources["sensor.pixel_aperture"] and found.finer is None
    with pytest.raises(InputError, match="finer grid needs shifted frames"):
        pixmetry.correct(np.full(SHAPE, 100, np.uint16), camera, finer=2)
