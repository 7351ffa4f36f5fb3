"""Corrected positions: what the camera does to points is taken off again, and what is left is within the stated covariance."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner

import pixmetry
from pixmetry.assess.known_geometry import height_map_of
from pixmetry.calibrate.bundle.model import CameraModel, Sensor
from pixmetry.calibrate.calibrated_camera import calibrated_camera, geometry_of
from pixmetry.camera.camera import Camera, load_camera
from pixmetry.camera.catalogue import sources
from pixmetry.camera.overrides import with_source
from pixmetry.camera.signal import Kind
from pixmetry.cli import main
from pixmetry.core.errors import InputError
from pixmetry.core.number import Estimates
from pixmetry.scene.discs import Discs
from pixmetry.scene.motion import Motion
from pixmetry.scene.picture import Picture
from pixmetry.scene.uniform import Uniform
from pixmetry.sources.sensor.unflatness import height_um

ANALOGUE, DIGITAL, FIELDS = "pulnix_tm6cn_epix_512", "imx264_like", "sony_xc8500_field"


def points(camera: Camera, n: int = 30) -> tuple[np.ndarray, np.ndarray]:
    """Places over the frame, away from its border."""
    rows, cols = camera.frame_shape
    k = np.arange(n)
    return 0.15 * cols + 0.7 * cols * ((0.5 + k * 0.7549) % 1), 0.15 * rows + 0.7 * rows * ((0.5 + k * 0.5698) % 1)


def host(source_id: str) -> Camera:
    """A preset with the source at its bound in the whole chain."""
    source = sources()[source_id]
    analogue = source.applies_to and "digital" not in source.applies_to and "cmos" not in source.applies_to
    camera = load_camera(ANALOGUE if analogue else DIGITAL)
    if not any(e.source.id == source_id for e in camera.chain):
        camera = with_source(camera, source_id)
    name = next(e.name for e in camera.chain if e.source.id == source_id)
    own = camera[name].params.model_dump()
    known = {n: own[n] for n in ("pitch_x_um", "pitch_y_um", "pitch_um", "line_time_us", "pixel_time_ns") if n in own}
    params = source.make({**source.bound.model_dump(), **known})
    return replace(camera, chain=tuple(replace(e, on=True, params=params) if e.name == name else e for e in camera.chain))


def moved_by(camera: Camera, source_id: str, **kw: Any) -> float:
    """The largest displacement by a source, in the chain."""
    x, y = points(camera)
    off = [e.name for e in camera.chain if e.source.id == source_id]
    seen, without = (np.stack(c.true_positions(x, y, **kw)) for c in (camera, camera.switched(off=off)))
    return float(np.nanmax(np.abs(seen - without)))


def moving_sources() -> list[str]:
    """All sources of the catalogue that move points in the maps of a camera, by what they do and not by a list.

    Sources of numbers that do not say where they put points move none.
    """
    found = []
    for source_id, source in sources().items():
        may = source.place is not None or {Kind.LIGHT, Kind.VIDEO} & set(source.consumes)
        if source.forward is not None and may and moved_by(host(source_id), source_id, frame=3) > 1e-9:
            found.append(source_id)
    return found


MOVING = moving_sources()


@pytest.mark.parametrize("source_id", MOVING)
def test_every_source_that_moves_points_is_corrected_in_the_whole_chain(source_id: str) -> None:
    camera = host(source_id)
    x, y = points(camera)
    table = dict(zip(("x_px", "y_px"), camera.true_positions(x, y, frame=3), strict=True)) | {"frame": np.full(len(x), 3)}
    before = np.hypot(table["x_px"] - x, table["y_px"] - y)
    found = pixmetry.corrected(table, camera, only=[e.name for e in camera.active if e.source.id != "sensor.exposure"])
    assert any(s.name == source_id and s.applied and max(s.shift_px) > 0 for s in found.sources)
    left = np.hypot(found.x_px - x, found.y_px - y)
    assert np.max(left) < 1e-6 < np.max(before)
    alone = pixmetry.corrected(table, camera, only=[source_id])  # the others stay in
    without = camera.switched(off=[source_id]).true_positions(x, y, frame=3)
    assert np.stack([alone.x_px, alone.y_px]) == pytest.approx(np.stack(without), abs=1e-6)


def test_no_source_says_that_positions_are_corrected_and_cannot_be_reached() -> None:
    words = ("positions are corrected", "coordinates are", "positions are multiplied")
    said = {i for i, s in sources().items() if s.forward is not None and any(w in s.reasons.get("correct", "") for w in words)}
    assert len(said) >= 13
    assert said <= set(MOVING)


@pytest.mark.parametrize("source_id", ["sensor.interlace", "sensor.rolling_shutter"])
def test_what_looks_at_other_times_is_corrected_by_the_speed(source_id: str) -> None:
    """Discs that move through the rows' times are located in frames; the speed brings them back to where they were."""
    camera = host(source_id)
    kept = (source_id, "sensor.exposure")
    camera = replace(camera, frame_shape=(240, 200), chain=tuple(e for e in camera.chain if e.source.id in kept), exposure_s=0.01)
    v = (400.0, -90.0)
    x, y = (a.ravel() for a in np.meshgrid([40.0, 100.0, 160.0], [40.0, 100.0, 160.0, 205.0]))
    middle = 0.5 * camera.exposure_s
    motion = Motion(v)
    discs = Discs(x - v[0] * middle, y - v[1] * middle, diameter_px=9.0, blur_px=1.0, peak_photons=1e4)
    data = camera.expose(Picture((discs.layer(motion),), Uniform(0.0)), 1, quiet=True).data[0].astype(float)
    seen = np.array([_centroid(data, round(a), round(b)) for a, b in zip(x, y, strict=True)])
    table = {"x_px": seen[:, 0], "y_px": seen[:, 1], "vx_px_per_s": np.full(len(x), v[0]), "vy_px_per_s": np.full(len(x), v[1])}
    found = pixmetry.corrected(table, camera)
    assert any(s.applied and s.name == source_id for s in found.sources)
    before, left = (np.abs(c - np.stack([x, y], 1)) for c in (seen, np.stack([found.x_px, found.y_px], 1)))
    assert left.max() < 0.04 < before.max()
    untold = pixmetry.corrected(seen, camera)
    assert any("needs the speed" in s.text for s in untold.sources if s.name == source_id)


def _centroid(data: np.ndarray, x: int, y: int, half: int = 20) -> tuple[float, float]:
    part = data[y - half : y + half + 1, x - half : x + half + 1]
    total, at = part.sum(), np.arange(-half, half + 1)
    return x + float((part.sum(axis=0) * at).sum() / total), y + float((part.sum(axis=1) * at).sum() / total)


