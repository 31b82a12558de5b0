"""System files: TOML into frozen, validated values, before anything starts.

Every message names file, table and key. ``docs/system-file.md`` explains each key to a user.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Self

from pydantic import (
    AfterValidator,
    BaseModel,
    Field,
    ValidationError,
    model_validator,
)

from master_node.system.fields import (
    FrozenTable,
    Reference,
    Value,
)
from master_node.system.mistakes import configuration_error
from master_node.system.places import SspPlaces, SystemFilePlaces
from master_node.system.simulation import PAPER, SimulationSettings
from master_node.system.tables import (
    Action,
    BusSettings,
    Connection,
    InputSettings,
    InputValue,
    OutputTolerance,
    ResultsSettings,
    SlaveSettings,
)
from master_node.system.toml_files import read_located_tables
from protocol.errors import ConfigurationError
from protocol.text.names import nearest
from protocol.wire.keys import check_name


class System(FrozenTable):
    """A whole system: what a system file holds.

    Attributes:
        inputs: what drives inputs from outside, by ``slave.variable``; in Python also functions of
            the time, and tuples of times and values.
        actions: what the run does by itself at points in time, in any order.
        base: directory to which the models' paths are relative; default: the working directory.
        source: what to call this in messages: the file's name.
        places: what to call its parts there.
        unpacked: directory into which packages were unpacked for this time; None: there are none.

    Raises:
        ConfigurationError: a table is wrong; the message has a line for each mistake.
    """

    simulation: SimulationSettings = SimulationSettings()
    slaves: Mapping[str, SlaveSettings]
    connections: tuple[Connection, ...] = ()
    inputs: Mapping[Reference, InputValue] = Field(default_factory=dict)
    actions: tuple[Action, ...] = ()
    results: ResultsSettings = ResultsSettings()
    bus: BusSettings = BusSettings()
    base: Annotated[Path, AfterValidator(Path.absolute)] = Field(
        default_factory=Path.cwd, exclude=True
    )
    source: str = Field(default="the system", exclude=True)
    places: SystemFilePlaces | SspPlaces = Field(SystemFilePlaces("the system"), exclude=True)
    unpacked: Path | None = Field(None, exclude=True)

    def __init__(self, **tables: Any) -> None:
        source = str(tables.get("source", "the system"))
        tables.setdefault("places", SystemFilePlaces(source))
        try:
            super().__init__(**tables)
        except ValidationError as error:
            raise configuration_error(source, error, _known_keys) from None

    @model_validator(mode="after")
    def _names(self) -> Self:
        if not self.slaves:
            raise ValueError("at least one [slaves.NAME] table is needed")
        for name in self.slaves:
            try:
                check_name(name)
            except ConfigurationError as error:
                raise ValueError(str(error)) from None
        return self

    @property
    def certificates(self) -> Path | None:
        """The directory with certificates for TLS."""
        return None if self.bus.tls is None else self.base / self.bus.tls

    def checked(self) -> Self:
        """The system itself, as nothing more can be added to it.

        Raises:
            ConfigurationError: something is still missing.
        """
        if self.simulation.stop_time is None:
            raise ConfigurationError(
                self.places.no_stop_time, remedy="give it there, or say --stop-time"
            )
        return self

    def with_simulation(self, **settings: Any) -> System:
        """System with other simulation settings; None leaves one as it is.

        A preset here wins over single settings of the system, except for a fixed ``order``.
        """
        given = {name: value for name, value in settings.items() if value is not None}
        simulation = self.simulation.model_dump(exclude_unset=True)
        if given.get("preset") == "paper":
            order = self.simulation.order
            simulation |= {**PAPER, "order": PAPER["order"] if order == "auto" else order}
        simulation |= given
        return self._with(simulation=simulation)

    def with_parameters(self, parameters: Mapping[str, Value]) -> System:
        """System with other start values, by ``slave.variable``; they win over its own.

        Raises:
            ConfigurationError: there is no such slave, with the nearest names.
        """
        by_length = sorted(self.slaves, key=len, reverse=True)  # names may hold dots
        given: dict[str, dict[str, Value]] = {}
        for reference, value in parameters.items():
            slave = next((name for name in by_length if reference.startswith(f"{name}.")), None)
            if slave is None:
                name = reference.partition(".")[0]
                near = nearest(name, self.slaves)
                raise ConfigurationError(f"{self.source}: {reference!r}: no slave {name!r}{near}")
            given.setdefault(slave, {})[reference[len(slave) + 1 :]] = value
        slaves = {name: slave.model_dump(exclude_unset=True) for name, slave in self.slaves.items()}
        for name, values in given.items():
            slaves[name]["parameters"] = {**self.slaves[name].parameters, **values}
        return self._with(slaves=slaves)

    def with_slave(self, name: str, **settings: Any) -> System:
        """System with other settings of one slave."""
        changed = self.slaves[name].model_dump(exclude_unset=True) | settings
        return self._with(slaves={**self.slaves, name: changed})

    def with_slaves(self, **settings: Any) -> System:
        """System with other settings of all slaves; None leaves one as it is."""
        given = {name: value for name, value in settings.items() if value is not None}
        slaves = {
            name: slave.model_dump(exclude_unset=True) | given
            for name, slave in self.slaves.items()
        }
        return self._with(slaves=slaves)

    def with_bus(self, **settings: Any) -> System:
        """System with other bus settings; None and empty ones leave one as it is."""
        given = {
            name: value
            for name, value in settings.items()
            if value is not None and value is not False and value != ()
        }
        return self._with(bus=self.bus.model_dump(exclude_unset=True) | given)

    def with_results(self, **settings: Any) -> System:
        """System with other results settings; None and empty ones leave one as it is."""
        given = {name: value for name, value in settings.items() if value not in (None, ())}
        return self._with(results=self.results.model_dump(exclude_unset=True) | given)

    def _with(self, **tables: Any) -> System:
        parts = {name for name, field in System.model_fields.items() if not field.exclude}
        kept = parts - tables.keys()
        return System(
            **{name: getattr(self, name) for name in kept},
            **tables,
            base=self.base,
            source=self.source,
            places=self.places,
            unpacked=self.unpacked,
        )


def load_system(path: Path | str) -> System:
    """Read a system file in TOML; `open_system` reads packages too.

    Raises:
        ConfigurationError: it is missing or wrong; the message has a line for each mistake.
    """
    return System(**read_located_tables(Path(path)))


def _known_keys(place: list[str]) -> list[str]:
    model: type[BaseModel] = System
    match place:
        case ["simulation"]:
            model = SimulationSettings
        case ["results"]:
            model = ResultsSettings
        case ["bus"]:
            model = BusSettings
        case ["slaves", _]:
            model = SlaveSettings
        case ["slaves", _, "tolerances", _]:
            model = OutputTolerance
        case ["connections", _]:
            return [field.alias or name for name, field in Connection.model_fields.items()]
        case ["inputs", _]:
            model = InputSettings
        case ["actions", _]:
            model = Action
    return [name for name, field in model.model_fields.items() if not field.exclude]
