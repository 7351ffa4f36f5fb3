"""The page of a calibration: numbers against the records, figures against geometry done by hand, structure against the rules of HTML."""

from __future__ import annotations

import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from chance import rng_of
from pixmetry.calibrate.bundle.model import NAMES, Sensor
from pixmetry.calibrate.bundle.network import Adjustment
from pixmetry.calibrate.checks.quality import image_records
from pixmetry.calibrate.page.figures import (
    MOST_IN_SMALL,
    MOST_VECTORS,
    Residuals,
    arrows,
    bin_means,
    cell_means,
    chain,
    draw_vectors,
    enlargement,
    even_choice,
    image_order,
    round_number,
    short,
)
from pixmetry.calibrate.page.page import page_of, write_page
from pixmetry.calibrate.page.space import ellipse, field_map, largest_axis, plan_views, pyramids, seen_from, shown_points
from pixmetry.calibrate.page.tables import control_points, gross_errors, images, network_facts, parameters, scale_bars
from pixmetry.calibrate.page.text import as_given, p_text, projection_levels, sentence, summary_text, typeset, worth
from pixmetry.calibrate.records import Calibration, CheckRecord, FieldPoints, ProjectionMap, read_record
from pixmetry.core.errors import InputError
from pixmetry.core.finding import Finding
from pixmetry.report import html_of
from report import calibrations
from report.test_page import Page

LIMIT_BYTES = 5_000_000


@pytest.fixture(scope="module")
def whole(request: pytest.FixtureRequest) -> Calibration:
    return calibrations.full(rng_of(request))


@pytest.fixture(scope="module")
def source(whole: Calibration) -> str:
    return html_of(page_of(whole))


@pytest.fixture(scope="module")
def page(source: str) -> Page:
    return Page(source)


def plain(text: str) -> str:
    """With ordinary spaces, as a `Page` gives its words."""
    return " ".join(text.split())


def with_tests(calibration: Calibration, **records: Any) -> Calibration:
    return replace(calibration, tests=replace(calibration.tests, **records))


def with_residuals(calibration: Calibration, x_px: float, y_px: float) -> Calibration:
    """Only what every adjustment has, with residuals of the same size everywhere."""
    v = calibration.adjustment.residual_px
    return Calibration(replace(calibration.adjustment, residual_px=np.broadcast_to([x_px, y_px], v.shape).copy()))


def residuals(x: np.ndarray, y: np.ndarray, dx: np.ndarray, dy: np.ndarray, image: np.ndarray | None = None) -> Residuals:
    return Residuals(x, y, dx, dy, np.zeros(len(x), int) if image is None else image, Sensor(1000, 800))


