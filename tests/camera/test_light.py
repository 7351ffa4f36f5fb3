"""Light that is sampled once: places, spreads, times; against integrals done another way."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest
from scipy.special import erf

from catalogue.support import IDEAL, NAME, Texture, make_source
from pixmetry.camera._camera_kernels import decimate
from pixmetry.camera.camera import Camera, Element
from pixmetry.camera.light import FINE, Light, Points
from pixmetry.camera.signal import Kind, Signal
from pixmetry.camera.source import Parameters
from pixmetry.core.errors import ChainError, InputError
from pixmetry.core.random import Grid
from pixmetry.scene.outlines import line
from pixmetry.scene.picture import Picture
from pixmetry.scene.shapes import Shapes
from pixmetry.scene.uniform import Uniform

SHAPE = (20, 24)


@dataclass(frozen=True)
class Spot:
    """A Gaussian spot of unit height that may run; its convolutions with Gaussians and boxes have closed forms."""

    x_px: float = 11.3
    y_px: float = 9.6
    sd_px: float = 1.2
    speed_px_per_s: float = 0.0

    @property
    def moving(self) -> bool:
        return self.speed_px_per_s != 0

    @property
    def smooth_px(self) -> float:
        return self.sd_px

    def radiance(self, at: Points) -> np.ndarray:
        var = self.sd_px**2 + at.blur_px**2
        x = at.x_px - self.x_px - self.speed_px_per_s * at.time_s
        return self.sd_px**2 / var * np.exp(-(x**2 + (at.y_px - self.y_px) ** 2) / (2 * var))


def boxed(at: np.ndarray, centre: float, sd: float, width: float = 1.0) -> np.ndarray:
    """A Gaussian of unit height averaged over boxes."""
    z = (at - centre) / (sd * np.sqrt(2))
    h = width / (2 * sd * np.sqrt(2))
    return sd * np.sqrt(np.pi / 2) * (erf(z + h) - erf(z - h)) / width


def light(scene: object, **kw: object) -> Light:
    return replace(Light(scene, Grid.whole([0], SHAPE), SHAPE, np.array([0.02]), np.array([0.0])), **kw)


def exact(spot: Spot, variance: float, width: tuple[float, float] = (1.0, 1.0)) -> np.ndarray:
    """The spot under a further Gaussian, averaged over pixels."""
    sd = np.sqrt(spot.sd_px**2 + variance)
    height = spot.sd_px**2 / sd**2
    return height * np.outer(boxed(np.arange(SHAPE[0]), spot.y_px, sd, width[1]), boxed(np.arange(SHAPE[1]), spot.x_px, sd, width[0]))


@pytest.mark.parametrize("variance", [0.0, 0.3, 2.0])
@pytest.mark.parametrize("aperture", [(1.0, 1.0), (0.4, 0.9)])
def test_gaussian_spread_and_aperture(variance: float, aperture: tuple[float, float]) -> None:
    got = light(Spot(), blur_px2=variance, aperture_px=aperture, sensitivity=0.9999999).photons()[0]
    assert np.allclose(got, exact(Spot(), variance, aperture), atol=2e-6)


def gaussian_kernel(sd_px: float) -> np.ndarray:
    half = int(np.ceil(5 * sd_px * FINE))
    at = np.arange(-half, half + 1) / FINE
    return np.exp(-(at[:, None] ** 2 + at**2) / (2 * sd_px**2))


@pytest.mark.parametrize("aperture", [(1.0, 1.0), (0.5, 1.0), (0.4, 0.7)])
def test_a_tabulated_spread_equals_the_closed_form(aperture: tuple[float, float]) -> None:
    """Within 1e-4 of the peak, for a spread of 0.6 px on a raster of 0.25 px."""
    got = light(Spot(sd_px=0.8), aperture_px=aperture).convolved(gaussian_kernel(0.6)).photons()[0]
    assert np.abs(got - exact(Spot(sd_px=0.8), 0.36, aperture)).max() < 1e-4


def test_a_one_sided_spread_goes_to_the_right_side() -> None:
    kernel = np.zeros((3, 2 * FINE + 1))
    kernel[1, -1] = 1.0  # all the light goes one pixel to the right
    there, back = (light(Spot(sd_px=0.8)), light(Spot(sd_px=0.8, x_px=12.3)))
    assert np.abs(there.convolved(kernel).photons() - back.photons()).max() < 1e-4
    assert np.abs(there.spread(np.array([1.0]), np.array([0.0]), np.array([1.0])).photons() - back.photons()).max() < 1e-6
    kernel = np.zeros((2 * FINE + 1, 1))
    kernel[-1] = 1.0  # one pixel down
    assert np.abs(there.convolved(kernel).photons() - light(Spot(sd_px=0.8, y_px=10.6)).photons()).max() < 1e-4


@pytest.mark.parametrize(("height", "width"), [(1, 1), (3, 5), (4, 4), (33, 35)])
@pytest.mark.parametrize("step", [1, 3, FINE])
def test_decimation_is_the_sum_under_the_mask_at_every_step(height: int, width: int, step: int) -> None:
    rng = np.random.default_rng(height + step)
    rows, cols = 6, 7
    fine, mask = rng.normal(size=(2, (rows - 1) * step + height, (cols - 1) * step + width)), rng.normal(size=(height, width))
    places = np.lib.stride_tricks.sliding_window_view(fine, mask.shape, axis=(1, 2))[:, ::step, ::step]
    assert np.allclose(decimate(fine, mask, step, rows, cols), (places * mask).sum(axis=(3, 4)), rtol=0, atol=1e-12)


def test_dots_are_the_mean_of_shifted_images_and_compose() -> None:
    half = np.full(2, 0.5)
    two = light(Spot()).spread(np.array([-0.5, 0.5]), np.zeros(2), half).spread(np.zeros(2), np.array([-0.3, 0.3]), half)
    expected = np.mean([exact(Spot(x_px=11.3 + a, y_px=9.6 + b), 0.0) for a in (-0.5, 0.5) for b in (-0.3, 0.3)], axis=0)
    assert np.allclose(two.photons()[0], expected, atol=1e-6)


def test_a_spread_that_varies_over_the_sensor() -> None:
    """Gauss–Hermite with three nodes: exact to the fifth moment; the sixth of 0.1 px² on a spot of 1.2 px is 4e-5 of the peak."""
    got = light(Spot()).blurred_by_place(lambda x, y: np.full(x.shape, 0.1)).photons()[0]
    assert np.allclose(got, exact(Spot(), 0.1), atol=6e-5)


def test_coordinate_maps_are_taken_in_the_order_of_the_light() -> None:
    """First stretched about 0, then moved: a pixel looks at (x − 2)/1.5; the other order gives x/1.5 − 2."""
    stretched = light(Spot()).moved(lambda x, y: (x / 1.5, y / 1.5)).moved(lambda x, y: (x - 2.0, y))
    x, y = stretched.pulled(np.array([[[5.0]]]), np.array([[[3.0]]]))
    assert x.item() == pytest.approx(2.0) and y.item() == pytest.approx(2.0)
    fine = np.arange(-0.5 + 1 / 32, 0.5, 1 / 16)
    rows, cols = (np.arange(n)[:, None] + fine for n in SHAPE)
    brute = np.exp(-(((rows / 1.5 - 9.6) ** 2)[:, :, None, None] + ((cols - 2) / 1.5 - 11.3) ** 2) / (2 * 1.2**2)).mean(axis=(1, 3))
    assert np.abs(stretched.photons()[0] - brute).max() < 2e-4


def test_placed_is_the_inverse_of_pulled() -> None:
    bent = light(Spot()).moved(lambda x, y: (x + 1e-3 * (x - 12) ** 2, y + 2e-3 * (x - 12) * (y - 10)))
    x, y = np.array([[[2.0], [11.3], [23.0]]]), np.array([[[1.0], [9.6], [19.0]]])
    u, v = bent.placed(x, y)
    back = bent.pulled(u, v)
    assert np.allclose(back[0], x, atol=1e-9) and np.allclose(back[1], y, atol=1e-9)
    assert np.isnan(light(Spot()).moved(lambda x, y: (x**2, y)).placed(np.array([[[-1.0]]]), np.array([[[0.0]]]))[0]).all()


def test_moments_see_the_scene_at_their_times() -> None:
    run = Spot(speed_px_per_s=100.0)
    times = np.zeros((1, SHAPE[0], 2))
    times[0, :, 0], times[0, 1::2, 0], times[0, :, 1] = 0.0, 0.02, 0.01
    weights = np.broadcast_to(np.array([0.75, 0.25]), times.shape)
    got = light(run, moments_s=times, weights=weights).photons()[0]
    first = np.where((np.arange(SHAPE[0]) % 2 == 1)[:, None], exact(Spot(x_px=13.3), 0), exact(Spot(), 0))
    assert np.allclose(got, 0.75 * first + 0.25 * exact(Spot(x_px=12.3), 0), atol=1e-6)
    tabulated = light(run, moments_s=times, weights=weights).convolved(gaussian_kernel(0.3)).photons()[0]
    first = np.where((np.arange(SHAPE[0]) % 2 == 1)[:, None], exact(Spot(x_px=13.3), 0.09), exact(Spot(), 0.09))
    assert np.abs(tabulated - (0.75 * first + 0.25 * exact(Spot(x_px=12.3), 0.09))).max() < 1e-3


class Bend(Parameters):
    """Of a test source."""


def _bend(params: Bend, signal: object, stream: object) -> object:
    shift = 0.01 * signal.grid.frame[:, None, None]
    bent = signal.light.moved(lambda x, y: (x * 1.001 + shift, y)).blurred_by_place(lambda x, y: 0.01 + 1e-4 * x)
    return signal.with_light(bent.convolved(gaussian_kernel(0.4)))


BEND = make_source("optics.bend", _bend, (Kind.LIGHT,), parameters=Bend)


def test_windows_threads_and_frames_of_a_bent_camera_are_the_same_bits() -> None:
    camera = Camera("bent", SHAPE, (Element(NAME, BEND, Bend()),))
    for scene in (Spot(), Texture()):
        whole = camera.expose(scene, 3).data
        for r, c, h, w in ((0, 0, 5, 7), (11, 3, 9, 20), (19, 23, 1, 1)):
            assert np.array_equal(camera.expose(scene, 3, window=(r, c, h, w)).data, whole[:, r : r + h, c : c + w])
        assert np.array_equal(camera.expose(scene, 3, threads=1).data, whole)
        assert np.array_equal(camera.expose(scene, [2]).data[0], whole[2])
        grid = Grid(np.array([2, 0]), np.array([3, 0]), np.array([4, 17]), (6, 6))
        batch = camera.expose_windows(scene, grid)
        assert np.array_equal(batch[0], whole[2, 3:9, 4:10]) and np.array_equal(batch[1], whole[0, 0:6, 17:23])


def _turn(params: Bend, signal: object, stream: object) -> object:
    angle = 0.004 * signal.grid.frame[:, None, None]
    cos, sin = np.cos(angle), np.sin(angle)
    return signal.with_light(signal.light.moved(lambda x, y: (x * cos + y * sin, y * cos - x * sin)))


def test_windows_of_one_batch_do_not_know_of_each_other() -> None:
    """Frame by frame the image is turned more: into how many parts a pixel is cut for it must not follow the frame turned most."""
    camera = Camera("turning", SHAPE, (Element(NAME, make_source("optics.turn", _turn, (Kind.LIGHT,), parameters=Bend), Bend()),))
    scene = Picture([Shapes.of([line(14.0, 12.0, 20.0, 3.0, 10.0, 4000.0)])], Uniform(1000.0))
    grid = Grid(np.array([0, 1, 2, 4]), np.array([4, 4, 5, 6]), np.array([5, 5, 6, 7]), (9, 9))
    batch = camera.expose_windows(scene, grid)
    for seen, frame, r, c in zip(batch, grid.frame, grid.row0, grid.col0, strict=True):
        assert np.array_equal(seen, camera.expose(scene, [int(frame)]).data[0, r : r + 9, c : c + 9])


def test_a_scene_that_stands_still_is_rendered_once() -> None:
    asked = []

    @dataclass(frozen=True)
    class Counted(Spot):
        def radiance(self, at: Points) -> np.ndarray:
            asked.append(at.x_px.size)
            return super().radiance(at)

    still = make_source("optics.still", lambda p, s, _: s.with_light(s.light.blurred(0.1)), (Kind.LIGHT,), parameters=Bend)
    camera = Camera("still", SHAPE, (Element(NAME, still, Bend()),))
    first = camera.expose(Counted(), 1, threads=1).data
    once = len(asked)
    frames = camera.expose(Counted(), 5, threads=1).data
    assert len(asked) == 2 * once
    assert all(np.array_equal(f, first[0]) for f in frames)


def test_pixels_that_move_from_frame_to_frame_are_not_rendered_once() -> None:
    def forward(params: Bend, signal: Signal, stream: object) -> Signal:
        shift = np.broadcast_to(0.1 * signal.grid.frame[:, None, None], signal.grid.size)
        return signal.with_light(signal.light.jittered(shift, 0 * shift))

    camera = Camera("shaken", SHAPE, (Element(NAME, make_source("optics.shaken", forward, (Kind.LIGHT,), parameters=Bend), Bend()),))
    frames = camera.expose(Spot(), 3, threads=1).data
    assert all(np.array_equal(frames[k], camera.expose(Spot(), [k]).data[0]) for k in range(3))
    assert np.abs(frames[2] - frames[0]).max() > 0.05


def test_true_positions_follow_the_geometry() -> None:
    camera = Camera("bent", SHAPE, (Element(NAME, BEND, Bend()),))
    x, y = camera.true_positions([11.3], [9.6], frame=3)
    assert x[0] == pytest.approx((11.3 - 0.03) / 1.001, abs=1e-8) and y[0] == pytest.approx(9.6)
    assert camera.layout([11.3], [9.6], frame=3)[0][0] == 11.3


@pytest.mark.filterwarnings("error")
def test_a_point_that_is_seen_nowhere_has_no_place() -> None:
    """x − 0.01 x² has its greatest value, 25, at 50: what lies beyond is not in the image."""

    def forward(params: Bend, signal: Signal, stream: object) -> Signal:
        return signal.with_light(signal.light.moved(lambda x, y: (x - 0.01 * x**2, y)))

    fold = make_source("optics.fold", forward, (Kind.LIGHT,), parameters=Bend)
    camera = Camera("folded", SHAPE, (Element(NAME, fold, Bend()),))
    x, y = camera.true_positions([24.0, 26.0, 9.0], [3.0, 4.0, 5.0])
    assert x[[0, 2]] == pytest.approx([40.0, 10.0]) and np.isnan(x[1]) and y[0] == pytest.approx(3.0)
    assert np.isnan(camera.true_positions([26.0], [4.0])[0]).all()


def test_light_sources_stand_before_the_pixels_and_need_a_scene_with_radiance() -> None:
    to_electrons = IDEAL[Kind.PHOTONS]
    with pytest.raises(ChainError, match="takes light and gets electrons"):
        Camera("wrong", SHAPE, (Element("e", to_electrons, to_electrons.typical), Element(NAME, BEND, Bend())))

    class Numbers:
        def photons(self, grid: Grid, *_: object) -> np.ndarray:
            return np.zeros(grid.size, np.float32)

    with pytest.raises(InputError, match="cannot be imaged through optics"):
        Camera("bent", SHAPE, (Element(NAME, BEND, Bend()),)).expose(Numbers())
    with pytest.raises(InputError, match="odd sides"):
        light(Spot()).convolved(np.ones((2, 3)))
