"""The pendulum and its gradient in a process of their own: `solve`, `export FILE` or `load FILE`.

Prints the value, the gradient, seconds after the imports, and how many programs came from JAX's
cache on the disk and how many did not.
"""

import collections
import json
import sys
import time

import jax


jax.config.update("jax_enable_x64", True)
events = collections.Counter()
jax.monitoring.register_event_listener(lambda event, **kwargs: events.update([event]))


def program():
    import diffrax as dfx

    import manifold_jax as mj

    problem = mj.problems.pendulum()

    def end(gravity):
        sol = mj.diffeqsolve(
            problem.terms,
            mj.Projected(dfx.Tsit5(), problem.constraint),
            problem.t0,
            problem.t1,
            None,
            problem.y0,
            problem.args._replace(gravity=gravity),
            stepsize_controller=dfx.PIDController(rtol=1e-8, atol=1e-8),
            adjoint=mj.StepReplayAdjoint(),
            throw=False,
        )
        return sol.ys[0][-1, 0], sol.result == dfx.RESULTS.successful

    return jax.jit(lambda g: (end(g), jax.grad(end, has_aux=True)(g)[0]))


def main(task, file=None):
    if task == "load":
        start = time.perf_counter()
        with open(file, "rb") as stream:
            solve = jax.jit(jax.export.deserialize(bytearray(stream.read())).call)
    else:
        solve = program()
        start = time.perf_counter()
    if task == "export":
        exported = jax.export.export(solve)(jax.ShapeDtypeStruct((), "float64"))
        with open(file, "wb") as stream:
            stream.write(exported.serialize())
        return
    (value, success), gradient = jax.block_until_ready(solve(jax.numpy.asarray(9.81)))
    result = dict(value=float(value), success=bool(success), gradient=float(gradient))
    result["seconds"] = time.perf_counter() - start
    for name in ("cache_hits", "cache_misses"):
        result[name] = events[f"/jax/compilation_cache/{name}"]
    print(json.dumps(result))


if __name__ == "__main__":
    main(*sys.argv[1:])
