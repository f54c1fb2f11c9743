"""Writes and executes docs/notebooks/*.ipynb; their cells are here, as text that can be reviewed.

python docs/make_notebooks.py [NAME...]
"""

from __future__ import annotations

import sys
from pathlib import Path

import nbformat
from nbclient import NotebookClient

FOLDER = Path(__file__).resolve().parent / "notebooks"
FIRST = [
    "# A first run\n\nSmooth a recording that comes with fgloc, and look at it. The recording has a truth, so that errors "
    "are known. NEES/3 is 1 on average if the covariance is right.",
    """%matplotlib inline
from pathlib import Path

import fgloc
from fgloc.evaluation.metrics import compute_metrics, match_result
from fgloc.evaluation.plots import plot_error, plot_trajectory
from fgloc_datasets import SAMPLE

sample = SAMPLE.parent
config = fgloc.load_config(sample / "robot.yaml")
result = fgloc.run(sample / "bag", sample / "map.yaml", config, "batch")
metrics, matched = compute_metrics(result, config), match_result(result, config)
print(f"{1e3 * metrics.ate_mean_m:.1f} mm, {metrics.yaw_mae_deg:.2f} deg, NEES/3 {metrics.nees_over_3:.2f}")""",
    """figure = plot_trajectory(result, matched)
figure.set_dpi(90)
figure""",
    """figure = plot_error(result, matched)
figure.set_dpi(90)
figure""",
    """# The installation: given, found, and how well it is known; then a pose at any time, and all files of the run
for setting in result.found.settings[:8]:
    print(f"{setting.name:24} {setting.given:7.3f} -> {setting.found:7.3f} +- {setting.sigma:.1g}")
stamp = int(result.trajectory.stamps_ns[100]) + 50_000_000  # ns
print(result.trajectory.interpolate(stamp).round(3))
result.write(Path("first-run-out"))""",
]
FAILURE = [
    "# A failure, and what saves the run\n\nThe camera is silent for 20 s on a slippery floor. Failures are filters of "
    "events: the estimator cannot know of them.",
    """%matplotlib inline
from pathlib import Path

import fgloc
from fgloc.ablation.failures import corrupt, generators
from fgloc.sensors.failures import Scene
from fgloc.ablation.suite import FailureEntry
from fgloc.evaluation.metrics import compute_metrics, match_result
from fgloc.evaluation.plots import plot_error
from fgloc.recording.reader import open_recording

here = next(p for p in [Path.cwd(), *Path.cwd().parents] if (p / "datasets" / "samples").is_dir())
sample = here / "datasets" / "samples" / "patches_run"
config = fgloc.load_config(sample / "robot.yaml")
outage = {"kind": "dropout", "sensor": "camera", "when": {"intervals": [[36, 56]]}}
chain = FailureEntry.model_validate({"name": "outage", "chain": [outage]}).chain""",
    """def run_with(config):
    with open_recording(sample / "bag", config.recording) as recording:
        start_ns, duration_s = recording.span_ns[0], recording.duration_s
    scenes = [Scene(start_ns, duration_s, config, (), rng) for rng in generators(1, seed=0)]
    return fgloc.run(
        sample / "bag",
        sample / "map.yaml",
        config,
        "online",
        events=lambda events: corrupt(chain, "recorded", events, scenes),
        sightings=lambda events: corrupt(chain, "sightings", events, scenes),
    )


with_model = run_with(config)
without = run_with(config.model_copy(update={"motion": config.motion.model_copy(update={"use": False})}))""",
    "Mean errors, with the learned motion model and without:",
    """for name, result in (("with the model", with_model), ("without", without)):
    metrics = compute_metrics(result, config)
    print(f"{name:15} {1e3 * metrics.ate_mean_m:6.1f} mm   NEES/3 {metrics.nees_over_3:.2f}")""",
    "The 3σ band opens while nothing is seen, and the error stays in it:",
    """figure = plot_error(with_model, match_result(with_model, config))
figure.set_dpi(90)
figure""",
    "The detected faults, as the report has them:",
    """for judgement in compute_metrics(with_model, config).judgements:
    print(f"{judgement.when:14} {judgement.what:45} {judgement.effect}")""",
]
NOTEBOOKS = {"first_run.ipynb": FIRST, "failure.ipynb": FAILURE}


def notebook(cells: list[str]) -> nbformat.NotebookNode:
    """A notebook without outputs: text begins with a capital letter or #, code does not."""
    made = nbformat.v4.new_notebook()
    made.metadata["kernelspec"] = {"name": "python3", "display_name": "Python 3", "language": "python"}
    for k, text in enumerate(cells):
        code = not (text[0].isupper() or text.startswith("# A "))
        cell = nbformat.v4.new_code_cell(text) if code else nbformat.v4.new_markdown_cell(text)
        cell["id"] = f"cell-{k}"
        made.cells.append(cell)
    return made


def main() -> None:
    """Write both, or those that are named, with their outputs."""
    FOLDER.mkdir(exist_ok=True)
    for name, cells in NOTEBOOKS.items():
        if sys.argv[1:] and name not in sys.argv[1:]:
            continue
        made = notebook(cells)
        NotebookClient(made, timeout=600, resources={"metadata": {"path": FOLDER}}).execute()
        for cell in made.cells:
            cell.metadata.pop("execution", None)  # times
        nbformat.write(made, FOLDER / name)
        print(FOLDER / name)


if __name__ == "__main__":
    main()
