"""A live camera taken through a shooting list: levels checked, frames counted, faults marked, a manifest that grows with the frames."""

from __future__ import annotations

import math
import os
import re
import time
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from pixmetry.camera.group_facts import GroupFacts
from pixmetry.capture.camera import Grabbed, LiveCamera
from pixmetry.capture.faults import DAMAGED, DOUBLED, GOOD, MISSED, Watch
from pixmetry.capture.levels import GroupLevels, Level
from pixmetry.capture.log import NAME, CaptureLog
from pixmetry.capture.plan import FROM_STAMPS, LONGEST_S, Step
from pixmetry.capture.records import Captured, Reached, TakenStep
from pixmetry.core.errors import InputError, MeasureError
from pixmetry.core.progress import Progress, no_progress
from pixmetry.files.images import load_frame, write_frame
from pixmetry.files.manifest import write_manifest
from pixmetry.files.records import CameraFacts, Campaign, FrameGroup, OpticsFacts

FRAMES = "frames"  # folder of the frames, in that of the capture
MANIFEST = "campaign.yaml"
MANIFEST_S = 2.0  # how old the manifest may be while frames come
TIMEOUT_S = 5.0  # beside the exposure time, for one frame
SILENT = 3  # time-outs after which the camera is given up
FAULTY = 0.5  # share of faults in a step from which it is given up, after
LEAST_JUDGED = 40  # frames
ROUNDS = 3  # times that frames are added until the wanted u is reached
MOST_TIMES = 4.0  # as many frames in one round: u of a few frames is itself uncertain
MOST_FRAMES = 1000  # of one step
WANTED_REL = {"gain_dn_per_e": 0.01, "dark_noise_e": 0.02}  # usual u of the photon transfer (budget/set_ups.py)
ADDED_TO = {"gain_dn_per_e": "bright", "dark_noise_e": "dark"}


class Operator(Protocol):
    """Who stands at the camera."""

    def ready(self, what: str) -> None:
        """Ask for a scene, or a setting of the camera, and come back when it is there."""
        ...

    def number(self, key: str, what: str) -> float:
        """Ask for a number that only the operator knows."""
        ...


def capture(
    camera: LiveCamera,
    steps: Sequence[Step],
    folder: str | Path,
    operator: Operator,
    *,
    factor: float = 1.0,
    full_s: float | None = None,
    facts: Mapping[str, Any] | None = None,
    progress: Progress = no_progress,
    tell: Callable[[str], None] = lambda line: None,
) -> Captured:
    """Take a shooting list with a live camera.

    Parameters
    ----------
    camera : LiveCamera
    steps : sequence of Step
        As of `pixmetry.capture.plan.steps_of`.
    folder : path
        Gets ``frames/*.tif``, the manifest ``campaign.yaml``, and the log ``capture.jsonl``. A capture that was killed goes on there.
    operator : Operator
    factor : float
        Wanted u over the usual one.
    full_s : float, optional
        Exposure time at which the brightest part just saturates; by default it is found by trial.
    facts : mapping, optional
        Of the camera, for the manifest: ``pitch_um``, ``interface``, ``sensor`` …
    progress : callable, optional
    tell : callable, optional
        Called with a sentence when something is found wrong.

    Returns
    -------
    Captured

    Raises
    ------
    InputError
        If the folder holds another capture, or the exposure must be stated.
    MeasureError
        If the camera sends no frames, or more than half of them are damaged; what was taken stays.

    Notes
    -----
    A frame is written under another name, put in its place, and noted in the log; each is on the disk before the next frame is asked for.
    So a run that is killed loses the frame in flight. Only good frames are counted; after the photon transfer its gain and dark noise are
    measured from the frames, and frames are added until their u is as wanted (three rounds at most).
    """
    run = _Run(camera, tuple(steps), Path(folder), operator, factor, full_s, dict(facts or {}), progress, tell)
    try:
        run.take_all()
        return run.result()
    finally:
        run.close()


