"""Laws of `Fmi2Slave` over real FMUs, and what an archive must not be able to do."""

from __future__ import annotations

import io
import math
import stat
import time
import zipfile
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
from fmpy import platform
from hypothesis import given, settings
from hypothesis import strategies as st

from protocol.calls import (
    DoStep,
    ExitInitializationMode,
    GetState,
    Initialize,
    Reset,
    SetInputs,
    SetState,
    StepStatus,
)
from protocol.errors import ModelError, SlaveError, StepRejectedError
from protocol.host.archives import MAX_ENTRIES
from protocol.host.log_files import SILENT, LogOutput
from protocol.signals import InputSignal
from protocol.slave import Slave
from protocol.variables import Causality, VariableType
from slave_node.execution.executor import Executor
from slave_node.fmu.archive import extract
from slave_node.fmu.description import describe_fmu
from slave_node.fmu.loading import load_fmu

MODELS = ("chassis", "wheel", "wheel_force", "chassis_force")
INPUTS = {
    "chassis": ("x_w", "v_w"),
    "wheel": ("x_c", "v_c"),
    "wheel_force": ("x_c", "v_c"),
    "chassis_force": ("F",),
}
OUTPUTS = dict.fromkeys(MODELS, ("x", "v")) | {"wheel_force": ("F",)}

Load = Callable[..., Slave]


@pytest.fixture
def load(fmu_dir: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Load]:
    """``load(model)`` instantiates an FMU, by name or from another file; freed after the test."""
    slaves: list[Slave] = []

    def make(model: str | Path, output: LogOutput = SILENT) -> Slave:
        fmu = fmu_dir / f"{model}.fmu" if isinstance(model, str) else model
        scratch = tmp_path_factory.mktemp("scratch")
        slaves.append(load_fmu(fmu, scratch, fmu.stem, output=output))
        return slaves[-1]

    yield make
    for slave in slaves:
        slave.close()


def start(
    slave: Slave,
    *,
    inputs: tuple[str, ...] | None = None,
    outputs: tuple[str, ...] | None = None,
    tolerance: float | None = 1e-9,
    **start_values: float | int | bool | str,
) -> Slave:
    """The slave at its first communication point, t = 0."""
    model = slave.description.model
    slave.initialize(
        Initialize(
            start_time=0.0,
            stop_time=None,
            relative_tolerance=tolerance,
            start_values=start_values,
            inputs=INPUTS[model] if inputs is None else inputs,
            outputs=OUTPUTS[model] if outputs is None else outputs,
        )
    )
    slave.exit_initialization_mode()
    return slave


def polynomial(model: str, order: int) -> np.ndarray:
    """Some inputs that matter, shape (order + 1, n_u)."""
    rows = np.array([[0.05, 0.3], [-0.2, 0.7], [3.0, -4.0], [-20.0, 30.0]])
    return rows[: order + 1, : len(INPUTS[model])] * (15000.0 if model == "chassis_force" else 1.0)


END = (((0.01 + 0.02) + 0.03) + 0.04) + 0.05
"""The time after `march` from 0 [s], added up as the slave does."""


def march(slave: Slave, begin: float, orders: tuple[int, ...] = (0, 3, 1, 2, 0)) -> bytes:
    """All that is seen over some steps with inputs of several orders, bit for bit."""
    seen, t = [], begin
    for i, order in enumerate(orders):
        slave.set_inputs(polynomial(slave.description.model, order) * math.cos(i))
        status, t = slave.do_step(t, 0.01 * (i + 1), False)
        assert status is StepStatus.OK
        seen.append(slave.get_outputs(1).tobytes())
    return b"".join(seen)


# ---- Description -------------------------------------------------------------------------------


