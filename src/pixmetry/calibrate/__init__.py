"""Calibrating a camera: lens models, plumb lines, the self-calibrating bundle adjustment, and what its numbers are worth.

Image coordinates or pictures of a field enter; interior orientation, poses and points with their covariance, tests and findings leave.
"""
