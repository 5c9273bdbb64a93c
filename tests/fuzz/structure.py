"""What is drawn at random once per compiled program: a structure, reproducible from its index."""

import dataclasses
from typing import Any

import numpy as np

from .families import Family, Invariants, Quadrics, Reactions, Spheres
from .matrices import Frames, GROUPS, MatrixGroup
from .mechanics import Linkage, MASSES, Rolling


EXPLICIT = ("Tsit5", "Dopri5", "Dopri8", "Bosh3", "Heun", "Ralston", "Midpoint", "HalfSolver")
IMPLICIT = ("Kvaerno3", "Kvaerno5", "ImplicitEuler")
SPLIT = ("KenCarp3", "Sil3")
LOW_ORDER = ("Heun", "Ralston", "Midpoint", "HalfSolver", "ImplicitEuler", "Euler")
GIVEN_STEPS = ("constant", "step-to")
ADAPTIVE = ("pid", "pi", "limited", "clipped", "jumps", "jumps-storing")
OUTPUTS = ("t1", "ts", "ends", "steps", "fn", "dense", "subs", "event")
DIRECTIONS = ("forward", "backward", "mixed")
CORRECTED = ("projected", "error-metric", "weights", "exact-0", "tangent", "partition")
STABILIZED = ("invariant", "invariant-projected", "exact")
OF_MECHANICS = ("baumgarte", "velocity")
LAYOUTS = ("vector", "scalars", "nested", "matrix", "with-none")
FAILURES = ("none", "nan-field", "nan-start", "impossible", "dependent", "fast")
REVERSE = ("default", "few states", "direct")


@dataclasses.dataclass(frozen=True)
class Structure:
    """Everything that is fixed when a program is compiled.

    - `tolerance`: of adaptive steps and implicit stages; `steps` the number of given ones.
    - `failing`: what is wrong with one lane of the batch.
    - `offset`: starts are not on the manifold.
    - `own_field`: the field is made tangent by the library, not by the fuzz program.
    - `single`: one lane is solved alone, too; `reverse` names an adjoint to be compared with
        forward mode, or is `None`.
    """

    index: int
    seed: int
    family: Family
    layout: str
    residual_layout: str
    solver: str
    controller: str
    tolerance: float
    steps: int
    first_step: bool
    output: str
    direction: str
    approach: str
    failing: str
    own_field: bool
    offset: bool
    single: bool
    reverse: str | None

    @property
    def is_adaptive(self) -> bool:
        return self.controller in ADAPTIVE

    @property
    def is_corrected(self) -> bool:
        return self.approach in CORRECTED

    @property
    def jumps(self) -> bool:
        return self.controller.startswith("jumps")

    @property
    def spec(self) -> str:
        """One line."""
        fields = dataclasses.fields(self.family)
        shape = ", ".join(f"{f.name}={getattr(self.family, f.name)}" for f in fields)
        size = f"{self.tolerance:.0e}" if self.is_adaptive else f"{self.steps} steps"
        size += ", dt0" if self.is_adaptive and self.first_step else ""
        words = [
            f"{type(self.family).__name__}({shape})",
            f"{self.layout}/{self.residual_layout}" + (", tangent_field" if self.own_field else ""),
            self.solver,
            f"{self.controller} ({size})",
            self.output,
            self.direction,
            self.approach,
            f"lane: {self.failing}",
        ]
        words += ["starts off"] if self.offset else []
        words += ["single"] if self.single else []
        words += [f"gradient: {self.reverse}"] if self.reverse else []
        return " | ".join(words)


def structure(index: int, seed: int) -> Structure:
    rng = np.random.default_rng((seed, index))
    choose = lambda options: options[int(rng.integers(len(options)))]
    chance = lambda probability: bool(rng.random() < probability)
    family = _longer(_family(rng, choose, chance), np.random.default_rng((seed, index, 1)))
    approach = _approach(family, choose, chance)
    solver, controller = _method(family, approach, choose, chance)
    low, implicit = solver in LOW_ORDER, solver in IMPLICIT + SPLIT
    tolerances = (1e-3, 1e-4) if low else (1e-4, 1e-6) if implicit else (1e-4, 1e-6, 1e-8, 1e-10)
    if solver == "Bosh3":
        tolerances = (1e-4, 1e-6)
    if family.stiff:
        tolerances = (1e-6, 1e-8)
    # Diffrax's own function corrects steps, not what is between them.
    # In a stiff network levels are flat where events would be.
    outputs = OUTPUTS[:-1] if family.stiff else OUTPUTS
    output = choose(("t1", "steps") if approach == "steps-only" else outputs)
    reverse = choose(REVERSE[:2] if chance(0.9) else REVERSE) if chance(0.35) else None
    return Structure(
        index=index,
        seed=seed,
        family=family,
        layout=choose(LAYOUTS[:-1] if chance(0.8) else LAYOUTS) if family.n <= 12 else "vector",
        residual_layout=choose(("vector", "tuple")),
        solver=solver,
        controller=controller,
        tolerance=choose(tolerances),
        steps=int(rng.integers(40, 120)),
        first_step=chance(0.5),
        output=output,
        direction="forward" if family.stiff else choose(DIRECTIONS),
        approach=approach,
        failing=_failing(family, approach, controller in ADAPTIVE and not implicit, choose),
        offset=_may_start_off(family, approach) and chance(0.3),
        own_field=isinstance(family, Quadrics) and family.m < family.n and chance(0.3),
        single=chance(0.4),
        reverse=reverse,
    )


