"""Thirty mutated files of each format; tests/fuzz/fuzz_readers.py runs any number."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip("resource", reason="the fuzzer limits its memory, which this system cannot")


@pytest.mark.nightly
def test_mutated_files_give_an_answer(tmp_path):
    command = [
        sys.executable,
        Path(__file__).parents[1] / "fuzz" / "fuzz_readers.py",
        "--count",
        "30",
        "--keep",
        tmp_path,
    ]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "FileFormatError" in done.stdout
    assert " read" in done.stdout  # some mutations do no harm
