"""Boards to print for a calibration: what is drawn on them, and the nominal coordinates of their points."""

from __future__ import annotations

import io
from dataclasses import dataclass, field

import numpy as np

from pixmetry.core.errors import InputError
from pixmetry.locate.detect.coded import QUIET_OUTER, RING_INNER, RING_OUTER, RINGS_OF_12, codes, segments_of

KINDS = ("chessboard", "dots", "asymmetric", "squares", "charuco", "aprilgrid", "coded")
DICTIONARY = {"charuco": "5X5_1000", "aprilgrid": "APRILTAG_36h11", "coded": RINGS_OF_12}
MARGIN = 1.0  # white around the targets, in pitches
CAPTION_MM, CAPTION_PT = 8.0, 7.0
KALIBR_BORDER = 2  # bits of black about the code of a tag
MM_PER_INCH = 25.4


@dataclass(frozen=True)
class PrintedBoard:
    """A board as it is printed, lengths in mm from its first point, x to the right, y down.

    Parameters
    ----------
    title : str
    options : str
        Of ``pixmetry calibrate``, for pictures of it.
    points : dict of (float, float)
        Nominal coordinates of the points by the names that ``calibrate`` gives them.
    black : list of ndarray, shape (m, 4)
        Rectangles: x, y, width, height.
    discs : ndarray, shape (n, 3)
        x, y, radius.
    box : (float, float, float, float)
        x, y, width and height of the sheet.
    sectors : ndarray, shape (k, 6)
        Parts of rings: x, y, outer radius, width, and the angles in degrees from x towards y between which they lie.
    """

    title: str
    options: str
    points: dict[str, tuple[float, float]]
    black: np.ndarray = field(default_factory=lambda: np.zeros((0, 4)))
    discs: np.ndarray = field(default_factory=lambda: np.zeros((0, 3)))
    box: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)
    sectors: np.ndarray = field(default_factory=lambda: np.zeros((0, 6)))

    def coordinates_csv(self) -> str:
        """Nominal coordinates as a table that a project's ``points`` reads."""
        rows = [f"{name},{x:.9g},{y:.9g},0" for name, (x, y) in self.points.items()]
        return "\n".join(["# pixmetry board: nominal coordinates of the print; measure its pitch", "point,X_mm,Y_mm,Z_mm", *rows]) + "\n"

    def drawn(self, form: str) -> bytes:
        """The print in its true size.

        Parameters
        ----------
        form : {"pdf", "svg"}
        """
        from matplotlib import rc_context
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.collections import EllipseCollection, PatchCollection
        from matplotlib.figure import Figure
        from matplotlib.patches import Patch, Rectangle, Wedge

        x, y, width, height = self.box
        figure = Figure((width / MM_PER_INCH, (height + CAPTION_MM) / MM_PER_INCH))
        FigureCanvasAgg(figure)
        axes = figure.add_axes((0, 0, 1, 1))
        axes.set(xlim=(x, x + width), ylim=(y + height + CAPTION_MM, y))
        axes.set_axis_off()
        patches: list[Patch] = [Rectangle((left, top), wide, high) for left, top, wide, high in self.black]
        patches += [Wedge((u, v), radius, first, last, width=wide) for u, v, radius, wide, first, last in self.sectors]
        axes.add_collection(PatchCollection(patches, facecolor="black", edgecolor="none", linewidth=0, antialiased=False))
        if len(self.discs):
            size = 2 * self.discs[:, 2]
            axes.add_collection(
                EllipseCollection(
                    size, size, np.zeros(len(size)), units="xy", offsets=self.discs[:, :2], transOffset=axes.transData, facecolors="black",
                    edgecolors="none", linewidths=0,
                )
            )  # fmt: skip
        axes.text(x + 0.5 * width, y + height + 0.5 * CAPTION_MM, f"{self.title}    pixmetry calibrate … {self.options}",
                  fontsize=CAPTION_PT, ha="center", va="center")  # fmt: skip
        raw = io.BytesIO()
        metadata = (
            {"CreationDate": None, "Creator": "pixmetry", "Producer": None} if form == "pdf" else {"Date": None, "Creator": "pixmetry"}
        )
        with rc_context({"svg.hashsalt": "pixmetry", "svg.fonttype": "none", "pdf.compression": 9}):
            figure.savefig(raw, format=form, metadata=metadata)
        return raw.getvalue()


