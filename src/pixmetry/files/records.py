"""What a campaign is: one camera, its facts, and groups of frames taken at known exposures."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from pixmetry.camera.covered import Covered
from pixmetry.camera.group_facts import GroupFacts
from pixmetry.camera.stated import StatedFacts
from pixmetry.core.errors import InputError, MeasureError
from pixmetry.files.formats import is_frame
from pixmetry.files.raw_values import RawLayout

STACK_FRAMES = 8  # from this many frames on, a group is a stack: its mean image serves the spatial measurements
KINDS = ("dark", "bright")  # frames of an even field, from which noise is measured
TARGETS = (
    "edge",
    "light_off",
    "chart",
    "line",
    "covered",
    "spots",
    "pattern",
    "dark_temperature",
    "border",
    "series",
    "motion",
    "speckle",
    "sequence",
    "views",
    "bands",
    "recording",
)  # pictures of something to measure; one frame may be enough
LOCATED = ("series", "motion", "views", "bands", "recording")  # kinds whose frames are measured one by one
LOSSY = ("pattern", "speckle", *LOCATED)  # kinds whose files may be JPEG
FACTS = {  # what else may be said of a group, by its kind
    "edge": ("wavelength_nm", "focus_um"),
    "dark": ("temperature_c",),  # which makes it the next kind
    "dark_temperature": ("temperature_c",),
    "chart": ("densities", "luminances", "u_light_rel", "regions", "white"),
    "line": ("recorded",),
    "series": ("times_s", "interval_s", "on_for_s", "temperatures_c"),
    "motion": ("times_s", "interval_s", "pulsed"),
    "speckle": ("wavelength_nm", "channel"),
    "views": ("channel",),
    "bands": ("wavelength_nm", "band", "filtered", "refocused", "channel"),
    "sequence": ("times_s", "interval_s"),
    "recording": ("recorded",),
}


@dataclass(frozen=True)
class CameraFacts:
    """What is known of the camera without measuring; None where it was not said."""

    name: str
    bits: int
    pitch_x_um: float | None = None
    pitch_y_um: float | None = None
    interface: str = "digital"  # or "analogue"
    sensor: str | None = None  # "ccd" or "cmos"
    temperature_c: float | None = None
    pixel_clock_mhz: float | None = None
    sampling_clock_mhz: float | None = None  # of a frame grabber with a clock of its own
    line_time_us: float | None = None  # from row to row as they are read; of two fields from line to line
    cfa: str | None = None  # colour filter of a mosaic: the colours of pixels (0,0), (0,1), (1,0), (1,1), e.g. "RGGB"
    vendor: str | None = None
    model: str | None = None
    serial_number: str | None = None
    sensor_cols: int | None = None  # of the whole sensor, where the frames are a window of it
    sensor_rows: int | None = None
    first_col: int | None = None  # place of the frames' first pixel on the sensor, from 0
    first_row: int | None = None
    covered: Covered | None = None  # borders of the stored frames that no light reaches
    lossless: bool | None = None  # False: somewhere before these files the frames were coded with loss; True: nowhere

    @property
    def sensor_shape(self) -> tuple[int, int] | None:
        """Rows and columns of the whole sensor, where they were said."""
        return None if self.sensor_rows is None or self.sensor_cols is None else (self.sensor_rows, self.sensor_cols)


@dataclass(frozen=True)
class OpticsFacts:
    """What is known of light and lens; None where it was not said."""

    wavelength_nm: float | None = None
    f_number: float | None = None
    focal_length_mm: float | None = None  # principal distance
    irradiance_uw_per_cm2: float | None = None
    light_source: str | None = None


@dataclass(frozen=True)
class FrameGroup:
    """Frames taken under one condition.

    Parameters
    ----------
    kind : str
        ``"dark"``, ``"bright"``, or one of ``TARGETS``.
    exposure_s : float
        0 where it was not said, which only a picture of a target may do.
    photons : float or None
        Mean number of photons per pixel and exposure; None where it is not known. A dark group has 0.
    paths : tuple of Path
        The image files, in the order in which they were taken.
    role : str
        ``"level"`` (a point of the photon-transfer series), ``"stack"`` (many frames for the mean image) or ``"target"`` (frames of a
        target that did not move between them).
    facts : GroupFacts
    """

    kind: str
    exposure_s: float
    photons: float | None
    paths: tuple[Path, ...]
    role: str
    facts: GroupFacts = GroupFacts()

    @property
    def label(self) -> str:
        """Short text for messages, e.g. ``bright, exposure 0.004 s``."""
        return self.kind if self.kind in TARGETS and not self.exposure_s else f"{self.kind}, exposure {self.exposure_s:g} s"


@dataclass(frozen=True)
class Campaign:
    """The frames taken to assess one camera.

    Parameters
    ----------
    camera : CameraFacts
    optics : OpticsFacts
    groups : tuple of FrameGroup
        Dark, bright, then pictures of targets; each by exposure and photons.
    frame_shape : tuple of int
        Rows and columns of every frame, without covered pixels.
    frame_dtype : str
        ``"uint8"`` or ``"uint16"``, of every frame.
    source_path : Path
        The manifest, or the descriptor where there is no manifest.
    descriptor_path : Path or None
        The descriptor that the manifest refers to.
    licence, notes : str
        Text that came with the data.
    operator : str
        Who took the frames; empty where it was not said.
    raw : RawLayout or None
        Of frames in files without a header.
    arrays : mapping of Path to ndarray, or None
        Frames in memory by the folder of their names: ``paths`` of a group are then no files, but ``arrays/3/7`` is frame 7 of
        ``arrays[Path("arrays/3")]``, of shape (frames, rows, cols).
    findings : tuple of str
        What was left out of the listing or looks wrong in it; results repeat it among their notes.
    """

    camera: CameraFacts
    optics: OpticsFacts
    groups: tuple[FrameGroup, ...]
    frame_shape: tuple[int, int]
    frame_dtype: str
    source_path: Path
    descriptor_path: Path | None = None
    licence: str = ""
    notes: str = ""
    operator: str = ""
    raw: RawLayout | None = None
    arrays: Mapping[Path, Sequence[np.ndarray] | np.ndarray] | None = field(default=None, compare=False)
    findings: tuple[str, ...] = ()

    @property
    def stated(self) -> StatedFacts:
        """What measurements need of the facts."""
        c = self.camera
        return StatedFacts(
            interface=c.interface,
            pixel_clock_mhz=c.pixel_clock_mhz,
            sampling_clock_mhz=c.sampling_clock_mhz,
            line_time_us=c.line_time_us,
            pitch_x_um=c.pitch_x_um,
            pitch_y_um=c.pitch_y_um or c.pitch_x_um,
            wavelength_nm=self.optics.wavelength_nm,
            f_number=self.optics.f_number,
            sensor_cols=c.sensor_cols,
            sensor_rows=c.sensor_rows,
        )

    @property
    def bits(self) -> int:
        """Bits of a stored value."""
        return self.camera.bits

    @property
    def stored_shape(self) -> tuple[int, int]:
        """Rows and columns of every stored frame, with covered pixels."""
        covered = self.camera.covered
        return self.frame_shape if covered is None else covered.stored_shape(self.frame_shape)

    @property
    def base(self) -> Path:
        """The folder to which names of files are relative."""
        return self.source_path.parent

    @property
    def frame_count(self) -> int:
        """Number of frames in all groups."""
        return sum(len(group.paths) for group in self.groups)

    @property
    def files(self) -> tuple[Path, ...]:
        """Every file that the campaign is read from."""
        if self.arrays is not None:
            return ()
        listings = tuple(path for path in (self.source_path, self.descriptor_path) if path is not None)
        frames = (path.parent if is_frame(path) else path for group in self.groups for path in group.paths)
        return (*listings, *dict.fromkeys(frames))

    @contextmanager
    def named_in_errors(self) -> Iterator[None]:
        """Name the campaign in errors about its frames that name no file: of several campaigns one must know which."""
        try:
            yield
        except (InputError, MeasureError) as problem:
            if any(str(path) in problem.where for path in self.files):
                raise
            where = ": ".join(filter(None, (str(self.source_path), problem.where)))
            raise type(problem)(problem.what, where=where, value=problem.value, allowed=problem.allowed, remedy=problem.remedy) from None

    @property
    def field_groups(self) -> tuple[FrameGroup, ...]:
        """The groups of dark and bright frames."""
        return tuple(g for g in self.groups if g.kind in KINDS)

    def levels(self, kind: str) -> tuple[FrameGroup, ...]:
        """Return the groups of the photon-transfer series, by rising exposure; where there are only stacks, these."""
        groups = tuple(g for g in self.groups if g.kind == kind)
        return tuple(g for g in groups if g.role == "level") or groups

    def stacks(self, kind: str) -> tuple[FrameGroup, ...]:
        """Return the groups with many frames, by rising exposure."""
        return tuple(g for g in self.groups if g.kind == kind and g.role == "stack")


def check_groups(groups: tuple[FrameGroup, ...], where: str) -> tuple[tuple[FrameGroup, ...], tuple[str, ...]]:
    """Sort groups, put right what needs no question, and refuse what cannot be a campaign.

    A dark or bright group of one frame is left out, for noise is measured from differences. Of two groups of one condition the one of more
    frames is a stack; dark levels of one exposure are taken together. Pictures of targets stay as they are.

    Returns
    -------
    tuple
        The groups, dark, bright, then targets, each by exposure and photons, and notes on what was left out, put together or looks wrong.

    Raises
    ------
    InputError
        No frames, nothing but single frames, a file listed twice, or two bright groups of one condition.
    """
    if not groups:
        raise InputError("no frames are listed", where=where, remedy="list dark and bright frames with their exposure times, or edges")
    _refuse_repeated_files(groups, where)
    _refuse_other_times(groups, where)
    targets = sorted((g for g in groups if g.kind in TARGETS), key=_order)
    fields = [g for g in groups if g.kind not in TARGETS]
    single = [g for g in fields if len(g.paths) < 2]
    if not targets and len(single) == len(fields):
        raise InputError(
            f"only 1 frame in group ({single[0].label}), and in every other",
            where=where,
            allowed="two frames or more: temporal noise is measured from their difference",
            remedy="take a second frame under the same condition",
        )
    notes = [f"only 1 frame in group ({g.label}): it is left out, noise is measured from the difference of two" for g in single]
    notes += [f"no {kind} frames: values that need them are not measured" for kind in KINDS if all(g.kind != kind for g in groups)]
    series, told = _of_different_conditions(sorted((g for g in fields if len(g.paths) > 1), key=_order), where)
    groups = (*series, *targets)
    return groups, (*notes, *told, *_doubtful_photons([g for g in groups if g.kind == "bright" and g.role == "level"]))


def _refuse_repeated_files(groups: tuple[FrameGroup, ...], where: str) -> None:
    path, times = Counter(path for group in groups for path in group.paths).most_common(1)[0]
    if times > 1:
        remedy = "list each frame once: a frame compared with itself has no noise"
        raise InputError(f"file '{path.name}' is listed {times} times", where=where, allowed="each file once", remedy=remedy)


def _refuse_other_times(groups: tuple[FrameGroup, ...], where: str) -> None:
    for group in groups:
        for name, what in (("times_s", "times"), ("temperatures_c", "temperatures")):
            told = getattr(group.facts, name)
            if told is not None and len(told) != len(group.paths):
                one = what.removesuffix("s")
                raise InputError(
                    f"{len(told)} {what} for {len(group.paths)} frames",
                    where=f"{where}, {group.label}",
                    allowed=f"{name} with one {one} for each frame",
                    remedy="correct it",
                )


def _of_different_conditions(groups: list[FrameGroup], where: str) -> tuple[tuple[FrameGroup, ...], list[str]]:
    """The groups with no condition twice, and what was put together."""
    seen: dict[tuple[str, str, float, float | None], FrameGroup] = {}
    notes = []
    for group in groups:
        other = seen.get(_condition(group))
        if other is not None and group.role == "level" and len(group.paths) != len(other.paths):
            more = max(group, other, key=lambda g: len(g.paths))
            seen[_condition(other)] = group if more is other else other
            group, other = replace(more, role="stack"), seen.get(_condition(replace(more, role="stack")))
            notes.append(f"two groups of the same condition ({group.label}): the group of {len(group.paths)} frames is taken as a stack")
        if other is not None and group.kind == "dark":
            group = replace(group, paths=(*other.paths, *group.paths))
            notes.append(f"two groups of the same condition ({group.label}): taken as one of {len(group.paths)} frames")
        elif other is not None:
            raise InputError(
                f"two groups have the same condition ({group.label})",
                where=where,
                allowed="one group for a level, and one stack",
                remedy="put their files into one group, or correct the exposure",
            )
        seen[_condition(group)] = group
    return tuple(sorted(seen.values(), key=_order)), notes


def _order(group: FrameGroup) -> tuple[int, float, float]:
    return (*KINDS, *TARGETS).index(group.kind), group.exposure_s, group.photons or 0.0


def _condition(group: FrameGroup) -> tuple[str, str, float, float | None]:
    return group.kind, group.role, group.exposure_s, group.photons


def _doubtful_photons(levels: list[FrameGroup]) -> list[str]:
    """What is odd about the photons of a series; those of a stack serve no value."""
    known = [(g.exposure_s, g.photons) for g in levels if g.photons is not None]
    if known and len(known) < len(levels):
        missing = next(g for g in levels if g.photons is None)
        return [f"photons are known for some bright groups, not for ({missing.label}): there are no values in photons"]
    notes, longest_s, most = [], 0.0, 0.0
    for exposure_s, photons in known:  # by exposure, then photons
        if exposure_s > longest_s and photons < most:
            notes.append(
                f"photons fall from {most:g} to {photons:g} while the exposure rises from {longest_s:g} s to {exposure_s:g} s: "
                "if the light was not changed there, correct the exposure or the photons; otherwise values in photons are wrong"
            )
        longest_s, most = exposure_s, photons
    return notes
