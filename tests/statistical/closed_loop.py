"""Random cameras, simulated through the whole chain, measured blind, and the score of every estimate against the truth.

A camera has a key: the same key is the same camera with the same noise. ``run_camera`` returns one ``Score`` a quantity; ``summarise``
turns the scores of many cameras into one line a quantity; ``failures`` says which of these contradict their stated uncertainty.

A quantity that cannot be negative is reported as a value where it stands out of the noise and as a 95 % limit elsewhere. That
choice is made from the data, so values of small quantities are a selected lot, and so are limits. By the truth, not by the data,
cameras are therefore put into two classes: *resolved* (truth at least ``RESOLVED`` times the reference uncertainty), where every
estimate must follow its distribution, and *near zero*, where only a miss counts: a limit below the truth, or a value whose 90 %
interval does not hold it. Coefficients of the non-linearity that short or noisy series leave to their prior are counted in the
same way.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace

import numpy as np
from scipy import stats
from scipy.special import ndtr

from pixmetry.assess.job import measure_sources
from pixmetry.camera.camera import Camera, Element
from pixmetry.camera.catalogue import sources
from pixmetry.camera.observations import Observations
from pixmetry.camera.signal import Kind, Signal
from pixmetry.core.errors import MeasureError, PixmetryError
from pixmetry.core.number import Number
from pixmetry.core.random import Grid
from pixmetry.observe.observe import Group, observe
from pixmetry.scene.files import SeriesModel
from pixmetry.simulate.job import expose_group, plan_series
from pixmetry.sources.grabber.adc import thresholds
from pixmetry.sources.sensor import prnu
from statistical.reference_u import Reference, photon_transfer_u, spatial_u

DIGITAL_CHAIN = (  # what dark and bright frames can tell of a camera, in the order of the light
    "optics.shading",
    "sensor.quantum_efficiency",
    "sensor.prnu",
    "sensor.dark_current",
    "sensor.defects",
    "sensor.shot_noise",
    "sensor.full_well",
    "sensor.dsnu",
    "electronics.amplifier_noise",
    "electronics.row_noise",
    "electronics.gain",
    "electronics.nonlinearity",
    "grabber.phase_pattern",
    "grabber.adc",
)
SHAPES = ((64, 96), (96, 128), (120, 160), (240, 320))
SHARES = (0.4, 0.3, 0.2, 0.1)
RESOLVED = 6.0
COUNTS = tuple(f"sensor.defects.{kind}_fraction" for kind in ("hot", "cold", "dead", "gain", "noisy"))  # of this very unit
MISCOUNTED = 2  # pixels: the weakest hot ones lie at the limit of what can be found
INFORMED = 0.03  # coefficients that the data tell less well follow the prior of 0 ± 0.1, not the data
CAN_BE_ZERO = (
    "sensor.dsnu.", "sensor.prnu.", "electronics.row_noise.", "sensor.dark_current.", "lamp noise", "grabber.phase_pattern.amplitude",
    "sensor.defects.", "grabber.adc.dnl",
)  # fmt: skip


@dataclass(frozen=True)
class Case:
    """One random camera with its campaign, and what its estimates should say."""

    key: tuple[int, int]
    camera: Camera
    series: SeriesModel
    lamp_rel: float
    truth: dict[str, float]
    traits: frozenset[str]


@dataclass(frozen=True)
class Score:
    """One estimate against the truth."""

    name: str
    kind: str  # "value" or "upper_limit"
    resolved: bool
    p: float  # probability of a value below the estimate, by the stated distribution
    held: bool  # the one-sided 95 % statement of a limit, or the 90 % interval of a value
    relative_error: float
    u_ratio: float  # u over the reference; nan without one
    traits: frozenset[str] = field(default=frozenset())


# ---- cameras ----------------------------------------------------------------------------------------------------------------------


def random_case(seed: int, index: int, quick: bool = False) -> Case:
    """Draw a camera; ``quick``: small frames and few levels."""
    rng = np.random.default_rng([seed, index])
    while True:
        values, series, lamp, traits = _draw(rng, quick)
        shape = (64, 96) if quick else SHAPES[rng.choice(len(SHAPES), p=SHARES)]
        try:
            camera = _camera(values, shape, series, index)
        except PixmetryError:  # a response that does not rise
            continue
        return Case((seed, index), camera, series, lamp, _truth(camera, series, lamp, traits), frozenset(traits))


def _some(rng: np.random.Generator, share: float, low: float, high: float) -> float:
    """A number between two bounds in a share of the cameras, else zero."""
    return float(rng.uniform(low, high)) if rng.random() < share else 0.0


def _draw(rng: np.random.Generator, quick: bool) -> tuple[dict[str, dict[str, float]], SeriesModel, float, set[str]]:
    """Parameters of every source, by source, the exposure series, lamp noise, and what is special about the camera."""
    traits: set[str] = set()
    while True:
        bits, gain, noise = (
            int(rng.integers(8, 15)),
            float(10 ** rng.uniform(np.log10(0.02), np.log10(4))),
            float(10 ** rng.uniform(0.3, 1.954)),
        )
        dsnu = noise * _some(rng, 0.8, 0.1, 0.8)
        offset = 2 + rng.uniform(4, 8) * gain * float(np.hypot(noise, dsnu))
        if gain * noise > 0.25 and offset < 0.2 * 2**bits and (2**bits - offset) / gain > 400:
            break
    x_top = 2.0**bits - 1 - offset
    top_e = x_top / gain
    values: dict[str, dict[str, float]] = {s: {} for s in DIGITAL_CHAIN}
    efficiency = float(rng.uniform(0.2, 0.9))
    exposure = float(10 ** rng.uniform(-2, 0))
    corner = _some(rng, 0.7, 0.02, 0.2)
    values["optics.shading"] = {
        "corner_rel": corner,
        "gradient_x_per_px": rng.uniform(-3e-4, 3e-4),
        "gradient_y_per_px": rng.uniform(-3e-4, 3e-4),
    }
    values["sensor.quantum_efficiency"] = {"quantum_efficiency": efficiency}
    pixel = float(rng.uniform(0.003, 0.02))
    values["sensor.prnu"] = {
        "pixel_std_rel": pixel,
        "row_std_rel": pixel * _some(rng, 0.6, 0.05, 0.4),
        "col_std_rel": pixel * _some(rng, 0.6, 0.05, 0.4),
    }
    values["sensor.dark_current"] = {"rate_e_per_s": min(_some(rng, 0.7, 1, 500), 0.02 * top_e / exposure)}
    if rng.random() < 0.15:
        traits.add("hot pixels")
        values["sensor.defects"] = {
            "hot_fraction": 10 ** rng.uniform(-3.5, -2.7),
            "hot_median_e": min(noise * rng.uniform(15, 60), 0.15 * top_e),
            "hot_sigma_log": 0.3,
        }
    well_clips = rng.random() < 0.5
    full_well = top_e * float(rng.uniform(0.4, 0.85) if well_clips else rng.uniform(1.2, 3))
    values["sensor.full_well"] = {"full_well_e": full_well}
    traits.add("well clips" if well_clips else "converter clips")
    values["sensor.dsnu"] = {
        "pixel_std_e": dsnu,
        "row_std_e": dsnu * _some(rng, 0.6, 0.05, 0.4),
        "col_std_e": dsnu * _some(rng, 0.6, 0.05, 0.4),
    }
    values["electronics.amplifier_noise"] = {"white_e": noise}
    values["electronics.row_noise"] = {"row_e": noise * _some(rng, 0.7, 0.02, 0.4), "column_e": noise * _some(rng, 0.5, 0.02, 0.4)}
    values["electronics.gain"] = {"gain_dn_per_e": gain}
    a = rng.normal(0, [0.02, 0.015, 0.015]) * (rng.random() < 0.8)
    values["electronics.nonlinearity"] = {"a1": a[0], "a2": a[1], "a3": a[2], "reference_dn": 2.0**bits - 1}
    values["grabber.adc"] = {"bits": bits, "offset_dn": offset}
    if rng.random() < 0.15:
        traits.add("phase pattern")
        values["grabber.phase_pattern"] = {
            "amplitude_dn": gain * noise * rng.uniform(0.1, 0.5), "frequency_x": rng.uniform(0.05, 0.45),
            "frequency_y": rng.choice([-1, 1]) * rng.uniform(0.05, 0.45), "moving": bool(rng.random() < 0.5),
        }  # fmt: skip
    if rng.random() < 0.15:
        traits.add("DNL")
        values["grabber.adc"]["dnl_std_lsb"] = rng.uniform(0.05, 0.3)
    saturation = min(full_well, top_e)
    over = float(rng.uniform(1.2, 1.4)) + 5 / np.sqrt(saturation)
    series = SeriesModel(
        levels=int(rng.integers(12, 17 if quick else 51)),
        brightest_photons=over * saturation / efficiency / (1 - corner),
        longest_exposure_s=exposure,
        stack_frames=16 if quick else int(rng.integers(16, 41)),
        stack_rel=float(rng.uniform(0.4, 0.6)) * (1 - corner) / over,
    )
    return values, series, _some(rng, 0.5, 2e-4, 2e-3), traits


def _camera(values: dict[str, dict[str, float]], shape: tuple[int, int], series: SeriesModel, index: int) -> Camera:
    every = sources()
    chain = tuple(Element(s, every[s], every[s].make(values[s])) for s in DIGITAL_CHAIN)
    return Camera(f"camera {index}", shape, chain, exposure_s=series.longest_exposure_s, unit_seed=index)


def _truth(camera: Camera, series: SeriesModel, lamp_rel: float, traits: set[str]) -> dict[str, float]:
    """Parameters by ``source.parameter``; means over the frame as this unit has them, standard deviations as of its population.

    The black level is that of a converter with equal steps that stores the same means in the dark.
    """
    truth = {f"{e.name}.{k}": float(v) for e in camera.chain for k, v in e.params.model_dump().items() if isinstance(v, int | float)}
    shade, response, extra_e = _unit_maps(camera)
    gain = camera["electronics.gain"].params.gain_dn_per_e
    adc, bend = camera["grabber.adc"].params, camera["electronics.nonlinearity"].params
    hot = _charge_of("sensor.defects", camera) > 0  # defects are not the black level
    truth["grabber.adc.offset_dn"] += gain * float(extra_e[~hot].sum()) / extra_e.size
    black_dn = truth["grabber.adc.offset_dn"]
    truth["sensor.quantum_efficiency.quantum_efficiency"] *= float((shade * response).mean() / shade.mean())
    if "DNL" in traits:
        truth["grabber.adc.offset_dn"] += _stored_by_uneven_codes(camera, series, extra_e[~hot])
    if "converter clips" in traits:
        x = np.linspace(0, 1.5, 200001) * adc.top
        w = x / bend.reference_dn
        stored = black_dn + x * (1 + w * (bend.a1 + w * (bend.a2 + w * bend.a3)))
        truth["sensor.full_well.full_well_e"] = float(np.interp(adc.top, stored, x)) / gain
    photons_per_s = series.brightest_photons / series.longest_exposure_s * float(shade.mean())
    truth["responsivity (DN/s)"] = gain * truth["sensor.quantum_efficiency.quantum_efficiency"] * photons_per_s
    truth["lamp noise"] = lamp_rel
    if camera["grabber.phase_pattern"].params.amplitude_dn == 0:
        del truth["grabber.phase_pattern.frequency_x"], truth["grabber.phase_pattern.frequency_y"]
    truth["sensor.defects.hot_fraction"] = float(hot.mean())
    if hot.sum() < 10:
        del truth["sensor.defects.hot_median_e"], truth["sensor.defects.hot_sigma_log"]
    for name in ("dead_gain_rel", "cold_e", "gain_std_rel", "noisy_std_e"):  # sizes of what these cameras do not have
        del truth[f"sensor.defects.{name}"]
    return truth


def _stored_by_uneven_codes(camera: Camera, series: SeriesModel, extra_e: np.ndarray) -> float:
    """DN that codes of unequal width add to black: at no exposure, on the line through what they add to the means of the dark levels."""
    adc, gain = camera["grabber.adc"].params, camera["electronics.gain"].params.gain_dn_per_e
    lines = camera["electronics.row_noise"].params
    noise_e2 = camera["electronics.amplifier_noise"].params.white_e ** 2 + lines.row_e**2 + lines.column_e**2
    codes = np.arange(1, adc.top + 1)
    uneven = thresholds(adc, camera.streams(0).of("grabber.adc"))
    some_e = np.quantile(extra_e, (np.arange(400) + 0.5) / 400)
    times = [group.exposure_s for group in plan_series(series) if group.kind == "dark"]
    added = []
    for time in times:
        dark_e = camera["sensor.dark_current"].params.rate_e_per_s * time
        mean, std = adc.offset_dn + gain * (some_e + dark_e), gain * np.sqrt(noise_e2 + dark_e)
        near = (codes > mean.min() - 8 * std - 2) & (codes < mean.max() + 8 * std + 2)
        stored, level = (ndtr((mean[:, None] - t[near]) / std).sum(axis=1).mean() for t in (uneven, codes - 0.5))
        added.append(float(stored - level))
    return float(np.polyfit(times, added, 1)[1]) if np.ptp(times) > 0 else float(np.mean(added))


def _charge_of(name: str, camera: Camera) -> np.ndarray:
    """Electrons that a source of this unit adds to none, shape of the frame."""
    one = np.ones(1)
    grid = Grid.whole([0], camera.frame_shape)
    still = Signal(np.zeros((1, *camera.frame_shape), np.float32), Kind.ELECTRONS, grid, camera.frame_shape, one, one, one)
    element = camera[name]
    return element.source.forward(element.params, still, camera.streams(0).of(name)).data[0].astype(float)


def _unit_maps(camera: Camera) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Shading, relative response, and constant extra electrons (DSNU and hot pixels) of this unit, each of the frame's shape."""
    from pixmetry.sources.optics import shading

    grid, streams = Grid.whole([0], camera.frame_shape), camera.streams(0)
    one = np.ones(1)
    still = Signal(np.zeros((1, *camera.frame_shape), np.float32), Kind.ELECTRONS, grid, camera.frame_shape, one, one, one)
    shade = shading.factor(camera["optics.shading"].params, still)[0].astype(float)
    response = prnu.response(camera["sensor.prnu"].params, grid, streams.of("sensor.prnu"))[0].astype(float)
    extra = _charge_of("sensor.dsnu", camera) + _charge_of("sensor.defects", camera)
    room = min(camera["sensor.full_well"].params.full_well_e, _top_dn(camera) / camera["electronics.gain"].params.gain_dn_per_e)
    return shade, response, np.minimum(extra, room)


