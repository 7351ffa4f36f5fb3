"""Grids of targets: which row and column of a regular plate each located target has."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pixmetry.core.errors import InputError

NEIGHBOURS = 8
STEP_TOLERANCE = 0.3  # of the pitch: how far a dot may lie from where its neighbours expect it
FILL_TOLERANCE = 0.2  # the same for dots beyond a gap
OUTLIER = 0.15  # of the pitch: farther from the homography through its neighbours, a dot is not on the grid
AROUND = 12  # dots through which that homography is laid
LARGEST_GAP = 3  # steps
LEAST_WHOLE = 0.85  # of the dots of a plate of known size, from which it is numbered
MOST_BESIDE = 0.2  # dots of something else that continue the grid of a plate, over those of the plate
RIM_SHARE = 0.3  # of the dots of an outermost row or column, from which it is one
LARGEST_INDEX = 1024  # rows or columns on one side of the first dot
SEEDS = 6
STEPS = np.array([(0, 1), (1, 0), (0, -1), (-1, 0)])  # (row, col)


@dataclass(frozen=True)
class Grid:
    """Places with a row and a column each, arrays of shape (n,).

    Parameters
    ----------
    x_px, y_px : ndarray
        Places in pixels from the centre of the top-left pixel.
    row, col : ndarray of int
        From 0; −1 for a place that belongs to no grid position.
    rows, cols : int
        Extent of the grid.
    message : str
        Why nothing was found, or what is not as it was asked for; empty otherwise.
    """

    x_px: np.ndarray
    y_px: np.ndarray
    row: np.ndarray
    col: np.ndarray
    rows: int
    cols: int
    message: str = ""

    def __len__(self) -> int:
        return len(self.x_px)

    @property
    def placed(self) -> np.ndarray:
        """Which places have a row and a column, boolean, shape (n,)."""
        return self.row >= 0


def no_grid(message: str, rows: int = 0, cols: int = 0) -> Grid:
    """An empty grid that says why."""
    none = np.empty(0)
    return Grid(none, none, none.astype(int), none.astype(int), rows, cols, message)


def order_grid(
    x_px: np.ndarray, y_px: np.ndarray, *, pattern: tuple[int, int] | None = None, asymmetric: bool = False, hexagonal: bool = False
) -> Grid:
    """Give each of many located dots its row and column on a regular plate, seen in perspective and through a distorting lens.

    Parameters
    ----------
    x_px, y_px : ndarray, shape (n,)
        Places, in any order; dots may be missing and others may lie between.
    pattern : (int, int), optional
        Columns and rows of the whole plate, where they are known and all of it is seen: then the numbering is the one that fits, and the
        message says why if none does. Dots of something else beside the plate, which happen to continue its grid, are left out.
    asymmetric : bool
        Every other row is shifted by half a step; row and column are counted as OpenCV does, ``x = 2 col + row % 2``.
    hexagonal : bool
        The same, and each dot has six neighbours at one distance: those at its sides are in its row.

    Returns
    -------
    Grid
        All places in their order, with row and column −1 where they are off the grid. Columns run towards x and rows towards y, as nearly
        as a grid allows that is turned; a plate has no mark that would tell more.

    Raises
    ------
    InputError
        If x and y are not of the same length.

    Notes
    -----
    The numbering grows from a dot that has neighbours on opposite sides: each dot's next neighbours are expected one local step on, the
    step being taken from the dots already placed, and the nearest dot within 0.3 steps of there is taken. Local steps bend with
    perspective and distortion, so nothing is assumed about either. Dots beyond a gap are placed by the homography through their
    12 nearest placed dots. Last, a dot that is more than 0.15 steps off the one through its own neighbours is an outlier.

    A plate of known size must be there: 0.85 of its dots, and 0.3 of each row and column at its rim. So must its end:
    a next row or column with 0.3 of its dots belongs to a larger plate, and no part of that is numbered.
    """
    x, y = np.asarray(x_px, float).ravel(), np.asarray(y_px, float).ravel()
    if x.shape != y.shape:
        raise InputError("x and y are not of one length", where="order_grid", value=(len(x), len(y)))
    nothing = Grid(x, y, np.full(len(x), -1), np.full(len(x), -1), 0, 0, "fewer than four dots in a regular arrangement")
    usable = np.flatnonzero(np.isfinite(x) & np.isfinite(y))
    if len(usable) < 4:
        return nothing
    place = np.stack([x[usable], y[usable]], axis=1)
    index = _grow_best(place)
    if (index[:, 0] > -LARGEST_INDEX).sum() < 4:
        return nothing
    index, extent, message = _numbered(place, index, pattern, asymmetric or hexagonal, hexagonal)
    row, col = nothing.row.copy(), nothing.col.copy()
    row[usable], col[usable] = index.T
    return Grid(x, y, row, col, *extent, message)


def images_through(cells: np.ndarray, places: np.ndarray, asked: np.ndarray) -> np.ndarray:
    """Images of the asked cells by the homography through some others."""
    middle, size = places.mean(axis=0), places.std()
    u, v = ((places - middle) / size).T
    r, c = cells.T
    one, none = np.ones(len(r)), np.zeros(len(r))
    design = np.concatenate(
        [np.stack([r, c, one, none, none, none, -u * r, -u * c], 1), np.stack([none, none, none, r, c, one, -v * r, -v * c], 1)]
    )
    h = np.append(np.linalg.lstsq(design, np.concatenate([u, v]), rcond=None)[0], 1.0).reshape(3, 3)
    image = np.column_stack([asked, np.ones(len(asked))]) @ h.T
    place: np.ndarray = image[:, :2] / image[:, 2:] * size + middle
    return place


def eight_bit(frame: np.ndarray) -> np.ndarray:
    """Return a frame as uint8 for finders that need it: between its 0.1 and 99.9 % quantiles. A frame of uint8 is returned unchanged."""
    if frame.dtype == np.uint8:
        return frame
    low, high = np.quantile(frame, (0.001, 0.999))
    if not high > low:  # two grey values, one of them rare
        low, high = frame.min(), frame.max()
    scale = 255.0 / max(float(high) - float(low), float(np.finfo(np.float32).tiny))
    return np.clip((frame.astype(np.float64) - float(low)) * scale, 0, 255).astype(np.uint8)


def _grow_best(place: np.ndarray) -> np.ndarray:
    from scipy.spatial import cKDTree

    tree = cKDTree(place)
    best = np.full(place.shape, -LARGEST_INDEX)
    for seed, basis in _seeds(place, tree):
        index = _filled(place, _grown(place, tree, seed, basis))
        if (index[:, 0] > -LARGEST_INDEX).sum() > (best[:, 0] > -LARGEST_INDEX).sum():
            best = index
        if (best[:, 0] > -LARGEST_INDEX).mean() > 0.85:
            break
    return _without_outliers(place, best)


def _seeds(place: np.ndarray, tree: object) -> list[tuple[int, np.ndarray]]:
    """Dots with their two local steps, shape (2, 2): those between opposite neighbours first, from the middle outwards."""
    k = min(NEIGHBOURS, len(place) - 1)
    around = tree.query(place, k=k + 1)[1][:, 1:]  # type: ignore[attr-defined]
    middle = np.median(place, axis=0)
    good: list[tuple[int, np.ndarray]] = []
    fair: list[tuple[int, np.ndarray]] = []
    for dot in np.argsort(((place - middle) ** 2).sum(axis=1))[: max(400, len(place) // 10)]:
        steps = place[around[dot]] - place[dot]
        length = np.hypot(*steps.T)
        opposite = np.hypot(*(steps[:, None] + steps[None]).transpose(2, 0, 1)).min(axis=1) < 0.2 * length
        for chosen, out in ((steps[opposite], good), (steps, fair)):
            basis = _two_steps(chosen)
            if basis is not None:
                out.append((int(dot), basis))
        if len(good) >= SEEDS:
            break
    return (good + fair)[:SEEDS]


def _two_steps(steps: np.ndarray) -> np.ndarray | None:
    """The shortest step (they come in order of length) and the shortest that is not along it; None without one."""
    for second in steps[1:]:
        across = abs(steps[0, 0] * second[1] - steps[0, 1] * second[0])
        if across > 0.35 * np.hypot(*steps[0]) * np.hypot(*second):
            return np.stack([steps[0], second])
    return None


def _grown(place: np.ndarray, tree: object, seed: int, basis: np.ndarray) -> np.ndarray:
    """Row and column of each dot reached from the seed, shape (n, 2); −LARGEST_INDEX where none."""
    n, half = len(place), min(LARGEST_INDEX, len(place)) + 2
    lattice = np.full((2 * half + 1, 2 * half + 1), -1, np.int64)
    index = np.full((n, 2), -LARGEST_INDEX)
    local = np.zeros((n, 2, 2))  # step along a row's increase and along a column's, per dot
    parent = np.arange(n)
    index[seed], local[seed] = 0, basis
    lattice[half, half] = seed
    front = previous = np.array([seed])
    for _ in range(half - 2):
        for dots in (previous, front):
            _refresh(place, lattice, half, index, local, parent, dots)
        dots = np.repeat(front, 4)
        step = np.tile(STEPS, (len(front), 1))
        target = index[dots] + step
        free = lattice[target[:, 0] + half, target[:, 1] + half] < 0
        dots, step, target = dots[free], step[free], target[free]
        if not len(dots):
            break
        expected = place[dots] + (local[dots] * step[:, :, None]).sum(axis=1)
        distance, nearest = tree.query(expected)  # type: ignore[attr-defined]
        pitch = np.minimum(*np.hypot(local[dots, :, 0], local[dots, :, 1]).T)
        near = (distance < STEP_TOLERANCE * pitch) & (index[nearest, 0] == -LARGEST_INDEX)
        order = np.flatnonzero(near)[np.argsort(distance[near] / pitch[near])]
        order = order[np.sort(np.unique(nearest[order], return_index=True)[1])]
        order = order[np.sort(np.unique(target[order], axis=0, return_index=True)[1])]
        new = nearest[order]
        index[new], local[new], parent[new] = target[order], local[dots[order]], dots[order]
        lattice[target[order, 0] + half, target[order, 1] + half] = new
        previous, front = front, new
        if not len(new):
            break
    return index


def _refresh(
    place: np.ndarray, lattice: np.ndarray, half: int, index: np.ndarray, local: np.ndarray, parent: np.ndarray, dots: np.ndarray
) -> None:
    """Take the local steps of some dots from their placed neighbours, and from their parents where there are none."""
    for axis in (0, 1):
        step = np.eye(2, dtype=int)[axis]
        at = [_at(place, lattice, index[dots] + half + reach * step) for reach in (-2, -1, 0, 1, 2)]
        steps = [after - before for before, after in zip(at, at[1:], strict=False)]
        # perspective: the step changes from dot to dot, and goes on changing
        behind = np.where(np.isnan(steps[0]), steps[1], 2 * steps[1] - steps[0])
        ahead = np.where(np.isnan(steps[3]), steps[2], 2 * steps[2] - steps[3])
        own = np.where(np.isnan(ahead), behind, np.where(np.isnan(behind), ahead, 0.5 * (steps[1] + steps[2])))
        local[dots, axis] = np.where(np.isnan(own), local[parent[dots], axis], own)


def _at(place: np.ndarray, lattice: np.ndarray, cells: np.ndarray) -> np.ndarray:
    """Places of the dots in some cells of the lattice, NaN where there is none."""
    dots = lattice[tuple(cells.T)]
    return np.where((dots >= 0)[:, None], place[dots], np.nan)


def _expected_index(place: np.ndarray, index: np.ndarray, known: np.ndarray, asked: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Row and column that a homography through the nearest known dots (but itself) gives each asked dot; cell of the nearest."""
    from scipy.spatial import cKDTree

    k = min(AROUND + 1, len(known))
    distance, near = cKDTree(place[known]).query(place[asked], k=k)
    itself = known[near] == asked[:, None]
    weight = np.where(itself, 0.0, 1.0)
    weight[:, -1] *= itself.any(axis=1)  # the same number of neighbours for all
    cell = index[known[near]].astype(float)
    base = cell[np.arange(len(asked)), itself[:, 0].astype(int)]
    u, v = ((place[known[near]] - place[asked][:, None]) / distance[:, -1, None, None]).transpose(2, 0, 1)
    (r, c), one, none = (cell - base[:, None]).transpose(2, 0, 1), np.ones_like(u), np.zeros_like(u)
    # r (1 + g u + h v) = a u + b v + c, and the same for the column: eight unknowns, of which g and h are held near zero
    design = np.concatenate(
        [np.stack([u, v, one, none, none, none, -r * u, -r * v], 2), np.stack([none, none, none, u, v, one, -c * u, -c * v], 2)], axis=1
    )
    both, right = np.tile(weight, 2), np.concatenate([r, c], axis=1)
    normal = np.einsum("nki,nk,nkj->nij", design, both, design) + np.diag([1e-9] * 6 + [1e-3] * 2)
    solution = np.linalg.solve(normal, np.einsum("nki,nk,nk->ni", design, both, right)[..., None])[..., 0]
    return solution[:, [2, 5]] + base, base


