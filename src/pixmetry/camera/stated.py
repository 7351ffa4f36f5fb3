"""What was said of a camera and its lens before anything was measured, as far as measurements need it."""

from __future__ import annotations

from dataclasses import dataclass

SAME_CLOCK = 1e-5  # relative: a hundredth of a pixel over a thousand


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

    @property
    def samples_per_pixel(self) -> float:
        """Sampling clock over pixel clock; 1 where they are not both stated, or are the same."""
        return self.sampling_clock_mhz / self.pixel_clock_mhz if self.own_clock else 1.0  # type: ignore[operator]

    @property
    def own_clock(self) -> bool:
        """Whether the frame grabber samples at another rate than the pixel clock."""
        if self.sampling_clock_mhz is None or self.pixel_clock_mhz is None:
            return False
        return abs(self.sampling_clock_mhz / self.pixel_clock_mhz - 1) > SAME_CLOCK
