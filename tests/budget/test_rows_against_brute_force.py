"""Each source of the catalogue: its row in the budget against brute force, in the whole chain of a camera that can have it.

A new source is here on the day it is written. Sources of the video line, and all behind it, stand in an analogue camera, each at a pixel
clock of its own in turn; the others in digital ones, with frames of 0.3 to 20 Mpx in turn. ``benchmarks/study_budget_rows.py`` does every
source in every preset at every clock and size, with more targets.

A false failure in 1e-6 of the comparisons: 5.5 standard errors of 32 to 192 targets (the scatter between 16 units is taken as 1.5 times
as large, for Student's t). With 192 targets a standard deviation that is wrong by a third beyond its declared error is seen, with 64 one
that is wrong by a factor of two; means over the places, as those of filters and cables, to some thousandths of a pixel.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from zlib import crc32

import pytest

from budget.brute_force import CLOCKS_MHZ, SHAPES, BruteForce, camera_at, element_of, table_at, verdict_of
from chance import rng_of
from pixmetry.budget.motion import OF_MOTION
from pixmetry.budget.parameters import applies
from pixmetry.budget.scenario import read_scenario
from pixmetry.budget.setting import Setting
from pixmetry.budget.table import Table
from pixmetry.camera.camera import load_camera
from pixmetry.camera.catalogue import sources
from pixmetry.camera.signal import Kind
from pixmetry.camera.source import Source
from pixmetry.locate.target_estimator import TargetEstimator

SIGMAS = 5.5
DIGITAL = ("imx264_like", "ft_ccd_generic", "dcs420_like", "cid_generic", "cmos_log_fuga15")  # the first that can have a source
ANALOGUE = "pulnix_tm6cn_epix_512"
SMALL = (240, 320)  # frames of cameras of which a window needs whole rows and columns
SMALLEST = (96, 128)  # for sources that have to see all of a frame, frame after frame
LOST = ("sensor.log_response",)  # at its bound no target is found
FIELD = ("sony_xc8500_field", 28.4, SMALL)  # single fields, of which each row is two of the sensor's
MOSAIC = ("dcs420_like", None, SMALL)
BRIGHT = {"target": {"peak_rel": 0.95}}  # green pixels are full, on an average below it
BY_OTHERS_IN_CHAIN = (  # rows that hang on another source: on the black level, on the mosaic, on the rows of a field
    ("grabber.adc", "usual", (ANALOGUE, 28.4, SMALL)),
    ("grabber.clamp", "bound", (ANALOGUE, 28.4, SMALL)),
    ("sensor.smear", "bound", MOSAIC),
    ("processing.sharpening", "usual", MOSAIC),
    ("processing.sharpening", "usual", (ANALOGUE, 10.0, SMALL)),
    ("grabber.sampling_clock", "usual", (ANALOGUE, 10.0, SMALL)),
    ("sensor.image_lag", "bound", ("dcs420_like", None, SMALLEST)),
    *(
        (name, size, FIELD)
        for name, size in (
            ("grabber.adc", "usual"),
            ("sensor.smear", "bound"),
            ("sensor.prnu", "bound"),
            ("sensor.pixel_aperture", "bound"),
            ("sensor.bayer_mosaic", "usual"),
            ("electronics.amplifier_noise", "bound"),
            ("electronics.row_noise", "bound"),
            ("grabber.clamp", "bound"),
            ("grabber.line_jitter", "usual"),
        )
    ),
)
SCENARIO = {
    "motion": {"speed_px_per_s": 60, "acceleration_px_per_s2": 100, "direction_deg": 30},
    "object": {"f_mm": 25, "distance_mm": 2000},
    "target": {"view_angle_deg": 30},
}


Cell = tuple[str, float | None, tuple[int, int]]


def cell_of(source: Source) -> Cell:
    """Preset, clock and frame of a source: always the same for one, others for others."""
    turn = crc32(source.id.encode())
    if Kind.VIDEO in source.consumes or source.stage == "storage" or not any(applies(source, load_camera(p).facts) for p in DIGITAL):
        return ANALOGUE, CLOCKS_MHZ[turn % len(CLOCKS_MHZ)], SMALLEST if source.id in OF_MOTION else SMALL
    named = [p for p in DIGITAL if any(e.source.id == source.id for e in load_camera(p).chain)]
    can = [p for p in DIGITAL if applies(source, load_camera(p).facts)]
    preset = (named or can)[0]
    if source.id in OF_MOTION or source.start is not None:
        return preset, None, SMALLEST
    return preset, None, list(SHAPES.values())[turn % len(SHAPES)] if preset == DIGITAL[0] else SMALL


@pytest.fixture(scope="module")
def cell(request: pytest.FixtureRequest) -> Callable[[Cell], tuple[Table, BruteForce]]:
    """One camera for all sources that are tried in it: what each is compared with is exposed once."""
    seed = int(rng_of(request).integers(2**31))

    @cache
    def made(at: Cell) -> tuple[Table, BruteForce]:
        camera = camera_at(*at)
        places = 2 if at[2] == SMALLEST else 4 if at[0] != DIGITAL[0] else 12
        brute = BruteForce(Setting(camera, read_scenario(SCENARIO)), TargetEstimator(), 16, places, seed)
        return table_at(brute), brute

    return made


@pytest.mark.parametrize("source_id", list(sources()))
def test_a_row_is_what_brute_force_shows(cell: Callable[[Cell], tuple[Table, BruteForce]], source_id: str) -> None:
    source = sources()[source_id]
    at = cell_of(source)
    table, brute = cell(at)
    for size in ("usual", "bound") if at[1] is None and at[2] != SMALLEST and source_id not in LOST else ("usual",):
        verdict = verdict_of(table, brute, element_of(table, source_id, size), SIGMAS)
        assert not verdict.wrong, f"{at}, {size}: {verdict.wrong}: {verdict.text}"


@pytest.mark.parametrize(("source_id", "size", "at"), BY_OTHERS_IN_CHAIN, ids=[f"{name}-{at[0]}" for name, _, at in BY_OTHERS_IN_CHAIN])
def test_a_row_holds_what_the_rest_of_the_chain_makes_of_it(
    cell: Callable[[Cell], tuple[Table, BruteForce]], source_id: str, size: str, at: Cell
) -> None:
    """A line that rings at 28 MHz dips below code 0 unless the clamp lifts it; a mosaic makes
    a smear's shift half as large again, pairs of rows that are summed three times as large. Noise of summed rows moves
    a target twice as far in y, and a mosaic of which pairs of rows are summed fifteen times as far.
    """
    table, brute = cell(at)
    verdict = verdict_of(table, brute, element_of(table, source_id, size), SIGMAS)
    assert not verdict.wrong, f"{at}, {size}: {verdict.wrong}: {verdict.text}"


@pytest.mark.parametrize("size", ["usual", "bound"])
def test_pixels_of_one_colour_are_full_first(request: pytest.FixtureRequest, size: str) -> None:
    """Charge of full green pixels spills along the column, 0.007 px at the bound, while a grey target stays below the full well."""
    brute = BruteForce(Setting(camera_at(*MOSAIC), read_scenario(BRIGHT)), TargetEstimator(), 16, 4, int(rng_of(request).integers(2**31)))
    table = table_at(brute)
    verdict = verdict_of(table, brute, element_of(table, "sensor.blooming", size), SIGMAS)
    assert not verdict.wrong, f"{verdict.wrong}: {verdict.text}"
    assert size == "usual" or verdict.said_bias[1] > 0.003
