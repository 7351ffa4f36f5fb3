"""Image coordinates measured in the pictures of a test field, and their numbers."""
