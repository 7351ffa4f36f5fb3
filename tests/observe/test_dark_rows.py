"""Hum and 1/f noise in the rows of dark frames, simulated here without the package."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from scipy import ndimage, stats

from pixmetry import Frames, assess, campaign_of_arrays
from pixmetry.assess.job import measure_sources, observe_campaign
from pixmetry.camera.dark_rows import DarkRows
from pixmetry.camera.observations import Observations, PatternList
from pixmetry.core.number import Estimates
from pixmetry.core.progress import no_progress
from pixmetry.observe.dark_rows import without_hum

SHAPE, GAIN, READ_E, BLACK = (128, 160), 0.4, 10.0, 60.0
LINE_PX, LINE_US = 192.0, 24.0  # 8 MHz
ALPHA = 1e-6


def one_over_f(rng: np.random.Generator, rms: float, corner: float, shape: tuple[int, int]) -> np.ndarray:
    """A frame read out of one long record with the density 1/f up to a corner, and less beyond."""
    size = int(LINE_PX) * shape[0]
    f = np.fft.rfftfreq(size)
    density = 1 / np.maximum(f, 1 / size) / (1 + (f / corner) ** 4)
    density[0] = 0.0
    record = np.fft.irfft((rng.standard_normal((2, f.size)) * np.sqrt(density)).T @ np.array([1, 1j]), size)
    scale = np.sqrt(2 * density.sum() / size**2 * 2)
    return rms * (record / scale).reshape(shape[0], int(LINE_PX))[:, : shape[1]]


def frames_of(
    rng: np.random.Generator,
    count: int,
    electrons: float = 0.0,
    *,
    hum_dn: float = 0.0,
    hertz: float = 1000.0,
    fields: bool = False,
    flicker_dn: float = 0.0,
    row_dn: float = 0.0,
    period_s: float | None = None,
) -> np.ndarray:
    """Frames in which hum, 1/f noise and noise of rows come with the read-out; ``fields``: even rows are read first, then odd ones.

    The phase of the hum is new in every frame, or goes on where the frames come with a ``period_s``.
    """
    row, col = np.mgrid[: SHAPE[0], : SHAPE[1]]
    line = row // 2 + 312.5 * (row % 2) if fields else row
    time_s = (line * LINE_US + col * LINE_US / LINE_PX) * 1e-6
    out = []
    for k in range(count):
        dn = GAIN * (rng.poisson(electrons, SHAPE) + READ_E * rng.standard_normal(SHAPE)) + BLACK
        phase = rng.uniform() if period_s is None else 0.3 + hertz * period_s * k
        dn = dn + row_dn * rng.standard_normal((SHAPE[0], 1)) + hum_dn * np.sin(2 * np.pi * (hertz * time_s + phase))
        out.append(dn + (one_over_f(rng, flicker_dn, 0.1, SHAPE) if flicker_dn else 0.0))
    return np.rint(np.clip(out, 0, 4095)).astype(np.uint16)


def seen_of(rng: np.random.Generator, *, facts: dict | None = None, stack: int = 24, **kw) -> Observations:
    groups = [Frames("dark", 0.01, frames_of(rng, stack, **kw), role="stack")]
    groups += [Frames("bright" if e else "dark", 1e-3 * k, frames_of(rng, 2, e * k, **kw)) for k in range(1, 9) for e in (0.0, 800.0)]
    stated = {"line_time_us": LINE_US, "pixel_clock_mhz": LINE_PX / LINE_US} if facts is None else facts
    return observe_campaign(campaign_of_arrays(groups, bits=12, **stated), no_progress)[1]


def test_hum_is_found_within_its_u_and_taken_off_the_noise_of_the_rows(rng: np.random.Generator):
    """6 cameras with noise of rows; χ² of amplitude and frequency, 1e-6 on either side, and row noise within six u."""
    z = []
    for _ in range(6):
        hum, hertz = rng.uniform(0.8, 3.0), rng.uniform(2000, 17000)
        told, _ = measure_sources(seen_of(rng, hum_dn=hum, hertz=hertz, row_dn=1.0))
        found, rows = told["electronics.supply_pickup"], told["electronics.row_noise"]["row_e"]
        z += [(found[n].value - truth) / found[n].u for n, truth in (("amplitude_dn", hum), ("frequency_hz", hertz))]
        assert abs(rows.value - 1.0 / GAIN) < 6 * rows.u if not rows.is_limit else rows.value > 0.9 / GAIN
        assert "grabber.phase_pattern" not in told or told["grabber.phase_pattern"].limits
    assert stats.chi2.ppf(ALPHA / 2, len(z)) < np.sum(np.square(z)) < stats.chi2.isf(ALPHA / 2, len(z)) * 1.6


def test_a_hum_above_half_the_line_rate_is_unfolded_by_its_turn_along_the_row(rng: np.random.Generator):
    """45 kHz at 41.7 kHz lines: 0.9 of a turn in a row. Without the pixel clock the lowest frequency is told, and says so."""
    told, _ = measure_sources(seen_of(rng, hum_dn=6.0, hertz=32000.0))
    found = told["electronics.supply_pickup"]["frequency_hz"]
    assert abs(found.value - 32000.0) < 6 * found.u and "turns" in found.reason
    told, _ = measure_sources(seen_of(rng, hum_dn=6.0, hertz=32000.0, facts={"line_time_us": LINE_US}))
    found = told["electronics.supply_pickup"]["frequency_hz"]
    assert abs(found.value - (1e6 / LINE_US - 32000.0)) < 6 * found.u and "look the same" in found.reason


def test_a_hum_is_no_white_noise_within_the_rows(rng: np.random.Generator):
    """15 kHz turn by 0.3 within a row of 20 µs: a quarter of the hum's variance is about the means of the rows."""
    seen = seen_of(rng, hum_dn=3.0, hertz=15000.0)
    square, u = seen.dark_rows.taken["pixel"]
    assert abs(square - 3.0**2 / 2 * (1 - np.sinc(15000.0 * SHAPE[1] / 8e6) ** 2)) < 6 * u < 0.5
    white = measure_sources(seen)[0]["electronics.amplifier_noise"]["white_e"]
    assert abs(white.value - READ_E) < 6 * white.u


