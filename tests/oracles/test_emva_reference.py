"""What the public EMVA 1288 reference implementation says of a camera that we simulate: the parameters that were put in.

It runs in an environment and a process of its own (``make oracles``) and sees nothing but image files and the descriptor.
Each comparison fails by chance with a probability of 1e-6, on the reference's own sampling error, which is derived here.
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
from pixmetry.core.config import load_yaml
from pixmetry.simulate.job import simulate

ROOT = Path(__file__).resolve().parents[2]
PYTHON = ROOT / ".venv-oracles" / "bin" / "python"
Z = stats.norm.isf(1e-6 / 2)
SIDE, LEVELS, STACK = 512, 40, 64
K, ETA, READ_E, DARK_E_PER_S, FULL_WELL_E = 0.38, 0.6, 2.5, 400.0, 10_000.0
LONGEST_S, BRIGHTEST_E, STACK_REL = 0.05, 10_400.0, 0.5
DSNU_E = {"pixel": 3.0, "row": 0.5, "col": 0.8}
PRNU_REL = {"pixel": 0.01, "row": 0.003, "col": 0.002}

pytestmark = [
    pytest.mark.oracle,
    pytest.mark.skipif(not PYTHON.exists(), reason=f"{PYTHON.parent.parent.name} is not there: make oracles"),
]


def camera(unit_seed: int) -> Camera:
    """A linear camera: the standard's model holds exactly."""
    chain = (
        ("sensor.quantum_efficiency", {"quantum_efficiency": ETA}),
        ("sensor.prnu", {f"{name}_std_rel": value for name, value in PRNU_REL.items()}),
        ("sensor.dark_current", {"rate_e_per_s": DARK_E_PER_S}),
        ("sensor.shot_noise", {}),
        ("sensor.full_well", {"full_well_e": FULL_WELL_E}),
        ("sensor.dsnu", {f"{name}_std_e": value for name, value in DSNU_E.items()}),
        ("electronics.amplifier_noise", {"white_e": READ_E}),
        ("electronics.gain", {"gain_dn_per_e": K}),
        ("grabber.adc", {"bits": 12, "offset_dn": 40.0}),
    )
    elements = tuple(Element(name, get_source(name), get_source(name).make(values)) for name, values in chain)
    return Camera("linear", (SIDE, SIDE), elements, unit_seed=unit_seed)


def write_descriptor(folder: Path) -> Path:
    """Write the frames of a simulated series as EMVA 1288 descriptor: nanoseconds, photons per pixel, one path a line."""
    lines = ["v 3.0", f"n 12 {SIDE} {SIDE}"]
    for group in load_yaml(folder / "campaign.yaml")["frames"]:
        exposure_ns = f"{group['exposure_s'] * 1e9:.3f}"
        lines.append(f"b {exposure_ns} {group['photons']!r}" if group["kind"] == "bright" else f"d {exposure_ns}")
        lines += [f"i {name}" for name in group["files"]]
    path = folder / "EMVA1288_Data.txt"
    path.write_text("\n".join(lines) + "\n")
    return path


