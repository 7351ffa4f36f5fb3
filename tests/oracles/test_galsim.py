"""Flat fields drawn by GalSim's detector noise and by us, for the same numbers: the same frequencies of the stored codes.

GalSim runs in an environment and a process of its own (``make oracles``), with generators of its own. Each comparison fails by chance
with a probability of 1e-6.
"""

from __future__ import annotations

import json
import subprocess
from pathlib import Path

import numpy as np
import pytest
from scipy import stats

from chance import rng_of
from pixmetry.camera.camera import Camera, Element
from pixmetry.camera.catalogue import get_source
from pixmetry.scene.uniform import Uniform

ROOT = Path(__file__).resolve().parents[2]
PYTHON = ROOT / ".venv-oracles" / "bin" / "python"
ALPHA = 1e-6
LEVELS_E = (0.0, 0.3, 5.0, 100.0, 4000.0, 9950.0, 20_000.0)
CASE = {
    "rows": 1024,
    "cols": 1024,
    "levels_e": LEVELS_E,
    "prnu_rel": 0.01,
    "dark_e": 2.0,
    "dsnu_e": 1.5,
    "read_e": 2.5,
    "full_well_e": 10_000.0,
    "gain_dn_per_e": 0.3,
    "offset_dn": 30.0,
    "top": 4095,
}

pytestmark = [
    pytest.mark.oracle,
    pytest.mark.skipif(not PYTHON.exists(), reason=f"{PYTHON.parent.parent.name} is not there: make oracles"),
]


def ours(level_e: float, seed: int) -> np.ndarray:
    """Histogram of one frame of one unit."""
    chain = (
        ("sensor.quantum_efficiency", {"quantum_efficiency": 1.0}),
        ("sensor.prnu", {"pixel_std_rel": CASE["prnu_rel"]}),
        ("sensor.dark_current", {"rate_e_per_s": CASE["dark_e"]}),
        ("sensor.shot_noise", {}),
        ("sensor.full_well", {"full_well_e": CASE["full_well_e"]}),
        ("sensor.dsnu", {"pixel_std_e": CASE["dsnu_e"]}),
        ("electronics.amplifier_noise", {"white_e": CASE["read_e"]}),
        ("electronics.gain", {"gain_dn_per_e": CASE["gain_dn_per_e"]}),
        ("grabber.adc", {"bits": 12, "offset_dn": CASE["offset_dn"]}),
    )
    elements = tuple(Element(name, get_source(name), get_source(name).make(values)) for name, values in chain)
    camera = Camera("detection", (CASE["rows"], CASE["cols"]), elements, exposure_s=1.0, unit_seed=seed)
    return np.bincount(camera.expose(Uniform(level_e), 1, seed).data.ravel(), minlength=CASE["top"] + 1)


@pytest.fixture(scope="module")
def histograms(request: pytest.FixtureRequest, tmp_path_factory) -> list[tuple[np.ndarray, np.ndarray]]:
    """GalSim's and ours, level by level."""
    seed = int(rng_of(request).integers(2**30))
    case = tmp_path_factory.mktemp("galsim") / "case.json"
    case.write_text(json.dumps(CASE | {"seed": seed}))
    done = subprocess.run([str(PYTHON), str(ROOT / "scripts" / "oracles" / "galsim_flats.py"), str(case)], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    theirs = json.loads(done.stdout)
    return [(np.array(counts), ours(level, seed + i)) for i, (level, counts) in enumerate(zip(LEVELS_E, theirs, strict=True))]


def moments(counts: np.ndarray) -> tuple[float, float, float, float]:
    """Mean and variance with the squares of their standard errors."""
    n, k = counts.sum(), np.arange(len(counts))
    mean = counts @ k / n
    m2, m4 = (counts @ (k - mean) ** power / n for power in (2, 4))
    return mean, m2, m2 / n, (m4 - m2**2) / n


@pytest.mark.parametrize("at", range(len(LEVELS_E)), ids=lambda i: f"{LEVELS_E[i]:g}e")
def test_stat_codes_are_those_of_galsim(histograms, at: int) -> None:
    """Mean, variance and all frequencies (χ² of two samples) of 1e6 pixels each; catches a mean off by 1 % of σ, a variance by 1.5 %."""
    theirs, own = histograms[at]
    a, b = moments(theirs), moments(own)
    z = stats.norm.isf(ALPHA / 2)
    for name, i in (("mean", 0), ("variance", 1)):
        u = np.sqrt(a[i + 2] + b[i + 2])
        print(f"{LEVELS_E[at]:8g} e  {name:<9} GalSim {a[i]:11.5f}   ours {b[i]:11.5f}   z {(b[i] - a[i]) / u:+.2f}")
        assert abs(b[i] - a[i]) < z * u
    often = theirs + own >= 40
    x, y = (np.append(v[often], v[~often].sum()).astype(float) for v in (theirs, own))
    statistic = np.sum((x - y) ** 2 / np.maximum(x + y, 1))
    assert stats.chi2.sf(statistic, often.sum()) > ALPHA
