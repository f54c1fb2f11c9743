"""Configurations, suites and maps that a careless reader would hang on, or answer with a traceback."""

from __future__ import annotations

import typing
from collections.abc import Iterator
from typing import Any

from pydantic import BaseModel

from fgloc.config import robot_file

_BOMB = "a0: &a0 [x, x]\n" + "".join(f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 9)}]\n" for i in range(1, 12))
_MERGES = "a0: &a0 {k: 1}\n" + "".join(f"a{i}: &a{i} {{<<: [{', '.join([f'*a{i - 1}'] * 9)}]}}\n" for i in range(1, 12))
_CHAIN = "a0: &a0 [x]\n" + "".join(f"a{i}: &a{i} [*a{i - 1}]\n" for i in range(1, 3000))

SYNTAX = {
    "alias bomb": _BOMB,
    "merge bomb": _MERGES,
    "alias chain": _CHAIN,
    "alias of itself": "wheels: &a {track: *a}\n",
    "deep lists": "wheels: " + "[" * 5000,
    "deep closed lists": "wheels: " + "[" * 5000 + "]" * 5000,
    "deep mappings": "".join(" " * i + "a:\n" for i in range(500)),
    "deep flow": "wheels: " + "{a: " * 5000,
    "impossible date": "wheels: {track: 2024-13-45}\n",
    "date": "wheels: {left_joint: 2024-01-01}\n",
    "date of year 0": "wheels: {left_joint: 0000-00-00}\n",
    "long integer": "estimator: {lag_s: " + "9" * 5000 + "}\n",
    "long hexadecimal": "estimator: {lag_s: 0x" + "f" * 5000 + "}\n",
    "long sexagesimal": "estimator: {lag_s: 1" + ":59" * 3000 + "}\n",
    "long float": "expert: {estimator: {lag_s: 1." + "9" * 5000 + "}}\n",
    "empty integer": "estimator: {lag_s: !!int ''}\n",
    "integer of a word": "estimator: {lag_s: !!int word}\n",
    "empty float": "estimator: {lag_s: !!float ''}\n",
    "bool of a word": "motion: {use: !!bool word}\n",
    "python object": "wheels: !!python/object/apply:os.system ['true']\n",
    "binary": "wheels: {track: !!binary aGVsbG8=}\n",
    "set": "wheels: !!set {a, b}\n",
    "unknown tag": "wheels: !mine {a: b}\n",
    "unknown anchor": "wheels: *nothing\n",
    "list as key": "? [a, b]\n: c\n",
    "mapping as key": "? {a: b}\n: c\n",
    "null as key": "null: c\n",
    "number as key": "1: c\n",
    "key twice": "wheels: {track: 0.3, track: 0.4}\n",
    "section twice": "wheels: {track: 0.3}\nwheels: {track: 0.4}\n",
    "tabs": "wheels:\n\ttrack: 0.3\n",
    "unclosed text": "wheels: {left_joint: 'abc\n",
    "control character": "wheels: {left_joint: \x07}\n",
    "escaped NUL": 'wheels: {left_joint: "a\\0b"}\n',
    "bell on the terminal": 'wheels: {"\\e[2J\\a": 1}\n',
    "two documents": "a: 1\n---\nb: 2\n",
    "a list": "- 1\n- 2\n",
    "a word": "word\n",
    "a number": "1\n",
    "nothing": "",
    "null": "null\n",
    "a comment": "# nothing\n",
    "directive": "%YAML 9.9\n---\na: 1\n",
    "many keys": "".join(f"k{i}: 1\n" for i in range(3_000)),
    "long key": "k" * 200_000 + ": 1\n",
    "merge of a word": "wheels: {<<: word}\n",
    "NUL in a path": 'camera: {file: "a\\0b"}\n',
    "NUL in a model": 'motion: {model: "a\\0b"}\n',
    "pipe as model": "motion: {model: /dev/stdin}\n",
    "endless model": "motion: {model: /dev/zero}\n",
    "folder as model": "motion: {model: /}\n",
    "endless camera": "camera: {file: /dev/zero}\n",
    "folder as camera": "camera: {file: /}\n",
    "endless dictionary": "markers: {dictionary: /dev/zero.yml}\n",
    "model of far away": "motion: {model: shipped:../../../etc/passwd}\n",
    "long path": "camera: {file: " + "a/" * 5000 + "b}\n",
    "unknown section": "wheel: {track: 0.3}\n",
    "unknown key": "wheels: {trak: 0.3}\n",
    "section of a word": "wheels: word\n",
    "section of a list": "wheels: [1, 2]\n",
    "no noise at all": "expert: {wheels: {noise: {x_per_sqrt_m: 0, y_per_sqrt_m: 0, yaw_per_sqrt_m: 0, "
    "xy_per_sqrt_rad: 0, yaw_per_sqrt_rad: 0, xy_per_sqrt_s: 0, yaw_per_sqrt_s: 0}}}\n"
    "wheels: {scale_sigma: 0, turn_scale_sigma: 0}\n",
    "no sigmas": "expert: {estimator: {initial_sigmas: [0, 0, 0]}}\n",
    "topic of control characters": 'recording: {topics: {odometry: "\\e[31m/odom"}}\n',
    "intervals of keyframes in the wrong order": "expert: {keyframes: {max_interval_s: 0.01}}\n",
    "distrust in the wrong order": "expert: {weights: {distrust: [{source: wheels, start_s: 2, end_s: 1}]}}\n",
}
"""Texts by what is wrong with them."""

_VALUES = (
    ".nan",
    ".inf",
    "-.inf",
    "1e300",
    "-1e300",
    "1e18",
    "-1",
    "0",
    "1e-300",
    "word",
    "[]",
    "{}",
    "99999999999999999999",
)


def numeric_keys(model: type[BaseModel] | None = None, path: str = "") -> Iterator[tuple[str, str, int]]:
    """Section, key and length (0: one number) of each numeric value of a configuration."""
    for name, field in (model or robot_file()).model_fields.items():
        kind = field.annotation
        if isinstance(kind, type) and issubclass(kind, BaseModel):
            yield from numeric_keys(kind, f"{path}{name}.")
            continue
        length = _numbers_in(kind)
        if length is not None:
            yield path.rstrip("."), name, length


def _numbers_in(kind: Any) -> int | None:
    if kind in (int, float):
        return 0
    for inner in typing.get_args(kind):
        if inner in (int, float):
            return 0
        if typing.get_origin(inner) is tuple or typing.get_origin(kind) is tuple:
            parts = typing.get_args(inner) or typing.get_args(kind)
            if parts and all(part is not Ellipsis and float in (part, *typing.get_args(part)) for part in parts):
                return len(parts)
    return None


def numeric_cases(values: tuple[str, ...] = _VALUES) -> Iterator[tuple[str, str]]:
    """Each numeric value of a configuration, set to each absurdity: name and text."""
    for section, key, length in numeric_keys():
        for value in values:
            shown = value if not length else "[" + ", ".join([value] * length) + "]"
            text = f"{key}: {shown}"
            for part in reversed(section.split(".")):
                text = f"{part}: {{{text}}}"
            yield f"{section}.{key} {value}", text + "\n"