def test_the_description_says_what_the_file_says(fmu_dir: Path) -> None:
    """Variables with units and start values, capabilities and feed-through, without the binary."""
    description = describe_fmu(fmu_dir / "wheel_force.fmu")
    assert description.model == "wheel_force"
    assert description.kind == "FMI 2.0 co-simulation"
    assert tuple(v.name for v in description.of(Causality.INPUT)) == ("x_c", "v_c")
    assert tuple(v.name for v in description.of(Causality.OUTPUT)) == ("F",)
    mass = description.variable("m")
    assert (mass.unit, mass.start, mass.type) == ("kg", 40.0, VariableType.REAL)
    assert description.variable("x_c").is_continuous_real
    can = description.capabilities
    assert can.can_get_and_set_state
    assert can.can_serialize_state
    assert can.can_interpolate_inputs
    assert can.can_handle_variable_step_size
    assert can.max_output_derivative_order == 1
    states = {"x": (), "v": (), "der(x)": (), "der(v)": ("x_c", "v_c")}
    assert description.feed_through == {"F": ("x_c", "v_c")} | states
    assert description.initial_feed_through == {"F": ("x_c", "v_c")}
    assert description.state_kind == "native"
    assert len(description.sha256) == 64
    wheel = describe_fmu(fmu_dir / "wheel.fmu").feed_through
    assert wheel == {"der(x)": (), "der(v)": ("x_c", "v_c")}


def test_the_slave_has_the_description_of_its_file(load: Load, fmu_dir: Path) -> None:
    """Descriptions that ``inspect`` shows are those a master gets."""
    for model in MODELS:
        assert load(model).description == describe_fmu(fmu_dir / f"{model}.fmu")


# ---- Initialization ----------------------------------------------------------------------------


@pytest.mark.parametrize("model", MODELS)
def test_start_values_are_where_it_starts(load: Load, model: str) -> None:
    """Start values, integers too, are the outputs at the first communication point."""
    slave = start(load(model), outputs=("x", "v"), x=1, v=-2.5)
    np.testing.assert_array_equal(slave.get_outputs(0), [[1.0, -2.5]])


def test_columns_are_those_named_at_initialization(load: Load) -> None:
    """Inputs and outputs come in the master's order, and any of them may be left out."""
    one = start(load("wheel"), inputs=("v_c", "x_c"), outputs=("v", "x"))
    two = start(load("wheel"))
    one.set_inputs(np.array([[0.3, 0.05]]))
    two.set_inputs(np.array([[0.05, 0.3]]))
    for slave in (one, two):
        slave.do_step(0.0, 0.1, False)
    np.testing.assert_array_equal(one.get_outputs(1)[:, ::-1], two.get_outputs(1))

    alone = start(load("wheel"), inputs=(), outputs=())
    alone.set_inputs(np.zeros((1, 0)))
    alone.do_step(0.0, 0.1, False)
    assert alone.get_outputs(1).shape == (2, 0)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"inputs": ("x_C",)}, "no variable 'x_C'; did you mean 'x_c'"),
        ({"outputs": ("speed",)}, "no variable 'speed'"),
        ({"mm": 3.0}, "no variable 'mm'; did you mean 'm'"),
        ({"m": "heavy"}, "'m' is of type Real; it cannot be 'heavy'"),
        ({"m": True}, "'m' is of type Real; it cannot be True"),
    ],
)
def test_a_wrong_name_or_value_is_named(load: Load, arguments: dict, message: str) -> None:
    """The error has the user's text, and the nearest right one."""
    with pytest.raises(ModelError) as caught:
        start(load("wheel"), **arguments)
    assert message in str(caught.value)


def test_a_calculated_variable_is_not_set(load: Load) -> None:
    """The FMU's own refusal comes with its words."""
    with pytest.raises(SlaveError, match=r"fmi2SetReal returned fmi2Error; the FMU's log: .*300"):
        start(load("wheel_force"), F=1.0)


def test_the_log_of_the_fmu_explains_errors(load: Load) -> None:
    """A status alone explains nothing: the FMU's last words, with their category, come along."""
    slave = load("wheel")
    with pytest.raises(SlaveError) as caught:
        start(slave, tolerance=-1.0)
    text = str(caught.value)
    assert text.startswith("fmi2SetupExperiment returned fmi2Error; the FMU's log: [logStatusError")
    assert "tolerance" in text

    rejected = start(load("wheel"), x=math.nan)
    with pytest.raises(StepRejectedError, match=r"fmi2DoStep returned fmi2Error.*log.*underflow"):
        rejected.do_step(0.0, 0.1, False)


