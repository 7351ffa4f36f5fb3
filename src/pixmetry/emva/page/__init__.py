"""The pages of a data sheet, on screen and on paper."""
