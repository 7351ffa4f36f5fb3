"""The report's page: numbers against hand calculation, structure against the rules of HTML, figures against a simulated camera."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace
from functools import lru_cache
from html.parser import HTMLParser
from math import log10
from pathlib import Path

import numpy as np
import pytest

from pixmetry.assess.page.figures import Curve, all_pictures, nonlinearity, target_picture
from pixmetry.assess.page.measured import table
from pixmetry.assess.page.page import page_of, write_report
from pixmetry.budget.monte_carlo import Crop
from pixmetry.camera.observations import Observations
from pixmetry.report import html_of
from pixmetry.report.drawing import thumbnail
from report import simulated

VOID = {"meta", "link", "br", "use", "path", "image", "img", "input", "rect", "circle"}


class Page(HTMLParser):
    """Elements, text by tag, and the links of a page."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.elements: list[tuple[str, dict[str, str]]] = []
        self.headings: list[tuple[str, str]] = []
        self.words: list[str] = []
        self.open: list[str] = []
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.append((tag, {k: v or "" for k, v in attrs}))
        if tag not in VOID:
            self.open.append(tag)
        if tag in {"h1", "h2", "h3"}:
            self.headings.append((tag, ""))

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.append((tag, {k: v or "" for k, v in attrs}))

    def handle_endtag(self, tag: str) -> None:
        if tag not in VOID:
            assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        if "style" in self.open:
            return
        self.words.append(data)
        if self.open and any(t in {"h1", "h2", "h3"} for t in self.open):
            self.headings[-1] = (self.headings[-1][0], self.headings[-1][1] + data)

    @property
    def text(self) -> str:
        return " ".join(" ".join(self.words).split())

    def of(self, tag: str) -> list[dict[str, str]]:
        return [attrs for name, attrs in self.elements if name == tag]


@lru_cache(maxsize=4)
def source(pitch_um: float | None = simulated.PITCH_UM, with_stacks: bool = True) -> str:
    return html_of(page_of(simulated.assessment(pitch_um, with_stacks)))


def page(pitch_um: float | None = simulated.PITCH_UM, with_stacks: bool = True) -> Page:
    return Page(source(pitch_um, with_stacks))


def test_the_verdict_is_the_root_sum_of_squares_in_px_and_um() -> None:
    """3-4-5 by construction: 0.05 px in x, 0.03 in y; with the accepted 0.13 and 0.05; times 7.4 µm."""
    text = page().text
    assert "0.050 px = 0.370 µm" in text
    assert "0.030 px = 0.222 µm" in text
    assert "x 0.130 px = 0.962 µm" in text
    assert "y 0.050 px = 0.370 µm" in text


def test_frames_lower_what_is_random_in_time_only() -> None:
    """y with 16 frames: random 0.02² + 0.01² over 16, bias 0.02² as it is: √(0.0005/16 + 0.0004) = 0.0208."""
    text = page().text
    row = text[text.index("16 frames") : text.index("64 frames")]
    assert row.split()[2:6] == ["0.013", "0.093", "µm", "0.021"]


def test_shares_of_random_and_systematic() -> None:
    """Squares: random 0.03² + 0.02² + 0.04² + 0.01² = 0.0030, bias 0.02² = 0.0004: 88 % and 12 %."""
    text = page().text
    assert "88 % is random in time" in text
    assert "12 % is constant; a calibration removes both" in text


def test_accepted_sources_are_named_with_their_reason() -> None:
    text = page().text
    assert "for 1 source: JPEG compression." in text
    assert "the files do not tell how strongly they were compressed" in text
    assert "only in a camera that is analogue" in text


def test_without_a_pitch_lengths_stay_in_pixels_and_the_page_says_how_to_add_it() -> None:
    found = page(None)
    assert "0.050 px" in found.text
    assert "pitch_x_um" in found.text
    verdict = found.text[found.text.index("Standard uncertainty (k = 1) of one target in one frame") : found.text.index("Target:")]
    assert "µm" not in verdict


