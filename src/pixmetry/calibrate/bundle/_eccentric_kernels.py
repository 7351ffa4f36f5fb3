"""Centre of area of the image of a flat target, relative to the image of its centre, by integrals along its outline."""

from __future__ import annotations

import numpy as np

from pixmetry.calibrate.bundle._model_kernels import INTERIOR, image_point
from pixmetry.core.jit import jit


@jit
def area_centres(xyz, first, second, size, image, camera, rotation, position, interior, direction, per_px, place, tangent):
    """Shift of the centre of area against the image of the centre, px, shape (n, 2); NaN where the outline has no image.

    ``first``, ``second``: unit vectors in the target's plane, shape (n, 3); ``size``: what one unit of ``place`` is in the object, (n,).
    ``place``, ``tangent``: nodes of a quadrature along the outline and the weighted steps along it, shape (m, 2). By Green's theorem
    the area is ½ ∮ (x dy − y dx) and its moments are ½ ∮ x² dy and −½ ∮ y² dx, here about the image of the centre.
    """
    n, m = len(size), len(place)
    shift = np.full((n, 2), np.nan)
    by_direction, by_interior = np.empty((2, 2)), np.empty((2, INTERIOR))
    centre, e, f, p, t = np.empty(3), np.empty(3), np.empty(3), np.empty(3), np.empty(3)
    for i in range(n):
        j, k = image[i], camera[image[i]]
        q, mx, my = interior[k], per_px[k, 0], per_px[k, 1]
        for a in range(3):
            centre[a] = e[a] = f[a] = 0.0
            for b in range(3):
                centre[a] += rotation[j, a, b] * (xyz[i, b] - position[j, b])
                e[a] += rotation[j, a, b] * first[i, b] * size[i]
                f[a] += rotation[j, a, b] * second[i, b] * size[i]
        if not centre[2] > 0:
            continue
        x0, y0 = image_point(
            centre[0] / centre[2], centre[1] / centre[2], q, direction[k], mx, my, np.nan, np.nan, by_direction, by_interior
        )
        area = moment_x = moment_y = 0.0
        for o in range(m):
            for a in range(3):
                p[a] = centre[a] + place[o, 0] * e[a] + place[o, 1] * f[a]
                t[a] = tangent[o, 0] * e[a] + tangent[o, 1] * f[a]
            if not p[2] > 0:
                area = np.nan
                break
            u, v = p[0] / p[2], p[1] / p[2]
            du, dv = (t[0] - u * t[2]) / p[2], (t[1] - v * t[2]) / p[2]
            x, y = image_point(u, v, q, direction[k], mx, my, x0, y0, by_direction, by_interior)
            dx = by_direction[0, 0] * du + by_direction[0, 1] * dv
            dy = by_direction[1, 0] * du + by_direction[1, 1] * dv
            x -= x0
            y -= y0
            area += 0.5 * (x * dy - y * dx)
            moment_x += 0.5 * x * x * dy
            moment_y -= 0.5 * y * y * dx
        shift[i, 0], shift[i, 1] = moment_x / area, moment_y / area
    return shift
