"""JPEG compression: rounding of the cosine coefficients of 8 × 8 blocks."""

from __future__ import annotations

import numpy as np

from pixmetry.camera.contribution import Contribution, Probe
from pixmetry.camera.jpeg_tables import BLOCK, cosines, equivalent_quality, steps
from pixmetry.camera.observations import Observations
from pixmetry.camera.signal import Kind, Signal, Windows
from pixmetry.camera.source import Parameters, Source, quantity
from pixmetry.core.arrays import Array
from pixmetry.core.errors import ParameterError
from pixmetry.core.number import Estimates
from pixmetry.core.random import Stream

MOST_ROWS = 65_496  # of one JPEG image, a whole number of blocks


class Jpeg(Parameters):
    """Setting of the coder."""

    quality: int = quantity(90, "1", "quality on the scale of the Independent JPEG Group", ge=1, le=100)


def forward(params: Jpeg, signal: Signal, stream: Stream) -> Signal:
    """Code and decode with the real codec, as grey 8-bit images.

    A frame whose sides are not multiples of 8 is completed by repeating its last row and column, which is what the codec does. The
    blocks of a grey image do not touch each other, so all windows of the batch are laid one below the other and coded as one image.
    """
    if signal.data.size and int(signal.data.max()) > 255:
        raise ParameterError(
            "JPEG stores 8 bits",
            where="storage.jpeg",
            value=int(signal.data.max()),
            allowed="codes 0 to 255",
            remedy="use a converter of 8 bits (grabber.adc bits: 8), or store the frames without JPEG",
        )
    n, rows, cols = signal.data.shape
    pad = ((0, 0), (0, -rows % BLOCK), (0, -cols % BLOCK))
    blocks = np.pad(signal.data, pad, mode="edge").astype(np.uint8)
    step = max(1, MOST_ROWS // blocks.shape[1])
    out = np.empty_like(blocks)
    for a in range(0, n, step):
        tall = blocks[a : a + step].reshape(-1, blocks.shape[2])
        out[a : a + step] = round_trip(tall, params.quality).reshape(-1, *blocks.shape[1:])
    return signal.with_data(np.ascontiguousarray(out[:, :rows, :cols]).astype(signal.data.dtype))


def round_trip(image: np.ndarray, quality: int) -> np.ndarray:
    """Code and decode one grey image, shape (rows, cols), uint8."""
    from imagecodecs import jpeg8_decode, jpeg8_encode

    return jpeg8_decode(jpeg8_encode(np.ascontiguousarray(image), level=quality))


def context(params: Jpeg, windows: Windows, frame_shape: tuple[int, int]) -> Windows:
    """Whole blocks of the raster that starts at pixel (0, 0)."""
    return windows.aligned(BLOCK, BLOCK, frame_shape)


def block_error(image_dn: np.ndarray, quality: int) -> np.ndarray:
    """Error in DN of images (n, rows, cols) whose raster starts at their first pixel: coefficients rounded to their steps."""
    n, rows, cols = image_dn.shape
    padded = np.pad(image_dn, ((0, 0), (0, -rows % BLOCK), (0, -cols % BLOCK)), mode="edge")
    tiles = padded.reshape(n, padded.shape[1] // BLOCK, BLOCK, padded.shape[2] // BLOCK, BLOCK).swapaxes(2, 3)
    transform, step = cosines(), steps(quality)
    coefficients = transform @ (tiles - 128.0) @ transform.T
    whole = np.copysign(np.floor(np.abs(coefficients) / step + 0.5), coefficients)  # halves away from zero, as the codec does
    lost = whole * step - coefficients
    error: Array = (transform.T @ lost @ transform).swapaxes(2, 3).reshape(padded.shape)[:, :rows, :cols]
    return error


def measure(observations: Observations) -> Estimates:
    """Quality: from the tables of the files, if they are JPEG; else from the comb of the coefficients of frames that were decoded."""
    table = observations.storage.table
    if table is not None:
        stored = np.array(table).reshape(BLOCK, BLOCK)
        same = [q for q in range(1, 101) if np.array_equal(steps(q), stored)]
        value, u = (float(same[0]), 0.0) if same else equivalent_quality(stored)
        told = {} if same else {"quality": "the file's table is none of the Independent JPEG Group's: the quality whose steps are alike"}
        return Estimates.from_rows([("quality", value, u, np.inf, "1")], method="quantiser table of the files (ITU-T T.81)", reasons=told)
    return observations.coder(("quality",), where="storage.jpeg")


def propagate(params: Jpeg, probe: Probe) -> Contribution:
    """Propagator P2 with the rounding of the target's own coefficients, the block raster at each of its 64 places; and of whole codes.

    The codec takes 8 bits: a camera of more is brought to 8 bits first.
    """
    scale = 2.0 ** (8 - max(probe.bits, 8))
    shifts = []
    for row in range(BLOCK):
        for col in range(BLOCK):
            image = np.pad(scale * probe.signal_dn, ((0, 0), (row, 0), (col, 0)), mode="edge")
            error = block_error(np.rint(image), params.quality)[:, row:, col:]
            shifts.append(probe.field(error / scale))
    dx, dy = (np.concatenate([s[a] for s in shifts]) for a in (0, 1))
    rounding = probe.white(np.sqrt(1 / 12) / scale)  # the decoder gives whole codes
    return probe.from_shifts(
        dx,
        dy,
        "F",
        beside=rounding,
        model_error=0.25 if params.quality >= 50 else 0.45,  # coarse steps change the target beyond first order
        floor_px=5e-4,
        method="response of the estimator to the rounding of the block coefficients, over all positions in the block raster",
    )


SOURCE = Source(
    id="storage.jpeg",
    title="JPEG compression",
    description="The cosine coefficients of 8 × 8 blocks are rounded. The shift of a target depends on its position in the block.",
    number=35,
    stars=1,
    parameters=Jpeg,
    consumes=(Kind.CODES,),
    after=("sensor", "electronics", "cable", "grabber"),
    typical=Jpeg(quality=90),
    bound=Jpeg(quality=75),
    forward=forward,
    measure=measure,
    propagate=propagate,
    context=context,
    gum_class="F",
    equation="F' = q round(F/q) for every coefficient of a block;  at most σ² = Σ q²/12 / 64",
    typical_size="0.004 px at quality 90, 0.013 px at 50 on a disc of 9 px of 170 DN",
    references=("ITU-T T.81 | ISO/IEC 10918-1, Annexes A and K", "Independent JPEG Group, libjpeg, jcparam.c (scaling of the tables)"),
    advice="Store without loss. If there is no choice, use a quality of at least 95 and large targets.",
    reasons={
        "correct": "all blocks whose coefficients round to the same multiples give the same file. What was rounded off is lost; store "
        "without loss",
        "neutral": "even at quality 100 the coefficients are rounded to whole numbers",
    },
)
