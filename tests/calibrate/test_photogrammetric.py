"""Cameras of HALCON, Australis and PhotoModeler: what these programs wrote is read, and what is written they would see as we do."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from pixmetry.calibrate.bundle.model import NAMES, CameraModel, Sensor
from pixmetry.calibrate.exchange import Known, carried_covariance, converted, opencv_covariance, opencv_form, read_opencv
from pixmetry.calibrate.files.exports import write_exports
from pixmetry.calibrate.files.imports import read_cameras
from pixmetry.calibrate.project import load_project
from pixmetry.core.errors import InputError

SENSOR = Sensor(1280, 960, 4.65, 4.65)
LENS = dict(c=8.2, xp=651.3, yp=466.1, k1=-2.1e-3, k2=3e-5, k3=-2e-7, p1=2e-5, p2=-3e-5)
DIVISION = """# INTERNAL CAMERA PARAMETERS
ParGroup: Camera: Parameter;
  "Internal camera parameters";
Focus:foc: 0.00806039;
  DOUBLE:0.0:;
  "Focal length of the lens [meter]";
Kappa:kappa: -2253.5;
  DOUBLE::;
  "Radial distortion coefficient [1/(meter*meter)]";
Sx:sx: 1.0629e-05;
  DOUBLE:0.0:;
  "Width of a cell on the sensor [meter]";
Sy:sy: 1.1e-05;
  DOUBLE:0.0:;
  "Height of a cell on the sensor [meter]";
Cx:cx: 378.236;
  DOUBLE:0.0:;
  "X-coordinate of the image center [pixel]";
Cy:cy: 297.587;
  DOUBLE:0.0:;
  "Y-coordinate of the image center [pixel]";
ImageWidth:imgw: 768;
  INT:1:32767;
  "Width of the images [pixel]";
ImageHeight:imgh: 576;
  INT:1:32767;
  "Height of the images [pixel]";
"""  # the example of HALCON's reference, read_cam_par
AUSTRALIS = """Australis Bundle Adjustment Results: Camera Parameters
                                        02 August, 2006   14:11:14
Adjustment: Free-Network
Number of Points: 145
Results for Camera 1    WASP-LT Camera 3    Lens
Sensor Size        Pixel Size (mm)
  H    648           0.007
  V    494           0.007
  Camera    Initial      Total          Final        Initial         Final
 Variable    Value     Adjustment       Value       Std. Error     Std. Error
    C      8.0000      0.30937        8.3094       1.0e+003      6.782e-003 (mm)
   XP      0.0000     -0.02804       -0.0280       1.0e+003      6.879e-003 (mm)
   YP      0.0000      0.02142        0.0214       1.0e+003      7.204e-003 (mm)
   K1 0.00000e+000    1.674e-003   1.67381e-003    1.0e+003      1.238e-004
   K2 0.00000e+000   -7.808e-006  -7.80809e-006    1.0e+003      3.066e-005
   K3 0.00000e+000   -1.229e-006  -1.22907e-006    1.0e+003      2.327e-006
   P1 0.00000e+000    1.752e-005   1.75249e-005    1.0e+003      3.496e-005
   P2 0.00000e+000   -8.641e-006  -8.64105e-006    1.0e+003      3.400e-005
   B1 0.00000e+000   -4.343e-004  -4.34298e-004    1.0e+003      1.100e-004
   B2 0.00000e+000    1.797e-005   1.79692e-005    1.0e+003      1.101e-004
Maximum Observational Radial Distance Encountered: 2.9 mm
"""  # numbers of a published report of 2006
PHOTOMODELER = """
Status Report Tree
   Project Name: inf focus.pmr
      Precisions / Standard Deviations
         Camera Calibration Standard Deviations
            Camera1: Olympus C4040Z 2272x1704 inf focus
               Focal Length
                    Value: 7.465291 mm
                    Deviation: Focal: 0.001 mm
               Xp - principal point x
                    Value: 3.617274 mm
                    Deviation: Xp: 8.7e-004 mm
               Yp - principal point y
                    Value: 2.612828 mm
                    Deviation: Yp: 0.001 mm
               Fw - format width
                    Value: 7.253189 mm
                    Deviation: Fw: 1.6e-004 mm
               Fh - format height
                    Value: 5.437636 mm
               K1 - radial distortion 1
                    Value: 4.980e-003
                    Deviation: K1: 1.2e-005
               K2 - radial distortion 2
                    Value: -9.799e-005
                    Deviation: K2: 5.7e-007
               K3 - radial distortion 3
                    Value: 0.000e+000
               P1 - decentering distortion 1
                    Value: -6.116e-005
                    Deviation: P1: 3.7e-006
               P2 - decentering distortion 2
                    Value: -4.366e-005
                    Deviation: P2: 4.2e-006
         Photograph Standard Deviations
            Photo 1: P8250021.JPG
               Omega
                    Value: -39.419768 deg
