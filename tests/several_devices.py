"""Ensembles on two devices; run by `test_several_devices.py` in a process that has them."""

import importlib
import re

import diffrax as dfx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
import pytest
from jax.sharding import Mesh, PartitionSpec

import manifold_jax as mj


PID = dfx.PIDController(rtol=1e-6, atol=1e-6)
CIRCLE = mj.Projected(dfx.Bosh3(), mj.Constraint(lambda t, y, args: y @ y - 1))
TURN = dfx.ODETerm(lambda t, y, args: (args[0] + args[1] @ y) * jnp.stack([-y[1], y[0]]))
ANGLES = np.linspace(0.1, 2.9, 7)
STARTS = jnp.asarray(np.stack([np.cos(ANGLES), np.sin(ANGLES)], 1))
RATES = jnp.linspace(0.5, 3.0, 7)
SHIFT = jnp.array([0.2, -0.3])
COLLECTIVE = re.compile(r" ((?:all|collective|reduce-scatter|ragged)[\w-]*)\(")


@pytest.fixture(scope="module")
def devices():
    devices = np.array(jax.devices())
    assert devices.size == 2
    return devices


def solve(mesh, y=STARTS, rates=RATES, t1=1.0, dt0=None, solver=CIRCLE, **options):
    args, args_axes = (rates, SHIFT), (0 if rates.ndim else None, None)
    options = dict(stepsize_controller=PID, lanes=2) | options
    return mj.solve_ensemble(
        TURN, solver, 0.0, t1, dt0, y, args, args_axes=args_axes, mesh=mesh, **options
    )


def test_each_is_what_it_is_on_one_device(devices):
    """Seven trajectories on two devices, two axes of a mesh, in order; one that fails."""
    saveat = dfx.SaveAt(t0=True, ts=jnp.array([0.25, 0.5]), t1=True)
    starts = STARTS.at[5].set(jnp.nan)
    t1s = jnp.linspace(0.5, 2.0, 7)
    one, two = (
        solve(mesh, starts, t1=t1s, saveat=saveat)
        for mesh in (None, Mesh(devices[:, None], ("x", "y")))
    )
    assert two.ys.shape == (7, 4, 2)
    jtu.tree_map(lambda a, b: np.testing.assert_allclose(a, b, rtol=0, atol=1e-13), one, two)
    assert [number for number, _ in two.failures()] == [5]
    assert one.failures() == two.failures()
    with pytest.raises(RuntimeError, match="`y0` has numbers that are NaN or infinite"):
        solve(Mesh(devices, "x"), starts, throw=True)


def test_gradient_with_one_sum(devices):
    """With respect to what all have in common, two arrays, and to what each has of its own."""

    def loss(values, mesh):
        rate, shift, starts = values
        sol = mj.solve_ensemble(
            TURN,
            CIRCLE,
            0.0,
            1.0,
            None,
            starts,
            (rate, shift),
            args_axes=None,
            stepsize_controller=PID,
            lanes=2,
            mesh=mesh,
        )
        return jnp.sum(sol.ys[..., 0] ** 2)

    gradient = jax.jit(jax.grad(loss), static_argnums=1)
    # Its axes are explicit, those of `Mesh` are not.
    mesh, values = jax.make_mesh((2,), ("x",)), (RATES[4], SHIFT, STARTS[:6])
    program = gradient.lower(values, mesh).compile()
    everywhere, in_loops = collectives(program.as_text())
    assert everywhere == ["all-reduce"]
    assert in_loops == []
    two = program(values)
    assert two[2].sharding.spec == jax.sharding.PartitionSpec("x")
    for a, b in zip(gradient(values, None), two):
        np.testing.assert_allclose(a, b, rtol=0, atol=1e-11)
        assert np.abs(a).max() > 1e-2


def test_too_many_operations_take_the_ordinary_way_on_each(devices, monkeypatch):
    module = importlib.import_module("manifold_jax._ensemble.lanes.in_lanes")
    monkeypatch.setattr(module, "_LONGEST", 100)
    one, two = (solve(mesh, STARTS[:3], RATES[:3], lanes=3) for mesh in (None, Mesh(devices, "x")))
    jtu.tree_map(lambda a, b: np.testing.assert_allclose(a, b, rtol=0, atol=1e-13), one, two)


def collectives(program):
    """Names of the operations between devices of a program's text: all, and those in loops."""
    blocks = {}
    for line in program.splitlines():
        if head := re.match(r"(?:ENTRY )?%?([\w.-]+) .*{$", line):
            block = blocks.setdefault(head[1], [])
        elif line.startswith(" "):
            block.append(line)

    def called(lines, names):
        return re.findall(rf"(?:{names})=%?([\w.-]+)", "\n".join(lines))

    loops, inside = [x for b in blocks.values() for x in called(b, "body|condition")], set()
    assert loops
    while loops:
        name = loops.pop()
        if name not in inside:
            inside.add(name)
            loops += called(blocks[name], "body|condition|to_apply|calls|\\w+_computation")
    found = {name: COLLECTIVE.findall("\n".join(lines)) for name, lines in blocks.items()}
    listed = lambda names: [x for name in names for x in found[name]]
    return listed(found), listed(inside)


HOOKS = {
    "none": dfx.Tsit5(),
    "projected": mj.Projected(dfx.Tsit5(), CIRCLE.constraint),
    "local": mj.LocalCoordinates(dfx.Tsit5(), CIRCLE.constraint),
}


@pytest.mark.parametrize("name", HOOKS)
def test_solves_in_mapped_functions(devices, name):
    """`jax.pmap` and `jax.shard_map` with what is not mapped beside what is: start and times."""

    def end(rate):
        saveat = dfx.SaveAt(ts=jnp.array([0.3, 1.0]))
        args = rate, SHIFT
        sol = mj.diffeqsolve(TURN, HOOKS[name], 0.0, 1.0, 0.1, start, args, saveat=saveat)
        return jnp.sum(sol.ys[:, 0])

    start, rates, both = STARTS[0], RATES[:2], jax.value_and_grad(end)
    single = [*map(jax.jit(both), rates)]
    spec = PartitionSpec("x")
    sharded = jax.shard_map(
        jax.vmap(both), mesh=Mesh(devices, ("x",)), in_specs=spec, out_specs=spec, check_vma=False
    )
    for values, slopes in (jax.pmap(both)(rates), jax.jit(sharded)(rates)):
        np.testing.assert_allclose(values, [v for v, _ in single], rtol=1e-14)
        np.testing.assert_allclose(slopes, [s for _, s in single], rtol=1e-12)
