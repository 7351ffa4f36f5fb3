"""A field without targets: places of its texture, against a random field moved by the phases of its spectrum."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from PIL import Image
from scipy import stats

from pixmetry import series
from pixmetry.cli import main
from pixmetry.core.errors import InputError, MeasureError
from pixmetry.files.images import write_frame
from pixmetry.series.job import measure_series
from pixmetry.series.texture import texture_of

SHAPE = (180, 260)
NOISE_DN = 2.0


class Field:
    """A random field, band limited, so that a shift by phases is exact; the frame wraps around."""

    def __init__(self, rng: np.random.Generator, blur_px: float = 1.5, amplitude_dn: float = 30.0) -> None:
        fy, fx = np.fft.fftfreq(SHAPE[0])[:, None], np.fft.rfftfreq(SHAPE[1])[None]
        spectrum = np.fft.rfft2(rng.normal(0, 1, SHAPE)) * np.exp(-2 * np.pi**2 * blur_px**2 * (fx**2 + fy**2))
        self.spectrum = amplitude_dn * spectrum / np.std(np.fft.irfft2(spectrum, SHAPE))
        self.rng, self.fx, self.fy = rng, fx, fy

    def moved(self, x: float, y: float) -> np.ndarray:
        """A frame of 8 bits."""
        turned = np.fft.irfft2(self.spectrum * np.exp(-2j * np.pi * (self.fx * x + self.fy * y)), SHAPE)
        return np.clip(np.rint(100 + turned + self.rng.normal(0, NOISE_DN, SHAPE)), 0, 255).astype(np.uint8)


def test_places_are_found_with_their_uncertainty(rng: np.random.Generator) -> None:
    field, frames = Field(rng), 12
    texture = texture_of(field.moved(0, 0))
    known = texture.centres[:, ::-1]
    errors = np.full((frames, len(known), 2), np.nan)
    u = errors.copy()
    for k, step in enumerate(rng.uniform(-9, 9, (frames, 2))):
        found = texture.find(field.moved(*step), "f", 0.0)
        which = np.linalg.norm(found.positions_px[:, None] - step - known, axis=2).argmin(axis=1)
        errors[k, which] = found.positions_px - known[which] - step
        u[k, which] = np.sqrt(np.diagonal(found.covariance_px2, axis1=1, axis2=2))
    assert np.isfinite(errors).mean() > 0.8 and np.nanmax(np.abs(errors)) < 0.1
    scores = (errors - np.nanmean(errors, axis=0)) / u  # the noise of the first frame moves a place alike in all others
    square = np.nansum(scores**2) / (np.isfinite(scores).sum() - 2 * len(known))
    assert 0.7 < square < 1.6  # interpolation adds a little; a factor of 2 in the variance fails


def test_the_motion_of_a_scene_is_measured(rng: np.random.Generator, tmp_path: Path) -> None:
    field, time_s = Field(rng), np.arange(24) * 120.0
    settled = 1 - np.exp(-time_s / 600.0)
    for k, share in enumerate(settled):
        write_frame(tmp_path / f"{k:02d}.png", field.moved(0.6 * share, -0.3 * share), 8)
    found = series(tmp_path, tmp_path / "out", interval_s=120.0)
    for name, truth in (("shift_x_px", 0.6), ("shift_y_px", -0.3)):
        assert abs(found.drift.fit[name].value - truth) < stats.norm.isf(1e-6) * found.drift.fit[name].u < 0.1
    assert any("texture" in note for note in found.notes)
    log = (tmp_path / "out.frames.jsonl").read_bytes()
    (tmp_path / "out.frames.jsonl").write_bytes(b"".join(log.splitlines(keepends=True)[:14]))
    again = series(tmp_path, tmp_path / "out", interval_s=120.0)  # goes on with the same places
    np.testing.assert_allclose(again.drift.values, found.drift.values, atol=1e-12)
    for number in ("0a", "0b"):  # and without the frame that chose the places: another one does, and no place of the log is taken
        write_frame(tmp_path / f"{number}.png", field.moved(0, 0), 8)
    (tmp_path / "00.png").rename(tmp_path / "0c.png")
    longer, alone = (series(tmp_path, tmp_path / name, interval_s=120.0) for name in ("out", "c"))
    np.testing.assert_allclose(longer.drift.values, alone.drift.values, atol=1e-12)
    done = CliRunner().invoke(main, ["series", str(tmp_path), "-o", str(tmp_path / "b"), "--interval", "120", "--kind", "texture"])
    assert done.exit_code == 0 and "places of the texture" not in done.output, done.output


def test_what_hides_a_place_is_not_taken_for_motion(rng: np.random.Generator) -> None:
    field = Field(rng)
    texture = texture_of(field.moved(0, 0))
    frame = field.moved(0.3, 0.2)
    frame[:, :130] = rng.integers(0, 255, (SHAPE[0], 130))
    found = texture.find(frame, "f", 0.0)
    left = found.positions_px[:, 0] < 110
    assert not left.any() and len(found.positions_px) >= 6


def test_a_channel_of_colour_frames_is_followed(rng: np.random.Generator, tmp_path: Path) -> None:
    field = Field(rng)
    for k in range(12):
        grey = field.moved(0.02 * k, 0.0)
        Image.fromarray(np.stack([grey // 2, grey, grey // 3], axis=-1)).save(tmp_path / f"{k:02d}.png")
    with pytest.raises(InputError, match="--channel green"):
        series(tmp_path, interval_s=60.0)
    moved = series(tmp_path, interval_s=60.0, channel="green").drift.values[:, 0]
    np.testing.assert_allclose(moved - moved[0], 0.02 * np.arange(12), atol=0.02)


def test_nothing_to_follow_is_refused(rng: np.random.Generator) -> None:
    flat = [(str(k), float(k), lambda: rng.normal(100, 2, SHAPE).astype(np.uint8)) for k in range(20)]
    with pytest.raises(MeasureError, match="no targets are found, and 0 places"):
        measure_series(flat)
