"""Kill a command, or let the disk be full, at every operation on its output; what is there after must be the old result or the new one.

python scripts/faults.py [--only COMMAND] [--every N] [--seconds S] [--list]

Each command runs once to tell its operations (open, write, rename, link, remove, folders, flushing to the disk) below a folder of its own.
Then it runs once for each of them and each fault: killed before it (of a write: after half of it), or ended by "no space left on device".
After that every result must be as it was before the run, or all of it new, and the same command must succeed and leave nothing else behind.
Several files that are no folder of results may be mixed where a run is killed between their renames, each of them whole: these points are
counted by themselves.
"""

from __future__ import annotations

import argparse
import builtins
import errno
import hashlib
import io
import json
import os
import shutil
import signal
import sys
import tempfile
import time
from collections.abc import Callable, Mapping
from contextlib import redirect_stderr, redirect_stdout, suppress
from dataclasses import dataclass, field
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

KILL, FULL = "killed", "disk full"
LONGEST_S = 120
KILLED = 77  # exit status of a run that was killed here
CALLS = ("replace", "rename", "link", "unlink", "remove", "rmdir", "mkdir", "fsync", "truncate", "symlink")
CAMERA = """schema: pixmetry/camera/1
name: test camera
rows: 32
cols: 48
pitch_x_um: 5.0
pitch_y_um: 5.0
chain:
- source: sensor.quantum_efficiency
  parameters: {quantum_efficiency: 0.5}
- source: sensor.prnu
  parameters: {pixel_std_rel: 0.02}
- source: sensor.shot_noise
- source: electronics.gain
  parameters: {gain_dn_per_e: 0.2}
- source: grabber.adc
  parameters: {bits: 12, offset_dn: 40}
"""
DISCS = "schema: pixmetry/scene/1\nuniform: {level_photons: 300}\ndiscs: {lattice_px: 16, peak_photons: 14000}\n"


