"""Beams by ISO 11146, and targets of any shape: against closed forms, an algorithm written from the standard, and their own u."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from pixmetry import locate
from pixmetry.locate.centroids.light_moments import beam_noise, beam_positions
from pixmetry.locate.detect.detection import detect
from pixmetry.locate.noise import NoiseModel

ROWS, COLS = 150, 200
READ_DN, GAIN, BLACK = 3.0, 0.25, 64.0


def turned(x: np.ndarray, y: np.ndarray, angle_deg: float) -> tuple[np.ndarray, np.ndarray]:
    c, s = np.cos(np.radians(angle_deg)), np.sin(np.radians(angle_deg))
    return c * x + s * y, c * y - s * x


def beam(kind: str, centre: tuple[float, float], w: tuple[float, float], angle_deg: float) -> tuple[np.ndarray, tuple[float, float]]:
    """Power density of a beam, peak 1, and its widths D4σ in closed form: Gaussian 2w, TEM01 2√3 w and 2w, top-hat of half axes w 2w."""
    y, x = np.mgrid[:ROWS, :COLS].astype(float)
    u, v = turned(x - centre[0], y - centre[1], angle_deg)
    u, v = u / w[0], v / w[1]
    if kind == "tophat":
        return np.clip((1 - np.hypot(u, v)) * min(w) + 0.5, 0, 1), (2 * w[0], 2 * w[1])
    light = np.exp(-2 * (u * u + v * v))
    if kind == "tem01":
        return u * u * light * 2 * np.e, (2 * np.sqrt(3) * w[0], 2 * w[1])
    return light, (2 * w[0], 2 * w[1])


def camera(light: np.ndarray, rng: np.random.Generator, height_dn: float = 3000.0, smear: float = 0.0) -> np.ndarray:
    """Photons, read noise, rounding; ``smear``: of a column's light in each of its pixels."""
    light = height_dn * light
    light = light + smear * light.sum(axis=0)
    return np.clip(np.rint(rng.poisson((light + BLACK) / GAIN) * GAIN + rng.normal(0, READ_DN, light.shape)), 0, 4095).astype(np.uint16)


def by_the_standard(image: np.ndarray, background: float) -> tuple[float, float, float, float, float]:
    """x, y, major, minor, angle as ISO 11146-1 says, and nothing else: a turned rectangle of three widths, from all of the frame on."""
    y, x = np.mgrid[: image.shape[0], : image.shape[1]].astype(float)
    light, mask = image.astype(float) - background, np.ones(image.shape)
    for _ in range(50):
        g = light * mask
        total = g.sum()
        xc, yc = (g * x).sum() / total, (g * y).sum() / total
        xx, yy, xy = ((g * a * b).sum() / total for a, b in ((x - xc, x - xc), (y - yc, y - yc), (x - xc, y - yc)))
        phi = 0.5 * np.arctan2(2 * xy, xx - yy)
        root = np.hypot(xx - yy, 2 * xy)
        major, minor = np.sqrt(8 * (xx + yy + root)), np.sqrt(8 * (xx + yy - root))
        u, v = turned(x - xc, y - yc, np.degrees(phi))
        mask = ((np.abs(u) <= 1.5 * major) & (np.abs(v) <= 1.5 * minor)).astype(float)
    return xc, yc, major, minor, np.degrees(phi)


@pytest.mark.parametrize("kind", ["gauss", "tem01", "tophat"])
def test_widths_are_those_of_the_closed_form_without_noise(kind: str) -> None:
    """Within 0.3 % of them (a raster of 1 px at the top-hat's rim), and within 0.2 % of the algorithm of the standard on the same frame."""
    light, widths = beam(kind, (97.3, 74.6), (13.0, 8.0), 25.0)
    frame = (1000 * light + 50).astype(np.float32)
    found = locate(frame, kind="spot", estimator="d4sigma", noise=NoiseModel(1e-4))
    assert len(found) == 1
    seen = np.array([found["d4sigma_major_px"][0], found["d4sigma_minor_px"][0]])
    assert seen == pytest.approx(widths, rel=3e-3)
    x, y, major, minor, angle = by_the_standard(frame, 50.0)
    raw = np.sqrt(seen**2 + 16 / 12)  # the standard has the pixel's own share in it
    assert raw == pytest.approx([major, minor], rel=2e-3)
    assert (found.x_px[0], found.y_px[0]) == pytest.approx((97.3, 74.6), abs=0.01) and (x, y) == pytest.approx((97.3, 74.6), abs=0.01)
    assert found["angle_deg"][0] == pytest.approx(25.0, abs=0.2) and angle == pytest.approx(25.0, abs=0.2)
    assert found["ellipticity"][0] == pytest.approx(seen[1] / seen[0], rel=1e-12)


