"""Finding targets: background, regions, coded targets, grids."""
