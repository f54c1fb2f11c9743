"""fgloc in a robot's own loop: push what the sensors say, ask for the pose. The sensors here are a bundled recording's.

python examples/live_loop.py [FOLDER of robot.yaml, map.yaml and bag]
"""

import sys
from pathlib import Path

from fgloc.config import load_config
from fgloc.live import Live
from fgloc.recording.reader import open_recording

folder = Path(sys.argv[1] if len(sys.argv) > 1 else "datasets/samples/first_run")
config = load_config(folder / "robot.yaml")
with open_recording(folder / "bag", config.recording) as sensors, Live(config, folder / "map.yaml") as live:
    for k, event in enumerate(sensors.events()):
        live.push(event)  # or live.joints(stamp_ns, names, angles), live.image(stamp_ns, pixels), ...
        live.wait()  # a replay is faster than a robot: no image is to be dropped
        pose = live.pose_at() if k % 200 == 0 else None
        if pose is not None:
            x, y, yaw = pose.pose
            print(f"{pose.stamp_ns * 1e-9:.2f} s  x {x:+.3f} m  y {y:+.3f} m  yaw {yaw:+.3f} rad  {pose.mode}")
    print(*live.status().notes, sep="\n")
