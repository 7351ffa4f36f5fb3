"""Observations: reduced data of a camera's frames, computed once before any measurement.

Records only. They are made by ``pixmetry.observe`` from streams of frames and read by the sources' ``measure``. All values are
in DN of the stored frames unless the name says otherwise; variances in DN². Where temporal statistics come from pairs of frames,
they are from differences, so what is fixed in the camera drops out.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, fields, replace
from typing import Any

import numpy as np

from pixmetry.camera.code_table import CodeTable
from pixmetry.camera.colour_bands import ColourBands
from pixmetry.camera.covered import Covered
from pixmetry.camera.dark_rows import DarkRows
from pixmetry.camera.drift_series import DriftSeries
from pixmetry.camera.frame_sequence import FrameSequences
from pixmetry.camera.motion_series import MotionSeries
from pixmetry.camera.noise_covariance import NoiseCovariance, NoiseFilter
from pixmetry.camera.recordings import Recordings
from pixmetry.camera.response import Response
from pixmetry.camera.speckle import SpeckleFrames
from pixmetry.camera.stated import StatedFacts
from pixmetry.camera.views import TargetViews
from pixmetry.core.errors import MeasureError
from pixmetry.core.number import Estimates


@dataclass(frozen=True)
class LevelMoments:
    """Temporal and spatial moments at several exposure levels, each from the same small number of frames (usually two).

    All arrays have shape (levels,). With F frames of M rows and N columns at a level, the temporal variances are mean squares of the
    two-way (row, column) analysis of variance of the frame differences: ``ms_*`` are the *mean squares per pixel, per row mean and
    per column mean*, so that E[ms_pixel] = σ²_white, E[ms_row] = σ²_row + σ²_white/N, E[ms_col] = σ²_col + σ²_white/M, and
    E[ms_frame] = σ²_frame + σ²_row/M + σ²_col/N + σ²_white/(MN) (the variance of the frame means about their mean).
    """

    exposure_s: np.ndarray
    photons: np.ndarray | None  # mean photons per pixel, when the irradiance is known
    n_frames: np.ndarray
    mean_dn: np.ndarray
    var_total_dn2: np.ndarray  # plain temporal variance per pixel (EMVA 1288: ½⟨d²⟩ − ½⟨d⟩² for a pair)
    ms_pixel_dn2: np.ndarray
    ms_row_dn2: np.ndarray
    ms_col_dn2: np.ndarray
    ms_frame_dn2: np.ndarray
    kurtosis_excess: np.ndarray  # of the frame differences
    fraction_min: np.ndarray  # share of pixels at the lowest code that the camera can store
    fraction_max: np.ndarray  # share at the highest
    spatial_cov_dn2: np.ndarray  # spatial variance free of temporal noise: ⟨y0 y1⟩ − µ0 µ1


@dataclass(frozen=True)
class LevelRows:
    """Means of the rows at several exposure levels, with the standard uncertainty that noise gives each."""

    exposure_s: np.ndarray  # shape (levels,)
    mean_dn: np.ndarray  # shape (levels, rows)
    u_dn: np.ndarray  # shape (levels,)
    fraction_max: np.ndarray  # shape (levels,): share of pixels at the highest code


@dataclass(frozen=True)
class PhotonTransfer:
    """A photon-transfer series: bright and dark levels of one camera at one gain and temperature."""

    bright: LevelMoments
    dark: LevelMoments
    frame_shape: tuple[int, int]
    bits: int
    # shape (dark levels, 3): what hot pixels add to mean (DN) and spatial variance (DN²), and what of the mean was not seen but estimated
    dark_tails: np.ndarray | None = None
    bright_rows: LevelRows | None = None
    dark_rows: LevelRows | None = None

    @property
    def full_dn(self) -> float:
        """Mean of the darkest bright level at which many pixels are full below the last code; infinite without one.

        Full pixels have no shot noise: the temporal variance falls from one level to a brighter one, by a quarter or more.
        """
        order = np.argsort(self.bright.mean_dn, kind="stable")
        var = self.bright.ms_pixel_dn2[order]
        fallen = (var < FALLEN * np.maximum.accumulate(var)) & (np.maximum.accumulate(var) > LEAST_KNEE_DN2)
        return float(self.bright.mean_dn[order][fallen][0]) if fallen.any() else float("inf")


@dataclass(frozen=True)
class StackMoments:
    """Moments of L frames taken at one setting (EMVA 1288 R4.0 §8): the mean image and its remaining noise."""

    n_frames: int
    exposure_s: float
    mean_map_dn: np.ndarray  # shape (rows, cols), float64
    var_map_dn2: np.ndarray  # shape (rows, cols), float32; sample variance over the frames
    mean_dn: float
    frame_means_dn: np.ndarray  # shape (L,), the mean of each frame
    var_stack_dn2: float  # σ²_stack: mean over pixels of the sample variance
    ms_pixel_dn2: float  # temporal mean squares as in LevelMoments, from the whole stack
    ms_row_dn2: float
    ms_col_dn2: float
    ms_frame_dn2: float
    fraction_min: float
    fraction_max: float

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        return self.mean_map_dn.shape


@dataclass(frozen=True)
class Spectra:
    """Power spectra of a mean image (fixed) and of frame differences (temporal), rows and columns apart.

    Frequencies in cycles per pixel, ``k / N`` for k = 0 … N//2; powers in DN² as in EMVA 1288 R4.0 §8.4 (white noise of variance σ²
    has power σ² at every frequency).
    """

    frequency_h: np.ndarray
    fixed_h_dn2: np.ndarray
    temporal_h_dn2: np.ndarray
    frequency_v: np.ndarray
    fixed_v_dn2: np.ndarray
    temporal_v_dn2: np.ndarray
    # two-dimensional temporal periodogram, shape (rows, cols // 2 + 1), float32, the mean over the frame pairs, zero on the axes
    temporal_power_dn2: np.ndarray | None = None
    n_pairs: int = 0


@dataclass(frozen=True)
class CodeHistogram:
    """How often each code occurs, over all frames of a campaign (``counts``) and over its dark frames alone."""

    counts: np.ndarray  # shape (2**bits,), int64
    dark_counts: np.ndarray
    bits: int
    # the light levels, for the counts that an ideal converter would give; each of shape (levels,), in order of their means
    level_means_dn: np.ndarray | None = None
    level_vars_dn2: np.ndarray | None = None  # variance of all codes of the level, temporal and spatial
    level_sizes: np.ndarray | None = None  # int64, number of codes of the level


@dataclass(frozen=True)
class SingleOutliers:
    """How many pixels of flat fields exceed all eight neighbours, or fall below them, by 0, 1, 2 … DN.

    ``counts`` and what normal noise of ``sigma_dn`` would have, ``expected``, have shape (sizes,); the neighbours are ``step`` pixels away.
    ``cut_dn`` and ``u_cut_dn``: the size above which they are missing; NaN where none are.
    """

    counts: np.ndarray
    expected: np.ndarray
    sigma_dn: float
    step: int
    cut_dn: float = float("nan")
    u_cut_dn: float = float("nan")


@dataclass(frozen=True)
class ColourCells:
    """Light of the four places of a colour mosaic.

    ``mean``, shape (2, 2), is over the geometric mean; ``log_covariance``, shape (4, 4), is of the logarithms, row by row, with ``dof``
    degrees of freedom.
    """

    mean: np.ndarray
    log_covariance: np.ndarray
    dof: int


@dataclass(frozen=True)
class TapSteps:
    """Gain of the taps by a flat field.

    ``fit`` has ``step_rel``, ``odd_even_rel`` and, where a border was found, ``taps``; it is empty where the flat field tells nothing.
    ``gain``, shape (cols,), is that of every column as far as it was found. ``unseen_rel`` is the size that a step may have that was not
    found: what all columns together fit best, with its u.
    """

    fit: Estimates
    gain: np.ndarray
    unseen_rel: float = 0.0


@dataclass(frozen=True)
class CodeErrors:
    """Results of a light sweep on the converter's codes; all arrays have one entry per tested code, or per missing code."""

    codes: np.ndarray  # int64, the codes that were covered evenly enough to be tested
    dnl_lsb: np.ndarray
    u_dnl_lsb: np.ndarray
    missing_codes: np.ndarray
    missing_probability: np.ndarray  # chance that any code tested would be empty like this in a converter that has it
    fit: Estimates  # dnl_rms_lsb; empty if fewer than two codes could be tested


