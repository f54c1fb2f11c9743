"""A physical simulator of wheeled robots (MuJoCo) that records standard bags with known truth.

``scenario`` (what) → ``physics`` (a log of what happened) → ``sensors`` and ``camera`` (what the robot saw) →
``record`` (a bag, a map and a robot file). Everything is a pure function of the scenario and the seed.
"""

import ctypes.util
import os
import sys

if sys.platform == "linux" and "MUJOCO_GL" not in os.environ:
    # MuJoCo chooses its OpenGL when it is imported; without any, physics still runs.
    if ctypes.util.find_library("EGL"):
        os.environ["MUJOCO_GL"] = "egl"
    else:
        os.environ["MUJOCO_GL"] = "osmesa" if ctypes.util.find_library("OSMesa") else "disable"
