"""Who is in which group, by the lines of the ACL file."""

from __future__ import annotations

import os
import threading
from pathlib import Path

import pytest
from waiting import PATIENCE

from appliance.access import Acl
from appliance.access.groups import groups, join, leave, members
from appliance.access.rewriting import locked


def test_groups_of_a_file(tmp_path: Path):
    (tmp_path / "groups").mkdir()
    for name in ("a", "b"):
        (tmp_path / f"groups/{name}.conf").write_text(f"topic read {name}/#\n")
    acl = tmp_path / "acl.conf"
    text = "# who\nuser x\ninclude groups/a.conf\ntopic read own\n\nuser y\ninclude groups/a.conf\n"
    acl.write_text(text)
    acl.chmod(0o640)
    assert groups(acl) == ["a", "b"] and members(acl) == {"x": ["a"], "y": ["a"]}
    join(acl, "r2", "x", ["b", "a", "b"])
    assert acl.read_text() == text.replace(
        "user x\ninclude groups/a.conf\n", "user x\ninclude groups/b.conf\ninclude groups/a.conf\n"
    )
    join(acl, "r2", "x", [])
    join(acl, "r2", "new one", ["b"])
    assert members(acl) == {"y": ["a"], "new one": ["b"]}
    changed = acl.stat().st_mtime_ns
    leave(acl, "r2", "x")
    assert acl.stat().st_mtime_ns == changed  # it was in none
    assert "topic read own" in acl.read_text() and acl.stat().st_mode & 0o777 == 0o640
    assert {rule.user for rule in Acl.load(acl, "r2").rules} == {"x", "y", "new one"}
    before = acl.read_text()
    with pytest.raises(ValueError, match="no group 'c'; there are a, b"):
        join(acl, "r2", "x", ["c"])
    with pytest.raises(ValueError):
        join(acl, "r2", "x\ntopic write #", ["a"])
    assert acl.read_text() == before and not list(tmp_path.glob(".acl*"))


def test_who_else_rewrites_a_file_there_is_waited_for_and_its_change_kept(tmp_path: Path):
    (tmp_path / "groups").mkdir()
    (tmp_path / "groups/a.conf").write_text("topic read a/#\n")
    acl = tmp_path / "acl.conf"
    acl.write_text("user x\ntopic read own\n")
    thread = threading.Thread(target=join, args=(acl, "r2", "x", ["a"]))
    with locked(tmp_path):
        thread.start()
        thread.join(0.2)
        assert thread.is_alive(), "it has not waited"
        acl.write_text("user x\ntopic read other\n")
    thread.join(PATIENCE)
    assert acl.read_text() == "user x\ninclude groups/a.conf\ntopic read other\n"


@pytest.mark.skipif(os.geteuid() != 0, reason="only root gives files away")
def test_the_file_keeps_its_owner(tmp_path: Path):
    (tmp_path / "groups").mkdir()
    (tmp_path / "groups/a.conf").write_text("topic read a/#\n")
    acl = tmp_path / "acl.conf"
    acl.write_text("user x\n")
    os.chown(acl, 65534, 65534)
    join(acl, "r2", "x", ["a"])
    assert (acl.stat().st_uid, acl.stat().st_gid) == (65534, 65534)
