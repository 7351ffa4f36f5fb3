"""Project files and tables: the network that they mean, whatever unit, origin or delimiter, and one clear error for each mistake."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from pixmetry.calibrate.bundle.network import Network
from pixmetry.calibrate.project import load_project
from pixmetry.calibrate.project.tables import read_table
from pixmetry.core.errors import InputError

COLS, ROWS, PITCH_UM = 640, 480, (5.0, 6.0)
PLACES = {
    ("a", "1"): (100.25, 50.5),
    ("a", "2"): (600.0, 50.0),
    ("b", "1"): (20.0, 470.0),
    ("b", "2"): (319.5, 239.5),
    ("b", "7"): (0.0, 479.0),
}
Form = Callable[[float, float], tuple[float, ...]]
CAMERA = f"cameras: {{cols: {COLS}, rows: {ROWS}, pitch_x_um: {PITCH_UM[0]}, pitch_y_um: {PITCH_UM[1]}, c_mm: 8}}\n"


def write(folder: Path, project: str, **tables: str) -> Path:
    for name, text in tables.items():
        (folder / f"{name}.csv").write_text(text)
    path = folder / "project.yaml"
    path.write_text(f"schema: pixmetry/calibration/1\n{project}")
    return path


def rows(header: str = "image,point,x_px,y_px", form: Form = lambda x, y: (x, y), mark: str = ",") -> str:
    lines = [mark.join([image, point, *(f"{v:.9f}" for v in form(x, y))]) for (image, point), (x, y) in PLACES.items()]
    return "\n".join([header.replace(",", mark), *lines]) + "\n"


def network(folder: Path, project: str, **tables: str) -> Network:
    return load_project(write(folder, CAMERA + project, **tables)).network


def places(found: Network) -> dict[tuple[str, str], tuple[float, float]]:
    names = [(found.images[i], found.points[p]) for i, p in zip(found.image, found.point, strict=True)]
    return dict(zip(names, zip(found.x_px.tolist(), found.y_px.tolist(), strict=True), strict=True))


def same_places(found: Network) -> bool:
    return all(np.allclose(places(found)[key], at, atol=1e-6) for key, at in PLACES.items()) and len(found) == len(PLACES)


def refused(folder: Path, project: str, *words: str, **tables: str) -> InputError:
    with pytest.raises(InputError) as caught:
        load_project(write(folder, project, **tables))
    for word in words:
        assert word in str(caught.value), str(caught.value)
    return caught.value


@pytest.mark.parametrize("mark", [",", ";", "\t", "  ", ", "])
def test_any_delimiter_comments_and_blank_lines(tmp_path: Path, mark: str) -> None:
    text = "# from another program\n\n" + rows(mark=mark).replace("\nb", "\n# the second image\n\nb", 1)
    assert same_places(network(tmp_path, "observations: o.csv\n", o=text))


MM = tuple(p / 1000 for p in PITCH_UM)


@pytest.mark.parametrize(
    ("coordinates", "header", "form"),
    [
        # each form written out by hand from where the origin is
        ("{}", "x_px,y_px", lambda x, y: (x, y)),
        ("{y: up}", "x_px,y_px", lambda x, y: (x, 479 - y)),
        ("{origin: corner}", "x_px,y_px", lambda x, y: (x + 0.5, y + 0.5)),
        ("{origin: corner, y: up}", "x_px,y_px", lambda x, y: (x + 0.5, 479.5 - y)),
        ("{origin: one}", "x_px,y_px", lambda x, y: (x + 1, y + 1)),
        ("{origin: one, y: up}", "x_px,y_px", lambda x, y: (x + 1, 480 - y)),
        ("{origin: centre}", "x_px,y_px", lambda x, y: (x - 319.5, y - 239.5)),
        ("{}", "x_mm,y_mm", lambda x, y: ((x - 319.5) * MM[0], (239.5 - y) * MM[1])),
        ("{unit: mm, origin: centre, y: up}", "x_mm,y_mm", lambda x, y: ((x - 319.5) * MM[0], (239.5 - y) * MM[1])),
        ("{y: down}", "x_mm,y_mm", lambda x, y: ((x - 319.5) * MM[0], (y - 239.5) * MM[1])),
        ("{origin: corner, y: down}", "x_mm,y_mm", lambda x, y: ((x + 0.5) * MM[0], (y + 0.5) * MM[1])),
        ("{}", "x_um,y_um", lambda x, y: ((x - 319.5) * 1000 * MM[0], (239.5 - y) * 1000 * MM[1])),
    ],
)
def test_any_unit_and_origin(tmp_path: Path, coordinates: str, header: str, form: Form) -> None:
    table = rows(f"image,point,{header}", form)
    assert same_places(network(tmp_path, f"observations: o.csv\nimage_coordinates: {coordinates}\n", o=table))


def test_upper_and_lower_case_of_columns_do_not_matter(tmp_path: Path) -> None:
    points = "Point,x,y,z,U_x,u_y,u_Z\n1,1,2,3,0.1,0.2,0.3\n"
    found = network(tmp_path, "observations: o.csv\npoints: p.csv\n", o=rows("Image,POINT,X_px,Y_PX"), p=points)
    assert same_places(found) and found.xyz[0].tolist() == [1, 2, 3] and found.u_xyz[0].tolist() == [0.1, 0.2, 0.3]


def test_columns_by_their_names_or_their_order(tmp_path: Path) -> None:
    theirs = rows("photo,id,col,row")
    assert same_places(
        network(tmp_path, "observations: {table: o.csv, columns: {image: photo, point: id, x_px: col, y_px: row}}\n", o=theirs)
    )
    bare = rows("", lambda x, y: (7.0, x, y)).strip() + "\n"
    assert same_places(network(tmp_path, "observations: {table: o.csv, columns: [image, point, '-', x_px, y_px]}\n", o=bare))


def test_covariances_in_pixels_and_millimetres(tmp_path: Path) -> None:
    px = network(tmp_path, "observations: o.csv\n", o=rows("image,point,x_px,y_px,u_x_px,u_y_px", lambda x, y: (x, y, 0.03, 0.05)))
    assert np.allclose(px.covariance_px2, [9e-4, 0, 25e-4]) and px.covariance_known
    both = network(tmp_path, "observations: o.csv\n", o=rows("image,point,x_px,y_px,u_px", lambda x, y: (x, y, 0.03)))
    assert np.allclose(both.covariance_px2, [9e-4, 0, 9e-4]) and both.covariance_known
    header = "image,point,x_mm,y_mm,var_x_mm2,cov_xy_mm2,var_y_mm2"
    mm = network(tmp_path, "observations: o.csv\n", o=rows(header, lambda x, y: (0.1, 0.2, 1e-8, 5e-9, 4e-8)))
    # y turns round, so the covariance does; 5 µm and 6 µm a pixel
    assert np.allclose(mm.covariance_px2, [1e-8 / 25e-6, -5e-9 / 30e-6, 4e-8 / 36e-6])
    told = network(tmp_path, "observations: {table: o.csv, u_px: 0.04}\n", o=rows())
    assert np.allclose(told.covariance_px2, [16e-4, 0, 16e-4]) and told.covariance_known
    assert not network(tmp_path, "observations: o.csv\n", o=rows()).covariance_known


POINTS = "point X Y Z\n7 1 2 3\n1 0 0 0\n2 10 0 0.5\n9 5 5 5\n"


@pytest.mark.parametrize(
    ("known", "u", "field"),
    [
        ("known: fixed", 0.0, "fixed"),
        ("known: free", np.inf, "free"),
        ("known: nominal", 0.0, None),
        ("u: 0.02", 0.02, "fixed"),
    ],
)
def test_what_is_known_of_points(tmp_path: Path, known: str, u: float, field: str | None) -> None:
    path = write(tmp_path, CAMERA + f"observations: o.csv\npoints: {{table: p.csv, {known}}}\n", o=rows(), p=POINTS)
    project = load_project(path)
    at = dict(zip(project.network.points, project.network.xyz.tolist(), strict=True))
    assert at == {"1": [0, 0, 0], "2": [10, 0, 0.5], "7": [1, 2, 3]}
    assert (project.network.u_xyz == u).all() and project.options.get("field") == field
    assert "9" in project.findings[0].text


def test_weighted_points_are_fixed_free_or_between(tmp_path: Path) -> None:
    points = "point,X,Y,Z,u_X,u_Y,u_Z\n7,0,1,0,,,\n8,0,0,0,5,5,5\n2,1,0,0,0.1,0.1,0.2\n1,0,0,0,0,0,0\n"
    found = network(tmp_path, "observations: o.csv\npoints: p.csv\n", o=rows(), p=points)
    u = dict(zip(found.points, found.u_xyz.tolist(), strict=True))
    assert u == {"1": [0, 0, 0], "2": [0.1, 0.1, 0.2], "7": [np.inf] * 3}


def test_bars_targets_and_terms_of_images(tmp_path: Path) -> None:
    project = (
        "observations: o.csv\npoints: {table: p.csv, known: free}\nscale_bars:\n- {from: 1, to: 2, length: 10.01, u: 0.002}\n"
        "scale_bars_table: b.csv\ntarget: {diameter: 0.5, normal: [0, 0, 2]}\nper_image: x_scale, x_shift\nunit: m\n"
    )
    points = "point,X,Y,Z,diameter\n1,0,0,0,\n2,10,0,0,0.7\n"
    found = network(tmp_path, project, o=rows(), p=points, b="from;to;length;u\n2;7;3.5;0.01\n")
    names = np.array(found.points)
    bars = zip(names[found.bars.start], names[found.bars.end], found.bars.length, found.bars.u, strict=True)
    assert [tuple(bar) for bar in bars] == [("1", "2", 10.01, 0.002), ("2", "7", 3.5, 0.01)]
    assert dict(zip(found.points, found.diameter, strict=True)) == {"1": 0.5, "2": 0.7, "7": 0.5}
    assert (found.normal == [0, 0, 1]).all() and found.per_image == ("x_scale", "x_shift") and found.unit == "m"


def test_several_cameras_and_times(tmp_path: Path) -> None:
    cameras = (
        "cameras:\n- {name: left, cols: 640, rows: 480, c_px: 900, free: 'c, xp, yp'}\n"
        "- {name: right, cols: 800, rows: 480, direction: object_to_image, k1: -0.2}\n"
    )
    images = "image,camera,time_s\nb,left,2.5\na,right,1\nunused,left,0\n"
    found = load_project(write(tmp_path, cameras + "observations: o.csv\nimages: i.csv\n", o=rows(), i=images)).network
    assert found.images == ("a", "b") and found.camera_of.tolist() == [1, 0] and found.time_s is not None
    assert found.time_s.tolist() == [1.0, 2.5]
    left, right = found.cameras
    assert left["c"] == 900 and left.free.sum() == 3 and right["c"] == 0 and right["k1"] == -0.2 and right["xp"] == 399.5
    assert (left.direction, right.direction) == ("image_to_object", "object_to_image")


def test_a_principal_distance_in_pixels_is_along_x(tmp_path: Path) -> None:
    found = load_project(write(tmp_path, CAMERA.replace("c_mm: 8", "c_px: 1600") + "observations: o.csv\n", o=rows())).network
    assert found.cameras[0]["c"] == pytest.approx(8.0)  # 1600 pixels of 5 µm


def test_a_camera_by_name_brings_its_pixels(tmp_path: Path) -> None:
    found = load_project(write(tmp_path, "cameras: {camera: imx264_like}\nobservations: o.csv\n", o=rows())).network
    sensor = found.cameras[0].sensor
    assert (sensor.cols, sensor.rows) == (2448, 2048) and sensor.pitch_x_um == pytest.approx(3.45)


def test_a_table_of_located_targets_is_one_of_observations(tmp_path: Path) -> None:
    """What `pixmetry locate` writes, with a column for the names of points."""
    header = "image,target,x_px,y_px,var_x_px2,cov_xy_px2,var_y_px2,radius_px,u_radius_px,code,flags"
    text = f"# pixmetry located\n{header}\na,0,1.5,2.5,0.01,0.001,0.02,3,0.1,17,border|faint\n"
    found = network(tmp_path, "observations: {table: o.csv, columns: {point: code}}\n", o=text)
    assert found.points == ("17",) and np.allclose(found.covariance_px2, [0.01, 0.001, 0.02])


GOOD = CAMERA + "observations: o.csv\n"


@pytest.mark.parametrize(
    ("project", "words"),
    [
        ("", ("project.yaml", "'cameras' is missing")),
        (CAMERA.replace("cols: 640, ", ""), ("cols and rows",)),
        (CAMERA, ("observations", "pictures", "to do")),
        (GOOD + "observation: x.csv\n", ("line 4", "unknown key 'observation'", "did you mean `observations`?")),
        (GOOD.replace("c_mm: 8", "c: 8"), ("line 2", "'cameras.1.c'", "c_mm")),
        (GOOD.replace("c_mm: 8", "c_mm: '8 mm'"), ("line 2", "not a number", "8 mm")),
        (GOOD.replace("c_mm: 8", "c_mm: .nan"), ("line 2", "c_mm")),
        (GOOD.replace("c_mm: 8", "free: [c, f]"), ("line 2", "free")),
        (GOOD.replace("c_mm: 8", "free: [xp, yp]"), ("c is held fixed", "c_mm or c_px")),
        ("cameras: {cols: 640, rows: 480, c_mm: 8}\nobservations: o.csv\n", ("c_mm, but no pitch", "pitch_um")),
        ("cameras: {cols: 640}\nobservations: o.csv\n", ("line 2", "cols and rows")),
        ("cameras: {c_px: 800}\nobservations: o.csv\n", ("size of the frame is missing", "cols and rows")),
        ("cameras: {camera: no_such}\nobservations: o.csv\n", ("line 2", "no_such")),
        (CAMERA + "observations: missing.csv\n", ("line 3", "'missing.csv' is missing", "to do")),
        (GOOD + "points: {table: o.csv}\n", ("o.csv", "'X' is missing", "X, Y, Z")),
        (GOOD + "unit: furlong\n", ("line 4", "unit", "inch")),
        (GOOD + "scale_bars:\n- {from: 1, to: 2, length: 10 mm, u: 0.1}\n", ("line 5", "length")),
        (GOOD + "scale_bars:\n- {from: 1, to: 2, length: 10}\n", ("line 5", "u' is missing")),
        (GOOD + "scale_bars:\n- {from: 1, to: 2, length: 10, u: 1}\n- {from: 1, to: 99, length: 1, u: 1}\n", ("line 6", "'99'", "1, 2, 7")),
        (GOOD + "scale_bars:\n- {from: 1, to: 1, length: 10, u: 1}\n", ("line 5", "itself")),
        (GOOD + "options: {losses: huber}\n", ("line 4", "losses", "loss")),
        (GOOD + "pictures: {files: a.png}\n", ("two sources",)),
        (GOOD + "per_image: [y_scale]\n", ("line 4", "per_image", "x_scale")),
        (GOOD + "image_coordinates: {unit: mm}\n", ("in px, the project says mm", "o.csv")),
        (GOOD + "target: {normal: [0, 0, 0]}\n", ("normal without direction",)),
        (GOOD.replace("cameras: {", "cameras: {name: x, ") + "images: o.csv\n", ("listed twice", "o.csv, lines 2 and 3")),
    ],
)
def test_a_mistake_in_the_project_is_told(tmp_path: Path, project: str, words: tuple[str, ...]) -> None:
    refused(tmp_path, project, *words, o=rows())


@pytest.mark.parametrize(
    ("table", "words"),
    [
        ("", ("empty",)),
        ("# nothing\n\n", ("empty",)),
        ("image,point,x_px,y_px\n", ("no row",)),
        (rows().partition("\n")[2], ("line 1", "no header", "columns:")),
        (rows("image,point,x_px,y"), ("'y_px' is missing", "image, point, x_px, y", "write `y_px` for `y`")),
        (rows("image,name,x_px,y_px"), ("'point' is missing",)),
        (rows("image,point,x,y"), ("no image coordinates", "x_mm and y_mm", "image, point, x, y")),
        (rows("image,point,x_px,x_px"), ("line 1", "two columns")),
        (rows() + "c,1,12.5\n", ("line 7", "a row of 3 values")),
        (rows() + "c,1,12.5,x\n", ("line 7", "'y_px' is not a number", "'x'")),
        (rows() + "c,1,12.5,\n", ("line 7", "'y_px' is empty")),
        (rows() + "c,1,nan,3\n", ("line 7", "x_px", "finite")),
        (rows() + "c,,1,3\n", ("line 7", "'point' is empty")),
        (rows(mark=";") + "c;1;12,5;3\n", ("line 7", "12.5", "point")),
        (rows() + "a,1,12.5,3\n", ("lines 2 and 7", "'1' is measured twice in image 'a'")),
        (rows() + "c,1,640.0,3000\nc,2,640.0,3000\n", ("line 7", "outside of the frame of 640 x 480", "one of 2", "pitch", "origin")),
        (rows("image,point,x_px,y_mm"), ("several units",)),
        (rows("image,point,x_px,y_px,u_x_px,u_y_px", lambda x, y: (x, y, 0.1, 0.0)), ("line 2", "u_y_px", "above 0")),
        (rows("image,point,x_px,y_px,u_x", lambda x, y: (x, y, 0.1)), ("u_x", "unknown kind", "u_x_px")),
        (rows("image,point,x_px,y_px,std_px", lambda x, y: (x, y, 0.1)), ("std_px", "unknown kind", "u_px")),
        (rows("image,point,x_px,y_px,var_x_px2,cov_xy_px2,var_y_px2", lambda x, y: (x, y, 1, 1, 1)), ("line 2", "determinant")),
    ],
)
def test_a_mistake_in_a_table_is_told(tmp_path: Path, table: str, words: tuple[str, ...]) -> None:
    refused(tmp_path, GOOD, "o.csv", *words, o=table)


@pytest.mark.parametrize(
    ("points", "more", "words"),
    [
        ("point,X,Y,Z\n1,0,0,0\n1,1,1,1\n", "", ("lines 2 and 3", "'1' is listed twice")),
        ("point,X,Y,Z\n1,0,inf,0\n", "", ("line 2", "finite")),
        ("point,X,Y,Z\nP1,0,0,0\n", "", ("no point of the table is measured", "1, 2, 7")),
        ("point,X,Y,Z,u_X,u_Y,u_Z\n1,0,0,0,-1,0,0\n", "", ("line 2", "u_X", "at least 0")),
        ("point,X,Y,Z,u_X\n1,0,0,0,1\n", "", ("'u_Y' is missing",)),
        ("point,X,Y,Z\n1,0,0,0\n", "", ("accuracy of the points", "known: fixed", "nominal", "free", "to do: add")),
        ("point,X,Y,Z,u_X,u_Y,u_Z\n2,1,1,1,1,1,1\n1,0,,0,,0.1,\n", "", ("line 3", "u_Y of a coordinate that is empty", "leave u_Y empty")),
        ("point,X,Y,Z\n1,0,0,0\n", "known: weighted", ("no uncertainty", "u_X, u_Y, u_Z")),
        ("point,X,Y,Z\n1,0,0,0\n", "known: fixed, u: 0.1", ("known: weighted",)),
        ("point,X,Y,Z,normal_x,normal_y,normal_z\n1,0,0,0,0,0,0\n", "known: fixed", ("line 2", "direction")),
        ("point,X,Y,Z,diameter\n1,0,0,0,-4\n", "known: fixed", ("line 2", "diameter")),
        ("point,X,Y,Z\n1,0,0,0\n2,0.01,0,0\n", "known: nominal", ("project.yaml, line 5", "0.01 apart", "unit of the points")),
    ],
)
def test_a_mistake_about_points_is_told(tmp_path: Path, points: str, more: str, words: tuple[str, ...]) -> None:
    bars = "scale_bars: [{from: 1, to: 2, length: 10, u: 0.1}]\n"
    refused(tmp_path, GOOD + f"points: {{table: p.csv, {more}}}\n{bars}", *words, o=rows(), p=points)


@pytest.mark.parametrize(
    ("check", "more", "words"),
    [
        ("point,X,Y,Z\n7,0,0,0\n2,1,1,1\n", "", ("check.csv, line 3", "point '2' is known and a check point")),
        ("point,X,Y,Z\n8,0,0,0\n", "", ("no point of the table is measured", "check.csv")),
        ("point,X,Y,Z,u_X,u_Y,u_Z\n7,0,0,,0,0,0\n", "", ("check.csv, line 2", "u_Z of a coordinate that is empty")),
        ("point,X,Y\n7,0,0\n", "", ("'Z' is missing",)),
        ("point,X,Y,Z\n7,0,0,0\n", ", known: fixed", ("unknown key 'check_points.known'",)),
        ("point,X,Y,Z\n7,0,0,0\n", ", u: -0.1", ("'check_points.u'", "-0.1")),
    ],
)
def test_a_mistake_about_check_points_is_told(tmp_path: Path, check: str, more: str, words: tuple[str, ...]) -> None:
    points = "point,X,Y,Z\n1,0,0,0\n2,,5,\n"
    tail = f"points: {{table: p.csv, known: fixed}}\ncheck_points: {{table: check.csv{more}}}\n"
    refused(tmp_path, GOOD + tail, *words, o=rows(), p=points, check=check)


@pytest.mark.parametrize("u", [0, 0.3])
def test_check_points_without_columns_of_u(tmp_path: Path, u: float) -> None:
    text = f"{GOOD}check_points: {{table: check.csv, u: {u}}}\n"
    checks = load_project(write(tmp_path, text, o=rows(), check="point,X,Y,Z\n7,1,2,3\n")).check_points
    assert checks is not None
    np.testing.assert_array_equal(checks.u_xyz, [[u] * 3])


def test_check_points_are_not_known(tmp_path: Path) -> None:
    check = "point;X;Y;Z;u_X;u_Y;u_Z;diameter\n7;1;2;3;0.1;;;5\n2;;;4;;;0.2;\n"
    path = write(
        tmp_path,
        GOOD + "points: p.csv\ncheck_points: {table: check.csv, u: 0.5}\n",
        o=rows(),
        p="point,X,Y,Z,u_X,u_Y,u_Z\n1,,,9,,,0\n2,,,,,,\n",
        check=check,
    )
    read = load_project(path)
    found, checks = read.network, read.check_points
    assert checks is not None and checks.names == ("7", "2") and {p.name for p in read.inputs} >= {"check.csv"}
    np.testing.assert_array_equal(checks.xyz, [[1, 2, 3], [np.nan, np.nan, 4]])
    np.testing.assert_array_equal(checks.u_xyz, [[0.1, 0.5, 0.5], [0, 0, 0.2]])
    at = [found.points.index(name) for name in "127"]
    np.testing.assert_array_equal(found.xyz[at], [[np.nan, np.nan, 9], [np.nan] * 3, [np.nan] * 3])
    np.testing.assert_array_equal(found.u_xyz[at], [[np.inf, np.inf, 0], [np.inf] * 3, [np.inf] * 3])
    np.testing.assert_array_equal(found.diameter[at], [np.nan, np.nan, 5])


@pytest.mark.parametrize(
    ("images", "words"),
    [
        ("image,camera\na,left\n", ("'b' is not in the table of images", "o.csv, line 4")),
        ("image,camera\na,left\nb,middle\n", ("i.csv, line 3", "'middle'", "left, right")),
        ("image\na\nb\n", ("'camera' is missing",)),
        ("image,camera,time_s\na,left,1\nb,left,\n", ("line 3", "time_s")),
    ],
)
def test_a_mistake_about_images_is_told(tmp_path: Path, images: str, words: tuple[str, ...]) -> None:
    cameras = "cameras:\n- {name: left, cols: 640, rows: 480}\n- {name: right, cols: 640, rows: 480}\n"
    refused(tmp_path, cameras + "observations: o.csv\nimages: i.csv\n", *words, o=rows(), i=images)
    refused(tmp_path, cameras + "observations: o.csv\n", "that assigns images to them", o=rows())


MATRIX = ",".join(f"r{i}{j}" for i in "123" for j in "123")


def of_angles(omega: float, phi: float, kappa: float) -> np.ndarray:
    """Kraus's matrix from the camera (y up, looking along -z) to the object, written out element by element."""
    (so, sp, sk), (co, cp, ck) = np.sin([omega, phi, kappa]), np.cos([omega, phi, kappa])
    return np.array([
        [cp * ck, -cp * sk, sp],
        [co * sk + so * sp * ck, co * ck - so * sp * sk, -so * cp],
        [so * sk - co * sp * ck, so * ck + co * sp * sk, co * cp],
    ])  # fmt: skip


