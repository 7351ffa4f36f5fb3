"""From the frames of a campaign to its observations, in one pass over the frames."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from pixmetry.core.errors import MeasureError
from pixmetry.core.estimates import Estimates
from pixmetry.core.observations import (
    CodeErrors,
    CodeHistogram,
    DefectList,
    LevelMoments,
    Observations,
    PatternList,
    PhotonTransfer,
    Spectra,
    StackMoments,
)
from pixmetry.core.threads import single_threaded_blas
from pixmetry.experiment.defects import find_defects
from pixmetry.experiment.histogram import HistogramAccumulator, code_errors, sweep_histogram
from pixmetry.experiment.linearity import Linearity
from pixmetry.experiment.moments import LevelAccumulator, LevelSummary, level_moments
from pixmetry.experiment.patterns import find_phase_patterns
from pixmetry.experiment.photon_transfer_fit import fit_photon_transfer
from pixmetry.experiment.spatial_fit import fit_spatial
from pixmetry.experiment.stack import StackAccumulator, new_group

EQUAL_EXPOSURE = 0.01  # relative; clocks round
SATURATED_FRACTION = 0.002  # EMVA 1288 R4.0 §6.6


@dataclass(frozen=True)
class Group:
    """Frames of one condition, as they come from the reader."""

    kind: str  # "dark" or "bright"
    role: str  # "level" or "stack"
    exposure_s: float
    photons: float | None
    frames: Iterable[np.ndarray]


@dataclass(frozen=True)
class _Level:
    summary: LevelSummary
    exposure_s: float
    photons: float | None


@dataclass(frozen=True)
class _Stack:
    moments: StackMoments
    spectra: Spectra


def observe(groups: Iterable[Group], bits: int, temperature_c: float | None = None) -> Observations:
    """Reduce all frames of a campaign, then estimate what many sources share.

    Parameters
    ----------
    groups : iterable of Group
        Read one after the other, each frame once; memory grows with the number of stacks of different exposures, not with that of frames.
    bits : int
        Bits per stored code.
    temperature_c : float, optional

    Returns
    -------
    Observations

    Raises
    ------
    MeasureError
        If the frames carry no photon transfer: all saturated, all black, too few levels.
    """
    levels: dict[str, list[_Level]] = {"dark": [], "bright": []}
    stacks: dict[str, dict[float, _Stack]] = {"dark": {}, "bright": {}}
    histogram, sweep = HistogramAccumulator(bits), []
    shape = None
    for group in groups:
        reduction = new_group(bits, group.role)
        for frame in group.frames:
            reduction.add(frame)
        moments = reduction.moments
        shape = moments.shape
        level = (group.kind, group.role, group.exposure_s, group.photons)
        histogram.add_counts(moments.counts, dark=group.kind == "dark", level=level)
        if isinstance(moments, LevelAccumulator):
            levels[group.kind].append(_Level(moments.summary(), group.exposure_s, group.photons))
            if group.kind == "bright":
                sweep.append(levels["bright"][-1].summary)
                _refuse_copies(levels["bright"][-1], bits)
        elif isinstance(moments, StackAccumulator):
            kept = stacks[group.kind].get(group.exposure_s)
            if kept is None or moments.n_frames > kept.moments.n_frames:
                stack = moments.result(group.exposure_s)
                stacks[group.kind][group.exposure_s] = _Stack(stack, reduction.spectra.result(stack.mean_map_dn))
    counts = histogram.result()
    notes = _code_notes(counts)
    dark, bright = _pair(list(stacks["dark"].values()), list(stacks["bright"].values()))
    dark_stack, bright_stack = (None if s is None else s.moments for s in (dark, bright))
    transfer = _photon_transfer(levels, shape, bits)
    codes = _codes(sweep_histogram(sweep, bits), notes)
    with single_threaded_blas():
        fit = fit_photon_transfer(transfer, dark_stack, bright_stack, _dnl_lsb(codes))
    if dark and not bright:
        notes.append("no stack of bright frames: DSNU and PRNU are not measured (take 16 or more at half of saturation)")
    if dark and bright and not _same_exposure(dark, bright):
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


def _refuse_copies(level: _Level, bits: int) -> None:
    """Refuse a bright level whose frames are the same picture; at either end of the codes frames may be alike."""
    between = 0 < level.summary.mean_dn < 2**bits - 1
    ends = (level.summary.counts[0] + level.summary.counts[-1]) / level.summary.counts.sum()
    if between and ends < 0.5 and level.summary.squares.total_dn2 == 0:
        raise MeasureError(
            f"the frames of a level are identical (bright, exposure {level.exposure_s:g} s): there is no temporal noise to measure",
            where="photon transfer",
            remedy="list frames that were taken one after the other, not copies, averages or synthetic frames",
        )


def _code_notes(histogram: CodeHistogram) -> list[str]:
    """What the codes themselves tell of a wrong or shifted number of bits."""
    used = np.flatnonzero(histogram.counts)
    step, highest = int(np.gcd.reduce(used)), int(used.max())
    fitting = max(highest.bit_length(), 1)
    if step > 1 and step & (step - 1) == 0:
        shifted = f"all values are multiples of {step}: the data seem to be shifted left"
        return [f"{shifted}; gain and noise are in steps of the file, not of the converter"]
    if fitting < histogram.bits:
        return [f"no value is above {highest} although {histogram.bits} bits are declared: if the camera has fewer, write bits: {fitting}"]
    return []


def _pair(dark: list[_Stack], bright: list[_Stack]) -> tuple[_Stack | None, _Stack | None]:
    """Choose the dark and the bright stack that belong together: of equal or nearest exposure.

    Of several such pairs one that is not saturated, then the longest exposure, then the most frames. With stacks of one kind only, the
    one of the most frames.
    """
    if not dark or not bright:
        most = [max(part, key=lambda s: (s.moments.n_frames, s.moments.exposure_s), default=None) for part in (dark, bright)]
        return most[0], most[1]

    def rank(pair: tuple[_Stack, _Stack]) -> tuple[float, bool, float, int]:
        d, b = pair[0].moments, pair[1].moments
        saturated = b.fraction_max - d.fraction_max > SATURATED_FRACTION
        gap = 0.0 if _same_exposure(*pair) else abs(np.log(max(d.exposure_s, 1e-9) / max(b.exposure_s, 1e-9)))
        return gap, saturated, -b.exposure_s, -min(d.n_frames, b.n_frames)

    return min(((d, b) for d in dark for b in bright), key=rank)


def _same_exposure(dark: _Stack, bright: _Stack) -> bool:
    one, other = dark.moments.exposure_s, bright.moments.exposure_s
    return abs(one - other) <= EQUAL_EXPOSURE * max(one, other)


def _unpaired(dark: _Stack, bright: _Stack) -> str:
    one, other = dark.moments.exposure_s, bright.moments.exposure_s
    return (
        f"no dark stack has the exposure of a bright one (nearest: dark {one:g} s, bright {other:g} s): DSNU, PRNU, shading and the "
        f"response of single pixels are not measured (take 16 or more dark frames at {other:g} s)"
    )


def _photon_transfer(levels: dict[str, list[_Level]], shape: tuple[int, int] | None, bits: int) -> PhotonTransfer:
    for kind in ("dark", "bright"):
        if not levels[kind]:
            raise MeasureError(
                f"no {kind} levels of an exposure series",
                where="photon transfer",
                remedy=f"add {kind} groups of two frames; a group of 8 or more frames counts as a stack unless its role says 'level'",
            )

    def moments(kind: str) -> LevelMoments:
        part = levels[kind]
        photons = [v.photons for v in part]
        known = None if any(v is None for v in photons) else [float(v) for v in photons if v is not None]
        return level_moments([v.summary for v in part], [v.exposure_s for v in part], known)

    assert shape is not None
    return PhotonTransfer(moments("bright"), moments("dark"), shape, bits)


def _spatial(
    dark: StackMoments | None, bright: StackMoments | None, spectra: Spectra | None, linearity: Linearity, dnl_lsb: float, notes: list[str]
) -> tuple[DefectList | None, Estimates | None, PatternList | None]:
    if dark is None:
        notes.append(
            "no stack of dark frames: DSNU, PRNU, defects and patterns are not measured (take 16 or more dark and as many bright frames)"
        )
        return None, None, None
    defects = find_defects(dark, bright)
    patterns = find_phase_patterns(dark, spectra, defects, dnl_lsb=dnl_lsb)
    if bright is None:
        return defects, None, patterns
    try:
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
