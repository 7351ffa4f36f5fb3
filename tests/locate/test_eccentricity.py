"""The image of a circle's centre: against brute-force projection, published closed forms, and rendered images."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import chi2, norm

from pixmetry.core.errors import InputError
from pixmetry.core.random import Grid
from pixmetry.locate.circles.eccentricity import (
    both_corrected,
    circle_seen,
    common_plane,
    corrected,
    corrected_distorted,
    homography_of,
    plane_normals,
)
from pixmetry.locate.circles.ellipses import Ellipses, Pinhole, ellipse_through
from pixmetry.locate.detect.targets import Targets
from pixmetry.locate.noise import NoiseModel
from pixmetry.scene.plates import Pose, dot_plate

CAMERA = Pinhole(2500.0, 640.0, 480.0)
FALSE_FAILURES = 1e-6


def turn(tilt_deg: float, about_deg: float) -> np.ndarray:
    """Rotation by a tilt about an axis in the image plane."""
    t, a = np.deg2rad([tilt_deg, about_deg])
    axis = np.array([np.cos(a), np.sin(a), 0.0])
    cross = np.array([[0, 0, axis[1]], [0, 0, -axis[0]], [-axis[1], axis[0], 0]])
    return np.eye(3) + np.sin(t) * cross + (1 - np.cos(t)) * cross @ cross


def contour(camera: Pinhole, normal: np.ndarray, centre: np.ndarray, radius: float, count: int = 4000) -> tuple[np.ndarray, np.ndarray]:
    """Points of a circle in space, seen one by one."""
    first = np.linalg.svd(normal[None])[2][1]
    second = np.cross(normal / np.linalg.norm(normal), first)
    t = 2 * np.pi * np.arange(count) / count
    p = centre + radius * (np.cos(t)[:, None] * first + np.sin(t)[:, None] * second)
    c = camera.principal_distance_px
    return camera.principal_x_px + c * p[:, 0] / p[:, 2], camera.principal_y_px + c * camera.pitch_ratio * p[:, 1] / p[:, 2]


def many(count: int, seed: int | None = None, ratio: float = 1.0) -> list[tuple[Pinhole, np.ndarray, np.ndarray, float]]:
    """Random cameras, normals, centres and radii."""
    rng = np.random.default_rng(seed)
    out = []
    for _ in range(count):
        camera = Pinhole(rng.uniform(800, 6000), rng.uniform(0, 2000), rng.uniform(0, 2000), ratio * rng.uniform(0.8, 1.2))
        normal = turn(rng.uniform(0, 60), rng.uniform(0, 360))[:, 2]
        out.append((camera, normal, np.array([rng.uniform(-200, 200), rng.uniform(-200, 200), 1000.0]), rng.uniform(2, 15)))
    return out


def test_the_correction_is_the_image_of_the_centre_for_any_pose_and_pitch() -> None:
    """1e-7 px: what double precision leaves of the ellipse through the points."""
    for camera, normal, centre, radius in many(40):
        ellipse = ellipse_through(*contour(camera, normal, centre, radius))
        seen = camera.matrix @ centre
        found = corrected(ellipse, camera, normal)
        assert (found.x_px[0], found.y_px[0]) == pytest.approx(tuple(seen[:2] / seen[2]), abs=1e-7)
        exact, image = circle_seen(homography_of(camera, normal, centre), 0.0, 0.0, radius)
        np.testing.assert_allclose(exact.conics, ellipse.conics, rtol=1e-7)
        assert (image.x_px[0], image.y_px[0]) == pytest.approx(tuple(seen[:2] / seen[2]), abs=1e-9)


def test_the_plainest_perspective() -> None:
    """x/(1 + κx), y/(1 + κx): the ellipse's centre lies at −κR²/(1 − κ²R²), −.0245 px at R = 3.5, κ = .002."""
    plain = np.array([[1.0, 0, 0], [0, 1, 0], [0.002, 0, 1]])
    ellipse, centre = circle_seen(plain, 0.0, 0.0, 3.5)
    assert ellipse.x_px[0] == pytest.approx(-0.0245, abs=2e-5)
    assert ellipse.x_px[0] == pytest.approx(-0.002 * 3.5**2 / (1 - 0.007**2), rel=1e-12)
    assert (centre.x_px[0], centre.y_px[0], centre.shift_x_px[0]) == pytest.approx((0, 0, -ellipse.x_px[0]), abs=1e-15)


