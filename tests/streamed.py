"""A small ensemble on the disk; as a program, `FOLDER`, one whose process kills itself while the third
chunk is being written."""

import os
import signal
import sys

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
import zarr

import manifold_jax as mj


SIZE, CHUNK = 300, 64  # five chunks, the last of 44
BROKEN, FAST = 70, 200  # trajectories that fail
CIRCLE = mj.Constraint(lambda t, y, args: y[0] @ y[0] - args["radius"] ** 2)
TURN = dfx.ODETerm(lambda t, y, args: (args["rate"] * jnp.stack([-y[0][1], y[0][0]]),))
SOLVER = mj.Projected(dfx.Heun(), CIRCLE)
RADIUS = np.asarray(2.0)  # in double precision before that of JAX is set


def sample(index, key):
    angle = jax.random.uniform(key, minval=-3.0, maxval=3.0)
    y0 = 2 * jnp.stack([jnp.cos(angle), jnp.sin(angle)])
    rate = jnp.where(index == FAST, 1e5, 1 + index / SIZE)
    return (jnp.where(index == BROKEN, jnp.nan, y0),), {"rate": rate, "radius": RADIUS}


def end(index, key):
    return 1 + 0.5 * jax.random.uniform(jax.random.fold_in(key, 1))


def stream(out, size=SIZE, solver=SOLVER, **options):
    options = dict(
        dict(
            saveat=dfx.SaveAt(ts=jnp.array([0.25, 1.0]), t1=True),
            stepsize_controller=dfx.PIDController(rtol=1e-4, atol=1e-4),
            max_steps=500,
            lanes=16,
            chunk=CHUNK,
            seed=3,
            progress=False,
        )
        | options
    )
    sampled = options.pop("sample", sample)
    t1 = options.pop("t1", end)
    return mj.stream_ensemble(sampled, size, out, TURN, solver, 0.0, t1, None, **options)


def main(out):
    """Each chunk has ten arrays, and three of the third get there."""
    jax.config.update("jax_enable_x64", True)
    write = zarr.Array.__setitem__
    count = 0

    def killed(array, place, values):
        nonlocal count
        if count == 2 * 10 + 3:
            os.kill(os.getpid(), signal.SIGKILL)
        count += 1
        write(array, place, values)

    zarr.Array.__setitem__ = killed
    stream(out)


if __name__ == "__main__":
    main(sys.argv[1])
