"""Sampling: pixels see an image that is finer than they are, and the centre of what they hold swings with its place in the pixel."""

from __future__ import annotations

import numpy as np

from pixmetry.camera.contribution import Contribution, Probe
from pixmetry.camera.signal import Kind
from pixmetry.camera.source import Parameters, Source


class Sampling(Parameters):
    """It has no parameter: blur and aperture belong to lens and pixel."""


def propagate(params: Sampling, probe: Probe) -> Contribution:
    """Centroid of all light above the background, without a threshold, less the true place, at the probe's phases (propagator P4)."""
    above = probe.signal_dn - probe.background_dn
    total = above.sum(axis=(1, 2))
    x = above.sum(axis=1) @ np.arange(above.shape[2]) / total
    y = above.sum(axis=2) @ np.arange(above.shape[1]) / total
    method = "centroid of all of the light on noise-free targets at the probe's phases"
    return probe.from_shifts(x - probe.x_px, y - probe.y_px, "F", model_error=0.05, method=method)


SOURCE = Source(
    id="sensor.sampling",
    title="Sampling",
    description="What the lens shows finer than two pixels is aliased; the centre of the samples swings with the phase in the pixel.",
    note="Note 21",
    parameters=Sampling,
    consumes=(Kind.PHOTONS,),
    typical=Sampling(),
    bound=Sampling(),
    propagate=propagate,
    part_of="processing.threshold",
    gum_class="F",
    equation="e(c) = −2 Σ_k S_k sin(2πkc)/∫h,  S_k = ∫ x h(x) sin(2πkx) dx;  a₁ = |H'(1)|/(π H(0))",
    typical_size="0.08 px for a point at f/4 on pixels of 3.45 µm; 1e-5 px for a disc of 7 px with a blur of 0.7 px",
    references=(
        "B. F. Alexander, K. C. Ng, Elimination of systematic error in subpixel accuracy centroid estimation, Opt. Eng. 30 (1991) 1320",
    ),
    advice="Stop the lens down or defocus until a point is seen in two pixels or more; take larger targets.",
    reasons={
        "forward": "it is what pixels are: there is no camera without it",
        "measure": "it has no parameter of its own. The swing follows from the spread of lens and pixels, which slanted edges measure",
        "correct": "what lies between the samples is in no value of the frame. Fitting the right template has no swing, and that of a "
        "known target can be looked up by its phase",
        "neutral": "it has no parameters: nothing of it can be switched off",
    },
)
