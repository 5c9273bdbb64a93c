"""The Doyle-Fuller-Newman model of a lithium-ion cell, in finite volumes.

M. Doyle, T. F. Fuller and J. Newman, J. Electrochem. Soc. 140 (1993) 1526, with the parameters that C.-H. Chen et al.,
J. Electrochem. Soc. 167 (2020) 080534, have measured on an LG M50, and the electrolyte of A. Nyman et al.,
Electrochim. Acta 53 (2008) 6356. At constant temperature; in m, s, mol, V, A.

Lithium diffuses in a spherical particle at each point of both electrodes and in the electrolyte; currents in the
solids and in the electrolyte follow algebraic equations.
"""

import dataclasses
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from scipy import constants

import manifold_jax as mj


FARADAY = constants.physical_constants["Faraday constant"][0]
TEMPERATURE = 298.15
THERMAL_VOLTAGE = constants.R * TEMPERATURE / FARADAY
SALT = 1000.0  # mol/m^3, the unit of concentrations in the electrolyte
AREA = 0.065 * 1.58
CAPACITY = 5.0  # A h
CUT_OFF = 2.5
SEPARATOR_THICKNESS, SEPARATOR_POROSITY = 1.2e-5, 0.47
BRUGGEMAN = 1.5


class Electrode(NamedTuple):
    """Parameters of an electrode. `reaction` is the rate constant `m` of the exchange current
    `m sqrt(c_e c_s (c_max - c_s))`, `initial` a concentration in the particles."""

    thickness: Any
    porosity: Any
    solid: Any
    conductivity: Any
    radius: Any
    diffusivity: Any
    maximum: Any
    initial: Any
    reaction: Any


NEGATIVE = Electrode(8.52e-5, 0.25, 0.75, 215.0, 5.86e-6, 3.3e-14, 33133.0, 29866.0, 6.48e-7)
POSITIVE = Electrode(7.56e-5, 0.335, 0.665, 0.18, 5.22e-6, 4e-15, 63104.0, 17038.0, 3.42e-6)


class Parameters(NamedTuple):
    negative: Electrode = NEGATIVE
    positive: Electrode = POSITIVE
    transference: Any = 0.2594
    current: Any = CAPACITY


def graphite_potential(x: Any) -> Any:
    return (
        1.9793 * jnp.exp(-39.3631 * x)
        + 0.2482
        - 0.0909 * jnp.tanh(29.8538 * (x - 0.1234))
        - 0.04478 * jnp.tanh(14.9159 * (x - 0.2769))
        - 0.0205 * jnp.tanh(30.4444 * (x - 0.6103))
    )


def nmc_potential(x: Any) -> Any:
    return (
        -0.8090 * x
        + 4.4875
        - 0.0428 * jnp.tanh(18.5138 * (x - 0.5542))
        - 17.7326 * jnp.tanh(15.7890 * (x - 0.3117))
        + 17.5842 * jnp.tanh(15.9308 * (x - 0.3120))
    )


def salt_diffusivity(c: Any) -> Any:
    return 8.794e-11 * c**2 - 3.972e-10 * c + 4.862e-10


def salt_conductivity(c: Any) -> Any:
    return 0.1297 * c**3 - 2.51 * c**1.5 + 3.329 * c