def test_start_poses_by_angles_or_matrices(tmp_path: Path) -> None:
    angles = np.array([0.3, -0.7, 2.1])
    expected = (of_angles(*angles) @ np.diag([1.0, -1.0, -1.0])).T  # to a camera that looks along +z with y down
    for unit, factor in (("deg", np.degrees(1)), ("gon", 200 / np.pi), ("rad", 1.0)):
        row = ",".join(f"{v:.12f}" for v in angles * factor)
        images = f"image,OMEGA_{unit},phi_{unit},kappa_{unit},X0,Y0,Z0,time_s\nb,{row},1,-2,30.5,0\na,,,,,,,1\n"
        poses = network(tmp_path, "observations: o.csv\nimages: i.csv\n", o=rows(), i=images).poses
        assert poses is not None and poses.given.tolist() == [False, True]
        np.testing.assert_allclose(poses.rotation[1], expected, atol=1e-10)
        assert poses.position[1].tolist() == [1, -2, 30.5]
    row = ",".join(f"{v:.5f}" for v in expected.ravel())  # rounded, and still a rotation
    images = f"image,X0,Y0,Z0,{MATRIX}\na,1,2,3,{row}\nb,1,2,3,{row}\n"
    found = network(tmp_path, "observations: o.csv\nimages: i.csv\n", o=rows(), i=images).poses
    assert found is not None
    np.testing.assert_allclose(found.rotation[0], expected, atol=2e-5)
    np.testing.assert_allclose(found.rotation[0] @ found.rotation[0].T, np.eye(3), atol=1e-14)
    assert network(tmp_path, "observations: o.csv\nimages: i.csv\n", o=rows(), i="image\na\nb\n").poses is None
    x, y, z, w = -2 * Rotation.from_matrix(expected).as_quat()  # of any length and sign
    t = -expected @ [1, 2, 3]
    images = f"image,qw,qx,qy,qz,tx,ty,tz\na,{w},{x},{y},{z},{t[0]},{t[1]},{t[2]}\nb,,,,,,,\n"
    found = network(tmp_path, "observations: o.csv\nimages: i.csv\n", o=rows(), i=images).poses
    assert found is not None and found.given.tolist() == [True, False]
    np.testing.assert_allclose(found.rotation[0], expected, atol=1e-12)
    np.testing.assert_allclose(found.position[0], [1, 2, 3], atol=1e-12)


