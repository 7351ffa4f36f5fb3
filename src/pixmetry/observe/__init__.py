"""Frames reduced once to observations: photon transfer, patterns, spectra, defects, histograms.

A campaign's frames enter, each read once; records of numbers (`pixmetry.camera.observations`) leave, which the sources' `measure` reads.
"""
