"""The error sources, one effect a file, in the order in which the light meets them.

Each holds a `Source` record: parameters, forward model, and, where they exist, measurement, correction, bound and contribution. A
stage imports `core` and `camera` only; sources do not see each other.
"""
