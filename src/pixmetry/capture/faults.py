"""Frames that a camera delivered told from those that were missed, damaged or doubled."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pixmetry.capture.camera import Grabbed

GOOD, DAMAGED, DOUBLED, MISSED = "good", "damaged", "doubled", "missed"
FAULTS = (MISSED, DAMAGED, DOUBLED)
WRAP = 1 << 15  # a counter that falls by more than this has begun anew (16-bit block numbers of GigE Vision)
OTHER_EXPOSURE_REL = 0.01  # from what was set, in a frame that tells its own


@dataclass(frozen=True)
class Verdict:
    """On one delivered frame: `GOOD`, `DAMAGED` or `DOUBLED`; ``missed`` is how many were lost before it; ``why`` is in words."""

    kind: str
    missed: int = 0
    why: str = ""


class Watch:
    """The faults of one run of frames, from start to stop.

    Parameters
    ----------
    bits : int
    shape : (int, int), optional
        Of the frames; by default that of the first good one.
    exposure_s : float, optional
        What was set.

    Notes
    -----
    Frames are missed where the camera's counter leaves numbers out; a damaged frame without a number takes the next one. A frame is
    doubled if its number does not rise, or if its pixels are those of the frame before, bit for bit, and not all are at an end of the
    scale: noise does not repeat.

    Examples
    --------
    >>> watch = Watch(bits=8)
    >>> frames = [np.full((2, 2), 10 + k, np.uint8) for k in range(4)]
    >>> [watch.judge(Grabbed(frames[k], number=n)).kind for k, n in ((0, 1), (1, 2), (1, 2))]
    ['good', 'good', 'doubled']
    >>> watch.judge(Grabbed(frames[2], number=5)).missed
    2
    """

    def __init__(self, bits: int, shape: tuple[int, int] | None = None, exposure_s: float | None = None) -> None:
        self.bits, self.shape, self.exposure_s = bits, shape, exposure_s
        self._number: int | None = None
        self._latest: np.ndarray | None = None

    def judge(self, frame: Grabbed) -> Verdict:
        """Say what a delivered frame is."""
        missed, repeated = self._count(frame.number)
        why = self._damage(frame)
        if why:
            return Verdict(DAMAGED, missed, why)
        assert frame.array is not None
        if repeated:
            return Verdict(DOUBLED, 0, f"number {frame.number} once more")
        if self._same(frame.array):
            return Verdict(DOUBLED, missed, "the pixels of the frame before")
        self._latest, self.shape = frame.array, (frame.array.shape[0], frame.array.shape[1])
        return Verdict(GOOD, missed)

    def _count(self, number: int | None) -> tuple[int, bool]:
        """Frames that are missing before this one, and whether its number was there already."""
        last = self._number
        if number is None:
            self._number = None if last is None else last + 1
            return 0, False
        if last is not None and last - WRAP < number <= last:
            return 0, True
        self._number = number
        return (0 if last is None or number < last else number - last - 1), False

    def _damage(self, frame: Grabbed) -> str:
        array = frame.array
        if array is None or not frame.complete:
            return frame.why or "incomplete"
        if array.ndim != 2 or array.dtype.kind not in "ui":
            return f"no grey image of whole numbers: {array.dtype}, {' x '.join(map(str, array.shape))}"
        if self.shape is not None and array.shape != self.shape:
            return f"{array.shape[1]} x {array.shape[0]} pixels in place of {self.shape[1]} x {self.shape[0]}"
        if array.size == 0:
            return "no pixels"
        if int(array.min()) < 0 or int(array.max()) >> self.bits:
            return f"values beyond {self.bits} bits"
        told = frame.exposure_s
        if told is not None and self.exposure_s and abs(told - self.exposure_s) > OTHER_EXPOSURE_REL * self.exposure_s:
            return f"exposed {told:g} s in place of {self.exposure_s:g} s"
        return ""

    def _same(self, array: np.ndarray) -> bool:
        if self._latest is None or not np.array_equal(array, self._latest):
            return False
        return bool(((array > 0) & (array < (1 << self.bits) - 1)).any())
