"""Products of the frames of a stack with each other, and the bootstrap over frames that rests on them."""

from __future__ import annotations

import tempfile
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from pixmetry.core.arrays import Array
from pixmetry.core.errors import InputError, MeasureError
from pixmetry.core.random import Generator
from pixmetry.core.threads import single_threaded_blas
from pixmetry.emva.records import FrameProducts
from pixmetry.emva.spatial._kernels import subtract_low_pass
from pixmetry.emva.spatial.high_pass import LOW_PASS, MARGIN, MINIMUM_SIDE
from pixmetry.observe.moments import check_frame

BLOCK_BYTES = 48e6  # of all frames' share of a block of pixels, as float64
MINIMUM_FRAMES = 4  # below that the scatter of the frames' products has no degree of freedom


def frame_products(frames: Iterable[Array], bits: int) -> FrameProducts:
    """Products of all pairs of frames, summed over the pixels, over the row means and over the column means.

    Parameters
    ----------
    frames : iterable of ndarray, shape (rows, cols), uint8 or uint16
        Read once, and kept in a temporary file.
    bits : int
        Bits per stored code.

    Returns
    -------
    FrameProducts
        With ``high_passed`` where the frames have 24 x 24 pixels or more. Beside these matrices and one frame only two blocks of pixels of
        48 MB are held at a time, however many frames there are and however large.

    Raises
    ------
    InputError
        If frames differ in shape or are not stored codes.
    MeasureError
        With fewer than four frames.
    """
    with tempfile.TemporaryFile(prefix="pixmetry-frames-") as file:
        shape: tuple[int, int] | None = None
        count = 0
        for frame in frames:
            frame = check_frame(frame, bits, shape)
            shape = frame.shape[0], frame.shape[1]
            file.write(np.ascontiguousarray(frame, dtype=np.uint16).data)
            count += 1
        if shape is None or count < MINIMUM_FRAMES:
            raise MeasureError("a bootstrap over frames needs more of them", value=count, allowed=f"{MINIMUM_FRAMES} or more")
        file.flush()
        stored = np.memmap(file, dtype=np.uint16, mode="r", shape=(count, *shape))
        with single_threaded_blas():
            raw = _products(stored, 0)
            inner = _products(stored, MARGIN) if min(shape) >= MINIMUM_SIDE else None
    return FrameProducts(raw.pixel_dn2, raw.row_dn2, raw.col_dn2, raw.means_dn, inner)


def _products(stored: np.ndarray, margin: int) -> FrameProducts:
    """Products of the frames as they are, or with a margin of the high-passed ones."""
    count, rows, cols = stored.shape[0], stored.shape[1] - 2 * margin, stored.shape[2] - 2 * margin
    height, width = _block_shape(count, rows, cols, margin)
    pixel, row, col = np.zeros((3, count, count))
    means = np.zeros(count)
    offset = 0.0
    with tempfile.TemporaryFile(prefix="pixmetry-columns-") as file:
        columns = np.memmap(file, dtype=float, mode="w+", shape=(count, cols))
        for top in range(0, rows, height):
            lines = np.zeros((count, min(height, rows - top)))
            for left in range(0, cols, width):
                block = _block(stored, slice(top, min(top + height, rows)), slice(left, min(left + width, cols)), margin)
                # near the mean, so that the products lose no digits when the means are taken off
                offset = offset if top or left else float(block.mean())
                block -= offset
                flat = block.reshape(count, -1)
                pixel += flat @ flat.T
                lines += block.sum(axis=2)
                columns[:, left : left + width] += block.sum(axis=1)
            lines /= cols
            means += lines.sum(axis=1) / rows
            row += lines @ lines.T
        step = height * width  # as many columns of sums as a block has pixels
        for left in range(0, cols, step):
            sums = columns[:, left : left + step] / rows
            col += sums @ sums.T
        del columns
    square = np.outer(means, means)
    return FrameProducts(pixel / (rows * cols) - square, row / rows - square, col / cols - square, means + offset)


