"""Coded targets: a disc in a ring of twelve segments, each printed or not, that number the target.

The scheme is that of C.-T. Schneider and K. Sinnreich, "Optical 3-D measurement systems for quality control in industry", Int. Archives
of Photogrammetry and Remote Sensing XXIX-B5, 56 (1992): the ring is read as a cyclic binary word, and the number is the least of its
rotations, so that a target needs no upright position. Here the printed segments are even in number, so that one misread segment never
makes another code. Rings of other numbers of segments, with radii of 1 : 2 : 3, are those of the expired patent DE 197 33 466 A1 too, which
moreover wants a pair of opposite segments: its codes are some of these. Segment k, clockwise from the first, is bit k of the word; programs
that begin with the highest bit have other numbers for the same rings, and so have those that count their codes.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np

from pixmetry.core.arguments import choice
from pixmetry.core.errors import InputError
from pixmetry.core.threads import map_tiles

# Radii in units of the disc's: white or black (the colour of the background) from DISC to RING_INNER and from RING_OUTER to QUIET_OUTER.
DISC, RING_INNER, RING_OUTER, QUIET_OUTER = 1.0, 2.0, 3.0, 4.0
BITS = 12
RINGS_OF_12 = "RING_12"
RINGS = ("RING_8", "RING_12", "RING_14", "RING_16", "RING_20")  # by their segments: what is in use
SAMPLES = 12  # directions a segment
INSIDE = slice(2, SAMPLES - 2)  # of them, those away from the segment's ends
RING_RADII, QUIET_RADIUS, OUTER_RADIUS = (2.3, 2.5, 2.7), 1.5, 3.5
LEAST_MARGIN = 0.3
LEAST_MORE = 1.25  # codes of another set, over those that were read, from which it is the right one
MOST_OUTSIDE = 0.4  # of the disc's contrast: more is not quiet
NOWHERE_PX = -1e6  # where targets without a position are put
CHUNK = 128


@dataclass(frozen=True)
class Codes:
    """Codes of the rings around targets, arrays of shape (n,).

    Parameters
    ----------
    number : ndarray of int
        Number of the code, −1 where there is none or it cannot be trusted.
    margin : ndarray
        How clearly the least clear segment was read: 1 when it has the full grey value of the disc or of the background, 0 half-way
        between. NaN where the ring leaves the frame.
    """

    number: np.ndarray
    margin: np.ndarray


def segments_of(dictionary: str) -> int:
    """Segments a ring of a set of codes by its name: 14 of RING_14.

    Raises
    ------
    InputError
        If there is no such set.
    """
    return int(choice(dictionary, RINGS, "dictionary", "no such rings of coded targets").removeprefix("RING_"))


@cache
def codes(bits: int = BITS) -> tuple[int, ...]:
    """Return all numbers in use, ascending: the least rotations of the words with an even number of ones, but neither none nor all.

    Raises
    ------
    InputError
        If the ring has fewer than 6 or more than 20 segments.
    """
    if not 6 <= bits <= 20:
        raise InputError("no such ring", where="bits", value=bits, allowed="6 to 20 segments")
    words = np.arange(1, 2**bits - 1)
    words = words[_ones(words, bits) % 2 == 0]
    return tuple(int(w) for w in np.unique(least_rotation(words, bits)))


def least_rotation(words: np.ndarray, bits: int = BITS) -> np.ndarray:
    """Return the smallest number among the cyclic shifts of each word, same shape."""
    words = np.asarray(words, np.int64)
    least, turned = words.copy(), words
    for _ in range(bits - 1):
        turned = (turned >> 1) | ((turned & 1) << (bits - 1))
        least = np.minimum(least, turned)
    return least


def read_codes(
    frame: np.ndarray,
    x_px: np.ndarray,
    y_px: np.ndarray,
    semi_major_px: np.ndarray,
    semi_minor_px: np.ndarray,
    angle_deg: np.ndarray,
    amplitude_dn: np.ndarray,
    *,
    bits: int = BITS,
    least_margin: float = LEAST_MARGIN,
    threads: int | None = None,
) -> Codes:
    """Read the ring about each target.

    Parameters
    ----------
    frame : ndarray, shape (rows, cols), uint8, uint16 or float32, DN
    x_px, y_px, semi_major_px, semi_minor_px, angle_deg : ndarray, shape (n,)
        The discs' outlines: ellipses. A perspective view of a target is so nearly an affine one that its ring follows from its disc.
    amplitude_dn : ndarray, shape (n,)
        Height of the disc over its background, negative for dark discs. Segments have the disc's colour.
    bits : int
        Segments a ring.
    least_margin : float
        0 … 1; a code with a less clear segment is not given.

    Returns
    -------
    Codes

    Notes
    -----
    The ring's profile over the direction is cut into segments at the phase that makes them clearest. A segment reads
    v = (ring − background)/amplitude, the background being mean and first harmonic of the zone inside the ring, so that uneven light does
    not matter; v > ½ is a one. A code is given if every |2v − 1| exceeds the least margin, the zones inside and outside the ring are
    quiet, ones are even in number, and neither none nor all are set. With mirrored pictures the words, and so the numbers, are others.
    """
    from pixmetry.locate.detect._detect_kernels import sample_rings

    x, y, a, b, amplitude = (np.ascontiguousarray(v, float).ravel() for v in (x_px, y_px, semi_major_px, semi_minor_px, amplitude_dn))
    angle = np.radians(np.ascontiguousarray(angle_deg, float).ravel())
    radii, directions = np.array([*RING_RADII, QUIET_RADIUS, OUTER_RADIUS]), 2 * np.pi * np.arange(bits * SAMPLES) / (bits * SAMPLES)
    rings = np.full((len(x), len(radii), len(directions)), np.nan)

    def sample(start: int) -> None:
        sample_rings(frame, x, y, a, b, angle, radii, directions, start, min(start + CHUNK, len(x)), rings)

    map_tiles(sample, range(0, len(x), CHUNK), threads)
    with np.errstate(invalid="ignore", divide="ignore"):
        background = _smooth(rings[:, -2])
        ring, inside, outside = ((r - background) / amplitude[:, None] for r in (rings[:, :-2].mean(axis=1), rings[:, -2], rings[:, -1]))
    segment = _segments(ring, bits)
    margin = np.abs(2 * segment - 1).min(axis=1)
    word = ((segment > 0.5) << np.arange(bits)).sum(axis=1)
    quiet = [np.abs(zone.reshape(-1, bits, SAMPLES).mean(axis=2)).max(axis=1) < MOST_OUTSIDE for zone in (inside, outside)]
    ones = _ones(word, bits)
    good = (margin >= least_margin) & quiet[0] & quiet[1] & (ones % 2 == 0) & (ones > 0) & (ones < bits)
    return Codes(np.where(good, least_rotation(word, bits), -1), margin)


def other_rings(
    frame: np.ndarray,
    x_px: np.ndarray,
    y_px: np.ndarray,
    semi_major_px: np.ndarray,
    semi_minor_px: np.ndarray,
    angle_deg: np.ndarray,
    amplitude_dn: np.ndarray,
    number: np.ndarray,
    bits: int,
    threads: int | None = None,
) -> tuple[str, int]:
    """The set of codes that more of the targets have than the one that was read, and how many; ("", 0) where there is none.

    A ring of few segments may pass for one of fewer or more; over several targets the right set has more codes, and clearer ones.

    Parameters
    ----------
    frame, x_px, y_px, semi_major_px, semi_minor_px, angle_deg, amplitude_dn, threads
        As of `read_codes`.
    number : ndarray of int, shape (n,)
        What it read.
    bits : int
        Segments for which it did.
    """
    ellipses = x_px, y_px, semi_major_px, semi_minor_px, angle_deg, amplitude_dn
    counts = {name: int((read_codes(frame, *ellipses, bits=segments_of(name), threads=threads).number >= 0).sum()) for name in RINGS}
    best = max(counts, key=lambda name: counts[name])
    more = counts[best] >= LEAST_MORE * int((number >= 0).sum()) and counts[best] > 1
    return (best, counts[best]) if segments_of(best) != bits and more else ("", 0)


def ring_members(
    x_px: np.ndarray, y_px: np.ndarray, semi_major_px: np.ndarray, semi_minor_px: np.ndarray, angle_deg: np.ndarray, number: np.ndarray
) -> np.ndarray:
    """Which targets are segments of another one's ring, boolean, shape (n,): those that lie between a decoded disc and its ring's end.

    Parameters
    ----------
    x_px, y_px, semi_major_px, semi_minor_px, angle_deg : ndarray, shape (n,)
        Of all targets.
    number : ndarray of int, shape (n,)
        From `read_codes`; −1 for targets without a code.
    """
    from scipy.spatial import cKDTree

    place = np.nan_to_num(np.stack([x_px, y_px], axis=1), nan=NOWHERE_PX)
    member = np.zeros(len(place), bool)
    tree = cKDTree(place)
    for i in np.flatnonzero(number >= 0):
        near = np.array(tree.query_ball_point(place[i], RING_OUTER * semi_major_px[i]))
        c, s = np.cos(np.radians(angle_deg[i])), np.sin(np.radians(angle_deg[i]))
        dx, dy = (place[near] - place[i]).T
        radius = np.hypot((c * dx + s * dy) / semi_major_px[i], (c * dy - s * dx) / semi_minor_px[i])
        member[near[(radius > DISC) & (radius < RING_OUTER) & (near != i)]] = True
    return member


def code_svg(number: int, disc_mm: float = 10.0, *, bits: int = BITS, bright: bool = True, label: bool = True) -> str:
    """Draw a target for printing, as the text of an SVG file in millimetres.

    Parameters
    ----------
    number : int
        One of `codes`.
    disc_mm : float
        Diameter of the disc. The ring's inner and outer diameters are 2 and 3 times as large; a square of 4 times its size is left around.
    bright : bool
        White on black, else black on white.
    label : bool
        Write the number into the corner.

    Raises
    ------
    InputError
        If the number is not one in use, or the disc has no size.
    """
    if number not in codes(bits):
        raise InputError("not a code in use", where="number", value=number, allowed=f"one of codes({bits})")
    if not (np.isfinite(disc_mm) and disc_mm > 0):
        raise InputError("the disc has no size", where="disc_mm", value=disc_mm, allowed="more than 0 mm")
    ink, paper = ("white", "black") if bright else ("black", "white")
    r = disc_mm / 2
    half, inner, outer = QUIET_OUTER * r, RING_INNER * r, RING_OUTER * r
    shapes = [f'<circle r="{r:.6g}"/>']
    for bit in range(bits):
        if number >> bit & 1:
            first, last = 2 * np.pi * bit / bits, 2 * np.pi * (bit + 1) / bits
            (x0, y0), (x1, y1) = ((np.cos(t), np.sin(t)) for t in (first, last))
            shapes.append(
                f'<path d="M{inner * x0:.6f} {inner * y0:.6f}L{outer * x0:.6f} {outer * y0:.6f}'
                f"A{outer:.6g} {outer:.6g} 0 0 1 {outer * x1:.6f} {outer * y1:.6f}L{inner * x1:.6f} {inner * y1:.6f}"
                f'A{inner:.6g} {inner:.6g} 0 0 0 {inner * x0:.6f} {inner * y0:.6f}Z"/>'
            )
    if label:
        corner = f'x="{-0.96 * half:.6g}" y="{0.96 * half:.6g}"'
        shapes.append(f'<text {corner} font-family="sans-serif" font-size="{0.4 * r:.6g}">{number}</text>')
    size, edge = f"{2 * half:.6g}", f"{-half:.6g}"
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{size}mm" height="{size}mm" viewBox="{edge} {edge} {size} {size}">'
        f'<title>coded target {number} of {bits} segments</title><rect x="{edge}" y="{edge}" width="{size}" height="{size}" '
        f'fill="{paper}"/><g fill="{ink}">{"".join(shapes)}</g></svg>\n'
    )


def _ones(words: np.ndarray, bits: int) -> np.ndarray:
    ones: np.ndarray = (words[..., None] >> np.arange(bits) & 1).sum(axis=-1)
    return ones


def _smooth(ring: np.ndarray) -> np.ndarray:
    """Mean and first harmonic over the direction."""
    spectrum = np.fft.rfft(ring, axis=1)
    spectrum[:, 2:] = 0
    return np.fft.irfft(spectrum, ring.shape[1], axis=1)


def _segments(ring: np.ndarray, bits: int) -> np.ndarray:
    """Means of the segments, shape (n, bits), at the phase for which they are farthest from ½ in the mean."""
    best, clearest = np.full((len(ring), bits), np.nan), np.full(len(ring), -1.0)
    for phase in range(SAMPLES):
        means = np.roll(ring, -phase, axis=1).reshape(-1, bits, SAMPLES)[:, :, INSIDE].mean(axis=2)
        clear = np.abs(means - 0.5).mean(axis=1)
        better = clear > clearest
        best[better], clearest[better] = means[better], clear[better]
    return best
