"""The simulated robot drives itself along waypoints, guided by a pose that is estimated while it drives."""
