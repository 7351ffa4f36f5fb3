"""Live cameras by their names on the command line."""

from __future__ import annotations

from pixmetry.capture.camera import LiveCamera
from pixmetry.core.errors import InputError
from pixmetry.files.raw_values import layout_of

KINDS = ("folder", "basler", "aravis")


def open_camera(source: str, bits: int | None = None, raw: str | None = None) -> LiveCamera:
    """Open a live camera.

    Parameters
    ----------
    source : str
        ``folder:PATH``, ``basler`` or ``aravis``, the two latter with ``:`` and a serial number or name if there are several cameras.
    bits : int, optional
        Of a stored value; a folder needs it.
    raw : str, optional
        Layout of files without a header, as of `pixmetry locate`.

    Raises
    ------
    InputError
        If there is no such camera, or the package that it needs is not installed.

    Examples
    --------
    >>> open_camera("webcam")
    Traceback (most recent call last):
    ...
    pixmetry.core.errors.InputError: no such kind of camera; found 'webcam'; allowed: folder:PATH, basler[:SERIAL], aravis[:NAME]
    """
    kind, _, which = source.partition(":")
    if kind == "folder":
        from pixmetry.capture.folder import FolderCamera

        if bits is None:
            raise InputError("the bits of a stored value are not known", where=source, allowed="1 to 16", remedy="add --bits")
        return FolderCamera(which or ".", bits, raw=layout_of(raw))
    if kind == "basler":
        from pixmetry.capture.basler import BaslerCamera

        return BaslerCamera(which, bits)
    if kind == "aravis":
        from pixmetry.capture.aravis import AravisCamera

        return AravisCamera(which, bits)
    allowed = "folder:PATH, basler[:SERIAL], aravis[:NAME]"
    raise InputError("no such kind of camera", value=source, allowed=allowed)
