"""Marker dictionaries: by name or from a file, which way up they are, and which one fits what is seen."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path

import cv2

from fgloc.errors import ConfigError
from fgloc.files.documents import read_text

_FILE_SUFFIXES = {".yml", ".yaml", ".json", ".xml"}
_MAX_BYTES = 1_000_000  # of a dictionary file; the largest that OpenCV ships has 1000 markers in 120 kB
_APRILTAG = "DICT_APRILTAG_"
_TAG36H11_0 = 0xD5D628584  # bits of tag 0 of tag36h11 from the top left, row by row, as the AprilTag project prints it
_LEAST_EVIDENCE_BITS = 6.0  # log2 of how much less likely than this chance has to be


def dictionary_names() -> tuple[str, ...]:
    """Names of the predefined dictionaries, in OpenCV's spelling, those spelled in two ways once."""
    names = {n.upper(): n for n in sorted(dir(cv2.aruco)) if n.startswith("DICT_")}  # "36h11" sorts behind "36H11"
    return tuple(sorted(names.values()))


def load_dictionary(name: str) -> cv2.aruco.Dictionary:
    """A predefined dictionary by its name in any case, or one of OpenCV's dictionary files.

    Raises:
        ConfigError: no such name (all are listed), or the file holds no dictionary.
    """
    known = {n.upper(): n for n in dictionary_names()}
    if name.upper() in known:
        return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, known[name.upper()]))
    if Path(name).suffix.lower() not in _FILE_SUFFIXES:
        raise ConfigError(f"marker dictionary '{name}' is not known; known are {', '.join(known.values())}")
    dictionary = cv2.aruco.Dictionary()
    try:
        text = read_text(Path(name), ConfigError, "give the name or the file of a marker dictionary", _MAX_BYTES)
        storage = cv2.FileStorage(text, cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)
        good = storage.isOpened() and dictionary.readDictionary(storage.root())
        storage.release()
    except (cv2.error, SystemError) as error:
        raise ConfigError(f"{name}: not a marker dictionary of OpenCV: {error}") from error
    if not good or len(dictionary.bytesList) == 0:
        raise ConfigError(f"{name}: not a marker dictionary of OpenCV (keys nmarkers, markersize, marker_0, ...)")
    return dictionary


def turned_by_180(name: str) -> bool:
    """Whether OpenCV's picture of these markers stands on its head, compared with the AprilTag project's prints.

    Source: OpenCV pull request 28823; the check of one known tag keeps this right before and after it.
    """
    if not name.upper().startswith(_APRILTAG):
        return False
    drawn = cv2.aruco.generateImageMarker(load_dictionary("DICT_APRILTAG_36h11"), 0, 8)[1:7, 1:7].ravel() > 0
    return int("".join("1" if bit else "0" for bit in drawn), 2) != _TAG36H11_0


def suggest(look: Callable[[str], tuple[list[int], int]]) -> str | None:
    """The dictionary whose sightings are the least likely to be chance, in its smallest size that holds the ids.

    Args:
        look: gives, for a dictionary's name, the ids found, once for each sighting, and the number of squares tried.

    Returns:
        The name, or None if no dictionary's sightings are beyond chance.
    """
    families: dict[str, list[str]] = {}
    for name in dictionary_names():
        stem, _, count = name.rpartition("_")
        families.setdefault(stem if count.isdigit() else name, []).append(name)
    best, best_evidence = None, _LEAST_EVIDENCE_BITS
    for names in families.values():
        names.sort(key=lambda n: len(load_dictionary(n).bytesList))
        ids, squares = look(names[-1])
        by_chance = math.log2(
            math.comb(max(squares, len(ids)), len(ids))
        )  # the ways to pick the ones that read wrongly
        evidence = len(ids) * _evidence_bits(load_dictionary(names[-1])) - by_chance
        if evidence > best_evidence:
            best_evidence = evidence
            best = next(n for n in names if len(load_dictionary(n).bytesList) > max(ids))
    return best


def _evidence_bits(dictionary: cv2.aruco.Dictionary) -> float:
    """How surprising it is [bits] that a random square reads as one of the markers."""
    bits = int(dictionary.markerSize) ** 2
    wrong = int(0.6 * dictionary.maxCorrectionBits)  # OpenCV's default error correction rate
    accepted = sum(math.comb(bits, k) for k in range(wrong + 1))
    return bits - math.log2(4 * len(dictionary.bytesList) * accepted)
