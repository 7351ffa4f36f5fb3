"""What may be said of one group of frames beside its kind, exposure and light."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class GroupFacts:
    """Facts of a group of frames; None where they were not stated, or are those of the whole campaign.

    Parameters
    ----------
    wavelength_nm : float or None
        Of the light.
    """

    wavelength_nm: float | None = None