@pytest.mark.parametrize(
    ("images", "words"),
    [
        ("image,X0,Y0,Z0\na,1,2,3\nb,1,2,3\n", ("'omega_deg' is missing",)),
        ("image,X0,Y0,Z0,omega_deg,phi_deg\na,1,2,3,4,5\nb,1,2,3,4,5\n", ("'kappa_deg' is missing",)),
        ("image,omega_deg,phi_deg,kappa_deg\na,1,2,3\nb,1,2,3\n", ("'X0' is missing",)),
        ("image,X0,Y0,Z0,omega_deg,phi_deg,kappa_rad\na,1,2,3,4,5,6\nb,1,2,3,4,5,6\n", ("given twice", "kappa_rad")),
        ("image,X0,Y0,Z0,omega_deg,phi_deg,kappa_deg\na,1,2,3,4,5,6\nb,1,,3,4,5,6\n", ("line 3", "an incomplete pose")),
        (f"image,X0,Y0,Z0,{MATRIX}\na,1,2,3,1,0,0,0,1,0,0,0,1\nb,1,2,3,1,0,0,0,1,0,0,0,-1\n", ("line 3", "mirror", "looks along +z")),
        ("image,X0,Y0,Z0,tx,ty,tz,qw,qx,qy,qz\na,1,2,3,1,2,3,1,0,0,0\nb,1,2,3,1,2,3,1,0,0,0\n", ("given twice", "tx")),
        ("image,X0,Y0,Z0,qw,qx,qy,qz\na,,,,,,,\nb,1,2,3,0,0,0,0\n", ("line 3", "length 0")),
        (f"image,X0,Y0,Z0,{MATRIX}\na,1,2,3,1,0,0,0,1,0,0,.1,1\nb,1,2,3,1,0,0,0,1,0,0,0,1\n", ("line 2", "no rotation")),
    ],
)
def test_a_mistake_about_start_poses_is_told(tmp_path: Path, images: str, words: tuple[str, ...]) -> None:
    refused(tmp_path, GOOD + "images: i.csv\n", *words, o=rows(), i=images)


