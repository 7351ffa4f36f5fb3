"""From a campaign's frames to the data sheet of a camera by EMVA 1288, and to its files."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from pixmetry.camera.observations import StackMoments
from pixmetry.core.arguments import typed
from pixmetry.core.errors import InputError, MeasureError
from pixmetry.core.progress import Progress, no_progress
from pixmetry.core.threads import imap_tiles, map_tiles, single_threaded_blas
from pixmetry.emva.files.keys import KEYS
from pixmetry.emva.files.sheets import check_names, named, write_files
from pixmetry.emva.records import MONO, RELEASES, DataSheet, Measurement, Results
from pixmetry.emva.reduction import Group, measure_frames, phases
from pixmetry.files import Campaign, FrameReader, InputHashes, load_campaign, provenance_record
from pixmetry.files.records import FrameGroup


@dataclass(frozen=True)
class Options:
    """How a campaign is tested; as the parameters of `emva1288`."""

    release: str = "4.0"
    bayer: str | None = None
    photons_u_rel: float = 0.0
    bootstrap: int = 0

    def __post_init__(self) -> None:
        if self.release not in RELEASES:
            raise InputError("no such release", where="release", value=self.release, allowed=", ".join(RELEASES))
        if not 0 <= self.photons_u_rel < 1:
            raise InputError("not a relative uncertainty", where="photons_u_rel", value=self.photons_u_rel, allowed="0 to below 1")
        if self.bootstrap != 0 and not 100 <= self.bootstrap <= 1_000_000:
            raise InputError("not a number of draws", where="bootstrap", value=self.bootstrap, allowed="0, or 100 to 1000000")


@partial(typed, but=("campaign",))  # of arrays it says more
def emva1288(
    campaign: str | Path | Campaign | None = None,
    *,
    release: str = "4.0",
    bayer: str | None = None,
    photons_u_rel: float = 0.0,
    bootstrap: int = 0,
    progress: Progress | None = None,
    json: str | Path | None = None,
    xml: str | Path | None = None,
    report: str | Path | None = None,
    pdf: str | Path | None = None,
) -> DataSheet:
    """Test a camera by EMVA 1288.

    Parameters
    ----------
    campaign : path, Campaign or None
        An EMVA 1288 descriptor, a manifest, a folder with one of them, or None for the packaged example.
    release : {"4.0", "3.1", "reference"}
        The standard's release, or what the public reference implementation 1.0.2 computes.
    bayer : {"RGGB", "BGGR", "GRBG", "GBRG"}, optional
        The colour filter of a mosaic camera, if the manifest does not say; its phases are tested one by one.
    photons_u_rel : float
        Relative standard uncertainty of the photon counts, common to all levels.
    bootstrap : int
        Draws of a bootstrap over frames and levels that gives u in place of the sampling laws; 0 for none.
    progress : callable, optional
        Called with (what, done, of).
    json, xml, report, pdf : path, optional
        Files for the results: JSON, the public XML format, a page (HTML), and the data sheet as PDF.

    Returns
    -------
    DataSheet

    Raises
    ------
    InputError, MeasureError
        If a file or the campaign cannot be used, or the frames do not carry what the standard asks for.

    Examples
    --------
    >>> sheet = emva1288()  # the packaged example
    >>> gain = sheet.results[0].values["K"]
    >>> 0.1 < gain.value < 1 and gain.u < 0.02 * gain.value
    True
    """
    options = Options(release, bayer, photons_u_rel, bootstrap)
    files = named(json=json, xml=xml, report=report, pdf=pdf)
    check_names(files)  # before anything is read
    frames = campaign if isinstance(campaign, Campaign) else load_campaign(campaign)
    check_names(files, frames.files)
    sheet = tested(frames, options, progress)
    write_sheet(sheet, files, frames.files, progress)
    return sheet


def tested(campaign: Campaign, options: Options, progress: Progress | None = None) -> DataSheet:
    """Measure and evaluate one campaign; errors as of `emva1288`."""
    with campaign.named_in_errors():
        measured, hashes = measure_campaign(
            campaign, bayer=options.bayer, products=options.bootstrap > 0, photons_u_rel=options.photons_u_rel, progress=progress
        )
        if options.bayer is not None:
            campaign = replace(campaign, camera=replace(campaign.camera, cfa=options.bayer))
        return make_sheet(campaign, measured, hashes, release=options.release, bootstrap=options.bootstrap, progress=progress)


def write_sheet(sheet: DataSheet, files: dict[str, Path], inputs: Sequence[Path], progress: Progress | None = None) -> None:
    """Write the wanted files, if any, with word of progress; as `pixmetry.emva.files.sheets.write_files`."""
    if files:
        told = progress or no_progress
        told("writing the results", 0, 1)
        write_files(sheet, files, inputs)
        told("writing the results", 1, 1)


def measure_campaign(
    campaign: Campaign,
    *,
    bayer: str | None = None,
    products: bool = False,
    photons_u_rel: float = 0.0,
    progress: Progress | None = None,
) -> tuple[tuple[Measurement, ...], InputHashes]:
    """Read the frames of a campaign, each file once unless products are asked for, and reduce them in threads.

    Parameters
    ----------
    campaign : Campaign
    bayer : str, optional
        Colour filter; by default that of the campaign's camera.
    products : bool
        Also the products of the frames of the two stacks, which a bootstrap needs; the files of the stacks are then read once more for
        each channel.
    photons_u_rel : float
        Relative standard uncertainty of the photon counts.
    progress : callable, optional
        Called with (what, done, of).

    Returns
    -------
    tuple
        One Measurement for each channel, and the digests of the files.

    Raises
    ------
    InputError, MeasureError
        As from `measure_frames`.
    """
    facts, done = campaign.camera, 0

    def on_frames(count: int) -> None:
        nonlocal done
        done += count
        if progress is not None:
            progress("reading frames", done, sum(len(g.paths) for g in campaign.field_groups))

    reader = FrameReader(campaign)

    def groups() -> Iterator[Group]:
        for g in campaign.field_groups:
            yield Group(g.kind, g.role, g.exposure_s, g.photons, [partial(reader.fetch, path) for path in g.paths])

    cfa = bayer or facts.cfa
    area = None if facts.pitch_x_um is None or facts.pitch_y_um is None else facts.pitch_x_um * facts.pitch_y_um
    found = measure_frames(groups(), campaign.bits, cfa=cfa, pixel_area_um2=area, photons_u_rel=photons_u_rel, on_frames=on_frames)
    notes, (rows, cols) = list(campaign.findings), campaign.frame_shape
    if bayer is not None and facts.cfa not in (None, bayer):
        notes.append(f"the colour filter is taken as {bayer}, not {facts.cfa} as stated")
    if cfa is not None and (rows % 2 or cols % 2):
        notes.append(f"frames of {cols} x {rows} pixels do not contain a whole number of colour cells: the last row or column is left out")
    found = tuple(replace(m, notes=(*notes, *m.notes)) for m in found)
    return (tuple(_with_products(m, reader, cfa) for m in found) if products else found), reader.hashes


def _with_products(m: Measurement, reader: FrameReader, cfa: str | None) -> Measurement:
    """Add the frames' products of the stacks that were chosen."""
    from pixmetry.emva.spatial.frame_products import frame_products

    part, campaign = phases(cfa)[m.channel], reader.campaign

    def of(group: FrameGroup | None) -> Any:
        if group is None:
            return None
        # a worker would otherwise hold the whole frame for its phase
        frames = imap_tiles(lambda path: np.ascontiguousarray(part(reader.fetch(path))), group.paths)
        return frame_products(frames, campaign.bits)

    def chosen(kind: str, stack: StackMoments | None, photons: float | None) -> FrameGroup | None:
        groups = [] if stack is None else [g for g in campaign.stacks(kind) if (g.exposure_s, g.photons) == (stack.exposure_s, photons)]
        return groups[0] if groups else None

    return replace(
        m,
        dark_products=of(chosen("dark", m.dark_stack, 0.0)),
        bright_products=of(chosen("bright", m.bright_stack, m.bright_stack_photons)),
    )


