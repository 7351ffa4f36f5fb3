"""What an error source is: one effect on the way from light to number, with four verbs.

A module of a stage makes one ``Source`` record named ``SOURCE``; the catalogue finds it. Verbs are pure functions:

* ``forward(params, signal, stream)`` returns the next ``Signal``; a source with a memory has ``forward(params, signal, stream, state)``
  and returns ``(signal, state)``;
* ``measure(observations)`` returns ``Estimates`` named like the parameters (a subset of them), or raises ``MeasureError``;
* ``correct(params, signal, maps)`` returns the signal with less of the effect; ``maps`` holds what was measured pixel by pixel in this
  unit (``dark_dn``, ``prnu_rel``, ``defects``), whole frames by name, and may be empty; a source of the video line finds the rest of
  the line, all that still acts on the samples but itself, in ``signal.line``, if it is known;
* ``propagate(params, probe)`` returns the ``Contribution`` to a target's position.

A verb that cannot exist is given as a sentence in ``reasons`` instead.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal, get_args, get_origin

import numpy as np

from pixmetry.camera.contribution import Contribution, Probe
from pixmetry.camera.observations import Observations
from pixmetry.camera.signal import Kind, Signal, Windows
from pixmetry.core.config import Model
from pixmetry.core.errors import InputError
from pixmetry.core.number import Estimates
from pixmetry.core.random import Stream

VERBS = ("forward", "measure", "correct", "propagate")
MOVES_POINTS = (  # why a source has no ``correct``
    "it moves points and leaves their grey values: resampling frames would correlate the noise of neighbours, and add an error of its own. "
    "Instead, positions are corrected"
)
STATED_FRAME = (480, 640)  # rows and columns for which a bound is stated that depends on the frame


class Parameters(Model):
    """Base of every source's parameters: frozen, validated, no unknown keys, no NaN or infinity."""


def quantity(default: Any, unit: str, description: str, **bounds: Any) -> Any:
    """A parameter with its unit, meaning and allowed range (``ge``, ``gt``, ``le``, ``lt``)."""
    from pydantic import Field

    return Field(default=default, description=description, json_schema_extra={"unit": unit}, **bounds)


