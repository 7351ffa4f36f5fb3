"""Correction of frames with what is known of their camera: measured by an assessment, or described."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from inspect import getdoc
from pathlib import Path
from typing import Any

import numpy as np

from pixmetry.assess.finer import APERTURE, FinerImage, finer_camera, finer_image
from pixmetry.camera.camera import Camera, Element, load_camera
from pixmetry.camera.catalogue import sources
from pixmetry.camera.conversions import SAMPLE, LineSources
from pixmetry.camera.covered import Covered
from pixmetry.camera.line import Line
from pixmetry.camera.overrides import changed_camera, with_source
from pixmetry.camera.provenance import MEASURED, TYPICAL
from pixmetry.camera.signal import Kind, Signal
from pixmetry.core.arguments import typed
from pixmetry.core.errors import InputError, MeasureError, ParameterError
from pixmetry.core.progress import Progress, no_progress
from pixmetry.core.random import Grid, Streams
from pixmetry.core.threads import imap_tiles
from pixmetry.files import InputHashes, provenance_record, staged_output, write_json
from pixmetry.files.assessment import load_assessment
from pixmetry.files.formats import is_frame
from pixmetry.files.images import LoadedFrame, check_frame, load_frame, picture_files
from pixmetry.files.raw_values import RawLayout, layout_of
from pixmetry.observe.covered import row_and_column_offsets
from pixmetry.observe.sequence import LEAST_FRAMES, FrameFactors, FrameLight, factors_of_frames
from pixmetry.observe.surface import fit_surface

OF_UNIT = {"sensor.dsnu": "dark_dn", "sensor.prnu": "prnu_rel", "sensor.defects": "defects"}  # maps in stored pixels and DN above black
OF_FRAMES = {  # told by the frames themselves, whatever a description says
    "electronics.row_noise": "row_offset_dn",
    "electronics.column_noise": "column_offset_dn",
    "electronics.agc": "factor_rel",
    "optics.flicker": "factor_rel",
}
MAP_OF = OF_UNIT | OF_FRAMES
MEASURES_IT = "; an assessment of the camera measures it"
SUPPLY = {
    "dark_dn": f"dark frames: give some (--dark, in Python dark=){MEASURES_IT}",
    "prnu_rel": f"frames of an even field: give some (--flat, in Python flat=){MEASURES_IT}",
    "defects": f"a mask of the defect pixels: give one (--defects, in Python defects=){MEASURES_IT}",
    "row_offset_dn": "optically black columns beside the image (covered in the camera's facts), in frames stored with them",
    "column_offset_dn": "optically black rows above or below the image (covered in the camera's facts), in frames stored with them",
    "factor_rel": f"{LEAST_FRAMES} frames or more in a row (--sequence, in Python sequence=True), in parts of which nothing changes",
}
OF_SHIFTS = "several frames of a scene at rest, shifted by parts of a pixel: say how (--shifts, in Python shifts=)"
SURFACE_DEGREE, SMALLEST = 4, 12  # of the light of a flat field, and the rows and columns that it needs
LEAST_RESPONSE = 0.1  # of a pixel that is divided by it; one with less is a defect
MOST_CLIPPED = 0.01  # of the values of dark or flat frames: hot pixels
RESCALES = ("electronics.agc", "processing.temporal_noise_reduction")  # what stored values tell of a frame is changed by these
BY_VALUE = ("electronics.gamma", "electronics.hdr_gain", "electronics.nonlinearity")  # ask for no place
CURVES = (*BY_VALUE, "sensor.log_response", "processing.companding")  # a value behind them is that of a value ahead
HIDDEN_BY = {"sensor.bayer_mosaic": "processing.demosaic"}  # what is not there any more behind another source
TOLD_BY = {
    "row_offset_dn": "the covered pixels of each frame",
    "column_offset_dn": "the covered pixels of each frame",
    "factor_rel": "what stays as it is from frame to frame",
}
WHOLE_PX = 0.01  # by which a place on the pixel grid may be off


@dataclass(frozen=True)
class FrameCorrection:
    """What was done about one error source.

    Parameters
    ----------
    name, title : str
        In the chain of the camera, and in words.
    corrected : bool
    text : str
        What was done, or why nothing was.
    does, leaves : str
        How the correction works, and what it leaves.
    noise_rel : float
        By how much it raises white noise, on average over the frame; NaN where this was not computed.
    """

    name: str
    title: str
    corrected: bool
    text: str
    does: str = ""
    leaves: str = ""
    noise_rel: float = float("nan")

    def to_record(self) -> dict[str, Any]:
        """Plain record for JSON."""
        noise = None if np.isnan(self.noise_rel) else self.noise_rel
        record = {"title": self.title, "corrected": self.corrected, "text": self.text}
        return record | ({"does": self.does, "leaves": self.leaves, "noise_rel": noise} if self.corrected else {})


def correct_signal(
    camera: Camera,
    signal: Signal,
    maps: Mapping[str, np.ndarray],
    *,
    only: Iterable[str] = (),
    skip: Iterable[str] = (),
    until: str | None = None,
    weigh: bool = False,
) -> tuple[Signal, tuple[FrameCorrection, ...]]:
    """Correct a batch of stored codes, source by source, the last error first.

    Parameters
    ----------
    camera : Camera
        With the known parameters.
    signal : Signal
        Codes, in pixels as they are stored.
    maps : mapping of ndarray
        Known pixel by pixel: ``dark_dn``, ``prnu_rel``, ``defects``.
    only, skip : iterable of str
        Names of sources. The converter is always undone.
    until : str, optional
        Name of the source before which to stop: what is made of it is what that source put out.
    weigh : bool
        Whether to compute what each correction does to white noise, in as much time again.

    Returns
    -------
    Signal
        DN above black, float32.
    tuple of FrameCorrection
    """
    chosen = tuple(only), tuple(skip)
    steps: list[FrameCorrection] = []
    for element in _last_first(camera):
        if element.name == until:
            break
        of_factors = MAP_OF.get(element.source.id) == "factor_rel"
        divided = [s.name for s in steps if s.corrected and MAP_OF.get(camera[s.name].source.id) == "factor_rel"]
        why_not = _reason(element, maps, *chosen) or (f"nothing to correct: {divided[0]} has it" if of_factors and divided else "")
        if why_not:
            steps.append(FrameCorrection(element.name, element.source.title, False, why_not))
            continue
        done = {step.name for step in steps if step.corrected}

        def undone(given: Signal, element: Element = element, done: frozenset[str] = frozenset(done)) -> Signal:
            return _undone(camera, element, given, maps, done)

        try:
            corrected = undone(signal)
            noise_rel = _noise_rel(undone, signal, corrected) if weigh and corrected is not signal else float("nan")
            steps.append(_told(element, corrected is not signal, noise_rel, _since(camera, element)))
            signal = corrected
        except (InputError, ParameterError) as problem:
            steps.append(FrameCorrection(element.name, element.source.title, False, f"not corrected: {problem}"))
    return signal, tuple(steps)


def _last_first(camera: Camera) -> list[Element]:
    """The sources as they are undone. Offsets that are told in stored values go before what changes the scale of frames, or mixes them."""
    order = list(reversed(camera.active))
    first = next((i for i, e in enumerate(order) if e.source.id in RESCALES), len(order))
    told = [e for e in order[first:] if OF_FRAMES.get(e.source.id, "factor_rel") != "factor_rel"]
    return order[:first] + told + [e for e in order[first:] if all(e is not t for t in told)]


def _reason(element: Element, maps: Mapping[str, np.ndarray], only: tuple[str, ...], skip: tuple[str, ...]) -> str:
    """Why a source is not corrected; empty where it is."""
    source, named = element.source, element.name in only
    needs = MAP_OF.get(source.id)
    if source.correct is None:
        return f"not corrected: {source.reasons['correct']}"
    if source.id == APERTURE:
        return f"not corrected: needs {OF_SHIFTS}"
    if source.produces is Kind.CODES:
        return ""  # what goes on is in DN
    if element.name in skip or (only and not named):
        return "not corrected: left out, as asked"
    if needs is not None and needs not in maps and not (needs == "factor_rel" and _is_idle(element)):
        return f"not corrected: needs {SUPPLY[needs]}"
    if source.id in OF_FRAMES:
        return "nothing to correct" if _is_idle(element) else ""
    if source.stage == "optics" and element.known_from == MEASURED and not named:
        return "not corrected: these frames have another light and lens than the campaign"
    if element.known_from == TYPICAL and needs is None and not named:
        return "not corrected: its parameters are only typical of such a camera; name it under `only` to correct it all the same"
    return ""


def _is_idle(element: Element) -> bool:
    """Whether a source does nothing with these parameters: it keeps no state, or they are the neutral ones."""
    source = element.source
    return bool(source.start(element.params) is None if source.start is not None else element.params == source.neutral)


def _since(camera: Camera, element: Element) -> str:
    """What has changed the values since and cannot be undone, in words; empty if nothing has."""
    at = next(i for i, link in enumerate(camera.links) if link.name == element.name)
    later = camera.links[at + 1 :]
    mixed = [link.name for link in later if link.source.stage in ("processing", "storage") and link.source.correct is None]
    if Kind.VIDEO not in element.source.consumes and any(link.source is SAMPLE and not link.params.line.plain for link in later):
        mixed.insert(0, "the video line")
    return ", ".join(mixed)


def _told(element: Element, changed: bool, noise_rel: float, since: str) -> FrameCorrection:
    """What was done by the source's own words."""
    source = element.source
    if not changed:
        return FrameCorrection(element.name, source.title, False, "nothing to correct")
    text = "corrected by typical parameters" if element.known_from == TYPICAL and source.id not in MAP_OF else "corrected"
    if source.id in OF_FRAMES:
        text += f" by {TOLD_BY[OF_FRAMES[source.id]]}"
    if since and source.id not in MAP_OF:
        text += f", as far as it is not changed since by {since}"
    does = (getdoc(source.correct) or "").partition("\n")[0]
    return FrameCorrection(element.name, source.title, True, text, does, source.leaves, noise_rel)