def test_the_largest_come_first_with_their_gain() -> None:
    titles = [t for level, t in page().headings if level == "h3" and t[0].isdigit()]
    assert [t.split()[0] for t in titles] == ["1.", "2.", "3."]
    assert "row" in titles[0]
    accepted = [t for level, t in page().headings if level == "h3" and t.startswith("Accepted")]
    assert accepted and page().text.index("JPEG compression class") > page().text.index(accepted[0])  # a bound leads no list
    # without_px of row noise is half of its rms √((0.04² + 0.01²)/2); the total is √((0.05² + 0.03²)/2)
    assert "the total would fall from 0.0412 to 0.0146 px (65 % less)" in page().text


def test_interaction_is_told_with_its_standard_error() -> None:
    """√((0.0505² + 0.0305²)/2) = 0.04172 px against 0.0412."""
    assert "The interaction is the difference, 0.0005" in page().text
    assert "within two standard errors" in page().text


def test_needs_nothing_but_itself() -> None:
    text, found = source(), page()
    assert not found.of("script")
    for _, attrs in found.elements:
        for name in ("src", "href", "xlink:href", "data", "poster", "action"):
            assert attrs.get(name, "#").startswith(("#", "data:"))
        assert not [name for name in attrs if name.startswith("on")]
    assert "@import" not in text
    assert "url(http" not in text.replace(" ", "").replace('"', "")
    assert len(text.encode()) < 1_000_000


def test_structure_is_accessible() -> None:
    found = page()
    assert [level for level, _ in found.headings].count("h1") == 1
    depth = [int(level[1]) for level, _ in found.headings]
    assert depth[0] == 1
    assert all(b <= a + 1 for a, b in zip(depth, depth[1:], strict=False))
    assert [t.strip()[0] for level, t in found.headings if level == "h2"] == list("123456789")
    assert all("scope" in attrs for attrs in found.of("th"))
    figures = [a for a in found.of("svg") if "figure" in a.get("class", "")]
    assert len(figures) == 11
    assert all(a["role"] == "img" and len(a["aria-label"]) > 30 for a in figures)
    assert all(attrs.get("aria-label") for attrs in found.of("div") if attrs.get("role") == "region")


def test_names_on_the_page_are_unique_and_all_are_there() -> None:
    found, text = page(), source()
    names = [attrs["id"] for _, attrs in found.elements if "id" in attrs]
    assert len(names) == len(set(names))
    wanted = {part.split(")")[0] for part in text.split("url(#")[1:]}
    wanted |= {attrs["xlink:href"][1:] for _, attrs in found.elements if attrs.get("xlink:href", "").startswith("#")}
    assert wanted
    assert wanted <= set(names)


def test_what_was_given_is_escaped() -> None:
    assert "Simulated &lt;camera&gt; &amp; co." in source()
    assert "<camera>" not in source()


def test_the_same_assessment_gives_the_same_file(tmp_path: Path) -> None:
    path = write_report(simulated.assessment(), tmp_path / "report.html")
    assert path.read_text(encoding="utf-8") == source()


def test_without_stacks_the_page_stands_and_says_what_is_missing() -> None:
    found = page(simulated.PITCH_UM, False)
    assert "no stack of dark frames" in found.text
    assert len([a for a in found.of("svg") if "figure" in a.get("class", "")]) == 6


@pytest.fixture(scope="module")
def seen() -> Observations:
    return simulated.observations()


def test_measured_values_end_where_their_uncertainty_does(seen: Observations) -> None:
    rows = {r.name: r for rows in table(seen, simulated.assessment().standard).values() for r in rows}
    e = seen.photon_transfer_fit["gain_dn_per_e"]
    places = 1 - int(np.floor(log10(e.u)))
    assert rows["gain_dn_per_e"].number.value == f"{e.value:.{places}f}"
    assert rows["gain_dn_per_e"].number.unit == "DN/e⁻"
    prnu = seen.spatial_fit["prnu_total_rel"].value
    assert abs(float(rows["prnu_total_rel"].number.value) - 100 * prnu) < 0.01
    assert rows["prnu_total_rel"].standard.endswith("%")
    limits = [n for n in seen.photon_transfer_fit.limits if n in rows]
    assert limits
    assert all(rows[n].number.value.startswith("<") for n in limits)
    assert set(seen.photon_transfer_fit.names) | set(seen.spatial_fit.names) <= set(rows)


