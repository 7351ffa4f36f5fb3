"""Frames that other people's programs made are measured by ours: GalSim's lenses, arCTIc's trails, curves of colour and scikit-image.

The programs run in an environment and a process of their own (``make oracles``). They give noise-free light, charge or curves; the noise
of the pixels is drawn here. Each comparison allows 5.5 u, plus what is said there of the other program.
"""

from __future__ import annotations

import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pixmetry import Frames, campaign_of_arrays
from pixmetry.assess.job import observe_campaign
from pixmetry.camera.covered import Covered
from pixmetry.camera.group_facts import GroupFacts
from pixmetry.core.progress import no_progress
from pixmetry.observe.covered import BorderFrames, covered_pixels
from pixmetry.observe.edge_fit import fit_edges
from pixmetry.observe.edges import FREQUENCY, Picture, responses_of, search_edges

ROOT = Path(__file__).resolve().parents[2]
PYTHON = ROOT / ".venv-oracles" / "bin" / "python"
SCRIPT = ROOT / "scripts" / "oracles" / "foreign_frames.py"
LIMIT = 5.5
NOT_THERE = 3

pytestmark = [
    pytest.mark.oracle,
    pytest.mark.skipif(not PYTHON.exists(), reason=f"{PYTHON.parent.parent.name} is not there: make oracles"),
]


def made_by(what: str, folder: Path, **given: Any) -> dict[str, np.ndarray]:
    """What the other program makes; the test is skipped where that program is not there."""
    np.savez(folder / "given.npz", **given)
    done = subprocess.run(
        [str(PYTHON), str(SCRIPT), what, str(folder / "given.npz"), str(folder / "made.npz")], capture_output=True, text=True
    )
    if done.returncode == NOT_THERE:
        pytest.skip(done.stderr.strip())
    assert done.returncode == 0, done.stderr
    with np.load(folder / "made.npz") as found:
        return {name: found[name] for name in found.files}


@pytest.mark.parametrize(("lens", "size_px"), [("gaussian", 0.5), ("gaussian", 0.8), ("airy", 0.9)])
def test_edges_behind_a_lens_of_galsim(lens: str, size_px: float, rng: np.random.Generator, tmp_path: Path) -> None:
    """Both directions: lens times pixel, of which an edge at 5 degrees sees the box along its normal. GalSim's images are good to 1e-3.

    What a lens limited by diffraction spreads beyond the window of an edge is not in its e-SFR: 1 % of the light here, in which all
    frequencies are too high. The light that is seen is the reference of a frequency response (ISO 12233).
    """
    angle = 5.0
    given = {"lens": lens, "size_px": size_px, "side_px": 110.0, "pixels": 200, "angle_deg": angle, "frequency": FREQUENCY}
    made = made_by("edges", tmp_path, **given)
    frame = 200 + 2400 * made["image"] + 6 * rng.standard_normal(made["image"].shape)
    picture = Picture("edge", np.clip(np.rint(frame), 0, 4095).astype(np.float32), 1, 4095.0)
    search = search_edges([picture])
    found = responses_of(search)
    assert len(found.edges) == 4 and {e.across for e in found.edges} == {"x", "y"}
    tilt = np.radians(angle)
    pixel = np.sinc(FREQUENCY * np.cos(tilt)) * np.sinc(FREQUENCY * np.sin(tilt))
    at = (FREQUENCY > 0.05) & (FREQUENCY <= 0.5)
    for edge in found.edges:
        off = np.abs(edge.sfr - made["mtf"] * np.abs(pixel))[at]
        assert (off < LIMIT * edge.u_sfr[at] + (2e-3 if lens == "gaussian" else 0.012)).all(), (off / edge.u_sfr[at]).max()
        assert float(np.mean(edge.u_sfr[at])) < 0.02
    if lens == "gaussian":
        optics = fit_edges(search.measured)
        variance = size_px**2 + 1 / 12
        assert abs(optics["spread_var_px2"].value - variance) < LIMIT * optics["spread_var_px2"].u + 2e-3
        if "sigma_px" in optics and not optics["sigma_px"].is_limit:
            assert abs(optics["sigma_px"].value - size_px) < LIMIT * optics["sigma_px"].u


