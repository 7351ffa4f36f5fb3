"""Results that lost or changed something on their way: every reader refuses them in one line, or reads what was written."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from zipfile import ZipFile

import numpy as np
import pytest
import tifffile

from cli.test_commands import CAMERA, DISCS, SERIES, refused, run
from pixmetry.assess.correct import correct
from pixmetry.assess.job import assess
from pixmetry.assess.judge.subjects import load_subject
from pixmetry.calibrate.calibrated_camera import calibrated_geometry
from pixmetry.calibrate.files.record import read_calibration, stored_cameras
from pixmetry.calibrate.job import calibrate
from pixmetry.core.errors import PixmetryError
from pixmetry.emva.job import emva1288
from pixmetry.files import read_frame, read_maps, write_maps, zarr_frames
from pixmetry.simulate.job import simulate

PLACES = 5  # of a file, at which a byte is changed
Damage = Callable[[Path], object]
Read = Callable[[Path], np.ndarray]


def damages(path: Path) -> Iterator[tuple[str, Damage]]:
    """Ways to damage a file: gone, cut off, one byte changed; of an archive also without each of its parts, of a folder of chunks each."""
    if path.is_dir():
        for part in sorted(p.relative_to(path) for p in path.rglob("*") if p.is_file()):
            yield f"without {part}", lambda p, part=part: (p / part).unlink()  # type: ignore[misc]
            for name, damage in damages(path / part):
                yield f"{part} {name}", lambda p, part=part, damage=damage: damage(p / part)  # type: ignore[misc]
        return
    size = path.stat().st_size
    yield "deleted", Path.unlink
    for left in sorted({0, 1, size // 2, size - 1}):
        yield f"cut after {left} bytes", partial(_cut, left=left)
    for at in {min(k * size // PLACES + 7, size - 1) for k in range(PLACES)}:
        for bits in (0x01, 0xFF):
            yield f"byte {at} changed by {bits:#x}", partial(_changed, at=at, bits=bits)
    if path.suffix == ".zip":
        for name in ZipFile(path).namelist():
            yield f"without {name}", partial(_without, name=name)


def _cut(path: Path, left: int) -> None:
    path.write_bytes(path.read_bytes()[:left])


def _changed(path: Path, at: int, bits: int) -> None:
    raw = bytearray(path.read_bytes())
    raw[at] ^= bits
    path.write_bytes(raw)


def _without(path: Path, name: str) -> None:
    with ZipFile(path) as old:
        parts = {part: old.read(part) for part in old.namelist() if part != name}
    with ZipFile(path, "w") as new:
        for part, raw in parts.items():
            new.writestr(part, raw)


def check(result: Path, names: list[str], readers: dict[str, Read], tmp_path: Path, least: dict[str, int]) -> None:
    """Damage one file after the other in every way; each reader must refuse (at least so often) or give the same as before."""
    right = {name: read(result) for name, read in readers.items()}
    refusals = dict.fromkeys(readers, 0)
    for name in names:
        for what, damage in damages(result / name):
            damaged = tmp_path / "damaged"
            shutil.copytree(result, damaged)
            damage(damaged / name)
            for reader, read in readers.items():
                try:
                    np.testing.assert_array_equal(read(damaged), right[reader], err_msg=f"{reader}: {name} {what}")
                except PixmetryError as problem:
                    refusals[reader] += 1
                    assert "damaged" in str(problem) or str(damaged) in str(problem), (reader, name, what, problem)
            shutil.rmtree(damaged)
    assert all(refusals[reader] >= least[reader] for reader in readers), refusals


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A simulated campaign, its assessment, a scene and a frame to correct."""
    folder = tmp_path_factory.mktemp("damaged")
    for name, text in (("camera.yaml", CAMERA), ("series.yaml", SERIES.replace("levels: 14", "levels: 8")), ("discs.yaml", DISCS)):
        (folder / name).write_text(text)
    simulate(folder / "camera.yaml", folder / "series.yaml", folder / "campaign", image_format="png")
    assess(folder / "campaign", folder / "result", trials=200)
    simulate(folder / "result" / "camera.yaml", folder / "discs.yaml", folder / "frames")
    return folder


