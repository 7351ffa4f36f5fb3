"""The page kit: templates, drawings, numbers as they are printed, paper.

Records of numbers enter; HTML, SVG and PDF leave. What a page says is decided in the room of its job.
"""