@pytest.mark.parametrize(("kind", "smear"), [("gauss", 0.0), ("gauss", 0.002), ("tem01", 0.0)])
def test_uncertainties_of_beams_cover(kind: str, smear: float, rng: np.random.Generator) -> None:
    """20 beams: every one found, mean square of z of centroid, widths and azimuth between 0.2 and 2.9 (χ² of 100 values, which share their
    images: 1e-6 for 20 independent ones is 0.17 … 2.9), and no width more than 6 u off."""
    z = []
    for _ in range(20):
        w = rng.uniform(8, 10)
        axes, angle = (w, w * rng.uniform(0.5, 0.8)), rng.uniform(-90, 90)
        centre = rng.uniform(90, 110), rng.uniform(68, 82)
        light, widths = beam(kind, centre, axes, angle)
        found = locate(camera(light, rng, smear=smear), kind="spot", estimator="d4sigma")
        assert len(found) == 1
        off = (found["angle_deg"][0] - angle + 90) % 180 - 90
        z.append(
            [
                (found.x_px[0] - centre[0]) / np.sqrt(found.var_x_px2[0]),
                (found.y_px[0] - centre[1]) / np.sqrt(found.var_y_px2[0]),
                (found["d4sigma_major_px"][0] - widths[0]) / found["u_d4sigma_major_px"][0],
                (found["d4sigma_minor_px"][0] - widths[1]) / found["u_d4sigma_minor_px"][0],
                off / found["u_angle_deg"][0],
            ]
        )
        assert abs(found["d4sigma_major_px"][0] / widths[0] - 1) < 0.05
    assert 0.2 < np.mean(np.square(z)) < 2.9 and np.abs(z).max() < 6


def test_a_beam_at_the_border_is_measured_and_said_to_be(rng: np.random.Generator) -> None:
    """A quarter of its width from the border it has still its centroid; where the frame holds no ground on either side, it has none."""
    light, widths = beam("gauss", (9.0, 75.0), (10.0, 7.0), 90.0)
    found = locate(camera(light, rng), kind="spot", estimator="d4sigma")
    assert len(found) == 1 and "border" in found.flag_words[0]
    assert abs(found.x_px[0] - 9.0) < 5 * np.sqrt(found.var_x_px2[0]) and abs(found["d4sigma_major_px"][0] - widths[0]) < 1
    light, _ = beam("gauss", (100.0, 75.0), (70.0, 60.0), 0.0)
    assert not len(locate(camera(light, rng), kind="spot", estimator="d4sigma"))


def test_two_lobes_are_one_beam_and_two_beams_are_two(rng: np.random.Generator) -> None:
    mode, widths = beam("tem01", (100.0, 75.0), (11.0, 8.0), 0.0)
    frame = camera(mode, rng)
    assert len(detect(frame).targets) == 2 and len(locate(frame, kind="spot", estimator="d4sigma")) == 1
    a, b = beam("gauss", (50.0, 75.0), (7.0, 5.0), 0.0)[0], beam("gauss", (150.0, 75.0), (7.0, 5.0), 0.0)[0]
    assert len(locate(camera(a + b, rng), kind="spot", estimator="d4sigma")) == 2
    for axes, chosen in (((3.0, 3.0), False), ((10.0, 10.0), True), ((9.0, 5.0), True)):
        found = locate(camera(beam("gauss", (50.0, 75.0), axes, 20.0)[0], rng), kind="spot")
        assert (found["estimator"][0] == "d4sigma") is chosen


def test_a_field_of_large_spots_is_no_row_of_beams(rng: np.random.Generator) -> None:
    """Apertures of beams would reach over the neighbours: each spot is fitted by its template, and none is lost."""
    y, x = np.mgrid[:200, :240].astype(float)
    places = np.stack(np.meshgrid(np.arange(24.0, 220, 38), np.arange(24.0, 190, 38)), axis=-1).reshape(-1, 2) + rng.uniform(-1, 1, (30, 2))
    light = sum(np.exp(-((x - a) ** 2 + (y - b) ** 2) / (2 * 4.5**2)) for a, b in places)
    found = locate(camera(light, rng, height_dn=400.0), kind="spot")
    assert len(found) == 30 and "d4sigma_major_px" not in found.columns
    away = np.hypot(found.x_px[:, None] - places[:, 0], found.y_px[:, None] - places[:, 1]).min(axis=1)
    assert away.max() < 0.5


def test_the_noise_of_a_smooth_frame_is_told_from_its_second_differences(rng: np.random.Generator) -> None:
    """Read noise, black's photons and rounding to 6 %, shot noise to 40 % (some hundred pixels are bright)."""
    frame = camera(beam("gauss", (100.0, 75.0), (25.0, 20.0), 0.0)[0], rng)
    noise = beam_noise(frame, detect(frame).targets)
    assert noise.constant_dn2 == pytest.approx(READ_DN**2 + GAIN * BLACK + 1 / 12, rel=0.15)
    assert noise.slope_dn == pytest.approx(GAIN, rel=0.4)


