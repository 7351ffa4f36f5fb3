"""Scene files: what the page on scenes shows is read and rendered; what cannot be used is refused with the reason."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from pixmetry.camera.camera import Camera
from pixmetry.core.errors import InputError
from pixmetry.core.random import Grid
from pixmetry.scene.files import KINDS, build_scene, read_scene

PAGE = (Path(__file__).resolve().parents[2] / "docs" / "scenes.md").read_text()
BLOCKS = re.findall(r"^```yaml\n(.*?)^```", PAGE, re.M | re.S)
SHAPE = (48, 64)
ZERO, EXPOSURE = np.zeros(1), np.full(1, 0.01)


def show(scene, frame=0, time_s=0.0, window=None):
    row0, col0, rows, cols = window or (0, 0, *SHAPE)
    return scene.photons(Grid(np.array([frame]), np.array([row0]), np.array([col0]), (rows, cols)), SHAPE, EXPOSURE, ZERO + time_s)[0]


@pytest.mark.parametrize("number", range(len(BLOCKS)))
def test_the_page_shows_scenes_that_can_be_rendered(number: int, tmp_path: Path) -> None:
    path = tmp_path / "scene.yaml"
    path.write_text(BLOCKS[number])
    model = read_scene(path)
    scene = build_scene(model, SHAPE)
    whole = show(scene, 1, 0.04)
    if model.photon_transfer is None:
        assert np.isfinite(whole).all() and whole.max() > 10
        assert whole.max() > 1.01 * whole.min()
    np.testing.assert_array_equal(show(scene, 1, 0.04, (11, 17, 20, 31)), whole[11:31, 17:48])
    for target in scene.targets(0.0, 0):
        assert {"kind", "x_px", "y_px"} <= set(target)


def test_the_page_tells_every_kind_and_every_key() -> None:
    for kind, model in KINDS.items():
        assert f"`{kind}`" in PAGE
        for key in model.model_fields:
            assert f"`{key}`" in PAGE, (kind, key)


def test_the_python_example_runs(capsys: pytest.CaptureFixture[str]) -> None:
    (code,) = re.findall(r"^```python\n(.*?)^```", PAGE, re.M | re.S)
    exec(compile(code, "scenes.md", "exec"), {})
    assert "'x_px': 20.05" in capsys.readouterr().out


def test_a_camera_without_optics_sees_the_scene_itself() -> None:
    scene = build_scene(read_scene({"schema": "pixmetry/scene/1", **DISC}), SHAPE)
    seen = Camera("bare", SHAPE, ()).expose(scene, seed=1).data[0]
    np.testing.assert_array_equal(seen, show(scene))


DISC = {"targets": [{"kind": "disc", "x_px": 20.3, "y_px": 18.7, "diameter_px": 7}]}


@pytest.mark.parametrize(
    ("record", "words"),
    [
        ({"targets": [{"kind": "disk", "x_px": 1, "y_px": 1}]}, "disc, ellipse"),
        ({"targets": [{"x_px": 1, "y_px": 1}]}, "lacks its kind"),
        ({"targets": ["disc"]}, "has no keys"),
        ({"targets": [{"kind": "disc", "x_px": 1, "y_px": 1}]}, "diameter_px.*missing"),
        ({"targets": [{"kind": "disc", "x_px": 1, "y_px": 1, "diameter": 7}]}, "lacks its unit.*diameter_px"),
        ({"targets": [{"kind": "disc", "x_px": 1, "y_px": 1, "diameter_px": -7}]}, "diameter_px.*greater than 0"),
        ({"targets": [{"kind": "ring", "x_px": 1, "y_px": 1, "diameter_px": 7, "inner_px": 8}]}, "below diameter_px"),
        ({"targets": [{"kind": "cross", "x_px": 1, "y_px": 1, "size_px": 7, "width_px": 8}]}, "below size_px"),
        ({"targets": [{"kind": "line", "x_px": float("nan"), "y_px": 1, "length_px": 7, "width_px": 8}]}, "finite"),
        ({**DISC, "blur_px": -1}, "blur_px"),
        ({**DISC, "motion": {"velocity_px_per_s": [1]}}, "velocity_px_per_s"),
        ({**DISC, "motion": {"velocity": [1, 1]}}, "velocity_px_per_s"),
        ({**DISC, "motion": {"table_px": []}}, "table_px"),
        ({**DISC, "lighting": {"surface": "shiny"}}, "surface"),
        ({**DISC, "lighting": {"surface": "lambert", "lamp_px": [0, 0, -5]}}, "in front of the surface"),
        ({**DISC, "lighting": {"surface": "lambert", "lamp_px": [5000, 0, 10], "tilt_x_deg": -30}}, "behind the surface"),
        ({"plate": {"kind": "dots", "rows": 2, "columns": 2, "diameter_mm": 3}}, "pose.*missing"),
        ({"plate": {"kind": "lines"}}, "dots, chessboard"),
        (
            {
                "plate": {
                    "kind": "dots",
                    "rows": 9,
                    "columns": 9,
                    "pitch_mm": 50,
                    "diameter_mm": 3,
                    "pose": {"principal_distance_px": 900, "z_mm": 100, "phi_deg": 60},
                }
            },
            "behind the camera",
        ),
        ({"spot": {"x_px": 1, "y_px": 1, "radius_px": 5, "peak_photons": 1, "wavelength_um": 0.6, "f_number": 8}}, "pitch_um.*missing"),
        (
            {"spot": {"x_px": 1, "y_px": 1, "radius_px": 900, "peak_photons": 1, "wavelength_um": 0.6, "f_number": 2, "pitch_um": 9}},
            "too large",
        ),
        (
            {
                "spot": {
                    "x_px": 1,
                    "y_px": 1,
                    "radius_px": 9,
                    "peak_photons": 1,
                    "wavelength_um": 0.6,
                    "f_number": 8,
                    "pitch_um": 9,
                    "contrast_rel": 0.05,
                }
            },
            "contrast",
        ),
        ({**DISC, "photon_transfer": {"brightest_photons": 10}}, "has no targets"),
        ({"motion": {"velocity_px_per_s": [1, 1]}}, "is empty"),
    ],
    ids=str,
)
def test_a_scene_that_cannot_be_used_is_refused_with_the_reason(record, words: str) -> None:
    with pytest.raises(InputError, match=words):
        build_scene(read_scene({"schema": "pixmetry/scene/1", **record}), SHAPE)


def test_a_mistake_in_a_target_names_its_line(tmp_path: Path) -> None:
    path = tmp_path / "scene.yaml"
    path.write_text(
        "schema: pixmetry/scene/1\ntargets:\n  - {kind: disc, x_px: 1, y_px: 1, diameter_px: 7}\n  - {kind: ring, x_px: 1, y_px: 2}\n"
    )
    with pytest.raises(InputError, match="line 4") as caught:
        read_scene(path)
    assert "missing" in str(caught.value)
