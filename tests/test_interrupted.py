"""Ctrl-C, or SIGTERM, ends the command wherever it comes, with one line and whole results; a kill without a line."""

import contextlib
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from jaxphoto.writing import check_folder

ROOT = Path(__file__).resolve().parents[1]
# What a script gives its background jobs, deafness to Ctrl-C, is not what a terminal gives.
_LISTENING = "import signal; signal.signal(signal.SIGINT, signal.default_int_handler)\n"
COMMAND = [sys.executable, "-c", _LISTENING + "from jaxphoto_command import main; print(flush=True); main()"]


def interrupted(arguments, delay, number=signal.SIGINT):
    """Exit code, standard error, seconds from the signal on, which comes after `delay` (s); None where it was over."""
    started = subprocess.Popen(
        [*COMMAND, *map(str, arguments)],
        cwd=ROOT,
        text=True,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
    )
    # Python itself has started: a busy machine may take its time for that.
    started.stdout.readline()
    with contextlib.suppress(subprocess.TimeoutExpired):
        started.communicate(timeout=delay)
        return None
    began = time.monotonic()
    started.send_signal(number)
    _, error = started.communicate()
    return started.returncode, error, time.monotonic() - began


def test_ctrl_c_while_it_starts(tmp_path):
    out = tmp_path / "out"
    arguments = ("simulate", ROOT / "examples" / "recipe.toml", "--out", out)
    code, error, seconds = interrupted(arguments, 0.1)
    assert (code, error) == (130, "jaxphoto: interrupted\n")
    assert seconds < 2
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
@pytest.mark.parametrize("command", ["adjust", "simulate"])
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGKILL])
def test_ended_at_any_moment_it_leaves_whole_results(tmp_path, command, number):
    given = ROOT / "examples" / {"adjust": "cross_block", "simulate": "recipe.toml"}[command]
    arguments, out = (command, given, "--out", tmp_path / "out"), tmp_path / "out"
    began = time.monotonic()
    subprocess.run([*COMMAND, *map(str, arguments)], cwd=ROOT, check=True, capture_output=True)
    whole = time.monotonic() - began
    for delay in np.random.default_rng(1).uniform(0.05, whole, 15):
        ended = interrupted(arguments, delay, number)
        if ended is not None and number != signal.SIGKILL:
            code, error, seconds = ended
            # All was written, and the process about to end, when the signal came.
            over = code == 0 and out.exists()
            assert over or (code, error) == (128 + number, "jaxphoto: interrupted\n"), delay
            assert seconds < 2
            assert [p.name for p in tmp_path.iterdir()] == ["out"]
        check_folder(out)
        assert [p.name for p in tmp_path.iterdir()] == ["out"]
