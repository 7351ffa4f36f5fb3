"""The main job: from the frames of a campaign to the uncertainty of a target's position."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from pixmetry.assess.digital_twin import ASSUMED_RANGE_E, digital_twin, of_unit
from pixmetry.assess.draft import draft_campaign
from pixmetry.assess.located_frames import with_located
from pixmetry.assess.page.page import write_report
from pixmetry.assess.results import Assessment
from pixmetry.assess.self_test import self_test
from pixmetry.budget.job import compute_budget
from pixmetry.budget.monte_carlo import Crop, Trials
from pixmetry.budget.parameters import with_estimates
from pixmetry.budget.probe import Target, parse_target
from pixmetry.budget.records import Budget
from pixmetry.camera.camera import Camera
from pixmetry.camera.catalogue import sources
from pixmetry.camera.geometry import frame_centre
from pixmetry.camera.observations import CameraGeometry, Observations
from pixmetry.core.arguments import typed
from pixmetry.core.errors import InputError, MeasureError
from pixmetry.core.number import Estimates
from pixmetry.core.progress import Progress, no_progress
from pixmetry.emva.evaluate import standard_values
from pixmetry.emva.records import Measurement, Results
from pixmetry.files import (
    EXAMPLE,
    Campaign,
    FrameReader,
    InputHashes,
    check_output,
    load_campaign,
    provenance_record,
    staged_output,
    write_maps,
    write_record,
)
from pixmetry.files.manifest import NoCampaign
from pixmetry.files.records import LOCATED, FrameGroup
from pixmetry.locate.target_estimator import TargetEstimator, parse_estimator
from pixmetry.observe.covered import BorderFrames, covered_pixels
from pixmetry.observe.observe import Group, observe
from pixmetry.observe.one_pass import without_levels

KIND = "assessment"
SPREADING = ("optics.point_spread", "optics.olpf", "sensor.pixel_aperture")
TARGET_BEFORE_LENS = (
    "Lens, pixel aperture or optical low-pass filter were measured from edges. The Monte Carlo shows the target through them, so its image "
    "is blurrier there than the stated target, on which the sum of the contributions rests; the two may differ by that."
)


@partial(typed, but=("campaign",))  # of arrays it says more
def assess(
    campaign: str | Path | Campaign | None = None,
    output: str | Path | None = None,
    *,
    target: str = "",
    estimator: str = "",
    calibration: str | Path | CameraGeometry | None = None,
    trials: int = 4000,
    seed: int = 1,
    progress: Progress | None = None,
) -> Assessment:
    """Assess a camera from its dark and bright frames, and from pictures of edges.

    Parameters
    ----------
    campaign : path, Campaign or None
        A manifest, an EMVA 1288 descriptor, a folder with one of them, or None for the packaged example. A folder of nothing but frames
        is drafted as `pixmetry init` does, if names, tags and pixels tell all.
    output : path, optional
        Folder for ``report.html``, ``results.json``, ``maps.zarr.zip``, ``camera.yaml`` and ``camera.maps.npz``.
    target, estimator : str
        As on the command line, e.g. ``"disc:diameter=7,blur=0.7,peak=0.6"`` and ``"template"`` or any other name that `pixmetry.locate`
        has for discs, or ``"fixed_soft_threshold:sigma=3,window=13"``. By default what `pixmetry.locate` takes.
    calibration : path or CameraGeometry, optional
        Results of `pixmetry calibrate` for the camera (the folder, or its ``calibration.json``), with which positions are corrected: their
        uncertainty and what is left over enter the budget. One in pixels takes the pitch from the campaign.
    trials : int
        Windows for each Monte Carlo of the budget.
    seed : int
        Of the Monte Carlo.
    progress : callable, optional
        Called with (what, done, of).

    Returns
    -------
    Assessment

    Raises
    ------
    InputError, MeasureError
        If a file or the campaign cannot be used, or the frames do not carry a photon transfer.

    Examples
    --------
    >>> import pixmetry
    >>> found = pixmetry.assess(output="result", trials=0)  # the packaged example; without Monte Carlo
    >>> gain = found.estimates["electronics.gain"]["gain_dn_per_e"]
    >>> bool(0.2 < gain.value < 0.4 and gain.u < 0.03 * gain.value)
    True
    >>> found.budget.largest[0].title, found.budget.advice[0].finding.kind
    ('Photon shot noise', 'to_lower')
    """
    what_target = parse_target(target) if target else Target()
    what_estimator = parse_estimator(estimator) if estimator else TargetEstimator()
    frames = campaign if isinstance(campaign, Campaign) else _campaign_in(campaign, progress or no_progress)
    if output is not None:
        check_output(output, KIND, _origin(frames), _inputs(frames, calibration))  # before the work, not after it
    if isinstance(calibration, str | Path):
        from pixmetry.calibrate.files.record import calibration_file

        calibration = calibration_file(calibration)
    geometry = None if calibration is None else _geometry_for(frames, calibration)
    window = _window_of(frames)
    told = progress or no_progress
    hashes, seen = observe_campaign(frames, told)
    told_of_frames = _other_frames(calibration, frames) if isinstance(calibration, Path) else ()
    seen = replace(seen, geometry=geometry, notes=(*seen.notes, *window, *told_of_frames))
    if isinstance(calibration, Path):
        hashes.add_file(calibration)
    standard = by_the_standard(frames, seen)
    estimates, unmeasured = measure_sources(seen)
    silent = noise_missing(seen)
    if silent:
        seen = replace(seen, notes=(*seen.notes, silent))
    if not {"electronics.gain", "sensor.log_response"} & set(estimates):
        estimates, unmeasured = _at_assumed_gain(seen, estimates, unmeasured, frames.bits)
        assumed = f"taken as if {ASSUMED_RANGE_E:g} electrons filled the range, fewer than in most cameras"
        note = f"The gain is not measured. For the shot noise it is {assumed}, which bounds it; electrons are DN over that gain."
        seen = replace(seen, notes=(*seen.notes, note))
    estimates, unmeasured = without_noise(seen, estimates, unmeasured)
    if any(source in estimates for source in SPREADING):
        seen = replace(seen, notes=(*seen.notes, TARGET_BEFORE_LENS))
    camera = digital_twin(frames, estimates, seen)
    steps = len(camera.active) + len(sources()) + 2
    done = itertools.count(1)
    budget = compute_budget(
        camera,
        estimates,
        None,
        what_target,
        what_estimator,
        geometry=geometry,
        sensor_shape=frames.camera.sensor_shape,
        accepted=[e.name for e in camera.active if e.name in unmeasured and e.source.measure is not None],
        trials=trials,
        seed=seed,
        progress=lambda _: told("computing the budget", min(next(done), steps - 1), steps),
    )
    told("computing the budget", steps, steps)
    record = provenance_record(hashes, seed=seed, libraries=("numpy", "scipy", "numba"))
    told("testing the digital twin", 0, 1)
    twin = of_unit(camera, seen)
    tested = self_test(twin, frames, seen, standard, seed)
    told("testing the digital twin", 1, 1)
    crop = crop_of(twin, budget, seed)
    assessment = Assessment(frames, seen, estimates, unmeasured, standard, twin, budget, record, tested, crop)
    if output is not None:
        told("writing the report", 0, 1)
        write_results(assessment, output, _inputs(frames, calibration))
        told("writing the report", 1, 1)
    return assessment


def _campaign_in(path: str | Path | None, progress: Progress) -> Campaign:
    """The campaign at a path; of a folder of nothing but frames the drafted one."""
    try:
        return load_campaign(path)
    except NoCampaign:
        assert path is not None  # the example is one
        return draft_campaign(path, progress=progress).campaign()


def crop_of(twin: Camera, budget: Budget, seed: int) -> Crop | None:
    """The target of a budget as the twin shows it; None where its frames are too small for it."""
    try:
        return Trials(twin, budget.target, budget.estimator, budget.facts, trials=1, units=1, frames=1, seed=seed).crop()
    except InputError:
        return None


def _geometry_for(campaign: Campaign, calibration: str | Path | CameraGeometry) -> CameraGeometry:
    """The calibrated geometry of a campaign's camera; refused where the pitches say that it is another camera's."""
    from pixmetry.calibrate.calibrated_camera import calibrated_geometry

    facts = campaign.camera
    ours = None if facts.pitch_x_um is None else (facts.pitch_x_um, facts.pitch_y_um or facts.pitch_x_um)
    geometry = calibrated_geometry(calibration, pitch_um=ours)
    theirs = tuple(geometry.lens[n].value for n in ("pitch_x_um", "pitch_y_um"))
    if ours is not None and not np.allclose(theirs, ours, rtol=1e-6):
        remedy = "give the calibration of this camera"
        raise InputError("a calibration with another pixel pitch", where=str(calibration), value=theirs, allowed=str(ours), remedy=remedy)
    if isinstance(calibration, Path) and _is_window_of(campaign, _calibrated_shape(calibration)):
        return _seen_from(geometry, campaign)
    return geometry


def _calibrated_shape(calibration: Path) -> tuple[int, int]:
    from pixmetry.calibrate.files.record import stored_cameras

    sensor = stored_cameras(calibration)[0].sensor
    return sensor.rows, sensor.cols


def _is_window_of(campaign: Campaign, shape: tuple[int, int]) -> bool:
    """Whether the frames are said to be a window, at a known place, of a sensor of this size."""
    facts = campaign.camera
    return facts.sensor_shape == shape != campaign.frame_shape and facts.first_col is not None


def _seen_from(geometry: CameraGeometry, campaign: Campaign) -> CameraGeometry:
    """The geometry of the whole sensor with the principal point counted from the centre of the window."""
    facts, lens = campaign.camera, geometry.lens
    if facts.sensor_shape is None or facts.first_col is None or facts.first_row is None:
        return geometry
    (x, y), (x0, y0) = frame_centre(campaign.frame_shape), frame_centre(facts.sensor_shape)
    values = lens.values.copy()
    values[lens.index("centre_x_px")] += x0 - (facts.first_col + x)
    values[lens.index("centre_y_px")] += y0 - (facts.first_row + y)
    whole = dict.fromkeys(
        geometry.told, "the frames are a window of the calibrated sensor, and what its residuals tell is of the whole frame"
    )
    return replace(geometry, lens=replace(lens, values=values), told={}, untold={**geometry.untold, **whole})


def _window_of(campaign: Campaign) -> tuple[str, ...]:
    """A note if the frames are a window of a sensor: which values hold for the window, and which for the whole sensor."""
    facts, (rows, cols) = campaign.camera, campaign.frame_shape
    if facts.sensor_shape in (None, (rows, cols)):
        return ()
    at = "" if facts.first_col is None else f" from column {facts.first_col}, row {facts.first_row}"
    whole = f"{cols} × {rows} pixels{at} of a sensor of {facts.sensor_cols} × {facts.sensor_rows}"
    rest = "measured values hold for these pixels; accepted bounds hold for the whole sensor"
    return (f"The frames show {whole}: {rest}.",)


def _other_frames(calibration: Path, campaign: Campaign) -> tuple[str, ...]:
    """A note where the frames are not of the size that was calibrated: a window of them, or another camera's."""
    rows, cols = _calibrated_shape(calibration)
    if (rows, cols) == campaign.frame_shape or _is_window_of(campaign, (rows, cols)):
        return ()
    sizes = f"{cols} × {rows} pixels, the frames have {campaign.frame_shape[1]} × {campaign.frame_shape[0]}"
    which = "" if campaign.camera.first_col is not None else " (sensor_cols, sensor_rows, first_col, first_row in the manifest say which)"
    holds = f"it can be used for a window of that camera's frames{which}, not for another camera or for binned pixels"
    return (f"The calibration is of {sizes}: {holds}.",)


