"""From frames to the input of a test by EMVA 1288, in one pass over the frames; a mosaic camera phase by phase."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace

import numpy as np

from pixmetry.camera.observations import PhotonTransfer, StackMoments
from pixmetry.core.errors import InputError, MeasureError
from pixmetry.emva.records import MONO, Measurement
from pixmetry.observe.defects import tail_of_counts
from pixmetry.observe.moments import LevelSummary
from pixmetry.observe.one_pass import Group, Level, Part, Reduced, photon_transfer, reduce_groups, refuse_copies, whole
from pixmetry.observe.stack import EQUAL_EXPOSURE, StackAccumulator, choose_stacks, same_exposure

__all__ = ["CHANNELS", "MOSAICS", "Group", "Phase", "measure_frames", "phases"]

MOSAICS = ("RGGB", "BGGR", "GRBG", "GBRG")  # colours of pixels (0,0), (0,1), (1,0), (1,1)
CHANNELS = ("R", "Gr", "Gb", "B")  # Gr and Gb: green in a row with red and with blue
MEDIAN_OF_CHI2 = 0.4549  # with one degree of freedom: of the flicker of two frames
UNEVEN = 7.0  # standard deviations
STACK_REMEDY = "take 16 or more dark frames, and as many at half of saturation, with the same exposure time"


@dataclass(frozen=True)
class Phase:
    """One position of a mosaic's cell of 2 x 2 pixels; incomplete cells at the edge of a frame are cut off."""

    row: int
    col: int

    def __call__(self, frame: np.ndarray) -> np.ndarray:
        rows, cols = (side - side % 2 for side in frame.shape)
        return frame[self.row : rows : 2, self.col : cols : 2]


def phases(cfa: str | None) -> dict[str, Part]:
    """Name the parts of a frame by channel: all of it, or the four phases of a colour filter.

    Raises
    ------
    InputError
        If there is no such filter.
    """
    if cfa is None:
        return {MONO: whole}
    if cfa not in MOSAICS:
        raise InputError("no such colour filter", value=cfa, allowed=", ".join(MOSAICS))
    named = {}
    for place, colour in enumerate(cfa):
        row, col = divmod(place, 2)
        name = colour if colour != "G" else "Gr" if "R" in cfa[2 * row : 2 * row + 2] else "Gb"
        named[name] = Phase(row, col)
    return {channel: named[channel] for channel in CHANNELS}


@dataclass
class _Channel:
    """What one channel's groups were reduced to so far."""

    levels: dict[str, list[Level]] = field(default_factory=lambda: {"dark": [], "bright": []})
    stacks: dict[str, list[tuple[StackMoments, float | None]]] = field(default_factory=lambda: {"dark": [], "bright": []})
    stacked: dict[str, list[Level]] = field(default_factory=lambda: {"dark": [], "bright": []})  # the stacks as levels
    shape: tuple[int, int] | None = None

    def add(self, group: Group, reduced: Reduced, bits: int) -> None:
        self.shape = reduced.shape
        if isinstance(reduced.sums, LevelSummary):
            refuse_copies(group, reduced.sums, bits)
            self.levels[group.kind].append(Level(_without_codes(reduced.sums), group.exposure_s, group.photons))
        elif isinstance(reduced.sums.moments, StackAccumulator):
            summary = _without_codes(reduced.sums.moments.summary())
            self.stacked[group.kind].append(Level(summary, group.exposure_s, group.photons))
            self.stacks[group.kind].append((reduced.sums.moments.result(group.exposure_s), group.photons))


def _without_codes(level: LevelSummary) -> LevelSummary:
    """Keep of the codes' occurrences the lowest, the highest, and all between together."""
    lowest, highest = level.counts[0], level.counts[-1]
    return replace(level, tail=tail_of_counts(level.counts), counts=np.array([lowest, level.counts.sum() - lowest - highest, highest]))


def measure_frames(
    groups: Iterable[Group],
    bits: int,
    *,
    cfa: str | None = None,
    pixel_area_um2: float | None = None,
    photons_u_rel: float = 0.0,
    threads: int | None = None,
    on_frames: Callable[[int], object] | None = None,
) -> tuple[Measurement, ...]:
    """Reduce the frames of a camera, each read once, in several threads.

    Parameters
    ----------
    groups : iterable of Group
        Memory grows with the number of stacks, not with that of frames.
    bits : int
        Bits per stored code.
    cfa : {"RGGB", "BGGR", "GRBG", "GBRG"}, optional
        The colour filter on the pixels (0,0), (0,1), (1,0), (1,1).
    pixel_area_um2 : float, optional
    photons_u_rel : float
        Relative standard uncertainty of the photon counts, common to all levels.
    threads : int, optional
        The results have the same bits for any number of them.
    on_frames : callable, optional
        Called with the number of frames that were done since the last call.

    Returns
    -------
    tuple of Measurement
        One for each channel: one, or R, Gr, Gb, B.

    Raises
    ------
    InputError
        If a frame does not fit, or there is no such colour filter.
    MeasureError
        If there are no frames, the frames of a level are copies, bright and dark are exchanged, or all is saturated.
    """
    parts = phases(cfa)
    channels = {name: _Channel() for name in parts}
    for group, reduced in reduce_groups(groups, bits, parts=list(parts.values()), spectra_pairs=0, threads=threads, on_frames=on_frames):
        for channel, part in zip(channels.values(), reduced, strict=True):
            channel.add(group, part, bits)
    return tuple(
        replace(_measurement(channel, bits, name), pixel_area_um2=pixel_area_um2, photons_u_rel=photons_u_rel)
        for name, channel in channels.items()
    )


