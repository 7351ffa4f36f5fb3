"""The u that a plan promises, against cameras measured over and over; and that plans meet wishes without waste."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats
from scipy.ndimage import convolve1d

from pixmetry.core.errors import InputError
from pixmetry.core.number import UPPER_LIMIT, Number
from pixmetry.emva.planning.known_camera import KnownCamera, camera_from_results
from pixmetry.emva.planning.planning import (
    Plan,
    camera_from_sheet,
    parse_wanted,
    plan_for,
    plan_text,
    predicted_u,
    with_scatter,
    write_campaign,
)
from pixmetry.emva.records import DataSheet, Results
from pixmetry.files.manifest import load_campaign

ALPHA = 1e-6
CCD = KnownCamera(480, 640, 12, 0.28, 10.9, 14000, 0.3, 0.2, 0.5, 0.0026, 0.0005, 0.001, row_noise_e=1.8, quantum_efficiency=0.45)


def assert_scatter(values: np.ndarray, u: float, dof: int, model: float = 0.0) -> None:
    """Standard deviation of repeated values against u: chi-square bounds at a false-failure rate of 1e-6, widened by ``model``."""
    ratio = float(np.sqrt((values**2).sum() / dof) / u)
    low, high = np.sqrt(stats.chi2.ppf([ALPHA / 2, 1 - ALPHA / 2], dof) / dof)
    assert low - model < ratio < high + model, (ratio, low, high)


@pytest.mark.parametrize("sweep", ["exposure", "light"])
@pytest.mark.parametrize("steady", [True, False])
def test_stat_series_scatters_as_foretold(sweep: str, steady: bool, rng: np.random.Generator) -> None:
    """K, σ_d, R and η of 500 repeated series; ± 16 % at 1e-6, so a frame too many in the degrees of freedom (22 %) is seen."""
    scatter = {} if steady else {"var_excess_rel": 0.03, "light_scatter_rel": 0.03}
    camera = KnownCamera(
        24, 40, 12, 0.5, 40.0, 3500, row_noise_e=8.0, dark_current_e_per_s=2000, quantum_efficiency=0.6, exposure_sat_s=0.01, **scatter
    )
    plan = Plan(levels=12, frames_per_level=3, stack_frames=200, sweep=sweep)
    found = np.array([_series_values(camera, plan, rng) for _ in range(500)])
    u = predicted_u(camera, plan)
    for i, key in enumerate(("K", "sigma_d", "R", "QE")):
        if steady and key == "R":  # the plan leaves the noise of the means out: without scatter of the light it promises 0
            continue
        # second-order terms at u of 5 % stay below 3 %
        assert_scatter(found[:, i] - found[:, i].mean(), u[key], 499, model=0.03)


def _series_values(camera: KnownCamera, plan: Plan, rng: np.random.Generator) -> tuple[float, float, float, float]:
    """One measurement of K, σ_d, R, η by the standard's formulas (R4.0 eq. 49, 50, 52, 53)."""
    sat = np.asarray(plan.fractions)
    sat = sat[sat <= 0.7]
    bright = [_level(camera, s, t, plan.frames_per_level, rng) for s, t in zip(sat, plan.bright_exposures, strict=False)]
    dark = [_level(camera, 0.0, t, plan.frames_per_level, rng) for t in plan.dark_fractions]
    mean, var = np.array(bright).T
    dark_mean, dark_var = np.array(dark).T
    beside = slice(0, sat.size) if plan.sweep == "exposure" else slice(-1, None)
    x, y = mean - dark_mean[beside], var - dark_var[beside]
    photons = sat * camera.saturation_e / camera.quantum_efficiency
    gain, responsivity = (x * y).sum() / (x * x).sum(), (photons * x).sum() / (photons**2).sum()
    intercept = np.polyfit(plan.dark_fractions, dark_var, 1)[1]
    return gain, np.sqrt(intercept - 1 / 12) / gain, responsivity, 100 * responsivity / gain


