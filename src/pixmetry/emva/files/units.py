"""One spelling of each unit, whatever the file that it comes from."""

from __future__ import annotations

import re


def plain_unit(text: str | None) -> str:
    """Return a unit in plain letters: ``$e^-/\\mu m^2$`` and ``e-/um2`` become ``e⁻/µm²``; an empty one is ``1``.

    Examples
    --------
    >>> plain_unit("$DN/e^-$"), plain_unit("DN2"), plain_unit("p"), plain_unit("")
    ('DN/e⁻', 'DN²', 'photon', '1')
    """
    unit = re.sub(r"\\mu\s*|μ", "µ", text or "")  # the Greek letter becomes the micro sign
    unit = re.sub(r"[$\\{}\s]", "", unit).replace("^", "").replace("e-", "e⁻")
    unit = re.sub(r"\bum", "µm", unit)
    unit = re.sub(r"(?<=DN|µm)2\b", "²", unit)
    return re.sub(r"\bp\b|\bphotons\b", "photon", unit) or "1"