@dataclass(frozen=True)
class DefectList:
    """Pixels that differ from the others; arrays have shape (defects,).

    ``kind`` is one of ``hot`` and ``cold`` (dark value), ``dead`` (less than half the response), ``gain`` (response off), ``stuck``
    (no response, no noise) and ``noisy`` (temporal noise); a pixel is listed once, under the worst of these.
    """

    row: np.ndarray
    col: np.ndarray
    kind: tuple[str, ...]
    dark_excess_dn: np.ndarray
    gain_rel: np.ndarray  # response over that of its surroundings; nan without a bright stack or where the end of the scale hides it
    expected_false: float  # mean number of false alarms in a frame whose good pixels are Gaussian
    shape: tuple[int, int]
    dark_limit_dn: float = float("nan")  # dark excess at which half of the pixels would be found
    dark_sigma_dn: float = float("nan")  # scatter of the good pixels' dark values
    gain_sigma_rel: float = float("nan")  # scatter of their response

    def __len__(self) -> int:
        return len(self.kind)

    def mask(self) -> np.ndarray:
        """True at each defect, shape (rows, cols)."""
        mask = np.zeros(self.shape, dtype=bool)
        mask[self.row, self.col] = True
        return mask


@dataclass(frozen=True)
class PatternList:
    """Sinusoidal patterns that stand out of the noise, off the two axes (row and column patterns are measured apart).

    Arrays have shape (patterns,), strongest first. Frequencies in cycles per pixel along x (0 … ½) and y (−½ … ½).
    """

    moving: np.ndarray  # bool; False: at the same place in every frame
    frequency_x: np.ndarray
    frequency_y: np.ndarray
    u_frequency_x: np.ndarray
    u_frequency_y: np.ndarray
    amplitude_dn: np.ndarray
    u_amplitude_dn: np.ndarray
    false_alarm_rate: float  # of the whole search
    n_searched: int  # periodogram ordinates looked at
    fixed_limit_dn: float  # amplitude of the weakest fixed pattern that would be found in half of all cases
    moving_limit_dn: float  # the same for moving patterns; nan if the frames were not searched

    def strongest(self) -> PatternList:
        """The strongest pattern only (or none), which has a row in the budget; the others count as part of the noise."""
        values = {f.name: getattr(self, f.name) for f in fields(self)}
        first: dict[str, Any] = {name: value[:1] for name, value in values.items() if isinstance(value, np.ndarray)}
        return replace(self, **first)

    def __len__(self) -> int:
        return len(self.amplitude_dn)