def _filled(place: np.ndarray, index: np.ndarray) -> np.ndarray:
    """Place dots beyond gaps."""
    for _ in range(50):
        known, asked = np.flatnonzero(index[:, 0] > -LARGEST_INDEX), np.flatnonzero(index[:, 0] == -LARGEST_INDEX)
        if len(known) < 6 or not len(asked):
            break
        guess, nearest = _expected_index(place, index, known, asked)
        whole = np.rint(guess).astype(int)
        taken = set(map(tuple, index[known]))
        off = np.abs(guess - whole).max(axis=1)
        changed = False
        far = np.abs(whole - nearest).max(axis=1)
        candidates = np.flatnonzero((off < FILL_TOLERANCE) & (far <= LARGEST_GAP) & (np.abs(whole).max(axis=1) < LARGEST_INDEX))
        for dot, cell in ((asked[i], tuple(whole[i])) for i in candidates[np.argsort(off[candidates])]):
            if cell not in taken:
                index[dot] = cell
                taken.add(cell)
                changed = True
        if not changed:
            break
    return index


def _without_outliers(place: np.ndarray, index: np.ndarray) -> np.ndarray:
    for _ in range(20):
        known = np.flatnonzero(index[:, 0] > -LARGEST_INDEX)
        if len(known) < 9:
            break
        guess, _ = _expected_index(place, index, known, known)
        off = np.hypot(*(guess - index[known]).T)
        if off.max() < OUTLIER:
            break
        # an outlier pulls at its neighbours: only the worst of each neighbourhood goes
        from scipy.spatial import cKDTree

        near = cKDTree(place[known]).query(place[known], k=min(NEIGHBOURS + 1, len(known)))[1]
        index[known[(off > OUTLIER) & (off >= off[near].max(axis=1))]] = -LARGEST_INDEX
    return index