@pytest.fixture(scope="module")
def reference(request: pytest.FixtureRequest, tmp_path_factory) -> dict:
    seed = int(rng_of(request).integers(2**40))
    series = {
        "levels": LEVELS,
        "brightest_photons": BRIGHTEST_E / ETA,
        "longest_exposure_s": LONGEST_S,
        "stack_frames": STACK,
        "stack_rel": STACK_REL,
    }
    folder = simulate(
        camera(seed), {"schema": "pixmetry/scene/1", "photon_transfer": series}, tmp_path_factory.mktemp("oracle") / "series", seed=seed
    )
    script = ROOT / "scripts" / "oracles" / "emva1288_results.py"
    done = subprocess.run([str(PYTHON), str(script), str(write_descriptor(folder))], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


def gain_error(last: int) -> float:
    """Sampling error of K: the slope through 0 of variance differences, each variance of N pixel pairs good to √(2/N) of itself."""
    share = np.arange(1, last + 2) / LEVELS
    x = K * BRIGHTEST_E * share
    dark = K**2 * (READ_E**2 + DARK_E_PER_S * LONGEST_S * share) + 1 / 12
    bright = dark + K * x
    u2 = 2 / SIDE**2 * (bright**2 + dark**2)
    return float(np.sqrt(np.sum(x**2 * u2)) / np.sum(x**2))


def dark_noise_error(gain_u: float) -> float:
    """Sampling error of the dark noise: the line's value at no exposure, less 1/12, its root over K."""
    share = np.arange(1, LEVELS + 1) / LEVELS
    variance = K**2 * (READ_E**2 + DARK_E_PER_S * LONGEST_S * share) + 1 / 12
    design = np.column_stack([share, np.ones(LEVELS)])
    weights = np.linalg.pinv(design)[1]
    u = np.sqrt(np.sum(weights**2 * 2 / SIDE**2 * variance**2)) / (2 * READ_E * K**2)
    return float(np.hypot(u, READ_E * gain_u / K))


def dark_current_error(gain_u: float) -> float:
    """Sampling error of the slope of the dark means, each of 2 N pixels."""
    share = np.arange(1, LEVELS + 1) / LEVELS
    variance = (READ_E**2 + DARK_E_PER_S * LONGEST_S * share + 1 / 12 / K**2) / (2 * SIDE**2)
    weights = np.linalg.pinv(np.column_stack([share * LONGEST_S, np.ones(LEVELS)]))[0]
    return float(np.hypot(np.sqrt(np.sum(weights**2 * variance)), DARK_E_PER_S * gain_u / K))


def spatial_errors(part: str, gain_u: float) -> tuple[float, float]:
    """Sampling errors of DSNU in electrons and of PRNU, of pixels, rows or columns.

    Of n independent values, the variance of a sum of parts p, d, r scatters by 2/n (p² + d² + r²)². In bright minus dark the dark
    pattern d cancels but for its products with the other parts. r: what temporal noise (and, for rows and columns, the pixels) leaves.
    """
    signal = BRIGHTEST_E * STACK_REL
    dark_e = DARK_E_PER_S * LONGEST_S * STACK_REL
    rest_dark = (READ_E**2 + dark_e + 1 / 12 / K**2) / STACK
    rest_bright = rest_dark + signal / STACK
    n = SIDE**2
    if part != "pixel":
        n = SIDE
        rest_dark = (rest_dark + DSNU_E["pixel"] ** 2) / SIDE
        rest_bright = (rest_bright + DSNU_E["pixel"] ** 2 + (PRNU_REL["pixel"] * signal) ** 2) / SIDE
    p, d = (PRNU_REL[part] * signal) ** 2, DSNU_E[part] ** 2
    u_dsnu = np.hypot(np.sqrt(2 / n) * (d + rest_dark) / (2 * np.sqrt(d)), np.sqrt(d) * gain_u / K)
    u2 = 2 / n * (p**2 + rest_bright**2 + rest_dark**2 + 2 * (p * d + p * rest_bright + d * rest_bright + d * rest_dark))
    return float(u_dsnu), float(np.sqrt(u2) / (2 * np.sqrt(p)) / signal)


def test_reference_finds_what_was_put_in(reference: dict) -> None:
    """Gain, efficiency, dark noise, dark current, DSNU and PRNU of pixels, rows and columns.

    Catches with 99 % (7.2 times its sampling error): gain 0.5 %, dark noise 0.9 %, dark current 0.6 %, DSNU and PRNU of pixels 1.2 % and
    1.0 %, of rows and columns 24 %.
    """
    gain_u = gain_error(int(reference["index_sensitivity_max"]))
    expected = {
        "K": (K, gain_u),
        "QE": (100 * ETA, 100 * ETA * gain_u / K),
        "sigma_d": (READ_E, dark_noise_error(gain_u)),
        "u_I_mean": (DARK_E_PER_S, dark_current_error(gain_u)),
    }
    for part in DSNU_E:
        u_dsnu, u_prnu = spatial_errors(part, gain_u)
        expected |= {f"DSNU1288_{part}": (DSNU_E[part], u_dsnu), f"PRNU1288_{part}": (100 * PRNU_REL[part], 100 * u_prnu)}
    z = {name: (reference[name] - value) / u for name, (value, u) in expected.items()}
    for name, (value, u) in expected.items():
        print(f"{name:<16} put in {value:9.4f}   found {reference[name]:10.5f}   u {u:8.5f} ({100 * u / value:.2f} %)   z {z[name]:+.2f}")
    assert all(abs(value) < Z for value in z.values()), z


def test_reference_sees_the_saturation(reference: dict) -> None:
    """The variance falls where pixels begin to fill up: within 4 standard deviations of noise and response below the full well."""
    found = BRIGHTEST_E * (reference["index_u_ysat"] + 1) / LEVELS
    spread = np.sqrt(FULL_WELL_E) + PRNU_REL["pixel"] * FULL_WELL_E
    assert FULL_WELL_E - 4 * spread < found < FULL_WELL_E
