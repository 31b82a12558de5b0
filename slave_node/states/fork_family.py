"""All processes that hold one model by forking, as the slave sees them that started them."""

from __future__ import annotations

import json
import os
import select
import signal
import socket
import subprocess
import sys
from collections import deque
from contextlib import suppress
from time import monotonic
from typing import NamedTuple

from protocol.errors import HostLimitError, SlaveKilledError
from protocol.host.python_processes import python_command
from protocol.host.threads import LIMITS
from slave_node.states.channel import PROCESS, Channel
from slave_node.states.obituaries import OBITUARY
from slave_node.states.repeating import RepeatingPart

_IDLE_TIME = 1.0
_OBITUARY_TIME = 1.0
_END_TIME = 5.0
_START = (
    "import json, sys; sys.path[:] = json.loads(sys.argv[1]); "
    "from slave_node.states.fork_keeper import main; main(*map(int, sys.argv[2:]))"
)
_ONE_THREAD = {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}
"""A process with more cannot be forked."""


_MOST_DEATHS = 1000
"""Deaths that are remembered: more than the holders that a slave keeps at a time."""


class _Death(NamedTuple):
    """Death of a holder.

    Attributes:
        process: its process id.
        births: how many holders had been made when it was told.
        exit_code: -N for signal N.
    """

    process: int
    births: int
    exit_code: int


class HolderFamily:
    """The keeper and the holders below it; see ``fork_keeper.py``.

    Args:
        repeating: tells what of their answers is to repeat.

    Attributes:
        first: our end of the socket to the first holder, which holds no model yet.
        first_process: its process id.
        repeating: see above.

    Raises:
        HostLimitError, SlaveKilledError: they do not come up.
    """

    def __init__(self, repeating: RepeatingPart) -> None:
        self.repeating = repeating
        ours, theirs = socket.socketpair()
        self._births = 0
        self._deaths: deque[_Death] = deque(maxlen=_MOST_DEATHS)
        self._obituaries, obituaries = os.pipe()
        os.set_blocking(self._obituaries, False)
        os.set_blocking(obituaries, False)  # a full pipe blocks no writer
        descriptors = (theirs.fileno(), obituaries)
        try:
            self._keeper = subprocess.Popen(
                python_command("-c", _START, json.dumps(sys.path), *map(str, descriptors)),
                stdin=subprocess.PIPE,
                pass_fds=descriptors,
                start_new_session=True,  # Ctrl-C is for who started us
                env={**os.environ, **_ONE_THREAD},
            )
        except OSError as error:
            ours.close()
            os.close(self._obituaries)
            raise HostLimitError(
                f"no process for the model can be started: {error}", remedy=LIMITS
            ) from error
        finally:
            theirs.close()
            os.close(obituaries)
        self._group = 0
        self._is_closed = False
        self.first = ours
        try:
            _, process = self.channel(ours).receive()
        except (EOFError, OSError):
            ours.close()
            self.close()
            raise SlaveKilledError("the process for the model did not come up") from None
        (self.first_process,) = PROCESS.unpack(process)
        self._group = self.first_process

    def channel(self, connection: socket.socket) -> Channel:
        """A channel to a holder whose waits end also when the keeper is gone."""
        return Channel(connection, self._check_keeper, _IDLE_TIME)

    def _check_keeper(self) -> None:
        """Without a keeper only this process ends the holders."""
        if self._keeper.poll() is not None:
            self._kill()

    def count_birth(self) -> int:
        """Number of births, for a holder that is about to be made: `exit_code` asks for it."""
        while self._read_death():
            pass
        self._births += 1
        return self._births

    def exit_code(self, process: int, birth: int) -> int | None:
        """Exit code of a holder whose channel is closed, -N for signal N; None: not known.

        Args:
            process: its process id; 0: it was never met.
            birth: number of births when it was made. A death that was told before is that of
                another one, which had its process id.
        """
        deadline = monotonic() + _OBITUARY_TIME
        reader = select.poll()
        reader.register(self._obituaries, select.POLLIN)
        while process:
            for death in self._deaths:
                if death.process == process and death.births >= birth:
                    return death.exit_code
            left = deadline - monotonic()
            if left <= 0.0 or not reader.poll(left * 1e3) or not self._read_death():
                break
        return None

    def _read_death(self) -> bool:
        """Note one that was written down; False: there is none now, or there will be none."""
        try:
            record = os.read(self._obituaries, OBITUARY.size)
        except BlockingIOError:
            return False
        if len(record) < OBITUARY.size:  # whoever could write one is gone
            return False
        process, status = OBITUARY.unpack(record)
        self._deaths.append(_Death(process, self._births, os.waitstatus_to_exitcode(status)))
        return True

    def close(self) -> None:
        """End all of them, at once and in a bounded time. Idempotent."""
        if self._is_closed:
            return
        self._is_closed = True
        assert self._keeper.stdin is not None
        self._keeper.stdin.close()
        try:
            self._keeper.wait(_END_TIME)
        except subprocess.TimeoutExpired:
            self._keeper.kill()
            self._keeper.wait()
        if self._keeper.returncode != 0:
            self._kill()
        os.close(self._obituaries)

    def _kill(self) -> None:
        if self._group:
            with suppress(ProcessLookupError):
                os.killpg(self._group, signal.SIGKILL)
