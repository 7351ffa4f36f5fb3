"""Targets located and identified in pictures of a test field, as the image coordinates of a network."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

from pixmetry.calibrate.bundle.model import CameraModel
from pixmetry.calibrate.project.coordinates import Measured, image_facts
from pixmetry.calibrate.project.points import Known
from pixmetry.calibrate.project.schema import PicturesModel
from pixmetry.calibrate.project.tables import Table
from pixmetry.core.finding import Finding
from pixmetry.core.progress import Progress


def located(
    wanted: PicturesModel,
    files: Sequence[Path],
    camera: CameraModel,
    images: Table | None,
    progress: Progress | None,
    check: Callable[[tuple[int, int]], None],
) -> tuple[CameraModel, Measured, Known, tuple[Finding, ...]]:
    """Locate the targets of a test field in pictures.

    Parameters
    ----------
    wanted : PicturesModel
    files : sequence of Path
    camera : CameraModel
        Its frame takes the size of the pictures.
    images : Table, optional
        Time and start pose of each picture, by the name of its file.
    progress : callable, optional
    check : callable
        Called with (cols, rows) of the pictures; refuses what is not the size that was expected.

    Returns
    -------
    tuple
        The camera, what was measured, what the test field's description says of its points, and what was found on the way.

    Raises
    ------
    InputError, MeasureError
        If pictures cannot be read, or too few of them show the test field.
    """
    from pixmetry.calibrate.images.images import observations_of

    found = observations_of(files, wanted.kind, **wanted.model_dump(exclude={"files", "kind"}), progress=progress)
    check(found.sizes[0])
    camera_of, time_s, poses = image_facts(images, found.images, [camera], lambda name: name)
    network = found.network(of_size(camera, *found.sizes[0]))
    seen = Measured(
        images=found.images,
        points=found.points,
        camera_of=camera_of,
        time_s=time_s,
        poses=poses,
        **{name: getattr(network, name) for name in ("image", "point", "x_px", "y_px", "covariance_px2", "covariance_known")},
    )
    return network.cameras[0], seen, Known(network.xyz, network.u_xyz, network.diameter, network.normal), found.findings


def of_size(camera: CameraModel, cols: int, rows: int) -> CameraModel:
    """The camera with the size of its pictures; a principal point that was not given stays in the middle of the frame."""
    before, sensor = camera.sensor.centre, replace(camera.sensor, cols=cols, rows=rows)
    middle = {name: new for name, old, new in zip(("xp", "yp"), before, sensor.centre, strict=True) if camera[name] == old}
    return replace(camera, sensor=sensor).with_values(**middle)
