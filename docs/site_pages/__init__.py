"""The documentation site: the pages of the repository, one page for each error source, and the Python API."""