def _top_dn(camera: Camera) -> float:
    return camera["grabber.adc"].params.top - camera["grabber.adc"].params.offset_dn


# ---- measuring and scoring ---------------------------------------------------------------------------------------------------------


def observe_case(case: Case) -> Observations:
    """Expose the campaign and reduce it; the observer is told bits, exposure times and photons, nothing else."""
    rng = np.random.default_rng([*case.key, 1])
    shade = float(_unit_maps(case.camera)[0].mean())

    def groups() -> Iterator[Group]:
        for g in plan_series(case.series):
            lamp = case.lamp_rel * float(rng.standard_normal()) if g.kind == "bright" else 0.0
            frames = expose_group(case.camera, g, seed=case.key[1], lamp_rel=lamp)
            yield Group(g.kind, g.role, g.exposure_s, g.photons * shade if g.kind == "bright" else None, frames)

    return observe(groups(), case.camera["grabber.adc"].params.bits)


def estimates_of(seen: Observations) -> dict[str, Number]:
    """All estimates by ``source.parameter``, and what only the common fit gives."""
    found = {f"{source}.{e.name}": e for source, estimates in measure_sources(seen)[0].items() for e in estimates}
    for name, old in (("lamp noise", "illumination_noise_rel"), ("responsivity (DN/s)", "responsivity_dn_per_s")):
        if old in seen.photon_transfer_fit:
            found[name] = seen.photon_transfer_fit[old]
    return found