@dataclass
class Fault:
    """What happens at which operation of a run; the operations so far."""

    root: str
    at: int = -1
    way: str = KILL
    journal: list[str] = field(default_factory=list)

    def step(self, name: str, *places: Any) -> bool:
        """Note an operation below the root; True where the disk is full at it; a run that is killed at it does not come back."""
        paths = [os.fsdecode(p) if isinstance(p, str | bytes | os.PathLike) else "" for p in places]
        if not any(os.path.abspath(p).startswith(self.root + os.sep) for p in paths if p):
            return False
        self.journal.append(f"{name} {' '.join(os.path.relpath(p, self.root) for p in paths if p)}")
        return len(self.journal) - 1 == self.at

    def happens(self) -> None:
        if self.way == KILL:
            os._exit(KILLED)
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def hook(fault: Fault) -> None:
    """Put the fault into this process: every way in which Python writes, and what is written by libraries in Python."""

    class Written(io.FileIO):
        def write(self, data: Any) -> int:
            if fault.step("write", self.name):
                super().write(bytes(data)[: len(bytes(data)) // 2])
                fault.happens()
            return super().write(data) or 0

    def faulty(call: Callable[..., Any], name: str) -> Callable[..., Any]:
        def run(*places: Any, **options: Any) -> Any:
            shown = places
            if name == "fsync":
                with suppress(OSError):
                    shown = (os.readlink(f"/proc/self/fd/{places[0]}"),)
            if fault.step(name, *shown[:2]):
                fault.happens()
            return call(*places, **options)

        return run

    for name in CALLS:
        setattr(os, name, faulty(getattr(os, name), name))
    plain = io.open

    def opened(file: Any, mode: str = "r", buffering: int = -1, *rest: Any, **options: Any) -> Any:
        if not set(mode) & set("wax+") or isinstance(file, int):
            return plain(file, mode, buffering, *rest, **options)
        if fault.step("open", file):
            fault.happens()
        raw = Written(file, mode.replace("b", "").replace("t", ""))
        buffer: Any = io.BufferedRandom(raw) if "+" in mode else io.BufferedWriter(raw)
        if "b" in mode:
            return raw if buffering == 0 else buffer
        names = ("encoding", "errors", "newline")
        given = dict(zip(names, rest, strict=False)) | {name: options[name] for name in names if name in options}
        return io.TextIOWrapper(buffer, **given)

    builtins.open = io.open = opened  # type: ignore[assignment]


def run_command(arguments: list[str], fault: Fault) -> tuple[int, str]:
    """Run a command of pixmetry in a child with a fault; its exit status and what it said. The journal comes back in the fault."""
    receive, send = os.pipe()
    child = os.fork()
    if child == 0:
        os.close(receive)
        status, said = 70, io.StringIO()
        try:
            os.chdir(fault.root)
            import pixmetry.files.provenance as provenance

            class Then(datetime):
                @classmethod
                def now(cls, tz: Any = None) -> Any:
                    return datetime(2020, 1, 1, tzinfo=tz or timezone.utc)  # noqa: UP017

            provenance.datetime = Then  # type: ignore[misc, assignment]
            sys.argv = ["pixmetry", *arguments]
            hook(fault)
            from pixmetry.cli import main

            with redirect_stdout(said), redirect_stderr(said):
                try:
                    main(arguments, prog_name="pixmetry")
                except SystemExit as end:
                    status = end.code if isinstance(end.code, int) else 0 if end.code is None else 1
        except BaseException as problem:
            said.write(f"Traceback: {type(problem).__name__}: {problem}")
            status = 71
        fault.at = -1
        os.write(send, json.dumps([fault.journal, said.getvalue()[-2000:]]).encode())
        os._exit(status)
    os.close(send)
    signal.signal(signal.SIGALRM, lambda *_: os.kill(child, signal.SIGKILL))
    signal.alarm(LONGEST_S)
    with os.fdopen(receive, "rb") as file:
        raw = file.read()
    status = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    signal.alarm(0)
    if raw:
        fault.journal, said_text = json.loads(raw)
        return status, said_text
    return status, ""


def state_of(folder: Path) -> dict[str, str]:
    """Digest of every file below a folder."""
    found = {}
    for path in sorted(p for p in folder.rglob("*") if p.is_file()):
        found[path.relative_to(folder).as_posix()] = hashlib.sha256(path.read_bytes()).hexdigest()
    return found


def results_of(state: Mapping[str, str]) -> dict[str, str]:
    """Without what an interrupted run may leave: temporary names beside the results."""
    return {name: digest for name, digest in state.items() if ".partial-" not in name and ".probe-" not in name}


@dataclass(frozen=True)
class Command:
    """A command of which the output is watched.

    Parameters
    ----------
    name : str
    old, new : list of str
        Arguments of the run before, and of the one with the fault: the same output, other content.
    needs : tuple of str
        Commands whose results it reads; they run first, into ``in_NAME``.
    """

    name: str
    old: list[str]
    new: list[str]
    needs: tuple[str, ...] = ()


def commands() -> list[Command]:
    """Commands with small work; ``in`` holds their input, ``out`` gets their output."""
    camera, scene = "in/camera.yaml", "in/discs.yaml"
    simulate = ["simulate", camera, scene, "-o", "out/frames"]
    seed = lambda k: ["--seed", str(k)]  # noqa: E731
    found = [
        Command("simulate", [*simulate, *seed(1)], [*simulate, *seed(2)]),
        Command("simulate zarr", [*simulate, "--format", "zarr", *seed(1)], [*simulate, "--format", "zarr", *seed(2)]),
        Command("locate", ["locate", "in/f1", "-o", "out/t.csv"], ["locate", "in/f2", "-o", "out/t.csv"]),
        Command("locate json", ["locate", "in/f1", "-o", "out/t.json"], ["locate", "in/f2", "-o", "out/t.json"]),
        Command(
            "budget",
            ["budget", camera, "--json", "out/b.json", "--html", "out/b.html"],
            ["budget", camera, "--json", "out/b.json", "--html", "out/b.html", "--set", "exposure_s=0.02"],
        ),
        Command(
            "correct",
            ["correct", "in/f1", "--with", camera, "-o", "out/c"],
            ["correct", "in/f1", "--with", camera, "-o", "out/c", "--set", "grabber.adc.offset_dn=41"],
        ),
        Command(
            "emva1288",
            ["emva1288", "--json", "out/e.json", "--xml", "out/e.xml", "--bootstrap", "0"],
            ["emva1288", "--json", "out/e.json", "--xml", "out/e.xml", "--bootstrap", "0", "--release", "3.1"],
        ),
        Command("calibrate", ["calibrate", "in/p.yaml", "-o", "out/k"], ["calibrate", "in/q.yaml", "-o", "out/k"]),
    ]
    return found


def put_inputs(folder: Path) -> None:
    """Camera, scene, frames of two seeds and a project below ``in``."""
    place = folder / "in"
    place.mkdir()
    (folder / "out").mkdir()
    (place / "camera.yaml").write_text(CAMERA)
    (place / "discs.yaml").write_text(DISCS)
    from pixmetry.simulate.job import simulate

    for k in (1, 2):
        simulate(place / "camera.yaml", place / "discs.yaml", place / f"f{k}", seed=k)
    put_project(place)


def put_project(place: Path) -> None:
    """A test field of 5 x 5 x 2 points seen from eight places, and two projects of different u."""
    import numpy as np

    draw = np.random.default_rng(3)
    grid = [(100.0 * i, 100.0 * j, 60.0 * ((i + j) % 2)) for i in range(5) for j in range(5)]
    xyz = np.array(grid) - [200, 200, 30]
    rows = ["image,point,x_px,y_px"]
    for k in range(8):
        a, roll = k * np.pi / 4, (k % 4) * np.pi / 2
        position = 900 * np.array([0.5 * np.cos(a), 0.5 * np.sin(a), 1.0])
        z = -position / np.linalg.norm(position)
        x = np.cross([np.sin(roll), np.cos(roll), 0.0], z)
        x /= np.linalg.norm(x)
        turned = (xyz - position) @ np.array([x, np.cross(z, x), z]).T
        for j, (u, v, w) in enumerate(turned):
            px = (319.5 + 900 * u / w, 239.5 + 900 * v / w) + draw.normal(0, 0.05, 2)
            rows.append(f"i{k},p{j},{px[0]:.4f},{px[1]:.4f}")
    (place / "obs.csv").write_text("\n".join(rows) + "\n")
    (place / "pts.csv").write_text("point,X,Y,Z\n" + "".join(f"p{j},{x},{y},{z}\n" for j, (x, y, z) in enumerate(xyz.tolist())))
    for name, u in (("p", 0.05), ("q", 0.06)):
        text = "schema: pixmetry/calibration/1\ncameras: {name: a, cols: 640, rows: 480, c_px: 890}\n"
        text += f"observations: {{table: obs.csv, u_px: {u}}}\npoints: {{table: pts.csv, known: fixed}}\n"
        (place / f"{name}.yaml").write_text(text)


def verdict(after: Mapping[str, str], old: Mapping[str, str], new: Mapping[str, str]) -> str:
    """Which result stands there: ``old``, ``new``, ``mixed`` (each file whole) or ``damaged``."""
    if after == old:
        return "old"
    if after == new:
        return "new"
    whole = all(digest in (old.get(name), new.get(name)) for name, digest in after.items())
    return "mixed" if whole and set(after) <= set(old) | set(new) else "damaged"


def examine(command: Command, every: int, stop: float) -> tuple[int, dict[str, int]]:
    """Every fault at every operation of one command, over an old result and without one; counts by what was found."""
    counts: dict[str, int] = {}
    points = 0
    with tempfile.TemporaryDirectory(dir="/dev/shm" if Path("/dev/shm").is_dir() else None) as name:
        base = Path(name, "base")
        base.mkdir()
        put_inputs(base)
        trial = Path(name, "trial")

        def fresh(source: Path) -> None:
            shutil.rmtree(trial, ignore_errors=True)
            shutil.copytree(source, trial, symlinks=True)

        def done(arguments: list[str]) -> dict[str, str]:
            status, said = run_command(arguments, Fault(str(trial)))
            if status:
                raise SystemExit(f"{command.name}: fails without a fault ({status}): {said}")
            return state_of(trial / "out")

        fresh(base)
        done(command.old)
        before = Path(name, "before")
        shutil.copytree(trial, before, symlinks=True)
        for start in (base, before):
            fresh(start)
            old = state_of(trial / "out")
            journal = Fault(str(trial))
            run_command(command.new, journal)
            new = state_of(trial / "out")
            for way in (FULL, KILL):
                for at in range(0, len(journal.journal), every):
                    if time.monotonic() > stop:
                        return points, counts
                    fresh(start)
                    status, said = run_command(command.new, Fault(str(trial), at, way))
                    after = state_of(trial / "out")
                    found = verdict(results_of(after), old, new)
                    problems = [] if found in ("old", "new") else [f"{found} after {way}"]
                    if way == FULL and status not in (0, 2):
                        problems.append(f"exit status {status}: {said[-200:]}")
                    if way == FULL and status == 2 and said.count("error: ") != 1:
                        problems.append(f"not one error: {said[-200:]}")
                    if way == FULL and status == 0 and found == "old" and old != new:
                        problems.append("success without a result")
                    removes = journal.journal[at].startswith(("unlink", "rmdir", "remove"))
                    if way == FULL and after != results_of(after) and not removes:  # what cannot be removed stays
                        problems.append(f"left behind: {sorted(set(after) - set(results_of(after)))[:2]}")
                    status, said = run_command(command.new, Fault(str(trial)))
                    if status or results_of(state_of(trial / "out")) != new:
                        problems.append(f"the next run fails ({status}): {said[-200:]}")
                    elif state_of(trial / "out") != new and way == KILL:
                        problems.append("the next run leaves what was left behind")
                    points += 1
                    for problem in problems:
                        counts[problem] = counts.get(problem, 0) + 1
                        print(f"{command.name}: {way} at {at} ({journal.journal[at]}): {problem}", flush=True)
    return points, counts


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", default="", help="commands whose names contain this")
    parser.add_argument("--every", type=int, default=1, help="take every n-th operation only")
    parser.add_argument("--seconds", type=float, default=1e9)
    parser.add_argument("--list", action="store_true")
    arguments = parser.parse_args()
    chosen = [c for c in commands() if arguments.only in c.name]
    if arguments.list:
        print("\n".join(c.name for c in chosen))
        return 0
    os.environ["OPENBLAS_NUM_THREADS"] = "1"
    stop, wrong = time.monotonic() + arguments.seconds, 0
    for command in chosen:
        points, counts = examine(command, arguments.every, stop)
        mixed = counts.get(f"mixed after {KILL}", 0)
        failed = sum(counts.values()) - mixed
        wrong += failed
        print(f"{command.name}: {points} points, {failed} failures, {mixed} killed between the renames of several files", flush=True)
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