class _Run:
    """A capture at work."""

    def __init__(
        self,
        camera: LiveCamera,
        steps: tuple[Step, ...],
        folder: Path,
        operator: Operator,
        factor: float,
        full_s: float | None,
        facts: dict[str, Any],
        progress: Progress,
        tell: Callable[[str], None],
    ) -> None:
        if not steps:
            raise InputError("nothing to take", where="capture", remedy="name set-ups, such as flat")
        if not camera.sets_exposure and full_s is None:
            remedy = "state the exposure time at which the scene just saturates: --full-s"
            raise InputError("this camera's exposure is set by hand", where=camera.name, remedy=remedy)
        self.camera, self.steps, self.folder, self.operator = camera, steps, folder, operator
        self.factor, self.full_s, self.facts, self.progress, self.tell = factor, full_s, facts, progress, tell
        self.frames = folder / FRAMES
        self._check_folder()
        name = {"name": camera.name, "serial_number": camera.serial_number, "bits": camera.bits}
        head = {"camera": name, "u_factor": factor, "full_s": full_s, "facts": facts, "steps": [step.to_record() for step in steps]}
        self.log = CaptureLog(folder, head)
        self.frames.mkdir(exist_ok=True)
        self._remove_unnoted()
        self.levels: dict[int, GroupLevels] = {}
        first = next((record["frame"] for records in self.log.frames.values() for record in records), None)
        self.shape: tuple[int, int] | None = None if first is None else _pixels(self.frames / first).shape
        self.place = ""
        self.written_s = -math.inf
        self.reached: tuple[Reached, ...] = ()
        self.write_manifest()

    def close(self) -> None:
        self.write_manifest()
        self.log.close()

    def _check_folder(self) -> None:
        """Begin no capture among files that no capture has written."""
        if (self.folder / NAME).exists():
            return
        manifest = self.folder / MANIFEST
        found = manifest if manifest.exists() else next(self.frames.iterdir(), None) if self.frames.is_dir() else None
        if found is not None:
            raise InputError("is there already, and not from a capture", where=str(found), remedy="choose another folder")

    def _remove_unnoted(self) -> None:
        """Remove the frame that was in flight when a run was killed: it is not in the log. Other files stay."""
        noted = {record["frame"] for records in self.log.frames.values() for record in records}
        names = "|".join(re.escape(step.name) for step in self.steps)
        own = re.compile(rf"(\.)?({names})_\d{{4,}}(?(1)\.partial)\.tif")
        for path in self.frames.iterdir():
            if own.fullmatch(path.name) and path.name not in noted:
                path.unlink()

    # ---- what is taken -----------------------------------------------------------------------------------------------------------------

    def take_all(self) -> None:
        for step in self.steps:
            if self.count(step) < self.wanted(step):
                self.take(step)
            last = step is self.steps[-1] or self.steps[step.number].set_up != step.set_up
            if step.set_up == "flat" and last:
                self.add_frames()

    def count(self, step: Step) -> int:
        return len(self.log.frames.get(step.number, ()))

    def wanted(self, step: Step) -> int:
        return int(self.log.facts.get(step.number, {}).get("frames", step.frames))

    def show(self, place: str, scene: str) -> None:
        if place != self.place:
            self.operator.ready(scene)
            self.place = place

    def take(self, step: Step) -> None:
        known = self.log.facts.get(step.number, {})
        missing = {key: word for key, word in step.asked.items() if key not in known}
        answers = {key: self.operator.number(word, f"{step.scene} {key}") for key, word in missing.items() if key != "temperature_c"}
        if "exposure_s" not in known and "exposure_s" not in answers:
            answers["exposure_s"] = self.exposure_of(step)
        self.show(step.place, step.scene)
        if "temperature_c" in missing:
            answers["temperature_c"] = self.temperature(missing["temperature_c"], step.scene)
        if answers:
            self.log.put_facts(step.number, **answers)
        self.run_step(step, self.set_exposure(self.log.facts[step.number]["exposure_s"]))

    def exposure_of(self, step: Step) -> float:
        """The exposure time that gives the wanted level."""
        assert step.light is not None
        if step.kind == "dark":
            bright = next(s for s in self.steps if s.set_up == step.set_up and s.kind == "bright")
            full = self.full_exposure(bright, bright.scene)
        else:
            full = self.full_exposure(step, step.scene)
        low, high = self.camera.exposure_range_s
        wanted = min(step.light * full, LONGEST_S.get(step.kind, math.inf))
        if not low <= wanted <= high:
            if step.set_up == "flat":  # two levels at one limit would be one
                what = f"{step.name} needs an exposure of {wanted:.3g} s, which the camera does not have"
                remedy = "take less light" if wanted < low else "take more light"
                raise MeasureError(what, where=self.camera.name, allowed=f"{low:.3g} to {high:.3g} s", remedy=remedy)
            self.tell(f"{step.name}: an exposure of {wanted:.3g} s is out of the camera's range ({low:.3g} to {high:.3g} s).")
        return float(f"{min(max(wanted, low), high):.6g}")

    def full_exposure(self, step: Step, scene: str) -> float:
        """The exposure time at which the scene just saturates: stated, noted, or found by trial."""
        if self.full_s is not None:
            return self.full_s
        first = next(s for s in self.steps if s.place == step.place)
        known = self.log.facts.get(first.number, {}).get("full_s")
        if known is None:
            self.show(step.place, scene)
            known = full_exposure_of(self.trial(step), self.camera)
            self.log.put_facts(first.number, full_s=known)
        return float(known)

    def trial(self, step: Step) -> Callable[[float], tuple[float, float]]:
        """A function (exposure time) that returns the exposure time that was set and the level of a frame."""

        def level(exposure_s: float) -> tuple[float, float]:
            made = self.camera.set_exposure(exposure_s)
            self.camera.start()
            try:
                watch = Watch(self.camera.bits)
                for _ in range(SILENT):
                    frame = self.camera.frame(TIMEOUT_S + made)
                    if frame is not None and watch.judge(frame).kind == GOOD and frame.array is not None:
                        found = Level.of(frame.array, self.camera.bits)
                        return made, found.mean_dn if step.kind == "bright" or step.kind == "speckle" else found.high_dn
            finally:
                self.camera.stop()
            raise self.silent(step)

        return level

    def set_exposure(self, exposure_s: float) -> float:
        if self.camera.sets_exposure:
            return self.camera.set_exposure(exposure_s)
        self.operator.ready(f"Set an exposure time of {1e3 * exposure_s:.5g} ms. Begin to record after you have gone on here.")
        return exposure_s

    def temperature(self, word: str, scene: str) -> float:
        """Temperature of the sensor: of a frame, else asked."""
        self.camera.start()
        try:
            frame = self.camera.frame(TIMEOUT_S)
        finally:
            self.camera.stop()
        if frame is not None and frame.temperature_c is not None:
            return float(frame.temperature_c)
        return self.operator.number(word, f"{scene} Temperature of the sensor, degrees Celsius")

    def run_step(self, step: Step, exposure_s: float) -> None:
        """Take frames until there are enough good ones."""
        levels = GroupLevels(step.kind, self.camera.bits, to_the_top=step.to_the_top, black_dn=self.black_dn())
        self.levels[step.number] = levels
        watch = Watch(self.camera.bits, self.shape, exposure_s)
        faulty = taken = silent = 0
        due = -math.inf
        self.log.put_facts(step.number, exposure_s=exposure_s)
        self.camera.start()
        try:
            while self.count(step) < self.wanted(step):
                grabbed = self.camera.frame(TIMEOUT_S + exposure_s + (step.interval_s or 0.0))
                arrived_s = time.time()
                if grabbed is None:
                    silent += 1
                    if silent == SILENT:
                        raise self.silent(step)
                    continue
                silent = 0
                verdict = watch.judge(grabbed)
                taken += 1 + verdict.missed
                if verdict.missed:
                    faulty += verdict.missed
                    self.log.put_fault(step.number, MISSED, verdict.missed, f"before number {grabbed.number}")
                if verdict.kind in (DAMAGED, DOUBLED):
                    faulty += 1
                    self.log.put_fault(step.number, verdict.kind, 1, verdict.why)
                if taken >= LEAST_JUDGED and faulty > FAULTY * taken:
                    what = f"{faulty} of {taken} frames are missed, damaged or doubled"
                    raise MeasureError(what, where=f"{self.camera.name}, {step.name}", remedy="check cable, bandwidth and frame rate")
                if verdict.kind != GOOD or grabbed.array is None:
                    continue
                now = grabbed.time_s if grabbed.time_s is not None else arrived_s
                if step.interval_s is not None and now < due:
                    continue
                due = (now if due == -math.inf else due) + (step.interval_s or 0.0)
                self.shape = watch.shape
                self.keep(step, grabbed, levels.add(grabbed.array), arrived_s)
        finally:
            self.camera.stop()
        for finding in levels.findings():
            self.tell(f"{step.name}: {finding.text} {finding.advice}")
        self.write_manifest()

    def black_dn(self) -> float | None:
        """Mean of the dark frames so far; None without any."""
        dark = [r["mean_dn"] for s in self.steps if s.kind == "dark" for r in self.log.frames.get(s.number, ())]
        return float(np.mean(dark)) if dark else None

    def keep(self, step: Step, grabbed: Grabbed, level: Level, arrived_s: float) -> None:
        """Put a good frame on the disk, then into the log."""
        assert grabbed.array is not None
        name = f"{step.name}_{self.count(step) + 1:04d}.tif"
        put_frame(self.frames / name, grabbed.array, self.camera.bits)
        told = {key: getattr(grabbed, key) for key in ("number", "time_s", "temperature_c")}
        self.log.put_frame(step.number, name, **told, arrived_s=arrived_s, mean_dn=level.mean_dn, zero=level.zero, full=level.full)
        self.progress(f"{step.name}", self.count(step), self.wanted(step))
        if time.monotonic() - self.written_s > MANIFEST_S:
            self.write_manifest()

    def silent(self, step: Step) -> MeasureError:
        remedy = "check that it is on and triggered; then start the same command again: it goes on here"
        return MeasureError("the camera sends no frames", where=f"{self.camera.name}, {step.name}", remedy=remedy)

    # ---- the wanted u ------------------------------------------------------------------------------------------------------------------

    def add_frames(self) -> None:
        """Measure gain and dark noise from the frames, and take more of them until their u is as wanted."""
        for _ in range(ROUNDS):
            self.reached = self.measured()
            short = {ADDED_TO[r.number.name]: r for r in self.reached if not r.is_reached}
            more = [s for s in self.steps if s.set_up == "flat" and s.kind in short and self.wanted(s) < MOST_FRAMES]
            if not more:
                return
            for kind, one in short.items():
                now, wanted = (100 * u for u in (one.number.u / abs(one.number.value), one.wanted_rel))
                self.tell(f"u of {one.number.name} is {now:.2g} %, wanted is {wanted:.2g} %: more {kind} frames.")
            for step in sorted(more, key=lambda s: (f"flat {s.kind}" != self.place, s.number)):
                one = short[step.kind]
                times = (one.number.u / (one.wanted_rel * abs(one.number.value))) ** 2
                self.log.put_facts(step.number, frames=min(math.ceil(self.wanted(step) * min(times, MOST_TIMES)), MOST_FRAMES))
                self.take(step)
        self.reached = self.measured()

    def measured(self) -> tuple[Reached, ...]:
        """Gain and dark noise from the frames so far, with what was wanted; none where the frames do not tell them."""
        from pixmetry.observe.observe import observe
        from pixmetry.observe.one_pass import Group

        flat = [s for s in self.steps if s.set_up == "flat"]
        groups = []
        for step in flat:
            paths = [self.frames / record["frame"] for record in self.log.frames.get(step.number, ())]
            exposure_s = self.log.facts[step.number]["exposure_s"]
            photons = 0.0 if step.kind == "dark" else None
            groups.append(Group(step.kind, step.role, exposure_s, photons, [partial(_pixels, path) for path in paths]))
        try:
            fit = observe(groups, self.camera.bits).photon_transfer_fit
        except MeasureError as problem:
            self.tell(f"gain and dark noise are not told by these frames: {problem}")
            return ()
        frames = sum(self.count(s) for s in flat)
        numbers = [] if fit is None else [fit[name] for name in WANTED_REL if name in fit]
        return tuple(Reached(n, WANTED_REL[n.name] * self.factor, frames) for n in numbers if not n.is_limit and math.isfinite(n.u))

    # ---- what is written ---------------------------------------------------------------------------------------------------------------

    def write_manifest(self) -> None:
        """Write the manifest of what there is so far, whole or not at all."""
        self.written_s = time.monotonic()
        groups = tuple(self.group(step) for step in self.steps if self.count(step))
        if not groups:
            return
        more = {"serial_number": self.camera.serial_number or None, **self.facts}
        if "pitch_um" in more:
            more["pitch_x_um"] = more["pitch_y_um"] = more.pop("pitch_um")
        camera = CameraFacts(self.camera.name, self.camera.bits, **more)
        notes = "taken by pixmetry capture; missed, damaged and doubled frames are in capture.jsonl"
        manifest = self.folder / MANIFEST
        campaign = Campaign(camera, OpticsFacts(), groups, self.shape or (0, 0), "", manifest, notes=notes)
        partial_path = self.folder / f".{MANIFEST}.partial.yaml"
        write_manifest(campaign, partial_path)
        os.replace(partial_path, manifest)

    def group(self, step: Step) -> FrameGroup:
        """The manifest's group of a step."""
        records, known = self.log.frames[step.number], self.log.facts[step.number]
        stated: dict[str, Any] = {**step.facts, **{key: known[key] for key in step.asked if key in known and key != "exposure_s"}}
        if step.kind in FROM_STAMPS:
            stamps = _times_s(records)
            stated["times_s"] = tuple(round(t - stamps[0], 6) for t in stamps)
            temperatures = [r["temperature_c"] for r in records]
            if step.kind == "series" and all(t is not None for t in temperatures):
                stated["temperatures_c"] = tuple(temperatures)
        stated = {key: tuple(value) if isinstance(value, list) else value for key, value in stated.items()}
        facts = GroupFacts(**stated)
        paths = tuple(self.frames / record["frame"] for record in records)
        return FrameGroup(step.kind, float(known["exposure_s"]), None, paths, step.role, facts)

    def result(self) -> Captured:
        steps = tuple(
            TakenStep(
                s,
                self.count(s),
                float(self.log.facts[s.number]["exposure_s"]),
                dict(self.log.faults.get(s.number, {})),
                tuple(self.levels[s.number].findings()) if s.number in self.levels else (),
            )
            for s in self.steps
        )
        return Captured(self.folder / MANIFEST, steps, self.reached, self.log.runs)


