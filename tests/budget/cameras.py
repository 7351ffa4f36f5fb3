"""Small cameras for the tests of the budget."""

from __future__ import annotations

from pixmetry.camera.camera import Camera, Element
from pixmetry.camera.catalogue import get_source

GAIN_DN_PER_E, ETA = 0.01, 0.5


def element(source_id: str, name: str = "", **params) -> Element:
    source = get_source(source_id)
    return Element(name or source_id, source, source.make(params))


def camera(*more: Element, shape: tuple[int, int] = (96, 128), adc: bool = False, **kw) -> Camera:
    """Conversions, and the given elements where they belong: by stage, before the shot noise, before or after the gain."""
    places = {"optics": 0, "sensor": 2, "electronics": 3, "cable": 5, "grabber": 6}
    chain = [
        (1, element("sensor.quantum_efficiency", quantum_efficiency=ETA)),
        (4, element("electronics.gain", gain_dn_per_e=GAIN_DN_PER_E)),
        *((places[e.source.stage], e) for e in more),
    ]
    if adc:
        chain.append((7, element("grabber.adc", bits=8, offset_dn=8.0)))
    ordered = [e for _, e in sorted(chain, key=lambda p: p[0])]
    return Camera("test", shape, tuple(ordered), **{"facts": {"saturation_dn": 200.0, "bits": 8}, **kw})