def run_camera(seed: int, index: int, quick: bool = False) -> list[Score] | str:
    """Scores of one camera, or why it could not be measured."""
    case = random_case(seed, index, quick)
    try:
        seen = observe_case(case)
    except MeasureError as problem:
        return str(problem)
    return score(case, estimates_of(seen))


def score(case: Case, found: dict[str, Number]) -> list[Score]:
    """Compare every estimate with the truth."""
    reference = reference_u(case)
    scores = []
    for name, e in found.items():
        if name not in case.truth or name in ("grabber.phase_pattern.moving", "sensor.full_well.knee_rel"):
            continue
        label, true = name, case.truth[name]
        if name == "sensor.full_well.full_well_e":
            label += " (well clips)" if "well clips" in case.traits else " (converter clips)"
        dof = min(e.dof, 1e9)
        p = float(stats.t.cdf((e.value - true) / e.u, dof)) if e.u > 0 else float("nan")
        u_ref = reference.get(name, float("nan"))
        resolved = true > (RESOLVED * u_ref if np.isfinite(u_ref) else 0) or not name.startswith(CAN_BE_ZERO)
        if name.startswith("electronics.nonlinearity.") and u_ref > INFORMED:
            resolved = False
        if name in COUNTS:
            pixels = case.camera.frame_shape[0] * case.camera.frame_shape[1]
            within = abs(e.value - true) * pixels <= MISCOUNTED
            scores.append(Score(label, e.kind, False, 0.5 if within else 0.0, bool(within), 0.0, float("nan"), case.traits))
            continue
        held = true <= e.value if e.kind == "upper_limit" else 0.05 <= p <= 0.95
        scores.append(Score(label, e.kind, resolved, p, bool(held), (e.value - true) / true if true else 0.0, e.u / u_ref, case.traits))
    return scores


