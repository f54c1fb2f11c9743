"""``python -m datasets.turtlebot3``: ``fgloc convert turtlebot3`` from a clone."""

from fgloc.cli import main

if __name__ == "__main__":
    main("convert", "turtlebot3")
