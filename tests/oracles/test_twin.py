"""The digital twin of a real camera, read by the public EMVA 1288 reference implementation: the camera's own values.

The twin of data set 001 is made of its frames, takes the whole campaign, and its image files go to the reference implementation in an
environment and a process of its own (``make oracles``), as the camera's do. u of a value is what pixmetry's release ``reference``, whose
values are those of that program, gives for the camera and for the twin: how the value would come out of another series of the same camera.
The frames of the camera are what they are and those of the twin hang on a seed, so nothing is left to chance: a twin that is off by more
than 3 u of the difference is found, whatever the value.
"""

from __future__ import annotations

import json
import math
import os
import subprocess
from pathlib import Path

import numpy as np
import pytest

from pixmetry.assess.digital_twin import digital_twin, of_unit
from pixmetry.assess.job import measure_sources, observe_campaign
from pixmetry.assess.self_test import expose, exposures_of, light_of
from pixmetry.emva.evaluate import standard_values
from pixmetry.emva.records import Measurement
from pixmetry.emva.reduction import measure_frames
from pixmetry.files import load_campaign
from pixmetry.simulate.files import FrameWriter

ROOT = Path(__file__).resolve().parents[2]
PYTHON = ROOT / ".venv-oracles" / "bin" / "python"
SET = Path(os.environ.get("PIXMETRY_DATA", "")) / "emva1288-set-001" / "EMVA1288_Data.txt"
SEED = 1
FAR_U = 3.0

pytestmark = [
    pytest.mark.oracle,
    pytest.mark.skipif(not PYTHON.exists(), reason=f"{PYTHON.parent.parent.name} is not there: make oracles"),
    pytest.mark.skipif(
        not (os.environ.get("PIXMETRY_DATA") and SET.is_file()), reason="PIXMETRY_DATA does not name a folder with emva1288-set-001"
    ),
]


def read_by_reference(descriptor: Path) -> dict[str, float]:
    """All scalar values that the reference implementation prints for a descriptor."""
    command = [str(PYTHON), str(ROOT / "scripts" / "oracles" / "emva1288_results.py"), str(descriptor)]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)["scalars"]


def test_reference_reads_the_twin_as_the_camera(tmp_path: Path) -> None:
    campaign = load_campaign(SET)
    _, seen = observe_campaign(campaign, lambda *told: None)
    twin = of_unit(digital_twin(campaign, measure_sources(seen)[0], seen), seen)

    wanted = exposures_of(campaign)
    rows, cols = campaign.frame_shape
    lines = ["v 3.0", f"n {campaign.bits} {cols} {rows}"]
    writer = FrameWriter(tmp_path, "png", campaign.bits, campaign.frame_count, campaign.frame_shape)
    groups, number = [], 0
    for group in expose(twin, wanted, light_of(wanted, seen), SEED):
        exposure_ns = f"{group.exposure_s * 1e9:.1f}"
        lines.append(f"b {exposure_ns} {group.photons!r}" if group.kind == "bright" else f"d {exposure_ns}")
        frames = [frame() for frame in group.frames]
        for frame in frames:
            lines.append(f"i {writer.write(f'{number:05d}', frame)}")
            number += 1
        groups.append(type(group)(group.kind, group.role, group.exposure_s, group.photons, frames))
    descriptor = tmp_path / "EMVA1288_Data.txt"
    descriptor.write_text("\n".join(lines) + "\n")
    (measured,) = measure_frames(groups, campaign.bits)
    del groups

    own = standard_values(Measurement(seen.photon_transfer, seen.dark_stack, seen.bright_stack), "reference").values
    of_twin = standard_values(measured, "reference").values
    camera, read = read_by_reference(SET), read_by_reference(descriptor)
    differences = {}
    for name, value in camera.items():
        u = math.hypot(own[name].u, of_twin[name].u) if name in own else math.nan
        difference = (read[name] - value) / u if u > 0 else 0.0 if read[name] == value else math.inf
        print(f"{name:<24} camera {value:13.7g}   twin {read[name]:13.7g}   u of the difference {u:10.3g}   {difference:+.2f} u")
        if np.isfinite([value, read[name]]).all():
            differences[name] = difference
        else:  # the root of a negative variance: for both
            assert math.isnan(value) and math.isnan(read[name]), name
    assert len(differences) > 40
    far = {name: difference for name, difference in differences.items() if not abs(difference) <= FAR_U}
    assert not far, far
