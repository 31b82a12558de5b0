"""Study files: TOML into frozen, validated values, before anything starts.

Every message names file, table and key. ``docs/sweep.md`` explains each key to a user.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import (
    AfterValidator,
    BaseModel,
    ConfigDict,
    Discriminator,
    Field,
    StrictBool,
    StrictInt,
    StrictStr,
    Tag,
    ValidationError,
    field_validator,
    model_validator,
)

from master_node.numerics.reductions import REDUCTIONS
from master_node.system.fields import Number, Positive, Reference, Scalar
from master_node.system.mistakes import configuration_error
from master_node.system.toml_files import read_located_tables
from protocol.errors import ConfigurationError
from protocol.text.names import nearest
from protocol.wire.keys import check_name

MAX_RUNS = 100_000
"""More runs than this are taken for a mistake."""

WholeNumber = Annotated[StrictInt, Field(ge=1)]


class _Table(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


class Range(_Table):
    """``{ from = a, to = b, number = n }``.

    Attributes:
        begin, end: both belong to it.
        number: of values, for a grid; a sample has its own number.
        spacing: equal distances or equal ratios.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", populate_by_name=True)

    begin: StrictInt | Number = Field(alias="from")
    end: StrictInt | Number = Field(alias="to")
    number: Annotated[StrictInt, Field(ge=2)] | None = None
    spacing: Literal["linear", "logarithmic"] = "linear"

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        if self.begin == self.end:
            raise ValueError("from and to are the same: write the value alone")
        if self.spacing == "logarithmic" and min(self.begin, self.end) <= 0.0:
            raise ValueError("a logarithmic range needs from and to above 0")
        return self


class SameValue(_Table):
    """``{ same_as = "slave.variable" }``: the value that another parameter has in the same run.

    Attributes:
        same_as: a parameter that has values.
    """

    same_as: Reference


def _kind_of_values(value: Any) -> str:
    if isinstance(value, bool | int | float | str):
        return "one-value"
    if isinstance(value, list | tuple):
        return "values"
    is_same = isinstance(value, SameValue) or (isinstance(value, Mapping) and "same_as" in value)
    return "same" if is_same else "range"


def _finite(value: Scalar) -> Scalar:
    if isinstance(value, float) and not abs(value) < float("inf"):
        raise ValueError("must be finite")
    return value


FiniteScalar = Annotated[Scalar, AfterValidator(_finite)]
Values = Annotated[
    Annotated[FiniteScalar, Tag("one-value")]
    | Annotated[Annotated[tuple[FiniteScalar, ...], Field(min_length=1)], Tag("values")]
    | Annotated[Range, Tag("range")]
    | Annotated[SameValue, Tag("same")],
    Discriminator(_kind_of_values),
]
"""One value for all runs, several values, a range of values, or that of another parameter."""


class Sample(_Table):
    """The ``[sample]`` table.

    Attributes:
        kind: how values are drawn from the ranges.
        number: of runs.
        seed: equal seeds give equal samples.
    """

    kind: Literal["latin-hypercube"]
    number: WholeNumber
    seed: Annotated[StrictInt, Field(ge=0)]


class Cases(_Table):
    """The ``[cases]`` table.

    Attributes:
        file: CSV, relative to the study file: a column for each parameter, a row for each run.
    """

    file: StrictStr


class RunSettings(_Table):
    """The ``[run]`` table.

    Attributes:
        in_process: run the slaves of a run in one process, without a bus.
        plot: draw ``results.png`` of each run.
        timeout: after which a run is ended and has failed [s].
        needs: the licences that a run holds; one that is named twice is held twice.
    """

    in_process: StrictBool = False
    plot: StrictBool = False
    timeout: Positive = 86400.0
    needs: tuple[StrictStr, ...] = ()


class Resources(_Table):
    """The ``[resources]`` table.

    Attributes:
        licences: how many of each there are.
    """

    licences: Mapping[str, WholeNumber] = Field(default_factory=dict)


class ReducedOutput(_Table):
    """One column of the table of results.

    Attributes:
        variable: ``slave.variable`` of an output.
        reduce: how its course becomes a number.
    """

    variable: Reference
    reduce: StrictStr

    @field_validator("reduce")
    @classmethod
    def _known(cls, value: str) -> str:
        if value not in REDUCTIONS:
            names = ", ".join(map(repr, REDUCTIONS))
            raise ValueError(f"must be one of {names}")
        return value


