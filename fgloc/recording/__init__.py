"""Recordings in (bags to events, the only rosbags importer) and results out."""