def _level(camera: KnownCamera, fraction: float, exposure: float, n: int, rng: np.random.Generator) -> tuple[float, float]:
    """Mean and temporal variance of the frames of a level; scatter of the light and of the variance as the camera has it."""
    light = camera.saturation_e * fraction * (1 + camera.light_scatter_rel * rng.standard_normal())
    shot = rng.poisson(light + camera.dark_current_e_per_s * exposure * camera.exposure_sat_s, (n, camera.rows, camera.cols)).astype(float)
    electrons = shot + camera.dark_noise_e * rng.standard_normal(shot.shape)
    electrons += camera.row_noise_e * rng.standard_normal((n, camera.rows, 1))
    frames = np.rint(camera.gain_dn_per_e * electrons + 100)
    frames -= frames.mean(axis=(1, 2), keepdims=True) - frames.mean()
    variance = frames.var(axis=0, ddof=1).mean()
    return frames.mean(), variance * (1 + camera.var_excess_rel * rng.standard_normal())


def _high_passed(image: np.ndarray) -> np.ndarray:
    low = image
    for kernel in (np.ones(7) / 7, np.ones(11) / 11, np.array([0.25, 0.5, 0.25])):
        low = convolve1d(convolve1d(low, kernel, axis=-1), kernel, axis=-2)
    return (image - low)[..., 9:-9, 9:-9]


def _strata(image: np.ndarray) -> np.ndarray:
    """Mean squares of pixel, row and column stratum, shape (3, …)."""
    rows, cols = image.shape[-2:]
    image = image - image.mean(axis=(-2, -1), keepdims=True)
    row, col = image.mean(axis=-1), image.mean(axis=-2)
    rest = image - row[..., None] - col[..., None, :]
    squares = (rest**2).sum(axis=(-2, -1)), cols * (row**2).sum(axis=-1), rows * (col**2).sum(axis=-1)
    return np.array([s / d for s, d in zip(squares, ((rows - 1) * (cols - 1), rows - 1, cols - 1), strict=True)])


def test_stat_stacks_scatter_as_foretold(rng: np.random.Generator) -> None:
    """DSNU and PRNU with their parts: 20 sensors, 40 stacks each; ± 13 % at 1e-6 beside 4 % for patterns that are no exact sample."""
    camera = KnownCamera(60, 80, 12, 0.5, 6.0, 8000, 3.0, 2.0, 1.5, 0.008, 0.005, 0.004, row_noise_e=1.5)
    plan = Plan(levels=500, frames_per_level=64, stack_frames=8)  # u of K counts for nothing beside the stacks
    shape = (camera.rows, camera.cols)
    white = _strata(_high_passed(rng.standard_normal((300, *shape)))).mean(axis=1)  # what the filter leaves of white noise
    found, sensors = [], 20
    for _ in range(sensors):
        dark_map = _pattern(camera, camera.dsnu_pixel_e, camera.dsnu_row_e, camera.dsnu_col_e, rng)
        prnu_map = _pattern(camera, camera.prnu_pixel_rel, camera.prnu_row_rel, camera.prnu_col_rel, rng)
        values = np.array([_stack_values(camera, plan, dark_map, prnu_map, white, rng) for _ in range(40)])
        found.append(values - values.mean(axis=0))
    scatter = np.concatenate(found)
    u = predicted_u(camera, plan)
    keys = [f"{name}{part}" for name in ("DSNU1288", "PRNU1288") for part in ("_pixel", "_row", "_col", "")]
    for i, key in enumerate(keys):
        assert_scatter(scatter[:, i], u[key], sensors * 39, model=0.04)


