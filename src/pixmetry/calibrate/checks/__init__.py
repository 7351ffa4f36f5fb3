"""Quality of a calibration: tests, gross errors, control points, variance components, cross-validation."""
