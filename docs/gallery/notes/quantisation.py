"""Rows of a slightly tilted line, with and without rounding to 8 bits: the share of rounding in the error of a row."""

import math

import numpy as np

from pixmetry.report.drawing import BLUE, RED, canvas

ROWS, SIGMA_PX, PEAK_DN, BACKGROUND_DN, REACH = 5000, 0.9, 150.0, 10.0, 3  # pixels to either side that the centroid takes
NOISES_DN = (0.0, 0.3, 0.6, 0.9, 1.2, 1.5, 1.8)


def errors(noise_dn, rounded, rng):
    """Error of the centroid of each row; the line wanders through 40 pixels, light averaged over each pixel."""
    centre = np.linspace(-20, 20, ROWS)
    x = np.rint(centre)[:, None] + np.arange(-REACH, REACH + 1)
    at = (x - centre[:, None]) / SIGMA_PX / math.sqrt(2)
    half = 0.5 / SIGMA_PX / math.sqrt(2)
    erf = np.vectorize(math.erf)
    level = PEAK_DN * math.sqrt(math.pi / 2) * SIGMA_PX * (erf(at + half) - erf(at - half)) + BACKGROUND_DN
    level = level + noise_dn * rng.standard_normal(level.shape)
    grey = (np.rint(level) if rounded else level) - BACKGROUND_DN
    return (grey * x).sum(axis=1) / grey.sum(axis=1) - centre


def run():
    ideal = errors(0.0, False, np.random.default_rng(0))  # the foot beyond the window, the same in all
    total, plain = (np.array([(errors(n, r, np.random.default_rng(1)) - ideal).std() for n in NOISES_DN]) for r in (True, False))
    alone = total[0]
    share = alone / total[1:]
    at = {n: share[NOISES_DN.index(n) - 1] for n in (0.9, 1.5, 1.8)}
    values = {"alone": 1000 * alone, "share_09": at[0.9], "share_15": at[1.5], "share_18": at[1.8], "variance_09": 100 * at[0.9] ** 2,
              "total_09": 1000 * total[3], "plain_09": 1000 * plain[3], "fwhm": 2.355 * math.sqrt(SIGMA_PX**2 + 1 / 12),
              "u_share_09": at[0.9] / math.sqrt(ROWS)}  # fmt: skip
    with canvas(2.2) as (figure, axes):
        axes.plot(NOISES_DN, 1000 * total, "o-", color=RED, label="rounded to 8 bits")
        axes.plot(NOISES_DN, 1000 * plain, "s--", color=BLUE, label="not rounded")
        axes.set(xlabel="noise / grey values", ylabel="error of a row / 0.001 px", xlim=(0, 1.9), ylim=(0, None))
        axes.legend()
    return values, {"quantisation": figure}
