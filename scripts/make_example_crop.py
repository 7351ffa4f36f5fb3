"""Make the example campaign in src/pixmetry/data from the full EMVA 1288 reference set 001.

    python scripts/make_example_crop.py PATH/TO/emva1288-set-001

Every frame is kept; of each, 60 x 60 pixels near the centre (rows 160 to 219, columns 240 to 299 of 480 x 640).
"""

from __future__ import annotations

import sys
from pathlib import Path

import imagecodecs
import numpy as np

from pixmetry.files.emva_descriptor import decode_descriptor
from pixmetry.files.files import find_file
from pixmetry.files.images import read_frame

FIRST_ROW, FIRST_COLUMN, SIZE = 160, 240, 60
TARGET = Path(__file__).resolve().parents[1] / "src" / "pixmetry" / "data" / "emva1288-set-001-crop"
DESCRIPTOR = "EMVA1288_Data.txt"

LICENCE = f"""The images in this folder and the descriptor {DESCRIPTOR} are a crop of "EMVA 1288 reference data set 001".

Copyright (C) 2011 Basler AG, Basler Vision Technologies, http://www.baslerweb.com
Author: Dr. Marco Grimm

Licence: Creative Commons Attribution-ShareAlike 3.0 Unported (CC BY-SA 3.0)
Summary: https://creativecommons.org/licenses/by-sa/3.0/
Full text: https://creativecommons.org/licenses/by-sa/3.0/legalcode

Changes made: each of the 300 frames was cropped from 640 x 480 to {SIZE} x {SIZE} pixels (columns {FIRST_COLUMN} to
{FIRST_COLUMN + SIZE - 1}, rows {FIRST_ROW} to {FIRST_ROW + SIZE - 1}, counted from 0) and stored again as PNG without loss; pixel
values are unchanged. The descriptor was given the new width and height and a line that says so; campaign.yaml was added.

This folder, and anything made from it, stays under CC BY-SA 3.0. It is data beside the program, which has its own licence.
"""

MANIFEST = f"""schema: pixmetry/campaign/1
camera:
  name: EMVA 1288 reference set 001 (Basler CCD camera, {SIZE} x {SIZE} pixels)
  bits: 12
  interface: digital
  sensor: ccd
  vendor: Basler AG
  sensor_cols: 640  # of the published frames, of which these are a crop
  sensor_rows: 480
  first_col: {FIRST_COLUMN}
  first_row: {FIRST_ROW}
emva_descriptor: {DESCRIPTOR}
licence: >-
  CC BY-SA 3.0 (https://creativecommons.org/licenses/by-sa/3.0/). Copyright (C) 2011 Basler AG, Basler Vision Technologies;
  author Dr. Marco Grimm. Cropped from 640 x 480 to {SIZE} x {SIZE} pixels, values unchanged; see LICENSE.
"""


def crop_set(source: Path, target: Path) -> int:
    """Crop all frames that the descriptor names, write the four parts of the example, and return the bytes of the images."""
    text = decode_descriptor((source / DESCRIPTOR).read_bytes())
    total = 0
    lines = []
    for line in text.splitlines():
        if line.startswith("n "):
            bits, width, height = line.split()[1:]
            note = f"# Cropped from {width} x {height}: columns from {FIRST_COLUMN}, rows from {FIRST_ROW}; see LICENSE"
            lines += [note, f"n {bits} {SIZE} {SIZE}"]
            continue
        lines.append(line)
        if line.startswith("i "):
            name = line[2:].strip()
            frame = read_frame(find_file(source, name, DESCRIPTOR))
            window = frame[FIRST_ROW : FIRST_ROW + SIZE, FIRST_COLUMN : FIRST_COLUMN + SIZE]
            raw = imagecodecs.png_encode(np.ascontiguousarray(window), level=9, filter=8)  # no filter: noise does not predict its neighbour
            path = target / name.replace("\\", "/")
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(raw)
            total += len(raw)
    # as in the original: CRLF and backslashes
    (target / DESCRIPTOR).write_bytes("\r\n".join([*lines, ""]).encode())
    (target / "LICENSE").write_text(LICENCE, encoding="utf-8")
    (target / "campaign.yaml").write_text(MANIFEST, encoding="utf-8")
    return total


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit("usage: make_example_crop.py FOLDER_OF_THE_FULL_SET")
    print(f"{crop_set(Path(sys.argv[1]), TARGET) / 1e6:.2f} MB of images in {TARGET}")
