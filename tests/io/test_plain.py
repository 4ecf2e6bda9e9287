"""JSON that anybody may have written: read, or refused by name."""

import json
import os

import pytest

from napari_fiberburst.errors import OutputError
from napari_fiberburst.io.plain import parse_json, read_json
from napari_fiberburst.io.results import check_output
from napari_fiberburst.recordings.work import claim, own
from napari_fiberburst.results.batch import Row

DEEP = "[" * 5000 + "]" * 5000


def deep(levels):
    return '{"a":' * levels + "1" + "}" * levels


def test_values_may_be_nested_as_deep_as_anything_can_walk():
    assert parse_json('{"a": [1, {"b": [2.5, null, "x"]}]}') == {"a": [1, {"b": [2.5, None, "x"]}]}
    assert json.dumps(parse_json(deep(99))) == deep(99).replace(":", ": ")
    for text in (deep(100), deep(900), deep(100_000), DEEP, "[" * 100_000):
        with pytest.raises(ValueError, match=r"nested|Expecting"):
            parse_json(text)


def test_what_is_no_json_file_is_refused(tmp_path):
    os.mkfifo(tmp_path / "pipe.json")
    (tmp_path / "folder.json").mkdir()
    for name, content in (("deep", DEEP), ("text", "hello"), ("empty", ""), ("bytes", "\udcff")):
        (tmp_path / f"{name}.json").write_bytes(content.encode(errors="surrogateescape"))
    for name in ("pipe", "folder", "deep", "text", "empty", "bytes", "missing"):
        with pytest.raises(OutputError, match=rf"{name}\.json"):
            read_json(tmp_path / f"{name}.json")


@pytest.mark.parametrize("content", [DEEP, deep(900), None])
def test_a_damaged_sidecar_is_never_written_over(tmp_path, content):
    if content is None:
        os.mkfifo(tmp_path / "image.json")
    else:
        (tmp_path / "image.json").write_text(content)
    with pytest.raises(OutputError, match="is not of napari-fiberburst, and would be lost"):
        check_output(tmp_path / "image.tif")


@pytest.mark.parametrize("content", [DEEP, "[1]", "hello", None])
def test_damaged_work_is_refused_and_a_damaged_row_is_made_again(tmp_path, content):
    for name in ("work.json", "outputs.json"):
        if content is None:
            os.mkfifo(tmp_path / name)
        else:
            (tmp_path / name).write_text('{"a": 1}' if content == "[1]" and name == "outputs.json" else content)
    with pytest.raises(OutputError, match=r"work\.json"):
        claim(tmp_path, {"version": 1})
    with pytest.raises(OutputError, match=r"outputs\.json"):
        own(tmp_path, [tmp_path / "a.zarr"])
    assert Row.load(tmp_path / "work.json", {"version": 1}) is None