def test_mains_of_a_fraction_of_a_cycle_a_frame_are_found_where_frames_follow_each_other(rng: np.random.Generator):
    """107 Hz over frames of 3 ms, 40 ms apart, beside 1/f noise or not."""
    for flicker in (0.0, 0.7):
        seen = seen_of(rng, hum_dn=3.0, hertz=107.0, period_s=0.0401, flicker_dn=flicker, stack=32)
        found = measure_sources(seen)[0]["electronics.supply_pickup"]
        assert abs(found["frequency_hz"].value - 107.0) < 6 * found["frequency_hz"].u
        assert abs(found["amplitude_dn"].value - 3.0) < 6 * found["amplitude_dn"].u


def test_hum_in_two_fields_and_without_clocks(rng: np.random.Generator):
    facts = {"line_time_us": LINE_US, "interface": "analogue", "pixel_clock_mhz": 8.0}
    found = measure_sources(seen_of(rng, hum_dn=2.0, hertz=5300.0, fields=True, facts=facts))[0]["electronics.supply_pickup"]
    assert found.settings["scan"] == "interlaced" and abs(found["frequency_hz"].value - 5300.0) < 6 * found["frequency_hz"].u
    assert "line_time_us" in measure_sources(seen_of(rng, hum_dn=2.0, hertz=5300.0, facts={}))[1]["electronics.supply_pickup"]


