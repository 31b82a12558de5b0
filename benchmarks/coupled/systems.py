"""Coupled systems of FMUs that tools exported and public repositories hold."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

Value = float | bool

Table = tuple[tuple[float, ...], tuple[float, ...]]
"""Times [s] and values, joined by straight lines."""


@dataclass(frozen=True, slots=True)
class Slave:
    """One FMU of a system.

    Attributes:
        file: its name in its repository.
        sha256: the first eight hexadecimal digits of its hash; there are many files of one name.
        parameters: start values by variable name.
    """

    file: str
    sha256: str
    parameters: Mapping[str, Value] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class CoupledFmus:
    """A system.

    Attributes:
        repository: that the FMUs are from.
        slaves: by name.
        connections: source and target of each, ``slave.variable``.
        stop_time: [s].
        inputs: constants and tables by ``slave.variable``.
        points: values are compared at so many times and the start. By default a prime, so that
            few of them are events.
        jumps: times at which signals are known to jump; values are not compared there [s].
    """

    repository: str
    slaves: Mapping[str, Slave]
    connections: tuple[tuple[str, str], ...]
    stop_time: float
    inputs: Mapping[str, float | Table] = field(default_factory=dict)
    points: int = 97
    jumps: tuple[float, ...] = ()


_DUAL_MASS = tuple((f"system1.{name}", f"system2.{name}") for name in ("a1", "v1", "x1"))
_INTEGRATOR = (("part1.x1", "part2.x1"), ("part1.x2", "part2.x2"), ("part2.x3", "part3.x3"))
_SPRING_DAMPER = (("left.x1", "right.x1"), ("left.v1", "right.v1"), ("right.fk", "left.fk"))

SYSTEMS: Mapping[str, CoupledFmus] = {
    "predator and prey": CoupledFmus(
        "ghorwin/MasterSim",
        {"prey": Slave("Prey.fmu", "5138be1f"), "predator": Slave("Predator.fmu", "af479edc")},
        (("prey.x", "predator.x"), ("predator.y", "prey.y")),
        50.0,
    ),
    "switched integrator": CoupledFmus(
        "ghorwin/MasterSim",
        {
            "part1": Slave("Part1.fmu", "b850462e"),
            "part2": Slave("Part2.fmu", "fe3ebf11"),
            "part3": Slave("Part3.fmu", "8d1f3edc"),
        },
        (*_INTEGRATOR, ("part3.x4", "part2.x4")),
        4.0,
        points=64,
        jumps=(1.0, 2.0, 3.0, 4.0),
    ),
    "switched integrator of two tools": CoupledFmus(
        "ghorwin/MasterSim",
        {
            "part1": Slave("Part1.fmu", "47ba884f"),
            "part2": Slave("Part2.fmu", "c4e873b9"),
            "part3": Slave("Part3.fmu", "da69f280"),
        },
        (*_INTEGRATOR, ("part3._D_outputStateAlias_x4", "part2.x4")),
        4.0,
        points=64,
        jumps=(1.0, 2.0, 3.0, 4.0),
    ),
    "two masses": CoupledFmus(
        "OpenModelica/OMSimulator",
        {
            "system1": Slave("DualMassOscillator.System1.fmu", "b427fa45"),
            "system2": Slave("DualMassOscillator.System2.fmu", "5a1f19b2"),
        },
        (*_DUAL_MASS, ("system2.F", "system1.F")),
        1.0,
    ),
    "quarter car, displacements": CoupledFmus(
        "OpenModelica/OMSimulator",
        {
            "chassis": Slave("QuarterCarModel.DisplacementDisplacement.Chassis.fmu", "1aeef073"),
            "wheel": Slave("QuarterCarModel.DisplacementDisplacement.Wheel.fmu", "36433b30"),
        },
        (
            ("chassis.z_c", "wheel.z_c"),
            ("chassis.der_z_c", "wheel.der_z_c"),
            ("wheel.z_w", "chassis.z_w"),
            ("wheel.der_z_w", "chassis.der_z_w"),
        ),
        1.0,
        {"wheel.z": 0.1},
    ),
    "quarter car, force": CoupledFmus(
        "OpenModelica/OMSimulator",
        {
            "chassis": Slave("QuarterCarModel.DisplacementForce.Chassis.fmu", "e445f8b6"),
            "wheel": Slave("QuarterCarModel.DisplacementForce.Wheel.fmu", "71018bb3"),
        },
        (
            ("chassis.z_c", "wheel.z_c"),
            ("chassis.der_z_c", "wheel.der_z_c"),
            ("wheel.F", "chassis.F"),
        ),
        1.0,
        {"wheel.z": 0.1},
    ),
    "controlled mass": CoupledFmus(
        "INTO-CPS-Association/RabbitMQFMU_DistributedCosimDemo",
        {"controller": Slave("controller.fmu", "d11ea945"), "mass": Slave("msd.fmu", "720aa80f")},
        (("mass.x", "controller.x"), ("controller.fk", "mass.fk")),
        2.0,
    ),
    "springs and dampers": CoupledFmus(
        "INTO-CPS-Association/maestro",
        {
            "left": Slave("MassSpringDamper1.fmu", "23932dc3"),
            "right": Slave("MassSpringDamper2.fmu", "79246cbb"),
        },
        _SPRING_DAMPER,
        10.0,
    ),
    "springs and dampers, stabilised": CoupledFmus(
        "INTO-CPS-Association/maestro",
        {
            "left": Slave("MassSpringDamper1.fmu", "7ba37664"),
            "right": Slave("MassSpringDamper2.fmu", "2eb93832"),
        },
        _SPRING_DAMPER,
        10.0,
    ),
    "water tank": CoupledFmus(
        "INTO-CPS-Association/maestro",
        {
            "tank": Slave("singlewatertank-20sim.fmu", "92a2a2e7"),
            "controller": Slave("watertankcontroller-c.fmu", "e37e2368"),
        },
        (("tank.level", "controller.level"), ("controller.valve", "tank.valvecontrol")),
        16.0,
    ),
    "controlled drivetrain": CoupledFmus(
        "CATIA-Systems/FMPy",
        {
            "controller": Slave("Controller.fmu", "83c748e4"),
            "drivetrain": Slave("Drivetrain.fmu", "57da67ce"),
        },
        (("drivetrain.w", "controller.u_m"), ("controller.y", "drivetrain.tau")),
        2.0,
        {"controller.u_s": ((0.0, 0.5, 2.0), (0.0, 1.0, 1.0))},
        points=100,
    ),
    "dc motor": CoupledFmus(
        "OpenModelica/OMSimulator",
        {
            "drive": Slave("edrive_mass.fmu", "11cea106"),
            "machine": Slave("emachine_model.fmu", "2d297455"),
            "stimuli": Slave("stimuli_model.fmu", "beee2c87"),
        },
        (
            ("drive.wA", "machine.w"),
            ("drive.phiA", "machine.phi"),
            ("stimuli.U", "machine.U"),
            ("machine.M", "drive.M_A"),
            ("stimuli.M_load", "drive.M_B"),
        ),
        1.0,
    ),
    "damped pendulum of two tools": CoupledFmus(
        "ThummeTo/FMIZoo.jl, OpenModelica/OMSimulator",
        {
            "pendulum": Slave("SpringPendulumExtForce1D.fmu", "519814c8"),
            "integrator": Slave("Modelica.Blocks.Continuous.Integrator.fmu", "3be2365b"),
            "feedback": Slave("Modelica.Blocks.Math.Feedback.fmu", "73ca7efd"),
        },
        (
            ("pendulum.v", "integrator.u"),
            ("integrator.y", "feedback.u2"),
            ("feedback.y", "pendulum.extForce"),
        ),
        2.0,
    ),
    "inverted pendulum": CoupledFmus(
        "matswj/Assignment_7",
        {
            "cart": Slave("Cart.fmu", "17503a40"),
            "controller": Slave("Controller.fmu", "7d315183"),
            "pendulum": Slave("Pendulum.fmu", "58a6114a"),
        },
        (
            ("pendulum.theta", "controller.theta"),
            ("pendulum.omega", "controller.omega"),
            ("cart.position", "controller.x"),
            ("cart.velocity", "controller.x_dot"),
            ("controller.force", "cart.force"),
            ("pendulum.Fpendulum", "cart.Fpendulum"),
        ),
        2.0,
    ),
    "heating tank": CoupledFmus(
        "ansys/example-data",
        {
            "tank": Slave("heatingTank.fmu", "f3cbab74"),
            "thermostat": Slave("thermostat.fmu", "4235c66f"),
        },
        (
            ("tank.Temperature", "thermostat.Temperature"),
            ("thermostat.Heat Rate", "tank.Heat Rate"),
        ),
        10.0,
    ),
    "quarter truck": CoupledFmus(
        "open-simulation-platform/libcosim",
        {
            "chassis": Slave("Chassis.fmu", "1305cb9e"),
            "wheel": Slave("Wheel.fmu", "8db731ed"),
        },
        (("chassis.velocity", "wheel.in_vel"), ("wheel.out_spring_damper_f", "chassis.force")),
        2.0,
    ),
    "knuckle boom crane": CoupledFmus(
        "open-simulation-platform/libcosim",
        {
            "controller": Slave("CraneController.fmu", "9357b7a8"),
            "crane": Slave("KnuckleBoomCrane.fmu", "6a3ae1c8"),
        },
        tuple((f"crane.p_Crane.f[{i}]", f"controller.p_Crane.f[{i}]") for i in (1, 2, 3))
        + tuple((f"controller.p_Crane.e[{i}]", f"crane.p_Crane.e[{i}]") for i in (1, 2, 3))
        + tuple((f"crane.Act_Limits[{i}]", f"controller.Act_Limits[{i}]") for i in (1, 2, 3)),
        1.0,
        {"controller.Cylinder1": 0.5, "controller.Motor": 0.5},
    ),
    "linear subsystems": CoupledFmus(
        "modelon-community/PyFMI",
        {
            "one": Slave("LinearCoSimulation_LinearSubSystem1.fmu", "993d3c14"),
            "two": Slave("LinearCoSimulation_LinearSubSystem2.fmu", "27b7ac70"),
        },
        (("one.y1", "two.u2"), ("two.y2", "one.u1")),
        1.0,
    ),
}
