"""``pixmetry warm-up``: every kernel is compiled into the cache by running all commands on small inputs."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator
from contextlib import redirect_stderr, redirect_stdout
from functools import partial
from importlib import import_module
from importlib.resources import files
from io import StringIO
from pathlib import Path
from typing import Any

import click
import numpy as np

from pixmetry.core.compiling import tell_when_compiling
from pixmetry.core.errors import PixmetryError
from pixmetry.core.jit import PACKAGE_ROOT, Kernel, cache_folder, kernel_files
from pixmetry.core.progress import Progress, no_progress

PRESET = "imx264_like"
SERIES = "photon_transfer: {levels: 10, brightest_photons: 12000, frames_per_level: 2, stack_frames: 8}"
SHAPES = """uniform: {level_photons: 300, gradient_x_per_px: 0.0005}
blur_px: 0.6
targets:
  - {kind: disc, x_px: 30.3, y_px: 28.7, diameter_px: 9, peak_photons: 5000}
  - {kind: ellipse, x_px: 70.2, y_px: 30.8, width_px: 14, height_px: 9, angle_deg: 30, peak_photons: 5000}
  - {kind: ring, x_px: 110.5, y_px: 30.0, diameter_px: 18, inner_px: 9, peak_photons: 5000}
  - {kind: cross, x_px: 40.0, y_px: 80.0, size_px: 30, width_px: 3, angle_deg: 10, peak_photons: 3000}
  - {kind: star, x_px: 100.0, y_px: 90.0, diameter_px: 44, inner_px: 3, sectors: 24, peak_photons: 3000}
  - {kind: bars, x_px: 50.0, y_px: 120.0, period_px: 5, count: 6, length_px: 20, angle_deg: 2, peak_photons: 3000}
  - {kind: edge, x_px: 140.0, y_px: 80.0, angle_deg: 5, peak_photons: 3000}
  - {kind: sine, period_px: 8, angle_deg: 10, mean_photons: 100, contrast_rel: 0.8}
