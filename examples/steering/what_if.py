"""Stop a run, look, change, and branch: what if the spring were twice as hard from 1 s on?"""

from pathlib import Path

from master_node import Session, load_system, open_run

SYSTEM = Path(__file__).parents[1] / "quarter_car" / "displacement_python.toml"


def main() -> dict[str, float]:
    """Height of the chassis at 2 s [m], for each branch."""
    with open_run(load_system(SYSTEM), in_process=True, stop_time=2.0) as run:
        point = run.until(1.0)
        print(
            f"t = {run.time} s, H = {run.step_size:.3g} s, chassis.x = {point['chassis.x']:.4f} m"
        )
        mark = run.save()

        run.set({"chassis.k": 3e4, "wheel.k_c": 3e4})
        ends = {"harder": height(run)}

        run.restore(mark)
        run.override({"chassis.x_w": 0.0, "chassis.v_w": 0.0})
        run.until(1.5)
        run.release("chassis.x_w", "chassis.v_w")
        ends["half a second without the wheel"] = height(run)

        run.restore(mark)
        ends["as it is"] = height(run)
    print(run.result())
    return ends


def height(run: Session) -> float:
    """Height of the chassis at the end [m]."""
    return float(run.until(2.0)["chassis.x"])


if __name__ == "__main__":
    for name, x in main().items():
        print(f"{name}: {x:.4f} m")
