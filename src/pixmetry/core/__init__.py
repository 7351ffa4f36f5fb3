"""The lowest floor: numbers with their uncertainty, errors, keyed randomness, threads, compiled kernels, files in small.

Knows no camera. Every other room may stand on it.
"""
