"""EMVA 1288: the standard's values and curves of a camera, with their uncertainties.

A campaign enters; a data sheet leaves, and what compares, plans and judges data sheets.
"""
