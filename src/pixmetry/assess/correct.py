"""Correction of frames with what an assessment of their camera measured."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from pixmetry.camera.camera import Camera, load_camera
from pixmetry.camera.conversions import SAMPLE, LineSources
from pixmetry.camera.line import Line
from pixmetry.camera.signal import Kind, Signal
from pixmetry.core.checksums import check_file, check_record
from pixmetry.core.errors import InputError
from pixmetry.core.progress import Progress, no_progress
from pixmetry.core.random import Grid
from pixmetry.core.threads import imap_tiles
from pixmetry.files import InputHashes, provenance_record, read_maps, staged_output, write_json
from pixmetry.files.formats import is_frame
from pixmetry.files.images import LoadedFrame, check_frame, load_frame, picture_files
from pixmetry.files.raw_values import RawLayout, layout_of

NOT_THE_CAMERA = ("optics",)  # light and lens of the campaign are not those of the frames to correct


def correct_signal(camera: Camera, signal: Signal, maps: Mapping[str, np.ndarray]) -> tuple[Signal, dict[str, str]]:
    """Correct a batch of stored codes, source by source.

    Parameters
    ----------
    camera : Camera
        With the measured parameters (the digital twin).
    signal : Signal
        Codes.
    maps : mapping of ndarray
        Measured pixel by pixel: ``dark_dn``, ``prnu_rel``, ``defects``.

    Returns
    -------
    Signal
        DN above black, float32.
    dict
        By source, what was done, or why nothing was.
    """
    done: dict[str, str] = {}
    for element in reversed(camera.active):  # the last error is taken out first
        source = element.source
        if source.stage in NOT_THE_CAMERA:
            done[element.name] = "not corrected: these frames have another light and lens than the campaign"
        elif source.correct is None:
            done[element.name] = f"not corrected: {source.reasons['correct']}"
        else:
            try:
                given = replace(signal, line=_rest_of_line(camera, element.name, done, signal))
                corrected = source.correct(element.params, given, maps)
                done[element.name] = "nothing to correct" if corrected is given else "corrected"
                signal = replace(corrected, line=None)
            except InputError as problem:
                done[element.name] = f"not corrected: {problem}"
    return signal, done


def _rest_of_line(camera: Camera, name: str, done: Mapping[str, str], signal: Signal) -> Line | None:
    """The line that still acts on samples as they are stored, without the source of that name; None for one that is not on a line."""
    for i, link in enumerate(camera.links):
        if link.source is SAMPLE and name in (on_line.name for on_line in link.params.links):
            others = [e for e in link.params.links if e.name != name and done.get(e.name) != "corrected"]
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
    """

    sources: Mapping[str, str]
    frames: np.ndarray | None = None
    output: Path | None = None

    def __repr__(self) -> str:
        done = [name for name, text in self.sources.items() if text.startswith("corrected")]
        return f"<Correction of {', '.join(done) or 'nothing'}; {len(self.sources) - len(done)} sources not corrected>"


def correct(
    frames: np.ndarray | str | Path | Sequence[str | Path],
    results: str | Path,
    output: str | Path | None = None,
    *,
    raw: str | RawLayout | None = None,
    progress: Progress | None = None,
) -> Correction:
    """Correct frames with the results of an assessment of their camera.

    Parameters
    ----------
    frames : ndarray, shape (rows, cols) or (n, rows, cols), or path or sequence of path
        Stored codes; or image files, folders of them, stores (``frames.zarr``) or single frames of a store (``frames.zarr/7``). The frames
        of a file with several are written one by one: ``stack.tif`` becomes ``stack_0.tif``, ``stack_1.tif`` …
    results : path
        ``results.json`` of the assessment, or its folder; ``camera.yaml`` and ``maps.zarr.zip`` stand beside it.
    output : path, optional
        Folder for the corrected frames of files, under their own names as TIFF of 32-bit floats in DN above black (rounding them again
        would add noise, and clipping at black would cut it in half); ``correction.json`` says what was done. Needed for files, and for
        files only.
    raw : str or RawLayout, optional
        Of files without a header: ``"1920x1200:Mono12p"``.
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
    >>> import tempfile, numpy as np, pixmetry
    >>> folder = tempfile.mkdtemp() + "/result"
    >>> assessment = pixmetry.assess(output=folder, trials=0)  # of the packaged example
    >>> frame = np.full((60, 60), 200, np.uint16)
    >>> correction = correct(frame, folder)
    >>> correction.frames.shape, correction.frames.dtype
    ((1, 60, 60), dtype('float32'))
    """
    if isinstance(frames, np.ndarray):
        if output is not None:
            remedy = "leave output away, or name files"
            raise InputError("a folder for corrected frames goes with files, not with arrays", where="output", value=output, remedy=remedy)
        return _correct_array(frames, *_load(Path(results)))
    if output is None:
        remedy = "name one, or give the frames as an array"
        raise InputError("the folder for the corrected frames is missing", where="output", remedy=remedy)
    return _correct_files([frames] if isinstance(frames, str | Path) else frames, Path(results), Path(output), raw, progress)