@pytest.mark.parametrize("along", ["parallel", "serial"])
@pytest.mark.parametrize("release_px", [0.8, 1.6])
def test_trails_of_arctic(along: str, release_px: float, rng: np.random.Generator, tmp_path: Path) -> None:
    """Traps that hold the share density over full well of the charge of each pixel, and release it with e^(−t/τ).

    A step lets 1 − e^(−1/τ) of it go: that is one over the length of the trail, and the share that a transfer leaves behind is the product.
    """
    gain, black, density, full_well = 0.2, 60.0, 12.0, 1e5
    borders, shape = Covered(left=4, right=16, top=2, bottom=14), (136, 140)
    levels = (0.0, 3000.0, 8000.0, 15000.0)
    images = np.zeros((len(levels), *shape))
    for image, level in zip(images, levels, strict=True):
        image[borders.active(shape)] = level
    given = {"images": images, "density": density, "full_well_e": full_well, "release_px": release_px, "along": along}
    groups = []
    for level, image in zip(levels, made_by("trails", tmp_path, **given)["images"], strict=True):
        held = BorderFrames("bright" if level else "dark", 0.01, borders)
        for index in range(8):
            dn = gain * rng.poisson(np.maximum(image, 0)) + black + rng.normal(0, 1.5, shape)
            held.add(index, np.clip(np.rint(dn), 0, 4095).astype(np.uint16))
        groups.append(held)
    found = covered_pixels(groups, False, gain)
    assert found is not None
    goes = 1 - np.exp(-1 / release_px)
    for name, true in ((f"{along}_cti", density / full_well * goes), ("trail_px", 1 / goes)):
        number = found.fit[name]
        print(f"{along} τ {release_px}: {name} {number.value:.4g} ± {number.u:.2g}, true {true:.4g}")
        assert number.kind == "value" and abs(number.value - true) < LIMIT * number.u < LIMIT * 0.2 * true
    other = found.fit[f"{'serial' if along == 'parallel' else 'parallel'}_cti"]
    assert other.is_limit or abs(other.value) < LIMIT * other.u


@pytest.mark.parametrize(("curve", "gamma"), [("ITU-R BT.709", 0.45), ("sRGB", 1 / 2.4), ("adjust_gamma", 0.6)])
def test_response_curves_of_colour_and_scikit_image(curve: str, gamma: float, rng: np.random.Generator, tmp_path: Path) -> None:
    """One scene at eight exposures behind a curve of another program: the exponent of its upper part."""
    top, gain, frames = 4000.0, 0.4, 2
    level = np.repeat(np.repeat(4000 * 10 ** rng.uniform(-0.8, 0.38, (8, 10)), 16, 0), 16, 1)
    steps = [level * 2.0 ** (k - 7) for k in range(8)]
    signal = np.array([[gain * (rng.poisson(e) + 8 * rng.standard_normal(e.shape)) for _ in range(frames)] for e in [*steps, 0 * level]])
    stored = made_by("curves", tmp_path, linear=signal / top, curve=curve, gamma=gamma)["stored"]
    codes = np.clip(np.rint(top * stored + 90), 0, 4095).astype(np.uint16)
    groups = [Frames("chart", 0.001 * 2.0**k, codes[k], facts=GroupFacts(u_light_rel=0.002)) for k in range(8)]
    seen = observe_campaign(campaign_of_arrays([*groups, Frames("dark", 0.01, codes[8])], bits=12), no_progress)[1]
    assert seen.response is not None and seen.response.curve, seen.response.fit.reasons
    number = seen.response.fit["gamma"]
    print(f"{curve}: gamma {number.value:.5f} ± {number.u:.2g}, true {gamma:.5f}; {seen.response.curve}")
    assert abs(number.value - gamma) < LIMIT * number.u and number.u < 0.01
