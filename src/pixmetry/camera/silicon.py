"""Silicon as light meets it: how strongly it absorbs, and how it refracts.

Reference: M. A. Green, "Self-consistent optical parameters of intrinsic silicon at 300 K including temperature coefficients", Solar
Energy Materials & Solar Cells 92 (2008) 1305–1310, table 1, every 20 nm from 300 nm to 1200 nm.
"""

from __future__ import annotations

import numpy as np

from pixmetry.core.arrays import Array
from pixmetry.core.errors import ParameterError

FIRST_NM, LAST_NM = 300.0, 1200.0
WAVELENGTH_NM = np.arange(300.0, 1201.0, 20.0)
ABSORPTION_PER_CM = np.array(
    [1.77e6, 1.30e6, 1.10e6, 1.04e6, 3.13e5, 9.30e4, 5.27e4, 3.07e4, 1.95e4, 1.44e4, 1.11e4, 8800.0, 7050.0, 5780.0, 4880.0]
    + [4175.0, 3520.0, 3030.0, 2570.0, 2200.0, 1890.0, 1680.0, 1420.0, 1190.0, 1030.0, 850.0, 707.0, 590.0, 479.0, 383.0]
    + [303.0, 240.0, 183.0, 134.0, 96.0, 64.0, 39.9, 22.6, 11.1, 6.2, 3.5, 2.0, 1.0, 0.42, 6.5e-2, 2.2e-2]
)
REFRACTIVE_INDEX = np.array(
    [4.976, 5.112, 5.301, 6.026, 6.616, 5.613, 5.119, 4.812, 4.587, 4.419, 4.294, 4.193, 4.112, 4.045, 3.988]
    + [3.940, 3.898, 3.861, 3.828, 3.798, 3.772, 3.748, 3.727, 3.708, 3.691, 3.675, 3.661, 3.647, 3.635, 3.624]
    + [3.614, 3.604, 3.595, 3.587, 3.579, 3.572, 3.565, 3.559, 3.553, 3.547, 3.542, 3.537, 3.532, 3.528, 3.524, 3.520]
)


def absorption_per_um(wavelength_nm: np.ndarray | float) -> np.ndarray:
    """Absorption coefficient at 300 K in 1/µm, interpolated in its logarithm; constant beyond 300 nm and 1200 nm."""
    absorption: Array = np.exp(np.interp(wavelength_nm, WAVELENGTH_NM, np.log(ABSORPTION_PER_CM))) * 1e-4
    return absorption


def refractive_index(wavelength_nm: np.ndarray | float) -> np.ndarray:
    """Real part of the refractive index at 300 K."""
    index: Array = np.interp(wavelength_nm, WAVELENGTH_NM, REFRACTIVE_INDEX)
    return index


def absorption_per_cm(wavelength_nm: np.ndarray | float) -> np.ndarray:
    """Absorption coefficient at 300 K in 1/cm, within the table only.

    Raises
    ------
    ParameterError
        If a wavelength is outside 300 nm to 1200 nm.
    """
    wavelength = np.asarray(wavelength_nm, float)
    if not ((wavelength >= FIRST_NM) & (wavelength <= LAST_NM)).all():
        raise ParameterError("the absorption of silicon at this wavelength is not known", value=wavelength_nm, allowed="300 nm to 1200 nm")
    return absorption_per_um(wavelength) * 1e4
