"""GigE Vision and USB3 Vision cameras of all makes, through Aravis; its fake camera is one of them."""

from __future__ import annotations

from importlib import import_module
from typing import Any

import numpy as np

from pixmetry.capture.camera import Grabbed
from pixmetry.core.errors import InputError

VERSION = "0.8"
BUFFERS = 16
FORMATS = {"Mono16": 16, "Mono12": 12, "Mono10": 10, "Mono8": 8}
PREFERRED = (12, 10, 16, 8)


def aravis() -> Any:
    """The library, by its introspection.

    Raises
    ------
    InputError
        If it is not installed.
    """
    try:
        gi = import_module("gi")
        gi.require_version("Aravis", VERSION)
        return import_module("gi.repository.Aravis")
    except (ImportError, ValueError):
        what = f"Aravis {VERSION} with its introspection is not installed, and is needed for cameras of kind aravis"
        remedy = f"apt install gir1.2-aravis-{VERSION} python3-gi, and make pixmetry's environment with --system-site-packages"
        raise InputError(what, remedy=remedy) from None


class AravisCamera:
    """A camera that Aravis finds.

    Parameters
    ----------
    device : str
        Its identity, as of ``arv-tool``; empty for the first one; ``Fake_1`` for the fake camera.
    bits : int, optional
        8, 10, 12 or 16; by default the first of 12, 10, 16 and 8 that it has.

    Raises
    ------
    InputError
        If Aravis is not installed, or there is no such camera.
    """

    sets_exposure = True

    def __init__(self, device: str = "", bits: int | None = None) -> None:
        self._arv = aravis()
        if device.startswith("Fake"):
            self._arv.enable_interface("Fake")
        self._error = import_module("gi.repository.GLib").Error
        try:
            self._camera = self._arv.Camera.new(device or None)
        except self._error as problem:
            raise InputError("no such camera", where="aravis", value=device or None, allowed=problem.message) from None
        self._stream: Any = None
        self.name = f"{self._camera.get_vendor_name()} {self._camera.get_model_name()}"
        self.serial_number = self._text("get_device_serial_number")
        there = self._camera.dup_available_pixel_formats_as_strings()
        depths = [depth for name, depth in FORMATS.items() if name in there]
        chosen = next((depth for depth in ([bits] if bits is not None else PREFERRED) if depth in depths), None)
        if chosen is None:
            allowed = ", ".join(map(str, depths)) or "none"
            raise InputError("the camera has no such grey format", where=self.name, value=bits, allowed=f"{allowed} bits")
        self.bits = chosen
        self._camera.set_pixel_format_from_string(next(name for name, depth in FORMATS.items() if depth == chosen))
        for switch, off in (("set_exposure_time_auto", "OFF"), ("set_gain_auto", "OFF")):
            try:
                getattr(self._camera, switch)(getattr(self._arv.Auto, off))
            except self._error:  # a camera without automatic control
                continue
        low, high = self._bounds(self._camera.get_exposure_time_bounds())
        self.exposure_range_s = (1e-6 * low, 1e-6 * high)

    @staticmethod
    def _bounds(told: Any) -> tuple[float, float]:
        return float(told[0]), float(told[1])

    def _text(self, getter: str) -> str:
        try:
            return getattr(self._camera, getter)() or ""
        except (self._error, AttributeError):
            return ""

    def set_exposure(self, exposure_s: float) -> float:
        """Set the exposure time, and return what the camera made of it."""
        self._camera.set_exposure_time(1e6 * exposure_s)
        return 1e-6 * float(self._camera.get_exposure_time())

    def start(self) -> None:
        """Start a stream."""
        self._stream = self._camera.create_stream(None, None)
        size = self._camera.get_payload()
        for _ in range(BUFFERS):
            self._stream.push_buffer(self._arv.Buffer.new_allocate(size))
        self._camera.start_acquisition()

    def frame(self, timeout_s: float) -> Grabbed | None:
        """The next frame; None if none came in time."""
        buffer = self._stream.timeout_pop_buffer(int(1e6 * timeout_s))
        if buffer is None:
            return None
        try:
            status = buffer.get_status()
            number, stamp = int(buffer.get_frame_id()), int(buffer.get_timestamp())
            good = status == self._arv.BufferStatus.SUCCESS
            array = self._pixels(buffer) if good else None
        finally:
            self._stream.push_buffer(buffer)
        why = "" if good else status.value_nick.replace("-", " ")
        return Grabbed(array, number if number or good else None, 1e-9 * stamp if stamp else None, self._temperature(), None, good, why)

    def _pixels(self, buffer: Any) -> np.ndarray:
        cols, rows = buffer.get_image_width(), buffer.get_image_height()
        kind = np.dtype(np.uint8 if self.bits == 8 else "<u2")
        data = buffer.get_data()
        return np.frombuffer(data, kind, rows * cols).reshape(rows, cols).astype(kind.newbyteorder("="), copy=True)

    def _temperature(self) -> float | None:
        try:
            return float(self._camera.get_float("DeviceTemperature"))
        except self._error:
            return None

    def stop(self) -> None:
        """End the run."""
        self._camera.stop_acquisition()
        self._stream = None

    def close(self) -> None:
        """Give the camera back."""
        self._stream = None
        self._camera = None