def test_every_fmu_keeps_its_own_log(load: Load) -> None:
    """Several FMUs in one process: an error has the words of its own FMU, after others ended."""
    one, two = start(load("wheel")), start(load("chassis"))
    for begin in (0.25, 0.75):
        with pytest.raises(StepRejectedError, match=f"currentCommunicationPoint is {begin}"):
            one.do_step(begin, 0.1, False)
        two.close()
    with pytest.raises(SlaveError) as caught:
        start(load("chassis"), tolerance=-1.0)
    assert "currentCommunicationPoint" not in str(caught.value)


def test_all_categories_are_logged_on_demand(fmu_dir: Path, tmp_path: Path, load: Load) -> None:
    """An FMU that cannot be instantiated says why, and a warning is no error."""
    start(load("wheel", LogOutput(categories=("*",))), tolerance=1e-18)
    fmu = changed(fmu_dir, tmp_path / "wheel.fmu", ('guid="{', 'guid="{0'))
    with pytest.raises(ModelError, match=r"fmi2Instantiate: .*; the FMU's log: .*guid"):
        load(fmu)


# ---- Steps -------------------------------------------------------------------------------------


@pytest.mark.parametrize("order", [0, 1, 2, 3])
@pytest.mark.parametrize("model", MODELS)
def test_inputs_of_every_order_arrive(load: Load, model: str, order: int) -> None:
    """One step on a polynomial is the same as two on the polynomial and its continuation."""
    u = InputSignal(polynomial(model, order))
    once, twice = start(load(model)), start(load(model))
    once.set_inputs(u.derivatives)
    once.do_step(0.0, 0.08, False)
    twice.set_inputs(u.derivatives)
    twice.do_step(0.0, 0.05, False)
    twice.set_inputs(u.shifted(0.05).derivatives)
    twice.do_step(0.05, 0.03, False)
    np.testing.assert_allclose(once.get_outputs(1), twice.get_outputs(1), rtol=1e-6, atol=1e-6)

    if order:  # and the highest derivative mattered
        without = start(load(model))
        without.set_inputs(u.derivatives[:-1])
        without.do_step(0.0, 0.08, False)
        assert np.abs(without.get_outputs(0) - once.get_outputs(0)).max() > 1e-7


def test_a_lower_order_leaves_no_derivative_behind(load: Load) -> None:
    """Inputs of order 0 after inputs of order 3 are constant."""
    one, two = start(load("wheel")), start(load("wheel"))
    one.set_inputs(polynomial("wheel", 3))
    for slave in (one, two):
        slave.set_inputs(polynomial("wheel", 0))
        slave.do_step(0.0, 0.1, False)
    assert one.get_outputs(1).tobytes() == two.get_outputs(1).tobytes()


