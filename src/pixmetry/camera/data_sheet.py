"""A camera from the numbers of its data sheet: a file of about ten lines, schema ``pixmetry/data_sheet/1``.

Only the size of the frame, the pixel pitch and the bits must be there. What the sheet states goes into the chain and is marked ``sheet``,
with its uncertainty where the file gives one under ``u``; everything else is the usual value of the catalogue and is marked ``typical``.
Values are those of EMVA 1288 Release 4.0 (Linear); where they are not parameters of the chain, the functions below convert them.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cache
from statistics import NormalDist
from typing import Any, Final, Literal

import numpy as np
from pydantic import Field, field_validator

from pixmetry.camera.camera import Camera
from pixmetry.camera.catalogue import get_source
from pixmetry.camera.chain_order import Element, in_order
from pixmetry.camera.provenance import DESCRIBED, SHEET, TYPICAL
from pixmetry.core.config import Model, validate
from pixmetry.core.errors import InputError
from pixmetry.core.number import Estimates, Number

SATURATED_SHARE = 0.002  # of the pixels, at the brightest level that counts as not saturated (EMVA 1288 R4.0 §6.6)
LINEAR_RANGE = (0.05, 0.95)  # of saturation, over which the linearity error is taken (EMVA 1288 R4.0 §6.7)
BLACK_STD = 5.0  # standard deviations of the dark signal by which black is lifted where the sheet does not say
MTF_ROUNDING = 0.02  # by which a stated MTF may lie above diffraction's before it is taken for a mistake
SNR_ROUNDING_DB = 1.0  # by which a stated SNR may differ from the root of the capacity
BLUR = "lens blur"  # the name in the chain of what the lens spreads beside diffraction

LIMITED: Final = "diffraction-limited"

Mtf = tuple[tuple[float, float], ...]


class LensRecord(Model):
    """The lens of a data sheet."""

    f_mm: float | None = Field(default=None, gt=0, le=1e5)
    f_number: float | None = Field(default=None, ge=0.7, le=64)
    wavelength_nm: float | None = Field(default=None, ge=100, le=2000)
    mtf: Literal["diffraction-limited"] | float | list[tuple[float, float]] | None = None
    distortion_rel: float | None = Field(default=None, gt=-0.5, le=1)

    @field_validator("mtf", mode="before")
    @classmethod
    def _has_a_form(cls, data: Any) -> Any:
        pairs = isinstance(data, list | tuple) and all(isinstance(p, list | tuple) and len(p) == 2 for p in data)
        if data is None or data == LIMITED or pairs or (isinstance(data, int | float) and not isinstance(data, bool)):
            return data
        allowed = f"{LIMITED}; pairs of line pairs per mm and MTF, such as [[50, 0.6], [100, 0.3]]; or one MTF at the Nyquist frequency"
        raise InputError("an MTF of no known form", value=data, allowed=allowed)


class DataSheetRecord(Model):
    """A data-sheet file, schema ``pixmetry/data_sheet/1``."""

    schema_: Literal["pixmetry/data_sheet/1"] = Field(alias="schema")
    name: str = ""
    source: str = ""
    rows: int = Field(ge=1, le=100_000)
    cols: int = Field(ge=1, le=100_000)
    pitch_um: float | None = Field(default=None, gt=0, le=100)
    pitch_x_um: float | None = Field(default=None, gt=0, le=100)
    pitch_y_um: float | None = Field(default=None, gt=0, le=100)
    bits: int = Field(ge=1, le=16)
    interface: Literal["digital", "analogue"] = "digital"
    sensor: Literal["cmos", "ccd"] | None = None
    shutter: Literal["global", "rolling", "interlaced"] = "global"
    line_time_us: float | None = Field(default=None, gt=0, le=10_000)
    exposure_s: float = Field(default=0.01, gt=0)
    temperature_c: float = Field(default=20.0, ge=-200, le=150)
    wavelength_nm: float | None = Field(default=None, ge=100, le=2000)
    colour: Literal["RGGB", "GRBG", "GBRG", "BGGR"] | None = None
    fill_factor: float | None = Field(default=None, gt=0.01, le=1)
    quantum_efficiency: float | None = Field(default=None, gt=0, le=1)
    full_well_e: float | None = Field(default=None, gt=1, le=1e9)
    saturation_capacity_e: float | None = Field(default=None, gt=1, le=1e9)
    snr_max_db: float | None = Field(default=None, gt=0, le=90)
    read_noise_e: float | None = Field(default=None, ge=0, le=1e5)
    dynamic_range_db: float | None = Field(default=None, gt=0, le=180)
    gain_dn_per_e: float | None = Field(default=None, gt=0, le=1e4)
    black_level_dn: float | None = Field(default=None, ge=0, le=6e4)
    dsnu_e: float | None = Field(default=None, ge=0, le=1e5)
    dsnu_row_e: float | None = Field(default=None, ge=0, le=1e5)
    dsnu_col_e: float | None = Field(default=None, ge=0, le=1e5)
    prnu_rel: float | None = Field(default=None, ge=0, le=0.3)
    prnu_row_rel: float | None = Field(default=None, ge=0, le=0.3)
    prnu_col_rel: float | None = Field(default=None, ge=0, le=0.3)
    dark_current_e_per_s: float | None = Field(default=None, ge=0, le=1e7)
    nonlinearity_rel: float | None = Field(default=None, ge=0, le=0.05)
    lens: LensRecord | None = None
    u: dict[str, float] = {}


UNITS = {
    "quantum_efficiency": "1",
    "full_well_e": "e-",
    "saturation_capacity_e": "e-",
    "snr_max_db": "dB",
    "read_noise_e": "e-",
    "dynamic_range_db": "dB",
    "gain_dn_per_e": "DN/e-",
    "black_level_dn": "DN",
    "fill_factor": "1",
    "dsnu_e": "e-",
    "dsnu_row_e": "e-",
    "dsnu_col_e": "e-",
    "prnu_rel": "1",
    "prnu_row_rel": "1",
    "prnu_col_rel": "1",
    "dark_current_e_per_s": "e-/s",
    "nonlinearity_rel": "1",
    "line_time_us": "us",
}
"""What a sheet may state of the chain with a number, and the units; in a file each of them may have its uncertainty under ``u``."""
OF_THE_LENS = {"f_number": "1", "mtf": "1", "distortion_rel": "1"}


# ---- conversions -------------------------------------------------------------------------------------------------------------------


def full_well_of_capacity(capacity_e: float, read_noise_e: float = 0.0, prnu_rel: float = 0.0) -> float:
    """Electrons at which a pixel is full, from the saturation capacity of EMVA 1288.

    The standard takes the brightest level at which no more than 0.2 % of the pixels are at the top (R4.0 §6.6). Their electrons scatter
    with σ² = µ + σ_d² + (PRNU µ)², so that the top lies z σ above that level, z = 2.88 being the normal quantile.

    Parameters
    ----------
    capacity_e : float
        µ_e.sat, in electrons.
    read_noise_e, prnu_rel : float
        Temporal dark noise in electrons, and non-uniformity as a share.

    Returns
    -------
    float
        In electrons.

    Examples
    --------
    >>> round(full_well_of_capacity(10_000, 2.3, 0.005))
    10322
    """
    z = NormalDist().inv_cdf(1 - SATURATED_SHARE)
    return capacity_e + z * math.sqrt(capacity_e + read_noise_e**2 + (prnu_rel * capacity_e) ** 2)


def capacity_of_snr(snr_max_db: float) -> float:
    """Saturation capacity in electrons from the largest signal-to-noise ratio, which is its root (EMVA 1288 R4.0 eq. 55).

    Examples
    --------
    >>> round(capacity_of_snr(40.0))
    10000
    """
    return 10 ** (snr_max_db / 10)


def dark_noise_of_range(capacity_e: float, dynamic_range_db: float) -> float:
    """Temporal dark noise, with that of rounding, in electrons, from the dynamic range.

    DR = µ_e.sat/µ_e.min with µ_e.min = √(σ² + 1/4) + 1/2 (EMVA 1288 R4.0 eq. 27 and 28); NaN of a range that no noise leaves.

    Examples
    --------
    >>> round(dark_noise_of_range(10_000, 70.0), 3)
    2.615
    """
    square = (capacity_e / 10 ** (dynamic_range_db / 20) - 0.5) ** 2 - 0.25
    return math.sqrt(square) if square >= 0 else math.nan


def linearity_error(bend: float) -> float:
    """Linearity error LE of the response x (1 + a w), w = x over saturation, as a share (EMVA 1288 R4.0 §6.7, eq. 58 to 63).

    Of levels spread evenly over 5 to 95 % of saturation: the mean relative distance from the straight line of least squares with weights
    1/y².
    """
    w = np.linspace(*LINEAR_RANGE, 2001)
    y = w * (1 + bend * w)
    (offset, slope), *_ = np.linalg.lstsq(np.stack([1 / y, w / y], axis=1), np.ones_like(w), rcond=None)
    return float(np.abs(y / (offset + slope * w) - 1).mean())


@cache
def bend_of_linearity_error(error_rel: float) -> float:
    """The bend a < 0 of the response x (1 + a w) that has this linearity error: the response falls behind near saturation.

    Examples
    --------
    >>> bend = bend_of_linearity_error(0.005)
    >>> round(bend, 4), round(linearity_error(bend), 6)
    (-0.0338, 0.005)
    """
    bend = 0.0
    for _ in range(60):  # LE rises a little faster than the bend: each step comes closer by about the bend itself
        bend = -error_rel / (linearity_error(bend) / -bend if bend else linearity_error(-1e-6) / 1e-6)
    return bend


def diffraction_mtf(lp_per_mm: np.ndarray | float, f_number: float, wavelength_nm: float) -> np.ndarray:
    """MTF of a clear circular pupil in incoherent light: (2/π)(acos s − s √(1 − s²)), s = λNν (Goodman, Fourier Optics, eq. 7-33).

    Examples
    --------
    >>> round(float(diffraction_mtf(100, 4.0, 550.0)), 3)
    0.722
    """
    s = np.clip(np.asarray(lp_per_mm, float) * f_number * wavelength_nm * 1e-6, 0, 1)
    return 2 / np.pi * (np.arccos(s) - np.sqrt(1 - s**2) * s)


def blur_of_mtf(
    points: Mtf, u_mtf: float = math.nan, f_number: float | None = None, wavelength_nm: float = 550.0, where: str = "lens.mtf"
) -> tuple[float, float]:
    """Standard deviation of the Gaussian that, together with diffraction, has an MTF, and its uncertainty, both in µm.

    MTF(ν) = MTF_diffraction(ν) exp(−2π²σ²ν²). With L = −ln(MTF/MTF_diffraction) the least squares over the stated points, in which an
    error of each MTF counts alike, is 2π²σ² = Σ M²ν²L / Σ M²ν⁴, with the variance u²/Σ M²ν⁴; one point is met exactly.

    Parameters
    ----------
    points : sequence of (float, float)
        Frequencies in line pairs per mm on the sensor, and MTF.
    u_mtf : float
        Standard uncertainty of each MTF.
    f_number : float, optional
        Without it there is no diffraction.
    wavelength_nm : float
    where : str
        For messages.

    Raises
    ------
    InputError
        If a point is none, or better than diffraction.

    Examples
    --------
    >>> sigma, _ = blur_of_mtf(((100.0, 0.4),), f_number=4.0, wavelength_nm=550.0)
    >>> round(sigma, 4)  # µm
    1.73
    >>> together = diffraction_mtf(100, 4.0, 550.0) * np.exp(-2 * np.pi**2 * (sigma * 1e-3 * 100) ** 2)
    >>> round(float(together), 6)
    0.4
    """
    frequency, mtf = np.array(points, float).reshape(-1, 2).T
    if not len(mtf) or (frequency <= 0).any() or (mtf <= 0).any() or (mtf > 1).any() or not np.isfinite(frequency).all():
        allowed = "pairs of line pairs per mm, above 0, and MTF, above 0 and up to 1, such as [[50, 0.6], [100, 0.3]]"
        raise InputError("an MTF that cannot be", where=where, value=[list(p) for p in points], allowed=allowed)
    best = np.ones_like(mtf) if f_number is None else diffraction_mtf(frequency, f_number, wavelength_nm)
    worst = int(np.argmax(mtf - best))
    if mtf[worst] > best[worst] + MTF_ROUNDING:
        raise InputError(
            f"an MTF better than diffraction at f/{f_number:g} and {wavelength_nm:g} nm",
            where=where,
            value=[float(frequency[worst]), float(mtf[worst])],
            allowed=f"up to {best[worst]:.3f} at {frequency[worst]:g} lp/mm",
            remedy="check f_number, wavelength_nm and the frequency, which is on the sensor and in line pairs",
        )
    per_um2 = 1e-6 * frequency**2  # (line pairs per µm)²
    loss = -np.log(mtf / np.maximum(best, mtf))
    weight = float((mtf**2 * per_um2**2).sum())
    slope = float((mtf**2 * per_um2 * loss).sum()) / weight
    sigma = math.sqrt(slope / (2 * np.pi**2))
    return sigma, u_mtf / math.sqrt(weight) / (4 * np.pi**2 * sigma) if sigma else math.nan


def radial_coefficient(distortion_rel: float, corner_mm: float) -> float:
    """K1 per mm², in r(1 + K1 r²) from the image to the ideal place, of a distortion that is stated at the frame's corner.

    Positive (pincushion): the corner, at r_c, shows what belongs to the radius r_c/(1 + d): K1 = −d/((1 + d) r_c²).
    """
    return -distortion_rel / ((1 + distortion_rel) * corner_mm**2)


# ---- the camera --------------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Part:
    """A source of the chain with what the sheet says of it: values that are not numbers or not uncertain, and numbers."""

    source: str
    values: Mapping[str, Any]
    numbers: Mapping[str, Number]
    name: str = ""
    where: str = ""

    def element(self, known_from: str, where: str) -> Element:
        """The element: what is stated in place of what is usual; what is only bounded from above is not simulated."""
        source = get_source(self.source)
        stated = {name: 0.0 if number.is_upper_limit else number.value for name, number in self.numbers.items()}
        values = {**source.typical.model_dump(), **self.values, **stated}
        params = source.make(values, where=f"{where}, {self.where}" if self.where else where)
        if not type(params).model_fields:
            return Element(self.name or self.source, source, params, known_from=DESCRIBED)
        uncertain = {name: number for name, number in self.numbers.items() if number.u >= 0 or number.is_limit}
        estimates = Estimates.from_rows(
            [(name, n.value, n.u if n.u >= 0 else 0.0, n.dof, n.unit) for name, n in uncertain.items()],
            method="; ".join(dict.fromkeys(n.method for n in uncertain.values() if n.method)),
            limits=frozenset(name for name, n in uncertain.items() if n.is_upper_limit),
            lower_limits=frozenset(name for name, n in uncertain.items() if n.is_lower_limit),
            reasons={name: n.reason for name, n in uncertain.items() if n.reason},
        )
        known = known_from if self.numbers else TYPICAL
        return Element(self.name or self.source, source, params, known_from=known, estimates=estimates)


def camera_of_data_sheet(record: Mapping[str, Any], where: str = "data sheet") -> Camera:
    """Build the camera of a data-sheet file's record.

    Parameters
    ----------
    record : mapping
        As in the file; see ``docs/data-sheets.md``.
    where : str
        For messages, and the camera's name where the record gives none.

    Returns
    -------
    Camera
        Its elements say whence their parameters are known: ``sheet`` or ``typical``.

    Raises
    ------
    InputError, ChainError
        With the line, what is allowed and what to do.

    Examples
    --------
    >>> sheet = {"schema": "pixmetry/data_sheet/1", "rows": 480, "cols": 640, "pitch_um": 5.0, "bits": 12, "read_noise_e": 3.0}
    >>> camera = camera_of_data_sheet(sheet | {"u": {"read_noise_e": 0.2}})
    >>> camera["electronics.amplifier_noise"].known_from, camera["sensor.prnu"].known_from
    ('sheet', 'typical')
    >>> camera.estimates["electronics.amplifier_noise"]["white_e"].u
    0.2
    """
    sheet = validate(DataSheetRecord, record, where)
    pitch = _pitch(sheet, where)
    numbers = _stated(sheet, where)
    _check_range(sheet, numbers, where)
    numbers = _with_ratios(sheet, numbers, where)
    return build_sheet_camera(sheet, numbers, pitch, SHEET, where)


def build_sheet_camera(
    sheet: DataSheetRecord, numbers: Mapping[str, Number], pitch_um: tuple[float, float] | None, known_from: str, where: str
) -> Camera:
    """Build a camera of a sheet and what is known of its numbers.

    Parameters
    ----------
    sheet : DataSheetRecord
        The rest of it: format, interface, shutter, lens.
    numbers : mapping of str to Number
        By the names of `UNITS` and, with the lens, of `OF_THE_LENS`.
    pitch_um : (float, float), optional
        Needed with a lens.
    known_from : str
        What the elements say that hold one of the numbers.
    where : str
        For messages.

    Raises
    ------
    InputError, ChainError
        If the numbers make no camera.
    """
    parts = [*_lens_parts(sheet, numbers, pitch_um, where), *_time_parts(sheet, numbers), *_pixel_parts(sheet, numbers)]
    parts += _signal_parts(sheet, numbers, where)
    by_source: dict[str, list[Part]] = {}
    for part in parts:
        by_source.setdefault(part.source, []).append(part)
    ordered = [part for source in in_order([get_source(i) for i in by_source]) for part in by_source[source.id]]
    return Camera(
        name=sheet.name or where,
        frame_shape=(sheet.rows, sheet.cols),
        chain=tuple(part.element(known_from, where) for part in ordered),
        pitch_um=pitch_um,
        exposure_s=sheet.exposure_s,
        temperature_c=sheet.temperature_c,
        facts=_facts(sheet),
    )


def _facts(sheet: DataSheetRecord) -> dict[str, Any]:
    lens = "none is stated: no point spread" if sheet.lens is None else sheet.lens.model_dump(mode="json", exclude_none=True)
    told = {"sensor": sheet.sensor, "wavelength_nm": sheet.wavelength_nm, "colour": sheet.colour, "source": sheet.source or "a data sheet"}
    known = {name: value for name, value in told.items() if value is not None}
    return {"interface": sheet.interface, "bits": sheet.bits, "shutter": sheet.shutter, "lens": lens} | known


def _pitch(sheet: DataSheetRecord, where: str) -> tuple[float, float]:
    x, y = sheet.pitch_x_um or sheet.pitch_um, sheet.pitch_y_um or sheet.pitch_um
    if x is None or y is None:
        raise InputError("'pitch_um' is missing", where=where, remedy="add `pitch_um: ...`, or pitch_x_um and pitch_y_um")
    if sheet.pitch_um is not None and (sheet.pitch_x_um is not None or sheet.pitch_y_um is not None):
        remedy = "keep pitch_um, or pitch_x_um and pitch_y_um"
        raise InputError("the pixel pitch is given twice", where=where, value=[sheet.pitch_um, x, y], remedy=remedy)
    return x, y


def _stated(sheet: DataSheetRecord, where: str) -> dict[str, Number]:
    """The numbers that a file states, with the uncertainties that it gives."""
    there: dict[str, Any] = {name: getattr(sheet, name) for name in UNITS}
    there |= {name: getattr(sheet.lens, name, None) for name in OF_THE_LENS}
    stated = {name: value for name, value in there.items() if value is not None}
    for name, u in sheet.u.items():
        if name not in stated:
            allowed = ", ".join(stated) or "none: it states none"
            remedy = f"state {name}, or delete its uncertainty"
            raise InputError(
                f"an uncertainty of {name!r}, which the sheet does not state", where=f"{where}, u", allowed=allowed, remedy=remedy
            )
        if not u >= 0:
            raise InputError(f"the uncertainty of {name} cannot be used", where=f"{where}, u", value=u, allowed="0 or more")
    units = UNITS | OF_THE_LENS
    return {
        name: Number(value if isinstance(value, float | int) else 0.0, sheet.u.get(name, math.nan), unit=units[name], method="data sheet")
        for name, value in stated.items()
    }


def _with_ratios(sheet: DataSheetRecord, numbers: dict[str, Number], where: str) -> dict[str, Number]:
    """The numbers, with saturation capacity and read noise from signal-to-noise ratio and dynamic range where only these are stated."""
    found = dict(numbers)
    if "snr_max_db" in numbers and not {"saturation_capacity_e", "full_well_e"} & numbers.keys():
        snr = numbers["snr_max_db"]
        capacity = capacity_of_snr(snr.value)
        found["saturation_capacity_e"] = Number(capacity, capacity * math.log(10) / 10 * snr.u, unit="e-", method=snr.method)
    if "dynamic_range_db" not in numbers or "read_noise_e" in numbers:
        return found
    full = found.get("saturation_capacity_e") or found.get("full_well_e")
    if full is None:
        remedy = "add saturation_capacity_e or snr_max_db, or give read_noise_e"
        raise InputError("a dynamic range without what it is a range of", where=where, remedy=remedy)
    ratio = numbers["dynamic_range_db"]
    total = dark_noise_of_range(full.value, ratio.value)
    gain = numbers["gain_dn_per_e"].value if "gain_dn_per_e" in numbers else (2**sheet.bits - 1) / full.value
    rounding = 1 / (12 * gain**2)  # EMVA 1288 R4.0 eq. 53
    if not total**2 - rounding >= 0:
        remedy = "check dynamic_range_db, snr_max_db and bits, or give read_noise_e"
        raise InputError("a dynamic range that rounding does not leave", where=where, value=ratio.value, remedy=remedy)
    read, e_min = math.sqrt(total**2 - rounding), full.value / 10 ** (ratio.value / 20)
    by_range = (e_min - 0.5) * e_min  # half the derivative of the square of the noise, by the logarithm of the range
    by_capacity = by_range if "gain_dn_per_e" in numbers else by_range - rounding
    u = math.hypot(by_capacity * full.u / full.value, by_range * math.log(10) / 20 * ratio.u) / read if read else math.nan
    found["read_noise_e"] = Number(read, u, unit="e-", method=ratio.method)
    return found


def _check_range(sheet: DataSheetRecord, numbers: Mapping[str, Number], where: str) -> None:
    """Refuse numbers that contradict each other."""
    if sheet.full_well_e is not None and sheet.saturation_capacity_e is not None and sheet.full_well_e < sheet.saturation_capacity_e:
        raise InputError(
            "a full well below the saturation capacity",
            where=where,
            value=[sheet.full_well_e, sheet.saturation_capacity_e],
            remedy="give one of full_well_e and saturation_capacity_e",
        )
    capacity = sheet.saturation_capacity_e or sheet.full_well_e
    if (
        sheet.snr_max_db is not None
        and capacity is not None
        and abs(20 * math.log10(math.sqrt(capacity)) - sheet.snr_max_db) > SNR_ROUNDING_DB
    ):
        raise InputError(
            "a largest signal-to-noise ratio that is not the root of the saturation capacity",
            where=where,
            value=[sheet.snr_max_db, capacity],
            allowed=f"{10 * math.log10(capacity):.1f} dB with this capacity",
            remedy="give one of the two",
        )
    if sheet.gain_dn_per_e is not None and sheet.saturation_capacity_e is not None:
        top, reached = 2**sheet.bits - 1, sheet.gain_dn_per_e * sheet.saturation_capacity_e + (sheet.black_level_dn or 0)
        if reached > 1.01 * top:
            raise InputError(
                f"the converter is full before the saturation capacity: gain_dn_per_e times saturation_capacity_e is {reached:.4g} DN",
                where=where,
                allowed=f"up to {top} DN with {sheet.bits} bits",
                remedy="check bits and gain_dn_per_e (DN per electron; many sheets give 1/K in e-/DN), or give full_well_e instead",
            )
    for total, parts in (("dsnu_e", ("dsnu_row_e", "dsnu_col_e")), ("prnu_rel", ("prnu_row_rel", "prnu_col_rel"))):
        there = [numbers[name].value for name in parts if name in numbers]
        if there and (total not in numbers or numbers[total].value < math.hypot(*there)):
            remedy = f"give {total}, which holds rows, columns and pixels together"
            value = [numbers[name].value for name in (total, *parts) if name in numbers]
            raise InputError(f"{' and '.join(parts)} without {total}, or larger than it", where=where, value=value, remedy=remedy)


def _lens_parts(sheet: DataSheetRecord, numbers: Mapping[str, Number], pitch_um: tuple[float, float] | None, where: str) -> list[Part]:
    """Diffraction, blur and distortion of the lens; nothing without one."""
    lens = sheet.lens
    if lens is None or pitch_um is None:
        return []
    source, wavelength = "optics.point_spread", lens.wavelength_nm or sheet.wavelength_nm or 550.0
    pixel_um, parts = math.sqrt(pitch_um[0] * pitch_um[1]), []
    if lens.f_number is not None:
        spot_px = 1.22e-3 * wavelength * lens.f_number / min(pitch_um)
        spread = {"model": "diffraction", "wavelength_nm": wavelength, "reach_px": min(max(4.0, math.ceil(spot_px) + 2.0), 12.0)}
        spread |= {"sigma_px": 0.0, "pitch_x_um": pitch_um[0], "pitch_y_um": pitch_um[1]}
        parts.append(Part(source, spread, {"f_number": numbers["f_number"]}, where="lens.f_number"))
    elif lens.mtf == LIMITED:
        raise InputError("'lens.f_number' is missing", where=where, remedy="add `f_number: ...`: diffraction depends on it")
    if lens.mtf is None:
        parts.append(Part(source, {}, {}, BLUR))
    elif lens.mtf != LIMITED:
        nyquist = 500 / pixel_um  # line pairs per mm
        points = ((nyquist, lens.mtf),) if isinstance(lens.mtf, float | int) else tuple(lens.mtf)
        blur = blur_of_mtf(points, numbers["mtf"].u, lens.f_number, wavelength, f"{where}, lens.mtf")
        sigma, u = (value / pixel_um for value in blur)
        parts.append(Part(source, {}, {"sigma_px": Number(sigma, u, unit="px", method="data sheet")}, BLUR, "lens.mtf"))
    if lens.distortion_rel is not None:
        corner_mm = 5e-4 * math.hypot(sheet.cols * pitch_um[0], sheet.rows * pitch_um[1])
        k1 = radial_coefficient(lens.distortion_rel, corner_mm)
        u_k1 = numbers["distortion_rel"].u / ((1 + lens.distortion_rel) ** 2 * corner_mm**2)
        values = {"p1_per_mm": 0.0, "pitch_x_um": pitch_um[0], "pitch_y_um": pitch_um[1]}
        number = Number(k1, u_k1, unit="1/mm²", method="data sheet")
        if abs(k1) > 0.1:
            allowed = f"up to {0.1 * corner_mm**2:.2g} at the corner of so small a frame, {corner_mm:.3g} mm off its centre"
            raise InputError("a distortion too strong", where=f"{where}, lens.distortion_rel", value=lens.distortion_rel, allowed=allowed)
        parts.append(Part("optics.distortion", values, {"k1_per_mm2": number}, where="lens.distortion_rel"))
    return parts


def _time_parts(sheet: DataSheetRecord, numbers: Mapping[str, Number]) -> list[Part]:
    """When the rows look: rolling shutter or fields."""
    line = numbers.get("line_time_us")
    if sheet.shutter == "rolling":
        row = {} if line is None else {"row_time_s": _scaled(line, 1e-6, "s")}
        return [Part("sensor.rolling_shutter", {}, row, where="line_time_us")]
    if sheet.shutter == "interlaced":
        field = {} if line is None else {"field_period_s": _scaled(line, 0.5e-6 * sheet.rows, "s")}
        return [Part("sensor.interlace", {}, field, where="line_time_us")]
    return []


def _pixel_parts(sheet: DataSheetRecord, numbers: Mapping[str, Number]) -> list[Part]:
    """What a pixel makes of light: aperture, colour, quantum efficiency, non-uniformity, dark current, shot noise."""
    aperture = {}
    if "fill_factor" in numbers:
        fill = numbers["fill_factor"]
        side = math.sqrt(fill.value)
        aperture = {name: Number(side, fill.u / (2 * side), unit="px", method=fill.method) for name in ("width_x_px", "width_y_px")}
    parts = [
        Part("sensor.pixel_aperture", {}, aperture, where="fill_factor"),
        Part("sensor.quantum_efficiency", {}, _renamed(numbers, quantum_efficiency="quantum_efficiency")),
        Part("sensor.prnu", *_split(numbers, "prnu", "rel"), where="prnu_rel"),
        Part(
            "sensor.dark_current",
            {"reference_temperature_c": sheet.temperature_c},
            _renamed(numbers, rate_e_per_s="dark_current_e_per_s"),
        ),
        Part("sensor.shot_noise", {}, {}),
        Part("sensor.dsnu", *_split(numbers, "dsnu", "e"), where="dsnu_e"),
    ]
    return parts if sheet.colour is None else [*parts, Part("sensor.bayer_mosaic", {"pattern": sheet.colour}, {})]


def _signal_parts(sheet: DataSheetRecord, numbers: Mapping[str, Number], where: str) -> list[Part]:
    """What is done with the charge: full well, noise, gain, bend, converter."""
    read = numbers.get("read_noise_e") or _usual("electronics.amplifier_noise", "white_e")
    well = _full_well(numbers, read.value)
    full = _usual("sensor.full_well", "full_well_e") if well is None else well
    dsnu, top = numbers.get("dsnu_e") or _usual("sensor.dsnu", "pixel_std_e"), 2**sheet.bits - 1
    lift_e = BLACK_STD * math.hypot(read.representative, dsnu.representative)
    if "black_level_dn" in numbers:
        black = numbers["black_level_dn"].value
    else:
        first_gain = numbers["gain_dn_per_e"].value if "gain_dn_per_e" in numbers else top / full.value
        black = float(math.ceil(first_gain * lift_e + 1))
    if black >= top:
        allowed = f"below {top} DN with {sheet.bits} bits"
        remedy = "check read_noise_e, gain_dn_per_e, black_level_dn, full_well_e and bits"
        raise InputError("black and its noise fill the range of the converter", where=where, value=black, allowed=allowed, remedy=remedy)
    gain = numbers.get("gain_dn_per_e") or _scaled_inverse(full, top - black)
    stated = {} if well is None and "gain_dn_per_e" not in numbers else {"gain_dn_per_e": gain}
    reference = min(gain.value * full.value, top - black)
    return [
        Part("sensor.full_well", {}, {} if well is None else {"full_well_e": well}, where="full_well_e"),
        Part("electronics.amplifier_noise", {}, _renamed(numbers, white_e="read_noise_e")),
        Part("electronics.gain", {"gain_dn_per_e": gain.value}, stated),
        Part("electronics.nonlinearity", *_bend(numbers, reference), where="nonlinearity_rel"),
        Part("grabber.adc", {"bits": sheet.bits, "offset_dn": black, "reference_temperature_c": min(sheet.temperature_c, 100.0)}, {}),
    ]


def _usual(source: str, name: str) -> Number:
    """The usual value of a parameter, with no uncertainty known."""
    return Number(float(getattr(get_source(source).typical, name)))


def _full_well(numbers: Mapping[str, Number], read_noise_e: float) -> Number | None:
    """Where a pixel is full: as stated, or above the saturation capacity; None where neither is known."""
    if "full_well_e" in numbers or "saturation_capacity_e" not in numbers:
        return numbers.get("full_well_e")
    capacity = numbers["saturation_capacity_e"]
    prnu = numbers.get("prnu_rel") or _usual("sensor.prnu", "pixel_std_rel")
    full = full_well_of_capacity(capacity.value, read_noise_e, prnu.representative)
    return replace(capacity, value=full)


def _bend(numbers: Mapping[str, Number], reference_dn: float) -> tuple[dict[str, Any], dict[str, Number]]:
    """Values and numbers of the non-linearity."""
    if "nonlinearity_rel" not in numbers:
        return {"reference_dn": reference_dn}, {}
    error = numbers["nonlinearity_rel"]
    bend = bend_of_linearity_error(error.representative)
    per_error = (bend - bend_of_linearity_error(0.99 * error.representative)) / (0.01 * error.representative) if bend else -7.0
    number = Number(bend, abs(per_error) * error.u, error.dof, "1", error.method)
    return {"reference_dn": reference_dn, "a2": 0.0, "a3": 0.0}, {"a1": number}


def _split(numbers: Mapping[str, Number], name: str, unit: str) -> tuple[dict[str, Any], dict[str, Number]]:
    """Values and numbers of a non-uniformity: rows, columns and pixels as they are known, else the lines 0 and the pixels the rest."""
    lines = {part: numbers[f"{name}_{part}_{unit}"] for part in ("row", "col") if f"{name}_{part}_{unit}" in numbers}
    total, pixel = numbers.get(f"{name}_{unit}"), numbers.get(f"{name}_pixel_{unit}")
    if pixel is None and total is None:
        return {}, {}
    if pixel is None and total is not None:
        rest = math.sqrt(max(total.value**2 - sum(number.representative**2 for number in lines.values()), 0.0))
        pixel = replace(total, value=rest, u=total.u * total.value / rest if rest else math.nan)
    found = {f"pixel_std_{unit}": pixel} | {f"{part}_std_{unit}": number for part, number in lines.items()}
    return {f"row_std_{unit}": 0.0, f"col_std_{unit}": 0.0}, {key: number for key, number in found.items() if number is not None}


def _renamed(numbers: Mapping[str, Number], **names: str) -> dict[str, Number]:
    """Numbers under the names of a source's parameters, as far as they are known."""
    return {new: numbers[old] for new, old in names.items() if old in numbers}


def _scaled(number: Number, factor: float, unit: str) -> Number:
    return replace(number, value=factor * number.value, u=factor * number.u, unit=unit)


def _scaled_inverse(full: Number, range_dn: float) -> Number:
    """The gain with which so many electrons fill the range."""
    gain = range_dn / full.value
    return Number(gain, gain * full.u / full.value, full.dof, "DN/e-", full.method)