def test_decimal_commas_are_named_where_they_part_columns(tmp_path: Path) -> None:
    project = CAMERA + "observations: {table: o.csv, columns: [image, point, x_px, y_px]}\n"
    refused(tmp_path, project, "line 1", "3 values", "write decimal points, not commas", o="a 1 12,5 30,25\na 2 13,5 31,5\n")


def test_a_project_without_a_schema_says_so(tmp_path: Path) -> None:
    path = write(tmp_path, CAMERA.replace("c_mm: 8", "").replace(f"cols: {COLS}, rows: {ROWS}, ", ""))
    path.write_text(path.read_text().partition("\n")[2])
    with pytest.raises(InputError, match="'schema' is missing.*schema: pixmetry/calibration/1"):
        load_project(path)


def test_a_few_places_outside_of_the_frame_are_left_to_the_adjustment(tmp_path: Path) -> None:
    """One of six passes, two of seven do not; each camera is judged by itself."""
    found = network(tmp_path, "observations: o.csv\n", o=rows() + "c,1,640.0,3000\n")
    assert len(found) == len(PLACES) + 1 and found.y_px.max() == 3000
    cameras = "cameras:\n- {name: L, cols: 640, rows: 480}\n- {name: R, cols: 640, rows: 480}\nobservations: o.csv\nimages: i.csv\n"
    images = "image,camera\na,L\nb,L\nc,R\n"
    refused(tmp_path, cameras, "line 7", "outside", o=rows() + "c,1,640.0,3000\n", i=images)


