"""Smooth a recording and plot its trajectory: ``python examples/smooth_and_plot.py BAG MAP.yaml ROBOT.yaml OUT``."""

import sys
from pathlib import Path

import matplotlib.pyplot as plt

import fgloc

bag, map_file, robot, out = map(Path, sys.argv[1:5])
result = fgloc.run(bag, map_file, fgloc.load_config(robot), "batch")
result.write(out)  # trajectory.tum, covariance.csv, report.html, ...
x, y, _ = result.trajectory.poses.T
plt.plot(x, y)
plt.axis("equal")
plt.savefig(out / "path.png")
