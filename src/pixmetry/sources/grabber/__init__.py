"""Sources of the frame grabber: clamp, clock, sampling, converter."""
