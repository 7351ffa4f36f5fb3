"""The curves of a data sheet: from the exposure series and, as each release of EMVA 1288 has them, from the dark and the bright stack."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pixmetry.emva.records import Measurement, Series
from pixmetry.emva.series import light_of
from pixmetry.emva.spatial.high_pass import passed_power
from pixmetry.emva.spatial.spatial import spatial_variances
from pixmetry.emva.spatial.spatial_inputs import SpatialInputs
from pixmetry.emva.temporal import dark_line, linearity_line

MAX_BINS = 256
BOX = 5  # side of the filter that release 3.1 puts before the PRNU histograms
Curve = dict[str, np.ndarray]


@np.errstate(divide="ignore", invalid="ignore")  # lines through levels without light are NaN
def temporal_curves(
    series: Series, values: dict[str, np.ndarray], u_var_dn2: np.ndarray, dsnu2_e2: float = 0.0, prnu2_percent2: float = 0.0
) -> dict[str, Curve]:
    """Sensitivity, dark signal, photon transfer, signal-to-noise ratio and linearity.

    Parameters
    ----------
    series : Series
        As measured, without draws.
    values : dict
        ``temporal_values`` of it.
    u_var_dn2 : ndarray, shape (levels,)
        Standard uncertainty of the temporal variances.
    dsnu2_e2, prnu2_percent2 : float
        Squares of DSNU1288 and PRNU1288, for the total signal-to-noise ratio (R4.0 eq. 69); a negative one counts as zero.

    Returns
    -------
    dict
        Arrays of shape (levels,), the dark signal's of shape (dark levels,), reference values of shape (1,). The light stands under
        ``photons``, under ``exposure_s`` where only that is known, under ``mean_dn`` alone where neither tells it.
    """
    signal, excess = series.mean_dn - series.dark_mean_dn, series.var_dn2 - series.dark_var_dn2
    known = light_of(series)
    axis = "mean_dn" if known is None else {"photon": "photons", "s": "exposure_s"}[known[1]]
    light = signal if known is None else known[0]
    responsivity = 1.0 if known is None else float(values["R"])
    gain, sat, last = float(values["K"]), int(values["index_u_ysat"]), int(values["index_sensitivity_max"])
    used = np.arange(signal.size) <= last
    return {
        "sensitivity": {axis: light, "mean_dn": signal, "fit_dn": responsivity * light, "used": used},
        "dark_signal": dark_signal(series),
        "PTC": {
            "mean_dn": signal,
            "var_dn2": excess,
            "u_var_dn2": u_var_dn2,
            "fit_dn2": gain * signal,
            "used": used,
            "saturation": signal[[sat]],
        },
        "SNR": {axis: light, **_snr(series, signal, light, responsivity / gain, values, max(dsnu2_e2, 0.0), max(prnu2_percent2, 0.0))},
        "linearity": _linearity(axis, light, signal, values),
    }


def dark_signal(series: Series) -> Curve:
    """Mean and variance of the dark levels over their exposure, with their lines."""
    mean, mean_slope, var, var_slope = (float(v) for v in dark_line(series))
    t = series.dark_exposure_s
    dark = {"exposure_s": t, "mean_dn": series.own_dark_mean_dn, "var_dn2": series.own_dark_var_dn2}
    return dark | {"fit_dn": mean + np.nan_to_num(mean_slope) * t, "var_fit_dn2": var + np.nan_to_num(var_slope) * t}


def _snr(
    series: Series, signal: np.ndarray, light: np.ndarray, per_light_e: float, values: dict[str, np.ndarray], dsnu2: float, prnu2: float
) -> Curve:
    """Measured ratio (R4.0 eq. 20), the model's (eq. 21), its two limits (eq. 22), the ideal camera's (eq. 23), the total (eq. 69)."""
    electrons = np.maximum(per_light_e * light, 0.0)
    dark2 = float(values["sigma_y_dark"] / values["K"]) ** 2
    ideal = np.sqrt(light) if series.photons is not None else np.full(light.size, np.nan)
    return {
        "snr": np.divide(signal, np.sqrt(series.var_dn2), out=np.full(light.size, np.nan), where=series.var_dn2 > 0),
        "ideal": ideal,
        "shot_limit": np.sqrt(electrons),
        "dark_limit": electrons / np.sqrt(dark2),
        "model": electrons / np.sqrt(dark2 + electrons),
        "total": electrons / np.sqrt(dark2 + electrons + dsnu2 + prnu2 * 1e-4 * electrons**2),
    }


def _linearity(axis: str, light: np.ndarray, signal: np.ndarray, values: dict[str, np.ndarray]) -> Curve:
    line = linearity_line(light, signal, np.asarray(values["index_u_ysat"]), np.asarray(values["index_linearity_max"]))
    return {
        axis: light,
        "mean_dn": signal,
        "fit_dn": line["fit_offset"] + line["fit_slope"] * light,
        "used": line["used"],
        "relative_deviation": line["relative_deviation"],
        "fit_slope": np.atleast_1d(line["fit_slope"]),
        "fit_offset": np.atleast_1d(line["fit_offset"]),
        "linearity_error_min": np.atleast_1d(line["LE_min"]),
        "linearity_error_max": np.atleast_1d(line["LE_max"]),
    }


@dataclass(frozen=True)
class _Pattern:
    """One of the two images that are shown, DSNU or PRNU, and the levels to be drawn beside its spectrogram; DN."""

    name: str
    image_dn: np.ndarray
    filtered_dn: np.ndarray  # the same, high-passed in release 4.0
    nonuniformity_dn: float  # NaN where the variance is negative
    temporal_dn: float
    floor_dn: float  # temporal noise left in the image
    signal_dn: float  # what it is set in relation to; 0 for none
    frames: int


def spatial_curves(m: Measurement, release: str, inputs: tuple[SpatialInputs, SpatialInputs] | None = None) -> dict[str, Curve]:
    """All spatial curves that the stacks allow.

    Parameters
    ----------
    m : Measurement
        Without a dark stack there are no curves, without a bright one those of the DSNU alone.
    release : {"4.0", "3.1", "reference"}
    inputs : (dark, bright), optional
        If they were made already, to save the time of the filter.

    Returns
    -------
    dict
        ``{horizontal,vertical}_spectrogram_{DSNU,PRNU}``: ``frequency`` (1/px), ``amplitude`` (root of the power; DN for the DSNU, % of the
        signal for the PRNU), and one-element levels in the same unit: ``total`` (root of the mean power, with what the filter takes of
        white noise), ``nonuniformity``, ``temporal``
        (σ_y.stack), ``white_floor`` (temporal noise left in the image), and ``white_share``.
        ``{horizontal,vertical}_profile_{DSNU,PRNU}``: ``position``, ``mid``, ``mean``, ``min``, ``max`` (DN).
        ``histogram_{DSNU,PRNU}``: ``bins`` (DN from the mean), ``values`` (pixels), ``model``; ``…_accumulated``: ``bins`` (DN), ``values``
        (% of the pixels that deviate by as much or more). Before release 4.0 the PRNU has these from 5 x 5 pixels on.

    Raises
    ------
    MeasureError
        If the frames are too small for the release.

    Notes
    -----
    EMVA 1288 R4.0 §8.4 to 8.6. 4.0: spectrograms and histograms of the high-passed image; 3.1: of the image as it is, but the PRNU
    histograms after a box filter of 5 x 5. The reference implementation shows the root of (power of the PRNU image/mean) without the second
    division by the mean and without per cent, at frequencies k/(2 bins); and its model of the histograms has (y_max − y_min)/bins for the
    width of a bin.
    """
    patterns = _patterns(m, release, inputs)
    curves: dict[str, Curve] = {}
    for pattern in patterns:
        curves[f"horizontal_spectrogram_{pattern.name}"] = _spectrogram(pattern, release, vertical=False)
        curves[f"vertical_spectrogram_{pattern.name}"] = _spectrogram(pattern, release, vertical=True)
        curves[f"horizontal_profile_{pattern.name}"] = _profile(pattern.image_dn)
        curves[f"vertical_profile_{pattern.name}"] = _profile(pattern.image_dn.T)
        counted = _steps(pattern, release)
        if counted is None:
            continue
        codes, per_dn = counted
        exact = release == "reference"
        curves[f"histogram_{pattern.name}"] = _histogram(codes, per_dn, exact, centred=not exact or pattern.name == "DSNU")
        curves[f"histogram_{pattern.name}_accumulated"] = _accumulated(codes, per_dn, exact)
    return curves


def _patterns(m: Measurement, release: str, inputs: tuple[SpatialInputs, SpatialInputs] | None) -> list[_Pattern]:
    if m.dark_stack is None:
        return []
    filtered = release == "4.0"
    dark = inputs[0] if inputs else SpatialInputs.of(m.dark_stack, filtered)
    dark_values = spatial_variances(dark, dark.vector, release)
    sigma2 = m.dark_stack.var_stack_dn2
    patterns = [
        _Pattern(
            name="DSNU",
            image_dn=m.dark_stack.mean_map_dn,
            filtered_dn=dark.image_dn,
            nonuniformity_dn=_root(dark_values["s_2_y"]),
            temporal_dn=_root(sigma2),
            floor_dn=_root(sigma2 / dark.n_frames),
            signal_dn=0.0,
            frames=dark.n_frames,
        )
    ]
    if m.bright_stack is None:
        return patterns
    bright = inputs[1] if inputs else SpatialInputs.of(m.bright_stack, filtered)
    bright_values = spatial_variances(bright, bright.vector, release)
    sigma2_bright = m.bright_stack.var_stack_dn2
    patterns.append(
        _Pattern(
            name="PRNU",
            image_dn=m.bright_stack.mean_map_dn - m.dark_stack.mean_map_dn,
            filtered_dn=bright.image_dn - dark.image_dn,
            nonuniformity_dn=_root(bright_values["s_2_y"] - dark_values["s_2_y"]),
            temporal_dn=_root(sigma2_bright),
            floor_dn=_root(sigma2_bright / bright.n_frames + sigma2 / dark.n_frames),
            signal_dn=bright.vector[0] - dark.vector[0],
            frames=bright.n_frames,
        )
    )
    return patterns


def _root(square: np.ndarray | float) -> float:
    return float(np.sqrt(square)) if square >= 0 else float("nan")


def _spectrogram(pattern: _Pattern, release: str, vertical: bool) -> Curve:
    """Mean power along the rows (or columns) and what it is to be compared with.

    The share of white noise. Where noise is white, each ordinate p is σ²/(2R) times a chi-square of 2 R degrees of freedom, R rows having
    been averaged; its median is σ² (1 − 1/(9R))³ (Wilson and Hilferty 1931). A few strong frequencies move the mean of p, but not the
    median, so σ² = median(p)/(1 − 1/(9R))³ is the white part and σ²/mean(p) its share. What the filter takes from white noise is undone
    first.
    """
    image = pattern.filtered_dn.T if vertical else pattern.filtered_dn
    lines, count = image.shape
    spectrum = np.fft.rfft(image - image.mean(), axis=1)
    power = np.mean(spectrum.real**2 + spectrum.imag**2, axis=0) / count
    frequency = np.arange(power.size) / count
    weight = np.full(power.size, 2.0)  # the ordinates above one half mirror those below
    weight[0] = 1.0
    if count % 2 == 0:
        weight[-1] = 1.0
    total = float(weight @ power / count)
    passed = passed_power(frequency) if release == "4.0" else np.ones(power.size)
    kept = float(weight @ passed) / count  # of white noise, by the filter
    white = float(np.median((power / passed)[1:])) / (1 - 1 / (9 * lines)) ** 3 * kept
    scale = 100.0 / pattern.signal_dn if pattern.signal_dn else 1.0
    amplitude = scale * np.sqrt(power)
    if release == "reference":
        frequency = np.arange(power.size) / (2 * power.size)
        amplitude = np.sqrt(power / pattern.signal_dn) if pattern.signal_dn else amplitude
    levels = {
        "total": scale * np.sqrt(total / kept),  # as the other levels: what it would be without the filter, were it white
        "nonuniformity": scale * pattern.nonuniformity_dn,
        "temporal": scale * pattern.temporal_dn,
        "white_floor": scale * pattern.floor_dn,
        "white_share": min(white / total, 1.0) if total > 0 else float("nan"),
    }
    return {"frequency": frequency, "amplitude": amplitude} | {name: np.array([value]) for name, value in levels.items()}


def _profile(image: np.ndarray) -> Curve:
    return {
        "position": np.arange(image.shape[1], dtype=float),
        "mid": image[image.shape[0] // 2].copy(),
        "mean": image.mean(axis=0),
        "min": image.min(axis=0),
        "max": image.max(axis=0),
    }


def _steps(pattern: _Pattern, release: str) -> tuple[np.ndarray, float] | None:
    """The image that the histograms count, in whole steps where it has them, and the number of steps per DN.

    Steps are 1/L DN; 1/(25 L) after the box filter of 5 x 5, of which a frame of fewer pixels leaves nothing. Release 4.0 counts the
    high-passed image, which has no such steps, in the same unit.
    """
    if release == "4.0":
        return pattern.filtered_dn * pattern.frames, float(pattern.frames)
    sums = np.rint(pattern.image_dn * pattern.frames).astype(np.int64)
    if pattern.name == "DSNU":
        return sums, float(pattern.frames)
    return (_box_high_pass(sums), 25.0 * pattern.frames) if min(sums.shape) >= BOX else None


def _box_high_pass(image: np.ndarray) -> np.ndarray:
    """25 times (image − its mean over 5 x 5 pixels), exact in integers, valid region."""
    rows, cols = image.shape[0] - BOX + 1, image.shape[1] - BOX + 1
    box = np.zeros((rows, image.shape[1]), dtype=image.dtype)
    for k in range(BOX):
        box += image[k : rows + k]
    result = 25 * image[2:-2, 2:-2]
    for k in range(BOX):
        result -= box[:, k : cols + k]
    return result


def _bins(steps: np.ndarray) -> tuple[np.ndarray, float, float, int]:
    """Counts of the bins, lowest value, range, and width of a bin in whole steps: as many bins as fit into 256 (eq. 73 to 75)."""
    low = steps.min()
    span = steps.max() - low
    if steps.dtype.kind == "i":
        # a span of up to 255 steps: one bin each
        width = 1 if span < MAX_BINS else int(span // MAX_BINS) + 1
        return np.bincount(((steps - low) // width).ravel(), minlength=int(span // width) + 1), low, span, width
    width = int(span // MAX_BINS) + 1
    return np.bincount(((steps - low) * (1 / width)).astype(np.intp).ravel()), low, span, width


def _histogram(steps: np.ndarray, per_dn: float, exact: bool, centred: bool) -> Curve:
    """Counts over the deviation from the mean, with the normal curve of the same mean and standard deviation.

    ``exact`` as in the reference implementation: bins named by their lower edges, and its width of the bins in the model.
    """
    counts, low, span, width = _bins(steps)
    mean, sigma = float(steps.mean()), float(steps.std())
    # values of a bin of whole steps lie at its edge and on; those of a continuous image throughout
    middle = 0.0 if exact else (width - 1) / 2 if steps.dtype.kind == "i" else width / 2
    place = low + width * np.arange(counts.size) + middle
    model_width = span / counts.size if exact else width
    with np.errstate(divide="ignore", invalid="ignore"):
        model = model_width * steps.size / (np.sqrt(2 * np.pi) * sigma) * np.exp(-0.5 * ((place - mean) / sigma) ** 2)
    bins = (place - mean if centred else place) / per_dn
    return {"bins": bins, "values": counts, "model": model if sigma > 0 else np.zeros(counts.size)}


def _accumulated(steps: np.ndarray, per_dn: float, exact: bool) -> Curve:
    """Per cent of the pixels that deviate from the mean by as much or more (eq. 77)."""
    away = np.abs(steps - (int(steps.mean()) if exact else steps.mean()))
    counts, low, _, width = _bins(away)
    values = 100 * np.cumsum(counts[::-1])[::-1] / steps.size
    return {"bins": (low + width * np.arange(counts.size)) / per_dn, "values": values}
