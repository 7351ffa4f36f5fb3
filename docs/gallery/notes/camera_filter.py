"""How silicon sees light of each wavelength, and what a filter leaves of a red laser."""

import numpy as np

from pixmetry.camera.camera import build_camera
from pixmetry.camera.silicon import absorption_per_um
from pixmetry.report.drawing import AMBER, BLUE, RED, canvas
from pixmetry.scene.uniform import Uniform

NM, DEPTHS_UM, PHOTONS = np.arange(400.0, 1101.0, 5.0), (2.0, 5.0, 15.0), 20000.0


def response(depth_um, nm=NM):
    """Signal per watt: share of photons that are absorbed over the depth, times the wavelength; highest value 1."""
    signal = nm * -np.expm1(-absorption_per_um(nm) * depth_um)
    return signal / (NM * -np.expm1(-absorption_per_um(NM) * depth_um)).max()


def camera_of(light_nm, filtered):
    """A sensor in the light of a laser, with or without a filter that passes what the eye sees."""
    given = {"light": "laser", "light_nm": light_nm, "band": "short_pass" if filtered else "none", "cut_nm": 650.0, "edge_nm": 30.0}
    chain = [("optics.spectral_filter", given), ("sensor.quantum_efficiency", {"quantum_efficiency": 1.0}), ("sensor.shot_noise", {}),
             ("electronics.gain", {"gain_dn_per_e": 0.1}), ("grabber.adc", {"bits": 12, "offset_dn": 20.0})]  # fmt: skip
    return build_camera({"schema": "pixmetry/camera/1", "name": "filter", "rows": 64, "cols": 64, "exposure_s": 0.01,
                         "chain": [{"source": name, "parameters": one} for name, one in chain]})  # fmt: skip


def passed(light_nm):
    """Share of the light that the filter passes, from the grey values of both cameras."""
    with_it, without = (camera_of(light_nm, f).expose(Uniform(PHOTONS), 1, seed=2).data.mean() - 20.0 for f in (True, False))
    return with_it / without


def run():
    values = {f"peak_{d:.0f}": NM[response(d).argmax()] for d in DEPTHS_UM}
    values["needed"] = next(d for d in np.arange(5.0, 60.0, 0.5) if NM[response(d).argmax()] >= 750.0)
    values |= {
        "laser": passed(670.0),
        "green": passed(550.0),
        "end_1100": response(5.0, np.array([1100.0]))[0],
        "end_400": response(5.0)[0],
    }
    with canvas(2.4) as (figure, axes):
        for depth, colour in zip(DEPTHS_UM, (BLUE, AMBER, RED), strict=True):
            axes.plot(NM, response(depth), color=colour, label=f"{depth:g} µm")
        scan = np.arange(500.0, 751.0, 25.0)
        axes.plot(scan, [passed(nm) for nm in scan], "o", color="#1a1d21", markerfacecolor="none", label="passed by the filter")
        axes.set(xlabel="wavelength / nm", ylabel="relative to the highest", xlim=(400, 1100), ylim=(0, 1.05))
        axes.legend(title="collecting depth")
    return values, {"camera-filter": figure}
