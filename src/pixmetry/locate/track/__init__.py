"""Targets that are known from the frame before: measured near where they are expected, with statistics of what was found."""
