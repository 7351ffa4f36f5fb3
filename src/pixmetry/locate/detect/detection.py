"""Find targets: regions above (or below) the background, their size and shape."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, fields, replace

import numpy as np

from pixmetry.core.errors import InputError
from pixmetry.core.threads import map_tiles
from pixmetry.locate.detect.background import Background, background, bands_of, scale_of
from pixmetry.locate.detect.blocks import Coder, coder_height_dn, coder_of
from pixmetry.locate.detect.targets import Flag, LeftOut, Targets

POLARITIES = ("auto", "bright", "dark")
KINDS = ("disc", "ellipse", "ring", "spot")
LARGEST_RATIO = 3.2  # of the axes of a disc seen at 70°, 2.9, and some noise
CUT_FILL = 0.1  # by which segments of a disc are less full than the disc
THRESHOLD_SIGMA = 4.0
LEAST_AREA_PX = 3
FALSE_ALARMS = 0.01  # a frame
FARTHEST_PX = 12.0  # from the outline of a target that its skirt counts as its own
FEEBLE = 0.2  # height, over the largest one's, below which a target may be an error of the ground between many targets
MORE = 1.01  # area of targets that another reading of the background must show
GROWN_PX = 0.25  # by which outlines at half height must be farther out where it shows no more targets: it is not the same at another level
TWO_LEVELS = 0.8  # least share of the variance between two levels
MOST_SEEN = 60000  # pixels
RINGING = 0.08  # height of what rings around a target, over the target's
CODED_RINGING, MOST_RINGING = 0.2, 0.5  # the same, in a frame whose blocks are visible; where the coder is coarse, at most
BEYOND_DN = 1e30  # no grey value is so far from the background


@dataclass(frozen=True)
class Regions(Targets):
    """Targets with the properties of their regions above half height; further arrays of shape (n,).

    Parameters
    ----------
    area_px : ndarray
        Pixels above half height.
    fill : ndarray
        That area over the one of an ellipse with the same second moments: 1 for a full ellipse, 0.955 for a rectangle, less for what has
        holes, corners or waists.
    holes : ndarray of int
        Holes in the region.
    """

    area_px: np.ndarray
    fill: np.ndarray
    holes: np.ndarray

    def __getitem__(self, which: np.ndarray | slice) -> Regions:
        """A part of them, by mask, index array or slice."""
        return Regions(**{f.name: getattr(self, f.name)[which] for f in fields(self)})


@dataclass(frozen=True)
class Detection:
    """What was found in a frame.

    Parameters
    ----------
    targets : Regions
        In order of row, then column, of their regions' first pixels.
    background : Background
    sigma_dn : float
        Typical standard deviation of the background's noise.
    polarity : {"bright", "dark", "both", "none"}
        Of the targets.
    left_out : LeftOut
        What other targets cause.
    reading : {"", "dark", "bright"}
        What the background is where targets cover the frame: its dark or its bright parts. Empty where it is what most pixels are.
    known : ndarray, shape (n, 5), int32
        Runs of pixels beyond the threshold that belong to targets: row, first and stop column, sign.
    blanked : bool
        Whether known targets cover so much of the frame that no fainter ones were looked for.
    """

    targets: Regions
    background: Background
    sigma_dn: float
    polarity: str
    left_out: LeftOut = field(default_factory=LeftOut.of)
    reading: str = ""
    known: np.ndarray = field(default_factory=lambda: np.empty((0, 5), np.int32))
    blanked: bool = False


def detect(
    frame: np.ndarray,
    *,
    polarity: str = "auto",
    high_dn: float = math.inf,
    low_dn: float = -math.inf,
    least_area_px: int = LEAST_AREA_PX,
    threshold_sigma: float = THRESHOLD_SIGMA,
    false_alarms: float = FALSE_ALARMS,
    coder: Coder | str | None = "auto",
    threads: int | None = None,
) -> Detection:
    """Find regions above (or below) the background.

    Parameters
    ----------
    frame : ndarray, shape (rows, cols), uint8, uint16 or float32
        Finite and C-contiguous.
    polarity : {"auto", "bright", "dark"}
        Which side of the background targets lie on; "auto" takes both.
    high_dn, low_dn : float
        Grey values at which the scale ends; never beyond the range of an integer type.
    least_area_px : int
        Connected pixels beyond the threshold that make a region.
    threshold_sigma : float
        Threshold in standard deviations of the background's noise. With a higher one than by default no fainter targets are looked for.
    false_alarms : float
        Greatest expected number of false targets that the matched filter finds in a frame of noise.
    coder : Coder, "auto" or None
        Of blocks, that the frame went through; "auto": what its pixels show (`coder_of`).
    threads : int, optional

    Raises
    ------
    InputError
        If an argument cannot be used.

    Notes
    -----
    A region is a set of pixels beyond the threshold T = kσ + ½ DN (½ for rounding) that touch, corners included. It counts if it has
    ``least_area_px`` pixels and rises to 1.5 T. White noise makes N·A_n·Q(k)ⁿ false regions of n pixels on each side in a frame of N
    pixels, with Q the tail of the normal distribution and A_n = 1, 4, 20, 110 the number of ways in which n pixels can touch (polyplets).
    With the defaults, k = 4 and n = 3, these are 2·20·N·(3.17e-5)³: 5e-6 per frame of 2048 × 2048, and less for the rise to 1.5 T. Where
    the noise is underestimated by a tenth there are 7e-4.

    Everything about a target is measured at half of its own height. A region that has several parts there is several targets, and so is one
    whose parts are 1.4 times as high as the saddle between them. Where half the height is below the threshold, the mean of 3 × 3 pixels
    takes the place of the pixels.

    What others cause is left out: less than 0.4 of another target's height, on the other side of the background and at its edge (the halo
    of a sharpening filter), or less than 0.08 of it within 12 pixels (stray light, and ringing in a coder's block).
    """
    if polarity not in POLARITIES:
        raise InputError("no such polarity", value=polarity, allowed=", ".join(POLARITIES))
    if not (threshold_sigma > 0 and least_area_px >= 1):
        raise InputError("a threshold or area that no target exceeds", value=(threshold_sigma, least_area_px), allowed="above 0; 1 or more")
    if not 0 < false_alarms < math.inf:
        raise InputError("no rate of false alarms", where="false_alarms", value=false_alarms, allowed="above 0, such as 0.01")
    look = _Look(frame, polarity, low_dn, high_dn, least_area_px, threshold_sigma, false_alarms, coder, threads)
    found = look.detected("")
    if found.background.doubtful:
        found = look.better_reading(found)
    if not found.reading and threshold_sigma <= THRESHOLD_SIGMA:  # no ground but between targets; or no faint ones are wanted
        found = look.with_faint_ones(found)
    return look.without_coder(found)


@dataclass(frozen=True)
class _Look:
    """A frame, and how targets are looked for in it."""

    frame: np.ndarray
    polarity: str
    low_dn: float
    high_dn: float
    least_area_px: int
    threshold_sigma: float
    false_alarms: float
    coder: Coder | str | None
    threads: int | None

    def detected(self, reading: str) -> Detection:
        """Regions beyond the threshold, of one reading of the background."""
        from pixmetry.locate.detect._background_kernels import Map
        from pixmetry.locate.detect._detect_kernels import find_runs, group_runs
        from pixmetry.locate.detect._region_kernels import GroupedRuns, measure_regions

        frame, threads = self.frame, self.threads
        ground = background(frame, low_dn=self.low_dn, high_dn=self.high_dn, ground=reading, threads=threads)
        *ends, grain = scale_of(frame, self.low_dn, self.high_dn)
        reach = self.threshold_sigma * ground.tame_sigma_dn + 0.5 * grain
        low = ground.level_dn - (reach if self.polarity != "bright" else BEYOND_DN)
        high = ground.level_dn + (reach if self.polarity != "dark" else BEYOND_DN)
        bands = bands_of(frame.shape[0], threads)
        runs, start = group_runs(np.concatenate(map_tiles(lambda b: find_runs(frame, low, high, *ground.scales, *b), bands, threads)))
        shares = np.searchsorted(start, np.linspace(0, len(runs), len(bands) + 1)).tolist()
        regions, least, level = GroupedRuns(runs, start), Map(reach, *ground.scales), Map(ground.level_dn, *ground.scales)
        parts = map_tiles(
            lambda b: measure_regions(frame, regions, least, level, b, self.least_area_px, (ends[0], ends[1])),
            zip(shares[:-1], [*shares[1:-1], len(start) - 1], strict=True),
            threads,
        )
        table = np.concatenate(parts)
        targets, left_out = _genuine(_targets(table, ground))
        is_target = np.zeros(len(start) - 1, bool)
        is_target[table[:, 16].astype(np.int64)] = True
        known = runs[np.repeat(is_target, np.diff(start))]
        return Detection(targets, ground, float(np.median(ground.sigma_dn)), _polarity(targets), left_out, reading, known)

    def better_reading(self, usual: Detection) -> Detection:
        """The reading of the background whose targets cover the greatest area, where a frame of two grey levels leaves a choice."""
        best, most = usual, MORE * max(_target_area(usual.targets), 0.0)
        whole, grown = _whole_ones(usual.targets).sum(), _target_area(usual.targets, GROWN_PX)
        for reading in ("dark", "bright"):
            if self.polarity == reading:  # bright targets do not stand on the bright parts
                continue
            other = _without_feeble(self.detected(reading))
            area, more = _target_area(other.targets), _whole_ones(other.targets).sum() > whole
            if area > most and (more or area > grown) and _two_levels(self.frame, other):
                best, most = other, area
        return best

    def with_faint_ones(self, found: Detection) -> Detection:
        """Add the targets that only a matched filter sees."""
        from pixmetry.locate.detect._background_kernels import Map
        from pixmetry.locate.detect._faint_kernels import measure_peaks
        from pixmetry.locate.detect.faint import faint_peaks

        ground, t = found.background, found.targets
        *ends, grain = scale_of(self.frame, self.low_dn, self.high_dn)
        margin = int(min(3 + 2 * float(np.median(t.blur_px)), FARTHEST_PX)) if len(t) else 0
        peaks = faint_peaks(self.frame, ground, found.known, self.polarity, self.false_alarms, grain, margin, self.threads)
        if peaks is None:
            return replace(found, blanked=True)
        if not len(peaks):
            return found
        table = measure_peaks(self.frame, peaks, Map(ground.level_dn, *ground.scales), (ends[0], ends[1]))
        new = _targets(table, ground)
        new = new[_apart(new, t)]
        both = Regions(**{f.name: np.concatenate([getattr(t, f.name), getattr(new, f.name)]) for f in fields(t)})
        both, left_out = _genuine(both)
        return replace(found, targets=both, polarity=_polarity(both), left_out=LeftOut.joined([found.left_out, left_out]))

    def without_coder(self, found: Detection) -> Detection:
        """Leave out what a coder of blocks draws, where the frame went through one: of little height, or close to a higher target."""
        coder = self.coder if not isinstance(self.coder, str) else coder_of(self.frame) if len(found.targets) else None
        if coder is None or not len(found.targets):
            return found
        highest = float(np.abs(found.targets.amplitude_dn).max())
        targets, left_out = _genuine(found.targets, min(max(CODED_RINGING, coder.ringing_dn / highest), MOST_RINGING))
        low = np.abs(targets.amplitude_dn) < coder_height_dn(self.frame, coder, found.background.image(), targets)
        left_out = LeftOut.joined([found.left_out, left_out, seen_at(targets[low], "no higher than what the coder draws into its blocks")])
        return replace(found, targets=targets[~low], polarity=_polarity(targets[~low]), left_out=left_out)


def _apart(new: Regions, known: Regions) -> np.ndarray:
    """Which of the new targets, the strongest first, hold the middle of no other one, nor lie in one; shape (n,), bool."""
    from pixmetry.locate.detect._faint_kernels import stand_apart

    names = ("x_px", "y_px", "row_first", "row_stop", "col_first", "col_stop")
    columns = [np.concatenate([getattr(known, name), getattr(new, name)]).astype(float) for name in names]
    apart: np.ndarray = stand_apart(np.stack(columns, axis=1), len(known))
    return apart


def _polarity(targets: Targets) -> str:
    bright, dark = bool((targets.amplitude_dn > 0).any()), bool((targets.amplitude_dn < 0).any())
    return "both" if bright and dark else "bright" if bright else "dark" if dark else "none"


def _without_feeble(found: Detection) -> Detection:
    """Leave out what is much lower than the largest target: between many targets the map of the ground has errors."""
    t = found.targets
    if not len(t):
        return found
    height = np.abs(t.amplitude_dn)
    feeble = height < FEEBLE * height[np.argmax(t.area_px * height)]
    left_out = LeftOut.joined([found.left_out, seen_at(t[feeble], "low, where targets cover most of the ground")])
    return replace(found, targets=t[~feeble], polarity=_polarity(t[~feeble]), left_out=left_out)


def _whole_ones(targets: Regions) -> np.ndarray:
    """Which targets are discs, ellipses or rings that the border does not cut; shape (n,), bool."""
    shaped = select(targets, "ellipse") | (select(targets, "ring") & (targets.holes == 1))  # the ground between targets has many
    whole: np.ndarray = shaped & (targets.flags & np.uint32(Flag.BORDER) == 0)
    return whole


def _target_area(targets: Regions, grown_px: float = 0.0) -> float:
    """Area of the whole targets, with outlines so much farther out, less that of all else, px²."""
    ring = math.pi * grown_px * (targets.semi_major_px + targets.semi_minor_px + grown_px)
    return float(np.where(_whole_ones(targets), targets.area_px + ring, -targets.area_px).sum())


def _two_levels(frame: np.ndarray, found: Detection) -> bool:
    """Whether the pixels of a frame have two levels, that of the ground and that of the targets, and not one distribution.

    The share of the variance that lies between the pixels above and below half the targets' height is 0.64 for a normal distribution and
    0.75 for an even one.
    """
    step = max(int(math.sqrt(frame.size / MOST_SEEN)), 1)
    y, x = (a.ravel().astype(float) for a in np.mgrid[: frame.shape[0] : step, : frame.shape[1] : step])
    height = (frame[::step, ::step].ravel() - found.background.at(x, y)[0]) / float(np.median(found.targets.amplitude_dn))
    high = height > 0.5
    share = float(high.mean())
    if not 0 < share < 1:
        return False
    between = share * (1 - share) * (float(height[high].mean()) - float(height[~high].mean())) ** 2
    return between > TWO_LEVELS * float(height.var())


def select(targets: Regions, kind: str) -> np.ndarray:
    """Return a mask of the targets whose shape can be that of a disc, ellipse, ring or spot; shape (n,), bool.

    Notes
    -----
    A disc, ellipse or spot is full: its fill is 1 up to its pixels and its noise, where a square has 0.955, a triangle 0.83 and two equal
    discs that touch 0.89. Seen at up to 70° from the normal, a disc is an ellipse of axes 1 : 2.9. A ring has a hole, and its moments and
    area give an outer ellipse that has the size of its box. What the frame's border cuts may be a segment of a disc, less full.
    """
    if kind not in KINDS:
        raise InputError("no such kind", value=kind, allowed=", ".join(KINDS))
    cut = (targets.flags & Flag.BORDER) != 0
    full = targets.fill > _least_fill(targets) - np.where(cut, CUT_FILL, 0.0)
    slim = targets.semi_major_px > LARGEST_RATIO * targets.semi_minor_px
    shaped = _fits_box(targets) & ~slim
    return shaped & ~full & (targets.holes > 0) if kind == "ring" else shaped & full


def neighbours(targets: Targets, reach_px: np.ndarray | float, light_px: np.ndarray | float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Find for each target the others that count for it: those whose boxes are within its reach, or their light within half of that.

    Each has a reach and a light of its own, so that one blurred target does not give all others many neighbours.

    Parameters
    ----------
    targets : Targets
    reach_px : float or ndarray, shape (n,)
    light_px : float or ndarray, shape (n,)
        How far a target's light goes beyond its box.

    Returns
    -------
    start : ndarray, shape (n + 1,), int64
    index : ndarray, int64
        Those of target i are ``index[start[i]:start[i + 1]]``, ascending.
    """
    from pixmetry.locate.detect._detect_kernels import boxes_in_reach

    box = np.stack([targets.row_first, targets.row_stop, targets.col_first, targets.col_stop], axis=1).astype(np.int64).reshape(-1, 4)
    reach, light = (np.nan_to_num(np.broadcast_to(np.asarray(far, float), len(box))) for far in (reach_px, light_px))
    return boxes_in_reach(box, reach, light)


def _least_fill(targets: Regions) -> np.ndarray:
    noise = (targets.sigma_dn / targets.amplitude_dn) ** 2
    least: np.ndarray = 0.975 - 1.5 / targets.area_px - 2 * noise
    return least


def _fits_box(targets: Regions) -> np.ndarray:
    """Whether the ellipse of a target is as wide and as high as its box."""
    turn = np.radians(targets.angle_deg)
    cosine, sine = np.cos(turn), np.sin(turn)
    wide = 2 * np.hypot(targets.semi_major_px * cosine, targets.semi_minor_px * sine)
    high = 2 * np.hypot(targets.semi_major_px * sine, targets.semi_minor_px * cosine)
    gaps = np.abs(targets.col_stop - targets.col_first - wide), np.abs(targets.row_stop - targets.row_first - high)
    fits: np.ndarray = np.maximum(*gaps) < 1.5 + 0.15 * np.minimum(wide, high)
    return fits


def _genuine(targets: Regions, ringing: float = RINGING) -> tuple[Regions, LeftOut]:
    """Leave out false targets that other targets cause; what is the same target found twice is not told."""
    from pixmetry.locate.detect._region_kernels import GLARE, REACH, Outlines, spurious

    t = targets
    box = np.stack([t.row_first, t.row_stop, t.col_first, t.col_stop], axis=1)
    outlines = Outlines(t.x_px, t.y_px, t.semi_major_px, t.semi_minor_px, t.angle_deg, t.blur_px, t.amplitude_dn, box)
    cause = spurious(outlines, *neighbours(t, REACH), ringing)
    if not cause.any():
        return t, LeftOut.of()
    return t[cause == 0], seen_at(t[cause == GLARE], "a halo, or the ringing of a coder, beside a target")


def seen_at(targets: Targets, reason: str) -> LeftOut:
    """Return targets as what was left out for a reason."""
    return LeftOut.of(targets.x_px, targets.y_px, reason, targets.semi_major_px, targets.amplitude_dn)


def _targets(table: np.ndarray, ground: Background) -> Regions:
    x, y = table[:, 0].copy(), table[:, 1].copy()
    level, slope_x, slope_y = ground.at(x, y)
    box = table[:, 7:11].astype(np.int64)
    return Regions(
        x_px=x, y_px=y, semi_major_px=table[:, 2].copy(), semi_minor_px=table[:, 3].copy(), angle_deg=table[:, 4].copy(),
        blur_px=table[:, 5].copy(), amplitude_dn=table[:, 6] * table[:, 15], background_dn=level, background_x_dn_per_px=slope_x,
        background_y_dn_per_px=slope_y, sigma_dn=ground.sigma(x, y), row_first=box[:, 0], row_stop=box[:, 1], col_first=box[:, 2],
        col_stop=box[:, 3], flags=table[:, 14].astype(np.uint32), area_px=table[:, 11].copy(), fill=table[:, 12].copy(),
        holes=table[:, 13].astype(np.int64),
    )  # fmt: skip
