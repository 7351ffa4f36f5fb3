"""The same seed on another processor: OpenBLAS is told to take the kernels of others, and frames stay the same bits."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

PROGRAM = """
import hashlib
import numpy as np
from dataclasses import replace
from pixmetry import load_camera
from pixmetry.scene.uniform import Uniform
camera = replace(load_camera("imx264"), frame_shape=(48, 64))
frames = camera.expose(Uniform(5000.0), frames=2, seed=3)
a = np.arange(40.0 * 30).reshape(40, 30) % 7.3
print(hashlib.sha256(np.asarray(frames.data).tobytes()).hexdigest(), repr(float(np.linalg.svd(a)[1].sum())))
"""


def test_frames_are_the_same_bits_with_the_kernels_of_other_processors() -> None:
    said = []
    for core in ("Haswell", "Prescott"):
        environment = {**os.environ, "OPENBLAS_CORETYPE": core}
        ran = subprocess.run([sys.executable, "-c", PROGRAM], capture_output=True, text=True, env=environment, check=False)
        if ran.returncode < 0:
            pytest.skip(f"no processor for {core}")
        assert ran.returncode == 0, ran.stderr
        said.append(ran.stdout.split())
    assert said[0][0] == said[1][0]
    assert float(said[0][1]) == pytest.approx(float(said[1][1]), rel=1e-12)
