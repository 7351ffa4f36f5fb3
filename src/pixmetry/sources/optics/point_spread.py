"""The lens's point spread: a Gaussian, the diffraction at an aberrated circular pupil, or a measured table."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from typing import Literal

import numpy as np

from pixmetry.camera.light import FINE
from pixmetry.camera.observations import Observations
from pixmetry.camera.raster import kernel_of, spread_of
from pixmetry.camera.signal import Kind, Signal
from pixmetry.camera.source import Parameters, Source, quantity
from pixmetry.camera.stated import StatedFacts
from pixmetry.core.arrays import Array
from pixmetry.core.errors import MeasureError, ParameterError
from pixmetry.core.number import Estimates
from pixmetry.core.random import Stream

NODES = 40  # of each integral over the common part of two pupils: 1e-6 for a wave of aberration (root mean square)


class PointSpread(Parameters):
    """One spread for the whole frame. Aberrations are Zernike coefficients by Noll's normalisation: waves, root mean square."""

    model: Literal["gaussian", "diffraction", "measured"] = quantity("gaussian", "name", "model of the spread")
    sigma_px: float = quantity(0.0, "px", "standard deviation along each axis (gaussian)", ge=0, le=50)
    wavelength_nm: float = quantity(550.0, "nm", "wavelength of the light (diffraction)", ge=100, le=2000)
    f_number: float = quantity(4.0, "1", "working f-number (diffraction)", ge=0.7, le=64)
    pitch_x_um: float = quantity(3.45, "µm", "pixel pitch along x (diffraction)", gt=0, le=100)
    pitch_y_um: float = quantity(3.45, "µm", "pixel pitch along y (diffraction)", gt=0, le=100)
    defocus_waves: float = quantity(0.0, "waves", "Zernike 2ρ² − 1, times √3", ge=-3, le=3)
    astigmatism_waves: float = quantity(0.0, "waves", "Zernike ρ² cos 2φ, times √6", ge=-3, le=3)
    oblique_astigmatism_waves: float = quantity(0.0, "waves", "Zernike ρ² sin 2φ, times √6", ge=-3, le=3)
    coma_x_waves: float = quantity(0.0, "waves", "Zernike (3ρ³ − 2ρ) cos φ, times √8; positive: the tail points to +x", ge=-3, le=3)
    coma_y_waves: float = quantity(0.0, "waves", "Zernike (3ρ³ − 2ρ) sin φ, times √8; positive: the tail points to +y", ge=-3, le=3)
    spherical_waves: float = quantity(0.0, "waves", "Zernike 6ρ⁴ − 6ρ² + 1, times √5", ge=-3, le=3)
    reach_px: float = quantity(4.0, "px", "half the side of the fine table; wide Gaussians continue its tail (diffraction)", ge=1, le=12)
    table: tuple[tuple[float, ...], ...] = quantity(
        (),
        "1",
        "mean density of the spread in square cells, rows from the top, odd sides; the central cell is the ideal image point (measured)",
    )
    table_step_px: float = quantity(0.25, "px", "side of the table's cells (measured)", gt=0.01, le=0.5)


