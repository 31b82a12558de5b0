"""The holder: the process that holds a model whose states are saved by forking.

All holders of a model are alike: each serves one channel until its other end closes. A fork makes
another one, with a channel of its own, that stands where this one stands. Which of them is the
slave and which are saved states is known to `ForkSlave` alone.
"""

from __future__ import annotations

import ctypes
import gc
import json
import os
import signal
import socket
from contextlib import suppress
from pathlib import Path
from time import perf_counter
from typing import NoReturn

from protocol.calls import Configure, Reply
from protocol.errors import DoublestepError, SlaveError
from protocol.host.log_files import LogOutput
from protocol.host.logs import LogFormat
from protocol.host.standard_error import forgive_models
from protocol.slave import CallExecutor, Slave
from protocol.wire.programs import decode_program
from protocol.wire.records import decode_map
from protocol.wire.replies import encode_error, encode_reply
from slave_node.execution.executor import Executor
from slave_node.models import load_model
from slave_node.states.channel import DURATION, PROCESS, Channel, Message
from slave_node.states.fork_hindrances import ForkHindrances, reopen
from slave_node.states.obituaries import report
from slave_node.states.step_message import execute_step

_CHILD = frozenset({signal.SIGCHLD})


def hold(connection: socket.socket, obituaries: int) -> NoReturn:
    """Load a model as the first message says, and hold it.

    Args:
        connection: on which this process is driven.
        obituaries: descriptor of the pipe into which deaths of copies are written.
    """
    forgive_models()
    channel = Channel(connection)
    channel.send(Message.DONE, PROCESS.pack(os.getpid()))
    hindrances = ForkHindrances()
    try:
        _, what = channel.receive()
        slave = _load(what)
    except DoublestepError as error:
        channel.send(Message.DONE, encode_error(error))
        os._exit(0)
    except (EOFError, OSError):
        os._exit(0)
    channel.send(Message.DONE, encode_reply(Reply([slave.description], None, 0.0)))
    gc.collect()
    gc.freeze()  # what is loaded is not looked at again: its pages stay shared
    _Holder(channel, slave, hindrances, obituaries).serve()


def _load(message: bytes) -> Slave:
    what = decode_map(message)
    configuration = decode_program(bytes(what["configuration"]))[0]  # type: ignore[arg-type]
    assert isinstance(configuration, Configure)
    return load_model(
        str(what["model"]),
        Path(str(what["base"])),
        str(what["name"]),
        Path(str(what["scratch"])),
        output=_output(str(what["output"])),
        configuration=configuration,
    )


def _output(text: str) -> LogOutput:
    file, style, categories, warnings = json.loads(text)
    return LogOutput(file, LogFormat(style), tuple(categories), warnings)


def _execute(executor: CallExecutor, program: bytes) -> bytes:
    try:
        calls = decode_program(program)
    except DoublestepError as error:
        return encode_error(error)
    reply = executor.execute(calls)
    return encode_reply(reply._replace(compute_time=0.0))  # the same whenever it is done again


class _Holder:
    """The main loop, in the first holder and in all copies.

    Deaths of copies are attended to only between messages, so that no signal meets the model.
    """

    def __init__(
        self,
        channel: Channel,
        slave: Slave,
        hindrances: ForkHindrances,
        obituaries: int,
    ) -> None:
        self._channel = channel
        self._slave = slave
        self._executor = Executor(slave)
        self._hindrances = hindrances
        self._obituaries = obituaries
        self._children: set[int] = set()
        self._flush = ctypes.CDLL(None).fflush
        signal.pthread_sigmask(signal.SIG_BLOCK, _CHILD)
        signal.signal(signal.SIGCHLD, lambda *_: self._bury())

    def serve(self) -> NoReturn:
        """Until the other end of the channel closes."""
        try:
            while True:
                kind, payload = self._next()
                match kind:
                    case Message.STEP:
                        self._step(payload)
                    case Message.PROGRAM:
                        self._run(payload)
                    case Message.FORK:
                        self._fork(self._channel.receive_socket())
                    case _:
                        self._executor.close()
                        self._channel.send(Message.DONE)
        except (EOFError, OSError):
            self._flush(None)
            os._exit(0)

    def _next(self) -> tuple[Message, bytes]:
        signal.pthread_sigmask(signal.SIG_UNBLOCK, _CHILD)
        try:
            return self._channel.receive()
        finally:
            signal.pthread_sigmask(signal.SIG_BLOCK, _CHILD)

    def _step(self, payload: bytes) -> None:
        begin = perf_counter()
        try:
            answer = execute_step(self._slave, payload)
        except DoublestepError as error:
            self._channel.send(Message.REFUSED, encode_error(error))
        else:
            self._channel.send(Message.DONE, DURATION.pack(perf_counter() - begin) + answer)

    def _run(self, payload: bytes) -> None:
        begin = perf_counter()
        answer = _execute(self._executor, payload)
        self._channel.send(Message.DONE, DURATION.pack(perf_counter() - begin) + answer)

    def _fork(self, connection: socket.socket) -> None:
        """Make a copy that serves ``connection``; it answers, or we say there why there is none."""
        ours = {self._channel.fileno(), connection.fileno()}
        try:
            readers = self._hindrances.check(ours)
            self._flush(None)  # what the model has printed is not to be printed by both
            child = os.fork()
        except (OSError, SlaveError) as error:
            with connection, suppress(OSError):  # the copy is no longer wanted
                Channel(connection).send(Message.REFUSED, encode_error(_refusal(error)))
            return
        if child:
            connection.close()
            self._children.add(child)
        else:
            self._channel.close()  # else the death of the original would go unnoticed
            self._channel = Channel(connection)
            self._children = set()
            reopen(readers)
            with suppress(OSError):  # given up already; but copies of it may be asked for
                self._channel.send(Message.DONE, PROCESS.pack(os.getpid()))

    def _bury(self) -> None:
        """Only our own: those of the model are the model's."""
        for child in tuple(self._children):
            try:
                pid, status = os.waitpid(child, os.WNOHANG)
            except ChildProcessError:  # the model waited for it
                pid, status = child, 0
            if pid:
                self._children.discard(pid)
                report(self._obituaries, pid, status)


def _refusal(error: Exception) -> SlaveError:
    return SlaveError(
        f"the process that holds the model cannot be forked: {error}",
        phase="get_state",
        remedy='choose another way to save its state: state = "replay"',
    )
