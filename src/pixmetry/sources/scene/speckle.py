"""Laser speckle: coherent light of a rough surface is granular, and the grains move the centre of a spot."""

from __future__ import annotations

import numpy as np

from pixmetry.camera.contribution import Contribution, Probe
from pixmetry.camera.signal import Kind
from pixmetry.camera.source import Parameters, Source, quantity


class Speckle(Parameters):
    """The light, and the pupil that sets the size of the grains."""

    contrast_rel: float = quantity(0.0, "1", "standard deviation over mean of the light, before pixels average it", ge=0, le=1)
    wavelength_nm: float = quantity(633.0, "nm", "of the laser", ge=200, le=2000)
    f_number: float = quantity(8.0, "1", "working f-number of the lens", ge=0.5, le=256)
    pitch_um: float = quantity(8.6, "µm", "pixel pitch", gt=0, le=100)

    @property
    def lambda_n_px(self) -> float:
        """Wavelength times f-number in pixels: the period of the finest detail."""
        return 1e-3 * self.wavelength_nm * self.f_number / self.pitch_um


def correlation(shift_px: np.ndarray, lambda_n_px: float) -> np.ndarray:
    """Normalised covariance of the intensity at two places so far apart: (2 J₁(πr/λN)/(πr/λN))² of a round pupil."""
    from scipy.special import j1

    v = np.pi * np.asarray(shift_px, float) / lambda_n_px
    safe = np.where(v > 1e-6, v, 1.0)
    return np.asarray(np.where(v > 1e-6, (2 * j1(safe) / safe) ** 2, 1.0))


REACH, FINE = 12.0, 8  # pixels to which the covariance is summed, at least; nodes along a pixel for its average


def pixel_covariance(lambda_n_px: float, reach_px: int) -> np.ndarray:
    """Covariance of the light of two pixels that lie up to ``reach_px`` apart in x and y, shape (2 reach + 1,) * 2, for contrast 1.

    The covariance at points, averaged over both pixels: the average over a square is one over the triangle of their separations.
    """
    # the separation of two points of two unit squares has a triangular density about that of the squares
    nodes, weights = np.polynomial.legendre.leggauss(FINE)
    part = np.concatenate([0.5 * nodes - 0.5, 0.5 * nodes + 0.5])
    weight = np.concatenate([0.5 * weights, 0.5 * weights]) * (1 - np.abs(part))
    steps = np.arange(-reach_px, reach_px + 1.0)
    at = (steps[:, None] + part).ravel()
    values = correlation(np.hypot(at[:, None], at), lambda_n_px).reshape(len(steps), len(part), len(steps), len(part))
    return np.einsum("ipjq,p,q->ij", values, weight, weight)


def propagate(params: Speckle, probe: Probe) -> Contribution:
    """Variance gᵀ C g of an estimator with the gradient g, for light with the covariance C of speckle times the light of both pixels."""
    from scipy.signal import fftconvolve

    reach = int(np.ceil(max(REACH, 4 * params.lambda_n_px)))
    covariance = params.contrast_rel**2 * pixel_covariance(params.lambda_n_px, reach)
    u = []
    for gradient in (probe.gx, probe.gy):
        moved = gradient * np.maximum(probe.signal_dn - probe.background_dn, 0.0)  # the spot is the laser's; the background is not
        spread = fftconvolve(moved, covariance[None], mode="same", axes=(1, 2))
        u.append(float(np.sqrt(max(float((moved * spread).sum(axis=(1, 2)).mean()), 0.0))))
    # first order in the contrast: grains as large as the spot leave it nothing of its shape
    return probe.contribution((u[0], u[1]), "O", model_error=0.25, method="covariance of the light of pixels, and the estimator's gradient")


SOURCE = Source(
    id="scene.speckle",
    title="Laser speckle",
    description="A laser spot on a rough surface is granular. The centre of its light is off that of the beam, and jumps when it moves.",
    number=39,
    stars=4,
    note="Note 3",
    parameters=Speckle,
    consumes=(Kind.LIGHT,),
    neutral=Speckle(),
    typical=Speckle(contrast_rel=0.5),
    bound=Speckle(contrast_rel=1.0, f_number=16.0),
    propagate=propagate,
    option="laser light",
    gum_class="O",
    equation="σ = C λN/π for a uniform disc, C λN/(√2 π) for a Gaussian spot;  u² = gᵀ C g, C_ij = c² I_i I_j (2 J₁(v)/v)², v = π r/λN",
    typical_size="0.2 px of 8.6 µm at f/8 and 0.67 µm; it grows with the f-number",
    references=(
        "R. G. Dorsch, G. Häusler, J. M. Herrmann, Laser triangulation: fundamental uncertainty in distance measurement, "
        "Appl. Opt. 33 (1994) 1306",
        "J. W. Goodman, Speckle Phenomena in Optics, 2nd ed., SPIE 2020, ch. 3 and 4",
    ),
    advice="Open the lens, take light of low coherence, move the surface or a diffuser, and average frames with different speckle.",
    reasons={
        "forward": "it belongs to the scene: a `spot` in a scene file is a laser spot with speckle",
        "measure": "needs frames of a fixed spot on a surface that is moved between them: the scatter of its centre",
        "correct": "the grains cannot be told from the spot; frames with different speckle can be averaged",
    },
)
