"""What a campaign is: one camera, its facts, and groups of frames taken at known exposures."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from pixmetry.campaign.formats import is_frame
from pixmetry.campaign.raw_values import RawLayout
from pixmetry.core.errors import InputError, MeasureError

STACK_FRAMES = 8  # from this many frames on, a group is a stack: its mean image serves the spatial measurements
KINDS = ("dark", "bright")


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
    cfa: str | None = None  # colour filter of a mosaic: the colours of pixels (0,0), (0,1), (1,0), (1,1), e.g. "RGGB"
    vendor: str | None = None
    model: str | None = None
    serial_number: str | None = None
    sensor_cols: int | None = None  # of the whole sensor, where the frames are a window of it
    sensor_rows: int | None = None
    first_col: int | None = None  # place of the frames' first pixel on the sensor, from 0
    first_row: int | None = None
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
        ``"dark"`` or ``"bright"``.
    exposure_s : float
    photons : float or None
        Mean number of photons per pixel and exposure; None where it is not known. A dark group has 0.
    paths : tuple of Path
        The image files, in the order in which they were taken.
    role : str
        ``"level"`` (a point of the photon-transfer series) or ``"stack"`` (many frames for the mean image).
    """

    kind: str
    exposure_s: float
    photons: float | None
    paths: tuple[Path, ...]
    role: str

    @property
    def label(self) -> str:
        """Short text for messages, e.g. ``bright, exposure 0.004 s``."""
        return f"{self.kind}, exposure {self.exposure_s:g} s"


@dataclass(frozen=True)
class Campaign:
    """The frames taken to assess one camera.

    Parameters
    ----------
    camera : CameraFacts
    optics : OpticsFacts
    groups : tuple of FrameGroup
        Dark before bright, then by exposure and photons.
    frame_shape : tuple of int
        Rows and columns of every frame.
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

    @property
    def bits(self) -> int:
        """Bits of a stored value."""
        return self.camera.bits

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

    def levels(self, kind: str) -> tuple[FrameGroup, ...]:
        """Return the groups of the photon-transfer series, by rising exposure; where there are only stacks, these."""
        groups = tuple(g for g in self.groups if g.kind == kind)
        return tuple(g for g in groups if g.role == "level") or groups

    def stacks(self, kind: str) -> tuple[FrameGroup, ...]:
        """Return the groups with many frames, by rising exposure."""
        return tuple(g for g in self.groups if g.kind == kind and g.role == "stack")


def check_groups(groups: tuple[FrameGroup, ...], where: str) -> tuple[FrameGroup, ...]:
    """Sort groups and refuse what cannot be a campaign.

    Raises
    ------
    InputError
        No frames, no dark, no bright, fewer than two frames in a group, a file or a condition listed twice, photons known for some
        bright groups only, or photons that fall while the exposure rises.
    """
    if not groups:
        raise InputError("no frames are listed", where=where, remedy="list dark and bright frames with their exposure times")
    for kind, how in (("dark", "with the lens capped or the light off"), ("bright", "of a uniformly lit field")):
        if not any(g.kind == kind for g in groups):
            raise InputError(
                f"no {kind} frames", where=where, allowed=f"at least one {kind} group of two frames", remedy=f"add frames {how}"
            )
    for group in groups:
        if len(group.paths) < 2:
            raise InputError(
                f"only {len(group.paths)} frame in group ({group.label})",
                where=where,
                allowed="two frames or more: temporal noise is measured from their difference",
                remedy="take a second frame under the same condition, or leave the group out",
            )
    _refuse_repeated_files(groups, where)
    groups = tuple(sorted(groups, key=lambda g: (g.kind != "dark", g.exposure_s, g.photons or 0.0)))
    _refuse_repeated_conditions(groups, where)
    _check_photons([g for g in groups if g.kind == "bright"], where)
    return groups


def _refuse_repeated_files(groups: tuple[FrameGroup, ...], where: str) -> None:
    path, times = Counter(path for group in groups for path in group.paths).most_common(1)[0]
    if times > 1:
        remedy = "list each frame once: a frame compared with itself has no noise"
        raise InputError(f"file '{path.name}' is listed {times} times", where=where, allowed="each file once", remedy=remedy)


def _refuse_repeated_conditions(groups: tuple[FrameGroup, ...], where: str) -> None:
    seen = set()
    for group in groups:
        condition = (group.kind, group.role, group.exposure_s, group.photons)
        if condition in seen:
            raise InputError(
                f"two groups have the same condition ({group.label})",
                where=where,
                allowed="one group for a level, and one stack",
                remedy="put their files into one group, or correct the exposure",
            )
        seen.add(condition)


def _check_photons(bright: list[FrameGroup], where: str) -> None:
    known = [(g.exposure_s, g.photons) for g in bright if g.photons is not None]
    if known and len(known) < len(bright):
        missing = next(g for g in bright if g.photons is None)
        remedy = "give photons (or the irradiance) for every bright group or for none"
        raise InputError(f"photons are known for some bright groups, not for ({missing.label})", where=where, remedy=remedy)
    longest_s, most = 0.0, 0.0
    for exposure_s, photons in known:  # by exposure, then photons
        if exposure_s > longest_s and photons < most:
            raise InputError(
                f"photons fall from {most:g} to {photons:g} while the exposure rises from {longest_s:g} s to {exposure_s:g} s",
                where=where,
                allowed="photons that rise with the exposure time",
                remedy="correct the exposure or the photons of these groups",
            )
        longest_s, most = exposure_s, photons
