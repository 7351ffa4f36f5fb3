"""Small data sheets of EMVA 1288, made of numbers and nothing else."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from pixmetry.core.number import LOWER_LIMIT, UPPER_LIMIT, Number
from pixmetry.emva.files.keys import KEYS, key_of
from pixmetry.emva.files.sheets import write_files
from pixmetry.emva.records import MONO, DataSheet, Results


def value(number: float, u: float = math.nan, dof: float = math.inf, unit: str = "1", **more: object) -> Number:
    return Number(number, u, dof, unit, **more)  # type: ignore[arg-type]


def sheet(values: dict[str, Number], release: str = "4.0", channel: str = MONO, **more: object) -> DataSheet:
    result = Results(release, values, more.pop("curves", {}), more.pop("notes", ()), channel)  # type: ignore[arg-type]
    return DataSheet((result,), more.pop("camera", {"name": "K"}), more.pop("conditions", {}), {"seed": 1}, **more)  # type: ignore[arg-type]


def measured(numbers: dict[str, tuple[float, float]], dof: float = math.inf, **more: object) -> DataSheet:
    """A sheet from ``{key: (value, u)}``, in the units of the keys."""
    return sheet({key: value(number, u, dof, key_of(key).unit) for key, (number, u) in numbers.items()}, **more)  # type: ignore[arg-type]


def full(channels: tuple[str, ...] = (MONO,)) -> DataSheet:
    """A sheet with every key, every kind of value, and curves of every type of number."""
    rng = np.random.Generator(np.random.Philox(7))
    results = []
    for channel in channels:
        values = {key: Number(float(rng.normal()), float(rng.gamma(1)), 12.5, about.unit, "a method") for key, about in KEYS.items()}
        values["K_nonlinear"] = Number(1 / 3, 1e-300, math.inf, "DN/e⁻")
        values["DSNU1288_pixel"] = Number(0.31, 0.1, 63.0, "e⁻", "", "σ² < 0 & more: “taken for pattern”", UPPER_LIMIT)
        values["u_e_sat"] = Number(35.5e3, 1.0, math.inf, "e⁻", "", "the series ends below saturation", kind=LOWER_LIMIT)
        values["u_p_min_area"] = Number(math.nan, math.nan, math.nan, "photon/µm²", "", "the pixel's area is not known")
        curves = {
            "PTC": {
                "mean_dn": rng.normal(size=9) * 10.0 ** rng.integers(-300, 300, 9),
                "used": np.arange(9) > 3,
                "saturation": np.array([5.0]),
            },
            "histogram_DSNU": {"bins": np.array([-0.5, math.nan, math.inf]), "values": np.array([3, 0, 2**40]), "model": np.zeros(0)},
            "horizontal_profile_PRNU": {"position": np.arange(4), "mid": np.array([1.0, 2.0, 3.0, -0.0])},
        }
        results.append(Results("4.0", values, curves, (f"note <{channel}>", "µ"), channel))
    camera = {"name": "Kamera „Ä“ & <1>", "bits": 12, "pitch_x_um": None, "temperature_c": 20.5, "taps": [1, 2]}
    conditions = {"photons_u_rel": 0.03, "exposures_s": [1e-5, 0.1], "closed": True}
    return DataSheet(tuple(results), camera, conditions, {"inputs": [{"name": "a.png", "size_bytes": 3}]}, "CC BY-SA 3.0")


def written(sheet: DataSheet, path: Path, kind: str = "") -> Path:
    """The file of a data sheet; its kind by default by the ending of its name."""
    write_files(sheet, {kind or path.suffix[1:]: path})
    return path


def assert_same(a: DataSheet, b: DataSheet) -> None:
    """Bit for bit, NaN equal to NaN, types of arrays included."""
    assert (a.camera, a.conditions, a.provenance, a.licence) == (b.camera, b.conditions, b.provenance, b.licence)
    assert [(r.release, r.channel, r.notes) for r in a.results] == [(r.release, r.channel, r.notes) for r in b.results]
    for one, two in zip(a.results, b.results, strict=True):
        assert {k: repr(v) for k, v in one.values.items()} == {k: repr(v) for k, v in two.values.items()}
        assert {(n, p) for n, c in one.curves.items() for p in c} == {(n, p) for n, c in two.curves.items() for p in c}
        for name, curve in one.curves.items():
            for part, array in curve.items():
                other = two.curves[name][part]
                assert other.dtype.kind == array.dtype.kind and other.shape == array.shape, (name, part)
                np.testing.assert_array_equal(other, array, f"{name}.{part}")