def test_a_circle_on_the_axis_follows_the_published_formula() -> None:
    """On the optical axis, tilted by α, the ellipse's centre is off by c R² sin α cos α / (Z² − R² sin²α) (Dold 1996; Ahn et al. 1999)."""
    c, z, radius = 2500.0, 1000.0, 15.0
    for alpha in (5.0, 30.0, 60.0):
        s, k = np.sin(np.deg2rad(alpha)), np.cos(np.deg2rad(alpha))
        _, centre = circle_seen(homography_of(CAMERA, np.array([s, 0, k]), np.array([0, 0, z])), 0, 0, radius)
        assert abs(centre.shift_x_px[0]) == pytest.approx(c * radius**2 * s * k / (z**2 - (radius * s) ** 2), rel=1e-9)
        assert centre.shift_y_px[0] == pytest.approx(0.0, abs=1e-12)


def test_two_normals_explain_an_ellipse_and_one_of_them_is_true() -> None:
    for camera, normal, centre, radius in many(40):
        ellipse, _ = circle_seen(homography_of(camera, normal, centre), 0, 0, radius)
        both = plane_normals(ellipse, camera)[0]
        true = normal * np.sign(normal[2])
        assert np.abs(both - true).max(axis=1).min() < 1e-7
        for found in both:  # either plane cuts the cone in a circle: all points of the contour are as far from one centre
            x, y = contour(camera, true, centre, radius, 50)
            ray = np.stack([x, y, np.ones_like(x)], axis=1) @ np.linalg.inv(camera.matrix).T
            points = ray / (ray @ found)[:, None]
            design = np.column_stack([2 * points, np.ones(50)])  # |p|² = 2 c·p + const is a sphere; on a plane a circle
            rest = (points**2).sum(axis=1) - design @ np.linalg.lstsq(design, (points**2).sum(axis=1), rcond=None)[0]
            assert np.abs(rest).max() < 1e-9
        first, second = both_corrected(ellipse, camera)
        seen = camera.matrix @ centre
        miss = [np.hypot(a.x_px[0] - seen[0] / seen[2], a.y_px[0] - seen[1] / seen[2]) for a in (first, second)]
        assert min(miss) < 1e-6


def noisy(ellipses: Ellipses, rng: np.random.Generator, sigma_px: float) -> Ellipses:
    """Ellipses with the errors of a fit of their edges: σ for the centre, 2aσ for the shape matrix, covariances told."""
    area = np.sqrt(np.prod([ellipses.semi_major_px, ellipses.semi_minor_px], axis=0))
    sd = sigma_px * np.stack([np.ones_like(area), np.ones_like(area), 2 * area, 1.5 * area, 2 * area], axis=1)
    covariance = np.einsum("ni,ij->nij", sd**2, np.eye(5))
    return Ellipses.of_conics(ellipses.conics + sd * rng.normal(size=sd.shape), covariance)