def test_one_over_f_noise_is_found_and_taken_off_white_and_row_noise(rng: np.random.Generator):
    """Its u is 2 % here; the law beyond the corner is another than the source's, which is worth some per cent: 12 % in all."""
    told, _ = measure_sources(seen_of(rng, flicker_dn=3.0, stack=32))
    found = told["electronics.flicker_noise"]
    assert found["rms_e"].value * GAIN == pytest.approx(3.0, rel=0.12) and found["corner_rel"].value == pytest.approx(0.1, rel=0.5)
    assert told["electronics.amplifier_noise"]["white_e"].value == pytest.approx(READ_E, rel=0.03)
    rows = told["electronics.row_noise"]["row_e"]
    assert rows.value * GAIN < 1.2  # 2.7 DN are in the means of the rows
    assert abs(told["electronics.gain"]["gain_dn_per_e"].value / GAIN - 1) < 0.02
    assert "line_px" not in found.reasons
    unclocked = measure_sources(seen_of(rng, flicker_dn=3.0, stack=8, facts={}))[0]["electronics.flicker_noise"]
    assert "state camera.line_time_us" in unclocked.reasons["line_px"]
    # lines may be up to twice as long as their pixels
    assert abs(unclocked["line_px"].value - LINE_US * 8.0) < 3**0.5 * unclocked["line_px"].u


def test_without_hum_and_one_over_f_there_are_limits(rng: np.random.Generator):
    """8 cameras, half of them with noise of the rows: a false hum happens once in 10⁴."""
    for k in range(8):
        told, refused = measure_sources(seen_of(rng, row_dn=1.0 * (k % 2), stack=16))
        assert "no hum is found" in refused["electronics.supply_pickup"]
        assert told["electronics.flicker_noise"].limits == {"rms_e"}
        assert told["electronics.flicker_noise"]["rms_e"].value * GAIN < 1.0


@pytest.mark.parametrize("wave_dn", [0.0, 0.4])
def test_one_over_f_noise_behind_a_filter_along_the_row_makes_no_waves(rng: np.random.Generator, wave_dn: float):
    """Thirty were found in such frames; a wave that is there is found still, at 100 times the power of its column.

    Of the thirty the greatest is at 7.4 ± 0.7 of the 12 that count (one beyond it: 1e-4, two: 1e-8). One in eight was beyond it where a
    place between two columns was held against the noise of the farther one.
    """
    row, col = np.mgrid[: SHAPE[0], : SHAPE[1]]

    def filtered(count: int, electrons: float) -> np.ndarray:
        made = frames_of(rng, count, electrons, flicker_dn=3.0).astype(float)
        made = ndimage.convolve1d(made, [0.25, 0.5, 0.25], axis=2, mode="nearest")
        phase = rng.uniform(0, 2 * np.pi, (count, 1, 1))
        return np.rint(made + wave_dn * np.sin(2 * np.pi * (0.11 * col + 0.07 * row) + phase)).astype(np.uint16)

    groups = [Frames("dark", 0.01, filtered(24, 0.0), role="stack")]
    groups += [Frames("bright" if e else "dark", 1e-3 * k, filtered(2, e * k)) for k in range(1, 9) for e in (0.0, 800.0)]
    seen = observe_campaign(campaign_of_arrays(groups, bits=12, line_time_us=LINE_US, pixel_clock_mhz=8.0), no_progress)[1]
    found = seen.patterns
    assert found is not None and "filter along the row" in seen.dark_rows.flicker.reasons["rms_dn"]
    own = np.hypot(found.frequency_x - 0.11, found.frequency_y - 0.07) < 2e-3
    assert own.any() == bool(wave_dn) and (~own).sum() <= 1


