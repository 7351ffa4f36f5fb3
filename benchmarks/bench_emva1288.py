"""A whole test by EMVA 1288, beside the public reference implementation: ``python benchmarks/bench_emva1288.py [CAMPAIGN]``.

CAMPAIGN is a descriptor or a folder with one; by default a campaign of 640 x 480 pixels is simulated. Both programs run alternately, each
in a process of its own in which it was imported and has run once before the clock starts; what is timed is everything from the name of
the descriptor to all values and curves, ours with its uncertainties, and reading with summing alone. Medians of 5. The reference
implementation (1.0.2, needs NumPy 1) lives in the environment of the oracles (``make oracles``).

Then the peak memory above the imports, for N frames and for 4 N (the same stacks four times as long, by links). Goals: 0.35 of the
reference's time for the whole, 0.22 for reading and summing; and that four times the frames of the stacks take less than 10 MB more.
"""

from __future__ import annotations

import json
import statistics
import subprocess
import sys
import tempfile
from pathlib import Path

from bench_memory import peak_mb, simulated
from goals import verdict

from pixmetry.files import Campaign, load_campaign

ORACLES = Path(__file__).resolve().parents[1] / ".venv-oracles" / "bin" / "python"
REPEATS, WHOLE, SUMMING, GROWTH_MB = 5, 0.35, 0.22, 10.0
OURS = """
import json, sys, time
from pixmetry.files import load_campaign
from pixmetry.emva.job import emva1288, measure_campaign

def run():
    start = time.perf_counter()
    emva1288(sys.argv[1])
    whole = time.perf_counter() - start
    start = time.perf_counter()
    measure_campaign(load_campaign(sys.argv[1]))
    return whole, time.perf_counter() - start

run()
print(json.dumps(run()))
"""
REFERENCE = """
import json, logging, sys, time
from emva1288.process.data import Data1288
from emva1288.process.loader import LoadImageData
from emva1288.process.parser import ParseEmvaDescriptorFile
from emva1288.process.results import Results1288
logging.disable(logging.CRITICAL)

def run():
    start = time.perf_counter()
    images = ParseEmvaDescriptorFile(sys.argv[1], loglevel=50).images
    loaded = LoadImageData(images, loglevel=50).data
    read = time.perf_counter() - start
    Results1288(Data1288(loaded, loglevel=50).data, loglevel=50).results
    return time.perf_counter() - start, read

run()
print(json.dumps(run()))
"""
PEAK = """
import sys
from pixmetry.emva.job import emva1288
emva1288(sys.argv[1])
"""


def seconds(python: str | Path, program: str, path: Path) -> tuple[float, float]:
    """Time of the whole and of reading with summing, measured inside the program."""
    done = subprocess.run([str(python), "-c", program, str(path)], capture_output=True, text=True, check=True)
    whole, summing = json.loads(done.stdout.splitlines()[-1])
    return whole, summing


def write_descriptor(campaign: Campaign, path: Path, times: int = 1) -> Path:
    """Write the campaign as an EMVA 1288 descriptor; with ``times`` its stacks are that many times as long, by links."""
    rows, cols = campaign.frame_shape
    lines, links = ["v 4.0", f"n {campaign.bits} {cols} {rows}"], path.parent / f"links-{times}"
    links.mkdir()
    for i, group in enumerate(campaign.groups):
        light = f"b {group.exposure_s * 1e9!r} {group.photons!r}" if group.kind == "bright" else f"d {group.exposure_s * 1e9!r}"
        lines.append(light)
        for k in range(times if group.role == "stack" else 1):
            for file in group.paths:
                link = links / f"{i}_{k}_{file.name}"
                link.symlink_to(file.resolve())
                lines.append(f"i {link.relative_to(path.parent)}")
    path.write_text("\n".join(lines) + "\n")
    return path


def times(path: Path) -> None:
    """Print the times of both and their ratios."""
    ours, theirs = [], []
    for _ in range(REPEATS):
        theirs.append(seconds(ORACLES, REFERENCE, path))
        ours.append(seconds(sys.executable, OURS, path))
    medians = [[statistics.median(column) for column in zip(*rows, strict=True)] for rows in (ours, theirs)]
    (whole, summing), (their_whole, their_summing) = medians
    print(f"reference implementation  whole {their_whole:6.3f} s   reading and summing {their_summing:6.3f} s")
    print(f"pixmetry                  whole {whole:6.3f} s   reading and summing {summing:6.3f} s")
    verdict("whole test over the reference's", whole / their_whole, WHOLE)
    verdict("reading and summing over the reference's whole test", summing / their_whole, SUMMING)


def memory(campaign: Campaign, folder: Path) -> None:
    """Print the peaks for N and 4 N frames above those of a campaign of small frames."""
    tiny = simulated(folder / "tiny", 48, 64, 12, 16)
    peak_mb(PEAK, tiny)  # compiles what is not yet compiled
    base = peak_mb(PEAK, tiny)
    print(f"imports {base:.1f} MB")
    peaks = []
    for n in (1, 4):
        peaks.append(peak_mb(PEAK, write_descriptor(campaign, folder / f"times-{n}.txt", n)) - base)
        frames = sum(len(g.paths) * (n if g.role == "stack" else 1) for g in campaign.groups)
        print(f"{frames} frames: {peaks[-1]:+.1f} MB")
    verdict("growth of the memory with the frames", peaks[1] - peaks[0], GROWTH_MB, " MB")


def main() -> None:
    """Both parts."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        campaign = load_campaign(Path(sys.argv[1]) if len(sys.argv) > 1 else simulated(folder / "real", 480, 640, 50, 50))
        if ORACLES.exists():
            times(write_descriptor(campaign, folder / "descriptor.txt", 1))
        else:
            print("the reference implementation is not installed: make oracles")
        (folder / "memory").mkdir()
        memory(campaign, folder / "memory")


if __name__ == "__main__":
    main()