@pytest.mark.parametrize("tilt_deg", [0.0, 5.0, 45.0, 60.0])
def test_the_covariance_of_the_centres_holds(tilt_deg: float, rng: np.random.Generator) -> None:
    """χ² over 9 targets × 80 trials × 2: catches a standard deviation 13 % off at a false-failure rate of 1e-6."""
    normal = turn(tilt_deg, 30.0)[:, 2]
    x, y = (v.ravel() for v in np.meshgrid([-60.0, 0, 60.0], [-60.0, 0, 60.0]))
    ellipses, truth = circle_seen(homography_of(CAMERA, normal, np.array([5.0, 8.0, 1000.0])), x, y, 10.0)
    total: dict[str, list[float]] = {"given": [], "common": [], "single": []}
    for _ in range(80):
        seen = noisy(ellipses, rng, 0.003)
        answers = {"given": corrected(seen, CAMERA, normal), "common": corrected(seen, CAMERA, hint=normal)}
        answers["single"] = corrected(seen, CAMERA, hint=normal, coplanar=False)
        for name, answer in answers.items():
            matrix = np.array([[answer.var_x_px2, answer.cov_xy_px2], [answer.cov_xy_px2, answer.var_y_px2]]).transpose(2, 0, 1)
            miss = np.stack([answer.x_px - truth.x_px, answer.y_px - truth.y_px], axis=1)
            total[name] += np.einsum("ni,nij,nj->n", miss, np.linalg.inv(matrix), miss).tolist()
    dof = 2 * 9 * 80
    for name in ("given", "single"):
        low, high = chi2.ppf([FALSE_FAILURES / 2, 1 - FALSE_FAILURES / 2], dof)
        assert low * (tilt_deg >= 45) < sum(total[name]) < high, name  # near the front a normal's sign is told by the hint: less than χ²
    assert sum(total["common"]) < 1.25 * chi2.ppf(1 - FALSE_FAILURES, dof)  # the plane's error is common to nine targets


def test_the_normal_of_several_circles_has_the_covariance_that_is_stated(rng: np.random.Generator) -> None:
    """z² of two angles over 60 trials: catches a standard deviation 34 % off at 1e-6."""
    normal = turn(40.0, -50.0)[:, 2]
    x, y = (v.ravel() for v in np.meshgrid([-60.0, 0, 60.0], [-60.0, 0, 60.0]))
    ellipses, _ = circle_seen(homography_of(CAMERA, normal, np.array([5.0, 8.0, 1000.0])), x, y, 10.0)
    squares, fits = 0.0, 0.0
    for _ in range(60):
        plane = common_plane(noisy(ellipses, rng, 0.003), CAMERA)
        assert plane.other_normal is None
        values, axes = np.linalg.eigh(plane.covariance)
        squares += ((axes[:, 1:].T @ (plane.normal - normal * np.sign(normal[2]))) ** 2 / values[1:]).sum()
        fits += plane.chi2_per_dof * 16
    assert chi2.ppf(FALSE_FAILURES / 2, 120) < squares < chi2.ppf(1 - FALSE_FAILURES / 2, 120)
    assert chi2.ppf(FALSE_FAILURES / 2, 960) < fits < chi2.ppf(1 - FALSE_FAILURES / 2, 960)


def test_one_circle_alone_has_two_answers_and_says_so() -> None:
    ellipse, _ = circle_seen(homography_of(CAMERA, turn(40.0, 0.0)[:, 2], np.array([20.0, 50.0, 1000.0])), 0, 0, 12.0)
    plane = common_plane(ellipse, CAMERA)
    assert plane.other_normal is not None
    with pytest.raises(InputError, match=r"two planes .* give the normal or a hint"):
        corrected(ellipse, CAMERA)
    with pytest.raises(InputError, match="each circle alone has two possible planes"):
        corrected(ellipse, CAMERA, coplanar=False)


