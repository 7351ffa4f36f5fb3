"""A laser spot on a surface that moves between frames: scatter of its centre, contrast and size of the grains, and how alike frames are.

Every frame shows the mean spot times a grain pattern. About the mean spot the patterns have the covariance C² γ(Δ; λN) that a round pupil
gives, averaged over the pixels; noise of the pixels is in the variance alone. How alike the patterns of two frames are says what the
scatter of the centre is short of.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from pixmetry.camera.observations import Observations
from pixmetry.camera.speckle import SpeckleFrames, SpeckleSpot, pixel_covariance_at
from pixmetry.core.arrays import Array
from pixmetry.core.errors import MeasureError
from pixmetry.core.number import ONE_SIDED_95, Estimates
from pixmetry.observe.experiment import PictureGroup

LEAST_FRAMES, WANTED_FRAMES = 8, 50
LARGEST_BYTES = 2**28  # of the parts of frames that are kept of a group
COARSE_PX = 160  # side to which frames are averaged to find the spot
FOUND = 6.0  # of the coarse light over its noise
WINDOW, RING = 1.75, 2.6  # radii of the window and of the ground about it, over the spot's
LIT = 0.1  # of the mean spot's peak, from which on its grains are compared
MOST_DEGREE = 4  # of the path of a spot
PATH_CHANCE = 1e-4  # with which a spot that stays is given a path
ALIKE = 0.2  # correlation of successive patterns above which the surface moved too little
LEAST_CONTRAST = 0.05  # of a pattern that is the same in all frames
SAME = 0.9  # share of a pattern that stays in all frames, above which nothing is told
CLIPPED, MUCH_CLIPPED = 0.001, 0.02  # share of light in saturated pixels
DETERMINED = 0.15  # relative u above which contrast and size of the grains are not told apart
FINEST_PX = 0.6  # λN below which neighbouring pixels hardly share a grain
SIGNIFICANT = 3.3
APERTURE_U = 0.05  # relative, of the contrast of grains smaller than a pixel, by its light-sensitive part
MODEL_U = (0.015, 0.025)  # relative, of contrast and size of the grains: a spot of a few grains, a response that bends, uneven pixels
METHOD = "scatter of the centre over frames with different speckle; covariance of the light of neighbouring pixels"
SMALL_GRAINS = "the grains are smaller than the pixels: close the lens, or state f_number, wavelength_nm and pitch_um"
POINTING = "a beam that points to another place in every frame moves the centre as speckle does; it does not depend on the f-number"
GRAINS = "the pupil is taken as round and evenly lit; a vignetted one, or a blur of the camera, makes grains look larger"


@dataclass
class SpotCrops:
    """The part of each frame that shows the brightest spot, with the place of its first pixel."""

    kept: dict[int, tuple[np.ndarray, int, int, float, float, float]] = field(default_factory=dict)  # part, row, col, x, y, radius
    empty: int = 0
    left_out: int = 0
    shape: tuple[int, int] = (0, 0)
    _bytes: int = 0
    _end: float = float("inf")  # index from which on frames are left out

    def add(self, frame: np.ndarray, index: int) -> None:
        """Add the frame of this index."""
        self.shape = (frame.shape[0], frame.shape[1])
        found = find_spot(frame)
        if found is None:
            self.empty += 1
            return
        x, y, radius = found
        half = RING * 1.6 * radius + 8
        (top, bottom), (left, right) = (
            (max(int(c - half), 0), min(int(c + half) + 2, size)) for c, size in ((y, frame.shape[0]), (x, frame.shape[1]))
        )
        part = np.array(frame[top:bottom, left:right])
        if index >= self._end:
            self.left_out += 1
            return
        self._bytes += part.nbytes
        self.kept[index] = (part, top, left, x, y, radius)
        while self._bytes > LARGEST_BYTES:  # the last ones go, so that the order in which threads end does not show
            self._end = max(self.kept)
            self._bytes -= self.kept.pop(int(self._end))[0].nbytes
            self.left_out += 1


def find_spot(frame: np.ndarray) -> tuple[float, float, float] | None:
    """Place and radius (twice the standard deviation along an axis) of the brightest spot of a frame; None where there is none."""
    from scipy import ndimage

    step = max(1, int(np.ceil(max(frame.shape) / COARSE_PX)))
    rows, cols = (n // step for n in frame.shape)
    if min(rows, cols) < 8:
        return None
    blocks = frame[: rows * step, : cols * step].reshape(rows, step, cols, step)
    coarse = blocks.mean(axis=(1, 3), dtype=float)
    light = ndimage.uniform_filter(coarse, 3) if step == 1 else coarse
    light = light - _ground(light)
    noise = max(1.4826 * float(np.median(np.abs(light - np.median(light)))), 1e-3)
    peak = float(light.max())
    if peak < FOUND * noise:
        return None
    lit = ndimage.binary_dilation(light > max(0.5 * FOUND * noise, 0.1 * peak), iterations=2)
    labels, count = ndimage.label(lit, np.ones((3, 3)))
    sums = ndimage.sum_labels(np.where(light > 0, light, 0), labels, np.arange(1, count + 1))
    inside = np.where(labels == 1 + int(np.argmax(sums)), np.maximum(light, 0), 0)
    at = ndimage.center_of_mass(inside)
    y, x = (at[0] + 0.5) * step - 0.5, (at[1] + 0.5) * step - 0.5
    spread = _spread(inside, at[1], at[0])
    radius = max(2 * spread * step, 1.5)
    for _ in range(8):  # at full resolution, in a window that follows the spot
        found = _moments(frame, x, y, max(WINDOW * radius, 3.0))
        if found is None:
            return None
        moved = np.hypot(found[0] - x, found[1] - y)
        x, y, new = found
        done, radius = moved < 0.05 and abs(new - radius) < 0.02 * radius, max(new, 1.0)
        if done:
            break
    return x, y, radius


def _ground(coarse: np.ndarray) -> np.ndarray:
    """A smooth ground under the light, of second degree, that the spot does not lift."""
    rows, cols = coarse.shape
    v, u = np.mgrid[-1 : 1 : rows * 1j, -1 : 1 : cols * 1j]
    basis = np.stack([np.ones_like(u), u, v, u * u, u * v, v * v], axis=-1).reshape(-1, 6)
    values, used = coarse.ravel(), np.ones(coarse.size, bool)
    fitted = np.full(coarse.size, float(np.median(values)))
    for _ in range(6):
        left = values - fitted
        centre = float(np.median(left))
        noise = max(1.4826 * float(np.median(np.abs(left - centre))), 1e-6)
        used = np.abs(left - centre) < 3 * noise
        if used.sum() < 30:
            break
        fitted = basis @ np.linalg.lstsq(basis[used], values[used], rcond=None)[0]
    ground: np.ndarray = fitted.reshape(coarse.shape)
    return ground


def _spread(light: np.ndarray, x: float, y: float) -> float:
    rows, cols = (np.arange(n, dtype=float) for n in light.shape)
    total = float(light.sum())
    xx = float((light.sum(axis=0) * (cols - x) ** 2).sum()) / total
    yy = float((light.sum(axis=1) * (rows - y) ** 2).sum()) / total
    return float(np.sqrt(max(0.5 * (xx + yy), 1e-6)))


def _moments(frame: np.ndarray, x: float, y: float, reach: float) -> tuple[float, float, float] | None:
    """Centre and radius of the light in a round window above the ground about it."""
    outer = RING / WINDOW * reach + 2
    top, left = max(int(y - outer), 0), max(int(x - outer), 0)
    part = frame[top : int(y + outer) + 2, left : int(x + outer) + 2].astype(float)
    if min(part.shape) < 4:
        return None
    rows, cols = (np.arange(n) + o for n, o in zip(part.shape, (top, left), strict=True))
    r = np.hypot(cols - x, rows[:, None] - y)
    ring, inside = r > reach, r <= reach
    if ring.sum() < 8 or not inside.any():
        return None
    light = np.where(inside, part - _plane(part, ring, cols - x, rows - y), 0.0)
    total = float(light.sum())
    if total <= 0:
        return None
    cx, cy = float((light * cols).sum()) / total, float((light * rows[:, None]).sum()) / total
    squares = float((light * ((cols - cx) ** 2 + (rows[:, None] - cy) ** 2)).sum()) / total
    if not (np.hypot(cx - x, cy - y) < reach and squares > 0):
        return None
    return cx, cy, 2 * float(np.sqrt(0.5 * squares))


def reduce_speckle(groups: Sequence[PictureGroup], seen: Observations) -> Observations:
    """Measure the spot of every group; what cannot be measured becomes a reason."""
    spots, refused = [], []
    for number, group in enumerate(groups, start=1):
        try:
            spots.append(spot_of(group, seen))
        except MeasureError as problem:
            refused.append(f"group {number} of {len(groups)}: {problem.what}" + (f" ({problem.remedy})" if problem.remedy else ""))
    best = max(spots, key=lambda s: (len(s.fit), s.effective_frames), default=None)
    fit = replace(Estimates.empty(), reasons={"contrast_rel": refused[0]}) if best is None else best.fit
    notes = [f"Laser spot: {why}" for why in refused]
    notes += [f"Laser spot{f' {k} of {len(spots)}' * (len(spots) > 1)}: {n}" for k, s in enumerate(spots, start=1) for n in s.notes]
    found = SpeckleFrames(tuple(spots), tuple(refused), fit, None if best is None else best.wavelength_nm)
    return replace(seen, speckle=found, notes=(*seen.notes, *notes))


def _plane(part: np.ndarray, ring: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """A plane through the ring about a spot, without what stands out of it."""
    basis = np.stack(np.broadcast_arrays(1.0, x, y[:, None]), axis=-1)
    around, values = basis[ring], part[ring]
    good = np.abs(values - np.median(values)) <= 4 * max(1.4826 * float(np.median(np.abs(values - np.median(values)))), 0.5)
    plane: np.ndarray = basis @ np.linalg.lstsq(around[good], values[good], rcond=None)[0]
    return plane


@dataclass(frozen=True)
class _Windows:
    """The spot in all frames, in windows that follow its path; light above the ground, shape (frames, side, side)."""

    light: Array
    x0: Array  # column of the windows' first pixel, shape (frames,)
    y0: Array
    radius: float
    inside: np.ndarray  # shape (side, side): the window for the centre
    full: np.ndarray  # pixels that reach the end of the scale in some frame
    ground_var: float  # temporal variance of the ground, DN²
    index: np.ndarray
    left_out: int


def _windows_of(group: PictureGroup) -> _Windows:
    sums = group.sums
    assert isinstance(sums, SpotCrops)
    if len(sums.kept) < LEAST_FRAMES:
        found = f"{len(sums.kept)} frames show a spot" + (f", {sums.empty} show none" if sums.empty else "")
        remedy = f"take {WANTED_FRAMES} frames, and move the surface between them"
        raise MeasureError(f"{found}; {LEAST_FRAMES} are the least", remedy=remedy)
    radii = np.array([k[5] for k in sums.kept.values()])
    radius = float(np.median(radii))
    index = np.array(sorted(i for i, k in sums.kept.items() if abs(np.log(k[5] / radius)) < np.log(1.6)))
    left_out = sums.empty + sums.left_out + len(sums.kept) - len(index)
    if len(index) < LEAST_FRAMES:
        raise MeasureError("the spot has another size in every frame", remedy="hold focus, distance and light")
    kept = [sums.kept[int(i)] for i in index]
    rough = np.array([[k[3], k[4]] for k in kept])
    middle = np.median(rough, axis=0)
    if np.ptp(rough, axis=0).max() > 0.5 * radius:  # it drifts: windows follow its path, not its jumps
        basis = _basis(index, MOST_DEGREE)
        path = basis @ np.linalg.lstsq(basis, rough, rcond=None)[0]
    else:
        path = np.broadcast_to(middle, rough.shape)
    half = int(np.ceil(RING * radius)) + 1
    side = 2 * half + 1
    first = np.round(path).astype(int) - half
    light: Array = np.full((len(kept), side, side), np.nan, np.float32)
    full = np.zeros((side, side), bool)
    top_code = 2**group.bits - 1
    for k, (part, top, left, *_) in enumerate(kept):
        x0, y0 = first[k]
        a, b = max(top, y0), min(top + part.shape[0], y0 + side)
        c, d = max(left, x0), min(left + part.shape[1], x0 + side)
        if b <= a or d <= c:
            continue
        cut = part[a - top : b - top, c - left : d - left]
        light[k, a - y0 : b - y0, c - x0 : d - x0] = cut
        full[a - y0 : b - y0, c - x0 : d - x0] |= cut >= min(top_code, _flat_top(part))
    r = np.hypot(*(np.mgrid[:side, :side] - half))
    inside, ring = r <= WINDOW * radius, (r > WINDOW * radius) & (r <= RING * radius + 1)
    seen = np.isfinite(light)
    whole = np.asarray(seen[:, inside].all(axis=1))
    if whole.sum() < LEAST_FRAMES:
        raise MeasureError("the spot is cut off by the border of the frame", remedy="move it inwards")
    light, first, index = light[whole], first[whole], index[whole]
    left_out += int((~whole).sum())
    ground, variance = _ground_of(light, ring)
    return _Windows(
        light=light - ground, x0=first[:, 0].astype(float), y0=first[:, 1].astype(float), radius=radius, inside=inside, full=full & inside,
        ground_var=variance, index=index, left_out=left_out,
    )  # fmt: skip


def _flat_top(part: np.ndarray) -> float:
    """The level at which a spot is cut off below the highest code, as in colour pictures that were made grey; infinite where it is not."""
    high = float(part.max())
    low = float(np.median(part))
    upper = part > 0.5 * (high + low)
    near = part >= high - 0.01 * (high - low)
    return high - 0.01 * (high - low) if near.sum() > 12 and near.sum() > 0.15 * upper.sum() else float("inf")


def _ground_of(light: Array, ring: np.ndarray) -> tuple[Array, float]:
    """A plane under each window that is common to all but for its level, and the temporal variance of a pixel of the ring."""
    side = ring.shape[0]
    used = ring & np.isfinite(light).all(axis=0)
    mean = light.mean(axis=0)
    rows, cols = np.nonzero(used)
    basis = np.column_stack([np.ones(len(rows)), cols / side, rows / side])
    values = mean[used]
    plane = np.array([float(np.median(values)), 0.0, 0.0])
    for _ in range(5):
        left = values - basis @ plane
        good = np.abs(left) <= 3 * max(1.4826 * float(np.median(np.abs(left))), 1e-6)
        plane = np.linalg.lstsq(basis[good], values[good], rcond=None)[0]
    whole = plane[0] + plane[1] * np.arange(side) / side + plane[2] * np.arange(side)[:, None] / side
    level = np.nanmedian(np.where(ring, light - whole, np.nan), axis=(1, 2))
    steps = np.diff(light[:, used], axis=0)
    variance = 0.5 * (1.4826 * float(np.nanmedian(np.abs(steps - np.nanmedian(steps, axis=1, keepdims=True))))) ** 2
    return (whole + level[:, None, None]).astype(np.float32), max(variance, 1 / 12)


def _basis(index: np.ndarray, degree: int) -> Array:
    scaled = (index - index.mean()) / max(float(np.ptp(index)), 1.0)
    return np.polynomial.legendre.legvander(2 * scaled, degree)


@dataclass(frozen=True)
class _Grains:
    """Relative covariance of the light of pixels, and how alike the patterns of frames are."""

    lags: np.ndarray
    covariance: Array
    model: Array
    of_model: Array  # covariance of the covariances
    fit: Estimates
    noise_rel: float
    shot: float  # variance of the noise over the light, DN
    toeplitz: Array  # shape (frames, frames)
    pattern: Array
    stays: float


def spot_of(group: PictureGroup, seen: Observations) -> SpeckleSpot:
    """All that one group of frames tells.

    Raises
    ------
    MeasureError
        With too few frames that show a spot, or if the surface did not move.
    """
    w = _windows_of(group)
    if not np.ptp(w.light[:, w.inside], axis=0).any():
        raise MeasureError("all frames are the same picture", remedy="list frames that were taken one after the other, not copies")
    grains = _grains_of(w, seen, group.facts.wavelength_nm or seen.stated.wavelength_nm)
    if grains.stays > SAME:
        what = f"{grains.stays:.0%} of the grain pattern is the same in all frames: the shift of the centre by it is a constant"
        raise MeasureError(what, remedy="move the surface between frames, by the size of the spot or more")
    x, y, u2 = _centres(w, grains.shot)
    degree, path = _path(np.column_stack([x, y]), w.index, grains.toeplitz)
    left = np.column_stack([x, y]) - path
    basis = _basis(w.index, degree)
    projector = np.eye(len(x)) - basis @ np.linalg.pinv(basis)
    free = projector @ grains.toeplitz
    expected = float(np.trace(free))
    dof = expected**2 / float(np.trace(free @ free))
    total = left.T @ left / expected
    noise = u2 * (len(x) - degree - 1) / expected
    scatter = total - noise * np.eye(2)
    notes = _notes(w, grains, left, dof)
    predicted, u_predicted = _predicted(w, grains)
    fit = _scatter_fit(total, noise, dof, grains, w).join(grains.fit)
    confounders = (POINTING, GRAINS)
    share = _clipped_share(w)
    if predicted is not None:
        more, u_more = _excess(total, noise, dof, predicted, u_predicted)
        if more > SIGNIFICANT * u_more:
            law = np.sqrt(0.5 * np.trace(predicted))
            notes.append(
                f"the centre scatters by {np.sqrt(0.5 * np.trace(scatter)):.2g} px; "
                f"grains of this size and contrast move it by {law:.2g} px: the rest is a beam that jumps, or the surface's own pattern "
                "(try another f-number: speckle is in proportion to it)"
            )
        elif more < -SIGNIFICANT * u_more and share <= MUCH_CLIPPED:
            notes.append("the centre scatters less than grains of this size and contrast make it: the patterns are not independent")
    return SpeckleSpot(
        x_px=x, y_px=y, path_x_px=path[:, 0], path_y_px=path[:, 1], degree=degree, u_located_px=float(np.sqrt(u2)), radius_px=w.radius,
        scatter_px2=scatter, predicted_px2=predicted, dof=dof, pattern_correlation=grains.pattern, stays_rel=grains.stays,
        effective_frames=len(x) ** 2 / float(grains.toeplitz.sum()), lags_px=grains.lags, covariance_rel=grains.covariance,
        model_rel=grains.model, noise_rel=grains.noise_rel, saturated_rel=share,
        wavelength_nm=group.facts.wavelength_nm or seen.stated.wavelength_nm, left_out=w.left_out,
        fit=replace(fit, confounders=confounders), notes=tuple(notes),
    )  # fmt: skip


def _centres(w: _Windows, shot: float) -> tuple[Array, Array, float]:
    """Centre of the light of each frame, and the variance of a coordinate by the noise of the pixels."""
    light = np.where(w.inside, w.light, 0.0).astype(float)
    flux = light.sum(axis=(1, 2))
    if not (flux > 0).all():
        raise MeasureError("frames without light where the spot is", remedy="list only frames that show it")
    side = light.shape[1]
    at = np.arange(side)
    cx, cy = (light.sum(axis=a) @ at / flux for a in (1, 2))
    mean = light.mean(axis=0)
    r2 = 0.5 * ((at - cx.mean()) ** 2 + (at[:, None] - cy.mean()) ** 2)
    variance = float((r2 * w.inside * (w.ground_var + shot * np.maximum(mean, 0))).sum()) / float(np.mean(flux)) ** 2
    return w.x0 + cx, w.y0 + cy, variance


def _clipped_share(w: _Windows) -> float:
    mean = np.where(w.inside, np.maximum(w.light.mean(axis=0), 0), 0.0)
    return float(mean[w.full].sum() / max(float(mean.sum()), 1e-12))


def _path(places: Array, index: np.ndarray, toeplitz: Array) -> tuple[int, Array]:
    """Degree of the path of the spot, and the path: terms that an F test of the whitened places needs."""
    from scipy.special import fdtrc

    root = np.linalg.inv(np.linalg.cholesky(toeplitz + 1e-6 * np.eye(len(places))))
    white = root @ places
    best = 0
    for degree in range(1, min(MOST_DEGREE, len(places) // 4) + 1):
        squares = []
        for d in (best, degree):
            basis = root @ _basis(index, d)
            squares.append(float(np.square(white - basis @ np.linalg.lstsq(basis, white, rcond=None)[0]).sum()))
        more, dof = 2 * (degree - best), 2 * (len(places) - degree - 1)
        if fdtrc(more, dof, (squares[0] - squares[1]) / more / max(squares[1] / dof, 1e-30)) < PATH_CHANCE:
            best = degree
    basis = _basis(index, best)
    return best, basis @ np.linalg.lstsq(basis, places, rcond=None)[0]


def _grains_of(w: _Windows, seen: Observations, wavelength_nm: float | None) -> _Grains:
    """Contrast and size of the grains from the covariance of pixels, and the correlation of the patterns of frames."""
    from scipy import ndimage

    light = np.where(np.isfinite(w.light), w.light, 0).astype(float)
    mean = light.mean(axis=0)
    smooth = ndimage.gaussian_filter(mean, max(0.3 * w.radius, 0.7))  # a pattern that stays does not choose the pixels
    lit = w.inside & ~ndimage.binary_dilation(w.full) & (smooth > LIT * smooth[w.inside].max())
    count = len(light)
    full = bool((w.inside & w.full).any())
    why = "the spot is saturated: take a shorter exposure" if full else "the spot is too small for its grains: make it larger, 6 px or more"
    none = replace(Estimates.empty(), reasons={"contrast_rel": why})
    if lit.sum() < 20 or w.full[w.inside].mean() > 0.5:
        zero = np.zeros(0)
        return _Grains(np.zeros((0, 2)), zero, zero, np.zeros((0, 0)), none, 0.0, 0.0, np.eye(count), np.ones(1), 0.0)
    flux = light[:, lit].sum(axis=1)
    light *= (flux.mean() / np.where(flux > 0, flux, flux.mean()))[:, None, None] if flux.std() < 0.02 * flux.mean() else 1.0
    mean = light.mean(axis=0)
    left = np.where(lit, light - mean, 0.0)
    lags = _first_lags(left, lit, mean, w.radius)
    products = _products(left, lags)  # shape (frames, lags)
    base = _products(np.where(lit, mean, 0.0)[None], lags)[0] * _between(mean, lit, lags)
    squares, sums = float(np.square(mean[lit]).sum()), float(np.maximum(mean[lit], 0).sum())
    shot, u_shot = _shot_noise(light, mean, w, seen)
    noise, u_noise = (w.ground_var * int(lit.sum()) + shot * sums) / squares, u_shot * sums / squares
    of_mean = 2 * np.einsum("ij,kij->k", np.where(lit, mean, 0.0), left) / count  # what a frame changes of the mean spot's square
    toeplitz, pattern, stays = np.eye(count), np.ones(1), 0.0
    products[:, 0] -= noise * base[0] * (count - 1) / count  # the noise of frames is not alike, whatever their patterns are
    for _ in range(3):  # what frames have in common enters the covariance, and this the comparison of frames
        alike = float(toeplitz.sum()) / count**2
        expected = count * (1 - alike)
        total = products.sum(axis=0) / expected
        covariance = total / np.maximum(base - total * alike, 0.1 * base)
        each = products * (count / expected) / base - np.outer(of_mean * count / base[0], covariance)
        of_model = np.atleast_2d(np.cov(each, rowvar=False)) * max(alike, 1 / count)
        of_model[0, 0] += u_noise**2
        fit, model, grain_px = _fit_grains(lags, covariance, of_model, seen, wavelength_nm, w.radius)
        toeplitz, pattern, stays = _alike(light, mean, lit, grain_px, w.radius, noise)
        if stays > SAME:
            break
    share = _clipped_share(w)
    if "contrast_rel" in fit and share > CLIPPED:  # the brightest grains are left out
        more = np.diag([(0.3 * share * fit["contrast_rel"].value) ** 2, *np.zeros(len(fit) - 1)])
        fit = replace(fit, covariance=fit.covariance + more)
    return _Grains(lags, covariance, model, of_model, fit, noise, shot, toeplitz, pattern, stays)


def _between(mean: Array, lit: np.ndarray, lags: np.ndarray) -> Array:
    """Square of the mean light midway between two pixels, over the product of theirs: what grains between them have in common.

    Of a Gaussian spot exp(−2 r²/w²) it is exp(Δ²/w²); the logarithm of the light gives the curvature.
    """
    rows, cols = np.nonzero(lit)
    value = np.maximum(mean[lit], 1e-3 * mean[lit].max())
    x, y = cols - cols.mean(), rows - rows.mean()
    basis = np.column_stack([np.ones(len(x)), x, y, x * x + y * y]) * value[:, None]
    curved = float(np.linalg.lstsq(basis, np.log(value) * value, rcond=None)[0][3])
    factor: Array = np.exp(-0.5 * min(curved, 0.0) * np.square(lags).sum(axis=1))
    return factor


def _shot_noise(light: Array, mean: Array, w: _Windows, seen: Observations) -> tuple[float, float]:
    """Variance of the noise over the light, DN, and its u: the gain, where it is known; else what of the variance grows as the light does.

    The variance of grains grows as the square of the mean light.
    """
    fit = seen.photon_transfer_fit
    if fit is not None and "gain_dn_per_e" in fit:
        return fit["gain_dn_per_e"].value, fit["gain_dn_per_e"].u
    used = w.inside & ~w.full & (mean > 0)
    x, y = mean[used], light[:, used].var(axis=0, ddof=1) - w.ground_var
    size, found, u = w.ground_var + np.maximum(y, 0.01 * x**2), np.zeros(2), 0.0
    for _ in range(4):
        basis = np.column_stack([x, x * x]) / size[:, None]
        cofactor = np.linalg.pinv(basis.T @ basis)
        found = cofactor @ (basis.T @ (y / size))
        left = y / size - basis @ found
        area = max(2.0, 4.0 * (found[1] > 0))  # neighbouring pixels show the same grain
        u = float(np.sqrt(cofactor[0, 0] * float(np.mean(left**2)) * area))
        size = w.ground_var + np.maximum(found[0] * x, 0) + np.maximum(found[1] * x * x, 1e-4 * x * x)
    return max(float(found[0]), 0.0), u


def _first_lags(left: Array, lit: np.ndarray, mean: Array, radius: float) -> np.ndarray:
    """Distances at which pixels are compared: to a little beyond the size of the grains, in half the plane; the first is 0."""
    most = max(int(0.8 * radius), 3)
    along = np.array([(k, 0) for k in range(most + 1)] + [(0, k) for k in range(1, most + 1)])
    shape = _products(left, along).sum(axis=0) / np.maximum(_products(np.where(lit, mean, 0.0)[None], along)[0], 1e-12)
    both = 0.5 * (shape[1 : most + 1] + shape[most + 1 :])
    low = np.flatnonzero(both < 0.3 * max(both[0], 1e-12))
    size = (int(low[0]) + 1) / 0.65 if low.size else most / 0.65  # γ = .3 at .65 λN
    reach = int(np.clip(np.ceil(2.2 * size), 3, most))
    if reach <= 6:
        steps = np.arange(-reach, reach + 1)
        return np.array([(0, 0)] + [(a, b) for b in range(reach + 1) for a in steps if (b > 0 or a > 0) and a * a + b * b <= reach * reach])
    far = np.unique(np.round(np.geomspace(1, reach, 10)).astype(int))
    star = [(0, 0)] + [(int(k * a), int(k * b)) for k in far for a, b in ((1, 0), (0, 1))]
    return np.array(star + [(s * int(round(0.71 * k)), int(round(0.71 * k))) for k in far[1:] for s in (1, -1)])


def _products(values: Array, lags: np.ndarray) -> Array:
    """Sum over all pixels of a value times that so far away, for each image: shape (images, lags)."""
    rows, cols = values.shape[1:]
    out = np.empty((len(values), len(lags)))
    for k, (a, b) in enumerate(lags):
        one = values[:, : rows - b, max(-a, 0) : cols - max(a, 0)]
        other = values[:, b:, max(a, 0) : cols - max(-a, 0)]
        out[:, k] = np.einsum("kij,kij->k", one, other)
    return out


def _fit_grains(
    lags: np.ndarray, covariance: Array, of_model: Array, seen: Observations, wavelength_nm: float | None, radius: float
) -> tuple[Estimates, Array, float | None]:
    """Contrast and λN from the covariance of pixels, the model, and λN, None where nothing is seen of grains."""
    from scipy.optimize import minimize_scalar

    size = np.sqrt(np.maximum(np.diag(of_model), 1e-12 * max(covariance[0], 1e-9) ** 2))
    weight = 1 / np.maximum(size, 0.1 * np.median(size))
    common = np.ones(len(lags))  # light that changes as a whole from frame to frame

    def design(lambda_n: float) -> Array:
        return np.column_stack([pixel_covariance_at(lags, lambda_n), common])

    def solved(lambda_n: float) -> tuple[Array, float]:
        a = design(lambda_n) * weight[:, None]
        values = np.linalg.lstsq(a, covariance * weight, rcond=None)[0]
        return values, float(np.square(a @ values - covariance * weight).sum())

    most = max(2.0 * float(np.abs(lags).max()), 1.0)
    grid = np.geomspace(0.3, most, 24)
    at = int(np.argmin([solved(float(v))[1] for v in grid]))
    ends = np.log([grid[max(at - 1, 0)], grid[min(at + 1, len(grid) - 1)]])
    best = minimize_scalar(lambda t: solved(float(np.exp(t)))[1], bounds=tuple(ends), method="bounded", options={"xatol": 1e-5})
    lambda_n = float(np.exp(best.x))
    values, _ = solved(lambda_n)
    step = 1e-3 * lambda_n
    slope = (pixel_covariance_at(lags, lambda_n + step) - pixel_covariance_at(lags, lambda_n - step)) / (2 * step)
    jacobian = np.column_stack([design(lambda_n), values[0] * slope]) * weight[:, None]
    inverse = np.linalg.pinv(jacobian, rcond=1e-9) * weight
    full = inverse @ of_model @ inverse.T
    cov = full[np.ix_([0, 2], [0, 2])]
    model = design(lambda_n) @ values
    c2, u_c2 = float(values[0]), float(np.sqrt(cov[0, 0]))
    if covariance[0] < SIGNIFICANT * np.sqrt(of_model[0, 0]) and c2 < SIGNIFICANT * u_c2:
        limit = float(np.sqrt(max(c2, 0.0) + ONE_SIDED_95 * u_c2))
        if limit > 1:
            return replace(Estimates.empty(), reasons={"contrast_rel": SMALL_GRAINS}), model, None
        row = ("contrast_rel", limit, u_c2 / (2 * limit), np.inf, "1")
        why = {"contrast_rel": "no grains are seen above the noise; 95 % upper limit"}
        return Estimates.from_rows([row], method=METHOD, limits=frozenset({"contrast_rel"}), reasons=why), model, None
    contrast = float(np.sqrt(max(c2, 1e-12)))
    to = np.diag([0.5 / contrast, 1.0])
    cov = to @ cov @ to
    if np.sqrt(cov[1, 1]) < DETERMINED * lambda_n and np.sqrt(cov[0, 0]) < DETERMINED * contrast and FINEST_PX < lambda_n < 0.9 * most:
        cov = cov + np.diag(np.square([MODEL_U[0] * contrast, MODEL_U[1] * lambda_n]))
        names, units = ("contrast_rel", "airy_px"), ("1", "px")
        return Estimates(names, np.array([contrast, lambda_n]), cov, np.full(2, np.inf), units, METHOD), model, lambda_n
    if lambda_n > 0.5 * radius:
        why = {"contrast_rel": "the grains are as large as the spot: open the lens, or make the spot larger"}
        return replace(Estimates.empty(), reasons=why), model, lambda_n
    stated = seen.stated
    if stated.f_number is None or wavelength_nm is None or stated.pitch_x_um is None:
        return replace(Estimates.empty(), reasons={"contrast_rel": SMALL_GRAINS}), model, lambda_n
    lambda_n = 1e-3 * wavelength_nm * stated.f_number / stated.pitch_x_um
    shape = float(pixel_covariance_at(np.zeros((1, 2)), lambda_n)[0])
    contrast = float(np.sqrt(max(covariance[0], 1e-12) / shape))
    u = float(np.hypot(np.sqrt(of_model[0, 0]) / (2 * contrast * shape), APERTURE_U * contrast))
    row = ("contrast_rel", contrast, u, np.inf, "1")
    told = {"contrast_rel": "with the stated f-number and wavelength: grains smaller than a pixel tell only their product with it"}
    return Estimates.from_rows([row], method=METHOD, reasons=told), model, lambda_n


def _alike(
    light: Array, mean: Array, lit: np.ndarray, grain_px: float | None, radius: float, noise_rel: float
) -> tuple[Array, Array, float]:
    """Correlation of the patterns of every two frames: as a matrix, by the distance in frames, and the share that all have in common."""
    from scipy import ndimage
    from scipy.linalg import toeplitz

    count = len(light)
    scale = radius / 6 if grain_px is None else 1.5 * max(grain_px, 1.0)
    fine = radius > 3 * scale
    if fine:  # without the mean spot: what a filter leaves that keeps all up to third degree
        ground = np.maximum(ndimage.gaussian_filter(mean, scale), 1e-9)
        patterns = np.array([((frame - _smooth(frame, scale)) / ground)[lit] for frame in light])
    else:
        ground = np.maximum(mean, 1e-9)
        patterns = ((light - mean) / ground)[:, lit]
    weight = ground[lit] ** 2
    gram = (patterns * weight) @ patterns.T / float(weight.sum())
    own = float(np.trace(gram)) / count
    signal = max(own - noise_rel, 0.05 * own)
    if grain_px is None and signal < LEAST_CONTRAST**2:  # no grains at all
        return np.eye(count), np.ones(1), 0.0
    lags = np.array([float(np.mean(np.diagonal(gram, k))) for k in range(1, count)]) / max(signal, 1e-12)
    if not fine:
        lags = (lags + 1 / count) / (1 + 1 / count)
    off = gram[np.triu_indices(count, 1)] / max(signal, 1e-12)
    spread = 1.4826 * float(np.median(np.abs(off - np.median(off))))
    u = spread / np.sqrt(count - np.arange(1, count))
    late = lags[count // 2 :]
    pairs = np.maximum(count - np.arange(count // 2 + 1, count), 1)
    stays = float((late * pairs).sum() / pairs.sum()) if fine and late.size else 0.0
    u_stays = spread / np.sqrt(count)  # pairs of frames share frames
    stays = float(np.clip(stays, 0.0, 0.999)) if stays > max(SIGNIFICANT * u_stays, 0.02) else 0.0
    rho = np.full(count, stays)
    rho[0] = 1.0
    for k in range(1, count // 2):
        if lags[k - 1] - stays < max(2.5 * u[k - 1], 0.02):
            break
        rho[k] = min(float(lags[k - 1]), 0.999)
    matrix = toeplitz(rho)
    values, vectors = np.linalg.eigh(matrix)
    if values[0] < 0:  # of a few frames, the estimate need not be a correlation
        matrix = (vectors * np.maximum(values, 0.0)) @ vectors.T
        size = np.sqrt(np.diag(matrix))
        matrix = matrix / size / size[:, None]
    shown = np.concatenate([[1.0], lags[: min(count // 2, 20)]])
    return matrix, shown, stays


def _smooth(image: Array, scale_px: float) -> Array:
    """Twice a Gaussian mean less its own mean."""
    from scipy import ndimage

    once = ndimage.gaussian_filter(image, scale_px)
    twice: Array = 2 * once - ndimage.gaussian_filter(once, scale_px)
    return twice


def _predicted(w: _Windows, grains: _Grains) -> tuple[Array | None, float]:
    """Scatter of the centre by the law of speckle for the mean spot, and its relative u."""
    from scipy.signal import fftconvolve

    fit = grains.fit
    if "contrast_rel" not in fit or "airy_px" not in fit or fit.limits:
        return None, 0.0
    contrast, lambda_n = fit["contrast_rel"].value, fit["airy_px"].value
    mean = np.where(w.inside, np.where(np.isfinite(w.light), w.light, 0).mean(axis=0), 0.0).astype(float)
    flux = float(mean.sum())
    at = np.arange(len(mean))
    cx, cy = float(mean.sum(axis=0) @ at) / flux, float(mean.sum(axis=1) @ at) / flux
    reach = int(np.ceil(max(3 * lambda_n, 4)))
    steps = np.arange(-reach, reach + 1)
    lags = np.array([(a, b) for b in steps for a in steps])
    shape = pixel_covariance_at(lags, lambda_n).reshape(len(steps), len(steps)) * contrast**2
    parts = [mean * (at - cx), mean * (at[:, None] - cy)]
    spread = [fftconvolve(p, shape, mode="same") for p in parts]
    matrix = np.array([[float((p * s).sum()) for s in spread] for p in parts]) / flux**2
    slope = np.array([1 / contrast, 1 / lambda_n])
    u_rel = float(np.sqrt(slope @ fit.select(["contrast_rel", "airy_px"]).covariance @ slope))
    return matrix, u_rel


def _excess(total: Array, noise: float, dof: float, predicted: Array, u_rel: float) -> tuple[float, float]:
    """Scatter beyond that of the grains, mean of both axes, and its u."""
    scatter, law = 0.5 * float(np.trace(total)) - noise, 0.5 * float(np.trace(predicted))
    expected = 0.5 * float(np.trace(total))
    return scatter - law, float(np.hypot(expected / np.sqrt(dof), 2 * law * np.hypot(u_rel, 0.05)))


def _scatter_fit(total: Array, noise: float, dof: float, grains: _Grains, w: _Windows) -> Estimates:
    """Standard deviations of the centre along x and y, or their limits; u as of a Wishart matrix."""
    rows, limits, reasons = [], set(), {}
    widened = 1.0
    if grains.stays > ALIKE:
        widened = 1 + 0.3 * grains.stays / (1 - grains.stays)
    names = ("scatter_x_px", "scatter_y_px")
    for k, name in enumerate(names):
        variance = float(total[k, k]) - noise
        u_var = float(total[k, k]) * float(np.sqrt(2 / dof)) * widened
        if variance < 2 * u_var and variance < noise:
            limits.add(name)
            reasons[name] = "not above what the noise of the pixels makes; 95 % upper limit"
            limit = float(np.sqrt(max(variance, 0) + ONE_SIDED_95 * u_var))
            rows.append((name, limit, u_var / (2 * limit), dof, "px"))
            continue
        value = float(np.sqrt(max(variance, 1e-12)))
        rows.append((name, value, u_var / (2 * value), dof, "px"))
    fit = Estimates.from_rows(rows, method=METHOD, limits=frozenset(limits), reasons=reasons)
    if not limits:  # covariance of the variances is 2 S_xy²/ν
        (x, y), both = fit.values, 2 * float(total[0, 1]) ** 2 / dof
        covariance = fit.covariance.copy()
        covariance[0, 1] = covariance[1, 0] = both / (4 * x * y)
        fit = replace(fit, covariance=covariance)
    return fit


def _notes(w: _Windows, grains: _Grains, left: Array, dof: float) -> list[str]:
    """What is doubtful about a spot."""
    notes = []
    count = len(left)
    if w.left_out:
        notes.append(f"frames left out, which show no such spot or only a part of it: {w.left_out}")
    if count < 20:
        notes.append(f"{count} frames tell the scatter to {1 / np.sqrt(2 * dof):.0%}; {WANTED_FRAMES} tell it to 10 %")
    near = float(grains.pattern[1]) if len(grains.pattern) > 1 else 0.0
    if grains.stays > ALIKE:
        notes.append(
            f"{grains.stays:.0%} of the grain pattern is the same in all frames. The scatter stated is that of patterns that change as a "
            "whole, with a larger u: move the surface by the size of the spot or more"
        )
    elif near > ALIKE:
        notes.append(
            f"the patterns of successive frames are alike (correlation {near:.2f}): {count} frames count as "
            f"{count**2 / float(grains.toeplitz.sum()):.0f}; the scatter and its u hold that. Move the surface further between frames"
        )
    share = _clipped_share(w)
    if share > CLIPPED:
        kept = "contrast and size of the grains are those of the pixels that are not"
        notes.append(f"{share:.1%} of the light is in saturated pixels: {kept}; the scatter is that of a spot that is cut off")
    return notes