@dataclasses.dataclass(frozen=True)
class Cell:
    """Numbers of finite volumes: in the negative electrode, separator and positive electrode, and in each particle.

    The state is a dictionary. `negative` and `positive`: how full the particles are, 0 to 1, of shape
    (points of the electrode, shells); `salt` in `SALT`; and the potentials, `solid` in both electrodes and
    `electrolyte`.
    """

    points: tuple[int, int, int] = (20, 20, 20)
    shells: int = 20

    @property
    def mass(self) -> dict[str, np.ndarray]:
        """One where there is a derivative."""
        n, s, p = self.points
        zeros = {"solid": np.zeros(n + p), "electrolyte": np.zeros(n + s + p)}
        particles = {"negative": np.ones((n, self.shells)), "positive": np.ones((p, self.shells))}
        return {**particles, "salt": np.ones(n + s + p), **zeros}

    @property
    def term(self) -> mj.MassMatrixTerm:
        return mj.MassMatrixTerm(self.rates, self.mass)

    def start(self, parameters: Parameters) -> dict[str, Any]:
        """Return a cell at rest; the potentials are a guess for a current."""
        n, s, p = self.points
        negative, positive = parameters.negative, parameters.positive
        x, y = negative.initial / negative.maximum, positive.initial / positive.maximum
        at_rest = graphite_potential(x)
        solid = [jnp.zeros(n), jnp.full(p, nmc_potential(y) - at_rest)]
        return {
            "negative": jnp.full((n, self.shells), x),
            "positive": jnp.full((p, self.shells), y),
            "salt": jnp.ones(n + s + p),
            "solid": jnp.concatenate(solid),
            "electrolyte": jnp.full(n + s + p, -at_rest),
        }

    def voltage(self, state: Any) -> Any:
        """Return the potential at the end of the positive electrode, extrapolated from two points."""
        return 1.5 * state["solid"][-1] - 0.5 * state["solid"][-2]

    def rates(self, t: Any, state: Any, parameters: Parameters) -> dict[str, Any]:
        del t
        n, s, _ = self.points
        density = parameters.current / AREA
        salt, solid, electrolyte = state["salt"], state["solid"], state["electrolyte"]
        sides = (
            (parameters.negative, state["negative"], slice(0, n), slice(0, n), graphite_potential),
            (
                parameters.positive,
                state["positive"],
                slice(n + s, None),
                slice(n, None),
                nmc_potential,
            ),
        )
        particles, sources = [], []
        for electrode, full, there, here, potential in sides:
            over = solid[here] - electrolyte[there]
            rate, source = self.particles(electrode, full, salt[there], over, potential)
            particles.append(rate)
            sources.append(source)
        source = jnp.concatenate([sources[0], jnp.zeros(s), sources[1]])
        salt_rate, ionic = self.electrolyte(parameters, salt, electrolyte, source)
        inner = self.solid_current(parameters.negative, solid[:n], density, left=True)
        outer = self.solid_current(parameters.positive, solid[n:], density, left=False)
        return {
            "negative": particles[0],
            "positive": particles[1],
            "salt": salt_rate,
            "solid": jnp.concatenate([inner + sources[0], outer + sources[1]])
            / density
            * parameters.negative.thickness,
            "electrolyte": (ionic - source) / density * parameters.negative.thickness,
        }

    def particles(
        self, electrode: Electrode, full: Any, salt: Any, over: Any, potential: Any
    ) -> tuple[Any, Any]:
        """Return the rates in the particles, and the current into the electrolyte per volume."""
        edges = np.linspace(0.0, 1.0, self.shells + 1)
        volumes = np.diff(edges**3) / 3
        surface = 1.5 * full[:, -1] - 0.5 * full[:, -2]
        exchange = (
            electrode.reaction * electrode.maximum * jnp.sqrt(SALT * salt * surface * (1 - surface))
        )
        current = 2 * exchange * jnp.sinh((over - potential(surface)) / (2 * THERMAL_VOLTAGE))
        inside = jnp.diff(full, axis=1) * self.shells * edges[1:-1] ** 2
        time_constant = electrode.radius**2 / electrode.diffusivity
        outflow = current * electrode.radius / (FARADAY * electrode.maximum * electrode.diffusivity)
        flux = jnp.concatenate([jnp.zeros_like(inside[:, :1]), inside, -outflow[:, None]], axis=1)
        rate = jnp.diff(flux, axis=1) / volumes / time_constant
        return rate, 3 * electrode.solid / electrode.radius * current

    def electrolyte(
        self, parameters: Parameters, salt: Any, potential: Any, source: Any
    ) -> tuple[Any, Any]:
        """Return the rates of the salt and the divergence of the current."""
        n, s, p = self.points
        negative, positive = parameters.negative, parameters.positive
        of_points = lambda values: jnp.concatenate(
            [jnp.full(k, v) for k, v in zip(self.points, values, strict=True)]
        )
        width = of_points([negative.thickness / n, SEPARATOR_THICKNESS / s, positive.thickness / p])
        porosity = of_points([negative.porosity, SEPARATOR_POROSITY, positive.porosity])
        transport = porosity**BRUGGEMAN
        distance = (width[1:] + width[:-1]) / 2
        share = width[:-1] / (width[1:] + width[:-1])  # of the left point in the distance
        mean = lambda v: (1 - share) * v[:-1] + share * v[1:]
        harmonic = lambda v: 1 / (share / v[:-1] + (1 - share) / v[1:])
        gradient = lambda v: jnp.diff(v) / distance
        closed = lambda flux: jnp.diff(jnp.concatenate([jnp.zeros(1), flux, jnp.zeros(1)])) / width
        diffusion = 2 * (1 - parameters.transference) * THERMAL_VOLTAGE
        drive = harmonic(diffusion / salt) * gradient(salt) - gradient(potential)
        current = mean(salt_conductivity(salt) * transport) * drive
        flux = -harmonic(transport * salt_diffusivity(salt)) * gradient(salt)
        flux += parameters.transference / (FARADAY * SALT) * current
        rate = (source / (FARADAY * SALT) - closed(flux)) / porosity
        return rate, closed(current)

    def solid_current(self, electrode: Electrode, potential: Any, density: Any, left: bool) -> Any:
        """Return the divergence of the current in a solid, which is zero at the separator."""
        width = electrode.thickness / potential.size
        inside = -electrode.conductivity * jnp.diff(potential) / width
        if left:
            first = -electrode.conductivity * potential[:1] / (width / 2)
            ends = (first, jnp.zeros(1))
        else:
            ends = (jnp.zeros(1), jnp.reshape(density, 1))
        return jnp.diff(jnp.concatenate([ends[0], inside, ends[1]])) / width