def board_of(
    kind: str,
    grid: tuple[int, int],
    pitch_mm: float,
    *,
    side_mm: float | None = None,
    diameter_mm: float | None = None,
    dictionary: str | None = None,
) -> PrintedBoard:
    """A board to print.

    Parameters
    ----------
    kind : {"chessboard", "dots", "asymmetric", "squares", "charuco", "aprilgrid", "coded"}
    grid : (int, int)
        Columns and rows, as ``calibrate`` takes them: of inner corners, dots (of an asymmetric plate: dots a row, and rows), separate
        squares; of squares of a chessboard with markers; of tags; of coded targets, which ``calibrate`` takes without.
    pitch_mm : float
        From one to the next; of an asymmetric plate in its row.
    side_mm : float, optional
        Of separate squares, markers or tags: by default half of the pitch, 3/4 and 10/13 of it.
    diameter_mm : float, optional
        Of dots, by default half of the pitch (asymmetric: 0.35 of it); of the discs of coded targets, by default 0.22 of it.
    dictionary : str, optional
        Of markers: 5X5_1000, of tags APRILTAG_36h11, of coded targets RING_12 by default.

    Raises
    ------
    InputError
        If there is no such board, or its parts do not fit.

    Examples
    --------
    >>> board = board_of("chessboard", (9, 6), 25.0)
    >>> board.points["5/8"], board.options
    ((200.0, 125.0), '--kind chessboard --grid 9x6 --pitch-mm 25')
    """
    cols, rows = grid
    if kind not in KINDS:
        raise InputError("no such kind of board", where="kind", value=kind, allowed=", ".join(KINDS))
    if not (min(grid) >= 3 and max(grid) <= 500):
        raise InputError("not the size of a board", where="grid", value=f"{cols}x{rows}", allowed="COLSxROWS, 3x3 to 500x500")
    if not 0 < pitch_mm < 1e4:
        raise InputError("not a spacing", where="pitch_mm", value=pitch_mm, allowed="above 0, in mm")
    shares, dots = {"squares": 0.5, "charuco": 0.75, "aprilgrid": 10 / 13}, {"dots": 0.5, "asymmetric": 0.35, "coded": 0.22}
    for name, value, has in (("side_mm", side_mm, kind in shares), ("diameter_mm", diameter_mm, kind in dots),
                             ("dictionary", dictionary, kind in DICTIONARY)):  # fmt: skip
        if value is not None and not has:
            raise InputError(f"has no meaning for a board of kind {kind}", where=name, value=value, remedy="leave it out")
    side = side_mm if side_mm is not None else round(shares.get(kind, 0.5) * pitch_mm, 4)
    diameter = diameter_mm if diameter_mm is not None else round(dots.get(kind, 0.5) * pitch_mm, 4)
    most = {"asymmetric": pitch_mm / 2**0.5, "coded": pitch_mm / QUIET_OUTER}.get(kind, pitch_mm)  # to the nearest neighbour; with its ring
    if not 0 < side < pitch_mm or not 0 < diameter < most:
        value = diameter if kind in dots else side
        raise InputError(
            "targets do not fit into their spacing", where="side_mm, diameter_mm", value=value, allowed="between 0 and the pitch"
        )
    words = dictionary or DICTIONARY.get(kind, "")
    sectors = np.zeros((0, 6))
    if kind == "coded":
        points, discs, sectors = _coded(cols, rows, pitch_mm, diameter, segments_of(words))
        black = NO_SQUARES
    else:
        points, black, discs = DRAWINGS[kind](cols, rows, pitch_mm, diameter if kind in dots else side, words)
    solid = np.concatenate([black, np.column_stack([discs[:, :2] - discs[:, 2:], 2 * discs[:, 2:], 2 * discs[:, 2:]])])
    low, high = solid[:, :2].min(axis=0) - MARGIN * pitch_mm, (solid[:, :2] + solid[:, 2:]).max(axis=0) + MARGIN * pitch_mm
    more = f" --diameter-mm {diameter:.9g}" if kind in dots else f" --side-mm {side:.9g}" if kind in shares else ""
    more += f" --dictionary {words}" if kind in DICTIONARY else ""
    size = "" if kind == "coded" else f" --grid {cols}x{rows} --pitch-mm {pitch_mm:.9g}"
    title = f"{kind}, {cols} × {rows}, pitch {pitch_mm:.9g} mm"
    box = (*low.tolist(), *(high - low).tolist())
    return PrintedBoard(title, f"--kind {kind}{size}{more}", points, black, discs, box, sectors)


Drawn = tuple[dict[str, tuple[float, float]], np.ndarray, np.ndarray]
NO_DISCS, NO_SQUARES = np.zeros((0, 3)), np.zeros((0, 4))


def _lattice(cols: int, rows: int, pitch: float) -> dict[str, tuple[float, float]]:
    return {f"{r}/{c}": (c * pitch, r * pitch) for r in range(rows) for c in range(cols)}


def _chess_squares(cols: int, rows: int, pitch: float) -> np.ndarray:
    """Dark squares of a board of so many inner corners, the first of them at (0, 0); that between the first four corners is dark."""
    places = [(c, r) for r in range(-1, rows) for c in range(-1, cols) if (r + c) % 2 == 0]
    return np.array([(c * pitch, r * pitch, pitch, pitch) for c, r in places])