def reference_u(case: Case) -> dict[str, float]:
    """The least uncertainty with which the same data can tell each quantity, all weights known; see ``reference_u``."""
    c, series = case.camera, case.series
    shade = _unit_maps(c)[0]
    bend, gain, row = c["electronics.nonlinearity"].params, c["electronics.gain"].params.gain_dn_per_e, c["electronics.row_noise"].params
    adc, dsnu, fixed = c["grabber.adc"].params, c["sensor.dsnu"].params, c["sensor.prnu"].params
    efficiency = case.truth["sensor.quantum_efficiency.quantum_efficiency"]
    reference = Reference(
        shape=c.frame_shape,
        levels=series.levels,
        frames=series.frames_per_level,
        stack_frames=series.stack_frames,
        stack_rel=series.stack_rel,
        bits=adc.bits,
        offset_dn=adc.offset_dn,
        gain=gain,
        dark_noise_e=c["electronics.amplifier_noise"].params.white_e,
        row_e=row.row_e,
        column_e=row.column_e,
        a=(bend.a1, bend.a2, bend.a3),
        light_e=efficiency * series.brightest_photons * float(shade.mean()),
        dark_e=c["sensor.dark_current"].params.rate_e_per_s * series.longest_exposure_s,
        full_well_e=c["sensor.full_well"].params.full_well_e,
        brightest_rel=float(shade.max() / shade.mean()) * (1 + 4 * fixed.pixel_std_rel),
        lamp_rel=case.lamp_rel,
        dsnu_e=(dsnu.pixel_std_e, dsnu.row_std_e, dsnu.col_std_e),
        prnu_rel=(fixed.pixel_std_rel, fixed.row_std_rel, fixed.col_std_rel),
        spread_rel=float(np.hypot(shade.std() / shade.mean(), fixed.pixel_std_rel)),
    )
    u = photon_transfer_u(reference)
    out = {
        "electronics.gain.gain_dn_per_e": u["gain"],
        "electronics.amplifier_noise.white_e": u["dark_noise_e"],
        "electronics.nonlinearity.a1": u["a1"],
        "electronics.nonlinearity.a2": u["a2"],
        "electronics.nonlinearity.a3": u["a3"],
        "grabber.adc.offset_dn": u["offset_dn"],
        "sensor.quantum_efficiency.quantum_efficiency": u["efficiency_rel"] * efficiency,
        "responsivity (DN/s)": u["slope_rel"] * case.truth["responsivity (DN/s)"],
        "sensor.dark_current.rate_e_per_s": u["dark_e"] / series.longest_exposure_s,
        "electronics.row_noise.row_e": u["row_e"],
        "electronics.row_noise.column_e": u["column_e"],
        "lamp noise": u["lamp_rel"],
    }
    return out | spatial_u(reference, u["gain"] / gain)


