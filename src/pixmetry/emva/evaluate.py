"""All values and curves of one channel by one release of EMVA 1288, with their uncertainties."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from pixmetry.core.errors import InputError, MeasureError
from pixmetry.core.number import ONE_SIDED_95, TWO_SIDED_95, UPPER_LIMIT, VALUE, Number
from pixmetry.core.random import Generator, generator
from pixmetry.core.threads import map_tiles, single_threaded_blas
from pixmetry.emva.curves import dark_signal, spatial_curves, temporal_curves
from pixmetry.emva.dark_noise import DarkNoise, pattern_limit_dn2
from pixmetry.emva.files.keys import KEYS, goes_with_photons
from pixmetry.emva.formulas import DARK_VARIANCE, Formulas, Spread, Values, keys_of
from pixmetry.emva.general.general import general_curve
from pixmetry.emva.general.nonlinear import nonlinear_values
from pixmetry.emva.linear_model import departure_bounds, level_free_values, linear_model
from pixmetry.emva.lower_limits import with_lower_limits
from pixmetry.emva.partial import partial_results
from pixmetry.emva.reasons import DARK_PATTERN, Case, breaks_the_split, is_blind, is_bound, lifted, notes_of, reason_for
from pixmetry.emva.records import RELEASES, Measurement, Results
from pixmetry.emva.scatter import GROUPS, Scatter, scatter_of
from pixmetry.emva.series import light_of
from pixmetry.emva.temporal import slope_departures, temporal_values
from pixmetry.emva.uncertainty import about, add_wave, bootstrap_series, draw_blocks

GROUP_DRAWS = 300
SEED = 1288
MOST_DRAWS = 0.99  # have a value: else it rests on levels that noise chooses
MANY = 1e6  # degrees of freedom beyond which u is as good as known
LEFT_TO_NOISE = "noise decides whether these levels give a value at all: take more levels, larger frames or more light"
NEGATIVE = "the root or the logarithm of a negative number: the signal does not grow with the light"
DARK_NOISE_LIMIT_DN = 0.40  # R4.0 eq. 54
MAY_NOT_BE_NEGATIVE = ("u_I_var", "u_I_var_DN")


def evaluate(m: Measurement, release: str, *, draws: int = 4000) -> Results:
    """Everything that a release of EMVA 1288 says of one channel.

    Parameters
    ----------
    m : Measurement
    release : {"4.0", "3.1", "reference"}
        ``reference`` is what the public reference implementation 1.0.2 computes.
    draws : int
        Of the Monte Carlo behind the uncertainties.

    Returns
    -------
    Results
        Each key of the release; a value that cannot be had is NaN with its reason. Values that take the camera's non-linearity into
        account stand beside, with the suffix ``_nonlinear``.

    Raises
    ------
    InputError
        No such release.
    MeasureError
        The exposure series carries no gain.

    Notes
    -----
    Uncertainties by propagating distributions (JCGM 101): the formulas of the release, choices of levels and extremes included, are
    applied to draws of the measured statistics from their sampling laws and from the scatter that the series shows. u is the root mean
    square of the draws about the value of the smooth series behind them, so it holds the bias that noise gives to extremes and absolute
    values (linearity errors). Degrees of freedom by Welch and Satterthwaite (JCGM 100, G.4) over the independent causes, each drawn alone.
    A standard deviation whose square comes out negative within its u is given as a 95 % upper limit: of the square (from its u), then the
    root. A square far below zero breaks what the split rests on; it has no root and gives no limit, and its reason says so.
    """
    _check_release(release)
    with single_threaded_blas():
        parts: tuple[Callable[[], Results], ...] = (lambda: _by_release(m, release, draws), lambda: _nonlinear(m, release))
        standard, beside = map_tiles(_call, parts)
    notes = tuple(dict.fromkeys((*m.notes, *standard.notes, *beside.notes)))
    return replace(standard, values={**standard.values, **beside.values}, notes=notes)


def _call(job: Callable[[], Results]) -> Results:
    return job()


def standard_values(m: Measurement, release: str, *, draws: int = 4000) -> Results:
    """Values of a release for one channel: :func:`evaluate` without curves and without what stands beside the standard.

    Parameters
    ----------
    m : Measurement
    release : {"4.0", "3.1", "reference"}
    draws : int
        Of the Monte Carlo behind the uncertainties.

    Raises
    ------
    InputError
        No such release.
    MeasureError
        The exposure series carries no gain.
    """
    _check_release(release)
    with single_threaded_blas():
        return _by_release(m, release, draws, with_curves=False)


def _check_release(release: str) -> None:
    if release not in RELEASES:
        raise InputError("no such release of EMVA 1288", where="release", value=release, allowed=", ".join(RELEASES))


def _by_release(m: Measurement, release: str, draws: int, with_curves: bool = True) -> Results:
    """Values of the release; without a series, only those that need none."""
    try:
        formulas = Formulas.of(m, release)
        scatter = scatter_of(m, formulas.series)
        measured, squares = formulas.at(formulas.series, *formulas.vectors)
        _refuse_no_gain(measured)
        spread, bounds = _monte_carlo(formulas, scatter, draws)
    except MeasureError as problem:
        return partial_results(m, release, problem)
    case = _case(m, formulas, measured, squares, spread)
    values = with_lower_limits({key: _value(key, case) for key in keys_of(release)}, case)
    low, high = np.split(np.array(bounds), 2)
    judged = linear_model(Results(release, values, {"PTC": {"departure_low": low, "departure_high": high}}))
    curves = _curves(m, formulas, measured, squares, scatter) if with_curves else {}
    if "PTC" in curves and release == "4.0":
        curves["PTC"] |= {"departure_low": low, "departure_high": high}
    return Results(release, values, curves, notes_of(case, values, judged), m.channel)


def _refuse_no_gain(measured: Values) -> None:
    """Refuse a series whose variance falls with the signal, as where no light came in: nothing in electrons follows from it."""
    if "K" in measured and not measured["K"] > 0:
        raise MeasureError(
            "the temporal variance does not grow with the signal",
            where="exposure series",
            value=f"K = {float(measured['K']):.3g} DN/e⁻",
            allowed="above 0",
            remedy="check whether light reached the sensor",
        )


def _case(m: Measurement, formulas: Formulas, measured: Values, squares: Values, spread: Spread) -> Case:
    """What was found, with the scale of the photons in u: exact and common to all levels, so that it can be taken off again."""
    noise = DarkNoise.of(m, formulas.series, spread.u_square[DARK_VARIANCE])
    if m.photons_u_rel > 0 and formulas.series.photons is not None:
        u, dof = dict(spread.u), dict(spread.dof)
        for key in filter(goes_with_photons, spread.u):
            u[key] = math.hypot(spread.u[key], float(measured[key]) * m.photons_u_rel)
            if spread.u[key] > 0:
                dof[key] = dof.get(key, math.inf) * (u[key] / spread.u[key]) ** 4
        spread = replace(spread, u=u, dof=dof)
    return Case(m, formulas, measured, squares, spread, noise)


def _nonlinear(m: Measurement, release: str) -> Results:
    """Values in addition to the standard."""
    values, notes = nonlinear_values(m)
    return Results(release, values, notes=notes)


def bootstrap_u(m: Measurement, release: str, draws: int = 2000) -> dict[str, float]:
    """Standard uncertainties by bootstrap instead of sampling laws, for comparison with those of :func:`evaluate`.

    The levels of the series by their residuals (``uncertainty.bootstrap_series``), the stacks over their frames
    (``SpatialInputs.bootstrap``), for which the measurement must hold the products of the frames.

    Returns
    -------
    dict
        By key, of the values that have a u.

    Raises
    ------
    InputError
        No such release, or stacks without the products of their frames.
    """
    _check_release(release)
    with single_threaded_blas():
        formulas = Formulas.of(m, release)
        scatter = scatter_of(m, formulas.series)
        rng = generator(SEED, "bootstrap")
        dark, bright = formulas.vectors
        if formulas.stacks is not None:
            if m.dark_products is None or m.bright_products is None:
                raise InputError(
                    "the products of the frames of a stack are missing", where="bootstrap", remedy="make them with emva.frame_products"
                )
            dark = formulas.stacks[0].bootstrap(m.dark_products, draws, rng)
            bright = formulas.stacks[1].bootstrap(m.bright_products, draws, rng)
        series = bootstrap_series(scatter, draws, rng)
        measured, squares = formulas.at(formulas.series, *formulas.vectors)
        centre = formulas.at(scatter.centre, *formulas.vectors, formulas.series)
        drawn = formulas.at(series, dark, bright, about(series, scatter.centre, formulas.series))
        spread = Spread(*_deviations(centre, drawn), {}, {})
        case = _case(m, formulas, measured, squares, spread)
        found = {key: _value(key, case).u for key in keys_of(release)}
    return {key: u for key, u in found.items() if not math.isnan(u)}


def _monte_carlo(formulas: Formulas, scatter: Scatter, draws: int) -> tuple[Spread, tuple[float, float]]:
    """Draw all causes together for u, and those with few degrees of freedom each alone, for the degrees of freedom of the values.

    Second comes what ``departure_bounds`` says of the draws.
    """
    causes = [g for g in GROUPS if g != "spatial" or formulas.release == "4.0"]
    few = [g for g in causes if math.isfinite(scatter.dof[g])]
    rng = generator(SEED, "draws")
    series = draw_blocks(scatter, [(draws, causes), *((GROUP_DRAWS, [g]) for g in few)], rng)
    alone = GROUP_DRAWS * len(few)
    dark, bright = _stack_draws(formulas, scatter, draws, alone, rng)
    centre = formulas.at(scatter.centre, *formulas.vectors, formulas.series)
    values = formulas.at(series, dark, bright, about(series, scatter.centre, formulas.series))
    blocks = [slice(0, draws), *(slice(draws + i * GROUP_DRAWS, draws + (i + 1) * GROUP_DRAWS) for i in range(len(few)))]
    (u, u_square), *single = (_deviations(centre, _rows(values, block, draws + alone)) for block in blocks)
    fourth = {key: sum(one[0][key] ** 4 / scatter.dof[g] for g, one in zip(few, single, strict=True)) for key in u}
    least = min((scatter.dof[g] for g in few), default=math.inf)  # rare draws of one cause alone may scatter more than those of all
    dof = {key: max(u[key] ** 4 / total, least) if total * MANY > u[key] ** 4 else math.inf for key, total in fourth.items()}
    together = _rows(values, blocks[0], draws + alone)[0]
    shift = {key: float(np.mean(drawn)) - float(centre[0][key]) for key, drawn in together.items() if not np.isnan(drawn).any()}
    bounds = (math.nan, math.nan)
    if formulas.release == "4.0" and not formulas.curved:
        all_rows = replace(
            series, **{name: getattr(series, name)[:draws] for name in ("mean_dn", "var_dn2", "dark_mean_dn", "dark_var_dn2")}
        )
        bounds = departure_bounds(slope_departures(all_rows, together["K"], together["index_sensitivity_max"]))
    return Spread(u, u_square, dof, shift), bounds


def _stack_draws(formulas: Formulas, scatter: Scatter, draws: int, still: int, rng: Generator) -> tuple[np.ndarray, np.ndarray]:
    """Draws of the statistics of both stacks, and after them the measured ones as often as the stacks stand still."""
    if formulas.stacks is None:
        return formulas.vectors
    dark, bright = formulas.stacks
    moved = [dark.draws(draws, rng), bright.draws(draws, rng, dark_mean_dn=float(dark.vector[0]))]
    if dark.coherence is None:  # without products of the stack's frames the dark levels tell whether a wave runs through them
        moved[0] = add_wave(moved[0], scatter, dark.n_frames, rng)
    one, other = (np.vstack([d, np.repeat(s.vector[None], still, axis=0)]) for d, s in zip(moved, formulas.stacks, strict=True))
    return one, other


def _rows(drawn: tuple[Values, Values], rows: slice, total: int) -> tuple[Values, Values]:
    """Some of the draws; a value that is equal for all draws is kept as one value."""
    values, squares = ({k: np.broadcast_to(v, (total,))[rows] for k, v in part.items()} for part in drawn)
    return values, squares


def _deviations(centre: tuple[Values, Values], drawn: tuple[Values, Values]) -> tuple[dict[str, float], dict[str, float]]:
    """Root mean square of the draws about the centre, of values and of squares; a root of a negative draw counts as zero.

    NaN where the value is, or where more than one draw in a hundred has none.
    """

    def rms(values: np.ndarray, about: float) -> float:
        kept = values[~np.isnan(values)]
        return float(np.sqrt(np.mean((kept - about) ** 2))) if np.isfinite(about) and kept.size >= MOST_DRAWS * values.size else math.nan

    u = {}
    for key, values in drawn[0].items():
        about = float(centre[0][key])
        u[key] = rms(np.nan_to_num(values) if key in drawn[1] else values, about)
    return u, {key: rms(values, float(centre[1][key])) for key, values in drawn[1].items()}


def _value(key: str, case: Case) -> Number:
    """One value with its uncertainty, or the limit or reason in its place."""
    formulas, measured, squares, spread, noise = case.formulas, case.measured, case.squares, case.spread, case.noise
    unit, method, reason = KEYS[key].unit, _method(key, formulas.release), reason_for(key, case)
    if key not in measured or key not in spread.u or is_blind(key, case) or breaks_the_split(key, case):
        return Number.not_available(unit, reason, method)
    value, u, dof = float(measured[key]), spread.u[key], spread.dof.get(key, math.inf)
    known = light_of(formulas.series)
    if key == "R" and known is not None and known[1] == "s":
        unit = "DN/s"
    square = float(squares[key]) if key in squares else math.nan
    has_unit = not formulas.curved or key.endswith("_DN")  # what a code is worth is not known of a curved camera
    if key in DARK_PATTERN and noise.hidden and formulas.release != "reference" and has_unit and math.isfinite(square):
        limit, u = _pattern_limit(key, square, case)
        return Number(limit, u, dof, unit, method, reason, kind=UPPER_LIMIT)
    if square < 0:
        u_square = spread.u_square[key]
        limit = math.sqrt(max(square + lifted(key, formulas, measured), 0.0) + ONE_SIDED_95 * u_square)
        return Number(limit, u_square / (2 * limit) if limit > 0 else 0.0, dof, unit, method, reason, kind=UPPER_LIMIT)
    if key in MAY_NOT_BE_NEGATIVE and value < 0:
        return Number(ONE_SIDED_95 * u, u, dof, unit, method, reason, kind=UPPER_LIMIT)
    if math.isfinite(value) and math.isnan(u):
        return Number.not_available(unit, "; ".join(filter(None, (LEFT_TO_NOISE, reason))), method)
    if noise.below and formulas.release != "reference" and (is_bound(key) or key.startswith("DR")):
        if formulas.curved:
            at_limit = level_free_values(formulas.series, noise.limit_dn2)
        else:
            at_limit = temporal_values(formulas.series, formulas.release, case.m.pixel_area_um2, noise.limit_dn2)
        value = float(at_limit[key])
        if key == "sigma_d":
            value = max(value, DARK_NOISE_LIMIT_DN / float(measured["K"]))
        elif noise.hidden and is_bound(key):
            value += ONE_SIDED_95 * u
        return Number(value, u, dof, unit, method, reason, kind=UPPER_LIMIT if is_bound(key) else VALUE)
    known_value = math.isfinite(value)
    reason = reason or ("" if known_value else NEGATIVE)
    if 0 <= square < ONE_SIDED_95 * spread.u_square.get(key, 0.0):  # not significant: zero may be the truth, and lies in the interval
        u = max(u, value / TWO_SIDED_95)
    return Number(value, u if known_value else math.nan, dof if known_value else math.nan, unit, method, reason)


def _pattern_limit(key: str, square: float, case: Case) -> tuple[float, float]:
    """Upper limit of a dark non-uniformity that quantisation hides, and its u."""
    dn_per_unit = 1.0 if key.endswith("_DN") else float(case.measured["R" if key == "general_DSNU" else "K"])
    u_dn2 = case.spread.u_square[key] * dn_per_unit**2
    square_dn2 = (square + lifted(key, case.formulas, case.measured)) * dn_per_unit**2
    limit = math.sqrt(pattern_limit_dn2(square_dn2, u_dn2, case.m)) / dn_per_unit
    return limit, case.spread.u_square[key] / (2 * limit) if limit > 0 else 0.0


def _method(key: str, release: str) -> str:
    clause = KEYS[key].clause
    source = "reference implementation 1.0.2" if release == "reference" else f"EMVA 1288 R{release}"
    if release == "4.0" or not clause.startswith("eq"):
        source = f"{source} {clause}".strip()
    return f"{source}; u by Monte Carlo (JCGM 101)"


def _curves(m: Measurement, formulas: Formulas, measured: Values, squares: Values, scatter: Scatter) -> dict[str, dict[str, np.ndarray]]:
    dsnu2, prnu2 = (float(squares.get(key, 0.0)) for key in ("DSNU1288", "PRNU1288"))
    if formulas.curved:
        curves = {"dark_signal": dark_signal(formulas.series)}
    else:
        curves = temporal_curves(formulas.series, measured, scatter.u_variance, dsnu2, prnu2)
    if formulas.stacks is not None:
        curves |= spatial_curves(m, formulas.release, formulas.stacks)
    if formulas.release == "4.0" and "general" not in formulas.missing:
        curves["general"] = general_curve(formulas.plan)
    return curves
