"""The worker process: single-threaded, holds the model, and holds no Zenoh session.

A crash or an endless loop in a model ends or blocks this process only; the node beside it still
answers. Programs and replies go through a pipe as the bytes that are on the wire.
"""

from __future__ import annotations

import ctypes
import logging
import multiprocessing
import os
import signal
import socket
import sys
import threading
import traceback
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Protocol

from protocol.calls import Call, Describe, Initialize
from protocol.description import SlaveDescription
from protocol.errors import (
    DeadlineError,
    DoublestepError,
    HostLimitError,
    MalformedMessageError,
    SlaveCrashedError,
    SlaveKilledError,
)
from protocol.host.log_files import SILENT, LogOutput
from protocol.host.logs import LogFormat, configure_logs
from protocol.host.python_processes import restore_path, safe_path
from protocol.host.scratch import ScratchDirectory
from protocol.host.standard_error import forgive_models
from protocol.host.threads import LIMITS, start_thread
from protocol.slave import CallExecutor
from protocol.variables import StartValue
from protocol.wire.administration import DEFAULT_LOAD_TIMEOUT
from protocol.wire.programs import decode_program, encode_program
from protocol.wire.replies import decode_reply, encode_error, encode_reply
from slave_node.execution.exit_codes import OWN_FAILURE, death, how_ended
from slave_node.worker.pipe import Pipe

_END = b""
_CLOSE_TIME = 0.5
_DEATH_TIME = 5.0  # whose pipe is closed is soon dead, unless the host is busy
_PR_SET_PDEATHSIG = 1


@dataclass(frozen=True, slots=True)
class ModelReference:
    """Reference to a model to load, see `slave_node.loading.load_executor`.

    ``parameters`` are start values that hold unless the master gives others, ``state_kind`` holds
    unless it asks for another; ``output`` is for the messages of an FMU, ``log_format`` that of the
    worker's.
    """

    model: str
    base: Path
    name: str
    parameters: Mapping[str, StartValue] = field(default_factory=dict)
    output: LogOutput = SILENT
    state_kind: str = ""
    log_format: LogFormat = LogFormat.TEXT


class Worker(Protocol):
    """Where programs are executed."""

    def start(self) -> SlaveDescription:
        """Load the model, in place of what there was before; raises what its loading raised."""
        ...

    def execute(self, program: bytes) -> bytes:
        """The reply to a program.

        Raises:
            SlaveCrashedError: the worker is dead; ``start`` makes a new one. A
                `SlaveKilledError` where the program is not known to be why.
        """
        ...

    def kill(self) -> None:
        """End it at once, even in the middle of a step. From any thread."""
        ...

    def stop(self) -> None:
        """Free the model and end it in a bounded time."""
        ...


def execute_program(executor: CallExecutor, reference: ModelReference, program: bytes) -> bytes:
    """Decode, execute, encode: never raises."""
    try:
        calls = decode_program(program)
    except DoublestepError as error:
        return encode_error(error)
    if reference.parameters:
        calls = [_with_parameters(call, reference.parameters) for call in calls]
    return encode_reply(executor.execute(calls))


def _with_parameters(call: Call, parameters: Mapping[str, StartValue]) -> Call:
    """Start values from the command line stand behind those of the master."""
    if type(call) is Initialize:
        return replace(call, start_values={**parameters, **call.start_values})
    return call


