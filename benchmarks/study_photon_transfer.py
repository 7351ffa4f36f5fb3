"""How honest is the uncertainty of the photon-transfer fit, and how far is it from the best that the data allow?

    python benchmarks/study_photon_transfer.py --cameras 1000 --framed 40 --seed 1

Random cameras (gain 0.01-5 DN/e-, dark noise 2-100 e-, 8-14 bit, row noise, dark current, a non-linearity of a few per cent, 10-50 levels,
64 × 48 to 640 × 480 pixels, lamp noise 0-0.2 %). For each value: the Kolmogorov-Smirnov probability that (estimate − truth)/u follows
Student's t with the stated degrees of freedom, and u over that of two references:

* ``bound``: the Cramér-Rao bound of the same data with all weights and variance components known, the non-linearity and the light at zero
  exposure free. The estimator is held to 1.15 times this.
* ``line``: the rule of EMVA 1288, a straight line through the origin, which takes a linear camera for granted. Not finding the
  non-linearity makes its u smaller, and its value wrong.
"""

from __future__ import annotations

import argparse
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy import stats

from pixmetry.camera.observations import PhotonTransfer
from pixmetry.core.number import Number
from pixmetry.emva.evaluate import standard_values
from pixmetry.emva.records import Measurement
from pixmetry.observe.photon_transfer_fit import fit_photon_transfer

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))
from observe.simulated_camera import Camera, drawn_record, framed_record, random_camera, reference_u, truth  # noqa: E402


def line(record: PhotonTransfer, name: str) -> Number:
    """The same value by the standard's line."""
    return standard_values(Measurement(record), "3.1").values[{"gain_dn_per_e": "K", "dark_noise_e": "sigma_d"}[name]]


def collect(records, names_of_bound: bool) -> tuple[dict, dict, dict, list[float]]:
    """Probability transforms, ratios of u to the bound and whether limits hold, by name; and the time of each fit (s)."""
    p, ratio, held, seconds = {}, {}, {}, []
    for camera, record in records:
        start = time.perf_counter()
        fit = fit_photon_transfer(record)
        seconds.append(time.perf_counter() - start)
        true = truth(camera)
        bound = reference_u(camera) if names_of_bound else {}
        for e in fit:
            if e.name not in true:
                continue
            if e.kind == "upper_limit":
                held.setdefault(e.name, []).append(true[e.name] <= e.value)
                continue
            p.setdefault(e.name, []).append(stats.t.cdf((e.value - true[e.name]) / e.u, min(e.dof, 1e9)))
            if e.name in bound:
                ratio.setdefault(e.name, []).append(e.u / bound[e.name])
        if names_of_bound:
            ratio.setdefault("gain_dn_per_e, over the line", []).append(fit["gain_dn_per_e"].u / line(record, "gain_dn_per_e").u)
    return p, ratio, held, seconds


def print_tables(title: str, p: dict, ratio: dict, held: dict, seconds: list[float]) -> None:
    print(f"\n{title}; a fit takes {1e3 * np.median(seconds):.1f} ms (median), {1e3 * np.max(seconds):.1f} ms at most")
    print(f"{'value':26s} {'n':>5s} {'KS p':>8s} {'outside 95 %':>13s} {'outside 99 %':>13s}")
    for name, values in p.items():
        v = np.array(values)
        outside = [np.mean(np.abs(v - 0.5) > 0.5 - a / 2) for a in (0.05, 0.01)]
        print(f"{name:26s} {v.size:5d} {stats.kstest(v, 'uniform').pvalue:8.3g} {outside[0]:13.3f} {outside[1]:13.3f}")
    for name, values in held.items():
        print(f"limit of {name:30s} {len(values):5d} holds in {100 * np.mean(values):.1f} %")
    for name, values in ratio.items():
        low, mid, high = np.percentile(values, [5, 50, 95])
        print(f"u ratio {name:32s} 5 % {low:6.3f}  median {mid:6.3f}  95 % {high:6.3f}  rms {np.sqrt(np.mean(np.square(values))):6.3f}")


def bent_camera(rng, seeds: int) -> None:
    """Bias on a camera y(1 − 0.02 w³), 0.1 DN/e-, 30 e- dark noise, 640 × 480, 50 × 2 exposures."""
    camera = Camera(a=(0.0, 0.0, -0.02))
    records = [drawn_record(camera, rng) for _ in range(seeds)]
    print(f"\nbent camera, {seeds} records: deviation of the mean from the truth (standard error), u of one record")
    for name in ("gain_dn_per_e", "dark_noise_e"):
        true = truth(camera)[name]
        for label, find in (("joint", lambda record, name: fit_photon_transfer(record)[name]), ("line", line)):
            e = [find(r, name) for r in records]
            value = np.array([x.value for x in e]) / true - 1
            u = np.mean([x.u for x in e]) / true
            print(f"{name:16s} {label:6s} {100 * value.mean():+8.4f} % ({100 * value.std() / np.sqrt(seeds):.4f} %)  u {100 * u:.3f} %")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--cameras", type=int, default=1000, help="records drawn from the sampling law of their moments")
    parser.add_argument("--framed", type=int, default=40, help="records made from simulated frames of 128 × 96 pixels")
    parser.add_argument("--seed", type=int, default=1)
    args = parser.parse_args()
    rng = np.random.default_rng(args.seed)
    cameras = [random_camera(rng) for _ in range(args.cameras)]
    print_tables(f"{args.cameras} drawn records", *collect([(c, drawn_record(c, rng)) for c in cameras], True))
    framed = [random_camera(rng, shape=(96, 128), prnu=0.01) for _ in range(args.framed)]
    # the lamp of the simulated frames flickers from frame to frame, so the light of a level's mean does so by 1/√2 of that
    records = ((replace(c, lamp=c.lamp / np.sqrt(2)), framed_record(c, rng, shading=0.1)) for c in framed)
    print_tables(f"{args.framed} records from frames", *collect(records, False))
    bent_camera(rng, 200)


if __name__ == "__main__":
    main()
