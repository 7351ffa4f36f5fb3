"""Speed of a Monte Carlo's windows: ``python benchmarks/bench_windows.py``.

10 000 windows of 24 × 24 px, each with a target of its own, through 25 sources in the mode ``frozen``, on one and on two threads; beside
it the same physics in plain NumPy with ``numpy.random.Generator``, and the locating of the targets. 18 kinds of sources take part, seven of
them twice under another name. Random from frame to frame: shot noise, amplifier noise (twice), row noise (twice), phase pattern (twice).
Random but fixed in the unit: PRNU (twice), DSNU (twice), defects, grain of the grabber (twice), code widths. With row context: cable
(twice), charge transfer.
"""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np
from goals import verdict

from pixmetry.camera.camera import Camera, Element
from pixmetry.camera.catalogue import get_source
from pixmetry.camera.signal import Clock, Kind
from pixmetry.core.random import Grid
from pixmetry.core.threads import set_threads
from pixmetry.locate.centroids.fixed import FixedCentroid
from pixmetry.scene.discs import REACH, STEP, Discs, radial_profile
from pixmetry.scene.uniform import Uniform
from pixmetry.sources.cable.termination import echoes

COUNT, SIDE, SHAPE = 10_000, 24, (582, 752)
PEAK_PHOTONS, BACKGROUND_PHOTONS = 30_000.0, 500.0
GOAL_S = 1.2
AGC_DN = 3.0  # so that the gain settles near 1
CHAIN = (
    "optics.shading",
    "sensor.quantum_efficiency",
    "sensor.prnu",
    "sensor.prnu:microlenses",
    "sensor.dark_current",
    "sensor.defects",
    "sensor.shot_noise",
    "sensor.full_well",
    "sensor.charge_transfer",
    "sensor.dsnu",
    "sensor.dsnu:columns",
    "electronics.amplifier_noise",
    "electronics.amplifier_noise:second_stage",
    "electronics.row_noise",
    "electronics.row_noise:supply",
    "electronics.gain",
    "electronics.nonlinearity",
    "electronics.agc",
    "cable.termination",
    "cable.termination:second",
    "grabber.phase_pattern",
    "grabber.phase_pattern:hum",
    "grabber.fixed_pattern",
    "grabber.fixed_pattern:board",
    "grabber.adc",
)


def camera() -> Camera:
    """All sources with their typical parameters."""
    chain = []
    for entry in CHAIN:
        source = get_source(entry.partition(":")[0])
        chain.append(Element(entry, source, source.typical))
    return Camera("bench", SHAPE, tuple(chain)).with_parameters("electronics.agc", target_dn=AGC_DN)


def _clock(element: Element, cam: Camera) -> tuple[float, int] | tuple[()]:
    """What the margins of the line's sources depend on besides their parameters."""
    return (cam.pixel_clock_hz, cam.frame_shape[1]) if Kind.VIDEO in element.source.consumes else ()