@dataclass(frozen=True)
class SlantedEdge:
    """One slanted edge and its edge response; lengths and frequencies are along the edge's normal.

    Parameters
    ----------
    picture : int
        In which picture of edges it is.
    across : {"x", "y"}
        What the step goes along: x of a nearly vertical edge, y of a nearly horizontal one.
    x_px, y_px : float
        Its middle.
    angle_deg, u_angle_deg : float
        Angle to the columns (``across`` x) or rows, with the sign of dx/dy or dy/dx.
    order : int
        Order of the polynomial that it follows.
    rows : int
        Rows (columns, of a nearly horizontal edge) that were used.
    half_px : float
        How far from the edge pixels were used.
    low_dn, high_dn : float
        Levels of the two sides, and ``rising``: whether the light grows with x or y.
    noise_dn : float
        Standard deviation of a pixel about the edge's mean curve.
    distance_px, spread_rel : ndarray, shape (bins,)
        Edge spread function: 0 on the dark side, 1 on the bright one.
    sfr, u_sfr : ndarray, shape (frequencies,)
        e-SFR, the modulus of the response.
    sfr50, u_sfr50 : float
        Frequency at which it is one half, cycles/px; NaN where it never is.
    asymmetry, u_asymmetry : float
        (d₉₀ + d₁₀ − 2 d₅₀)/(d₉₀ − d₁₀) of the distances at which 10, 50 and 90 % of the step are reached, counted towards growing x or y.
    """

    picture: int
    across: str
    x_px: float
    y_px: float
    angle_deg: float
    u_angle_deg: float
    order: int
    rows: int
    half_px: float
    low_dn: float
    high_dn: float
    rising: bool
    noise_dn: float
    distance_px: np.ndarray
    spread_rel: np.ndarray
    sfr: np.ndarray
    u_sfr: np.ndarray
    sfr50: float
    u_sfr50: float
    asymmetry: float
    u_asymmetry: float


@dataclass(frozen=True)
class RefusedEdge:
    """An edge that was found and cannot be measured; ``reason`` says why."""

    picture: int
    across: str
    x_px: float
    y_px: float
    angle_deg: float
    rows: int
    reason: str


@dataclass(frozen=True)
class EdgeResponse:
    """Mean e-SFR of all edges of one direction: shape (frequencies,), and its covariance, (frequencies, frequencies)."""

    sfr: np.ndarray
    covariance: np.ndarray
    edges: int


@dataclass(frozen=True)
class SlantedEdges:
    """Slanted edges of all pictures, and what they have in common.

    Parameters
    ----------
    frequency : ndarray, shape (frequencies,)
        Cycles per pixel, along the edge's normal.
    edges : tuple of SlantedEdge
    refused : tuple of RefusedEdge
    x, y : EdgeResponse or None
        Of steps along x (nearly vertical edges) and along y.
    fit : Estimates
        ``sfr50_x``, ``sfr50_y``, ``sampling_efficiency_x``, ``sampling_efficiency_y`` (frequency at which the response is 10 %, over 0.5
        cycles/px, at most 1), ``asymmetry_x``, ``asymmetry_y``, as far as there are edges for them.
    optics : Estimates
        Lens, pixel and optical low-pass filter, fitted together: see `pixmetry.observe.edge_fit`.
    line : Estimates or None
        Of an analogue camera its video line, see `pixmetry.observe.line_fit.line_estimates`: delays in pixels, frequencies over the clock.
    """

    frequency: np.ndarray
    edges: tuple[SlantedEdge, ...]
    refused: tuple[RefusedEdge, ...]
    x: EdgeResponse | None
    y: EdgeResponse | None
    fit: Estimates
    optics: Estimates
    line: Estimates | None = None


@dataclass(frozen=True)
class FocusOverFrame:
    """How far the sensor lies behind the image of a chart, all over the frame.

    Parameters
    ----------
    settings_um : tuple of float
        Of the focus: how far the sensor was from the lens beyond its first place.
    places_px : ndarray, shape (edges, 2)
        Of the edges that three settings or more show, and their directions, ``across``: as of `SlantedEdge`.
    z_um, u_z_um : ndarray, shape (edges,)
        Place of the sensor at the mean setting less that of the best focus, as fitted.
    fit : Estimates
        ``tilt_x_deg``, ``tilt_y_deg``, ``bow_x_um``, ``bow_y_um``, ``twist_um``, ``f_number``; ``reasons`` for what is not told.
    """

    settings_um: tuple[float, ...]
    places_px: np.ndarray
    across: tuple[str, ...]
    z_um: np.ndarray
    u_z_um: np.ndarray
    fit: Estimates


@dataclass(frozen=True)
class Spot:
    """One bright spot: its centre, its rows and columns (first and one behind the last), and the light of its brightest pixel, DN/s."""

    x_px: float
    y_px: float
    rows: tuple[int, int]
    cols: tuple[int, int]
    peak_dn_per_s: float


