"""Mutants of small sound recordings and models: bytes changed, cut out, doubled; numbers replaced by absurd ones."""

from __future__ import annotations

import random
import shutil
import struct
from collections.abc import Callable, Iterator
from pathlib import Path

from tests.fuzz.samples import SAMPLES

_ABSURD = [struct.pack("<d", v) for v in (float("nan"), float("inf"), -float("inf"), 1e300, -1e300, 1e-320, 0.0)]
_ABSURD += [struct.pack("<f", v) for v in (float("nan"), float("inf"), 3e38)]
_ABSURD += [b"\xff" * 4, b"\xff" * 8, b"\0" * 8, b"\x7f\xff\xff\xff", b"\xff\xff\xff\x7f", b"\x80" * 4]


def _flip(data: bytearray, rng: random.Random) -> None:
    for _ in range(rng.choice((1, 1, 2, 8, 64))):
        data[rng.randrange(len(data))] ^= 1 << rng.randrange(8)


def _absurd(data: bytearray, rng: random.Random) -> None:
    value = rng.choice(_ABSURD)
    at = rng.randrange(max(1, len(data) - len(value)))
    at -= at % len(value) if rng.random() < 0.5 else 0
    data[at : at + len(value)] = value


def _cut(data: bytearray, rng: random.Random) -> None:
    del data[rng.randrange(len(data)) :]


def _remove(data: bytearray, rng: random.Random) -> None:
    at = rng.randrange(len(data))
    del data[at : at + rng.choice((1, 4, 64, 4096))]


def _double(data: bytearray, rng: random.Random) -> None:
    at, size = rng.randrange(len(data)), rng.choice((1, 8, 100, 5000))
    data[at:at] = data[at : at + size]


def _swap(data: bytearray, rng: random.Random) -> None:
    size = rng.choice((8, 64, 1024))
    a, b = rng.randrange(len(data)), rng.randrange(len(data))
    data[a : a + size], data[b : b + size] = data[b : b + size], data[a : a + size]


def _zero(data: bytearray, rng: random.Random) -> None:
    at, size = rng.randrange(len(data)), rng.choice((16, 512, 4096))
    data[at : at + size] = bytes(len(data[at : at + size]))


def _noise(data: bytearray, rng: random.Random) -> None:
    at, size = rng.randrange(len(data)), rng.choice((4, 64, 2048))
    data[at : at + size] = rng.randbytes(len(data[at : at + size]))


MUTATIONS: tuple[Callable[[bytearray, random.Random], None], ...] = (
    _flip,
    _absurd,
    _absurd,
    _cut,
    _remove,
    _double,
    _swap,
    _zero,
    _noise,
)


def mutated(data: bytes, seed: int) -> bytes:
    """One to three mutations of some bytes; the same seed gives the same ones."""
    rng = random.Random(seed)
    out = bytearray(data)
    for _ in range(rng.choice((1, 1, 2, 3))):
        if out:
            rng.choice(MUTATIONS)(out, rng)
    return bytes(out)


def mutants(samples: Path, folder: Path, seeds: Iterator[int]) -> Iterator[tuple[str, Path]]:
    """Mutated recordings, each in a folder of its own with the sample's map and configuration: name and path.

    The file before is deleted when the next one is asked for.
    """
    names = sorted(SAMPLES)
    for seed in seeds:
        name = names[seed % len(names)]
        source = samples / name
        target = folder / f"{name.replace('.', '_')}_{seed}"
        shutil.copytree(source.parent if source.is_file() else source, target, ignore=_others(source))
        victim = _victim(target, source, seed)
        victim.write_bytes(mutated(victim.read_bytes(), seed))
        yield f"{name} {seed}", target if source.is_dir() else target / source.name
        shutil.rmtree(target)


def _others(source: Path) -> Callable[[str, list[str]], list[str]]:
    """Of the folder that holds the samples, all but this one and the files beside it."""
    return lambda where, names: [
        n for n in names if source.is_file() and n in SAMPLES and n != source.name and Path(where) == source.parent
    ]


def _victim(target: Path, source: Path, seed: int) -> Path:
    if source.is_file():
        return target / source.name
    files = sorted(f for f in target.iterdir() if f.suffix in (".mcap", ".db3", ".zstd"))
    metadata = target / "metadata.yaml"
    return metadata if seed % 16 == 0 and metadata.exists() else files[seed % len(files)]
