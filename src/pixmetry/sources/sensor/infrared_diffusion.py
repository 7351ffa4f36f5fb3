"""Diffusion of charge in silicon: red and infrared light is absorbed so deep that its charge wanders into neighbouring pixels."""

from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache

import numpy as np
from scipy.integrate import cumulative_trapezoid
from scipy.special import k1

from pixmetry.camera.geometry import corner_px, frame_centre, image_shift
from pixmetry.camera.light import Pull
from pixmetry.camera.observations import Observations, of_pictures
from pixmetry.camera.raster import spread_of
from pixmetry.camera.signal import Kind, Signal
from pixmetry.camera.silicon import absorption_per_um, refractive_index
from pixmetry.camera.source import Parameters, Source, quantity
from pixmetry.core.arrays import Array
from pixmetry.core.number import Estimates
from pixmetry.core.random import Stream


class InfraredDiffusion(Parameters):
    """Light of one wavelength in a sensor lit from the front: a depleted layer, below it silicon without a field."""

    wavelength_nm: float = quantity(850.0, "nm", "of the light", ge=300, le=1100)
    depletion_um: float = quantity(3.0, "µm", "depth above which all charge is collected in its own pixel", ge=0, le=100)
    diffusion_length_um: float = quantity(0.0, "µm", "diffusion length below that depth; 0: charge from below is lost", ge=0, le=500)
    chief_ray_deg: float = quantity(0.0, "deg", "angle of the chief ray in the frame's corners; 0: telecentric", ge=0, le=60)
    pitch_x_um: float = quantity(8.6, "µm", "pixel pitch along x", gt=0, le=100)
    pitch_y_um: float = quantity(8.3, "µm", "pixel pitch along y", gt=0, le=100)
    reach_px: float = quantity(4.0, "px", "half the side of the fine table of the spread; wide Gaussians continue its tail", ge=1, le=12)


def transfer(params: InfraredDiffusion, fx: np.ndarray, fy: np.ndarray) -> np.ndarray:
    """Transfer function of the collected charge at frequencies in cycles per pixel, 1 at 0.

    Charge from depth z below the depleted layer reaches it with exp(−z/L_k) of the modulation, 1/L_k² = 1/L² + (2πk)²; integrated
    over the absorption α exp(−α z): η(k) = 1 − exp(−α w)/(1 + α L_k) (Crowell & Labuda 1969; Seib 1974).
    """
    alpha, length = absorption_per_um(params.wavelength_nm), params.diffusion_length_um
    k2 = (fx / params.pitch_x_um) ** 2 + (fy / params.pitch_y_um) ** 2
    reach = length / np.sqrt(1 + (2 * np.pi * length) ** 2 * k2)
    below = np.exp(-alpha * params.depletion_um)
    return (1 - below / (1 + alpha * reach)) / (1 - below / (1 + alpha * length))


def mean_depth_um(params: InfraredDiffusion) -> float:
    """Mean depth at which the collected charge was set free."""
    a, w, length = float(absorption_per_um(params.wavelength_nm)), params.depletion_um, params.diffusion_length_um
    below = np.exp(-a * w)
    share = length / (1 + a * length)  # ∫ exp(−z/L − α z) dz below the depleted layer
    moment = (1 - (1 + a * w) * below) / a + a * below * share * (w + share)
    return float(moment / (1 - below + a * below * share)) if moment else 0.0