@dataclass(frozen=True)
class SpotStreaks:
    """Charge that left overexposed spots along their columns, above and below them; one entry a column and exposure.

    Parameters
    ----------
    light_dn : ndarray, shape (entries, rows)
        Light of the spot's rows in that exposure, from exposures that do not saturate.
    first_row : ndarray, shape (entries,)
        The row of the frame of ``light_dn[:, 0]``.
    centre_row : ndarray, shape (entries,)
        The row of the frame that has most light.
    column : ndarray, shape (entries,)
        Number of the column that an entry is of: entries of one column share the error of its light.
    u_light_rel : ndarray, shape (entries,)
        Relative standard uncertainty of that.
    window : ndarray, shape (entries, 2)
        First row, and one behind the last, that are summed.
    level_dn : ndarray, shape (entries, 2)
        Level of the column above and below spot and streak, which the full pixels hold too.
    up_dn, down_dn : ndarray, shape (entries,)
        Sum of the window's rows above the centre, and below it.
    var_dn2 : ndarray, shape (entries,)
        Variance of either, as expected; its scale is not trusted.
    """

    light_dn: np.ndarray
    first_row: np.ndarray
    centre_row: np.ndarray
    column: np.ndarray
    u_light_rel: np.ndarray
    window: np.ndarray
    level_dn: np.ndarray
    up_dn: np.ndarray
    down_dn: np.ndarray
    var_dn2: np.ndarray

    def __len__(self) -> int:
        return len(self.up_dn)


@dataclass(frozen=True)
class BrightSpots:
    """Spots on black at several exposures, and what they leave in the rest of their columns and rows.

    Parameters
    ----------
    spots : tuple of Spot
    exposure_s, peak_dn : ndarray, shape (exposures,)
        And the brightest pixel, above black.
    saturated : ndarray, shape (exposures,), bool
    level_up_s, level_down_s, u_level_s : ndarray, shape (exposures,)
        Streak above and below, per light of the column in one second, in seconds: smear is the same at all exposures. NaN where a streak of
        full pixels reaches the frame's end.
    plateau_dn : float
        Level above black at which spots saturate; NaN where none does.
    clipped : bool
        Whether that is the highest code.
    streaks : SpotStreaks or None
        Of spots that are alone in their columns, whose streaks end within the frame.
    smear_rows, smear_store : str
        As in ``sensor.smear``: the rows that charge passes, and the side of the storage.
    fit : Estimates
        ``smear_s``, ``row_crosstalk``, ``col_crosstalk``, ``plateau_dn``; why others are missing in ``reasons``.
    frame_rows : int
    """

    spots: tuple[Spot, ...]
    exposure_s: np.ndarray
    peak_dn: np.ndarray
    saturated: np.ndarray
    level_up_s: np.ndarray
    level_down_s: np.ndarray
    u_level_s: np.ndarray
    plateau_dn: float
    clipped: bool
    streaks: SpotStreaks | None
    smear_rows: str
    smear_store: str
    fit: Estimates
    frame_rows: int


@dataclass(frozen=True)
class DarkTemperatures:
    """Dark signal a second at several temperatures of the sensor, DN/s, with its u, each of shape (temperatures,), and its law.

    ``fit`` has ``doubling_temperature_k`` and ``dark_current_ref``, the dark signal at ``reference_c``; without them the reason.
    """

    temperature_c: np.ndarray
    rate_dn_per_s: np.ndarray
    u_rate_dn_per_s: np.ndarray
    reference_c: float
    fit: Estimates


@dataclass(frozen=True)
class LightStep:
    """One sequence of frames in which the light went off.

    Parameters
    ----------
    bright_frames : int
        Frames before the step.
    signal_dn : float
        Mean light of the last bright frame, where it is lit.
    shares : ndarray, shape (frames after the step,)
        What each of them shows of the last bright frame, over that.
    u_shares : tuple of float
        Standard uncertainty of the first two.
    dof : float
    noise_correlation, u_noise_correlation : float
        Correlation of the noise of successive dark frames; its u is infinite where there is too little noise.
    levels_dn, left_dn : ndarray, shape (levels,)
        Places of like light: the light, and what the first dark frame shows of it.
    left_covariance_dn2 : ndarray, shape (levels, levels)
        Of ``left_dn``.
    """

    bright_frames: int
    signal_dn: float
    shares: np.ndarray
    u_shares: tuple[float, float]
    dof: float
    noise_correlation: float
    u_noise_correlation: float
    levels_dn: np.ndarray
    left_dn: np.ndarray
    left_covariance_dn2: np.ndarray


@dataclass(frozen=True)
class LightSteps:
    """All sequences in which the light went off, why others were refused, and ``left_rel``: the share that the next frame shows."""

    steps: tuple[LightStep, ...]
    refused: tuple[str, ...]
    fit: Estimates


@dataclass(frozen=True)
class RowPlaces:
    """The place of every row of every frame along one upright line or edge.

    Parameters
    ----------
    picture : int
        In which picture of lines it is.
    kind : {"line", "edge"}
    row : ndarray, shape (rows,)
        Rows of the frame that were measured.
    place_px : ndarray, shape (rows,)
        Column in the mean of the frames.
    shift_px : ndarray, shape (frames, rows)
        Shift of each row of each frame against that.
    u_px : ndarray, shape (rows,)
        Standard uncertainty of a row's place in one frame that comes of the noise of the pixels.
    u_rel : float
        Relative u of its square.
    height_dn, noise_dn : float
        Of the step, or of the line above its sides; standard deviation of a pixel beside it.
    half_px : int
        Half of the window that was summed.
    """

    picture: int
    kind: str
    row: np.ndarray
    place_px: np.ndarray
    shift_px: np.ndarray
    u_px: np.ndarray
    u_rel: float
    height_dn: float
    noise_dn: float
    half_px: int


