"""A damper chosen by SciPy: each trial is a branch from one mark, and nothing is started again."""

from pathlib import Path

from scipy.optimize import minimize_scalar

from master_node import Session, load_system, open_run

SYSTEM = Path(__file__).parents[1] / "quarter_car" / "displacement_python.toml"
ROAD = 0.1


def main() -> tuple[float, float, float]:
    """The best damping [N.s/m], its cost [m² s], and that of the damper as it is."""
    with open_run(load_system(SYSTEM), in_process=True, stop_time=1.5) as run:
        run.until(0.05)
        mark = run.save()

        def cost(damping: float) -> float:
            run.restore(mark)
            run.set({"chassis.d": damping, "wheel.d_c": damping})
            return deviation(run)

        found = minimize_scalar(
            cost, bounds=(200.0, 5000.0), method="bounded", options={"xatol": 20}
        )
        return float(found.x), float(found.fun), cost(1000.0)


def deviation(run: Session) -> float:
    """Integral of the squared distance of the chassis from its rest to the end [m² s]."""
    total, before = 0.0, run.time
    for point in run:
        total += (float(point["chassis.x"]) - ROAD) ** 2 * (point.time - before)
        before = point.time
    return total


if __name__ == "__main__":
    damping, best, as_it_is = main()
    print(f"d = {damping:.0f} N.s/m: {best:.3g} m² s instead of {as_it_is:.3g}")