def pull_of(params: InfraredDiffusion, frame_shape: tuple[int, int]) -> Pull:
    """The map from the place of the charge to the place of the light on the surface: the refracted chief ray leads outwards."""
    x0, y0 = frame_centre(frame_shape)
    px, py = params.pitch_x_um, params.pitch_y_um
    slope = np.tan(np.radians(params.chief_ray_deg)) / (corner_px(frame_shape, py / px) * px)
    n2, depth = refractive_index(params.wavelength_nm) ** 2, mean_depth_um(params)

    def pull(x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        t2 = slope**2 * (((x - x0) * px) ** 2 + ((y - y0) * py) ** 2)
        inward = depth * slope / np.sqrt(n2 + (n2 - 1) * t2)  # tan in silicon over tan in air, by the law of refraction
        return x - inward * (x - x0), y - inward * (y - y0)

    return pull


def light_beyond(params: InfraredDiffusion, d_um: np.ndarray) -> np.ndarray:
    """Share of an edge's charge that is collected farther than d on its dark side.

    From a line at depth z it comes with z/(π L ρ) K1(ρ/L), ρ² = x² + z², whose transfer function is the e^(−z/L_k) of `transfer`. Summed
    over x beyond d and over the absorption below the depleted layer.
    """
    alpha, length = float(absorption_per_um(params.wavelength_nm)), params.diffusion_length_um
    below = np.exp(-alpha * params.depletion_um)
    d = np.asarray(d_um, float)
    z = np.geomspace(1e-3, 40.0, 300) / (alpha + 1 / length)
    x = np.geomspace(d.min(), d.max() + 40 * length, 600)
    rho = np.hypot(x[:, None], z)
    density = np.trapezoid(z / (np.pi * length * rho) * k1(rho / length) * np.exp(-alpha * z), z, axis=1)
    seen = cumulative_trapezoid(density[::-1], -x[::-1], initial=0.0)[::-1]
    light: Array = alpha * below * np.interp(np.log(d), np.log(x), seen) / (1 - below / (1 + alpha * length))
    return light


@lru_cache(maxsize=32)
def kernel(params: InfraredDiffusion) -> tuple[np.ndarray, np.ndarray | None]:
    """The spread on the light's fine raster and its tail, see `camera.raster`."""
    pitch = params.pitch_x_um, params.pitch_y_um
    return spread_of(lambda fx, fy: transfer(params, fx, fy), params.reach_px, lambda d: light_beyond(params, d), pitch)


def forward(params: InfraredDiffusion, signal: Signal, stream: Stream) -> Signal:
    """Spread the light as the charge spreads, and move it along the slanting ray."""
    light = signal.own_light
    if params.diffusion_length_um:
        light = light.convolved(*kernel(params))
    if params.chief_ray_deg:
        light = light.moved(pull_of(params, signal.frame_shape))
    return signal.with_light(light)


def truth(params: InfraredDiffusion, signal: Signal, stream: Stream) -> Mapping[str, np.ndarray]:
    """Displacement of the image at every pixel, shape (rows, cols)."""
    return {name: shift[0] for name, shift in image_shift(pull_of(params, signal.frame_shape), signal).items()}


def measure(observations: Observations) -> Estimates:
    """Diffusion length, or its limit, from the blur of targets in infrared light against that in visible light.

    The wavelength is that of the campaign's light, where it is stated: the length is the sensor's at all wavelengths.
    """
    bands, failed = observations.bands, observations.failed.get("bands", "")
    fit = of_pictures(
        None if bands is None else bands.diffusion,
        {"diffusion_length_um": "diffusion_length_um"},
        where="sensor.infrared_diffusion",
        pictures="targets in visible and in infrared light",
        kind="bands",
        failed=failed,
    )
    stated = observations.stated
    assert bands is not None and stated.pitch_x_um is not None
    light_nm = stated.wavelength_nm if stated.wavelength_nm is not None and 300 <= stated.wavelength_nm <= 1100 else bands.long_nm
    known = [("wavelength_nm", light_nm, "nm"), ("pitch_x_um", stated.pitch_x_um, "µm")]
    known.append(("pitch_y_um", stated.pitch_y_um or stated.pitch_x_um, "µm"))
    return fit.join(Estimates.from_rows([(name, value, 0.0, np.inf, unit) for name, value, unit in known]))


SOURCE = Source(
    id="sensor.infrared_diffusion",
    title="Infrared light and charge diffusion",
    description="Light that is absorbed deep in the silicon generates charge that diffuses sideways and blurs the image. Oblique rays "
    "also shift it outwards.",
    note="Note 14",
    parameters=InfraredDiffusion,
    consumes=(Kind.LIGHT,),
    neutral=InfraredDiffusion(),
    typical=InfraredDiffusion(diffusion_length_um=10.0, chief_ray_deg=5.0),
    bound=InfraredDiffusion(wavelength_nm=940.0, diffusion_length_um=30.0, chief_ray_deg=15.0),
    forward=forward,
    truth=truth,
    measure=measure,
    gum_class="G",
    equation="η(k) = 1 − exp(−α w)/(1 + α L_k),  1/L_k² = 1/L² + (2πk)²;  Δr = ⟨z⟩ tan θ',  sin θ' = sin θ/n",
    typical_size="0.03 px outwards in the corners for 10 µm of depth under 5° in air (8.6 µm pixels)",
    references=(
        "D. H. Seib, Carrier diffusion degradation of MTF in charge coupled imagers, IEEE Trans. ED-21 (1974) 210–217",
        "C. R. Crowell, E. F. Labuda, The silicon diode array camera tube, BSTJ 48 (1969) 1481–1528",
        "M. A. Green, Solar Energy Mat. & Solar Cells 92 (2008) 1305–1310",
    ),
    advice="Put an infrared-cut filter in front of the sensor, or use light below 650 nm.",
    reasons={
        "correct": "it spreads charge alike to all sides, which moves no centre, and a deconvolution would amplify the noise. Its "
        "outward shift is part of the calibrated distortion",
        "propagate": "it changes the sampling of the target; that needs the target before the spread, which the probe does not contain",
    },
)
