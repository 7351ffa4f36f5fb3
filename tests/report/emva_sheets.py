"""Data sheets of a camera that is known in closed form: values and curves by formulas, no frames and no evaluation."""

from __future__ import annotations

from math import erfc, log2, log10, pi, sqrt

import numpy as np

from pixmetry.core.number import UPPER_LIMIT, Number
from pixmetry.emva.files.keys import KEYS, key_of
from pixmetry.emva.records import DataSheet, Results

K, ETA, SIGMA_D, DARK_RATE = 0.28, 0.45, 11.0, 30.0  # DN/e-, 1, e-, e-/s
SATURATION_E, DSNU_DN, PRNU_PERCENT = 14000.0, 0.2, 0.4
LEVELS, FRAMES, ROWS, COLS = 50, 50, 480, 640
PHOTONS = np.linspace(600.0, 1.1 * SATURATION_E / ETA, LEVELS)
EXPOSURE_S = PHOTONS / 3e6
DEPARTURE = (2.7, 3.4)  # %, what frames of a camera at the limit of the linear model show
SAT_P = SATURATION_E / ETA
NOISE_DN = sqrt((K * SIGMA_D) ** 2 + 1 / 12)
THRESHOLD = (sqrt((NOISE_DN / K) ** 2 + 0.25) + 0.5) / ETA


def true_values() -> dict[str, float]:
    """The values that the formulas of the standard give for this camera, by key."""
    snr_max, dr = sqrt(SATURATION_E), SAT_P / THRESHOLD
    return {
        "index_u_ysat": 44, "R": K * ETA, "K": K, "inverse_K": 1 / K, "QE": 100 * ETA, "sigma_y_dark": NOISE_DN, "sigma_d": SIGMA_D,
        "u_p_min": THRESHOLD, "u_e_min": ETA * THRESHOLD, "u_p_sat": SAT_P, "u_e_sat": SATURATION_E, "SNR_max": snr_max,
        "SNR_max_dB": 20 * log10(snr_max), "SNR_max_bit": log2(snr_max), "DR": dr, "DR_dB": 20 * log10(dr), "PTC_linearity": 1.2,
        "LE": 0.31, "LE_min": -0.6, "LE_max": 0.5, "u_I_mean": DARK_RATE, "u_I_var": 31.0, "s_2_y_dark": DSNU_DN**2,
        "DSNU1288": DSNU_DN / K, "DSNU1288_DN": DSNU_DN, "DSNU1288_row": 0.1, "DSNU1288_col": 0.2, "DSNU1288_pixel": 0.35,
        "PRNU1288": PRNU_PERCENT, "PRNU1288_row": 0.1, "PRNU1288_col": 0.1, "PRNU1288_pixel": 0.37,
    }  # fmt: skip


def values(k: float = 1.0) -> dict[str, Number]:
    """These values with uncertainties of half a percent; a limit, a value that cannot be given, and two beside the standard's."""
    found = {
        name: Number(k * v, abs(0.005 * v) if KEYS[name].section != "info" else 0.0, 47.0, KEYS[name].unit, f"by {KEYS[name].section}")
        for name, v in true_values().items()
    }
    found["DSNU1288_pixel"] = Number(0.35, 0.2, np.inf, "e⁻", "by spatial", "the variance is negative: temporal row noise", UPPER_LIMIT)
    found["u_p_min_area"] = Number(np.nan, np.nan, np.nan, "photon/µm²", "", "the pixel pitch is not known")
    found["K_nonlinear"] = Number(0.2851, 0.0006, 80.0, "DN/e⁻", "joint fit", "the camera bends by 2 %")
    found["u_I_mean_nonlinear"] = Number(28.9, 0.6, 80.0, "e⁻/s", "joint fit")
    return found


def curves(photons_known: bool = True, stacks: bool = True, scale: float = 1.0) -> dict[str, dict[str, np.ndarray]]:
    """Curves of the same camera; ``scale`` multiplies the quantum efficiency."""
    light = {"photons": PHOTONS} if photons_known else {"exposure_s": EXPOSURE_S}
    electrons = np.minimum(scale * ETA * PHOTONS, SATURATION_E)
    mean = K * electrons
    sigma2 = np.where(electrons < SATURATION_E, K * mean, 30.0)
    wobble = 0.003 * np.sin(np.arange(LEVELS) * 2.3)
    used = electrons <= 0.7 * SATURATION_E
    noise_e = np.sqrt((NOISE_DN / K) ** 2 + scale * ETA * PHOTONS)
    spatial_e = np.hypot(DSNU_DN / K, PRNU_PERCENT / 100 * scale * ETA * PHOTONS)
    signal = scale * ETA * PHOTONS
    fit = K * scale * ETA * PHOTONS
    between = (electrons > 0.05 * SATURATION_E) & (electrons < 0.95 * SATURATION_E)
    snr = mean * (1 + wobble) / np.sqrt(NOISE_DN**2 + sigma2)
    found = {
        "sensitivity": {**light, "mean_dn": mean * (1 + wobble), "fit_dn": fit, "used": used},
        "dark_signal": {
            "exposure_s": EXPOSURE_S, "mean_dn": 14.7 + K * DARK_RATE * EXPOSURE_S + 0.01 * wobble,
            "fit_dn": 14.7 + K * DARK_RATE * EXPOSURE_S,
            "var_dn2": NOISE_DN**2 + K**2 * DARK_RATE * EXPOSURE_S + wobble, "var_fit_dn2": NOISE_DN**2 + K**2 * DARK_RATE * EXPOSURE_S,
        },
        "PTC": {
            "mean_dn": mean * (1 + wobble), "var_dn2": sigma2 * (1 + 2 * wobble), "u_var_dn2": 0.004 * sigma2,
            "fit_dn2": K * mean * (1 + wobble), "used": used, "saturation": np.array([K * SATURATION_E]),
            "departure_low": np.array([DEPARTURE[0]]), "departure_high": np.array([DEPARTURE[1]]),
        },
        "linearity": {
            **light, "mean_dn": mean * (1 + wobble), "fit_dn": fit, "used": between, "relative_deviation": 100 * wobble,
            "fit_slope": np.array([K * ETA]), "fit_offset": np.array([0.4]),
            "linearity_error_min": np.array([-0.3]), "linearity_error_max": np.array([0.3]),
        },
    }  # fmt: skip
    if photons_known:
        found["SNR"] = {
            "photons": PHOTONS, "snr": snr, "ideal": np.sqrt(PHOTONS), "shot_limit": np.sqrt(signal), "dark_limit": signal * K / NOISE_DN,
            "model": signal / noise_e, "total": signal / np.hypot(noise_e, spatial_e),
        }  # fmt: skip
        slope = np.where(electrons < SATURATION_E, K * ETA, 1e-3)
        found["general"] = {
            "photons": PHOTONS, "mean_dn": mean, "var_dn2": NOISE_DN**2 + sigma2, "slope": slope, "sigma_p": noise_e / ETA,
            "s_p": spatial_e / ETA, "snr_p": signal / noise_e, "snr_p_total": signal / np.hypot(noise_e, spatial_e),
        }  # fmt: skip
    return found | (spatial_curves() if stacks else {})


