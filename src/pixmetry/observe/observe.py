"""From the frames of a campaign to its observations, in one pass over the frames."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace

import numpy as np

from pixmetry.camera.code_table import CodeTable
from pixmetry.camera.noise_covariance import MOSAIC, WHITE, NoiseCovariance, NoiseFilter, frames_share_noise, shared_by_frames
from pixmetry.camera.observations import (
    CodeErrors,
    CodeHistogram,
    ColourCells,
    DefectList,
    LevelMoments,
    Observations,
    PatternList,
    PhotonTransfer,
    SingleOutliers,
    Spectra,
    StackMoments,
)
from pixmetry.camera.stated import StatedFacts
from pixmetry.core.errors import MeasureError
from pixmetry.core.number import ONE_SIDED_95, Estimates
from pixmetry.core.threads import single_threaded_blas
from pixmetry.observe import photon_transfer_model as model
from pixmetry.observe.colour_cells import balanced, find_colour_cells
from pixmetry.observe.companding import find_code_table, without_steps
from pixmetry.observe.dark_rows import reduce_dark_rows, without_hum
from pixmetry.observe.defects import find_defects, without_hot_pixels
from pixmetry.observe.edges import LINE_START_PX
from pixmetry.observe.experiment import PictureGroup
from pixmetry.observe.experiments import reduce_pictures
from pixmetry.observe.histogram import HistogramAccumulator, code_errors, sweep_histogram
from pixmetry.observe.linearity import Linearity
from pixmetry.observe.moments import LevelSummary
from pixmetry.observe.noise_covariance import CorrelatedGroup, FrameSuccession, LagProducts, noise_covariance
from pixmetry.observe.noise_filter import LARGEST_ALPHA, before_correlation, find_noise_filter, fit_unfiltered, unseen_rms
from pixmetry.observe.one_pass import Group, Level, photon_transfer, reduce_groups, refuse_copies, without_levels
from pixmetry.observe.outliers import cut_of, single_outliers
from pixmetry.observe.patterns import find_phase_patterns
from pixmetry.observe.photon_transfer_levels import (
    MINIMUM_LEVELS,
    NONLINEARITY_PRIOR,
    core_spread_dn2,
    refuse_dead_series,
    temporal_row_col_vars,
    unclipped_bright,
    with_stacks,
)
from pixmetry.observe.spatial_fit import fit_dark_pattern, fit_spatial, with_shading_of, without_columns, without_defects
from pixmetry.observe.stack import SATURATED_FRACTION, RowMeans, StackAccumulator, choose_stacks, same_exposure
from pixmetry.observe.tap_steps import evened, find_taps, with_steps_in_slope

__all__ = ["Group", "observe"]
NOT_SIGNIFICANT = 3.0
METHOD = "mean squares of the differences of dark frames"
METHOD_WITH_LIGHT = f"{METHOD}; gain from variance and mean of one light level"
ONE_LIGHT = "from one light level: u includes that the response may deviate from a straight line by 10 % over the range"


@dataclass(frozen=True)
class _Stack:
    moments: StackMoments
    spectra: Spectra
    rows: RowMeans | None = None


def observe(
    groups: Iterable[Group],
    bits: int,
    temperature_c: float | None = None,
    stated: StatedFacts | None = None,
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
    stated : StatedFacts, optional
        What the manifest says of camera and lens.
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
        If there are no frames, or all bright frames are saturated, black or copies.
    """
    told = stated or StatedFacts()
    levels: dict[str, list[Level]] = {"dark": [], "bright": []}
    stacked: dict[str, list[Level]] = {"dark": [], "bright": []}
    stacks: dict[str, dict[float, _Stack]] = {"dark": {}, "bright": {}}
    histogram = HistogramAccumulator(bits)
    pictures: list[PictureGroup] = []
    shape = None
    correlated: list[CorrelatedGroup] = []
    for group, [(sums, found, products, succession)] in reduce_groups(groups, bits, lags=True, threads=threads, on_frames=on_frames):
        shape = found
        if group.role == "target" and not isinstance(sums, LevelSummary):
            assert isinstance(sums.moments, StackAccumulator)
            pictures.append(PictureGroup(group.kind, group.exposure_s, group.facts, sums.moments, sums.of_pictures, bits))
            continue
        condition = (group.kind, group.role, group.exposure_s, group.photons)
        if isinstance(sums, LevelSummary):
            histogram.add_counts(sums.counts, dark=group.kind == "dark", level=condition)
            refuse_copies(group, sums, bits)
            levels[group.kind].append(Level(sums, group.exposure_s, group.photons))
            correlated.append(_correlated(group, sums, products, succession))
        elif isinstance(sums.moments, StackAccumulator) and sums.spectra is not None:
            histogram.add_counts(sums.moments.counts, dark=group.kind == "dark", level=condition)
            summary = sums.moments.summary()
            stacked[group.kind].append(Level(summary, group.exposure_s, group.photons))
            correlated.append(_correlated(group, summary, products, succession))
            kept = stacks[group.kind].get(group.exposure_s)
            if kept is None or sums.moments.n_frames > kept.moments.n_frames:
                stack = sums.moments.result(group.exposure_s)
                stacks[group.kind][group.exposure_s] = _Stack(stack, sums.spectra.result(stack.mean_map_dn), sums.rows)
    levels = {kind: found or stacked[kind] for kind, found in levels.items()}  # where there are only stacks, these
    if pictures and shape is not None and not (levels["dark"] or levels["bright"]):
        alone = Observations(
            photon_transfer=without_levels(shape, bits),
            photon_transfer_fit=Estimates.empty(),
            stated=told,
            temperature_c=temperature_c,
        )
        with single_threaded_blas():
            return reduce_pictures(pictures, alone)
    counts = histogram.result()
    notes = _code_notes(counts)
    sweep = [level.summary for level in levels["bright"]]
    dark, bright = _pair(list(stacks["dark"].values()), list(stacks["bright"].values()))
    dark_stack, bright_stack = (None if s is None else s.moments for s in (dark, bright))
    transfer = photon_transfer(levels["dark"], levels["bright"], shape, bits)
    table = find_code_table(counts)
    codes = _codes(sweep_histogram(sweep, bits), notes) if table is None else None  # gaps of a table are no fault of the converter
    with single_threaded_blas():
        noise = noise_covariance(correlated)
        noise_filter = find_noise_filter(noise, told.samples_per_pixel)
        fit = _transfer_fit(transfer, (dark_stack, bright_stack), _dnl_lsb(codes), noise, noise_filter, table, notes)
    if noise_filter is not None and noise_filter.kind == MOSAIC:
        meant = "the gain is that of the original pixels, and the fixed pattern, of interpolated ones too, is smaller than the sensor's"
        notes.append(f"the frames are not raw ({noise_filter.name}): {meant}")
    if dark and not bright:
        notes.append("no stack of bright frames: PRNU is not measured (take 16 or more at half of saturation)")
    if dark and bright and not same_exposure(dark.moments, bright.moments):
        notes.append(_unpaired(dark, bright))
        bright = bright_stack = None  # a dark map of another exposure holds another dark current: their difference is not the light's
    cells = None if dark_stack is None or bright_stack is None else find_colour_cells(dark_stack, bright_stack)
    if dark_stack is not None and bright_stack is not None and cells is not None:
        bright_stack = balanced(dark_stack, bright_stack, cells)
    dark_spectra, bright_spectra = (None if s is None else s.spectra for s in (dark, bright))
    taps, even = None, bright_stack
    if dark_stack is not None and bright_stack is not None:
        taps = find_taps(dark_stack, bright_stack, cells is not None)
        even = evened(dark_stack, bright_stack, taps)
    with single_threaded_blas():
        rising = LINE_START_PX if told.interface == "analogue" else 0
        defects, spatial, found_patterns = _spatial(dark_stack, even, dark_spectra, Linearity.of(fit, bits), _dnl_lsb(codes), notes, rising)
        rows = None
        if dark is not None and dark.rows is not None:
            rows = reduce_dark_rows(dark.rows, dark.spectra, dark.moments.shape, told, found_patterns, noise_filter)
        patterns = without_hum(found_patterns, rows, dark_spectra)
    if spatial is not None and taps is not None:
        spatial = with_steps_in_slope(spatial, taps)
    if spatial is not None and noise_filter is not None and dark_stack is not None and bright_stack is not None:
        spatial = before_correlation(spatial, noise_filter, bright_stack.ms_pixel_dn2 - dark_stack.ms_pixel_dn2)
    seen = Observations(
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
        dark_rows=rows,
        code_errors=codes,
        code_table=table,
        colour_cells=cells,
        taps=taps,
        outliers=_outliers(correlated, cells),
        noise_covariance=noise,
        noise_filter=noise_filter,
        stated=told,
        temperature_c=temperature_c,
        notes=tuple(notes),
    )
    with single_threaded_blas():
        return reduce_pictures(pictures, seen)


