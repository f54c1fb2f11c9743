"""``python -m datasets.drive``: see `fgloc.datasets.drive`."""

from fgloc.datasets.convert import command_line
from fgloc.datasets.drive import main

if __name__ == "__main__":
    command_line(main)
