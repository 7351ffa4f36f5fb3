"""Displaced pixels: a slope turns places into signal, and the raster of a tabulated spread agrees with direct looking."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import stats

from light_scenes import MEAN, Spot, camera, signal_of
from pixmetry.camera.light import Points
from pixmetry.sources.optics.point_spread import SOURCE as LENS
from pixmetry.sources.optics.point_spread import PointSpread
from pixmetry.sources.sensor.pixel_geometry import SOURCE, PixelGeometry
from source_signals import ALPHA, stream


@dataclass(frozen=True)
class Slope:
    """Light that grows by 100 photons per pixel along x and falls by 50 along y."""

    moving = False
    smooth_px = 1.0

    def radiance(self, at: Points) -> np.ndarray:
        return MEAN + 100 * at.x_px - 50 * at.y_px


def test_pixels_see_the_slope_at_their_own_places():
    shape, params = (60, 70), PixelGeometry(pixel_std_px=0.05)
    cam = camera(shape, (SOURCE, params))
    seen = cam.expose(Slope()).data[0].astype(float)
    told = next(iter(cam.truth().values()))
    x, y = np.meshgrid(np.arange(70), np.arange(60))
    expected = MEAN + 100 * (x - told["shift_x_px"]) - 50 * (y - told["shift_y_px"])
    assert np.abs(seen - expected).max() < 2e-3


def test_the_scatter_is_the_parameter(rng: np.random.Generator):
    """4200 pixels: 95 % of a false alarm at 1e-6 lies within 5.3 %; a factor of 1.1 would be seen."""
    told = SOURCE.truth(PixelGeometry(pixel_std_px=0.01), signal_of(SOURCE, PixelGeometry(), (60, 70)), stream(rng))
    for shift in told.values():
        low, high = stats.chi2.ppf([ALPHA / 4, 1 - ALPHA / 4], shift.size) / shift.size
        assert low < np.mean(shift**2) / 1e-4 < high


def test_a_raster_gives_the_same_as_looking_directly():
    """The lens as a table (to first order in the displacement) and as a Gaussian spread."""
    step, sigma = 0.125, 0.6
    line = np.exp(-0.5 * ((np.arange(51) - 25) * step / sigma) ** 2)
    table = tuple(tuple(row) for row in np.outer(line, line))
    spot = Spot(np.array([9.3]), np.array([8.8]), sigma=0.8)
    both = []
    for lens in (PointSpread(sigma_px=np.sqrt(sigma**2 + step**2 / 12)), PointSpread(model="measured", table=table, table_step_px=step)):
        pixels = PixelGeometry(pixel_std_px=0.02)
        with_it, without = (camera((19, 19), (LENS, lens), (SOURCE, p)).expose(spot).data[0] for p in (pixels, PixelGeometry()))
        both.append(with_it.astype(float) - without)
    assert np.abs(both[0]).max() > 5
    assert np.abs(both[1] - both[0]).max() < 0.05 * np.abs(both[0]).max()


def test_fields_move_as_a_whole_and_meet_between_pixels(rng: np.random.Generator):
    params = PixelGeometry(field_std_px=0.3, fields_x=2, fields_y=3)
    told = SOURCE.truth(params, signal_of(SOURCE, params, (30, 40)), stream(rng))["shift_x_px"]
    blocks = told.reshape(3, 10, 2, 20)
    assert np.abs(blocks - blocks[:, :1, :, :1]).max() < 1e-12
    assert len(np.unique(blocks.round(9))) == 6
