"""Data sheets on disk: what is written is what is read, and the public format as other programs write and read it."""

from __future__ import annotations

import json
import math
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from data_sheets import assert_same, full, sheet, value, written
from pixmetry.core.errors import InputError
from pixmetry.core.number import Number
from pixmetry.emva.files.json_format import sheet_of_record, to_record
from pixmetry.emva.files.keys import KEYS, plain_unit
from pixmetry.emva.files.sheets import read_sheet
from pixmetry.emva.files.xml_format import sheet_of_xml, xml_text

ROOT = Path(__file__).resolve().parents[2]
PYTHON = ROOT / ".venv-oracles" / "bin" / "python"
CROP = ROOT / "src" / "pixmetry" / "data" / "emva1288-set-001-crop" / "EMVA1288_Data.txt"

# As programs of several makers have written it: sections in upper case, decimal commas, no value, no section at all.
FOREIGN = """\
<?xml version="1.0" encoding="ISO-8859-1"?>
<Results>
  <!-- made by hand -->
  <Sensitivity>
    <K><Section>Sensitivity</Section><Short>System gain \xe4</Short><Unit>$DN/e^-$</Unit><Value>0,28067900812484126</Value></K>
    <U_E_SAT_AREA><Unit>$e^-/\\mu m^2$</Unit><Value>None</Value></U_E_SAT_AREA>
    <index_u_ysat><value> 37 </value></index_u_ysat>
  </Sensitivity>
  <spatial>
    <dsnu1288_pixel><unit>$e^-$</unit><value>nan</value></dsnu1288_pixel>
    <s_2_y_pixel_dark><unit>DN2</unit><value>-6.076950008280098e-03</value></s_2_y_pixel_dark>
    <own_value><unit>p</unit><value>+1.5</value></own_value>
  </spatial>
  <defect_pixel>
    <histogram_dsnu><data><Bins>-1,5 0.0 1e1</Bins><values>1
      2 nan</values><model/></data></histogram_dsnu>
  </defect_pixel>
  <DR><section>sensitivity</section><value>1252.167431726851</value></DR>
  <empty/>
</Results>
""".encode("latin-1")


def refused(path: Path, *words: str) -> None:
    with pytest.raises(InputError) as caught:
        read_sheet(path)
    text = str(caught.value)
    assert "\n" not in text and len(text) < 400, text
    assert all(word in text for word in (*words, path.name)), text


@pytest.mark.parametrize("kind", ["json", "xml"])
@pytest.mark.parametrize("channels", [("mono",), ("R", "Gr", "Gb", "B"), ("Gr",)])
def test_inverse_reading_gives_what_was_written(kind: str, channels: tuple[str, ...], tmp_path: Path) -> None:
    made = full(channels)
    path = written(made, tmp_path / f"sheet.{kind}")
    assert_same(made, read_sheet(path))
    assert [p.name for p in path.parent.iterdir()] == [path.name]


numbers = st.one_of(st.floats(), st.just(math.nan))
texts = st.text(st.characters(codec="utf-8", exclude_categories=["Cc", "Cn"]))
values_drawn = st.builds(
    Number, numbers, st.floats(0) | st.just(math.nan), st.floats(0, exclude_min=True) | st.just(math.nan), st.just("DN"), texts, texts
)


@settings(max_examples=60, deadline=None)
@given(values_drawn, st.lists(numbers), texts)
def test_inverse_any_number_and_text_survives(drawn: Number, array: list[float], name: str) -> None:
    if math.isnan(drawn.value) and not drawn.reason:  # XML gives a reason of its own
        drawn = value(drawn.value, drawn.u, drawn.dof, "DN", reason="-")
    written = sheet({"K": drawn}, curves={"SNR": {"snr": np.array(array)}}, camera={"name": name})
    assert_same(written, sheet_of_record(json.loads(json.dumps(to_record(written), allow_nan=False))))
    assert_same(written, sheet_of_xml(xml_text(written).encode()))


