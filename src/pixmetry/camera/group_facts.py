"""What may be said of one group of frames beside its kind, exposure and light."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class GroupFacts:
    """Facts of a group of frames; None where they were not stated, or are those of the whole campaign.

    Parameters
    ----------
    wavelength_nm : float or None
        Of the light.
    focus_um : float or None
        Setting of the focus of pictures of edges: how far the sensor was from the lens beyond its first place.
    temperature_c : float or None
        Of the sensor, of dark frames at another temperature than that of the campaign.
    densities : tuple of float or None
        Optical densities of the patches of a chart (ISO 14524).
    luminances : tuple of float or None
        Luminances of the patches of a chart, in any unit.
    u_light_rel : float or None
        Relative standard uncertainty of the light of one patch, or of one exposure.
    regions : tuple of (x, y, width, height) or None
        Places of the patches in the frame, in the order of their densities; x and y of the first pixel.
    white : bool or None
        True: the frames show a white sheet in place of the chart, in the same light.
    times_s : tuple of float, or None
        When each frame of a series or sequence was taken.
    temperatures_c : tuple of float, or None
        Of the sensor, in each frame of a series.
    interval_s : float or None
        Time from frame to frame of a series or sequence.
    on_for_s : float or None
        How long the camera had been on when the first frame of a series was taken.
    recorded : bool or None
        Whether the frames were recorded (on video tape, or as a video file) and played again.
    pulsed : bool or None
        Whether moving targets are in the light of two pulses, one for each field.
    band : str or None
        Name of the light of a band, such as that of its lamp.
    filtered : bool or None
        Whether a filter was in front of the lens or the sensor.
    refocused : bool or None
        Whether the lens was focused anew for this band.
    channel : str or None
        ``"red"``, ``"green"`` or ``"blue"``: the one of colour images to measure in.
    """

    wavelength_nm: float | None = None
    focus_um: float | None = None
    temperature_c: float | None = None
    densities: tuple[float, ...] | None = None
    luminances: tuple[float, ...] | None = None
    u_light_rel: float | None = None
    regions: tuple[tuple[int, int, int, int], ...] | None = None
    white: bool | None = None
    times_s: tuple[float, ...] | None = None
    temperatures_c: tuple[float, ...] | None = None
    interval_s: float | None = None
    on_for_s: float | None = None
    recorded: bool | None = None
    pulsed: bool | None = None
    band: str | None = None
    filtered: bool | None = None
    refocused: bool | None = None
    channel: str | None = None