def test_a_principal_point_that_is_held_is_said_and_not_a_projection_of_nothing(whole: Calibration) -> None:
    """Without xp and yp nothing that is estimated moves the middle of the frame: 0 px there would be taken for certainty."""
    (name, known), *_ = whole.tests.projection.items()
    u = known.u_px.copy()
    u[u.shape[0] // 2, u.shape[1] // 2] = 1e-9
    held = replace(whole, tests=replace(whole.tests, projection={name: replace(known, u_px=u)}))
    text = worth(held, 0)
    assert "principal point, which is held" in text and "middle of the frame" not in text
    assert "middle of the frame" in worth(whole, 0)


@pytest.mark.usefixtures("undrawn")
def test_the_verdict_comes_first_in_px_and_um(whole: Calibration, rng: np.random.Generator) -> None:
    """0.03 and 0.05 px of 5.5 µm pixels are 0.165 and 0.275 µm."""
    text = worth(with_residuals(whole, 0.03, -0.05), 0).replace("\u00a0", " ")
    assert "0.030 px (0.165 µm) rms in x and 0.050 px (0.275 µm) in y" in text
    few = calibrations.full(rng, images=2)
    found = Page(html_of(page_of(with_residuals(few, 0.03, -0.05))))
    assert found.headings[1][1].startswith("1Accuracy of the calibration")
    assert "x 0.030 px = 0.165 µm y 0.050 px = 0.275 µm" in found.text


def test_projection_uncertainty_in_the_middle_and_in_the_worst_corner() -> None:
    u = np.full((5, 7), 9.0)
    u[2, 3], u[0, 0], u[0, -1], u[-1, 0], u[-1, -1] = 0.01, 0.02, 0.03, np.nan, 0.04
    axes = np.arange(7.0), np.arange(5.0)
    assert projection_levels(ProjectionMap(*axes, u, u)) == (0.01, 0.04)
    assert projection_levels(ProjectionMap(*axes, np.full((5, 7), np.nan), u)) is None


def test_every_record_is_on_the_page(whole: Calibration, page: Page) -> None:
    text = page.text
    for finding in whole.findings:
        assert plain(typeset(finding.text)) in text and finding.advice in text
    assert whole.tests.f_test["camera"].text in text
    dof = [f"{axis.dof:.0f}" for axis in whole.tests.residuals["camera"].axes.values()]
    assert f"in px² 1.31 {dof[0]} and {dof[1]} 1.12 0.00020" in text
    assert f"in µm² 1.31 {dof[0]} and {dof[1]} 1.12 0.00020" in text
    assert "Affinity B1 1.200" in text and "from the middle" in text
    assert "fx 1458.36 ± 0.21" in text
    assert "radial K1, K2, K3 512 3 and" in text
    assert "camera: c img_014.tif: Z0 0.97" in text
    assert "points as given 0.081 0.092 0.062 points free 0.039 0.044 0.029" in text
    assert "With noise alone, half of the residuals of images left out would be above 0.027 px" in text
    assert "xp +1.81 0.110 16.5" in text
    assert "x residuals depend on the sub-pixel phase 0.012 ± 0.0011 3.0 × 10⁻⁶ Possible cause: pixels that see little" in text
    assert "1003 image points were corrected for the eccentricity of circular targets, by at most 0.023 px." in text
    assert whole.adjustment.datum in text
    assert "image_coordinates.csv" in text and "pixmetry calibrate project.yaml" in text and "field = auto" in text


@pytest.mark.usefixtures("undrawn")
def test_gross_errors_are_listed_worst_first(whole: Calibration, rng: np.random.Generator) -> None:
    one = whole.tests.gross_errors[0]
    records = [replace(one, image="mild", statistic=40.0), replace(one, image="awful", statistic=900.0)]
    assert [row[0] for row in gross_errors(records)] == ["awful", "mild"]
    few = calibrations.full(rng, images=3)
    assert "No gross error was found." in Page(html_of(page_of(with_tests(few, gross_errors=())))).text


def test_a_parameter_that_is_not_significant_says_so(whole: Calibration) -> None:
    records = list(whole.tests.parameters)
    records[3] = replace(records[3], value=1e-5, u=2e-5, p_zero=0.62)
    changed = with_tests(whole, parameters=tuple(records))
    row = next(r for r in parameters(changed, 0) if r["symbol"] == "B1")
    assert [row[key] for key in ("value", "u", "unit", "p")] == ["1.0", "± 2.0", "10⁻⁵", "0.62, not significant"]
    assert re.search(r"B1 +1\.0 ± 2\.0 +10⁻⁵ +not significant", summary_text(changed))


def test_for_which_y_the_signs_are_is_said_for_each_camera(page: Page) -> None:
    assert page.text.count("B2 and P2 are for y down. For y up both change their sign") == 1


@pytest.mark.usefixtures("undrawn")
def test_a_curve_of_terms_that_are_not_there_is_not_drawn(whole: Calibration) -> None:
    """Two curves of ten parameters; without P none tangential, without K none radial; held at a value they are drawn."""
    adjustment = whole.adjustment
    (camera,) = adjustment.network.cameras

    def kinds(held: tuple[str, ...], *, zero: bool) -> list[bool]:
        values = adjustment.state.interior.copy()
        values[0, np.isin(NAMES, held)] = 0.0 if zero else 1e-6
        network = replace(adjustment.network, cameras=(replace(camera, free=camera.free & ~np.isin(NAMES, held)),))
        changed = replace(adjustment, network=network, state=replace(adjustment.state, interior=values))
        text = html_of(page_of(replace(whole, adjustment=changed)))
        return [f"{kind} correction against the radius" in text for kind in ("radial", "tangential")]

    k, p = tuple(f"k{i}" for i in range(1, 6)), ("p1", "p2")
    assert kinds((), zero=False) == [True, True] and kinds(p, zero=False) == [True, True]
    assert kinds(p, zero=True) == [True, False] and kinds(k, zero=True) == [False, True]


@pytest.mark.usefixtures("undrawn")
def test_a_long_table_says_that_it_scrolls(whole: Calibration) -> None:
    records = whole.tests.gross_errors
    many = [replace(records[0], point=f"P{i}") for i in range(30)]
    assert "The table scrolls." in Page(html_of(page_of(with_tests(whole, gross_errors=many)))).text
    assert "The table scrolls." not in Page(html_of(page_of(with_tests(whole, gross_errors=many[:5])))).text


def test_a_parameter_held_fixed_is_shown_without_u(whole: Calibration) -> None:
    adjustment = whole.adjustment
    camera = adjustment.network.cameras[0]
    free = camera.free.copy()
    free[4] = False
    network = replace(adjustment.network, cameras=(replace(camera, free=free),))
    columns = tuple(name for name in adjustment.free_columns if not name.endswith(":b2"))
    keep = [i for i, name in enumerate(adjustment.free_columns) if not name.endswith(":b2")]
    fixed = replace(adjustment, network=network, free_columns=columns, covariance=adjustment.covariance[np.ix_(keep, keep)])
    row = next(r for r in parameters(Calibration(fixed), 0) if r["symbol"] == "B2")
    assert [plain(row[key]) for key in ("value", "u", "unit", "p")] == ["\u22123", "held fixed", "10⁻⁵", ""]
    assert "fixed" in summary_text(Calibration(fixed))


@pytest.mark.parametrize(
    ("value", "unit", "text"),
    [(2016.1667, "px", "2016.1667 px"), (5657.83, "px", "5657.83 px"), (14.0, "mm", "14 mm"), (3e-4, "1/mm²", "0.0003 1/mm²"),
     (-1.0543217e-6, "1/mm⁴", "\u22121.0543217 10⁻⁶ 1/mm⁴"), (1.5e-5, "1", "1.5 10⁻⁵"), (0.1 + 0.2, "1", "0.3")],
)  # fmt: skip
def test_what_is_held_is_shown_as_it_was_given(value: float, unit: str, text: str) -> None:
    number = as_given(value, unit)
    assert plain(f"{number.value} {number.unit}") == text and number.u == "\u2013"


def test_images_that_are_not_oriented_are_not_counted_and_nothing_of_them_is_rejected(whole: Calibration) -> None:
    """Two images without a pose; of another one a point is left out."""
    adjustment = whole.adjustment
    net, position = adjustment.network, adjustment.state.position.copy()
    position[:2] = np.nan
    used = adjustment.used & (net.image > 1)
    used[np.flatnonzero(used)[0]] = False
    without = replace(adjustment, used=used, state=replace(adjustment.state, position=position))
    records = image_records(without, {net.images[0]: 7, net.images[2]: 1})
    assert [(r.oriented, r.rejected) for r in records[:3]] == [(False, 0), (False, 0), (True, 1)]
    assert records[0].measured == (net.image == 0).sum()
    rows = images(records)["rows"]
    assert rows[0][2][:2] == ["not oriented", "\u2013"] and rows[2][2][1] == "1"
    said = plain(summary_text(Calibration(without)))
    assert f"{len(net.images) - 2} of {len(net.images)} images, " in said and f"{used.sum()} of {len(net)} image points" in said
    facts = dict(network_facts(Calibration(without)))
    assert facts["Images"] == f"{len(net.images) - 2} of {len(net.images)}" and facts["Image points used"] == f"{used.sum()} of {len(net)}"


@pytest.mark.parametrize(
    ("make", "pitch_um", "cameras"),
    [(calibrations.bare, 5.5, 1), (calibrations.bare, None, 2), (calibrations.full, None, 1), (calibrations.full, 5.5, 2)],
)
def test_the_page_is_whole_for_every_kind(rng: np.random.Generator, make: Any, pitch_um: float | None, cameras: int) -> None:
    calibration = make(rng, pitch_um=pitch_um, cameras=cameras, images=4 * cameras, points=49, plane=cameras == 2)
    text = html_of(page_of(calibration))
    found = Page(text)
    assert found.open == []
    ids = [attrs["id"] for _, attrs in found.elements if "id" in attrs]
    assert len(ids) == len(set(ids))
    depth = [int(tag[1]) for tag in re.findall(r"<(h[1-6])", text)]
    assert depth[0] == 1 and depth.count(1) == 1 and all(b <= a + 1 for a, b in zip(depth, depth[1:], strict=False))
    words = f" {found.text} ".lower()
    for bad in (" nan", "none ", "inf ", "array(", "{", "}"):
        assert bad not in words.replace("none was found", ""), bad
    if pitch_um is None:
        assert "µm" not in found.text
    for k in range(cameras):
        assert calibration.adjustment.network.cameras[k].name in found.text
    numbers = [int(n) for n in re.findall(r'<span class="no">(\d)</span>', text)]
    assert numbers == list(range(1, len(numbers) + 1))
    assert all(href.startswith("data:") for href in re.findall(r'(?:src|href)="([^"#]+)"', text))


@pytest.mark.usefixtures("undrawn")
def test_without_covariance_nothing_is_claimed(rng: np.random.Generator) -> None:
    plain = calibrations.bare(rng, covariance=False, images=4)
    text = Page(html_of(page_of(plain))).text
    assert "The uncertainty of the parameters was not computed." in text
    assert "±" not in text[text.index("Principal distance") : text.index("Residuals are measured")]
    none: Any = None
    nothing = Calibration(replace(plain.adjustment, covariance=none, point_covariance=none))
    assert "The uncertainty of the points was not computed." in Page(html_of(page_of(nothing))).text
    assert "nan" not in summary_text(nothing)


@pytest.mark.usefixtures("undrawn")
def test_fixed_points_have_no_ellipsoids(rng: np.random.Generator) -> None:
    plain = calibrations.bare(rng, plane=True, images=4)
    assert plan_views(plain.adjustment) == []
    assert "All points were held at their given coordinates." in Page(html_of(page_of(plain))).text


def test_images_and_points_that_are_not_determined_are_left_out(rng: np.random.Generator) -> None:
    plain = calibrations.bare(rng)
    adjustment, state = plain.adjustment, plain.adjustment.state
    position, rotation, xyz = state.position.copy(), state.rotation.copy(), state.xyz.copy()
    position[2], rotation[2], xyz[7] = np.nan, np.nan, np.nan
    residual, covariance = adjustment.residual_px.copy(), adjustment.point_covariance.copy()
    out = (adjustment.network.image == 2) | (adjustment.network.point == 7)
    residual[out], covariance[7] = np.nan, np.nan
    changed = replace(
        adjustment,
        state=replace(state, position=position, rotation=rotation, xyz=xyz),
        residual_px=residual,
        used=adjustment.used & ~out,
        point_covariance=covariance,
    )
    text = Page(html_of(page_of(Calibration(changed)))).text
    assert "1 point is not determined" in text and "nan" not in text.lower()
    assert len(Residuals.of(changed, 0)) == int((adjustment.used & ~out).sum())


@pytest.mark.usefixtures("undrawn")
def test_a_camera_without_used_coordinates_says_so(rng: np.random.Generator) -> None:
    plain = calibrations.bare(rng, cameras=2, images=6)
    adjustment = plain.adjustment
    second = adjustment.network.camera_of[adjustment.network.image] == 1
    text = Page(html_of(page_of(Calibration(replace(adjustment, used=adjustment.used & ~second))))).text
    assert text.count("No image coordinate of this camera was used.") == 1


def test_names_from_outside_are_only_text(rng: np.random.Generator) -> None:
    plain = calibrations.full(rng, images=4)
    bad = '<script>alert("x")</script>'
    network = replace(plain.adjustment.network, images=(bad, *plain.adjustment.network.images[1:]))
    findings = (Finding("start", f"Image {bad} was left out.", "", "warning"),)
    images = [replace(r, image=network.images[k]) for k, r in enumerate(plain.tests.images)]
    changed = replace(with_tests(plain, images=images), adjustment=replace(plain.adjustment, network=network), findings=findings)
    assert "<script" not in html_of(page_of(changed))


def test_many_images_and_points_stay_small(rng: np.random.Generator) -> None:
    big = calibrations.full(rng, images=300, points=3000, visibility=0.05)
    text = html_of(page_of(big))
    assert 1_000_000 < len(text.encode()) < LIMIT_BYTES
    found = Page(text)
    assert "Table of the 300 images" in found.text
    assert f"{len(even_choice(np.arange(int(big.adjustment.used.sum())), MOST_VECTORS))} of them are drawn" in found.text
    # every image is drawn: its name stands over its small figure
    assert all(f">{name}</text>" in text for name in big.adjustment.network.images)
    assert "data:image/png;base64," in text


def test_a_page_is_written_whole_and_nothing_else_is_replaced(
    whole: Calibration, tmp_path: Path, source: str, rng: np.random.Generator
) -> None:
    path = write_page(whole, tmp_path / "report.html")
    assert path.read_text(encoding="utf-8") == source  # also: it is the same every time
    path.write_text("mine")
    with pytest.raises(InputError):
        write_page(calibrations.bare(rng, images=2), path)


def test_an_arrow_is_its_vector_enlarged(rng: np.random.Generator) -> None:
    x, y = rng.uniform(0, 800, (2, 40))
    dx, dy = rng.normal(0, 0.05, (2, 40))
    sensor = Sensor(1000, 800)
    from matplotlib.figure import Figure

    axes = Figure().subplots()
    factor = draw_vectors(axes, x, y, dx, dy, sensor)
    drawn = axes.lines[1].get_xydata().reshape(40, 6, 2)
    np.testing.assert_allclose(drawn[:, 0], np.column_stack([x, y]))
    np.testing.assert_allclose(drawn[:, 1] - drawn[:, 0], factor * np.column_stack([dx, dy]))
    # both barbs go back from the tip by the same angle
    along, left, right = drawn[:, 1] - drawn[:, 0], drawn[:, 2] - drawn[:, 1], drawn[:, 4] - drawn[:, 1]
    np.testing.assert_allclose((along * left).sum(axis=1), (along * right).sum(axis=1))
    assert ((along * left).sum(axis=1) < 0).all()
    # the key has the length that its text says
    key = axes.lines[2].get_xdata()[1] * (axes.get_xlim()[1] - axes.get_xlim()[0])
    said = re.match(r"([\d.]+) px, drawn ([\d.]+) times", axes.texts[0].get_text())
    assert said is not None and float(said[2]) == factor
    assert key == pytest.approx(factor * float(said[1]))
    assert axes.get_ylim()[0] > axes.get_ylim()[1]  # y goes down


def test_enlargement_is_round_and_puts_long_vectors_at_a_share_of_the_frame(rng: np.random.Generator) -> None:
    size = 10 ** rng.uniform(-6, 3)
    angle, length = rng.uniform(0, 2 * np.pi, 500), size * rng.rayleigh(1.0, 500)
    factor, key = enlargement(length * np.cos(angle), length * np.sin(angle), 1000.0)
    long = np.percentile(length, 95) * factor / 1000
    assert 0.06 / 2.5 < long <= 0.06 * (1 + 1e-9)
    assert 0.6 < key / np.percentile(length, 95) <= 1.5 * (1 + 1e-9)
    for value in (factor, key):
        assert round(value / 10.0 ** np.floor(np.log10(value) + 1e-9)) in (1, 2, 5)
    assert enlargement(np.zeros(3), np.zeros(3), 100.0) == (1.0, 1.0)
    assert [round_number(v) for v in (0.019, 0.02, 4.99, 5.0, 9.9, 1000.0)] == pytest.approx([0.01, 0.02, 2, 5, 5, 1000])


def test_cell_means_are_those_of_a_loop(rng: np.random.Generator) -> None:
    n = 900
    r = residuals(rng.uniform(-0.5, 999.5, n), rng.uniform(-0.5, 799.5, n), *rng.normal(0, 1, (2, n)))
    means = cell_means(r)
    cell = float(means["cell_px"])
    expected = []
    for row in range(int(800 / cell) + 1):
        for col in range(int(1000 / cell) + 1):
            inside = [
                i
                for i in range(n)
                if col * cell - 0.5 <= r.x[i] < (col + 1) * cell - 0.5 and row * cell - 0.5 <= r.y[i] < (row + 1) * cell - 0.5
            ]
            if len(inside) >= 4:
                expected.append([np.mean(v[inside]) for v in (r.x, r.y, r.dx, r.dy)] + [len(inside)])
    found = np.column_stack([means[key] for key in ("x", "y", "dx", "dy", "n")])
    order, order_expected = np.argsort(found[:, 0] + 1e4 * found[:, 1]), np.argsort([e[0] + 1e4 * e[1] for e in expected])
    np.testing.assert_allclose(found[order], np.array(expected)[order_expected])


def test_images_are_ordered_by_their_rms(rng: np.random.Generator) -> None:
    image = np.repeat([4, 1, 9], [5, 50, 20])
    size = np.repeat([0.2, 0.1, 0.3], [5, 50, 20])
    r = residuals(*rng.uniform(0, 800, (2, 75)), size, -size, image)
    assert image_order(r).tolist() == [9, 4, 1]


def test_bin_means_and_their_uncertainty(rng: np.random.Generator) -> None:
    at, value = rng.uniform(0, 4, 300), rng.normal(0, 1, 300)
    at = np.where(at < 1, at + 1, at)  # nothing in the first bin
    bins = bin_means(at, value, np.array([0.0, 1.0, 2.0, 4.0]))
    assert len(bins.at) == 2
    for k, (low, high) in enumerate(((1.0, 2.0), (2.0, 4.0))):
        v = value[(at >= low) & (at < high)]
        assert bins.mean[k] == pytest.approx(v.mean())
        assert bins.u[k] == pytest.approx(v.std(ddof=1) / np.sqrt(len(v)))


def test_an_even_choice_holds_no_more_than_asked() -> None:
    for n in (1, 249, 250, 251, 999, 5000):
        chosen = even_choice(np.arange(n), MOST_IN_SMALL)
        assert len(chosen) <= MOST_IN_SMALL and (len(chosen) == n or len(chosen) > MOST_IN_SMALL / 2)
        assert len(np.unique(np.diff(chosen))) <= 1


def test_chained_lines_have_gaps() -> None:
    line = chain(np.array([1.0, 2.0]), np.array([3.0, 4.0]))
    np.testing.assert_array_equal(line, [1, 3, np.nan, 2, 4, np.nan])
    x, _ = arrows(np.zeros(2), np.zeros(2), np.ones(2), np.zeros(2), 3.0)
    assert np.nanmax(x) == 3.0 and np.isnan(x).sum() == 2


def test_a_standard_ellipse_is_where_the_quadratic_form_is_one(rng: np.random.Generator) -> None:
    half = rng.normal(0, 1, (2, 2))
    covariance = half @ half.T + 0.01 * np.eye(2)
    outline = ellipse(covariance)
    np.testing.assert_allclose(np.einsum("in,ij,jn->n", outline, np.linalg.inv(covariance), outline), 1.0)


def test_largest_axis_and_which_ellipses_are_drawn(rng: np.random.Generator) -> None:
    size = rng.uniform(1, 2, 900)
    covariance = size[:, None, None] ** 2 * np.diag([0.5, 1.0, 0.2])
    covariance[3] = np.nan
    covariance[5] = 0.0
    found = largest_axis(covariance)
    good = np.setdiff1d(np.arange(900), [3, 5])
    np.testing.assert_allclose(found[good], size[good])
    assert np.isnan(found[3]) and found[5] == 0
    shown = shown_points(found)
    assert len(shown) == len(set(shown.tolist())) <= 250 and not {3, 5} & set(shown.tolist())
    assert set(np.argsort(-np.nan_to_num(found))[:25].tolist()) <= set(shown.tolist())


def test_views_keep_lengths_across_the_line_of_sight(rng: np.random.Generator) -> None:
    azimuth, elevation = rng.uniform(-180, 180), rng.uniform(-80, 80)
    view = seen_from(azimuth, elevation)
    np.testing.assert_allclose(view @ view.T, np.eye(2), atol=1e-12)
    assert view[1, 2] > 0 and view[0, 2] == 0  # Z is up
    a, e = np.radians([azimuth, elevation])
    towards = np.array([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])
    np.testing.assert_allclose(np.cross(view[0], view[1]), towards, atol=1e-12)


def test_pyramids_stand_at_the_cameras_and_open_where_they_look(rng: np.random.Generator) -> None:
    adjustment = calibrations.bare(rng).adjustment
    edges = pyramids(adjustment, np.array([3]), 10.0)
    apex, corners = edges[:4, 0], edges[:4, 1]
    np.testing.assert_allclose(apex, np.broadcast_to(adjustment.state.position[3], (4, 3)))
    np.testing.assert_allclose(np.linalg.norm(corners - apex, axis=1), 10.0)
    local = (corners - apex) @ adjustment.state.rotation[3].T
    assert (local[:, 2] > 0).all()
    fx, fy = adjustment.camera(0).c_px
    np.testing.assert_allclose(np.abs(local[:, 0] / local[:, 2]), 1280 / 2 / fx)
    np.testing.assert_allclose(np.abs(local[:, 1] / local[:, 2]), 1024 / 2 / fy)


def test_the_field_is_drawn_in_its_own_axes(rng: np.random.Generator) -> None:
    """A board in the XZ plane: without its axes all its points would lie on one line."""
    adjustment = calibrations.bare(rng).adjustment
    xyz = np.column_stack([rng.uniform(0, 100, 30), np.zeros(30), rng.uniform(0, 60, 30)])
    none, axes = np.zeros(30), np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    points = FieldPoints((), xyz, axes, none, none, none, none, rng.normal(0, 1, 30), none)
    picture = field_map(adjustment, points)
    assert picture is not None and "30 points" in picture.alt and ">Z / mm</text>" in picture.svg
    assert field_map(adjustment, replace(points, dz=np.full(30, np.nan))) is None


def test_scale_bars_are_measured_less_adjusted(whole: Calibration) -> None:
    rows = scale_bars(whole)
    assert [row[3:] for row in rows] == [["+0.013", "1.3"], ["\u22120.0040", "\u22120.4"]] or rows[0][3] == "+0.012"
    assert rows[0][0] == "P1 – P9"


def test_control_points_far_from_the_origin_have_all_their_digits(rng: np.random.Generator) -> None:
    far = calibrations.bare(rng)
    net = far.adjustment.network
    xyz = net.xyz.copy()
    xyz[2] = far.adjustment.state.xyz[2] + [0.02, 0, 0]
    state = replace(far.adjustment.state, xyz=far.adjustment.state.xyz + [5.4e6, 0, 0])
    network = replace(net, xyz=xyz + [5.4e6, 0, 0], u_xyz=np.where(np.arange(len(xyz))[:, None] == 2, [0.01, 0.02, np.inf], np.inf))
    rows = control_points(replace(far, adjustment=replace(far.adjustment, network=network, state=state)))
    assert [row[0] for row in rows] == ["P3 X", "P3 Y"] and [row[2:] for row in rows] == [
        ["± 0.010", "+0.020", "2.0"],
        ["± 0.020", "0", "0.0"],
    ]
    assert rows[0][1] == f"{network.xyz[2, 0]:.3f}".replace("-", "\u2212")


NOTHING = np.full(3, np.nan)
CHECKED = {
    "unit": "mm", "datum_parameters": 0, "n": 4, "dof": 4, "level": 0.001, "rms": [0.02, 0.01, 0.03], "expected_rms": [0.02] * 3,
    "chi2": 3.21, "p": 0.52, "worst": {"name": "C1", "axis": "X", "difference": -0.031, "ratio": -1.57, "critical": 3.5},
    "text": "2 check points with 4 coordinates: largest: C1 X, -0.031 mm (1.6 u)",
    "points": [
        {"name": "C1", "given": np.array([1234567.5, 2.0, 3.0]), "u_given": np.array([0.01, 0.0, 0.0]),
         "found": np.array([1234567.531, 2.0, 3.0]), "u_found": np.full(3, 0.02), "difference": np.array([-0.031, 0, 0]),
         "u_difference": np.full(3, 0.02), "ratio": np.array([-1.57, 0, 0]), "images": 7},
        {"name": "C2", "given": np.array([np.nan, np.nan, 5.25]), "u_given": np.zeros(3),
         "found": NOTHING, "u_found": NOTHING, "difference": NOTHING, "u_difference": NOTHING, "ratio": NOTHING, "images": 0},
    ],
}  # fmt: skip


@pytest.mark.usefixtures("undrawn")
def test_check_points_are_listed(whole: Calibration, page: Page) -> None:
    assert "Check points" not in page.text
    checked = with_tests(whole, check_points=read_record(CheckRecord, CHECKED))
    shown = Page(html_of(page_of(checked))).text
    assert "C1 X 1234567.500 ± 0.010 1234567.531 ± 0.020 \u22120.031 \u22121.6 7" in shown
    assert "C1 Y 2.000 exact 2.000 ± 0.020 0 0.0 7" in shown and "C2 Z 5.25 exact – – – – 0" in shown
    assert "C2 X" not in shown and "largest: C1 X, \u22120.031 mm (1.6 u)." in shown and "above 3.5 by chance in 0.1 %" in shown
    assert "parameters of the datum took up" not in shown
    assert "2 check points with 4 coordinates" in " ".join(summary_text(checked).split())
    assert max(len(line) for line in summary_text(checked).splitlines()) <= 100
    telling = read_record(CheckRecord, CHECKED)
    silent = with_tests(whole, check_points=replace(telling, datum_parameters=7, chi2=None, p=None, worst=None))
    shown = Page(html_of(page_of(silent))).text
    assert "less what the 7 parameters of the datum took up" in shown and "by chance" not in shown


def test_words() -> None:
    assert [p_text(p) for p in (None, float("nan"), 0.0, 1e-7, 0.0123, 0.5)] == ["–", "–", "<\u200910⁻⁶", "<\u200910⁻⁶", "0.012", "0.50"]
    assert typeset("moved by -1.25 px, +3 px (p = 1.5e-10), a-b and 2-3") == (
        "moved by \u22121.25 px, +3 px (p = 1.5\u2009×\u200910⁻¹⁰), a-b and 2-3"
    )
    texts = ("", "x is noisier", "variance of x.", "left: c moved")
    assert [sentence(t) for t in texts] == ["", "x is noisier.", "Variance of x.", "left: c moved."]
    assert [short(r) for r in (0.974, -0.974, -0.999, 0.05)] == [".97", "\u2212.97", "\u22121.00", ".05"]


def test_the_summary_fits_a_terminal(whole: Calibration) -> None:
    text = summary_text(whole)
    assert max(len(line) for line in text.splitlines()) <= 100
    assert "\u00a0" not in text and "\u2009" not in text
    assert worth(whole, 0).replace("\u00a0", " ") in " ".join(text.split())
    assert all(f.text in " ".join(text.split()) for f in whole.findings)
    for name in ("c", "xp", "yp", "B1", "B2", "P1", "P2", "K1", "K2", "K3"):
        assert re.search(rf"^  {name} +[\u2212\d.]+ ± [\d.]+", text, re.M)


def test_sigma0_says_what_it_is_compared_with(whole: Calibration) -> None:
    known: Adjustment = replace(whole.adjustment, network=replace(whole.adjustment.network, covariance_known=True))
    assert "1 would mean" in plain(summary_text(Calibration(known)))
    assert "no covariance of the image coordinates was given" in " ".join(summary_text(whole).split())


def test_importing_the_page_does_not_load_matplotlib() -> None:
    heavy = ("matplotlib", "scipy", "numba")
    code = f"import sys, pixmetry.calibrate.page.page; print([m for m in {heavy} if m in sys.modules])"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.strip() == "[]"
