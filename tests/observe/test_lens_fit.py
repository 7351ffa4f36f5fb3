"""A lens limited by diffraction is told from a Gaussian one, and its f-number is found blind."""

from __future__ import annotations

import numpy as np
import pytest

from observe.edge_cameras import clean_squares, stored_picture
from pixmetry.camera.catalogue import get_source
from pixmetry.camera.observations import Observations
from pixmetry.camera.stated import StatedFacts
from pixmetry.core.errors import MeasureError
from pixmetry.observe.edge_fit import fit_edges
from pixmetry.observe.edges import responses_of, search_edges
from pixmetry.observe.lens_fit import defocused_response, fit_diffraction, with_other_lens
from pixmetry.sources.optics.point_spread import PointSpread, transfer

LIMIT = 5.5  # u; beyond it once in 3e7
WIDTHS: dict[str, object] = {"width_x_px": 0.9, "width_y_px": 0.8}


@pytest.mark.parametrize("waves", [0.0, 0.1, 0.3])
def test_response_is_that_of_the_source_of_point_spreads(waves: float):
    """Its integral over both sides of the pupil, for λN of one pixel."""
    nu = np.linspace(0, 1.2, 25)
    params = PointSpread(model="diffraction", f_number=4.0, wavelength_nm=550.0, pitch_x_um=2.2, pitch_y_um=2.2, defocus_waves=waves)
    np.testing.assert_allclose(defocused_response(nu, waves), transfer(params, nu, np.zeros(25)), atol=1e-9)


@pytest.mark.parametrize("waves", [0.0, 0.1])
def test_f_number_and_defocus_are_found(waves: float, rng: np.random.Generator):
    """f/4 at 550 nm on pixels of 3.45 µm, which a Gaussian does not describe: N to 0.03, the pixel to 0.01."""
    lens: dict[str, object] = {"model": "diffraction", "f_number": 4.0, "defocus_waves": waves}
    picture = stored_picture(rng, clean_squares(rng, {"optics.point_spread": lens, "sensor.pixel_aperture": WIDTHS}))
    search = search_edges([picture])
    edges = responses_of(search, with_other_lens(fit_edges(search.measured), search.measured))
    measure, pixel = (get_source(name).measure for name in ("optics.point_spread", "sensor.pixel_aperture"))
    assert measure is not None and pixel is not None
    found = measure(Observations(edges=edges, stated=StatedFacts(pitch_x_um=3.45, pitch_y_um=3.45, wavelength_nm=550.0)))
    assert found.settings == {"model": "diffraction"}
    assert abs(found["f_number"].value - 4.0) < LIMIT * found["f_number"].u < LIMIT * 0.06
    assert ("defocus_waves" in found) == (waves > 0)
    if waves:
        assert abs(found["defocus_waves"].value - waves) < LIMIT * found["defocus_waves"].u < LIMIT * 0.004
    for e in pixel(Observations(edges=edges)):
        assert abs(e.value - float(str(WIDTHS[e.name]))) < LIMIT * e.u < LIMIT * 0.02
    with pytest.raises(MeasureError, match="pitch_um"):
        measure(Observations(edges=edges))


def test_a_gaussian_lens_stays_one(rng: np.random.Generator):
    sources: dict[str, dict[str, object]] = {"optics.point_spread": {"sigma_px": 0.4}, "sensor.pixel_aperture": WIDTHS}
    search = search_edges([stored_picture(rng, clean_squares(rng, sources))])
    assert not len(fit_diffraction(search.measured))
    gaussian = fit_edges(search.measured)
    assert with_other_lens(gaussian, search.measured).names == gaussian.names
    assert not len(fit_diffraction([m for m in search.measured if m[0].across == "x"]))
