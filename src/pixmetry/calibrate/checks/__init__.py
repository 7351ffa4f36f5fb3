"""What a calibration's numbers are worth: tests, gross errors, control, variance components, hold-out."""
