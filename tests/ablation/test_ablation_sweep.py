"""A sweep: jobs named by their inputs, run once, whole records, nothing lost when processes die."""

import multiprocessing
import os
import shutil
import signal
import subprocess
import sys
import threading
import time

import psutil
import pytest
import yaml
from attempts import attempts
from circle_bag import write_circle
from refusal import refusal

from fgloc.ablation.jobs import execute, make_jobs, read_record, record_path
from fgloc.ablation.suite import expand, load_suite
from fgloc.ablation.sweep import _client, sweep
from fgloc.errors import ConfigError, RecordingError

SUITE = {
    "title": "short",
    "recordings": [{"name": "circle", "bag": "bag"}],
    "variants": [
        {"name": "full"},
        {"name": "wheels alone", "config": {"recording": {"topics": {"sightings": "none"}}}, "start": "truth"},
    ],
    "failures": [
        {
            "name": "blind",
            "chain": [{"kind": "dropout", "sensor": "camera", "when": {"bursts": 1, "after_s": 1.0}}],
            "severity": {"field": "when.burst_s", "values": [1, 3], "unit": "s"},
        },
        {"name": "dead", "chain": [{"kind": "encoder_dead", "when": {"intervals": [[2, 4]]}}]},
    ],
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A bag, its map and a suite."""
    path = tmp_path_factory.mktemp("suite")
    write_circle(path, seconds=6.0)
    (path / "suite.yaml").write_text(yaml.safe_dump(SUITE))
    return path


def jobs_of(folder, **changes):
    path = folder / f"changed{abs(hash(str(changes)))}.yaml"
    path.write_text(yaml.safe_dump(SUITE | changes))
    return make_jobs(expand(load_suite(path), folder))


def test_one_recording_under_two_names_differs_by_its_settings_at_least(folder):
    one, two = {"name": "circle", "bag": "bag"}, {"name": "again", "bag": "./bag"}
    with refusal(RecordingError, "circle", "again"):
        jobs_of(folder, recordings=[one, two])
    assert jobs_of(folder, recordings=[one, two | {"settings": {"recording": {"topics": {"truth": "none"}}}}])


@pytest.fixture(scope="module")
def swept(folder, tmp_path_factory):
    """All records of the suite, swept undisturbed by two workers."""
    out = tmp_path_factory.mktemp("swept")
    said = []
    records = sweep(jobs_of(folder), out, workers=2, progress=lambda done, total: said.append((done, total)))
    assert said == [(k, 8) for k in range(9)]
    return out, records


def comparable(record):
    return record.model_dump(exclude={"cost"})


def test_sweep_answers_what_a_failure_costs(folder, swept):
    _, records = swept
    by_cell = {(j.cell.variant, j.cell.failure, j.cell.severity): records[j.key] for j in jobs_of(folder)}
    assert all(r.outcome == "done" for r in records.values())
    assert by_cell["full", "none", None].figures["ate_mean_m"] < 0.1
    assert by_cell["full", "blind", 3.0].affected == {"dropout": 12}
    assert by_cell["full", "blind", 3.0].modes["DEAD_RECKONING"] > 0.0
    assert by_cell["full", "dead", None].figures["ate_mean_m"] > by_cell["full", "none", None].figures["ate_mean_m"]
    assert by_cell["full", "dead", None].sensors == ("wheels", "camera")
    alone = by_cell["wheels alone", "none", None]
    assert alone.figures["factors"] == {"prior": 1, "wheels": alone.figures["keyframes"] - 1}
    assert by_cell["wheels alone", "blind", 1.0].affected == {}
    assert by_cell["wheels alone", "blind", 1.0].sensors == ("wheels",)  # it is blind anyway: the report says so
    assert len(alone.track.estimate) == len(alone.track.truth) > 20


def test_key_follows_the_inputs_and_nothing_else(folder, tmp_path):
    keys = {job.key for job in jobs_of(folder)}
    assert len(keys) == 8
    renamed = [{"name": "other name", **{k: v for k, v in SUITE["failures"][0].items() if k != "name"}}]
    assert {job.key for job in jobs_of(folder, failures=renamed)} < keys
    copy = shutil.copytree(folder, tmp_path / "elsewhere")
    assert {job.key for job in jobs_of(copy)} == keys
    assert not {j.key for j in jobs_of(folder, mode="batch")} & keys
    seeded = {job.key for job in jobs_of(folder, seeds=[7])}
    assert len(seeded & keys) == 2  # without failure nothing is drawn
    with (copy / "map.yaml").open("a") as file:
        file.write("  - {id: 9, position: [9, 9]}\n")
    assert not {job.key for job in jobs_of(copy)} & keys


def test_same_jobs_again_give_the_same_records(folder, swept, tmp_path):
    _, records = swept
    for job in jobs_of(folder)[1:3]:
        execute(job, tmp_path)
        assert comparable(read_record(tmp_path, job.key)) == comparable(records[job.key])


def test_second_sweep_runs_nothing(folder, swept):
    out, records = swept
    before = attempts(out)
    assert sweep(jobs_of(folder), out) == records
    assert attempts(out) == before
    assert len(before) == 8


def _sweep_in_child(folder, out):
    sweep(jobs_of(folder), out, workers=1)


@pytest.mark.slow
def test_fault_70_killed_sweep_resumes_and_runs_nothing_twice(folder, swept, tmp_path):
    _, undisturbed = swept
    child = multiprocessing.get_context("spawn").Process(target=_sweep_in_child, args=(folder, tmp_path))
    child.start()
    while not any((tmp_path / "jobs").glob("*.json")) and child.is_alive():
        time.sleep(0.02)
    os.kill(child.pid, signal.SIGKILL)
    child.join()
    finished = {path: path.stat().st_mtime_ns for path in (tmp_path / "jobs").glob("*.json")}
    assert 1 <= len(finished) < 8
    records = sweep(jobs_of(folder), tmp_path, workers=2)
    assert {k: comparable(r) for k, r in records.items()} == {k: comparable(r) for k, r in undisturbed.items()}
    assert all(path.stat().st_mtime_ns == before for path, before in finished.items())
    started = attempts(tmp_path)
    assert all(started.count(path.stem) == 1 for path in finished)


def test_job_that_cannot_run_is_quarantined_and_listed(folder, tmp_path):
    silent = {"odometry": "none", "sightings": "none"}
    variants = [{"name": "no motion", "config": {"recording": {"topics": silent}}}]
    jobs = jobs_of(folder, variants=variants, failures=[])
    (record,) = sweep(jobs, tmp_path, workers=1).values()
    assert record.outcome == "refused"
    assert record.error.startswith("RecordingError")
    sweep(jobs, tmp_path, workers=1)
    assert len(attempts(tmp_path)) == 1  # left alone
    sweep(jobs, tmp_path, workers=1, retry=True)
    assert len(attempts(tmp_path)) == 2


@pytest.mark.slow
def test_job_that_kills_its_workers_is_quarantined_and_the_others_finish(folder, tmp_path):
    """The worker is killed each time it begins one certain job, as a crash in native code would do."""
    write_circle(tmp_path, seconds=60.0)  # long enough to be killed in
    (tmp_path / "suite.yaml").write_text(yaml.safe_dump(SUITE | {"failures": SUITE["failures"][1:]}))
    jobs = make_jobs(expand(load_suite(tmp_path / "suite.yaml"), tmp_path))
    poison, out = jobs[1].key, tmp_path / "out"
    over, kills = threading.Event(), []

    def kill_whenever_it_begins():
        while not over.is_set():
            begun = attempts(out).count(poison)
            if begun > len(kills):
                workers = [c for c in psutil.Process().children(True) if any("spawn_main" in a for a in c.cmdline())]
                kills.append(len(workers))
                for worker in workers:
                    worker.kill()
            time.sleep(0.005)

    thread = threading.Thread(target=kill_whenever_it_begins)
    thread.start()
    try:
        records = sweep(jobs, out, workers=1)
    finally:
        over.set()
        thread.join()
    assert kills == [1] * 4
    assert records[poison].outcome == "crashed"
    assert " 4 times" in records[poison].error
    assert all(r.outcome == "done" for key, r in records.items() if key != poison)
    assert sweep(jobs, out) == records  # left alone


@pytest.mark.slow
def test_workers_that_the_cluster_gave_up_are_replaced():
    with _client(1, None) as client:
        client.cluster.sync(client.cluster.workers[0].close)
        client.cluster.workers.clear()  # as after a worker's death while it was starting
        assert client.submit(abs, -1).result(timeout=120) == 1


def test_half_written_record_does_not_count(folder, tmp_path):
    job = jobs_of(folder)[0]
    path = record_path(tmp_path, job.key)
    path.parent.mkdir(parents=True)
    path.with_name(f".{path.name}.1.partial").write_text('{"key"')
    execute(job, tmp_path)
    assert read_record(tmp_path, job.key).outcome == "done"


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"recordings": [{"name": "a", "bag": "nowhere"}]}, r"\bnowhere\b.*'a'"),
        ({"variants": [{"name": "a", "config": {"wheels": {"sorce": "twist"}}}]}, "variant 'a'.*\n.*sorce"),
        ({"variants": [{"name": "a"}, {"name": "a"}]}, "'a'"),
        ({"failures": [{"name": "none", "chain": [{"kind": "darkness"}]}]}, "'none'"),
        ({"failures": [{"name": "a", "chain": [{"kind": "darknes"}]}]}, "darknes"),
        (
            {"failures": [{"name": "a", "chain": [{"kind": "darkness"}], "severity": {"field": "x", "values": [1]}}]},
            r"\bdarkness\b.*'x'",
        ),
    ],
)
def test_wrong_suite_is_refused_with_its_reason(folder, change, said):
    with pytest.raises(ConfigError, match=said):
        jobs_of(folder, **change)


def test_error_names_the_extra_and_the_scheduler(folder, tmp_path):
    with pytest.raises(ConfigError, match="start `dask scheduler`"):
        sweep(jobs_of(folder), tmp_path, scheduler="nonsense://127.0.0.1:1")
    code = (
        "import sys; sys.modules['dask'] = None\n"
        "from pathlib import Path\n"
        "from fgloc.ablation import sweep\n"
        "try:\n    sweep._client(1, None).__enter__()\n"
        "except Exception as error: print(type(error).__name__, error)\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.startswith("ConfigError")
    assert f"{sys.executable} -m pip install 'fgloc[sweep]'" in done.stdout
