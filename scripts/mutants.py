"""Plant wrong factors in a copy of the package, one at a time, and see whether a test fails: is what the tests say worth something?

python scripts/mutants.py [--only TEXT] [--jobs 2] [--list]

Each fault names the text that it replaces, which must stand once in src/pixmetry, and the tests that ought to find it. A fault whose text
is gone is reported as stale and counts as not found, so the list has to follow the code.
"""

from __future__ import annotations

import argparse
import compileall
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
SOURCE = ROOT / "src" / "pixmetry"
WANTED = 0.9  # share of the faults that the tests find
LONGEST_S = 900


@dataclass(frozen=True)
class Fault:
    """A wrong factor: what it is, the text as it stands and as it becomes, and the tests that should fail."""

    what: str
    old: str
    new: str
    tests: str


OPTICS, SENSOR, ELECTRONICS, GRABBER = (f"tests/sources/{stage}/test_" for stage in ("optics", "sensor", "electronics", "grabber"))
FAULTS = (
    # the light
    Fault("Noll factor of defocus", "np.sqrt(3) * params.defocus_waves", "np.sqrt(2) * params.defocus_waves", f"{OPTICS}point_spread.py"),
    Fault("Noll factor of astigmatism", "np.sqrt(6) * (params.astig", "np.sqrt(5) * (params.astig", f"{OPTICS}point_spread.py"),
    Fault("Noll factor of coma", "np.sqrt(8) * (3 * r2", "np.sqrt(6) * (3 * r2", f"{OPTICS}point_spread.py"),
    Fault(
        "Noll factor of spherical aberration", "np.sqrt(5) * params.spherical", "np.sqrt(6) * params.spherical", f"{OPTICS}point_spread.py"
    ),
    Fault(
        "cut-off of the diffraction doubled",
        "scale = 2e-3 * params.wavelength_nm",
        "scale = 1e-3 * params.wavelength_nm",
        f"{OPTICS}point_spread.py",
    ),
    Fault("sign of the pupil's shadow", "np.arccos(s) - s * np.sqrt(1", "np.arccos(s) + s * np.sqrt(1", f"{OPTICS}vignetting.py"),
    Fault(
        "mean of shading over the frame",
        "centre = 1 + loss * (rows**2 + cols**2 - 2) / 12",
        "centre = 1 + loss * (rows**2 + cols**2 - 2) / 6",
        f"{OPTICS}shading.py",
    ),
    Fault(
        "sign of lateral colour",
        "scale = 1 + params.scale_per_nm",
        "scale = 1 - params.scale_per_nm",
        f"{OPTICS}filters.py tests/catalogue",
    ),
    Fault("width of a logistic edge", "params.edge_nm / (2 * np.log(9))", "params.edge_nm / np.log(9)", f"{OPTICS}filters.py"),
    Fault(
        "flicker over the exposure",
        "params.depth_rel * np.sinc(params.frequency_hz * length)",
        "params.depth_rel * np.sinc(0.5 * params.frequency_hz * length)",
        f"{OPTICS}flicker.py",
    ),
    # the sensor
    Fault("half the band gap", "params.gap_ev / (2 * BOLTZMANN", "params.gap_ev / (1 * BOLTZMANN", f"{SENSOR}dark_current.py"),
    Fault(
        "mean of a lognormal field",
        "np.float32(-0.5 * params.spread_log**2)",
        "np.float32(-1.0 * params.spread_log**2)",
        f"{SENSOR}dark_current.py",
    ),
    Fault(
        "degrees of freedom of DSNU halved",
        'dof=np.where(dof < 1e9, np.maximum(dof, 1.0), np.inf),\n        units=("e-",) * len(in_dn)',
        'dof=np.where(dof < 1e9, np.maximum(dof / 2, 1.0), np.inf),\n        units=("e-",) * len(in_dn)',
        f"{SENSOR}dsnu.py",
    ),
    Fault(
        "gain's share in DSNU's covariance",
        "np.outer(values, values) * (gain.u / gain.value) ** 2",
        "np.outer(values, values) * (gain.u / gain.value)",
        f"{SENSOR}dsnu.py",
    ),
    Fault(
        "diffusion in the substrate",
        "np.sqrt(1 + (2 * np.pi * length) ** 2 * k2)",
        "np.sqrt(1 + (np.pi * length) ** 2 * k2)",
        f"{SENSOR}infrared_and_microlens.py",
    ),
    Fault(
        "sign of the refocusing by a cover glass",
        "(1 / n - 1 / root) - seen)",
        "(1 / n + 1 / root) - seen)",
        f"{OPTICS}filters.py tests/sources/optics/test_cover_glass.py",
    ),
    Fault(
        "smear by two",
        "params.leak_rel * params.transfer_s / (signal.frame_shape[0]",
        "2 * params.leak_rel * params.transfer_s / (signal.frame_shape[0]",
        f"{SENSOR}smear.py",
    ),
    Fault(
        "knee of the full well",
        "above - room * np.expm1(-above / room)",
        "above - room * np.expm1(-above / (2 * room))",
        f"{SENSOR}full_well.py",
    ),
    Fault("tilt the other way", "scale = 1000 / (1 + z / params", "scale = 1000 / (1 - z / params", f"{SENSOR}unflatness_and_tilt.py"),
    Fault(
        "expansion of sensor and mount exchanged",
        "(1 + params.sensor_per_k * dt) / (1 + params.mount_per_k * dt)",
        "(1 + params.mount_per_k * dt) / (1 + params.sensor_per_k * dt)",
        f"{SENSOR}thermal_and_drift.py",
    ),
    Fault(
        "borders moved by all four sides",
        "with_data(move_borders(data, w, params.area_loss_per_e / (4 * (1 - w[1]))",
        "with_data(move_borders(data, w, params.area_loss_per_e / (2 * (1 - w[1]))",
        f"{SENSOR}brighter_fatter.py",
    ),
    Fault(
        "lost in the dead layer",
        "lost = np.exp(-per_um * params.dead_layer_um)",
        "lost = np.exp(-2 * per_um * params.dead_layer_um)",
        f"{SENSOR}quantum_efficiency.py",
    ),
    Fault(
        "delay of a rolling shutter's middle",
        '"delay_s": 0.5 * delay, "exposure_rel"',
        '"delay_s": delay, "exposure_rel"',
        f"{SENSOR}shutter_times.py",
    ),
    Fault(
        "acceptance of microlenses",
        "np.exp(-0.5 * ((chief - design) / np.radians",
        "np.exp(-1.0 * ((chief - design) / np.radians",
        f"{SENSOR}infrared_and_microlens.py",
    ),
    # electronics, cable, grabber, storage
    Fault("toe of BT.709", "alpha * gamma * beta ** (gamma - 1)", "alpha * gamma * beta**gamma", f"{ELECTRONICS}gamma.py"),
    Fault(
        "second term of the nonlinearity's slope",
        "(2 * params.a1 + w * (3 * params.a2",
        "(2 * params.a1 + w * (2 * params.a2",
        f"{ELECTRONICS}nonlinearity.py",
    ),
    Fault("variance between nodes of flicker noise", "VARIANCE = 2 / 3 ", "VARIANCE = 1 / 3 ", f"{ELECTRONICS}flicker_noise.py"),
    Fault(
        "telegraph noise under double sampling",
        '"cds": 2 * (1 - params.cds_correlation)',
        '"cds": (1 - params.cds_correlation)',
        f"{ELECTRONICS}telegraph_noise.py",
    ),
    Fault(
        "overshoot of a damped amplifier",
        "math.exp(-math.pi * self.damping / math.sqrt(1 - self.damping**2))",
        "math.exp(-2 * math.pi * self.damping / math.sqrt(1 - self.damping**2))",
        f"{ELECTRONICS}video_amplifier.py tests/sources/grabber/test_analogue_chain.py",
    ),
    Fault(
        "echo once instead of there and back",
        "DELAY_S_PER_M = 2 / (0.66 * 299_792_458.0)  # there and back, at 0.66 of the speed of light\n\n\nclass TPiece",
        "DELAY_S_PER_M = 1 / (0.66 * 299_792_458.0)  # there and back, at 0.66 of the speed of light\n\n\nclass TPiece",
        "tests/sources/cable/test_t_piece.py",
    ),
    Fault(
        "sign of the reflection at the load",
        "reflection[0] * reflection[1] * 10",
        "-reflection[0] * reflection[1] * 10",
        "tests/sources/cable/test_termination.py",
    ),
    Fault(
        "power for voltage in the cable's loss",
        "10 ** (-self.loss_db / 10)",
        "10 ** (-self.loss_db / 20)",
        "tests/sources/cable/test_termination.py",
    ),
    Fault(
        "differential nonlinearity shared by two codes",
        "params.dnl_std_lsb / math.sqrt(2) * stream",
        "params.dnl_std_lsb * stream",
        f"{GRABBER}adc.py",
    ),
    Fault("droop over the line", "np.log1p(-self.droop_rel) / cols", "np.log1p(-self.droop_rel) / (2 * cols)", f"{GRABBER}clamp.py"),
    Fault(
        "shift of a cold clock × 1.3",
        "shift_s(params, at_s[(at_s > 0) & (at_s < cols / probe.pixel_clock_hz)], np.zeros(1)) * probe",
        "1.3 * shift_s(params, at_s[(at_s > 0) & (at_s < cols / probe.pixel_clock_hz)], np.zeros(1)) * probe",
        "tests/sources/grabber/test_clock_warm_up.py tests/catalogue/test_monte_carlo.py -k clock_warm_up",
    ),
    Fault(
        "poles of a Butterworth filter",
        "np.pi * (0.5 + (np.arange(order) + 0.5) / order)",
        "np.pi * (0.5 + (np.arange(order) + 0.4) / order)",
        f"{GRABBER}low_pass.py",
    ),
    Fault(
        "settling of the lines",
        "params.settling_ns * np.exp(-line / params.settling_rows)",
        "params.settling_ns * np.exp(-2 * line / params.settling_rows)",
        f"{GRABBER}line_jitter.py",
    ),
    # locating
    Fault(
        "rounding's variance",
        "ROUNDING_DN2 = 1 / 12  # variance of rounding",
        "ROUNDING_DN2 = 1 / 6  # variance of rounding",
        "tests/locate/test_bound.py tests/locate/test_moments.py tests/locate/test_template.py",
    ),
    Fault(
        "aperture's variance",
        "float(np.sqrt(blur_px**2 + aperture_px**2 / 12))",
        "float(np.sqrt(blur_px**2 + aperture_px**2 / 6))",
        "tests/locate/test_bound.py",
    ),
    Fault(
        "sign of the ellipse's eccentricity",
        "offset = -(m @ w[:, :, None])[:, :, 0]",
        "offset = (m @ w[:, :, None])[:, :, 0]",
        "tests/locate/test_eccentricity.py",
    ),
    Fault(
        "noise law with 1.3 times the shot noise",
        "return noise.constant_dn2 + noise.slope_dn * light + pattern",
        "return noise.constant_dn2 + 1.69 * noise.slope_dn * light + pattern",
        "tests/locate/test_moments.py tests/locate/test_template.py",
    ),
    Fault(
        "covariance of the fitted ground doubled",
        "factor = variance * max(1.0, chi2 if n > 20.0 else 1.0) / det",
        "factor = 2.0 * variance * max(1.0, chi2 if n > 20.0 else 1.0) / det",
        "tests/locate/test_moments.py",
    ),
    Fault(
        "gradient of a squared centroid",
        "return value**2, 2 * value",
        "return value**2, value",
        "tests/locate/test_estimators.py tests/budget/test_target_estimators.py",
    ),
    Fault(
        "a camera's pattern with the temporal noise of its mean",
        "return max(float(spread - stack.var(axis=0, ddof=1).mean() / len(stack)), 0.0)",
        "return max(float(spread), 0.0)",
        "tests/locate/test_bound.py tests/locate/test_bound_command.py",
    ),
    Fault(
        "variance of a cross's angle halved",
        "cov[:, kernels.ANGLE_1 + side, kernels.ANGLE_1 + side] / DEG**2",
        "cov[:, kernels.ANGLE_1 + side, kernels.ANGLE_1 + side] / (2 * DEG**2)",
        "tests/locate/test_lines.py",
    ),
    # EMVA 1288 and the photon transfer
    Fault(
        "sign of mean and variance's covariance",
        "v_ms, skew - g * v_mean, g,",
        "v_ms, g * v_mean - skew, g,",
        "tests/observe/test_photon_transfer_fit.py",
    ),
    Fault(
        "skewness of Poisson",
        "skew = f1**3 * p[GAIN] ** 2 * poisson",
        "skew = f1**3 * p[GAIN] ** 3 * poisson",
        "tests/observe/test_photon_transfer_fit.py",
    ),
    Fault(
        "quantisation twice", "QUANTISATION_DN2 = 1.0 / 12.0", "QUANTISATION_DN2 = 1.0 / 6.0", "tests/observe/test_photon_transfer_fit.py"
    ),
    Fault(
        "temporal noise left in a mean map",
        "pixel, row, col = np.moveaxis(whole - vectors[..., 5:] / frames, -1, 0)",
        "pixel, row, col = np.moveaxis(whole - vectors[..., 5:] / (frames + 20), -1, 0)",
        "tests/emva/test_spatial.py",
    ),
    Fault(
        "absolute sensitivity threshold",
        "np.sqrt(noise_e**2 + 0.25) + 0.5",
        "np.sqrt(noise_e**2 + 0.5) + 0.5",
        "tests/emva/test_temporal.py",
    ),
    Fault(
        "light counted twice in SNR max",
        "return u_e_sat / np.sqrt(dark_noise_e2 + u_e_sat + pattern)",
        "return u_e_sat / np.sqrt(dark_noise_e2 + 2 * u_e_sat + pattern)",
        "tests/emva/test_spatial.py",
    ),
    Fault(
        "frames of a stack",
        'squares[f"PRNU1288{part}"] = (values[f"s_2_y{part}"] - ',
        'squares[f"PRNU1288{part}"] = (values[f"s_2_y{part}"] + ',
        "tests/emva/test_spatial.py",
    ),
    Fault("doubling temperature by e", "-math.log(2) / growth**2", "-1.0 / growth**2", "tests/emva/test_dark_temperature.py"),
    Fault(
        "excess of the fourth moment",
        "return fourth / variance**2 - 3.0 if",
        "return fourth / variance**2 - 2.5 if",
        "tests/observe/test_reductions.py",
    ),
    Fault(
        "degrees of freedom of a stack's variance",
        "self.deviation_map_dn2() / (self.n_frames - 1)",
        "self.deviation_map_dn2() / self.n_frames",
        "tests/observe tests/emva/test_spatial.py",
    ),
    Fault(
        "waves at half their power",
        "(0.5 * patterns.amplitude_dn[patterns.moving] ** 2)",
        "(1.0 * patterns.amplitude_dn[patterns.moving] ** 2)",
        "tests/observe/test_spatial_fit.py",
    ),
    Fault(
        "Birge ratio's root",
        "covariance, dof = covariance * chi2 / nu, float(nu)",
        "covariance, dof = covariance * (chi2 / nu) ** 0.5, float(nu)",
        "tests/emva/test_dark_temperature.py",
    ),
    Fault(
        "degrees of freedom of a level's variance",
        "(2 + kurtosis) / (lines * more)",
        "(2 + kurtosis) / (lines * (more + 1))",
        "tests/emva/test_uncertainty.py",
    ),
    Fault(
        "kurtosis of differences for that of pixels",
        "-1.5) * 2 * more / levels.n_frames",
        "-1.5) * more / levels.n_frames",
        "tests/emva/test_uncertainty.py",
    ),
    # calibrating
    Fault(
        "half of a pixel beside the centre",
        "return (self.cols - 1) / 2, (self.rows - 1) / 2",
        "return self.cols / 2, (self.rows - 1) / 2",
        "tests/calibrate/test_bundle.py tests/calibrate/test_other_programs.py tests/calibrate/test_exchange.py",
    ),
    Fault(
        "principal distance by the affinity",
        "by_interior[0, 0], by_interior[1, 0] = ((1.0 + b1) * a + b2 * b) / mx",
        "by_interior[0, 0], by_interior[1, 0] = ((1.0 - b1) * a + b2 * b) / mx",
        "tests/calibrate/test_bundle.py tests/calibrate/test_solve.py",
    ),
    Fault(
        "derivative by the shear",
        "by_interior[0, 4], by_interior[1, 4] = c * b / mx",
        "by_interior[0, 4], by_interior[1, 4] = 1.3 * c * b / mx",
        "tests/calibrate/test_bundle.py tests/calibrate/test_solve.py tests/calibrate/test_quality.py",
    ),
    Fault(
        "critical value of the snooping",
        "dof * (1 - alpha ** (2 / (dof - 2)))",
        "dof * (1 - alpha ** (1 / (dof - 2)))",
        "tests/calibrate/test_snooping.py",
    ),
    Fault(
        "a circle's diameter for its radius",
        "network.diameter[point] / 2)",
        "network.diameter[point])",
        "tests/calibrate/test_eccentric.py",
    ),
    Fault(
        "datum's turn scaled",
        "-state.rotation[posed] @ basis[3:6] / datum.size",
        "-state.rotation[posed] @ basis[3:6]",
        "tests/calibrate/test_bundle.py tests/calibrate/test_control.py",
    ),
    Fault(
        "u of camera constants × 1.3",
        "float(adjustment.state.interior[k, place]), float(np.sqrt(covariance[i, i]))",
        "float(adjustment.state.interior[k, place]), 1.3 * float(np.sqrt(covariance[i, i]))",
        "tests/calibrate/test_quality.py tests/calibrate/test_bundle_coverage.py",
    ),
    Fault(
        "u of the jitter of lines × 1.3",
        "self.within_px2 * np.sqrt(2 / self.dof[1])) / m",
        "self.within_px2 * np.sqrt(2 / self.dof[1])) / m * 1.3",
        "tests/calibrate/test_plumb_line.py",
    ),
    Fault(
        "mean of the frames forgotten in the jitter of repeated ones",
        "free_share * (1 - 1 / v.shape[0])",
        "free_share",
        "tests/calibrate/test_plumb_line.py tests/handbook/test_line_jitter.py",
    ),
    Fault(
        "degrees of freedom of a residual grid",
        "/ max(2 * (len(v) - taken), 1.0)",
        "/ max(len(v) - taken, 1.0)",
        "tests/calibrate/test_residual_grid.py",
    ),
    Fault(
        "u of a variance component twice",
        "else sigma * u / 2,",
        "else sigma * u,",
        "tests/calibrate/test_variance_components.py",
    ),
    # boards, exchange, shared errors
    Fault(
        "a rim of a chessboard that is the outline of its squares",
        "crossing: np.ndarray = gap > CLEAR_COLOUR * contrast",
        "crossing: np.ndarray = gap > -np.inf * contrast",
        "tests/locate/test_corners.py -k outline",
    ),
    Fault(
        "segments of a printed ring the other way round",
        "bit * step, (bit + 1) * step)",
        "-(bit + 1) * step, -bit * step)",
        "tests/calibrate/test_boards.py -k rings",
    ),
    Fault(
        "rings of another number of segments",
        "*ellipses, bits=task.segments, threads",
        "*ellipses, bits=12, threads",
        "tests/calibrate/test_boards.py -k rings",
    ),
    Fault(
        "half a step of an asymmetric plate",
        "(c + 0.5 * (r % 2)) * pitch",
        "(c + 0.5 * ((r + 1) % 2)) * pitch",
        "tests/calibrate/test_boards.py -k asymmetric",
    ),
    Fault(
        "decentring of HALCON per m²",
        '"p1": 1e-3, "p2": 1e-3, "d1"',
        '"p1": 1e-6, "p2": 1e-6, "d1"',
        "tests/calibrate/test_photogrammetric.py",
    ),
    Fault(
        "half a pixel of PhotoModeler's corner",
        '"xp": (form["xp"] + 0.5) * mx',
        '"xp": form["xp"] * mx',
        "tests/calibrate/test_photogrammetric.py",
    ),
    Fault(
        "y of Australis downwards",
        '"yp": (y0 - form["yp"]) * my',
        '"yp": (form["yp"] - y0) * my',
        "tests/calibrate/test_photogrammetric.py",
    ),
    Fault(
        "affinity in the pitch the other way round",
        'factor = 1 + b1 if model.direction == "image_to_object" else 1 / (1 + b1)',
        'factor = 1 / (1 + b1) if model.direction == "image_to_object" else 1 + b1',
        "tests/calibrate/test_photogrammetric.py",
    ),
    Fault(
        "covariance of another form by the model's own slopes",
        "return Known(tuple(NAMES[k] for k in kept), by @ known.covariance @ by.T)",
        "return Known(tuple(NAMES[k] for k in kept), 1.2 * by @ known.covariance @ by.T)",
        "tests/calibrate/test_photogrammetric.py",
    ),
    Fault(
        "focal length of OpenCV without the affinity",
        '"c": (0, (1 + b1) / mx)',
        '"c": (0, 1.01 / mx)',
        "tests/calibrate/test_photogrammetric.py",
    ),
    Fault("COLMAP's half pixel", "cx + 0.5, cy + 0.5", "cx, cy", "tests/calibrate/test_exchange.py"),
    Fault("metres of Kalibr's chain", '"mm": 1e-3, "cm"', '"mm": 1e-2, "cm"', "tests/calibrate/test_calibration_exports.py -k kalibr"),
    Fault(
        "degrees of freedom of shared errors twice",
        "dof = 2 * variance**2 / np.einsum(",
        "dof = 4 * variance**2 / np.einsum(",
        "tests/calibrate/test_shared_errors.py",
    ),
    # the budget
    Fault("variance of a limit", "covariance[i, i] = e.value**2 / 12", "covariance[i, i] = e.value**2 / 6", "tests/budget"),
    Fault(
        "value of a limit",
        "return self.value / 3**0.5 if self.is_upper_limit",
        "return self.value / 2 if self.is_upper_limit",
        "tests/budget tests/assess",
    ),
    Fault(
        "averaging over frames and targets",
        "left = time / (frames * targets) + place / targets",
        "left = time / frames + place / targets",
        "tests/budget/test_combine.py",
    ),
    Fault(
        "both axes in one total",
        "0.5 * (self.total_x_px**2 + self.total_y_px**2)",
        "1.0 * (self.total_x_px**2 + self.total_y_px**2)",
        "tests/budget/test_combine.py",
    ),
    Fault(
        "shot noise × 1.3",
        "probe.white(np.sqrt(probe.gain_dn_per_e * np.maximum(probe.signal_dn, 0.0)))",
        "probe.white(1.3 * np.sqrt(probe.gain_dn_per_e * np.maximum(probe.signal_dn, 0.0)))",
        "tests/catalogue/test_monte_carlo.py -k shot_noise",
    ),
    Fault(
        "standard error of a Monte Carlo's total",
        "(a.bias * a.se_bias) ** 2 for a in (self.x, self.y))) / (2 * self.total_px)",
        "(a.bias * a.se_bias) ** 2 for a in (self.x, self.y))) / self.total_px",
        "tests/budget/test_monte_carlo.py -k scatters",
    ),
    Fault(
        "biases of drifting sources twice after a calibration",
        "u + (0 if signed else bias)]",
        "u + bias]",
        "tests/budget/test_combine.py",
    ),
    Fault(
        "degrees of freedom of a budget halved",
        "** 2 * error_rel**2",
        "** 2 * 2 * error_rel**2",
        "tests/budget/test_combine.py",
    ),
    Fault(
        "fixed part with the temporal noise of its means",
        "fixed = between - temporal / frames",
        "fixed = between",
        "tests/budget/test_monte_carlo.py",
    ),
    # scenes and the line
    Fault(
        "acceleration without its half",
        "0.5 * self.acceleration_px_per_s2[axis] * t**2",
        "self.acceleration_px_per_s2[axis] * t**2",
        "tests/scene/test_motion_and_lighting.py",
    ),
    Fault(
        "half a pixel in the sampling",
        "(at - self.start_s) * self.sample_clock_hz - 0.5",
        "(at - self.start_s) * self.sample_clock_hz",
        "tests/camera/test_line.py",
    ),
    Fault(
        "absorption per µm",
        "np.log(ABSORPTION_PER_CM))) * 1e-4",
        "np.log(ABSORPTION_PER_CM))) * 2e-4",
        f"{SENSOR}infrared_and_microlens.py tests/sources/sensor/test_quantum_efficiency.py",
    ),
    # the camera of a data sheet
    Fault("full well below the capacity", "capacity_e + z * math.sqrt(", "capacity_e - z * math.sqrt(", "tests/camera/test_data_sheet.py"),
    Fault(
        "half an electron of the threshold",
        "dynamic_range_db / 20) - 0.5) ** 2",
        "dynamic_range_db / 20)) ** 2",
        "tests/camera/test_data_sheet.py",
    ),
    Fault("blur of an MTF", "math.sqrt(slope / (2 * np.pi**2))", "math.sqrt(slope / np.pi**2)", "tests/camera/test_data_sheet.py"),
    Fault("distortion at the corner", "-distortion_rel / ((1 + dist", "-distortion_rel / ((1 - dist", "tests/camera/test_data_sheet.py"),
    # corrections of positions and frames
    Fault(
        "a target that moves is put where it goes",
        "scene_places(u - shift[:, 0], v - shift[:, 1]",
        "scene_places(u + shift[:, 0], v + shift[:, 1]",
        "tests/assess/test_corrected.py",
    ),
    Fault(
        "half of a cause of uncertainty",
        "(at if minus is None else mapped(minus))) / sides",
        "(at if minus is None else mapped(minus))) / (2 * sides)",
        "tests/assess/test_corrected.py",
    ),
    Fault("measured covariance not through the map", "out = j @ c @ np.swapaxes(j, 1, 2)", "out = c", "tests/assess/test_corrected.py"),
    Fault(
        "warm-up of the clock backwards",
        "            at = at - self._warped_s(at)",
        "            at = at + self._warped_s(at)",
        "tests/assess/test_corrected.py",
    ),
    Fault(
        "gain of a correction in electrons",
        "data = corrected.data * np.float32(gain) if",
        "data = corrected.data * np.float32(2 * gain) if",
        "tests/assess/test_correct_catalogue.py",
    ),
    Fault(
        "covariance of a fit without its weights",
        "spread = np.linalg.inv(a.T @ weighed)",
        "spread = 4 * np.linalg.inv(a.T @ weighed)",
        "tests/assess/test_corrected.py",
    ),
    Fault("estimates of what changed stay", "names if name not in changed", "names if name in changed", "tests/camera/test_provenance.py"),
    Fault("rotation of a field backwards", '"rotation_rad": (-y, x),', '"rotation_rad": (y, -x),', "tests/series/test_warm_up.py"),
    Fault(
        "places of a field weighted by covariance",
        "weight[seen] = np.linalg.inv(covariance[seen])",
        "weight[seen] = covariance[seen]",
        "tests/series",
    ),
    Fault(
        "u of targets that scatter not enlarged",
        "* max(1.0, motion.location_factor) ** 2\n    if not np.ptp",
        "\n    if not np.ptp",
        "tests/series/test_warm_up.py",
    ),
    Fault(
        "clock's warm-up about the first pixel",
        'arm = series.x0_px + 0.5 + values[at["lock"]]',
        "arm = series.x0_px + 0.5",
        "tests/series/test_warm_up.py",
    ),
    Fault("a settled share of half", "e2 = np.exp(-time_s / slow)", "e2 = np.exp(-2 * time_s / slow)", "tests/series/test_warm_up.py"),
    Fault(
        "scatter from frame to frame of too few frames",
        "whole = (left**2).sum(axis=0) / (frames - taken)",
        "whole = (left**2).sum(axis=0) / (2 * frames)",
        "tests/series/test_warm_up.py",
    ),
    Fault(
        "odd rows of a frame at even places",
        "found.positions_px * wide + [0.0, parity]",
        "found.positions_px * wide",
        "tests/series/test_motion.py",
    ),
    Fault(
        "row time by the wrong sign of the stretch",
        "shear = motion.values[:, at] * [1.0, -1.0]",
        "shear = motion.values[:, at] * [1.0, 1.0]",
        "tests/series/test_motion.py",
    ),
    Fault(
        "f-number from the size of the grains",
        '"f_number": (1e3 * pitch_um / wavelength_nm, "1")',
        '"f_number": (0.8e3 * pitch_um / wavelength_nm, "1")',
        "tests/observe/test_laser_spots.py",
    ),
    Fault("grains of a round pupil", "(2 * j1(safe) / safe) ** 2", "np.abs(2 * j1(safe) / safe)", "tests/observe/test_laser_spots.py"),
    Fault(
        "offset of a centroid by a slope of the light",
        'predicted = 0.25 * np.einsum("nij,nj->ni", shape, gradient)',
        'predicted = 0.2 * np.einsum("nij,nj->ni", shape, gradient)',
        "tests/series/test_views.py",
    ),
    Fault("tilt of a view", "np.degrees(np.arccos(ratio))", "np.degrees(np.arcsin(ratio))", "tests/series/test_views.py"),
    Fault("focus behind a plate", "pitch_x_um * 1.52 / 0.52", "pitch_x_um * 1.52", "tests/series/test_bands.py"),
    Fault("light with a filter", "value = level[k] / level[j]", "value = level[j] / level[k]", "tests/series/test_bands.py"),
    Fault("u of the field period without that of the speed", "+ slope**2 * sum(of_speed)", "", "tests/series/test_motion.py"),
    Fault(
        "jitter over half the speed",
        "weights += float((size**2).sum())",
        "weights += float((size**2).sum()) / 4",
        "tests/series/test_motion.py",
    ),
)


