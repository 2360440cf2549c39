"""Runs a plugin in a process of its own, which sees what it is sent, has limits, and can be ended at any time.

`Sandbox.load` gives a `ModelPlugin` whose models live there: the plugin's file is never executed in this process.
"""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, NoReturn

from dlobench.bench import plugins
from dlobench.bench.answers import Misdeed
from dlobench.bench.guest import FOLDER
from dlobench.bench.limits import Limits
from dlobench.bench.plugins import ModelPlugin
from dlobench.bench.processes import descendants, end_descendants, resident
from dlobench.bench.remote import remote_model
from dlobench.bench.wire import Arrays, GarbledError, Wire
from dlobench.errors import RunError, UsageError

STARTING = 120.0  # s that Python may take to start and to confine itself
SMALL = 2**20  # bytes of an answer that holds no prediction
_LOOK = 0.25  # s between two looks at all processes, at least
_PASSED = [
    "PATH", "LANG", "LC_ALL", "LC_CTYPE", "LD_LIBRARY_PATH", "PYTHONPATH", "PYTHONHASHSEED", "PYTHONUTF8",
    "VIRTUAL_ENV", "TZ",
]  # fmt: skip
_PREFIXES = ("CUDA_", "NVIDIA_", "CUBLAS_", "TORCH_", "PYTORCH_", "XLA_", "JAX_", "KMP_", "GOMP_")
_THREADS = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS")


