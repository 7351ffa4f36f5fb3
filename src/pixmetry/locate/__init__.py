"""Where targets, lines and corners are in an image, with a covariance; and how well they can be located at all.

An image and the camera's noise enter; positions with their covariance, or bounds, leave.
"""
