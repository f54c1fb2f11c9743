"""fgloc as a lifecycle node of ROS 2: `settings` and `transport` around `fgloc.live.wire.node`, and the `node`."""
