"""Start values of a bundle adjustment, from nothing but the network.

Poses that were given come first (`pixmetry.calibrate.start.posed_start`). A test field that is known, or known roughly, poses the images by
itself: the principal distance comes from homographies where it is plane, from the start values, or from a search for the one that explains
the images best. Otherwise, and where that fails, the images are oriented relative to each other (`pixmetry.calibrate.start.free_start`) and
brought to the object's frame afterwards.

References
----------
R. Hartley & A. Zisserman, Multiple View Geometry, 2nd ed. 2004, algorithm 4.2 (normalised DLT); Z. Zhang, IEEE PAMI 22 (2000) 1330–1334,
section 3.1, here with the principal point in the middle of the frame.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from pixmetry.calibrate.bundle.model import CameraModel
from pixmetry.calibrate.bundle.network import Network, State
from pixmetry.calibrate.start.free_start import best_free, common_points, without_lens
from pixmetry.calibrate.start.object_frame import moved, to_object
from pixmetry.calibrate.start.posed_start import from_poses
from pixmetry.calibrate.start.reconstruction import Reconstruction
from pixmetry.calibrate.start.resection import FEWEST, FLAT, fitted, thickness
from pixmetry.core.arrays import Array
from pixmetry.core.errors import InputError, MeasureError
from pixmetry.core.threads import single_threaded_blas

TRIED_IMAGES = 12  # by which principal distances are compared
FINE_STEPS = (1.25, 0.8, 1.0, 1.6, 0.63, 2.0, 0.5, 2.6, 0.4, 3.3, 4.2, 5.3, 6.6, 8.5)  # principal distances, in widths of the frame
CONTROL_FITS = 0.3  # of FINE, as an rms: what a start from known points must reach
AT_ONCE = 0.1  # the same, with which no other principal distance is tried
SETTLED = 0.01  # change of the weights of a homography with which it stands
POOR = 3.0  # median residual of an image, in spreads, at which its other answer is tried
JOINS = 0.02  # rms distance at the points that join two parts, in units of the extent
BEGINNINGS = (0, 1, 2, 4, 8, 14)  # pairs to begin with, one after the other while most images get no pose
TIE = 3  # points that join two parts of a network
ENOUGH = 0.7  # of the images that must get a pose
FEW_POSED = 0.5  # of a camera's images: then its principal distance may be a wrong one


def start_values(network: Network) -> tuple[Network, State]:
    """Start values of all unknowns.

    Parameters
    ----------
    network : Network
        Principal distances of 0 in its cameras are searched for.

    Returns
    -------
    network : Network
        With the principal distances that were found in its cameras.
    state : State
        NaN: images that could not be posed, points that fewer than two of them see.

    Raises
    ------
    InputError
        If known coordinates fit the images only mirrored.
    MeasureError
        If most of the images cannot be posed; says which, and how many points they share with the others.
    """
    _check_distances(network)
    interior = np.stack([camera.values for camera in network.cameras])
    with single_threaded_blas():
        work = from_poses(network, interior)
        if work is not None:
            _grow_cameras(work)
        if work is None:
            work = _from_known_points(network, interior)
        if work is None:
            work = _from_images(network, interior)
        if not work.control.any():
            while work.posed.sum() < len(work.posed) and _join_rest(work):
                pass
            work.mend()
            work.settle()
            work.mend()
        _check_posed(work)
        if not work.control.any():
            to_object(work)
    cameras = tuple(replace(camera, values=row) for camera, row in zip(network.cameras, work.interior, strict=True))
    state = work.state()
    fixed = np.where((network.u_xyz == 0) & np.isfinite(network.xyz), network.xyz, state.xyz)
    return replace(network, cameras=cameras), replace(state, xyz=fixed)


def _check_distances(network: Network) -> None:
    for camera in network.cameras:
        if not camera.free[0] and not camera.values[0] > 0:
            remedy = "give the principal distance, or leave it free"
            raise InputError("the principal distance is held fixed, but is not given", where=camera.name, remedy=remedy)


def _from_known_points(network: Network, interior: np.ndarray) -> Reconstruction | None:
    """Poses from points that are known, or roughly known; None where there are not enough, or they do not fit."""
    fixed, given = network.control, network.given
    for control in (fixed, given) if (given & ~fixed).any() else (fixed,):
        work = _resected(network, interior, control)
        if work is not None:
            return work
    return None


def _resected(network: Network, interior: np.ndarray, control: np.ndarray) -> Reconstruction | None:
    seen = np.bincount(network.image[control[network.point]], minlength=len(network.images))
    images = np.flatnonzero(seen >= FEWEST + 2)
    if len(images) < min(2, len(network.images)) or thickness(network.xyz[control])[1] < 1e-3:
        return None
    work = Reconstruction(network, interior, control)
    for camera in range(len(network.cameras)):
        mine = images[network.camera_of[images] == camera]
        mine = mine[np.argsort(-seen[mine], kind="stable")]
        if len(mine):
            _search_distance(work, camera, mine[:: max(1, len(mine) // TRIED_IMAGES)][:TRIED_IMAGES])
    fits = _fits(work)
    if not fits:
        _check_mirrored(network, interior, control, images)
        return None
    work.grow()
    rough = control & ~np.isfinite(network.u_xyz).all(axis=1)
    if rough.any():  # coordinates that are only start values have done their part
        work.control = control & ~rough
        work.triangulate()
        work.judge()
        work.adjust()
        work.grow()
    return work


def _fits(work: Reconstruction) -> bool:
    rough = not np.isfinite(work.network.u_xyz[work.control]).all()
    return work.fits(np.flatnonzero(work.posed), (2 if rough else 1) * CONTROL_FITS)


def _search_distance(work: Reconstruction, camera: int, images: np.ndarray) -> None:
    """Pose some images of a camera with the principal distance that explains them best, and refine it."""
    model = work.network.cameras[camera]
    width = model.sensor.cols * model.sensor.per_px[0]
    given = model.values[0]
    from_planes = _distance_from_planes(work, camera, images)
    tries = [given] if given > 0 and not model.free[0] else [c for c in (from_planes, given) if c > 0] + [s * width for s in FINE_STEPS]
    best, least = None, np.inf
    for c in tries:
        trial = work.copy()
        trial.interior[camera] = model.values if c == given else without_lens(work.network, trial.interior)[camera]
        trial.interior[camera, 0] = c
        trial.look()
        trial.spread_px = np.inf  # anything may be wrong as yet
        for k, image in enumerate(images):
            trial.resect(int(image))
            if trial.least_cost(images[: k + 1], images) > least:  # it cannot become the best any more
                break
        else:
            trial.judge()
            cost = trial.cost(images)
            if c == tries[0] and _settles_at_once(first := trial.copy(), images):
                work.__dict__.update(first.__dict__)
                return
            if cost < least:
                best, least = trial, cost
    if best is None or not best.posed[images].any():
        return
    best.adjust(rounds=3)
    for _ in range(2):  # with a better lens: the images that did not fit, and the other answer where a plane has two
        for image in images:
            best.resect(int(image))
        best.judge()
        best.adjust(rounds=3)
    work.__dict__.update(best.__dict__)


def _settles_at_once(trial: Reconstruction, images: np.ndarray) -> bool:
    """Whether an adjustment makes the images fit so well that no other principal distance need be tried."""
    if not trial.posed[images].all():
        return False
    trial.adjust(rounds=1)
    trial.adjusted = int(trial.posed.sum())
    poor = images[trial.typical_errors()[images] > POOR * trial.spread_px]  # a plane has two answers
    for image in poor:
        trial.resect(int(image))
    if len(poor):
        trial.judge()
        trial.adjust(rounds=3)
    return trial.fits(images, AT_ONCE)


def _distance_from_planes(work: Reconstruction, camera: int, images: np.ndarray) -> float:
    network = work.network
    model = network.cameras[camera]
    if not work.control.any() or thickness(network.xyz[work.control])[0] > FLAT:
        return 0.0
    plane = np.full((len(network.points), 2), np.nan)
    plane[work.control] = plane_coordinates(network.xyz[work.control])
    mx, my = model.sensor.per_px
    found = []
    for image in images:
        rows = work.rows[image][work.control[network.point[work.rows[image]]]]
        if len(rows) >= FEWEST:
            places = np.column_stack([(network.x_px[rows] - model.values[1]) * mx, (network.y_px[rows] - model.values[2]) * my])
            found.append(homography(plane[network.point[rows]], places))
    c = principal_distance(found) if found else np.nan
    return float(c) if np.isfinite(c) else 0.0


def homography(plane: Array, image: Array, passes: int = 6) -> Array:
    """Homography that takes points of a plane to an image, both shape (n, 2), n ≥ 4; wrong points are weighted down.

    Raises
    ------
    ValueError
        If there are fewer than four points.
    """
    if len(plane) < 4:
        raise ValueError("a homography takes four points")
    (a, to_a), (b, to_b) = _normalised(plane), _normalised(image)
    weight = np.ones(len(a))
    p, x, y = np.column_stack([a, np.ones(len(a))]), b[:, 0], b[:, 1]
    factors, normal = np.stack([np.ones_like(x), -x, -y, x**2 + y**2]), np.zeros((9, 9))
    products = (p[:, :, None] * p[:, None, :]).reshape(len(p), 9)
    for _ in range(passes):  # rows (p, 0, −x p) and (0, p, −y p), times the weight
        one, by_x, by_y, by_both = ((factors * weight**2) @ products).reshape(4, 3, 3)
        normal[:3, :3] = normal[3:6, 3:6] = one
        normal[:3, 6:] = normal[6:, :3] = by_x
        normal[3:6, 6:] = normal[6:, 3:6] = by_y
        normal[6:, 6:] = by_both
        before, h = weight, np.linalg.eigh(normal)[1][:, 0].reshape(3, 3)
        with np.errstate(all="ignore"):
            seen = p @ h.T
            error = np.hypot(*(seen[:, :2] / seen[:, 2:] - b).T)
            spread = max(3.0 * float(np.median(np.where(np.isnan(error), np.inf, error))), 1e-9)
            depth = np.abs(seen[:, 2]) / np.median(np.abs(seen[:, 2]))  # algebraic errors are geometric ones times the depth
            weight = np.nan_to_num(1 / (depth * np.sqrt(1 + (error / spread) ** 2)))
        if (np.abs(weight - before) <= SETTLED * before).all():
            break
    h = np.linalg.inv(to_b) @ h @ to_a
    of_unit_length: Array = h / np.linalg.norm(h)
    return of_unit_length


def principal_distance(homographies: list[np.ndarray]) -> float:
    """Principal distance, in the unit of the image, from homographies into images about the principal point; NaN if they hold none.

    With ω = diag(1/c², 1/c², 1): h₁ᵀ ω h₂ = 0 and h₁ᵀ ω h₁ = h₂ᵀ ω h₂ for each; weak where the planes stand parallel
    to the image.
    """
    factors, constants = [], []
    for h in homographies:
        h1, h2 = h[:, 0], h[:, 1]
        size = np.linalg.norm(h1) * np.linalg.norm(h2)
        factors += [(h1[:2] @ h2[:2]) / size, (h1[:2] @ h1[:2] - h2[:2] @ h2[:2]) / size]
        constants += [h1[2] * h2[2] / size, (h1[2] ** 2 - h2[2] ** 2) / size]
    f, g = np.array(factors), -np.array(constants)
    slope = float(f @ g) / float(f @ f) if f.any() else np.nan  # 1/c²
    return float(1 / np.sqrt(slope)) if slope > 0 else float("nan")


def plane_coordinates(xyz: Array) -> Array:
    """Coordinates (n, 2) of points in the plane that lies through them."""
    a = xyz - xyz.mean(axis=0)
    within: Array = a @ np.linalg.svd(a, full_matrices=False)[2][:2].T
    return within


def _normalised(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    middle = points.mean(axis=0)
    scale = np.sqrt(2) / max(float(np.sqrt(np.mean(np.sum((points - middle) ** 2, axis=1)))), 1e-300)
    to = np.array([[scale, 0, -scale * middle[0]], [0, scale, -scale * middle[1]], [0, 0, 1]])
    return (points - middle) * scale, to


def _check_mirrored(network: Network, interior: np.ndarray, control: np.ndarray, images: np.ndarray) -> None:
    """Whether the images fit known points with one axis turned over (a plane fits either way)."""
    if thickness(network.xyz[control])[0] < FLAT:
        return
    rows = np.array([camera.sensor.rows for camera in network.cameras])[network.camera_of[network.image]]
    turned = Reconstruction(replace(network, y_px=rows - 1 - network.y_px), interior, control)
    for camera in range(len(network.cameras)):
        mine = images[network.camera_of[images] == camera][:TRIED_IMAGES]
        if len(mine):
            _search_distance(turned, camera, mine)
    if _fits(turned):
        raise InputError(
            "image and object coordinates agree only if one of them is mirrored", where="image coordinates", value="y counted downwards",
            allowed="x to the right and y down in the image, a right-handed frame in the object",
            remedy="state that y counts upwards in the table of image coordinates, or reverse one axis of the object",
        )  # fmt: skip


def _from_images(network: Network, interior: np.ndarray) -> Reconstruction:
    best: Reconstruction | None = None
    for first in BEGINNINGS:
        work = best_free(network, interior, np.ones(len(network.images), bool), first)
        if work is None:
            continue
        _grow_cameras(work)
        if best is None or work.posed.sum() > best.posed.sum():
            best = work
        if best.posed.mean() >= ENOUGH:
            break
    if best is None:
        raise _not_oriented(network, np.zeros(len(network.images), bool))
    return best


def _grow_cameras(work: Reconstruction) -> None:
    """Grow to all images; cameras few of whose images got a pose are searched for anew, on the points that stand by then."""
    network = work.network
    work.grow()
    for camera in range(len(network.cameras)):
        mine = np.flatnonzero(network.camera_of == camera)
        if not len(mine) or work.posed[mine].mean() > FEW_POSED:
            continue
        trial = work.copy()
        trial.rotation[mine], trial.position[mine] = np.nan, np.nan
        trial.triangulate()
        trial.judge()
        known = np.isfinite(trial.xyz[network.point, 0])
        seen = np.bincount(network.image[known], minlength=len(network.images))
        mine = mine[np.argsort(-seen[mine], kind="stable")][:TRIED_IMAGES]
        _search_distance(trial, camera, mine[seen[mine] >= FEWEST + 2])
        trial.grow()
        if trial.posed.sum() > work.posed.sum():
            work.__dict__.update(trial.__dict__)


def _join_rest(work: Reconstruction) -> bool:
    """Orient images that are left by themselves and join them to the others; whether some could be.

    What holds both parts together are points that both have, and images of the one that can be posed in the other.
    """
    network = work.network
    left = ~work.posed
    if left.sum() < 3:
        return False
    rest = best_free(replace(network, cameras=_held(network, work)), work.interior, left)
    if rest is None:
        return False
    rest.grow()
    rest.allowed[:] = True
    rest.grow(limit=int(rest.posed.sum()) + TIE)
    points = np.isfinite(rest.xyz[:, 0]) & np.isfinite(work.xyz[:, 0])
    images = rest.posed & work.posed
    source = np.concatenate([rest.xyz[points], rest.position[images]])
    target = np.concatenate([work.xyz[points], work.position[images]])
    if len(source) < TIE or thickness(source)[1] < 1e-3:
        return False
    scale, rotation, shift, away = fitted(source, target)
    if not np.median(away) < JOINS * np.linalg.norm(np.nanstd(work.xyz, axis=0)):
        return False
    moved(rest, scale, rotation, shift)
    new = rest.posed & left
    work.rotation[new], work.position[new] = rest.rotation[new], rest.position[new]
    work.triangulate()
    work.judge()
    work.grow()
    return bool(new.any())


def _held(network: Network, work: Reconstruction) -> tuple[CameraModel, ...]:
    """Cameras whose principal distance is known by now."""
    return tuple(
        replace(camera, values=row, free=np.zeros(len(row), bool)) if row[0] > 0 else camera
        for camera, row in zip(network.cameras, work.interior, strict=True)
    )


def _check_posed(work: Reconstruction) -> None:
    posed = work.posed
    measured = np.isin(np.arange(len(posed)), work.network.image)  # an image without any point is nobody's failure
    if (posed & measured).sum() < max(1, ENOUGH * measured.sum()):
        raise _not_oriented(work.network, posed)


def _not_oriented(network: Network, posed: np.ndarray) -> MeasureError:
    measured = np.isin(np.arange(len(posed)), network.image)
    if measured.sum() == 1:
        name = network.images[int(np.argmax(measured))]
        remedy = "check the points' coordinates, the size of the frame and the lens: distortion that is held at 0 is a frequent reason"
        return MeasureError(
            "the only image fits no pose with the camera and the points as given", where="start values", value=name, remedy=remedy
        )
    common = common_points(network)
    np.fill_diagonal(common, 0)
    left = np.flatnonzero(~posed & measured)
    best = common[left].max(axis=1)
    worst = left[np.argsort(best, kind="stable")][:5]
    names = ", ".join(f"{network.images[i]} (at most {int(common[i].max())} points in common with another image)" for i in worst)
    remedy = "check the points' names and the size of the frame, give a start value of c, rough coordinates of some points or rough poses"
    if np.median(best) < 8:
        remedy = "take images that share at least 8 points with others, from sides that differ by 10° to 90°, or give rough poses"
    elif posed.any():
        ties = len(np.intersect1d(network.point[posed[network.image]], network.point[np.isin(network.image, left)]))
        if ties < 8:
            remedy = f"these images share {ties} points with the others: take images or points that connect both, at least 8 points"
    what = f"{len(left)} of {measured.sum()} images cannot be oriented"
    return MeasureError(what, where="start values", value=names, remedy=remedy)