# ---- summary -----------------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Line:
    """One quantity over many cameras."""

    name: str
    n: int  # estimates of resolved quantities
    p_uniform: float  # Kolmogorov–Smirnov
    p_mean: float  # that the mean of z is 0
    p_scatter: float  # that z² sums to χ² of n
    mean_z: float
    std_z: float
    inside_95: float
    u_ratio: float  # median
    lost: int  # resolved by the truth, yet reported as a limit
    n_small: int
    missed: int  # of the small ones
    p_missed: float


def summarise(scores: Iterable[Score]) -> list[Line]:
    """One line a quantity."""
    by_name: dict[str, list[Score]] = {}
    for s in scores:
        by_name.setdefault(s.name, []).append(s)
    return [_line(name, group) for name, group in sorted(by_name.items())]


def _line(name: str, group: list[Score]) -> Line:
    big = [s for s in group if s.resolved and s.kind == "value" and np.isfinite(s.p)]
    small = [s for s in group if not s.resolved or s.kind == "upper_limit"]
    p = np.clip(np.array([s.p for s in big]), 1e-16, 1 - 1e-16)
    z = stats.norm.ppf(p)
    n, missed = len(big), sum(not s.held for s in small)
    chi2 = stats.chi2(n) if n else None
    ratios = [s.u_ratio for s in big if np.isfinite(s.u_ratio)]
    nan = float("nan")
    return Line(
        name,
        n,
        float(stats.kstest(p, "uniform").pvalue) if n else nan,
        float(2 * stats.norm.sf(abs(z.mean()) * np.sqrt(n))) if n else nan,
        float(2 * min(chi2.sf((z**2).sum()), chi2.cdf((z**2).sum()))) if n else nan,
        float(z.mean()) if n else nan,
        float(np.sqrt((z**2).mean() - z.mean() ** 2)) if n else nan,
        float(np.mean(np.abs(p - 0.5) < 0.475)) if n else nan,
        float(np.median(ratios)) if ratios else nan,
        sum(s.resolved and s.kind == "upper_limit" for s in group),
        len(small),
        missed,
        # a limit misses in 5 % of all cases, a 90 % interval in 10 %: never more than that
        float(stats.binom.sf(missed - 1, len(small), 0.1 if any(s.kind == "value" for s in small) else 0.05)) if small else 1.0,
    )


def failures(lines: Iterable[Line], rate: float, excluded: Iterable[str] = ()) -> list[str]:
    """Quantities that contradict their stated uncertainty; ``rate`` is the chance that any sound one is named (Bonferroni)."""
    lines = [line for line in lines if not line.name.startswith(tuple(excluded))]
    each = rate / (4 * max(len(lines), 1))
    found = []
    for line in lines:
        for what in ("p_uniform", "p_mean", "p_scatter", "p_missed"):
            if getattr(line, what) < each:
                found.append(
                    f"{line.name}: {what} = {getattr(line, what):.1e} (mean z {line.mean_z:+.2f}, std z {line.std_z:.2f}, n {line.n})"
                )
    return found


def planted(scores: Iterable[Score], name: str, bias_u: float = 0.0, u_factor: float = 1.0) -> list[Score]:
    """The scores as they would be if one estimator were off by ``bias_u`` of its u, or stated a u that is ``u_factor`` times as large."""

    def spoil(s: Score) -> Score:
        z = (stats.norm.ppf(np.clip(s.p, 1e-16, 1 - 1e-16)) + bias_u) / u_factor
        return replace(s, p=float(stats.norm.cdf(z)))

    return [spoil(s) if s.name == name else s for s in scores]