def main() -> int:
    """Plant the faults, print which were found, and return 1 when fewer than wanted were."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", default="", metavar="TEXT", help="faults with this text in what they are")
    parser.add_argument("--jobs", type=int, default=2, help="faults at the same time")
    parser.add_argument("--list", action="store_true", help="say which faults there are, and which are stale")
    options = parser.parse_args()
    faults = [f for f in FAULTS if options.only.lower() in f.what.lower()]
    texts = {path: path.read_text(encoding="utf-8") for path in SOURCE.rglob("*.py")}
    if options.list:
        for fault in faults:
            print(f"{'stale' if place_of(fault, texts) is None else '     '}  {fault.what}")
        return 0
    print(f"{len(faults)} faults")
    with tempfile.TemporaryDirectory() as folder, ThreadPoolExecutor(options.jobs) as pool:
        sound = Path(folder) / "pixmetry"  # compiled once: copies keep the stamps, and so the bytecode
        shutil.copytree(SOURCE, sound, ignore=shutil.ignore_patterns("__pycache__"))
        compileall.compile_dir(sound, quiet=2)
        found = list(pool.map(lambda fault: report(fault, texts, sound), faults))
    share = sum(found) / max(len(found), 1)
    print(f"found {sum(found)} of {len(found)}: {share:.2f}, wanted {WANTED}")
    return int(share < WANTED)


def place_of(fault: Fault, texts: dict[Path, str]) -> Path | None:
    """The file that holds the text of a fault, once; None where there is none, or more than one."""
    places = [path for path, text in texts.items() for _ in occurrences(text, fault.old)]
    return places[0] if len(places) == 1 else None


def occurrences(text: str, part: str) -> Iterator[int]:
    """Where a part stands in a text."""
    at = text.find(part)
    while at >= 0:
        yield at
        at = text.find(part, at + 1)


def report(fault: Fault, texts: dict[Path, str], sound: Path) -> bool:
    """Plant one fault and say whether a test found it."""
    place = place_of(fault, texts)
    if place is None:
        print(f"STALE     {fault.what}: {fault.old!r} does not stand once in the package", flush=True)
        return False
    started = time.monotonic()
    found = planted(fault, place, texts[place], sound)
    print(
        f"{'found   ' if found else 'SURVIVED'}  {fault.what} ({place.relative_to(SOURCE)}, {time.monotonic() - started:.0f} s)", flush=True
    )
    return found


def planted(fault: Fault, place: Path, text: str, sound: Path) -> bool:
    """Whether a test fails with the fault in a copy of the package."""
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder) / "src" / "pixmetry"
        shutil.copytree(sound, copy)
        (copy / place.relative_to(SOURCE)).write_text(text.replace(fault.old, fault.new), encoding="utf-8")
        environment = {**os.environ, "PYTHONPATH": str(copy.parent), "OPENBLAS_NUM_THREADS": "1", "PYTHONDONTWRITEBYTECODE": "1"}
        command = [
            sys.executable,
            "-m",
            "pytest",
            "-x",
            "-q",
            "-p",
            "no:cacheprovider",
            "-m",
            "not browser and not oracle",
            *fault.tests.split(),
        ]
        ran = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, timeout=LONGEST_S, check=False)
    if ran.returncode not in (0, 1):
        raise SystemExit(f"{fault.what}: the tests could not be run\n{ran.stdout[-2000:]}\n{ran.stderr[-2000:]}")
    return ran.returncode == 1


if __name__ == "__main__":
    sys.exit(main())
