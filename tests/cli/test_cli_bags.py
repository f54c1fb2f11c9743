"""``fgloc smooth`` of many bags: a folder each, no bag stops another, what is done is not done again."""

import json
import shutil

import pytest
from attempts import attempts
from test_cli import FILES, fgloc, refused, write_circle

from fgloc.ablation.jobs import execute
from fgloc.ablation.sweep import folder_names, plan_bags
from fgloc.config import Config, config_of, load_config
from fgloc.errors import ConfigError


@pytest.fixture(scope="module")
def bags(tmp_path_factory):
    """Two good recordings, one that is lost, one that cannot be read, one whose configuration is wrong."""
    folder = tmp_path_factory.mktemp("bags")
    for name in ("one", "two", "lost"):
        (folder / name).mkdir()
        write_circle(folder / name, seconds=6.0, sees=name != "lost")
    (folder / "broken").mkdir()
    (folder / "broken" / "bag.mcap").write_bytes(b"not a bag")
    shutil.copytree(folder / "one", folder / "wrong")
    (folder / "wrong" / "robot.yaml").write_text("wheels: {scale: 2}\n")
    return folder


def run_before(bags, out):
    """Do in this process what the command would start processes for."""
    for job in plan_bags(bags, None, lambda bag: config_of({}), "fgloc smooth a b").jobs:
        execute(job, out)


def test_each_bag_gets_a_folder_and_a_bad_one_stops_no_other(bags, tmp_path):
    out = tmp_path / "out"
    given = [bags / name / "bag" for name in ("one", "two", "wrong")]
    command = ("smooth", *given, bags / "broken" / "bag.mcap", bags / "nowhere.bag", "--out", out, "--workers", 1)
    code, stdout, stderr = fgloc(*command)
    assert code == 1
    for name in ("one_bag", "two_bag"):
        assert {file.name for file in (out / name).iterdir()} == FILES
    rows = {line.split()[0]: line.split()[1:] for line in stdout.splitlines() if line.strip()}
    metrics = json.loads((out / "two_bag" / "metrics.json").read_text())
    assert f"{metrics['ate_mean_m']:.4f}" in rows["two_bag"]
    assert all(rows[name][-1] == "failed" for name in ("wrong_bag", "broken_bag", "nowhere"))
    said = dict(line.split(": ", 1) for line in stderr.splitlines() if ": " in line)
    assert "RecordingError" in said["broken_bag"]
    assert "nowhere.bag" in said["nowhere"]
    assert "wheels.scale" in stderr
    assert stderr.splitlines()[-1].startswith("3 of 5 bags ")
    assert len(attempts(out)) == 3
    before = (out / "one_bag" / "trajectory.tum").stat().st_mtime_ns
    shutil.rmtree(out / "two_bag")
    assert fgloc(*command)[:2] == (1, stdout)
    assert (out / "one_bag" / "trajectory.tum").stat().st_mtime_ns == before
    assert {file.name for file in (out / "two_bag").iterdir()} == FILES
    assert len(attempts(out)) == 5  # the one whose files were gone, and the broken one


def test_many_bags_give_what_each_alone_gives(bags, tmp_path):
    given = [bags / "one" / "bag", bags / "two" / "bag"]
    run_before(given, tmp_path / "many")
    code, stdout, stderr = fgloc("smooth", *given, "--out", tmp_path / "many")
    assert (code, stderr) == (0, "")
    assert stdout.splitlines()[-1] == f"reports: {tmp_path / 'many' / '*' / 'report.html'}"
    fgloc("smooth", given[1], "--out", tmp_path / "alone")
    for name in ("trajectory.tum", "covariance.csv", "steps.csv"):
        assert (tmp_path / "many" / "two_bag" / name).read_bytes() == (tmp_path / "alone" / name).read_bytes()


@pytest.mark.slow
def test_files_of_other_settings_do_not_count(bags, tmp_path):
    noises = {0.05: [], 0.2: []}
    for noise in (0.05, 0.2, 0.05, 0.05):
        config = Config.model_validate({"landmarks": {"range_sigma_m": noise}})
        (job,) = plan_bags([bags / "one" / "bag"], None, lambda bag, config=config: config, "").jobs
        execute(job, tmp_path)
        noises[noise].append((tmp_path / "bag" / "trajectory.tum").read_bytes())
    assert noises[0.05][0] == noises[0.05][1] != noises[0.2][0]
    assert len(attempts(tmp_path)) == 3


def test_a_lost_robot_among_many_exits_with_3(bags, tmp_path):
    given = [bags / "one" / "bag", bags / "lost" / "bag"]
    for job in plan_bags(given, None, lambda bag: config_of({}), "fgloc smooth a b").jobs:
        execute(job, tmp_path / "out")
    code, stdout, stderr = fgloc("smooth", *given, "--out", tmp_path / "out")
    assert code == 3
    assert "LOST" in stderr
    rows = {line.split()[0]: line.split() for line in stdout.splitlines() if line.strip()}
    assert float(rows["one_bag"][-2]) == 0.0 < float(rows["lost_bag"][-2])


def test_a_wrong_configuration_for_all_ends_at_once(bags, tmp_path):
    given = [bags / "one" / "bag", bags / "two" / "bag"]
    error = refused("smooth", *given, "--config", bags / "wrong" / "robot.yaml", "--out", tmp_path / "out")
    assert "wheels.scale" in error
    assert not (tmp_path / "out").exists()
    assert "given twice" in refused("smooth", given[0], given[0], "--out", tmp_path / "out")


def test_folder_names_differ_and_spare_the_sweeps_own(tmp_path):
    for name in ("a", "b", "jobs"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "run.1.mcap").touch()
    one, other = tmp_path / "a" / "run.1.mcap", tmp_path / "b" / "run.1.mcap"
    assert folder_names([one, tmp_path / "b"]) == ["run.1", "b"]
    assert folder_names([one, other]) == ["a_run.1", "b_run.1"]
    assert folder_names([tmp_path / "jobs"]) == [f"{tmp_path.name}_jobs"]
    assert folder_names([tmp_path / "a" / "x.bag", tmp_path / "a" / "x.mcap"])[0] != "x"
    with pytest.raises(ConfigError, match="given twice"):
        folder_names([one, tmp_path / "b" / ".." / "a" / "run.1.mcap"])


def test_each_bag_has_its_own_configuration(bags):
    plan = plan_bags([bags / "one", bags / "wrong"], None, lambda bag: load_config(bag / "robot.yaml"), "")
    assert set(plan.errors) == {"one", "wrong"}
    assert not plan.jobs
