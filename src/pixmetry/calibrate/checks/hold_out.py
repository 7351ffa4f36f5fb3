"""Cross-validation: the fit of images that were left out of the adjustment."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from pixmetry.calibrate.bundle.network import SCALE, SHIFT, Adjustment, Network, State
from pixmetry.calibrate.checks.added_terms import derivatives, whitening
from pixmetry.calibrate.checks.quality import p_fall, p_words
from pixmetry.calibrate.records import HeldRms, HoldOut
from pixmetry.core.arrays import Array
from pixmetry.core.errors import InputError

STEPS = 30
CLOSE = 1e-6  # steps are small when they move the image by so many px
WORSE = 1.5  # than the fit, and than noise alone: images left out of which something must be said
TUNING = 2.5  # of Huber's weights, in standard deviations


@dataclass(frozen=True)
class LeftOut:
    """Residuals of each image in an adjustment without it.

    Parameters
    ----------
    residual_px : ndarray, shape (n, 2)
        NaN: not used, or of a point that the other images do not determine.
    fit_px : ndarray, shape (n, 2)
        Residuals of the adjustment of all images; NaN: not used.
    image : ndarray of int, shape (n,)
    folds : int
    interior : ndarray, shape (folds, cameras, 12), or None
        Parameters found without each fold.
    """

    residual_px: np.ndarray
    fit_px: np.ndarray
    image: np.ndarray
    folds: int
    interior: np.ndarray | None = None


def left_out(adjustment: Adjustment, folds: int = 5, seed: int = 0) -> LeftOut:
    """Adjust without each fold of images in turn; a left-out image then gets only its pose (and its own x-scale and x-shift, if images have
    them), with cameras and points of the others fixed.

    Points keep the part that they have in the network of the adjustment (fixed, weighted or free), and rejected observations stay out. The
    images of every camera are dealt out to the folds at random.

    Parameters
    ----------
    adjustment : Adjustment
        Of all images.
    folds : int
        At least 2; no more than there are images of a camera.
    seed : int
        Of the deal.

    Raises
    ------
    InputError
        If a camera has fewer than 3 images, or fewer than 2 folds are asked for.
    MeasureError
        If the images of the other folds do not carry the adjustment.
    """
    from pixmetry.calibrate.bundle.bundle import adjust

    network, used = adjustment.network, adjustment.used
    fold_of, folds = _dealt(network, folds, seed)
    residual = np.full((len(network), 2), np.nan)
    interior = []
    for fold in range(folds):
        rest = fold_of != fold
        part, start, kept = subset(network, adjustment.state, rest)
        without = adjust(part, start, used=used[kept], covariance=False).state
        interior.append(without.interior)
        state = replace(adjustment.state, interior=without.interior, xyz=without.xyz)
        mine = used & (fold_of[network.image] == fold)
        residual[mine] = resect(network, state, mine)[1][mine]
    fit = np.where(used[:, None], adjustment.residual_px, np.nan)
    return LeftOut(residual, fit, network.image, folds, np.array(interior))


def _dealt(network: Network, folds: int, seed: int) -> tuple[np.ndarray, int]:
    from pixmetry.core.random import generator

    least = int(np.bincount(network.camera_of, minlength=len(network.cameras)).min())
    if least < 3 or folds < 2:
        found = f"{least} images, {folds} folds"
        raise InputError("too few images to leave some out", where="hold-out", value=found, allowed="3 images of each camera, 2 folds")
    folds = min(folds, least)
    rng = generator(seed, "hold out")
    fold_of = np.empty(len(network.images), int)
    for k in range(len(network.cameras)):
        mine = np.flatnonzero(network.camera_of == k)
        fold_of[rng.permutation(mine)] = np.arange(len(mine)) % folds
    if network.instant is not None:  # images of one instant go together
        for t in np.unique(network.instant[network.instant >= 0]):
            together = np.flatnonzero(network.instant == t)
            fold_of[together] = fold_of[together[0]]
    return fold_of, folds


def subset(network: Network, state: State, images: np.ndarray) -> tuple[Network, State, np.ndarray]:
    """The network and state of some of the images (a mask), and which observations they keep. Cameras and points stay as they are."""
    kept = images[network.image]
    numbers = np.cumsum(images) - 1
    part = replace(
        network,
        images=tuple(name for name, keep in zip(network.images, images, strict=True) if keep),
        camera_of=network.camera_of[images],
        x_px=network.x_px[kept],
        y_px=network.y_px[kept],
        image=numbers[network.image[kept]],
        point=network.point[kept],
        covariance_px2=network.covariance_px2[kept],
        time_s=None if network.time_s is None else network.time_s[images],
        poses=None,
        instant=None if network.instant is None else network.instant[images],
    )
    start = replace(
        state,
        rotation=state.rotation[images],
        position=state.position[images],
        x_scale=state.x_scale[images],
        x_shift_px=state.x_shift_px[images],
    )
    return part, start, kept


def resect(network: Network, state: State, used: np.ndarray) -> tuple[State, np.ndarray]:
    """Robust pose of every image that has used observations, with cameras and points fixed.

    Parameters
    ----------
    network : Network
        Its ``per_image`` says whether an image also has an x-scale and an x-shift of its own.
    state : State
        Cameras, points and start values of the poses.
    used : ndarray of bool, shape (n,)

    Returns
    -------
    state : State
        With the poses found.
    residual_px : ndarray, shape (n, 2)
        Measured less computed, of the observations used; NaN for the others and where a point has no coordinates.
    """
    posed = state.posed & np.all(np.isfinite(state.rotation), axis=(1, 2))
    used = used & state.located[network.point] & posed[network.image]
    free = [*range(6), *((SCALE,) if "x_scale" in network.per_image else ()), *((SHIFT,) if "x_shift" in network.per_image else ())]
    known = 2 * np.bincount(network.image[used], minlength=len(network.images)) >= len(free)
    used = used & known[network.image]
    part = _observations(network, used)
    white = whitening(part.covariance_px2)
    measured = np.stack([part.x_px, part.y_px], axis=1)
    for _ in range(STEPS):
        d = derivatives(part, state)
        v = np.einsum("nij,nj->ni", white, measured - d.computed)
        slopes = np.einsum("nij,njk->nik", white, d.by_image[:, :, free])
        weight = _huber(v, part.image, len(network.images))
        step = _steps(slopes, v, weight, part.image, len(network.images))
        state = _moved(state, step, free)
        if len(part) == 0 or np.abs(np.einsum("nij,nj->ni", d.by_image[:, :, free], step[part.image])).max() < CLOSE:
            break
    residual = np.full((len(network), 2), np.nan)
    residual[used] = measured - derivatives(part, state).computed
    return state, residual


def _observations(network: Network, used: np.ndarray) -> Network:
    return replace(
        network,
        x_px=network.x_px[used],
        y_px=network.y_px[used],
        image=network.image[used],
        point=network.point[used],
        covariance_px2=network.covariance_px2[used],
    )


def _huber(v: np.ndarray, image: np.ndarray, images: int) -> np.ndarray:
    """Huber's weights by the length of a whitened residual over its image's median length (Rayleigh: the median is 1.1774 σ)."""
    length = np.hypot(*v.T)
    order = np.lexsort((length, image))
    count = np.bincount(image, minlength=images)
    middle = np.cumsum(count) - count + np.maximum(count - 1, 0) // 2
    sigma = np.full(images, np.inf)
    sigma[count > 0] = length[order][middle[count > 0]] / 1.1774
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(length > TUNING * sigma[image], TUNING * sigma[image] / length, 1.0)


def _steps(slopes: np.ndarray, v: np.ndarray, weight: np.ndarray, image: np.ndarray, images: int) -> np.ndarray:
    """Gauss–Newton steps of all images, shape (images, k); 0 for an image without observations."""
    k = slopes.shape[2]
    seen = np.isfinite(v).all(axis=1) & np.isfinite(slopes).all(axis=(1, 2))  # not behind the camera, nor beyond its lens
    slopes, v, weight = (np.where(seen.reshape(-1, *[1] * (part.ndim - 1)), part, 0.0) for part in (slopes, v, weight))
    normal, right = np.zeros((images, k, k)), np.zeros((images, k))
    np.add.at(normal, image, np.einsum("n,nij,nik->njk", weight, slopes, slopes))
    np.add.at(right, image, np.einsum("n,nij,ni->nj", weight, slopes, v))
    length = np.sqrt(np.einsum("nii->ni", normal))
    length[length == 0] = 1.0
    unit = normal / length[:, :, None] / length[:, None, :]
    steps: Array = np.einsum("nij,nj->ni", np.linalg.pinv(unit, rcond=1e-13, hermitian=True), right / length) / length
    return steps


def _moved(state: State, step: np.ndarray, free: list[int]) -> State:
    from scipy.spatial.transform import Rotation

    full = np.zeros((len(step), SHIFT + 1))
    full[:, free] = step
    rotation = Rotation.from_rotvec(full[:, :3]).as_matrix() @ state.rotation
    moved = replace(state, rotation=rotation, position=state.position + full[:, 3:6])
    return replace(moved, x_scale=state.x_scale + full[:, SCALE], x_shift_px=state.x_shift_px + full[:, SHIFT])


def expected_median_px(adjustment: Adjustment, folds: int, seed: int = 0) -> float:
    """What `left_out` would show if nothing but noise were wrong, by one simulation of the adjusted network.

    Points that few images see are worse known without one of them, so that images left out show more than those of the fit. The median says
    what half of the image coordinates do; the rms would hang on the few weakest points.

    Parameters
    ----------
    adjustment : Adjustment
    folds, seed : int
        As in `left_out`.

    Returns
    -------
    float
        Median size of the residuals, px.

    Raises
    ------
    InputError, MeasureError
        As `left_out`.
    """
    from pixmetry.core.random import generator

    network, state, rng = adjustment.network, adjustment.state, generator(seed, "expected hold out")
    noise = adjustment.sigma0 * np.linalg.solve(whitening(network.covariance_px2), rng.standard_normal((len(network), 2, 1)))[:, :, 0]
    change = np.where(adjustment.used[:, None], noise - adjustment.residual_px, 0.0)
    weighted = np.isfinite(network.u_xyz) & np.isfinite(state.xyz)
    u = np.where(weighted, network.u_xyz, 0.0) * rng.standard_normal(state.xyz.shape)
    bars = network.bars
    length = np.linalg.norm(state.xyz[bars.end] - state.xyz[bars.start], axis=1) + bars.u * rng.standard_normal(len(bars))
    simulated = replace(
        network,
        x_px=network.x_px + change[:, 0],
        y_px=network.y_px + change[:, 1],
        xyz=np.where(weighted, state.xyz + u, network.xyz),
        bars=replace(bars, length=np.where(np.isfinite(length), length, bars.length)),
    )
    return float(np.nanmedian(np.abs(left_out(replace(adjustment, network=simulated), folds, seed).residual_px)))


def hold_out_record(fixed: LeftOut | None, free: LeftOut | None = None) -> HoldOut:
    """Fit of images that were left out, compared with the fit of all.

    Parameters
    ----------
    fixed, free : LeftOut or None
        With the points as given, and with them free. With both, all numbers are of the observations that have a residual in either.

    Returns
    -------
    HoldOut
        Its ``p`` is that of a one-sided t-test on the logarithms of the images' mean squares, paired.

    Raises
    ------
    ValueError
        If there is neither.
    """
    given = [part for part in (fixed, free) if part is not None]
    if not given:
        raise ValueError("neither fixed nor free")
    common = np.logical_and.reduce([np.isfinite(part.residual_px).all(axis=1) for part in given])
    fixed_record, free_record = (None if part is None else _rms_record(part, common) for part in (fixed, free))
    p = None
    if fixed is not None and free is not None:
        p = p_fall(fixed.residual_px[common], free.residual_px[common], fixed.image[common])
    found = HoldOut(fixed_record, free_record, given[0].folds, p, "")
    return replace(found, text=_text(found))


def _text(found: HoldOut) -> str:
    words = []
    for name, record in (("points as given", found.fixed), ("points free", found.free)):
        if record is not None:
            words.append(f"{name}: {record.fit_rms_px:.4f} px in the fit, {record.left_out_rms_px:.4f} px in images left out")
    text = f"{'; '.join(words)} ({found.folds} folds; rms of a coordinate)"
    return text if found.p is None else f"{text}; {p_words(found.p)} for the decrease of the latter"


def _rms_record(part: LeftOut, common: np.ndarray) -> HeldRms:
    fit, left = (float(np.sqrt(np.mean(values[common] ** 2))) for values in (part.fit_px, part.residual_px))
    return HeldRms(fit, left, float(np.median(np.abs(part.residual_px[common]))))