def test_output_derivatives_are_slopes(load: Load) -> None:
    """Row 1 is the derivative of row 0, also where the input feeds through."""
    for model in MODELS:
        slave, h = start(load(model), tolerance=1e-12), 1e-6
        slave.set_inputs(polynomial(model, 3))
        slave.do_step(0.0, 0.1, False)
        before = slave.get_outputs(0)[0]
        slave.do_step(0.1, h, False)
        slope = slave.get_outputs(1)[1]
        slave.do_step(0.1 + h, h, False)
        central = (slave.get_outputs(0)[0] - before) / (2.0 * h)
        np.testing.assert_allclose(slope, central, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("order", [-1, 2, 4, 100])
def test_derivatives_that_it_does_not_have_are_refused(load: Load, order: int) -> None:
    """The order is bounded before the FMU would write beyond the buffer."""
    slave = start(load("wheel"))
    with pytest.raises(SlaveError, match=f"order {order} asked for; it gives orders up to 1"):
        slave.get_outputs(order)


def test_inputs_of_another_shape_are_refused(load: Load) -> None:
    """Neither more columns nor more rows than there is room for."""
    slave = start(load("wheel"))
    for shape in ((1, 1), (1, 3), (5, 2)):
        with pytest.raises(SlaveError):
            slave.set_inputs(np.zeros(shape))


def test_what_get_outputs_gave_stays(load: Load) -> None:
    """A result belongs to the caller: the next step does not change it."""
    slave = start(load("wheel"), x=1.0)
    first = slave.get_outputs(1)
    kept = first.copy()
    slave.do_step(0.0, 0.1, False)
    slave.get_outputs(1)
    np.testing.assert_array_equal(first, kept)


def test_a_discard_tells_how_far_it_came(load: Load) -> None:
    """Status and last successful time reach the master; a saved state leads back."""
    slave, twin = start(load("wheel"), max_step=0.02), start(load("wheel"))
    state = slave.get_state()
    assert slave.do_step(0.0, 0.05, False) == (StepStatus.DISCARD, 0.02)
    slave.set_state(state)
    assert slave.do_step(0.0, 0.02, False) == (StepStatus.OK, 0.02)
    twin.do_step(0.0, 0.02, False)
    assert slave.get_outputs(1).tobytes() == twin.get_outputs(1).tobytes()
    slave.free_state(state)


def test_the_time_reached_is_the_end_of_the_step(load: Load) -> None:
    """To the bit, so that the master and the slave never disagree."""
    slave, t = start(load("wheel")), 0.0
    for step_size in (0.1, 0.2, 1e-9, 0.3):
        expected = t + step_size
        status, t = slave.do_step(t, step_size, False)
        assert (status, t) == (StepStatus.OK, expected)


# ---- Saved states ------------------------------------------------------------------------------


@pytest.mark.parametrize("model", MODELS)
def test_a_restored_state_repeats_bit_for_bit(load: Load, model: str) -> None:
    """Saving leaves no trace, and restoring does, whatever order the inputs had in between."""
    slave, untouched = start(load(model), x=0.1), start(load(model), x=0.1)
    for one in (slave, untouched):
        march(one, 0.0)
    t = END
    state = slave.get_state()
    first = march(slave, t)
    assert first == march(untouched, t)
    for orders in ((3, 3), (0,), (1, 2)):
        slave.set_state(state)
        march(slave, t, orders)
        slave.set_state(state)
        assert march(slave, t) == first
    slave.free_state(state)


@pytest.mark.parametrize("model", MODELS)
def test_a_serialized_state_goes_on_elsewhere(load: Load, model: str) -> None:
    """In another instance the bytes give the same bytes again and the same future."""
    slave = start(load(model), x=0.1, m=77.0)
    march(slave, 0.0)
    state = slave.get_state()
    data = slave.serialize_state(state)
    assert isinstance(data, bytes)
    slave.free_state(state)

    other = start(load(model))
    restored = other.deserialize_state(data)
    assert other.serialize_state(restored) == data
    other.set_state(restored)
    assert march(other, END) == march(slave, END)
    other.free_state(restored)


def test_bytes_that_are_no_state_are_refused(load: Load) -> None:
    """With the FMU's reason, and without harm."""
    slave = start(load("wheel"))
    for data in (b"", b"nonsense", bytes(5000)):
        with pytest.raises(SlaveError, match=r"fmi2DeSerializeFMUstate returned fmi2Error; .*log"):
            slave.deserialize_state(data)
    march(slave, 0.0)


def test_reset_is_as_good_as_new(load: Load) -> None:
    """Also for the inputs' derivatives that the adapter keeps in mind."""
    slave = start(load("wheel"), m=77.0)
    march(slave, 0.0)
    slave.reset()
    assert march(start(slave), 0.0) == march(start(load("wheel")), 0.0)


def test_closing_twice_is_closing(load: Load) -> None:
    """``close`` frees the instance once."""
    slave = start(load("wheel"))
    slave.terminate()
    slave.close()
    slave.close()


def test_a_whole_life_under_the_executor(load: Load) -> None:
    """A rejected step, a way back and a second life, as a master asks for them."""
    executor = Executor(load("wheel"))
    begin = [
        Initialize(0.0, None, 1e-9, {"max_step": 0.02}, ("x_c", "v_c"), ("x", "v")),
        ExitInitializationMode(),
        GetState(1),
    ]
    for _ in range(2):
        reply = executor.execute([*begin, SetInputs(np.zeros((2, 2))), DoStep(0.0, 0.05)])
        assert reply.error is None
        assert reply.results[-1] == (StepStatus.DISCARD, 0.02)
        reply = executor.execute([SetState(1), DoStep(0.0, 0.01), DoStep(0.01, 0.01), Reset()])
        assert reply.error is None
    executor.close()


# ---- Files that are no FMU for us --------------------------------------------------------------

Entries = dict[str, bytes]


def entries_of(fmu: Path) -> Entries:
    """The contents of an archive."""
    with zipfile.ZipFile(fmu) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


def packed(path: Path, entries: Entries | list[tuple[str, bytes]]) -> Path:
    """An archive with these entries, in order, whatever their names."""
    items = entries.items() if isinstance(entries, dict) else entries
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in items:
            archive.writestr(name, content)
    return path


def refusal(fmu: Path, tmp_path: Path, bound: float = 1.0) -> str:
    """Why an FMU is refused: at once, by both ways in, before anything is written."""
    scratch = tmp_path / "scratch"
    scratch.mkdir(exist_ok=True)
    begin = time.process_time()
    with pytest.raises(ModelError) as caught:
        extract(fmu, scratch)
    assert time.process_time() - begin < bound
    assert list(scratch.iterdir()) == []
    assert sorted(p.name for p in tmp_path.iterdir()) == sorted({fmu.name, "scratch"})
    with pytest.raises(ModelError):
        describe_fmu(fmu)
    return str(caught.value)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "not a readable FMU archive"),
        (b"PK\x03\x04 but not more", "not a readable FMU archive"),
        (b"\0" * 10_000, "not a readable FMU archive"),
    ],
)
def test_what_is_no_archive_is_refused(tmp_path: Path, content: bytes, message: str) -> None:
    """With the file's name and what to do."""
    fmu = tmp_path / "broken.fmu"
    fmu.write_bytes(content)
    text = refusal(fmu, tmp_path)
    assert message in text
    assert "broken.fmu" in text
    assert "export the FMU again" in text


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    """The path as it was looked for; a folder may be an FMU, and says what it lacks."""
    with pytest.raises(ModelError, match=r"nowhere\.fmu: no such file"):
        extract(tmp_path / "nowhere.fmu", tmp_path)
    with pytest.raises(ModelError, match=r"not an FMU: it holds no modelDescription\.xml"):
        extract(tmp_path, tmp_path)


