"""The command `jaxphoto`, which Ctrl-C ends at once and cleanly, wherever it comes.

It lies beside the package, because importing that takes a second, in which Ctrl-C must do the same. Python asks for
signals between two of its own steps, and what compiles, solves or decodes takes many seconds for one; some of it even
swallows the exception. So here a thread waits for the signal, tidies up and ends the process.
"""

import atexit
import contextlib
import ctypes
import os
import signal
import sys
import threading
from collections.abc import Callable

# Ctrl-C, and what `kill` and a system that shuts down send.
_SIGNALS = (signal.SIGINT, signal.SIGTERM)
# Of <malloc.h>.
_ARENA_MAX = -8
tidy_up: list[Callable[[], object]] = []
"""What is done before a process that is told to end does."""
_ending = threading.Event()
_exit_code = 1


def main() -> None:
    """Entry point of the command `jaxphoto`."""
    global _exit_code
    share_one_pool()
    # The first to be registered is the last to be called.
    atexit.register(_leave)
    end_at_signals()
    # Here, because this is what takes a second.
    from jaxphoto.cli import main as command

    try:
        command()
        _exit_code = 0
    except SystemExit as stop:
        _exit_code = stop.code if isinstance(stop.code, int) else int(stop.code is not None)
        raise


def share_one_pool() -> None:
    """Have all threads take their memory from one pool of glibc, before there are any; other C libraries have none.

    In one of its own a thread can keep nothing large, and asks the system anew for each array.
    """
    if sys.platform == "linux" and hasattr(libc := ctypes.CDLL(None), "mallopt"):
        libc.mallopt(_ARENA_MAX, 1)


def end_at_signals() -> None:
    """Have this process end at Ctrl-C or SIGTERM: one line, nothing half-written, exit code 128 + the signal's number.

    What the process was started to ignore (nohup, a job in the background of a script) it goes on ignoring.
    """
    read, write = os.pipe()
    os.set_blocking(write, False)
    # Python writes the number of each signal there when it comes, not when it asks for it.
    signal.set_wakeup_fd(write, warn_on_full_buffer=False)
    threading.Thread(target=_wait, args=(read,), name="jaxphoto-signals", daemon=True).start()
    for number in _SIGNALS:
        if signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, lambda *_: None)


def wait_if_ending() -> None:
    """Wait for the end where the process was told to end: what fails then fails because its files are being removed."""
    if _ending.is_set():
        threading.Event().wait()


def _wait(read: int) -> None:
    while (number := os.read(read, 1)[0]) not in _SIGNALS:
        pass
    _ending.set()
    # Of a line that tells how far it is: away with it, and the cursor back.
    clean = "\r\x1b[2K\x1b[?25h" if os.isatty(2) else ""
    with contextlib.suppress(OSError):
        os.write(2, f"{clean}jaxphoto: interrupted\n".encode())
    try:
        for step in tidy_up:
            step()
    finally:
        os._exit(128 + number)


def _leave() -> None:
    """End without taking the interpreter apart: from then on nothing would answer a signal."""
    wait_if_ending()
    code = _exit_code
    for stream in (sys.stdout, sys.stderr):
        try:
            stream.flush()
        except (OSError, ValueError):
            # As Python itself ends where its output cannot be written.
            code = code or 120
    os._exit(code)
