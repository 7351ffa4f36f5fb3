"""One target through a camera: every step's image is that of the camera cut short there, and the moves add up."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from catalogue.support import make_source
from pixmetry.camera.camera import Camera, Element, load_camera
from pixmetry.camera.catalogue import get_source
from pixmetry.camera.signal import Kind
from pixmetry.camera.source import Parameters
from pixmetry.core.errors import InputError
from pixmetry.simulate.chain import chain

SCENE = {
    "schema": "pixmetry/scene/1",
    "uniform": {"level_photons": 500},
    "discs": {"x_px": [60.3, 25.0], "y_px": [40.4, 20.0], "diameter_px": 7, "blur_px": 0.7, "peak_photons": 9000},
}


class Shift(Parameters):
    """Of a test source."""

    x_px: float = 0.25


SHIFT = make_source(
    "optics.shift", lambda p, s, _: s.with_light(s.light.moved(lambda x, y: (x - p.x_px, y))), (Kind.LIGHT,), parameters=Shift
)


def camera() -> Camera:
    preset = load_camera("imx264_like")
    links = (Element("lens shift", SHIFT, Shift()), *preset.chain)
    return replace(preset, frame_shape=(90, 110), chain=links)


def test_every_step_is_the_camera_cut_short_there() -> None:
    full = camera()
    result = chain(full, SCENE, seed=4)
    from pixmetry.scene.files import build_scene, read_scene

    scene = build_scene(read_scene(SCENE), full.frame_shape)
    assert [s.name for s in result.steps] == ["scene", *(e.name for e in full.chain)]
    for k, step in enumerate(result.steps):
        short = replace(full, chain=full.chain[:k])
        c, r = step.origin
        window = (r, c, *step.image.shape)
        assert np.array_equal(step.image, short.expose(scene, 1, seed=4, window=window).data[0].astype(float))
        assert np.array_equal(step.expected, short.expose(scene, 1, seed=4, window=window, quiet=True).data[0].astype(float))


def test_a_known_move_is_named_and_the_moves_add_up() -> None:
    result = chain(camera(), SCENE, seed=4)
    first, shift = result.steps[:2]
    assert np.allclose(first.error, 0.0, atol=4e-3)  # what sampling and threshold do to a disc of 7 px
    assert np.allclose(shift.moved, (0.25, 0.0), atol=3e-3) and np.allclose(shift.expected_moved, (0.25, 0.0), atol=3e-3)
    total = np.sum([s.moved for s in result.steps[1:]], axis=0)
    assert np.allclose(total + first.error, result.steps[-1].error)
    assert result.movers()[0].name == "lens shift"


def test_the_target_can_be_chosen_and_a_wrong_one_is_refused() -> None:
    assert chain(camera(), SCENE).target["x_px"] == pytest.approx(60.3)
    assert chain(camera(), SCENE, target=1).target["x_px"] == pytest.approx(25.0)
    with pytest.raises(InputError, match="no such target.*0 to 1"):
        chain(camera(), SCENE, target=2)
    with pytest.raises(InputError, match="no such frame"):
        chain(camera(), SCENE, frame=-1)


def test_a_target_out_of_sight_is_refused() -> None:
    scene = {"schema": "pixmetry/scene/1", "targets": [{"kind": "disc", "x_px": 5000, "y_px": 40, "diameter_px": 7}]}
    with pytest.raises(InputError, match="outside of the frame"):
        chain(camera(), scene)


def test_a_later_frame_of_a_camera_with_a_memory() -> None:
    full = camera()
    agc = get_source("electronics.agc")
    links = (*full.chain[:-2], Element("agc", agc, agc.typical), *full.chain[-2:])
    full = replace(full, chain=links)
    from pixmetry.scene.files import build_scene, read_scene

    scene = build_scene(read_scene(SCENE), full.frame_shape)
    step = chain(full, SCENE, frame=3, seed=1).steps[-1]
    c, r = step.origin
    assert np.array_equal(step.image, full.expose(scene, [3], seed=1, window=(r, c, *step.image.shape)).data[0].astype(float))


def test_dark_and_missing_targets() -> None:
    dark = SCENE | {"uniform": {"level_photons": 9000}, "discs": SCENE["discs"] | {"peak_photons": -8000}}
    assert np.hypot(*chain(camera(), dark).steps[1].moved) == pytest.approx(0.25, abs=5e-3)
    nothing = chain(camera(), {"schema": "pixmetry/scene/1", "uniform": {"level_photons": 500}})
    assert all(s.error is None for s in nothing.steps) and nothing.movers() == []
    faint = SCENE | {"discs": SCENE["discs"] | {"peak_photons": 2.0}}
    assert chain(camera(), faint).steps[-1].error is None


def test_what_is_constant_stands_apart_from_what_varies() -> None:
    """A shift is the same for all targets, photon noise differs from frame to frame, and sensitivities go with the place."""
    found = chain(camera(), SCENE, seed=4, draws=8)
    assert found.draws == 8
    by_name = {s.name: s for s in found.spread}
    shift, shot, prnu = by_name["lens shift"], by_name["sensor.shot_noise"], by_name["sensor.prnu"]
    assert np.hypot(*shift.constant) == pytest.approx(0.25, abs=0.01) and max(*shift.place, *shift.time) < 0.01
    assert shot.constant == shot.place == (0.0, 0.0) and min(shot.time) > 1e-4 and max(shot.time) < 0.05
    assert min(prnu.place) > 1e-5 and prnu.time == (0.0, 0.0)
    single = chain(camera(), SCENE, seed=4)
    assert single.spread == () and single.draws == 1


def test_the_command_writes_a_page_and_replaces_only_its_own(tmp_path: Path) -> None:
    from pixmetry.cli import main
    from pixmetry.core.config import dump_yaml

    scene, page, pdf = tmp_path / "scene.yaml", tmp_path / "page.html", tmp_path / "page.pdf"
    dump_yaml(SCENE, scene)
    small = replace(load_camera("imx264_like"), frame_shape=(90, 110))
    small.save(tmp_path / "camera.yaml")
    arguments = ["chain", str(tmp_path / "camera.yaml"), str(scene), "-o", str(page)]
    for more in ([], ["--pdf", str(pdf)]):
        done = CliRunner().invoke(main, [*arguments, *more])
        assert done.exit_code == 0 and str(page) in done.output
    assert pdf.read_bytes().startswith(b"%PDF-1") and f"pdf: {pdf}" in done.output
    text = page.read_text()
    assert len(re.findall(r'<figure id="source-', text)) == 1 + len(small.chain)
    assert "From frame to frame" in text and "the links of the chain" in text
    assert "http" not in re.sub(r"http://www\.w3\.org/\S+", "", text)  # asks for nothing from anywhere
    refused = CliRunner().invoke(main, [*arguments[:-1], str(scene)])
    assert refused.exit_code == 2 and "would overwrite an input" in refused.output and "discs" in scene.read_text()
    pdf.write_bytes(b"%PDF-1.4 of somebody else")
    refused = CliRunner().invoke(main, [*arguments, "--pdf", str(pdf)])
    assert refused.exit_code == 2 and "no result of this kind" in refused.output
    assert pdf.read_bytes() == b"%PDF-1.4 of somebody else"
    assert sorted(p.name for p in tmp_path.iterdir()) == ["camera.yaml", "page.html", "page.pdf", "scene.yaml"]