def test_an_archive_without_a_description_is_no_fmu(tmp_path: Path) -> None:
    """A zip file alone is not an FMU."""
    fmu = packed(tmp_path / "a.fmu", {"readme.txt": b""})
    assert "holds no modelDescription.xml" in refusal(fmu, tmp_path)


def test_another_platform_is_named(fmu_dir: Path, tmp_path: Path, load: Load) -> None:
    """An FMU without a binary for here says which ones it has; it can still be inspected."""
    entries = {
        name.replace(f"binaries/{platform}/", "binaries/darwin64/"): content
        for name, content in entries_of(fmu_dir / "wheel.fmu").items()
    }
    entries["binaries/win32/wheel.dll"] = b""
    fmu = packed(tmp_path / "wheel.fmu", entries)
    with pytest.raises(ModelError) as caught:
        load(fmu)
    assert f"no binary for this platform, {platform}; it has darwin64, win32" in str(caught.value)
    assert describe_fmu(fmu).model == "wheel"


def changed(fmu_dir: Path, path: Path, *changes: tuple[str, str]) -> Path:
    """The wheel with its model description changed."""
    entries = entries_of(fmu_dir / "wheel.fmu")
    xml = entries["modelDescription.xml"].decode()
    for old, new in changes:
        assert old in xml
        xml = xml.replace(old, new)
    return packed(path, {**entries, "modelDescription.xml": xml.encode()})