def test_located_discs_of_a_grabber_that_warms_up_are_brought_back() -> None:
    """The whole chain, through the locator: 20 minutes of warm-up, 2.5 px, are taken off, and a constant delay by the filters stays."""
    camera = load_camera(ANALOGUE)
    x, y = (a.ravel() for a in np.meshgrid(np.arange(90.0, 660, 90), np.arange(90.0, 500, 90)))
    scene = Discs(x, y, diameter_px=10.0, blur_px=0.7, peak_photons=40000.0, background=Uniform(4000.0))
    errors, raw = [], []
    for number in (0, 30000):
        found = pixmetry.locate(camera.expose(scene, [number], quiet=True).data[0], kind="disc")
        told = pixmetry.corrected({"x_px": found.x_px, "y_px": found.y_px, "frame": np.full(len(found), number)}, camera)
        distance = np.hypot(told.x_px[:, None] - x, told.y_px[:, None] - y)
        nearest = np.argmin(distance, axis=0)
        assert len(found) == len(x) == len(set(nearest))
        errors.append(np.stack([told.x_px[nearest] - x, told.y_px[nearest] - y], 1))
        raw.append(np.stack([found.x_px[nearest], found.y_px[nearest]], 1))
    drift, left = raw[1] - raw[0], errors[1] - errors[0]
    assert np.abs(drift[:, 0]).mean() > 1.5
    assert np.abs(left).max() < 0.03
    delay = np.median(errors[1], axis=0)
    assert 0.2 < delay[0] < 2.0 and abs(delay[1]) < 0.03
    assert np.abs(errors[1] - delay).max() < 0.06


def uncertain(camera: Camera, name: str, **u: float) -> Camera:
    """The camera with standard uncertainties of parameters, correlated by 0.6 where they are two."""
    params = camera[name].params
    names, values = tuple(u), np.array(list(u.values()))
    correlation = np.full((len(u), len(u)), 0.6)
    np.fill_diagonal(correlation, 1.0)
    estimates = Estimates(
        names=names,
        values=np.array([getattr(params, n) for n in names]),
        covariance=correlation * np.outer(values, values),
        dof=np.full(len(names), np.inf),
        units=tuple(camera[name].source.units[n] for n in names),
    )
    return replace(
        camera, chain=tuple(replace(e, estimates=estimates, known_from="measured") if e.name == name else e for e in camera.chain)
    )


def test_the_covariance_is_that_of_cameras_drawn_from_what_is_known(rng: np.random.Generator) -> None:
    """Positions seen by 400 true cameras, corrected by the one that is described: u and the correlations between points are as stated."""
    camera = load_camera(DIGITAL)
    for source_id in ("optics.distortion", "sensor.thermal_expansion"):
        camera = with_source(camera, source_id) if source_id not in camera else camera
    camera = camera.with_parameters("optics.distortion", k1_per_mm2=-5e-4).with_parameters(
        "sensor.thermal_expansion", reference_c=20.0, mount_per_k=23e-6
    )
    camera = uncertain(camera, "optics.distortion", k1_per_mm2=2e-5, k2_per_mm4=4e-7)
    camera = uncertain(camera, "sensor.thermal_expansion", mount_per_k=3e-6)
    camera = replace(camera, temperature_c=35.0)
    x, y = points(camera, 6)
    seen = camera.true_positions(x, y)
    told = pixmetry.corrected({"x_px": seen[0], "y_px": seen[1]}, camera)
    trials, n = 400, len(x)
    errors = np.empty((trials, 2 * n))
    for k in range(trials):
        one = camera
        for name, e in camera.estimates.items():
            drawn = rng.multivariate_normal(e.values, e.covariance)
            one = one.with_parameters(name, **dict(zip(e.names, map(float, drawn), strict=True)))
        # M₀(M⁻¹(p)) by the described camera of what the drawn one shows
        u, v = camera.ideal_positions(*one.true_positions(x, y))
        errors[k] = np.stack([u - x, v - y], 1).ravel()
    covariance = told.correction_covariance_px2
    assert told.correction_px2.max() > 0.02**2
    # whitened errors: three independent causes, each of variance 1 within six standard errors √(2/400) = 0.071
    power, directions = np.linalg.eigh(covariance)
    assert np.sum(power > 1e-6 * power[-1]) == 3
    scores = (errors @ directions[:, -3:]) / np.sqrt(power[-3:])
    assert scores.var(axis=0) == pytest.approx(np.ones(3), abs=6 * 0.071 + 0.03)
    off = np.corrcoef(scores.T)[np.triu_indices(3, 1)]
    assert np.abs(off).max() < 6 / np.sqrt(trials)
    mean = errors.reshape(trials, n, 2).mean(axis=1).std(axis=0)
    assert mean == pytest.approx(np.array(told.common_u_px), rel=6 * 0.036 + 0.03, abs=1e-4)


def test_the_measured_covariance_goes_through_the_map_and_grows() -> None:
    camera = load_camera(ANALOGUE)
    x, y = points(camera, 5)
    seen = camera.true_positions(x, y)
    table = {"x_px": seen[0], "y_px": seen[1], "var_x_px2": np.full(5, 1e-4), "cov_xy_px2": np.zeros(5), "var_y_px2": np.full(5, 4e-4)}
    plain = pixmetry.corrected(table, camera)
    # 14.1875 MHz over 10 MHz, less the grabber that is too fast by 0.7 %
    assert np.sqrt(plain.covariance_px2[:, 0]) == pytest.approx(np.full(5, 0.01 * 1.41875 / 1.0071), rel=1e-3)
    told = pixmetry.corrected(table, camera, u={"state.temperature_change_k": 5.0, "grabber.clock_warm_up.delay_ns": 10.0})
    assert np.all(told.covariance_px2[:, 0] > plain.covariance_px2[:, 0])
    own = told.effects_px[list(told.causes).index("grabber.clock_warm_up")]
    assert np.abs(own[:, 0]) == pytest.approx(np.full(5, 10e-9 * 14.1875e6 * np.exp(-7200 / 820)), rel=0.02)
    assert told.columns["var_x_px2"] == pytest.approx(told.covariance_px2[:, 0])
    assert told.state_u_px["state.temperature_change_k"][0] > 0


