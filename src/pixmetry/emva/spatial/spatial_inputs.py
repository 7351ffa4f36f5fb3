"""The statistics of a stack from which the spatial values are computed, and how they scatter under temporal noise."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from pixmetry.camera.observations import StackMoments
from pixmetry.core.arrays import Array
from pixmetry.core.errors import InputError, MeasureError
from pixmetry.core.random import Generator
from pixmetry.emva.records import FrameProducts
from pixmetry.emva.spatial.frame_products import Products, deviations, strata
from pixmetry.emva.spatial.high_pass import MARGIN, pattern_gains
from pixmetry.emva.spatial.high_pass import high_pass as without_low_pass

ENTRIES = ("mean", "measured", "cav_raw", "rav_raw", "stack", "white_t", "row_t", "col_t")
# sums of squares of the strata pixel, row, column from the variances of all pixels, of column means and of row means
TO_STRATA = np.array([[1.0, -1.0, -1.0], [0.0, 0.0, 1.0], [0.0, 1.0, 0.0]])
FROM_STRATA = np.linalg.inv(TO_STRATA)


@dataclass(frozen=True)
class SpatialInputs:
    """What the spatial values are computed from, for one stack.

    ``vector``, shape (8,), entries as in ``ENTRIES``: the mean (DN); then in DN²: variance of the mean image, of its column means and of
    its row means (denominators MN, N and M; temporal noise still in them; of the high-passed image where that was asked for); σ²_y.stack;
    and the variances of the temporal white, row and column noise of one frame.
    """

    vector: Array
    shape: tuple[int, int]  # of the frame
    n_frames: int
    high_passed: bool
    gains: Array  # shape (3, 3), see ``high_pass.PatternGains``
    dof: Array  # shape (3,), of white noise in the strata pixel, row, column of the image
    ms_frame_dn2: float
    uneven_first: float  # ⟨F²σ²⟩/(⟨F²⟩⟨σ²⟩) over the pixels: above 1 where those that stand out are also noisy
    uneven_second: float  # ⟨σ⁴⟩/⟨σ²⟩²
    image_dn: Array = field(repr=False, compare=False)  # the image that ``vector`` tells of
    # in the strata pixel, row, column, each of shape (3,); from the products of frames where there are any
    coherence: Array | None = None  # variance of the product of two frames' noise over that of white noise, v²/ν
    first_extra: Array | None = None  # variance of the term pattern times noise beyond that of white noise, DN⁴

    @classmethod
    def of(cls, stack: StackMoments, high_pass: bool, products: FrameProducts | None = None) -> SpatialInputs:
        """Statistics of a stack, with or without the filter of release 4.0.

        ``products`` of all frames, or of the first dozen, tell whether the temporal noise is white. Where a wave runs through the frames
        it is not, and the spatial variances then scatter more than the temporal variance says.

        Raises
        ------
        MeasureError
            If the frames are too small.
        """
        rows, cols = stack.shape
        if min(rows, cols) < 3:
            raise MeasureError("frames are too small to separate rows, columns and pixels", value=stack.shape, allowed="3 x 3 or more")
        gains = pattern_gains(stack.shape, high_pass)
        image, noise, white = stack.mean_map_dn, stack.var_map_dn2, stack.ms_pixel_dn2
        if high_pass:
            image, noise = without_low_pass(image), noise[MARGIN:-MARGIN, MARGIN:-MARGIN]
            # noisy pixels of the border are not in the image
            white = max(white + float(noise.mean(dtype=float)) - stack.var_stack_dn2, 0.0)
        squares = (image - image.mean()) ** 2
        variances = [squares.mean(), image.mean(axis=0).var(), image.mean(axis=1).var()]
        row_t, col_t = stack.ms_row_dn2 - stack.ms_pixel_dn2 / cols, stack.ms_col_dn2 - stack.ms_pixel_dn2 / rows
        level = float(noise.mean(dtype=float))
        first = float((squares * noise).mean()) / (variances[0] * level) if level > 0 and variances[0] > 0 else 1.0
        # a sample variance on L − 1 degrees of freedom scatters by itself: E[v²] = σ⁴ (1 + 2/(L − 1))
        second = float(np.square(noise, dtype=float).mean()) / level**2 / (1 + 2 / (stack.n_frames - 1)) if level > 0 else 1.0
        inputs = cls(
            vector=np.array([stack.mean_dn, *variances, stack.var_stack_dn2, white, row_t, col_t]),
            shape=(rows, cols),
            n_frames=stack.n_frames,
            high_passed=high_pass,
            gains=gains.matrix,
            dof=gains.dof,
            ms_frame_dn2=stack.ms_frame_dn2,
            uneven_first=first,
            uneven_second=max(second, 1.0),
            image_dn=image,
        )
        return inputs if products is None else inputs._with_products(products)

    def _with_products(self, products: FrameProducts) -> SpatialInputs:
        parts = [Products.of(q) for q in strata(self._fitting(products))]
        left, pattern = self._left(), self._pattern()
        white = (left * self.n_frames) ** 2 / self.dof
        coherence = np.divide([p.zeta2 for p in parts], white, out=np.ones(3), where=white > 0)
        if products.means_dn.size != self.n_frames:  # too uncertain from some of the frames
            return replace(self, coherence=coherence)
        known = self._first_order(left, pattern)
        extra = np.maximum(4 * np.array([p.zeta1 for p in parts]) / self.n_frames - known, 0.0)
        return replace(self, coherence=coherence, first_extra=extra)

    def _fitting(self, products: FrameProducts) -> FrameProducts:
        """The products of the frames as the inputs take them: high-passed or not."""
        if not self.high_passed:
            return products
        if products.high_passed is None:
            raise InputError("the frame products contain no high-passed frames", remedy="make them from frames of 24 x 24 pixels or more")
        return products.high_passed

    def draws(self, n: int, rng: Generator, dark_mean_dn: float | None = None) -> Array:
        """The vector as it would scatter in repeated measurements of this sensor: the pattern stays, the temporal noise is new.

        Parameters
        ----------
        n : int
            Number of draws.
        rng : numpy.random.Generator
        dark_mean_dn : float, optional
            Of a lit stack: the mean without light. The pattern then grows with the light, whose fluctuation from frame to frame is in the
            mean square of the frames' means.

        Returns
        -------
        ndarray, shape (n, 8)

        Notes
        -----
        In each stratum (pixel, row, column; independent of each other) a mean square of pattern plus noise of variance v has the
        expectation F² + v and the variance (2 v² + 4 F² v)/ν: a non-central chi-square. F² is what is left of the observed one after v.
        Unequal noise of the pixels (hot ones) raises both terms, and so does noise that is not white. The temporal mean squares of L frames
        are chi-square on L − 1 times the degrees of freedom of their stratum, and independent of the mean image for Gaussian noise.
        """
        frames = self.n_frames
        temporal, within_var = self._temporal_draws(n, rng)
        frame = self.ms_frame_dn2 * rng.chisquare(frames - 1, n) / (frames - 1) - self.ms_frame_dn2
        shift = rng.normal(0.0, np.sqrt(self.ms_frame_dn2 / frames), n)
        left, pattern = self._left(), self._pattern()
        second_dof = self.dof / ([self.uneven_second, 1.0, 1.0] if self.coherence is None else self.coherence)
        first_var = self._first_order(left, pattern) + (0.0 if self.first_extra is None else self.first_extra)
        second = left * (rng.chisquare(second_dof, (n, 3)) / second_dof - 1)
        drawn = TO_STRATA @ self.vector[1:4] + second + rng.normal(0.0, 1.0, (n, 3)) * np.sqrt(first_var)
        if dark_mean_dn is not None and self.vector[0] > dark_mean_dn:
            drawn += pattern * ((1 + shift / (self.vector[0] - dark_mean_dn)) ** 2 - 1)[:, None]
        out = np.empty((n, 8))
        out[:, 0] = self.vector[0] + shift
        out[:, 1:4] = drawn @ FROM_STRATA.T
        out[:, 4] = self.vector[4] + within_var + frame
        out[:, 5:] = temporal
        return out

    def _left(self) -> Array:
        """Temporal noise left in the strata of the mean image: what white, row and column noise of variance t/L shows there."""
        return np.maximum(TO_STRATA @ self.gains @ self.vector[5:] / self.n_frames, 0.0)

    def _pattern(self) -> Array:
        """Mean square of the pattern in the strata, not below zero."""
        return np.maximum(TO_STRATA @ self.vector[1:4] - self._left(), 0.0)

    def _first_order(self, left: Array, pattern: Array) -> Array:
        return 4 * pattern * left * [self.uneven_first, 1.0, 1.0] / self.dof

    def _temporal_draws(self, n: int, rng: Generator) -> tuple[Array, Array]:
        """Draws of the temporal white, row and column variances, and the deviation that these give σ²_y.stack."""
        rows, cols = self.shape
        white, row, col = self.vector[5:]
        least = 1 / (rows * cols * self.n_frames)  # one pixel that toggled once: no variance is known better than to that
        white = max(white, least)
        # noise of less than a code toggles between two: of a difference of −1, 0 or 1 the fourth power is the square, Var = σ² − σ⁴
        toggling = max(0.5 * (1 / white - 1), 1.0)
        squares = np.maximum([white, white, row + white / cols, col + white / rows], 0.0)  # per pixel twice, row mean, column mean
        share = self.image_dn.size / (rows * cols)  # the white noise counts in the filtered region, σ²_y.stack in the whole frame
        lines = np.array([share, 1 - share, 1.0, 1.0]) * [(rows - 1) * (cols - 1), (rows - 1) * (cols - 1), rows - 1, cols - 1]
        uneven = max(self.uneven_second, toggling)
        dof = np.maximum(lines * (self.n_frames - 1.0) / [uneven, uneven, 1.0, 1.0], 1.0)
        deviation = squares * (rng.chisquare(dof, (n, 4)) / dof - 1)
        whole = share * deviation[:, 0] + (1 - share) * deviation[:, 1]
        out = np.stack([deviation[:, 0], deviation[:, 2] - whole / cols, deviation[:, 3] - whole / rows], axis=1)
        return self.vector[5:] + out, deviation @ (lines * [1.0, 1.0, cols, rows] / (rows * cols))

    def bootstrap(self, products: FrameProducts, n: int, rng: Generator) -> Array:
        """The vector as a bootstrap over the L frames lets it scatter, shape (n, 8); see ``frame_products.deviations``.

        Raises
        ------
        InputError
            If the products are of another number of frames, or hold nothing of high-passed frames where the inputs need it.
        """
        self._fitting(products)
        if products.means_dn.size != self.n_frames:
            raise InputError("frame products of another stack", value=products.means_dn.size, allowed=f"{self.n_frames} frames")
        return self.vector + deviations(products, self.shape, self.gains if self.high_passed else None, n, rng)