def test_a_damaged_assessment_gives_no_wrong_frames_and_no_wrong_values(folder: Path, tmp_path: Path) -> None:
    def corrected(result: Path) -> np.ndarray:
        shutil.rmtree(tmp_path / "corrected", ignore_errors=True)
        correct([folder / "frames"], result / "results.json", tmp_path / "corrected")
        return tifffile.imread(tmp_path / "corrected" / "frame_00000.tif")

    def simulated(result: Path) -> np.ndarray:
        shutil.rmtree(tmp_path / "simulated", ignore_errors=True)
        simulate(result / "camera.yaml", folder / "discs.yaml", tmp_path / "simulated")
        return read_frame(tmp_path / "simulated" / "frame_00000.tif")

    def compared(result: Path) -> np.ndarray:
        return np.array([[value.value, value.u, value.dof] for value in load_subject(result, "result").values.values()])

    names = ["results.json", "camera.yaml", "maps.zarr.zip", ".pixmetry-output.json"]
    names += [path.name for path in (folder / "result").glob("*.npz")]
    each = 4 + 2 * PLACES
    least = {"corrected": 3 * each, "simulated": each, "compared": each}
    check(folder / "result", names, {"corrected": corrected, "simulated": simulated, "compared": compared}, tmp_path, least)


@pytest.mark.parametrize(("name", "side"), [("maps.zarr.zip", 2100), ("maps.zarr", 50)])
def test_damaged_maps_are_never_read_as_others(name: str, side: int, tmp_path: Path, rng: np.random.Generator) -> None:
    """A map of zeros, whose chunks are not stored, one that is zero in some chunks only, and a small one."""
    maps = {"large": np.zeros((side, side), np.float32), "defects": np.zeros((60, 80), np.uint8)}
    maps["prnu_rel"] = rng.random((9, 8))
    maps["large"][:40, :40] = 1.5
    (tmp_path / "maps").mkdir()
    write_maps(tmp_path / "maps" / name, maps, {"camera": "a"})

    def read(folder: Path) -> np.ndarray:
        found, attributes = read_maps(folder / name)
        return np.array([attributes == {"camera": "a"}, *(np.array_equal(found[key], maps[key]) for key in maps)])

    check(tmp_path / "maps", [name], {"read": read}, tmp_path, {"read": 15})


def test_a_damaged_calibration_gives_no_wrong_camera(tmp_path: Path, rng: np.random.Generator) -> None:
    from calibrate.networks import simulate as network

    calibrate(network(rng, images=5, points=12).network, tmp_path / "result")

    def cameras(result: Path) -> np.ndarray:
        return np.concatenate([camera.values for camera in stored_cameras(result)])

    def everything(result: Path) -> np.ndarray:
        stored = read_calibration(result)
        return np.concatenate([stored.covariance.ravel(), stored.xyz.ravel(), stored.position.ravel(), stored.rotation.ravel()])

    def geometry(result: Path) -> np.ndarray:
        found = calibrated_geometry(result, pitch_um=(5.0, 5.0))
        return np.array([[e.value, e.u] for e in found.lens])

    readers = {"cameras": cameras, "everything": everything, "geometry": geometry}
    check(tmp_path / "result", ["calibration.json"], readers, tmp_path, dict.fromkeys(readers, 4 + 2 * PLACES - 2))


def test_a_damaged_data_sheet_is_not_compared(tmp_path: Path) -> None:
    (tmp_path / "sheet").mkdir()
    emva1288(json=tmp_path / "sheet" / "sheet.json", bootstrap=0)

    def read(folder: Path) -> np.ndarray:
        return np.array([[value.value, value.u] for value in load_subject(folder / "sheet.json").values.values()])

    check(tmp_path / "sheet", ["sheet.json"], {"read": read}, tmp_path, {"read": 2 + 2 * PLACES - 2})


def test_a_damaged_store_of_frames_is_refused(folder: Path, tmp_path: Path) -> None:
    """A chunk that is missing or changed; the same bytes with another check sum."""
    simulate(folder / "camera.yaml", folder / "discs.yaml", tmp_path / "in" / "store", frames=2, image_format="zarr")

    def read(folder: Path) -> np.ndarray:
        zarr_frames._frames.cache_clear()  # each damaged store has the name and the time of the one before
        return np.stack([read_frame(folder / "store" / "frames.zarr" / str(i)) for i in range(2)])

    check(tmp_path / "in", ["store/frames.zarr"], {"read": read}, tmp_path, {"read": 2 * (4 + 2 * PLACES)})


def test_a_result_that_was_edited_says_what_to_do(folder: Path, tmp_path: Path) -> None:
    result = shutil.copytree(folder / "result", tmp_path / "result")
    edited = (result / "camera.yaml").read_text() + "\n"
    (result / "camera.yaml").write_text(edited)
    again = run("simulate", result / "camera.yaml", folder / "discs.yaml", "-o", tmp_path / "out")
    refused(again, "camera.yaml", "damaged", "another name")
    refused(run("correct", folder / "frames", "--with", result / "results.json", "-o", tmp_path / "out"), "camera.yaml", "damaged")
    assert not (tmp_path / "out").exists()
    (result / "mine.yaml").write_text(edited)
    done = run("simulate", result / "mine.yaml", folder / "discs.yaml", "-o", tmp_path / "out")
    assert done.exit_code == 0, done.output
