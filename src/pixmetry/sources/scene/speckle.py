"""Laser speckle: coherent light of a rough surface is granular, and the grains move the centre of a spot."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from pixmetry.camera.contribution import Contribution, Probe
from pixmetry.camera.observations import Observations, of_pictures
from pixmetry.camera.signal import Kind
from pixmetry.camera.source import Parameters, Source, quantity
from pixmetry.camera.speckle import pixel_covariance
from pixmetry.core.errors import MeasureError
from pixmetry.core.number import Estimates


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


LARGEST_U = 4.0  # by which the contrast of light that has 1, the most there is, may come out larger
REACH = 12.0  # pixels to which the covariance is summed, at least


def measure(observations: Observations) -> Estimates:
    """Contrast of the light and f-number of the pupil, from frames of a spot on a surface that was moved between them."""
    found = observations.speckle
    names = {"contrast_rel": "contrast_rel", "f_number": "airy_px"}
    fit = of_pictures(
        None if found is None else found.fit, names, where="scene.speckle", pictures="a laser spot on a moved surface", kind="speckle"
    )
    if "contrast_rel" in fit and fit["contrast_rel"].value >= 1 + LARGEST_U * fit["contrast_rel"].u:
        bent = f"the light seems to have a contrast of {fit['contrast_rel'].value:.2f}, and that of a laser has at most 1"
        remedy = "take frames with a straight response (gamma 1), without sharpening, and with a surface that moves as a whole"
        raise MeasureError(bent, where="scene.speckle", remedy=remedy)
    if "contrast_rel" in fit and fit["contrast_rel"].value > 1:
        values = fit.values.copy()
        values[fit.index("contrast_rel")] = 1.0
        fit = replace(fit, values=values)
    stated, usual = observations.stated, Speckle()
    if found is None or "contrast_rel" not in fit or fit.limits:
        return fit
    if "f_number" not in fit:  # grains smaller than a pixel: with what is stated, or a limit of the contrast
        rows = [("f_number", stated.f_number, "1"), ("wavelength_nm", found.wavelength_nm, "nm"), ("pitch_um", stated.pitch_x_um, "µm")]
        return fit.join(Estimates.from_rows([(name, value, 0.0, np.inf, unit) for name, value, unit in rows if value is not None]))
    wavelength_nm, pitch_um = found.wavelength_nm or usual.wavelength_nm, stated.pitch_x_um or usual.pitch_um
    unknown = " and ".join(n for n, v in (("wavelength", found.wavelength_nm), ("pitch", stated.pitch_x_um)) if v is None)
    known = Estimates.from_rows([("wavelength_nm", wavelength_nm, 0.0, np.inf, "nm"), ("pitch_um", pitch_um, 0.0, np.inf, "µm")])
    lens = fit.scaled({"f_number": (1e3 * pitch_um / wavelength_nm, "1")})
    told = "the grains tell its product with the wavelength over the pitch"
    with_u = f": {wavelength_nm:g} nm and {pitch_um:g} µm are assumed ({unknown} not stated)" if unknown else ""
    return replace(lens.join(known), reasons={**lens.reasons, "f_number": told + with_u}, confounders=fit.confounders)


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
    measure=measure,
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
        "correct": "the same values come from another spot with other grains: what is grain and what is spot is not in the frame. Frames "
        "with different speckle can be averaged",
    },
)