class InNumpy:
    """The same chain on the same windows, written with NumPy alone; windows are widened by what the row context needs."""

    def __init__(self, cam: Camera, row0: np.ndarray, col0: np.ndarray, x: np.ndarray, y: np.ndarray) -> None:
        self.p = {e.name: e.params for e in cam.chain}
        needs = [e.source.near(e.params, *_clock(e, cam)) for e in cam.chain if e.source.near is not None]
        self.up, self.left = sum(n[0] for n in needs), sum(n[2] for n in needs)
        self.rows = row0[:, None] - self.up + np.arange(SIDE + self.up)
        self.cols = col0[:, None] - self.left + np.arange(SIDE + self.left)
        self.x, self.y = x, y

    def render(self) -> np.ndarray:
        """Discs by interpolation of the radial profile at 3 × 3 Gauss–Legendre nodes a pixel, near the target alone."""
        profile = radial_profile(7.0, 0.7)
        radius = np.arange(len(profile)) * STEP
        nodes, weights = np.polynomial.legendre.leggauss(3)
        half = int(np.ceil(3.5 + REACH * 0.7)) + 1
        out = np.full((COUNT, *self.rows.shape[1:], self.cols.shape[1]), BACKGROUND_PHOTONS, np.float32)
        r, c = np.arange(self.up + 12 - half, self.up + 12 + half + 1), np.arange(self.left + 12 - half, self.left + 12 + half + 1)
        dy, dx = self.rows[:, r] - self.y[:, None], self.cols[:, c] - self.x[:, None]
        disc = np.zeros((COUNT, len(r), len(c)))
        for u, wu in zip(nodes / 2, weights / 2, strict=True):
            for v, wv in zip(nodes / 2, weights / 2, strict=True):
                distance = np.hypot(dy[:, :, None] + u, dx[:, None, :] + v)
                disc += wu * wv * np.interp(distance, radius, profile, right=0.0)
        out[:, r[0] : r[-1] + 1, c[0] : c[-1] + 1] += (PEAK_PHOTONS * disc).astype(np.float32)
        return out

    def run(self, seed: int) -> np.ndarray:
        """Render and go through the chain."""
        rng, fixed, p = np.random.default_rng(seed), np.random.default_rng(1), self.p
        f32 = np.float32
        at = (slice(None), self.rows[:, :, None], self.cols[:, None, :])[1:]  # pixels of the whole frame; beyond its edge they repeat

        def normal(*size: int) -> np.ndarray:
            return rng.standard_normal(size, f32)

        def pattern() -> np.ndarray:
            return fixed.standard_normal(SHAPE, f32)[at[0] % SHAPE[0], at[1] % SHAPE[1]]

        data = self.render()
        n, h, w = data.shape
        s = p["optics.shading"]
        dy, dx = self.rows - (SHAPE[0] - 1) / 2, self.cols - (SHAPE[1] - 1) / 2
        loss = s.corner_rel / ((SHAPE[0] - 1) ** 2 + (SHAPE[1] - 1) ** 2) * 4
        along_y, along_x = dy * (s.gradient_y_per_px - loss * dy), dx * (s.gradient_x_per_px - loss * dx)
        data *= (1 + loss * (SHAPE[0] ** 2 + SHAPE[1] ** 2 - 2) / 12 + along_y[:, :, None] + along_x[:, None, :]).astype(f32)
        data *= f32(p["sensor.quantum_efficiency"].quantum_efficiency)
        for name in ("sensor.prnu", "sensor.prnu:microlenses"):
            s = p[name]
            lines = fixed.standard_normal(SHAPE[0], f32), fixed.standard_normal(SHAPE[1], f32)
            gain = 1 + f32(s.pixel_std_rel) * pattern() + f32(s.row_std_rel) * lines[0][self.rows % SHAPE[0]][:, :, None]
            data *= gain + f32(s.col_std_rel) * lines[1][self.cols % SHAPE[1]][:, None, :]
        data += f32(p["sensor.dark_current"].rate_e_per_s * 0.01)
        s, lot = p["sensor.defects"], fixed.random(SHAPE, f32)[at[0] % SHAPE[0], at[1] % SHAPE[1]]
        data[lot > 1 - s.dead_fraction] *= f32(s.dead_gain_rel)
        hot = lot < s.hot_fraction
        data[hot] += f32(s.hot_median_e) * np.exp(f32(s.hot_sigma_log) * normal(int(hot.sum())))
        data = rng.poisson(np.maximum(data, 0)).astype(f32)
        data = np.minimum(data, f32(p["sensor.full_well"].full_well_e))
        data = self.transfer(data)
        for name in ("sensor.dsnu", "sensor.dsnu:columns"):
            s = p[name]
            lines = fixed.standard_normal(SHAPE[0], f32), fixed.standard_normal(SHAPE[1], f32)
            data += f32(s.pixel_std_e) * pattern() + f32(s.row_std_e) * lines[0][self.rows % SHAPE[0]][:, :, None]
            data += f32(s.col_std_e) * lines[1][self.cols % SHAPE[1]][:, None, :]
        for name in ("electronics.amplifier_noise", "electronics.amplifier_noise:second_stage"):
            data += f32(p[name].white_e) * normal(n, h, w)
        for name in ("electronics.row_noise", "electronics.row_noise:supply"):
            data += f32(p[name].row_e) * normal(n, h, 1) + f32(p[name].column_e) * normal(n, 1, w)
        data *= f32(p["electronics.gain"].gain_dn_per_e)
        s = p["electronics.nonlinearity"]
        v = np.clip(data / f32(s.reference_dn), -0.25, 1.25)
        data = data * (1 + v * (s.a1 + v * (s.a2 + v * s.a3)))
        data *= f32(AGC_DN / (BACKGROUND_PHOTONS * p["sensor.quantum_efficiency"].quantum_efficiency * p["electronics.gain"].gain_dn_per_e))
        for name in ("cable.termination", "cable.termination:second"):
            data = self.echo(data, p[name])
        for name in ("grabber.phase_pattern", "grabber.phase_pattern:hum"):
            s = p[name]
            turns = s.frequency_y * self.rows[:, :, None] + s.frequency_x * self.cols[:, None, :] + rng.random(n)[:, None, None]
            data = data + f32(s.amplitude_dn) * np.sin(2 * np.pi * turns).astype(f32)
        for name in ("grabber.fixed_pattern", "grabber.fixed_pattern:board"):
            s = p[name]
            settling = s.settling_dn * np.exp(-np.maximum(self.rows, 0) / s.settling_rows)
            step = s.column_step_dn * ((self.cols % s.column_period == 0) - 1 / s.column_period)
            data += f32(s.random_std_dn) * pattern() + settling.astype(f32)[:, :, None] + step.astype(f32)[:, None, :]
        s = p["grabber.adc"]
        k = np.arange(1, 2**s.bits)
        levels = k - 0.5 + s.inl_amplitude_lsb * np.sin(2 * np.pi * s.inl_cycles * k / 2**s.bits)
        levels = np.maximum.accumulate(levels + s.dnl_std_lsb / np.sqrt(2) * fixed.standard_normal(len(k)))
        codes = np.searchsorted(levels, data[:, self.up :, self.left :] * (1 + s.gain_error_rel) + s.offset_dn, side="right")
        return codes.astype(np.uint16)

    def transfer(self, data: np.ndarray) -> np.ndarray:
        """Charge transfer, line after line, both ways."""
        s = self.p["sensor.charge_transfer"]
        for loss, first in ((s.parallel_cti, self.rows[:, 0]), (s.serial_cti, self.cols[:, 0])):
            out, pool = np.empty_like(data), np.zeros((len(data), data.shape[2]))
            for r in range(data.shape[1]):
                transfers = np.maximum(first + r + 1, 1) * s.phases
                share = -np.expm1(transfers * np.log1p(-loss))
                free = np.minimum(share / (transfers * loss * s.trail_px), 1.0)[:, None]
                own = share[:, None] * data[:, r]
                out[:, r] = data[:, r] - own + pool * free
                pool = pool * (1 - free) + own
            data = np.ascontiguousarray(out.swapaxes(1, 2))
        return data

    @staticmethod
    def echo(data: np.ndarray, s) -> np.ndarray:
        """The series of echoes of held pixels, read in the middle of each."""
        out, cols = np.zeros_like(data), np.arange(data.shape[2])
        for delay_s, amplitude in zip(*echoes(s), strict=True):
            back = -int(np.floor(0.5 - delay_s * Clock.pixel_hz))
            out += np.float32(amplitude) * data[:, :, np.maximum(cols - back, 0)]
        return out


