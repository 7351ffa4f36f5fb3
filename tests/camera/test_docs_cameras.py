"""The camera of the documentation works as it stands, and its table names every preset."""

from __future__ import annotations

import re
from importlib.resources import files
from pathlib import Path

import pytest

from pixmetry.camera.camera import load_camera
from pixmetry.scene.uniform import Uniform

PAGE = (Path(__file__).resolve().parents[2] / "docs" / "cameras.md").read_text(encoding="utf-8")


def test_the_example_is_a_camera(tmp_path: Path) -> None:
    text = re.search(r"```yaml\n(.*?)```", PAGE, re.S)
    assert text is not None
    (tmp_path / "mine.yaml").write_text(text[1], encoding="utf-8")
    camera = load_camera(tmp_path / "mine.yaml")
    assert camera["optics.point_spread"].params.pitch_x_um == 5.0  # the camera's own
    frame = camera.expose(Uniform(2000.0), 1, window=(0, 0, 16, 16)).data
    assert abs(frame.mean() - (20 + 0.1 * 0.6 * 2000)) < 5


@pytest.mark.parametrize("name", ["imx264_like", "pulnix_tm6cn", "ft_ccd_generic", "cid_generic", "cmos_log_fuga15", "dcs420_like"])
def test_the_light_of_the_table_brings_half_of_the_range(name: str) -> None:
    row = next(line for line in PAGE.splitlines() if line.startswith(f"| `{name}`"))
    photons = float(row.split("|")[4].replace(" ", ""))
    camera = load_camera(name)

    def level(light: float) -> float:
        window = (camera.output_shape[0] // 2, camera.output_shape[1] // 2, 16, 16)
        return float(camera.expose(Uniform(light), 1, window=window, quiet=True).data.mean())

    dark, top = level(0.0), level(1e8)
    assert 0.4 < (level(photons) - dark) / (top - dark) < 0.6


def test_the_table_names_every_preset_with_the_size_of_its_frames() -> None:
    rows = [line for line in PAGE.splitlines() if line.startswith("| `")]
    for path in (files("pixmetry.camera") / "presets").iterdir():
        if not path.name.endswith(".yaml"):
            continue
        name = path.name.removesuffix(".yaml")
        family, _, mode = name.rpartition("_")
        row = next(r for r in rows if f"`{name}`" in r or (f"`{family}_" in r and f"`_{mode}`" in r))
        assert "{} × {}".format(*load_camera(name).output_shape) in row, name