def _undone(camera: Camera, element: Element, signal: Signal, maps: Mapping[str, np.ndarray], done: frozenset[str]) -> Signal:
    """The signal without a source: in its own pixels, and in electrons where it works on those; the same object if nothing is to do."""
    source = element.source
    assert source.correct is not None
    given, hidden_by = signal, HIDDEN_BY.get(source.id)
    if any(e.source.id == hidden_by for e in camera.active):
        raise InputError(f"{hidden_by} has changed the pixels since, and cannot be undone")
    if source.id not in MAP_OF and Kind.VIDEO not in source.consumes:
        on_sensor = _on_grid_of(camera, element, signal)
        if on_sensor is None and source.id not in BY_VALUE:
            raise InputError("the stored pixels are not those of the sensor: the frame grabber samples them anew, or stores other rows")
        given = signal if on_sensor is None else on_sensor
    gain = next((e.params.gain_dn_per_e for e in camera.active if e.source.id == "electronics.gain"), None)
    in_electrons = gain and Kind.ELECTRONS in source.consumes and source.id not in MAP_OF and given.kind is Kind.DN
    if in_electrons:
        given = given.with_data((given.data / np.float32(gain)).astype(np.float32), Kind.ELECTRONS)
    given = replace(given, line=_rest_of_line(camera, element.name, done, signal))
    corrected = source.correct(element.params, given, maps)
    if corrected is given or (source.neutral is not None and element.params == source.neutral and source.id not in MAP_OF):
        return signal
    data = corrected.data * np.float32(gain) if in_electrons else corrected.data
    return signal.with_data(data, Kind.DN if in_electrons else corrected.kind)


