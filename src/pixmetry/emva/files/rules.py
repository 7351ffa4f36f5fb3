"""Limits that EMVA 1288 sets and several modules share, each from the place where it is at home."""

from pixmetry.observe.photon_transfer_model import MINIMUM_DARK_VAR_DN2, QUANTISATION_DN2
from pixmetry.observe.stack import EQUAL_EXPOSURE, SATURATED_FRACTION

__all__ = [
    "EQUAL_EXPOSURE",
    "FIT_RANGE",
    "MINIMUM_DARK_VAR_DN2",
    "PTC_LIMIT_PERCENT",
    "QUANTISATION_DN2",
    "SATURATED_FRACTION",
    "UNDERFLOW_FRACTION",
]

FIT_RANGE = 0.7  # of saturation, for responsivity and gain (R4.0 §6.6)
UNDERFLOW_FRACTION = 0.005  # of the dark pixels at the lowest code (R4.0 §6.5)
PTC_LIMIT_PERCENT = 3.0  # departure of the photon transfer's local slope up to which the Linear model is used (R4.0 eq. 51)