motion: {velocity_px_per_s: [30, 0]}
lighting: {surface: glossy, lamp_px: [400, 0, 900], camera_distance_px: 1500, tilt_x_deg: 12, lobe_gain: 2, lobe_exponent: 60}"""
DISCS = "uniform: {level_photons: 300}\ndiscs: {lattice_px: 30, diameter_px: 7, peak_photons: 5000}"
SPOT = """uniform: {level_photons: 50}
spot: {x_px: 60, y_px: 60, radius_px: 8, peak_photons: 4000, wavelength_um: 0.67, f_number: 16, pitch_um: 8.6, contrast_rel: 0.7}"""
PLATE = """uniform: {{level_photons: 150}}
blur_px: 0.7
plate:
  {plate}
  peak_photons: 9000
  pose: {{principal_distance_px: 2000, z_mm: 1000, omega_deg: {omega}, phi_deg: {phi}, kappa_deg: {kappa}}}"""
PLATES = {
    "chessboard": "kind: chessboard\n  rows: 7\n  columns: 9\n  square_mm: 20",
    "dots": "kind: dots\n  rows: 7\n  columns: 9\n  pitch_mm: 20\n  diameter_mm: 9",
}
BOUNDS = ("disc --radius 3.5", "ellipse --semi-major 5 --semi-minor 3", "ring --radius 6 --inner-radius 3", "line --length 50")
POSES = ((0, 0, 0), (25, 5, 0), (-25, 5, 90), (5, 25, 0), (5, -25, 90), (20, 20, 45))
TYPES = (np.uint8, np.uint16, np.float32)
Job = tuple[str, Callable[[], object]]


@click.command("warm-up")
def warm_up() -> None:
    """Compile the kernels of all commands, so that no command waits for it later.

    Kernels are compiled for this processor when they are first needed: once after an installation or an upgrade. The first run of a command
    therefore takes a minute or so longer. `pixmetry warm-up` compiles all kernels at once, in some minutes. It stores them in the folder
    that PIXMETRY_CACHE_DIR names, otherwise in the user's cache.
    """
    import time

    from pixmetry.cli._progress import shown_progress

    tell_when_compiling(None)
    begun = time.monotonic()
    with shown_progress() as progress:
        count, folder = compile_kernels(progress)
    where = f"kept in {folder}" if folder is not None else "lost when this command ends, because no cache folder can be written"
    click.echo(f"{count} kernels, compiled now or before, in {time.monotonic() - begun:.0f} s; they are {where}")


def compile_kernels(progress: Progress | None = None) -> tuple[int, Path | None]:
    """Compile all kernels into the cache on disk, where they are not there yet.

    Parameters
    ----------
    progress : callable (what, done, of), optional

    Returns
    -------
    int
        How many kernels there are.
    Path or None
        Folder of the cache; None if none can be written to.
    """
    told = progress or no_progress
    with tempfile.TemporaryDirectory(prefix="pixmetry-warm-up-") as name:
        jobs = list(jobs_in(Path(name)))
        for i, (_, job) in enumerate(jobs):
            told("compiling", i, len(jobs))
            try:
                job()
            except PixmetryError:
                continue  # the input is too small to be measured; the kernels up to there are compiled
        told("compiling", len(jobs), len(jobs))
    return len(all_kernels()), cache_folder()


def all_kernels() -> dict[str, Kernel[..., Any]]:
    """Every kernel of the package by its module and name; imports all files of kernels."""
    found: dict[str, Kernel[..., Any]] = {}
    for path in kernel_files(PACKAGE_ROOT):
        module = ".".join(("pixmetry", *path.relative_to(PACKAGE_ROOT).with_suffix("").parts))
        members = vars(import_module(module)).values()
        found |= {f"{module}.{k.__name__}": k for k in members if isinstance(k, Kernel) and k.__module__ == module}
    return found


def jobs_in(folder: Path) -> Iterator[Job]:
    """The commands to run in a folder, each with its name, in the order in which they need each other's files."""

    def scene(name: str, text: str) -> Path:
        path = folder / f"{name}.yaml"
        path.write_text(f"schema: pixmetry/scene/1\n{text}\n")
        return path

    def command(*arguments: object) -> Job:
        return str(arguments[0]), lambda: _run([str(a) for a in arguments])

    discs, series = scene("discs", DISCS), scene("series", SERIES)
    presets = sorted(p.name.removesuffix(".yaml") for p in (files("pixmetry.camera") / "presets").iterdir() if p.name.endswith(".yaml"))
    for preset in presets:
        yield command("simulate", preset, discs, "-n", 2, "-o", folder / f"discs-{preset}", "--truth")
    window = ("--window", "900,1100,160,160")
    for name, text in (("shapes", SHAPES), ("spot", SPOT)):
        yield command("simulate", PRESET, scene(name, text), "-n", 2, "-o", folder / name, "--format", "png", *window)
    yield command("chain", "pulnix_tm6cn_epix_512", discs, "-o", folder / "chain.html")
    yield command("simulate", PRESET, series, "-o", folder / "series", "--window", "0,0,96,128")
    manifest = folder / "series" / "campaign.yaml"
    yield command("assess", manifest, "-o", folder / "assessed", "--trials", 200)
    yield command("assess", "-o", folder / "example", "--trials", 200)
    yield "correct", partial(_correct, folder / "series", folder / "assessed" / "results.json", folder / "corrected")
    yield command("emva1288", manifest, "--html", folder / "sheet.html", "--bootstrap", 100)
    for kind, plate in PLATES.items():
        for i, (omega, phi, kappa) in enumerate(POSES):
            posed = scene(f"{kind}-{i}", PLATE.format(plate=plate, omega=omega, phi=phi, kappa=kappa))
            where = folder / "boards" / kind / str(i)
            yield command("simulate", PRESET, posed, "-o", where, "--window", "624,824,800,800")
        options = ("--grid", "8x6") if kind == "chessboard" else ("--grid", "9x7", "--diameter-mm", 9, "--polarity", "bright")
        copies = folder / "boards" / f"{kind}-images"
        yield "calibrate", partial(_numbered, folder / "boards" / kind, copies)
        yield command("calibrate", copies, "--kind", kind, *options, "--pitch-mm", 20, "-o", folder / f"calibrated-{kind}")
    yield from _locating()
    yield command("budget", "pulnix_tm6cn_epix_512", "--set", "motion.speed_px_per_s=20", "--set", "light.source=laser")
    positions = folder / "positions.csv"
    positions.write_text("x_px,y_px\n100.0,200.0\n300.5,250.25\n")
    yield command("corrected", positions, "--with", "pulnix_tm6cn_epix_512", "-o", folder / "corrected.csv")
    for kind in BOUNDS:
        yield command("bound", "--kind", *kind.split(), "--blur", 0.7, "--amplitude", 150, "--camera", PRESET)


