"""The models of slaves that agents start: found there by SHA-256, or sent."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from time import monotonic, sleep

from master_node.hosts.agent_requests import SeenAgent, ask_agent
from master_node.system.system import System
from protocol.bus.bus import Bus
from protocol.errors import ModelError, ProtocolError, SlaveLostError
from protocol.host.files import Contents, as_file, is_fmu
from protocol.text.references import split_reference
from protocol.wire.agents import (
    CHUNK_BYTES,
    AgentModel,
    AgentStatus,
    Done,
    ModelList,
    Upload,
    UploadState,
)
from protocol.wire.keys import MODELS, UPLOAD, AgentKey

log = logging.getLogger("master_node")

_MODELS_TIME = 60.0  # an agent reads files that are new to it
_CHUNK_TIME = 30.0
_PAUSE = 0.1
_LOSSES = 3  # of an upload that others displace


@dataclass(frozen=True, slots=True)
class Sent:
    """Progress of the upload of a model.

    Attributes:
        slave: for which it is.
        agent: to which it goes.
        model: file name.
        sent, size: [bytes].
    """

    slave: str
    agent: str
    model: str
    sent: int
    size: int


Uploading = Callable[[Sent], None]
"""Told of every piece that was sent."""


@dataclass(frozen=True)
class WantedModel:
    """The model of a slave as it is known here.

    Attributes:
        slave: its name.
        file: the model's file, or the folder of an FMU, here; None: there is none.
        name: of the model's file, without folders.
        python_class: of a Python model, with its colon; empty for an FMU.
        sha256, size: of ``file``; empty and 0 without it.
    """

    slave: str
    file: Path | None
    name: str
    python_class: str
    sha256: str = ""
    size: int = 0


def wanted_model(system: System, slave: str) -> WantedModel:
    """Look at the model of a slave.

    Raises:
        ModelError: its file cannot be read.
    """
    model = str(system.slaves[slave].model)
    reference = None if is_fmu(model, system.base) else split_reference(model)
    is_python = reference is not None
    path = model.rstrip("/\\") if reference is None else reference[0]
    python_class = "" if reference is None else f":{reference[1]}"
    file_name = path.replace("\\", "/").rpartition("/")[2]
    file = system.base / path
    try:
        if (is_python and not path.endswith(".py")) or not file.exists():
            return WantedModel(slave, None, file_name, python_class)
        digest, size = Contents.of(file)
    except OSError as error:
        raise ModelError(f"{file} cannot be read: {error}", slave=slave) from error
    return WantedModel(slave, file, file_name, python_class, digest, size)


class ModelPlacing:
    """Finds models on agents, and sends those that are not there.

    Args:
        bus: opened.
        reconnect_time: how long to wait for an agent that vanished while a model was sent [s].
        uploading: told of models that are sent.
    """

    def __init__(self, bus: Bus, reconnect_time: float, uploading: Uploading | None = None) -> None:
        self._bus = bus
        self._reconnect_time = reconnect_time
        self._uploading = uploading

    def place(self, agent: SeenAgent, wanted: WantedModel) -> tuple[str, str]:
        """Find the model on an agent, or send it there.

        Returns:
            What to call it there, and its SHA-256, empty if it is not known.

        Raises:
            ModelError: the agent has not the model and does not take it.
            ConfigurationError: it cannot keep it.
            SlaveLostError, DeadlineError: it does not answer.
        """
        if wanted.python_class and not wanted.name.endswith(".py"):
            return f"{wanted.name}{wanted.python_class}", ""
        if wanted.python_class and not agent.status.python:
            raise ModelError(
                "it starts no Python models",
                remedy="start it with --allow-python, or export the model as an FMU",
            )
        models = ask_agent(
            self._bus, agent.key, MODELS, Done(), ModelList, timeout=_MODELS_TIME
        ).models
        named = [model for model in models if model.name == wanted.name]
        if wanted.python_class:
            return self._python_model_on(named, wanted)
        if wanted.file is None:
            if not named:
                raise ModelError(
                    f"it has no model {wanted.name}, and there is none here",
                    remedy=f"give the path of {wanted.name} here, or copy it into the agent's "
                    "--models directory",
                )
            return named[0].sha256, named[0].sha256
        if not any(model.sha256 == wanted.sha256 for model in models):
            self._may_send(agent.status, named, wanted)
            self._send(agent, wanted, wanted.file)
        return wanted.sha256, wanted.sha256

    @staticmethod
    def _python_model_on(named: Sequence[AgentModel], wanted: WantedModel) -> tuple[str, str]:
        """A Python file is never sent: it would be a program for that host."""
        if not named:
            raise ModelError(
                f"it has no file {wanted.name}",
                remedy="copy it into the agent's --models directory",
            )
        if wanted.sha256 and wanted.sha256 != named[0].sha256:
            raise ModelError(
                f"its {wanted.name} is another one: SHA-256 {named[0].sha256}, here "
                f"{wanted.sha256}",
                remedy="copy the one from here into the agent's --models directory",
            )
        return f"{wanted.name}{wanted.python_class}", named[0].sha256

    @staticmethod
    def _may_send(status: AgentStatus, named: Sequence[AgentModel], wanted: WantedModel) -> None:
        if wanted.size <= status.upload_limit:
            return
        other = f"; its {wanted.name} is another one" if named else ""
        limit, remedy = "models may not be sent to it", "start it with --allow-upload"
        if status.upload_limit:
            limit = f"it takes models up to {status.upload_limit} bytes, and this one has "
            limit += str(wanted.size)
            remedy = "raise its --upload-limit"
        raise ModelError(
            f"it has no model with the SHA-256 of {wanted.name}, {wanted.sha256}{other}, and "
            f"{limit}",
            remedy=f"copy {wanted.name} into its --models directory, or {remedy}",
        )

    def _send(self, agent: SeenAgent, wanted: WantedModel, file: Path) -> None:
        """Send the pieces that are not there yet; goes on after a lost connection, and begins
        again, a few times, when the agent needed the room for others meanwhile.
        """
        log.info("sending %s (%d bytes) to agent %s", wanted.name, wanted.size, agent.key.name)
        try:
            with as_file(file) as packed, packed.open("rb") as source:
                state = self._piece(agent.key, Upload(wanted.sha256, wanted.size, 0, b""))
                losses = 0
                while not state.complete:
                    offset = state.received
                    source.seek(offset)
                    data = source.read(CHUNK_BYTES)
                    state = self._piece(agent.key, Upload(wanted.sha256, wanted.size, offset, data))
                    losses += state.received < offset
                    if not state.complete and (state.received == offset or losses > _LOSSES):
                        raise ProtocolError(
                            f"agent {agent.key.name} did not take the piece at {offset}"
                        )
                    self._tell(agent, wanted, state.received)
        except OSError as error:
            raise ModelError(f"{file} cannot be read: {error}") from error

    def _tell(self, agent: SeenAgent, wanted: WantedModel, sent: int) -> None:
        if self._uploading is not None:
            self._uploading(Sent(wanted.slave, agent.key.name, wanted.name, sent, wanted.size))

    def _piece(self, key: AgentKey, piece: Upload) -> UploadState:
        deadline = monotonic() + self._reconnect_time
        while True:
            try:
                return ask_agent(self._bus, key, UPLOAD, piece, UploadState, timeout=_CHUNK_TIME)
            except SlaveLostError:
                if monotonic() > deadline:
                    raise
            sleep(_PAUSE)