def spatial_curves() -> dict[str, dict[str, np.ndarray]]:
    """White pattern with one line in each spectrum, level profiles with ripples, and normal histograms with one outlier."""
    found: dict[str, dict[str, np.ndarray]] = {}
    rng = np.random.default_rng(20240612)
    for kind, size, temporal in (("DSNU", DSNU_DN, NOISE_DN), ("PRNU", PRNU_PERCENT, 1.2)):
        for way, n in (("horizontal", COLS), ("vertical", ROWS)):
            amplitude = size * np.sqrt(rng.gamma(20.0, 1 / 20, n // 2))
            amplitude[n // 8] *= 6
            levels = {"total": 1.1 * size, "nonuniformity": size, "temporal": temporal, "white_floor": temporal / sqrt(FRAMES)}
            levels["white_share"] = 0.93
            found[f"{way}_spectrogram_{kind}"] = {
                "frequency": np.arange(1, n // 2 + 1) / n,
                "amplitude": amplitude,
                **{name: np.array([v]) for name, v in levels.items()},
            }
            level = 14.7 if kind == "DSNU" else 2000.0
            mean = level * (1 + 0.01 * np.cos(2 * pi * np.arange(n) / n))
            found[f"{way}_profile_{kind}"] = {
                "position": np.arange(n), "mid": mean * (1 + 0.004 * rng.standard_normal(n)), "mean": mean,
                "min": 0.97 * mean, "max": 1.03 * mean,
            }  # fmt: skip
        size *= 1.0 if kind == "DSNU" else 20.0  # PRNU in DN at a signal of 2000 DN
        bins = np.linspace(-6, 6, 241) * size
        model = ROWS * COLS * (bins[1] - bins[0]) / (sqrt(2 * pi) * size) * np.exp(-0.5 * (bins / size) ** 2)
        counts = np.round(model)
        counts[-3] = 2
        found[f"histogram_{kind}"] = {"bins": bins, "values": counts, "model": model}
        half = bins[bins >= 0]
        found[f"histogram_{kind}_accumulated"] = {"bins": half, "values": np.array([100 * erfc(b / size / sqrt(2)) for b in half])}
    return found


def results(channel: str = "mono", release: str = "4.0", *, photons_known: bool = True, stacks: bool = True, scale: float = 1.0) -> Results:
    """One channel."""
    shown = values()
    if not stacks:
        shown = {name: v for name, v in shown.items() if key_of(name).section != "spatial"}
    notes = ("A note of the evaluation.",) if channel in ("mono", "R") else ()
    return Results(release, shown, curves(photons_known, stacks, scale), notes, channel)


def sheet(*channels: Results) -> DataSheet:
    """A data sheet of these channels, by default one of a monochrome camera."""
    camera = {
        "name": "Simulated <camera> & co.", "sensor": "ccd", "bits": 12, "rows": ROWS, "cols": COLS, "pitch_x_um": 7.4, "pitch_y_um": 7.4,
        "wavelength_nm": 530.0, "temperature_c": 30.5,
    }  # fmt: skip
    conditions = {"release": "4.0", "levels": LEVELS, "dark_frames": 2 * LEVELS, "exposures_s": (EXPOSURE_S[0], EXPOSURE_S[-1])}
    record = {
        "schema": "pixmetry/provenance/1", "pixmetry": "0.0", "python": "3.11", "libraries": {"numpy": "2.0"}, "platform": "Linux x86_64",
        "time_utc": "2024-06-11T12:00:00+00:00", "command": ["pixmetry", "emva1288", "campaign.yaml"], "seed": 5,
        "inputs": [{"name": f"bright{k}.png", "sha256": f"{k:064x}", "size_bytes": 1000 + k} for k in range(7)],
    }  # fmt: skip
    return DataSheet(channels or (results(),), camera, conditions, record, "CC0, made for a test")


def colour_sheet() -> DataSheet:
    """Two channels of unlike quantum efficiency."""
    return sheet(results("R", scale=0.7), results("Gr"))
