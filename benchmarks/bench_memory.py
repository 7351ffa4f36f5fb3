"""Peak memory above the imports: of exposures of a megapixel and of an assessment; each also with ten times the frames.

Usage: python benchmarks/bench_memory.py [CAMPAIGN]   (default: a simulated campaign of 640 x 480 px, 12 bit)

Each case runs in a process of its own, on two threads; what is printed is the peak of its resident memory as Linux counts it. The imports
are those of the same work on frames of 64 x 48 px, compiled kernels included. Goals: 60 MB for the exposures of a megapixel camera,
whatever their number; 40 MB for the assessment.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
from pathlib import Path

from goals import verdict

from pixmetry.camera.camera import build_camera, load_camera
from pixmetry.files import load_campaign, write_manifest
from pixmetry.simulate.job import simulate

ASSESS = """
import sys
from pixmetry import assess
assess(sys.argv[1], sys.argv[2])
"""
EXPOSE = """
import sys
from dataclasses import replace
sys.path.insert(0, sys.argv[1])
from bench_detection import Element, Uniform, camera, get_source
side, frames, extra = int(sys.argv[2]), int(sys.argv[3]), sys.argv[4:]
plain = camera((side, side))
chain = list(plain.chain)
for name in extra:
    at = next(i for i, e in enumerate(chain) if e.name == ("sensor.dsnu" if name.startswith("sensor.") else "grabber.adc"))
    chain.insert(at, Element(name, get_source(name), get_source(name).typical))
for signal in replace(plain, chain=tuple(chain)).iter_frames(Uniform(1000.0), range(frames), threads=2):
    pass
"""
LIGHT = """
import sys
from dataclasses import replace
sys.path.insert(0, sys.argv[1])
from bench_presets import scene_of
from bench_detection import Element, camera, get_source
from pixmetry.camera.camera import load_camera
side, frames, name = int(sys.argv[2]), int(sys.argv[3]), sys.argv[4]
if name == "optics":
    made = camera((side, side))
    settings = {
        "optics.point_spread": {"model": "diffraction", "f_number": 8.0},
        "optics.distortion": {"k1_per_mm2": -5e-4},
        "sensor.tilt": {"tilt_x_deg": 1.0, "tilt_y_deg": 0.5},
    }
    lens = [Element(i, get_source(i), get_source(i).make(v)) for i, v in settings.items()]
    made = replace(made, chain=(*lens, *made.chain))
else:
    made = load_camera(name)
    made = replace(made, frame_shape=(96, 128)) if side == 64 else made
for signal in made.iter_frames(scene_of(made), range(frames), threads=2):
    pass
"""
# The peak of this process alone: getrusage also counts what the parent held before the new program was loaded.
PEAK = """
print(next(line for line in open("/proc/self/status") if line.startswith("VmHWM")).split()[1])
"""
EXPOSURES_MB, ASSESSMENT_MB = 60.0, 40.0
EXTRAS = {
    "detection chain": (),
    "and charge transfer": ("sensor.charge_transfer",),
    "and charge transfer, cable": ("sensor.charge_transfer", "cable.termination"),
    "and charge transfer, gain control": ("sensor.charge_transfer", "electronics.agc"),
}


OTHERS = {"diffraction, distortion, tilt": "optics", "pulnix_tm6cn_epix_512": "pulnix_tm6cn_epix_512"}  # light and line


def peak_mb(program: str, *arguments: object) -> float:
    """Peak resident memory of a program in MB."""
    command = [sys.executable, "-c", program + PEAK, *map(str, arguments)]
    return float(subprocess.run(command, capture_output=True, text=True, check=True).stdout.split()[-1]) / 1024


def exposures() -> None:
    """Print the peaks of exposing frames of 1024 x 1024 px."""
    here, worst = Path(__file__).parent, 0.0
    cases = [(label, EXPOSE, extra, 20) for label, extra in EXTRAS.items()] + [(label, LIGHT, (name,), 6) for label, name in OTHERS.items()]
    for label, program, words, few in cases:
        peak_mb(program, here, 64, 8, *words)  # compiles what is not yet compiled
        base = peak_mb(program, here, 64, 8, *words)
        peaks = [peak_mb(program, here, 1024, frames, *words) - base for frames in (few, 10 * few)]
        worst = max(worst, *peaks)
        print(f"{label:<36} imports {base:6.1f} MB   {few} frames {peaks[0]:+6.1f} MB   {10 * few} frames {peaks[1]:+6.1f} MB")
    verdict("memory of exposures above imports", worst, EXPOSURES_MB, " MB")


def simulated(folder: Path, rows: int, cols: int, levels: int, stack: int) -> Path:
    """Write a campaign of a modern camera."""
    record = load_camera("imx264_like").to_record() | {"rows": rows, "cols": cols}
    series = {"levels": levels, "brightest_photons": 16500, "longest_exposure_s": 0.01, "stack_frames": stack}
    folder.mkdir()
    return simulate(build_camera(record), {"schema": "pixmetry/scene/1", "photon_transfer": series}, folder / "campaign") / "campaign.yaml"


def times_ten(campaign: Path) -> Path:
    """The same campaign with every stack ten times as long, by files under other names (links)."""
    from dataclasses import replace

    c = load_campaign(campaign)
    links = campaign.parent / "links"
    links.mkdir()
    groups = []
    for i, g in enumerate(c.groups):
        paths = list(g.paths)
        if g.role == "stack":
            for k in range(9):
                for p in g.paths:
                    paths.append(links / f"{i}_{k}_{p.name}")
                    paths[-1].symlink_to(p.resolve())
        groups.append(replace(g, paths=tuple(paths)))
    path = campaign.parent / "ten.yaml"
    write_manifest(replace(c, groups=tuple(groups)), path)
    return path


def assessments() -> None:
    """Print the peaks of assessing campaigns."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        tiny = simulated(folder / "tiny", 48, 64, 12, 16)
        peak_mb(ASSESS, tiny, folder / "report")  # compiles what is not yet compiled
        base = peak_mb(ASSESS, tiny, folder / "report")
        campaign = Path(sys.argv[1]) if len(sys.argv) > 1 else simulated(folder / "real", 480, 640, 50, 50)
        print(f"assessment: imports            {base:7.1f} MB")
        once = peak_mb(ASSESS, campaign, folder / "report")
        print(f"campaign                       {once:7.1f} MB   {once - base:+.1f}")
        verdict("memory of an assessment above imports", once - base, ASSESSMENT_MB, " MB")
        if len(sys.argv) == 1:
            ten = peak_mb(ASSESS, times_ten(campaign), folder / "report")
            print(f"ten times the frames           {ten:7.1f} MB   {ten - base:+.1f}")
            verdict("the same with ten times the frames", ten - base, ASSESSMENT_MB, " MB")


if __name__ == "__main__":
    exposures()
    assessments()