"""  # camera section of a published report of PhotoModeler 2012


def written(path: Path, text: str) -> Path:
    path.write_text(text, encoding="utf-8")
    return path


def pixels(sensor: Sensor) -> tuple[np.ndarray, np.ndarray]:
    return tuple(v.ravel() for v in np.meshgrid(np.linspace(0, sensor.cols - 1, 9), np.linspace(0, sensor.rows - 1, 7)))


def halcon_looks(text: str, cols: np.ndarray, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """X/Z and Y/Z by HALCON's own formulas, from the numbers of a file, in metres."""
    value = {m[1]: float(m[2]) for m in re.finditer(r"^(\w+):\w+: *([-+.\de]+);", text, re.MULTILINE)}
    u, v = (cols - value["Cx"]) * value["Sx"], (rows - value["Cy"]) * value["Sy"]
    r2 = u**2 + v**2
    if "Kappa" in value:
        u, v = u / (1 + value["Kappa"] * r2), v / (1 + value["Kappa"] * r2)
    else:
        k1, k2, k3, p1, p2 = (value[f"Poly{n}"] for n in range(1, 6))
        radial = k1 * r2 + k2 * r2**2 + k3 * r2**3
        u, v = (
            u + u * radial + p1 * (r2 + 2 * u**2) + 2 * p2 * u * v,
            v + v * radial + 2 * p1 * u * v + p2 * (r2 + 2 * v**2),
        )
    return u / value["Focus"], v / value["Focus"]


def test_halcons_own_example_is_read(tmp_path: Path) -> None:
    (model,) = read_cameras(written(tmp_path / "cam.dat", DIVISION)).values()
    assert model.sensor.cols == 768 and model.sensor.pitch_x_um == pytest.approx(10.629)
    x, y = pixels(model.sensor)
    np.testing.assert_allclose(model.direction_of(x, y), halcon_looks(DIVISION, x, y), rtol=1e-12, atol=1e-15)
    write_exports([model], {"halcon": tmp_path / "again.cal"})
    np.testing.assert_allclose(halcon_looks((tmp_path / "again.cal").read_text(), x, y), model.direction_of(x, y), rtol=1e-12, atol=1e-15)


@pytest.mark.parametrize(
    ("direction", "more", "most_px"),
    [("image_to_object", {}, 1e-9), ("image_to_object", {"b1": 2e-4}, 0.02), ("object_to_image", {"b1": 2e-3}, 0.02)],
)
def test_halcon_looks_where_we_look(direction: str, more: dict, most_px: float, tmp_path: Path) -> None:
    """Within what the sentence says is lost: nothing of corrections without affinity; a width of the pixels stands for b1."""
    lens = LENS | more
    if direction == "object_to_image":
        lens = {"c": 8.2, "xp": 651.3, "yp": 466.1, "k1": -0.08, "k2": 0.02, "p1": 2e-4, "p2": -1e-4} | more
    model = CameraModel.of(SENSOR, direction, **lens)
    (sentence,) = write_exports([model], {"halcon": tmp_path / "cam.dat"}, 0.05).sentences
    told = 0.0 if "nothing is lost" in sentence else float(sentence.partition("up to ")[2].partition(" px")[0])
    assert (told == 0) == (most_px < 1e-6)
    x, y = pixels(SENSOR)
    again = np.hypot(*(np.array(model.project(*halcon_looks((tmp_path / "cam.dat").read_text(), x, y))) - [x, y])).max()
    assert again <= max(1.1 * told, 1e-9) < most_px + 1e-9