def test_what_is_only_typical_or_drawn_is_left_unless_it_is_named() -> None:
    camera = load_camera(DIGITAL)
    for source_id, params in (
        ("optics.distortion", {"k1_per_mm2": -5e-4}),
        ("sensor.stabilisation", {"shift_std_px": 1.0}),
    ):
        camera = with_source(camera, source_id).with_parameters(source_id, **params)
    chain = tuple(replace(e, known_from="typical") if e.name == "optics.distortion" else e for e in camera.chain)
    camera = replace(camera, chain=chain)
    found = pixmetry.corrected([[100.0, 200.0], [1500.0, 900.0]], camera)
    why = {s.name: s.text for s in found.sources if not s.applied}
    assert "only typical" in why["optics.distortion"] and "drawn at random" in why["sensor.stabilisation"]
    assert np.abs(found.shift_px).max() < 0.5  # neither of the two
    named = pixmetry.corrected([[100.0, 200.0], [1500.0, 900.0]], camera, only=["optics.distortion"])
    assert np.abs(named.shift_px).max() > 1 and [s.name for s in named.sources if s.applied] == ["optics.distortion"]


def test_a_height_map_gives_the_surface_that_made_it(tmp_path: Path) -> None:
    source = sources()["sensor.unflatness"]
    params = source.make({"bow_x_um": 12.0, "bow_y_um": -7.0, "twist_um": 4.0, "skew_x_um": 2.0, "more_um": [[0, 0], [0, 0, 3.0]]})
    camera = load_camera(DIGITAL)
    rows, cols = camera.frame_shape
    y, x = np.meshgrid((np.arange(12) + 0.5) / 12 * rows - 0.5, (np.arange(16) + 0.5) / 16 * cols - 0.5, indexing="ij")
    height = height_um(params, x, y, (rows, cols))
    np.save(tmp_path / "height.npy", height)
    lines = [f"{a:.6f},{b:.6f},{h:.9f}" for a, b, h in zip(x.ravel(), y.ravel(), height.ravel(), strict=True)]
    (tmp_path / "height.csv").write_text("x_px,y_px,height_um\n" + "\n".join(lines) + "\n")
    for name in ("height.npy", "height.csv"):
        settings = height_map_of(tmp_path / name, camera).settings
        found = pixmetry.corrected([[300.0, 400.0], [2000.0, 1500.0]], camera, settings=settings, only=["sensor.unflatness"])
        told = {key.rpartition(".")[2]: value for key, value in settings.items()}
        again = height_um(source.make(told), x, y, (rows, cols))
        assert again == pytest.approx(height, abs=1e-6)
        assert np.abs(found.shift_px).max() > 0.1
    np.save(tmp_path / "few.npy", height[:1])
    with pytest.raises(InputError, match="too few heights"):
        height_map_of(tmp_path / "few.npy", camera)


def run(*arguments: object) -> tuple[int, str]:
    done = CliRunner().invoke(main, ["corrected", *map(str, arguments)])
    return done.exit_code, done.output


def test_a_table_of_another_program_keeps_all_it_holds(tmp_path: Path) -> None:
    text = "# survey 7\nname;X;Y;sigma_x;sigma_y;note\na;100.5;200.5;0.01;0.02;left\nb;;;;;lost\nc;400.5;300.5;0.01;0.02;right\n"
    (tmp_path / "other.csv").write_text(text)
    code, said = run(
        tmp_path / "other.csv", "--with", ANALOGUE, "--origin", "corner", "-o", tmp_path / "out.csv", "--json", tmp_path / "r.json"
    )
    assert code == 0, said
    assert (
        "grabber.sampling_clock: corrected" in said
        and "switched on when frame 0 was taken" in said
        and "warms up by 20 K from frame 0" in said
    )
    lines = (tmp_path / "out.csv").read_text().splitlines()
    assert lines[1] == "# survey 7" and lines[2] == "name;X;Y;sigma_x;sigma_y;note"
    a, b, c = (line.split(";") for line in lines[3:])
    assert (a[0], a[5], b, c[5]) == ("a", "left", ["b", "", "", "", "", "lost"], "right")
    x, y = load_camera(ANALOGUE).ideal_positions([100.0, 400.0], [200.0, 300.0])
    assert [float(v) - 0.5 for v in (a[1], c[1])] == pytest.approx(list(x)) and [float(v) - 0.5 for v in (a[2], c[2])] == pytest.approx(
        list(y)
    )
    assert float(a[3]) == pytest.approx(0.01 * 1.41875 / 1.0071, rel=1e-3)
    record = json.loads((tmp_path / "r.json").read_text())
    assert record["schema"] == "pixmetry/corrected/1" and any(s["applied"] for s in record["sources"])
    again, _ = run(tmp_path / "other.csv", "--with", ANALOGUE, "--origin", "corner", "-o", tmp_path / "out.csv")
    assert again == 0  # its own earlier result is replaced
    code, said = run(tmp_path / "other.csv", "--with", ANALOGUE, "-o", tmp_path / "other.csv")
    assert code == 2 and "overwrite an input" in said
    assert (tmp_path / "other.csv").read_text() == text


def test_tables_of_locate_come_back_in_their_form(tmp_path: Path) -> None:
    camera = load_camera(DIGITAL)
    frame = camera.expose(Discs([60.0, 130.0], [50.0, 90.0], peak_photons=9000.0), 1, window=(0, 0, 150, 200)).data[0]
    table = pixmetry.locate(frame)
    for name in ("table.csv", "table.json"):
        table.write(tmp_path / name)
        code, said = run(tmp_path / name, "--with", DIGITAL, "--temperature-k", 10, "--cover-glass", "0.75", "-o", tmp_path / f"out_{name}")
        assert code == 0, said
        assert "optics.cover_glass: corrected" in said and "not told" in said
    record = json.loads((tmp_path / "out_table.json").read_text())
    assert record["schema"] == "pixmetry/located/1" and record["columns"] == list(table.columns)
    found = pixmetry.corrected(tmp_path / "out_table.csv", DIGITAL, skip=[e.name for e in camera.active])
    assert [t["x_px"] for t in record["targets"]] == pytest.approx(list(found.measured.x_px), abs=1e-6)
    direct = pixmetry.corrected(table, DIGITAL, settings={"state.temperature_change_k": 10.0, "optics.cover_glass.thickness_um": 750.0})
    assert direct.x_px == pytest.approx(found.measured.x_px, abs=1e-6)
    (tmp_path / "blanks.txt").write_text("x y note\n100 200 a\nnan nan b\n")
    for more, columns in (((), "x y note"), (("--u", "state.temperature_change_k=1"), "x y note correction_var_x_px2")):
        code, said = run(tmp_path / "blanks.txt", "--with", ANALOGUE, "-o", tmp_path / "out.txt", *more)
        assert code == 0, said
        first, header, *rows = (tmp_path / "out.txt").read_text().splitlines()
        assert (
            "lacks the uncertainty of" in first and header.startswith(columns) and {len(r.split()) for r in rows} == {len(header.split())}
        )
    code, said = run(tmp_path / "table.csv", "--with", DIGITAL, "--list")
    assert code == 0 and "x_px" not in said


