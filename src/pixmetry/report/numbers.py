"""Numbers as text: a value to the place that its uncertainty allows, units with their signs, lengths in px and µm."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from math import floor, isfinite, log10

from pixmetry.core.number import Number

MINUS, THIN, NO_BREAK = "\u2212", "\u2009", "\u00a0"
NONE = "\u2013"
SUPERSCRIPT = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")
LIMIT_DIGITS = 2  # significant digits of an upper limit, as of an uncertainty


@dataclass(frozen=True)
class PrintedNumber:
    """A value, its standard uncertainty and its unit as text; a power of ten common to both is in ``unit``."""

    value: str
    u: str
    unit: str

    def joined(self, with_unit: bool = True) -> str:
        """Value, uncertainty and unit in one string."""
        return " ".join(part for part in (self.value, self.u, self.unit if with_unit else "") if part)


def decimals_of(u: float, digits: int = 2) -> int:
    """Decimal places that leave ``digits`` significant digits of ``u`` (negative: rounded to tens, hundreds …)."""
    # through the exponent of the rounded number, so that 0.0996 becomes 0.10 and not 0.100
    return digits - 1 - int(f"{abs(u):.{digits - 1}e}".partition("e")[2])


def fixed(value: float, decimals: int) -> str:
    """A number with that many decimal places and a true minus sign."""
    text = f"{round(value, decimals):.{max(decimals, 0)}f}"
    return text.replace("-", MINUS) if float(text) else text.replace("-", "")


def significant(value: float, digits: int = 3) -> str:
    """A number with a given number of significant digits, without an exponent between 0.0001 and a million."""
    if not isfinite(value):
        return NONE
    if value == 0:
        return "0"
    if not 1e-4 <= abs(value) < 1e6:
        mantissa, _, exponent = f"{value:.{digits - 1}e}".partition("e")
        return f"{mantissa.replace('-', MINUS)}{THIN}×{THIN}10{str(int(exponent)).translate(SUPERSCRIPT)}"
    return fixed(value, decimals_of(value, digits))


def short(value: float, digits: int = 4) -> str:
    """Significant digits without the zeros at the end; a whole number unchanged."""
    if isfinite(value) and value == int(value) and abs(value) < 1e6:
        return fixed(value, 0)
    text = significant(value, digits)
    return text.rstrip("0").rstrip(".") if "." in text and "×" not in text else text


def uncertain(value: float, u: float, unit: str) -> PrintedNumber:
    """Value and standard uncertainty, the uncertainty to two significant digits and the value to the same place (JCGM 100, 7.2.6)."""
    if not (isfinite(u) and u > 0):
        return PrintedNumber(significant(value, 4), NONE, pretty_unit(unit))
    largest = max(abs(value), u)
    power = floor(log10(largest))
    power = 0 if -4 < power < 6 else power
    scaled_value, scaled_u = value / 10.0**power, u / 10.0**power
    places = decimals_of(scaled_u)
    return PrintedNumber(fixed(scaled_value, places), fixed(scaled_u, places), _with_power(unit, power))


def limit(value: float, unit: str) -> PrintedNumber:
    """A one-sided upper limit."""
    power = floor(log10(value)) if value > 0 else 0
    power = 0 if -4 < power < 6 else power
    text = f"<{NO_BREAK}{significant(value / 10.0**power, LIMIT_DIGITS)}"
    return PrintedNumber(text, NONE, _with_power(unit, power))


def printed_number(number: Number) -> PrintedNumber:
    """A `Number` as text: value and ± u to the place of u, a one-sided 95 % limit, or a dash.

    Examples
    --------
    >>> printed_number(Number(0.28041, 0.00142, unit="DN/e-")).joined()
    '0.2804 ± 0.0014 DN/e⁻'
    """
    unit = pretty_unit(number.unit)
    if not isfinite(number.value):
        return PrintedNumber(NONE, "", unit)
    if number.is_upper_limit:
        found = limit(number.value, number.unit)
        return PrintedNumber(found.value, f"(95{NO_BREAK}%)", found.unit)
    if number.is_lower_limit:
        return PrintedNumber(f">{NO_BREAK}{_rounded_down(number)}", f"(95{NO_BREAK}%)", unit)
    if number.u == 0:  # a setting or a place in a series
        return PrintedNumber(short(number.value, 6), "", unit)
    found = uncertain(number.value, number.u, number.unit)
    if not any(digit in found.value for digit in "123456789"):  # far less than its u: rounded as that is it would be 0
        found = PrintedNumber(short(number.value, 2), short(number.u, 2), unit)
    return PrintedNumber(found.value, "" if found.u == NONE else f"± {found.u}", found.unit)


def _rounded_down(number: Number) -> str:
    """A lower limit to the first digit of its u, never above it; a place in a series as it is."""
    if not (isfinite(number.u) and number.u > 0):
        return short(number.value, 6)
    places = decimals_of(number.u, 1)
    return fixed(floor(number.value * 10.0**places) / 10.0**places, places)


def _with_power(unit: str, power: int) -> str:
    name = pretty_unit(unit)
    return name if power == 0 else f"10{str(power).translate(SUPERSCRIPT)}{NO_BREAK}{name}".rstrip(NO_BREAK)


def pretty_unit(unit: str) -> str:
    """Unit with its typographic signs; the unit one is not written."""
    return "" if unit == "1" else unit.replace("e-", "e⁻").replace("^2", "²").replace("um", "µm")


def length_px(value: float, digits: int = 2) -> str:
    """A length in pixels to so many significant digits (one more from 0.1 on), never finer than a hundred-thousandth."""
    return _length(value, digits + (abs(value) >= 0.1), 5)


def length_mpx(value_px: float) -> str:
    """A length in thousandths of a pixel, never finer than a hundredth of that."""
    return _length(1000 * value_px, 2, 2)


def _length(value: float, digits: int, most_places: int) -> str:
    if not isfinite(value):
        return NONE
    if value == 0:
        return "0"
    if abs(value) < 0.5 * 10.0**-most_places:
        return f"<{THIN}{10.0**-most_places:.{most_places}f}"
    return fixed(value, min(max(decimals_of(value, digits), 0), most_places))


def length_um(value_px: float, pitch_um: float | None) -> str:
    """A length given in pixels, in µm; a dash where the pitch is unknown."""
    return NONE if pitch_um is None else length_px(value_px * pitch_um)


def percent(share: float) -> str:
    """A share of one as percent: whole above ten, one decimal below, ``<0.1`` for smaller shares."""
    if not isfinite(share):
        return NONE
    value = 100 * share
    if 0 < value < 0.05:
        return f"<{THIN}0.1"
    return fixed(value, 0 if abs(value) >= 9.95 else 1)


def signed(value: float, formatter: Callable[[float], str]) -> str:
    """Format with an explicit sign; a value too small to be shown is 0."""
    text = formatter(abs(value))
    if text == NONE:
        return text
    return "0" if text == "0" or text.startswith("<") else ("+" if value > 0 else MINUS) + text
