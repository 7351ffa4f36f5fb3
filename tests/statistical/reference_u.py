"""The least uncertainty that the frames of a campaign allow: Cramér-Rao bounds with all weights and variances known.

Written on the raw observations (mean and white mean square of each level, mean squares of the stacks) and on nothing of the package.
Free parameters of the photon transfer: black level, light at zero exposure, slope, gain, dark variance, three coefficients, dark signal
and dark variance per exposure, with the weak priors of a short series (0.1 a coefficient, 5 % of the light at zero exposure).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import ndtr

CLIPPED = 2e-5


@dataclass(frozen=True)
class Reference:
    """What the bound depends on; spreads of the population, light and dark electrons at the longest exposure."""

    shape: tuple[int, int]
    levels: int
    frames: int
    stack_frames: int
    stack_rel: float
    bits: int
    offset_dn: float
    gain: float
    dark_noise_e: float
    row_e: float
    column_e: float
    a: tuple[float, float, float]
    light_e: float
    dark_e: float
    full_well_e: float
    brightest_rel: float
    lamp_rel: float
    dsnu_e: tuple[float, float, float]
    prnu_rel: tuple[float, float, float]
    spread_rel: float

    @property
    def x_ref(self) -> float:
        return 2.0**self.bits - 1

    def curve(self, x: np.ndarray, a: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The bent response and its first two derivatives."""
        w = x / self.x_ref
        f = x * (1 + a[0] * w + a[1] * w**2 + a[2] * w**3)
        f1 = 1 + 2 * a[0] * w + 3 * a[1] * w**2 + 4 * a[2] * w**3
        return f, f1, (2 * a[0] + 6 * a[1] * w + 12 * a[2] * w**2) / self.x_ref

    def lines_dn2(self) -> tuple[float, float]:
        """Temporal row and column variance."""
        return (self.gain * self.row_e) ** 2, (self.gain * self.column_e) ** 2

    def white_dn2(self, share: float, bright: bool) -> float:
        """White temporal variance at a share of the longest exposure, to leading order."""
        electrons = share * (self.light_e * bright + self.dark_e)
        f1 = float(self.curve(np.array(self.gain * electrons), np.array(self.a))[1])
        return self.gain**2 * (electrons + self.dark_noise_e**2) * f1**2 + 1 / 12


