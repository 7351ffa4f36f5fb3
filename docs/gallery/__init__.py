"""Experiments of the handbook's chapter on image sensors, made again: plain records of numbers, and the pages that show them."""
