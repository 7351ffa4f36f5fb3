"""Positions are as good and as sure as they say, in the quick form of benchmarks/study_location.py.

Images come from `rendered`, which shares nothing with the package. Every test holds for any seed but for one in a million. With the 900
coordinates of a cell (900 z values) it misses half of the biases of .17 u, or of errors of the stated uncertainty by 12 %.
"""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from locate import coverage_cells, line_frames, rendered
from locate.coverage_cells import Case
from pixmetry.locate.detect.targets import Flag
from pixmetry.locate.job import locate

RATE = 1e-6
EXACT = ("template", "poisson_gaussian", "centroid", "squared_centroid", "windowed_centroid")
COVERING = ("soft_threshold", "hard_threshold", "perimeter", "forstner", "ellipse_edges", "gaussian")
TOO_LARGE = ("squared_centroid", "windowed_centroid")  # on discs of a pixel's size: the S-curve of a rougher shape than theirs is in u
LEAST_RADIUS = {"ellipse_edges": 1.5}  # px: below it neighbouring rays see the same few pixels
# Of 450 targets that thresholds and operators do not find again, and say so. None of 16200 was lost, so that the rate is below 2e-4; five
# of 450 are lost once in 10⁶ runs at a rate of 3e-4. Of the others none of 27000 was lost or unsure, and nothing is known that loses them.
MOST_LOST = 4
CELLS = (
    Case(),
    Case(radius=1.0, blur=0.8, read_dn=0.5),
    Case(radius=2.0, blur=0.5, read_dn=4.0),
    Case(radius=12.0, blur=2.0, read_dn=8.0),
    Case(radius=3.0, gain_dn_per_e=0.5, read_dn=0.5),
    Case(radius=3.0, blur=1.0, amplitude=-2500.0, background=2800.0, gain_dn_per_e=0.3, read_dn=1.0, bits=12),
)


@pytest.mark.parametrize("case", CELLS, ids=str)
def test_errors_over_uncertainties_are_standard_normal(case: Case, rng: np.random.Generator):
    outcomes = coverage_cells.collect_all(coverage_cells.make_frame(case, rng, 225), rng, EXACT, draws=2)
    for name, out in outcomes.items():
        assert out.missed == out.false == out.unsure == 0, name
        if case.radius < 1.5 and name in TOO_LARGE:
            assert np.std(out.z) < 1.13, name
        else:
            assert coverage_cells.departures(out.z, RATE / len(EXACT)) == [], name


@pytest.mark.parametrize("case", CELLS[:4], ids=str)
def test_thresholds_and_operators_cover(case: Case, rng: np.random.Generator):
    """Of 900 coordinates, at least as many within 1 u and 2 u as promised; 61 % for 68.3 % and 91 % for 95.4 % would be caught."""
    names = tuple(name for name in COVERING if case.radius >= LEAST_RADIUS.get(name, 0.0))
    for name, out in coverage_cells.collect_all(coverage_cells.make_frame(case, rng, 225), rng, names, draws=2).items():
        assert out.false == 0 and out.missed <= MOST_LOST, name
        assert coverage_cells.under_covered(out.z, RATE / len(COVERING)) == [], name


def test_the_judge_sees_planted_errors(rng: np.random.Generator):
    z = rng.normal(size=900)
    assert coverage_cells.departures(z, RATE) == []
    assert coverage_cells.departures(z + 0.4, RATE) != []
    assert coverage_cells.departures(1.3 * z, RATE) != []
    assert coverage_cells.departures(0.75 * z, RATE) != []
    assert coverage_cells.departures(np.sqrt(2) * np.sin(rng.uniform(0, 2 * np.pi, 3000)), RATE) != []
    assert coverage_cells.under_covered(z, RATE) == [] and coverage_cells.under_covered(0.5 * z, RATE) == []
    assert coverage_cells.under_covered(1.4 * z, RATE) != []


