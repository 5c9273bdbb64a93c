"""One of two processes that solve an ensemble together: `PORT NUMBER`."""

import sys

import jax


def main(port, number):
    jax.config.update("jax_enable_x64", True)
    jax.config.update("jax_cpu_collectives_implementation", "gloo")
    jax.distributed.initialize(f"localhost:{port}", 2, number)
    import jax.numpy as jnp
    import numpy as np
    import pytest
    from jax.sharding import Mesh, PartitionSpec
    from several_devices import RATES, solve, STARTS

    mesh, own = Mesh(np.array(jax.devices()), "x"), slice(3 * number, 3 * number + 3)
    assert mesh.size == 2

    def mine(x):
        """The part of this process."""
        assert x.sharding.spec == PartitionSpec("x")
        (shard,) = x.addressable_shards
        assert shard.index[0] == own
        return shard.data

    # Each process knows of its own failures, by the number among all.
    one, two = solve(None), solve(mesh, STARTS[:6].at[4].set(jnp.nan), RATES[:6])
    others = np.array([[0, 1, 2], [3, 5]][number])
    np.testing.assert_allclose(mine(two.ys)[others - own.start], one.ys[others], rtol=0, atol=1e-13)
    assert [k for k, _ in two.failures()] == [[], [4]][number]
    # A number that does not divide is gathered.
    np.testing.assert_allclose(solve(mesh, throw=True).ys, one.ys, rtol=0, atol=1e-13)
    # Both raise, though only one has a trajectory that fails: the other would wait for ever.
    with pytest.raises(RuntimeError, match="`y0` has numbers that are NaN or infinite"):
        jax.block_until_ready(solve(mesh, STARTS.at[6].set(jnp.nan), throw=True))

    loss = lambda rate, starts, mesh: jnp.sum(solve(mesh, starts, rate).ys[..., 0] ** 2)
    gradient = jax.jit(jax.grad(loss, (0, 1)), static_argnums=2)
    values = RATES[4], STARTS[:6]
    (rate, starts), (common, each) = gradient(*values, None), gradient(*values, mesh)
    np.testing.assert_allclose(common, rate, rtol=0, atol=1e-11)
    np.testing.assert_allclose(mine(each), starts[own], rtol=0, atol=1e-11)
    assert abs(rate) > 1e-2


if __name__ == "__main__":
    main(sys.argv[1], int(sys.argv[2]))