def test_the_record_says_what_the_documentation_says() -> None:
    record = to_record(full())
    assert list(record) == ["schema", "release", "camera", "conditions", "provenance", "licence", "results", "curves", "notes"]
    assert record["schema"] == "pixmetry/emva1288/1" and record["release"] == "4.0"
    assert set(record["results"]) == {*KEYS, "K_nonlinear"}
    nothing = record["results"]["u_p_min_area"]
    assert nothing["value"] is None and nothing["u"] is None and nothing["reason"]
    assert record["results"]["K_nonlinear"]["dof"] == "inf"
    assert record["results"]["DSNU1288_pixel"] == {
        "value": 0.31, "u": 0.1, "dof": 63.0, "unit": "e⁻", "method": "", "reason": "σ² < 0 & more: “taken for pattern”", "is_limit": True,
        "is_lower_limit": False,
    }  # fmt: skip
    assert record["curves"]["PTC"]["used"] == [False] * 4 + [True] * 5
    colour = to_record(full(("R", "B")))
    assert list(colour["channels"]) == ["R", "B"] and set(colour["channels"]["R"]) == {"results", "curves", "notes"}


def test_keys_stay_apart_in_lower_case() -> None:
    assert len({key.lower() for key in KEYS}) == len(KEYS)


def test_sheets_of_other_programs_are_read(tmp_path: Path) -> None:
    path = tmp_path / "other.xml"
    path.write_bytes(FOREIGN)
    (result,) = read_sheet(path).results
    assert result.release == "" and result.channel == "mono"
    got = result.values
    assert {key: v.value for key, v in got.items() if not math.isnan(v.value)} == {
        "K": 0.28067900812484126,
        "index_u_ysat": 37.0,
        "s_2_y_pixel_dark": -6.076950008280098e-03,
        "own_value": 1.5,
        "DR": 1252.167431726851,
    }
    assert {key: v.unit for key, v in got.items()} == {
        "K": "DN/e⁻",
        "u_e_sat_area": "e⁻/µm²",
        "index_u_ysat": "1",
        "DSNU1288_pixel": "e⁻",
        "s_2_y_pixel_dark": "DN²",
        "own_value": "photon",
        "DR": "1",
    }
    assert "None" in got["u_e_sat_area"].reason and "nan" in got["DSNU1288_pixel"].reason
    assert all(math.isnan(v.u) and math.isnan(v.dof) and not v.is_upper_limit for v in got.values())
    curve = result.curves["histogram_DSNU"]
    np.testing.assert_array_equal(curve["bins"], [-1.5, 0.0, 10.0])
    np.testing.assert_array_equal(curve["values"], [1.0, 2.0, math.nan])
    assert curve["model"].size == 0


@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16"])
def test_other_encodings_are_read(encoding: str, tmp_path: Path) -> None:
    text = xml_text(full())
    path = tmp_path / "sheet.xml"
    path.write_bytes(text.replace("UTF-8", encoding.upper().removesuffix("-SIG")).encode(encoding))
    assert_same(full(), read_sheet(path))
    path.write_bytes(json.dumps(to_record(full()), allow_nan=False).encode(encoding))
    assert_same(full(), read_sheet(path))


def test_a_limit_is_no_value_to_other_programs() -> None:
    text = xml_text(full())
    entry = text.partition("<DSNU1288_pixel>")[2].partition("</DSNU1288_pixel>")[0]
    assert "<value>nan</value>" in entry and "<upper_limit>0.31</upper_limit>" in entry


