"""What is taken away from the bench makes the same picture and the same error again, for every note, preset and data sheet."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pixmetry import locate, read_frame, simulate
from pixmetry.bench.notes import NOTES
from pixmetry.bench.picture import found_in, picture_of
from pixmetry.bench.state import Shelf, preset_names, read_state, sheet_names
from pixmetry.bench.take_away import taken_away
from pixmetry.camera.kept_steps import KeptSteps

SHELF, KEPT = Shelf(), KeptSteps()
STATES = {f"note {n.number}": n.state for n in NOTES} | {name: {"camera": name} for name in (*preset_names(), *sheet_names())}


@pytest.mark.parametrize("name", STATES)
def test_the_files_make_picture_and_error_again_to_the_bit(name: str, tmp_path: Path) -> None:
    state: dict[str, Any] = {"side_px": 64, "seed": 3, **STATES[name]}
    layout = SHELF.laid_out(read_state(state))
    shown = picture_of(layout, KEPT)
    for file, text in taken_away(layout).items():
        (tmp_path / file).write_text(text)
    written = simulate(tmp_path / "pictured.yaml", tmp_path / "scene.yaml", tmp_path / "frames", seed=3, window=layout.window)
    frame = read_frame(written / "frame_00000.tif")
    assert np.array_equal(frame, shown.codes) and shown.codes.shape == (64, 64) and np.ptp(shown.codes) > 0
    assert len(NOTES) == 22
    found = found_in(shown, layout, layout.true_px)
    if found.found_px is not None:
        again = locate(frame, estimator=layout.state.estimator, bits=shown.bits)
        places = np.stack([again.x_px + shown.col0, again.y_px + shown.row0], axis=1)
        assert (places == found.found_px).all(axis=1).sum() == 1
