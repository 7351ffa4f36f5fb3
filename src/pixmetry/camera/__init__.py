"""What a camera is: sources in the order of the light, the signal that they hand on, and what a source says of itself.

A camera file (or a preset) enters; a `Camera` that makes frames, keeps its unit frozen, and knows its line and its clock leaves. The error
sources themselves are in `pixmetry.sources`, found through the catalogue.
"""