def _on_grid_of(camera: Camera, element: Element, signal: Signal) -> Signal | None:
    """The stored pixels as a window of the frame that a source saw; None where they are no pixels of it."""
    links = camera.links
    at = next(i for i, link in enumerate(links) if link.name == element.name)
    x = y = np.array([0.0, 1.0])
    for link in links[at + 1 :]:
        if link.source is SAMPLE:
            x = link.params.line.placed(x)
        elif link.source.place is not None:
            x, y = link.source.place(link.params, x, y, link.shape, 0)
    if abs(x[1] - x[0] - 1) > 1e-9 or abs(y[1] - y[0] - 1) > 1e-9 or max(abs(v[0] - np.rint(v[0])) for v in (x, y)) > WHOLE_PX:
        return None
    row0, col0, shape = -int(np.rint(y[0])), -int(np.rint(x[0])), links[at].shape_out
    rows, cols = signal.data.shape[1:]
    first, left = row0 + signal.grid.row0, col0 + signal.grid.col0
    if (first < 0).any() or (left < 0).any() or (first + rows > shape[0]).any() or (left + cols > shape[1]).any():
        return None
    return replace(signal, grid=Grid(signal.grid.frame, first, left, (rows, cols)), frame_shape=shape)


def _noise_rel(undone: Any, signal: Signal, corrected: Signal) -> float:
    """What a correction makes of white noise of 1 DN: the standard deviation of the change that it brings, over the frame."""
    noise = Streams(0, 0).of("noise of a correction").normal(signal.grid)
    noisy = undone(signal.with_data((signal.data + noise).astype(np.float32)))
    return float(np.std(noisy.data[-1].astype(float) - corrected.data[-1]) / np.std(noise))


def _rest_of_line(camera: Camera, name: str, done: frozenset[str], signal: Signal) -> Line | None:
    """The line that still acts on samples as they are stored, without the source of that name; None for one that is not on a line."""
    for i, link in enumerate(camera.links):
        if link.source is SAMPLE and name in (on_line.name for on_line in link.params.links):
            others = [e for e in link.params.links if e.name != name and e.name not in done]
            line = LineSources(tuple(others), link.params.pixel_hz).line_at(signal)
            first = np.zeros(1)  # sample of the line that is stored first
            for later in camera.links[i + 1 :]:
                if later.source.place is not None:
                    first, _ = later.source.place(later.params, first, first, later.shape, 0)
            return replace(line, start_s=line.start_s - float(first[0]) / line.sample_clock_hz)
    return None


@dataclass(frozen=True)
class Correction:
    """Result of a correction.

    Parameters
    ----------
    sources : mapping of str
        By error source: what was done, or why nothing was.
    frames : ndarray, shape (n, rows, cols), float32, or None
        The corrected frames, DN above black; None where they were written to files.
    output : Path, optional
        Their folder.
    steps : tuple of FrameCorrection
        What was done to the first frame (of a sequence, to the second), in this order, with what it leaves and what it does to noise.
    clipped : ndarray of bool, shape (n, rows, cols), or None
        Pixels that were stored at an end of the range: what is behind them is not known, and their values are limits.
    clipped_pixels : int
        How many these are, in all frames.
    finer : FinerImage, optional
        Of shifted frames: the image that they give together, which is then the only one of ``frames``.
    """

    sources: Mapping[str, str]
    frames: np.ndarray | None = None
    output: Path | None = None
    steps: tuple[FrameCorrection, ...] = ()
    clipped: np.ndarray | None = None
    clipped_pixels: int = 0
    finer: FinerImage | None = None

    def __repr__(self) -> str:
        done = [name for name, text in self.sources.items() if text.startswith("corrected")]
        return f"<Correction of {', '.join(done) or 'nothing'}; {len(self.sources) - len(done)} sources not corrected>"

    @property
    def noise_rel(self) -> float:
        """By how much all corrections together raise white noise; NaN where it was not computed."""
        known = [s.noise_rel for s in self.steps if s.corrected]
        return float(np.prod(known)) if known else float("nan")