@dataclass(frozen=True)
class RefusedLine:
    """A line that was found and cannot be measured; ``reason`` says why."""

    picture: int
    kind: str
    x_px: float
    y_px: float
    rows: int
    reason: str


@dataclass(frozen=True)
class LineRows:
    """Upright lines and edges of all pictures of lines, row by row, and what the rows have in common.

    Parameters
    ----------
    lines : tuple of RowPlaces
    refused : tuple of RefusedLine
    recorded : tuple of bool
        By picture, whether it was played from video tape.
    jitter : Estimates
        ``white_px``, ``loop_px``, ``loop_rows``, ``interlaced``, ``settling_px``, ``settling_rows`` of the pictures that were not recorded:
        see `pixmetry.observe.line_jitter`.
    taped : Estimates
        The same of the pictures that were played from tape.
    notes : tuple of str
    """

    lines: tuple[RowPlaces, ...]
    refused: tuple[RefusedLine, ...]
    recorded: tuple[bool, ...]
    jitter: Estimates = Estimates.empty()
    taped: Estimates = Estimates.empty()
    notes: tuple[str, ...] = ()


@dataclass(frozen=True)
class Trail:
    """What covered pixels show behind the lit area of bright frames, in DN above the farther ones.

    Parameters
    ----------
    axis : {"columns", "rows"}
        What is covered.
    signal_dn, first_dn, u_first_dn : ndarray, shape (levels,)
        Light beside the border, and the first covered pixel.
    share, u_share : float
        The first covered pixel over the light.
    shape, u_shape : ndarray, shape (pixels,)
        The same of the covered pixels behind each other, as they were seen.
    length_px, u_length_px : float
        Mean distance by which late charge comes.
    transfers : int
        To the output from the first covered pixel.
    bent : float
        By how many u the share differs between faint and strong light.
    """

    axis: str
    signal_dn: np.ndarray
    first_dn: np.ndarray
    u_first_dn: np.ndarray
    share: float
    u_share: float
    shape: np.ndarray
    u_shape: np.ndarray
    length_px: float
    u_length_px: float
    transfers: int
    bent: float


@dataclass(frozen=True)
class CoveredPixels:
    """What the covered columns and rows of the stored frames tell.

    Parameters
    ----------
    covered : Covered
    fit : Estimates
        ``serial_cti``, ``serial_trail_px``, ``parallel_cti``, ``parallel_trail_px`` (per pixel); ``droop_rel`` of a line's length;
        ``smear_s``: what a row takes up of its column, as a time of moving through all lit rows.
    trails : tuple of Trail
    row_noise : tuple of (float, float, float)
        Exposure of a group, standard deviation of the noise common to a row in DN, its u.
    notes : tuple of str
    """

    covered: Covered
    fit: Estimates
    trails: tuple[Trail, ...]
    row_noise: tuple[tuple[float, float, float], ...]
    notes: tuple[str, ...] = ()


LENS, AFFINITY = "optics.distortion", "sensor.affinity"
TAKEN_UP = (LENS, AFFINITY, "optics.cover_glass", "sensor.pixel_pitch", "sensor.tilt")  # by a calibration, in the first two


@dataclass(frozen=True)
class CameraGeometry:
    """Geometry of a camera from a calibration with targets, and the remaining errors.

    Parameters
    ----------
    lens : Estimates
        ``k1_per_mm2`` to ``k5_per_mm10``, ``p1_per_mm``, ``p2_per_mm`` (distorted to ideal places), ``centre_x_px``,
        ``centre_y_px`` (principal point less the frame's centre), ``b1``, ``b2`` (of an image that the lens has distorted before),
        ``principal_distance_mm``, ``pitch_x_um``, ``pitch_y_um``.
    u_x_px, u_y_px : float
        Root mean square over the frame of the uncertainty of a corrected place, from the covariance of the parameters, without what a
        rotation of the camera takes up.
    left_x_px, left_y_px : float
        Systematic part of the calibration's residuals: what they have in common at one place of the frame.
    origin : str
        Where it comes from.
    told : mapping
        By source: its parameters as the residuals of the calibration tell them. Lens and affinity are those beside them.
    untold : mapping
        By source: why they tell nothing of it.
    """

    lens: Estimates
    u_x_px: float
    u_y_px: float
    left_x_px: float
    left_y_px: float
    origin: str
    told: Mapping[str, Estimates] = field(default_factory=dict)
    untold: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class ActiveArea:
    """Place of the active area in frames that store more than it.

    Parameters
    ----------
    left, right, top, bottom : float
        First column and row of the active area, and the first behind it, counted from the edge of the first pixel; NaN where the frame
        shows no black border on that side.
    rows, cols : int
        Of the frames.
    black_dn, bright_dn : float
    profile_cols_dn, profile_rows_dn : ndarray, shape (cols,), (rows,)
        Means over the active rows, and over the active columns.
    beat : float
        Frequency of a line in the fixed pattern along the rows, cycles per sample; NaN without.
    beat_power : float
        Power of the strongest line over the median.
    fit : Estimates
        ``row_offset``, ``col_offset``, ``clock_mhz``, ``start_ns``, ``clock_ratio`` as far as they are told; ``reasons`` for the others.
    """

    left: float
    right: float
    top: float
    bottom: float
    rows: int
    cols: int
    black_dn: float
    bright_dn: float
    profile_cols_dn: np.ndarray
    profile_rows_dn: np.ndarray
    beat: float
    beat_power: float
    fit: Estimates