class ResultSettings(_Table):
    """The ``[results]`` table.

    Attributes:
        outputs: columns of the table of results, by their names.
    """

    outputs: Mapping[str, ReducedOutput] = Field(default_factory=dict)

    @field_validator("outputs")
    @classmethod
    def _names(cls, value: Mapping[str, ReducedOutput]) -> Mapping[str, ReducedOutput]:
        for name in value:
            try:
                check_name(name, "name of a column")
            except ConfigurationError as error:
                raise ValueError(str(error)) from None
        return value


class Study(_Table):
    """A whole study: what a study file holds.

    Attributes:
        system: a ``.toml``, ``.ssp`` or ``.ssd`` file, relative to the study file.
        parameters: values by ``slave.variable`` or ``simulation.key``.
        base: directory of the study file.
        source: what to call this in messages: the file's name.
    """

    system: StrictStr
    parameters: Mapping[Reference, Values] = Field(default_factory=dict)
    sample: Sample | None = None
    cases: Cases | None = None
    run: RunSettings = RunSettings()
    resources: Resources = Resources()
    results: ResultSettings = ResultSettings()
    base: Path = Field(default_factory=Path.cwd, exclude=True)
    source: str = Field(default="the study", exclude=True)

    def __init__(self, **tables: Any) -> None:
        try:
            super().__init__(**tables)
        except ValidationError as error:
            source = str(tables.get("source", "the study"))
            raise configuration_error(source, error, _known_keys) from None

    @model_validator(mode="after")
    def _one_way(self) -> Self:
        if self.cases is not None and (self.parameters or self.sample is not None):
            raise ValueError("[cases] stands alone: its file has the parameters and the runs")
        if self.cases is None and not self.parameters:
            raise ValueError("there is nothing to vary: give [parameters] or [cases]")
        for name, values in self.parameters.items():
            mistake = self._mistake(values)
            if mistake:
                raise ValueError(f'[parameters] "{name}": {mistake}')
        if self.sample is not None and not any(
            isinstance(values, Range) for values in self.parameters.values()
        ):
            raise ValueError("[sample] needs a range in [parameters]")
        return self

    def _mistake(self, values: object) -> str:
        """Mistake in the values of a parameter, beside what is in [sample]; or ""."""
        match values:
            case Range(number=None) if self.sample is None:
                return "number is missing, or a [sample] table"
            case Range(number=int()) if self.sample is not None:
                return "number is for a grid, and [sample] has its own"
            case tuple() if self.sample is not None:
                return "a sample is drawn from ranges: write { from = a, to = b }"
            case SameValue(same_as=other):
                given = self.parameters.items()
                having = [name for name, v in given if not isinstance(v, SameValue)]
                if other not in having:
                    return f"same_as = {other!r}: no parameter with values{nearest(other, having)}"
        return ""

    @model_validator(mode="after")
    def _licences(self) -> Self:
        licences = self.resources.licences
        for name in dict.fromkeys(self.run.needs):
            if name not in licences:
                raise ValueError(
                    f"[run] needs: there is no licence {name!r} in [resources] licences"
                    f"{nearest(name, licences)}"
                )
            if self.run.needs.count(name) > licences[name]:
                raise ValueError(
                    f"[run] needs: a run needs {self.run.needs.count(name)} licences {name!r}, and "
                    f"there are {licences[name]}"
                )
        return self

    @property
    def system_file(self) -> Path:
        """Where the system is."""
        return self.base / self.system

    @property
    def licence_limit(self) -> int | None:
        """Number of runs that have their licences at the same time; None: no limit."""
        needs = self.run.needs
        limits = [self.resources.licences[name] // needs.count(name) for name in needs]
        return min(limits, default=None)


def load_study(path: Path) -> Study:
    """Read a study file.

    Raises:
        ConfigurationError: it is missing or wrong; the message has a line for each mistake.
    """
    return Study(**read_located_tables(path))


def _known_keys(place: list[str]) -> list[str]:
    model: type[BaseModel] = Study
    match place:
        case ["sample"]:
            model = Sample
        case ["cases"]:
            model = Cases
        case ["run"]:
            model = RunSettings
        case ["resources"]:
            model = Resources
        case ["results"]:
            model = ResultSettings
        case ["results", "outputs", _]:
            model = ReducedOutput
        case ["parameters", _]:
            return sorted({*_keys(Range), *_keys(SameValue)})
    return sorted(_keys(model) - {"base", "source"})


def _keys(model: type[BaseModel]) -> set[str]:
    return {field.alias or name for name, field in model.model_fields.items()}