@pytest.mark.parametrize(
    ("written", "plain"),
    [
        ("$DN/e^-$", "DN/e⁻"), ("$e^-$", "e⁻"), ("$e^-/DN$", "e⁻/DN"), ("$e^-/s$", "e⁻/s"), ("$DN/s$", "DN/s"), ("DN2", "DN²"),
        ("$p$", "photon"), ("$e^-/\\mu m^2$", "e⁻/µm²"), ("$p/\\mu m^2$", "photon/µm²"), ("DN/p", "DN/photon"), ("\\%", "%"), ("", "1"),
        (None, "1"), ("dB", "dB"), ("bit", "bit"), ("e-/s", "e⁻/s"), ("DN^2", "DN²"), ("1/px", "1/px"), ("px", "px"), ("um", "µm"),
        ("e-/um^2", "e⁻/µm²"), ("μm", "µm"),
    ],
)  # fmt: skip
def test_units_have_one_spelling(written: str | None, plain: str) -> None:
    assert plain_unit(written) == plain


def test_units_of_the_keys_are_plain() -> None:
    assert all(plain_unit(about.unit) == about.unit for about in KEYS.values())


LAUGHS = '<!DOCTYPE r [<!ENTITY a "ha">' + "".join(f'<!ENTITY {b} "{f"&{a};" * 10}">' for a, b in zip("abcdefgh", "bcdefghi", strict=True))
GOOD = json.dumps(to_record(sheet({"K": value(0.28, 0.01, 9.0, "DN/e⁻")})))


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", ["empty"]),
        ("v 3.0\nn 12 2 2\n", ["neither JSON nor XML"]),
        (LAUGHS + "]><results><a><K><value>&i;</value></K></a></results>", ["document type definition"]),
        ('<!DOCTYPE r SYSTEM "file:///etc/passwd"><results/>', ["document type definition"]),
        ("<results><a><K><value>&x;</value></K></a></results>", ["not valid XML", "line 1"]),
        ("<results><a>", ["not valid XML"]),
        ('<?xml version="1.0" encoding="no-such"?><results/>', ["not valid XML"]),
        ("<html><body/></html>", ["not a result", "html"]),
        ("<results><a/></results>", ["holds no value"]),
        ("<results><a><K><value>0.2x</value></K></a></results>", ["K", "not a number", "0.2x"]),
        ("<results><a><K><value>1.234,5</value></K></a></results>", ["not a number"]),
        ("<results><a><K><value>1</value></K><k><value>1</value></k></a></results>", ["K", "given twice"]),
        ("<results><a><K><value>1</value><u>-1</u></K></a></results>", ["negative uncertainty"]),
        (
            "<results><a><histogram_PRNU><data><bins>1 b</bins></data></histogram_PRNU></a></results>",
            ["not a number", "histogram_PRNU.bins"],
        ),
        (
            '<results schema="x/2"><info><sheet><value>None</value></sheet><K><value>1</value></K></info></results>',
            ["another kind", "x/2"],
        ),
        ("{", ["not valid JSON", "line 1"]),
        ('{"a": ' + "[" * 100_000, ["not valid JSON"]),
        ('{"a": 1, "a": 2}', ["'a' is given twice"]),
        ('{"schema": "pixmetry/results/1"}', ["not a data sheet", "pixmetry/results/1"]),
        (GOOD.replace("0.28", "NaN"), ["NaN"]),
        (GOOD.replace("0.28", '"0.28"'), ["K.value", "not a number"]),
        (GOOD.replace("0.28", "1" + "0" * 400), ["K.value", "too large"]),
        (GOOD.replace("0.01", "-0.01"), ["negative uncertainty"]),
        (GOOD.replace("9.0", "0"), ["degrees of freedom"]),
        (GOOD.replace('"results"', '"result"'), ["'results' is missing"]),
        (GOOD.replace('"unit": "DN/e⁻"', '"unit": 3').replace('"unit": "DN/e\\u207b"', '"unit": 3'), ["'unit'"]),
        (GOOD.replace('"curves": {}', '"curves": {"PTC": {"a": 3}}'), ["PTC.a", "list"]),
        (GOOD.replace('"curves": {}', '"curves": {"PTC": {"a": ["x"]}}'), ["PTC.a", "not a number"]),
    ],
)
def test_bad_files_give_one_clear_error(text: str, words: list[str], tmp_path: Path) -> None:
    path = tmp_path / "bad.file"
    path.write_text(text)
    refused(path, *words)


