"""The handbook's 22 notes as states of the bench: what to look at, and what to move."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

GRABBER, CAMERA, CLOCKED = "pulnix_tm6cn_epix_512", "pulnix_tm6cn", "pulnix_tm6cn_epix_pixelclock"


@dataclass(frozen=True)
class Note:
    """One note.

    Parameters
    ----------
    number : int
    title, text : str
        What it is about; what to move and what to see.
    state : mapping
        See `pixmetry.bench.state.BenchState`.
    view : str
        The view to open: one of those of the page, or empty.
    """

    number: int
    title: str
    text: str
    state: Mapping[str, Any] = field(default_factory=dict)
    view: str = ""


def _added(camera: str, source_id: str, **values: Any) -> dict[str, Any]:
    return {"camera": camera, "add": [source_id], "set": {f"{source_id}.{n}": v for n, v in values.items()}, "chosen": source_id}


NOTES = (
    Note(
        1,
        "The frame grabber warms up",
        "The clock of the grabber is wrong when it is cold, and the image moves along x for an hour. Drag along the hour.",
        {"camera": GRABBER, "scenario": {"state": {"grabber_on_min": 0.0, "camera_on_min": 120.0}}, "chosen": "grabber.clock_warm_up"},
        "hour",
    ),
    Note(
        2,
        "A sampling clock of the grabber's own",
        "10 MHz where the pixels come at 14.1875 MHz: samples are 1.4 pixels wide, so the target is narrow. Move the clock.",
        {"camera": GRABBER, "chosen": "grabber.sampling_clock"},
        "line",
    ),
    Note(
        3,
        "A laser spot and its speckle",
        "Light of a laser on a rough surface has speckle, another on every piece of surface. See its row in the budget; move its contrast.",
        {"camera": CAMERA, "scenario": {"light": {"source": "laser", "f_number": 16.0}}, "chosen": "scene.speckle"},
    ),
    Note(
        4,
        "Two fields, two times",
        "The target moves, and the odd rows look 1/50 s after the even ones: the picture is a comb. Move the speed.",
        {
            "camera": CAMERA,
            "scenario": {"motion": {"speed_px_per_s": 50.0}, "target": {"diameter_px": 14.0}},
            "set": {"exposure_s": 0.001},
            "chosen": "sensor.interlace",
        },
        "fields",
    ),
    Note(
        5,
        "Gamma",
        "With a gamma of 0.45 faint light gets more grey values. It does not move the middle of a round target; it changes its profile.",
        _added(CAMERA, "electronics.gamma", gamma=0.45, reference_dn=255.0),
    ),
    Note(
        6,
        "The low-pass filter of the grabber",
        "It delays the line and smears edges to the right: every target moves. Lower the cutoff, and compare with the picture without it.",
        {"camera": GRABBER, "chosen": "grabber.low_pass"},
        "line",
    ),
    Note(
        7,
        "Video tape",
        "A tape limits the bandwidth, adds noise and shifts each line. Move the generations.",
        {"camera": GRABBER, "scenario": {"storage": {"format": "tape"}}, "chosen": "storage.tape"},
    ),
    Note(
        8,
        "Thresholds",
        "A hard threshold lets whole grey values in and out as the target moves over the pixels, and the error changes with the place. "
        "Choose the estimators hard threshold, soft threshold and template, and compare the curves.",
        {
            "camera": CAMERA,
            "estimator": "hard_threshold",
            "scenario": {"target": {"diameter_px": 4.0}},
            "chosen": "processing.threshold",
        },
        "pixel",
    ),
    Note(
        9,
        "The view-point",
        "A surface looks different from every side, so light falls off over the target. Choose: retro, diffuse, glossy.",
        {"camera": CAMERA, "scenario": {"target": {"surface": "glossy"}}, "chosen": "scene.view_point"},
    ),
    Note(
        10,
        "A sensor that is not flat",
        "Where the sensor lies off its plane, slanting rays meet it elsewhere. Put the target into a corner and raise the bow.",
        {
            "camera": CAMERA,
            "x_px": 690.3,
            "y_px": 60.6,
            "set": {"sensor.unflatness.bow_x_um": 100.0, "sensor.unflatness.chief_ray_deg": 30.0},
            "chosen": "sensor.unflatness",
        },
    ),
    Note(
        11,
        "The video cable",
        "20 m of 50 Ω cable into an input that is left open: the echo comes back and stands beside the target. Shorten the cable.",
        {
            "camera": CLOCKED,
            "set": {"cable.termination.length_m": 20.0, "cable.termination.line_ohm": 50.0, "cable.termination.load_ohm": 1000.0},
            "chosen": "cable.termination",
        },
        "line",
    ),
    Note(
        12,
        "Where the image begins",
        "The grabber stores a part of the picture, which begins in steps of four rows. Move the first row.",
        {"camera": GRABBER, "chosen": "grabber.window_offset"},
    ),
    Note(
        13,
        "Black below zero",
        "If black lies below zero the converter cuts off the feet of the target. Lower the offset of clamp and converter.",
        {
            "camera": GRABBER,
            "set": {"grabber.clamp.offset_dn": -6.0, "grabber.adc.offset_dn": 0.0},
            "scenario": {"target": {"background_rel": 0.0, "blur_px": 1.5}},
            "chosen": "grabber.clamp",
        },
        "pixel",
    ),
    Note(
        14,
        "The colour of the light",
        "A filter for the eye takes most of the light of a red laser off. Move the wavelength of the light, and the edge of the filter.",
        _added(CAMERA, "optics.spectral_filter", light="laser", light_nm=645.0, band="short_pass", cut_nm=650.0, width_nm=30.0),
    ),
    Note(
        15,
        "The camera warms up",
        "The sensor expands and moves in its mount as the camera warms up. Drag along the hour.",
        _added(CAMERA, "sensor.mount_drift", shift_x_px=0.2, shift_y_px=0.1, slow_s=1800.0)
        | {"scenario": {"state": {"camera_on_min": 0.0, "grabber_on_min": 120.0}}, "x_px": 660.3, "y_px": 90.4},
        "hour",
    ),
    Note(
        16,
        "Charge that stays behind",
        "At each transfer a little charge stays behind, and the target is late. Raise the serial inefficiency, far from the read-out.",
        {"camera": "ft_ccd_generic", "x_px": 950.3, "y_px": 950.6, "chosen": "sensor.charge_transfer"},
    ),
    Note(
        17,
        "Noise",
        "In the dark it is the noise of the amplifier, in the light that of the photons. Lower the peak of the target, and see the bars.",
        {"camera": CAMERA, "chosen": "electronics.amplifier_noise"},
        "flat",
    ),
    Note(
        18,
        "Rounding to grey values",
        "With few bits the profile has steps. Take bits off the converter.",
        {"camera": CAMERA, "set": {"grabber.adc.bits": 8}, "scenario": {"target": {"peak_rel": 0.1}}, "chosen": "grabber.adc"},
    ),
    Note(
        19,
        "Line jitter",
        "The grabber finds the start of each line a little early or late: rows shift sideways, and only x suffers. Raise the jitter.",
        {"camera": GRABBER, "set": {"grabber.line_jitter.white_ns": 30.0}, "chosen": "grabber.line_jitter"},
    ),
    Note(
        20,
        "Fixed pattern",
        "In an even field a pattern is seen that is always the same. Look at the flat and at the dark field.",
        {"camera": CLOCKED, "chosen": "grabber.fixed_pattern"},
        "flat",
    ),
    Note(
        21,
        "Between the pixels",
        "A small light-sensitive area leaves gaps, in which a sharp target is not seen. Make the area small and the target sharp.",
        {
            "camera": CAMERA,
            "set": {"sensor.pixel_aperture.width_x_px": 0.3, "sensor.pixel_aperture.width_y_px": 0.3},
            "scenario": {"target": {"diameter_px": 3.0, "blur_px": 0.2}},
            "chosen": "sensor.pixel_aperture",
        },
        "pixel",
    ),
    Note(
        22,
        "Pixels off their places",
        "Where pixels are not in their places a target cannot be located better than that. Raise the scatter of the pixels.",
        _added(CAMERA, "sensor.pixel_geometry", pixel_std_px=0.05),
    ),
)
