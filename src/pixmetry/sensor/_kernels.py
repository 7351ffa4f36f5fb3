"""Kernels of the sensor: charge on its way to the output."""

from __future__ import annotations

import numpy as np

from pixmetry.core.jit import jit


@jit
def deferred(transfers, loss, trail_px):
    """Return the share of a packet that falls behind in so many transfers, and the share of the trapped charge set free per pixel."""
    share = -np.expm1(transfers * np.log1p(-loss))
    if share <= 0.0:
        return 0.0, 1.0
    return share, min(share / (transfers * loss * trail_px), 1.0)


@jit
def transfer_lines(data, first, phases, loss, trail_px, beta, reference_e):
    """Move the packets of every column to the register before row 0; line ``first[i] + r`` suffers ``first + r + 1`` pixel steps.

    What falls behind waits in a pool and leaves it geometrically into the pixels that follow. The mean trail is stretched so that the
    first moment of the whole is transfers × loss × trail_px although only 1 − (1 − loss)^transfers is deferred: charge that falls
    behind twice. For ``beta`` other than 1 the loss follows the packet, loss (x / reference)^(beta − 1); the trail does not.
    """
    n, rows, cols = data.shape
    out = np.empty_like(data)
    pool = np.empty(cols, np.float64)
    for i in range(n):
        pool[:] = 0.0
        for r in range(rows):
            transfers = np.float64((first[i] + r + 1) * phases)
            share, free = deferred(transfers, loss, trail_px)
            for c in range(cols):
                x = np.float64(data[i, r, c])
                own = share
                if beta != 1.0:
                    own = 0.0
                    if x > 0.0:
                        own = deferred(transfers, min(loss * (x / reference_e) ** (beta - 1.0), 0.5), trail_px)[0]
                out[i, r, c] = x * (1.0 - own) + pool[c] * free
                pool[c] = pool[c] * (1.0 - free) + own * x
    return out
