"""The project file of a calibration and the tables that it names, as the network that is adjusted."""

from pixmetry.calibrate.project.project import Project, load_project, project_of_pictures

__all__ = ["Project", "load_project", "project_of_pictures"]
