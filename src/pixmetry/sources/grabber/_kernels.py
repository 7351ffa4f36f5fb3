"""Kernels of the grabber: conversion of the analogue line to codes."""

from __future__ import annotations

import numpy as np

from pixmetry.core.jit import jit


@jit
def quantise_ideal(data, factor, offset, top):
    """Return min(max(floor(factor·y + offset + 1/2), 0), top) as uint16."""
    flat = data.reshape(-1)
    out = np.empty(flat.size, np.uint16)
    for i in range(flat.size):
        v = np.floor(np.float64(flat[i]) * factor + offset + 0.5)
        out[i] = np.uint16(min(max(v, 0.0), top))
    return out.reshape(data.shape)


@jit
def quantise_at(data, factor, offset, thresholds):
    """Return how many of the rising thresholds T_1 … T_top the value reaches, as uint16; it starts at the ideal code."""
    top = thresholds.size
    flat = data.reshape(-1)
    out = np.empty(flat.size, np.uint16)
    for i in range(flat.size):
        v = np.float64(flat[i]) * factor + offset
        k = int(min(max(np.floor(v + 0.5), 0.0), np.float64(top)))
        while k > 0 and thresholds[k - 1] > v:
            k -= 1
        while k < top and thresholds[k] <= v:
            k += 1
        out[i] = np.uint16(k)
    return out.reshape(data.shape)
