"""Samples of another clock: published numbers, and a wave that is seen at its alias."""

from __future__ import annotations

import numpy as np
import pytest

from catalogue.support import camera_with
from pixmetry.sources.grabber.sampling_clock import SOURCE, SamplingClock
from video_signals import PIXEL_HZ, bump, centre, row_of, sampled, seen, video

EPIX = SamplingClock(clock_mhz=10.0, samples=512)


def test_published_ratio_of_the_clocks() -> None:
    assert PIXEL_HZ / 10e6 == 1.41875
    for params, pixels in ((EPIX, 726.4), (SamplingClock(samples=752), 752.0)):
        line = SOURCE.forward(params, video(row_of(np.zeros(752))), None).line
        assert np.diff(line.pixels(np.array([-0.5, line.samples - 0.5]))) == pytest.approx(pixels)


def test_the_pixel_clock_shows_at_its_alias(rng: np.random.Generator) -> None:
    """Alternating columns have half the pixel clock's frequency: 0.5 × 1.41875 cycles a sample, seen at 1 − 0.709375."""
    row = 100 + 50 * (-1.0) ** np.arange(752)
    got = seen(rng, SOURCE, EPIX, row_of(row))[0, 0]
    assert got.shape == (512,)
    power = np.abs(np.fft.rfft((got - got.mean()) * np.hanning(512))) ** 2
    assert power[1:].argmax() + 1 == pytest.approx(512 * (1 - 0.709375), abs=1)


@pytest.mark.parametrize("start_ns", [0.0, 700.0, -300.0])
def test_targets_lie_where_the_geometry_says(start_ns: float) -> None:
    params = SamplingClock(clock_mhz=10.0, start_ns=start_ns, samples=512)
    camera = camera_with(SOURCE, params, shape=(4, 752))
    expected = camera.true_positions([150.0], [2.0])[0][0]
    assert expected == pytest.approx((150.5 / PIXEL_HZ - start_ns * 1e-9) * 10e6 - 0.5)
    before = video(row_of(bump(150.0, 752, 4.0)), smooth=True)
    late = before.line.delay_s * 10e6
    assert centre(sampled(SOURCE.forward(params, before, None)))[0, 0] - late == pytest.approx(expected, abs=1e-3)
    assert camera.output_shape == (4, 512)


def test_what_is_sampled_beyond_the_line_is_black(rng: np.random.Generator) -> None:
    got = seen(rng, SOURCE, SamplingClock(clock_mhz=10.0, start_ns=-500.0, samples=60), row_of(np.full(64, 80.0)))[0, 0]
    inside = np.arange(60)
    t = (inside + 0.5) / 10e6 - 500e-9
    np.testing.assert_array_equal(got, np.where((t >= 0) & (t * PIXEL_HZ < 64), 80.0, 0.0))
