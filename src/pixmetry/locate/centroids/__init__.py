"""Estimators of a target's place from moments, thresholds and operators."""
