"""Files are written whole or not at all; what a person wrote is read, or refused with why."""

import os
from pathlib import Path

import pytest

from tog_drake.errors import InputError
from tog_drake.files import MAX_YAML_BYTES, read_yaml, write_atomically


def test_a_written_file_is_complete_and_the_folder_is_made(tmp_path):
    path = tmp_path / "a" / "b.txt"
    write_atomically(path, "grüße")
    write_atomically(path, b"\x00\xff")
    assert path.read_bytes() == b"\x00\xff"
    assert [p.name for p in path.parent.iterdir()] == ["b.txt"]
    umask = os.umask(0)
    os.umask(umask)
    assert path.stat().st_mode & 0o777 == 0o666 & ~umask


@pytest.mark.parametrize("broken", [OSError("disk full"), KeyboardInterrupt()])
@pytest.mark.parametrize("step", ["fsync", "replace"])
def test_a_failed_write_leaves_the_old_file_and_nothing_else(tmp_path, monkeypatch, broken, step):
    def fail(*args):
        raise broken

    path = tmp_path / "report.html"
    write_atomically(path, "old")
    monkeypatch.setattr(os if step == "fsync" else Path, step, fail)
    with pytest.raises(type(broken)):
        write_atomically(path, "new")
    assert [p.name for p in tmp_path.iterdir()] == ["report.html"]
    assert path.read_text() == "old"


def test_yaml_is_read_in_any_language(tmp_path):
    file = tmp_path / "a.yaml"
    file.write_text("größe: [1, 2.5, null]  # 锤子\n", encoding="utf-8")
    assert read_yaml(file) == {"größe": [1, 2.5, None]}


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"a: [1", "expected ',' or ']'"),
        (b"a: \xff", "'utf-8' codec can't decode"),
        (b"made: 2026-99-99", "month must be in 1..12"),
        (b"!!python/object/apply:os.getcwd []", "could not determine a constructor"),
        (b"[" * 20_000, "it is nested too deeply"),
        (b"a: b" + b" " * MAX_YAML_BYTES, f"it has more than {MAX_YAML_BYTES} bytes"),
    ],
    ids=["cut", "bytes", "date", "python", "deep", "large"],
)
def test_yaml_that_cannot_be_read_is_refused_with_the_reason(content, message, tmp_path):
    file = tmp_path / "a.yaml"
    file.write_bytes(content)
    with pytest.raises(InputError, match=message):
        read_yaml(file)


def test_yaml_that_is_not_there_or_a_folder_is_refused(tmp_path):
    with pytest.raises(InputError, match=r"No such file.*none\.yaml"):
        read_yaml(tmp_path / "none.yaml")
    with pytest.raises(InputError, match="Is a directory"):
        read_yaml(tmp_path)
