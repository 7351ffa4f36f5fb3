"""Phase pattern: interference of a fixed frequency that lies over the frame as a wave, standing or moving."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from pixmetry.camera.contribution import Contribution, Probe
from pixmetry.camera.observations import Observations, PatternList
from pixmetry.camera.signal import Kind, Signal
from pixmetry.camera.source import Parameters, Source, quantity
from pixmetry.camera.waves import shift_per_dn, wave, without_wave
from pixmetry.core.errors import MeasureError
from pixmetry.core.number import Estimates
from pixmetry.core.random import Stream

LARGEST_REL = 3.0  # amplitude in a frame over the measured one, up to which it is the same wave


class PhasePattern(Parameters):
    """One wave over the frame."""

    amplitude_dn: float = quantity(0.0, "DN", "amplitude of the wave", ge=0, le=1e3)
    frequency_x: float = quantity(0.11, "1/px", "cycles per pixel along the row", ge=0, le=0.5)
    frequency_y: float = quantity(0.07, "1/px", "cycles per pixel down the column", ge=-0.5, le=0.5)
    moving: bool = quantity(True, "1", "whether the phase is new in every frame, or fixed in the camera")
    turns_per_frame: float = quantity(0.0, "1", "steady advance of a fixed phase from frame to frame, in turns", ge=-0.5, le=0.5)


def forward(params: PhasePattern, signal: Signal, stream: Stream) -> Signal:
    """Add A sin(2π(ν_x c + ν_y r + φ)) with the phase φ of the frame; of a measured unit, one that stands still has its ``phase_turns``."""
    if params.amplitude_dn == 0 or (params.moving and stream.quiet):  # over the phases of all frames the mean is 0
        return signal
    if params.moving:
        phase = stream.uniform_frames(signal.grid)
    else:
        known = stream.known_unit("phase_turns")
        phase = (stream.uniform_unit(1) if known is None else known) + params.turns_per_frame * signal.grid.frame % 1
    added = wave(signal, params.frequency_x, params.frequency_y, phase)
    added *= np.float32(params.amplitude_dn)
    return signal.with_data(np.add(signal.data, added, out=added))


def measure(observations: Observations) -> Estimates:
    """Read the strongest line of the two-dimensional periodogram of the dark frames; if there is none, a limit of its amplitude."""
    found = observations.patterns
    if found is None:
        raise MeasureError("phase patterns need dark frames", where="grabber.phase_pattern", remedy="take a stack of at least 16")
    if len(found) == 0:
        return _limit(found)
    # the power of a moving wave is the mean over a few pairs of frames, and its u comes from their number (JCGM 100, 4.2)
    spectra = observations.dark_spectra
    dof = max(spectra.n_pairs - 1.0, 1.0) if found.moving[0] and spectra is not None else math.inf
    rows = [
        ("amplitude_dn", found.amplitude_dn[0], found.u_amplitude_dn[0], dof, "DN"),
        ("frequency_x", found.frequency_x[0], found.u_frequency_x[0], math.inf, "1/px"),
        ("frequency_y", found.frequency_y[0], found.u_frequency_y[0], math.inf, "1/px"),
        ("moving", float(found.moving[0]), 0.0, math.inf, "1"),
    ]
    return Estimates.from_rows(
        rows, method="strongest line of the two-dimensional periodogram", confounders=("a periodic pattern of the sensor or of the light",)
    )


def _limit(found: PatternList) -> Estimates:
    """One-sided 95 % limit: the amplitude A found in half of all cases plus 1.645 u, with u = A/√(2z) at a threshold of z mean powers."""
    half = np.nanmax([found.fixed_limit_dn, found.moving_limit_dn])
    u = float(half / math.sqrt(2 * math.log(max(found.n_searched, 1) / found.false_alarm_rate)))
    worst: Any = SOURCE.bound  # the frequency of a wave that was not found is not known
    return Estimates.from_rows(
        [
            ("amplitude_dn", float(half) + 1.645 * u, u, math.inf, "DN"),
            ("frequency_x", worst.frequency_x, 0.0, math.inf, "1/px"),
            ("frequency_y", worst.frequency_y, 0.0, math.inf, "1/px"),
        ],
        method="search of the two-dimensional periodogram",
        limits=frozenset({"amplitude_dn"}),
        reasons={"amplitude_dn": "no line of the spectrum is significant against the noise"},
    )


def correct(params: PhasePattern, signal: Signal, maps: Mapping[str, np.ndarray]) -> Signal:
    """Fit amplitude and phase of the wave to the background of every frame, beside uneven light, and subtract what is significant of it.

    A fitted amplitude of more than `LARGEST_REL` times the measured one is the scene's own structure, and stays.
    """
    if params.amplitude_dn == 0:
        return signal
    data = without_wave(signal, params.frequency_x, params.frequency_y, LARGEST_REL * params.amplitude_dn)
    return signal if data is None else signal.with_data(data)


def propagate(params: PhasePattern, probe: Probe) -> Contribution:
    """Propagator P2 for a wave, averaged over its phase."""
    ux, uy = (params.amplitude_dn * u for u in shift_per_dn(probe, params.frequency_x, params.frequency_y))
    return probe.contribution(
        (ux, uy), "T" if params.moving else "F", model_error=0.12, method="response of the estimator to a wave of any phase"
    )


SOURCE = Source(
    id="grabber.phase_pattern",
    title="Phase pattern",
    description="Interference from a clock or a supply beats with the sampling. It appears as a wave over the frame, standing or moving.",
    number=34,
    stars=1,
    parameters=PhasePattern,
    consumes=(Kind.DN,),
    after=("sensor", "electronics", "cable"),
    before=("grabber.adc", "processing"),
    neutral=PhasePattern(),
    typical=PhasePattern(amplitude_dn=0.5),
    bound=PhasePattern(amplitude_dn=1.0, frequency_x=0.05, frequency_y=0.05),
    maps={"phase_turns": ("frequency_x", "frequency_y", "moving")},
    forward=forward,
    measure=measure,
    correct=correct,
    propagate=propagate,
    gum_class="T",
    equation="y' = y + A sin(2π(ν_x c + ν_y r) + φ_frame)",
    typical_size="0.04 px per DN at 0.05 cycles per pixel, 0.002 px at 0.42, on a disc of 7 px of 150 DN (centroid, window radius 6)",
    references=("EMVA 1288 R4.0 Linear, §8.4 (spectrograms)", "A. Schuster, Terr. Magn. 3, 1898, 13 (periodogram)"),
    leaves="what is below the noise of the background, and the same wave in the scene itself",
    advice="Find the source by its frequency and shield it, synchronise the clocks, or fit and subtract the wave in every frame.",
)