def write_results(assessment: Assessment, directory: str | Path, inputs: Sequence[Path] = ()) -> Path:
    """Write report, results, maps and the twin into a folder, whole or not at all; return the path of the report.

    Parameters
    ----------
    assessment : Assessment
    directory : path
    inputs : sequence of Path
        Files that must not be replaced.

    Raises
    ------
    InputError
        If the folder cannot be written, or holds anything else than an earlier assessment of this campaign.
    """
    with staged_output(directory, KIND, _origin(assessment.campaign), inputs) as folder:
        write_maps(folder / "maps.zarr.zip", assessment.maps(), {"camera": assessment.campaign.camera.name})
        assessment.camera.save(folder / "camera.yaml")
        write_report(assessment, folder / "report.html")
        write_record(folder / "results.json", assessment.to_record())
    return Path(directory) / "report.html"


def _origin(campaign: Campaign) -> tuple[str | Path, ...]:
    """What an assessment is of: the file of the campaign, or the camera's name where there is none."""
    if campaign.arrays is not None:
        return (campaign.camera.name,)
    return ("packaged example" if campaign.source_path.is_relative_to(EXAMPLE) else campaign.source_path,)


def _inputs(campaign: Campaign, calibration: str | Path | CameraGeometry | None) -> list[Path]:
    """Files that an assessment reads."""
    more = [Path(calibration)] if isinstance(calibration, str | Path) else []
    return [*campaign.files, *more]


