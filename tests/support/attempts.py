"""Runs that a sweep has begun."""

from __future__ import annotations

from pathlib import Path


def attempts(out: Path) -> list[str]:
    """Key of every run that was begun, in order."""
    path = out / "jobs" / "attempts.log"
    return [line.split()[0] for line in path.read_text().splitlines()] if path.exists() else []
