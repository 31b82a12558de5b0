"""Model descriptions with slips that leave no doubt of what is meant are read, and say so."""

from __future__ import annotations

import zipfile
from pathlib import Path
from xml.etree.ElementTree import Element, fromstring

import numpy as np
import pytest

from master_node import System, simulate
from slave_node.fmu.description import describe_fmu
from slave_node.fmu.repairs import repair


def described(*variables: str, version: str = "2.0") -> Element:
    """A model description with these variables."""
    text = "".join(variables)
    return fromstring(
        f'<fmiModelDescription fmiVersion="{version}"><TypeDefinitions><SimpleType name="known"/>'
        f"</TypeDefinitions><ModelVariables>{text}</ModelVariables></fmiModelDescription>"
    )


def variability(root: Element) -> list[str | None]:
    """Variabilities of all variables."""
    return [variable.get("variability") for variable in root.iterfind("./ModelVariables/*")]


@pytest.mark.parametrize(
    ("causality", "given", "read"),
    [
        ("parameter", "continuous", "tunable"),
        ("parameter", None, "tunable"),
        ("calculatedParameter", "discrete", "tunable"),
        ("parameter", "fixed", "fixed"),
        ("input", "tunable", "discrete"),
        ("input", None, None),
        ("output", "fixed", "discrete"),
        ("output", "constant", "constant"),
        ("independent", "discrete", "continuous"),
        ("local", "fixed", "fixed"),
    ],
)
def test_a_variability_that_is_not_allowed_is_the_one_that_is_meant(
    causality: str, given: str | None, read: str | None
) -> None:
    """FMI 2.0's default is continuous, which no parameter can be; what is allowed stays."""
    attribute = "" if given is None else f'variability="{given}"'
    root = described(f'<ScalarVariable name="v" causality="{causality}" {attribute}/>')
    remarks = repair(root)
    assert variability(root) == [read]
    assert bool(remarks) == (given != read)


def test_fmi_3_has_other_defaults() -> None:
    """A parameter without a variability is fixed there, and that of FMI 1.0 is no causality."""
    three = described('<Float64 name="p" causality="parameter"/>', version="3.0")
    one = described('<ScalarVariable name="p" variability="parameter"/>', version="1.0")
    assert repair(three) == repair(one) == []


def test_slips_of_one_kind_are_one_sentence() -> None:
    """With the first name and the number of the others."""
    root = described(*(f'<ScalarVariable name="p{i}" causality="parameter"/>' for i in range(100)))
    (remark,) = repair(root)
    assert remark.startswith("p0 and 99 more: a variable of causality parameter cannot be contin")


def test_a_type_that_is_not_defined_is_left_out() -> None:
    """In FMI 2.0 it stands in the element within, in FMI 3.0 in the variable itself."""
    within = described('<ScalarVariable name="v"><Real declaredType="lost"/></ScalarVariable>')
    itself = described('<Float64 name="v" declaredType="lost"/>', version="3.0")
    known = described('<Float64 name="v" declaredType="known"/>', version="3.0")
    assert repair(within) == repair(itself) == ["v: its type lost is not defined; it is left out"]
    assert repair(within) == repair(itself) == repair(known) == []


@pytest.mark.slow
def test_an_fmu_with_slips_runs_as_one_without(
    fmu_dir: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """FMPy refuses to read it; here it runs to the same bits, with a warning of what was mended."""
    fmu, slipped = fmu_dir / "wheel.fmu", tmp_path / "wheel.fmu"
    with zipfile.ZipFile(fmu) as archive, zipfile.ZipFile(slipped, "w") as target:
        for name in archive.namelist():
            data = archive.read(name)
            if name == "modelDescription.xml":
                data = data.replace(b'variability="tunable"', b"")
                data = data.replace(b'variability="fixed"', b"")
            target.writestr(name, data)
    assert any("cannot be continuous" in remark for remark in describe_fmu(slipped).remarks)
    results = [
        simulate(System(slaves={"wheel": {"model": str(path)}}), stop_time=0.1, in_process=True)
        for path in (fmu, slipped)
    ]
    assert np.array_equal(results[0].outputs, results[1].outputs)
    assert any("cannot be continuous" in record.getMessage() for record in caplog.records)
