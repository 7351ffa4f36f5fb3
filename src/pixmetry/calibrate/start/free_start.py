"""Start values of a network of which nothing is known: two images first (relative orientation), the others one after the other.

A principal distance that is not known is tried in steps wide enough for the small adjustments to close; what explains most of the image
coordinates best is kept. Relative orientation: D. Nistér, IEEE PAMI 26 (2004) 756–770, by OpenCV, inside a RANSAC.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from scipy.sparse import csr_matrix

from pixmetry.calibrate.bundle.network import Network
from pixmetry.calibrate.start.reconstruction import COARSE, FINE, Reconstruction
from pixmetry.calibrate.start.resection import intersect, rays
from pixmetry.core.extras import import_extra

DISTANCES = (1.25, 2.1, 0.8, 3.6, 0.5, 6.0)  # principal distances to try, in widths of the frame
FEWEST_COMMON = 6  # points of a pair: five give its relative orientation
ENOUGH_COMMON = 30  # more of them make a pair no better
PAIRS, LISTED = 6, 24  # pairs to try at a time, and at all
WEIGHED = 250  # pairs whose parallax is looked at
TRIAL_IMAGES = 7  # images by which a start is judged
CONVINCING_PX = 0.25  # median residual at which no further start is tried
AGREED_PX = 3.0  # median residual up to which two starts that agree are believed
LEAST_ANGLE = np.deg2rad(3.0)  # at which the rays of a pair must meet


def common_points(network: Network) -> np.ndarray:
    """How many points two images share, for all pairs: shape (images, images)."""
    ones = np.ones(len(network))
    seen = csr_matrix((ones, (network.image, network.point)), (len(network.images), len(network.points)))
    seen.data[:] = 1.0
    return np.asarray((seen @ seen.T).todense())


def good_pairs(network: Network, allowed: np.ndarray) -> list[tuple[int, int]]:
    """Pairs of images, those first that share many points and see them from different sides."""
    common = common_points(network)
    same_camera = network.camera_of[:, None] == network.camera_of
    common = np.where(allowed[:, None] & allowed, common, 0)
    rank = np.triu(np.minimum(common, 2 * ENOUGH_COMMON) * np.where(same_camera, 1.0, 0.5), 1)
    order = np.argsort(-rank, axis=None, kind="stable")
    order = order[rank.ravel()[order] > 0]
    if len(order) > WEIGHED:  # not always those of the same few images
        enough = order[rank.ravel()[order] >= 0.5 * rank.max()]
        order = enough[np.linspace(0, len(enough) - 1, WEIGHED).astype(int)] if len(enough) > WEIGHED else order[:WEIGHED]
    first, second = np.unravel_index(order, rank.shape)
    value = []
    for i, j in zip(first, second, strict=True):
        a, b = shared(network, int(i), int(j))
        value.append(_parallax(network, a, b) * min(rank[i, j], ENOUGH_COMMON) if len(a) >= FEWEST_COMMON else 0.0)
    best = [k for k in np.argsort(-np.array(value), kind="stable") if value[k] > 0]
    chosen: list[tuple[int, int]] = []
    for k in best:  # each image twice at most, so that one bad image does not spoil all
        pair = int(first[k]), int(second[k])
        if all(sum(image in other for other in chosen) < 2 for image in pair):
            chosen.append(pair)
    return chosen[:LISTED]


def shared(network: Network, i: int, j: int) -> tuple[np.ndarray, np.ndarray]:
    """Rows of the image coordinates in two images that belong to the same points."""
    a, b = np.flatnonzero(network.image == i), np.flatnonzero(network.image == j)
    _, first, second = np.intersect1d(network.point[a], network.point[b], return_indices=True)
    return a[first], b[second]


def _parallax(network: Network, a: np.ndarray, b: np.ndarray) -> float:
    """By how much one image differs from an affine picture of the other, relative to the frame, saturating: perspective and depth."""
    x = np.column_stack([network.x_px[a], network.y_px[a]])
    y = np.column_stack([network.x_px[b], network.y_px[b]])
    p = np.column_stack([x - x.mean(axis=0), np.ones(len(x))])
    left = y - p @ np.linalg.lstsq(p, y, rcond=None)[0]
    size = float(np.median(np.hypot(*left.T))) * np.sqrt(len(a) / max(len(a) - 3, 1))
    width = network.cameras[0].sensor.cols
    spread = float(np.sqrt(np.linalg.det(np.cov(y.T)))) / width**2  # a pair should fill the frame
    return float(min(size / width, 0.05) * min(1.0, 20 * spread))


def seed(work: Reconstruction, i: int, j: int) -> bool:
    """Orient two images relative to each other (base 1) and intersect their points; False if it cannot be done."""
    cv2 = import_extra("cv2")

    a, b = shared(work.network, i, j)
    good = np.isfinite(work.uv[a]).all(axis=1) & np.isfinite(work.uv[b]).all(axis=1)
    a, b = a[good], b[good]
    if len(a) < FEWEST_COMMON:
        return False
    first, second = np.ascontiguousarray(work.uv[a]), np.ascontiguousarray(work.uv[b])
    c_px = min(work.c_px(work.network.camera_of[image]) for image in (i, j))
    best = None
    for share in (COARSE / 4, COARSE / 16):
        try:
            matrix, _ = cv2.findEssentialMat(first, second, np.eye(3), cv2.RANSAC, 0.9999, share * work.width / c_px)
        except cv2.error:
            continue
        for k in range(0 if matrix is None else len(matrix) // 3):
            for rotation, position in _decomposed(matrix[3 * k : 3 * k + 3]):
                count = _meeting(first, second, rotation, position, share * work.width / c_px)
                if best is None or count > best[0]:
                    best = count, rotation, position
    if best is None or best[0] < max(5, 0.5 * len(a)):
        return False
    for image, rotation, position in ((i, np.eye(3), np.zeros(3)), (j, best[1], best[2])):
        work.rotation[image], work.position[image] = rotation, position
    work.triangulate()
    known = np.isfinite(work.xyz[:, 0])
    away = work.xyz[known] - work.position[i], work.xyz[known] - work.position[j]
    cosine = np.einsum("ni,ni->n", *away) / (np.linalg.norm(away[0], axis=1) * np.linalg.norm(away[1], axis=1))
    return bool(known.sum() >= max(5, 0.5 * len(a)) and np.median(np.arccos(np.clip(cosine, -1, 1))) > LEAST_ANGLE)


def _decomposed(matrix: np.ndarray) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """The four poses (R, X₀ of the second image) behind an essential matrix."""
    left, _, right = np.linalg.svd(matrix)
    left, right = left * np.sign(np.linalg.det(left)), right * np.sign(np.linalg.det(right))
    turn = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    for rotation in (left @ turn @ right, left @ turn.T @ right):
        for sign in (1.0, -1.0):
            yield rotation, -rotation.T @ (sign * left[:, 2])


def _meeting(first: np.ndarray, second: np.ndarray, rotation: np.ndarray, position: np.ndarray, tolerance: float) -> int:
    """Number of points that lie before both images, on rays that meet."""
    n = len(first)
    rotations = np.concatenate([np.broadcast_to(np.eye(3), (n, 3, 3)), np.broadcast_to(rotation, (n, 3, 3))])
    origin = np.concatenate([np.zeros((n, 3)), np.broadcast_to(position, (n, 3))])
    point = np.tile(np.arange(n), 2)
    return int(intersect(origin, rays(np.concatenate([first, second]), rotations), point, n, tolerance)[1].sum()) // 2


def start_distances(network: Network) -> list[np.ndarray]:
    """Principal distances to try, one per camera in each: those given first, then steps."""
    given = np.array([camera.values[0] for camera in network.cameras])
    widths = np.array([camera.sensor.cols * camera.sensor.per_px[0] for camera in network.cameras])
    fixed = np.array([not camera.free[0] for camera in network.cameras])
    tries = [np.where(given > 0, given, DISTANCES[0] * widths)]
    if not (fixed & (given > 0)).all():
        tries += [np.where(fixed & (given > 0), given, step * widths) for step in DISTANCES]
    return tries[:1] + [c for c in tries[1:] if np.max(np.abs(np.log(c / tries[0]))) > 0.05]


def without_lens(network: Network, interior: np.ndarray) -> np.ndarray:
    """Interior parameters with all terms of lens and affinity that are free set to 0."""
    free = np.array([camera.free for camera in network.cameras])
    free[:, :3] = False
    return np.where(free, 0.0, interior)


def start_interiors(network: Network, interior: np.ndarray) -> list[np.ndarray]:
    """Interior parameters to try: a lens that was given is believed first, then all principal distances without one."""
    distances, plain = start_distances(network), without_lens(network, interior)
    given = [np.column_stack([distances[0], interior[:, 1:]])] if (plain != interior).any() else []
    return given + [np.column_stack([c, plain[:, 1:]]) for c in distances]


def best_free(network: Network, interior: np.ndarray, allowed: np.ndarray, first: int = 0) -> Reconstruction | None:
    """The start that explains the image coordinates best, grown to a few images; None if no pair can be oriented.

    ``first`` is the pair to begin with, in the order of `good_pairs`.
    """
    pairs = good_pairs(network, allowed)[first : first + PAIRS]
    best, least = None, np.inf
    no_control = np.zeros(len(network.points), bool)
    starts = start_interiors(network, interior)
    order = [(k, row) for k in range(min(2, len(pairs))) for row in starts] + [(k, row) for k in range(2, len(pairs)) for row in starts[:3]]
    for number, (k, values) in enumerate(order):
        if best is not None and number == len(starts):  # one pair has been tried with all: is the best of it on its way down?
            best.settle()
            least, convincing = _value(best)
            if convincing:
                break
        work = Reconstruction(network, values, no_control)
        work.allowed[:] = allowed
        if not seed(work, *pairs[k]):
            continue
        work.grow(limit=min(TRIAL_IMAGES, int(allowed.sum())))
        value, convincing = _value(work)
        agree = best is not None and _agree(work, best)
        if value < least:
            best, least = work, value
        if convincing or agree:
            break
    return best


def _agree(one: Reconstruction, other: Reconstruction) -> bool:
    """Whether two starts with different first principal distances or pairs came to the same: then it is not by chance."""
    whole = min(one.posed.sum(), other.posed.sum()) >= min(TRIAL_IMAGES, len(one.posed))
    cameras = np.unique(one.network.camera_of[one.posed & other.posed])
    ratio = np.abs(np.log(one.interior[cameras, 0] / other.interior[cameras, 0]))
    small = max(one.spread_px, other.spread_px) < AGREED_PX
    return bool(whole and len(cameras) and (ratio < 0.005).all() and abs(np.log(one.spread_px / other.spread_px)) < 0.3 and small)


def _value(work: Reconstruction) -> tuple[float, bool]:
    """How badly a trial explains its images, less for more of them; and whether nothing better need be looked for."""
    images = np.flatnonzero(work.posed)
    wanted = min(TRIAL_IMAGES, len(work.posed))
    cost = (work.cost(images) * len(images) + (FINE * work.width) ** 2 * max(0, wanted - len(images))) / max(wanted, len(images))
    c = np.array([work.c_px(k) for k in np.unique(work.network.camera_of[images])]) / work.width
    plausible = bool((c > 0.2).all() and (c < 30).all())
    value = (cost + work.spread_px**2) * (1.0 if plausible else 100.0)
    return value, bool(plausible and work.spread_px < CONVINCING_PX and len(images) >= wanted and np.sqrt(cost) < 20 * CONVINCING_PX)
