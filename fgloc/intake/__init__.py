"""Events to steps: validation, clocks, and keyframes."""
