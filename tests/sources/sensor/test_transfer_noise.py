"""Noise of charge on its way out: electrons that fall behind one by one leave flat fields Poisson; traps do what single traps do."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from pixmetry.sources.sensor.charge_transfer import SOURCE, ChargeTransfer
from source_signals import ALPHA, Z, quiet, signal, stream

LEVEL = 9000.0


def moved(rng: np.random.Generator, params: ChargeTransfer, data: np.ndarray, draws: object = None) -> np.ndarray:
    return SOURCE.forward(params, signal(data), draws or stream(rng)).data.astype(float)


@pytest.mark.parametrize(
    "params",
    [
        ChargeTransfer(serial_cti=1e-4),
        ChargeTransfer(parallel_cti=1e-4, phases=2),
        ChargeTransfer(parallel_cti=1e-4, interlaced=True, phases=4),
        ChargeTransfer(parallel_cti=1e-4, serial_cti=1e-4, trail_px=3.0),
    ],
    ids=["register", "columns", "fields", "both, with a trail"],
)
def test_flat_fields_stay_poisson(params: ChargeTransfer, rng: np.random.Generator) -> None:
    """Variance over mean 1 and no covariance with eight neighbours, in the far half of 1.5 million pixels.

    Shares that move would leave 4 to 8 % of the variance out and show 2 to 4 % in a neighbour; 1 % would be seen.
    """
    out = moved(rng, params, rng.poisson(LEVEL, (10, 400, 400)))
    far = out[:, 200:, 200:] - out[:, 200:, 200:].mean(axis=0)
    n = far.size * 0.9
    assert np.array_equal(out, np.rint(out))
    assert far.var() / 0.9 / LEVEL == pytest.approx(1, abs=Z * np.sqrt(2 / n))
    for dr, dc in ((0, 1), (1, 0), (2, 0), (0, 2), (1, 1), (3, 0)):
        near = (far[:, dr:, dc:] * far[:, : 200 - dr, : 200 - dc]).mean() / 0.9 / LEVEL
        assert abs(near) < Z / np.sqrt(n * 0.98), (dr, dc)


def test_a_dim_field_keeps_poissons_whole_law(rng: np.random.Generator) -> None:
    """Three electrons a pixel, a tenth of them late: chi-square over all counts, at 1e-6."""
    out = moved(rng, ChargeTransfer(serial_cti=5e-4), rng.poisson(3.0, (3, 200, 300)))[:, :, 100:]
    counts = np.bincount(out.astype(int).ravel(), minlength=30)[:12]
    expected = stats.poisson.pmf(np.arange(12), 3.0) * out.size
    assert ((counts - expected) ** 2 / expected).sum() < stats.chi2.ppf(1 - ALPHA, 12)


@pytest.mark.parametrize("params", [ChargeTransfer(parallel_cti=2e-4, trail_px=2.5), ChargeTransfer(parallel_cti=1e-4, beta=0.6)])
def test_means_are_those_of_the_shares_and_no_electron_is_lost(params: ChargeTransfer, rng: np.random.Generator) -> None:
    data = np.zeros((1, 300, 400))
    data[0, 250] = 5000.0
    out, mean = moved(rng, params, data)[0], moved(rng, params, data, quiet())[0]
    assert np.array_equal(out.sum(axis=0), np.full(400, 5000.0))
    for k in range(5):
        share = mean[250 + k, 0] / 5000
        tolerance = Z * np.sqrt(5000 * share * (1 - share) / 400)
        assert out[250 + k].mean() == pytest.approx(mean[250 + k, 0], abs=tolerance + 1e-3)
        assert out[250 + k].var() == pytest.approx(5000 * share * (1 - share), rel=Z * np.sqrt(2 / 400) + 0.05, abs=0.2)


def test_fields_are_moved_line_by_line(rng: np.random.Generator) -> None:
    """What row 400 leaves comes in row 402, after 201 steps; each field as a sensor of its own."""
    data = np.zeros((1, 582, 3))
    data[0, 400] = 20_000.0
    params = ChargeTransfer(parallel_cti=1e-4, interlaced=True)
    out = moved(rng, params, data, quiet())[0]
    assert out[401].max() == 0 and out[399].max() == 0
    assert out[402, 0] == pytest.approx(20_000 * 201 * 1e-4 * (1 - 1e-4) ** 201, rel=1e-4)
    scene = rng.uniform(0, 5000, (2, 61, 8))
    both = moved(rng, ChargeTransfer(parallel_cti=1e-3, slow_traps_per_px=2.0, interlaced=True), scene, quiet())
    for field in (0, 1):
        alone = moved(rng, ChargeTransfer(parallel_cti=1e-3, slow_traps_per_px=2.0), scene[:, field::2], quiet())
        assert np.array_equal(both[:, field::2], alone)
    shifted = signal(scene[:, 1:], row0=1, frame_shape=(62, 8))
    assert np.array_equal(SOURCE.correct(params, SOURCE.forward(params, shifted, quiet()), {}).data.round(1), shifted.data.round(1))


def over_single_traps(rng: np.random.Generator, columns: np.ndarray, per_px: int, tau: float, beta: float, well: float) -> np.ndarray:
    """Packets (rows, columns) over every trap of every pixel: filled at once up to the packet's height, released one by one by chance."""
    packets = columns.astype(float).copy()
    for pixel in range(len(columns)):
        height = (np.arange(per_px) + (0.618034 * pixel) % 1) / per_px  # others in every pixel: together they fill the volume evenly
        full = np.zeros((per_px, columns.shape[1]), bool)
        for r in range(pixel, len(columns)):
            freed = full & (rng.random(full.shape) < -np.expm1(-1 / tau))
            full &= ~freed
            packets[r] += freed.sum(axis=0)
            caught = (height[:, None] < (np.maximum(packets[r], 0) / well) ** beta) & ~full
            full |= caught
            packets[r] -= caught.sum(axis=0)
    return packets


