"""From images of a calibration board, or of coded targets, to identified image coordinates with covariances."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from pixmetry.calibrate.bundle.model import CameraModel
from pixmetry.calibrate.bundle.network import Network
from pixmetry.calibrate.images.looks import Looks, by_marks, together
from pixmetry.calibrate.images.numbering import Board, asymmetric_turns, consistent, quarters_between
from pixmetry.calibrate.images.parts import numbered_parts
from pixmetry.calibrate.images.targets import DICTIONARIES, KINDS, NUMBERED, Seen, Wanted, board_size, see
from pixmetry.camera.camera import Camera
from pixmetry.core.errors import InputError, MeasureError
from pixmetry.core.finding import Finding
from pixmetry.core.progress import Progress, no_progress
from pixmetry.core.threads import imap_tiles
from pixmetry.files.formats import PICTURE_ENDINGS, frame_name
from pixmetry.files.images import picture_files
from pixmetry.files.raw_values import RawLayout, layout_of
from pixmetry.locate.noise import NoiseModel, noise_model
from pixmetry.locate.template.corners import chessboard_turns

LEAST_IMAGES = 3
NAMED_REASONS = 3
LEAST_IMAGE_SHARE = 1 / 3  # of all images: where fewer show the board, those that do may show something else


@dataclass(frozen=True)
class ImageObservations:
    """Identified image coordinates of several images by one camera. Lengths are in the unit in which the board's were given.

    Parameters
    ----------
    kind : str
    images : tuple of str
        Names of the images that are used.
    sizes : tuple of (int, int)
        Their columns and rows, px; all the same.
    points : tuple of str
    xyz : ndarray, shape (points, 3)
        Nominal coordinates on the board, x along its columns, y along its rows, z = 0; NaN for coded targets.
    image, point : ndarray of int, shape (n,)
    x_px, y_px : ndarray, shape (n,)
    covariance_px2 : ndarray, shape (n, 3)
        var x, cov xy, var y, of the noise of the grey values.
    diameter : ndarray, shape (points,), optional
        Of circular targets: the image coordinates are those of the centres of their images.
    normal : ndarray, shape (points, 3), optional
        Of the circles, where they stand on a board.
    left_out : tuple of (str, str)
        Names of the images that are not used, and why.
    findings : tuple of Finding
    plate : Looks, optional
        Of a plate of dots: the marks by which it was numbered.
    """

    kind: str
    images: tuple[str, ...]
    sizes: tuple[tuple[int, int], ...]
    points: tuple[str, ...]
    xyz: np.ndarray
    image: np.ndarray
    point: np.ndarray
    x_px: np.ndarray
    y_px: np.ndarray
    covariance_px2: np.ndarray
    diameter: np.ndarray | None = None
    normal: np.ndarray | None = None
    left_out: tuple[tuple[str, str], ...] = ()
    findings: tuple[Finding, ...] = ()
    plate: Looks | None = None

    def __len__(self) -> int:
        return len(self.x_px)

    def network(self, camera: CameraModel, unit: str = "mm") -> Network:
        """The network of these observations by one camera: the board's coordinates are held fixed, coded targets are free."""
        return Network(
            cameras=(camera,),
            images=self.images,
            camera_of=np.zeros(len(self.images), np.int64),
            points=self.points,
            x_px=self.x_px,
            y_px=self.y_px,
            image=self.image,
            point=self.point,
            covariance_px2=self.covariance_px2,
            xyz=self.xyz,
            u_xyz=np.where(np.isfinite(self.xyz), 0.0, np.inf),
            diameter=self.diameter,
            normal=self.normal,
            unit=unit,
            covariance_known=True,
        )


