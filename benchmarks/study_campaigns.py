"""Everything at once: ``python benchmarks/study_campaigns.py [--cameras 5] [--first 0] [--seed 1] [--kind NAME] [--pickle FILE]``.

Random cameras of five kinds, each with every source of its chain on at sizes of real cameras, take one campaign of all kinds of frames:
dark and bright series, stacks, dark frames at temperatures, slanted edges, upright lines, covered pixels, a chart, bright spots, a light
that goes off, and texture. All of it is measured blind, as by `pixmetry.assess`. Each value that its camera was made with is compared
with what was found: n, mean, standard deviation and largest |z| of z = (value − truth)/u, and the median of u; of a limit, whether it
holds; of what is not told, the reason. ``--pickle`` keeps the scores of a part of the study, ``--read FILE ...`` prints the table of
several parts.
"""

from __future__ import annotations

import argparse
import pickle
import time
from collections import Counter, defaultdict
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from types import MappingProxyType

import numpy as np

from pixmetry import Frames, campaign_of_arrays
from pixmetry.assess.job import measure_sources, observe_campaign
from pixmetry.camera.camera import Camera, Element, in_order
from pixmetry.camera.catalogue import get_source, sources
from pixmetry.camera.dark_rows import octave_periods
from pixmetry.camera.group_facts import GroupFacts
from pixmetry.camera.light import Scene
from pixmetry.core.number import Estimates
from pixmetry.core.progress import no_progress
from pixmetry.scene.discs import Discs
from pixmetry.scene.outlines import Outline, disc, polygon
from pixmetry.scene.picture import Picture
from pixmetry.scene.shapes import Shapes
from pixmetry.scene.uniform import Uniform
from pixmetry.sources.electronics.flicker_noise import FlickerNoise

Values = dict[str, dict[str, object]]
KINDS = ("rolling CMOS", "global CMOS", "interline CCD", "frame transfer CCD", "analogue")
BORDERS = {"left": 4, "right": 16, "top": 2, "bottom": 12}
CLOCK_MHZ, EXPOSURE_S, TEMPERATURE_C = 14.1875, 0.01, 30.0
ABSENT = 3.3  # u by which a source that is not there must differ from nothing to count as found
UNCOMPARED = ("sensor.defects", "sensor.full_well")  # shares above a threshold; codes that end first
DENSITIES = tuple(np.linspace(0.05, 1.85, 16))
CELL, SIDE = 172, 126
LENS = ("optics.point_spread", "optics.olpf")
NO_SETTINGS: Mapping[str, str | int] = MappingProxyType({})


@dataclass(frozen=True)
class Unit:
    """A camera of the study and how it is told to the assessment."""

    kind: str
    camera: Camera
    values: Values
    full_photons: float  # that fill nine tenths of the range in ``EXPOSURE_S``
    covered: dict[str, int]
    facts: dict[str, object]
    seed: int

    @cached_property
    def black_dn(self) -> float:
        """Mean code in the dark, without charge."""
        still = self.camera.switched(off=[name for name in ("sensor.defects", "electronics.telegraph_noise") if name in self.values])
        left, right, first, last = self.lit
        dark = still.expose(Uniform(0.0), 24, seed=self.seed, exposure_s=1e-6).data
        return float(dark[:, first:last, left:right].mean(dtype=float))

    @property
    def lit(self) -> tuple[int, int, int, int]:
        """First and one behind the last column and row that see light."""
        rows, cols = self.camera.output_shape
        c = self.covered or dict.fromkeys(BORDERS, 0)
        return c["left"], cols - c["right"], c["top"], rows - c["bottom"]


