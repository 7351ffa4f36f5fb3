"""Start values of a bundle adjustment."""