def make_sheet(
    campaign: Campaign,
    measured: Sequence[Measurement],
    hashes: InputHashes | None,
    *,
    release: str = "4.0",
    bootstrap: int = 0,
    progress: Progress | None = None,
) -> DataSheet:
    """Evaluate what the frames of a campaign were reduced to; parameters as of `emva1288`."""
    told = progress or no_progress
    told("evaluating", 0, 1)
    one = partial(_results, release=release, bootstrap=bootstrap)
    with single_threaded_blas():
        # a channel alone stays in this thread, so that what is evaluated of it may use the others
        results = (one(measured[0]),) if len(measured) == 1 else tuple(map_tiles(one, measured))
    told("evaluating", 1, 1)
    record = provenance_record(hashes, libraries=("numpy", "scipy", "numba"))
    return DataSheet(results, _camera(campaign), _conditions(campaign, measured, release, bootstrap), record, campaign.licence)


def _results(m: Measurement, release: str, bootstrap: int) -> Results:
    from pixmetry.emva.evaluate import bootstrap_u, evaluate

    found = evaluate(m, release)
    if not bootstrap:
        return found
    try:
        drawn = bootstrap_u(m, release, bootstrap)
    except MeasureError as problem:
        return replace(found, notes=(*found.notes, f"no u by a bootstrap: {problem}"))
    values = dict(found.values)
    for key, u in drawn.items():
        if math.isfinite(u) and key in values and values[key].is_available:
            dof, units = _bootstrap_dof(key, m)
            text = f"u by a bootstrap, {bootstrap} draws, dof: {units} less one"
            # what the method says of the value stays, what it says of the other u does not
            method = "; ".join(part for part in (*values[key].method.split("; "), text) if not part.startswith("u by Monte"))
            values[key] = replace(values[key], u=u, dof=dof, method=method)
    note = (
        f"u by a bootstrap over frames and levels, {bootstrap} draws; values with the non-linearity taken into account keep the u of "
        "their fit"
    )
    return replace(found, values=values, notes=(*found.notes, note))


