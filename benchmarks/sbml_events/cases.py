"""Cases with events of the SBML semantic test suite, as functions of JAX.

`cases.json` holds their equations, which were written out once, and the published results.
"""

import json
from pathlib import Path
from typing import Any, NamedTuple

import diffrax as dfx
import jax.numpy as jnp
import numpy as np

import manifold_jax as mj


FUNCTIONS = {
    name: getattr(jnp, name)
    for name in (
        "abs exp log sqrt sin cos tan sinh cosh tanh arcsin arccos arctan arcsinh arccosh arctanh floor ceil "
        "minimum maximum where logical_and logical_or logical_xor logical_not inf nan"
    ).split()
}


def read():
    """Return the cases by their numbers."""
    path = Path(__file__).parent / "cases.json"
    return {case["number"]: case for case in json.loads(path.read_text())["cases"]}


class Case(NamedTuple):
    """An initial value problem with resets, and what is observed of it."""

    terms: Any
    solver: Any
    y0: Any
    args: Any
    resets: tuple
    observe: Any  # (t, y, args) -> values of the columns

    def solve(self, y0, args, ts, **options):
        """Return the solution, with the observed values at `ts`."""
        return mj.diffeqsolve(
            self.terms,
            self.solver,
            ts[0],
            ts[-1] * (1 + 1e-12),  # with the events at the last time
            None,
            y0,
            args,
            saveat=dfx.SaveAt(ts=ts, fn=self.observe),
            stepsize_controller=dfx.PIDController(rtol=1e-9, atol=1e-12),
            resets=self.resets,
            max_resets=250,
            throw=False,
            **options,
        )


def build(case):
    """Make functions from the expressions of a case."""
    states, unknowns = list(case["states"]), dict(case["algebraic"])
    code = lambda text: compile(text, "case", "eval")
    assigned = [(name, code(text)) for name, text in case["assignments"]]
    compiled = lambda texts: {name: code(text) for name, text in texts.items()}
    rates, outputs = compiled(case["rates"] | unknowns), compiled(case["outputs"])

    def values(t, y, args):
        names = {**FUNCTIONS, **args, **dict(zip(states, y, strict=True)), "time": t}
        for name, text in assigned:
            names[name] = eval(text, names)
        return names

    def vector(texts, names):
        number = lambda name: jnp.asarray(eval(texts[name], names), float)
        return jnp.stack([number(name) for name in texts])

    def field(t, y, args):
        names = values(t, y, args)
        return jnp.stack([jnp.asarray(eval(rates[name], names), float) for name in states])

    def observe(t, y, args):
        return vector(outputs, values(t, y, args))

    def resets_of(event):
        is_true = bool(eval(code(event["condition"]), values(jnp.zeros(()), y0, args)))
        fires = event["fires_at_start"] and is_true
        # What is true at the start is not an event, also where the number that says so is zero there.
        boolean = event["boolean"] or (is_true and not fires)
        trigger = code(event["condition"] if boolean else event["trigger"])
        new = compiled(event["assignments"])

        def condition(t, y, args):
            value = eval(trigger, values(t, y, args))
            return jnp.asarray(value, bool if boolean else float)

        def jump(t, y, args):
            names = values(t, y, args)
            put = {name: jnp.asarray(eval(text, names), float) for name, text in new.items()}
            return jnp.stack([put.get(name, old) for name, old in zip(states, y, strict=True)])

        reset = mj.Reset(condition, jump, direction=None if boolean else True)
        return [mj.ResetAt([0.0], jump), reset] if fires else [reset]

    y0 = jnp.asarray(list(case["states"].values()), float)
    args = {name: jnp.asarray(value, float) for name, value in case["parameters"].items()}
    term, solver = dfx.ODETerm(field), dfx.Tsit5()
    if unknowns:
        mass = np.diag([0.0 if name in unknowns else 1.0 for name in states])
        term, solver = mj.MassMatrixTerm(field, mass), mj.Rodas5P()
        y0, _ = term.consistent_state(0.0, y0, args)
    resets = tuple(reset for event in case["events"] for reset in resets_of(event))
    return Case(term, solver, y0, args, resets, observe)


def excess(case, ours):
    """Return the largest difference from the published values, in units of the tolerance of the suite."""
    expected = np.asarray(case["expected"], float)
    allowed = case["absolute"] + case["relative"] * np.abs(expected)
    same = (np.asarray(ours) == expected) | (np.isnan(ours) & np.isnan(expected))
    with np.errstate(invalid="ignore"):
        return float(np.max(np.where(same, 0.0, np.abs(ours - expected) / allowed)))
