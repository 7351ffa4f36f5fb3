"""EMVA 1288: the standard's values and curves of a camera, with their uncertainties."""
