"""Calls beside what their thread does."""

import subprocess
import sys
import threading

import pytest

from meshsplats.blender.background import Background


def test_a_call_runs_beside_and_gives_its_result():
    here, go_on = threading.get_ident(), threading.Event()

    def call():
        assert go_on.wait(60)
        return threading.get_ident()

    beside = Background(call)
    go_on.set()  # which the call waits for
    assert beside.result() != here


def test_what_it_raises_is_raised_where_the_result_is_wanted():
    def call():
        raise KeyError("colours")

    beside = Background(call)
    for _ in range(2):
        with pytest.raises(KeyError, match="colours"):
            beside.result()


def test_the_process_does_not_wait_for_it():
    code = """
import time
from meshsplats.blender.background import Background
Background(lambda: time.sleep(600))
raise SystemExit(3)
"""
    assert subprocess.run([sys.executable, "-c", code], timeout=60).returncode == 3