def best_s(action: Callable[[], object], rounds: int) -> float:
    """Return the shortest of several runs, after one that compiles."""
    action()
    times = []
    for _ in range(rounds):
        start = time.perf_counter()
        action()
        times.append(time.perf_counter() - start)
    return min(times)


def main() -> None:
    """Time both and print."""
    cam = camera()
    rng = np.random.default_rng(7)
    row0, col0 = rng.integers(0, SHAPE[0] - SIDE + 1, COUNT), rng.integers(0, SHAPE[1] - SIDE + 1, COUNT)
    x, y = col0 + 12 + rng.random(COUNT) - 0.5, row0 + 12 + rng.random(COUNT) - 0.5
    background = Uniform(BACKGROUND_PHOTONS)
    scene = Discs(x[:, None], y[:, None], peak_photons=PEAK_PHOTONS, background=background, per_frame=True)
    grid = Grid(np.arange(COUNT), row0, col0, (SIDE, SIDE))

    def ours() -> np.ndarray:
        return cam.expose_windows(scene, grid, mode="frozen", background=background)

    print(f"{COUNT} windows of {SIDE} x {SIDE} px, {len(cam.chain)} sources ({len({e.source.id for e in cam.chain})} kinds)")
    for threads in (1, 2):
        set_threads(threads)
        ours_s = best_s(ours, 5)
        print(f"pixmetry, {threads} thread{'s' if threads > 1 else ' '}   {ours_s:6.3f} s")
    plain = InNumpy(cam, row0, col0, x, y)
    numpy_s = best_s(lambda: plain.run(3), 1)
    print(f"plain NumPy            {numpy_s:6.3f} s   (x{numpy_s / ours_s:.1f})")
    windows = ours().astype(np.float32)
    law = FixedCentroid(threshold_dn=5.0, background_dn=float(np.median(windows)))
    verdict(f"{COUNT} windows on two threads", ours_s, GOAL_S, " s")
    print(f"locate (soft, 13 x 13) {1e3 * best_s(lambda: law.locate(windows), 5):6.1f} ms")
    found, check = law.locate(windows)[0], law.locate(plain.run(3))[0]
    truth = x - col0
    for label, error in (("pixmetry", found - truth), ("plain NumPy", check - truth)):
        print(f"error of x, {label:<11} mean {error.mean():+.4f}, standard deviation {error.std():.4f} px")


if __name__ == "__main__":
    main()