class WorkerProcess:
    """Implements `Worker` with a process of its own.

    Args:
        reference: the model.
        load_timeout: bound on loading the model [s].
    """

    def __init__(
        self, reference: ModelReference, load_timeout: float = DEFAULT_LOAD_TIMEOUT
    ) -> None:
        self._reference = reference
        self._load_timeout = load_timeout
        self._process: BaseProcess | None = None
        self._pipe: Pipe | None = None
        self._guard: threading.Thread | None = None
        self._scratch: ScratchDirectory | None = None
        self._using = threading.Lock()
        """Held while the pipe is in use; ``kill`` needs none and makes the holder let go."""

    @property
    def pid(self) -> int | None:
        """Process id, None when there is no process."""
        return self._process.pid if self._process else None

    def start(self) -> SlaveDescription:
        """See `Worker`. On Linux the process ends with the thread that called this."""
        with self._using:
            return self._start()

    def _start(self) -> SlaveDescription:
        self._discard()
        self._scratch = ScratchDirectory()
        context = multiprocessing.get_context("spawn")
        ours, theirs = socket.socketpair()
        self._pipe = Pipe(ours)
        self._process = context.Process(
            target=_main, args=(theirs, self._reference, str(self._scratch.path)), daemon=True
        )
        try:
            with safe_path():
                self._process.start()
            self._guard = _start_guard(self._process, self._pipe)
        except (OSError, HostLimitError) as error:
            self._process = self._process if self._process.pid is not None else None
            self._discard()
            raise _no_process(error) from error
        finally:
            theirs.close()
        try:
            if not self._pipe.has_message(self._load_timeout):
                raise DeadlineError(
                    f"the model was not loaded within {self._load_timeout:g} s",
                    phase="load",
                    remedy="if it is only slow, raise load_timeout in [bus], or --load-timeout of "
                    "slave-node",
                )
            data = self._pipe.receive()
        except (EOFError, OSError):
            raise self._crashed() from None
        except DeadlineError:
            self._discard()
            raise
        reply = decode_reply([Describe()], data)
        if reply.error is not None:
            self._discard()
            raise reply.error
        description = reply.results[0]
        assert isinstance(description, SlaveDescription)
        return description

    def execute(self, program: bytes) -> bytes:
        """See `Worker`."""
        if not program:  # on the pipe it means the end
            return encode_error(MalformedMessageError("a program is empty"))
        with self._using:
            if self._pipe is None:
                raise SlaveKilledError(
                    "the process that held the model is gone", remedy="claim the slave again"
                )
            try:
                self._pipe.send(program)
            except OSError:
                raise self._lost() from None
            try:
                return self._pipe.receive()
            except (EOFError, OSError):
                raise self._crashed() from None

    def kill(self) -> None:
        """See `Worker`."""
        process = self._process
        if process is not None and process.pid is not None:
            process.kill()

    def stop(self) -> None:
        """See `Worker`."""
        if not self._using.acquire(blocking=False):  # in a step, which nothing else ends
            self.kill()
            self._using.acquire()
        try:
            if self._pipe is not None and self._process is not None:
                with suppress(OSError):
                    self._pipe.send(_END)
                    self._wait_ended(self._process, _CLOSE_TIME)
            self._discard()
        finally:
            self._using.release()

    def _crashed(self) -> SlaveCrashedError:
        """The error that it died of what it was asked."""
        return death(self._exit_code())

    def _lost(self) -> SlaveKilledError:
        """The error that it died while it was asked for nothing."""
        return SlaveKilledError(f"the process that held the model {how_ended(self._exit_code())}")

    def _exit_code(self) -> int | None:
        """Exit code of a process that is dying; None: not known."""
        assert self._process is not None
        self._wait_ended(self._process, _DEATH_TIME)
        self._process.join(_CLOSE_TIME)
        code = self._process.exitcode
        self._discard()
        return code

    def _discard(self) -> None:
        if self._process is not None:
            self._process.kill()
            self._wait_ended(self._process, _CLOSE_TIME)
            self._process.join(_CLOSE_TIME)
            self._process = self._guard = None
        if self._pipe is not None:
            self._pipe.close()
            self._pipe = None
        if self._scratch is not None:
            self._scratch.close()
            self._scratch = None

    def _wait_ended(self, process: BaseProcess, timeout: float) -> None:
        """At most so long; the guard is done before the process is reaped and its id free."""
        (process if self._guard is None else self._guard).join(timeout)


def _no_process(error: OSError | HostLimitError) -> HostLimitError:
    if isinstance(error, HostLimitError):
        return error
    return HostLimitError(f"no process for the model can be started: {error}", remedy=LIMITS)


def _start_guard(process: BaseProcess, pipe: Pipe) -> threading.Thread | None:
    """Look after what a model has started: it ends with the worker.

    Such processes hold the worker's end of the pipe, so that its death could not be seen there.
    """
    worker = process.pid
    if sys.platform == "linux" and worker is not None:
        return start_thread(lambda: _end_with(worker, pipe), "guard")
    return None


def _end_with(worker: int, pipe: Pipe) -> None:
    if sys.platform == "linux":
        with suppress(ChildProcessError):
            os.waitid(os.P_PID, worker, os.WEXITED | os.WNOWAIT)
        with suppress(ProcessLookupError, PermissionError):
            os.killpg(worker, signal.SIGKILL)
    pipe.hang_up()


def _main(end: socket.socket, reference: ModelReference, scratch: str) -> None:
    """Load the model, then execute programs until the node says end or is gone."""
    forgive_models()
    try:
        _hold(end, reference, scratch)
    except Exception:
        traceback.print_exc()
        sys.stderr.flush()
        os._exit(OWN_FAILURE)


def _hold(end: socket.socket, reference: ModelReference, scratch: str) -> None:
    _die_with_parent()
    restore_path()
    if sys.platform == "linux":
        os.setsid()  # what the model starts is in this group, see `_start_guard`
    pipe = Pipe(end)
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    configure_logs(
        reference.log_format, f"%(asctime)s {reference.name}: %(message)s", slave=reference.name
    )
    try:
        from slave_node.loading import load_executor  # noqa: PLC0415  after the process is set up

        executor = load_executor(
            reference.model,
            reference.base,
            reference.name,
            Path(scratch),
            output=reference.output,
            state_kind=reference.state_kind,
        )
    except DoublestepError as error:
        pipe.send(encode_error(error))
        return
    try:
        pipe.send(execute_program(executor, reference, encode_program([Describe()])))
        while program := pipe.receive():
            pipe.send(execute_program(executor, reference, program))
    except (EOFError, ConnectionError):
        logging.getLogger(__name__).warning("the node is gone: ending")
    finally:
        executor.close()


def _die_with_parent() -> None:
    """Even in the middle of a step; elsewhere than on Linux the closed pipe ends an idle worker."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
        parent = multiprocessing.parent_process()
        if parent is not None and os.getppid() != parent.pid:
            os._exit(0)  # it was gone before
