"""Calibrating a camera: lens models, plumb lines, the self-calibrating bundle adjustment, and what its numbers are worth."""
