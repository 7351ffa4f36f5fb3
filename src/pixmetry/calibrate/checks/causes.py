"""Which of the patterns in the residuals explain them, and what may have made these.

Patterns overlap: a sensor that is not flat also shows residuals that depend on the radius, on the column and on the place. They are
chosen one after the other by what they explain beside those chosen before, each term weighed against the number of observations
(G. Schwarz, Annals of Statistics 6 (1978) 461–464). A difference of 10 in this measure is strong evidence (R. E. Kass, A. E. Raftery,
J. Am. Stat. Assoc. 90 (1995) 773–795).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from pixmetry.calibrate.checks.added_terms import AddedTerms, Normals

STRONG = 10.0  # difference of 2 ln of the evidence from which on one explanation is named alone
ANALOGUE, DIGITAL = "analogue", "digital"


@dataclass(frozen=True)
class Candidate:
    """A pattern as terms: their derivatives as of `AddedTerms.test`, and of how many such patterns it is the best."""

    name: str
    columns: Any
    out_of: int = 1


@dataclass(frozen=True)
class Place:
    """A pattern among the others.

    Parameters
    ----------
    gain : float
        What it explains beside those chosen before, as a difference of Schwarz's criterion.
    rivals : tuple of str
        Patterns that explain the same nearly as well, or better.
    behind : str
        The pattern beside which it explains least; empty: it was chosen.
    p_left : float
        Of an F-test beside all that were chosen, of a pattern that was not.
    """

    gain: float
    rivals: tuple[str, ...] = ()
    behind: str = ""
    p_left: float = 1.0


def places_of(terms: AddedTerms, candidates: Sequence[Candidate]) -> dict[str, Place]:
    """Choose among patterns that were found, forwards.

    Parameters
    ----------
    terms : AddedTerms
    candidates : sequence of Candidate
        All of one camera, with different names.

    Returns
    -------
    dict
        `Place` by name; those chosen come first, in their order.
    """
    if not candidates:
        return {}
    blocks = [terms.as_rows(one.columns) for one in candidates]
    ends = np.cumsum([0, *(block.shape[1] for block in blocks)])
    parts = {one.name: np.arange(a, b) for one, a, b in zip(candidates, ends[:-1], ends[1:], strict=True)}
    out_of, adjustment = {one.name: one.out_of for one in candidates}, terms.adjustment
    return chosen_among(terms.normals(_side_by_side(blocks)), parts, out_of, adjustment.sigma0**2 * adjustment.dof, float(adjustment.dof))


def chosen_among(
    normals: Normals, parts: Mapping[str, np.ndarray], out_of: Mapping[str, int], squares: float, dof: float
) -> dict[str, Place]:
    """The same by the normal equations of all candidates together: the numbers of each one's terms, and of how many it is the best."""
    model = _Explained(normals, parts, out_of, squares, dof)
    left = list(parts)
    chosen: list[str] = []
    found: dict[str, Place] = {}
    while left:
        gains = {name: model.gain(name, chosen) for name in left}
        best = max(left, key=lambda name: gains[name])
        if chosen and gains[best] <= STRONG:
            break
        rest = [name for name in left if name != best]
        close = [name for name in rest if gains[best] - gains[name] < STRONG and model.gain(name, [*chosen, best]) <= STRONG]
        found[best] = Place(gains[best], tuple(sorted(close, key=lambda name: -gains[name])))
        chosen.append(best)
        left = rest
    for name in left:
        alone = {other: model.gain(name, [other]) for other in chosen}
        found[name] = Place(model.gain(name, chosen), (), min(alone, key=lambda other: alone[other]), model.p(name, chosen))
    return found