@typed
def correct(
    frames: np.ndarray | str | Path | Sequence[str | Path],
    with_: Camera | str | Path,
    output: str | Path | None = None,
    *,
    dark: Any = None,
    flat: Any = None,
    defects: Any = None,
    settings: Mapping[str, Any] | None = None,
    only: Iterable[str] = (),
    skip: Iterable[str] = (),
    raw: str | RawLayout | None = None,
    sequence: bool = False,
    shifts: Any = None,
    finer: Any = None,
    progress: Progress | None = None,
) -> Correction:
    """Correct frames with what is known of their camera.

    Parameters
    ----------
    frames : ndarray, shape (rows, cols) or (n, rows, cols), or path or sequence of path
        Stored codes; or image files, folders of them, stores (``frames.zarr``) or single frames of a store (``frames.zarr/7``). The frames
        of a file with several are written one by one: ``stack.tif`` becomes ``stack_0.tif``, ``stack_1.tif`` …
    with_ : Camera or str or path
        ``results.json`` of an assessment, or its folder (``camera.yaml`` and ``maps.zarr.zip`` stand beside it); or a camera, a camera
        file, the name of a preset, or a data sheet.
    output : path, optional
        Folder for the corrected frames of files, under their own names as TIFF of 32-bit floats in DN above black (rounding them again
        would add noise, and clipping at black would cut it in half); ``correction.json`` says what was done. Needed for files, and for
        files only.
    dark, flat : ndarray, shape (n, rows, cols), or path or sequence of path, optional
        Dark frames, and frames of an even field, of this camera: their means take the place of its dark pattern and of its relative
        response, which a description does not hold.
    defects : ndarray of bool, shape (rows, cols), or path, optional
        Mask of defect pixels; an image that is not 0 there.
    settings : mapping, optional
        Changes to the camera by name, such as ``exposure_s``, or a parameter such as ``sensor.smear.transfer_s``. A source that is not in
        the camera is put into it.
    only, skip : iterable of str
        Names of sources. What is only typical of such a camera is corrected only if it is named; so is the light of a campaign.
    raw : str or RawLayout, optional
        Of files without a header: ``"1920x1200:Mono12p"``.
    sequence : bool
        Whether the frames were taken one after the other without a pause, files in the order of their names. Then what a frame leaves in
        the next one (``sensor.image_lag``, ``processing.temporal_noise_reduction``) is corrected, from the second frame on; and what makes
        the frames, or their rows, unequally bright (``electronics.agc``, ``optics.flicker``), by the parts of the scene that stay as they
        are.
    shifts : array_like of shape (n, 2), or path, or "found", optional
        The frames are of one scene at rest, and the image is displaced by this in each of them, along x and y in pixels: put them together
        on a finer grid (``sensor.pixel_aperture``). A path names a table (CSV) with the columns ``shift_x_px`` and ``shift_y_px``, a row
        for each frame in their order; ``"found"`` finds the shifts in the frames, against the first.
    finer : int or (int, int), optional
        Finer pixels in a pixel, 1 to 4 (along x and y). By default the finest grid that the shifts part.
    progress : callable, optional
        Called with (what, done, of).

    Returns
    -------
    Correction

    Raises
    ------
    InputError
        If a file cannot be read, a frame has not the size and depth of this camera's frames, or two frames have one name.

    Examples
    --------
    >>> import numpy as np, pixmetry
    >>> camera = pixmetry.load_camera("ft_ccd_generic")
    >>> frame = np.full(camera.output_shape, 200, np.uint16)
    >>> correction = correct(frame, camera, settings={"sensor.smear.transfer_s": 0.001})
    >>> correction.sources["sensor.smear"], correction.frames.shape == (1, *frame.shape)
    ('corrected', True)
    >>> print(correction.sources["sensor.dsnu"])
    not corrected: needs dark frames: give some (--dark, in Python dark=); an assessment of the camera measures it
    """
    if isinstance(frames, np.ndarray):
        if output is not None:
            remedy = "leave output away, or name files"
            raise InputError("a folder for corrected frames goes with files, not with arrays", where="output", value=output, remedy=remedy)
    elif output is None:
        remedy = "name one, or give the frames as an array"
        raise InputError("the folder for the corrected frames is missing", where="output", remedy=remedy)
    if shifts is None and finer is not None:
        raise InputError("a finer grid needs shifted frames", where="finer", value=finer, remedy="say how they are shifted (shifts)")
    layout = layout_of(raw)
    known = known_of(with_, dark=dark, flat=flat, defects=defects, settings=settings, only=only, skip=skip, raw=layout)
    if shifts is not None:
        _check_pixels(known)
    if isinstance(frames, np.ndarray):
        made = _correct_array(frames, known, sequence)
        return made if shifts is None else _put_together(made, known, shifts, finer)
    assert output is not None
    files = [frames] if isinstance(frames, str | Path) else frames
    return _correct_files(files, known, Path(output), layout, progress, sequence, shifts, finer)


