"""``python -m datasets.turtlebot3``: see `fgloc.datasets.turtlebot3`."""

from fgloc.datasets.convert import command_line
from fgloc.datasets.turtlebot3 import main

if __name__ == "__main__":
    command_line(main)
