"""A manifest drafted from a folder of frames: what names, tags and pixels tell, and the questions that only the user can answer."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from pixmetry.budget.set_ups import FLAT, SET_UPS, SetUp, kind_of
from pixmetry.camera.catalogue import sources
from pixmetry.camera.group_facts import GroupFacts
from pixmetry.core.errors import InputError, PixmetryError
from pixmetry.core.progress import Progress, no_progress
from pixmetry.core.threads import imap_tiles
from pixmetry.files.files import natural
from pixmetry.files.formats import PICTURE_ENDINGS, frame_name, frames_of
from pixmetry.files.images import load_picture
from pixmetry.files.manifest import role_of, write_manifest
from pixmetry.files.records import FACTS, KINDS, LOSSY, TARGETS, CameraFacts, Campaign, FrameGroup, OpticsFacts, check_groups
from pixmetry.files.told import SCALES, Told, joined, told_by_file, told_by_name
from pixmetry.files.zarr_frames import entries
from pixmetry.locate.job import locate
from pixmetry.observe.edges import Picture, search_edges

BOARD, NONE = "board", "none"  # what frames may show beside the kinds of a manifest
WORDS = {  # in names of files and folders, and IMAGETYP of FITS
    "dark": "dark darks bias black lenscap cap dunkel noir closed",
    "bright": "bright flat flats light white grey gray hell uniform ptc",
    "edge": "edge edges slanted sfr esfr mtf",
    "chart": "chart wedge oecf greyscale grayscale",
    "line": "line lines",
    "spots": "spots blooming smear",
    "light_off": "lightoff lag",
    "series": "series warmup warm drift stability",
    "motion": "motion moving turntable",
    "speckle": "speckle laser",
    "sequence": "sequence flicker agc",
    "views": "views",
    "bands": "bands wavelengths",
    "border": "border",
    BOARD: "board chess chessboard checkerboard charuco calib calibration calibrate dotplate",
}
KIND_OF_WORD = {word: kind for kind, words in WORDS.items() for word in words.split()}
BLOCKS = 16  # along each side of a frame, whose means show whether it is even
EVEN_REL = 0.03  # of the light: what blocks of an even field, and
ROUGH_REL = 0.15  # its pixels, may scatter beside noise and a quadratic surface
DARK_REL = 0.02  # of the range of all even fields: below it one is dark
JUMP = 8.0  # times the usual change from frame to frame is another light
LEAST_TARGETS = 9  # of a fixed field
DEPTHS = (8, 10, 12, 14, 16)


@dataclass(frozen=True)
class Look:
    """One frame, looked at: ``blocks`` are means of its parts, shape (16, 16); ``rough_dn`` is the scatter of pixels within parts."""

    path: Path
    shape: tuple[int, int]
    dtype: str
    lossless: bool | None
    mean_dn: float
    top_dn: int
    used: int
    blocks: np.ndarray
    rough_dn: float
    told: Told

    @property
    def even(self) -> bool:
        """Whether it shows an even field: noise, shading and a little pattern."""
        row, col = (np.linspace(-1, 1, BLOCKS)[:, None], np.linspace(-1, 1, BLOCKS)[None, :])
        terms = np.stack([np.broadcast_to(t, (BLOCKS, BLOCKS)).ravel() for t in (1 + 0 * row, row, col, row * col, row**2, col**2)], axis=1)
        values = self.blocks.ravel()
        rest = values - terms @ np.linalg.lstsq(terms, values, rcond=None)[0]
        noise = self.rough_dn / np.sqrt(self.shape[0] * self.shape[1] / BLOCKS**2)
        smooth = rest.std() < max(EVEN_REL * max(self.mean_dn, 1.0), 4 * noise)
        return bool(smooth and self.rough_dn < ROUGH_REL * self.mean_dn + 3 * np.sqrt(self.mean_dn) + 20)


@dataclass(frozen=True)
class DraftGroup:
    """Frames that seem to be taken under one condition.

    Parameters
    ----------
    name : str
        ``g1``, ``g2`` …, by which answers name it.
    looks : tuple of Look
    kind : str
        Of a manifest, or `BOARD`, or `NONE`; empty where it is asked.
    why : str
        What tells the kind.
    exposure_s, photons : float or None
    doubts : tuple of str
    """

    name: str
    looks: tuple[Look, ...]
    kind: str = ""
    why: str = ""
    exposure_s: float | None = None
    photons: float | None = None
    doubts: tuple[str, ...] = ()

    @property
    def paths(self) -> tuple[Path, ...]:
        """The frames, in the order of their names."""
        return tuple(look.path for look in self.looks)

    @property
    def level_dn(self) -> float:
        """Mean of all pixels of all frames."""
        return float(np.mean([look.mean_dn for look in self.looks]))


@dataclass(frozen=True)
class Question:
    """What only the user knows: ``key`` is what an answer is for, ``allowed`` what it may be."""

    key: str
    text: str
    allowed: str


@dataclass(frozen=True)
class Draft:
    """What a folder seems to hold.

    Parameters
    ----------
    folder : Path
    groups : tuple of DraftGroup
    camera : CameraFacts
    assumed : tuple of str
        What was taken from tags, names and pixels, and is to be checked.
    left_out : tuple of str
        Files that no manifest can list, and why.
    questions : tuple of Question
        With answers to all of them there is a campaign.
    """

    folder: Path
    groups: tuple[DraftGroup, ...]
    camera: CameraFacts
    assumed: tuple[str, ...]
    left_out: tuple[str, ...]
    questions: tuple[Question, ...]

    @property
    def listed(self) -> tuple[DraftGroup, ...]:
        """Groups of the manifest."""
        return tuple(g for g in self.groups if g.kind in (*KINDS, *TARGETS))

    @property
    def boards(self) -> tuple[DraftGroup, ...]:
        """Pictures for a calibration, which a manifest does not list."""
        return tuple(g for g in self.groups if g.kind == BOARD)

    def campaign(self) -> Campaign:
        """The campaign of a draft without questions.

        Raises
        ------
        InputError
            If there are questions left, or no frames for a manifest.
        """
        if self.questions:
            raise unanswered(self)
        where = str(self.folder)
        if not self.listed:
            remedy = "photograph dark and bright frames or a chart (pixmetry shoot-list)"
            if self.boards:
                remedy = f"these are pictures for `pixmetry calibrate`; for an assessment {remedy}"
            raise InputError("no frames for an assessment", where=where, allowed=", ".join((*KINDS, *TARGETS)), remedy=remedy)
        groups = tuple(_group_of(g) for g in self.listed)
        groups, notes = check_groups(groups, where)
        first = self.listed[0].looks[0]
        manifest = self.folder / "campaign.yaml"
        drafted = ("the manifest was drafted from names, tags and pixels (pixmetry init)", *(f"to check: {text}" for text in self.assumed))
        return Campaign(self.camera, OpticsFacts(), groups, first.shape, first.dtype, manifest, findings=(*notes, *drafted, *self.left_out))


def unanswered(found: Draft) -> InputError:
    """The questions of a draft, as one error."""
    listed = "; ".join(f"{q.key}: {q.text} ({q.allowed})" for q in found.questions)
    remedy = "answer with `pixmetry init FOLDER --set KEY=VALUE …`"
    return InputError(
        "folder holds no campaign, and its files do not tell all that one needs", where=str(found.folder), value=listed, remedy=remedy
    )


def draft_campaign(folder: str | Path, answers: Mapping[str, str] | None = None, progress: Progress = no_progress) -> Draft:
    """Look at every frame of a folder and the folders below, and draft the manifest.

    Parameters
    ----------
    folder : str or Path
    answers : mapping of str to str, optional
        ``name``, ``bits``, ``pitch_um``, ``sensor``, ``interface``, ``exposure_unit``; and of a group ``g2.kind``, ``g2.exposure_s``,
        ``g2.photons``.
    progress : callable, optional

    Returns
    -------
    Draft

    Raises
    ------
    InputError
        If the folder has no images, or an answer is to no question.
    """
    folder, answers = Path(folder), dict(answers or {})
    looks, left_out = _looks(folder, progress)
    looks, others = _of_one_size(looks)
    groups = [DraftGroup(f"g{k}", part) for k, part in enumerate(_conditions(folder, looks), start=1)]
    _refuse_unknown(answers, groups)
    groups = _with_kinds(groups, answers)
    groups, unit_asked = _with_exposures(groups, answers)
    camera, assumed = _camera(folder, looks, answers)
    questions = [*_kind_questions(groups), *unit_asked, *_exposure_questions(groups, bool(unit_asked)), *_light_questions(groups)]
    lossy = [g for g in groups if g.kind in (*KINDS, *TARGETS) and g.kind not in LOSSY and any(k.lossless is False for k in g.looks)]
    left_out += [f"{g.name} ({_shown(folder, g)}): stored as JPEG, which changes noise: no frames of kind {g.kind}" for g in lossy]
    kept = tuple(replace(g, kind=NONE) if g in lossy else g for g in groups)
    doubts = [f"{g.name}: {doubt}" for g in kept for doubt in g.doubts]
    return Draft(folder, kept, camera, (*assumed, *doubts), (*left_out, *others), tuple(questions))


def write_draft(found: Draft, path: str | Path | None = None) -> Path:
    """Write the manifest of a draft without questions, with what was assumed as comments in front.

    Raises
    ------
    InputError
        If there are questions left, or the file exists.
    """
    path = Path(path) if path is not None else found.folder / "campaign.yaml"
    campaign = found.campaign()
    if path.exists():
        raise InputError("the file exists", where=str(path), remedy="remove it, or name another with -o")
    write_manifest(replace(campaign, source_path=path), path)
    lines = ["# Drafted from names, tags and pixels. Check:", *(f"# - {text}" for text in found.assumed)]
    path.write_text("\n".join(lines) + "\n" + path.read_text(encoding="utf-8"), encoding="utf-8")
    return path


@dataclass(frozen=True)
class Prospect:
    """What the frames of a kind measure: titles of error sources."""

    set_up: SetUp
    titles: tuple[str, ...]


def prospects(kinds: set[str]) -> tuple[tuple[Prospect, ...], tuple[Prospect, ...]]:
    """What frames of these kinds measure, and what others would add, the most useful first."""
    titles: dict[str, list[str]] = {}
    for source in sources().values():
        titles.setdefault(kind_of(source.id), []).append(source.title)
    given = {FLAT if kind in KINDS else kind for kind in kinds}
    if not set(KINDS) <= kinds:
        given.discard(FLAT)
    every = [Prospect(s, tuple(titles.get(kind, ()))) for kind, s in SET_UPS.items()]
    now = tuple(p for p in every if p.set_up.kind in given)
    later = sorted((p for p in every if p.set_up.kind not in given and p.titles), key=lambda p: -len(p.titles))
    return now, tuple(later)


# ---- looking ---------------------------------------------------------------------------------------------------------------------------


def _looks(folder: Path, progress: Progress) -> tuple[list[Look], list[str]]:
    """Every frame of the folder and those below that can be read, by name; and which cannot."""
    if not folder.is_dir():
        raise InputError("no such folder", where=str(folder), remedy="name the folder that holds the frames")
    found = sorted((p for p in folder.rglob("*") if not _hidden(p.relative_to(folder))), key=natural)
    problems: dict[str, list[Path]] = {}
    files: list[Path] = []
    for path in found:
        try:
            if path.is_dir():
                files += entries(path)
            elif path.suffix.lower() in PICTURE_ENDINGS:
                files += frames_of(path)
        except InputError as problem:
            problems.setdefault(problem.what, []).append(path)
    if not files and not problems:
        remedy = "name the folder that holds the frames; for files without a header write a manifest with `raw:`"
        raise InputError("no image files", where=str(folder), allowed=", ".join(PICTURE_ENDINGS), remedy=remedy)
    looks: list[Look] = []
    for done, seen in enumerate(imap_tiles(lambda path: _look(folder, path), files, None), start=1):
        progress("looking at frames", done, len(files))
        if isinstance(seen, Look):
            looks.append(seen)
        else:
            problems.setdefault(seen[1], []).append(seen[0])
    left_out = [
        f"{frame_name(paths[0])}{f' and {len(paths) - 1} more' if len(paths) > 1 else ''}: {what}" for what, paths in problems.items()
    ]
    if not looks:
        raise InputError("no frames that can be measured", where=str(folder), value="; ".join(left_out))
    return looks, left_out


def _hidden(path: Path) -> bool:
    return any(part.startswith(".") for part in path.parts)


def _look(folder: Path, path: Path) -> Look | tuple[Path, str]:
    try:
        picture = load_picture(path)
    except InputError as problem:
        return path, problem.what
    data = picture.array
    if data.dtype.kind == "f":
        return path, "values with fractions: frames are whole numbers as the camera stored them"
    if min(data.shape) < 2 * BLOCKS:
        return path, f"{data.shape[1]} x {data.shape[0]} pixels are too few for a frame"
    rows, cols = (n // BLOCKS * BLOCKS for n in data.shape)
    parts = data[:rows, :cols].reshape(BLOCKS, rows // BLOCKS, BLOCKS, cols // BLOCKS).astype(np.float32)
    blocks = parts.mean(axis=(1, 3), dtype=float)
    rough = float(np.sqrt(np.median(parts.var(axis=(1, 3)))))
    told = joined(told_by_file(path), told_by_name(path.relative_to(folder).as_posix()))
    named = told_by_name(path.relative_to(folder).as_posix()).words
    told = replace(told, words=told.words | named)
    used = int(np.bitwise_or.reduce(data, axis=None))
    shape = (int(data.shape[0]), int(data.shape[1]))
    return Look(path, shape, data.dtype.name, picture.lossless, float(data.mean()), int(data.max()), used, blocks, rough, told)


def _of_one_size(looks: list[Look]) -> tuple[list[Look], list[str]]:
    """The frames of the size and depth that most have; what a manifest cannot list beside them."""
    of = Counter((look.shape, look.dtype) for look in looks)
    (usual, _), *rest = of.most_common()
    size, others = f"{usual[0][1]} x {usual[0][0]}, {usual[1]}", [(f"{s[1]} x {s[0]}, {t}", count) for (s, t), count in rest]
    notes = [f"{count} frames of {other}: a campaign has frames of one size and depth, here {size}" for other, count in others]
    return [look for look in looks if (look.shape, look.dtype) == usual], notes


def _conditions(folder: Path, looks: Sequence[Look]) -> Iterator[tuple[Look, ...]]:
    """Frames of one condition: of one pattern of names, one exposure, and one level of light."""
    by_name: dict[Any, list[Look]] = {}
    for look in looks:
        pattern = re.sub(r"\d+", "#", look.path.relative_to(folder).as_posix())
        by_name.setdefault((pattern, look.told.exposure_s, look.told.unitless, look.even), []).append(look)
    for part in by_name.values():
        yield from _by_light(part) if part[0].even else [tuple(part)]


def _by_light(looks: list[Look]) -> Iterator[tuple[Look, ...]]:
    """Split where the mean jumps from one frame to the next, and put frames of one level together again."""
    steps = np.abs(np.diff([look.mean_dn for look in looks]))
    jump = max(JUMP * float(np.quantile(steps, 0.25)), 0.5, 0.01 * looks[0].mean_dn) if steps.size else 0.0
    runs: list[list[Look]] = [[looks[0]]]
    for look, step in zip(looks[1:], steps, strict=True):
        if step > jump:
            runs.append([])
        runs[-1].append(look)
    if len(runs) > len(looks) / 2 and len(looks) > 3:  # as many levels as frames: light that changes all the time, or pictures
        yield tuple(looks)
        return
    levels: list[list[Look]] = []
    for run in runs:
        same = next((other for other in levels if abs(_level(other) - _level(run)) <= jump), None)
        if same is None:
            levels.append(run)
        else:
            same += run
    yield from map(tuple, levels)


def _level(looks: Sequence[Look]) -> float:
    return float(np.mean([look.mean_dn for look in looks]))


# ---- what they show --------------------------------------------------------------------------------------------------------------------


def _with_kinds(groups: list[DraftGroup], answers: Mapping[str, str]) -> list[DraftGroup]:
    even = [g.looks[0].even for g in groups]
    levels = [g.level_dn for g, is_even in zip(groups, even, strict=True) if is_even]
    black, span = (min(levels), max(levels) - min(levels)) if levels else (0.0, 0.0)
    contrast = span > max(0.02 * max(levels, default=0.0), 2.0)
    out = []
    for group, is_even in zip(groups, even, strict=True):
        named = [KIND_OF_WORD[w] for w in sorted(group.looks[0].told.words) if w in KIND_OF_WORD]
        kinds = list(dict.fromkeys(named))
        answer = answers.get(f"{group.name}.kind")
        seen = _kind_of_even(group, black, span, contrast) if is_even else ""
        if answer is not None:
            out.append(replace(group, kind=answer, why="as answered"))
        elif len(kinds) == 1:
            out.append(replace(group, kind=kinds[0], why="its name", doubts=_against(kinds[0], is_even, seen, contrast)))
        elif is_even:
            out.append(replace(group, kind=seen, why="an even field" if seen else ""))
        else:
            kind, why = _kind_of_picture(group)
            out.append(replace(group, kind=kind, why=why))
    return out


def _against(named: str, even: bool, seen: str, contrast: bool) -> tuple[str, ...]:
    """Why the pixels make a name doubtful."""
    if named in KINDS and not even:
        return (f"named {named}, but it shows something: an even field is expected",)
    if contrast and named in KINDS and seen in KINDS and seen != named:
        return (f"named {named}, but as {'bright' if seen == 'bright' else 'dark'} as the {seen} frames",)
    return ()


def _kind_of_even(group: DraftGroup, black: float, span: float, contrast: bool) -> str:
    if not contrast:
        return ""
    return "dark" if group.level_dn <= black + DARK_REL * span else "bright"


def _kind_of_picture(group: DraftGroup) -> tuple[str, str]:
    """What a picture shows: a board, slanted edges, targets."""
    frame = load_picture(group.paths[0]).array
    if _has_chessboard(frame):
        return BOARD, "a chessboard"
    depth = np.iinfo(frame.dtype).bits
    try:
        edges = search_edges([Picture("edge", frame.astype(np.float32), 1, 2.0**depth - 1)]).measured
    except PixmetryError:
        edges = ()
    targets = _targets(frame)
    if len(targets) < LEAST_TARGETS:
        return ("edge", "a slanted edge" if len(edges) == 1 else f"{len(edges)} slanted edges") if edges else ("", "")
    last = _targets(load_picture(group.paths[-1]).array) if len(group.paths) > 1 else targets
    apart = np.hypot(*(targets[:, None, :] - last[None, :, :]).transpose(2, 0, 1)).min(axis=1) if len(last) else np.array([np.inf])
    if len(group.paths) < 3:
        return "", ""
    if float(np.median(apart)) < 1.5 and len(group.paths) >= LEAST_TARGETS:
        return "series", f"{len(targets)} targets at rest"
    return "", ""


def _targets(frame: np.ndarray) -> np.ndarray:
    """Places of discs in a frame, shape (targets, 2)."""
    try:
        found = locate(frame, estimator="centroid").columns
    except PixmetryError:
        return np.zeros((0, 2))
    return np.stack([found["x_px"], found["y_px"]], axis=1) if len(found["x_px"]) else np.zeros((0, 2))


def _has_chessboard(frame: np.ndarray) -> bool:
    try:
        import cv2
    except ImportError:  # then it is asked what the picture shows
        return False
    grey = frame if frame.dtype == np.uint8 else (frame * (255.0 / max(float(frame.max()), 1.0))).astype(np.uint8)
    return bool(cv2.findChessboardCornersSBWithMeta(grey, (3, 3), cv2.CALIB_CB_LARGER)[0])


# ---- exposures, camera, questions ------------------------------------------------------------------------------------------------------


def _with_exposures(groups: list[DraftGroup], answers: Mapping[str, str]) -> tuple[list[DraftGroup], list[Question]]:
    """Groups with their exposures, by answers, tags and names; and the question for the unit of bare numbers."""
    unit = answers.get("exposure_unit")
    if unit is not None and unit not in SCALES:
        raise InputError("unknown unit", where="exposure_unit", value=unit, allowed=", ".join(SCALES))
    out, bare = [], []
    for group in groups:
        told = group.looks[0].told
        exposure = told.exposure_s
        if (answer := answers.get(f"{group.name}.exposure_s")) is not None:
            exposure = _number(answer, f"{group.name}.exposure_s")
        elif exposure is None and told.unitless is not None:
            if unit is not None:
                exposure = float(f"{told.unitless * SCALES[unit]:.12g}")
            elif group.kind in KINDS:
                bare.append(told.unitless)
        photons = answers.get(f"{group.name}.photons")
        out.append(replace(group, exposure_s=exposure, photons=None if photons is None else _number(photons, f"{group.name}.photons")))
    if not bare:
        return out, []
    text = f"names tell exposures of {min(bare):g} to {max(bare):g}: in which unit?"
    return out, [Question("exposure_unit", text, "us, ms, s")]


def _kind_questions(groups: Sequence[DraftGroup]) -> list[Question]:
    allowed = f"{', '.join((*KINDS, *TARGETS))}, {BOARD}, or {NONE} to leave it out"
    shown = [(g, f"what do {len(g.paths)} frames from {frame_name(g.paths[0])} to {frame_name(g.paths[-1])} show?") for g in groups]
    return [Question(f"{g.name}.kind", text, allowed) for g, text in shown if not g.kind]


def _exposure_questions(groups: Sequence[DraftGroup], unit_asked: bool) -> list[Question]:
    asked = [g for g in groups if g.kind in KINDS and g.exposure_s is None]
    if unit_asked:
        asked = [g for g in asked if g.looks[0].told.unitless is None]
    text = "how long were {} {} frames from {} exposed?"
    return [
        Question(f"{g.name}.exposure_s", text.format(len(g.paths), g.kind, frame_name(g.paths[0])), "seconds, such as 0.01") for g in asked
    ]


def _light_questions(groups: Sequence[DraftGroup]) -> Iterator[Question]:
    """For the photons of bright groups of one exposure: the light was changed, and nothing in the files tells by how much."""
    bright = [(g, (g.exposure_s, role_of(g.kind, g.paths))) for g in groups if g.kind == "bright" and g.exposure_s is not None]
    shared = {one for one, count in Counter(condition for _, condition in bright).items() if count > 1}
    for group, condition in bright:
        if condition in shared and group.photons is None:
            text = f"{frame_name(group.paths[0])} has the exposure of other bright frames and another light: photons per pixel?"
            yield Question(f"{group.name}.photons", text, f"a number; or {group.name}.kind={NONE} to leave the group out")


def _camera(folder: Path, looks: Sequence[Look], answers: Mapping[str, str]) -> tuple[CameraFacts, list[str]]:
    """Facts of the camera, and which of them were assumed."""
    notes = []
    told = next((look.told.camera for look in looks if look.told.camera), "")
    name = answers.get("name") or told or folder.resolve().name
    if "name" not in answers:
        notes.append(f"name: '{name}' is that of {'the tags' if told else 'the folder'}")
    facts: dict[str, Any] = {}
    for key, choices in (("sensor", ("ccd", "cmos", "cid")), ("interface", ("digital", "analogue"))):
        if key in answers:
            if answers[key] not in choices:
                raise InputError("not an answer", where=key, value=answers[key], allowed=", ".join(choices))
            facts[key] = answers[key]
    pitch = (
        _number(answers["pitch_um"], "pitch_um") if "pitch_um" in answers else next(filter(None, (k.told.pitch_um for k in looks)), None)
    )
    if pitch is None:
        notes.append("pitch_um is not known: add it under camera, and there are values in µm, of the lens too")
    temperatures = [k.told.temperature_c for k in looks if k.told.temperature_c is not None]
    if temperatures:
        facts["temperature_c"] = float(np.median(temperatures))
    bits, why = _bits(looks)
    if "bits" in answers:
        bits = int(_number(answers["bits"], "bits"))
    else:
        notes.append(why)
    if any(look.lossless is False for look in looks):
        notes.append("some frames are JPEG: noise cannot be measured in them")
    return CameraFacts(name, bits, pitch, pitch, **facts), notes


def _bits(looks: Sequence[Look]) -> tuple[int, str]:
    """Bits of a stored value, and why."""
    top, used = max(look.top_dn for look in looks), int(np.bitwise_or.reduce([look.used for look in looks]))
    if looks[0].dtype == "uint8":
        return 8, "bits: 8, as the files are; say so if the camera delivers more"
    low = (used & -used).bit_length() - 1 if used else 0
    if low > 0 and top.bit_length() == 16:
        return 16, f"bits: 16; the lowest {low} bits are always 0: the values are shifted to the left, and a code is {2**low} DN"
    bits = next(depth for depth in DEPTHS if depth >= top.bit_length())
    sure = " (it saturates there)" if top == (1 << bits) - 1 else "; say so if the camera delivers more"
    return bits, f"bits: {bits}, for the largest value is {top}{sure}"


def _group_of(group: DraftGroup) -> FrameGroup:
    told = [look.told for look in group.looks]
    facts: dict[str, Any] = {}
    allowed = FACTS.get(group.kind, ())
    times = [t.taken_s for t in told]
    if "times_s" in allowed and all(t is not None for t in times) and len(set(times)) == len(times):
        start = min(t for t in times if t is not None)
        facts["times_s"] = tuple(round(t - start, 6) for t in times if t is not None)
    temperatures = [t.temperature_c for t in told]
    if "temperatures_c" in allowed and all(t is not None for t in temperatures):
        facts["temperatures_c"] = tuple(t for t in temperatures if t is not None)
    photons = 0.0 if group.kind == "dark" else group.photons
    return FrameGroup(group.kind, group.exposure_s or 0.0, photons, group.paths, role_of(group.kind, group.paths), GroupFacts(**facts))


def _refuse_unknown(answers: Mapping[str, str], groups: Sequence[DraftGroup]) -> None:
    keys = ["name", "bits", "pitch_um", "sensor", "interface", "exposure_unit"]
    keys += [f"{g.name}.{what}" for g in groups for what in ("kind", "exposure_s", "photons")]
    kinds = (*KINDS, *TARGETS, BOARD, NONE)
    for key, value in answers.items():
        if key not in keys:
            raise InputError(
                "nothing is asked by this name", value=key, allowed=f"{', '.join(keys[:6])}, g1.kind … {groups[-1].name}.exposure_s"
            )
        if key.endswith(".kind") and value not in kinds:
            raise InputError("no such kind of frames", where=key, value=value, allowed=", ".join(kinds))


def _number(text: str, where: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = float("nan")
    if not (np.isfinite(value) and value > 0):
        raise InputError("not a number above 0", where=where, value=text, remedy="write it without its unit")
    return value


def _shown(folder: Path, group: DraftGroup) -> str:
    return group.paths[0].relative_to(folder).as_posix()