@dataclass(frozen=True)
class StoredBlocks:
    """Traces of a lossy coder in textured frames.

    Parameters
    ----------
    fit : Estimates
        ``quality`` of JPEG on the scale of the Independent JPEG Group, or the reason why it is not told.
    table : ndarray, shape (8, 8)
        Quantiser steps of the luminance; 0 where a step is not told.
    offset : tuple of int
        Row and column of the first whole block in the frames.
    score : float
        Logarithm of the likelihood ratio against no coder.
    coefficients : int
        That are not zero.
    repeated_share : float
        Of blocks of 16 px that are the same in successive frames; NaN where it is not told.
    notes : tuple of str
    """

    fit: Estimates
    table: np.ndarray
    offset: tuple[int, int]
    score: float
    coefficients: int
    repeated_share: float
    notes: tuple[str, ...] = ()


@dataclass(frozen=True)
class Storage:
    """Whether a lossy coder changed the frames before they were read, and how that is known.

    Parameters
    ----------
    lossless : bool or None
        True: no lossy coder; False: there was one (JPEG, a video codec); None: not known.
    known : str
        ``"proven"``: every file says it itself: PNG, BMP, FITS, NPY, raw, Zarr and TIFF without a coder or with a lossless one, True; a
        lossy coder inside a TIFF, False. It holds for the files; a coder before them (a camera that sends JPEG) can only be stated.
        ``"stated"``: ``lossless`` in the manifest says it. ``"unknown"``: neither, as with arrays in memory.
    table : tuple of int or None
        Luminance quantiser of frames of kind pattern, row by row, where their files are JPEG.
    """

    lossless: bool | None = None
    known: str = "unknown"
    table: tuple[int, ...] | None = None


UNKNOWN_BEND_REL = 0.005  # of a response that is not measured; linear cameras stay below it (EMVA 1288, linearity error)
FALLEN = 0.75  # of the temporal variance, over that of a darker level, where pixels are full
LEAST_KNEE_DN2 = 2.0  # of it, above which rounding does not make it fall