def _numbered(
    place: np.ndarray, index: np.ndarray, pattern: tuple[int, int] | None, asymmetric: bool, hexagonal: bool
) -> tuple[np.ndarray, tuple[int, int], str]:
    """Choose the axes and the origin of a numbering: (row, col) from 0, its extent (rows, cols), and a message if it differs."""
    known = index[:, 0] > -LARGEST_INDEX
    cells, dots = index[known], place[known]
    entries = (-2, -1, 0, 1, 2)
    plain = [np.array([[a, b], [c, d]]) for a in entries for b in entries for c in entries for d in entries if abs(a * d - b * c) == 1]
    if asymmetric:
        plain = [np.array([[1, 1], [-1, 1]]) @ change for change in plain]
    design = np.column_stack([cells, np.ones(len(cells))])
    per_cell = np.linalg.lstsq(design, dots, rcond=None)[0][:2]  # image step per old row and old column
    best, rank = plain[0], None
    for change in plain:
        new = _from_zero(cells @ change.T, asymmetric)
        extent = _extent(new, asymmetric)
        corner = None if pattern is None or asymmetric else _corner(new, pattern)
        image = np.linalg.solve(change.astype(float), np.eye(2)).T @ per_cell  # image step per new row and per new column
        if image[1, 0] * image[0, 1] - image[1, 1] * image[0, 0] <= 0:
            continue
        if hexagonal and np.hypot(*image[1]) > np.hypot(*image[0]):  # half the step in a row is 1/√3 of that from row to row
            continue
        fits = corner is not None or (asymmetric and pattern is not None and extent == (pattern[1], pattern[0]))
        area = np.log((np.ptp(new, axis=0) + 1).prod())
        slant = np.log(np.hypot(*image[0]) * np.hypot(*image[1]) / abs(np.linalg.det(image)))
        # every row of an asymmetric plate has the same number of dots, which tells its top from its bottom if it has an odd number of rows
        regular = asymmetric and np.ptp(new[:, 1]) % 2 == 1 and new[:, 1].min() == 0
        upright = image[1, 0] / np.hypot(*image[1]) + image[0, 1] / np.hypot(*image[0])
        mark = (fits, 0.4 * regular - area - 0.3 * slant + 0.08 * upright)
        if rank is None or mark > rank:
            best, rank = change, mark
    cells = _from_zero(cells @ best.T, asymmetric)
    corner = None if pattern is None or asymmetric else _corner(cells, pattern)
    if pattern is not None and corner is not None:
        cells = cells - corner
        beside = (cells < 0).any(axis=1) | (cells >= (pattern[1], pattern[0])).any(axis=1)
        cells[beside], rows, cols = -1, pattern[1], pattern[0]
    else:
        rows, cols = _extent(cells, asymmetric)
    if asymmetric:
        cells[:, 1] //= 2
    full = np.full(index.shape, -1)
    full[known] = cells
    if pattern is not None and corner is None and not asymmetric and (cols, rows) == tuple(pattern):
        return (
            full,
            (rows, cols),
            f"a grid of {cols} × {rows}, but too much of it is missing, or an outermost row or column is hardly there",
        )
    wrong = pattern is not None and (cols, rows) != tuple(pattern)
    return full, (rows, cols), f"a grid of {cols} × {rows}, not {pattern[0]} × {pattern[1]}" if wrong and pattern else ""


