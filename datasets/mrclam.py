"""``python -m datasets.mrclam``: see `fgloc.datasets.mrclam`."""

from fgloc.datasets.convert import command_line
from fgloc.datasets.mrclam import main

if __name__ == "__main__":
    command_line(main)