@pytest.mark.parametrize(
    ("content", "arguments", "words"),
    [
        ("a,b\n1,2\n", (), ("no column with x", "--x NAME")),
        ("x,y\n1,zwei\n", (), ("'y' is no number", "row 1")),
        ("x;y\n1,5;2\n", (), ("write the decimal point as a point: 1.5",)),
        ("x,y,frame\n1,2,0.5\n", (), ("'frame' is no number of a frame",)),
        ("x,y,var_x,var_y\n1,2,-1,1\n", (), ("hold no uncertainty",)),
        ("x,y\n1,2\n", ("--u", "optics.nothing=1"), ("no number has this name",)),
        ("x,y\n1,2\n", ("--u", "motion.speed_px_per_s=1"), ("has no value",)),
        ("x,y\n1,2\n", ("--only", "sensor.tilt"), ("no source named 'sensor.tilt'",)),
        ("x,y\n1,2\n", ("--cover-glass", "750"), ("no cover glass is so thick",)),
        ("x,y\n1,2\n", ("--speed", "fast"), ("cannot be read",)),
    ],
)
def test_what_cannot_be_used_is_told(content: str, arguments: tuple[str, ...], words: tuple[str, ...], tmp_path: Path) -> None:
    (tmp_path / "t.csv").write_text(content)
    code, said = run(tmp_path / "t.csv", "--with", DIGITAL, *arguments)
    assert code == 2, said
    assert all(word in said for word in words), said


def test_positions_that_the_correction_loses_are_empty_and_those_outside_of_the_frame_are_told() -> None:
    table = {"x_px": [1200.0, np.inf, 11000.0], "y_px": [1000.0, 3.0, 1000.0], "u_x_px": [0.1] * 3, "u_y_px": [0.1] * 3}
    found = pixmetry.corrected(table, DIGITAL)
    assert "1 positions lie outside of the frame of 2448 × 2048 pixels" in found.notes[-1]
    assert np.isnan(found.x_px[1]) and found.columns["x_px"][1] == np.inf
    lost = replace(found, x_px=np.array([1200.0, np.nan, np.nan]))
    assert lost.columns["x_px"] == [1200.0, np.inf, None] and lost.columns["u_x_px"] == pytest.approx([0.1, 0.1, None])


def test_what_changes_from_image_to_image_is_fitted_to_reference_positions(rng: np.random.Generator, tmp_path: Path) -> None:
    """A grabber of unknown warm-up: scales of three images by nine of 30 targets; the others are right within the stated covariance."""
    camera = load_camera(ANALOGUE).switched(off=["sensor.thermal_expansion"])
    x, y = points(camera)
    u, rows = 0.01, []
    for image in range(3):
        seen = camera.true_positions(x, y, frame=9000 * image)
        noise = u * rng.standard_normal((2, len(x)))
        rows += [(f"im{image}", f"p{k}", *v) for k, v in enumerate(zip(*(np.stack(seen) + noise), strict=True))]
    image, point, px, py = (list(v) for v in zip(*rows, strict=True))
    n = len(rows)
    table = {"image": image, "point": point, "x_px": px, "y_px": py, "u_x_px": np.full(n, u), "u_y_px": np.full(n, u)}
    control = {"point": [f"p{k}" for k in range(9)], "x_px": x[:9], "y_px": y[:9]}
    unaware = camera.switched(off=["grabber.clock_warm_up"])
    plain, found = (pixmetry.corrected(table, unaware, reference=r) for r in (None, control))
    free = np.array([int(p[1:]) >= 9 for p in point])
    aim = np.stack([np.tile(x, 3), np.tile(y, 3)], 1)
    before, left = (np.stack([c.x_px, c.y_px], 1) - aim for c in (plain, found))
    assert np.abs(before[free, 0]).mean() > 1 > 0.12 > np.abs(left[free]).max()  # 126 numbers of u 0.018 px at most
    z2 = (left[free, 0] ** 2 / found.covariance_px2[free, 0]).mean()
    # 63 normal scores, of which the fits correlate some: a mean square of 1 to 6 x sqrt(2/63) x 1.3
    assert abs(z2 - 1) < 6 * 1.3 * np.sqrt(2 / 63) and z2 > 0.2
    assert np.all(found.covariance_px2[:, 0] > plain.covariance_px2[:, 0])
    assert found.image_effects_px.shape == (4, n, 2) and "im2" in found.notes[-1]
    whole = found.correction_covariance_px2
    assert whole[::2, ::2].diagonal() == pytest.approx(found.correction_px2[:, 0]) and np.all(whole[:60, 60:] == 0)
    assert np.array(found.common_u_px) == pytest.approx(np.sqrt([whole[i::2, i::2].mean() for i in (0, 1)]))
    wide = pixmetry.corrected(table, unaware, reference=control, u={"grabber.sampling_clock.clock_mhz": 0.01})
    alone = wide.effects_px[list(wide.causes).index("grabber.sampling_clock")]
    assert np.abs(alone[:, 0]).max() < 0.01  # a wrong clock is a scale, which every image tells
    few = pixmetry.corrected(table, unaware, reference={"point": ["p1"], "x_px": x[1:2], "y_px": y[1:2]})
    assert "too few" in few.notes[-1] and few.x_px == pytest.approx(plain.x_px)
    with pytest.raises(InputError, match="no column names"):
        pixmetry.corrected(table, unaware, reference={"spot": ["a"], "x_px": [1.0], "y_px": [2.0]})
    with pytest.raises(InputError, match="no target of the table"):
        pixmetry.corrected(table, unaware, reference={"point": ["a"], "x_px": [1.0], "y_px": [2.0]})


