"""Estimation: motion and sightings are judged, the graph is begun and followed, decisions are recorded."""
