"""YAML settings: what is accepted, and what each refusal says."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from pixmetry.core.config import Model, dump_yaml, load_yaml, validate
from pixmetry.core.errors import InputError


class Part(Model):
    exposure_s: float
    irradiance_uw_per_cm2: float | None = None
    gain: float = 1.0


class Whole(Model):
    parts: tuple[Part, ...]


def refused(text: str, tmp_path: Path) -> str:
    path = tmp_path / "settings.yaml"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(InputError) as caught:
        validate(Whole, load_yaml(path), "settings.yaml")
    return str(caught.value)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("parts:\n  - exposure: 1\n", ["line 2", "parts.1.exposure", "lacks its unit", "exposure_s"]),
        ("parts:\n  - gain: 2\n    exposure_ms: 1\n", ["line 3", "exposure_ms", "another unit", "exposure_s"]),
        ("parts: [{exposure_s: 1, irradiance_mw_per_m2: 3}]", ["another unit", "irradiance_uw_per_cm2"]),
        ("parts: [{exposure_s: 1, gian: 3}]", ["unknown key", "gian", "did you mean `gain`"]),
        ("parts: [{exposure_s: 1, colour: 3}]", ["unknown key", "colour", "allowed: exposure_s", "delete it"]),
        ("parts: [{gain: 1}]", ["exposure_s", "missing"]),
        ("parts: [{exposure_s: 1, 'gain]': 3}]", ["line 1", "unknown key 'parts.1.gain]'", "did you mean `gain`"]),
        ("'a]': 3", ["unknown key 'a]'"]),
        ("parts: [{exposure_s: 10 ms}]", ["not a number", "10 ms", "alone"]),
        ("parts:\n  - exposure_s: .nan\n", ["line 2", "exposure_s", "not a finite number"]),
        ("parts: [{exposure_s: -.inf}]", ["not a finite number"]),
        ("parts: [{exposure_s: 1, gain: 2, gain: 3}]", ["line 1", "'gain' is given twice"]),
        ("parts:\n\t- exposure_s: 1\n", ["line 2", "tab"]),
        ("parts: [{exposure_s: 1}", ["not valid YAML"]),
        ("- 1\n- 2\n", ["keys with values"]),
        ("parts: 3\n", ["'parts' is not a list", "brackets"]),
        ("", ["'parts' is missing"]),
        ("1: 2\n", ["1"]),
        ("parts: [3]", ["'parts.1' holds no keys", "exposure_s, irradiance_uw_per_cm2, gain"]),
        ("a: &a [*a]\n", ["an alias that contains itself"]),
        ("parts:\n  - &p {exposure_s: 1}\n  - {<<: *p, gain: x}\n", ["line 3", "parts.2.gain", "not a number"]),
    ],
)
def test_each_mistake_is_named_with_its_place_and_remedy(text: str, words: list[str], tmp_path: Path) -> None:
    message = refused(text, tmp_path)
    assert "settings.yaml" in message
    for word in words:
        assert word in message
    assert "Traceback" not in message
    assert "pydantic" not in message
    assert "\n" not in message


def test_yaml_is_version_1_2(tmp_path: Path) -> None:
    path = tmp_path / "a.yaml"
    path.write_text("a: 1e4\nb: no\nc: 012\nd: 12:30:00\n", encoding="utf-8")
    assert load_yaml(path) == {"a": 1e4, "b": "no", "c": 12, "d": "12:30:00"}


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16"])
def test_byte_order_mark_and_line_ends_do_not_matter(encoding: str, tmp_path: Path) -> None:
    path = tmp_path / "a.yaml"
    path.write_bytes("name: Prüfstück\r\nbits: 12\r\n".encode(encoding))
    assert load_yaml(path) == {"name": "Prüfstück", "bits": 12}


def test_missing_or_binary_file_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="cannot be read"):
        load_yaml(tmp_path / "none.yaml")
    (tmp_path / "b.yaml").write_bytes(b"a: 1\nb: \xff\x80\n")
    with pytest.raises(InputError, match="line 2.*UTF-8"):
        load_yaml(tmp_path / "b.yaml")


def test_code_in_yaml_is_not_run(tmp_path: Path) -> None:
    path = tmp_path / "a.yaml"
    path.write_text("a: !!python/object/apply:os.system ['true']\n", encoding="utf-8")
    with pytest.raises(InputError, match="not valid YAML"):
        load_yaml(path)


def test_inverse_dump_then_load(tmp_path: Path) -> None:
    path = tmp_path / "a.yaml"
    whole = Whole(parts=(Part(exposure_s=0.1, gain=np.float64(1 / 3)), Part(exposure_s=1e-9, irradiance_uw_per_cm2=2)))
    dump_yaml(whole, path)
    assert validate(Whole, load_yaml(path)) == whole
    dump_yaml({"b": np.int64(3), "a": (np.float32(0.5), None), "c": Path("x/y"), "d": None}, path)
    assert load_yaml(path) == {"b": 3, "a": [0.5, None], "c": "x/y"}
    assert path.read_text(encoding="utf-8").startswith("b:")


def test_settings_cannot_be_changed() -> None:
    with pytest.raises(ValueError, match="frozen"):
        Part(exposure_s=1).gain = 2