def observe_campaign(campaign: Campaign, progress: Progress) -> tuple[InputHashes, Observations]:
    """Read every frame once and reduce it."""
    done = 0

    def on_frames(count: int) -> None:
        nonlocal done
        done += count
        progress("reading frames", done, campaign.frame_count)

    reader = FrameReader(campaign)

    shown = [g for g in campaign.groups if g.kind not in LOCATED]
    chosen = [g for g in shown if campaign.camera.cfa is None or g.kind not in ("edge", "chart", "line", "spots", "speckle")]
    note = "edges, lines, spots, laser light and charts are not measured through a colour mosaic: a step of brightness looks jagged there"
    left_out = (note,) if len(chosen) < len(shown) else ()

    covered, borders = campaign.camera.covered, list[BorderFrames]()

    def taken(group: FrameGroup) -> Iterator[tuple[Path, Callable[[np.ndarray], object] | None]]:
        if covered is None:
            yield from ((path, None) for path in group.paths)
            return
        borders.append(BorderFrames(group.kind, group.exposure_s, covered))
        yield from ((path, partial(borders[-1].add, index)) for index, path in enumerate(group.paths))

    def groups() -> Iterator[Group]:
        for g in chosen:
            yield Group(g.kind, g.role, g.exposure_s, g.photons, [partial(reader.fetch, path, put) for path, put in taken(g)], g.facts)

    if chosen:
        seen = observe(groups(), campaign.bits, campaign.camera.temperature_c, campaign.stated, on_frames=on_frames)
    else:
        alone = without_levels(campaign.frame_shape, campaign.bits)
        seen = Observations(alone, Estimates.empty(), temperature_c=campaign.camera.temperature_c, stated=campaign.stated)
    seen = with_located(seen, campaign, reader.fetch, on_frames)
    fit = seen.photon_transfer_fit
    gain = fit["gain_dn_per_e"].value if fit is not None and "gain_dn_per_e" in fit else None
    known = fit is not None and {"saturation_dn", "offset_dn"} <= set(fit.names)
    full = fit["saturation_dn"].value - fit["offset_dn"].value if fit is not None and known else float("inf")
    if fit is not None and "offset_dn" in fit:
        full = min(full, seen.series.full_dn - fit["offset_dn"].value)
    bordered = covered_pixels(borders, campaign.camera.interface == "analogue", gain, full)
    coded = [f"frames of kind {kind} are JPEG: their positions hold what the coder does" for kind in sorted(reader.located_with_loss)]
    notes = (*campaign.findings, *left_out, *seen.notes, *coded, *(() if bordered is None else bordered.notes))
    facts = campaign.camera
    return reader.hashes, replace(seen, storage=reader.storage, sensor=facts.sensor, covered=bordered, notes=notes)


