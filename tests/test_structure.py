"""benchmarks.structure counts what it says, and what is counted stays where it is."""

from __future__ import annotations

import pytest

from benchmarks import structure

FILES = {
    "fgloc/__init__.py": "",
    "fgloc/types.py": "class OdometryEvent: ...\n",
    "fgloc/localizer.py": "import json\nfrom fgloc import types\nfrom fgloc.sensors.gyro import Gyro\n",
    "fgloc/sensors/gyro.py": "class Gyro: ...\nname = 'gyro'\n",
    "fgloc/sensors/registry.py": (
        "from fgloc.sensors.gyro import Gyro\n\n\ndef built_in(): return (Gyro,)\n\n\n"
        "def odometer(config): return config.wheels\n"
    ),
    "fgloc/sensors/maps.py": "import fgloc.sensors.gyro\n",
    "fgloc/robust.py": "class Gyro: ...\nx = Gyro()\nname = 'wheels.radius'\n",
    "fgloc/long.py": "def f():\n" + "    x = 1\n" * 50 + "def g():\n" + "    x = 1\n" * 49,
    "fgloc/wide.py": "def f(self, a, b, c, d, e, f, g): ...\n\n\ndef g(self, a, b, c, d, e, f, *, g, h): ...\n",
    "fgloc/circle_a.py": "import fgloc.circle_b\n",
    "fgloc/circle_b.py": "from fgloc import circle_a\n",
    "fgloc/big.py": "x = 1\n" * 301,
    "docs/page.md": "See fgloc/types.py, ../CHANGELOG.md and docs/nowhere.md; edit robot.yaml.\n",
    "CHANGELOG.md": "",
    "datasets/bag.py": '"""As design.md has it."""\n# and types.py\n',
}


@pytest.fixture
def root(tmp_path):
    for name, text in FILES.items():
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, encoding="utf-8")
    return tmp_path


def test_counts_of_a_small_tree(root):
    assert len(structure.flat_files(root)) == 9
    assert structure.localizer_imports(root) == ["fgloc.sensors.gyro", "fgloc.types"]
    assert structure.long_functions(root) == ["fgloc/long.py:1 f"]
    assert structure.many_parameters(root) == ["fgloc/wide.py:4 g"]
    assert structure.long_files(root) == ["fgloc/big.py 301"]
    assert structure.import_cycles(root) == ["fgloc.circle_a, fgloc.circle_b"]
    assert structure.cited_missing(root) == ["datasets/bag.py cites design.md", "docs/page.md cites docs/nowhere.md"]
    assert structure.new_sensor_files(root) is None


def test_leaks_of_a_small_tree(root):
    found = structure.sensor_leaks(root)
    assert "fgloc/localizer.py names gyro: Gyro, fgloc.sensors.gyro" in found
    assert "fgloc/robust.py names wheels: 'wheels.radius'" in found
    assert "fgloc/sensors/maps.py names gyro: fgloc.sensors.gyro" in found
    assert "fgloc/sensors/registry.py names wheels: config.wheels" in found
    assert not [
        line for line in found if line.startswith(("fgloc/sensors/registry.py names g", "fgloc/robust.py names g"))
    ]


@pytest.mark.parametrize(
    "name",
    [
        "structure.sensor_leaks",
        "structure.new_sensor_files",
        "structure.long_functions",
        "structure.many_parameters",
        "structure.long_files",
        "structure.import_cycles",
        "structure.cited_missing",
    ],
)
def test_nothing_is_found_here(name):
    assert structure.COUNTED[name](structure.ROOT) == []