def _pattern(camera: KnownCamera, pixel: float, row: float, col: float, rng: np.random.Generator) -> np.ndarray:
    """A fixed pattern whose parts have the wanted standard deviations after the filter."""

    def scaled(part: np.ndarray, wanted: float, stratum: int) -> np.ndarray:
        gain = 0.9885 if stratum == 0 else 0.88906  # of the filter for an endless field of white pixels or lines
        size = (1.0, camera.cols, camera.rows)[stratum]
        return part * wanted / np.sqrt(_strata(_high_passed(part))[stratum] / size / gain)

    shape = (camera.rows, camera.cols)
    rows, cols = rng.standard_normal((camera.rows, 1)) * np.ones(shape), rng.standard_normal((1, camera.cols)) * np.ones(shape)
    return scaled(rng.standard_normal(shape), pixel, 0) + scaled(rows, row, 1) + scaled(cols, col, 2)


def _stack_values(camera, plan, dark_map, prnu_map, white, rng) -> np.ndarray:
    """DSNU (e⁻) and PRNU (%) of one pair of stacks: pixel, row, column, total (R4.0 eq. 36, 42, 66, 67, temporal line noise taken off)."""
    signal, n = 0.5 * camera.saturation_e, plan.stack_frames
    squares = []
    for light in (0.0, signal):
        fixed = dark_map + light * (1 + prnu_map)
        noise = np.sqrt(camera.dark_noise_e**2 + light) * rng.standard_normal((n, *dark_map.shape))
        noise += camera.row_noise_e * rng.standard_normal((n, camera.rows, 1))
        frames = np.rint(camera.gain_dn_per_e * (fixed + noise) + 200) / camera.gain_dn_per_e
        mean = frames.mean(axis=0)
        temporal = _strata(frames - mean).sum(axis=1) / (n - 1)  # mean squares, free of the pattern
        strata = _strata(_high_passed(mean)) / white - temporal / n
        parts = np.array([strata[0], (strata[1] - strata[0]) / camera.cols, (strata[2] - strata[0]) / camera.rows])
        squares.append(np.append(parts, parts.sum()))
    dark, bright = squares
    return np.concatenate([np.sqrt(dark), 100 * np.sqrt(bright - dark) / signal])


def test_limit_of_no_pattern_stays_finite() -> None:
    """Where s² is pure noise of standard deviation v, the mean of max(s², 0) is v/√(2π): √max(s², 0) has that root about no pattern."""
    camera = replace(CCD, dsnu_pixel_e=0.0, dsnu_row_e=0.0, dsnu_col_e=0.0, row_noise_e=0.0, quantum_efficiency=None)
    white_e2 = camera.dark_noise_e**2 + 1 / 12 / camera.gain_dn_per_e**2
    size = (480 - 18) * (640 - 18)
    v = white_e2 / 100 * np.sqrt(2 / size * 100 / 99)
    assert predicted_u(camera, Plan(stack_frames=100))["DSNU1288_pixel"] == pytest.approx(np.sqrt(v / np.sqrt(2 * np.pi)), rel=0.01)


def test_limit_of_hidden_dark_noise() -> None:
    camera = replace(CCD, gain_dn_per_e=0.01)
    assert np.isinf(predicted_u(camera, Plan())["sigma_d"])
    plan = plan_for(camera, {"sigma_d": 1.0})
    assert "0.40/K" in plan.unreachable["sigma_d"]
    assert "bound only" in plan_text(camera, plan, {"sigma_d": 1.0})


WISHES = [
    {"K": 0.0001},
    {"K": 0.0003, "DSNU1288": 0.01},
    {"sigma_d": 0.02, "PRNU1288_row": 0.0003, "QE": 0.05},
    {"DSNU1288_pixel": 0.002, "PRNU1288": 0.0002, "K": 0.00008},
]