def by_the_standard(campaign: Campaign, observations: Observations) -> Results:
    """Values of EMVA 1288 from the same frames, for comparison: Release 3.1, which takes the images as they are.

    Release 4.0 filters the slow part of the patterns out, and would not speak of the same quantity as the estimates beside it.
    """
    pitch_x_um, pitch_y_um = campaign.camera.pitch_x_um, campaign.camera.pitch_y_um
    area = None if pitch_x_um is None or pitch_y_um is None else pitch_x_um * pitch_y_um
    seen = Measurement(observations.series, observations.dark_stack, observations.bright_stack, pixel_area_um2=area)
    return standard_values(seen, "3.1")


def measure_sources(observations: Observations) -> tuple[dict[str, Estimates], dict[str, str]]:
    """Let every source measure its parameters from the observations: estimates, and by source the reason if there are none.

    A source that most cameras have not, and of which only limits are known, is not taken into the camera: its limits are the reason.
    """
    estimates, unmeasured = {}, {}
    for source in sources().values():
        if source.measure is None:
            unmeasured[source.id] = source.reasons["measure"]
            continue
        try:
            found = source.measure(observations)
            with_estimates(source, source.typical, found)  # outside the model's range it is no measurement of this effect
            if (
                source.option and found.limits == frozenset(found.names) and not found.settings
            ):  # most cameras have none: what was not found is not in this one
                unmeasured[source.id] = "not found: " + ", ".join(f"{e.name} is below {e.value:.2g} {e.unit} (95 %)" for e in found)
                continue
            estimates[source.id] = found
        except (MeasureError, InputError) as problem:
            unmeasured[source.id] = str(problem)
    return estimates, unmeasured