def test_the_pose_of_a_stabilised_sensor_is_fitted(rng: np.random.Generator) -> None:
    camera = with_source(load_camera(DIGITAL), "sensor.stabilisation")
    camera = camera.with_parameters("sensor.stabilisation", shift_std_px=0.5, roll_std_rad=1e-3)
    x, y = points(camera, 12)
    seen = np.stack(camera.true_positions(x, y, frame=4)) + 0.005 * rng.standard_normal((2, 12))
    names = [f"t{k}" for k in range(12)]
    found = pixmetry.corrected(
        {"name": names, "x_px": seen[0], "y_px": seen[1]},
        camera,
        reference={"name": names[:6], "x_px": x[:6], "y_px": y[:6]},
        per_image="pose",
    )
    left = np.stack([found.x_px - x, found.y_px - y])
    assert np.abs(seen - np.stack([x, y])).max() > 0.1 > 0.06 > np.abs(left[:, 6:]).max()
    assert 1e-4 < np.sqrt(found.correction_px2[6:, [0, 2]]).max() < 0.05


def test_a_calibrated_lens_is_taken_off_as_the_bundle_does_it(tmp_path: Path) -> None:
    """The bundle's own formula for directions is the oracle; the file of the camera carries the covariance of the calibration."""
    camera = load_camera("pulnix_tm6cn")
    rows, cols = camera.frame_shape
    names, u = ("c", "k1", "p1", "b1"), np.array([1e-3, 2e-6, 1e-6, 2e-6])
    model = CameraModel.of(Sensor(cols, rows, *camera.pitch_um), c=12.0, xp=380.0, yp=287.0, b1=1e-3, b2=-5e-4, k1=-1.5e-3, p1=3e-5)
    geometry = geometry_of(model, names, np.diag(u**2), dof=300)
    calibrated_camera(camera, geometry).save(tmp_path / "camera.yaml")
    x, y = points(camera)
    found = pixmetry.corrected({"x_px": x, "y_px": y}, tmp_path / "camera.yaml", only=["optics.distortion", "sensor.affinity"])
    c, cx, cy = (geometry.lens[n].value for n in ("principal_distance_mm", "centre_x_px", "centre_y_px"))
    a, b = model.direction_of(x, y)
    ideal = np.stack([(cols - 1) / 2 + cx + c / (camera.pitch_um[0] / 1000) * a, (rows - 1) / 2 + cy + c / (camera.pitch_um[1] / 1000) * b])
    # what else the chain moves stays in, by thousandths of what it moves
    assert np.stack([found.x_px, found.y_px]) == pytest.approx(ideal, abs=0.03)
    assert np.abs(found.shift_px).max() > 1
    told = {s.name: s for s in found.sources if s.applied}
    assert set(told) == {"optics.distortion", "sensor.affinity"}
    # K1 alone: r³ u(K1), and c along with it
    r = np.hypot((x - 380.0) * 8.6e-3, (y - 287.0) * 8.3e-3).max()
    assert max(told["optics.distortion"].u_px) == pytest.approx(r**3 * 2e-6 / 8.5e-3, rel=0.5)
    assert all("by measured parameters" in s.text and "not stated" not in s.text for s in told.values())


def four(shift_px: float = 0.0, **more: Any) -> dict[str, Any]:
    """Four named targets, with a shift in x."""
    x, y = np.array([300.0, 900.0, 1500.0, 2100.0]), np.array([300.0, 1700.0, 900.0, 400.0])
    return {"point": ["a", "b", "c", "d"], "x_px": x + shift_px, "y_px": y, **more}


def stacked(*tables: dict[str, Any]) -> dict[str, Any]:
    return {name: [v for t in tables for v in t[name]] for name in tables[0]}


def test_frames_and_images_are_fitted_one_by_one() -> None:
    shifts = (1.0, 5.0, -2.0, 0.5)
    names = [("m", 0), ("m", 1), ("n", 0), ("n", 1)]
    tables = [four(s, image=[i] * 4, frame=[k] * 4) for s, (i, k) in zip(shifts, names, strict=True)]
    both = stacked(*tables)
    frames = stacked(*({**t, "frame": [k] * 4} for k, t in enumerate(tables)))
    frames = {name: values for name, values in frames.items() if name != "image"}
    for table, told in ((both, "image n, frame 1"), (frames, "frame 3")):
        found = pixmetry.corrected(table, DIGITAL, reference=four(), per_image="shift")
        assert found.x_px == pytest.approx(np.tile(four()["x_px"], 4), abs=1e-6)
        assert any(note.startswith(f"{told}: shift by 4") for note in found.notes)


def test_the_uncertainty_of_the_reference_is_in_every_image_alike() -> None:
    own = {"u_x_px": np.full(4, 0.02), "u_y_px": np.full(4, 0.02)}
    table = stacked(four(1.0, frame=[0] * 4, **own), four(5.0, frame=[1] * 4, **own))
    wide = four(u_x_px=np.full(4, 0.5), u_y_px=np.full(4, 0.5))
    plain, told = (pixmetry.corrected(table, DIGITAL, reference=r, per_image="shift") for r in (four(), wide))
    assert plain.correction_px2[:, 0] == pytest.approx(np.full(8, 0.02**2 / 4), rel=1e-3)
    assert told.correction_px2[:, 0] == pytest.approx(np.full(8, (0.02**2 + 0.5**2) / 4), rel=1e-3)
    whole = told.correction_covariance_px2
    assert whole[0, 8] == pytest.approx(0.5**2 / 4, rel=1e-3) and told.common_u_px[0] == pytest.approx(0.25, rel=1e-2)


def test_an_uncertainty_of_0_has_no_weight_and_numbers_as_names_are_told_apart() -> None:
    ids = [1234567.0, 1234568.0, 1234569.0, 3.0]
    u = {"u_x_px": [0.0, 0.1, 0.1, 0.1], "u_y_px": [0.1] * 4, "id": ids}
    table, control = ({**four(shift, **u), "point": ids} for shift in (1.0, 0.0))
    found = pixmetry.corrected(table, DIGITAL, reference={**control, "u_x_px": [0.0] * 4, "u_y_px": [0.0] * 4}, per_image="shift")
    assert found.x_px == pytest.approx(control["x_px"], abs=1e-6)
    assert any("has no weight" in note for note in found.notes)


@pytest.mark.parametrize(
    ("key", "u"),
    [("optics.cover_glass.thickness_um", 20.0), ("sensor.affinity.b1", 1e-4), ("state.temperature_change_k", 3.0)],
)
def test_the_uncertainty_of_what_moves_nothing_is_not_lost(key: str, u: float) -> None:
    """What a change by u does, as for a value that is not 0."""
    camera = load_camera(DIGITAL)
    if key.startswith("state"):
        params = {"reference_c": camera.temperature_c, "mount_per_k": 23e-6}
        camera = with_source(camera, "sensor.thermal_expansion").with_parameters("sensor.thermal_expansion", **params)
    at = [[100.0, 100.0], [2300.0, 1900.0]]
    found = pixmetry.corrected(at, camera, u={key: u})
    moved = pixmetry.corrected(at, camera, settings={key: u}, u={key: 0.0})
    still = pixmetry.corrected(at, camera, settings={key: 0.0}, only=[s.name for s in moved.sources if s.applied])
    change = np.abs(moved.x_px - still.x_px)
    assert change.min() > 1e-3
    assert np.sqrt(found.correction_px2[:, 0]) == pytest.approx(change, rel=0.05)