@pytest.mark.parametrize("dark", [False, True])
def test_reference_frame(dark: bool, rng: np.random.Generator):
    """Five hundred discs: all found, none false; the template's error at most 1.05 of the bound, the soft threshold's 1.25.

    The rms of 1000 coordinates is uncertain by 2.2 %, so 1.17 and 1.39 are asked: 11 % more than the goals that the benchmark tests.
    """
    mean, x, y, radius = rendered.discs_frame(
        rng, shape=(1024, 1024), count=500, amplitude=-170 if dark else 170, background=180 if dark else 10
    )
    image = rendered.expose(mean, rng, read_dn=1.5)
    at = rendered.window(0, 0, 14)

    def least(r: float) -> float:
        model = lambda p: p[3] + p[2] * rendered.edge_disc(p[0], p[1], p[4], p[5], at)  # noqa: E731
        return rendered.bound(model, (0.2, 0.3, 170, 10, r, 0.757), 1.5**2 + 1 / 12)[0, 0]

    bound = np.mean([least(r) for r in radius[:100]])
    allowed = 1 + stats.norm.isf(RATE / 2) / np.sqrt(2 * 2 * len(x))
    for name, goal in (("template", 1.05), ("soft_threshold", 1.25)):
        out = coverage_cells.Outcome()
        coverage_cells.add(out, locate(image, estimator=name), coverage_cells.Frame(Case(radius=3.0), mean, x, y))
        assert out.missed == out.false == 0
        assert out.rms_over(bound) < goal * allowed, name


@pytest.mark.parametrize(("radius", "blur"), [(1.0, 0.3), (1.5, 0.5), (4.0, 0.3), (8.0, 1.0)])
def test_template_has_no_phase_error(radius: float, blur: float, rng: np.random.Generator):
    """At a noise of .05 DN the mean of a tenth of the phase is uncertain by some .0001 px; the goal is .001 px."""
    frame = coverage_cells.make_frame(Case(radius=radius, blur=blur, read_dn=0.05, bits=None), rng, 400)
    out = coverage_cells.collect(frame, rng, "template")
    assert out.missed == out.false == 0
    mean, error = coverage_cells.phase_bias(out)
    assert error.max() < 3e-4
    assert np.abs(mean).max() < 0.001


@pytest.mark.parametrize("light_on", ["surface", "image"])
def test_light_that_falls_off_leaves_no_bias(light_on: str, rng: np.random.Generator):
    """Ten per cent across the disc, both readings; the mean of 400 is uncertain by .0001 px, a centroid is off by .05 px."""
    case = Case(light=(0.1 / 8, 0.0), light_on=light_on, read_dn=0.5)
    frame = coverage_cells.make_frame(case, rng, 400)
    out = coverage_cells.collect(frame, rng, "template", light_on=light_on)
    assert np.abs(out.errors.mean(axis=1)).max() < 0.001
    assert coverage_cells.departures(out.z, RATE) == []
    assert abs(coverage_cells.collect(frame, rng, "centroid").errors[0].mean()) > 0.03


def test_sloping_background_costs_little(rng: np.random.Generator):
    case = Case(slope=(0.25, 0.0), background=400.0, bits=12)
    out = coverage_cells.collect(coverage_cells.make_frame(case, rng, 400), rng, "template")
    assert out.missed == out.false == 0
    assert out.rms_over(case.least_var()) < 1.6
    assert coverage_cells.departures(out.z, RATE) == []


@pytest.mark.parametrize("amplitude", [250.0, 400.0])
def test_saturated_tops_leave_no_bias(amplitude: float, rng: np.random.Generator):
    """In all and in each tenth of the phase, within 5.3 standard errors (1e-6 for 11 means, about .001 px); each is flagged."""
    frame = coverage_cells.make_frame(Case(amplitude=amplitude), rng, 400)
    out = coverage_cells.collect(frame, rng, "template")
    assert out.missed == out.false == 0
    assert coverage_cells.departures(out.z, RATE) == []
    mean, error = coverage_cells.phase_bias(out)
    assert np.abs(mean / error).max() < 5.3
    assert (locate(frame.exposed(rng)).flags & int(Flag.SATURATED)).all()


@pytest.mark.parametrize(("name", "goal"), [("template", 1.05), ("row_squared_centroid", 1.2)])
def test_lines(name: str, goal: float, rng: np.random.Generator):
    """Offsets of 150 lines over their bound; their rms is uncertain by 5.8 %, so 28 % above the goal is asked; z is standard normal."""
    bars = line_frames.Bars(width=1.0, blur=1.0)
    frame = line_frames.make_lines(rng, 150, (1600, 1600), bars)
    error, var, false = line_frames.offsets(frame, locate(frame.image, kind="line", estimator=name))
    assert len(error) == 150 and false == 0
    least = np.mean([bars.least_offset_var(a) for a in frame.angle_deg[:10]])
    assert np.sqrt(np.mean(error**2) / least) < goal * (1 + stats.norm.isf(RATE / 2) / np.sqrt(2 * 150))
    assert coverage_cells.departures(error / np.sqrt(var), RATE) == []