def test_paths_that_cannot_be(tmp_path: Path) -> None:
    refused(tmp_path / "nothing.json", "cannot be read")
    refused(tmp_path, "cannot be read")


needs_reference = pytest.mark.skipif(not PYTHON.exists(), reason=f"{PYTHON.parent.parent.name} is not there: make oracles")

READER = """
import json, sys
from emva1288.process.routines import xml_to_dict
d = xml_to_dict(sys.argv[1])
numbers = lambda item: [float(v) for v in item]
print(json.dumps({s: {k: ({p: numbers(a) for p, a in v['data'].items()} if 'data' in v else v['value']) for k, v in part.items()}
                  for s, part in d.items()}))
"""
WRITER = """
import json, logging, sys
from emva1288.process.data import Data1288
from emva1288.process.loader import LoadImageData
from emva1288.process.parser import ParseEmvaDescriptorFile
from emva1288.process.results import Results1288
quiet = {"loglevel": logging.ERROR}
images = ParseEmvaDescriptorFile(sys.argv[1], **quiet).images
results = Results1288(Data1288(LoadImageData(images, **quiet).data, **quiet).data, **quiet)
results.xml(sys.argv[2])
plain = lambda v: {p: [float(x) for x in a] for p, a in v.items()} if isinstance(v, dict) else None if v is None else float(v)
found = {}
for name in json.loads(sys.argv[3]):
    if hasattr(results, name):
        v = getattr(results, name)
        found[name] = plain(v() if callable(v) else v)
print(json.dumps(found))
"""


def run_reference(script: str, *arguments: str) -> dict:
    done = subprocess.run([str(PYTHON), "-c", script, *arguments], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


@pytest.mark.oracle
@needs_reference
@pytest.mark.parametrize("channels", [("mono",), ("R", "Gb")])
def test_reference_implementation_reads_ours(channels: tuple[str, ...], tmp_path: Path) -> None:
    """The same numbers, bit for bit; no value where we have none or a limit."""
    made = full(channels)
    read = run_reference(READER, str(written(made, tmp_path / "ours.xml")))
    found = {(section.partition(".")[2], key): entry for section, part in read.items() for key, entry in part.items()}
    for result in made.results:
        channel = "" if result.channel == "mono" else result.channel.lower()
        for key, v in result.values.items():
            seen = found[channel, key.lower()]
            if v.is_limit or math.isnan(v.value):
                assert seen is None or math.isnan(seen), key
            else:
                assert seen == v.value, key
        for name, curve in result.curves.items():
            for part, array in curve.items():
                np.testing.assert_array_equal(found[channel, name.lower()][part], array.astype(float), f"{name}.{part}")


@pytest.mark.oracle
@needs_reference
def test_we_read_what_the_reference_implementation_writes(tmp_path: Path) -> None:
    """Every value and histogram of its own file, bit for bit, in our units."""
    path = tmp_path / "reference.xml"
    names = [*KEYS, *(f"histogram_{of}{tail}" for of in ("DSNU", "PRNU") for tail in ("", "_accumulated"))]
    own = run_reference(WRITER, str(CROP), str(path), json.dumps(names))
    (result,) = read_sheet(path).results
    assert len(result.values) > 50 and set(result.values) <= set(KEYS) and len(result.curves) == 4
    for key, v in result.values.items():
        assert (own[key] is None and math.isnan(v.value)) or repr(own[key]) == repr(v.value), key
        assert v.unit == KEYS[key].unit, key
    for name, curve in result.curves.items():
        for part, array in curve.items():
            np.testing.assert_array_equal(array, own[name][part], f"{name}.{part}")


def test_reading_needs_no_heavy_library() -> None:
    code = "import sys, pixmetry.emva.files.xml_format; print([m for m in ('scipy', 'pydantic', 'lxml') if m in sys.modules])"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True).stdout.strip() == "[]"