def test_an_fmu_for_one_instance_per_process_has_one(
    fmu_dir: Path, tmp_path: Path, load: Load
) -> None:
    """The second is refused with a remedy, until the first is gone."""
    once = "canBeInstantiatedOnlyOncePerProcess"
    fmu = changed(fmu_dir, tmp_path / "wheel.fmu", (f'{once}="false"', f'{once}="true"'))
    first = load(fmu)
    with pytest.raises(ModelError, match=r"only once per process.*leave out --in-process"):
        load(fmu)
    first.close()
    start(load(fmu))


def test_output_derivatives_that_are_refused_come_with_a_remedy(
    fmu_dir: Path, tmp_path: Path, load: Load
) -> None:
    """An FMU that declares more of them than it gives would end every run at its start."""
    order = "maxOutputDerivativeOrder"
    fmu = changed(fmu_dir, tmp_path / "wheel.fmu", (f'{order}="1"', f'{order}="2"'))
    slave = start(load(fmu))
    slave.get_outputs(1)
    with pytest.raises(
        SlaveError, match="fmi2GetRealOutputDerivatives of order 2 returned fmi2Error"
    ) as info:
        slave.get_outputs(2)
    assert "derivative_points = 0" in info.value.remedy


FMI_4 = """<?xml version="1.0"?>
<fmiModelDescription fmiVersion="4.0" modelName="m" instantiationToken="{0}">
<CoSimulation modelIdentifier="m"/><ModelVariables/><ModelStructure/>
</fmiModelDescription>"""
SCHEDULED = """<?xml version="1.0"?>
<fmiModelDescription fmiVersion="3.0" modelName="m" instantiationToken="{0}">
<ScheduledExecution modelIdentifier="m"/><ModelVariables/><ModelStructure/>
</fmiModelDescription>"""
MODEL_EXCHANGE_1 = """<?xml version="1.0"?>
<fmiModelDescription fmiVersion="1.0" modelName="m" modelIdentifier="m" guid="{0}"
numberOfContinuousStates="0" numberOfEventIndicators="0"><ModelVariables/>
</fmiModelDescription>"""
MODEL_EXCHANGE = """<?xml version="1.0"?>
<fmiModelDescription fmiVersion="2.0" modelName="m" guid="{0}" numberOfEventIndicators="0">
<ModelExchange modelIdentifier="m"/><ModelVariables/><ModelStructure/>
</fmiModelDescription>"""


@pytest.mark.parametrize(
    ("xml", "message"),
    [
        (FMI_4, "is an FMI 4.0 FMU; export it with FMI 3.0, 2.0 or 1.0"),
        (SCHEDULED, "has neither co-simulation nor model exchange; export it as FMI 3.0"),
        (MODEL_EXCHANGE_1, "is an FMU for model exchange of FMI 1.0; export it as co-simulation"),
        ("<fmiModelDescription", "modelDescription.xml cannot be read"),
        ("<other/>", "modelDescription.xml cannot be read"),
        ("", "modelDescription.xml cannot be read"),
    ],
)
def test_another_kind_of_fmu_is_refused(tmp_path: Path, load: Load, xml: str, message: str) -> None:
    """Another version, another kind, and what is no description at all."""
    fmu = packed(tmp_path / "a.fmu", {"modelDescription.xml": xml.encode()})
    for use in (load, describe_fmu):
        with pytest.raises(ModelError) as caught:
            use(fmu)
        assert message in str(caught.value)
        assert "a.fmu" in str(caught.value)


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ('start="0"', 'start="zero"'),
        ('maxOutputDerivativeOrder="1"', 'maxOutputDerivativeOrder="one"'),
        ('causality="input"', 'causality="magic"'),
        ("<Real ", "<Complex "),
        ('index="3"', 'index="300"'),
        ('modelIdentifier="wheel"', 'modelIdentifier="../wheel"'),
        ('modelIdentifier="wheel"', 'modelIdentifier="another"'),
        ('guid="{', 'guid="{0'),
    ],
)
def test_nonsense_in_the_description_is_refused(
    fmu_dir: Path, tmp_path: Path, load: Load, old: str, new: str
) -> None:
    """Whatever stands where a number, a kind or a name belongs, the file is named."""
    with pytest.raises(ModelError, match=r"wheel\.fmu"):
        load(changed(fmu_dir, tmp_path / "wheel.fmu", (old, new)))


