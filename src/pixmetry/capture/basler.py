"""Cameras of Basler, through pypylon; with ``PYLON_CAMEMU=1`` in the environment its emulator is one of them."""

from __future__ import annotations

from typing import Any

from pixmetry.capture.camera import Grabbed
from pixmetry.core.errors import InputError
from pixmetry.core.extras import import_extra

EXPOSURES = ("ExposureTime", "ExposureTimeAbs")  # µs; the second of older GigE cameras
TEMPERATURES = ("DeviceTemperature", "TemperatureAbs")
AUTOMATIC = ("ExposureAuto", "GainAuto")
TICKS = ("GevTimestampTickFrequency",)  # per second; of other cameras a tick is 1 ns
FORMATS = {16: "Mono16", 12: "Mono12", 10: "Mono10", 8: "Mono8"}


class BaslerCamera:
    """A camera that pypylon finds.

    Parameters
    ----------
    serial_number : str
        Or part of its name; empty for the first camera.
    bits : int, optional
        8, 10, 12 or 16; by default 12, or else what the camera has.

    Raises
    ------
    InputError
        If pypylon is not installed, or there is no such camera.
    """

    sets_exposure = True

    def __init__(self, serial_number: str = "", bits: int | None = None) -> None:
        self._pylon = import_extra("pypylon.pylon")
        factory = self._pylon.TlFactory.GetInstance()
        found = list(factory.EnumerateDevices())
        names = [f"{d.GetModelName()} {d.GetSerialNumber()}".strip() for d in found]
        at = next((k for k, name in enumerate(names) if serial_number in name), None)
        if at is None:
            allowed = ", ".join(names) or "none is connected"
            raise InputError("no such camera", where="basler", value=serial_number or None, allowed=allowed, remedy="check cable and power")
        try:
            self._camera = self._pylon.InstantCamera(factory.CreateDevice(found[at]))
            self._camera.Open()
        except self._pylon.GenericException as problem:
            remedy = "close the program that has it open"
            raise InputError("the camera cannot be opened", where=names[at], value=str(problem).strip(), remedy=remedy) from None
        self.name = f"{found[at].GetVendorName()} {found[at].GetModelName()}"
        self.serial_number = found[at].GetSerialNumber()
        for name in AUTOMATIC:
            self._set(name, "Off")
        self.bits = self._choose_format(bits)
        exposures = [node for node in map(self._node, EXPOSURES) if node is not None]
        if not exposures:
            raise InputError("the camera has no exposure time that can be set", where=self.name)
        self._exposure: Any = exposures[0]
        self.exposure_range_s = (1e-6 * self._exposure.Min, 1e-6 * self._exposure.Max)
        ticks = self._node(TICKS[0])
        self._ticks_per_s = float(ticks.Value) if ticks is not None else 1e9

    def _node(self, name: str) -> Any:
        """A feature of the camera; None where this one does not have it."""
        try:
            node = getattr(self._camera, name)
            node.Value  # noqa: B018 - reading it tells whether it is there
        except self._pylon.GenericException:
            return None
        return node

    def _set(self, name: str, value: Any) -> None:
        node = self._node(name)
        if node is not None:
            node.Value = value

    def _choose_format(self, bits: int | None) -> int:
        there = self._camera.PixelFormat.Symbolics
        for depth in [bits] if bits is not None else [12, 10, 16, 8]:
            if FORMATS.get(depth) in there:
                self._camera.PixelFormat.Value = FORMATS[depth]
                return depth
        depths = ", ".join(str(depth) for depth, name in FORMATS.items() if name in there)
        raise InputError("the camera has no such grey format", where=self.name, value=bits, allowed=f"{depths or 'none'} bits")

    def set_exposure(self, exposure_s: float) -> float:
        """Set the exposure time, and return what the camera made of it."""
        self._exposure.Value = min(max(1e6 * exposure_s, self._exposure.Min), self._exposure.Max)
        return 1e-6 * float(self._exposure.Value)

    def start(self) -> None:
        """Start to grab; every frame is delivered, in order."""
        self._camera.StartGrabbing(self._pylon.GrabStrategy_OneByOne)

    def frame(self, timeout_s: float) -> Grabbed | None:
        """The next frame; None if none came in time."""
        result = self._camera.RetrieveResult(int(1e3 * timeout_s), self._pylon.TimeoutHandling_Return)
        if not result.IsValid():
            return None
        try:
            good = result.GrabSucceeded()  # the error code of an incomplete buffer may be 0
            array = result.Array.copy() if good else None
            number = int(result.BlockID)
            stamp = int(result.TimeStamp)
            why = "" if good else result.ErrorDescription or "incomplete"
        finally:
            result.Release()
        counted = good and 0 <= number < (1 << 63)
        time_s = stamp / self._ticks_per_s if stamp else None
        return Grabbed(array, number if counted else None, time_s, self._temperature(), complete=good, why=why)

    def _temperature(self) -> float | None:
        node = next((node for name in TEMPERATURES if (node := self._node(name)) is not None), None)
        return None if node is None else float(node.Value)

    def stop(self) -> None:
        """End the run."""
        self._camera.StopGrabbing()

    def close(self) -> None:
        """Give the camera back."""
        self._camera.Close()
