"""The mode `frozen` of the budget against the mode `exact`, target by target, on a chain with charge transfer and a badly terminated cable.

Both see the same targets with the same random numbers. What `frozen` leaves out is the far context's deviation from the noise-free
background, of which at most the stated share (`Camera.frozen_tail`) reaches a pixel. By the estimator's gradient that moves a target by at
most

    share × Σ|g_i| × (largest deviation of the far signal, here eight standard deviations of the noise).
"""

from __future__ import annotations

import numpy as np

from pixmetry.budget.monte_carlo import Trials
from pixmetry.budget.probe import Target, facts_of, make_probe
from pixmetry.camera.camera import Camera, Element, in_order
from pixmetry.camera.catalogue import sources
from pixmetry.locate.centroids.fixed import FixedCentroid

SETTINGS = {
    "sensor.quantum_efficiency": {"quantum_efficiency": 0.5},
    "sensor.prnu": {"pixel_std_rel": 0.01},
    "sensor.shot_noise": {},
    "sensor.charge_transfer": {"parallel_cti": 2e-5, "serial_cti": 1e-5},
    "electronics.amplifier_noise": {"white_e": 40.0},
    "electronics.gain": {"gain_dn_per_e": 0.02},
    "cable.termination": {"length_m": 20.0, "line_ohm": 50.0, "load_ohm": 1000.0},
}


def main() -> None:
    every = sources()
    chain = [Element(s.id, s, s.make(SETTINGS[s.id])) for s in in_order(every[i] for i in SETTINGS)]
    camera = Camera("chain", (240, 320), tuple(chain), facts={"interface": "analogue", "sensor": "ccd", "bits": 8})
    target, estimator = Target(), FixedCentroid()
    facts = facts_of(camera, target)
    found = {}
    for mode in ("exact", "frozen"):
        trials = Trials(camera, target, estimator, facts, trials=400, units=2, frames=2, mode=mode, seed=3)
        found[mode] = trials.errors(camera)
    probe = make_probe(facts, target, estimator)
    deviation_dn = 8 * np.sqrt(facts.noise_dn**2 + facts.gain_dn_per_e * target.peak_rel * facts.saturation_dn)
    for axis, name, gradient in ((0, "x", probe.gx), (1, "y", probe.gy)):
        difference = found["frozen"][axis] - found["exact"][axis]
        stated = camera.frozen_tail() * np.abs(gradient).sum(axis=(1, 2)).max() * deviation_dn
        print(
            f"{name}: frozen - exact over {difference.size} targets: largest {np.abs(difference).max():.2e} px, "
            f"rms {difference.std():.2e} px; stated bound {stated:.2e} px (share {camera.frozen_tail():.1e})"
        )


if __name__ == "__main__":
    main()
