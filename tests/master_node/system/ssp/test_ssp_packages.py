"""SSP packages as they come: files wherever they lie, variants, messages in SSP's words."""

from __future__ import annotations

import zipfile
from pathlib import Path

import pytest

from master_node import Result, open_system, simulate
from master_node.coupling.coupled_system import resolve
from master_node.simulation import resume
from protocol.errors import ConfigurationError, DoublestepError, ModelError
from tests.support.ssp_documents import (
    CHASSIS,
    DIRECT,
    GEAR,
    INPUTS,
    OUTPUTS,
    WHEEL,
    WHOLE_CHASSIS,
    WHOLE_WHEEL,
    Packages,
    array_component,
    binding,
    bindings,
    component,
    connection,
    connector,
    described,
    invoke,
    pairs,
    parameter_set,
    real,
    ssd,
    system,
)

EXPERIMENT = '<ssd:DefaultExperiment stopTime="0.05"/>'
CAR = system(WHOLE_CHASSIS + WHOLE_WHEEL, "".join(connection(*pair) for pair in DIRECT))


@pytest.fixture
def packages(tmp_path: Path, fmu_dir: Path) -> Packages:
    """Writes packages."""
    return Packages(tmp_path, fmu_dir)


def package(path: Path, descriptions: dict[str, str], files: dict[str, Path]) -> Path:
    """An archive with these documents and files, in order."""
    with zipfile.ZipFile(path, "w") as archive:
        for name, text in descriptions.items():
            archive.writestr(name, text)
        for name, file in files.items():
            archive.write(file, name)
    return path


def car(folder: str = "", wheel: str = "wheel.fmu") -> str:
    """The quarter car with its FMUs in a folder."""
    text = ssd(CAR, EXPERIMENT)
    text = text.replace("resources/chassis.fmu", f"{folder}chassis.fmu")
    return text.replace("resources/wheel.fmu", f"{folder}{wheel}")


def refusal(path: Path) -> str:
    """Why a package is not run."""
    with pytest.raises(DoublestepError) as caught, open_system(path) as opened:
        simulate(opened, in_process=True)
    return str(caught.value)


# ---- Files --------------------------------------------------------------------------------------


@pytest.mark.parametrize("folder", ["", "fmus/", "./", "resources\\", "a/../"])
def test_fmus_are_found_wherever_they_lie(tmp_path: Path, fmu_dir: Path, folder: str) -> None:
    """At the root, in a folder, behind ``./`` and backslashes: the same run as from resources."""
    place = {"./": "./", "resources\\": "resources/", "a/../": ""}.get(folder, folder)
    files = {f"{place}{name}.fmu": fmu_dir / f"{name}.fmu" for name in ("chassis", "wheel")}
    path = package(tmp_path / "a.ssp", {"./SystemStructure.ssd": car(folder)}, files)
    whole = package(
        tmp_path / "b.ssp",
        {"SystemStructure.ssd": ssd(CAR, EXPERIMENT)},
        {f"resources/{file.name}": file for file in files.values()},
    )
    results = []
    for each in (path, whole):
        with open_system(each) as opened:
            results.append(simulate(opened, in_process=True))
    assert results[0].outputs.tobytes() == results[1].outputs.tobytes()
    invoke("import", path, "--output", tmp_path / "a.toml")
    assert (tmp_path / "a_models" / "wheel.fmu").read_bytes() == (
        fmu_dir / "wheel.fmu"
    ).read_bytes()


