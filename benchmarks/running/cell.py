"""A process that calls methods and can be killed: for taking too long, or too much memory."""

from __future__ import annotations

import ctypes
import gc
import importlib
import os
import pickle
import subprocess
import sys
import threading
import time
import traceback
from contextlib import suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection, Pipe
from pathlib import Path
from typing import Any

READY = "ready"
PREPARATION_S = 900.0
"""Most time for what comes before the call: libraries load, and what an oracle is told is read."""
GIB = 1 << 30
_LOOK_S = 0.05


@dataclass(frozen=True)
class Limits:
    """What one call may take: wall-clock seconds, and GiB resident in its process."""

    seconds: float = 300.0
    memory_gib: float = 6.0


@dataclass(frozen=True)
class Ended:
    """A call that was ended from outside: `kind` is timeout, memory or crash, `sentence` says it for a table."""

    kind: str
    sentence: str


class Cell:
    """A process of its own, started when needed and started anew after it was ended."""

    def __init__(self) -> None:
        self._process: subprocess.Popen[bytes] | None = None
        self._line: Connection | None = None

    def call(self, function: str, argument: Any, limits: Limits) -> Any:
        """Call ``module:function(argument, ready)`` there; the clock starts anew whenever it says `ready()`.

        Returns
        -------
        What the function returned, or `Ended`.

        Raises
        ------
        RuntimeError
            The function raised: a bug of the bench, as it answers for the methods.
        """
        line = self._started()
        try:
            line.send((function, pickle.dumps(argument)))
        except ConnectionError:
            return self._gone()
        until, started = time.monotonic() + PREPARATION_S, False
        while True:
            if line.poll(_LOOK_S):
                try:
                    said, value = line.recv()
                except (EOFError, ConnectionError):
                    return self._gone()
                if said == READY:
                    until, started = time.monotonic() + limits.seconds, True
                elif said == "raised":
                    raise RuntimeError(value)
                else:
                    return value
            elif time.monotonic() > until:
                self.close()
                limit = f"{limits.seconds:g} s" if started else f"{PREPARATION_S:g} s to begin"
                return Ended("timeout", f"took longer than {limit} and was ended")
            elif self._resident() > limits.memory_gib * GIB:
                self.close()
                return Ended("memory", f"needed more than {limits.memory_gib:g} GiB of memory and was ended")

    def close(self) -> None:
        """End the process, whatever it does."""
        if self._process is not None and self._line is not None:
            self._process.kill()
            self._process.wait()
            self._line.close()
        self._process = self._line = None

    def __del__(self) -> None:
        self.close()

    def _started(self) -> Connection:
        if self._line is not None and self._process is not None and self._process.poll() is None:
            return self._line
        self.close()
        ours, theirs = Pipe()
        command = [sys.executable, "-m", "benchmarks.running.cell", str(theirs.fileno()), str(os.getpid())]
        root = str(Path(__file__).resolve().parents[2])
        path = os.pathsep.join([root, *filter(None, [os.environ.get("PYTHONPATH")])])
        self._process = subprocess.Popen(
            command,
            pass_fds=(theirs.fileno(),),
            env=os.environ | {"PYTHONPATH": path},
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            start_new_session=True,  # Ctrl-C is for who started the run; a cell ends with its parent
        )
        theirs.close()
        self._line = ours
        return ours

    def _gone(self) -> Ended:
        status = self._process.wait() if self._process is not None else 0
        self.close()
        return Ended("crash", f"its process ended with status {status}")

    def _resident(self) -> float:
        return 0.0 if self._process is None else resident_bytes(self._process.pid)


def resident_bytes(process: int | str = "self", field: str = "VmRSS") -> float:
    """Read the resident memory of a process, or with ``VmHWM`` the most it had; NaN where the system does not tell."""
    try:
        lines = Path(f"/proc/{process}/status").read_text(encoding="ascii", errors="replace").splitlines()
    except OSError:
        return float("nan")
    return next((1024.0 * int(line.split()[1]) for line in lines if line.startswith(field + ":")), float("nan"))


def forget_peak() -> None:
    """Give back what is free and let the peak of this process start from here, where the system can do that."""
    gc.collect()
    with suppress(OSError, AttributeError):  # glibc alone has it; without, memory that was freed before hides the need
        ctypes.CDLL(None).malloc_trim(0)
    try:
        Path("/proc/self/clear_refs").write_text("5")
    except OSError:
        return


def serve(line: Connection, parent: int) -> None:
    """Answer calls until whoever asks is gone."""
    threading.Thread(target=_end_with, args=(parent,), daemon=True).start()
    while True:
        try:
            name, argument = line.recv()
        except (EOFError, ConnectionError):
            return
        try:
            module, function = name.split(":")
            value = getattr(importlib.import_module(module), function)(
                pickle.loads(argument), lambda: line.send((READY, None))
            )
            line.send(("answer", value))
        except Exception:  # reported to whoever asked, who raises it there
            line.send(("raised", traceback.format_exc()))


def _end_with(parent: int) -> None:
    while os.getppid() == parent:
        time.sleep(0.5)
    os._exit(1)


if __name__ == "__main__":
    serve(Connection(int(sys.argv[1])), int(sys.argv[2]))