def irregular(centre: tuple[float, float], rng: np.random.Generator, sub: int = 5) -> tuple[np.ndarray, tuple[float, float]]:
    """Light of a shape with three to five lobes and a bay, blurred by 0.9 px, on a window of 60 × 60, and its true centroid."""
    at = (np.arange(60 * sub) + 0.5) / sub - 0.5
    x, y = np.meshgrid(at - centre[0], at - centre[1])
    angle = np.arctan2(y, x)
    radius = 10 + sum(rng.uniform(1, 3) * np.cos(k * angle + rng.uniform(0, 2 * np.pi)) for k in (1, 2, 3, 5))
    fine = (np.hypot(x, y) < radius).astype(float)
    true = float((fine * x).sum() / fine.sum()) + centre[0], float((fine * y).sum() / fine.sum()) + centre[1]
    return gaussian_filter(fine, 0.9 * sub).reshape(60, sub, 60, sub).mean(axis=(1, 3)), true


def test_irregular_targets_are_all_found_and_cover_their_true_centroids(rng: np.random.Generator) -> None:
    """24 shapes in one frame, of which the kind disc takes few. z: mean square of 48 values between 0.3 and 2.3 (1e-6)."""
    frame, truth = np.zeros((240, 360)), []
    for i in range(4):
        for j in range(6):
            light, (x, y) = irregular((29.5 + rng.uniform(-1, 1), 29.5 + rng.uniform(-1, 1)), rng)
            frame[60 * i : 60 * i + 60, 60 * j : 60 * j + 60] += light
            truth.append((x + 60 * j, y + 60 * i))
    noisy = camera(frame, rng, height_dn=400.0)
    found = locate(noisy, kind="blob")
    assert len(found) == 24 and len(locate(noisy, kind="disc")) < 12
    z = []
    for x, y in truth:
        k = int(np.argmin(np.hypot(found.x_px - x, found.y_px - y)))
        z += [(found.x_px[k] - x) / np.sqrt(found.var_x_px2[k]), (found.y_px[k] - y) / np.sqrt(found.var_y_px2[k])]
    assert 0.3 < np.mean(np.square(z)) < 2.3


def test_a_dark_target_and_a_touched_one(rng: np.random.Generator) -> None:
    """A hole in bright ground is located as a target on dark ground; a target that another one touches is flagged."""
    light, true = irregular((29.5, 29.5), rng)
    frame = camera(np.pad(1 - light, 20, constant_values=1.0), rng, height_dn=400.0)
    found = locate(frame, kind="blob")
    assert len(found) == 1 and found["amplitude_dn"][0] < 0
    assert np.hypot(found.x_px[0] - 20 - true[0], found.y_px[0] - 20 - true[1]) < 6 * np.sqrt(found.var_x_px2[0] + found.var_y_px2[0])
    y, x = np.mgrid[:60, :90].astype(float)
    pair = sum(1 / (1 + np.exp(2 * (np.hypot(x - a, y - 30) - 9))) for a in (30.0, 51.0))
    assert ["overlapping" in words for words in locate(camera(pair, rng, height_dn=400.0), kind="blob").flag_words] == [True, True]


def test_without_targets_there_is_nothing() -> None:
    flat = np.full((40, 50), 90, np.uint8)
    assert not len(locate(flat, kind="blob")) and not len(locate(flat, kind="spot", estimator="d4sigma"))
    assert not len(beam_positions(flat, detect(flat).targets))


@pytest.mark.parametrize("width_px", [8.0, 16.0])
def test_a_ground_that_slopes_is_no_smear(width_px: float, rng: np.random.Generator) -> None:
    """Rounded grey values over a slope of 0.01 DN a pixel: widths within 5 u and 5 %; medians of rounded columns made them 20 % wrong."""
    y, x = np.indices((240, 250))
    light = 200 * np.exp(-2 * ((x - 124.7) ** 2 + (y - 119.8) ** 2) / width_px**2)
    frame = np.rint(light + 10 + 0.01 * x + rng.normal(0, 0.7, x.shape)).astype(np.uint8)
    table = locate(frame, kind="spot", estimator="d4sigma")
    assert len(table) == 1 and table.flag_words == [""]
    for name in ("d4sigma_major_px", "d4sigma_minor_px"):
        off = abs(table[name][0] - 2 * width_px)
        assert off < 5 * table[f"u_{name}"][0] and off < 0.05 * 2 * width_px + 3 * table[f"u_{name}"][0]


def test_smear_over_a_ground_that_is_cut_off_at_black(rng: np.random.Generator) -> None:
    """Nearly all of the ground is 0, and most of its columns are alike: the beam has its row, within 5 u."""
    y, x = np.indices((300, 320))
    light = 200 * np.exp(-2 * ((x - 160.3) ** 2 + (y - 150.2) ** 2) / 10.0**2)
    frame = np.clip(np.rint(light + 0.2 * light.mean(axis=0) + rng.normal(0, 0.7, x.shape)), 0, 255).astype(np.uint8)
    table = locate(frame, kind="spot", estimator="d4sigma")
    assert len(table) == 1
    assert abs(table.d4sigma_major_px[0] - 20) < 5 * table.u_d4sigma_major_px[0] < 5