def test_an_uncertainty_larger_than_the_range_is_refused_and_what_has_no_effect_is_told() -> None:
    at = [[100.0, 100.0], [2300.0, 1900.0]]
    with pytest.raises(InputError, match="on both sides"):
        pixmetry.corrected(at, DIGITAL, settings={"optics.cover_glass.index": 1.5}, u={"optics.cover_glass.index": 50.0})
    camera = load_camera(DIGITAL)
    without = camera.switched(off=[e.name for e in camera.active if e.source.id == "sensor.thermal_expansion"])
    warm = pixmetry.corrected(at, without, settings={"state.temperature_change_k": 5.0})
    assert "state.temperature_change_k has no effect on these positions" in warm.notes
    table = {"x_px": [100.0, 2300.0], "y_px": [100.0, 1900.0], "temperature_c": [30.0, 40.0]}
    told = with_source(without, "sensor.thermal_expansion").with_parameters("sensor.thermal_expansion", mount_per_k=23e-6)
    hidden = pixmetry.corrected(table, told, settings={"state.temperature_change_k": 5.0}, u={"temperature_c": 2.0})
    assert "state.temperature_change_k has no effect on these positions: the column temperature_c tells the temperature" in hidden.notes
    none = pixmetry.corrected(table, without, u={"temperature_c": 2.0})
    assert "the uncertainty of temperature_c has no effect on these positions" in none.notes
    warmer = pixmetry.corrected({**table, "temperature_c": [32.0, 42.0]}, told, settings={"state.temperature_change_k": 5.0})
    assert np.sqrt(hidden.correction_px2[:, 0]) == pytest.approx(np.abs(warmer.x_px - hidden.x_px), rel=1e-3)
    assert np.abs(warmer.x_px - hidden.x_px).min() > 1e-3


def test_speeds_of_a_table_are_those_of_its_pixels() -> None:
    """100 px/s of the sensor are 70.5 px/s in frames whose pixels are wider by 1.41875."""
    at = {"x_px": [200.0, 200.0], "y_px": [200.0, 203.0]}
    still, sensor = (pixmetry.corrected(at, ANALOGUE, settings={"motion.speed_px_per_s": v}) for v in (0.0, 100.0))
    frame = pixmetry.corrected({**at, "vx_px_per_s": [100 / 1.41875] * 2, "vy_px_per_s": [0.0] * 2}, ANALOGUE)
    taken = sensor.x_px - still.x_px
    assert np.abs(taken).max() > 0.5
    assert frame.x_px - still.x_px == pytest.approx(taken, rel=0.01)


def test_only_corrected_tables_are_replaced_and_in_their_form(tmp_path: Path) -> None:
    located = "# pixmetry pixmetry/located/1; kind disc\nx_px,y_px\n100,200\n"
    for name in ("t.csv", "precious.csv"):
        (tmp_path / name).write_text(located)
    code, said = run(tmp_path / "t.csv", "--with", ANALOGUE, "-o", tmp_path / "precious.csv")
    assert code == 2 and "no result of this kind" in said and (tmp_path / "precious.csv").read_text() == located
    (tmp_path / "precious.json").write_text(json.dumps({"schema": "pixmetry/located/1", "targets": [{"x_px": 1, "y_px": 2}]}, indent=1))
    (tmp_path / "list.json").write_text(json.dumps([{"x": 100, "y": 200, "note": "'-1"}]))
    for table, output, words in (
        ("t.csv", "precious.json", "written as CSV"),
        ("t.csv", "new.parquet", "written as CSV"),
        ("list.json", "new.csv", "written as JSON"),
        ("list.json", "precious.json", "no result of this kind"),
    ):
        code, said = run(tmp_path / table, "--with", ANALOGUE, "-o", tmp_path / output)
        assert code == 2 and words in said
    (tmp_path / "truth.csv").write_text("# pixmetry pixmetry/truth/1\nx,y\n1,2\n")
    for table, output in (("list.json", "out.json"), ("truth.csv", "out.csv"), ("precious.json", "out2.json"), ("t.csv", "out2.csv")):
        for _ in range(2):  # its own result is replaced
            code, said = run(tmp_path / table, "--with", ANALOGUE, "-o", tmp_path / output)
            assert code == 0, said
        code, said = run(tmp_path / output, "--with", ANALOGUE, "-o", tmp_path / f"twice_{output}")
        assert code == 2 and "corrected for it before" in said and "--skip grabber.sampling_clock" in said
        skip = [w for w in said.split() if "." in w and w in {e.name for e in load_camera(ANALOGUE).active}]
        code, said = run(tmp_path / output, "--with", ANALOGUE, "--list", *(a for name in skip for a in ("--skip", name)))
        assert code == 0, said
    record = json.loads((tmp_path / "out.json").read_text())
    assert record["targets"][0]["note"] == "'-1" and record["corrected"].startswith("sensor.")


@pytest.mark.parametrize("mark", [",", ";", "\t"])
def test_what_is_not_corrected_stays_as_it_was_written(mark: str, tmp_path: Path) -> None:
    head = ["=name", "x", '"a note"', "y", "temp", "", "-"]
    rows = [["-A1", "100.50", f'"b{mark} ""c"""', "200.25", '"-5,3"', "@ok", "-"], ["+B", "", "-inf", "", " 007 ", "'=1", "1e3"]]
    (tmp_path / "t.csv").write_text("".join(mark.join(r) + "\n" for r in (head, *rows)))
    code, said = run(tmp_path / "t.csv", "--with", ANALOGUE, "-o", tmp_path / "out.csv", "--u", "grabber.sampling_clock.clock_mhz=0.01")
    assert code == 0, said
    _, first, one, other = (tmp_path / "out.csv").read_text().splitlines()
    new = mark + mark.join(("correction_var_x_px2", "correction_cov_xy_px2", "correction_var_y_px2"))
    assert first == mark.join(head) + new and other == mark.join(rows[1]) + 3 * mark
    x = pixmetry.corrected([[100.5, 200.25]], ANALOGUE).x_px[0]
    assert one.startswith(f"-A1{mark}{x:.10g}{mark}{rows[0][2]}{mark}") and f'{mark}"-5,3"{mark}@ok{mark}-{mark}' in one


