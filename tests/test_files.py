"""Files that are written whole, locks, and names that are fit to be shown."""

import os
import stat
from pathlib import Path

import pytest

from agents.names import csv_cell, figure_label, file_names, name_folders, printable
from roadgym.files import check_file, locked, make_folder, remove_parts, whole_file


def test_writing_goes_through_no_link_that_lies_in_the_folder(tmp_path, monkeypatch):
    victim = tmp_path / "victim"
    victim.write_text("before")
    monkeypatch.setattr("secrets.token_hex", lambda count: "0" * 2 * count)  # whoever could foresee it all the same
    for name in ("part-x.json", f".part-{'0' * 16}.json"):
        (tmp_path / name).symlink_to(victim)
    with pytest.raises(FileExistsError), whole_file(tmp_path / "x.json") as part:
        part.write_text("after")
    monkeypatch.undo()
    with whole_file(tmp_path / "x.json") as part:
        part.write_text("after")
    assert (victim.read_text(), (tmp_path / "x.json").read_text()) == ("before", "after")


def test_link_stays_and_what_it_leads_to_is_replaced(tmp_path):
    (tmp_path / "disk").mkdir()
    (tmp_path / "link").symlink_to(tmp_path / "disk" / "file")
    for text in ("first", "second"):
        with whole_file(tmp_path / "link") as part:
            part.write_text(text)
        assert (tmp_path / "link").is_symlink()
        assert (tmp_path / "disk" / "file").read_text() == text
    assert len(list((tmp_path / "disk").iterdir())) == 1


@pytest.mark.skipif(os.name == "nt", reason="permissions of another kind")
def test_permissions_are_those_of_any_new_file_or_of_the_file_before(tmp_path):
    plain, whole = tmp_path / "plain", tmp_path / "whole"
    plain.write_text("")
    for wanted in (stat.S_IMODE(plain.stat().st_mode), 0o600):
        with whole_file(whole) as part:
            part.write_text("text")
        assert stat.S_IMODE(whole.stat().st_mode) == wanted
        whole.chmod(0o600)


def test_failed_writing_leaves_what_was_there_and_nothing_else(tmp_path):
    file = tmp_path / ("long" * 60 + ".json")
    file.write_text("before")

    def fail():
        with whole_file(file) as part:
            part.write_text("half")
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        fail()
    assert [path.read_text() for path in tmp_path.iterdir()] == ["before"]


def test_no_folder_device_or_file_in_the_way_is_written(tmp_path):
    (tmp_path / "file").write_text("in the way")
    for path in (tmp_path, tmp_path / "file" / "x", tmp_path / "none" / "x", Path(os.devnull), Path()):
        with pytest.raises(OSError, match=r"is a folder|is not a regular file|Not a directory|No such file"):
            check_file(path)
    with pytest.raises(NotADirectoryError, match="is not a folder"):
        make_folder(tmp_path / "file")
    check_file(tmp_path / "new")
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


def test_lock_is_held_by_one_and_leaves_nothing(tmp_path):
    lock = tmp_path / ".lock"
    lock.write_text("")  # left by a killed process
    for _ in range(2):
        with locked(lock):
            with pytest.raises(BlockingIOError), locked(lock):
                pass
            assert lock.exists()
        assert not lock.exists()


def test_only_parts_are_removed(tmp_path):
    with whole_file(tmp_path / "a.zip") as part:
        name = part.name
    (tmp_path / "a.zip").rename(tmp_path / name)  # as a killed writer would leave it
    (tmp_path / ".part-mine").write_text("somebody's")
    remove_parts(tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == [".part-mine"]


def test_names_of_folders_tell_them_apart():
    assert name_folders(["runs/a", "runs/b"], ()) == ["a", "b"]
    assert name_folders(["x/agent-0", "y/agent-0", "y/Other"], ()) == ["x/agent-0", "y/agent-0", "y/Other"]
    assert name_folders(["one/a", "two/A"], ()) == ["one/a", "two/A"]
    assert name_folders(["runs/skyhook", "runs/b"], ("skyhook",)) == ["runs/skyhook", "runs/b"]
    assert name_folders(["runs/new\nline"], ()) == [r"new\nline"]
    long = name_folders(["a/" + "x" * 300, "b/" + "x" * 300], ())
    assert len(set(long)) == 2
    assert max(map(len, long)) < 50
    assert printable("größe") == "größe"
    assert printable("größe".encode().decode("ascii", "surrogateescape")) == "größe"  # as another locale reads it
    assert printable("\udcff") == r"\udcff"


def test_names_are_harmless_where_they_are_written():
    assert figure_label(r"$\frac{$") == r"\$\frac{\$"
    assert figure_label("_hidden") == " _hidden"
    assert len(figure_label("x" * 500)) < 50
    assert [csv_cell(text) for text in ("=cmd", "+1", "-1", "@x", "plain", -1.0)] == [
        "'=cmd",
        "'+1",
        "'-1",
        "'@x",
        "plain",
        -1.0,
    ]
    names = ["a/b", "a:b", "A_B", "größe", "../x", "y" * 300]
    files = file_names(names)
    assert list(files) == names
    assert len({file.casefold() for file in files.values()}) == len(names)
    assert all(len(file) < 50 and file.isascii() and "/" not in file for file in files.values())
