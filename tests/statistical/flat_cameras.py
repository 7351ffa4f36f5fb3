"""Random cameras with one thing that flat frames tell beside the photon transfer, simulated through the whole chain, measured blind."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from pixmetry.assess.job import measure_sources
from pixmetry.camera.camera import Camera, Element, in_order
from pixmetry.camera.catalogue import sources
from pixmetry.core.errors import MeasureError
from pixmetry.core.number import Number
from pixmetry.observe.observe import Group, observe
from pixmetry.scene.files import SeriesModel
from pixmetry.simulate.job import expose_group, plan_series

GAIN = "electronics.gain.gain_dn_per_e"
KINDS = (
    "none", "charge", "sharpening", "blur", "temporal", "taps", "everything", "companding", "median", "demosaic", "mosaic", "columns",
    "telegraph", "outliers",
)  # fmt: skip
OWN = (
    "brighter_fatter", "sharpening", "temporal_noise_reduction", "tap_gain", "companding", "noise_reduction", "bayer_mosaic",
    "column_noise", "telegraph_noise", "defect_correction",
)  # fmt: skip


@dataclass(frozen=True)
class FlatCase:
    """One random camera, and what its estimates should say."""

    kind: str
    camera: Camera
    series: SeriesModel
    truth: dict[str, float]


def flat_case(rng: np.random.Generator, kind: str, shape: tuple[int, int] = (120, 160), levels: int = 10, stack: int = 16) -> FlatCase:
    """Draw a camera; ``everything`` has all that may stand together: repelled charge, taps, lines, patterns, defects, lag, a bend."""
    bits, offset = 12, float(rng.uniform(40, 120))
    gain, noise = float(rng.uniform(0.15, 0.3) if kind == "charge" else rng.uniform(0.2, 0.8)), float(rng.uniform(4, 15))
    top_e = (2**bits - 1 - offset) / gain
    values: dict[str, dict[str, object]] = {
        "optics.shading": {"corner_rel": rng.uniform(0, 0.15), "gradient_x_per_px": rng.uniform(-2e-4, 2e-4)},
        "sensor.quantum_efficiency": {"quantum_efficiency": rng.uniform(0.3, 0.8)},
        "sensor.prnu": {"pixel_std_rel": rng.uniform(0.002, 0.01)},
        "sensor.dark_current": {"rate_e_per_s": rng.uniform(0, 100)},
        "sensor.shot_noise": {},
        "sensor.dsnu": {"pixel_std_e": noise * rng.uniform(0.1, 0.5)},
        "electronics.amplifier_noise": {"white_e": noise},
        "electronics.row_noise": {"row_e": noise * rng.uniform(0, 0.3), "column_e": noise * rng.uniform(0, 0.2)},
        "electronics.gain": {"gain_dn_per_e": gain},
        "grabber.adc": {"bits": bits, "offset_dn": offset},
    }
    truth = {GAIN: gain, "electronics.amplifier_noise.white_e": noise}
    if kind in ("charge", "everything"):
        area = min(rng.uniform(0.06, 0.1) / top_e, 1e-5)
        values["sensor.brighter_fatter"] = {"area_loss_per_e": area, "field_px": rng.choice([0.0, 0.5, 0.7])}
    if kind == "sharpening":
        values["processing.sharpening"] = {"amount": rng.uniform(0.2, 1.5), "sigma_px": rng.uniform(0.6, 1.5)}
    if kind == "blur":
        radius, sigma = int(rng.integers(1, 4)), rng.uniform(0.35, 0.9)
        values["processing.noise_reduction"] = {"method": "gaussian", "radius_px": radius, "sigma_px": sigma}
    if kind == "temporal":
        values["processing.temporal_noise_reduction"] = {"alpha": rng.uniform(0.02, 0.4)}
    if kind == "median":
        values["processing.noise_reduction"] = {"method": "median", "radius_px": int(rng.integers(1, 3))}
    if kind == "demosaic":
        method, colour = str(rng.choice(["bilinear", "malvar"])), str(rng.choice(["green", "red"]))
        pattern = str(rng.choice(["RGGB", "GRBG"]))
        values["processing.demosaic"] = {"method": method, "output": colour, "pattern": pattern}
        shares = {"red": rng.uniform(0.5, 1), "green": 1.0, "blue": rng.uniform(0.4, 1)}
        values["sensor.bayer_mosaic"] = {"pattern": pattern} | shares
    if kind == "mosaic":
        order, split = str(rng.choice(["RGGB", "GRBG", "GBRG", "BGGR"])), rng.normal(0, 0.01)
        shares = {"red": rng.uniform(0.6, 0.9), "green": 1.0, "blue": rng.uniform(0.3, 0.55)}
        values["sensor.bayer_mosaic"] = {"pattern": order, "green_split_rel": split} | shares
    if kind in ("columns", "everything"):
        values["electronics.column_noise"] = {"gain_rel": rng.uniform(2e-4, 2e-3)}
    if kind == "telegraph":
        values["electronics.telegraph_noise"] = {"share": rng.uniform(0.005, 0.05), "amplitude_e": noise * rng.uniform(2, 5)}
        stack = 200
    if kind == "outliers":  # in units of the noise at half of saturation
        noise_dn = float(np.sqrt(0.4 * gain * (2**bits - offset)))
        values["processing.defect_correction"] = {"threshold_dn": int(noise_dn * rng.uniform(0.7, 1.6))}
    if kind == "companding":
        values["processing.companding"] = {"law": str(rng.choice(["root", "linear"])), "transport_bits": int(rng.integers(8, 11))}
    if kind in ("taps", "everything"):
        step, stripes = rng.uniform(0.005, 0.03) * rng.choice([-1, 1]), rng.uniform(0.001, 0.01) * rng.choice([-1, 1])
        values["electronics.tap_gain"] = {"taps": int(rng.choice([2, 4])), "step_rel": step, "odd_even_rel": stripes}
    if kind == "everything":
        values["electronics.nonlinearity"] = {"a1": rng.normal(0, 0.01), "a2": rng.normal(0, 0.01), "reference_dn": 2.0**bits - 1}
        values["sensor.defects"] = {"hot_fraction": 1e-3, "hot_median_e": 30 * noise, "hot_sigma_log": 0.3}
        values["grabber.phase_pattern"] = {
            "amplitude_dn": 0.3 * gain * noise, "frequency_x": 0.21, "frequency_y": -0.13, "moving": bool(rng.random() < 0.5)
        }  # fmt: skip
        values["sensor.image_lag"] = {"lag_rel": 0.005}
    every = sources()
    chain = []
    for source in in_order([every[name] for name in values]):
        own = values[source.id] | ({"bits": bits} if "bits" in source.parameters.model_fields else {})
        chain.append(Element(source.id, source, source.make(own)))
        if source.id.split(".")[1] in OWN:
            truth |= {f"{source.id}.{k}": float(v) for k, v in values[source.id].items() if not isinstance(v, str)}
    camera = Camera(f"flat {kind}", shape, tuple(chain), exposure_s=0.01, unit_seed=int(rng.integers(2**31)))
    efficiency = float(values["sensor.quantum_efficiency"]["quantum_efficiency"])
    series = SeriesModel(
        levels=levels, brightest_photons=0.8 * top_e / efficiency, longest_exposure_s=0.01, stack_frames=stack, stack_rel=0.5
    )
    return FlatCase(kind, camera, series, truth)


def measured(case: FlatCase, seed: int) -> dict[str, Number]:
    """Estimates by ``source.parameter``, limits of what was not found among them; the observer is told bits, exposures and photons."""

    def groups() -> Iterator[Group]:
        for g in plan_series(case.series):
            yield Group(g.kind, g.role, g.exposure_s, g.photons if g.kind == "bright" else None, expose_group(case.camera, g, seed=seed))

    seen = observe(groups(), 12)
    found = dict(measure_sources(seen)[0])
    for name in ("processing.sharpening", "processing.temporal_noise_reduction", "electronics.tap_gain", "sensor.bayer_mosaic"):
        source = sources()[name]
        if name not in found and source.measure is not None:
            try:
                found[name] = source.measure(seen)
            except MeasureError:  # the reason is in the table of what was not measured
                continue
    return {f"{name}.{e.name}": e for name, estimates in found.items() for e in estimates}