def _bootstrap_dof(key: str, m: Measurement) -> tuple[float, str]:
    """Degrees of freedom of an u that is drawn from so many levels or frames, the fewest that the value rests on, and what they are."""
    levels = {"bright levels": m.transfer.bright.mean_dn.size}
    dark_levels = {"dark levels": m.transfer.dark.mean_dn.size}
    frames = [stack.n_frames for stack in (m.dark_stack, m.bright_stack) if stack is not None]
    stacks = {"frames of a stack": min(frames)} if frames else {}
    resampled = {"spatial": stacks, "general": levels | stacks, "dark_current": dark_levels}.get(KEYS[key].section) or levels
    units = min(resampled, key=lambda name: resampled[name])
    return float(max(resampled[units] - 1, 1)), units


def _camera(campaign: Campaign) -> dict[str, Any]:
    facts, optics = campaign.camera, campaign.optics
    rows, cols = campaign.frame_shape
    known = {
        "name": facts.name,
        "sensor": facts.sensor,
        "bits": facts.bits,
        "rows": rows,
        "cols": cols,
        "pitch_x_um": facts.pitch_x_um,
        "pitch_y_um": facts.pitch_y_um,
        "cfa": facts.cfa,
        "interface": facts.interface,
        "pixel_clock_mhz": facts.pixel_clock_mhz,
        "temperature_c": facts.temperature_c,
        "wavelength_nm": optics.wavelength_nm,
        "f_number": optics.f_number,
        "vendor": facts.vendor,
        "model": facts.model,
        "serial_number": facts.serial_number,
        "sensor_cols": facts.sensor_cols,
        "sensor_rows": facts.sensor_rows,
        "first_col": facts.first_col,
        "first_row": facts.first_row,
    }
    return {name: value for name, value in known.items() if value is not None}


def _conditions(campaign: Campaign, measured: Sequence[Measurement], release: str, bootstrap: int) -> dict[str, Any]:
    first = measured[0]
    bright, dark = first.transfer.bright, first.transfer.dark
    photons = [] if bright.photons is None or not bright.photons.size else [float(bright.photons.min()), float(bright.photons.max())]
    exposures = sorted({float(t) for t in bright.exposure_s})
    known = {
        "release": release,
        "sweep": None if not exposures else "exposure time at constant light" if len(exposures) > 1 else "light at constant exposure time",
        "bright_levels": int(bright.mean_dn.size),
        "dark_levels": int(dark.mean_dn.size),
        "frames_per_level": sorted({int(n) for n in (*bright.n_frames, *dark.n_frames)}),
        "dark_stack_frames": None if first.dark_stack is None else first.dark_stack.n_frames,
        "bright_stack_frames": None if first.bright_stack is None else first.bright_stack.n_frames,
        "stack_exposure_s": None if first.dark_stack is None else first.dark_stack.exposure_s,
        "exposures_s": [exposures[0], exposures[-1]] if exposures else None,
        "photons": photons or None,
        "photons_u_rel": first.photons_u_rel,
        "colour_channels": None if first.channel == MONO else [m.channel for m in measured],
        "bootstrap_draws": bootstrap or None,
        "irradiance_uw_per_cm2": campaign.optics.irradiance_uw_per_cm2,
        "light_source": campaign.optics.light_source,
        "operator": campaign.operator or None,
    }
    return {name: value for name, value in known.items() if value is not None}
