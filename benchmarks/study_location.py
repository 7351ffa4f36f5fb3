"""Are positions as good, and as sure, as they say? ``python benchmarks/study_location.py [PART …] [--targets N] [--seed N] …``.

Parts (all by default): noise, shot, operators, phase, light, slope, saturated, lines. Discs and lines are rendered at known places by the
tests' own renderer, which integrates the blurred figure over the pixel and has nothing in common with the package, and are located with
the defaults (`pixmetry.locate`, noise measured in the image). Verdicts:

noise, shot   errors over stated uncertainties follow N(0, 1): mean, variance and distribution (Kolmogorov–Smirnov), at a false-failure
              rate of 1e-3 for the whole part, shared out among its cells and estimators;
operators     the same errors lie within 1 and 2 stated uncertainties as often as promised or more often, same rate;
phase         mean error of the template per bin of the sub-pixel phase, for every size, noise averaged out;
light         mean shift along a fall of the light of 10 % across the disc, on the surface and on the image;
slope         rms error on a background of .25 DN/px over the bound without a slope;
saturated     mean error and coverage with tops cut off, and whether each is flagged;
lines         error of the offset over its bound.
"""

from __future__ import annotations

import argparse
import itertools
import sys
from collections.abc import Iterable
from pathlib import Path

import numpy as np
from goals import verdict

from pixmetry.core.threads import set_threads
from pixmetry.locate.detect.targets import Flag
from pixmetry.locate.job import locate

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))
from locate import coverage_cells, line_frames  # noqa: E402
from locate.coverage_cells import Case, Outcome  # noqa: E402

RATE = 1e-3
EXACT = ("template", "poisson_gaussian", "centroid", "squared_centroid", "windowed_centroid")
COVERING = ("soft_threshold", "hard_threshold", "perimeter", "forstner", "ellipse_edges", "gaussian")
RADII = (1.0, 1.5, 2.0, 3.0, 5.0, 8.0, 12.0)
BLURS = (0.3, 0.7, 1.2, 2.0)
NOISES_DN = (0.5, 1.5, 4.0, 8.0)
DRAWS = 4


def noise_cells() -> list[Case]:
    """Radii, blurs and noises; where the blur takes so much of the height that a pixel's peak is less than 6 σ, the target is no target."""
    cells = [Case(radius=r, blur=s, read_dn=n) for r, s, n in itertools.product(RADII, BLURS, NOISES_DN)]
    return [c for c in cells if c.amplitude * (1 - np.exp(-(c.radius**2) / (2 * c.blur**2 + 1 / 6))) > 6 * c.read_dn]


def shot_cells() -> list[Case]:
    """Cameras whose noise is that of the electrons: from 34 to 10 000 of them at the peak, 8 and 12 bits, bright and dark targets."""
    cameras = (
        {"gain_dn_per_e": 0.05, "read_dn": 0.3},
        {"gain_dn_per_e": 0.5, "read_dn": 0.5},
        {"gain_dn_per_e": 5.0, "read_dn": 1.0},
        {"gain_dn_per_e": 0.3, "read_dn": 1.0, "amplitude": 3000.0, "background": 100.0, "bits": 12},
        {"gain_dn_per_e": 0.3, "read_dn": 1.0, "amplitude": -2500.0, "background": 2800.0, "bits": 12},
    )
    return [Case(radius=r, blur=s, **c) for c, r, s in itertools.product(cameras, (1.5, 3.0, 8.0), (0.4, 0.8, 1.5))]