def wave_aberration(params: PointSpread, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Wave aberration in waves at places of the pupil, whose radius is 1."""
    r2 = x * x + y * y
    waves: Array = (
        np.sqrt(3) * params.defocus_waves * (2 * r2 - 1)
        + np.sqrt(6) * (params.astigmatism_waves * (x * x - y * y) + params.oblique_astigmatism_waves * 2 * x * y)
        + np.sqrt(8) * (3 * r2 - 2) * (params.coma_x_waves * x + params.coma_y_waves * y)
        + np.sqrt(5) * params.spherical_waves * (6 * r2 * r2 - 6 * r2 + 1)
    )
    return waves


def transfer(params: PointSpread, fx: np.ndarray, fy: np.ndarray) -> np.ndarray:
    """Optical transfer function at frequencies in cycles per pixel, complex.

    The autocorrelation of the pupil function (Hopkins): the integral of exp(2πi (W(p − s/2) − W(p + s/2))) over the common part of two
    unit circles whose centres are s = 2 λN ν apart, over π; by Gauss–Legendre nodes along and across the line between the centres.
    """
    scale = 2e-3 * params.wavelength_nm * params.f_number
    sx, sy = (np.asarray(v, float).ravel() * scale / p for v, p in ((fx, params.pitch_x_um), (fy, params.pitch_y_um)))
    s = np.hypot(sx, sy)
    out = np.zeros(s.size, complex)
    at = np.flatnonzero(s < 2)
    cx, cy = (np.divide(v[at], s[at], out=np.full(at.size, d), where=s[at] > 0) for v, d in ((sx, 1.0), (sy, 0.0)))
    node, weight = np.polynomial.legendre.leggauss(NODES)
    height = np.sqrt(1 - s[at] ** 2 / 4)  # half height of the common part; across it v = height sin t
    angle = 0.5 * np.pi * node
    total = np.zeros(at.size, complex)
    for sine, cosine, w in zip(np.sin(angle), np.cos(angle), weight, strict=True):
        v = height * sine
        half = np.sqrt(1 - v * v) - s[at] / 2
        u = half[:, None] * node
        px, py = cx[:, None] * u - cy[:, None] * v[:, None], cy[:, None] * u + cx[:, None] * v[:, None]
        dx, dy = 0.5 * sx[at][:, None], 0.5 * sy[at][:, None]
        phase = wave_aberration(params, px - dx, py - dy) - wave_aberration(params, px + dx, py + dy)
        total += w * 0.5 * np.pi * cosine * height * half * (np.exp(2j * np.pi * phase) * weight).sum(axis=1)
    out[at] = total / np.pi
    return out.reshape(np.shape(fx))


def table_transfer(params: PointSpread, fx: np.ndarray, fy: np.ndarray) -> np.ndarray:
    """Transfer function of the measured table, whose density is constant in each cell."""
    table, step = np.array(params.table, float), params.table_step_px
    at_y, at_x = ((np.arange(n) - n // 2) * step for n in table.shape)
    ex, ey = np.exp(-2j * np.pi * fx.ravel()[:, None] * at_x), np.exp(-2j * np.pi * fy.ravel()[:, None] * at_y)
    value = ((ey @ table) * ex).sum(axis=1) / table.sum()
    interpolated: Array = value.reshape(fx.shape) * np.sinc(fx * step) * np.sinc(fy * step)
    return interpolated


def _check_table(params: PointSpread) -> None:
    sides = {len(row) for row in params.table}
    if len(sides) != 1 or len(params.table) % 2 == 0 or min(sides) % 2 == 0 or sum(map(sum, params.table)) <= 0:
        raise ParameterError(
            "the table of the point spread cannot be used",
            where="optics.point_spread.table",
            value=[len(row) for row in params.table][:5],
            allowed="rows of one length, odd sides, a positive sum",
        )


def light_beyond(params: PointSpread, d_um: np.ndarray) -> np.ndarray:
    """Share of an edge's light farther than d on its dark side, without rings: atan(2λN/(π² d))/π.

    Its transfer function, exp(−4 λNν/π), begins as that of the clear pupil: 1 − 4 λNν/π. Light that is bent far comes from the pupil's
    edge, whatever the aberrations; its density falls as λN/(π³ r³) (Lord Rayleigh 1881: J0² + J1² of the light is outside a circle).
    """
    return np.arctan(2e-3 * params.wavelength_nm * params.f_number / (np.pi**2 * np.asarray(d_um, float))) / np.pi


@lru_cache(maxsize=32)
def kernel(params: PointSpread) -> tuple[np.ndarray, np.ndarray | None]:
    """The spread on the light's fine raster and its tail, see `camera.raster`."""
    if params.model == "diffraction":
        pitch = params.pitch_x_um, params.pitch_y_um
        return spread_of(lambda fx, fy: transfer(params, fx, fy), params.reach_px, lambda d: light_beyond(params, d), pitch)
    _check_table(params)
    half = 0.5 * params.table_step_px * max(len(params.table), len(params.table[0]))
    return kernel_of(lambda fx, fy: table_transfer(params, fx, fy), int(np.ceil(half * FINE)) + 2 * FINE), None


def forward(params: PointSpread, signal: Signal, stream: Stream) -> Signal:
    """Spread the light."""
    light = signal.own_light
    if params.model == "gaussian":
        return signal.with_light(light.blurred(params.sigma_px**2)) if params.sigma_px else signal
    return signal.with_light(light.convolved(*kernel(params)))


def measure(observations: Observations) -> Estimates:
    """Standard deviation of a Gaussian lens, or f-number (and defocus) of one limited by diffraction, from slanted edges."""
    if observations.edges is not None and "airy_px" in observations.edges.optics:
        return _limited(observations.edges.optics, observations.stated)
    return observations.edge_optics({"sigma_px": "sigma_px"}, where="optics.point_spread")


def _limited(optics: Estimates, stated: StatedFacts) -> Estimates:
    """f-number from λN over the pitch, which is what edges show."""
    pitch_um = stated.pitch_x_um
    if pitch_um is None:
        told = f"the edges tell λN = {optics['airy_px'].value:.3f} px of a lens that is limited by diffraction, and the pitch is not stated"
        raise MeasureError(told, where="optics.point_spread", remedy="state pitch_um in the manifest")
    nm = stated.wavelength_nm or 550.0
    names = {"f_number": "airy_px", "defocus_waves": "defocus_waves"}
    lens = optics.select({new: old for new, old in names.items() if old in optics}).scaled({"f_number": (1e3 * pitch_um / nm, "1")})
    known = Estimates.from_rows([("wavelength_nm", nm, 0.0, np.inf, "nm"), *((f"pitch_{c}_um", pitch_um, 0.0, np.inf, "µm") for c in "xy")])
    light = "" if stated.wavelength_nm else ": the wavelength is not stated"
    reasons = {"f_number": f"the edges tell its product with the wavelength, {nm:g} nm{light}"}
    if "defocus_waves" in lens:
        reasons["defocus_waves"] = "its size: the sign is not seen"
    return replace(lens.join(known), reasons=reasons, settings={"model": "diffraction"})


SOURCE = Source(
    id="optics.point_spread",
    title="Point spread of the lens",
    description="The lens images a point as a small spot. A spot much narrower than a pixel is undersampled; coma makes it one-sided.",
    note="Note 21",
    parameters=PointSpread,
    consumes=(Kind.LIGHT,),
    before=("sensor",),
    neutral=PointSpread(),
    typical=PointSpread(sigma_px=0.6),
    bound=PointSpread(sigma_px=1.5),
    forward=forward,
    measure=measure,
    gum_class="F",
    equation="OTF(ν) = (1/π) ∬ exp 2πi (W(p − λNν) − W(p + λNν)) dp;  clear: (2/π)(acos s − s √(1 − s²)), s = λNν",
    typical_size="periodic error OTF(1)/π of a point under full pixels: 0.08 px at f/4 with 3.45 µm, 1e-6 px at σ = 0.8 px",
    references=(
        "H. H. Hopkins, The frequency response of a defocused optical system, Proc. R. Soc. A 231 (1955) 91–103",
        "R. J. Noll, Zernike polynomials and atmospheric turbulence, JOSA 66 (1976) 207–211",
    ),
    advice="If targets are only a few pixels wide: stop down until λN is at least the pixel pitch, or defocus slightly.",
    reasons={
        "correct": "an even spread moves no centre. What it takes from the highest frequencies is below the noise, and a deconvolution "
        "would amplify that",
        "propagate": "it only changes the undersampling; that needs the target before the spread, which the probe does not contain",
    },
)
