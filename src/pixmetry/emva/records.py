"""Input and result of a test by EMVA 1288. Records only."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from pixmetry.camera.observations import PhotonTransfer, StackMoments
from pixmetry.core.arrays import Array
from pixmetry.core.number import Number

RELEASES = ("4.0", "3.1", "reference")
MONO = "mono"


@dataclass(frozen=True)
class FrameProducts:
    """Products of the frames of a stack with each other: what a bootstrap over its L frames needs. Arrays have shape (L, L), DN².

    ``pixel`` holds ⟨y_k y_l⟩ − µ_k µ_l over the pixels, ``row`` and ``col`` the same of row means and column means; ``means_dn``, shape
    (L,), the frame means. ``high_passed`` holds the same of frames from which the illumination was taken (R4.0 §8.1).
    """

    pixel_dn2: Array
    row_dn2: Array
    col_dn2: Array
    means_dn: Array
    high_passed: FrameProducts | None = None


@dataclass(frozen=True)
class Measurement:
    """Reduced data of the frames of one channel of one camera."""

    transfer: PhotonTransfer  # bright levels by exposure, then photons; dark levels by exposure
    dark_stack: StackMoments | None = None
    bright_stack: StackMoments | None = None
    bright_stack_photons: float | None = None
    pixel_area_um2: float | None = None
    photons_u_rel: float = 0.0  # relative standard uncertainty of the photon counts, common to all levels
    dark_products: FrameProducts | None = None  # where a bootstrap was asked for
    bright_products: FrameProducts | None = None
    channel: str = MONO  # or the place in the colour filter's cell: "R", "Gr", "Gb", "B"
    notes: tuple[str, ...] = ()  # what has to be said of the frames


@dataclass(frozen=True)
class Series:
    """The exposure series as the standard takes it: each bright level beside the dark level of its exposure.

    Arrays of measured values have shape (..., levels): leading axes are draws of a simulation or of a bootstrap.
    """

    exposure_s: Array
    photons: Array | None
    mean_dn: Array
    var_dn2: Array  # temporal
    spatial_var_dn2: Array  # of the image behind the noise, from two frames (R4.0 eq. 32)
    dark_mean_dn: Array  # of the dark level with the exposure of the bright one
    dark_var_dn2: Array
    dark_spatial_var_dn2: Array
    fraction_min: Array  # share of pixels at the lowest code
    fraction_max: Array
    # the dark series by itself, shape (..., dark levels)
    dark_exposure_s: Array
    own_dark_mean_dn: Array
    own_dark_var_dn2: Array


@dataclass(frozen=True)
class Results:
    """Values and curves of one channel by one release; keys as in ``pixmetry.emva.files.keys``."""

    release: str
    values: Mapping[str, Number]
    curves: Mapping[str, Mapping[str, Array]] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    channel: str = MONO


@dataclass(frozen=True)
class DataSheet:
    """Everything there is to say of one camera under one set of conditions."""

    results: tuple[Results, ...]  # one per channel
    camera: Mapping[str, Any]  # name, bits, rows, cols, pitch_x_um, pitch_y_um, temperature_c, wavelength_nm, …; what is known
    conditions: Mapping[str, Any]  # numbers of levels and frames, exposures, photons, release
    provenance: Mapping[str, Any]
    licence: str = ""
