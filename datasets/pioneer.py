"""``python -m datasets.pioneer``: see `fgloc.datasets.pioneer`."""

from fgloc.datasets.convert import command_line
from fgloc.datasets.pioneer import main

if __name__ == "__main__":
    command_line(main)