@pytest.mark.parametrize("key", ["K1", "K2", "K3", "K4", "K5", "P1", "P2"])
def test_capitals_of_the_lens_are_led_to_our_names(tmp_path: Path, key: str) -> None:
    camera = CAMERA.replace("c_mm: 8", f"c_mm: 8, {key}: 0.01")
    path = write(tmp_path, camera + "observations: o.csv\n", o=rows())
    with pytest.raises(InputError, match=f"unknown key '{key}'.*write `{key.lower()}`.*Values of another program") as caught:
        load_project(path)
    assert "delete" not in str(caught.value)


@pytest.mark.parametrize("direction", ["image_to_object", "object_to_image"])
@pytest.mark.parametrize(
    ("coordinates", "header", "upwards"),
    [
        ("{y: up}", "x_px,y_px", True),
        ("{}", "x_px,y_px", False),
        ("{}", "x_mm,y_mm", True),
        ("{y: down}", "x_mm,y_mm", False),
        ("{y: up, origin: corner}", "x_um,y_um", True),
    ],
)
def test_decentring_and_shear_go_with_y_of_the_image_coordinates(
    tmp_path: Path, coordinates: str, header: str, upwards: bool, direction: str
) -> None:
    """The model, written out with y as the program of the table has it, sees the same directions."""
    given = {"b1": 2e-3, "b2": -3e-3, "p1": 4e-3, "p2": -7e-3, "k1": 6e-2}
    keys = ", ".join(f"{name}: {value}" for name, value in given.items())
    camera = CAMERA.replace("c_mm: 8", f"c_mm: 8, xp_px: 310, yp_px: 250, direction: {direction}, {keys}")
    middle = rows(f"image,point,{header}", lambda x, y: (0.01, 0.02))
    project = f"observations: o.csv\nimage_coordinates: {coordinates}\n"
    model = load_project(write(tmp_path, camera + project, o=middle)).network.cameras[0]
    assert model["xp"] == 310 and model["yp"] == 250  # places in pixels are always from the top-left one
    sign = -1.0 if upwards else 1.0
    b1, b2, p1, p2, k1 = given.values()

    def bent(a: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        r2 = a**2 + b**2
        return a * (1 + k1 * r2) + p1 * (r2 + 2 * a**2) + 2 * p2 * a * b, b * (1 + k1 * r2) + p2 * (r2 + 2 * b**2) + 2 * p1 * a * b

    if direction == "image_to_object":
        x, y = np.array([100.0, 500.0, 320.0]), np.array([90.0, 300.0, 470.0])
        a, b = (x - 310) * MM[0], sign * (y - 250) * MM[1]
        found = bent(a, b)
        theirs = (found[0] + b1 * a + b2 * b) / 8, sign * found[1] / 8
        assert np.allclose(model.direction_of(x, y), theirs, atol=1e-12)
    else:
        u, v = np.array([-0.1, 0.15, 0.05]), np.array([0.12, -0.03, 0.1])
        a, b = bent(u, sign * v)
        theirs = 310 + 8 * ((1 + b1) * a + b2 * b) / MM[0], 250 + sign * 8 * b / MM[1]
        assert np.allclose(model.project(u, v), theirs, atol=1e-9)


def test_a_row_whose_name_begins_with_a_hash_is_not_lost(tmp_path: Path) -> None:
    path = tmp_path / "t.csv"
    rows = ["image,point,x_px,y_px", "#im0,p1,1,2", "im1,p1,3,4"]
    path.write_text("\n".join(rows), encoding="utf-8")
    with pytest.raises(InputError, match=r"t.csv, line 2: a row whose name begins with #, or a comment; .*in quotes if it is a row"):
        read_table(path)
    path.write_text("\n".join(["# made by hand", rows[0], '"#im0",p1,1,2', "# im9,p9,7,8", "#left out", "##", rows[2]]), encoding="utf-8")
    assert read_table(path).columns["image"] == ["#im0", "im1"]
    path.write_text("image point x_px y_px\nim1 p1 3 4\n#im0 p1 1 2\n", encoding="utf-8")
    with pytest.raises(InputError, match="line 3"):
        read_table(path)


def test_a_quote_that_is_not_closed_swallows_no_row(tmp_path: Path) -> None:
    path = tmp_path / "t.csv"
    path.write_text('image,point,x_px,y_px\nim0,"p1,1,2\nim1",p2,3,4\nim2,p3,5,6\n', encoding="utf-8")
    with pytest.raises(InputError, match="line 2: a quote that is not closed"):
        read_table(path)
    path.write_text('image,point,x_px,y_px\nim0,p1,1,2\n5" wide,"p2,3,4\nim2,p3,5,6\n', encoding="utf-8")  # the first one is part of a name
    with pytest.raises(InputError, match="line 3: a quote that is not closed"):
        read_table(path)