def _correct_array(frames: np.ndarray, bits: int, camera: Camera, maps: Mapping[str, np.ndarray]) -> Correction:
    stack = frames[None] if frames.ndim == 2 else frames
    if stack.ndim != 3 or stack.dtype.kind not in "ui":
        allowed = "whole numbers of shape (rows, cols) or (n, rows, cols)"
        raise InputError("no frames of stored codes", where="frames", value=f"{frames.dtype} of shape {frames.shape}", allowed=allowed)
    top = 2**bits - 1
    if stack.size and (int(stack.min()) < 0 or int(stack.max()) > top):
        raise InputError("values that this camera cannot store", where="frames", value=int(stack.max()), allowed=f"0 to {top}")
    stack = stack.astype(np.uint8 if bits <= 8 else np.uint16)
    done: dict[str, list[str]] = {}
    out = np.empty(stack.shape, np.float32)
    for i, frame in enumerate(stack):
        check_frame(frame, f"frames[{i}]", bits=bits, shape=camera.output_shape)
        corrected, said = correct_signal(camera, _as_signal(frame, camera), maps)
        out[i] = corrected.data[0]
        for name, text in said.items():
            done.setdefault(name, []).append(text)
    return Correction({name: _together(texts) for name, texts in done.items()}, out)


def _correct_files(
    frames: Sequence[str | Path], results: Path, output: Path, raw: str | RawLayout | None, progress: Progress | None
) -> Correction:
    from tifffile import imwrite

    bits, camera, maps = _load(results)
    layout = layout_of(raw)
    files = _named_once(picture_files(frames, raw=layout))
    hashes = InputHashes(files[0].parent)
    told = progress or no_progress
    done: dict[str, list[str]] = {}

    def work(path: Path) -> tuple[Path, LoadedFrame, np.ndarray, dict[str, str]]:
        loaded = load_frame(path, raw=layout)
        frame = loaded.array
        check_frame(frame, str(path), bits=bits, shape=camera.output_shape)
        corrected, said = correct_signal(camera, _as_signal(frame, camera), maps)
        return path, loaded, corrected.data[0], said

    of = [results, *dict.fromkeys(path if path.is_dir() else path.parent for path in map(Path, frames))]
    with staged_output(output, "correction", of, [*files, results]) as folder:
        for i, (path, loaded, data, said) in enumerate(imap_tiles(work, files)):
            for name, text in said.items():
                done.setdefault(name, []).append(text)
            hashes.add(path, loaded.sha256, loaded.size_bytes)
            imwrite(folder / f"{_stem(path)}.tif", data.astype(np.float32))
            told("correcting frames", i + 1, len(files))
        told_of = {name: _together(texts) for name, texts in done.items()}
        write_json(
            folder / "correction.json",
            {"schema": "pixmetry/correction/1", "unit": "DN above black", "sources": told_of, "provenance": provenance_record(hashes)},
        )
    return Correction(told_of, output=output)


def _together(texts: Sequence[str]) -> str:
    """What was done to all frames in a sentence, with the number of frames where it is not the same for all."""
    counts = {text: texts.count(text) for text in dict.fromkeys(texts)}
    return texts[0] if len(counts) == 1 else "; ".join(f"{text} ({count} of {len(texts)} frames)" for text, count in counts.items())


def _load(results: Path) -> tuple[int, Camera, dict[str, np.ndarray]]:
    """Bits of the camera, the camera and its maps, each held against the digest that was taken when it was written."""
    remedy = "name the results.json of an assessment"
    if results.is_dir():
        results = results / "results.json"
    try:
        record = json.loads(results.read_text(encoding="utf-8"))
    except OSError as problem:
        raise InputError("results cannot be read", where=str(results), value=problem.strerror, remedy=remedy) from None
    except (ValueError, RecursionError):
        raise InputError("is not JSON", where=str(results), remedy=f"{remedy}; if this is one, it is damaged: assess again") from None
    if not isinstance(record, dict) or record.get("schema") != "pixmetry/results/1":
        raise InputError("is not the result of an assessment", where=str(results), remedy=remedy)
    digests = check_record(record, str(results))
    for name in ("camera.yaml", "maps.zarr.zip"):
        path = results.parent / name
        if not path.is_file():
            raise InputError(f"{name} is missing beside the results", where=str(results.parent), remedy="assess the camera again")
        if name not in digests:
            remedy = "assess the camera again"
            raise InputError(f"the results contain no digest of {name}", where=str(results), remedy=remedy)
        check_file(path, digests)
    try:
        bits = int(record["camera"]["bits"])
    except (KeyError, TypeError, ValueError):
        raise InputError("damaged results of an assessment", where=str(results), remedy="assess the camera again") from None
    maps, _ = read_maps(results.parent / "maps.zarr.zip")
    return bits, load_camera(results.parent / "camera.yaml"), maps


def _named_once(files: list[Path]) -> list[Path]:
    names = [_stem(p) for p in files]
    double = next((n for n in names if names.count(n) > 1), None)
    if double is not None:
        raise InputError("two frames have one name", value=double, remedy="correct them in two runs")
    return files


def _stem(path: Path) -> str:
    return f"{path.parent.stem}_{path.name}" if is_frame(path) else path.stem


def _as_signal(frame: np.ndarray, camera: Camera) -> Signal:
    one = np.ones(1)
    grid = Grid.whole([0], frame.shape)
    return Signal(frame[None], Kind.CODES, grid, camera.output_shape, camera.exposure_s * one, 0 * one, camera.temperature_c * one)
