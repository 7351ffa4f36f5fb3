"""Locating discs, beside other programs: ``python benchmarks/bench_locate.py [--frames N] [--full] [--repeats N] [--no-peers]``.

Frames of 2048 × 2048 pixels with 2000 discs of radius 3 to 8 px at random sub-pixel places that do not touch: 170 DN above a background
of 10 DN, edges Φ((R − ρ)/.757), noise 1.5 DN, rounded to 8 bits; as many with dark discs (170 below 180). N frames of each kind (20 with
--full). The table has for each program the time of the whole frame on two threads (shortest of the repeats, all in the same run), how
many discs were found (a place within 1.5 px) and how many places are none, the mean offset in x and y (where its origin is), and the
error: rms per coordinate about that offset, over the Cramér–Rao bound for unknown place, height, background, radius and edge, which is
computed here, by differences of the images. Some slow peers are given the places of a few discs that stand alone, and measure them only.
"""

from __future__ import annotations

import argparse
import sys
import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import peers_locate as peers
from goals import verdict
from scipy.spatial import cKDTree

from pixmetry.core.threads import set_threads
from pixmetry.locate.job import locate
from pixmetry.locate.track.tracker import Tracker

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))
from locate import line_frames, rendered  # noqa: E402

NOISE_DN, EDGE_S, AMPLITUDE_DN = 1.5, 0.757, 170.0
BACKGROUND_DN = {False: 10.0, True: 180.0}  # bright discs, dark discs
OURS = (
    "template",
    "poisson_gaussian",
    "soft_threshold",
    "squared_centroid",
    "centroid",
    "hard_threshold",
    "windowed_centroid",
    "perimeter",
    "forstner",
    "ellipse_edges",
    "gaussian",
)
CENTROIDS = ("soft_threshold", "squared_centroid", "centroid")
THREADS = 2
ALONE_PX = 30.0  # distance to the next disc of those that slow peers are given


@dataclass
class Frame:
    """One frame, what is in it, and the least variance of a coordinate of each disc."""

    dark: bool
    image: np.ndarray
    x: np.ndarray
    y: np.ndarray
    least_var: np.ndarray
    tree: cKDTree = field(init=False)

    def __post_init__(self) -> None:
        self.tree = cKDTree(np.stack([self.x, self.y], axis=1))


@dataclass
class Score:
    """What a program did, summed over frames."""

    wanted: int = 0
    found: int = 0
    false: int = 0
    seconds: list[float] = field(default_factory=list)
    errors: list[np.ndarray] = field(default_factory=list)
    least: list[np.ndarray] = field(default_factory=list)

    def add(self, frame: Frame, x: np.ndarray, y: np.ndarray, which: np.ndarray | None = None) -> None:
        """Count places; a disc that is found twice counts once as found and once as false."""
        self.wanted += len(frame.x) if which is None else len(which)
        if not len(x):
            return
        good = np.isfinite(x) & np.isfinite(y)
        distance, index = frame.tree.query(np.stack([x[good], y[good]], axis=1))
        order = np.argsort(distance)
        order = order[distance[order] < 1.5]
        _, first = np.unique(index[order], return_index=True)
        hit = order[first]
        self.found += len(hit)
        self.false += len(x) - len(hit)
        self.errors.append(np.stack([x[good][hit] - frame.x[index[hit]], y[good][hit] - frame.y[index[hit]]]))
        self.least.append(frame.least_var[index[hit]])

    def offset_px(self) -> np.ndarray:
        """Mean error in x and y."""
        return np.concatenate(self.errors, axis=1).mean(axis=1)

    def over_bound(self) -> float:
        """Rms error of a coordinate about its mean, over the rms of the bound."""
        return float(np.sqrt(np.concatenate(self.errors, axis=1).var(axis=1).mean() / np.concatenate(self.least).mean()))

    def line(self, name: str) -> str:
        """One line of the table."""
        text = f"{name:<28}{1e3 * min(self.seconds):10.1f}{self.found:8d}{self.wanted - self.found:8d}{self.false:7d}"
        if self.errors:
            text += "{:+10.4f}{:+9.4f}".format(*self.offset_px()) + f"{self.over_bound():9.2f}"
        return text


def least_variance(radius: float, dx: float, dy: float) -> float:
    """Cramér–Rao bound of a coordinate (mean of x and y), px², with the place, height, background, radius and edge unknown."""
    at = rendered.window(0.0, 0.0, radius + 6 * EDGE_S)

    def mean(p: np.ndarray) -> np.ndarray:
        return p[3] + p[2] * rendered.edge_disc(p[0], p[1], p[4], p[5], at)

    covariance = rendered.bound(mean, (dx, dy, AMPLITUDE_DN, 10.0, radius, EDGE_S), NOISE_DN**2 + 1 / 12)
    return 0.5 * (covariance[0, 0] + covariance[1, 1])