def test_a_wave_between_two_columns_of_the_spectrum_is_held_against_both():
    """At 1.51 columns, where 1/f noise falls by half from the first to the second: 14 of the second are 7 of the first."""
    power = np.array([9.0, 2.0, 1.0, 0.7])
    untold = replace(Estimates.empty(), reasons={"rms_dn": "the frames are filtered (along the row)"})
    rows = DarkRows(8, 64, 6, *[np.zeros(1)] * 3, Estimates.empty(), untold, 6.0, 0.0, {})
    spectra = SimpleNamespace(frequency_h=np.arange(4) / 6, temporal_h_dn2=power)
    for times, place, kept in ((14.0, 1.51, 0), (26.0, 1.51, 1), (26.0, 0.7, 1)):
        amplitude = np.array([np.sqrt(4 * times / 64 / 6)])
        one = np.array([place / 6])
        waves = PatternList(np.array([True]), one, one, 0 * one, 0 * one, amplitude, 0 * one, 1e-6, 1, 0.0, 0.0)
        assert len(without_hum(waves, rows, spectra)) == kept


@pytest.mark.parametrize("still", [True, False])
def test_frames_that_are_all_the_same_tell_neither_hum_nor_noise_of_rows(rng: np.random.Generator, still: bool):
    """A read-out below rounding; and one frame whose rows differ by a code now and then."""
    data = np.full((16, *SHAPE), 60, np.uint16)
    if not still:
        data[3, 40, 7:9] += 1
    groups = [Frames("dark", 0.01, data, role="stack")]
    groups += [Frames("bright" if e else "dark", 1e-3 * k, frames_of(rng, 2, e * k)) for k in range(1, 9) for e in (0.0, 800.0)]
    with np.errstate(all="raise", under="ignore"):
        seen = observe_campaign(campaign_of_arrays(groups, bits=12, line_time_us=LINE_US, pixel_clock_mhz=8.0), no_progress)[1]
    assert seen.dark_rows is not None
    assert "rms_dn" not in seen.dark_rows.flicker or seen.dark_rows.flicker.limits
    if still:
        assert "all the same" in seen.dark_rows.flicker.reasons["rms_dn"]
    assert "per_row" not in seen.dark_rows.hum


def test_page_and_results_have_them(rng: np.random.Generator, tmp_path: Path):
    hum = {"hum_dn": 2.0, "hertz": 4000.0}
    groups = [Frames("dark", 0.01, frames_of(rng, 16, **hum), role="stack")]
    groups += [
        Frames("bright" if e else "dark", 1e-3 * k, frames_of(rng, 2, e * k, **hum))
        for k in range(1, 9)
        for e in (0.0, 800.0)
    ]
    campaign = campaign_of_arrays(groups, bits=12, name="humming", line_time_us=LINE_US, pixel_clock_mhz=8.0)
    found = assess(campaign, tmp_path / "result", trials=0)
    assert "A hum of" in (tmp_path / "result" / "report.html").read_text()
    assert found.to_record()["dark_rows"]["hum"]["names"][0] == "amplitude_dn"
    assert found.camera["electronics.supply_pickup"].params.frequency_hz == pytest.approx(4000.0, rel=0.02)


def test_row_noise_behind_a_filter_along_the_row_is_without_what_changes_slowly(rng: np.random.Generator) -> None:
    """1/f noise of 3 DN beside row noise of 2 DN: it would make 3 DN of it."""

    def filtered(count: int, electrons: float) -> np.ndarray:
        frames = frames_of(rng, count, electrons, flicker_dn=3.0, row_dn=2.0).astype(float)
        return np.rint(ndimage.convolve1d(frames, [0.15, 0.7, 0.15], axis=2, mode="nearest")).astype(np.uint16)

    groups = [Frames("dark", 0.01, filtered(16, 0.0), role="stack")]
    groups += [Frames("bright" if e else "dark", 1e-3 * k, filtered(2, e * k)) for k in range(1, 9) for e in (0.0, 800.0)]
    seen = observe_campaign(campaign_of_arrays(groups, bits=12, line_time_us=LINE_US, pixel_clock_mhz=8.0), no_progress)[1]
    found = measure_sources(seen)[0]["electronics.row_noise"]["row_e"]
    assert "changes slowly" in found.reason
    assert abs(found.value - 2.0 / GAIN) < 5 * found.u and found.u < 0.35 * 2.0 / GAIN
