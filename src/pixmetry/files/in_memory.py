"""A campaign whose frames are arrays in memory."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from pixmetry.camera.group_facts import GroupFacts
from pixmetry.core.errors import InputError
from pixmetry.files.manifest import active_shape, camera_facts, check_window, photons_of, role_of
from pixmetry.files.records import Campaign, FrameGroup, OpticsFacts, check_groups

NAME = "arrays in memory"


@dataclass(frozen=True)
class Frames:
    """Frames in memory that were taken under one condition.

    Parameters
    ----------
    kind : str
        ``"dark"``, ``"bright"``, or a kind of pictures, as the manifest's ``kind``.
    exposure_s : float, or None of a target
    data : ndarray, shape (frames, rows, cols), or sequence of ndarray of shape (rows, cols)
        Stored values, whole numbers from 0 to 65535, in the order in which the frames were taken. They are not copied.
    photons : float, optional
        Mean number of photons per pixel and exposure of a bright group.
    role : {"level", "stack"}, optional
        A point of the photon-transfer series, or many frames for the mean image; by default told from their number.
    facts : GroupFacts
        What else is known of the group, as the manifest's ``wavelength_nm``.

    Examples
    --------
    >>> import numpy as np
    >>> Frames("dark", 0.01, np.zeros((2, 8, 8), np.uint16)).kind
    'dark'
    """

    kind: str
    exposure_s: float | None
    data: np.ndarray | Sequence[np.ndarray]
    photons: float | None = None
    role: str | None = None
    facts: GroupFacts = GroupFacts()


def campaign_of_arrays(groups: Iterable[Frames], *, optics: Mapping[str, Any] | None = None, operator: str = "", **camera: Any) -> Campaign:
    """Make a campaign of frames in memory, for `assess`, `emva1288` and all that takes a campaign.

    Parameters
    ----------
    groups : iterable of Frames
        One for each exposure time and light, dark and bright; one for each picture of a target (frames in which nothing moved).
    optics : mapping, optional
        Of the manifest's keys under ``optics``: ``wavelength_nm``, ``f_number``, ``focal_length_mm``, ``irradiance_uw_per_cm2``,
        ``light_source``.
    operator : str
        Who took the frames.
    **camera
        The manifest's keys under ``camera``: ``bits`` (needed), ``name``, ``pitch_um``, ``sensor``, ``interface``, ``lossless`` …

    Returns
    -------
    Campaign

    Raises
    ------
    InputError
        If a key is unknown, or the frames make no campaign.

    Examples
    --------
    >>> import numpy as np
    >>> rng = np.random.default_rng(1)
    >>> def taken(kind, exposure_s, electrons):
    ...     dn = 20 + 0.5 * rng.poisson(electrons, (2, 24, 32)) + rng.normal(0, 2, (2, 24, 32))
    ...     return Frames(kind, exposure_s, np.rint(dn).astype(np.uint16))
    >>> steps = [0.001 * k for k in range(1, 11)]
    >>> groups = [taken("dark", t, 0) for t in steps] + [taken("bright", t, 4e5 * t) for t in steps]
    >>> campaign_of_arrays(groups, bits=12, name="my camera").camera.name
    'my camera'
    """
    from pixmetry.core.config import validate
    from pixmetry.files.schema import CameraModel, GroupModel, OpticsModel

    facts = camera_facts(validate(CameraModel, {"name": NAME, **camera}, NAME))
    light = validate(OpticsModel, dict(optics or {}), NAME)
    made, shapes, eight = [], set(), True
    arrays: dict[Path, np.ndarray | Sequence[np.ndarray]] = {}
    for number, group in enumerate(groups):
        folder = Path(NAME) / str(number)
        if not isinstance(group, Frames):
            remedy = "give Frames(kind, exposure_s, data), one for each exposure time and light"
            raise InputError("not frames of one condition", where=str(folder), value=type(group).__name__, allowed="Frames", remedy=remedy)
        known = {name: getattr(group, name) for name in ("kind", "exposure_s", "photons", "role")}
        checked = validate(GroupModel, {**known, **asdict(group.facts), "files": ("in memory",)}, str(folder))
        data = arrays[folder] = _checked(group.data, str(folder))
        shapes |= {frame.shape for frame in data}
        eight = eight and all(frame.dtype == np.uint8 for frame in data)
        paths = tuple(folder / str(k) for k in range(len(data)))
        photons = photons_of(checked, light, facts, str(folder))
        role = checked.role or role_of(checked.kind, paths)
        made.append(FrameGroup(checked.kind, checked.exposure_s or 0.0, photons, paths, role, checked.facts()))
    if len(shapes) > 1:
        raise InputError("frames of several sizes", where=NAME, value=sorted(shapes), allowed="one size for all frames")
    ordered, findings = check_groups(tuple(made), NAME)
    (stored,) = shapes
    shape = active_shape(facts, stored, NAME)
    check_window(facts, shape, NAME)
    dtype = "uint8" if eight else "uint16"
    told = OpticsFacts(**light.model_dump())
    return Campaign(facts, told, ordered, shape, dtype, Path(NAME), operator=operator, arrays=arrays, findings=findings)


def _checked(data: Any, where: str) -> np.ndarray | list[np.ndarray]:
    frames = data if isinstance(data, np.ndarray) else [np.asarray(frame) for frame in data]
    if isinstance(frames, np.ndarray) and frames.ndim != 3 or any(frame.ndim != 2 for frame in frames):
        found = frames.shape if isinstance(frames, np.ndarray) else [frame.shape for frame in frames]
        raise InputError("not a stack of frames", where=where, value=found, allowed="shape (frames, rows, cols)", remedy="store it so")
    wrong = next((frame.dtype for frame in frames if frame.dtype.kind not in "ui"), None)
    if wrong is not None:
        remedy = "give the stored values, before any processing"
        raise InputError("grey values that are not whole numbers", where=where, value=str(wrong), allowed="integers", remedy=remedy)
    if not len(frames) or any(frame.size == 0 for frame in frames):
        raise InputError("no frames, or frames without pixels", where=where, remedy="leave them out")
    return frames