def _outliers(groups: list[CorrelatedGroup], cells: ColourCells | None) -> SingleOutliers | None:
    """Single outliers of the bright stack of the most light that is not clipped, with the size above which they are missing."""
    stacks = [g for g in groups if g.bright and g.products.samples and g.clipped <= SATURATED_FRACTION]
    if not stacks:
        return None
    brightest = max(stacks, key=lambda g: g.mean_dn)
    found = single_outliers([frame for _, frame in sorted(brightest.products.samples.items())], step=1 if cells is None else 2)
    cut = None if found is None else cut_of(found)
    return found if found is None or cut is None else replace(found, cut_dn=cut[0], u_cut_dn=cut[1])


def _correlated(group: Group, level: LevelSummary, products: LagProducts, succession: FrameSuccession) -> CorrelatedGroup:
    """What the record of the noise's autocovariance needs of a group."""
    clipped = float((level.counts[0] + level.counts[-1]) / level.counts.sum())
    return CorrelatedGroup(
        bright=group.kind == "bright",
        stack=group.role == "stack",
        exposure_s=group.exposure_s,
        mean_dn=level.mean_dn,
        clipped=clipped,
        products=products,
        succession=succession,
        var_dn2=level.squares.pixel_dn2,
    )


def _transfer_fit(
    transfer: PhotonTransfer,
    stacks: tuple[StackMoments | None, StackMoments | None],
    dnl_lsb: float,
    noise: NoiseCovariance | None,
    noise_filter: NoiseFilter | None,
    table: CodeTable | None,
    notes: list[str],
) -> Estimates:
    """The joint fit; where the frames carry none, what they tell nevertheless, and a note."""
    if transfer.bright.mean_dn.size:
        refuse_dead_series(transfer)
    independent = noise is None or not frames_share_noise(noise)
    try:
        if not independent:
            raise MeasureError(
                "the noise of successive frames is correlated, as behind temporal noise reduction: their differences do not tell the gain",
                where="photon transfer",
                remedy="switch temporal noise reduction off",
            )
        alpha, u_alpha = (0.0, np.inf) if noise is None else shared_by_frames(noise)
        unseen = unseen_rms(alpha, u_alpha, LARGEST_ALPHA) if np.isfinite(u_alpha) else 0.0
        even, dark, bright = (transfer, *stacks) if table is None else without_steps(transfer, *stacks, table)
        return fit_unfiltered(even, dark, bright, dnl_lsb, noise_filter, unseen)
    except MeasureError as problem:
        straight = is_short(transfer) and independent and table is None and (noise_filter is None or noise_filter.kind == WHITE)
        found = partial_transfer(transfer, stacks[0], straight=straight)
        if not len(found) and not transfer.bright.mean_dn.size:
            raise
        missing = "non-linearity, saturation" if "gain_dn_per_e" in found else "gain, noise in electrons, non-linearity, saturation"
        notes.append(f"{missing} and values that follow from them are not measured: {problem}")
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
    rising: int = 0,
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
        kept = without_columns(dark, rising), without_columns(bright, rising), without_defects(defects, rising)
        found = fit_spatial(*kept, linearity=linearity, patterns=patterns, dnl_lsb=dnl_lsb)
        return defects, with_shading_of(found, dark.shape, rising), patterns
    except MeasureError as problem:
        notes.append(f"DSNU and PRNU are not measured: {problem}")
        return defects, None, patterns


