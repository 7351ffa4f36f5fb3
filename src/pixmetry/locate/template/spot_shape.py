"""How far a Gaussian template misplaces a sharp point whose image is not Gaussian: the disc of a lens that diffracts.

A point that is unresolved by the pixels shows too little of its shape for the residuals to say that it is not a Gaussian. Its place then
depends on where in the pixel it lies. The error is that of the template itself on noise-free images of Airy's disc.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np

FIRST_ZEROS_PX = (0.6, 0.9, 1.2, 1.6, 1.8)  # radii of the first dark ring
PHASES = 3  # a side
SAMPLES = 7  # of a pixel, a side
HALF_PX = 7


def shape_error_px(blur_px: np.ndarray) -> np.ndarray:
    """Standard deviation over the sub-pixel phase of the place of a point seen as Airy's disc, for fitted blurs; 0 for wide ones.

    Parameters
    ----------
    blur_px : ndarray, shape (n,)
        Standard deviation of the fitted Gaussian, without the pixel.
    """
    blur, error = _table()
    within = np.interp(np.nan_to_num(blur_px, nan=1.0), blur, np.log(error))
    return np.where(blur_px < blur[-1], np.exp(within), 0.0)


@lru_cache(1)
def _table() -> tuple[np.ndarray, np.ndarray]:
    """Median fitted blur and error over the phases, by first zero; ascending in the blur."""
    from scipy.optimize import least_squares
    from scipy.special import j1

    from pixmetry.locate.template._contour_template_kernels import SPOT
    from pixmetry.locate.template._template_kernels import mean_images

    side = 2 * HALF_PX + 1
    fine = (np.arange(SAMPLES) + 0.5) / SAMPLES - 0.5
    pixel = np.arange(side)[:, None] + fine
    phases = (np.arange(PHASES) + 0.5) / PHASES - 0.5

    def drawn(p: np.ndarray) -> np.ndarray:
        return mean_images(SPOT, np.concatenate([p, np.zeros(4)]), side, side, 1.0, False)[: len(p) + 1, :, :side]

    rows = []
    for zero in FIRST_ZEROS_PX:
        blurs, errors = [], []
        for x in phases:
            for y in phases[phases >= x - 1e-9]:  # x and y are alike
                v, u = (pixel - HALF_PX - y)[:, :, None, None], (pixel - HALF_PX - x)[None, None]
                rho = np.maximum(np.hypot(u, v) * 3.8317 / zero, 1e-9)
                image = ((2 * j1(rho) / rho) ** 2).mean(axis=(1, 3))

                def left(p: np.ndarray, image: np.ndarray = image) -> np.ndarray:
                    return (drawn(p)[0] - image).ravel()

                def slopes(p: np.ndarray) -> np.ndarray:
                    return drawn(p)[1:].reshape(len(p), -1).T

                start = [HALF_PX + x, HALF_PX + y, max(0.34 * zero, 0.2), 1.0, 0.0]
                fit = least_squares(left, start, slopes, bounds=([0, 0, 0.1, 0, -1], [side, side, 2, 50, 1])).x
                blurs.append(fit[2])
                errors += [fit[0] - HALF_PX - x, fit[1] - HALF_PX - y]
        rows.append((float(np.median(blurs)), float(np.sqrt(np.mean(np.square(errors))))))
    blur, error = np.array(sorted(rows)).T
    return blur, np.maximum.accumulate(error[::-1])[::-1]  # at one blur between, errors happen to cancel
