"""The slow bend of a converter that a polynomial response does not follow: from the means and variances of the levels."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np

from pixmetry.camera.observations import Observations
from pixmetry.core.arrays import Array
from pixmetry.observe.linearity import COEFFICIENTS, Linearity
from pixmetry.observe.photon_transfer_model import transfer

AMPLITUDES_DN = (0.0, 0.05, 0.1, 0.2, 0.4, 0.8, 1.6, 3.2)
LENGTHS_REL = (1 / 32, 1 / 16, 1 / 8, 1 / 4)  # of the range
SCATTERS_REL = (0.0, 0.003, 0.006, 0.012)  # of the variances, from level to level, beyond sampling
CLEAR_SIGMAS = 4.5  # from a level's mean to the ends of the range
COMMON_REL, COMMON_DN = 0.01, 2.0  # of the light of all levels: its scale, and what longer exposures than stated add to all
NEEDED_LOG = 5.0  # by which the logarithm of the likelihood must rise: two numbers more do that by chance once in 150
FEWEST_LEVELS = 8


@dataclass(frozen=True)
class ConverterBend:
    """Displacement d of the thresholds at every code, LSB, shape (2^bits,), and its slope; a code is then x − d(x).

    ``amplitude_dn`` is the standard deviation of d that the levels speak for; 0 where they need none.
    """

    displacement_lsb: np.ndarray
    slope: np.ndarray
    amplitude_dn: float

    def gain_at(self, stored_dn: float) -> float:
        """Steps of the output for one of the input: 1 − d'."""
        return 1.0 - float(np.interp(stored_dn, np.arange(self.slope.size), self.slope))


def converter_bend(seen: Observations, bits: int) -> ConverterBend:
    """Find the bend that means and variances of an exposure series show beyond the fitted response.

    Parameters
    ----------
    seen : Observations
        With the photon-transfer series and its fit.
    bits : int

    Notes
    -----
    A mean of a level tells −d at its place, as well as the light is known, and a variance tells −2 d', as it is multiplied by the square
    of the local slope. d is taken as a Gaussian process of mean 0 and covariance A² exp(−(y − y')²/2 l²); the covariances of its values and
    slopes are derivatives of that (Rasmussen and Williams, Gaussian Processes for Machine Learning, MIT Press 2006, 2.2 and 9.4). A, l and
    the scatter of the variances beyond sampling are those of the greatest likelihood of a grid; A = 0 is among them. The stack of bright
    frames has no such scatter: what it says of its own place holds.
    """
    top = 2**bits - 1
    nothing = ConverterBend(np.zeros(top + 1), np.zeros(top + 1), 0.0)
    data = _data(seen, bits)
    if data is None:
        return nothing
    place, is_slope, value, var, scatters = data
    best, without = None, -np.inf
    for amplitude, length, scatter in itertools.product(AMPLITUDES_DN, np.array(LENGTHS_REL) * top, SCATTERS_REL):
        noise = var + np.diag(scatters * (0.5 * scatter) ** 2)
        covariance = amplitude**2 * _kernel(place, place, is_slope, is_slope, length) + noise
        lower = np.linalg.cholesky(covariance + 1e-12 * np.diag(np.diag(covariance)))
        white = np.linalg.solve(lower, value)
        likelihood = -0.5 * float(white @ white) - float(np.log(np.diag(lower)).sum())
        without = max(without, likelihood) if amplitude == 0 else without
        if best is None or likelihood > best[0]:
            best = (likelihood, amplitude, length, np.linalg.solve(lower.T, white))
    if best is None or best[0] < without + NEEDED_LOG:
        return nothing
    _, amplitude, length, weights = best
    codes = np.arange(top + 1.0)
    value, steep = np.zeros(codes.size, bool), np.ones(codes.size, bool)
    displacement, slope = (amplitude**2 * _kernel(codes, place, of, is_slope, length) @ weights for of in (value, steep))
    return ConverterBend(displacement, slope, float(amplitude))


def _kernel(one: np.ndarray, other: np.ndarray, slope_one: np.ndarray, slope_other: np.ndarray, length: float) -> np.ndarray:
    """Covariances of values and slopes of a process with the covariance exp(−t²/2l²) of its values."""
    t = one[:, None] - other[None, :]
    k = np.exp(-0.5 * (t / length) ** 2)
    a, b = slope_one[:, None], slope_other[None, :]
    value_slope, slopes = k * t / length**2, k * (1 / length**2 - t**2 / length**4)
    kernel: Array = np.where(a & b, slopes, np.where(b, value_slope, np.where(a, -value_slope, k)))
    return kernel


