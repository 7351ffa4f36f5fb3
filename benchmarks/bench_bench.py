"""The bench in Chromium: from slider to picture, and to the first screen: ``python benchmarks/bench_bench.py [--moves N]``.

Goals, on two quiet cores with kernels warm: median 60 ms, 95 % below 120 ms, for a window of 128 × 128 pixels of
``pulnix_tm6cn_epix_512`` with all sources on; 1 s to the first picture. A move is one step of a slider; it counts from the event
to the frame of the browser in which the canvas is drawn. Sliders of the lens, the sensor, the electronics and the grabber take
turns. Needs ``pip install '.[bench,browser]'`` and chromium.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import time

import numpy as np
from goals import verdict
from playwright.sync_api import sync_playwright

CHROMIUM = "/usr/bin/chromium"
SOURCES = (
    "optics.point_spread",
    "sensor.unflatness",
    "sensor.prnu",
    "sensor.charge_transfer",
    "electronics.amplifier_noise",
    "electronics.nonlinearity",
    "cable.termination",
    "grabber.low_pass",
    "grabber.line_jitter",
    "grabber.clamp",
    "grabber.fixed_pattern",
    "grabber.adc",
)
MOVES = """async (moves) => {
  const slider = [...document.querySelectorAll('#source-body input[type=range]')].find((s) => Number(s.max) > 0);
  const times = [];
  const middle = Number(slider.value);
  for (let k = 0; k < moves; k++) {
    await new Promise((done) => setTimeout(done, 30));
    const from = bench.answers(), begun = performance.now();
    slider.value = Math.min(Math.max(middle + (k % 2 ? 1 : -1) * (10 + k), 1), 999);
    slider.dispatchEvent(new Event('input', { bubbles: true }));
    while (bench.answers() <= from || bench.busy()) {
      await new Promise((done) => { const m = new MessageChannel(); m.port1.onmessage = done; m.port2.postMessage(0); });
    }
    await new Promise((done) => requestAnimationFrame(done));
    times.push(performance.now() - begun);
  }
  slider.value = middle;
  return times;
}"""


def cpu_s(process: int) -> float:
    """Processor time that a process has used; 0 where the system does not tell it."""
    try:
        with open(f"/proc/{process}/stat", encoding="ascii", errors="replace") as file:
            fields = file.read().rpartition(")")[2].split()
    except OSError:
        return 0.0
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def main() -> None:
    asked = argparse.ArgumentParser(description=__doc__)
    asked.add_argument("--moves", type=int, default=20, help="of each source's slider")
    moves = asked.parse_args().moves
    command = [sys.executable, "-m", "pixmetry", "bench", "--no-open"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as server, sync_playwright() as playwright:
        assert server.stdout is not None
        link = server.stdout.readline().strip()
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        first = []
        for _ in range(4):
            page = browser.new_page(viewport={"width": 1440, "height": 900})
            begun = time.perf_counter()
            page.goto(link)
            page.wait_for_selector("body[data-drawn]")
            first.append(time.perf_counter() - begun)
            page.close()
        page = browser.new_page(viewport={"width": 1440, "height": 900})
        page.goto(link)
        page.wait_for_selector("body[data-drawn]")
        every = []
        for source in SOURCES:
            page.evaluate("async (chosen) => { await bench.open({ camera: 'pulnix_tm6cn_epix_512', chosen }); }", source)
            page.evaluate(MOVES, 3)
            before = cpu_s(server.pid)
            times = np.array(page.evaluate(MOVES, moves))
            cpu_ms = 1e3 * (cpu_s(server.pid) - before) / moves
            every.append(times)
            print(f"{source:<30} median {np.median(times):6.1f} ms, 95 % {np.percentile(times, 95):6.1f} ms, server {cpu_ms:4.0f} ms CPU")
        together = np.concatenate(every)
        print(f"first picture: {first[0]:.2f} s, then {min(first[1:]):.2f} s")
        print(f"all moves: median {np.median(together):.1f} ms, 95 % below {np.percentile(together, 95):.1f} ms")
        verdict("slider to picture, median", float(np.median(together)), 60.0, " ms")
        verdict("slider to picture, 95 %", float(np.percentile(together, 95)), 120.0, " ms")
        verdict("first picture, kernels warm", min(first[1:]), 1.0, " s")
        browser.close()
        server.terminate()


if __name__ == "__main__":
    main()
