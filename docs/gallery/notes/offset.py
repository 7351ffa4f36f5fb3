"""A line whose feet a black level below the converter's zero cuts off: the error of its centroid in every row."""

import numpy as np

from pixmetry.report.drawing import BLUE, RED, canvas

ROWS, HALF_PX, SIGMA_PX, PEAK, SKEW_PX, OFFSET = 500, 20, 1.5, 150.0, 3.0, 6.0  # grey values
CONVERTERS = {"unrounded": lambda v: v, "rounded": np.rint, "truncated": np.floor}


def errors(offset, convert):
    """Centroid of each row less the place of the line, which moves by three whole pixels over the rows."""
    place = SKEW_PX * (np.arange(ROWS) / ROWS - 0.5)
    x = np.arange(-HALF_PX, HALF_PX + 1)
    light = PEAK * np.exp(-0.5 * ((x - place[:, None]) / SIGMA_PX) ** 2)
    row = np.clip(convert(light - offset), 0, 255)
    return place, (row * x).sum(axis=1) / row.sum(axis=1) - place


def wave(place, error):
    """Amplitude of the sine with a period of a pixel in the error."""
    terms = np.stack([np.sin(2 * np.pi * place), np.cos(2 * np.pi * place), np.ones(ROWS)], axis=1)
    return abs(np.linalg.lstsq(terms, error, rcond=None)[0][0])


def run():
    values = {}
    for name, convert in CONVERTERS.items():
        place, error = errors(OFFSET, convert)
        values |= {f"first_{name}": wave(place, error), f"half_{name}": np.ptp(error) / 2, f"rms_{name}": np.sqrt(np.mean(error**2))}
    values["rms_without"] = np.sqrt(np.mean(errors(0.0, CONVERTERS["unrounded"])[1] ** 2))
    with canvas(2.2) as (figure, axes):
        for offset, colour in ((OFFSET, RED), (0.0, BLUE)):
            axes.plot(errors(offset, CONVERTERS["unrounded"])[1], color=colour, label=f"{offset:g} grey values below black")
        axes.set(xlabel="row", ylabel="error / px", ylim=(-0.02, 0.02))
        axes.legend()
    return values, {"offset-script": figure}
