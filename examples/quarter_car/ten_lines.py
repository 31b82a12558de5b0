"""The quarter car in Python. Run it in the folder where the FMUs are."""

from master_node import System, simulate

slaves = {"chassis": {"model": "chassis.fmu"}, "wheel": {"model": "wheel.fmu"}}
to_wheel = [("chassis.x", "wheel.x_c"), ("chassis.v", "wheel.v_c")]
to_chassis = [("wheel.x", "chassis.x_w"), ("wheel.v", "chassis.v_w")]
result = simulate(System(slaves=slaves, connections=to_wheel + to_chassis), stop_time=4.0)
result.plot("quarter_car.png")
print(result.time, result["wheel.x"])