def measure(
    cells: Iterable[Case], names: tuple[str, ...], rng: np.random.Generator, targets: int, told: bool
) -> list[tuple[Case, str, Outcome]]:
    """Locate with every estimator in every cell, in the same images; told: with the camera's noise model."""
    rows = []
    for case in cells:
        frame = coverage_cells.make_frame(case, rng, max(16, targets // DRAWS))
        known = {"noise": case.noise()} if told else {}
        rows += [(case, name, out) for name, out in coverage_cells.collect_all(frame, rng, names, DRAWS, **known).items()]
    return rows


def show(case: Case, name: str, out: Outcome, said: str) -> None:
    """One line of a table."""
    one, two = out.shares()
    numbers = (
        f"z std {out.z.std():.3f} mean {out.z.mean():+.3f}  in 1u {one:.1%} 2u {two:.1%}  rms/bound {out.rms_over(case.least_var()):.2f}"
    )
    lost = f"  missed {out.missed} false {out.false} unsure {out.unsure} of {out.wanted}" if out.missed or out.false or out.unsure else ""
    print(f"{name:<18} {case}: {numbers}{lost}  {said}")


def judged(rows: list[tuple[Case, str, Outcome]], covering_only: bool, everything: bool) -> None:
    """Print the cells that fail, all cells on demand, and a summary per estimator."""
    test = coverage_cells.under_covered if covering_only else coverage_cells.departures
    rate = RATE / len(rows)
    failed: dict[str, int] = {}
    for case, name, out in rows:
        empty = out.table.shape[1] == 0
        said = ["nothing located"] if empty else test(out.z, rate)
        failed[name] = failed.get(name, 0) + bool(said)
        if empty:
            print(f"{name:<18} {case}: nothing located, unsure {out.unsure} of {out.wanted}")
        elif said or everything:
            show(case, name, out, "; ".join(said))
    n = int(np.median([out.z.size for _, _, out in rows]))
    bias, spread = coverage_cells.smallest(n, rate)
    print(
        f"{len(rows)} cells × estimators, about {n} coordinates each; half of the biases of {bias:.2f} u "
        f"and of errors of u of {spread:.0%} are seen"
    )
    for name, count in failed.items():
        own = [out for _, other, out in rows if other == name and out.table.shape[1]]
        z = np.concatenate([out.z for out in own])
        missed, wanted = sum(out.missed for out in own), sum(out.wanted for out in own)
        print(
            f"{name}: all cells z std {z.std():.3f}, mean {z.mean():+.4f}; missed {missed} of {wanted}, false {sum(o.false for o in own)}"
        )
        verdict(f"{name}: cells that {'are not covered' if covering_only else 'depart from N(0, 1)'}", count, 0)


def phase_part(rng: np.random.Generator, targets: int) -> None:
    """Mean error per bin of the phase, at a tenth of the usual noise."""
    worst = 0.0
    for radius, blur in itertools.product(RADII, BLURS):
        case = Case(radius=radius, blur=blur, read_dn=0.05, bits=None)
        out = coverage_cells.collect(coverage_cells.make_frame(case, rng, targets), rng, "template")
        mean, error = coverage_cells.phase_bias(out)
        largest = float(np.abs(mean).max())
        worst = max(worst, largest)
        print(
            f"template, {case}: largest mean of a tenth of the phase {largest:.5f} ± {error.max():.5f} px, "
            f"rms {np.sqrt((out.errors**2).mean()):.5f}"
        )
    verdict("S-curve of the template, all phases and sizes", worst, 0.001, " px")


def light_part(rng: np.random.Generator, targets: int) -> None:
    """Shift along the fall of the light, at low noise so that the mean is known to .0002 px."""
    worst = 0.0
    for radius, on in itertools.product((3.0, 4.0, 5.0, 8.0), ("surface", "image")):
        case = Case(radius=radius, light=(0.1 / (2 * radius), 0.0), light_on=on, read_dn=0.5)
        frame = coverage_cells.make_frame(case, rng, targets)
        out = coverage_cells.collect(frame, rng, "template", light_on=on)
        simple = coverage_cells.collect_all(
            frame, rng, ("centroid", "squared_centroid", "soft_threshold", "perimeter", "ellipse_edges", "gaussian")
        )
        bias = out.errors.mean(axis=1)
        worst = max(worst, float(np.abs(bias).max()))
        others = ", ".join(f"{name} {o.errors[0].mean():+.4f}" for name, o in simple.items())
        print(f"{case}: template {bias[0]:+.5f} {bias[1]:+.5f}, z std {out.z.std():.3f}; {others} px")
    verdict("bias with the light plane", worst, 0.001, " px")
    for share in (0.003, 0.01, 0.03):  # where the test of significance wavers
        case = Case(light=(share / 8.0, 0.0))
        out = coverage_cells.collect(coverage_cells.make_frame(case, rng, targets), rng, "template")
        print(f"{case}: bias {out.errors[0].mean():+.5f} px, z std {out.z.std():.3f} (light {share:.1%} across)")


def slope_part(rng: np.random.Generator, targets: int) -> None:
    """Background of .25 DN/px along x and across both; the level in the frame's middle is such that nothing is cut off."""
    worst = 0.0
    for radius, slope in itertools.product((3.0, 5.0, 8.0), ((0.25, 0.0), (0.18, -0.18))):
        case = Case(radius=radius, slope=slope, background=400.0, bits=12)
        out = coverage_cells.collect(coverage_cells.make_frame(case, rng, targets), rng, "template")
        worst = max(worst, out.rms_over(case.least_var()))
        show(case, "template", out, "; ".join(coverage_cells.departures(out.z, RATE)))
    verdict("rms error on the sloping background over the bound", worst, 1.6)


def saturated_part(rng: np.random.Generator, targets: int) -> None:
    """Tops cut off at 255, little and much, and backgrounds cut off at 0."""
    worst, unflagged, withheld = 0.0, 0, 0
    for radius, amplitude, background in itertools.product((2.0, 4.0, 8.0), (245.0, 300.0, 340.0, 500.0), (10.0, 1.0)):
        case = Case(radius=radius, amplitude=amplitude, background=background)
        frame = coverage_cells.make_frame(case, rng, targets // DRAWS)
        out = coverage_cells.collect(frame, rng, "template", DRAWS)
        withheld += out.unsure
        if out.unsure < 0.5 * out.wanted:
            show(case, "template", out, "; ".join(coverage_cells.departures(out.z, RATE)))
            phase, error = coverage_cells.phase_bias(out)
            worst = max(worst, float(np.abs(phase / error).max()))
        else:
            print(f"{case}: {out.unsure} of {out.wanted} flagged as unsure")
        if amplitude > 245:
            flags = locate(frame.exposed(rng), estimator="template").flags
            unflagged += int(((flags & int(Flag.SATURATED)) == 0).sum())
    verdict("largest mean error of a tenth of the phase, in its standard errors", worst, 5.0)
    verdict("saturated targets without the flag", unflagged, 0)
    verdict("saturated targets without a position to rely on", withheld, 0)


def lines_part(rng: np.random.Generator, targets: int) -> None:
    """Offset across the line."""
    for width, blur in ((3.0, 0.7), (1.0, 1.0), (5.0, 0.5)):
        bars = line_frames.Bars(width=width, blur=blur)
        frame = line_frames.make_lines(rng, min(targets // 4, 200), (2048, 2048), bars)
        least = np.sqrt(np.mean([bars.least_offset_var(a) for a in frame.angle_deg[:20]]))
        for name, goal in (("template", 1.05), ("row_squared_centroid", 1.2)):
            error, var, false = line_frames.offsets(frame, locate(frame.image, kind="line", estimator=name))
            z = error / np.sqrt(var)
            lost = f"missed {len(frame.x) - len(error)}, false {false}"
            print(f"{name} {bars}: {lost}, mean {error.mean():+.5f} px, z std {z.std():.3f}, {coverage_cells.departures(z, RATE)}")
            verdict(f"{name}, width {width:g}, blur {blur:g}: offset over the bound", float(np.sqrt(np.mean(error**2)) / least), goal)


PARTS = {
    "noise": lambda rng, a: judged(measure(noise_cells(), a.only or EXACT, rng, a.targets, a.told), False, a.all),
    "shot": lambda rng, a: judged(measure(shot_cells(), a.only or EXACT, rng, a.targets, a.told), False, a.all),
    "operators": lambda rng, a: judged(measure(noise_cells() + shot_cells(), a.only or COVERING, rng, a.targets, a.told), True, a.all),
    "phase": lambda rng, a: phase_part(rng, a.targets),
    "light": lambda rng, a: light_part(rng, a.targets),
    "slope": lambda rng, a: slope_part(rng, a.targets),
    "saturated": lambda rng, a: saturated_part(rng, a.targets),
    "lines": lambda rng, a: lines_part(rng, a.targets),
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("parts", nargs="*", choices=[*PARTS, []], metavar="PART", help=", ".join(PARTS))
    parser.add_argument("--targets", type=int, default=1000, help="in each cell")
    parser.add_argument("--only", nargs="+", metavar="ESTIMATOR", help="of noise, shot and operators")
    parser.add_argument("--told", action="store_true", help="noise, shot and operators with the camera's noise model")
    parser.add_argument("--all", action="store_true", help="print every cell, not only those that fail")
    parser.add_argument("--seed", type=int, default=None)
    args = parser.parse_args()
    set_threads(2)
    seed = np.random.SeedSequence(args.seed).entropy
    print(f"seed {seed}, {args.targets} targets a cell")
    for name in args.parts or PARTS:
        print(f"\n{name}")
        PARTS[name](np.random.default_rng(seed), args)


if __name__ == "__main__":
    main()
