"""The tools that make files of the project delete nothing else."""

from __future__ import annotations

import sys

import pytest
from _local import script

pytest.importorskip("tomllib", reason="releases are made with Python 3.11")
pytest.importorskip("resource", reason="releases are made on Linux")
release = script("tools/release.py")
docs_site = script("tools/docs_site.py")


@pytest.fixture
def refused(tmp_path, monkeypatch):
    """Asserts that ``main`` ends with a message before any program starts, and all files stay."""

    def check(tool, folder, message):
        monkeypatch.setattr(tool, "subprocess", None)
        monkeypatch.setattr(sys, "argv", ["tool", "-o", str(folder), *["--rehearsal"] * (tool is release)])
        before = sorted(tmp_path.rglob("*"))
        with pytest.raises(SystemExit, match=message):
            tool.main()
        assert sorted(tmp_path.rglob("*")) == before

    return check


@pytest.mark.parametrize("tool", [release, docs_site])
def test_a_folder_of_others_is_refused_and_stays(tool, tmp_path, refused):
    (tmp_path / "work" / "deeper").mkdir(parents=True)
    (tmp_path / "work" / "deeper" / "thesis.txt").touch()
    (tmp_path / "work" / "index.html").touch()
    refused(tool, tmp_path / "work", "name another folder after -o")
    refused(tool, tmp_path / "work" / "index.html", "is a file")


@pytest.mark.parametrize("other", ["notes.txt", "meshsplats-1.whl/", "numpy-2.0.whl"])
def test_a_release_with_something_else_beside_it_is_refused(other, tmp_path, refused):
    (tmp_path / "SHA256SUMS").touch()
    if other.endswith("/"):
        (tmp_path / other).mkdir()
    else:
        (tmp_path / other).touch()
    refused(release, tmp_path, f"no part of a release: {other.rstrip('/')}")


def test_an_older_release_is_replaced(tmp_path):
    for name in ("meshsplats-0.1.0.tar.gz", "meshsplats-0.1.0-py3-none-win_amd64.whl", "SHA256SUMS"):
        (tmp_path / name).touch()
    (tmp_path / "meshsplats-0.1.0-linux_x64-blender_4.2.zip").touch()
    release.check_output(tmp_path)
    release.check_output(tmp_path / "new")


def test_an_older_site_is_replaced_unless_it_is_also_a_repository(tmp_path, refused):
    (tmp_path / "searchindex.js").touch()
    (tmp_path / "index.html").write_text("<title>Another project</title>")
    refused(docs_site, tmp_path, "no site that was made here")
    (tmp_path / "index.html").write_text(docs_site.TITLE)
    docs_site.check_output(tmp_path)
    (tmp_path / ".git").mkdir()
    refused(docs_site, tmp_path, "no site that was made here")


def test_the_first_page_of_the_site_has_the_title_that_tells_it():
    conf = (docs_site.ROOT / "docs" / "conf.py").read_text(encoding="utf-8")
    assert f'html_title = "{docs_site.TITLE[7:-8]}"' in conf
