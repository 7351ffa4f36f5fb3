"""Networks that cannot be calibrated say so, in one line each; weak ones are named after the adjustment."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from calibrate.networks import simulate
from pixmetry.calibrate.bundle.bundle import adjust
from pixmetry.calibrate.bundle.network import Network
from pixmetry.calibrate.checks.checks import check_determined, check_network, left_out
from pixmetry.core.errors import InputError, MeasureError


def kept(network: Network, keep: np.ndarray) -> Network:
    return replace(network, **{name: getattr(network, name)[keep] for name in ("x_px", "y_px", "image", "point", "covariance_px2")})


def kinds(findings) -> set[str]:
    return {finding.kind for finding in findings}


def fails(error: type[Exception], match: str, network: Network) -> None:
    with pytest.raises(error, match=match) as caught:
        check_network(network)
    assert "\n" not in str(caught.value) and "to do: " in str(caught.value)


def test_sound_networks_pass(rng: np.random.Generator):
    for options in ({}, {"known": "fixed", "field": "plane"}, {"known": "rough", "field": "panels"}, {"cameras": 2}, {"known": "partly"}):
        assert check_network(simulate(rng, images=12, points=60, **options).network) == ()


def test_image_coordinates_in_another_unit(rng: np.random.Generator):
    network = simulate(rng, images=6, points=60).network
    fails(InputError, "as if they were not in pixels.*2048 × 1536", replace(network, x_px=(network.x_px - 1024) * 3.45e-3,
          y_px=(768 - network.y_px) * 3.45e-3))  # fmt: skip
    fails(InputError, "counted from the middle of the frame", replace(network, x_px=network.x_px - 1024, y_px=network.y_px - 768))
    fails(InputError, "lie outside of the frame", replace(network, x_px=2.5 * network.x_px, y_px=2.5 * network.y_px))
    stray = network.x_px.copy()
    stray[3] = 9000.0
    assert kinds(check_network(replace(network, x_px=stray))) == {"outside_frame"}


def test_bars_in_another_unit(rng: np.random.Generator):
    network = simulate(rng, images=6, points=60, known="rough").network
    fails(InputError, r"not in one unit \(m against mm\?\)", replace(network, xyz=network.xyz / 1000))
    fails(InputError, r"not in one unit \(inches against mm\?\)", replace(network, xyz=network.xyz / 25.4))
    longer = replace(network.bars, length=1.6 * network.bars.length)
    assert kinds(check_network(replace(network, bars=longer))) == {"bar_ratio"}
    fails(InputError, "bars contradict the known coordinates", replace(network, bars=longer, u_xyz=np.zeros_like(network.u_xyz)))


def test_one_image(rng: np.random.Generator):
    fails(MeasureError, "IMG_0001: one image of a plane", simulate(rng, images=1, points=60, field="plane", known="fixed").network)
    fails(MeasureError, "one image does not determine points", simulate(rng, images=1, points=60, bars=0).network)
    check_network(simulate(rng, images=1, points=60, known="fixed").network)


def test_points_on_a_line(rng: np.random.Generator):
    for known in ("fixed", "free"):
        network = simulate(rng, images=6, points=30, size=(1000.0, 1e-6, 1e-6), known=known).network
        fails(MeasureError, "all points lie on one line", network)


def test_image_with_points_on_a_line_is_left_out(rng: np.random.Generator):
    network = simulate(rng, images=8, points=60).network
    y = network.y_px.copy()
    mine = network.image == 2
    y[mine] = 300.0 + 0.3 * network.x_px[mine]
    (finding,) = check_network(replace(network, y_px=y))
    assert finding.kind == "images_left_out" and "IMG_0003" in finding.text and "line" in finding.text


def test_groups_without_a_tie_are_named(rng: np.random.Generator):
    network = simulate(rng, images=8, points=60).network
    first = network.image < 3
    apart = kept(network, np.where(first, network.point < 31, network.point >= 29))  # two points in common
    fails(MeasureError, "consists of separate parts.*5 images .IMG_0004.*3 images .IMG_0001, IMG_0002, IMG_0003", apart)
    tied = kept(network, np.where(first, network.point < 33, network.point >= 29))
    assert check_network(tied) == ()
    known = replace(apart, xyz=simulate(rng, images=1, points=60).truth.xyz, u_xyz=np.zeros((60, 3)), bars=replace(
        network.bars, start=network.bars.start[:0], end=network.bars.end[:0], length=network.bars.length[:0], u=network.bars.u[:0]
    ))  # fmt: skip
    assert check_network(known) == ()  # known points hold the groups together


def test_what_is_seen_too_seldom_is_named(rng: np.random.Generator):
    network = simulate(rng, images=8, points=60).network
    few = kept(network, ((network.point != 7) | (network.image == 0)) & ((network.image != 5) | (network.point < 3)))
    findings = {finding.kind: finding.text for finding in check_network(few)}
    assert set(findings) == {"single_points", "images_left_out"} or "loose_bars" in findings
    assert "T8" in findings["single_points"] and "IMG_0006" in findings["images_left_out"]


def test_parallel_planes_do_not_determine_the_principal_distance(rng: np.random.Generator):
    """u(c)/c is about 0.14 for tilts up to 0.5°, 0.01 for 2°, 4e-5 for 50° (0.04 px); the adjustment itself may already give up."""
    level = simulate(rng, images=10, points=80, field="plane", known="fixed", oblique_deg=0.5)
    with pytest.raises(MeasureError, match=r"c is not determined.*the distance.*-(1\.0|0\.999).*tilted"):
        check_determined(adjust(level.network, level.truth))
    hardly = simulate(rng, images=10, points=80, field="plane", known="fixed", oblique_deg=2.0)
    found = {finding.kind: finding.text for finding in check_determined(adjust(hardly.network, hardly.truth))}
    assert "correlation of c with the distances -0.9999" in found["correlation"] or "-1.0" in found["correlation"]
    tilted = simulate(rng, images=10, points=80, field="plane", known="fixed")
    assert check_determined(adjust(tilted.network, tilted.truth)) == ()


def test_principal_point_without_roll_is_named(rng: np.random.Generator):
    simulated = simulate(rng, images=10, points=80, field="plane", known="fixed", oblique_deg=6.0, rolled=False, noise_px=4.0)
    camera = simulated.network.cameras[0]
    held = replace(camera, free=camera.free & (np.arange(len(camera.free)) > 0))  # c is not determined either
    found = check_determined(adjust(replace(simulated.network, cameras=(held,)), simulated.truth))
    advice = {finding.text.split()[0]: finding.advice for finding in found}
    assert "roll the camera by 90°" in advice["xp"] and "roll the camera by 90°" in advice["yp"]


def test_narrow_base_is_named(rng: np.random.Generator):
    simulated = simulate(rng, images=10, points=60, look="frontal")
    found = {finding.kind for finding in check_determined(adjust(simulated.network, simulated.truth))}
    assert "parallel_rays" in found


def test_plane_seen_from_behind_is_named(rng: np.random.Generator):
    simulated = simulate(rng, images=10, points=80, field="plane", known="fixed")
    network, truth = simulated.network, simulated.truth
    result = adjust(network, truth)
    position = truth.position.copy()
    position[4, 2] *= -1
    (finding,) = check_determined(replace(result, state=replace(result.state, position=position)))
    assert finding.kind == "both_sides" and "IMG_0005" in finding.text


def test_images_without_pose_are_named(rng: np.random.Generator):
    simulated = simulate(rng, images=8, points=60)
    position = simulated.truth.position.copy()
    position[2] = np.nan
    result = adjust(simulated.network, replace(simulated.truth, position=position))
    (finding,) = check_determined(result)
    assert finding.kind == "images_left_out" and "IMG_0003" in finding.text


def test_what_goes_with_images_that_are_not_oriented_is_told(rng: np.random.Generator):
    """The last image alone ties ten points to the others; an image of three points was named before and is not named again."""
    simulated = simulate(rng, images=8, points=60)
    network = kept(simulated.network, (simulated.network.image != 5) | (simulated.network.point < 3))
    only = (network.point >= 50) & ~np.isin(network.image, (0, 7))
    network, position = kept(network, ~only), simulated.truth.position.copy()
    position[[5, 7]] = np.nan
    xyz = simulated.truth.xyz.copy()
    xyz[50:] = np.nan
    (finding,) = left_out(network, replace(simulated.truth, position=position, xyz=xyz))
    first = network.point[network.image == 7]
    assert finding.level == "warning" and "IMG_0006" not in finding.text
    assert f"IMG_0008 ({(first < 50).sum()} of its {len(first)} points are determined without it)" in finding.text
    gone = len(np.intersect1d(first[first >= 50], network.point[network.image == 0]))
    assert "1 of 8 images is not oriented and not used" in finding.text and f"go {gone} points" in finding.text


def test_image_coordinates_that_all_lie_at_one_place(rng: np.random.Generator):
    """Millimetres taken for micrometres make a frame of a few pixels; a target of a twentieth of the frame is small, but there."""
    network = simulate(rng, images=6, points=60).network
    centre = np.array(network.cameras[0].sensor.centre)
    for share, place in ((1e-3, centre), (0.008, 1.3 * centre)):
        shrunk = replace(network, x_px=place[0] + share * (network.x_px - centre[0]), y_px=place[1] + share * (network.y_px - centre[1]))
        fails(InputError, "within 2% of the frame about one place.*mm taken for um", shrunk)
    small = [centre[axis] + 0.05 * (values - centre[axis]) for axis, values in enumerate((network.x_px, network.y_px))]
    assert check_network(replace(network, x_px=small[0], y_px=small[1])) == ()
    one = np.where(network.image == network.image[-1], network.point == network.point[-1], True)  # a camera with one image point
    alone = replace(kept(network, one), cameras=network.cameras * 2, camera_of=(np.arange(len(network.images)) == network.image[-1]) * 1)
    check_network(replace(alone, cameras=(network.cameras[0], replace(network.cameras[0], name="two"))))