@dataclass(frozen=True)
class Observations:
    """All reduced data of one campaign; missing data are ``None``.

    ``response`` is what patches of known light tell. ``photon_transfer_fit`` is the joint estimate made once from ``photon_transfer`` (and
    the stacks), which many sources read.
    """

    photon_transfer: PhotonTransfer | None = None
    photon_transfer_fit: Estimates | None = None
    dark_stack: StackMoments | None = None
    bright_stack: StackMoments | None = None
    dark_spectra: Spectra | None = None
    bright_spectra: Spectra | None = None
    histogram: CodeHistogram | None = None
    spatial_fit: Estimates | None = None
    defects: DefectList | None = None
    patterns: PatternList | None = None
    code_errors: CodeErrors | None = None
    colour_cells: ColourCells | None = None  # of a colour mosaic; the bright stack is then balanced
    taps: TapSteps | None = None  # the stacks still have them; `spatial_fit` has not
    outliers: SingleOutliers | None = None  # of the stack of bright frames
    code_table: CodeTable | None = None  # of companding, where the codes show one
    edges: SlantedEdges | None = None
    focus: FocusOverFrame | None = None
    light_off: LightSteps | None = None
    spots: BrightSpots | None = None
    dark_rows: DarkRows | None = None  # of the stack of dark frames
    dark_temperatures: DarkTemperatures | None = None
    sensor: str | None = None  # ccd, cmos or cid, where it was said
    response: Response | None = None
    lines: LineRows | None = None
    blocks: StoredBlocks | None = None
    area: ActiveArea | None = None
    covered: CoveredPixels | None = None
    noise_covariance: NoiseCovariance | None = None
    noise_filter: NoiseFilter | None = None
    stated: StatedFacts = StatedFacts()
    temperature_c: float | None = None
    geometry: CameraGeometry | None = None
    drift: DriftSeries | None = None
    motion: MotionSeries | None = None
    speckle: SpeckleFrames | None = None
    sequences: FrameSequences | None = None
    views: TargetViews | None = None
    bands: ColourBands | None = None
    recordings: Recordings | None = None
    failed: Mapping[str, str] = field(default_factory=dict)  # by kind of frames: why they tell nothing
    storage: Storage = Storage()
    notes: tuple[str, ...] = field(default_factory=tuple)

    @property
    def series(self) -> PhotonTransfer:
        """The levels of a campaign that must have some; `MeasureError` where it has none."""
        if self.photon_transfer is None:
            raise MeasureError("no levels of dark and bright frames", remedy="take frames at several exposures")
        return self.photon_transfer

    @property
    def fit(self) -> Estimates:
        """The joint estimate of a campaign that must have one; `MeasureError` where it has none."""
        if self.photon_transfer_fit is None:
            raise MeasureError("nothing was fitted to the levels", remedy="take frames at several exposures")
        return self.photon_transfer_fit

    @property
    def stacks(self) -> tuple[StackMoments, StackMoments]:
        """The stacks of dark and of bright frames; `MeasureError` where one is missing."""
        if self.dark_stack is None or self.bright_stack is None:
            raise MeasureError("needs a stack of dark and one of bright frames", remedy="take 16 or more of each")
        return self.dark_stack, self.bright_stack

    def fitted(self, names: Mapping[str, str], what: str, *, where: str, remedy: str) -> Estimates:
        """Take a source's parameters ``{parameter: fitted name}`` with their covariance from the joint fit that has the first of them.

        Raises
        ------
        MeasureError
            With ``what``, ``where`` and ``remedy``, if no fit holds it.
        """
        first = next(iter(names.values()))
        for fit in (self.photon_transfer_fit, self.spatial_fit):
            if fit is not None and first in fit:
                return fit.select(names)
        raise MeasureError(what, where=where, remedy=remedy)

    def edge_optics(self, names: Mapping[str, str], *, where: str) -> Estimates:
        """Take a source's parameters ``{parameter: fitted name}`` that slanted edges tell, with their covariance.

        Raises
        ------
        MeasureError
            Without edges, or with the reason why they do not tell any of these.
        """
        optics = None if self.edges is None or not self.edges.edges else self.edges.optics
        return of_pictures(optics, names, where=where, pictures="slanted edges", kind="edge")

    def border(self, names: Iterable[str], *, where: str) -> Estimates:
        """Take a frame grabber's set-up out of frames that show the border of the active area.

        Raises
        ------
        MeasureError
            Without such frames, or with the reason why they do not tell any of these.
        """
        fit = None if self.area is None else self.area.fit
        pictures = "bright field with the border of the image"
        return of_pictures(fit, {n: n for n in names}, where=where, pictures=pictures, kind="border")

    def coder(self, names: Iterable[str], *, where: str) -> Estimates:
        """Take a coder's parameters out of what textured frames, or their files, tell.

        Raises
        ------
        MeasureError
            Without such frames, or with the reason why they do not tell any of these.
        """
        fit = None if self.blocks is None else self.blocks.fit
        return of_pictures(fit, {n: n for n in names}, where=where, pictures="textured frames", kind="pattern")

    @property
    def sample_clock_mhz(self) -> float | None:
        """Clock of the stored samples: of the grabber, as measured at the border of the image or as stated; else that of the pixels."""
        area = None if self.area is None else self.area.fit
        if area is not None and "clock_mhz" in area and not area.limits:
            return area["clock_mhz"].value
        return self.stated.sampling_clock_mhz or self.stated.pixel_clock_mhz

    def video_line(self, scales: Mapping[str, str], *, where: str) -> tuple[Estimates, float]:
        """Take fitted values of the video line that slanted edges tell, and the clock of the samples in MHz.

        Raises
        ------
        MeasureError
            Without edges, of a digital camera, without a stated pixel clock, or with the reason why the edges do not tell these.
        """
        clock = self.sample_clock_mhz
        if self.edges is not None and self.edges.edges and self.edges.line is None:
            raise MeasureError("the camera is digital: it has no video line", where=where, remedy="state interface: analogue if it has one")
        line = None if self.edges is None or not self.edges.edges else self.edges.line
        found = of_pictures(line, scales, where=where, pictures="slanted edges", kind="edge")
        if clock is None:
            raise MeasureError(
                "the edges tell it in pixels, and the pixel clock is not stated",
                where=where,
                remedy="state pixel_clock_mhz in the manifest",
            )
        return found, clock

    def curve(self, names: Mapping[str, str] | Iterable[str], *, where: str) -> Estimates:
        """Take a source's parameters ``{parameter: fitted name}`` out of the response that a chart tells, with their covariance.

        Raises
        ------
        MeasureError
            Without patches of known light, or with the reason why they do not tell any of these.
        """
        fit = None if self.response is None else self.response.fit
        mapping = dict(names) if isinstance(names, Mapping) else {n: n for n in names}
        return of_pictures(fit, mapping, where=where, pictures="patches of known light", kind="chart")

    def by_covered(self, names: Mapping[str, str], *, where: str, method: str = "") -> Estimates:
        """Take a source's parameters ``{parameter: fitted name}`` that covered columns and rows tell.

        With a ``method`` of its own a source is not taken for what the others could be mistaken for.

        Raises
        ------
        MeasureError
            Without covered pixels, or with the reason why they do not tell any of these.
        """
        if self.covered is None:
            remedy = "state camera.covered in the manifest, as covered: {right: 16, bottom: 8}"
            raise MeasureError("not measured: needs covered columns or rows", where=where, remedy=remedy)
        found = of_pictures(self.covered.fit, names, where=where, pictures="covered pixels", kind="bright")
        return replace(found, method=method, confounders=()) if method else found

    def moved_charge(self, name: str) -> tuple[float, float]:
        """Smear (``smear_s``) or loss of a transfer by covered pixels or bright spots, the better of both, with u; zero where unknown."""
        fits = [None if part is None else part.fit for part in (self.covered, self.spots)]
        known = [fit[name] for fit in fits if fit is not None and name in fit]
        if not known:
            return 0.0, 0.0
        best = min(known, key=lambda e: e.u)
        return (0.0, best.u) if best.is_limit else (best.value, best.u)

    def row_jitter(self, names: Mapping[str, str], *, where: str, taped: bool = False) -> Estimates:
        """Take a source's parameters ``{parameter: fitted name}`` that the rows of upright lines tell, in px, with their covariance.

        Raises
        ------
        MeasureError
            Without pictures of lines, or with the reason why they do not tell any of these.
        """
        fit = None
        if self.lines is not None and taped in self.lines.recorded:
            fit = self.lines.taped if taped else self.lines.jitter
        pictures = "upright lines or edges in 4 frames or more" + (", played from tape and once more directly" if taped else "")
        return of_pictures(fit, names, where=where, pictures=pictures, kind="line")

    def bend_rel(self, level_dn: float) -> float:
        """Relative deviation from a straight response at a level above black: as fitted, with its u, or `UNKNOWN_BEND_REL`."""
        fit, transfer = self.photon_transfer_fit, self.photon_transfer
        names = [n for n in ("nonlinearity_a1", "nonlinearity_a2", "nonlinearity_a3") if fit is not None and n in fit]
        if fit is None or transfer is None or not names:
            return UNKNOWN_BEND_REL
        powers = (level_dn / (2**transfer.bits - 1)) ** np.arange(1, len(names) + 1)
        found = fit.select(names)
        return float(np.hypot(powers @ found.values, np.sqrt(powers @ found.covariance @ powers)))

    def moving(self, names: Mapping[str, str], *, where: str, settings: Iterable[str] = ()) -> Estimates:
        """Take a source's parameters ``{parameter: fitted name}`` that moving targets tell, with those settings that it has.

        Raises
        ------
        MeasureError
            Without frames of moving targets, or with the reason why they do not tell any of these.
        """
        fit, failed = None if self.motion is None else self.motion.fit, self.failed.get("motion", "")
        found = of_pictures(fit, names, where=where, pictures="moving targets", kind="motion", failed=failed)
        return replace(found, settings={name: found.settings[name] for name in settings if name in found.settings})

    def recorder(self, names: Mapping[str, str], *, where: str, settings: Iterable[str] = ()) -> Estimates:
        """Take a source's parameters ``{parameter: fitted name}`` that a scene tells which was seen directly and recorded.

        Raises
        ------
        MeasureError
            Without such frames, or with the reason why they do not tell any of these.
        """
        fit, failed = None if self.recordings is None else self.recordings.fit, self.failed.get("recording", "")
        found = of_pictures(fit, names, where=where, pictures="one scene, directly and recorded", kind="recording", failed=failed)
        return replace(found, settings={name: found.settings[name] for name in settings if name in found.settings})

    def choices(self, source: str) -> Mapping[str, Any]:
        """Parameters of a source that are no numbers, such as words, as the pictures tell them."""
        return {} if self.response is None else self.response.choices.get(source, {})

    def by_residuals(self, *, where: str) -> Estimates:
        """Take a source's parameters as the residuals of a calibration tell them, with their covariance.

        Raises
        ------
        MeasureError
            Without a calibration, or with the reason why its residuals do not tell them.
        """
        if self.geometry is None:
            remedy = "calibrate the camera with images of targets and give the calibration"
            raise MeasureError("not measured: needs the residuals of a calibration", where=where, remedy=remedy)
        if where not in self.geometry.told:
            unknown = "they were not examined: a camera needs 200 image points or more"
            raise MeasureError(f"not told by the residuals of the calibration: {self.geometry.untold.get(where, unknown)}", where=where)
        return self.geometry.told[where]

    def calibrated(self, names: Mapping[str, str] | Iterable[str], *, where: str) -> Estimates:
        """Take a source's parameters out of the calibrated geometry, with their covariance.

        Raises
        ------
        MeasureError
            If there is no calibration.
        """
        if self.geometry is None:
            remedy = "calibrate the camera with images of targets and give the calibration"
            raise MeasureError("needs a calibrated geometry; dark and bright frames show no targets", where=where, remedy=remedy)
        return self.geometry.lens.select(names)