def _data(seen: Observations, bits: int) -> tuple[np.ndarray, ...] | None:
    """Places, whether of slopes, values, their covariance, and which scatter beyond it; None if too little is known.

    The covariance holds sampling, the light, what all levels have in common of it, and the parameters of the fitted response.
    """
    fit, series, dark, stack = seen.photon_transfer_fit, seen.photon_transfer, seen.dark_stack, seen.bright_stack
    if fit is None or series is None or dark is None or stack is None:
        return None
    bright, top, pixels = series.bright, float(2**bits - 1), float(np.prod(series.frame_shape))
    sigma = np.sqrt(bright.var_total_dn2 + np.maximum(bright.spatial_cov_dn2, 0.0))
    ceiling = fit["saturation_dn"].value if "saturation_dn" in fit else top
    use = (bright.mean_dn + CLEAR_SIGMAS * sigma < ceiling) & (bright.mean_dn - CLEAR_SIGMAS * sigma > 0) & (bright.ms_pixel_dn2 > 1.0)
    response = "quantum_efficiency" if bright.photons is not None and "quantum_efficiency" in fit else "responsivity_dn_per_s"
    if use.sum() < FEWEST_LEVELS or response not in fit:
        return None
    names = [n for n in ("gain_dn_per_e", response, "offset_dn", *COEFFICIENTS, "dark_current_e_per_s") if n in fit and n not in fit.limits]
    fitted = fit.select(names)
    mean, n = bright.mean_dn[use], int(use.sum())
    places = np.concatenate([mean, [stack.mean_dn]])
    variances = np.concatenate([bright.ms_pixel_dn2[use], [stack.ms_pixel_dn2]])

    def values(parameters: np.ndarray) -> np.ndarray:
        """0 at black, −(mean less that of the model), and −(√(variance over that of the model) − 1), the stack's last."""
        p = dict(zip(names, parameters, strict=True))
        a = np.array([p.get(c, 0.0) for c in COEFFICIENTS])
        light = p["gain_dn_per_e"] * p[response] * bright.photons if response == "quantum_efficiency" else p[response] * bright.exposure_s
        light = light + p["gain_dn_per_e"] * p.get("dark_current_e_per_s", 0.0) * bright.exposure_s
        expected = p["offset_dn"] + transfer(light[use], a, top)[0]
        x = Linearity(p["offset_dn"], a, fitted.covariance, top).straight(places)
        steep, steep_dark = transfer(x, a, top)[1], transfer(np.zeros(1), a, top)[1]
        model = steep**2 * (p["gain_dn_per_e"] * x + (dark.ms_pixel_dn2 - 1 / 12) / steep_dark**2) + 1 / 12
        return np.concatenate([[p["offset_dn"] - fit["offset_dn"].value], expected - mean, 1 - np.sqrt(variances / model)])

    steps = np.diag(np.maximum(fitted.u, 1e-12))
    gradient = np.array([(values(fitted.values + h) - values(fitted.values - h)) / (2 * h.sum()) for h in steps])
    lamp = fit["illumination_noise_rel"].value if "illumination_noise_rel" in fit else 1e-3
    above = mean - fit["offset_dn"].value
    var_mean = (lamp * above) ** 2 + bright.var_total_dn2[use] / (pixels * bright.n_frames[use])
    var_levels = 2 / (pixels * (bright.n_frames[use] - 1)) / 4
    var_stack = 2 / (pixels * (stack.n_frames - 1)) / 4
    var = np.diag(np.concatenate([[1e-6], var_mean, var_levels, [var_stack]])) + gradient.T @ fitted.covariance @ gradient
    var[1 : n + 1, 1 : n + 1] += np.outer(above, above) * COMMON_REL**2 + COMMON_DN**2
    return (
        np.concatenate([[fit["offset_dn"].value], mean, places]),
        np.concatenate([np.zeros(1 + n, bool), np.ones(n + 1, bool)]),
        values(fitted.values),
        var,
        np.concatenate([np.zeros(1 + n), np.ones(n), [0.0]]),
    )