@dataclass(frozen=True)
class _Explained:
    """The reduced normal equations of all candidates together."""

    normals: Normals
    parts: Mapping[str, np.ndarray]
    out_of: Mapping[str, int]
    squares: float
    dof: float
    falls: dict[frozenset[str], tuple[float, int]] = field(default_factory=dict)

    def gain(self, name: str, beside: Sequence[str]) -> float:
        """2 ln of the evidence for a pattern beside others."""
        before, rank = self._fall(beside)
        after, more = self._fall([*beside, name])
        if more == rank:
            return 0.0
        floor = 1e-12 * self.squares
        ratio = max(self.squares - before, floor) / max(self.squares - after, floor)
        return float(self.dof * np.log(ratio) - (more - rank) * np.log(self.dof) - 2 * np.log(self.out_of[name]))

    def p(self, name: str, beside: Sequence[str]) -> float:
        """Of an F-test of a pattern beside others."""
        from scipy import stats

        before, rank = self._fall(beside)
        after, more = self._fall([*beside, name])
        if more <= rank or self.dof <= more:
            return 1.0
        variance = max(self.squares - after, 1e-12 * self.squares) / (self.dof - more)
        return float(stats.f.sf((after - before) / (more - rank) / variance, more - rank, self.dof - more))

    def _fall(self, names: Sequence[str]) -> tuple[float, int]:
        if not names:
            return 0.0, 0
        which = frozenset(names)
        if which not in self.falls:
            solved = self.normals.of(np.concatenate([self.parts[name] for name in self.parts if name in which])).solved()
            self.falls[which] = solved.fall, solved.rank
        return self.falls[which]


def _side_by_side(blocks: Sequence[Any]) -> Any:
    from scipy import sparse

    if any(sparse.issparse(block) for block in blocks):
        return sparse.hstack([sparse.csr_matrix(block) for block in blocks]).tocsr()
    return np.hstack(blocks)


READ_OUT = ("sensor.rolling_shutter", "rows that are read one after the other while something moves")
SCALED = ("", "targets whose distance beats with the pixels, or pictures that software has scaled")
# what makes a pattern on analogue cameras alone, and what may look so on a digital one: sources (or none), and words
ON_DIGITAL = {
    "rows_x": (READ_OUT,),
    "columns_x": (("", "pictures that software has scaled or warped"),),
    "wave_xx": (SCALED,),
    "wave_xy": (SCALED,),
    "x_scale_trend": (READ_OUT, ("", "pictures that software has scaled")),
    "x_scale_by_image": (READ_OUT, ("", "pictures that software has scaled")),
    "x_shift_by_image": (
        ("sensor.mount_drift", "a sensor or lens that moves between the images"),
        ("", "a test field that is not as it is said to be"),
    ),
}
SOURCES = {  # in words
    "optics.distortion": "lens distortion beyond the terms that were estimated",
    "sensor.unflatness": "a sensor that is not flat",
    "sensor.pixel_geometry": "small-scale irregularities of pixels, lens or board",
    "grabber.line_jitter": "lines that a frame grabber starts at different positions",
    "grabber.sampling_clock": "samples that are not evenly spaced along a line",
    "grabber.phase_pattern": "interference from the sampling clock",
    "sensor.pixel_aperture": "pixels that are too coarse for the images of the targets",
    "grabber.clock_warm_up": "a frame grabber whose clock warms up",
    "sensor.mount_drift": "a sensor or lens that moves while it warms up",
    "sensor.thermal_expansion": "a camera that expands while it warms up",
    "sensor.rolling_shutter": "rows that are read one after the other while something moves",
}


@dataclass(frozen=True)
class Cause:
    """What may have made a pattern: a source of the catalogue (empty: none), and words."""

    source: str
    words: str

    @property
    def text(self) -> str:
        """As a sentence names it."""
        return f"{self.words}, {self.source}" if self.source else self.words


def causes_of(pattern: str, source: str, interface: str | None) -> tuple[Cause, ...]:
    """What may have made a pattern, as far as the camera is known.

    Parameters
    ----------
    pattern : str
    source : str
        Of the catalogue, on a camera of any kind; empty: none.
    interface : {"digital", "analogue"} or None
        None: not told.

    Examples
    --------
    >>> [cause.source for cause in causes_of("x_scale_trend", "grabber.clock_warm_up", "digital")]
    ['sensor.rolling_shutter', '']
    >>> [cause.source for cause in causes_of("x_scale_trend", "grabber.clock_warm_up", None)]
    ['grabber.clock_warm_up', 'sensor.rolling_shutter', '']
    """
    if not source:
        return ()
    if not source.startswith("grabber."):
        return (Cause(source, SOURCES[source]),)
    others = tuple(Cause(*one) for one in ON_DIGITAL[pattern])
    if interface == DIGITAL:
        return others
    own = Cause(source, SOURCES[source])
    return (own,) if interface == ANALOGUE else (Cause(source, f"on an analogue camera {own.words}"), *others)
