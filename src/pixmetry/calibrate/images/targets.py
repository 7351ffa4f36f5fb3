"""The targets of a calibration in one image: located and identified as far as one image allows, or the reason why not."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from pixmetry.calibrate.images.looks import Looks, looks_of, round_steps
from pixmetry.calibrate.images.numbering import Board, Marks, dot_marks
from pixmetry.core.arrays import Flags
from pixmetry.core.errors import InputError
from pixmetry.files.formats import Decoded
from pixmetry.files.images import load_picture
from pixmetry.files.raw_values import RawLayout
from pixmetry.locate.detect.coded import RINGS_OF_12
from pixmetry.locate.detect.grids import LEAST_WHOLE, Grid
from pixmetry.locate.detect.targets import Flag, Positions
from pixmetry.locate.frame import checked_frame, scale_ends
from pixmetry.locate.job import locate
from pixmetry.locate.noise import ROUNDING_DN2, NoiseModel
from pixmetry.locate.records import Located

KINDS = ("chessboard", "dots", "asymmetric", "squares", "coded", "charuco", "aprilgrid")
NUMBERED = ("coded", "charuco", "aprilgrid")  # whose targets carry numbers: part of a board suffices
DICTIONARIES = {"charuco": "5X5_1000", "aprilgrid": "APRILTAG_36h11", "coded": RINGS_OF_12}  # unless another one is named
LEAST_SHARE = 0.5  # of a board's points, that an image must show to be used
MARKER_GAP, MARKER_CLEARANCE_PX = 0.7, 2.0  # from a corner to the next marker, over what that leaves of a square; for its blur
LEAST_NUMBERED = 8  # corners in an image
MOST_MOVED, MOVED_PX = 0.2, (2.0, 6.0)  # of a corner from where it was seen: of the distance to the next one, within these limits
LEAST_CODES = 4  # targets in an image
LEAST_PART = 16  # dots of a plate that is larger than the image
UNUSABLE = Flag.NOT_CONVERGED | Flag.BORDER


@dataclass(frozen=True)
class Wanted:
    """The targets to be found in all images.

    Parameters
    ----------
    kind : {"chessboard", "dots", "asymmetric", "squares", "coded", "charuco", "aprilgrid"}
    grid : (int, int) or None
        Columns and rows of the whole board; None: not known, or there is none.
    side : (float, float)
        Of the squares of a plate, of markers or tags, in units of the pitch along columns and along rows.
    polarity, channel, noise, threads
        As in `pixmetry.locate`.
    raw : RawLayout, optional
        Of files without a header.
    dictionary : str
        Of markers, or of the codes of coded targets.
    pitch_ratio : float
        Distance of the rows of a plate over that of its columns.
    """

    kind: str
    grid: tuple[int, int] | None = None
    side: tuple[float, float] = (np.nan, np.nan)
    polarity: str = "auto"
    channel: str | None = None
    noise: NoiseModel | None = None
    threads: int | None = None
    raw: RawLayout | None = None
    dictionary: str = ""
    pitch_ratio: float = 1.0

    @property
    def whole(self) -> int:
        """Points of the whole board; 0 where it has no size."""
        if self.grid is None:
            return 0
        cols, rows = self.grid
        return (cols - 1) * (rows - 1) if self.kind == "charuco" else cols * rows * (4 if self.kind in ("squares", "aprilgrid") else 1)


@dataclass(frozen=True)
class Seen:
    """The points of one image, or why it cannot be used.

    Parameters
    ----------
    name : str
    size : (int, int)
        Columns and rows, px.
    keys : ndarray of int, shape (n, 2) or (n, 1)
        Row and column on the board (of the corners of separate squares: two a square), or the code.
    x_px, y_px : ndarray, shape (n,)
    covariance_px2 : ndarray, shape (n, 3)
        var x, cov xy, var y.
    extent : (int, int)
        Rows and columns of the keys.
    marks : Marks, optional
    looks : Looks, optional
        Of the cells of a plate of dots.
    reason : str
        Why the image cannot be used by itself; empty if it can. With keys, it shows part of a plate, counted from the first that is seen.
    note : str
        What else is to be said about it.
    lossy : bool
        Whether its file was stored with loss.
    """

    name: str
    size: tuple[int, int]
    keys: np.ndarray = field(default_factory=lambda: np.zeros((0, 2), np.int64))
    x_px: np.ndarray = field(default_factory=lambda: np.zeros(0))
    y_px: np.ndarray = field(default_factory=lambda: np.zeros(0))
    covariance_px2: np.ndarray = field(default_factory=lambda: np.zeros((0, 3)))
    extent: tuple[int, int] = (0, 0)
    marks: Marks | None = None
    looks: Looks | None = None
    reason: str = ""
    note: str = ""
    lossy: bool = False

    @property
    def board(self) -> Board:
        """The points as a board."""
        return Board(self.keys[:, 0], self.keys[:, 1], self.x_px, self.y_px, *self.extent, self.marks)


def see(name: str, source: Path | np.ndarray, wanted: Wanted) -> Seen:
    """Read one image and find its targets.

    Raises
    ------
    InputError
        If it cannot be read.
    """
    picture = Decoded(source, None) if isinstance(source, np.ndarray) else load_picture(source, wanted.channel, wanted.raw)
    frame = checked_frame(picture.array, name)
    seen = replace(_FINDERS[wanted.kind](name, frame, wanted), lossy=picture.lossless is False)
    missing = wanted.whole - len(seen.keys)
    if seen.reason or wanted.grid is None or missing <= 0:
        return seen
    if wanted.kind not in NUMBERED and len(seen.keys) < LEAST_SHARE * wanted.whole:
        return _nothing(name, frame, f"only {len(seen.keys)} of {wanted.whole} points were found")
    return replace(seen, note=f"{missing} of {wanted.whole} points were not found or not identified")


def _nothing(name: str, frame: np.ndarray, reason: str) -> Seen:
    return Seen(name, (frame.shape[1], frame.shape[0]), reason=reason)


def _usable(found: Located | Positions) -> Flags:
    usable: Flags = np.isfinite(found.x_px) & np.isfinite(found.var_x_px2) & (found.flags & UNUSABLE == 0)
    return usable


def _seen(name: str, frame: np.ndarray, found: Located | Positions, keys: np.ndarray, use: np.ndarray, extent: tuple[int, int]) -> Seen:
    covariance = np.column_stack([found.var_x_px2, found.cov_xy_px2, found.var_y_px2])
    return Seen(name, (frame.shape[1], frame.shape[0]), keys[use], found.x_px[use], found.y_px[use], covariance[use], extent)


def _located(name: str, frame: np.ndarray, kind: str, wanted: Wanted, grid: str | tuple[int, int] | None = None) -> Located:
    polarity = "auto" if kind == "chessboard" else wanted.polarity
    words = wanted.dictionary if kind == "coded" else RINGS_OF_12
    return locate(frame, kind=kind, grid=grid, polarity=polarity, noise=wanted.noise, dictionary=words, threads=wanted.threads, name=name)


def _chessboard(name: str, frame: np.ndarray, wanted: Wanted) -> Seen:
    assert wanted.grid is not None
    cols, rows = wanted.grid
    found = _located(name, frame, "chessboard", wanted, wanted.grid)
    use = _usable(found)
    if use.sum() < 3:
        return _nothing(name, frame, "its corners could not be identified" if len(found) else found.images[0]["reason"])
    return _seen(name, frame, found, np.column_stack([found["grid_row"], found["grid_col"]]), use, (rows, cols))


def _dots(name: str, frame: np.ndarray, wanted: Wanted) -> Seen:
    found = _located(name, frame, "disc", wanted, "any" if wanted.grid is None else wanted.grid)
    keys = np.column_stack([found["grid_row"], found["grid_col"]])
    placed = keys[:, 0] >= 0
    rows, cols = (keys[placed].max(axis=0) + 1).tolist() if placed.any() else (0, 0)
    if placed.sum() < 4:
        return _nothing(name, frame, f"{len(found)} dots were seen: {found.images[0]['grid']}")
    if wanted.grid not in (None, (cols, rows)):
        return _part(name, frame, found, wanted, f"{len(found)} dots were seen: {found.images[0]['grid']}")
    use = placed & _usable(found)
    if use.sum() < LEAST_WHOLE * wanted.whole:
        missing = f"{len(found)} dots were seen: too much of {cols} × {rows} is missing to be sure of its rows and columns"
        return _part(name, frame, found, wanted, missing)
    if wanted.grid is None:
        keys = _round_cells(found, keys, use, wanted)
        rows, cols = (keys[use].max(axis=0) + 1).tolist()
    seen = _with_looks(_seen(name, frame, found, keys, use, (rows, cols)), frame)
    return replace(seen, marks=dot_marks(seen.board, _area_px(found)[use]))


def _area_px(found: Located) -> np.ndarray:
    area: np.ndarray = found["semi_major_px"] * found["semi_minor_px"] if "semi_major_px" in found.columns else found["radius_px"] ** 2
    return area


def _with_looks(seen: Seen, frame: np.ndarray) -> Seen:
    return replace(seen, looks=looks_of(frame, seen.keys[:, 0], seen.keys[:, 1], seen.x_px, seen.y_px, seen.extent))


def _part(name: str, frame: np.ndarray, found: Located, wanted: Wanted, reason: str) -> Seen:
    """Part of a plate, counted from the first row and column that are seen, or nothing; and why it is not the whole."""
    from pixmetry.locate.detect.grids import order_grid

    grid = order_grid(found.x_px, found.y_px)
    use = grid.placed & _usable(found)
    if grid.message or use.sum() < LEAST_PART:
        return _nothing(name, frame, reason)
    keys = _round_cells(found, np.column_stack([grid.row, grid.col]), use, wanted)
    rows, cols = (keys[use].max(axis=0) + 1).tolist()
    return replace(_with_looks(_seen(name, frame, found, keys, use, (rows, cols)), frame), reason=reason)


def _round_cells(found: Located, keys: np.ndarray, use: np.ndarray, wanted: Wanted) -> np.ndarray:
    """Rows and columns along steps in which the dots are round, from 0."""
    if "semi_major_px" in found.columns:
        along, across, angle = found["semi_major_px"][use], found["semi_minor_px"][use], np.radians(found["angle_deg"][use])
        axes = np.stack([np.stack([np.cos(angle), np.sin(angle)], 1), np.stack([-np.sin(angle), np.cos(angle)], 1)], axis=2)
        shapes = np.einsum("nik,nk,njk->nij", axes, np.stack([along, across], axis=1) ** 2, axes)
    else:
        shapes = found["radius_px"][use][:, None, None] ** 2 * np.eye(2)
    places = np.column_stack([found.x_px, found.y_px])[use]
    change = round_steps(keys[use], places, shapes, wanted.pitch_ratio)
    cells = np.full_like(keys, -1)
    counted = keys[use] @ change.T
    cells[use] = counted - counted.min(axis=0)
    return cells


def _asymmetric(name: str, frame: np.ndarray, wanted: Wanted) -> Seen:
    from pixmetry.locate.detect.grids import RIM_SHARE, order_grid

    assert wanted.grid is not None
    cols, rows = wanted.grid
    found = _located(name, frame, "disc", wanted)
    grid = order_grid(found.x_px, found.y_px, pattern=wanted.grid, asymmetric=True)
    if grid.message:
        return _nothing(name, frame, f"{len(found)} dots were seen: {grid.message}")
    keys = np.column_stack([grid.row, np.where(grid.placed, 2 * grid.col + grid.row % 2, -1)])
    in_row, in_col = (np.bincount(key[grid.placed], minlength=n) for key, n in zip(keys.T, (rows, 2 * cols), strict=True))
    if (
        grid.placed.sum() < LEAST_WHOLE * wanted.whole
        or in_row[[0, -1]].min() < RIM_SHARE * cols
        or in_col[[0, -1]].min() < RIM_SHARE * (rows // 2)
    ):
        return _nothing(name, frame, f"{len(found)} dots were seen: too much of {cols} × {rows} is missing")
    return _seen(name, frame, found, keys, grid.placed & _usable(found), (rows, 2 * cols))


def _squares(name: str, frame: np.ndarray, wanted: Wanted) -> Seen:
    from pixmetry.locate.detect.squares import plate_corners

    assert wanted.grid is not None
    low, high = scale_ends(frame, None, wanted.noise)
    grid, found = plate_corners(
        frame, wanted.grid, wanted.side, wanted.noise, polarity=wanted.polarity, low_dn=low, high_dn=high, threads=wanted.threads
    )
    if not len(found):
        return _nothing(name, frame, grid.message)
    return _seen(name, frame, found, np.column_stack([grid.row, grid.col]), _usable(found), (grid.rows, grid.cols))


def _coded(name: str, frame: np.ndarray, wanted: Wanted) -> Seen:
    found = _located(name, frame, "coded", wanted)
    if "rings" in found.images[0]:
        return _nothing(name, frame, found.images[0]["rings"])
    numbers, counts = np.unique(found["code"][found["code"] >= 0], return_counts=True)
    use = _usable(found) & np.isin(found["code"], numbers[counts == 1])
    if use.sum() < LEAST_CODES:
        return _nothing(name, frame, f"{int(use.sum())} coded targets were read, {LEAST_CODES} are needed")
    twice = ", ".join(str(n) for n in numbers[counts > 1])
    seen = _seen(name, frame, found, found["code"][:, None].astype(np.int64), use, (0, 0))
    return replace(seen, note=f"codes seen more than once are not used: {twice}" if twice else "")


def _charuco(name: str, frame: np.ndarray, wanted: Wanted) -> Seen:
    from pixmetry.locate.detect.tags import find_charuco
    from pixmetry.locate.template.corners import default_reach_px, measured_corners

    assert wanted.grid is not None
    grid = find_charuco(frame, wanted.grid, min(wanted.side), wanted.dictionary)
    if grid.message:
        return _nothing(name, frame, grid.message)
    # up to the markers, which are alike on both sides of a corner
    reach = default_reach_px(grid.x_px, grid.y_px, MARKER_GAP * (1 - min(wanted.side)), MARKER_CLEARANCE_PX)
    found, _ = measured_corners(frame, grid, reach, _noise_of(frame, wanted), threads=wanted.threads)
    return _numbered(name, frame, found, grid)


def _aprilgrid(name: str, frame: np.ndarray, wanted: Wanted) -> Seen:
    from pixmetry.locate.detect.squares import square_corners
    from pixmetry.locate.detect.tags import find_tag_grid
    from pixmetry.locate.template.corners import default_reach_px, measured_corners

    assert wanted.grid is not None
    grid, joined = find_tag_grid(frame, wanted.grid, wanted.side, wanted.dictionary)
    if grid.message:
        return _nothing(name, frame, grid.message)
    noise = _noise_of(frame, wanted)
    if joined:
        found, _ = measured_corners(frame, grid, default_reach_px(grid.x_px, grid.y_px), noise, threads=wanted.threads)
    else:
        corners = np.stack([grid.x_px, grid.y_px], axis=1).reshape(-1, 4, 2)
        dark, bright = np.quantile(frame, (0.05, 0.95))
        height, ground = float(dark - bright), float(bright)
        found = square_corners(frame, corners, noise, amplitude_dn=height, background_dn=ground, threads=wanted.threads)
    return _numbered(name, frame, found, grid)


def _numbered(name: str, frame: np.ndarray, found: Positions, grid: Grid) -> Seen:
    """Corners of markers that were identified, without those that the fit moved where their neighbours do not expect them."""
    use, keys = _usable(found), np.column_stack([grid.row, grid.col])
    if use.sum() >= LEAST_NUMBERED:
        from scipy.spatial import cKDTree

        place = np.column_stack([grid.x_px, grid.y_px])
        next_px = cKDTree(place).query(place, k=2)[0][:, 1]
        moved = np.hypot(found.x_px - grid.x_px, found.y_px - grid.y_px)
        use &= np.nan_to_num(moved, nan=np.inf) < np.clip(MOST_MOVED * next_px, *MOVED_PX)
    if use.sum() < LEAST_NUMBERED:
        return _nothing(name, frame, f"{int(use.sum())} numbered corners could be measured, {LEAST_NUMBERED} are needed")
    return _seen(name, frame, found, keys, use, (grid.rows, grid.cols))


def _noise_of(frame: np.ndarray, wanted: Wanted) -> NoiseModel:
    """The given noise, with the ends of the scale; else that of the background, which the residuals of the fits correct."""
    from pixmetry.locate.detect.background import background

    low, high = scale_ends(frame, None, wanted.noise)
    if wanted.noise is not None:
        return replace(wanted.noise, low_dn=max(low, wanted.noise.low_dn), high_dn=min(high, wanted.noise.high_dn))
    sigma = float(np.median(background(frame, low_dn=low, high_dn=high, threads=wanted.threads).sigma_dn))
    return NoiseModel(max(sigma**2, ROUNDING_DN2 if frame.dtype.kind == "u" else 1e-12), low_dn=low, high_dn=high, origin="image")


_FINDERS = {
    "chessboard": _chessboard,
    "dots": _dots,
    "asymmetric": _asymmetric,
    "squares": _squares,
    "coded": _coded,
    "charuco": _charuco,
    "aprilgrid": _aprilgrid,
}


def board_size(kind: str, grid: str | tuple[int, int] | None) -> tuple[int, int] | None:
    """Columns and rows of a board as the user gave them; None for "any" number of dots.

    Raises
    ------
    InputError
        If it is not the size of a board, or the kind has none.
    """
    if kind == "coded":
        if grid is not None:
            raise InputError("coded targets form no grid", where="grid", value=grid, allowed="nothing")
        return None
    if grid == "any" and kind == "dots":
        return None
    try:
        cols, rows = (int(v) for v in (grid.lower().split("x") if isinstance(grid, str) else grid or ()))
    except (TypeError, ValueError):
        cols = rows = 0
    if min(cols, rows) < 3:
        allowed = "COLSxROWS, such as 9x6, both at least 3" + ("; or any, for one image or a plate with marks" if kind == "dots" else "")
        raise InputError("not the size of a board", where="grid", value=grid, allowed=allowed)
    return cols, rows