@dataclass(frozen=True, kw_only=True)
class Source:
    """One error source.

    Parameters
    ----------
    id : str
        ``stage.name``, as in ``sensor.prnu``; the stage is the folder.
    title, description : str
        The effect, in a line and in a sentence or two.
    number, stars, note : int, int, str
        Row of the handbook's error table (0 for an effect that is not in it), its stars, its note.
    parameters : type
        Class of the parameters.
    consumes : tuple of Kind
        Kinds it accepts.
    produces : Kind, optional
        The kind it makes, if it converts.
    after, before : tuple of str
        Sources (or whole stages) that must come earlier or later in a camera.
    essential : bool
        A conversion without which the chain does not reach its end: it is never switched off in a budget.
    neutral : parameters, optional
        Values at which ``forward`` is the identity; where there are none, ``reasons["neutral"]`` says why.
    typical, bound : parameters
        Usual values, and the largest to expect of a sound camera: the bound enters a budget where nothing was measured.
    bound_over : callable, optional
        ``bound_over(frame_shape)``: the bound in a frame of this size, for a source with parameters per pixel or per row whose effect adds
        up over the frame; ``bound`` is that of `STATED_FRAME`.
    ideal : callable, optional
        ``ideal(params)``: an essential conversion with errors of its own, without them; a budget compares with that one.
    context : callable, optional
        ``context(params, windows, frame_shape) -> Windows``: the input it needs to make these windows; by default the windows.
    near : callable, optional
        ``near(params) -> (up, down, left, right)`` pixels that the budget's frozen mode keeps of a far context; what lies farther is
        taken from the noise-free frame. By default the exact context is used in that mode too. Of a source of the video line, ``near`` and
        ``tail`` take ``(params, pixel_hz, row_px)``: the camera's pixel clock, and the pixels of a row.
    tail : callable, optional
        ``tail(params)``: the largest share of a pixel's signal that reaches beyond ``near``; the frozen mode's stated error.
    reshape : callable, optional
        ``reshape(params, frame_shape)``: rows and columns of the frame that it puts out, if they differ from those that it takes.
    place : callable, optional
        ``place(params, x_px, y_px, frame_shape, frame)``: where points of its input frame, of that number, lie in its output frame, if it
        moves whole pixels.
        (Sources of ``light`` and ``video`` need none: the camera follows their maps.)
    truth : callable, optional
        ``truth(params, signal, stream)``: what it does in this unit and these frames, as named arrays: maps (rows, cols) of the unit,
        masks, shifts (n, rows) of every row; ``signal`` is a batch of whole frames of the kind that it takes, of which only the grid, times
        and sizes count.
    maps : mapping
        Arrays of one measured unit that ``forward`` takes from its stream (``known_fixed``, ``known_unit``) in place of what it would draw:
        by name, the parameters that they stand for.
    start : callable, optional
        ``start(params)``: the state before frame 0, for a source with a memory; None where it has none with these parameters.
    applies_to : tuple of str
        Kinds of camera that can have it: of ``digital``, ``analogue``, ``ccd``, ``cmos``, ``cid``; empty for all.
    option : str
        What a camera must have for this source to be in it, where most have not: ``a colour mosaic``. A budget counts it only where the
        camera's chain holds it.
    part_of : str
        Id of the source whose row in a budget holds it already: its own row is told, and does not count.
    held_by : tuple of str
        Sources under whose names frames without targets show all of it. A budget in which these are measured does not count it once more.
    gum_class : str
        Class of its contribution, see ``camera.contribution``.
    equation, typical_size : str
        For the listing and the docs.
    references : tuple of str
    leaves : str
        What ``correct`` leaves of it, or adds.
    advice : str
        What to do about it when it is among the largest.
    reasons : mapping
        For every verb that is missing (and for ``neutral``): why.
    """

    id: str
    title: str
    description: str
    parameters: type[Parameters]
    consumes: tuple[Kind, ...]
    typical: Parameters
    bound: Parameters
    gum_class: str
    equation: str
    typical_size: str
    references: tuple[str, ...]
    advice: str
    number: int = 0
    stars: int = 0
    note: str = ""
    produces: Kind | None = None
    after: tuple[str, ...] = ()
    before: tuple[str, ...] = ()
    essential: bool = False
    neutral: Parameters | None = None
    forward: Callable[..., Any] | None = None
    measure: Callable[[Observations], Estimates] | None = None
    correct: Callable[[Any, Signal, Mapping[str, np.ndarray]], Signal] | None = None
    propagate: Callable[[Any, Probe], Contribution] | None = None
    context: Callable[[Any, Windows, tuple[int, int]], Windows] | None = None
    ideal: Callable[[Any], Any] | None = None
    bound_over: Callable[[tuple[int, int]], Any] | None = None
    near: Callable[..., tuple[int, int, int, int]] | None = None
    tail: Callable[..., float] | None = None
    reshape: Callable[[Any, tuple[int, int]], tuple[int, int]] | None = None
    place: Callable[[Any, np.ndarray, np.ndarray, tuple[int, int], int], tuple[np.ndarray, np.ndarray]] | None = None
    truth: Callable[[Any, Signal, Stream], Mapping[str, np.ndarray]] | None = None
    maps: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    start: Callable[[Any], Any] | None = None
    applies_to: tuple[str, ...] = ()
    option: str = ""
    leaves: str = ""
    part_of: str = ""
    held_by: tuple[str, ...] = ()
    reasons: Mapping[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.bound_over is not None and self.bound != self.bound_over(STATED_FRAME):
            raise ValueError(f"{self.id}: its bound is not that of {STATED_FRAME[0]} × {STATED_FRAME[1]} pixels")
        silent = [v for v in VERBS if getattr(self, v) is None and not self.reasons.get(v)]
        if silent:
            raise ValueError(f"{self.id}: no reason given for the missing verb {', '.join(silent)}")
        if self.neutral is None and not self.reasons.get("neutral"):
            raise ValueError(f"{self.id}: neither neutral parameters nor the reason why there are none")
        if (self.near is None) != (self.tail is None):
            raise ValueError(f"{self.id}: near and tail come together")

    @property
    def stage(self) -> str:
        """Stage of the source: the folder of its module."""
        return self.id.split(".")[0]

    @property
    def verbs(self) -> dict[str, bool]:
        """Which of the four verbs it has."""
        return {verb: getattr(self, verb) is not None for verb in VERBS}

    @property
    def units(self) -> dict[str, str]:
        """Unit of every parameter."""
        extras: dict[str, Any] = {n: f.json_schema_extra or {} for n, f in self.parameters.model_fields.items()}
        return {n: extra.get("unit", "") for n, extra in extras.items()}

    def bound_of(self, frame_shape: tuple[int, int]) -> Any:
        """The largest to expect of a sound camera whose frames have this size."""
        return self.bound if self.bound_over is None else self.bound_over(frame_shape)

    def window_needed(self, params: Any, windows: Windows, frame_shape: tuple[int, int]) -> Windows:
        """The input windows that it needs for these output windows."""
        return windows if self.context is None else self.context(params, windows, frame_shape)

    def make(self, values: Mapping[str, Any] | None = None, where: str = "") -> Parameters:
        """Validated parameters from plain values; ``InputError`` states the error."""
        from pixmetry.core.config import validate

        return validate(self.parameters, dict(values or {}), where or self.id)


def run(source: Source, params: Any, signal: Signal, stream: Stream, state: Any = None) -> tuple[Signal, Any]:
    """Call ``forward`` of any source, with or without a memory."""
    if source.forward is None:
        raise TypeError(f"{source.id} cannot stand in a camera: {source.reasons['forward']}")
    if source.start is None:
        return source.forward(params, signal, stream), None
    following: tuple[Signal, Any] = source.forward(params, signal, stream, source.start(params) if state is None else state)
    return following


def cut_rows(maps: Mapping[str, np.ndarray], name: str, signal: Signal, along: Literal["rows", "cols"] = "rows") -> np.ndarray:
    """Cut what is told of every row (or column) of these frames, shape (n, rows of the frame), to the windows of a signal, as float32.

    Raises
    ------
    InputError
        If it is missing, or is not of these frames.
    """
    if name not in maps:
        raise InputError(f"the correction needs {name!r} of these frames", allowed=", ".join(maps) or "nothing was given")
    own, length = maps[name], signal.frame_shape[0 if along == "rows" else 1]
    if own.shape != (len(signal), length):
        raise InputError(f"{name!r} is not of these frames", value=own.shape, allowed=str((len(signal), length)))
    places = signal.rows if along == "rows" else signal.cols
    window: np.ndarray = np.take_along_axis(own, places, axis=1).astype(np.float32)
    return window


def cut_map(maps: Mapping[str, np.ndarray], name: str, signal: Signal) -> np.ndarray:
    """Cut a measured whole-frame map to the windows of a signal, shape (n, rows, cols); ``InputError`` if it is missing or too small."""
    if name not in maps:
        raise InputError(
            f"the correction needs the map {name!r}", allowed=", ".join(maps) or "none was given", remedy="assess the camera first"
        )
    if maps[name].shape != tuple(signal.frame_shape):
        raise InputError(
            f"the map {name!r} has another frame size",
            value=maps[name].shape,
            allowed=str(signal.frame_shape),
            remedy="use maps of this camera",
        )
    window: np.ndarray = maps[name][signal.rows[:, :, None], signal.cols[:, None, :]]
    return window


def bounds_text(field: Any) -> str:
    """Write a parameter's allowed range for people, e.g. ``0 to 0.3`` or ``even, odd``; ``field`` is the model's field."""
    if field.annotation is bool:
        return "true, false"
    if get_origin(field.annotation) is Literal:
        return ", ".join(str(v) for v in get_args(field.annotation))
    limits = {name: getattr(m, name) for m in field.metadata for name in ("ge", "gt", "le", "lt") if getattr(m, name, None) is not None}
    low = f"{limits['ge']:g}" if "ge" in limits else f"above {limits['gt']:g}" if "gt" in limits else ""
    high = f"{limits['le']:g}" if "le" in limits else f"below {limits['lt']:g}" if "lt" in limits else ""
    return f"{low} to {high}" if low and high else low and f"{low} or more" or high and f"{high} or less" or "any"