@pytest.mark.parametrize("sweep", ["exposure", "light"])
@pytest.mark.parametrize("wanted", WISHES)
@pytest.mark.parametrize("more", [{}, {"var_excess_rel": 0.0075, "light_scatter_rel": 0.005}, {"exposure_sat_s": 0.1, "frame_rate_hz": 25}])
def test_plans_meet_wishes_without_waste(wanted: dict, sweep: str, more: dict) -> None:
    camera = replace(CCD, **more)
    plan = plan_for(camera, wanted, sweep=sweep)
    wishes = {key: u for key, u in wanted.items() if key not in plan.unreachable}

    def meets(p: Plan) -> bool:
        return all(predicted_u(camera, p)[key] <= u for key, u in wishes.items())

    assert meets(plan)
    least = {"levels": 50, "frames_per_level": 2, "stack_frames": 16} | ({"dark_levels": 6} if sweep == "light" else {})
    for name, minimum in least.items():
        number = getattr(plan, name)
        assert number >= minimum
        assert number == minimum or not meets(replace(plan, **{name: number - 1})), name
        assert (plan.drivers[name] == "least number") == (number == minimum)
    for frames in (2, 3, 5):  # no plan with other frames per level is cheaper, whatever its levels
        for levels in range(50, plan.levels + 1, 25):
            other = replace(plan, levels=levels, frames_per_level=frames)
            cost = [p.n_frames if camera.exposure_sat_s is None else p.duration_s(camera) for p in (other, plan)]
            assert cost[0] >= cost[1] * 0.97 or not meets(other)


def test_what_cannot_be_reached_is_said_with_its_cause() -> None:
    rough = replace(CCD, var_excess_rel=0.02, light_scatter_rel=0.01)
    plan = plan_for(rough, {"K": 0.00005, "R": 1e-6, "PRNU1288": 1e-7, "DSNU1288": 0.01})
    assert set(plan.unreachable) == {"K", "R", "PRNU1288"}
    assert "scatter of the variances" in plan.unreachable["K"] and "2 %" in plan.unreachable["K"]
    assert "scatter of the light" in plan.unreachable["R"]
    assert plan.drivers["stack_frames"] == "u of DSNU1288"
    assert (plan.levels, plan.frames_per_level) == (50, 2)  # what cannot be reached costs nothing
    assert "Cannot be reached: u(K)" in plan_text(rough, plan, {"K": 0.00005})


def test_no_wish_takes_the_least_and_wrong_ones_are_refused() -> None:
    plan = plan_for(CCD, {})
    assert (plan.levels, plan.frames_per_level, plan.stack_frames, plan.n_frames) == (50, 2, 16, 232)
    with pytest.raises(InputError, match="cannot be planned"):
        plan_for(CCD, {"LE": 0.1})
    with pytest.raises(InputError, match="above 0"):
        plan_for(CCD, {"K": 0.0})
    with pytest.raises(InputError, match="quantum efficiency"):
        plan_for(replace(CCD, quantum_efficiency=None), {"QE": 0.1})
    with pytest.raises(InputError, match="sweep"):
        Plan(sweep="both")
    with pytest.raises(InputError, match="gain_dn_per_e"):
        replace(CCD, gain_dn_per_e=0.0)


def test_wishes_are_read() -> None:
    wanted = parse_wanted(CCD, ["K=0.1%", "sigma_d = 0.02", "PRNU1288=0.01%", "QE=0.5"])
    assert wanted == pytest.approx({"K": 0.00028, "sigma_d": 0.02, "PRNU1288": 0.01, "QE": 0.5})
    for text in ("K", "K=x", "=", "K=0.1 DN"):
        with pytest.raises(InputError, match="cannot be read"):
            parse_wanted(CCD, [text])
    with pytest.raises(InputError, match="unknown or zero"):
        parse_wanted(replace(CCD, dsnu_row_e=0.0), ["DSNU1288_row=5%"])