def _dnl_lsb(codes: CodeErrors | None) -> float:
    """Standard deviation of the code widths; 0 where it is not significant."""
    if codes is None or "dnl_rms_lsb" not in codes.fit or codes.fit.limits:
        return 0.0
    return codes.fit["dnl_rms_lsb"].value


def _codes(counts: CodeHistogram, notes: list[str]) -> CodeErrors | None:
    try:
        return code_errors(counts)
    except MeasureError as problem:
        notes.append(f"code widths are not measured: {problem}")
        return None


def partial_transfer(series: PhotonTransfer, stack: StackMoments | None, *, straight: bool) -> Estimates:
    """Black level and dark noise in DN; in electrons too, with the gain, where a few light levels of a straight response tell it.

    Parameters
    ----------
    series : PhotonTransfer
        Bright levels may be none.
    stack : StackMoments, optional
        Dark frames beside the series.
    straight : bool
        Whether the response is not known to be bent: then a light level tells the gain.

    Returns
    -------
    Estimates
        ``offset_dn``, ``dark_noise_dn``, ``row_noise_dn``, ``column_noise_dn``; with a gain ``gain_dn_per_e``, ``dark_noise_e``,
        ``row_noise_e``, ``column_noise_e``, and with photons ``quantum_efficiency``. A noise that is not significant is a 95 % upper limit.
        Empty without dark frames.

    Notes
    -----
    K = (σ² − σ²_dark)/(µ − µ_dark) (EMVA 1288 R4.0 eq. 14). A response y = x(1 + a w), w the share of the range, makes that K(1 + 3aw)
    to first order; a is taken as 0 ± 0.1, as in the joint fit. Of several levels the one of the smallest u is taken.
    """
    whole, hot = without_hot_pixels(with_stacks(series, stack, None), stack)
    dark, pixels = whole.dark, int(np.prod(whole.frame_shape))
    if dark.mean_dn.size == 0:
        return Estimates.empty()
    frames = dark.n_frames - 1.0
    black = float(np.average(dark.mean_dn, weights=dark.n_frames))
    scatter = float(dark.mean_dn.std(ddof=1) / np.sqrt(dark.mean_dn.size)) if dark.mean_dn.size > 1 else 0.0
    white, spread = float(np.average(dark.ms_pixel_dn2, weights=frames)), core_spread_dn2(stack)
    white_u = white * np.sqrt(2 / (frames.sum() * pixels)) + 1 / (dark.n_frames.sum() * pixels)
    before = model.white_before_rounding(white, spread)
    q_mean, q_var = (float(q) for q in model.rounding_error_vars(np.array(before), spread))
    u_black = float(np.linalg.norm([scatter, hot.mean_dn, np.sqrt(q_mean), np.sqrt(dark.ms_frame_dn2.mean() / dark.n_frames.sum())]))
    rows = [("offset_dn", black, u_black, float(max(dark.mean_dn.size - 1, 1)), "DN")]
    reasons = {"offset_dn": "the mean of the dark frames: contains their dark signal"}
    hidden = white < model.MINIMUM_DARK_VAR_DN2
    lines, line_vars = temporal_row_col_vars(whole)
    squares = [white - model.QUANTISATION_DN2, *lines]
    u_squares = [float(np.linalg.norm([white_u, np.sqrt(q_var), hot.var_dn2])), *np.sqrt(line_vars)]
    limits: set[str] = set()
    gain = _gain(whole, (white, float(np.hypot(white_u, hot.var_dn2))), (black, u_black), pixels) if straight else None
    for name, square, u in zip(("dark_noise", "row_noise", "column_noise"), squares, u_squares, strict=True):
        value, u_value, limit, reason = _root(float(square), float(u), hidden)
        rows.append((f"{name}_dn", value, u_value, np.inf, "DN"))
        if gain is not None:
            rows.append((f"{name}_e", value / gain[0], float(np.hypot(u_value, value * gain[1] / gain[0]) / gain[0]), np.inf, "e-"))
        limits |= {f"{name}_dn", f"{name}_e"} if limit else set()
        reasons |= {f"{name}_dn": reason, f"{name}_e": reason} if reason else {}
    if gain is not None:
        rows.append(("gain_dn_per_e", gain[0], gain[1], np.inf, "DN/e-"))
        reasons["gain_dn_per_e"] = ONE_LIGHT
        if gain[2] is not None:
            rows.append(("quantum_efficiency", gain[2], gain[2] * gain[1] / gain[0], np.inf, "1"))
            reasons["quantum_efficiency"] = f"{ONE_LIGHT}; u does not include the calibration of the photon count"
    method, names = METHOD if gain is None else METHOD_WITH_LIGHT, {row[0] for row in rows}
    told = {name: reason for name, reason in reasons.items() if name in names}
    return Estimates.from_rows(rows, method=method, limits=frozenset(limits & names), reasons=told)


