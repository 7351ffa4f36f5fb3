"""Experiments of the handbook's chapter on image sensors, repeated: plain records of numbers, and the pages that show them."""
