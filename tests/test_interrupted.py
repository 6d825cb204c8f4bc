"""Interrupted or killed at any moment, a command leaves complete results."""

import contextlib
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from jaxphoto.writing import check_folder, is_place

ROOT = Path(__file__).resolve().parents[1]
# A script starts its background jobs deaf to Ctrl-C; a terminal does not.
_LISTENING = "import signal; signal.signal(signal.SIGINT, signal.default_int_handler)\n"
COMMAND = [sys.executable, "-c", _LISTENING + "from jaxphoto_command import main; print(flush=True); main()"]


def interrupted(arguments, delay, number=signal.SIGINT):
    """Exit code and standard error after a signal that comes after `delay` (s); None if it came too late."""
    process = subprocess.Popen(
        [*COMMAND, *map(str, arguments)], cwd=ROOT, text=True, stdout=subprocess.PIPE, stderr=subprocess.PIPE
    )
    process.stdout.readline()
    with contextlib.suppress(subprocess.TimeoutExpired):
        process.communicate(timeout=delay)
        return None
    process.send_signal(number)
    _, error = process.communicate()
    return process.returncode, error


@pytest.mark.slow
@pytest.mark.parametrize("command", ["adjust", "simulate"])
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGKILL])
def test_ended_at_any_moment_it_leaves_complete_results(tmp_path, command, number):
    given = ROOT / "examples" / {"adjust": "cross_block", "simulate": "recipe.toml"}[command]
    out = tmp_path / "out"
    arguments = (command, given, "--out", out)
    subprocess.run([*COMMAND, *map(str, arguments)], cwd=ROOT, check=True, capture_output=True)
    for delay in np.random.default_rng(1).uniform(0.05, 5.0, 8):
        ended = interrupted(arguments, delay, number)
        if ended is not None and number == signal.SIGINT and ended[0] == 130:
            assert ended[1].endswith("jaxphoto: interrupted\n")
            assert [p.name for p in tmp_path.iterdir()] == ["out"]
        check_folder(out)
        assert [p.name for p in tmp_path.iterdir() if not is_place(p.name)] == ["out"]