def _root(square: float, u: float, hidden: bool) -> tuple[float, float, bool, str]:
    """A standard deviation from its square, with its u; a limit where it is not significant or rounding hides it."""
    if hidden:
        bound = 0.40  # EMVA 1288 R4.0 eq. 54
        what = f"the dark variance is below {model.MINIMUM_DARK_VAR_DN2} DN², where rounding hides it"
        reason = f"{what}: bound 0.40 DN (EMVA 1288 R4.0 eq. 54)"
        return bound, bound / np.sqrt(12), True, reason
    if square < NOT_SIGNIFICANT * u:
        limit = float(np.sqrt(max(square, 0.0) + ONE_SIDED_95 * u))
        return limit, u / (2 * max(limit, 1e-12)), True, "not significantly above zero; 95 % upper limit"
    return float(np.sqrt(square)), float(u / (2 * np.sqrt(square))), False, ""


def _gain(
    series: PhotonTransfer, dark_var: tuple[float, float], dark_mean: tuple[float, float], pixels: int
) -> tuple[float, float, float | None] | None:
    """Gain, its u, and electrons per photon where these are known; None where no level tells. Of the dark: values with their u."""
    bright: LevelMoments = series.bright
    (white, white_u), (black, black_u) = dark_var, dark_mean
    if bright.mean_dn.size == 0:
        return None
    signal, noise = bright.mean_dn - black, bright.ms_pixel_dn2 - white
    usable = unclipped_bright(series) & (signal > 0)
    if not usable.any():
        return None
    with np.errstate(divide="ignore", invalid="ignore"):
        gain = noise / signal
        sampling = np.sqrt(2 / ((bright.n_frames - 1) * pixels)) * bright.ms_pixel_dn2
        before = np.array([bright.ms_pixel_dn2, np.full_like(noise, white)]) - model.QUANTISATION_DN2
        q_var = model.rounding_error_vars(before)[1].sum(axis=0)
        of_scale = np.hypot(3 * NONLINEARITY_PRIOR * signal / (2**series.bits - 1), black_u / signal)
        u = np.hypot(np.sqrt(sampling**2 + q_var + white_u**2) / signal, of_scale * gain)
    relative = np.where(usable & (gain > 0), u / gain, np.inf)
    at = int(np.argmin(relative))
    if not relative[at] < 1 / NOT_SIGNIFICANT:
        return None
    photons = 0.0 if bright.photons is None else float(bright.photons[at])
    efficiency = float(signal[at] / (gain[at] * photons)) if photons > 0 else None
    return float(gain[at]), float(u[at]), efficiency


def is_short(series: PhotonTransfer) -> bool:
    """Whether the series has fewer light levels below saturation than the joint fit needs, so that nothing is known of a bend."""
    return series.bright.mean_dn.size == 0 or int(unclipped_bright(series).sum()) < MINIMUM_LEVELS
