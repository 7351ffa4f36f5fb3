"""Peak memory of an assessment: the interpreter with its imports, a campaign, and the same campaign with ten times the frames.

Usage: python benchmarks/bench_memory.py [CAMPAIGN]   (default: a simulated campaign of 640 x 480 px, 12 bit)

Each case runs in a process of its own; what is printed is its peak resident memory as the operating system counts it. The imports
are those of a whole assessment, compiled kernels included: an assessment of frames of 64 x 48 px.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
from pathlib import Path

from pixmetry.campaign import load_campaign, write_manifest
from pixmetry.core.camera import build_camera, load_camera
from pixmetry.simulation import simulate

ASSESS = """
import resource, sys
from pixmetry import assess
assess(sys.argv[1], sys.argv[2])
print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024)
"""


def peak_mb(campaign: Path, folder: Path) -> float:
    """Peak resident memory of an assessment in MB."""
    done = subprocess.run([sys.executable, "-c", ASSESS, str(campaign), str(folder / "report")], capture_output=True, text=True, check=True)
    return float(done.stdout.split()[-1])


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


def main() -> None:
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        tiny = simulated(folder / "tiny", 48, 64, 12, 16)
        peak_mb(tiny, folder)  # compiles what is not yet compiled
        base = peak_mb(tiny, folder)
        campaign = Path(sys.argv[1]) if len(sys.argv) > 1 else simulated(folder / "real", 480, 640, 50, 50)
        print(f"interpreter with its imports   {base:7.1f} MB")
        once = peak_mb(campaign, folder)
        print(f"campaign                       {once:7.1f} MB   {once - base:+.1f}")
        if len(sys.argv) == 1:
            ten = peak_mb(times_ten(campaign), folder)
            print(f"ten times the frames           {ten:7.1f} MB   {ten - base:+.1f}")


if __name__ == "__main__":
    main()