def test_capabilities_that_are_not_there_are_not_used(
    fmu_dir: Path, tmp_path: Path, load: Load
) -> None:
    """Functions that the FMU does not declare are refused by name and never called."""
    fmu = changed(
        fmu_dir,
        tmp_path / "wheel.fmu",
        ('canGetAndSetFMUstate="true"', 'canGetAndSetFMUstate="false"'),
        ('canSerializeFMUstate="true"', 'canSerializeFMUstate="false"'),
        ('canInterpolateInputs="true"', 'canInterpolateInputs="false"'),
        ('maxOutputDerivativeOrder="1"', 'maxOutputDerivativeOrder="0"'),
    )
    slave = start(load(fmu))
    assert slave.description.state_kind == "none"
    for call in (
        slave.get_state,
        lambda: slave.deserialize_state(b""),
        lambda: slave.set_inputs(polynomial("wheel", 1)),
        lambda: slave.get_outputs(1),
    ):
        with pytest.raises(SlaveError):
            call()
    slave.set_inputs(polynomial("wheel", 0))
    slave.do_step(0.0, 0.1, False)


def test_more_derivatives_than_can_travel_are_not_asked_for(
    fmu_dir: Path, tmp_path: Path, load: Load
) -> None:
    """An FMU that declares derivatives of order 9 gives them up to 3, within the buffer."""
    order = ('maxOutputDerivativeOrder="1"', 'maxOutputDerivativeOrder="9"')
    slave = start(load(changed(fmu_dir, tmp_path / "wheel.fmu", order)))
    with pytest.raises(SlaveError, match="up to 3"):
        slave.get_outputs(9)


# ---- Hostile archives --------------------------------------------------------------------------

GOOD = {"modelDescription.xml": MODEL_EXCHANGE.encode()}


@pytest.mark.parametrize(
    "name",
    [
        "../evil",
        "resources/../../evil",
        "resources/..",
        "/evil",
        "//host/evil",
        "\\evil",
        "..\\evil",
        "resources\\..\\..\\evil",
        "C:\\evil",
        "C:/evil",
        "c:evil",
    ],
)
def test_names_that_lead_outside_are_refused(tmp_path: Path, name: str) -> None:
    """Parents, absolute names, drives, with either slash: refused by name, nothing written."""
    text = refusal(packed(tmp_path / "a.fmu", {**GOOD, name: b"evil"}), tmp_path)
    assert f"entry {name!r} leads outside the archive" in text


def test_links_are_refused(tmp_path: Path) -> None:
    """A symbolic link could lead a later entry anywhere."""
    link = zipfile.ZipInfo("resources/link")
    link.external_attr = (stat.S_IFLNK | 0o777) << 16
    fmu = tmp_path / "a.fmu"
    with zipfile.ZipFile(fmu, "w") as archive:
        archive.writestr("modelDescription.xml", GOOD["modelDescription.xml"])
        archive.writestr(link, "/etc")
    assert "entry 'resources/link' is a symbolic link" in refusal(fmu, tmp_path)


@pytest.mark.filterwarnings("ignore:Duplicate name")
@pytest.mark.parametrize("twin", ["modelDescription.xml", "./modelDescription.xml"])
def test_entries_with_one_place_are_refused(tmp_path: Path, twin: str) -> None:
    """Two entries must not go to one place: the checked one is the extracted one."""
    fmu = packed(tmp_path / "a.fmu", [*GOOD.items(), (twin, b"<!DOCTYPE x>")])
    assert f"entry {twin!r} is there twice" in refusal(fmu, tmp_path)


