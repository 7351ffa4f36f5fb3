"""The experiments that pixmetry knows: one for each kind of pictures that a manifest may list (``files.records.TARGETS``)."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np

from pixmetry.camera.observations import Observations
from pixmetry.observe.active_area import reduce_borders
from pixmetry.observe.dark_temperature import reduce_dark_temperatures
from pixmetry.observe.edge_fit import fit_edges
from pixmetry.observe.edges import Picture, Search, edge_notes, motion_notes, responses_of, search_edges
from pixmetry.observe.experiment import Experiment, PictureGroup
from pixmetry.observe.focus import focus_of
from pixmetry.observe.jpeg_blocks import FirstFrames, reduce_patterns
from pixmetry.observe.laser_spots import SpotCrops, reduce_speckle
from pixmetry.observe.lens_fit import with_other_lens
from pixmetry.observe.light_off import BlockMeans, reduce_light_off
from pixmetry.observe.line_fit import fit_line
from pixmetry.observe.line_jitter import with_jitter
from pixmetry.observe.lines import LineFrames, places_of_rows
from pixmetry.observe.patches import find_patches
from pixmetry.observe.response_fit import response_of, with_response
from pixmetry.observe.sequence import SequenceSums, reduce_sequences
from pixmetry.observe.spots import reduce_spots

BLUR_AT = 12  # of the frequencies of edges: 0.24 cycles/px, where their blur is compared


def reduce_edges(groups: Sequence[PictureGroup], seen: Observations) -> Observations:
    """Find and fit the slanted edges of pictures."""
    seen = _with_wavelength(groups, seen)
    pictures = [Picture.of(g.kind, g.moments, g.bits) for g in groups]
    analogue = seen.stated.interface == "analogue"
    whole = search_edges(pictures, analogue)
    focus_um = [float("nan") if g.facts.focus_um is None else g.facts.focus_um for g in groups]
    search, sharp = _in_focus(whole, focus_um)
    if analogue:
        line, optics = fit_line(search.measured, own_clock=seen.stated.own_clock)
        edges = responses_of(search, optics, line)
    else:
        optics = fit_edges(search.measured)
        if seen.stated.pitch_x_um == seen.stated.pitch_y_um:
            optics = with_other_lens(optics, search.measured)
        edges = responses_of(search, optics)
    if np.isfinite(focus_um).any():
        every = responses_of(whole)
        focus = focus_of(every.edges, every.frequency, focus_um, pictures[0].data.shape, seen.stated)
        seen = replace(seen, focus=focus, notes=(*seen.notes, *sharp))
    return replace(seen, edges=edges, notes=(*seen.notes, *edge_notes(edges), *motion_notes(pictures, whole)))


def _in_focus(found: Search, focus_um: Sequence[float]) -> tuple[Search, tuple[str, ...]]:
    """The edges of the sharpest setting of the focus, for what they have in common; those of pictures that state none too."""
    settings = sorted({f for f in focus_um if np.isfinite(f)})
    if len(settings) < 2:
        return found, ()
    blur = {f: [float(s.modulus[BLUR_AT]) for r, s in found.measured if focus_um[r.picture] == f] for f in settings}
    best = max(settings, key=lambda f: float(np.median(blur[f])) if blur[f] else -1.0)
    kept = tuple(one for one in found.measured if not np.isfinite(focus_um[one[0].picture]) or focus_um[one[0].picture] == best)
    note = f"of {len(settings)} settings of the focus the sharpest, {best:g} µm, tells lens and pixel"
    return replace(found, measured=kept), (note,)


def _with_wavelength(groups: Sequence[PictureGroup], seen: Observations) -> Observations:
    """The wavelength of the edges, which are fitted together, in place of that of the campaign; a note if they have several."""
    told = {g.facts.wavelength_nm or seen.stated.wavelength_nm for g in groups}
    if len(told) == 1:
        return replace(seen, stated=replace(seen.stated, wavelength_nm=told.pop()))
    listed = ", ".join(f"{nm:g} nm" if nm else "not stated" for nm in sorted(told, key=lambda nm: nm or 0.0))
    what = f"edges in light of several wavelengths ({listed}) are fitted together"
    return replace(seen, notes=(*seen.notes, f"{what}: take those of one wavelength for the f-number of the lens"))


def reduce_charts(groups: Sequence[PictureGroup], seen: Observations) -> Observations:
    """Fit the response to the patches of charts."""
    found = find_patches(groups)
    return with_response(seen, response_of(found, groups[0].bits, seen))


def reduce_lines(groups: Sequence[PictureGroup], seen: Observations) -> Observations:
    """Follow upright lines row by row and frame by frame, and fit what the rows have in common."""
    fit = seen.photon_transfer_fit
    gain = fit["gain_dn_per_e"].value if fit is not None and "gain_dn_per_e" in fit else None
    lines = with_jitter(places_of_rows(groups, gain))
    return replace(seen, lines=lines, notes=(*seen.notes, *lines.notes))


def reduce_covered(groups: Sequence[PictureGroup], seen: Observations) -> Observations:
    """Nothing by themselves: their covered borders are reduced with those of all other frames (`pixmetry.observe.covered`)."""
    return seen


EXPERIMENTS = {
    e.kind: e
    for e in (
        Experiment("edge", reduce_edges),
        Experiment("light_off", reduce_light_off, BlockMeans),
        Experiment("chart", reduce_charts),
        Experiment("line", reduce_lines, LineFrames),
        Experiment("covered", reduce_covered),
        Experiment("spots", reduce_spots),
        Experiment("pattern", reduce_patterns, FirstFrames),
        Experiment("dark_temperature", reduce_dark_temperatures),
        Experiment("border", reduce_borders),
        Experiment("speckle", reduce_speckle, SpotCrops),
        Experiment("sequence", reduce_sequences, SequenceSums),
    )
}


def reduce_pictures(groups: Iterable[PictureGroup], seen: Observations) -> Observations:
    """Reduce the pictures of all kinds, in the order of ``EXPERIMENTS``."""
    groups = tuple(groups)
    for kind, experiment in EXPERIMENTS.items():
        own = [g for g in groups if g.kind == kind]
        if own:
            seen = experiment.reduce(own, seen)
    return seen