def _block_shape(count: int, rows: int, cols: int, margin: int) -> tuple[int, int]:
    """Rows and columns of a block: whole rows where they fit, and with the filter no lower than its margins while there are columns."""
    pixels = max(int(BLOCK_BYTES / (8 * count)), 1)
    height = min(max(pixels // cols, min(2 * margin, pixels), 1), rows)
    return height, min(pixels // height, cols)


def _block(stored: Array, rows: slice, cols: slice, margin: int) -> Array:
    """A block of pixels of all frames, float64, [frame, row, col]; with a margin of the high-passed ones."""
    found = stored[:, rows.start : rows.stop + 2 * margin, cols.start : cols.stop + 2 * margin]
    if not margin:
        return found.astype(float)
    block = np.empty((len(stored), rows.stop - rows.start, cols.stop - cols.start))
    for frame, out in zip(found, block, strict=True):
        subtract_low_pass(np.ascontiguousarray(frame, dtype=float), LOW_PASS, np.empty(frame.shape[1]), out)
    return block


def deviations(products: FrameProducts, shape: tuple[int, int], gains: Array | None, n: int, rng: Generator) -> Array:
    """Bootstrap over the frames: by how much the vector of ``SpatialInputs`` would come out elsewhere, shape (n, 8).

    With ``gains`` (of ``high_pass.pattern_gains``) for high-passed images, without for images as they are.

    Notes
    -----
    Let Q_kl be the product of frames k and l in one stratum (pixel, row or column): θ + g_k + g_l + h_kl for k ≠ l, with the pattern's
    mean square θ, g_k = pattern · noise of frame k, h_kl = noise · noise. The pattern's unbiased estimate is U = mean of Q_kl over k ≠ l,
    a U-statistic of degree 2, and s² measured of the mean image is U + T/L, T the temporal variance of the stratum.

    Var(U) = 4 ζ₁/L + 2 ζ₂/(L(L − 1)), ζ₁ = Var g, ζ₂ = Var h. Where the pattern is weaker than the noise of the mean image, ζ₁ counts
    for little and a bootstrap that draws frames with replacement is wrong: the row means of Q that it rests on hold h too, and it gives
    6 ζ₂/L² in place of 2 ζ₂/L² (Arcones and Giné, Ann. Statist. 20, 1992). So linear and degenerate part are told apart (Hoeffding): with
    a_k = mean of Q_kl over l ≠ k, less U,

        h_kl = Q_kl − U − (a_k + a_l)(L − 1)/(L − 2),    ζ₂ = Σ_{k<l} h²_kl/(L(L − 3)/2),
        ζ₁ = (Σ a²_k − ζ₂ (L − 2)/(L − 1)) (L − 1)/(L − 2)²,

    both free of bias (a negative ζ₁ is taken as zero), and U* − U = 2/L Σ w_k g_k + 1/(L(L − 1)) Σ_{k≠l} w_k w_l h_kl, with g and h
    scaled to ζ₁ and ζ₂ and weights w_k of mean 0 and variance 1, the same for all entries of the vector (Dehling and Mikosch, J.
    Multivariate Anal. 51, 1994). Normal weights are taken: their products have exactly the variance 1, those of resampled frames only for
    many frames.
    """
    frames = products.means_dn.size
    rows, cols = shape
    weights = rng.standard_normal((n, frames))
    raw = [Products.of(q).deviate(weights) for q in strata(products)]
    image = raw
    if gains is not None:
        if products.high_passed is None:
            raise InputError("no products of high-passed frames", where="bootstrap", remedy="make them of frames of 24 x 24 pixels or more")
        image = [Products.of(q).deviate(weights) for q in strata(products.high_passed)]
    out = np.empty((n, 8))
    scale = np.sqrt(frames / (frames - 1))
    means = products.means_dn - products.means_dn.mean()
    out[:, 0] = scale * (weights @ means) / frames
    measured = np.stack([pattern + temporal / frames for pattern, temporal in image])
    out[:, 1], out[:, 2], out[:, 3] = measured.sum(axis=0), measured[2], measured[1]
    (pixel, row, col) = (temporal for _, temporal in raw)
    out[:, 4] = pixel + row + col + scale * (weights @ (means**2 - (means**2).mean())) / (frames - 1)
    white = pixel * rows * cols / ((rows - 1) * (cols - 1))
    out[:, 5], out[:, 6], out[:, 7] = white, row * rows / (rows - 1) - white / cols, col * cols / (cols - 1) - white / rows
    if gains is not None:  # of the filtered region alone
        out[:, 5] = image[0][1] / (gains[0, 0] - gains[1, 0] - gains[2, 0])
    return out


def strata(products: FrameProducts) -> tuple[Array, Array, Array]:
    """Products of the frames in the strata pixel, row, column, each of shape (L, L), per pixel of the frame."""
    return products.pixel_dn2 - products.row_dn2 - products.col_dn2, products.row_dn2, products.col_dn2


@dataclass(frozen=True)
class Products:
    """Products of frames in one stratum, told apart: see :func:`deviations`."""

    pattern: float  # U
    temporal: float  # T
    linear: Array  # g_k as far as it shows, shape (L,)
    own: Array  # Q_kk
    degenerate: Array  # h_kl, zero for k = l
    zeta1: float  # not negative
    zeta2: float

    @classmethod
    def of(cls, q: Array) -> Products:
        """Split the products of frames, shape (L, L)."""
        count = q.shape[0]
        own = np.diag(q)
        a = (q.sum(axis=1) - own) / (count - 1)
        pattern = float(a.mean())
        a = a - pattern
        linear = a * (count - 1) / (count - 2)
        h = q - pattern - linear[:, None] - linear[None, :]
        np.fill_diagonal(h, 0.0)
        zeta2 = float((h**2).sum()) / (count * (count - 3))
        zeta1 = float(a @ a - zeta2 * (count - 2) / (count - 1)) * (count - 1) / (count - 2) ** 2
        return cls(pattern, float(own.mean()) - pattern, linear, own, h, max(zeta1, 0.0), zeta2)

    def deviate(self, weights: Array) -> tuple[Array, Array]:
        """Deviations of U and T for weights of shape (draws, L)."""
        count = self.own.size
        observed = float(self.linear @ self.linear) / count
        share = min(self.zeta1 / observed, 1.0) if observed > 0 else 0.0
        degenerate = np.einsum("dk,dk->d", weights @ self.degenerate, weights)
        degenerate *= np.sqrt((count - 1) / (count - 3)) / (count * (count - 1))
        # Q_kk − 2 g_k is free of the pattern; the best guess of g_k is its share of what shows
        temporal = self.own - self.own.mean() - 2 * share * self.linear
        return (
            2 * np.sqrt(share) * (weights @ self.linear) / count + degenerate,
            np.sqrt(count / (count - 1)) * (weights @ temporal) / count - degenerate,
        )