def make_frame(
    rng: np.random.Generator, dark: bool, shape: tuple[int, int] = (2048, 2048), count: int = 2000, radii: tuple[float, float] = (3.0, 8.0)
) -> Frame:
    """Render one frame and compute its discs' bounds."""
    sign = -1.0 if dark else 1.0
    mean, x, y, radius = rendered.discs_frame(
        rng, shape=shape, count=count, radii=radii, amplitude=sign * AMPLITUDE_DN, background=BACKGROUND_DN[dark], edge_s=EDGE_S
    )
    least = np.array([least_variance(*disc) for disc in zip(radius, x - np.rint(x), y - np.rint(y), strict=True)])
    return Frame(dark, rendered.expose(mean, rng, read_dn=NOISE_DN), x, y, least)


def best_s(action: Callable[[], object], rounds: int) -> float:
    """Shortest of several runs, after one that compiles."""
    action()
    times = []
    for _ in range(rounds):
        start = time.perf_counter()
        action()
        times.append(time.perf_counter() - start)
    return min(times)


def by_us(estimator: str) -> Callable[[np.ndarray, bool], peers.Found]:
    """Our estimator as a function like those of the peers; the polarity is not told."""

    def run(image: np.ndarray, dark: bool) -> peers.Found:
        table = locate(image, kind="disc", estimator=estimator, threads=THREADS)
        return table.x_px, table.y_px

    return run


def score_all(programs: dict[str, Callable], frames: list[Frame], repeats: int, selected: int = 0) -> dict[str, Score]:
    """Run every program on every frame; the repeats for the time are on the first frame, program after program."""
    scores = {name: Score() for name in programs}
    picks = [alone(frame, selected) if selected else None for frame in frames]
    for i, (frame, pick) in enumerate(zip(frames, picks, strict=True)):
        places = () if pick is None else (frame.x[pick], frame.y[pick])
        for repeat in range(1 + repeats if i == 0 else 1):
            for name, program in programs.items():
                start = time.perf_counter()
                x, y = program(frame.image, frame.dark, *places)
                if i == 0 and repeat > 0:
                    scores[name].seconds.append(time.perf_counter() - start)
                if repeat == 0:
                    scores[name].add(frame, x, y, pick)
    return scores


def alone(frame: Frame, count: int) -> np.ndarray:
    """Numbers of some discs that stand alone."""
    next_px = frame.tree.query(frame.tree.data, k=2)[0][:, 1]
    return np.flatnonzero(next_px > ALONE_PX)[:count]


def stages(frame: Frame, repeats: int) -> None:
    """Detection alone, the fit alone."""
    from pixmetry.locate.detect.detection import detect, select
    from pixmetry.locate.template.image_noise import noise_from_image
    from pixmetry.locate.template.template import fit_template

    found = detect(frame.image)
    targets = found.targets[select(found.targets, "disc")]
    noise = noise_from_image(frame.image, targets, "disc")
    print(f"detection alone       {1e3 * best_s(lambda: detect(frame.image), repeats):8.1f} ms")
    print(f"noise from the image  {1e3 * best_s(lambda: noise_from_image(frame.image, targets, 'disc'), repeats):8.1f} ms")
    fit_s = best_s(lambda: fit_template(frame.image, targets, noise, "disc", threads=THREADS), repeats)
    print(f"template fits alone   {1e3 * fit_s:8.1f} ms, {len(targets) / fit_s:.0f} targets/s")


def many(rng: np.random.Generator) -> None:
    """Twenty thousand targets in one frame."""
    frame = make_frame(rng, False, (4096, 4096), 20000, (2.0, 5.0))
    for name in ("template", "soft_threshold"):
        program = by_us(name)
        seconds = best_s(lambda: program(frame.image, False), 2)  # noqa: B023
        score = Score(seconds=[seconds])
        score.add(frame, *program(frame.image, False))
        print(score.line(f"20 000 targets: {name}"))


def sequences(frame: Frame, repeats: int) -> tuple[float, float]:
    """Tracking: milliseconds a call for a region of 64 × 64 pixels with one disc, and microseconds a target of the whole frame."""
    middle = int(np.argmin(np.hypot(frame.x - 1024, frame.y - 1024)))
    row, col = int(frame.y[middle]) - 32, int(frame.x[middle]) - 32
    region = np.ascontiguousarray(frame.image[row : row + 64, col : col + 64])
    one, all_of_them = Tracker(region, threads=1), Tracker(frame.image, threads=THREADS)
    call_s = best_s(lambda: one.update(region), 500 * repeats)
    plain_s = best_s(lambda: locate(region, estimator="soft_threshold", threads=1), 5 * repeats)
    whole_s = best_s(lambda: all_of_them.update(frame.image), 2 * repeats)
    print(f"tracking, soft_threshold: {1e3 * call_s:.3f} ms a call for 64 × 64 pixels ({len(one)} targets; locate {1e3 * plain_s:.2f} ms)")
    each_us = 1e6 * whole_s / len(all_of_them)
    print(f"tracking, soft_threshold: {1e3 * whole_s:.1f} ms a frame, {each_us:.1f} µs a target, {1 / whole_s:.0f} frames/s")
    if peers.available("cv2"):
        import cv2

        def by_components() -> object:
            level = float(frame.image.mean() + 85)
            return cv2.connectedComponentsWithStats(cv2.threshold(region, level, 255, cv2.THRESH_BINARY)[1])

        print(f"OpenCV, threshold and connected components of 64 × 64 pixels: {1e3 * best_s(by_components, 100 * repeats):.3f} ms")
    return 1e3 * call_s, each_us


