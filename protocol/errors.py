"""The exception tree. Every error names slave, phase, t, H, cause and remedy as far as they apply.

As a text an error is printable: much of it comes from peers and files.

::

    DoublestepError
    ├── ConfigurationError       the user's file, command line or model is wrong          exit 2
    │   └── ModelError           a model file cannot be loaded or used                    exit 2
    ├── SlaveLostError           a slave is not there, or went away                       exit 3
    │   └── HostLimitError       the host gives no more memory, threads or processes      exit 3
    ├── SlaveError               a slave could not do what it was asked                   exit 4
    │   ├── StepRejectedError    a step failed in the slave; a smaller one may succeed    exit 4
    │   ├── FatalSlaveError      fmi2Fatal: the model must not be called any more          exit 4
    │   ├── StepSizeError        the smallest communication step size was reached         exit 4
    │   └── SlaveCrashedError    the process that holds the model died of the model       exit 4
    │       └── SlaveKilledError it is gone, and not known to be by the model's doing     exit 3
    ├── DeadlineError            a wait reached its bound                                 exit 5
    ├── ProtocolError            the two sides do not speak the same language             exit 6
    │   ├── MalformedMessageError  bytes that are not a message, or beyond a limit        exit 6
    │   ├── VersionError         different protocol versions                              exit 6
    │   ├── LifeCycleError       a call that the slave's state does not allow             exit 6
    │   ├── SequenceError        a stale epoch or a sequence number out of order          exit 6
    │   └── SlaveBusyError       the slave, or a licence, is held by another master       exit 6
    ├── ResultsError             results cannot be written or read                        exit 7
    └── InterruptedRunError      Ctrl-C or SIGTERM ended the run                          exit 130
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import ClassVar, Self

from protocol.text.limits import cut
from protocol.text.plain_text import printable

_TEXT_FIELDS = ("slave", "phase", "remedy")
_NUMBER_FIELDS = ("time", "step_size", "last_successful_time")


class DoublestepError(Exception):
    """The root. ``cause`` is a sentence; the other fields say where it happened and what to do.

    Attributes:
        cause: what went wrong.
        slave: name of the slave, or "".
        phase: the call or the part of the run, such as ``do_step``, or "".
        time: communication point t [s], or None.
        step_size: communication step size H [s], or None.
        last_successful_time: where a discarded step got to [s], or None.
        remedy: what the user can do, or "".
    """

    exit_code: ClassVar[int] = 1

    def __init__(
        self,
        cause: str,
        *,
        slave: str = "",
        phase: str = "",
        time: float | None = None,
        step_size: float | None = None,
        last_successful_time: float | None = None,
        remedy: str = "",
    ) -> None:
        super().__init__(cause)
        self.cause = cause
        self.slave = slave
        self.phase = phase
        self.time = time
        self.step_size = step_size
        self.last_successful_time = last_successful_time
        self.remedy = remedy

    def located(
        self,
        *,
        slave: str = "",
        phase: str = "",
        time: float | None = None,
        step_size: float | None = None,
    ) -> Self:
        """Fill in what is not known yet about the place; returns the error itself."""
        self.slave = self.slave or slave
        self.phase = self.phase or phase
        self.time = time if self.time is None else self.time
        self.step_size = step_size if self.step_size is None else self.step_size
        return self

    def __str__(self) -> str:
        place = self.phase
        if self.time is not None:
            place += f" at t={self.time!r} s"
        if self.step_size is not None:
            place += f", H={self.step_size!r} s"
        head = ": ".join(part for part in (self.slave, place.strip()) if part)
        text = f"{head}: {self.cause}" if head else self.cause
        return printable(f"{text}; {self.remedy}" if self.remedy else text)

    def to_reply(self) -> dict[str, str | float]:
        """The error as plain data for an error reply."""
        reply: dict[str, str | float] = {"error": type(self).__name__, "cause": _sent(self.cause)}
        for name in _TEXT_FIELDS:
            if text := getattr(self, name):
                reply[name] = _sent(text)
        for name in _NUMBER_FIELDS:
            number = getattr(self, name)
            if number is not None:
                reply[name] = float(number)
        return reply

    @staticmethod
    def from_reply(reply: Mapping[str, object]) -> DoublestepError:
        """The error that ``to_reply`` described; an unknown class becomes a ``ProtocolError``."""
        texts = {key: cut(value) for key, value in reply.items() if isinstance(value, str)}
        cls = _BY_NAME.get(texts.get("error", ""), ProtocolError)
        error = cls(texts.get("cause", "an error reply without a cause"))
        for name in _TEXT_FIELDS:
            setattr(error, name, texts.get(name, ""))
        for name in _NUMBER_FIELDS:
            value = reply.get(name)
            setattr(error, name, value if isinstance(value, float) else None)
        return error


class SteeringError(DoublestepError):
    """A call of a session cannot be done where the run stands. The run is as it was."""

    exit_code = 2


class ConfigurationError(DoublestepError):
    """The system file, the command line or a model's use is wrong. No step was taken.

    Attributes:
        mistakes: the causes, where there are several; each is shown on a line of its own.
    """

    exit_code = 2
    mistakes: tuple[str, ...] = ()

    @classmethod
    def of_mistakes(cls, mistakes: Sequence[str]) -> Self:
        """One error for all of them."""
        error = cls("\n".join(mistakes))
        error.mistakes = tuple(mistakes)
        return error

    def __str__(self) -> str:
        return "\n".join(map(printable, self.mistakes)) or super().__str__()


class ModelError(ConfigurationError):
    """A model cannot be loaded: missing, corrupt, for another platform, of another kind."""


class SlaveLostError(DoublestepError):
    """A slave never appeared, its process died, or the connection to it is gone."""

    exit_code = 3


class HostLimitError(SlaveLostError):
    """The host gives this process no more memory, threads or processes."""


class SlaveError(DoublestepError):
    """The model returned an error, or cannot do what it was asked."""

    exit_code = 4


class StepRejectedError(SlaveError):
    """fmi2Error in a step: the slave is usable again after its state was restored."""


class FatalSlaveError(SlaveError):
    """fmi2Fatal: the instance must not be called any more."""


class StepSizeError(SlaveError):
    """The step size control asked for a step below the smallest communication step size."""


class SlaveCrashedError(SlaveError):
    """The worker process that held the model died; the slave node itself still answers."""


class SlaveKilledError(SlaveCrashedError):
    """Its death is not known to be the model's doing: a signal from outside, or nothing is known.

    It never rejects a step: the slave is restored, and does the same again.
    """

    exit_code = 3


class DeadlineError(DoublestepError):
    """A wait reached its bound."""

    exit_code = 5


class ProtocolError(DoublestepError):
    """The two sides do not understand each other."""

    exit_code = 6


class MalformedMessageError(ProtocolError):
    """Bytes that are no message of this protocol, or that go beyond one of its limits."""


class VersionError(ProtocolError):
    """The other side speaks another protocol version."""


class LifeCycleError(ProtocolError):
    """The slave's state does not allow this call (see ``life_cycle.py``)."""


class SequenceError(ProtocolError):
    """A stale epoch, or a sequence number that is neither the last one nor the next."""


class SlaveBusyError(ProtocolError):
    """The slave is held by another master, or all licences for it are taken."""


class ResultsError(DoublestepError):
    """Results cannot be written or read."""

    exit_code = 7


class InterruptedRunError(DoublestepError):
    """The user ended the run; what was accepted so far is in the results."""

    exit_code = 130


def _sent(text: str) -> str:
    """``text`` as it can travel: a file name may hold what is no character."""
    return cut(cut(text).encode("utf-8", "backslashreplace").decode("utf-8"))


def _tree(cls: type[DoublestepError]) -> list[type[DoublestepError]]:
    return [cls, *(sub for child in cls.__subclasses__() for sub in _tree(child))]


_BY_NAME = {cls.__name__: cls for cls in _tree(DoublestepError)}
