"""What frames in a row tell: gain and black of each, the loop that moves the gain, the lamp's flicker."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pixmetry.core.number import Estimates


@dataclass(frozen=True)
class LampWave:
    """A sinusoid in the light of a sequence, over frames and rows.

    Parameters
    ----------
    amplitude_rel, u_amplitude_rel : float
        Half of peak to valley over the mean, as the exposure leaves it.
    per_frame, u_per_frame : float
        Cycles from frame to frame, 0 to ½ where the rows show nothing, else −½ to ½: whole cycles between frames are not seen.
    per_row, u_per_row : float
        Cycles from row to row, 0 to ½; 0 where all rows see the same light, ½ where odd and even rows are two fields.
    phase_turns : float
        At frame 0 and row 0, of a cosine.
    """

    amplitude_rel: float
    u_amplitude_rel: float
    per_frame: float
    u_per_frame: float
    per_row: float = 0.0
    u_per_row: float = 0.0
    phase_turns: float = 0.0

    @property
    def of_fields(self) -> bool:
        """Whether odd rows see other light than even ones."""
        return self.per_row == 0.5

    def light(self, place: np.ndarray, row: np.ndarray) -> np.ndarray:
        """Light over its mean, shape (frames, rows), of frames taken at ``place`` (in frame times)."""
        turns = self.per_frame * np.asarray(place, float)[:, None] + self.per_row * np.asarray(row, float) + self.phase_turns
        light: np.ndarray = 1 + self.amplitude_rel * np.cos(2 * np.pi * turns)
        return light


@dataclass(frozen=True)
class FrameSequence:
    """One sequence of frames.

    Parameters
    ----------
    interval_s, exposure_s : float
        Time from frame to frame, and exposure; 0 where they were not said.
    level_dn : ndarray, shape (frames,)
        Mean of each whole frame.
    gain_rel, offset_dn : ndarray, shape (frames,)
        Factor and offset of each frame against the mean of all, where the scene does not change: frame = gain × mean + offset. The factor
        is gain, exposure and lamp as one.
    covariance : ndarray, shape (frames, 2, 2)
        Of ``gain_rel`` and ``offset_dn``.
    fitted_rel : ndarray, shape (frames,)
        ``gain_rel`` by loop and lamp.
    scene_rel : ndarray, shape (frames,)
        Mean of the frame over its factor: what changed in the scene, over its mean.
    static_share : float
        Share of the frame that does not change.
    changes : int
        How often the scene went from dark to bright or back.
    gain_share, u_gain_share : float
        Share of the factor (in decibels) that multiplies the noise in the dark, too: 1 of a gain, 0 of an exposure; u is infinite where it
        is not told.
    black_moves_dn : float
        Standard deviation of black from frame to frame where it is more than its u explains; else 0.
    wave : LampWave or None
    loop : Estimates
        ``kappa``, ``target_dn``, ``black_dn``, ``lowest_db``, ``highest_db`` as far as they are told; ``reasons`` for the others.
    notes : tuple of str
    """

    interval_s: float
    exposure_s: float
    level_dn: np.ndarray
    gain_rel: np.ndarray
    offset_dn: np.ndarray
    covariance: np.ndarray
    fitted_rel: np.ndarray
    scene_rel: np.ndarray
    static_share: float
    changes: int
    gain_share: float
    u_gain_share: float
    black_moves_dn: float
    wave: LampWave | None
    loop: Estimates
    notes: tuple[str, ...] = ()


@dataclass(frozen=True)
class FrameSequences:
    """All sequences, why others were refused, and what they tell together.

    ``loop`` has ``kappa``, ``target_dn``, ``lowest_db``, ``highest_db`` of a gain that follows the scene; ``lamp`` has ``depth_rel`` and
    ``frequency_hz`` of a light that flickers.
    """

    sequences: tuple[FrameSequence, ...]
    refused: tuple[str, ...]
    loop: Estimates
    lamp: Estimates