def _longer(family: Family, rng: np.random.Generator) -> Family:
    """Of some linkages one of 9 to 15 links: dense systems of that size are solved in another way."""
    if not isinstance(family, Linkage) or family.redundant or rng.random() > 0.2:
        return family
    parents = tuple(int(rng.integers(max(-1, i - 3), i)) for i in range(int(rng.integers(9, 16))))
    return dataclasses.replace(family, dimension=2, parents=parents)


def _family(rng: np.random.Generator, choose: Any, chance: Any) -> Family:
    kind = choose(("quadrics",) * 3 + ("matrices",) * 2 + ("invariants",) * 2 + ("mechanics",) * 4
                  + ("rolling", "reactions", "large"))  # fmt: skip
    if kind == "quadrics":
        n = int(rng.integers(1, 7))
        return Quadrics(n, int(rng.integers(1, n + 1)), chance(0.6))
    if kind == "matrices":
        if chance(0.3):
            return Frames(int(rng.integers(3, 6)), 2)
        return MatrixGroup(int(rng.integers(2, 5)), choose(GROUPS))
    if kind == "invariants":
        n = int(rng.integers(2, 7))
        return Invariants(n, n > 2 and chance(0.5))
    if kind == "mechanics":
        points = int(rng.integers(1, 5))
        parents = tuple(int(rng.integers(-1, i)) for i in range(points))
        return Linkage(choose(MASSES), choose((2, 3)), parents, chance(0.4), chance(0.15))
    if kind == "rolling":
        return Rolling(choose(MASSES), int(rng.integers(3, 6)), chance(0.3))
    if kind == "reactions":
        return Reactions(int(rng.integers(3, 6)))
    chain = tuple(range(-1, int(rng.integers(15, 32))))
    return choose((
        Frames(50, 4), Spheres(40, 5), Spheres(10, 4), Invariants(200, True),
        Linkage("scalar", 3, chain, chance(0.5), False), MatrixGroup(7, "orthogonal"),
    ))  # fmt: skip


def _approach(family: Family, choose: Any, chance: Any) -> str:
    if isinstance(family, Linkage) and family.redundant:
        return choose(("projected", "projected", "one-step", "invariant"))
    if chance(0.4):
        return "projected"
    options = (*CORRECTED, *STABILIZED, "one-step", "steps-only")
    holonomic = isinstance(family, Linkage) and not family.redundant
    return choose(options + OF_MECHANICS if holonomic else options)


def _method(family: Family, approach: str, choose: Any, chance: Any) -> tuple[str, str]:
    """The solver and the controller."""
    if family.stiff:
        return choose(("Kvaerno3", "Kvaerno5")), choose(ADAPTIVE[:4])
    if family.n > 50:  # explicit only: implicit ones need minutes to compile
        return choose(EXPLICIT[:4]), choose((*GIVEN_STEPS, *ADAPTIVE))
    controller = choose(GIVEN_STEPS) if chance(0.3) else choose(ADAPTIVE)
    splits = approach not in (*STABILIZED, *OF_MECHANICS, "exact-0")
    if chance(0.15):
        return choose(IMPLICIT), controller
    if splits and chance(0.08):
        return choose(SPLIT), controller
    if controller in GIVEN_STEPS and chance(0.1):
        return "Euler", controller
    return choose(EXPLICIT if chance(0.5) else EXPLICIT[:3]), controller


def _may_start_off(family: Family, approach: str) -> bool:
    """Whether NumPy knows to which point of the manifold the library will go."""
    simple = not (family.mechanical or family.conserves or family.stiff)
    return simple and approach not in ("error-metric", "weights", "steps-only")


def _failing(family: Family, approach: str, may_be_fast: bool, choose: Any) -> str:
    options = [kind for kind in FAILURES if kind != "fast" or may_be_fast]
    if approach in (*STABILIZED, *OF_MECHANICS, "exact-0") or family.conserves:
        # What is stabilized may end off the manifold; frozen invariants can always be satisfied.
        options = [kind for kind in options if kind not in ("impossible", "dependent")]
    return choose(options)