def draw_unit(kind: str, number: int, seed: int) -> Unit:
    """A camera of a kind, from (seed, number) alone."""
    rng = np.random.default_rng([seed, number, KINDS.index(kind)])

    def log(low: float, high: float) -> float:
        return float(np.exp(rng.uniform(np.log(low), np.log(high))))

    def flat(low: float, high: float) -> float:
        return float(rng.uniform(low, high))

    ccd, analogue = kind in ("interline CCD", "frame transfer CCD", "analogue"), kind == "analogue"
    bits = 8 if analogue else 12
    top = 2.0**bits - 1
    well = log(8e3, 4e4)
    offset = flat(4, 8) if analogue else flat(30, 100)
    gain = (top - offset) / well * flat(0.85, 0.97)
    read = log(25, 60) if analogue else log(6, 25) if ccd else log(2, 6)
    width = flat(0.55, 0.95) if ccd and kind != "frame transfer CCD" else flat(0.85, 1.0)
    values: Values = {
        "optics.point_spread": {"sigma_px": flat(0.3, 0.6)},
        "optics.shading": {"corner_rel": flat(0.01, 0.08), "gradient_x_per_px": flat(-1e-4, 1e-4), "gradient_y_per_px": flat(-1e-4, 1e-4)},
        "sensor.pixel_aperture": {"width_x_px": width, "width_y_px": flat(0.85, 1.0)},
        "sensor.exposure": {},
        "sensor.shot_noise": {},
        "sensor.quantum_efficiency": {"quantum_efficiency": flat(0.3, 0.7)},
        "sensor.prnu": {"pixel_std_rel": flat(0.003, 0.012), "row_std_rel": log(1e-4, 1e-3), "col_std_rel": log(1e-4, 1e-3)},
        "sensor.dark_current": {"rate_e_per_s": log(2, 300), "reference_temperature_c": TEMPERATURE_C, "doubling_c": flat(5.5, 9)},
        "sensor.full_well": {"full_well_e": well},
        "sensor.dsnu": {"pixel_std_e": log(1, 8), "row_std_e": log(0.1, 1), "col_std_e": log(0.1, 1)},
        "sensor.defects": {"hot_fraction": 2e-4, "hot_median_e": 300.0},
        "sensor.brighter_fatter": {"area_loss_per_e": log(1e-7, 1e-6)},
        "electronics.amplifier_noise": {"white_e": read},
        "electronics.row_noise": {"row_e": flat(0.05, 0.3) * read},
        "electronics.gain": {"gain_dn_per_e": gain},
        "electronics.nonlinearity": {"a2": flat(-0.01, 0.01), "reference_dn": top},
        "grabber.adc": {"bits": bits, "offset_dn": offset, "dnl_std_lsb": flat(0, 0.1), "inl_amplitude_lsb": flat(0, 0.2)},
    }
    if rng.random() < 0.3 and not analogue:
        plate = flat(0.8, 1.2)
        values["optics.olpf"] = {"separation_x_px": plate, "separation_y_px": plate}
    if not ccd:
        values["sensor.image_lag"] = {"lag_rel": log(5e-4, 1e-2)}
        values["electronics.column_noise"] = {"offset_dn": flat(0, 0.3), "gain_rel": log(1e-4, 1e-3)}
        values["electronics.telegraph_noise"] = {"share": log(1e-3, 0.02), "amplitude_e": flat(3, 8) * read}
        values["electronics.tap_gain"] = {"taps": 2, "step_rel": flat(-0.01, 0.01), "odd_even_rel": flat(-0.003, 0.003)}
        if kind == "rolling CMOS":
            values["sensor.rolling_shutter"] = {"row_time_s": log(5e-6, 6e-5)}
        else:
            values["sensor.parasitic_light"] = {"sensitivity_rel": log(1e-5, 3e-4), "wait_s": 1e-3}
    else:
        leak = 1.0 if kind == "frame transfer CCD" else log(1e-5, 1e-4)
        moved = log(1e-4, 1e-3) if kind == "frame transfer CCD" else 0.04
        up, ratio = flat(0.4, 0.6), float(rng.choice([1.0, 1.0, 3.0, 100.0]))
        values["sensor.smear"] = {"transfer_s": moved, "leak_rel": leak}
        values["sensor.blooming"] = {"full_well_e": well, "up_share": up, "drain_ratio": ratio}
        moves = {"parallel_cti": log(1e-6, 3e-5), "serial_cti": log(1e-6, 3e-5), "trail_px": flat(1, 2.5)}
        values["sensor.charge_transfer"] = moves
        values["electronics.flicker_noise"] = {"rms_e": 0.2 * read}
    if analogue:
        values["electronics.video_amplifier"] = {"natural_mhz": flat(5, 8), "damping": flat(0.4, 0.8)}
        values["cable.termination"] = {"length_m": flat(3, 30), "line_ohm": 50.0}
        values["grabber.low_pass"] = {"kind": "butterworth", "order": 3, "cutoff_mhz": flat(3.5, 4.8)}
        values["grabber.line_jitter"] = {"white_ns": flat(2, 15)}
        values["grabber.clamp"] = {"noise_dn": flat(0.1, 0.4)}
        if number % 2:
            values["grabber.sampling_clock"] = {"clock_mhz": 10.0}
    squares = int(rng.integers(2, 4))
    borders = BORDERS if ccd and not analogue else {}
    rows, cols = 2 * CELL + sum(borders.get(k, 0) for k in ("top", "bottom")), squares * CELL + 8
    if "grabber.sampling_clock" in values:  # as many samples as the rows last
        values["grabber.sampling_clock"]["samples"], cols = cols, int(np.ceil(cols * CLOCK_MHZ / 10.0))
    else:
        cols += sum(borders.get(k, 0) for k in ("left", "right"))
    chain = tuple(Element(s.id, s, s.parameters(**values[s.id])) for s in in_order(get_source(name) for name in values))
    known = {"interface": "analogue" if analogue else "digital", "sensor": "ccd" if ccd else "cmos", "bits": bits}
    facts = {**known, "frame_period_s": 0.04} | ({"covered": borders} if borders else {})
    clocks = {"pixel_clock_hz": 1e6 * CLOCK_MHZ, "line_period_s": 64e-6} if analogue else {}
    camera = Camera(kind, (rows, cols), chain, exposure_s=EXPOSURE_S, temperature_c=TEMPERATURE_C, facts=facts, unit_seed=number, **clocks)
    efficiency = values["sensor.quantum_efficiency"]["quantum_efficiency"]
    told = {**known, "pitch_um": 5.0, "temperature_c": TEMPERATURE_C, "lossless": True} | ({"covered": borders} if borders else {})
    told |= {"line_time_us": 64.0, "pixel_clock_mhz": CLOCK_MHZ} if ccd else {}
    told |= {"sampling_clock_mhz": 10.0} if "grabber.sampling_clock" in values else {}
    return Unit(kind, camera, values, well / efficiency, borders, told, 1000 * seed + number)  # type: ignore[operator]


