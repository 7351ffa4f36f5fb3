"""Analogue-to-digital conversion: black level, rounding to whole codes, and steps that are not all of one width."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
from pydantic import field_validator

from pixmetry.camera.contribution import Contribution, Probe
from pixmetry.camera.observations import Observations
from pixmetry.camera.signal import Kind, Signal, Windows
from pixmetry.camera.source import Parameters, Source, quantity
from pixmetry.core.arrays import Array
from pixmetry.core.errors import InputError, MeasureError
from pixmetry.core.number import Estimates
from pixmetry.core.random import Stream
from pixmetry.sources.grabber._kernels import quantise_at, quantise_ideal


class Adc(Parameters):
    """The converter's black level, range, and departures from equal steps; one LSB is one DN."""

    bits: int = quantity(8, "bit", "the codes run from 0 to 2^bits − 1", ge=1, le=16)
    offset_dn: float = quantity(0.0, "DN", "black level: the value that is added to black", ge=-1e4, le=6e4)
    gain_error_rel: float = quantity(0.0, "1", "relative error of the slope about black", ge=-0.5, le=0.5)
    inl_amplitude_lsb: float = quantity(0.0, "LSB", "amplitude of a sinusoidal bend of the thresholds", ge=0, le=64)
    inl_cycles: float = quantity(1.0, "1", "periods of that bend over the range", ge=0, le=64)
    dnl_std_lsb: float = quantity(0.0, "LSB", "standard deviation of the code widths, fixed in the unit", ge=0, le=2)
    missing_every: int = quantity(0, "1", "period of missing codes: one code in this number of codes is missing; 0: none", ge=0, le=65536)
    hysteresis_lsb: float = quantity(
        0.0, "LSB", "by how much thresholds are higher for a rising signal than for a falling one", ge=0, le=16
    )
    aperture_jitter_rel: float = quantity(
        0.0,
        "1",
        "standard deviation of the sampling instant, divided by the sampling period; it acts on slopes along the row",
        ge=0,
        le=0.1,
    )
    offset_drift_dn_per_k: float = quantity(0.0, "DN/K", "change of the black level with temperature", ge=-10, le=10)
    gain_drift_per_k: float = quantity(0.0, "1/K", "relative change of the slope with temperature", ge=-0.01, le=0.01)
    reference_temperature_c: float = quantity(20.0, "°C", "temperature at which the stated offset and slope hold", ge=-60, le=100)

    @field_validator("missing_every")
    @classmethod
    def _not_all(cls, value: int) -> int:
        if value == 1:
            raise InputError("every code would be missing", value=value, allowed="0, or at least 2")
        return value

    @property
    def top(self) -> int:
        """The highest code."""
        return (1 << self.bits) - 1

    @property
    def equal_steps(self) -> bool:
        """Whether all thresholds are at k − 1/2."""
        return not (self.inl_amplitude_lsb or self.dnl_std_lsb or self.missing_every)


def bend(params: Adc, level_dn: np.ndarray) -> np.ndarray:
    """Integral non-linearity of the thresholds in LSB at a level in DN: A sin(2πm v/2^bits); a threshold that is late is positive."""
    bend_lsb: Array = params.inl_amplitude_lsb * np.sin(2 * np.pi * params.inl_cycles * np.asarray(level_dn, float) / 2**params.bits)
    return bend_lsb


def thresholds(params: Adc, stream: Stream) -> np.ndarray:
    """The levels T_1 … T_top in DN from which on a code is given, rising, float64.

    Each threshold is displaced by itself, with the standard deviation ``dnl_std_lsb``/√2: the code widths then scatter by
    ``dnl_std_lsb``, and the displacements do not add up along the range, whose slow bend is a parameter of its own. The two
    thresholds about a missing code meet at its centre. Of a measured unit the displacements are its own, ``threshold_lsb``, shape (top,).
    """
    k = np.arange(1, params.top + 1, dtype=float)
    level = k - 0.5 + bend(params, k)
    known = stream.known_unit("threshold_lsb")
    if known is not None:
        level += known
    elif params.dnl_std_lsb:
        level += params.dnl_std_lsb / math.sqrt(2) * stream.normal_unit(params.top)
    if params.missing_every:
        gone = np.arange(params.missing_every, params.top, params.missing_every)  # T_k is level[k − 1]
        level[gone - 1] = level[gone] = 0.5 * (level[gone - 1] + level[gone])
    return np.maximum.accumulate(level)


def context(params: Adc, windows: Windows, frame_shape: tuple[int, int]) -> Windows:
    """The sample before, if the thresholds depend on it; the neighbours that give the slope, if the moment of sampling jitters."""
    right = 1 if params.aperture_jitter_rel else 0
    return windows.expand(0, 0, 1, right, frame_shape) if params.hysteresis_lsb or right else windows


def forward(params: Adc, signal: Signal, stream: Stream) -> Signal:
    """Lift black to the offset and count the thresholds that are reached; with equal steps, floor(v + 1/2): halves go up."""
    data = np.ascontiguousarray(signal.data, np.float32)
    factor = 1.0 + params.gain_error_rel
    if params.aperture_jitter_rel:
        data = stream.add_normal(data, signal.grid, params.aperture_jitter_rel * np.abs(slope(data)))
    if params.hysteresis_lsb:
        rising = np.sign(np.diff(data, axis=2, prepend=np.float32(0)))
        data = (data - np.float32(0.5 * params.hysteresis_lsb / factor) * rising).astype(np.float32)
    if params.offset_drift_dn_per_k or params.gain_drift_per_k:
        data = _drifted(params, data, signal.temperature_c)
    if params.equal_steps and stream.known_unit("threshold_lsb") is None:
        codes = quantise_ideal(data, factor, params.offset_dn, float(params.top))
    else:
        codes = quantise_at(data, factor, params.offset_dn, thresholds(params, stream))
    return signal.with_data(codes, Kind.CODES)


