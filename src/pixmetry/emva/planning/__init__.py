"""Before a test: the number of frames, and a check of the set-up."""
