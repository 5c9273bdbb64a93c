"""The same cell in PyBaMM (V. Sulzer et al., J. Open Res. Softw. 9 (2021) 14), with its solver IDAKLU."""

import time
from typing import Any

import numpy as np


def solve(
    tolerance: float, ts: np.ndarray, last: float, derivatives: bool = False
) -> tuple[Any, ...]:
    """Return voltages at the times `ts`, the time of the cut-off, seconds of a second solve, and the derivatives of the
    voltages by the logarithms of the diffusivities in the negative and the positive particles, if asked for."""
    import pybamm

    pybamm.set_logging_level("ERROR")
    pybamm.settings.tolerances["reg_power"] = 1e-12  # square roots are smoothed by this
    parameters = pybamm.ParameterValues("Chen2020")
    names = [f"{side} particle diffusivity [m2.s-1]" for side in ("Negative", "Positive")]
    values = [parameters[name] for name in names]
    inputs = {}
    if derivatives:
        parameters.update({name: "[input]" for name in names})
        inputs = dict(zip(names, values, strict=True))
    solver = pybamm.IDAKLUSolver(rtol=tolerance, atol=tolerance, output_variables=["Voltage [V]"])
    simulation = pybamm.Simulation(
        pybamm.lithium_ion.DFN(), parameter_values=parameters, solver=solver
    )
    run = lambda: simulation.solve(
        [0, last], t_interp=ts, inputs=inputs, calculate_sensitivities=derivatives
    )
    run()
    begin = time.perf_counter()
    solution = run()
    seconds = time.perf_counter() - begin
    voltage = solution["Voltage [V]"]
    slopes = None
    if derivatives:
        slopes = np.stack(
            [
                np.asarray(voltage.sensitivities[name]).ravel()[: ts.size] * value
                for name, value in inputs.items()
            ],
            axis=1,
        )
    return voltage.entries[: ts.size], float(solution.t[-1]), seconds, slopes