def _measurement(channel: _Channel, bits: int, name: str) -> Measurement:
    levels = {kind: found or channel.stacked[kind] for kind, found in channel.levels.items()}  # where there are only stacks, these
    transfer = photon_transfer(levels["dark"], levels["bright"], channel.shape, bits)
    dark, bright, photons, notes = _stacks(channel)
    if transfer.bright.mean_dn.size and transfer.dark.mean_dn.size:
        _refuse_exchanged(transfer)
        notes = (*notes, *_uneven_pairs(transfer))
    if transfer.bright.mean_dn.size:
        _refuse_saturated(transfer.bright.fraction_max, name)
    return Measurement(transfer, dark, bright, photons, channel=name, notes=notes)


def _uneven_pairs(transfer: PhotonTransfer) -> list[str]:
    """Name the bright levels whose frames differ by more than 1 %, and by far more than noise and the light's usual flicker allow."""
    b, (rows, cols) = transfer.bright, transfer.frame_shape
    signal = np.maximum(b.mean_dn - transfer.dark.mean_dn.min(), 1e-9)
    noise = b.ms_row_dn2 / rows + b.ms_col_dn2 / cols - b.ms_pixel_dn2 / (rows * cols)  # of a frame's mean
    flicker = float(np.median(np.maximum(b.ms_frame_dn2 - noise, 0.0) / signal**2)) / MEDIAN_OF_CHI2
    allowed = noise + flicker * signal**2
    change = np.sqrt(2 * b.ms_frame_dn2) / signal
    times = np.sqrt(b.ms_frame_dn2 / np.where(allowed > 0, allowed, np.inf))
    return [
        f"the frames of bright level {k + 1} (mean {b.mean_dn[k]:.4g} DN) differ by {100 * change[k]:.2g} %, "
        f"{times[k]:.2g} times what noise and the light's flicker allow: they may have been taken under different light"
        for k in np.flatnonzero((change > 0.01) & (times > UNEVEN))
    ]


def _stacks(channel: _Channel) -> tuple[StackMoments | None, StackMoments | None, float | None, tuple[str, ...]]:
    """The dark and the bright stack that belong together, the light of the bright one, and what has to be said of them."""
    darks, brights = channel.stacks["dark"], channel.stacks["bright"]
    d, b = choose_stacks([stack for stack, _ in darks], [stack for stack, _ in brights])
    dark = None if d is None else darks[d][0]
    bright, photons = (None, None) if b is None else brights[b]
    if dark is None and bright is None:
        return None, None, None, (f"no stacks of frames: there are no values of non-uniformity ({STACK_REMEDY})",)
    if dark is None or bright is None:
        missing = "dark" if dark is None else "bright"
        return dark, bright, photons, (f"no stack of {missing} frames: values of non-uniformity are missing ({STACK_REMEDY})",)
    if not same_exposure(dark, bright):
        gap = f"dark {dark.exposure_s:g} s, bright {bright.exposure_s:g} s"
        what = "no dark stack has the exposure time of a bright one, so the light is not the only difference between them"
        return dark, None, None, (f"{what} (nearest: {gap}): PRNU is not measured ({STACK_REMEDY})",)
    return dark, bright, photons, ()


def _refuse_exchanged(transfer: PhotonTransfer) -> None:
    """Refuse a series whose brightest level lies below a dark level that was exposed no longer, by more than the noise of a pixel."""
    bright, dark = transfer.bright, transfer.dark
    b = int(np.argmax(bright.mean_dn))
    no_longer = np.flatnonzero(dark.exposure_s <= bright.exposure_s[b] * (1 + EQUAL_EXPOSURE))
    if not no_longer.size:
        return
    d = no_longer[np.argmax(dark.exposure_s[no_longer])]
    if bright.mean_dn[b] < dark.mean_dn[d] - np.sqrt(dark.var_total_dn2[d]):
        raise MeasureError(
            f"bright levels are darker than the dark ones (mean {bright.mean_dn[b]:.4g} DN against {dark.mean_dn[d]:.4g} DN "
            f"at {dark.exposure_s[d]:.4g} s)",
            where="exposure series",
            allowed="bright above dark",
            remedy="check whether bright and dark frames are exchanged",
        )


def _refuse_saturated(fraction_max: np.ndarray, channel: str) -> None:
    """Refuse a series that is all white: nothing can be measured from it."""
    if np.min(fraction_max) > 0.5:
        raise MeasureError(
            "all bright levels are saturated",
            where="exposure series" if channel == MONO else f"exposure series, channel {channel}",
            value=f"{100 * np.min(fraction_max):.0f} % of the pixels at the highest code in the darkest level",
            remedy="take levels from dark to saturation, evenly spaced",
        )
