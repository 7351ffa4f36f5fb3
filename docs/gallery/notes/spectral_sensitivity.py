"""The spectral sensitivity of a camera with its lens, scanned as with a monochromator, and what is in the simulated camera."""

import numpy as np

from pixmetry.camera.camera import build_camera
from pixmetry.report.drawing import BLUE, RED, SOFT, canvas
from pixmetry.scene.uniform import Uniform
from pixmetry.sources.optics.spectral_filter import passed
from pixmetry.sources.sensor.quantum_efficiency import efficiency

SCAN_NM, SIDE, FRAMES, PHOTONS = np.arange(400.0, 1001.0, 20.0), 50, 4, 30000.0
LENS = {"light": "laser", "band": "short_pass", "cut_nm": 720.0, "edge_nm": 200.0}  # glass and coatings made for visible light
SILICON = {"model": "silicon", "depth_um": 5.0, "reflectance": 0.1, "collected": 0.6}
DIODE_REL = 0.01  # standard uncertainty of the photodiode's calibration from one wavelength to the next


def camera_at(light_nm, glass):
    """A camera in light of one wavelength, with or without the glass of a lens."""
    chain = [("optics.spectral_filter", LENS | {"light_nm": light_nm, "band": LENS["band"] if glass else "none"}),
             ("sensor.quantum_efficiency", SILICON | {"wavelength_nm": light_nm}), ("sensor.shot_noise", {}),
             ("electronics.amplifier_noise", {"white_e": 85.0}), ("electronics.gain", {"gain_dn_per_e": 0.2}),
             ("grabber.adc", {"bits": 12, "offset_dn": 50.0})]  # fmt: skip
    return build_camera({"schema": "pixmetry/camera/1", "name": "scan", "rows": SIDE, "cols": SIDE, "exposure_s": 0.01,
                         "chain": [{"source": name, "parameters": given} for name, given in chain]})  # fmt: skip


def scan(glass, told_photons):
    """Signal per photon at each wavelength, dark signal taken off, and its standard error."""
    mean, u = [], []
    for k, nm in enumerate(SCAN_NM):
        camera = camera_at(nm, glass)
        bright, dark = (camera.expose(Uniform(v), FRAMES, seed=k).data.astype(float) for v in (PHOTONS, 0.0))
        mean.append((bright.mean() - dark.mean()) / told_photons[k])
        u.append(np.hypot(bright.std(), dark.std()) / np.sqrt(bright.size) / told_photons[k])
    return np.array(mean), np.array(u)


def run():
    told = PHOTONS * (1 + DIODE_REL * np.random.default_rng(18).standard_normal(len(SCAN_NM)))  # as the photodiode reads them
    values = {}
    with canvas(2.4) as (figure, axes):
        for glass, colour, name in ((False, BLUE, "sensor"), (True, RED, "with_lens")):
            found, u = scan(glass, told)
            cameras = [camera_at(nm, glass) for nm in SCAN_NM]
            true = np.array(
                [efficiency(c["sensor.quantum_efficiency"].params) * passed(c["optics.spectral_filter"].params) for c in cameras]
            )
            per_watt, curve = found * SCAN_NM, np.array(true) * SCAN_NM  # a watt of red light has more photons
            ratio = found / true / (found.sum() / sum(true))
            u_rel = np.hypot(DIODE_REL, u / found)
            values |= {f"peak_{name}": SCAN_NM[per_watt.argmax()], f"true_peak_{name}": SCAN_NM[curve.argmax()],
                       f"off_{name}": 100 * np.abs(ratio - 1).max(), f"z_{name}": np.sqrt((((ratio - 1) / u_rel) ** 2).mean()),
                       f"at_950_{name}": np.interp(950.0, SCAN_NM, per_watt) / per_watt.max()}  # fmt: skip
            axes.plot(SCAN_NM, per_watt / per_watt.max(), "o", color=colour, label=name.replace("_", " "))
            axes.plot(SCAN_NM, curve / curve.max(), color=colour)
        axes.axvline(750.0, color=SOFT, linestyle="--")
        axes.set(xlabel="wavelength / nm", ylabel="relative to the highest", ylim=(0, 1.08))
        axes.legend()
    return values, {"spectral-sensitivity": figure}