def test_traps_scatter_as_single_traps_do(rng: np.random.Generator) -> None:
    """Mean, variance and covariance of neighbours behind a bright block, in a flat field, and in the dark; 6000 columns of 40 rows.

    What is released into the dark scatters, what is released into a packet is caught again and does not: in a flat field traps that
    fill at once smooth the shot noise. Tolerances: sampling at 1e-6, and 4 % for heights that are steps there.
    """
    params = ChargeTransfer(slow_traps_per_px=20.0, slow_release_px=4.0, fill_beta=0.6, trap_well_e=5000.0)
    mean = np.full(40, 400.0)
    mean[14:20] = 2000.0
    mean[28:] = 0.0
    columns = rng.poisson(mean[:, None], (40, 6000))
    ours = moved(rng, params, columns[None])[0]
    single = over_single_traps(rng, columns, 20, 4.0, 0.6, 5000.0)
    change = np.abs(single - columns).mean(axis=1)
    assert np.abs(ours.mean(axis=1) - single.mean(axis=1)).max() < 0.04 * change.max() + 0.5
    for lag in (0, 1):
        a, b = (np.array([np.cov(x[r], x[r + lag])[0, 1] for r in range(39)]) for x in (ours, single))
        scale = np.array([np.sqrt(single[r].var() * single[r + lag].var()) for r in range(39)])
        assert np.abs(a - b).max() < (Z * np.sqrt(2 * 2 / 6000) * scale + 0.04 * scale + 1.0).max(), lag
        dark = slice(28, 36)
        assert a[dark] == pytest.approx(b[dark], rel=0.15, abs=Z * np.sqrt(4 / 6000) * scale[dark].max() + 1.0)
    assert ours[28:32].var(axis=1).min() > 5 > 1 > moved(rng, params, columns[None], quiet())[0, 28:32].var(axis=1).max()
    assert ours[5:14].var(axis=1).mean() < 0.985 * 400