def test_an_australis_report_is_read(tmp_path: Path) -> None:
    """By the formulas in its calibration files: x = x(meas) − xp, and so on; y upwards, from the middle of the frame."""
    ((name, model),) = read_cameras(written(tmp_path / "camera3.txt", AUSTRALIS)).items()
    assert name == "WASP-LT Camera 3" and model.sensor == Sensor(648, 494, 7.0, 7.0)
    px, py = pixels(model.sensor)
    x, y = (px - 323.5) * 0.007 + 0.0280, (246.5 - py) * 0.007 - 0.0214
    k, p1, p2, b1, b2 = (1.67381e-3, -7.80809e-6, -1.22907e-6), 1.75249e-5, -8.64105e-6, -4.34298e-4, 1.79692e-5
    r2 = x**2 + y**2
    dr = k[0] * r2 + k[1] * r2**2 + k[2] * r2**3
    corrected = (
        x + x * dr + p1 * (r2 + 2 * x**2) + 2 * p2 * x * y + b1 * x + b2 * y,
        y + y * dr + p2 * (r2 + 2 * y**2) + 2 * p1 * x * y,
    )
    u, v = model.direction_of(px, py)
    np.testing.assert_allclose((u, -v), np.array(corrected) / 8.3094, rtol=1e-10, atol=1e-13)


def test_a_photomodeler_report_is_read(tmp_path: Path) -> None:
    """By the formulas of its help page: from the outer corner of the frame, corrections with y upwards."""
    ((_, model),) = read_cameras(written(tmp_path / "report.txt", PHOTOMODELER)).items()
    assert (model.sensor.cols, model.sensor.rows) == (2272, 1704)
    px, py = pixels(model.sensor)
    x, y = (px + 0.5) * 7.253189 / 2272 - 3.617274, 2.612828 - (py + 0.5) * 5.437636 / 1704
    r2 = x**2 + y**2
    dr, p1, p2 = 4.98e-3 * r2 - 9.799e-5 * r2**2, -6.116e-5, -4.366e-5
    u, v = model.direction_of(px, py)
    np.testing.assert_allclose(u, (x + x * dr + p1 * (r2 + 2 * x**2) + 2 * p2 * x * y) / 7.465291, rtol=1e-10, atol=1e-13)
    np.testing.assert_allclose(-v, (y + y * dr + p2 * (r2 + 2 * y**2) + 2 * p1 * x * y) / 7.465291, rtol=1e-10, atol=1e-13)


def test_reports_are_written_as_they_are_read(tmp_path: Path) -> None:
    """Two cameras in a file, standard errors in their columns; the same numbers come back, and a later export replaces the file."""
    left = CameraModel.of(SENSOR, name="left", **LENS, b1=1e-4, b2=-2e-4)
    right = CameraModel.of(SENSOR, name="right", **LENS)
    u = {"c": 2e-3, "xp": 0.4, "yp": 0.3, "k1": 1e-5, "b1": 3e-6}
    known = {one.name: Known(tuple(u), np.diag([value**2 for value in u.values()])) for one in (left, right)}
    paths = {"australis": tmp_path / "a.txt", "photomodeler": tmp_path / "p.txt"}
    for _ in range(2):
        made = write_exports([left, right], paths, known=known)
    assert [str(path) for path, _ in made.refused] == [str(paths["photomodeler"])]  # which has no b2
    back = read_cameras(paths["australis"])
    for one in (left, right):
        np.testing.assert_allclose(back[one.name].values, one.values, rtol=1e-10, atol=1e-16)
    rows = re.findall(r"^ +(C|XP|K1|K2|B1) .* ([-+.\de]+)(?: \(mm\))?$", paths["australis"].read_text(), re.MULTILINE)[:5]
    assert {name: float(value) for name, value in rows} == pytest.approx(
        {"C": 2e-3, "XP": 0.4 * 4.65e-3, "K1": 1e-5, "K2": 0.0, "B1": 3e-6}, rel=1e-5
    )
    for _ in range(2):
        made = write_exports([right], {"photomodeler": paths["photomodeler"]}, known=known)
    assert not made.refused
    (again,) = read_cameras(paths["photomodeler"]).values()
    np.testing.assert_allclose(again.values, right.values, rtol=1e-10, atol=1e-16)
    text = paths["photomodeler"].read_text()
    value = r".*\s*Value: ([0-9\-\+\.e]+)"  # as other programs look for the numbers in such a report
    found = {label: float(re.findall(label + value, text)[0]) for label in ("Focal Length", "Xp", "Fw", "K1", "P2")}
    assert found == pytest.approx({"Focal Length": 8.2, "Xp": 651.8 * 4.65e-3, "Fw": 1280 * 4.65e-3, "K1": LENS["k1"], "P2": -LENS["p2"]})
    sigma = re.findall(r"Fw.*\s.*\s*Deviation: .*: ([0-9\-\+\.e]+)", text)
    assert float(sigma[0]) == pytest.approx(3e-6 * 1280 * 4.65e-3, rel=1e-5)


