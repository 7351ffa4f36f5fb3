"""Other people's simulated cameras, taken for real ones: what we say of their image files, against the parameters that were put in.

The simulators (the one of the public EMVA 1288 reference implementation, and getframes) run in an environment and processes of their own
(``make oracles``); nothing comes back but image files, a descriptor and the noise-free images. All comparisons of this file together fail
by chance with a probability of 1e-6.

Quantisation. getframes rounds to the nearest code, as the standard has it: variance 1/12 DN². The reference's simulator adds an even
deviate of ±½ DN and then rounds. The rounded sum x + w of a fixed x and such a w is one of the two codes next to x, with the chances
1 − f and f, f being the fraction of x: without bias, with the variance f (1 − f), which over all fractions is 1/6 DN². As 1/12 DN² is
taken off, its dark noise must be found to be √(σ_d² + 1/(12 K²)).
"""

from __future__ import annotations

import json
import subprocess
from pathlib import Path

import numpy as np
import pytest
from scipy import stats

from emva.truths import filter_gains, high_passed
from pixmetry.emva.job import emva1288

ROOT = Path(__file__).resolve().parents[2]
PYTHON = ROOT / ".venv-oracles" / "bin" / "python"
ALPHA = 1e-6
PARTS = ("", "_row", "_col", "_pixel")

REFERENCE = {
    "coarse": {"K": 0.1, "bits": 10, "sigma2_dark_0": 36.0, "dark_signal_0": 60.0, "blackoffset": 20.0},
    "fine": {"K": 0.3, "bits": 12, "sigma2_dark_0": 49.0, "dark_signal_0": 60.0, "blackoffset": 20.0},
    "finer": {"K": 1.03, "bits": 12, "sigma2_dark_0": 4.0, "dark_signal_0": 25.0, "blackoffset": 10.0},
    "dark current": {"K": 0.7, "bits": 14, "sigma2_dark_0": 100.0, "dark_signal_0": 90.0, "blackoffset": 30.0, "dark_current_ref": 20000},
}
GETFRAMES = {
    "coarse": {"gain_e_per_adu": 9.0, "bit_depth": 10, "read_noise_e": 7.0, "dark_current_e_per_s": 300.0},
    "fine": {"gain_e_per_adu": 3.2, "bit_depth": 12, "read_noise_e": 5.0, "dark_current_e_per_s": 800.0},
    "finer": {"gain_e_per_adu": 0.9, "bit_depth": 12, "read_noise_e": 2.0, "dark_current_e_per_s": 50.0},
    "dark current": {"gain_e_per_adu": 1.5, "bit_depth": 14, "read_noise_e": 9.0, "dark_current_e_per_s": 20_000.0},
}
# values compared: K, QE, sigma_d, and each part of DSNU and PRNU that the simulator has, for two releases
COMPARISONS = 2 * (len(REFERENCE) * (3 + 2 * 4) + len(GETFRAMES) * (3 + 2 * 2))

pytestmark = [
    pytest.mark.oracle,
    pytest.mark.skipif(not PYTHON.exists(), reason=f"{PYTHON.parent.parent.name} is not there: make oracles"),
]


def taken(script: str, case: dict, folder: Path) -> dict:
    """Run a simulator; what it prints."""
    (folder / "case.json").write_text(json.dumps(case))
    command = [str(PYTHON), str(ROOT / "scripts" / "oracles" / script), str(folder / "case.json"), str(folder)]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


def patterns(printed: dict, release: str, gain: float) -> dict[str, float]:
    """DSNU (electrons) and PRNU (%) of the noise-free images, with release 4.0 after its high-pass filter."""
    dark, bright = np.load(printed["dark"]), np.load(printed["bright"])

    def squares(image: np.ndarray) -> np.ndarray:
        """Of all, rows, columns and pixels."""
        if release == "4.0":
            shown, gains = high_passed(image), filter_gains(image.shape)
        else:
            # s² = s²_pixel + s²_row + s²_col, s²_rav = s²_row + s²_pixel/N, s²_cav = s²_col + s²_pixel/M
            shown, gains = image, [[1, 1, 1], [1 / image.shape[1], 1, 0], [1 / image.shape[0], 0, 1]]
        pixel, row, col = np.linalg.solve(gains, [shown.var(), shown.mean(axis=1).var(), shown.mean(axis=0).var()])
        return np.array([pixel + row + col, row, col, pixel])

    signal, of_dark = bright.mean() - dark.mean(), squares(dark)
    with np.errstate(invalid="ignore"):  # a simulator without rows and columns has chance ones only
        prnu = 100 * np.sqrt(squares(bright) - of_dark) / signal
        dsnu = np.sqrt(of_dark) / gain
    named = {"DSNU1288": dsnu, "PRNU1288": prnu}
    return {f"{key}{part}": float(v) for key, values in named.items() for part, v in zip(PARTS, values, strict=True)}