def _chessboard(cols: int, rows: int, pitch: float, side: float, dictionary: str) -> Drawn:
    return _lattice(cols, rows, pitch), _chess_squares(cols, rows, pitch), NO_DISCS


def _dots(cols: int, rows: int, pitch: float, diameter: float, dictionary: str) -> Drawn:
    points = _lattice(cols, rows, pitch)
    return points, NO_SQUARES, np.array([(x, y, diameter / 2) for x, y in points.values()])


def _asymmetric(cols: int, rows: int, pitch: float, diameter: float, dictionary: str) -> Drawn:
    """As OpenCV has it: odd rows are half a step further, rows half a step apart."""
    points = {f"{r}/{c}": ((c + 0.5 * (r % 2)) * pitch, 0.5 * r * pitch) for r in range(rows) for c in range(cols)}
    return points, NO_SQUARES, np.array([(x, y, diameter / 2) for x, y in points.values()])


def _coded(cols: int, rows: int, pitch: float, diameter: float, bits: int) -> tuple[dict[str, tuple[float, float]], np.ndarray, np.ndarray]:
    """Discs in rings of segments, the numbers in use along the rows; what is set in a number is printed."""
    numbers, radius = codes(bits), diameter / 2
    if cols * rows > len(numbers):
        allowed = f"at most {len(numbers)} targets"
        raise InputError(f"there are not so many codes of {bits} segments", where="grid", value=f"{cols}x{rows}", allowed=allowed)
    points = {str(numbers[r * cols + c]): (c * pitch, r * pitch) for r in range(rows) for c in range(cols)}
    step, wide = 360 / bits, (RING_OUTER - RING_INNER) * radius
    sectors = [
        (x, y, RING_OUTER * radius, wide, bit * step, (bit + 1) * step)
        for number, (x, y) in points.items()
        for bit in range(bits)
        if int(number) >> bit & 1
    ]
    return points, np.array([(x, y, radius) for x, y in points.values()]), np.array(sectors)


def _tag_points(cols: int, rows: int, pitch: float, side: float) -> dict[str, tuple[float, float]]:
    around = ((0, 0), (1, 0), (1, 1), (0, 1))  # (x, y) of the corners, round as x turns to y
    return {
        f"{r}/{c}.{k}": (c * pitch + x * side, r * pitch + y * side)
        for r in range(rows)
        for c in range(cols)
        for k, (x, y) in enumerate(around)
    }


def _squares(cols: int, rows: int, pitch: float, side: float, dictionary: str) -> Drawn:
    black = np.array([(c * pitch, r * pitch, side, side) for r in range(rows) for c in range(cols)])
    return _tag_points(cols, rows, pitch, side), black, NO_DISCS


def _marker(dictionary: str, number: int, border: int, left: float, top: float, side: float) -> list[tuple[float, float, float, float]]:
    """Black runs of a marker's cells, row by row."""
    from pixmetry.locate.detect.tags import marker_cells

    cells = marker_cells(dictionary, number, border)
    step, runs = side / len(cells), []
    for r, row in enumerate(cells):
        ends = np.flatnonzero(np.diff(np.concatenate([[0], row.astype(int), [0]])))
        runs += [(left + a * step, top + r * step, (b - a) * step, step) for a, b in zip(ends[::2], ends[1::2], strict=True)]
    return runs


def _charuco(cols: int, rows: int, pitch: float, side: float, dictionary: str) -> Drawn:
    """As OpenCV prints it from version 4.6 on: the first square is dark, markers are numbered along the rows."""
    black = _chess_squares(cols - 1, rows - 1, pitch).tolist()
    bright = [(c, r) for r in range(-1, rows - 1) for c in range(-1, cols - 1) if (r + c) % 2 == 1]
    gap = 0.5 * (pitch - side)
    for number, (c, r) in enumerate(bright):
        black += _marker(dictionary, number, 1, c * pitch + gap, r * pitch + gap, side)
    return _lattice(cols - 1, rows - 1, pitch), np.array(black), NO_DISCS


def _aprilgrid(cols: int, rows: int, pitch: float, side: float, dictionary: str) -> Drawn:
    """As Kalibr prints it: numbers along the rows from the bottom left, two bits of border, small squares at the corners of all tags."""
    gap, black = pitch - side, []
    for r in range(rows):
        for c in range(cols):
            black += _marker(dictionary, (rows - 1 - r) * cols + c, KALIBR_BORDER, c * pitch, r * pitch, side)
    black += [(c * pitch - gap, r * pitch - gap, gap, gap) for r in range(rows + 1) for c in range(cols + 1)]
    return _tag_points(cols, rows, pitch, side), np.array(black), NO_DISCS


DRAWINGS = {"chessboard": _chessboard, "dots": _dots, "asymmetric": _asymmetric, "squares": _squares, "charuco": _charuco,
            "aprilgrid": _aprilgrid}  # fmt: skip