class Sandbox:
    """Keeps the process of one plugin: a context manager that ends it, with all that it started.

    `hidden` are the folders that it must not see, beyond all others that it has no need of; `threads` is how many
    torch and the libraries of linear algebra may use.
    """

    def __init__(self, limits: Limits | None = None, *, hidden: Sequence[Path] = (), threads: int = 1) -> None:
        self.limits, self.hidden, self.threads = limits or Limits(), tuple(hidden), threads
        self.protection: tuple[str, ...] = ()  # what is in force, once a plugin is loaded
        self._process: subprocess.Popen[bytes] | None = None
        self.generation = 0  # how many processes there were
        self._path, self._dropped, self._printed = Path(), list[int](), bytearray()
        self._asked, self._next_look = 0, 0.0

    def __enter__(self) -> Sandbox:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def load(self, name_or_path: str) -> ModelPlugin:
        """Loads a model by name or path as `plugins.load_model` does, and raises as it does."""
        self._path = plugins.resolve("models", name_or_path)
        try:
            self._ensure()
        except Misdeed as error:
            raise RunError(f"model plugin {self._path} {error}") from error
        found = self._found
        model = remote_model(self, found)
        return ModelPlugin(self._path.stem, self._path, found["sha256"], model, self.protection)

    def parse_settings(self, texts: Sequence[str]) -> dict[str, Any]:
        """Reads `FIELD=VALUE` texts as hyperparameters as `plugins.parse_settings` does, and raises as it does."""
        header, _ = self.ask("parse", {"texts": list(texts)})
        return dict(header["settings"])

    def forget(self, generation: int, handle: int) -> None:
        """Lets go of a model of the process of that generation; it is told with whatever is asked next."""
        if generation == self.generation:
            self._dropped.append(handle)

    def ask(
        self,
        what: str,
        header: Mapping[str, Any],
        arrays: Arrays | None = None,
        *,
        generation: int | None = None,
        most: int = SMALL,
        log: Callable[[int, int, dict[str, float]], None] | None = None,
    ) -> tuple[dict[str, Any], Arrays]:
        """Asks the plugin's process to do something, and returns the header and arrays of its answer.

        `generation` is that of the model which is asked, `most` the bytes that an answer's arrays may have. Raises
        what the plugin raised, and `Misdeed` when the process ended, broke a limit or answered something else.
        """
        if generation is None:
            self._ensure()
        elif self._process is None or generation != self.generation:
            raise Misdeed("has lost its process, which was ended before")
        dropped, self._dropped = self._dropped, []
        return self._exchange({"do": what, "drop": dropped, **header}, arrays, self.limits.seconds, most, log)

    def close(self) -> None:
        """Ends the process and all that it started."""
        process, self._process = self._process, None
        if process is None:
            return
        end_descendants(process.pid)
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        process.wait()
        self._wire.close()
        os.close(self._output)
        self._folder.cleanup()

    def _ensure(self) -> None:
        """Starts a process where there is none, and has it load the plugin."""
        if self._process is not None:
            return
        ours, theirs = socket.socketpair()
        self._folder = tempfile.TemporaryDirectory(prefix=FOLDER, ignore_cleanup_errors=True)
        self._output, printed = os.pipe()
        os.set_blocking(self._output, False)
        folder = Path(self._folder.name).resolve()
        passed = {k: v for k, v in os.environ.items() if k in _PASSED or k.startswith(_PREFIXES)}
        home = {name: str(folder) for name in ("HOME", "TMPDIR", "XDG_CACHE_HOME", "MPLCONFIGDIR")}
        try:
            self._process = subprocess.Popen(
                [sys.executable, "-P", "-m", "dlobench.bench.guest", str(theirs.fileno())],
                stdin=subprocess.DEVNULL,
                stdout=printed,
                stderr=printed,
                cwd=folder,
                env=passed | home | dict.fromkeys(_THREADS, str(self.threads)),
                pass_fds=[theirs.fileno()],
                start_new_session=True,  # a Ctrl-C of the terminal comes here only
            )
        finally:
            theirs.close()
            os.close(printed)
        self._wire, self.generation, self._dropped = Wire(ours, self._look), self.generation + 1, []
        cage = {
            "hidden": [str(path.resolve()) for path in self.hidden],
            "needed": [str(self._path), str(Path(plugins.__file__).parents[1])],
            "folder": str(folder),
            "memory": self.limits.memory,
            "tasks": self.limits.processes,
        }
        header, _ = self._exchange({"confine": cage}, None, STARTING, SMALL, None)
        self.protection = tuple(map(str, header["force"]))
        try:
            seconds = max(STARTING, self.limits.seconds)
            self._found, _ = self._exchange({"do": "load", "path": str(self._path)}, None, seconds, SMALL, None)
        except BaseException:
            self.close()
            raise

    def _exchange(
        self,
        header: Mapping[str, Any],
        arrays: Arrays | None,
        seconds: float,
        most: int,
        log: Callable[[int, int, dict[str, float]], None] | None,
    ) -> tuple[dict[str, Any], Arrays]:
        self._until, self._seconds = time.monotonic() + seconds, seconds
        self._asked, self._printed = self._asked + 1, bytearray()
        try:
            try:
                self._wire.send({"ask": self._asked, **header}, arrays, share=True)
                while True:
                    answer, parts = self._wire.receive(most)
                    if "log" not in answer:
                        break
                    step, total, values = answer["log"]
                    if log is not None:
                        log(int(step), int(total), {str(name): float(value) for name, value in values.items()})
            except (EOFError, ConnectionError):
                self._lost()
            except (GarbledError, TypeError, ValueError, KeyError, AttributeError) as error:
                raise Misdeed("answered with something that is no message") from error
            self._read_output()
            if answer.get("done") is not True or answer.get("ask") != self._asked:
                raise Misdeed("answered with something that is no message")
        except BaseException as error:
            self.close()  # whatever it was, also Ctrl-C: the process does something else than what is thought
            self._note(error, "")
            raise
        if "error" in answer:
            kind = {"usage": UsageError, "run": RunError}.get(str(answer["error"]), Misdeed)
            said = "".join(each if each.isprintable() else " " for each in str(answer.get("said")))
            failure = kind(said)  # a terminal takes what else is there for orders
            self._note(failure, str(answer.get("trace", "")))
            raise failure
        return answer, parts

    def _look(self) -> None:
        """Looks after the process while it is waited for; raises `Misdeed` when it breaks a limit."""
        now = time.monotonic()
        if now > self._until:
            raise Misdeed(f"took longer than the time limit of {self._seconds:g} s")
        self._read_output()
        if now > self._next_look and self._process is not None:
            begin = time.thread_time()  # not the clock, which also runs while a busy machine does something else
            found = descendants(self._process.pid)
            if len(found) > self.limits.processes:
                raise Misdeed(f"started more than {self.limits.processes} processes")
            if (held := resident(found)) > self.limits.memory:
                raise Misdeed(f"holds {held / 1e9:.3g} GB, the memory limit is {self.limits.memory / 1e9:.3g} GB")
            self._next_look = now + max(_LOOK, 100 * (time.thread_time() - begin))  # at most a hundredth of a processor

    def _read_output(self) -> None:
        try:
            while part := os.read(self._output, 2**16):
                self._printed += part
                if len(self._printed) > self.limits.output:
                    raise Misdeed(f"printed more than {self.limits.output:,} bytes")
        except BlockingIOError:
            pass

    def _lost(self) -> NoReturn:
        """Says how the process was lost whose socket is closed."""
        assert self._process is not None  # noqa: S101
        try:
            code = self._process.wait(1)
        except subprocess.TimeoutExpired:
            raise Misdeed("closed the socket that it is asked over") from None
        if code > 128:
            raise Misdeed(f"was ended by {signal.Signals(code - 128).name}")
        raise Misdeed(f"ended its process with exit code {code}")

    def _note(self, error: BaseException, trace: str) -> None:
        """Adds what was printed, and the traceback from there, to an error; DLOBENCH_DEBUG shows them."""
        printed = self._printed[-4000:].decode(errors="replace")
        for title, text in (("in the plugin's process", trace), ("printed by the plugin", printed)):
            if text:
                error.add_note(f"{title}:\n{text}")
