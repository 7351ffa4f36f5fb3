"""What was said of a camera and its lens before anything was measured, as far as measurements need it."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class StatedFacts:
    """Facts from the manifest of a campaign; None where they were not said.

    Parameters
    ----------
    interface : {"digital", "analogue"}
    pixel_clock_mhz : float or None
    sampling_clock_mhz : float or None
        Of a frame grabber with a clock of its own.
    line_time_us : float or None
        From row to row as they are read; of two fields from line to line.
    pitch_x_um, pitch_y_um : float or None
    wavelength_nm : float or None
        Of the light.
    f_number : float or None
        Working f-number of the lens.
    sensor_cols, sensor_rows : int or None
        Active pixels of the whole sensor.
    """

    interface: str = "digital"
    pixel_clock_mhz: float | None = None
    sampling_clock_mhz: float | None = None
    line_time_us: float | None = None
    pitch_x_um: float | None = None
    pitch_y_um: float | None = None
    wavelength_nm: float | None = None
    f_number: float | None = None
    sensor_cols: int | None = None
    sensor_rows: int | None = None