def test_distortion_is_taken_out_and_put_back() -> None:
    """Contours through a radial distortion; a distorted ellipse is no exact ellipse, which leaves 2e-4 px of a correction of .15 px."""
    k = 2.0e-8

    def undistort(x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        dx, dy = x - CAMERA.principal_x_px, y - CAMERA.principal_y_px
        scale = 1 + k * (dx**2 + dy**2)
        return CAMERA.principal_x_px + dx * scale, CAMERA.principal_y_px + dy * scale

    def distort(x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        u, v = np.array(x, float), np.array(y, float)
        for _ in range(50):
            a, b = undistort(u, v)
            u, v = u - (a - x), v - (b - y)
        return u, v

    normal = turn(50.0, 20.0)[:, 2]
    centre = np.array([150.0, -90.0, 1000.0])
    ellipse = ellipse_through(*distort(*contour(CAMERA, normal, centre, 10.0)))
    found = corrected_distorted(ellipse, CAMERA, normal, undistort)
    seen = CAMERA.matrix @ centre
    truth = np.concatenate(distort(np.array([seen[0] / seen[2]]), np.array([seen[1] / seen[2]])))
    assert np.hypot(ellipse.x_px[0] - truth[0], ellipse.y_px[0] - truth[1]) > 0.1
    assert (found.x_px[0], found.y_px[0]) == pytest.approx(tuple(truth), abs=2e-4)


def rough_targets(ellipses: Ellipses, amplitude_dn: float, background_dn: float, edge_px: float) -> Targets:
    """What a detection would tell: everything a little off."""
    n = len(ellipses)
    full = np.ones(n)
    half = np.ceil(ellipses.semi_major_px).astype(int)
    x, y = np.round(ellipses.x_px).astype(int), np.round(ellipses.y_px).astype(int)
    return Targets(
        x_px=ellipses.x_px + 0.07,
        y_px=ellipses.y_px - 0.05,
        semi_major_px=1.02 * ellipses.semi_major_px,
        semi_minor_px=0.99 * ellipses.semi_minor_px,
        angle_deg=ellipses.angle_deg,
        blur_px=edge_px * full,
        amplitude_dn=0.98 * amplitude_dn * full,
        background_dn=(background_dn + 1) * full,
        background_x_dn_per_px=0 * full,
        background_y_dn_per_px=0 * full,
        sigma_dn=full,
        row_first=y - half,
        row_stop=y + half + 1,
        col_first=x - half,
        col_stop=x + half + 1,
        flags=np.zeros(n, np.uint32),
    )


@pytest.mark.parametrize("diameter_mm", [4.0, 12.0, 33.6])
@pytest.mark.parametrize("tilt_deg", [0.0, 30.0, 60.0])
def test_centres_in_rendered_images(diameter_mm: float, tilt_deg: float) -> None:
    """Circles of 5 to 42 px radius, rendered by the scenes, fitted by the template: within .002 px, where ellipses are up to .3 px off."""
    from pixmetry.locate.template.template import fit_template

    pose = Pose(2500.0, 250.0, 220.0, tilt_deg * 0.8, tilt_deg * 0.6, 15.0, 2.0, -3.0, 1000.0)
    plate = dot_plate(pose, 3, 3, 1.6 * diameter_mm, diameter_mm, 200.0, 0.7)
    shape = (440, 500)
    frame = (10 + plate.render(Grid.whole([0], shape), shape, np.zeros(1), np.full(1, 0.01), False)[0, 0]).astype(np.float32)
    told = plate.targets(0.0, 0)
    truth = np.array([(t["x_px"], t["y_px"]) for t in told])
    exact, _ = circle_seen(pose.homography, [t["x_mm"] for t in told], [t["y_mm"] for t in told], diameter_mm / 2)
    noise = NoiseModel(0.02)
    found = fit_template(frame, rough_targets(exact, 200.0, 10.0, np.hypot(0.7, 12**-0.5)), noise, "ellipse")
    ellipses = Ellipses.of(found)
    camera = Pinhole(2500.0, 250.0, 220.0)
    normal = np.cross(*(np.linalg.inv(camera.matrix) @ pose.homography)[:, :2].T)
    for answer in (corrected(ellipses, camera, normal), corrected(ellipses, camera, hint=normal)):
        miss = np.hypot(answer.x_px - truth[:, 0], answer.y_px - truth[:, 1])
        assert miss.max() < 0.002
    if diameter_mm > 30 and tilt_deg == 30.0:
        assert np.hypot(ellipses.x_px - truth[:, 0], ellipses.y_px - truth[:, 1]).max() > 0.25


def test_noisy_images_agree_on_the_plane_as_well_as_their_covariance_says(rng: np.random.Generator) -> None:
    """χ² of 3 × 9 ellipses about common planes: catches a covariance 2.2 times too large or too small at 1e-6."""
    from pixmetry.locate.template.template import fit_template

    shape, camera = (440, 500), Pinhole(2500.0, 250.0, 220.0)
    total = 0.0
    for tilt_deg, diameter_mm in ((20.0, 12.0), (45.0, 20.0), (60.0, 33.6)):
        pose = Pose(2500.0, 250.0, 220.0, tilt_deg * 0.8, tilt_deg * 0.6, 15.0, 2.0, -3.0, 1000.0)
        plate = dot_plate(pose, 3, 3, 1.6 * diameter_mm, diameter_mm, 200.0, 0.7)
        clean = 10 + plate.render(Grid.whole([0], shape), shape, np.zeros(1), np.full(1, 0.01), False)[0, 0]
        frame = (clean + rng.normal(0, 1.0, shape)).astype(np.float32)
        told = plate.targets(0.0, 0)
        exact, _ = circle_seen(pose.homography, [t["x_mm"] for t in told], [t["y_mm"] for t in told], diameter_mm / 2)
        rough = rough_targets(exact, 200.0, 10.0, 0.76)
        found = fit_template(frame, rough, NoiseModel(1.0), "ellipse", background_plane=False, light_plane=False)
        total += 16 * common_plane(Ellipses.of(found), camera).chi2_per_dof
    low, high = chi2.ppf([FALSE_FAILURES / 2, 1 - FALSE_FAILURES / 2], 48)
    assert low < total < high


def test_bad_input_has_a_clear_outcome() -> None:
    good, _ = circle_seen(homography_of(CAMERA, np.array([0.0, 0, 1]), np.array([0, 0, 1000.0])), 0, 0, 10.0)
    for make, text in (
        (lambda: Pinhole(0.0, 1.0, 1.0), "camera cannot be used"),
        (lambda: Ellipses(1.0, 1.0, np.nan, 1.0, 0.0), "finite"),
        (lambda: Ellipses(1.0, 1.0, 2.0, 0.0, 0.0), "no extent"),
        (lambda: corrected(good, CAMERA, (0, 0, 0)), "not a direction"),
        (lambda: corrected(good, CAMERA, (1.0, 0.0, 0.0)), "horizon"),
        (lambda: circle_seen(np.zeros((3, 3)), 0, 0, 1), "cannot be projected"),
        (lambda: circle_seen(np.array([[1.0, 0, 0], [0, 1, 0], [0.3, 0, 1]]), 0, 0, 5.0), "horizon"),
        (lambda: ellipse_through([0, 1, 2, 3], [0, 1, 2, 3]), "five or more"),
        (lambda: ellipse_through(np.arange(9.0), 2 * np.arange(9.0)), "ellipse"),
        (lambda: common_plane(good[:0], CAMERA), "no ellipse"),
    ):
        with pytest.raises(InputError, match=text):
            make()


def test_no_circles_and_many_circles() -> None:
    good, _ = circle_seen(homography_of(CAMERA, turn(30, 0)[:, 2], np.array([0, 0, 1000.0])), np.zeros(20000), np.zeros(20000), 10.0)
    assert len(corrected(good[:0], CAMERA, (0, 0.5, 1))) == 0
    assert len(corrected(good, CAMERA, hint=turn(30, 0)[:, 2])) == 20000


def test_the_rate_of_false_failures_is_the_one_that_is_stated() -> None:
    assert norm.sf(4.75) == pytest.approx(FALSE_FAILURES, rel=0.03)
