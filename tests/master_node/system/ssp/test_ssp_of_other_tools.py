"""SSP: packages in the layouts that other tools write, from the prompt to the results."""

from __future__ import annotations

import zipfile
from pathlib import Path

import pytest

from master_node import load_system
from tests.support.quarter_car_case import EXAMPLES
from tests.support.ssp_documents import invoke

OMSIMULATOR = """<?xml version="1.0" encoding="UTF-8"?>
<ssd:SystemStructureDescription
  xmlns:ssc="http://ssp-standard.org/SSP1/SystemStructureCommon"
  xmlns:ssd="http://ssp-standard.org/SSP1/SystemStructureDescription"
  xmlns:ssv="http://ssp-standard.org/SSP1/SystemStructureParameterValues"
  xmlns:ssm="http://ssp-standard.org/SSP1/SystemStructureParameterMapping"
  xmlns:ssb="http://ssp-standard.org/SSP1/SystemStructureSignalDictionary"
  xmlns:oms="https://raw.githubusercontent.com/OpenModelica/OMSimulator/master/schema/oms.xsd"
  name="car"
  version="1.0">
  <ssd:System
    name="root">
    <ssd:Connectors />
    <ssd:ParameterBindings>
      <ssd:ParameterBinding
        source="resources/root.ssv">
        <ssd:ParameterMapping
          source="resources/root.ssm" />
      </ssd:ParameterBinding>
    </ssd:ParameterBindings>
    <ssd:Elements>
      <ssd:System
        name="axle">
        <ssd:Connectors>
          {axle}
        </ssd:Connectors>
        <ssd:Elements>
          <ssd:Component
            name="wheel"
            type="application/x-fmu-sharedlibrary"
            source="resources/0001_wheel.fmu">
            <ssd:Connectors>
              {wheel}
            </ssd:Connectors>
            <ssd:ElementGeometry x1="-10.0" y1="-10.0" x2="10.0" y2="10.0" />
            <ssd:ParameterBindings>
              <ssd:ParameterBinding
                source="resources/wheel.ssv" />
            </ssd:ParameterBindings>
          </ssd:Component>
        </ssd:Elements>
        <ssd:Connections>
          {inner}
        </ssd:Connections>
        <ssd:Annotations>
          <ssc:Annotation
            type="org.openmodelica">
            <oms:Annotations>
              <oms:SimulationInformation>
                <oms:VariableStepSolver
                  description="cvode"
                  absoluteTolerance="0.0001"
                  relativeTolerance="0.0001"
                  minimumStepSize="1e-12"
                  maximumStepSize="0.001"
                  initialStepSize="1e-06" />
              </oms:SimulationInformation>
            </oms:Annotations>
          </ssc:Annotation>
        </ssd:Annotations>
      </ssd:System>
      <ssd:Component
        name="chassis"
        type="application/x-fmu-sharedlibrary"
        source="resources/0002_chassis.fmu">
        <ssd:Connectors>
          {chassis}
        </ssd:Connectors>
      </ssd:Component>
    </ssd:Elements>
    <ssd:Connections>
      {outer}
    </ssd:Connections>
    <ssd:Annotations>
      <ssc:Annotation
        type="org.openmodelica">
        <oms:Annotations>
          <oms:SimulationInformation>
            <oms:FixedStepMaster
              description="oms-ma"
              stepSize="0.001000"
              absoluteTolerance="0.000100"
              relativeTolerance="0.000100" />
          </oms:SimulationInformation>
          <oms:ElementGeometry
            sizeX="200"
            sizeY="200" />
        </oms:Annotations>
      </ssc:Annotation>
    </ssd:Annotations>
  </ssd:System>
  <ssd:Units>
    <ssc:Unit
      name="m">
      <ssc:BaseUnit
        m="1" />
    </ssc:Unit>
  </ssd:Units>
  <ssd:DefaultExperiment
    startTime="0.000000"
    stopTime="0.500000">
    <ssd:Annotations>
      <ssc:Annotation
        type="org.openmodelica">
        <oms:Annotations>
          <oms:SimulationInformation
            resultFile="car_res.mat"
            loggingInterval="0.000000"
            bufferSize="10"
            signalFilter="resources/signalFilter.xml" />
        </oms:Annotations>
      </ssc:Annotation>
    </ssd:Annotations>
  </ssd:DefaultExperiment>
</ssd:SystemStructureDescription>
"""

