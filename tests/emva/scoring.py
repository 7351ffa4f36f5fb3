"""Does the truth lie where the stated uncertainty says? One score a value over many cameras."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field

import numpy as np
from scipy import stats

from emva.cameras import Camera
from pixmetry.camera.observations import PhotonTransfer
from pixmetry.core.number import Number
from pixmetry.emva.records import Measurement, Results
from pixmetry.observe.moments import LevelAccumulator, level_moments
from pixmetry.observe.stack import StackAccumulator


def measured(camera: Camera) -> Measurement:
    """The package's reduction of the camera's frames."""
    streams = iter(range(1_000_000))

    def level(exposure: float, photons: float) -> LevelAccumulator:
        group = LevelAccumulator(camera.bits)
        for frame in camera.frames(2, exposure, photons, next(streams)):
            group.add(frame)
        return group.summary()

    def stack(exposure: float, photons: float):
        group = StackAccumulator(camera.bits)
        for frame in camera.frames(camera.stack_frames, exposure, photons, next(streams)):
            group.add(frame)
        return group.result(exposure)

    exposure, photons = camera.settings
    dark = camera.dark_exposures_s
    bright_levels = level_moments([level(t, p) for t, p in zip(exposure, photons, strict=True)], exposure, photons)
    dark_levels = level_moments([level(t, 0.0) for t in dark], dark)
    at = camera.stack_level
    return Measurement(
        transfer=PhotonTransfer(bright_levels, dark_levels, camera.shape, camera.bits),
        dark_stack=stack(exposure[at], 0.0),
        bright_stack=stack(exposure[at], photons[at]),
        bright_stack_photons=photons[at],
        pixel_area_um2=camera.pixel_area_um2,
    )


@dataclass
class Score:
    """Of one value over many cameras."""

    transforms: list[float] = field(default_factory=list)  # probability of a smaller value, by the stated u and degrees of freedom
    errors: list[float] = field(default_factory=list)  # (value - truth)/u
    limits: list[bool] = field(default_factory=list)  # whether an upper limit is above the truth, a lower one below
    covered: list[bool] = field(default_factory=list)  # of values that cannot scatter like Student's t: truth within 3 u
    without: int = 0  # no value, or no truth

    def add(self, value: Number, truth: float, one_sided: bool, near_zero: bool = False) -> None:
        if not np.isfinite(value.value) or not np.isfinite(truth) and not value.is_limit:
            assert np.isfinite(value.value) or value.reason, "NaN without a reason"
            self.without += 1
            return
        if value.is_upper_limit:
            self.limits.append(not truth > value.value)
            return
        if value.is_lower_limit:
            self.limits.append(not truth < value.value)
            return
        if not value.u >= 0:
            self.covered.append(False)
            return
        error = value.value - truth
        z = 0.0 if abs(error) <= 1e-9 * abs(truth) else error / max(value.u, 1e-9 * abs(truth) + 1e-300)
        if near_zero:
            # a root: its square is what scatters evenly, by 2 value u
            self.covered.append(abs(value.value**2 - truth**2) <= 6 * value.value * value.u)
            return
        if one_sided:
            self.covered.append(abs(z) <= 3)
            return
        self.errors.append(z)
        self.transforms.append(float(stats.t.cdf(z, min(max(value.dof, 0.1), 1e9))))

    def distribution_p(self) -> float:
        """Probability of transforms so far from even ones: by Kolmogorov-Smirnov, or as normal scores by their mean or their squares."""
        if len(self.transforms) < 5:
            return 1.0
        p = np.clip(self.transforms, 1e-12, 1 - 1e-12)
        normal = stats.norm.isf(p)
        mean = 2 * stats.norm.sf(abs(normal.sum()) / np.sqrt(p.size))
        squares = stats.chi2.sf(normal @ normal, p.size), stats.chi2.cdf(normal @ normal, p.size)
        return min(1.0, 4 * min(stats.kstest(p, "uniform").pvalue, mean, *squares))

    @staticmethod
    def coverage_p(covered: list[bool]) -> float:
        """Probability of so few, or fewer, if 95 % are covered."""
        return float(stats.binom.cdf(sum(covered), len(covered), 0.95)) if covered else 1.0

    def p(self) -> float:
        """Smallest probability of the three."""
        return min(self.distribution_p(), self.coverage_p(self.limits), self.coverage_p(self.covered))


# Levels come in steps, and where two are as good, any of them is off by 2 u; a largest deviation is never below zero, which is its truth;
# with the non-uniformity in it, the ratio is nearly the same at all bright levels, and noise chooses the largest.
ONE_SIDED = ("index_", "u_p_sat", "LE", "PTC_linearity", "general_u_p_sat", "general_SNR_total_max")
# What may come out negative and is then a limit: told as a value, it is a selection unless the truth is well above zero.
ROOTS = ("DSNU", "PRNU", "general_DSNU", "general_PRNU")
MAYBE_LIMITS = (*ROOTS, "u_I_var", "u_I_mean_nonlinear")
# The maximum of the variance as saturation: noise finds it before the clipped levels rather than among them.
OF_THE_MAXIMUM = ("u_e_sat", "SNR_max", "SNR_total_max", "inverse_SNR_max", "DR")


def is_one_sided(release: str, key: str) -> bool:
    """Whether the errors of a value cannot follow Student's t, so that only its coverage is tested."""
    return key.startswith(ONE_SIDED) or release != "4.0" and key.startswith(OF_THE_MAXIMUM)


def collect(scores: dict[tuple[str, str], Score], results: Iterable[tuple[Results, dict[str, float]]]) -> None:
    """Add the values of one camera to the scores, by (release, key)."""
    for result, true in results:
        for key, truth in true.items():
            if key in result.values:
                score = scores.setdefault((result.release, key), Score())
                value = result.values[key]
                near_zero = key.startswith(MAYBE_LIMITS) and truth < 4 * value.u
                root = key.startswith(ROOTS)
                score.add(value, truth, near_zero or is_one_sided(result.release, key), near_zero and root)