def compare(descriptor: str, release: str, expected: dict[str, float]) -> None:
    values = emva1288(descriptor, release=release).results[0].values
    failed = {}
    for key, truth in expected.items():
        found = values[key]
        z = (found.value - truth) / found.u
        p = 2 * stats.t.sf(abs(z), min(found.dof, 1e9))
        u = f"{found.u:8.5f} ({100 * found.u / truth:.2f} %)"
        print(f"{release:4s}{key:<16} put in {truth:9.4f}   found {found.value:9.4f}   u {u}   z {z:+.2f}")
        if found.is_upper_limit or p < ALPHA / COMPARISONS:
            failed[key] = (found, truth)
    assert not failed


@pytest.mark.parametrize("name", REFERENCE)
def test_recovers_the_camera_of_the_reference_implementation(name: str, tmp_path: Path, rng: np.random.Generator) -> None:
    """Gain, efficiency, dark noise, and DSNU and PRNU with their row, column and pixel parts.

    Catches with 99 % an error of 8.1 u: 2 % of gain and efficiency, 4 % of the dark noise, 9 % of DSNU and 3 % of PRNU, 26 % and 10 % of
    their rows and columns.
    """
    seed = int(rng.integers(2**30))
    case = {"seed": seed, "rows": 128, "cols": 160, "u_esat": 1e9, "dark_current_ref": 30, "exposure_max_ns": 2e7, "steps": 50, "L": 50}
    case |= {"dsnu_e": [2.0, 0.8, 1.0], "prnu_rel": [0.008, 0.002, 0.003]} | REFERENCE[name]
    printed = taken("emva1288_simulator.py", case, tmp_path)
    gain = printed["K"]
    temporal = {"K": gain, "QE": 100 * printed["QE"], "sigma_d": np.sqrt(case["sigma2_dark_0"] + 1 / (12 * gain**2))}
    for release in ("4.0", "3.1"):
        compare(printed["descriptor"], release, temporal | patterns(printed, release, gain))


@pytest.mark.parametrize("name", GETFRAMES)
def test_recovers_the_camera_of_getframes(name: str, tmp_path: Path, rng: np.random.Generator) -> None:
    """Gain, efficiency, dark noise, DSNU and PRNU (it has no rows and columns); catches the same errors."""
    seed = int(rng.integers(2**30))
    config = {"resolution": [128, 160], "quantum_efficiency": 0.6, "full_well_e": 1e6, "bias_offset_adu": 50.0, "prnu": 0.008}
    config |= {"bias_pixel_spread_adu": 0.7, "dark_current_nonuniformity": 0.05, "fixed_pattern_seed": seed} | GETFRAMES[name]
    gain, longest = 1 / config["gain_e_per_adu"], 0.02
    capacity = (2 ** config["bit_depth"] - 51) / gain - config["dark_current_e_per_s"] * longest
    case = {"seed": seed, "levels": 50, "L": 50, "longest_s": longest, "brightest_photons": 1.08 * capacity / 0.6, "config": config}
    printed = taken("getframes_simulator.py", case, tmp_path)
    temporal = {"K": gain, "QE": 60.0, "sigma_d": config["read_noise_e"]}
    for release in ("4.0", "3.1"):
        spatial = {key: value for key, value in patterns(printed, release, gain).items() if not key.endswith(("_row", "_col"))}
        # what a photon's count is worth, the sensor's own mean response included
        mean = (np.load(printed["bright"]).mean() - np.load(printed["dark"]).mean()) / gain
        light = 0.5 * case["brightest_photons"]
        compare(printed["descriptor"], release, temporal | {"QE": 100 * mean / light} | spatial)