SSV = """<?xml version="1.0" encoding="UTF-8"?>
<ssv:ParameterSet
  xmlns:ssc="http://ssp-standard.org/SSP1/SystemStructureCommon"
  xmlns:ssv="http://ssp-standard.org/SSP1/SystemStructureParameterValues"
  version="1.0"
  name="parameters">
  <ssv:Parameters>
    <ssv:Parameter
      name="{name}">
      <ssv:Real
        value="{value}"
        unit="{unit}" />
    </ssv:Parameter>
  </ssv:Parameters>
  <ssv:Units>
    <ssc:Unit
      name="{unit}">
      <ssc:BaseUnit
        {base} />
    </ssc:Unit>
  </ssv:Units>
</ssv:ParameterSet>
"""

SSM = """<?xml version="1.0" encoding="UTF-8"?>
<ssm:ParameterMapping
  xmlns:ssc="http://ssp-standard.org/SSP1/SystemStructureCommon"
  xmlns:ssm="http://ssp-standard.org/SSP1/SystemStructureParameterMapping"
  version="1.0">
  <ssm:MappingEntry
    source="road_height"
    target="axle.wheel.z" />
</ssm:ParameterMapping>
"""


def connectors(**kinds: str) -> str:
    """Connectors as OMSimulator writes them."""
    return "".join(
        f'<ssd:Connector name="{name}" kind="{kind}"><ssc:Real{unit} />'
        '<ssd:ConnectorGeometry x="0.000000" y="0.500000" /></ssd:Connector>'
        for name, kind in kinds.items()
        for unit in (' unit="m"' if name.startswith("x") else "",)
    )


def connections(*pairs: str) -> str:
    """Connections between ``element.connector``, with a connector alone for one of the system."""
    texts = []
    for pair in pairs:
        ends = ""
        for which, reference in zip(("start", "end"), pair.split(), strict=True):
            element, _, name = reference.rpartition(".")
            ends += f' {which}Element="{element}"' if element else ""
            ends += f' {which}Connector="{name}"'
        texts.append(
            f'<ssd:Connection{ends}><ssd:ConnectionGeometry pointsX="0.0 1.0" pointsY="2.0 3.0" />'
            "</ssd:Connection>"
        )
    return "".join(texts)


@pytest.fixture
def package(tmp_path: Path, fmu_dir: Path) -> Path:
    """The quarter car as OMSimulator exports a system."""
    signals = {"x_c": "input", "v_c": "input", "x": "output", "v": "output"}
    text = OMSIMULATOR.format(
        axle=connectors(**signals),
        wheel=connectors(**signals, z="parameter"),
        chassis=connectors(x_w="input", v_w="input", x="output", v="output"),
        inner=connections("x_c wheel.x_c", "v_c wheel.v_c", "wheel.x x", "wheel.v v"),
        outer=connections(
            "chassis.x axle.x_c", "chassis.v axle.v_c", "axle.x chassis.x_w", "axle.v chassis.v_w"
        ),
    )
    path = tmp_path / "car.ssp"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("SystemStructure.ssd", text)
        archive.write(fmu_dir / "wheel.fmu", "resources/0001_wheel.fmu")
        archive.write(fmu_dir / "chassis.fmu", "resources/0002_chassis.fmu")
        road = SSV.format(name="road_height", value="10", unit="cm", base='m="1" factor="0.01"')
        archive.writestr("resources/root.ssv", road)
        archive.writestr("resources/root.ssm", SSM)
        mass = SSV.format(name="m", value="40000", unit="g", base='kg="1" factor="0.001"')
        archive.writestr("resources/wheel.ssv", mass)
        archive.writestr("resources/signalFilter.xml", '<?xml version="1.0"?><oms/>')
    return path


def test_a_package_of_omsimulator_runs(package: Path, fmu_dir: Path, tmp_path: Path) -> None:
    """To the results of the same system in TOML; one sentence names what is not carried.

    Geometry and settings of a solver are left out, units of parameters and the mapping are not.
    """
    arguments = ("--in-process", "--quiet", "--no-plot", "--output")
    told = invoke("run", package, *arguments, tmp_path / "ssp")
    assert "not carried, as it has no influence here: annotation org.openmodelica (3" in told
    assert told.count("not carried") == 1
    invoke("import", package, "--output", tmp_path / "car.toml")
    invoke("run", tmp_path / "car.toml", *arguments, tmp_path / "toml")
    results = [(tmp_path / name / "results.csv").read_bytes() for name in ("ssp", "toml")]
    assert results[0] == results[1]
    imported = load_system(tmp_path / "car.toml")
    assert imported.slaves["axle.wheel"].parameters == pytest.approx({"m": 40.0, "z": 0.1})
    assert (imported.simulation.start_time, imported.simulation.stop_time) == (0.0, 0.5)
    direct = load_system(EXAMPLES / "displacement.toml")
    names = {(c.source, c.target) for c in imported.connections}
    assert {tuple(n.replace("axle.", "") for n in pair) for pair in names} == {
        (c.source, c.target) for c in direct.connections
    }