def test_the_folder_of_an_fmu_is_a_source(tmp_path: Path, fmu_dir: Path) -> None:
    """It runs, imported as a packed FMU too; ``sourceBase="component"`` reads a file in it."""
    with zipfile.ZipFile(fmu_dir / "wheel.fmu") as archive:
        archive.extractall(tmp_path / "wheel")
    values = '<ssd:ParameterBinding source="resources/m.ssv" sourceBase="component"/>'
    text = car("resources/", "wheel").replace(
        "</ssd:Connectors></ssd:Component>\n</ssd:Elements>",
        f"</ssd:Connectors>{bindings(values)}</ssd:Component>\n</ssd:Elements>",
    )
    text = text.replace(
        'source="resources/wheel">', 'source="resources/wheel">' + bindings(values), 1
    )
    resources = tmp_path / "wheel" / "resources"
    resources.mkdir(exist_ok=True)
    (resources / "m.ssv").write_text(
        parameter_set(real("z", 0.1)).replace(
            "<ssv:ParameterSet",
            '<ssv:ParameterSet xmlns:ssv="http://ssp-standard.org/SSP1/'
            'SystemStructureParameterValues"',
        )
    )
    files = {
        f"resources/{path.relative_to(tmp_path).as_posix()}": path
        for path in (tmp_path / "wheel").rglob("*")
        if path.is_file()
    }
    files["resources/chassis.fmu"] = fmu_dir / "chassis.fmu"
    path = package(tmp_path / "a.ssp", {"SystemStructure.ssd": text}, files)
    with open_system(path) as opened:
        assert opened.slaves["wheel"].parameters == {"z": 0.1}
        expected = simulate(opened, in_process=True)
    invoke("import", path, "--output", tmp_path / "a.toml")
    assert (tmp_path / "a_models" / "wheel.fmu").is_file()
    with open_system(tmp_path / "a.toml") as opened:
        result = simulate(opened, in_process=True)
    assert result.outputs.tobytes() == expected.outputs.tobytes()


def test_what_is_missing_is_named_with_what_is_like_it(tmp_path: Path, fmu_dir: Path) -> None:
    """A source in the wrong folder, or with other letters."""
    path = package(
        tmp_path / "a.ssp",
        {"SystemStructure.ssd": car("resources/")},
        {"wheel.fmu": fmu_dir / "wheel.fmu", "resources/Chassis.fmu": fmu_dir / "chassis.fmu"},
    )
    told = refusal(path)
    assert "line 3: " in told
    assert "resources/chassis.fmu: no such file; did you mean 'resources/Chassis.fmu'" in told