def test_bombs_are_refused(tmp_path: Path) -> None:
    """Neither one entry of zeros nor twenty thousand of nothing is unpacked."""
    fmu = packed(tmp_path / "a.fmu", {**GOOD, "resources/zeros": bytes(100_000_000)})
    assert "entry 'resources/zeros' unpacks to 100000000 bytes" in refusal(fmu, tmp_path)
    with zipfile.ZipFile(fmu, "w") as archive:
        for i in range(MAX_ENTRIES + 1):
            archive.writestr(f"resources/{i}", b"")
    assert f"{MAX_ENTRIES + 1} entries" in refusal(fmu, tmp_path)


DOCUMENT_TYPES = {
    "entity bomb": '<!DOCTYPE x [<!ENTITY a "aaaaaaaaaa">'
    + "".join(
        f'<!ENTITY {b} "{f"&{a};" * 10}">' for a, b in zip("abcdefgh", "bcdefghi", strict=True)
    )
    + "]>",
    "external entity": '<!DOCTYPE x [<!ENTITY a SYSTEM "file:///etc/passwd">]>',
    "external definition": '<!DOCTYPE x SYSTEM "http://192.0.2.1/x.dtd">',
    "after a comment": "<!-- x -->\n<?x y?>\n<!DOCTYPE x>",
}


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16", "iso-8859-1"])
@pytest.mark.parametrize("kind", DOCUMENT_TYPES)
def test_document_types_are_refused(tmp_path: Path, kind: str, encoding: str) -> None:
    """In whatever encoding: an entity can exhaust memory or read files; FMI needs none."""
    declared = encoding.removesuffix("-sig")
    xml = (
        f'<?xml version="1.0" encoding="{declared}"?>{DOCUMENT_TYPES[kind]}'
        f'<fmiModelDescription fmiVersion="2.0" modelName="&i;"/>'
    )
    fmu = packed(tmp_path / "a.fmu", {"modelDescription.xml": xml.encode(encoding)})
    assert "declares a document type" in refusal(fmu, tmp_path, bound=0.05)


@pytest.mark.parametrize("encoding", ["utf-7", "utf-32", "cp037", "no-such-encoding"])
def test_strange_encodings_are_refused(tmp_path: Path, encoding: str) -> None:
    """A comment for one parser must not be a document type for another."""
    head = f'<?xml version="1.0" encoding="{encoding}"?>'
    body = '<!DOCTYPE x [<!ENTITY i "i">]><fmiModelDescription modelName="&i;"/>'
    if encoding == "utf-7":
        xml = head.encode() + body.replace("<", "+ADw-").encode()
    else:
        xml = (head + body).encode("ascii" if encoding.startswith("no") else encoding)
    refusal(packed(tmp_path / "a.fmu", {"modelDescription.xml": xml}), tmp_path)


def test_the_word_doctype_is_allowed_in_text(fmu_dir: Path, tmp_path: Path) -> None:
    """Only a declaration is refused, not a description that speaks of one."""
    fmu = changed(
        fmu_dir,
        tmp_path / "wheel.fmu",
        ("<!-- 1 -->", "<!-- <!DOCTYPE is not used -->"),
    )
    assert describe_fmu(fmu).model == "wheel"


@given(data=st.data())
@settings(max_examples=150)
def test_a_damaged_archive_raises_nothing_strange(
    data: st.DataObject, fmu_dir: Path, tmp_path_factory: pytest.TempPathFactory
) -> None:
    """Whatever is flipped in an FMU, it is extracted or refused with a `ModelError`."""
    packed_small = io.BytesIO()
    with zipfile.ZipFile(packed_small, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("modelDescription.xml", GOOD["modelDescription.xml"] * 3)
        archive.writestr("resources/a.txt", b"some text, some text, some text")
    content = bytearray(packed_small.getvalue())
    for place, value in data.draw(
        st.lists(st.tuples(st.integers(0, len(content) - 1), st.integers(0, 255)), min_size=1)
    ):
        content[place] = value
    folder = tmp_path_factory.mktemp("damaged")
    fmu = folder / "a.fmu"
    fmu.write_bytes(content)
    scratch = folder / "scratch"
    scratch.mkdir()
    with suppress(ModelError):
        extract(fmu, scratch)
    assert {p.name for p in folder.iterdir()} == {"a.fmu", "scratch"}
