"""Makes the pictures of docs/gallery.md and docs/concepts.md from the bundled recordings, with headless Chromium.

    python docs/make_gallery.py [--ablation DIR]

DIR: results of ``fgloc ablate ablations/first.yaml``; without it the ablation's picture stays as it is.
"""

from __future__ import annotations

import argparse
import shutil
import subprocess
import tempfile
from pathlib import Path
from typing import Any

import yaml
from PIL import Image

from fgloc.ablation.failures import corrupt, generators
from fgloc.sensors.failures import Scene
from fgloc.ablation.suite import FailureEntry
from fgloc.config import file_content, load_config
from fgloc.files.settings import joined
from fgloc.evaluation.report import write_results
from fgloc.recording.reader import open_recording
from fgloc.runner import run

ROOT = Path(__file__).resolve().parent.parent
SAMPLES = ROOT / "datasets" / "samples"
PICTURES = ROOT / "docs" / "pictures"
LOST = [
    {"kind": "dropout", "sensor": "camera", "when": {"intervals": [[0, 9], [30, 52]]}},
    {"kind": "lift", "when": {"intervals": [[31, 50]]}},
]
WIDTH_PX = 1000
COLORS = 255
CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")


def report(
    folder: Path, sample: str, mode: str, settings: dict[str, Any], chain: list[Any], mapped: bool = True
) -> Path:
    """Run a sample, with other settings and with failures; the report's file."""
    content = joined(yaml.safe_load((SAMPLES / sample / "robot.yaml").read_text(encoding="utf-8")))
    for section, values in settings.items():
        content[section] = content.get(section, {}) | values
    file = folder / "robot.yaml"
    file.write_text(yaml.safe_dump(file_content(content)), encoding="utf-8")
    config, bag = load_config(file), SAMPLES / sample / "bag"
    options: dict[str, Any] = {}
    if chain:
        failures = FailureEntry.model_validate({"name": "gallery", "chain": chain}).chain
        with open_recording(bag, config.recording) as recording:
            start_ns, duration_s = recording.span_ns[0], recording.duration_s
        scenes = [Scene(start_ns, duration_s, config, (), rng) for rng in generators(len(failures), 0)]
        options = {
            "events": lambda events: corrupt(failures, "recorded", events, scenes),
            "sightings": lambda events: corrupt(failures, "sightings", events, scenes),
        }
    result = run(bag, SAMPLES / sample / "map.yaml" if mapped else None, config, mode, **options)
    out = folder / "out"
    command = f"fgloc {'smooth' if mode == 'batch' else 'online'} {sample}/bag --out out"
    write_results(result, result.config or config, out, command, figures=("png",))
    return out / "report.html"


def screenshot(page: Path, name: str, height_px: int, dark: bool = False) -> None:
    """A picture of a page's top, in few colors."""
    assert CHROMIUM is not None, "install chromium"
    PICTURES.mkdir(exist_ok=True)
    with tempfile.TemporaryDirectory() as folder:
        raw = Path(folder) / "page.png"
        options = ["--headless=new", "--no-sandbox", "--disable-gpu", "--hide-scrollbars", "--virtual-time-budget=8000"]
        options += [f"--blink-settings=preferredColorScheme={0 if dark else 1}", f"--user-data-dir={folder}/profile"]
        options += [f"--window-size={WIDTH_PX},{height_px}", f"--screenshot={raw}"]
        subprocess.run([CHROMIUM, *options, page.as_uri()], check=True, capture_output=True, timeout=120)
        save(raw, name)


def save(file: Path, name: str) -> None:
    """As a PNG with a palette."""
    target = PICTURES / f"{name}.png"
    Image.open(file).convert("RGB").quantize(COLORS, dither=Image.Dither.NONE).save(target, optimize=True)
    print(f"{target}: {target.stat().st_size / 1e3:.0f} kB")


def main() -> None:
    """Make all pictures."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--ablation", type=Path)
    arguments = parser.parse_args()
    no_truth = {"recording": {"topics": {"command": "/cmd_vel", "odometry": "/odom", "truth": "none"}}}
    no_map = {"markers": {"dictionary": "DICT_4X4_50", "default_size_m": 0.2, "sigma_px": 0.15}}
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder)
        page = report(place, "installed_run", "batch", {}, [])
        screenshot(page, "report-sample", 2600)
        save(page.parent / "error.png", "error")
        page = report(place, "patches_run", "online", {}, [])
        screenshot(page, "report-dark", 2600, dark=True)
        save(page.parent / "timeline.png", "timeline")
        screenshot(report(place, "patches_run", "batch", no_truth, []), "report-no-truth", 2300)
        screenshot(report(place, "light_drop_run", "online", {}, LOST), "report-lost", 2700)
        screenshot(report(place, "patches_run", "batch", no_map, [], mapped=False), "report-unknown-map", 2400)
    if arguments.ablation is not None:
        screenshot(arguments.ablation / "report.html", "report-ablation", 3300)


if __name__ == "__main__":
    main()