def test_two_cameras_of_one_name_are_two_cameras(tmp_path: Path) -> None:
    """Reports call a camera by its type, and a rig has several of one type: none takes the place of another."""
    australis = AUSTRALIS + AUSTRALIS.replace("Camera 1", "Camera 2").replace("8.3094", "8.4094")
    found = read_cameras(written(tmp_path / "rig.txt", australis))
    assert {name: model["c"] for name, model in found.items()} == {"WASP-LT Camera 3": 8.3094, "WASP-LT Camera 3 (2)": 8.4094}
    one = PHOTOMODELER[PHOTOMODELER.index("Camera1") :].partition("Photograph Standard Deviations")[0]
    found = read_cameras(written(tmp_path / "both.txt", PHOTOMODELER.replace(one, one + one.replace("Camera1", "Camera2"))))
    assert len(found) == 2 and len({model["c"] for model in found.values()}) == 1


@pytest.mark.parametrize("direction", ["image_to_object", "object_to_image"])
def test_the_covariance_goes_with_the_form(direction: str) -> None:
    """Against differences: each parameter changed by a step, and the model converted again; correlations to 0.03, as something is lost."""
    lens = LENS if direction == "image_to_object" else dict(c=8.2, xp=651.3, yp=466.1, k1=-0.02, k2=2e-3, p1=2e-4, p2=-1e-4)
    model = CameraModel.of(SENSOR, direction, **lens, b1=1e-3)
    free = ("c", "xp", "yp", "b1", "p1", "p2", "k1", "k2")
    other = {"image_to_object": "object_to_image", "object_to_image": "image_to_object"}[direction]
    names = ("c", "xp", "yp", "b1", "p1", "p2", "k1", "k2", "k3")
    form = converted(model, other, names).model
    step = np.array([1e-4, 0.02, 0.02, 1e-5, 1e-7, 1e-7, 1e-6, 1e-7])
    step *= 1 if direction == "image_to_object" else [1, 1, 1, 1, 10, 10, 10, 1e3]
    own = [NAMES.index(name) for name in names]
    by = np.column_stack(
        [
            (converted(model.with_values(**{n: model[n] + h}), other, names).model.values[own]
             - converted(model.with_values(**{n: model[n] - h}), other, names).model.values[own]) / (2 * h)
            for n, h in zip(free, step, strict=True)
        ]
    )  # fmt: skip
    known = Known(free, np.diag(step**2) + 0.3 * np.outer(step, step))
    told, covariance = carried_covariance(model, form, known, names)
    expected = by @ known.covariance @ by.T
    size = np.sqrt(np.diag(expected))
    assert told == tuple(name for name in NAMES if name in names)
    order = [told.index(name) for name in names]
    np.testing.assert_allclose(covariance[np.ix_(order, order)] / np.outer(size, size), expected / np.outer(size, size), atol=0.03)