def slope(data: np.ndarray) -> np.ndarray:
    """Slope along the row per sample, by central differences; shape and dtype of the data."""
    return np.gradient(data, axis=2) if data.shape[2] > 1 else np.zeros_like(data)


def _drifted(params: Adc, data: np.ndarray, temperature_c: np.ndarray) -> np.ndarray:
    """Equivalent data: at its reference temperature the converter gives the same codes for them as for the true data at theirs."""
    warmer = (temperature_c - params.reference_temperature_c)[:, None, None]
    added = params.offset_drift_dn_per_k * warmer / (1 + params.gain_error_rel)
    return data * (1 + params.gain_drift_per_k * warmer).astype(np.float32) + added.astype(np.float32)


def measure(observations: Observations) -> Estimates:
    """Read the black level of the photon-transfer fit and the scatter of the code widths of the histogram test, as far as there are."""
    fit, errors = observations.photon_transfer_fit, observations.code_errors
    parts = []
    if fit is not None and "offset_dn" in fit:
        parts.append(fit.select(["offset_dn"]))
    if errors is not None and "dnl_rms_lsb" in errors.fit:
        parts.append(errors.fit.select({"dnl_std_lsb": "dnl_rms_lsb"}))
    if not parts:
        raise MeasureError(
            "neither black level nor code widths were observed", where="grabber.adc", remedy="take dark frames and a sweep of light levels"
        )
    return parts[0].join(*parts[1:])


def correct(params: Adc, signal: Signal, maps: Mapping[str, np.ndarray]) -> Signal:
    """Return codes to DN above black: the offset and the error of the slope are taken out; the rounding stays."""
    data = (signal.data.astype(np.float32) - np.float32(params.offset_dn)) / np.float32(1 + params.gain_error_rel)
    return signal.with_data(data, Kind.DN)


def propagate(params: Adc, probe: Probe) -> Contribution:
    """Rounding and code widths as white noise (P1); bend, hysteresis and the ends of the range as the field that they add (P2).

    A threshold displaced by d adds d² to the mean square error of a signal that is spread evenly over its codes. Hence 1/12 for equal
    steps, dnl²/2 for displacements of variance dnl²/2, and two of (1/2)² for each missing code. A slope common to all codes moves no
    target, and the black level is known: that of the converter on top of what it gets, below whose code 0 a line that swings is cut off.
    """
    variance = 1 / 12 + params.dnl_std_lsb**2 / 2 + (0.5 / params.missing_every if params.missing_every else 0.0)
    black = params.offset_dn + (probe.pedestal_dn if math.isfinite(probe.pedestal_dn) else 0.0)
    level = probe.signal_dn * (1 + params.gain_error_rel) + black
    rising = np.sign(np.diff(probe.signal_dn, axis=2, prepend=probe.background_dn))
    stored = np.clip(level - bend(params, level) - 0.5 * params.hysteresis_lsb * rising, 0, params.top)
    dx, dy = probe.field((stored - level) / (1 + params.gain_error_rel))
    jitter = params.aperture_jitter_rel * slope(probe.signal_dn) * (1 + params.gain_error_rel)
    white = probe.white(np.sqrt(variance + jitter**2) / (1 + params.gain_error_rel))
    return Contribution(
        u_x_px=math.hypot(white[0], float(np.std(dx))),
        u_y_px=math.hypot(white[1], float(np.std(dy))),
        bias_x_px=float(np.mean(dx)),
        bias_y_px=float(np.mean(dy)),
        gum_class="F",
        model_error=0.25,
        floor_px=3e-4,
        method="white noise of 1/12 + DNL²/2 LSB², and the response of the estimator to the curvature and to the ends of the range",
    )


SOURCE = Source(
    id="grabber.adc",
    title="Analogue-to-digital conversion",
    description="The converter adds its black level, rounds to whole codes and clips. Its curve is not straight, and its steps differ "
    "in width.",
    number=28,
    stars=1,
    note="Note 18",
    parameters=Adc,
    consumes=(Kind.DN,),
    produces=Kind.CODES,
    after=("sensor", "electronics", "cable"),
    before=("storage.jpeg", "storage.video_codec", "processing"),
    typical=Adc(bits=8, offset_dn=5.0, dnl_std_lsb=0.2, inl_amplitude_lsb=0.3),
    bound=Adc(bits=8, offset_dn=16.0, dnl_std_lsb=0.5, inl_amplitude_lsb=1.0),
    maps={"threshold_lsb": ("dnl_std_lsb", "bits")},
    forward=forward,
    measure=measure,
    correct=correct,
    propagate=propagate,
    context=context,
    gum_class="F",
    equation="code = #{k : T_k ≤ (1 + g) y + b},  T_k = k − 1/2 + A sin(2πm k/2^bits) + (s_DNL/√2) n_k;  σ² = 1/12 + s_DNL²/2 + (j dy/dc)²",
    typical_size="0.003 px at 8 bit on a disc of 7 px of 150 DN (centroid)",
    references=("IEEE Std 1241-2010, §4 (code transition levels, DNL, INL)", "EMVA 1288 R4.0 Linear, §2.2 (σ_q² = 1/12)"),
    leaves="the rounding, and errors of single codes",
    advice="Use the whole range of the converter. Keep at least 0.5 DN of noise as dither, or take a converter with more bits.",
    reasons={"neutral": "it turns the analogue signal into whole codes, and this always rounds"},
)
