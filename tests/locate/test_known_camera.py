"""A camera that is known before its frames are seen: what its pixels share is in the covariance, its defect pixels are left out."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from locate import honest_cases
from pixmetry.camera.camera import Camera, Element, in_order
from pixmetry.camera.catalogue import get_source
from pixmetry.core.errors import InputError
from pixmetry.locate.detect.targets import Flag
from pixmetry.locate.job import locate
from pixmetry.locate.known_camera import known_camera, mended

RATE, SIDE = 1e-6, 8
SOURCES: dict[str, dict[str, object]] = {
    "sensor.quantum_efficiency": {"quantum_efficiency": 1.0},
    "electronics.amplifier_noise": {"white_e": 20.0},
    "electronics.row_noise": {"row_e": 20.0},
    "electronics.gain": {"gain_dn_per_e": 0.1},
    "grabber.adc": {"bits": 10, "offset_dn": 40},
}


def camera_of(sources: dict[str, dict[str, object]]) -> Camera:
    found = {name: get_source(name) for name in sources}
    chain = tuple(Element(s.id, s, s.parameters(**sources[s.id])) for s in in_order(found.values()))
    return Camera("rows", (256, 256), chain, unit_seed=3)


@pytest.fixture(scope="module")
def camera() -> Camera:
    return camera_of(SOURCES)


def rows_in_ten_bits(mean: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    return mean + rng.normal(0, 2.0, mean.shape) + rng.normal(0, 2.0, (mean.shape[0], 1))


def test_noise_of_rows_is_that_of_the_assessment(camera: Camera, rng: np.random.Generator) -> None:
    """Error over u along y is 1 to chance of 4 frames of 8 rows of targets, and along x that of the pixels' own noise."""
    known = known_camera(camera)
    covariance = known.correlation_at(60.0)
    middle = len(covariance.covariance_dn2) // 2
    assert covariance.covariance_dn2[middle, middle + 5] == pytest.approx(4.0, rel=0.2)  # 80 rows of noise, 40 pairs: 3 %
    assert abs(covariance.covariance_dn2[middle + 5, middle]) < 0.5
    picture = honest_cases.Picture(*honest_cases.discs(rng, SIDE, radius=5.0), rows_in_ten_bits, bits=10)
    score = honest_cases.score(picture, rng, 4, with_=known, bits=10)
    z = score.z.reshape(4, 2, -1) if len(score.z) == 4 * 2 * SIDE**2 else None
    assert z is not None
    for axis, independent in ((0, 4 * SIDE**2), (1, 4 * SIDE)):
        low, high = np.sqrt(stats.chi2.isf([1 - RATE / 2, RATE / 2], independent) / independent)
        assert low / 1.15 < np.sqrt((z[:, axis] ** 2).mean()) < 1.15 * high


def columns_in_ten_bits(mean: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    return mean + rng.normal(0, 2.0, mean.shape) + rng.normal(0, 2.0, (1, mean.shape[1]))


def test_fixed_offsets_of_columns_are_in_the_uncertainty(rng: np.random.Generator) -> None:
    """Columns of 2 DN, the same in all frames: error over u along x is 1 to chance; it was 2.2, for differences of frames hide them."""
    sources = {n: p for n, p in SOURCES.items() if n != "electronics.row_noise"} | {"sensor.dsnu": {"col_std_e": 20.0}}
    known = known_camera(camera_of(sources))
    assert known.lines_dn2[1] == pytest.approx(4.0, rel=0.3)  # of a unit of known seed; 93 degrees of freedom: 15 %
    assert known.lines_dn2[0] < 0.2
    picture = honest_cases.Picture(*honest_cases.discs(rng, SIDE, radius=5.0), columns_in_ten_bits, bits=10)
    score = honest_cases.score(picture, rng, 4, with_=known, bits=10)
    assert len(score.z) == 4 * 2 * SIDE**2
    z = score.z.reshape(4, 2, -1)
    for axis, independent in ((0, 4 * SIDE), (1, 4 * SIDE**2)):
        low, high = np.sqrt(stats.chi2.isf([1 - RATE / 2, RATE / 2], independent) / independent)
        assert low / 1.15 < np.sqrt((z[:, axis] ** 2).mean()) < 1.15 * high


def test_what_is_known_does_not_depend_on_the_frames_before() -> None:
    """Of a camera with shot noise, at two levels that are so near that one correlation does for both."""
    camera = camera_of(SOURCES | {"sensor.shot_noise": {}})
    first, second = known_camera(camera), known_camera(camera)
    first.correlation_at(300.0)
    assert (first.correlation_at(302.0).covariance_dn2 == second.correlation_at(302.0).covariance_dn2).all()
    assert len(first.seen) == 1
    assert len(second.seen) == 1 and second.correlation_at(60.0).variance_dn2 < 0.8 * second.correlation_at(302.0).variance_dn2


def test_defect_pixels_are_left_out(camera: Camera, rng: np.random.Generator) -> None:
    """Pixels on the edges of discs that are 30 DN too bright move them by a tenth of a pixel; with a map of them they do not."""
    mean, x, y = honest_cases.discs(rng, SIDE, radius=5.0)
    frame = np.rint(mean + rng.normal(0, 2.0, mean.shape)).astype(np.uint16)
    defects = np.zeros(frame.shape, bool)
    for px, py in zip(x, y, strict=True):
        defects[round(py) - 1 : round(py) + 2, round(px + 5)] = True
    spoiled = np.where(defects, frame + 30, frame).astype(np.uint16)
    known = replace(known_camera(camera), defects=defects)

    def off(**options: object) -> float:
        table = locate(spoiled, bits=10, **options)
        assert len(table) == SIDE**2
        nearest = np.hypot(table.x_px[:, None] - x, table.y_px[:, None] - y).argmin(axis=1)
        if options:
            assert ((table.flags & np.uint32(Flag.DEFECT)) != 0).all()
        return float(np.abs(table.x_px - x[nearest]).mean())

    assert off() > 0.03 > 3 * off(with_=known)
    assert off(with_=known, estimator="centroid") < 0.04
    assert off(with_=known, kind="blob") < 0.04
    assert (mended(spoiled, defects) == spoiled)[~defects].all()


def test_what_does_not_fit_is_refused(camera: Camera) -> None:
    known = replace(known_camera(camera), defects=np.eye(20, dtype=bool))
    with pytest.raises(InputError, match="another size"):
        locate(np.zeros((30, 30), np.uint16), with_=known)
    for frame, bits, match in (
        (np.zeros((30, 30), np.uint8), None, "grey values of 8 bits"),
        (np.full((30, 30), 1024, np.uint16), None, "more bits"),
        (np.zeros((30, 30), np.uint16), 12, "other bits"),
    ):
        with pytest.raises(InputError, match=match):
            locate(frame, with_=camera, bits=bits)
    with pytest.raises(InputError, match="both a camera and a noise"):
        locate(np.zeros((30, 30), np.uint8), with_=camera, noise="read=1")