def test_opencvs_file_has_the_covariance_of_its_numbers(tmp_path: Path) -> None:
    """fx = c (1 + B1)/pitch and so on, by hand; in the order of cv2.calibrateCameraExtended."""
    import cv2

    model = CameraModel.of(SENSOR, "object_to_image", c=8.2, xp=651.3, yp=466.1, b1=1e-3, k1=-0.1, k2=0.02, p1=1e-3, p2=-5e-4, name="eye")
    names = ("c", "xp", "b1", "k1", "p2")
    half = np.diag([1e-3, 0.2, 1e-5, 1e-3, 1e-5])
    half[0, 3] = 5e-4
    covariance = half @ half.T
    write_exports([model], {"opencv": tmp_path / "eye.yaml"}, known={"eye": Known(names, covariance)})
    storage = cv2.FileStorage(str(tmp_path / "eye.yaml"), cv2.FILE_STORAGE_READ)
    told = storage.getNode("covariance_intrinsics").mat()
    assert storage.getNode("std_dev_intrinsics").mat().ravel() == pytest.approx(np.sqrt(np.diag(told)))
    m = 4.65e-3
    by = np.zeros((9, 5))
    by[0, [0, 2]], by[1, 0], by[2, 1], by[4, 3], by[6, 4] = (1.001 / m, 8.2 / m), 1 / m, 1, 1, 1
    np.testing.assert_allclose(told, by @ covariance @ by.T, rtol=1e-9, atol=1e-18)
    assert read_opencv(tmp_path / "eye.yaml")["k1"] == pytest.approx(-0.1)
    fisheye = CameraModel.of(SENSOR, "object_to_image", c=3.0, k1=0.01, projection="equidistant")
    assert opencv_covariance(fisheye, opencv_form(fisheye), Known(("c", "k1"), np.eye(2)))[4, 4] == pytest.approx(1)


def test_a_project_starts_from_them(tmp_path: Path) -> None:
    """A report that does not tell the frame's size needs it from the project."""
    written(tmp_path / "o.csv", "image,point,x_px,y_px\na,1,10,10\n")
    written(tmp_path / "cam.dat", DIVISION)
    written(tmp_path / "pm.txt", PHOTOMODELER.replace("2272x1704 ", ""))
    project = "schema: pixmetry/calibration/1\ncameras: {start_from: %s}\nobservations: o.csv\n"
    (model,) = load_project(written(tmp_path / "p.yaml", project % "cam.dat")).network.cameras
    assert model["d1"] == pytest.approx(-2253.5e-6) and model.sensor.pitch_y_um == pytest.approx(11)
    with pytest.raises(InputError, match="how many pixels the frame has"):
        load_project(written(tmp_path / "p.yaml", project % "pm.txt"))
    sized = project.replace("{start", "{cols: 2272, rows: 1704, start")
    (model,) = load_project(written(tmp_path / "p.yaml", sized % "pm.txt")).network.cameras
    assert model["c"] == pytest.approx(7.465291)


@pytest.mark.parametrize(
    ("name", "text", "match"),
    [
        ("a.dat", DIVISION.replace("0.00806039", "0"), "cannot represent"),
        ("a.dat", DIVISION + "Vx:vx: 1e-5;\n  DOUBLE::;\n", "cannot represent"),
        ("a.dat", DIVISION.replace("Sy:sy", "Sz:sz"), "Sy is missing"),
        ("a.dat", "1 2 3\n", "not the camera parameters of HALCON"),
        ("a.txt", AUSTRALIS.replace("   XP ", "   XQ "), "not the camera parameters of Australis"),
        ("a.txt", AUSTRALIS.partition("Results for")[0], "no camera in the report"),
        ("a.txt", PHOTOMODELER.replace("Camera1:", "Lens:"), "no camera in the report"),
        ("a.txt", PHOTOMODELER.replace("Value: 7.465291 mm", ""), "focal length or format is missing"),
    ],
)
def test_what_cannot_be_read_is_refused(name: str, text: str, match: str, tmp_path: Path) -> None:
    from pixmetry.calibrate.project.cameras import read_start

    with pytest.raises(InputError, match=match):
        read_start(written(tmp_path / name, text), "camera")


def test_a_camera_in_pixels_and_a_fisheye_have_no_place(tmp_path: Path) -> None:
    paths = {"halcon": tmp_path / "a.dat", "australis": tmp_path / "a.txt", "photomodeler": tmp_path / "b.txt"}
    made = write_exports([CameraModel.of(Sensor(640, 480), c=800.0, k1=1e-8)], paths, 1e9)
    assert len(made.refused) == 3 and all("pixel pitch is not known" in str(problem) for _, problem in made.refused)
    fisheye = CameraModel.of(SENSOR, "object_to_image", c=2.2, projection="equidistant")
    assert len(write_exports([fisheye], paths, 1.0).refused) == 3 and not list(tmp_path.iterdir())