def _series(r: Reference) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Share of the longest exposure, whether lit, and number of frames of every level, the stacks among them."""
    share = np.arange(1, r.levels + 1) / r.levels
    both = np.concatenate([share, share, [r.stack_rel, r.stack_rel]])
    bright = np.concatenate([np.zeros(r.levels), np.ones(r.levels), [0.0, 1.0]])
    frames = np.concatenate([np.full(2 * r.levels, r.frames), [r.stack_frames] * 2]).astype(float)
    return both, bright, frames


def _moments(r: Reference, p: np.ndarray, share: np.ndarray, bright: np.ndarray) -> np.ndarray:
    """Mean and white variance of every level, shape (2, n)."""
    offset, light0, slope, gain, dark_var, a1, a2, a3, dark_dn, dark_var_dn2 = p
    light = bright * slope * (share + light0)
    x = light + dark_dn * share
    v = dark_var + gain * light + dark_var_dn2 * share
    f, f1, f2 = r.curve(x, np.array([a1, a2, a3]))
    return np.array([offset + f + 0.5 * f2 * v, f1**2 * v + 1 / 12])


def photon_transfer_u(r: Reference) -> dict[str, float]:
    """Bounds of what the exposure series tells."""
    share, bright, frames = _series(r)
    k = r.gain
    start = np.array([
        r.offset_dn, 0.0, k * r.light_e, k, (k * r.dark_noise_e) ** 2, *r.a, k * r.dark_e, k**2 * r.dark_e,
    ])  # fmt: skip
    step = 1e-5 * np.array([1.0, 1, start[2], k, start[4] + 1e-3, 1, 1, 1, 1, 1])
    row, col = r.lines_dn2()
    # levels of which some pixels are clipped, at the top code or at the full well, tell nothing
    light_e, dark_e = share * r.light_e * bright, share * r.dark_e
    electrons = light_e + dark_e
    full = ndtr((electrons * r.brightest_rel - r.full_well_e) / np.sqrt(electrons + 1))
    mean, var = _moments(r, start, share, bright)
    wide = np.sqrt(var + row + col + (k * r.dsnu_e[0]) ** 2 + (r.spread_rel * k * light_e) ** 2)
    used = (ndtr((mean - r.x_ref) / wide) < CLIPPED) & ((full < CLIPPED) | (bright == 0))
    share, bright, frames, mean, var, electrons = (v[used] for v in (share, bright, frames, mean, var, electrons))
    n = r.shape[0] * r.shape[1]
    jac = np.array([(_moments(r, start + h, share, bright) - _moments(r, start - h, share, bright)) / (2 * h.max()) for h in np.diag(step)])
    f1 = r.curve(k * electrons, np.array(r.a))[1]
    kurtosis = f1**4 * k**4 * electrons / var**2
    information = np.diag([0, 1 / 0.05**2, 0, 0, 0, 100.0, 100.0, 100.0, 0, 0])
    for i in range(share.size):
        j = jac[:, :, i].T
        skew = f1[i] ** 3 * k**3 * electrons[i] / (n * frames[i])
        v_mean = (var[i] / n + row / r.shape[0] + col / r.shape[1]) / frames[i]
        v_ms = var[i] ** 2 * (2 / (frames[i] - 1) + kurtosis[i] / frames[i]) / n
        lamp = j[:, 2] * start[2] * r.lamp_rel * bright[i]
        information += j.T @ np.linalg.inv(np.array([[v_mean, skew], [skew, v_ms]]) + np.outer(lamp, lamp)) @ j
    scale = 1 / np.sqrt(np.diag(information))
    covariance = np.linalg.inv(information * np.outer(scale, scale)) * np.outer(scale, scale)

    def u(gradient: dict[int, float]) -> float:
        g = np.zeros(10)
        for at, value in gradient.items():
            g[at] = value
        return float(np.sqrt(g @ covariance @ g))

    line, lit = _line_u(r), bright > 0
    level_var = (var / n + row / r.shape[0] + col / r.shape[1]) / frames
    k_rel = u({3: 1 / k})
    return {
        "gain": u({3: 1.0}),
        "dark_noise_e": u({4: 0.5 / (r.dark_noise_e * k**2), 3: -r.dark_noise_e / k}),
        "a1": u({5: 1.0}),
        "a2": u({6: 1.0}),
        "a3": u({7: 1.0}),
        "offset_dn": u({0: 1.0}),
        "slope_rel": u({2: 1 / start[2]}),
        "efficiency_rel": u({2: 1 / start[2], 3: -1 / k}),
        "dark_e": u({8: 1 / k, 3: -start[8] / k**2}),
        "lamp_rel": _lamp_u(r, level_var[lit], (f1 * k * r.light_e * share)[lit]),
        "row_e": float(np.hypot(line[0], r.row_e * k_rel)),
        "column_e": float(np.hypot(line[1], r.column_e * k_rel)),
    }


def _lamp_u(r: Reference, v_mean: np.ndarray, light_dn: np.ndarray) -> float:
    """Bound of the lamp's standard deviation from the scatter of the lit levels' means, five of them spent on the curve."""
    relative = v_mean / light_dn**2 + r.lamp_rel**2
    u2 = 1 / np.sqrt(0.5 * (relative**-2.0).sum() * max(1 - 5 / light_dn.size, 0.1))
    return float(u2 / (2 * max(r.lamp_rel, np.sqrt(u2))))


def _line_u(r: Reference) -> tuple[float, float]:
    """χ² sampling of temporal row and column noise, in electrons, from the dark frames."""
    out = []
    share, bright, frames = _series(r)
    white = np.array([r.white_dn2(s, False) for s in share[bright == 0]])
    f = frames[bright == 0] - 1
    for variance, groups, size in zip(r.lines_dn2(), r.shape, r.shape[::-1], strict=True):
        dof = f * (groups - 1)
        line = variance + (dof * white).sum() / dof.sum() / size
        u2 = line * np.sqrt(2 / dof.sum())
        # the standard deviation at which the square is as large as its u, where there is none
        out.append(float(u2 / (2 * np.sqrt(max(variance, u2)))) / r.gain)
    return out[0], out[1]


def spatial_u(r: Reference, gain_rel_u: float) -> dict[str, float]:
    """χ² sampling of the standard deviations of pixels, rows and columns, with what the stacks leave of the temporal noise."""
    rows, cols = r.shape
    n, k = r.stack_frames, r.gain
    line = np.array(r.lines_dn2())
    dark = r.white_dn2(r.stack_rel, False) / n
    light_dn = k * r.light_e * r.stack_rel
    bright = (r.white_dn2(r.stack_rel, True) / n + dark) / light_dn**2
    out = {}
    for source, std, noise, lines, rel in (
        ("sensor.dsnu", k * np.array(r.dsnu_e), dark, line / n, gain_rel_u),
        ("sensor.prnu", np.array(r.prnu_rel), bright, 2 * line / n / light_dn**2, 0.0),
    ):
        var = np.array(std) ** 2
        white = var[0] + noise
        squares = np.array([white, white / cols + var[1] + lines[0], white / rows + var[2] + lines[1]])
        u2 = squares * np.sqrt(2 / np.array([(rows - 1) * (cols - 1), rows - 1, cols - 1]))
        u2[1:] = np.hypot(u2[1:], u2[0] / np.array([cols, rows]))
        u = u2 / (2 * np.sqrt(np.maximum(var, u2)))
        unit, names = (
            (k, ("pixel_std_e", "row_std_e", "col_std_e"))
            if source == "sensor.dsnu"
            else (1.0, ("pixel_std_rel", "row_std_rel", "col_std_rel"))
        )
        for name, value, s in zip(names, u / unit, np.array(std) / unit, strict=True):
            out[f"{source}.{name}"] = float(np.hypot(value, s * rel))
    return out
