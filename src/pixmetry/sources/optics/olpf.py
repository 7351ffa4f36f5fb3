"""Optical low-pass filter (diffuser) before the sensor: each image point is spread into a few, or frosted into a round spot."""

from __future__ import annotations

from typing import Literal

import numpy as np

from pixmetry.camera.observations import Observations
from pixmetry.camera.signal import Kind, Signal
from pixmetry.camera.source import Parameters, Source, quantity
from pixmetry.core.number import Estimates
from pixmetry.core.random import Stream


class OpticalLowPass(Parameters):
    """Birefringent plates, which split a point by a distance along x and along y, or a frosted plate.

    A plate of thickness t, cut at 45°, splits by t (n_e² − n_o²)/(n_e² + n_o²): quartz by 0.0059 t.
    """

    model: Literal["birefringent", "frosted"] = quantity("birefringent", "name", "two or four points, or a round Gaussian spot")
    separation_x_px: float = quantity(0.0, "px", "distance of the two images along x (birefringent)", ge=0, le=10)
    separation_y_px: float = quantity(0.0, "px", "distance of the two images along y (birefringent)", ge=0, le=10)
    sigma_px: float = quantity(0.0, "px", "standard deviation of the spot along each axis (frosted)", ge=0, le=10)


def dots(params: OpticalLowPass) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Places of the images about the point and their weights: 1, 2 or 4 of them."""
    x, y = (np.array([-0.5, 0.5]) * d if d else np.zeros(1) for d in (params.separation_x_px, params.separation_y_px))
    dy, dx = (v.ravel() for v in np.meshgrid(y, x, indexing="ij"))
    return dx, dy, np.full(dx.size, 1 / dx.size)


def forward(params: OpticalLowPass, signal: Signal, stream: Stream) -> Signal:
    """Spread the light."""
    if params.model == "frosted":
        return signal.with_light(signal.own_light.blurred(params.sigma_px**2)) if params.sigma_px else signal
    if not (params.separation_x_px or params.separation_y_px):
        return signal
    return signal.with_light(signal.own_light.spread(*dots(params)))


def measure(observations: Observations) -> Estimates:
    """Distances of the images of a birefringent plate, from slanted edges; upper limits where they do not need one."""
    names = ("separation_x_px", "separation_y_px")
    return observations.edge_optics({name: name for name in names}, where="optics.olpf")


SOURCE = Source(
    id="optics.olpf",
    title="Optical low-pass filter (diffuser)",
    description="A plate in front of the sensor spreads each image point over about one pixel, so that finer details cause no aliasing.",
    number=1,
    parameters=OpticalLowPass,
    consumes=(Kind.LIGHT,),
    before=("sensor",),
    neutral=OpticalLowPass(),
    typical=OpticalLowPass(separation_x_px=1.0, separation_y_px=1.0),
    bound=OpticalLowPass(separation_x_px=1.5, separation_y_px=1.5),
    forward=forward,
    measure=measure,
    gum_class="F",
    equation="PSF = ¼ Σ δ(x ± d_x/2, y ± d_y/2),  MTF = |cos(π d_x ν_x) cos(π d_y ν_y)|,  d = t (n_e² − n_o²)/(n_e² + n_o²)",
    typical_size="none by itself (symmetric); adds d²/4 px² to the variance of the spread and removes the error of an undersampled target",
    references=("J. E. Greivenkamp, Color dependent optical prefilter, Applied Optics 29 (1990) 676–684", "ISO 12233:2023 (SFR)"),
    advice="If targets are sharper than about 0.5 px and less than 3 px wide: add such a filter, defocus slightly, or stop down.",
    reasons={
        "correct": "it spreads light alike to both sides, which moves no centre. What it takes from the highest frequencies is below the "
        "noise, and a deconvolution would amplify that",
        "propagate": "it only changes the undersampling; that needs the spread in front of the plate, which the probe does not contain",
    },
)
