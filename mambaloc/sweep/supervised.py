"""Run a command for as long as whoever asked for it lives: python supervised.py COMMAND [WORD ...].

The asker holds the other end of stdin, which closes however it ends, ``kill -9`` included; then this process's whole
group is killed, so that no orphaned training goes on. The group must be its own. Where this process is
killed itself, as Ray does to what its workers started, Linux ends the command.
"""

import ctypes
import os
import signal
import subprocess
import sys
import threading

_PR_SET_PDEATHSIG = 1


def main() -> None:
    """Pass on how the command ended, as a shell does: 128 and the signal that killed it."""
    preexec = _end_with_parent if sys.platform == "linux" else None
    command = subprocess.Popen(sys.argv[1:], stdin=subprocess.DEVNULL, preexec_fn=preexec)
    threading.Thread(target=_end_with_asker, daemon=True).start()
    code = command.wait()
    sys.exit(code if code >= 0 else 128 - code)


def _end_with_parent() -> None:
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)


def _end_with_asker() -> None:
    while os.read(0, 4096):  # unbuffered: the interpreter could not end with a buffer in use
        pass
    os.killpg(0, signal.SIGKILL)


if __name__ == "__main__":
    main()
