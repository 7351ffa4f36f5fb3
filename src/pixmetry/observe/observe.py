"""From the frames of a campaign to its observations, in one pass over the frames."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np

from pixmetry.camera.observations import (
    CodeErrors,
    CodeHistogram,
    DefectList,
    Observations,
    PatternList,
    PhotonTransfer,
    Spectra,
    StackMoments,
)
from pixmetry.core.errors import MeasureError
from pixmetry.core.number import Estimates
from pixmetry.core.threads import single_threaded_blas
from pixmetry.observe.defects import find_defects
from pixmetry.observe.histogram import HistogramAccumulator, code_errors, sweep_histogram
from pixmetry.observe.linearity import Linearity
from pixmetry.observe.moments import LevelSummary
from pixmetry.observe.one_pass import Group, Level, photon_transfer, reduce_groups, refuse_copies
from pixmetry.observe.partial_transfer import is_short, partial_transfer
from pixmetry.observe.patterns import find_phase_patterns
from pixmetry.observe.photon_transfer_fit import fit_photon_transfer
from pixmetry.observe.photon_transfer_levels import refuse_dead_series
from pixmetry.observe.spatial_fit import fit_dark_pattern, fit_spatial
from pixmetry.observe.stack import StackAccumulator, choose_stacks, same_exposure

__all__ = ["Group", "observe"]


@dataclass(frozen=True)
class _Stack:
    moments: StackMoments
    spectra: Spectra


def observe(
    groups: Iterable[Group],
    bits: int,
    temperature_c: float | None = None,
    *,
    threads: int | None = None,
    on_frames: Callable[[int], object] | None = None,
) -> Observations:
    """Reduce all frames of a campaign, then estimate what many sources share.

    Parameters
    ----------
    groups : iterable of Group
        Read one after the other, each frame once; memory grows with the number of stacks of different exposures, not with that of frames.
    bits : int
        Bits per stored code.
    temperature_c : float, optional
    threads : int, optional
        The results have the same bits for any number of them.
    on_frames : callable, optional
        Called with the number of frames that were done since the last call.

    Returns
    -------
    Observations

    Raises
    ------
    MeasureError
        If all bright frames are saturated, black or copies.
    """
    levels: dict[str, list[Level]] = {"dark": [], "bright": []}
    stacked: dict[str, list[Level]] = {"dark": [], "bright": []}
    stacks: dict[str, dict[float, _Stack]] = {"dark": {}, "bright": {}}
    histogram = HistogramAccumulator(bits)
    shape = None
    for group, [(sums, found)] in reduce_groups(groups, bits, threads=threads, on_frames=on_frames):
        shape = found
        condition = (group.kind, group.role, group.exposure_s, group.photons)
        if isinstance(sums, LevelSummary):
            histogram.add_counts(sums.counts, dark=group.kind == "dark", level=condition)
            refuse_copies(group, sums, bits)
            levels[group.kind].append(Level(sums, group.exposure_s, group.photons))
        elif isinstance(sums.moments, StackAccumulator) and sums.spectra is not None:
            histogram.add_counts(sums.moments.counts, dark=group.kind == "dark", level=condition)
            stacked[group.kind].append(Level(sums.moments.summary(), group.exposure_s, group.photons))
            kept = stacks[group.kind].get(group.exposure_s)
            if kept is None or sums.moments.n_frames > kept.moments.n_frames:
                stack = sums.moments.result(group.exposure_s)
                stacks[group.kind][group.exposure_s] = _Stack(stack, sums.spectra.result(stack.mean_map_dn))
    levels = {kind: found or stacked[kind] for kind, found in levels.items()}  # where there are only stacks, these
    counts = histogram.result()
    notes = _code_notes(counts)
    sweep = [level.summary for level in levels["bright"]]
    dark, bright = _pair(list(stacks["dark"].values()), list(stacks["bright"].values()))
    dark_stack, bright_stack = (None if s is None else s.moments for s in (dark, bright))
    transfer = photon_transfer(levels["dark"], levels["bright"], shape, bits)
    codes = _codes(sweep_histogram(sweep, bits), notes)
    with single_threaded_blas():
        fit = _transfer_fit(transfer, dark_stack, bright_stack, _dnl_lsb(codes), notes)
    if dark and not bright:
        notes.append("no stack of bright frames: PRNU is not measured (take 16 or more at half of saturation)")
    if dark and bright and not same_exposure(dark.moments, bright.moments):
        notes.append(_unpaired(dark, bright))
        bright = bright_stack = None  # a dark map of another exposure holds another dark current: their difference is not the light's
    dark_spectra, bright_spectra = (None if s is None else s.spectra for s in (dark, bright))
    with single_threaded_blas():
        defects, spatial, patterns = _spatial(dark_stack, bright_stack, dark_spectra, Linearity.of(fit, bits), _dnl_lsb(codes), notes)
    return Observations(
        photon_transfer=transfer,
        photon_transfer_fit=fit,
        dark_stack=dark_stack,
        bright_stack=bright_stack,
        dark_spectra=dark_spectra,
        bright_spectra=bright_spectra,
        histogram=counts,
        spatial_fit=spatial,
        defects=defects,
        patterns=patterns,
        code_errors=codes,
        temperature_c=temperature_c,
        notes=tuple(notes),
    )


def _transfer_fit(
    transfer: PhotonTransfer, dark: StackMoments | None, bright: StackMoments | None, dnl_lsb: float, notes: list[str]
) -> Estimates:
    """The joint fit; where the frames carry none, what they tell nevertheless, and a note."""
    if transfer.bright.mean_dn.size:
        refuse_dead_series(transfer)
    try:
        return fit_photon_transfer(transfer, dark, bright, dnl_lsb)
    except MeasureError as problem:
        found = partial_transfer(transfer, dark, straight=is_short(transfer))
        if not len(found) and not transfer.bright.mean_dn.size:
            raise
        missing = "non-linearity, saturation" if "gain_dn_per_e" in found else "gain, noise in electrons, non-linearity, saturation"
        notes.append(f"{missing} and what follows from them are not measured: {problem}")
        return found


def _code_notes(histogram: CodeHistogram) -> list[str]:
    """What the codes themselves tell of a wrong or shifted number of bits."""
    used = np.flatnonzero(histogram.counts)
    step, highest = int(np.gcd.reduce(used)), int(used.max())
    fitting = max(highest.bit_length(), 1)
    if (histogram.counts == histogram.dark_counts).all():  # dark frames alone reach no high code
        fitting = histogram.bits
    if step > 1 and step & (step - 1) == 0:
        shifted = f"all values are multiples of {step}: the data seem to be shifted left"
        return [f"{shifted}; gain and noise are in steps of the file, not of the converter"]
    if fitting < histogram.bits:
        return [f"no value is above {highest} although {histogram.bits} bits are declared: if the camera has fewer, write bits: {fitting}"]
    return []


def _pair(dark: list[_Stack], bright: list[_Stack]) -> tuple[_Stack | None, _Stack | None]:
    """Choose the dark and the bright stack that belong together."""
    d, b = choose_stacks([s.moments for s in dark], [s.moments for s in bright])
    return None if d is None else dark[d], None if b is None else bright[b]


def _unpaired(dark: _Stack, bright: _Stack) -> str:
    one, other = dark.moments.exposure_s, bright.moments.exposure_s
    return (
        f"no dark stack has the exposure of a bright one (nearest: dark {one:g} s, bright {other:g} s): PRNU, shading and the "
        f"response of single pixels are not measured (take 16 or more dark frames at {other:g} s)"
    )


def _spatial(
    dark: StackMoments | None,
    bright: StackMoments | None,
    spectra: Spectra | None,
    linearity: Linearity | None,
    dnl_lsb: float,
    notes: list[str],
) -> tuple[DefectList | None, Estimates | None, PatternList | None]:
    if dark is None:
        notes.append(
            "no stack of dark frames: DSNU, PRNU, defects and patterns are not measured (take 16 or more dark and as many bright frames)"
        )
        return None, None, None
    defects = find_defects(dark, bright)
    patterns = find_phase_patterns(dark, spectra, defects, dnl_lsb=dnl_lsb)
    try:
        if bright is None:
            return defects, fit_dark_pattern(dark, defects, patterns=patterns, dnl_lsb=dnl_lsb), patterns
        return defects, fit_spatial(dark, bright, defects, linearity=linearity, patterns=patterns, dnl_lsb=dnl_lsb), patterns
    except MeasureError as problem:
        notes.append(f"DSNU and PRNU are not measured: {problem}")
        return defects, None, patterns


def _dnl_lsb(codes: CodeErrors | None) -> float:
    """Standard deviation of the code widths; 0 where it is not significant."""
    if codes is None or "dnl_rms_lsb" not in codes.fit or codes.fit.limits:
        return 0.0
    return codes.fit["dnl_rms_lsb"].value


def _codes(counts, notes: list[str]) -> CodeErrors | None:
    try:
        return code_errors(counts)
    except MeasureError as problem:
        notes.append(f"code widths are not measured: {problem}")
        return None
