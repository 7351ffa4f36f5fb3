"""Small campaigns on disk, written without the code under test."""

from __future__ import annotations

from pathlib import Path

import imagecodecs
import numpy as np

HEAD = """schema: pixmetry/campaign/1
camera: {name: test camera, bits: 12, pitch_um: 5.0, sensor: cmos}
"""
FRAMES = """frames:
  - {kind: dark, exposure_s: 0.01, files: ["d_*.png"]}
  - {kind: bright, exposure_s: 0.01, photons: 1000, files: [b_0.png, b_1.png]}
"""


def put_frame(path: Path, value: int = 100, shape: tuple[int, ...] = (6, 8), dtype: str = "uint16") -> Path:
    """Write a PNG whose pixels are `value`, rising by one along the first row."""
    array = np.full(shape, value, dtype)
    array[0, :4] += np.arange(4, dtype=dtype).reshape((4,) + (1,) * (array.ndim - 2))
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(imagecodecs.png_encode(array))
    return path


def put_campaign(folder: Path, text: str = HEAD + FRAMES) -> Path:
    """Write two dark frames, two bright frames and a manifest; return the manifest."""
    for name, value in (("d_0", 60), ("d_1", 61), ("b_0", 400), ("b_1", 402)):
        put_frame(folder / f"{name}.png", value)
    manifest = folder / "campaign.yaml"
    manifest.write_text(text, encoding="utf-8")
    return manifest


def put_descriptor(folder: Path, text: str, name: str = "set.txt", **kw: str) -> Path:
    """Write a descriptor with the given text, bytes as they come from the encoding."""
    path = folder / name
    path.write_bytes(text.encode(**kw))
    return path