def _run(arguments: list[str]) -> None:
    """Run one command silently; a refusal does not matter here."""
    from pixmetry.cli import main

    with redirect_stdout(StringIO()), redirect_stderr(StringIO()):
        main.main(arguments, standalone_mode=False)
    tell_when_compiling(None)


def _numbered(boards: Path, folder: Path) -> None:
    """Put images of one name into one folder."""
    folder.mkdir()
    for i, image in enumerate(sorted(boards.rglob("frame_*.tif"))):
        (folder / f"{i}.tif").write_bytes(image.read_bytes())


def _correct(series: Path, results: Path, corrected: Path) -> None:
    from pixmetry.locate.files import frames_inside

    _run(["correct", str(frames_inside(series)), "--with", str(results), "-o", str(corrected)])


def _locating() -> Iterator[Job]:
    """Every kind of target with every estimator, in frames of every type of number."""
    from pixmetry.locate.estimators import estimators
    from pixmetry.locate.job import locate

    for kind, (picture, options) in _pictures().items():
        for estimator in estimators(kind):
            for number in TYPES:
                yield "locate", partial(locate, picture.astype(number), kind=kind, estimator=estimator, **options)
    discs = _pictures()["disc"][0]
    for number in TYPES:
        yield "locate", partial(_track, discs.astype(number), estimator="soft_threshold")
    few = np.rint(discs / 8.0)
    for number in TYPES:
        yield "locate", partial(locate, few.astype(number), estimator="poisson_gaussian", noise="read=0.5,gain=1")


def _track(picture: np.ndarray, estimator: str) -> None:
    """Follow the targets of a picture into itself."""
    from pixmetry.locate.track.tracker import Tracker

    Tracker(picture, estimator=estimator).update(picture)


def _pictures() -> dict[str, tuple[np.ndarray, dict[str, Any]]]:
    """A picture for each kind of target, 8 bits, and the options that it wants."""
    y, x = np.indices((200, 240), float)
    noise = 5 * ((np.sin(12.9898 * x + 78.233 * y) * 43758.5453) % 1 - 0.5)  # rough enough for a noise

    def soft(distance: np.ndarray) -> np.ndarray:
        return 1 / (1 + np.exp(np.clip(distance / 0.4, -50, 50)))

    def noisy(image: np.ndarray) -> np.ndarray:
        return np.clip(np.rint(20 + 150 * image + noise), 0, 255)

    centres = [(cx + 0.3 * (cy % 7), cy + 0.2 * (cx % 5)) for cy in range(30, 190, 32) for cx in range(30, 230, 32)]
    discs = np.sum([soft(np.hypot(x - a, y - b) - 5) for a, b in centres], axis=0)
    ellipses = np.sum([soft((np.hypot((x - a) / 7, (y - b) / 4) - 1) * 5) for a, b in centres], axis=0)
    rings = np.sum([soft(np.hypot(x - a, y - b) - 8) - soft(np.hypot(x - a, y - b) - 4) for a, b in centres], axis=0)
    spots = np.sum([np.exp(-((x - a) ** 2 + (y - b) ** 2) / 4.5) for a, b in centres], axis=0)
    line = soft(np.abs(y - 100 - 0.1 * (x - 120)) - 1.5)
    across = np.maximum(line, soft(np.abs(x - 120 + 0.1 * (y - 100)) - 1.5))
    u, v = x * 0.99 + y * 0.1, y * 0.99 - x * 0.1
    board = 0.5 + 0.5 * np.tanh(6 * np.sin(np.pi * u / 24)) * np.tanh(6 * np.sin(np.pi * v / 24))
    board = np.where((u > 24) & (u < 24 * 9) & (v > 0) & (v < 24 * 7), board, 1.0)
    coded = sum(soft(np.hypot(x - a, y - b) - 7) for a, b in centres[::3])
    coded = coded + sum(
        (soft(np.abs(np.hypot(x - a, y - b) - 17.5) - 3.5) * (np.sin(3 * np.arctan2(y - b, x - a)) > 0)) for a, b in centres[::3]
    )
    return {
        "disc": (noisy(discs), {}),
        "ellipse": (noisy(ellipses), {"grid": "any"}),
        "ring": (noisy(rings), {}),
        "spot": (noisy(spots), {}),
        "line": (noisy(line), {}),
        "edge": (noisy(soft(x - 120 - 0.1 * y)), {}),
        "cross": (noisy(across), {}),
        "chessboard": (noisy(board), {"grid": (7, 5)}),
        "coded": (noisy(np.minimum(coded, 1.0)), {}),
        "blob": (noisy(discs), {}),
    }