def observations_of(
    images: Sequence[str | Path | np.ndarray],
    kind: str,
    *,
    grid: str | tuple[int, int] | None = None,
    pitch: float | tuple[float, float] | None = None,
    side: float | None = None,
    diameter: float | None = None,
    polarity: str = "auto",
    channel: str | None = None,
    raw: str | RawLayout | None = None,
    noise: NoiseModel | Camera | str | Path | None = None,
    dictionary: str | None = None,
    plate: Looks | None = None,
    least_images: int = LEAST_IMAGES,
    threads: int | None = None,
    progress: Progress | None = None,
) -> ImageObservations:
    """Locate and identify the targets of a calibration in all of its images.

    Parameters
    ----------
    images : sequence of path or ndarray
        Image files (PNG, TIFF, BMP, FITS, NPY, JPEG, raw), folders of them, or frames of shape (rows, cols), in the order in which they
        were taken. A file with several frames is as many images.
    kind : {"chessboard", "dots", "asymmetric", "squares", "coded", "charuco", "aprilgrid"}
        Inner corners of a chessboard; a plate of circular targets; one whose odd rows are shifted by half a step (OpenCV's); corners of a
        plate of separate squares; coded targets anywhere; inner corners of a chessboard whose bright squares hold markers; corners of a
        grid of AprilTags.
    grid : "COLSxROWS" or (cols, rows), optional
        Of inner corners, dots, separate squares or tags on the whole board; of a charuco board the squares. Of a plate of dots that is
        larger than the images, with three marks or more among its dots, "any" will do. Not for coded targets.
    pitch : float or (float, float), optional
        Distance of neighbours along columns and rows, in the unit that object coordinates are wanted in. Not for coded targets.
    side : float, optional
        Of the separate squares, markers or tags, in the same unit.
    diameter : float, optional
        Of circular targets, in the same unit, for the correction of their eccentricity.
    polarity : {"auto", "bright", "dark"}
        Of dots, squares or coded discs on their ground.
    channel : {"red", "green", "blue"}, optional
        Of colour images.
    raw : str or RawLayout, optional
        Of files without a header: ``"1920x1200:Mono12p"``.
    noise : optional
        As in `pixmetry.locate`; by default it is measured in each image.
    dictionary : str, optional
        Of the markers: ``5X5_1000`` of a charuco board and ``APRILTAG_36h11`` of tags by default. Of coded targets ``RING_8``, ``RING_12``
        (the default), ``RING_14``, ``RING_16`` or ``RING_20``, by the segments of their rings.
    plate : Looks, optional
        Of a plate of dots: its marks as another camera's pictures were numbered by them (``ImageObservations.plate``).
    least_images : int
        From how many usable images on there is a result.
    threads : int, optional
    progress : callable (what, done, of), optional

    Returns
    -------
    ImageObservations
        Points are named ``row/col`` from 0 (of squares: ``row/col.k``, k = 0 … 3 round the square from its corner of least row and column
        along the row first), coded targets by their numbers.

    Raises
    ------
    InputError
        If a file or an option cannot be used.
    MeasureError
        If fewer images than ``least_images`` can be used; it says what was found in each.
    """
    if kind not in KINDS:
        raise InputError("no such kind of calibration target", where="kind", value=kind, allowed=", ".join(KINDS))
    size, step = board_size(kind, grid), _checked_lengths(kind, pitch, side, diameter)
    if polarity not in ("auto", "bright", "dark"):
        raise InputError("no such polarity", where="polarity", value=polarity, allowed="auto, bright, dark")
    sides = (np.nan, np.nan) if side is None else (side / step[0], side / step[1])
    layout = layout_of(raw)
    if dictionary is not None and kind not in DICTIONARIES:
        raise InputError("a dictionary is one of markers", where="dictionary", value=dictionary, allowed="with charuco, aprilgrid or coded")
    markers = dictionary or DICTIONARIES.get(kind, "")
    ratio = step[1] / step[0] if kind == "dots" else 1.0
    wanted = Wanted(kind, size, sides, polarity, channel, noise_model(noise), threads, layout, markers, ratio)
    items = _items(images, layout)
    told = progress or no_progress
    seen: list[Seen] = []
    for one in imap_tiles(lambda item: see(*item, wanted), items, threads):
        seen.append(one)
        told("locating", len(seen), len(items))
    seen = _of_one_size(seen)
    seen, marks, parts = numbered_parts(seen, wanted, plate) if kind == "dots" else (seen, None, ())
    good = [s for s in seen if not s.reason]
    _check_enough(seen, good, wanted, least_images)
    good, marks, numbering = (good, marks, parts) if parts else _numbered(good, kind, plate)
    out = _gathered(good, kind)
    names, xyz = _nominal(out.xyz, kind, step, side)
    return replace(
        out,
        points=names,
        xyz=xyz,
        diameter=None if diameter is None or kind not in ("dots", "asymmetric", "coded") else np.full(len(names), float(diameter)),
        normal=np.tile([0.0, 0.0, 1.0], (len(names), 1)) if kind in ("dots", "asymmetric") else None,
        left_out=tuple((s.name, s.reason) for s in seen if s.reason),
        findings=(*_lost_images(seen), *numbering, *_notes(good), *out.findings),
        plate=marks,
    )


