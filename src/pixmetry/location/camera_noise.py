"""The noise model of a camera, read from the sources in its chain."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from pixmetry.core.camera import Camera, Element
from pixmetry.core.errors import InputError
from pixmetry.core.random import Grid
from pixmetry.location.information import ROUNDING_DN2
from pixmetry.location.noise import NoiseModel

BOLTZMANN_J_PER_K, ELECTRON_C, ZERO_C_K = 1.380649e-23, 1.602176634e-19, 273.15  # SI 2019
BENT = ("sensor.log_response", "electronics.gamma", "processing.companding", "processing.demosaic", "electronics.hdr_gain")


@dataclass(frozen=True)
class CameraNoise:
    """What a camera adds to a grey value.

    Parameters
    ----------
    model : NoiseModel
        Temporal noise of a pixel and the spread of the sensitivities; the scale's ends are those of the codes.
    pattern_dn : float
        Standard deviation of the fixed offsets from pixel to pixel (DSNU); not in the model.
    aperture_px : float
        Side of the square that has the area of the pixel's sensitive part.
    pitch_um : (float, float) or None
    counted, left_out : tuple of str
        Sources that were read, and sources of noise or of a bent response that were not.
    """

    model: NoiseModel
    pattern_dn: float
    aperture_px: float
    pitch_um: tuple[float, float] | None
    counted: tuple[str, ...]
    left_out: tuple[str, ...]


def camera_noise(camera: Camera) -> CameraNoise:
    """Read gain, dark noise, sensitivities, range and black level of a camera from its sources.

    Raises
    ------
    InputError
        If the camera tells no gain or no bits.

    Notes
    -----
    variance = K²(Σ σ_e² + dark electrons) + Σ σ_DN² + 1/12 + K · light, EMVA 1288 R4.0 Linear, 2.4; K in DN per electron. Noise that is
    common to a row or a column counts as if it were independent in every pixel. The settled temperature and the default exposure hold.
    """
    gain = _find(camera, "electronics.gain", "gain_dn_per_e")
    if gain is None:
        raise InputError(
            "the camera tells no gain in DN per electron",
            where=camera.name,
            allowed="a camera with the source electronics.gain",
            remedy="give the noise instead, as in --noise read=1.5,gain=0.01",
        )
    bits = _find(camera, "grabber.adc", "bits") or camera.facts.get("bits")
    if bits is None:
        raise InputError("the camera tells no bits", where=camera.name, remedy="add grabber.adc, or bits among its facts")
    electrons, dark_e, grey, counted = 0.0, 0.0, 0.0, {"electronics.gain"}
    for element in camera.active:
        source = element.source.id
        if source in _ELECTRONS:
            electrons += _ELECTRONS[source](element.params, camera)
        elif source == "sensor.dark_current":
            dark_e = _dark_e(element, camera)
        elif source in _GREY:
            grey += _GREY[source](element.params)
        elif source not in _READ:
            continue
        counted.add(source)
    offsets = [_find(camera, s, "offset_dn") or 0.0 for s in ("grabber.clamp", "grabber.adc")]
    prnu = _find(camera, "sensor.prnu", "pixel_std_rel") or 0.0
    dsnu = _find(camera, "sensor.dsnu", "pixel_std_e") or 0.0
    shot = any(e.source.id == "sensor.shot_noise" for e in camera.active)
    model = NoiseModel(
        constant_dn2=gain**2 * (electrons + (dark_e if shot else 0.0)) + grey + ROUNDING_DN2,
        slope_dn=gain if shot else 0.0,
        pattern_rel=prnu,
        black_dn=sum(offsets) + gain * dark_e,
        low_dn=0.0,
        high_dn=float(2 ** int(bits) - 1),
        origin="camera",
    )
    rest = [e.source for e in camera.active if e.source.id not in counted]
    others = [s.id for s in rest if s.gum_class in ("T", "Tr") or s.id in BENT]
    widths = [_find(camera, "sensor.pixel_aperture", f"width_{axis}_px") or 1.0 for axis in "xy"]
    return CameraNoise(model, gain * dsnu, float(np.sqrt(widths[0] * widths[1])), camera.pitch_um, tuple(sorted(counted)), tuple(others))


def _find(camera: Camera, source: str, parameter: str) -> Any:
    return next((getattr(e.params, parameter) for e in camera.active if e.source.id == source), None)


def _dark_e(element: Element, camera: Camera) -> float:
    """Mean dark electrons of a pixel in one exposure: what the source itself adds to an empty signal."""
    zero = np.zeros(1, np.int64)
    empty = camera.signal(_Nothing(), Grid(zero, zero, zero, (1, 1)), temperature_c=camera.temperature_c)  # type: ignore[arg-type]
    even = element.params.model_copy(update={"spread_log": 0.0, "glow_e_per_s": 0.0})
    return float(element.source.forward(even, empty, None).data[0, 0, 0])


class _Nothing:
    """A scene without light."""

    moving = False


def _reset_e2(params: Any, camera: Camera) -> float:
    """Of the sense node: kTC/q² unless sampled twice; the injection, which double sampling counts twice."""
    if params.cds:
        return 2 * params.injection_std_e**2
    return BOLTZMANN_J_PER_K * (camera.temperature_c + ZERO_C_K) * params.node_ff * 1e-15 / ELECTRON_C**2 + params.injection_std_e**2


_ELECTRONS: dict[str, Callable[[Any, Camera], float]] = {
    "electronics.amplifier_noise": lambda p, _: p.white_e**2 * p.clock_ratio,
    "electronics.flicker_noise": lambda p, _: p.rms_e**2,
    "electronics.row_noise": lambda p, _: p.row_e**2 + p.column_e**2,
    "sensor.charge_injection": _reset_e2,
    "sensor.cid_readout": lambda p, _: p.read_std_e**2 / p.reads + p.floor_std_e**2,
}
_GREY: dict[str, Callable[[Any], float]] = {
    "grabber.clamp": lambda p: p.noise_dn**2,
    "electronics.column_noise": lambda p: p.offset_dn**2,
}
_READ = {"sensor.quantum_efficiency", "sensor.shot_noise", "sensor.prnu", "sensor.dsnu", "grabber.adc", "sensor.pixel_aperture"}