def of_pictures(fit: Estimates | None, names: Mapping[str, str], *, where: str, pictures: str, kind: str, failed: str = "") -> Estimates:
    """Take a source's parameters ``{parameter: fitted name}`` out of what pictures of one kind tell, with their covariance.

    Parameters
    ----------
    fit : Estimates or None
        None where there are no such pictures. ``reasons`` of names that it does not hold say why.
    names : mapping
    where : str
        Id of the source.
    pictures : str
        What the pictures show, for the message.
    kind : str
        As in the manifest.
    failed : str
        Why the pictures tell nothing at all, where there are some.

    Raises
    ------
    MeasureError
        Without pictures, or with the reason why they do not tell any of these.
    """
    if fit is None and failed:
        raise MeasureError(f"not told by {pictures}: {failed}", where=where)
    if fit is None:
        remedy = f"take frames of {pictures} (kind: {kind} in the manifest)"
        raise MeasureError(f"not measured: needs {pictures}", where=where, remedy=remedy)
    known = {name: fitted for name, fitted in names.items() if fitted in fit}
    if not known:
        own = [fit.reasons.get(fitted, "") for fitted in names.values()]
        why = next(filter(None, [*own, *fit.reasons.values()]), f"no {pictures} could be measured")
        raise MeasureError(f"not told by {pictures}: {why}", where=where)
    return fit.select(known)
