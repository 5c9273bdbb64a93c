"""A net of water pipes.

Source of equations and end values: Mazzia & Magherini, Test Set for Initial Value Problem Solvers
(2008), problem `water`.
"""

import jax.numpy as jnp
import numpy as np

from .problem import BoardProblem


# From node, to node.
_PIPES = np.array(
    [
        (1, 2), (2, 3), (2, 6), (3, 4), (3, 5), (4, 5), (5, 10), (6, 5), (7, 4),
        (7, 8), (8, 5), (8, 10), (9, 8), (11, 9), (11, 12), (12, 7), (12, 8), (13, 11),
    ]
)  # fmt: skip
_WATER_FLOWS = [
    0.2298488296477430e-2,
    0.1188984650746585e-2,
    0.1109503645730845e-2,
    0.1589620100314825e-3,
    0.1030022640715102e-2,
    0.8710606306836165e-3,
    0.3243571480903489e-2,
    0.1109503645730845e-2,
    0.7120986206521341e-3,
    0.6414613963833099e-3,
    0.9416978549524347e-3,
    0.3403428519096511e-2,
    0.2397639310739395e-2,
    0.2397639310739395e-2,
    0.3348581430454180e-2,
    0.1353560017035444e-2,
    0.1995021413418736e-2,
    0.5746220741193575e-2,
]
# Of the nodes 1, 2, ..., 13.
_WATER_PRESSURES = [
    0.1111271078730254e6,
    0.1111269851929858e6,
    0.1111269255355337e6,
    0.1111269322658045e6,
    0.1111268591478108e6,
    0.1111269221703983e6,
    0.1111270121140691e6,
    0.1111270045592387e6,
    0.1111274419515807e6,
    0.1111255158881087e6,
    0.1111278793439227e6,
    0.1111270995171642e6,
    0.1111298338971779e6,
]


def water_tubes() -> BoardProblem:
    """Flows in 18 pipes, of which the friction is given by an implicit law, between 13 nodes of which
    two have a buffer: index 2."""
    viscosity, density, critical, length, roughness = 1.31e-6, 1e3, 2.3e3, 1e3, 2e-4
    area, buffer, gravity = np.pi / 4, 200.0, 9.8
    net = np.zeros((13, 18))
    net[_PIPES[:, 1] - 1, np.arange(18)] += 1
    net[_PIPES[:, 0] - 1, np.arange(18)] -= 1
    buffers = np.zeros(13)
    buffers[[4, 7]] = buffer / (density * gravity)

    def outside(t, demand):
        hours = t / 3600
        one_in = (1 - jnp.cos(jnp.exp(-hours) - 1)) / 200
        out = hours**2 * (3 * hours**2 - 92 * hours + 720) / 1e6
        flows = jnp.zeros(13).at[0].set(one_in).at[12].set(one_in * 200 / 80)
        return flows.at[9].set(-demand * out)

    def residual(t, x, xdot, args):
        flow, friction, pressure = x["flow"], x["friction"], x["pressure"]
        reynolds = jnp.abs(flow) / (viscosity * area)
        turbulent = reynolds > critical
        root = jnp.sqrt(friction)
        rough = 2 * roughness + 18.7 / (jnp.where(turbulent, reynolds, critical) * root)
        lost = friction * density * length * flow**2 / area**2
        smooth = 32 * viscosity * density * length * flow / area
        driving = -net.T @ pressure - jnp.where(turbulent, lost, smooth)
        return {
            "momentum": density * length / area * xdot["flow"] - driving,
            "friction": 1 / root - 1.74 + 2 * jnp.log10(rough),
            "balance": buffers * xdot["pressure"] - net @ flow - outside(t, args["demand"]),
        }

    start = {
        "flow": np.zeros(18),
        "friction": np.full(18, 0.47519404529185289807e-1),
        "pressure": np.full(13, 109800.0),
    }
    end = {"flow": _WATER_FLOWS, "pressure": _WATER_PRESSURES}
    return BoardProblem(
        residual,
        start,
        {"demand": 1.0},
        61200.0,
        end,
        "demand",
        rtol=1e-8,
        atol=1e-11,
        short=3600.0,
    )
