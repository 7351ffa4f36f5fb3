"""Stored values back to a straight line, with the non-linearity that the photon transfer found."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from pixmetry.camera.observations import StackMoments
from pixmetry.core.number import Estimates
from pixmetry.observe.photon_transfer_model import signal_from_mean, transfer

COEFFICIENTS = ("nonlinearity_a1", "nonlinearity_a2", "nonlinearity_a3")
HIGHEST = 1.1  # of the largest code: beyond it lies nothing that could be straightened


@dataclass(frozen=True)
class Linearity:
    """Black level and the coefficients of y = b + x(1 + a₁w + a₂w² + a₃w³), w = x/x_ref, with their covariance."""

    offset_dn: float
    a: np.ndarray
    covariance: np.ndarray
    x_ref: float

    @classmethod
    def of(cls, transfer_fit: Estimates, bits: int) -> Linearity | None:
        """Take it from a photon-transfer fit of frames of so many bits; None where that holds no coefficients."""
        if COEFFICIENTS[0] not in transfer_fit:
            return None
        found = transfer_fit.select(COEFFICIENTS)
        return cls(transfer_fit["offset_dn"].value, found.values, found.covariance, float(2**bits - 1))

    def straight(self, stored_dn: np.ndarray) -> np.ndarray:
        """Linear signal above black, DN, in the shape given."""
        y = np.clip(stored_dn - self.offset_dn, -0.25 * self.x_ref, HIGHEST * self.x_ref)
        return signal_from_mean(y, self.a, self.x_ref, np.zeros(1))

    def straight_stack(self, stack: StackMoments) -> StackMoments:
        """The stack as a linear camera would have given it; temporal mean squares over f'² at the mean."""
        mean_map = self.straight(stack.mean_map_dn)
        slope2 = transfer(mean_map, self.a, self.x_ref)[1] ** 2
        middle = float(slope2.mean())
        scaled = {name: getattr(stack, name) / middle for name in ("ms_pixel_dn2", "ms_row_dn2", "ms_col_dn2", "ms_frame_dn2")}
        var_map = stack.var_map_dn2 / slope2.astype(np.float32)
        return replace(
            stack,
            mean_map_dn=mean_map,
            mean_dn=float(mean_map.mean()),
            var_map_dn2=var_map,
            var_stack_dn2=float(var_map.mean(dtype=float)),
            **scaled,
        )

    def contrast_u_rel(self, stored_dn: float) -> float:
        """Relative standard uncertainty of a small contrast δx/x at a stored value, from the coefficients alone.

        δx/x = δy/(x f'(x)), where x depends on the coefficients too; derivatives by finite differences.
        """

        def log_scale(a: np.ndarray) -> float:
            x = signal_from_mean(np.array([stored_dn - self.offset_dn]), a, self.x_ref, np.zeros(1))
            return float(np.log(x * transfer(x, a, self.x_ref)[1])[0])

        step = 1e-5
        gradient = np.array([(log_scale(self.a + h) - log_scale(self.a - h)) / (2 * step) for h in step * np.eye(3)])
        return float(np.sqrt(gradient @ self.covariance @ gradient))