def _lost_images(seen: list[Seen]) -> list[Finding]:
    return [Finding("image_left_out", f"{s.name} was left out: {s.reason}.", level="warning") for s in seen if s.reason]


def _notes(good: list[Seen]) -> list[Finding]:
    """What else is to be said about the images that are used."""
    notes = [Finding("targets", f"{s.name}: {s.note}.") for s in good if s.note]
    lossy = [s.name for s in good if s.lossy]
    if lossy:
        text = (
            f"{len(lossy)} of {len(good)} images were stored with loss (JPEG): its blocks shift edges, and the noise is that of the coder."
        )
        notes.append(Finding("targets", text, "Store images of a test field without loss."))
    return notes


def _checked_lengths(
    kind: str, pitch: float | tuple[float, float] | None, side: float | None, diameter: float | None
) -> tuple[float, float]:
    """Pitch along columns and rows; NaN for coded targets."""
    if diameter is not None and not (np.isfinite(diameter) and diameter > 0):
        raise InputError("not a diameter", where="diameter", value=diameter, allowed="above 0")
    if kind == "coded":
        return np.nan, np.nan
    try:
        along, across = (float(v) for v in np.broadcast_to(np.nan if pitch is None else np.asarray(pitch, float), 2))
    except ValueError:
        along = across = np.nan
    if not (0 < along < np.inf and 0 < across < np.inf):
        raise InputError("the spacing of the points on the board is missing", where="pitch", value=pitch, allowed="a length above 0")
    if kind in ("squares", *DICTIONARIES) and not (side is not None and 0 < side < min(along, across)):
        raise InputError("the side of the squares is missing", where="side", value=side, allowed="a length between 0 and the pitch")
    return along, across


def _items(images: Sequence[str | Path | np.ndarray], raw: RawLayout | None) -> list[tuple[str, Path | np.ndarray]]:
    """Names and sources of all images; a name that two files share has its folder with it."""
    given: Sequence[str | Path | np.ndarray] = [images] if isinstance(images, (str, Path)) else images
    items: list[tuple[str, Path | np.ndarray]] = []
    for one in given:
        if isinstance(one, np.ndarray):
            items.append((f"image {len(items) + 1}", one))
        else:
            items += [(frame_name(path), path) for path in picture_files([one], PICTURE_ENDINGS, raw)]
    count = Counter(name for name, _ in items)
    return [(str(source) if count[name] > 1 else name, source) for name, source in items]


def _of_one_size(seen: list[Seen]) -> list[Seen]:
    """Images of another size than most can no longer be used."""
    sizes = Counter(s.size for s in seen if not s.reason)
    if len(sizes) < 2:
        return seen
    cols, rows = sizes.most_common(1)[0][0]
    reason = f"pixels, {cols} x {rows} in the other images"
    return [s if s.reason or s.size == (cols, rows) else Seen(s.name, s.size, reason=f"{s.size[0]} x {s.size[1]} {reason}") for s in seen]


def _check_enough(seen: list[Seen], good: list[Seen], wanted: Wanted, least: int) -> None:
    if len(good) < least:
        each = "; ".join(f"{s.name}: {s.reason or f'{len(s.keys)} points'}" for s in seen)
        what = f"{len(good)} of {len(seen)} images can be used ({each})"
        remedy = "check kind, grid and polarity, or take more images of the whole board"
        raise MeasureError(what, where="images", allowed=f"{least} or more", remedy=remedy)
    if len(good) < LEAST_IMAGE_SHARE * len(seen):
        reasons = Counter(s.reason for s in seen if s.reason).most_common(NAMED_REASONS)
        said = "; ".join(f"{reason} ({count} images)" if count > 1 else reason for reason, count in reasons)
        what = f"the test field was identified in {len(good)} of {len(seen)} images only; in the others: {said}"
        remedy = "check kind, grid and polarity: part of the field may pass for all of it; else leave out images that do not show it"
        raise MeasureError(what, where="images", allowed="a third of them or more", remedy=remedy)