def test_the_drawn_curve_is_that_of_the_simulated_camera(seen: Observations) -> None:
    """Variance f'² (K² σ² + K x) + 1/12 at mean f(x) = x (1 − 0.02 x/4096).

    The fit knows the gain to 0.4 % from these frames, so 3 % is beyond seven u; a missing f' at the top is 7 %.
    """
    x = np.array([500.0, 2000.0, 3500.0])
    mean, var = Curve.of(seen.photon_transfer_fit, simulated.BITS).moments(x)
    slope = 1 - 2 * 0.02 * x / 4096
    expected = slope**2 * (simulated.GAIN**2 * simulated.NOISE_E**2 + simulated.GAIN * x) + 1 / 12
    assert np.allclose(mean, x * (1 - 0.02 * x / 4096), rtol=0.01)
    assert np.allclose(var, expected, rtol=0.03)


def test_every_figure_says_what_to_see(seen: Observations) -> None:
    pictures = all_pictures(seen, simulated.assessment().standard, simulated.assessment().maps())
    assert set(pictures) == {"transfer", "linearity", "snr", "spectrum-dark", "spectrum-bright", "map-dark", "map-prnu", "dark-codes"}
    for picture in pictures.values():
        assert len(picture.caption) > 60
        assert "<text" in picture.svg
        assert "font-family" not in picture.svg.replace("font-family: var(--sans)", "")
    assert "1/PRNU = 1" in pictures["snr"].caption  # PRNU of 1 % holds it at 100


def test_photons_can_take_the_place_of_exposures(seen: Observations) -> None:
    """At one exposure time the non-linearity is drawn against the photons; the same light gives the same figure."""
    bright = seen.photon_transfer.bright
    rate = seen.photon_transfer_fit["responsivity_dn_per_s"].value
    gain = seen.photon_transfer_fit["gain_dn_per_e"].value
    fit = seen.photon_transfer_fit.join(type(seen.photon_transfer_fit).from_rows([("quantum_efficiency", 0.5, 0.001, np.inf, "1")]))
    lamp = replace(bright, photons=bright.exposure_s * rate / gain / 0.5, exposure_s=np.full(bright.exposure_s.shape, 0.01))
    other = replace(seen, photon_transfer=replace(seen.photon_transfer, bright=lamp), photon_transfer_fit=fit)
    first, second = nonlinearity(seen), nonlinearity(other)
    assert first.caption == second.caption


def test_thumbnail_is_the_mean_over_blocks() -> None:
    values = np.arange(450.0 * 700).reshape(450, 700)
    small, block = thumbnail(values)
    assert block == 4
    assert small.shape == (112, 175)
    assert small[3, 5] == values[12:16, 20:24].mean()


def test_importing_the_page_is_cheap_and_knows_nothing_of_the_job() -> None:
    heavy = ("matplotlib", "scipy", "numba", "pydantic", "pixmetry.assess.job", "pixmetry.assess.results")
    code = f"import sys, pixmetry.assess.page.page; print([m for m in {heavy} if m in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_the_page_shows_the_target_with_its_centres() -> None:
    """The uncertainty is enlarged by a power of ten, so that it is seen; a target that was not found has no measured centre."""
    pixels = np.full((24, 24), 100.0)
    pixels[9:16, 9:16] = 2000.0
    budget = simulated.budget()
    for x_hat_px, words in ((12.03, "The measured centre is 0.050 px from the true one."), (np.nan, "The target was not found here.")):
        drawn = target_picture(Crop(pixels, 12.0, 11.5, x_hat_px, 11.54), budget)
        assert words in drawn.alt and words in drawn.caption
        lost = np.isnan(x_hat_px)
        assert ("enlarged 10 times" in drawn.caption) != lost and len(drawn.drawing.axes[0].patches) == (0 if lost else 1)
    found = page_of(replace(simulated.assessment(), crop=Crop(pixels, 12.0, 11.5, 12.03, 11.54)))
    assert html_of(found).count('<figure id="target">') == 1
