"""Memory and time stay in proportion to a recording's size, whatever it claims to hold."""

import bz2
import json
import re
import sqlite3

import cv2
import lz4.frame
import numpy as np
import pytest
import zstandard
from rosbags.interfaces import MessageDefinition, MessageDefinitionFormat
from rosbags.typesys import get_types_from_msg

from fgloc.errors import RecordingError
from fgloc.recording.limits import Budget, TooLargeError, check_sqlite, decompressed
from fgloc.recording.messages import Decoder, DefinitionError, check_sizes, default_typestore, plain_idl
from fgloc.sensors.markers.images import ImageError, ImageEvent, decode
from tests.fuzz.hostile_bags import make_all, mcap_bomb, megabytes
from tests.fuzz.processes import run

COMPRESS = {"zstd": zstandard.compress, "lz4": lz4.frame.compress, "bz2": bz2.compress}

_INSPECT = """
import json, sys
from pathlib import Path
from fgloc.config import load_config, Config
from fgloc.errors import FglocError
from fgloc.recording.info import inspect
from fgloc.runner import run
said = {}
for name in sys.argv[1:]:
    path, found = Path(name), []
    try:
        info = inspect(path, Config())
        found += [*info.notes, *info.findings]
        if (path / "robot.yaml").exists():
            result = run(path, None, load_config(path / "robot.yaml"), "online")
            found += [f"{reason} {n}" for reason, n in result.rejections.items()]
    except FglocError as error:
        found.append(str(error))
    said[path.name.split(".")[0]] = " ".join(found)
print(json.dumps(said))
"""

EXPECTED = {
    "mcap_zstd": "expands to",
    "mcap_lz4": "expands to",
    "mcap_undeclared": "a chunk expands to more than",
    "mcap_merged": "expands to",
    "ros1_bz2": "expands to",
    "ros1_lz4": "expands to",
    "raw_image": "expands to",
    "compressed": "expands to",
    "definition_strings": "Damaged definitions",
    "definition_numbers": "cannot be decoded",
    "definition_messages": "Damaged definitions",
    "definition_itself": "Damaged definitions",
    "definition_empty": "Damaged definitions",
    "definition_comments": "Damaged definitions",
    "definition_fields": "Damaged definitions",
    "definition_idl": "Damaged definitions",
    "sqlite_endless": "is computed, as no recorder writes it",
    "sqlite_blobs": "is computed, as no recorder writes it",
    "sqlite_generated": "is computed, as no recorder writes it",
    "png": "image.size 1",
    "jpeg": "image.size 1",
    "webp": "image.undecodable 1",
    "scans": "image.undecodable 1",
}


@pytest.mark.slow
def test_hostile_recordings_are_refused_within_bounds(tmp_path):
    """In one process, so that its peak is that of the worst of them."""
    made = {k: p for k, p in make_all(tmp_path / "bags", great=256 << 20).items() if k != "mcap_many_chunks"}
    assert all(megabytes(path) < 1.0 for path in made.values())
    done = run(["-c", _INSPECT, *map(str, made.values())], seconds=100.0)
    assert done.failures(codes=[0], peak_mb=500.0) == [], done.stderr

    said = json.loads(done.stdout)
    assert {name: text for name, text in EXPECTED.items() if text not in said[name]} == {}, said


@pytest.mark.slow
def test_chunks_of_nothing_end_the_reading(tmp_path):
    mcap_bomb(tmp_path / "many.mcap", "zstd", 25 << 20, chunks=100)
    done = run(["-m", "fgloc.cli", "info", str(tmp_path / "many.mcap")], seconds=60.0)
    assert done.failures(peak_mb=500.0) == []
    assert "expands to" in done.stderr