def _times_s(records: Sequence[Mapping[str, Any]]) -> list[float]:
    """Times of frames by one clock: the camera's, unless it is missing, or was set anew between two runs."""
    told = [r["time_s"] for r in records]
    if all(t is not None for t in told) and all(b > a for a, b in zip(told, told[1:], strict=False)):
        return told
    return [r["arrived_s"] for r in records]


def full_exposure_of(level: Callable[[float], tuple[float, float]], camera: LiveCamera) -> float:
    """The exposure time at which the level reaches the top of the scale, from two levels below it.

    Parameters
    ----------
    level : callable (exposure_s)
        Returns the exposure time that was set, and the level in DN.
    camera : LiveCamera

    Raises
    ------
    MeasureError
        If the level does not follow the exposure time, or saturates at the shortest one.
    """
    top = (1 << camera.bits) - 1
    low, high = camera.exposure_range_s
    exposure = min(max(0.01, low), high)
    for _ in range(12):
        exposure, found = level(exposure)
        if found > 0.9 * top and exposure > low:
            exposure = max(exposure / 4, low)
        elif found < 0.25 * top and exposure < high:
            exposure = min(exposure * 3, high)
        else:
            break
    shorter, less = level(max(exposure / 2, low))
    if found > 0.98 * top:
        raise MeasureError("the scene saturates at the shortest exposure time", where=camera.name, remedy="take less light")
    if not (found - less > 0.02 * top and exposure > shorter):
        remedy = "check the light, or state the exposure time at which the scene just saturates: --full-s"
        raise MeasureError("the level does not follow the exposure time", where=camera.name, value=[less, found], remedy=remedy)
    slope = (found - less) / (exposure - shorter)
    return exposure + (top - found) / slope


def put_frame(path: Path, array: np.ndarray, bits: int) -> None:
    """Write a frame so that under its name it is whole, and on the disk."""
    made = path.with_name(f".{path.stem}.partial.tif")
    write_frame(made, array, bits)
    with made.open("rb+") as file:
        os.fsync(file.fileno())
    os.replace(made, path)
    _sync_folder(path.parent)


def _sync_folder(folder: Path) -> None:
    """Put the names of a folder on the disk, where the system can."""
    if os.name != "posix":
        return
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def _pixels(path: Path) -> np.ndarray:
    return load_frame(path).array
