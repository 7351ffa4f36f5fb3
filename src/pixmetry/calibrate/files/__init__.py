"""A calibration on disk, and in the forms of other programs."""
