"""Calibrating with straight lines, and line jitter from them."""