def _numbered(good: list[Seen], kind: str, plate: Looks | None) -> tuple[list[Seen], Looks | None, tuple[Finding, ...]]:
    """The same corner of the board is the first one in all images; and the marks that tell it on a plate of dots."""
    if kind in NUMBERED:
        return good, None, ()
    rows, cols = good[0].extent
    alike = {"chessboard": lambda: chessboard_turns(rows, cols), "asymmetric": lambda: asymmetric_turns(rows)}.get(kind, lambda: None)()
    if kind != "dots":
        boards, findings = consistent([s.board for s in good], alike)
        return _renumbered(good, boards), None, findings
    looks = [s.looks for s in good if s.looks is not None]
    known = plate if plate is not None and plate.seen.shape == (rows, cols) else None
    laid = by_marks(looks, (0, 1, 2, 3) if rows == cols else (0, 2), shifted=False, plate=known)
    decided = [None if one is None else one.quarters for one in laid]
    boards, findings = consistent([s.board for s in good], alike, decided, common=None if known is None else 0)
    out = _renumbered(good, boards)
    first = next((k for k, way in enumerate(laid) if way is not None), None)
    if known is not None or first is None:
        return out, known, findings
    quarters = quarters_between(good[first].board, boards[first]) - laid[first].quarters  # type: ignore[union-attr]
    return out, together(looks, laid)[0].turned(quarters), findings


def _renumbered(good: Sequence[Seen], boards: Sequence[Board]) -> list[Seen]:
    return [replace(s, keys=np.column_stack([b.row, b.col])) for s, b in zip(good, boards, strict=True)]


def _gathered(good: list[Seen], kind: str) -> ImageObservations:
    """All images in one table; keys of points take the place of coordinates."""
    image = np.repeat(np.arange(len(good)), [len(s.keys) for s in good])
    keys, x, y, covariance = (np.concatenate([getattr(s, name) for s in good]) for name in ("keys", "x_px", "y_px", "covariance_px2"))
    unique, point = np.unique(keys, axis=0, return_inverse=True)
    point, use = point.ravel(), np.ones(len(x), bool)
    findings: tuple[Finding, ...] = ()
    if kind == "coded" and len(good) > 1:
        use = np.bincount(point)[point] > 1
        once = ", ".join(str(k) for k in unique[np.unique(point[~use]), 0])
        findings = (Finding("targets", f"Coded targets that only one image shows are left out: {once}."),) if once else ()
        kept, point = np.unique(point[use], return_inverse=True)
        unique = unique[kept]
    names, sizes = tuple(s.name for s in good), tuple(s.size for s in good)
    return ImageObservations(kind, names, sizes, (), unique, image[use], point.ravel(), x[use], y[use], covariance[use], findings=findings)


def _nominal(keys: np.ndarray, kind: str, pitch: tuple[float, float], side: float | None) -> tuple[tuple[str, ...], np.ndarray]:
    """Names of points and their coordinates on the board."""
    if kind == "coded":
        return tuple(str(k) for k in keys[:, 0]), np.full((len(keys), 3), np.nan)
    row, col = keys.T
    if kind == "asymmetric":
        names = tuple(f"{r}/{c // 2}" for r, c in keys)
        return names, np.column_stack([0.5 * col * pitch[0], 0.5 * row * pitch[1], np.zeros(len(keys))])
    if kind not in ("squares", "aprilgrid"):
        return tuple(f"{r}/{c}" for r, c in keys), np.column_stack([col * pitch[0], row * pitch[1], np.zeros(len(keys))])
    corner = np.where(row % 2 == 0, col % 2, 3 - col % 2)
    names = tuple(f"{r // 2}/{c // 2}.{k}" for r, c, k in zip(row, col, corner, strict=True))
    x, y = (v // 2 * step + v % 2 * (side or 0.0) for v, step in zip((col, row), pitch, strict=True))
    return names, np.column_stack([x, y, np.zeros(len(keys))])