@pytest.mark.parametrize("kind", COMPRESS)
def test_decompression_is_bounded_and_exact(kind):
    data = bytes(range(256)) * 5000
    packed = COMPRESS[kind](data)
    assert decompressed(kind, packed, len(data)) == data
    assert decompressed(kind, packed + packed, 2 * len(data)) == data + data
    with pytest.raises(OverflowError):
        decompressed(kind, packed, len(data) - 1)
    for damaged in (packed[:-5], packed[: len(packed) // 2]):
        with pytest.raises(ValueError, match=kind):
            decompressed(kind, damaged, len(data))
    with pytest.raises(ValueError, match=r"\b1000\b"):
        decompressed(kind, COMPRESS[kind](b"x") * 1001, 10_000)
    with pytest.raises(ValueError, match="unknown compression"):
        decompressed("xz", b"", 1)


def test_budget_grows_with_the_file(tmp_path):
    path = tmp_path / "f"
    path.write_bytes(bytes(1 << 20))
    budget = Budget(path)
    assert budget.limit == (32 + 128) << 20
    budget.check(budget.limit)
    budget.start_pass()
    budget.spend(budget.limit)
    with pytest.raises(TooLargeError, match=re.escape(str(path))):
        budget.spend(1)


def test_usual_definitions_pass():
    for ros1 in (False, True):
        check_sizes(default_typestore(ros1).fielddefs)


def test_definition_may_not_stand_for_more_than_its_message():
    def check(text):
        check_sizes(get_types_from_msg(text, "a/msg/A"))

    separator = "=" * 80 + "\nMSG: "
    check("float64[2000] x\nstring[100] names\n")
    for bad in (
        "string[1001] x\n",
        f"a/B[500] x\n{separator}a/B\n",  # of nothing
        f"a/B[] x\n{separator}a/B\n",
        f"a/B x\n{separator}a/B\na/A[] y\n",
    ):
        with pytest.raises(DefinitionError):
            check(bad)


IDL = """// generated from rosidl_adapter/resource/msg.idl.em
#include "geometry_msgs/msg/Vector3.idl"

module geometry_msgs {
  module msg {
    @verbatim (language="comment", text=
      "This expresses velocity in free space (broken into its" "\\n"
      "linear and angular parts).")
    struct Twist {
      @unit (value="m/s")
      geometry_msgs::msg::Vector3 linear; /* (and) */
      geometry_msgs::msg::Vector3 angular;
    };
  };
};
"""


def test_idl_is_read_without_annotations():
    vector = "module geometry_msgs { module msg { struct Vector3 { double x; double y; double z; }; }; };\n"
    separator = "=" * 80 + "\n"
    text = f"{separator}IDL: geometry_msgs/msg/Twist\n{IDL}{separator}IDL: geometry_msgs/msg/Vector3\n{vector}"
    definition = MessageDefinition(MessageDefinitionFormat.IDL, text)
    decoder = Decoder(False, [("geometry_msgs/msg/Twist", definition)])
    assert decoder.notes == []
    raw = b"\0\1\0\0" + np.arange(6.0).tobytes()
    assert decoder.deserialize("geometry_msgs/msg/Twist", raw).angular.z == 5.0
    with pytest.raises(DefinitionError):
        plain_idl("module a { const long X = ((1)); };")


def test_computed_columns_are_told_from_usual_tables(tmp_path):
    path = tmp_path / "a.db3"
    database = sqlite3.connect(path)
    database.execute("CREATE TABLE messages(id INTEGER PRIMARY KEY, data BLOB NOT NULL)")
    database.execute("CREATE INDEX timestamp_idx ON messages (id ASC)")
    database.commit()
    check_sqlite(path)
    database.execute("CREATE VIEW other AS SELECT 1")
    database.commit()
    database.close()
    with pytest.raises(RecordingError, match="view 'other' is computed"):
        check_sqlite(path)


def test_image_sizes_are_those_of_the_headers():
    def message(data, **more):
        fields = {"encoding": "jpeg", "compressed": True, "width": 0, "height": 0, "step": 0, "is_bigendian": False}
        return ImageEvent(1, 1, "/i", "c", **(fields | more), data=np.frombuffer(data, np.uint8))

    image = np.zeros((30, 40), np.uint8)
    for suffix in (".png", ".jpg"):
        data = bytearray(cv2.imencode(suffix, image)[1].tobytes())
        assert decode(message(bytes(data))).shape == (30, 40)
        at = 16 if suffix == ".png" else data.index(b"\xff\xc0") + 5
        data[at : at + (8 if suffix == ".png" else 4)] = (
            b"\0\0\x40\0\0\0\x40\1" if suffix == ".png" else b"\xff\xff\xff\xff"
        )
        with pytest.raises(ImageError, match=r"\b16777216\b"):
            decode(message(bytes(data)))
    with pytest.raises(ImageError, match="5000x5000"):
        decode(message(b"\0", encoding="mono8", compressed=False, width=5000, height=5000))


def test_opencv_keeps_the_bound_whatever_the_format():
    code = (
        "import fgloc, cv2, numpy\n"
        "data = cv2.imencode('.webp', numpy.zeros((5000, 5000), numpy.uint8))[1]\n"
        "try: cv2.imdecode(data, 0)\nexcept cv2.error as error: print('CV_IO_MAX_IMAGE_PIXELS' in str(error))"
    )
    assert run(["-c", code]).stdout.strip() == "True"