@dataclass(frozen=True)
class Known:
    """What is known of a camera, and what of it is wanted."""

    camera: Camera
    bits: int
    maps: Mapping[str, np.ndarray]
    only: tuple[str, ...] = ()
    skip: tuple[str, ...] = ()
    files: tuple[Path, ...] = ()

    def corrected(
        self,
        frame: np.ndarray,
        weigh: bool = False,
        before: Sequence[np.ndarray] = (),
        factors: np.ndarray | None = None,
        until: str | None = None,
    ) -> tuple[Signal, tuple[FrameCorrection, ...]]:
        """A frame of codes without what is known.

        ``before`` are the frames that were taken just before it, and ``factors``, shape (frames, rows), the factors of these and of it.
        Sources are undone back to that named ``until``, which stays.
        """
        stack = np.stack([*before, frame])
        maps = {**self.maps, **self._offsets(stack)}
        if factors is not None:
            maps["factor_rel"] = factors
        first = 1 if before else None
        signal = _signal_of(np.ascontiguousarray(self.lit(stack)), self.camera.output_shape, Kind.CODES, self.camera, first)
        signal, steps = correct_signal(self.camera, signal, maps, only=self.only, skip=self.skip, until=until, weigh=weigh)
        return (signal.take(np.array([len(stack) - 1])) if before else signal), steps

    @property
    def memory(self) -> int:
        """How many frames before it a frame is corrected by, in a sequence."""
        keeping = [e for e in self.camera.active if e.source.start is not None and e.source.correct is not None]
        return sum(e.source.id not in OF_FRAMES and not _is_idle(e) for e in keeping)

    def followed(self) -> str:
        """Name of the source behind which the factors of a sequence's frames are told, the last of the chain; empty without one."""
        moving = [e for e in self.camera.active if OF_FRAMES.get(e.source.id) == "factor_rel" and not _is_idle(e)]
        wanted = [e.name for e in moving if not _reason(e, {"factor_rel": np.empty(0)}, self.only, self.skip)]
        return wanted[-1] if wanted else ""

    def _offsets(self, stack: np.ndarray) -> dict[str, np.ndarray]:
        """Offsets of the rows and columns of frames that have their covered borders, shape (frames, rows) and (frames, cols)."""
        covered = self.covered
        if covered is None or stack.shape[1:] != covered.stored_shape(self.camera.output_shape):
            return {}
        sinks = any(e.source.id == "grabber.clamp" and e.params.droop_rel > 0 for e in self.camera.active)
        found = [row_and_column_offsets(frame, covered, left_alone=sinks) for frame in self._straight(stack)]
        return {name: np.array([f[name] for f in found]) for name in found[0]}

    def _straight(self, stack: np.ndarray) -> np.ndarray:
        """Codes in DN as they were in front of the curves that are undone before offsets are subtracted; codes where there is none."""
        order = _last_first(self.camera)
        offsets = next((e for e in order if OF_FRAMES.get(e.source.id, "factor_rel") != "factor_rel"), None)
        ahead = [] if offsets is None else order[: order.index(offsets)]
        curves = [e for e in ahead if e.source.id in CURVES and not _is_idle(e) and not _reason(e, {}, self.only, self.skip)]
        if offsets is None or not curves:
            return stack
        codes, shape = np.arange(2**self.bits, dtype=np.uint16), self.camera.output_shape
        every = np.resize(codes, (-(-codes.size // (shape[0] * shape[1])), *shape))
        signal = _signal_of(every, shape, Kind.CODES, self.camera, None)
        straight, _ = correct_signal(self.camera, signal, {}, only=[e.name for e in curves], until=offsets.name)
        table: np.ndarray = straight.data.reshape(-1)[: codes.size]
        return table[stack]

    @property
    def covered(self) -> Covered | None:
        """Covered borders of the stored frames, from the camera's facts."""
        stated = self.camera.facts.get("covered")
        return None if stated is None else Covered(**{side: int(count) for side, count in dict(stated).items()})

    def shape_of(self, frame: np.ndarray) -> tuple[int, int]:
        """The size that a frame must have: that of the light-sensitive area, or with the covered borders where it has these."""
        shape, covered = self.camera.output_shape, self.covered
        stored = shape if covered is None else covered.stored_shape(shape)
        return stored if frame.shape == stored else shape

    def lit(self, stack: np.ndarray) -> np.ndarray:
        """Frames of shape (n, rows, cols) without covered borders, if they have them."""
        covered = self.covered
        if covered is None or stack.shape[1:] != covered.stored_shape(self.camera.output_shape):
            return stack
        return stack[(slice(None), *covered.active(stack.shape[1:]))]

    def listed(self) -> tuple[FrameCorrection, ...]:
        """What would be done to an even frame at half of the range."""
        return self.corrected(np.full(self.camera.output_shape, 2 ** (self.bits - 1), np.uint8 if self.bits <= 8 else np.uint16), True)[1]


def known_of(
    with_: Camera | str | Path,
    *,
    dark: Any = None,
    flat: Any = None,
    defects: Any = None,
    settings: Mapping[str, Any] | None = None,
    only: Iterable[str] = (),
    skip: Iterable[str] = (),
    raw: RawLayout | None = None,
) -> Known:
    """What is known of a camera, for `correct`; parameters and errors are those of it."""
    files: tuple[Path, ...] = ()
    maps: dict[str, np.ndarray] = {}
    bits: int | None = None
    if isinstance(with_, Camera):
        camera = with_
    elif Path(with_).is_dir() or Path(with_).suffix.lower() == ".json":
        bits, camera, maps = load_assessment(with_)
        files = (Path(with_),)
    else:
        camera = load_camera(with_)
        files = (Path(with_),) if Path(with_).is_file() else ()
    for source_id in (
        *(key.rpartition(".")[0] for key in settings or {}),
        *(i for i, m in zip(OF_UNIT, (dark, flat, defects), strict=True) if m is not None),
    ):
        camera = _with(camera, source_id)
    camera = changed_camera(camera, settings)
    known = Known(
        camera, _bits_of(camera) if bits is None else bits, {**_own_maps(camera), **maps}, _names(camera, only), _names(camera, skip), files
    )
    return _with_maps(known, dark, flat, defects, raw)


def _with(camera: Camera, name: str) -> Camera:
    """The camera with a source that it does not hold, or that is off."""
    there = [e.name for e in camera.chain if name in (e.name, e.source.id)]
    if not there:
        return with_source(camera, name) if name and "." in name else camera
    return replace(camera, chain=tuple(replace(e, on=e.on or e.name in there) for e in camera.chain))


def _names(camera: Camera, names: Iterable[str]) -> tuple[str, ...]:
    found: list[str] = []
    for name in names:
        there = [e.name for e in camera.active if name in (e.name, e.source.id)]
        if not there:
            allowed = ", ".join(e.name for e in camera.active)
            raise InputError(f"{camera.name} has no source named {name!r} that is on", allowed=allowed, remedy="take one of its own")
        found += there
    return tuple(found)


def _bits_of(camera: Camera) -> int:
    """Bits of the frames that a camera stores."""
    told = camera.facts.get("bits") or next((e.params.bits for e in camera.active if e.source.produces is Kind.CODES), None)
    if told is None:
        remedy = "add `- source: grabber.adc` with its bits to the chain"
        raise InputError("the camera has no converter: its frames are not whole numbers", where=camera.name, remedy=remedy)
    return int(told)


def _own_maps(camera: Camera) -> dict[str, np.ndarray]:
    """Maps that were measured in the unit of a camera file."""
    if camera.measured is None or camera.unit_seed != camera.measured.unit_seed or camera.output_shape != camera.measured.frame_shape:
        return {}
    found = {}
    gain = next((e.params.gain_dn_per_e for e in camera.active if e.source.id == "electronics.gain"), None)
    told = camera.truth()
    for element in camera.active:
        name = OF_UNIT.get(element.source.id)
        if name is None or not element.maps:
            continue
        own = told[element.name]
        if name == "prnu_rel":
            found[name] = own["prnu_rel"]
        elif name == "defects":
            found[name] = np.any([np.asarray(mask, bool) for mask in own.values()], axis=0)
        elif gain is not None:
            found[name] = own["dsnu_e"] * gain
    return found


def _with_maps(known: Known, dark: Any, flat: Any, defects: Any, raw: RawLayout | None) -> Known:
    """The same with maps from frames: the mask first, so that the others are without defects."""
    shape = known.camera.output_shape
    if defects is not None:
        mask = np.asarray(defects) if isinstance(defects, np.ndarray) else load_frame(Path(defects), raw=raw).array
        if mask.shape != shape:
            raise InputError("the mask has another size than the frames", where="defects", value=mask.shape, allowed=str(shape))
        known = replace(known, maps={**known.maps, "defects": mask != 0})
    for given, source_id, what in ((dark, "sensor.dsnu", "dark"), (flat, "sensor.prnu", "flat")):
        if given is None:
            continue
        mean = _mean_frame(given, known, what, raw)
        until = next(e.name for e in known.camera.active if e.source.id == source_id)
        signal = _signal_of(mean[None], shape, Kind.CODES, known.camera)
        found = correct_signal(known.camera, signal, known.maps, skip=known.skip, until=until)[0].data[0].astype(float)
        if what == "flat":
            found = _response_of(found, _is_mosaic(known.camera))
        known = replace(known, maps={**known.maps, MAP_OF[source_id]: found.astype(np.float32)})
    return known


def _is_mosaic(camera: Camera) -> bool:
    """Whether neighbours of the frame have colour filters of their own."""
    there = {e.source.id for e in camera.active}
    return any(name in there and other not in there for name, other in HIDDEN_BY.items())


def _response_of(flat_dn: np.ndarray, mosaic: bool = False) -> np.ndarray:
    """Relative response of every pixel, by the mean frame of an even field over its smooth light; 1 for pixels that hardly respond.

    In a mosaic the pixels of each colour are held against the light that they see.
    """
    if mosaic:
        out = np.empty_like(flat_dn)
        for i, j in np.ndindex(2, 2):
            out[i::2, j::2] = _response_of(flat_dn[i::2, j::2])
        return out
    light = fit_surface(flat_dn, SURFACE_DEGREE if min(flat_dn.shape) >= SMALLEST else 0).values
    if light.min() <= 0:
        remedy = "give frames of an even field, well above the dark"
        raise InputError("the flat frames hold no light everywhere", where="flat", value=f"{light.min():.3g} DN", remedy=remedy)
    response = flat_dn / light
    return np.where(response < LEAST_RESPONSE, 1.0, response)


def _mean_frame(given: Any, known: Known, what: str, raw: RawLayout | None) -> np.ndarray:
    """Mean of frames, in codes."""
    shape = known.camera.output_shape
    if isinstance(given, np.ndarray):
        stack = given[None] if given.ndim == 2 else given
        if stack.ndim != 3 or stack.shape[1:] != shape or not len(stack):
            raise InputError("no frames of this camera", where=what, value=f"shape {given.shape}", allowed=f"(n, {shape[0]}, {shape[1]})")
        top = 2**known.bits - 1
        if stack.dtype.kind not in "uif" or not np.isfinite(stack).all() or stack.min() < 0 or stack.max() > top:
            raise InputError("values that this camera cannot store", where=what, allowed=f"numbers from 0 to {top}", remedy="correct them")
        _refuse_clipped(int((stack == top).sum()), stack.size, what)
        return np.asarray(stack.mean(axis=0), np.float32)
    files = picture_files([given] if isinstance(given, str | Path) else given, raw=raw)
    total, at_top = np.zeros(shape), 0
    for path in files:
        frame = load_frame(path, raw=raw).array
        check_frame(frame, str(path), bits=known.bits, shape=shape)
        total += frame
        at_top += int((frame == 2**known.bits - 1).sum())
    _refuse_clipped(at_top, total.size * len(files), what)
    return (total / len(files)).astype(np.float32)


def _refuse_clipped(at_top: int, values: int, what: str) -> None:
    """Refuse frames of which more than single pixels are at the upper end of the range: their mean is that of no light."""
    if at_top > MOST_CLIPPED * values:
        allowed = f"at most {100 * MOST_CLIPPED:g} % at the upper end of the range"
        raise InputError(
            "frames that are clipped",
            where=what,
            value=f"{100 * at_top / values:.3g} % of values",
            allowed=allowed,
            remedy="expose them less",
        )


def _correct_array(frames: np.ndarray, known: Known, sequence: bool = False) -> Correction:
    stack = frames[None] if frames.ndim == 2 else frames
    if stack.ndim != 3 or stack.dtype.kind not in "ui":
        allowed = "whole numbers of shape (rows, cols) or (n, rows, cols)"
        raise InputError("no frames of stored codes", where="frames", value=f"{frames.dtype} of shape {frames.shape}", allowed=allowed)
    top = 2**known.bits - 1
    if stack.size and (int(stack.min()) < 0 or int(stack.max()) > top):
        raise InputError("values that this camera cannot store", where="frames", value=int(stack.max()), allowed=f"0 to {top}")
    stack = stack.astype(np.uint8 if known.bits <= 8 else np.uint16)
    said: list[tuple[FrameCorrection, ...]] = []
    for i, frame in enumerate(stack):
        check_frame(frame, f"frames[{i}]", bits=known.bits, shape=known.shape_of(frame))
    shown = min(known.memory if sequence else 0, len(stack) - 1)  # the frame of which the steps are told
    active = known.lit(stack)
    clipped = (active == 0) | (active == top)
    early = [range(max(0, i - known.memory) if sequence else i, i) for i in range(len(stack))]  # the frames before each
    name, factors = known.followed() if sequence else "", Factors()
    if name:
        lights = (known.corrected(f, before=list(stack[early[i]]), until=name)[0].data[0] for i, f in enumerate(stack))
        factors = Factors.of([FrameLight.of(light, ends) for light, ends in zip(lights, clipped, strict=True)])
    out = np.empty(active.shape, np.float32)
    for i, frame in enumerate(stack):
        corrected, steps = known.corrected(frame, i == shown, list(stack[early[i]]), factors.cut(early[i].start, i + 1))
        out[i] = corrected.data[0]
        said.append(factors.told(name, steps))
    return Correction(_together(said), out, steps=said[shown] if said else (), clipped=clipped, clipped_pixels=int(clipped.sum()))


def _check_pixels(known: Known) -> None:
    """Refuse a finer grid of values that are no pixels of the sensor: it undoes the light-sensitive area of one pixel."""
    camera, where = known.camera, "shifts"
    mosaic = next((e.name for e in camera.active if e.source.id in HIDDEN_BY), None)
    if mosaic is not None:
        raise InputError("neighbouring pixels have colours of their own", where=where, value=mosaic, allowed="a camera without a mosaic")
    if not any(e.source.id == APERTURE for e in camera.active):
        camera = with_source(replace(camera, chain=tuple(e for e in camera.chain if e.source.id != APERTURE)), APERTURE)
    element = next(e for e in camera.active if e.source.id == APERTURE)
    frame = _signal_of(np.zeros((1, *camera.output_shape), np.uint8), camera.output_shape, Kind.CODES, camera)
    if _on_grid_of(camera, element, frame) is None:
        remedy = "sample by the pixel clock, and store the rows of the sensor"
        raise InputError("the stored pixels are not those of the sensor", where=where, value=camera.name, remedy=remedy)


def _put_together(made: Correction, known: Known, shifts: Any, finer: Any) -> Correction:
    """Corrected frames as one on a finer grid."""
    assert made.frames is not None
    found = finer_image(made.frames, known.camera, shifts, finer)
    name = next((e.name for e in known.camera.active if e.source.id == APERTURE), APERTURE)
    source = sources()[APERTURE]
    does = (getdoc(source.correct) or "").partition("\n")[0]
    step = FrameCorrection(name, source.title, True, f"corrected: {found.text}", does, source.leaves, found.noise_rel)
    steps = (*(s for s in made.steps if s.name != name), step)
    said = {**{key: text for key, text in made.sources.items() if key != name}, name: step.text}
    return replace(made, sources=said, frames=found.image_dn[None], steps=steps, finer=found)


def _correct_files(
    frames: Sequence[str | Path],
    known: Known,
    output: Path,
    layout: RawLayout | None,
    progress: Progress | None,
    sequence: bool = False,
    shifts: Any = None,
    finer: Any = None,
) -> Correction:
    from tifffile import imwrite

    files = _named_once(picture_files(frames, raw=layout))
    hashes = InputHashes(files[0].parent)
    told = progress or no_progress
    top = 2**known.bits - 1
    memory, name, factors = (known.memory, known.followed(), Factors()) if sequence else (0, "", Factors())
    shown = min(memory, len(files) - 1)  # the frame of which the steps are told

    def loaded_with(i: int) -> tuple[LoadedFrame, list[np.ndarray]]:
        loaded = load_frame(files[i], raw=layout)
        check_frame(loaded.array, str(files[i]), bits=known.bits, shape=known.shape_of(loaded.array))
        before = [load_frame(path, raw=layout).array for path in files[max(0, i - memory) : i]] if memory else []
        for path, frame in zip(files[max(0, i - memory) : i], before, strict=False):
            check_frame(frame, str(path), bits=known.bits, shape=loaded.array.shape)
        return loaded, before

    def ends(frame: np.ndarray) -> np.ndarray:
        lit = known.lit(frame[None])[0]
        return np.asarray((lit == 0) | (lit == top))

    def light(i: int) -> FrameLight:
        loaded, before = loaded_with(i)
        return FrameLight.of(known.corrected(loaded.array, before=before, until=name)[0].data[0], ends(loaded.array))

    def work(i: int) -> tuple[Path, LoadedFrame, np.ndarray, tuple[FrameCorrection, ...], int]:
        loaded, before = loaded_with(i)
        corrected, steps = known.corrected(loaded.array, i == shown, before, factors.cut(i - len(before), i + 1))
        return files[i], loaded, corrected.data[0], factors.told(name, steps), int(ends(loaded.array).sum())

    said: list[tuple[FrameCorrection, ...]] = []
    clipped: dict[str, int] = {}
    kept: list[np.ndarray] = []  # of shifted frames
    of = [*known.files, *dict.fromkeys(path if path.is_dir() else path.parent for path in map(Path, frames))]
    with staged_output(output, "correction", of, [*files, *known.files]) as folder:
        if name:
            lights = []
            for found in imap_tiles(light, range(len(files))):
                lights.append(found)
                told("following the light of the frames", len(lights), len(files))
            factors = Factors.of(lights)
        for i, (path, loaded, data, steps, at_ends) in enumerate(imap_tiles(work, range(len(files)))):
            said.append(steps)
            if at_ends:
                clipped[path.name] = at_ends
            hashes.add(path, loaded.sha256, loaded.size_bytes)
            if shifts is None:
                imwrite(folder / f"{_stem(path)}.tif", data.astype(np.float32))
            else:
                kept.append(data.astype(np.float32))
            told("correcting frames", i + 1, len(files))
        correction = Correction(_together(said), output=output, steps=said[shown], clipped_pixels=sum(clipped.values()))
        if shifts is not None:
            correction = replace(_put_together(replace(correction, frames=np.array(kept)), known, shifts, finer), frames=None)
            assert correction.finer is not None
            imwrite(folder / "finer.tif", correction.finer.image_dn)
            finer_camera(known.camera, correction.finer).save(folder / "camera.yaml")
        record = {
            "schema": "pixmetry/correction/1",
            "unit": "DN above black",
            "sources": correction.sources,
            "steps": {step.name: step.to_record() for step in correction.steps},
            "noise_rel": None if np.isnan(correction.noise_rel) else correction.noise_rel,
            "clipped_pixels": clipped,
            **({} if correction.finer is None else {"finer": correction.finer.to_record()}),
            "provenance": provenance_record(hashes),
        }
        write_json(folder / "correction.json", record)
    return correction


@dataclass(frozen=True)
class Factors:
    """Factors of the frames of a sequence, or why there are none."""

    found: FrameFactors | None = None
    why: str = ""

    @classmethod
    def of(cls, frames: Sequence[FrameLight]) -> Factors:
        """What the frames tell."""
        try:
            return cls(factors_of_frames(frames))
        except MeasureError as problem:
            return cls(why=str(problem))

    def cut(self, first: int, end: int) -> np.ndarray | None:
        """Of a part of the frames."""
        return None if self.found is None else self.found.factor_rel[first:end]

    def told(self, name: str, steps: tuple[FrameCorrection, ...]) -> tuple[FrameCorrection, ...]:
        """The steps, with what the factors are, or why there are none, at the source of that name."""
        if not name:
            return steps
        if self.found is None:
            return tuple(replace(s, text=f"not corrected: {self.why}") if s.name == name else s for s in steps)
        low, high, u = (float(v) for v in (self.found.factor_rel.min(), self.found.factor_rel.max(), np.median(self.found.u_rel)))
        text = f": factors from {low:.3f} to {high:.3f}, u {u:.1g}"
        return tuple(replace(s, text=s.text + text) if s.name == name and s.corrected else s for s in steps)


def _together(said: Sequence[tuple[FrameCorrection, ...]]) -> dict[str, str]:
    """What was done to all frames in a sentence a source, with the number of frames where it is not the same for all."""
    by_name: dict[str, list[str]] = {}
    for step in (step for steps in said for step in steps):
        by_name.setdefault(step.name, []).append(step.text)
    return {name: _sentence(texts) for name, texts in by_name.items()}


def _sentence(texts: Sequence[str]) -> str:
    counts = Counter(texts)
    return texts[0] if len(counts) == 1 else "; ".join(f"{text} ({count} of {len(texts)} frames)" for text, count in counts.items())


def _named_once(files: list[Path]) -> list[Path]:
    double = [name for name, count in Counter(map(_stem, files)).items() if count > 1]
    if double:
        raise InputError("two frames have one name", value=double[0], remedy="correct them in two runs")
    return files


def _stem(path: Path) -> str:
    return f"{path.parent.stem}_{path.name}" if is_frame(path) else path.stem


def _as_signal(frame: np.ndarray, camera: Camera) -> Signal:
    return _signal_of(frame[None], camera.output_shape, Kind.CODES, camera)


def _signal_of(
    data: np.ndarray, shape: tuple[int, int], kind: Kind, camera: Camera | None = None, first_frame: int | None = None
) -> Signal:
    """Frames as a signal; of a sequence with the number of the first frame, of others all with the number 0."""
    one = np.ones(len(data))
    exposure_s, temperature_c = (0.01, 20.0) if camera is None else (camera.exposure_s, camera.temperature_c)
    numbers = [0] * len(data) if first_frame is None else list(range(first_frame, first_frame + len(data)))
    grid = Grid.whole(numbers, data.shape[1:])
    return Signal(data, kind, grid, shape, exposure_s * one, 0 * one, temperature_c * one)
