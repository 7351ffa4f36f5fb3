"""Fitting a drawn target to the image."""