class Shooting:
    """Takes the frames of a unit, each group with draws of its own."""

    def __init__(self, unit: Unit, rng: np.random.Generator) -> None:
        self.unit, self.rng, self.taken = unit, rng, 0
        scale = unit.camera.output_shape[1] / unit.camera.frame_shape[1]
        self.per_px = 1 / scale  # pixels of the sensor in a stored one, along x
        left, right, first, last = unit.lit
        self.width, self.height = (right - left), last - first

    def frames(self, outlines: list[Outline], level: float, count: int, exposure_s: float = EXPOSURE_S, **kw: float) -> np.ndarray:
        """Shapes on an even field within the lit part of the frame; levels in shares of nine tenths of the range."""
        full, blur, even = self.unit.full_photons, float(kw.pop("blur", 0.0)), not outlines
        if self.unit.covered:
            ground = [self.box(0, self.width, 0, self.height, level * full)] if level else []
            scene: Scene = Picture((Shapes.of([*ground, *outlines], blur),), Uniform(0.0)) if ground or outlines else Uniform(0.0)
        else:
            scene = Picture((Shapes.of(outlines, blur),), Uniform(level * full)) if outlines else Uniform(level * full)
        return self.exposed(scene, count, exposure_s, blurred=bool(kw.pop("blurred", not even)), **kw)

    def exposed(
        self, scene: Scene, count: int, exposure_s: float = EXPOSURE_S, settle: bool = True, blurred: bool = True, **kw: float
    ) -> np.ndarray:
        """Frames, once a lag has settled; without the lens where it would blur the border of the cover, which is on the sensor."""
        self.taken += 1
        skip = 2 if settle and "sensor.image_lag" in self.unit.values else 0
        seed = 1000 * self.unit.seed + self.taken
        camera = self.unit.camera if blurred else self.unit.camera.switched(off=[name for name in LENS if name in self.unit.values])
        data = camera.expose(scene, count + skip, seed=seed, exposure_s=exposure_s, **kw).data[skip:]
        return data.astype(np.uint8 if self.unit.facts["bits"] == 8 else np.uint16)

    def box(self, x0: float, x1: float, y0: float, y1: float, photons: float) -> Outline:
        """A rectangle in the lit part of the frame, in stored pixels."""
        return self.outline(np.array([x0, x1, x1, x0]) - 0.5, np.array([y0, y0, y1, y1]) - 0.5, photons)

    def outline(self, x: np.ndarray, y: np.ndarray, photons: float) -> Outline:
        left, _, first, _ = self.unit.lit
        return polygon((x + left + 0.5) * self.per_px - 0.5, y + first, photons)

    @property
    def ends(self) -> np.ndarray:
        """Rows in which upright lines begin and end: beyond the frame, or at the cover."""
        return np.array([-0.5, -0.5, self.height - 0.5, self.height - 0.5]) + (0 if self.unit.covered else 12 * np.array([-1, -1, 1, 1]))

    def squares(self, angle_deg: float, height: float) -> list[Outline]:
        """Turned squares, one a cell."""
        turn, out = np.radians(angle_deg), []
        for i in range(self.height // CELL):
            for j in range(self.width // CELL):
                x, y = CELL * (j + 0.5) + self.rng.uniform(-0.5, 0.5), CELL * (i + 0.5) + self.rng.uniform(-0.5, 0.5)
                u, v = 0.5 * SIDE * np.array([-1, 1, 1, -1]), 0.5 * SIDE * np.array([-1, -1, 1, 1])
                corners = x + u * np.cos(turn) - v * np.sin(turn), y + u * np.sin(turn) + v * np.cos(turn)
                out.append(self.outline(*corners, height * self.unit.full_photons))
        return out


def campaign_frames(unit: Unit, rng: np.random.Generator) -> list[Frames]:
    """All kinds of frames of one camera."""
    shoot = Shooting(unit, rng)
    full, groups = unit.full_photons, []
    for share in np.linspace(0.04, 0.92, 13):
        time_s = EXPOSURE_S * share
        groups.append(Frames("bright", time_s, shoot.frames([], share, 2, time_s), photons=None))
        groups.append(Frames("dark", time_s, shoot.frames([], 0.0, 2, time_s)))
    groups.append(Frames("bright", EXPOSURE_S * 0.5, shoot.frames([], 0.5, 16, EXPOSURE_S * 0.5), role="stack"))
    groups.append(Frames("dark", EXPOSURE_S * 0.5, shoot.frames([], 0.0, 16, EXPOSURE_S * 0.5), role="stack"))
    for degrees in (40.0, 50.0, 60.0):
        for time_s in (EXPOSURE_S, 1.0):
            facts = GroupFacts(temperature_c=degrees)
            groups.append(Frames("dark", time_s, shoot.frames([], 0.0, 4, time_s, temperature_c=degrees), facts=facts))
    for angle in (5.0, -4.0):
        groups.append(Frames("edge", None, shoot.frames(shoot.squares(angle, 0.55), 0.2, 4)))
    lines = []
    for x in (60, shoot.width / 2, shoot.width - 60):
        lines.append(shoot.outline(x + np.array([-1.5, 1.5, 7.5, 4.5]), shoot.ends, 0.6 * full))
    groups.append(Frames("line", None, shoot.frames(lines, 0.1, 12)))
    bars = [shoot.box(x, x + 40, 0, shoot.height, 0.7 * full) for x in range(10, shoot.width - 60, 80)]
    if unit.covered:
        groups.append(Frames("covered", EXPOSURE_S, shoot.frames(bars, 0.0, 4, blurred=False)))
    groups += chart_frames(shoot, rng)
    places = [(shoot.width * u, shoot.height * v) for u, v in ((0.35, 0.48), (0.52, 0.55), (0.66, 0.45))]
    for times in (1, 2, 5, 12):
        spots = [_disc(shoot, x, y, 0.5 * full * times) for x, y in places]
        groups.append(Frames("spots", EXPOSURE_S * times, shoot.frames(spots, 0.0, 4, EXPOSURE_S * times, blur=1.0)))
    lamp = np.where(np.arange(22) < 4, unit.camera.frame_shape[1] / 2, 1e5)[:, None]
    wide = Discs(lamp, np.full((22, 1), unit.camera.frame_shape[0] / 2), 1000.0, peak_photons=0.5 * full, per_frame=True)
    groups.append(Frames("light_off", EXPOSURE_S, shoot.exposed(wide, 22, settle=False)))
    if unit.facts["bits"] == 8:
        groups.append(Frames("pattern", None, shoot.frames(shoot.squares(8.0, 0.3), 0.3, 2)))
    return groups


def _disc(shoot: Shooting, x: float, y: float, photons: float) -> Outline:
    left, _, first, _ = shoot.unit.lit
    return disc((x + left + 0.5) * shoot.per_px - 0.5, y + first, 6.0, photons)


def chart_frames(shoot: Shooting, rng: np.random.Generator) -> list[Frames]:
    """A chart of 16 patches in even light, densities off by 1 %."""
    pitch, side = min(shoot.height, shoot.width) // 4 - 4, min(shoot.height, shoot.width) // 4 - 16
    full, out, surround = shoot.unit.full_photons, [], 0.18
    for k, density in enumerate(DENSITIES):
        x, y = 12 + (k % 4) * pitch, 12 + (k // 4) * pitch
        light = 0.8 * (10**-density * np.exp(0.01 * rng.standard_normal()) - surround)
        out.append(shoot.box(x, x + side, y, y + side, light * full))
    facts = GroupFacts(densities=DENSITIES, u_light_rel=0.01)
    return [Frames("chart", None, shoot.frames(out, 0.8 * surround, 4), facts=facts)]


@dataclass
class Scores:
    """What was found of the cameras of one kind, by quantity."""

    z: dict[str, list[tuple[float, float, float, int]]] = field(default_factory=lambda: defaultdict(list))
    limits: dict[str, list[bool]] = field(default_factory=lambda: defaultdict(list))
    absent: dict[str, list[tuple[float, float, int]]] = field(default_factory=lambda: defaultdict(list))
    reasons: dict[str, Counter[str]] = field(default_factory=lambda: defaultdict(Counter))

    def add(self, unit: Unit, estimates: dict[str, Estimates], unmeasured: dict[str, str], number: int) -> None:
        """Compare what was measured with the camera."""
        for name, source in sources().items():
            if source.measure is None:
                continue
            if name not in estimates:
                if name in unit.values:
                    self.reasons[name][unmeasured.get(name, "no reason")] += 1
                continue
            for e in estimates[name]:
                if e.reason.startswith("assumed"):
                    continue
                key, truth = f"{name}.{e.name}", truth_of(unit, name, e.name, estimates[name].settings)
                if name not in unit.values:
                    if not e.is_limit and e.u and abs(e.value - (truth or 0.0)) > ABSENT * e.u:
                        self.absent[key].append((e.value, e.u, number))
                    continue
                if truth is None:
                    continue
                if e.is_limit:
                    self.limits[key].append(truth <= e.value if e.kind == "upper_limit" else truth >= e.value)
                elif e.u:
                    self.z[key].append(((e.value - truth) / e.u, e.u, truth, number))
                else:
                    self.limits[key].append(e.value == truth)


def truth_of(unit: Unit, source: str, parameter: str, settings: Mapping[str, str | int] = NO_SETTINGS) -> float | None:
    """What a parameter of this camera is, as an assessment means it with these settings; None where it has no counterpart."""
    if source in UNCOMPARED:
        return None
    if (source, parameter) == ("sensor.blooming", "full_well_e") and source not in unit.values:
        return float(unit.values["sensor.full_well"]["full_well_e"])  # type: ignore[arg-type]
    if (source, parameter) == ("electronics.flicker_noise", "rms_e") and source in unit.values and "octaves" in settings:
        shares = octave_periods(0.1, FlickerNoise().octaves)[1]  # of the variance; slower octaves than were told are not seen
        return float(unit.values[source][parameter]) * float(np.sqrt(shares[: int(settings["octaves"])].sum()))  # type: ignore[arg-type]
    if (source, parameter) == ("grabber.adc", "offset_dn"):
        return unit.black_dn
    if (source, parameter) == ("electronics.row_noise", "column_e") and "electronics.column_noise" in unit.values:
        offset, gain = unit.values["electronics.column_noise"]["offset_dn"], unit.values["electronics.gain"]["gain_dn_per_e"]
        return float(offset / gain)  # type: ignore[operator]
    if (source, parameter) == ("electronics.row_noise", "row_e") and "grabber.clamp" in unit.values:
        own, clamp = unit.values[source][parameter], unit.values["grabber.clamp"]["noise_dn"]  # which one gain does not tell apart
        return float(np.hypot(own, clamp / unit.values["electronics.gain"]["gain_dn_per_e"]))  # type: ignore[operator]
    if source == "optics.shading" and unit.covered:
        return _shading_of(unit, parameter)
    record = get_source(source)
    params = record.parameters(**unit.values[source]) if source in unit.values else record.neutral
    if source == "sensor.smear" and parameter == "transfer_s" and source in unit.values:
        rows = unit.camera.frame_shape[0]
        first, last = unit.lit[2:]
        return float(params.transfer_s * params.leak_rel) * (last - first) / rows  # type: ignore[union-attr]
    value = None if params is None else getattr(params, parameter, None)
    return float(value) if isinstance(value, int | float) and not isinstance(value, bool) else None


def _shading_of(unit: Unit, parameter: str) -> float:
    """Shading about the centre of the lit part of the frame, over its mean light."""
    left, right, first, last = unit.lit
    rows, cols = unit.camera.frame_shape
    x, y = 0.5 * (left + right - 1) - 0.5 * (cols - 1), 0.5 * (first + last - 1) - 0.5 * (rows - 1)
    gx, gy, corner = (float(unit.values["optics.shading"][n]) for n in ("gradient_x_per_px", "gradient_y_per_px", "corner_rel"))  # type: ignore[arg-type]
    loss = corner / (((rows - 1) ** 2 + (cols - 1) ** 2) / 4)
    own = ((right - left - 1) ** 2 + (last - first - 1) ** 2) / 4
    mean = 1 + loss * (rows**2 + cols**2 - 2) / 12 + gx * x + gy * y - loss * (x * x + y * y)
    mean -= loss * ((right - left) ** 2 + (last - first) ** 2 - 2) / 12
    return {"gradient_x_per_px": gx - 2 * loss * x, "gradient_y_per_px": gy - 2 * loss * y, "corner_rel": loss * own}[parameter] / mean


def table(scores: dict[str, Scores], largest: float) -> str:
    """One line for each kind of camera and quantity."""
    out = [f"{'camera':20}{'quantity':48}{'n':>4}{'mean z':>8}{'std z':>7}{'max':>7}{'u':>10}{'truth':>10}"]
    for kind, score in scores.items():
        for name in sorted({*score.z, *score.limits}):
            line = f"{kind:20}{name:48}"
            if score.z[name]:
                z, u, truth, number = np.array(score.z[name]).T
                line += f"{len(z):4}{z.mean():+8.2f}{z.std():7.2f}{np.abs(z).max():7.1f}{np.median(u):10.2g}{np.median(truth):10.3g}"
                far = np.abs(z) > largest
                line += "".join(f"  [{int(k)}: {v:+.1f}]" for k, v in zip(number[far], z[far], strict=True))
            if score.limits[name]:
                line += f"  limits that hold {sum(score.limits[name])} of {len(score.limits[name])}"
            out.append(line)
        out += [f"{kind:20}{name}: found though absent, {v:.4g} ± {u:.2g} [{k}]" for name, each in score.absent.items() for v, u, k in each]
        for name, reasons in score.reasons.items():
            out += [f"{kind:20}{name}: not told by {n}: {why}" for why, n in reasons.items()]
    return "\n".join(out)


def keep(scores: dict[str, Scores], path: Path) -> None:
    """Write the scores for another run to read."""
    parts = {k: {name: dict(getattr(s, name)) for name in ("z", "limits", "absent", "reasons")} for k, s in scores.items()}
    path.write_bytes(pickle.dumps(parts))


def main() -> None:
    """Run a part of the study, or print the table of several parts."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cameras", type=int, default=5, help="of each kind")
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--kind", choices=KINDS)
    parser.add_argument("--pickle", type=Path)
    parser.add_argument("--read", type=Path, nargs="*")
    parser.add_argument("--largest", type=float, default=4.0, help="|z| from which the camera's number is shown")
    asked = parser.parse_args()
    scores: dict[str, Scores] = {}
    start = time.process_time()
    if asked.read:
        for part in asked.read:
            for kind, score in pickle.loads(part.read_bytes()).items():
                whole = scores.setdefault(kind, Scores())
                for name, values in score["z"].items():
                    whole.z[name] += values
                for name, held in score["limits"].items():
                    whole.limits[name] += held
                for name, seen in score["absent"].items():
                    whole.absent[name] += seen
                for name, reasons in score["reasons"].items():
                    whole.reasons[name] += reasons
    else:
        for number in range(asked.first, asked.first + asked.cameras):
            for kind in (asked.kind,) if asked.kind else KINDS:
                unit = draw_unit(kind, number, asked.seed)
                frames = campaign_frames(unit, np.random.default_rng([asked.seed, number, 99]))
                campaign = campaign_of_arrays(frames, name=f"{kind} {number}", **unit.facts)
                _, seen = observe_campaign(campaign, no_progress)
                scores.setdefault(kind, Scores()).add(unit, *measure_sources(seen), number)
                if asked.pickle:
                    keep(scores, asked.pickle)
                print(f"{kind} {number}: {time.process_time() - start:.0f} s", flush=True)
    print(table(scores, asked.largest))


if __name__ == "__main__":
    main()