def test_known_camera_from_a_sheet() -> None:
    """Limits L count as L/√3; the scatter that explains a u of K is found again."""
    truth = replace(CCD, var_excess_rel=0.0075, light_scatter_rel=0.004, coherence=6.0, dsnu_col_e=0.0)
    plan = Plan(frames_per_level=2)
    u = predicted_u(truth, plan)
    values = {key: Number(value, u[key], 50.0, "") for key, value in truth.values.items()}
    values |= {"u_e_sat": Number(14000.0, 10.0, 50.0, "e⁻"), "u_I_mean": Number(-3.0, 1.0, 9.0, "e⁻/s")}
    values["DSNU1288_row"] = Number(0.2 * np.sqrt(3), 0.1, 9.0, "e⁻", kind=UPPER_LIMIT)
    values["DSNU1288_col"] = Number(np.nan, np.nan, 9.0, "e⁻", reason="nothing is known")
    k2, s = CCD.gain_dn_per_e**2, CCD.dsnu_pixel_e
    values["s_2_y_pixel_dark"] = Number(k2 * s**2, k2 * 2 * s * u["DSNU1288_pixel"], 50.0, "DN²")
    facts = {"rows": 480, "cols": 640, "bits": 12}
    camera = camera_from_sheet(DataSheet((Results("4.0", values),), facts, {}, {}), row_noise_e=1.8)
    expected = vars(replace(CCD, dsnu_col_e=0.0))
    assert vars(camera) == {k: pytest.approx(v) if isinstance(v, float) else v for k, v in expected.items()}
    known = with_scatter(camera, values, plan)
    assert known.var_excess_rel == pytest.approx(0.0075, rel=1e-6)
    assert known.light_scatter_rel == pytest.approx(0.004, rel=1e-6)
    assert known.coherence == pytest.approx(6.0, rel=0.02)  # u of the root is no tangent
    conditions = {"sweep": "exposure time at constant light", "bright_levels": 50, "frames_per_level": [2], "dark_stack_frames": 100}
    conditions |= {"exposures_s": [0.0, 0.02], "photons": [0.0, 62000.0]}
    values["u_p_sat"] = Number(31000.0, 10.0, 50.0, "photon")
    timed = camera_from_sheet(DataSheet((Results("4.0", values),), facts, conditions, {}), row_noise_e=1.8)
    assert timed.exposure_sat_s == pytest.approx(0.01)
    assert timed.var_excess_rel == pytest.approx(0.0075, rel=1e-4)
    assert camera_from_sheet(DataSheet((Results("4.0", values),), facts, conditions, {}), var_excess_rel=0.0).var_excess_rel == 0.0
    as_json = {key: {"value": None if np.isnan(v.value) else v.value, "u": v.u, "is_limit": v.is_upper_limit} for key, v in values.items()}
    assert camera_from_results(as_json, 480, 640, 12, row_noise_e=1.8) == camera
    with pytest.raises(InputError, match="sigma_d"):
        camera_from_results({"K": 0.3}, 480, 640, 12)


@pytest.mark.parametrize("sweep", ["exposure", "light"])
def test_manifest_loads_once_its_frames_exist(tmp_path, sweep: str) -> None:
    import tifffile

    camera, plan = replace(CCD, exposure_sat_s=0.02), Plan(levels=5, frames_per_level=3, stack_frames=4, sweep=sweep)
    write_campaign(camera, plan, tmp_path / "campaign.yaml", name="test camera")
    (tmp_path / "frames").mkdir()
    from pixmetry.core.config import load_yaml

    groups = load_yaml(tmp_path / "campaign.yaml")["frames"]
    for group in groups:
        for i in range(plan.stack_frames if group["role"] == "stack" else plan.frames_per_level):
            tifffile.imwrite(tmp_path / group["files"].replace("*", f"{i:03d}"), np.zeros((8, 8), np.uint16))
    campaign = load_campaign(tmp_path)
    assert campaign.frame_count == plan.n_frames and campaign.bits == 12
    assert len(campaign.levels("bright")) == 5 and len(campaign.levels("dark")) == plan.dark_fractions.size
    bright, dark = *campaign.stacks("bright"), *campaign.stacks("dark")
    assert bright.exposure_s == dark.exposure_s == (0.01 if sweep == "exposure" else 0.02)
    assert (bright.photons is None) == (sweep == "exposure")
    with pytest.raises(InputError, match="exposures are not known"):
        write_campaign(CCD, plan, tmp_path / "other.yaml")
