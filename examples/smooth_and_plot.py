"""Smooth a recording and plot its trajectory."""

import argparse
from pathlib import Path

import matplotlib.pyplot as plt

import fgloc

parser = argparse.ArgumentParser(description=__doc__)
for name in ("BAG", "MAP.yaml", "ROBOT.yaml", "OUT"):
    parser.add_argument(name, type=Path)
bag, map_file, robot, out = vars(parser.parse_args()).values()

result = fgloc.run(bag, map_file, fgloc.load_config(robot), "batch")
result.write(out)  # trajectory.tum, covariance.csv, report.html, ...
x, y, _ = result.trajectory.poses.T
plt.plot(x, y)
plt.axis("equal")
plt.savefig(out / "path.png")
