"""A long series that is killed: ``python benchmarks/study_series.py [frames] [kills]``, by default 5400 frames of 1 Mpx and three kills.

Follows discs through the frames in a process of its own, kills that at random moments (SIGKILL), and lets it go on. Prints after each kill
how many frames the log holds and whether the next run measures one of them again; at the end the motion, the largest memory, the CPU time.
"""

from __future__ import annotations

import json
import os
import random
import resource
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

SIZE, TARGETS, SLOW_S, SHIFT_PX = 1000, (5, 4), 1500.0, 0.8
PITCH = 0.05  # of the shifts that frames are made for; the nearest one is taken


def made_frames() -> tuple[np.ndarray, list[np.ndarray]]:
    """Frames of soft discs at shifts along x from 0 on, with noise."""
    rng, frames = np.random.default_rng(4), []
    shifts = np.arange(0, SHIFT_PX + PITCH / 2, PITCH)
    y, x = np.indices((41, 41)) - 20.0
    for shift in shifts:
        grey = np.full((SIZE, SIZE), 20.0)
        for cx in np.linspace(100.2, 900.4, TARGETS[0]) + shift:
            for cy in np.linspace(90.3, 905.1, TARGETS[1]):
                row, col = round(cy), round(cx)
                away = np.hypot(x - (cx - col), y - (cy - row))
                grey[row - 20 : row + 21, col - 20 : col + 21] += 150 / (1 + np.exp(3 * (away - 5)))
        frames.append(np.clip(np.rint(grey + rng.normal(0, 1.2, grey.shape)), 0, 255).astype(np.uint8))
    return shifts, frames


def run(frames: int, log_file: Path) -> None:
    """Measure the series, or go on with it."""
    from pixmetry.series.job import measure_series
    from pixmetry.series.log import SeriesLog

    shifts, made = made_frames()

    def fetch(time_s: float) -> np.ndarray:
        return made[int(np.abs(shifts - SHIFT_PX * (1 - np.exp(-time_s / SLOW_S))).argmin())]

    log = SeriesLog(log_file)
    told = len(log.done)
    found = measure_series([(f"{k:05d}", float(k), lambda k=k: fetch(float(k))) for k in range(frames)], log=log)
    log.close()
    used = resource.getrusage(resource.RUSAGE_SELF)
    fit = found.drift.fit
    shift = f"{fit['shift_x_px'].value:.3f} ± {fit['shift_x_px'].u:.3f} px" if "shift_x_px" in fit else fit.reasons["shift_x_px"]
    print(f"went on from frame {told}; shift: {shift} (made: {SHIFT_PX} px, in steps of {PITCH} px)")
    print(f"{used.ru_maxrss / 1024:.0f} MB at most, {used.ru_utime + used.ru_stime:.0f} s of CPU time for {frames - told} frames")


def main(frames: int = 5400, kills: int = 3) -> None:
    """Run, kill, go on."""
    with tempfile.TemporaryDirectory() as folder:
        log = Path(folder) / "log.jsonl"
        seen = 0
        for _ in range(kills):
            process = subprocess.Popen([sys.executable, __file__, "--run", str(frames), str(log)])
            lines = 0
            until = seen + random.randint(1, max(frames // (kills + 1), 2))
            while lines < until and process.poll() is None:
                time.sleep(0.2)
                lines = log.read_bytes().count(b"\n") if log.exists() else 0
            time.sleep(random.random())
            os.kill(process.pid, signal.SIGKILL)
            process.wait()
            raw = log.read_bytes()
            whole = [json.loads(line) for line in raw.splitlines(keepends=True) if line.endswith(b"\n")]
            names = [line["frame"] for line in whole if "frame" in line]
            twice = len(names) - len(set(names))
            lost = len(raw.rpartition(b"\n")[2])
            print(f"killed: {len(names)} frames are kept, {lost} bytes of one are lost, {twice} measured twice")
            seen = len(names)
        subprocess.run([sys.executable, __file__, "--run", str(frames), str(log)], check=True)


if __name__ == "__main__":
    if sys.argv[1:2] == ["--run"]:
        run(int(sys.argv[2]), Path(sys.argv[3]))
    else:
        main(*map(int, sys.argv[1:]))
