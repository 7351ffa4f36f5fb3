"""``python -m pixmetry`` is the command ``pixmetry``."""

from pixmetry.cli import main

main(prog_name="pixmetry")