def test_entries_that_nothing_refers_to_are_named_together(
    tmp_path: Path, fmu_dir: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """Those outside of resources and documentation; FMUs and their folders are part of it."""
    files = {
        **{f"{name}.fmu": fmu_dir / f"{name}.fmu" for name in ("chassis", "wheel")},
        "README.md": fmu_dir / "wheel.fmu",
        "old/wheel.fmu": fmu_dir / "wheel.fmu",
        "documentation/index.html": fmu_dir / "wheel.fmu",
    }
    path = package(tmp_path / "a.ssp", {"SystemStructure.ssd": car()}, files)
    invoke("import", path, "--output", tmp_path / "a.toml")
    assert "entries that are not carried: 'README.md', 'old/wheel.fmu'\n" in caplog.text


# ---- Variants -----------------------------------------------------------------------------------


@pytest.fixture
def variants(tmp_path: Path, fmu_dir: Path) -> Path:
    """A package with two descriptions."""
    descriptions = {
        "SystemStructure.ssd": car(),
        "Heavy.ssd": car().replace(
            '<ssd:System name="root">',
            '<ssd:System name="root">' + bindings(binding(real("chassis.m", 800.0))),
        ),
    }
    files = {f"{name}.fmu": fmu_dir / f"{name}.fmu" for name in ("chassis", "wheel")}
    return package(tmp_path / "car.ssp", descriptions, files)


def test_a_variant_is_chosen_behind_the_package(
    variants: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """``import`` lists them; run, import and resume take ``package.ssp#Variant.ssd``."""
    invoke("import", variants, "--output", tmp_path / "car.toml")
    assert "variants beside SystemStructure.ssd: 'Heavy.ssd'; choose one as car.ssp#Heavy.ssd" in (
        caplog.text
    )
    heavy = f"{variants}#Heavy.ssd"
    invoke("import", heavy)
    assert "variants beside Heavy.ssd: 'SystemStructure.ssd'" in caplog.text
    with open_system(tmp_path / "car_Heavy.toml") as opened:
        assert opened.slaves["chassis"].parameters == {"m": 800.0}
    arguments = ("--in-process", "--quiet", "--no-plot", "--output")
    for name, file in (("ssp", heavy), ("toml", tmp_path / "car_Heavy.toml"), ("plain", variants)):
        invoke("run", file, *arguments, tmp_path / name)
    results = [(tmp_path / n / "results.csv").read_bytes() for n in ("ssp", "toml", "plain")]
    assert results[0] == results[1] != results[2]
    assert Result.load(tmp_path / "ssp").summary["settings"]["system_file"] == heavy


def test_a_variant_is_resumed_as_itself(variants: Path, tmp_path: Path) -> None:
    """A run of a variant that was interrupted goes on with the models of that variant."""

    class Interrupting:
        count = 0

        def started(self, _: object) -> None: ...

        def attempted(self, _: object) -> None:
            self.count += 1
            if self.count == 5:
                raise KeyboardInterrupt

        def ended(self, _: object) -> None: ...

    heavy = f"{variants}#Heavy.ssd"
    with open_system(heavy) as opened:
        whole = opened.with_simulation(checkpoint_interval=1e-9)
        simulate(whole, output=tmp_path / "whole", in_process=True)
        with pytest.raises(DoublestepError, match="interrupted"):
            simulate(whole, output=tmp_path / "cut", in_process=True, observers=[Interrupting()])
    resume(tmp_path / "cut")
    results = [(tmp_path / name / "results.csv").read_bytes() for name in ("whole", "cut")]
    assert results[0] == results[1]


def test_a_variant_that_is_not_there_is_named(variants: Path, tmp_path: Path) -> None:
    """With those that are; a package may have no default description."""
    assert "car.ssp holds no 'Light.ssd', but 'SystemStructure.ssd', 'Heavy.ssd'; choose one" in (
        refusal(Path(f"{variants}#Light.ssd"))
    )
    path = package(tmp_path / "a.ssp", {"Heavy.ssd": car()}, {})
    assert "not an SSP: it holds no SystemStructure.ssd, but 'Heavy.ssd'; choose one as " in (
        refusal(path)
    )


# ---- Attributes and elements --------------------------------------------------------------------


def test_an_empty_attribute_is_none(packages: Packages) -> None:
    """``source=""`` beside inline values, ``startElement=""`` for the system itself, and others."""
    inline = binding(real("z", 0.1, "m"), attributes='source="" sourceBase="" type="" prefix=""')
    text = ssd(
        system(
            component("wheel", INPUTS, bindings(inline)) + CHASSIS,
            connection("u", "wheel.x_c").replace(
                "<ssd:Connection", '<ssd:Connection startElement="" startIndices=""'
            )
            + connection("chassis.v", "wheel.v_c", attributes='suppressUnitConversion=""'),
            f"<ssd:Connectors>{connector('u', 'input')}</ssd:Connectors>",
        ),
        '<ssd:DefaultExperiment startTime="" stopTime="2"/>',
    )
    read = packages.read(text)
    assert read.system.slaves["wheel"].parameters == {"z": 0.1}
    assert pairs(read.system) == [("chassis.v", "wheel.v_c")]
    assert read.system.simulation.stop_time == 2.0
    told = packages.refusal(ssd(system(component("wheel", INPUTS, source='source=""'))))
    assert "component 'wheel' has no source" in told


def test_what_is_harmless_is_noted(packages: Packages) -> None:
    """A unit without a definition, and a connector that is there twice."""
    twice = connector("x_c", "input", "furlong") * 2
    read = packages.read(ssd(system(component("wheel", twice))))
    assert any("unit 'furlong' is not in the Units of the file" in note for note in read.notes)
    assert any("connector 'x_c' is there twice" in note for note in read.notes)
    both = connector("x_c", "input") + connector("x_c", "output")
    assert "there are two connectors 'x_c'" in packages.refusal(ssd(system(component("w", both))))


def test_an_integer_is_connected_to_an_enumeration(
    packages: Packages, capability_dir: Path
) -> None:
    """By the numbers of its items; the item of a parameter may be one that the FMU alone knows."""
    fmu = {"all_types3__fmu": capability_dir / "all_types3.fmu"}
    values = '<ssv:Parameter name="enumeration_in"><ssv:Enumeration value="green"/></ssv:Parameter>'
    text = ssd(
        system(
            array_component("a", connector("int32_out", "output", inner="<ssc:Integer/>"))
            + array_component(
                "b",
                connector("enumeration_in", "input", inner=GEAR),
            )
            + array_component("c", connector("v", "input"), bindings(binding(values))),
            connection("a.int32_out", "b.enumeration_in"),
        ),
        '<ssd:Enumerations><ssc:Enumeration name="gear"/></ssd:Enumerations>',
        version="2.0",
    )
    read = packages.read(text, **fmu).system
    assert read.slaves["c"].parameters == {"enumeration_in": 2}
    model = described(capability_dir / "all_types3.fmu")
    coupled = resolve(read.with_simulation(stop_time=1.0), dict.fromkeys(read.slaves, model))
    ((held,),) = (inputs for inputs in coupled.discrete.inputs if inputs)
    assert [held.cast(number) for number in (1, 2, 3)] == [1, 2, 3]
    with pytest.raises(KeyError):
        held.cast(4)


# ---- Words --------------------------------------------------------------------------------------


def test_a_description_without_components_says_so(packages: Packages) -> None:
    """In SSP's words; nested in another one it is nothing but a system without slaves."""
    empty = f"<ssd:Connectors>{connector('u', 'input')}</ssd:Connectors>"
    told = packages.refusal(ssd(empty))
    assert "ssd:System 'root' has no ssd:Component, so there is nothing to simulate" in told
    inner = f'<ssd:System name="s">{empty}</ssd:System>'
    read = packages.read(ssd(system(WHEEL + CHASSIS + inner, connection("chassis.x", "s.u"))))
    assert list(read.system.slaves) == ["wheel", "chassis"]


@pytest.mark.parametrize(
    ("text", "told"),
    [
        (ssd(CAR), "test.ssp: ssd:DefaultExperiment has no stopTime"),
        (
            ssd(CAR, '<ssd:DefaultExperiment startTime="2" stopTime="1"/>'),
            "ssd:DefaultExperiment: stopTime 1.0 is not after startTime 2.0",
        ),
        (
            ssd(
                system(WHEEL + CHASSIS, connection("chassis.q", "wheel.x_c")),
                EXPERIMENT,
            ).replace(OUTPUTS, OUTPUTS + connector("q", "output")),
            "line 3: ssd:Connection: output connector = 'chassis.q': chassis has no variable 'q'",
        ),
        (
            ssd(
                system(component("wheel", INPUTS, bindings(binding(real("m[2]", 1.0))))),
                EXPERIMENT,
            ),
            "no variable of 'wheel' has the name 'm[2]'",
        ),
    ],
)
def test_messages_speak_of_elements(packages: Packages, text: str, told: str) -> None:
    """File, line and element, and no table of a system file."""
    path = packages.write(text)
    if "has no variable" in told or "stopTime" in told:
        message = refusal(path)
        assert told in message
        assert "[" not in message
    else:
        assert any(told in note for note in packages.read_file(path).notes)


def test_models_are_named_by_the_package(packages: Packages, tmp_path: Path) -> None:
    """And not by the folder into which it was extracted for the time being."""
    broken = tmp_path / "broken.fmu"
    broken.write_bytes(b"no archive")
    path = packages.write(
        ssd(system(component("a", "", source='source="resources/b.fmu"')), EXPERIMENT),
        b__fmu=broken,
    )
    told = refusal(path)
    assert told.startswith(f"a: {path}/resources/b.fmu: not a readable FMU archive")
    with pytest.raises(ModelError), open_system(path) as opened:
        simulate(opened, in_process=True)


def test_settings_are_given_in_a_system_file(packages: Packages) -> None:
    """Settings that SSP cannot express are in the file that import makes."""
    path = packages.write(ssd(CAR, EXPERIMENT))
    with open_system(path) as opened:
        assert opened.places.setting("slaves.wheel", "step_size") == (
            "[slaves.wheel] step_size in a system file, which `master-node import` makes"
        )
        with pytest.raises(ConfigurationError, match=r"the annotation of Doublestep: \[slaves"):
            resolve(
                opened.with_slave("wheel", tolerances={"q": {"relative": 1.0}}),
                {name: described(packages.fmus / f"{name}.fmu") for name in ("chassis", "wheel")},
            )
