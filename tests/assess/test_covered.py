"""Covered columns and rows in an assessment and in corrections: through the package's own cameras, with everything else on."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

import pixmetry
from pixmetry import Frames, campaign_of_arrays
from pixmetry.assess.digital_twin import digital_twin
from pixmetry.assess.job import measure_sources, observe_campaign
from pixmetry.assess.page.covered import covered_section
from pixmetry.assess.results import covered_record
from pixmetry.camera.camera import Camera, Element, in_order
from pixmetry.camera.catalogue import get_source
from pixmetry.core.errors import InputError
from pixmetry.core.progress import no_progress
from pixmetry.files.images import write_frame
from pixmetry.report import Page, html_of
from pixmetry.scene.outlines import polygon
from pixmetry.scene.picture import Picture as Scene
from pixmetry.scene.shapes import Shapes
from pixmetry.scene.uniform import Uniform

LIMIT = 5.5  # u; beyond it once in 3e7
BORDERS = {"left": 4, "right": 16, "top": 2, "bottom": 12}
ROWS, COLS, EXPOSURE_S = 174, 200, 0.01
LIT = (BORDERS["left"], COLS - BORDERS["right"], BORDERS["top"], ROWS - BORDERS["bottom"])
OTHERS: dict[str, dict[str, object]] = {
    "sensor.pixel_aperture": {},
    "sensor.quantum_efficiency": {},
    "sensor.prnu": {"pixel_std_rel": 0.005},
    "sensor.dsnu": {"pixel_std_e": 3.0},
    "sensor.shot_noise": {},
    "electronics.amplifier_noise": {"white_e": 8.0},
    "electronics.row_noise": {"row_e": 2.0},
    "electronics.gain": {"gain_dn_per_e": 0.1},
    "grabber.adc": {"bits": 12, "offset_dn": 40.0},
}


def camera_with(interface: str = "digital", shape: tuple[int, int] = (ROWS, COLS), **changed: dict[str, object]) -> Camera:
    chosen = OTHERS | {name.replace("__", "."): values for name, values in changed.items()}
    chain = tuple(Element(s.id, s, s.make(chosen[s.id])) for s in in_order(get_source(name) for name in chosen))
    facts = {"interface": interface, "bits": 12, "sensor": "ccd", "covered": BORDERS}
    return Camera("covered", shape, chain, facts=facts, exposure_s=EXPOSURE_S)


def area(x0: float, x1: float, y0: float, y1: float, level: float):
    return polygon(np.array([x0, x1, x1, x0]) - 0.5, np.array([y0, y0, y1, y1]) - 0.5, level)


def campaign_with(camera: Camera, seed: int, interface: str = "digital"):
    def taken(kind: str, shapes: list, first: int, count: int = 4, level: float | None = None) -> Frames:
        scene = Scene((Shapes.of(shapes),), Uniform(0.0)) if shapes else Uniform(0.0)
        return Frames(kind, EXPOSURE_S, camera.expose(scene, range(first, first + count), seed=seed).data, photons=level)

    x0, x1, y0, y1 = LIT
    bars = [area(x0 + 60 * i, x0 + 60 * i + 30, y0, y1, 20000.0) for i in range(3)]
    groups = [taken("dark", [], 0, 8)]
    groups += [taken("bright", [area(x0, x1, y0, y1, level)], 20 + 20 * i, 4, level) for i, level in enumerate((4000.0, 9000.0, 20000.0))]
    groups.append(taken("covered", bars, 100))
    return campaign_of_arrays(groups, bits=12, covered=BORDERS, interface=interface, sensor="ccd")


def measured(camera: Camera, seed: int, interface: str = "digital"):
    campaign = campaign_with(camera, seed, interface)
    _, seen = observe_campaign(campaign, no_progress)
    return campaign, seen, *measure_sources(seen)


def test_transfer_and_smear_at_once_through_the_camera(rng: np.random.Generator):
    """Smear in 160 of 174 rows; the other rows move charge, too, but see no light."""
    moves = {"serial_cti": 2e-5, "parallel_cti": 3e-5, "trail_px": 1.8}
    camera = camera_with(sensor__charge_transfer=moves, sensor__smear={"transfer_s": 1e-4, "rows": "all"})
    campaign, seen, estimates, _ = measured(camera, int(rng.integers(1 << 30)))
    found = estimates["sensor.charge_transfer"]
    for name, true in moves.items():
        assert abs(found[name].value - true) < LIMIT * found[name].u and found[name].u < 0.2 * true
    smear = estimates["sensor.smear"]["transfer_s"]
    assert abs(smear.value - 1e-4 * 160 / 174) < LIMIT * smear.u and smear.u < 3e-6
    assert campaign.frame_shape == (160, 180)
    twin = digital_twin(campaign, estimates, seen)
    assert twin.facts["covered"] == BORDERS and twin["sensor.charge_transfer"].known_from == "measured"
    assert seen.covered is not None
    text = html_of(Page("covered", sections=[covered_section(seen.covered)]))
    assert "They tell 4 of 5 quantities" in text
    record = covered_record(seen.covered)
    assert json.loads(json.dumps(record)) == record and record["borders"] == BORDERS


def test_droop_of_an_analogue_line(rng: np.random.Generator):
    camera = camera_with("analogue", grabber__clamp={"droop_rel": 0.015, "noise_dn": 0.3})
    _, _, estimates, _ = measured(camera, int(rng.integers(1 << 30)), "analogue")
    droop = estimates["grabber.clamp"]["droop_rel"]
    assert abs(droop.value - 0.015) < LIMIT * droop.u + 1e-4 and droop.u < 5e-4


def test_without_covered_pixels_the_reason_names_them(rng: np.random.Generator):
    campaign = campaign_of_arrays([Frames("dark", 0.01, rng.integers(90, 110, (4, 40, 40)).astype(np.uint16))], bits=12)
    _, seen = observe_campaign(campaign, no_progress)
    assert "camera.covered" in measure_sources(seen)[1]["sensor.charge_transfer"]


def discs(camera: Camera, frames: int, seed: int, at: list[tuple[float, float]]) -> np.ndarray:
    turn = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    dots = [polygon(x + 3.5 * np.cos(turn), y + 3.5 * np.sin(turn), 9000.0) for x, y in at]
    ground = area(*LIT, 500.0)
    return camera.expose(Scene((Shapes.of([ground, *dots]),), Uniform(0.0)), frames, seed=seed).data


def centroids(frames: np.ndarray, at: list[tuple[float, float]], black_dn: float) -> np.ndarray:
    """Plain centroids of the discs above a threshold, shape (frames, discs, 2)."""
    found = []
    for frame in frames.astype(float) - black_dn:
        for x, y in at:
            i, j = round(y), round(x)
            window = np.maximum(frame[i - 6 : i + 7, j - 6 : j + 7] - 150, 0)
            rows, cols = np.mgrid[i - 6 : i + 7, j - 6 : j + 7]
            found.append(((window * cols).sum() / window.sum() - x, (window * rows).sum() / window.sum() - y))
    return np.array(found).reshape(len(frames), len(at), 2)


AT = [(30.3 + 33 * i, 25.2 + 37 * j) for i in range(5) for j in range(4)]
ON_LIT = [(x - BORDERS["left"], y - BORDERS["top"]) for x, y in AT]


def test_row_offsets_by_covered_columns_make_positions_better(rng: np.random.Generator):
    """Row noise of 5 DN among all other errors: the scatter of y falls; and so does that of frames without covered borders not at all."""
    camera = camera_with(electronics__row_noise={"row_e": 50.0}, electronics__column_noise={})
    stored = discs(camera, 8, int(rng.integers(1 << 30)), AT)
    lit = Camera("lit", (160, 180), camera.chain, facts=camera.facts, exposure_s=EXPOSURE_S)
    found = pixmetry.correct(stored, lit)
    assert found.frames is not None and found.frames.shape == (8, 160, 180) and found.clipped is not None
    assert found.clipped.shape == found.frames.shape
    assert found.sources["electronics.row_noise"] == "corrected by the covered pixels of each frame"
    raw = centroids(stored, AT, 40.0).std(axis=0)[:, 1]
    better = centroids(found.frames, ON_LIT, 0.0).std(axis=0)[:, 1]
    assert np.sqrt((better**2).mean()) < 0.75 * np.sqrt((raw**2).mean())
    trimmed = pixmetry.correct(stored[:, LIT[2] : LIT[3], LIT[0] : LIT[1]], lit)
    assert "optically black columns" in trimmed.sources["electronics.row_noise"]


def test_charge_transfer_from_covered_pixels_is_taken_out(rng: np.random.Generator):
    """Measured blind, then corrected by that: shifts along x and y of discs on average fall below a third."""
    moves = {"serial_cti": 2e-4, "parallel_cti": 3e-4, "trail_px": 1.6}
    camera = camera_with(sensor__charge_transfer=moves)
    campaign, seen, estimates, _ = measured(camera, int(rng.integers(1 << 30)))
    twin = digital_twin(campaign, estimates, seen)
    seed = int(rng.integers(1 << 30))
    stored = discs(camera, 4, seed, AT)
    ideal = centroids(discs(camera.switched(off=["sensor.charge_transfer"]), 4, seed, AT), AT, 40.0).mean(axis=(0, 1))
    raw = centroids(stored, AT, 40.0).mean(axis=(0, 1)) - ideal
    found = pixmetry.correct(stored, twin)
    assert found.sources["sensor.charge_transfer"].startswith("corrected")
    assert found.frames is not None
    better = centroids(found.frames, ON_LIT, 0.0).mean(axis=(0, 1)) - ideal
    assert (raw > 0.01).all() and (np.abs(better) < raw / 3).all()


def test_files_with_covered_borders_are_trimmed_and_others_refused(rng: np.random.Generator, tmp_path: Path):
    lit = camera_with(shape=(160, 180))
    frame = rng.integers(30, 900, (ROWS, COLS)).astype(np.uint16)
    write_frame(tmp_path / "a.tif", frame, 12)
    found = pixmetry.correct(tmp_path / "a.tif", lit, tmp_path / "out")
    from tifffile import imread

    assert imread(tmp_path / "out" / "a.tif").shape == (160, 180) and found.clipped_pixels == 0
    with pytest.raises(InputError):
        pixmetry.correct(frame[:-1], lit)