def lines(rng: np.random.Generator, repeats: int) -> tuple[float, float, float]:
    """Lines a second of the template alone, and the rms error of its offsets and of the row-wise squared centroid's over the bound."""
    from pixmetry.locate.lines.line_detection import find_lines
    from pixmetry.locate.lines.lines import line_positions
    from pixmetry.locate.noise import NoiseModel

    bars = line_frames.Bars(width=1.0, blur=1.0)
    frame = line_frames.make_lines(rng, 400, (2600, 2600), bars)
    found, noise = find_lines(frame.image), NoiseModel(NOISE_DN**2 + 1 / 12)
    fit_s = best_s(lambda: line_positions(frame.image, found, noise, estimator="template", threads=THREADS), repeats)
    whole_s = best_s(lambda: locate(frame.image, kind="line", estimator="template", threads=THREADS), 2)
    print(f"{len(found)} lines of {bars.length:g} px: template alone {len(found) / fit_s:.0f} lines/s; whole frame {1e3 * whole_s:.0f} ms")
    least = np.mean([bars.least_offset_var(angle) for angle in frame.angle_deg[:40]])
    over = []
    for name in ("template", "row_squared_centroid"):
        error, _, false = line_frames.offsets(frame, locate(frame.image, kind="line", estimator=name, threads=THREADS))
        over.append(float(np.sqrt(np.mean(error**2) / least)))
        print(f"lines, {name}: {len(error)} of {len(frame.x)} found, {false} false, {over[-1]:.2f} × the bound of {np.sqrt(least):.5f} px")
    return len(found) / fit_s, over[0], over[1]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--frames", type=int, default=1, help="of each polarity")
    parser.add_argument("--full", action="store_true", help="twenty frames of each polarity")
    parser.add_argument("--repeats", type=int, default=5, help="runs of which the shortest counts")
    parser.add_argument("--no-peers", action="store_true")
    parser.add_argument("--seed", type=int, default=None)
    args = parser.parse_args()
    warnings.filterwarnings("ignore")  # those of the peers
    set_threads(THREADS)
    seed = np.random.SeedSequence(args.seed).entropy
    rng = np.random.default_rng(seed)
    frames = [make_frame(rng, dark) for _ in range(20 if args.full else args.frames) for dark in (False, True)]
    bound = np.sqrt(np.concatenate([f.least_var for f in frames]).mean())
    print(f"{len(frames)} frames, {sum(len(f.x) for f in frames)} discs, seed {seed}; bound {bound:.5f} px rms per coordinate")

    ours = score_all({name: by_us(name) for name in OURS}, frames, args.repeats)
    whole = {n: f for n, (module, f) in peers.WHOLE.items() if not args.no_peers and peers.available(module)}
    if whole and peers.available("cv2"):
        import cv2

        cv2.setNumThreads(THREADS)
    theirs = score_all(whole, frames, min(args.repeats, 2))
    few = {n: f for n, (module, f) in peers.AT_PLACES.items() if not args.no_peers and peers.available(module)}
    given = score_all(few, frames[:2], 1, selected=100)
    print(f"\n{'':<28}{'ms':>10}{'found':>8}{'missed':>8}{'false':>7}{'off x':>10}{'off y':>9}{'× bound':>9}")
    for name, score in {**ours, **theirs}.items():
        print(score.line(name))
    for name, score in given.items():
        print(score.line(name) + f"   (places given; {score.wanted / len(frames[:2]) / min(score.seconds):.0f} targets/s)")
    print()
    stages(frames[0], args.repeats)
    call_ms, target_us = sequences(frames[0], args.repeats)
    many(rng)
    lines_per_s, line_template, line_rows = lines(rng, args.repeats)
    print()
    verdict("discs missed", sum(s.wanted - s.found for s in (ours["template"], ours["soft_threshold"])), 0)
    verdict("false discs", sum(s.false for s in (ours["template"], ours["soft_threshold"])), 0)
    verdict("template over the bound", ours["template"].over_bound(), 1.05)
    verdict("soft-threshold centroid over the bound", ours["soft_threshold"].over_bound(), 1.25)
    verdict("template, whole frame", 1e3 * min(ours["template"].seconds), 60, " ms")
    for name in CENTROIDS:
        verdict(f"{name}, whole frame", 1e3 * min(ours[name].seconds), 15, " ms")
    verdict("tracking, a call", call_ms, 0.15, " ms")
    verdict("tracking, a target", target_us, 30, " µs")
    verdict("line template", lines_per_s, 5000, " lines/s", at_least=True)
    verdict("line template over the bound", line_template, 1.05)
    verdict("row-wise squared centroid of lines over the bound", line_rows, 1.2)


if __name__ == "__main__":
    main()