NEED_DITHER = ("grabber.phase_pattern", "grabber.fixed_pattern")  # below half a step rounding hides them where there is no noise
NEED_NOISE = ("electronics.amplifier_noise", "electronics.row_noise", "sensor.dsnu", "sensor.defects", *NEED_DITHER)


def equal_dark_dn(observations: Observations) -> float | None:
    """The grey value that every pixel of every dark frame has; None where they differ."""
    levels, stack = observations.series.dark, observations.dark_stack
    means = [*levels.mean_dn, *(() if stack is None else (stack.mean_dn,))]
    scatter = [*levels.var_total_dn2, *(() if stack is None else (stack.var_stack_dn2, np.ptp(stack.mean_map_dn)))]
    return float(means[0]) if means and not np.any(scatter) and np.ptp(means) == 0 else None


def noise_missing(observations: Observations) -> str:
    """A note on what cannot be measured if all dark frames are equal; empty if they differ."""
    level = equal_dark_dn(observations)
    if level is None:
        return ""
    if level > 0:
        told = "Dark noise and DSNU are bounded by the rounding alone, and patterns in the dark are not measured"
    else:
        told = "They are clipped at black: noise, DSNU, defects and patterns of the dark are not measured (raise the black level)"
    return f"All dark frames are equal, {level:g} DN in every pixel: they hold no noise. {told}."


def without_noise(
    observations: Observations, estimates: dict[str, Estimates], unmeasured: dict[str, str]
) -> tuple[dict[str, Estimates], dict[str, str]]:
    """Leave out values that equal dark frames cannot show: patterns below the rounding, and all noise if black is clipped."""
    level = equal_dark_dn(observations)
    gone = () if level is None else NEED_DITHER if level > 0 else NEED_NOISE
    why = "all dark frames are equal: they contain no noise"
    return {k: v for k, v in estimates.items() if k not in gone}, unmeasured | dict.fromkeys(gone, why)


IN_ELECTRONS = ("electronics.amplifier_noise", "electronics.row_noise", "sensor.dsnu", "sensor.defects")


def _at_assumed_gain(
    seen: Observations, estimates: dict[str, Estimates], unmeasured: dict[str, str], bits: int
) -> tuple[dict[str, Estimates], dict[str, str]]:
    """What was measured in DN, given in electrons at the assumed gain: so it counts in twin and budget with its size in DN."""
    fit, gain = seen.photon_transfer_fit, (2**bits - 1) / ASSUMED_RANGE_E
    if fit is None or "dark_noise_dn" not in fit:
        return estimates, unmeasured
    parts = [fit[f"{name}_dn"] for name in ("dark_noise", "row_noise", "column_noise")]
    names = [e.name.replace("_dn", "_e") for e in parts]
    told = "measured in DN; in electrons at an assumed gain"
    rows = [("gain_dn_per_e", gain, 0.0, np.inf, "DN/e-")]
    rows += [(name, e.value / gain, e.u / gain, e.dof, "e-") for name, e in zip(names, parts, strict=True)]
    assumed = Estimates.from_rows(
        rows,
        limits=frozenset(n for n, e in zip(names, parts, strict=True) if e.kind == "upper_limit"),
        reasons={n: "; ".join(filter(None, (told, e.reason))) for n, e in zip(names, parts, strict=True)},
        method=fit.method,
    )
    found, _ = measure_sources(replace(seen, photon_transfer_fit=fit.join(assumed)))
    added = {source: found[source] for source in IN_ELECTRONS if source in found}
    return estimates | added, {source: why for source, why in unmeasured.items() if source not in added}
