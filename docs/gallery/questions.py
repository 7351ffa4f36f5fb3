"""Questions of the chapter that one number in a page's script answers: what to change, and what comes out."""

from __future__ import annotations

from dataclasses import dataclass

from gallery.note import Note, Signed
from gallery.page import Page, table
from pixmetry.core.errors import InputError

NAME = "questions"
TEXT = """# Questions that one number answers

Each page of the handbook has its script, as text and as a notebook. Change one number in it, run it again, and see: copy the script into a
file, and print its numbers with the command that stands above it; or open the notebook and run all cells.
Here are five questions, and what comes out.

"""


@dataclass(frozen=True)
class Question:
    """One change in the script of a page.

    Parameters
    ----------
    ask, page : str
        The question, and the page with the script.
    old, new : str
        Text of the script, and what to put in its place.
    shown : dict of str
        Numbers of the page that answer, and what they are.
    answer : str
        In words, with the numbers before and after as ``{name}`` and ``{new_name}``.
    """

    ask: str
    page: str
    old: str
    new: str
    shown: dict[str, str]
    answer: str

    def run(self) -> dict[str, float]:
        """Numbers of the changed script, rounded to six digits."""
        script = Note.read(self.page).script
        if script.count(self.old) != 1:
            raise InputError("the script does not have this once", where=f"{self.page}: {self.ask}", value=self.old, allowed="once")
        names: dict[str, object] = {"__name__": self.page}
        exec(compile(script.replace(self.old, self.new), f"{self.page}, changed", "exec"), names)
        values = names["run"]()[0]  # type: ignore[operator]
        return {name: float(f"{values[name]:.6g}") for name in self.shown}


QUESTIONS = (
    Question(
        "Why may a gamma of 0.45 be harmless?", "gamma", '{"white_e": 85.0}', '{"white_e": 10.0}',
        {"ratio": "error at gamma 0.45 over that at 1", "noise_045": "noise of the background at 0.45 / grey values"},
        "A gamma of 0.45 spreads dark grey values, and with them the noise of the background. With the noise of the chapter's "
        "camera a target is "
        "{ratio:.2f} times less certain; a camera with 10 electrons of read noise has {new_noise_045:.1f} grey values of noise in place of "
        "{noise_045:.1f}, and the factor is {new_ratio:.2f} ± 0.06. Gamma moves no target; what it does through the noise goes with"
        " the noise.",
    ),
    Question(
        "What does 20 ns of jitter cost?", "jitter-cost", "JITTER_NS = 5.0", "JITTER_NS = 20.0",
        {"row": "error of a single row / px", "disc_7": "error of a disc of 7 px / px"},
        "A row is shifted by 20 ns/70.5 ns = {new_row:.2f} px, and a disc of 7 px by {new_disc_7:.2f} px, along x only. With the 5 "
        "ns of the page it is "
        "{disc_7:.3f} px.",
    ),
    Question(
        "Can I use a red laser with a filter that ends at 700 nm?", "camera-filter", '"cut_nm": 650.0', '"cut_nm": 700.0',
        {"laser": "share of 670 nm that passes", "green": "share of 550 nm that passes"},
        "Yes: {new_laser:.2f} of the light of 670 nm passes, in place of {laser:.2f} behind one that ends at 650 nm.",
    ),
    Question(
        "How far does a worse sensor move a target?", "charge-transfer", "LEFT = 2048, 4, 1e-5", "LEFT = 2048, 4, 5e-5",
        {"all": "charge that arrives in its packet", "shift_4": "shift across 2048 pixels / px"},
        "At 0.99995 for each of four transfers only {new_all:.2f} of the charge arrives in its packet, and a target is "
        "{new_shift_4:.2f} px late at the "
        "far end, in place of {shift_4:.2f} px at 0.99999. The shift grows evenly along the row, so most of it is a scale.",
    ),
    Question(
        "What does rounding cost a faint line?", "quantisation", "REACH = 5000, 0.9, 150.0, 10.0, 3", "REACH = 5000, 0.9, 37.5, 10.0, 3",
        {"alone": "error by rounding alone / 0.001 px", "total_09": "error with noise of 0.9 / 0.001 px", "share_09": "share of rounding"},
        "A line of a quarter of the height has an error of {new_alone:.0f} thousandths of a pixel by rounding alone, in place of "
        "{alone:.1f}. Its error by noise grows fourfold, so the share of rounding falls from {share_09:.2f} to {new_share_09:.2f}: "
        "for a faint line more bits help less than more light.",
    ),
)  # fmt: skip


def page(numbers: dict[str, dict[str, float]], changed: dict[str, float]) -> Page:
    """The page of all questions.

    Parameters
    ----------
    numbers : dict
        Of the pages, as they are.
    changed : dict
        As `all_changed` gives them.
    """
    parts = [TEXT]
    for k, q in enumerate(QUESTIONS):
        old = {name: numbers[q.page][name] for name in q.shown}
        new = {name: changed[f"{k}_{name}"] for name in q.shown}
        rows = [[what, f"{old[name]:.4g}", f"{new[name]:.4g}"] for name, what in q.shown.items()]
        words = q.answer.format_map({n: Signed(v) for n, v in {**old, **{f"new_{n}": v for n, v in new.items()}}.items()})
        title = Note.read(q.page).head["title"]
        parts += [f"## {q.ask}\n", f"In the script of [{title}]({q.page}.md) change\n", f"```python\n{q.old}  # to {q.new}\n```\n"]
        parts += [table(["", "as it is", "changed"], rows), f"{words}\n"]
    return Page(NAME, "\n".join(parts))


def all_changed() -> dict[str, float]:
    """Numbers of all changed scripts, by the question's number and the number's name."""
    return {f"{k}_{name}": value for k, q in enumerate(QUESTIONS) for name, value in q.run().items()}