def test_all_columns_of_uncertainty_are_kept_up_to_date() -> None:
    at = {"x_px": [150.0], "y_px": [100.0]}
    full = pixmetry.corrected({**at, "u_x_px": [0.1], "u_y_px": [0.2], "cov_xy_px2": [0.005]}, ANALOGUE)
    var = pixmetry.corrected({**at, "var_x_px2": [0.01], "var_y_px2": [0.04], "cov_xy_px2": [0.005], "u_x": [9.0], "u_y": [9.0]}, ANALOGUE)
    assert full.covariance_px2 == pytest.approx(var.covariance_px2) and abs(full.covariance_px2[0, 1]) > 0.004
    assert var.columns["u_x"] == pytest.approx(np.sqrt(var.columns["var_x_px2"]))
    assert full.columns["cov_xy_px2"] == pytest.approx(full.covariance_px2[:, 1])
    glass = {"settings": {"optics.cover_glass.thickness_um": 700}, "u": {"optics.cover_glass.thickness_um": 100}}
    none = pixmetry.corrected({"x_px": [150.0], "y_px": [100.0], "u_x_px": [1e-3], "u_y_px": [1e-3]}, DIGITAL, **glass)
    assert none.columns["cov_xy_px2"] == pytest.approx(none.covariance_px2[:, 1])
    with pytest.raises(InputError, match="'cov_xy_px2' is no covariance"):
        pixmetry.corrected({**at, "var_x_px2": [0.01], "var_y_px2": [0.01], "cov_xy_px2": [0.05]}, ANALOGUE)


def test_an_image_without_targets_gives_an_empty_table() -> None:
    for table in (np.zeros((0, 2)), {"x_px": [], "y_px": []}):
        found = pixmetry.corrected(table, ANALOGUE, u={"grabber.sampling_clock.clock_mhz": 0.01})
        assert len(found) == 0 and found.columns["x_px"] == [] and found.common_u_px == (0.0, 0.0)
    empty = {"x_px": [], "y_px": [], "point": []}
    assert len(pixmetry.corrected(empty, ANALOGUE, reference=four(), per_image="shift")) == 0


def test_a_measured_lens_holds_the_cover_glass() -> None:
    camera = with_source(load_camera(DIGITAL), "optics.distortion").with_parameters("optics.distortion", k1_per_mm2=-5e-4)
    measured = uncertain(camera, "optics.distortion", k1_per_mm2=2e-5)
    at, glass = [[100.0, 100.0], [2300.0, 1900.0]], {"optics.cover_glass.thickness_um": 750.0}
    plain, told, named = (
        pixmetry.corrected(at, measured, settings=s, only=o)
        for s, o in (({}, ()), (glass, ()), (glass, ("optics.distortion", "optics.cover_glass")))
    )
    assert told.x_px == pytest.approx(plain.x_px, abs=1e-9) and np.abs(named.x_px - plain.x_px).max() > 0.01
    assert any("the lens was measured with it" in s.text for s in told.sources if s.name == "optics.cover_glass")
    assert any(s.applied for s in pixmetry.corrected(at, camera, settings=glass).sources if s.name == "optics.cover_glass")


def test_a_limit_is_a_rectangular_distribution() -> None:
    camera = with_source(load_camera(DIGITAL), "sensor.affinity")
    limit = 6e-4
    estimates = Estimates.from_rows([("b1", limit, 0.0, np.inf, "1")], limits=frozenset({"b1"}))
    chain = tuple(replace(e, estimates=estimates, known_from="measured") if e.name == "sensor.affinity" else e for e in camera.chain)
    at = [[100.0, 100.0], [2300.0, 1900.0]]
    found = pixmetry.corrected(at, replace(camera, chain=chain))
    one, small = (pixmetry.corrected(at, camera, settings={"sensor.affinity.b1": v}) for v in (limit / 3**0.5, limit / 12**0.5))
    assert np.abs(one.shift_px[:, 0]).min() > 0.1
    assert found.x_px == pytest.approx(one.x_px, abs=1e-6)
    assert np.sqrt(found.correction_px2[:, 0]) == pytest.approx(np.abs(small.shift_px[:, 0]), rel=0.01)
    assert any("b1 is only known to be at most 0.0006" in note for note in found.notes)


def test_a_height_map_is_without_its_plane_and_tells_what_it_knows(rng: np.random.Generator, tmp_path: Path) -> None:
    camera = load_camera(DIGITAL)
    rows, cols = camera.frame_shape
    np.save(tmp_path / "raised.npy", 500 + np.linspace(0, 20, 400).reshape(20, 20))
    raised = height_map_of(tmp_path / "raised.npy", camera)
    at = [[100.0, 100.0], [2300.0, 1900.0]]
    assert np.abs(pixmetry.corrected(at, camera, settings=raised.settings).shift_px).max() < 1e-4
    assert "510 µm of piston" in raised.notes[0]
    # a bow of 10 µm under noise of 1 µm: five standard uncertainties at most, no order by chance
    y, x = np.meshgrid((np.arange(20) + 0.5) / 20 * rows - 0.5, (np.arange(20) + 0.5) / 20 * cols - 0.5, indexing="ij")
    params = sources()["sensor.unflatness"].make({"bow_x_um": 10.0})
    np.save(tmp_path / "bow.npy", height_um(params, x, y, (rows, cols)) + rng.standard_normal((20, 20)))
    bow = height_map_of(tmp_path / "bow.npy", camera)
    u = bow.u["sensor.unflatness.bow_x_um"]
    assert u == pytest.approx(np.sqrt(5 / 400), rel=0.3)  # 1 µm over the root of n ⟨P₂²⟩ = n/5
    assert abs(bow.settings["sensor.unflatness.bow_x_um"] - 10) < 6 * u
    assert np.shape(bow.settings["sensor.unflatness.more_um"])[0] <= 4  # chance adds an order with 8e-5, and two with 2e-8
    found = pixmetry.corrected(at, camera, settings=bow.settings, u=bow.u)
    assert found.correction_px2.min(axis=0)[0] > 0
    k = np.arange(200)
    part = {"inner": (0.25 + 0.5 * (k * 0.7549 % 1), 0.25 + 0.5 * (k * 0.5698 % 1)), "line": (k / 200, k / 200)}
    corner = 0.25 * part["inner"][0], 0.25 * part["inner"][1]
    for name, (a, b) in (part | {"corner": corner}).items():
        lines = "".join(f"{s * cols:.3f},{t * rows:.3f},{h:.3f}\n" for s, t, h in zip(a, b, rng.standard_normal(200), strict=True))
        (tmp_path / f"{name}.csv").write_text("x_px,y_px,height_um\n" + lines)
    for name in ("line", "corner"):
        with pytest.raises(InputError, match="do not tell the surface"):
            height_map_of(tmp_path / f"{name}.csv", camera)
    inner = height_map_of(tmp_path / "inner.csv", camera)
    assert "does not reach the edges" in inner.notes[-1]
    assert np.abs(pixmetry.corrected(at, camera, settings=inner.settings).shift_px).max() < 0.5
    code, said = run(_table(tmp_path), "--with", DIGITAL, "--height-map", tmp_path / "bow.npy")
    assert code == 0 and "left out is its plane" in said, said


