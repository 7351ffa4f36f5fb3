"""Before a test: how many frames, and whether the set-up is fit for it."""