def _corner(cells: np.ndarray, pattern: tuple[int, int]) -> np.ndarray | None:
    """Least row and column of a plate of a known size among the cells of its dots and of others; None where its rims are not sure."""
    shape = np.array([pattern[1], pattern[0]])
    extent = cells.max(axis=0) + 1
    if (extent < shape).any():
        return None
    taken = np.zeros(extent + 2, int)  # one empty row and column around
    np.add.at(taken, tuple(cells.T + 1), 1)
    sums = np.pad(taken, ((1, 0), (1, 0))).cumsum(axis=0).cumsum(axis=1)
    rows, cols = shape
    inside = sums[rows:, cols:] - sums[:-rows, cols:] - sums[rows:, :-cols] + sums[:-rows, :-cols]
    top, left = (1 + k for k in np.unravel_index(np.argmax(inside[1:-1, 1:-1]), inside[1:-1, 1:-1].shape))
    here, across = slice(left, left + cols), slice(top, top + rows)
    rims = [taken[top, here].sum(), taken[top + rows - 1, here].sum(), taken[across, left].sum(), taken[across, left + cols - 1].sum()]
    beyond = [taken[top - 1, here].sum(), taken[top + rows, here].sum(), taken[across, left - 1].sum(), taken[across, left + cols].sum()]
    whole = np.array([cols, cols, rows, rows])
    within = inside[top, left]
    alone = len(cells) - within <= MOST_BESIDE * within  # the dots of a plate that is counted along a diagonal leave a window of its size
    whole_plate = within >= LEAST_WHOLE * rows * cols  # part of it, counted along a diagonal, may have its size too
    sure = alone and whole_plate and (np.array(rims) >= RIM_SHARE * whole).all() and (np.array(beyond) < RIM_SHARE * whole).all()
    return np.array([top, left]) - 1 if sure else None


def _from_zero(cells: np.ndarray, asymmetric: bool) -> np.ndarray:
    """Count from 0; on an asymmetric plate the columns are half steps, even in even rows and odd in odd ones."""
    cells = cells - cells.min(axis=0)
    if asymmetric:
        cells[:, 1] += cells[0].sum() % 2
    return cells


def _extent(cells: np.ndarray, asymmetric: bool) -> tuple[int, int]:
    rows, cols = cells.max(axis=0) + 1
    return int(rows), int(-(-cols // 2)) if asymmetric else int(cols)
