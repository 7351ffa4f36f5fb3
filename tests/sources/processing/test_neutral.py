"""The camera's own range of codes, filled in by whoever builds a camera, switches no processing on."""

from __future__ import annotations

import numpy as np
import pytest

from pixmetry.camera.catalogue import sources
from source_signals import stream
from sources.processing.code_frames import codes

STEPS = {i: s for i, s in sources().items() if s.stage == "processing" and "bits" in s.parameters.model_fields}


@pytest.mark.parametrize("source", STEPS.values(), ids=STEPS.keys())
@pytest.mark.parametrize("bits", [8, 12, 16])
def test_bits_alone_leave_the_frame_as_it_is(source, bits, rng: np.random.Generator):
    params = source.make({"bits": bits})
    frame = codes(rng.integers(0, 2**bits, (9, 8)))
    extra = () if source.start is None else (source.start(params),)
    out = source.forward(params, frame, stream(rng), *extra)
    assert np.array_equal((out[0] if extra else out).data, frame.data)