def _table(folder: Path) -> Path:
    (folder / "at.csv").write_text("x,y\n100,100\n")
    return folder / "at.csv"


def test_jitter_of_rows_is_taken_off_by_a_line_and_the_covariance_holds_what_the_line_leaves(rng: np.random.Generator) -> None:
    """Rows are displaced by 0.3 px at random, discs by the mean over their rows; a line of 0.05 px of noise in each row sees it.

    Over frames and discs, errors over stated uncertainties have a standard deviation of 1: of 1200 within 12 % but once in 10⁸ (the frames
    of one run share where the line is, which is known to 0.3 px / √8000). Two discs in the same rows have the covariance that is stated.
    """
    camera = load_camera(DIGITAL).switched(off=[e.name for e in load_camera(DIGITAL).chain])
    frames, discs, radius, noise = 20, 60, 4.0, 0.02
    rows = np.arange(400.0)
    y = np.repeat(rng.uniform(20, 380, discs // 2), 2)  # two discs in the same rows
    x = rng.uniform(100, 1000, discs)
    weight = np.sqrt(np.maximum(radius**2 - (rows[:, None] + (np.arange(99) - 49)[:, None, None] / 99 - y) ** 2, 0)).mean(axis=0)
    weight /= weight.sum(axis=0)
    table: dict[str, list] = {n: [] for n in ("frame", "x_px", "y_px", "u_x_px", "u_y_px", "diameter_px")}
    line: dict[str, list] = {n: [] for n in ("frame", "x_px", "y_px", "u_x_px", "u_y_px")}
    for frame in range(frames):
        jitter = 0.3 * rng.standard_normal(len(rows))
        columns = (frame, x + jitter @ weight + noise * rng.standard_normal(discs), y, noise, noise, 2 * radius)
        for name, values in zip(table, columns, strict=True):
            table[name] += list(np.broadcast_to(values, discs))
        seen = 500 + 0.05 * rows + jitter + 0.05 * rng.standard_normal(len(rows))
        for name, values in zip(line, (frame, seen, rows, 0.05, 0.05), strict=True):
            line[name] += list(np.broadcast_to(values, len(rows)))
    found = pixmetry.corrected(table, camera, reference=line, per_image="rows")
    error = found.x_px - np.tile(x, frames)
    before = np.array(table["x_px"]) - np.tile(x, frames)
    z = error / np.sqrt(found.covariance_px2[:, 0])
    assert before.std() > 0.08 > 0.035 > error.std() and abs(z.std() - 1) < 0.12
    assert np.array_equal(found.y_px, np.array(table["y_px"]))
    stated = found.correction_covariance_px2[0, 2]  # of x of the first two discs
    common = error.reshape(frames, -1, 2)
    assert stated == pytest.approx(np.mean(common[..., 0] * common[..., 1]), rel=0.35) and stated > 1e-4
    assert found.sources[-1].applied and found.correction_covariance_px2[0, 2 * discs] < 1e-4  # another frame: only where the line is


def test_a_grabber_that_jitters_is_corrected_in_the_whole_chain(tmp_path: Path) -> None:
    """Located discs of a frame with 40 ns of jitter in each row; the line is where the camera shows it. Less than a third is left."""
    camera = load_camera(ANALOGUE)
    camera = camera.switched(off=[e.name for e in camera.chain if e.source.gum_class not in ("T",) and e.name != "grabber.line_jitter"])
    camera = camera.with_parameters("grabber.line_jitter", white_ns=40.0, loop_ns=0.0, settling_ns=0.0, shear_ns=0.0)
    x, y = (v.ravel() for v in np.meshgrid(np.arange(60, 440, 40) + 0.3, np.arange(60, 460, 40) + 0.2))
    camera = camera.switched(on=["grabber.line_jitter"])
    picture = camera.expose(Discs(x, y, diameter_px=9, blur_px=0.8, peak_photons=60000), seed=3)
    located = pixmetry.locate(picture.data[0], kind="disc")
    rows = np.arange(camera.frame_shape[0], dtype=float)
    shown = 250.0 + camera.truth(0, seed=3)["grabber.line_jitter"]["row_shift_px"][0]
    seen = camera.switched(off=["grabber.line_jitter"]).true_positions(x, y)
    line = {"x_px": shown, "y_px": rows}
    found = pixmetry.corrected(located, camera, skip=[e.name for e in camera.active], reference=line, per_image="rows")
    of = np.hypot(located.x_px[:, None] - seen[0], located.y_px[:, None] - seen[1]).argmin(axis=1)
    before, after = located.x_px - seen[0][of], found.x_px - seen[0][of]
    assert len(located) >= 60 and after.std() < before.std() / 3 and before.std() > 0.1


def test_a_line_that_cannot_be_used_is_refused() -> None:
    camera, line = load_camera(DIGITAL), {"x_px": [5.0] * 9, "y_px": list(range(9))}
    table = {"x_px": [9.0, 9.0], "y_px": [4.0, 4.0], "diameter_px": [4.0, 4.0]}
    for given, reference, words in (
        ({"x_px": [9.0], "y_px": [4.0]}, line, "size of the targets"),
        (table, {"x_px": [5.0], "y_px": [1.0]}, "too few rows"),
        (table | {"frame": [0, 1]}, line, "in which image"),
    ):
        with pytest.raises(InputError, match=words):
            pixmetry.corrected(given, camera, reference=reference, per_image="rows")
    far = pixmetry.corrected({"x_px": [9.0], "y_px": [300.0], "diameter_px": [4.0]}, camera, reference=line, per_image="rows")
    assert not far.sources[-1].applied and any("not corrected" in note for note in far.notes)
