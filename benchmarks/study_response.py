"""Response curves from charts and scenes: does u hold? ``python benchmarks/study_response.py [--cameras 40] [--seed 1]``.

Random cameras of five kinds of response see a chart of 14 patches in uneven light (5 %), with glare and densities off by 2 %; and one scene
at eight exposures off by 0.2 %. Shot noise, read noise, PRNU and rounding are on. Each value is compared with what the camera was made
with: mean and rms of z = (value − truth)/u, and median u. What was not found, or found as another curve, is counted.
"""

from __future__ import annotations

import argparse
import sys
from collections import Counter, defaultdict
from collections.abc import Callable
from pathlib import Path

import numpy as np

from pixmetry import Frames, campaign_of_arrays
from pixmetry.assess.job import observe_campaign
from pixmetry.camera.group_facts import GroupFacts
from pixmetry.camera.response import Response, toed_power
from pixmetry.core.progress import no_progress

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "tests"))
from observe.chart_pictures import TOP, expose, field_of, knee, power, wedge  # noqa: E402

Curve = Callable[[np.ndarray], np.ndarray]
DENSITIES = np.linspace(0.05, 2.0, 14)
WHITE_E, KT_V = 9000.0, 0.0252617  # kT/q at 20 °C


def toed(x: np.ndarray) -> np.ndarray:
    """The continuous curve of BT.709."""
    return np.asarray(np.sign(x) * TOP * toed_power(np.abs(x) / TOP, 0.45, "bt709"))


def chart(rng: np.random.Generator, curve: Curve, **kw: float) -> list[Frames]:
    """A chart in uneven light, with glare; dark frames."""
    light, _ = wedge(DENSITIES + rng.normal(0, 0.02 / np.log(10), len(DENSITIES)), WHITE_E * rng.uniform(0.7, 1.0))
    light = (light + abs(rng.normal(0, 0.0042)) * WHITE_E) * field_of(light.shape, *rng.normal(0, 0.05, 3))
    prnu = 1 + 0.005 * rng.standard_normal(light.shape)
    facts = GroupFacts(densities=tuple(DENSITIES), u_light_rel=0.02)
    return [
        Frames("chart", None, expose(rng, light, curve, prnu=prnu, **kw), facts=facts),
        Frames("dark", 0.01, expose(rng, np.zeros(light.shape), curve, **kw)),
    ]


def scene(rng: np.random.Generator, curve: Curve, **kw: float) -> list[Frames]:
    """Blocks of many levels at eight exposures; dark frames."""
    light = np.repeat(np.repeat(4000 * 10 ** rng.uniform(-0.8, 1.6, (8, 10)), 16, 0), 16, 1)
    prnu = 1 + 0.005 * rng.standard_normal(light.shape)
    frames = [Frames("dark", 0.01, expose(rng, np.zeros(light.shape), curve, **kw))]
    for k in range(8):
        e = light * 2.0 ** (k - 7) * np.exp(rng.normal(0, 0.002))
        frames.append(Frames("chart", 0.001 * 2.0**k, expose(rng, e, curve, prnu=prnu, **kw), facts=GroupFacts(u_light_rel=0.002)))
    return frames


def cameras(rng: np.random.Generator) -> dict[str, tuple[Curve, dict[str, float], dict[str, float]]]:
    """By the name of the curve: the curve, how it is exposed, and what is true of it."""
    gamma, at, slope = rng.uniform(0.4, 0.8), rng.uniform(1000, 2200), rng.uniform(0.2, 0.7)
    gain, foot = rng.uniform(0.3, 0.5), 10 ** rng.uniform(1.5, 3)
    known = {"gain": gain}
    return {
        "linear": (lambda x: x, known, {}),
        "power": (power(gamma), known, {"gamma": gamma, "gain_dn_per_e": gain}),
        "bt709": (toed, known, {"gamma": 0.45, "reference_dn": TOP, "gain_dn_per_e": gain}),
        "knee": (knee(at, slope), known, {"switch_dn": at, "mismatch_rel": slope - 1, "gain_dn_per_e": gain}),
        "log": (
            lambda x: 300 * np.log1p(np.maximum(x, 0) / foot),
            {"gain": gain, "dark_noise_e": 0.0, "noise_dn": 1.0},
            {"gain_dn_per_v": 300 / KT_V, "foot_e": foot / gain},
        ),
    }


def response(frames: list[Frames]) -> Response:
    """What an assessment finds."""
    found = observe_campaign(campaign_of_arrays(frames, bits=12), no_progress)[1].response
    assert found is not None
    return found


def main() -> None:
    """Run the study and print its table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cameras", type=int, default=40)
    parser.add_argument("--seed", type=int, default=1)
    asked = parser.parse_args()
    rng = np.random.default_rng(asked.seed)
    scores: dict[tuple[str, str, str], list[tuple[float, float]]] = defaultdict(list)
    others: dict[tuple[str, str], Counter[str]] = defaultdict(Counter)
    for _ in range(asked.cameras):
        for curve, (bend, how, truth) in cameras(rng).items():
            for name, take in (("chart", chart), ("scene", scene)):
                found = response(take(rng, bend, **how))
                if found.curve != curve:
                    others[curve, name][found.curve or "refused"] += 1
                    continue
                for quantity, value in truth.items():
                    if quantity in found.fit:
                        number = found.fit[quantity]
                        scores[curve, name, quantity].append(((number.value - value) / number.u, number.u / abs(value)))
    print(f"{'curve':8}{'from':8}{'quantity':16}{'n':>4}{'mean z':>8}{'rms z':>8}{'u, relative':>13}")
    for (curve, name, quantity), values in scores.items():
        z, u = np.array(values).T
        print(f"{curve:8}{name:8}{quantity:16}{len(z):4}{z.mean():8.2f}{np.sqrt((z**2).mean()):8.2f}{np.median(u):13.2g}")
    for (curve, name), counts in others.items():
        print(f"{curve} from a {name}: found as {dict(counts)}")


if __name__ == "__main__":
    main()
