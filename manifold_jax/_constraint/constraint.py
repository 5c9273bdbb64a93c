"""The manifold `{y : g(t, y, args) = 0}`, and the correction of points onto it."""

import abc
from typing import ClassVar

import equinox as eqx
import jax
import jax.flatten_util as jfu
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, Float

from .._base.types import Args, BoolScalar, RealScalarLike, Residual, ResidualFunction, Y
from .._base.user_functions import check_function
from .._linalg.rows import multiply
from .._linalg.sparse import check_choice, Choice, choose_structure, Structure
from .correction import ConstraintNormals, equations_of, solve_correction, without_normal_part
from .projection_info import ProjectionInfo
from .residual import as_time, residual_vector
from .settings import NewtonProjection


class AbstractConstraint(eqx.Module):
    """A manifold given by `m` equations, `g(t, y, args) = 0`.

    Implementations have to provide `__call__`, the residual, and `redundant`, whether equations may
    depend on each other. The rest has defaults for any residual; a manifold with more structure
    overrides what it knows better: how a point is corrected (`correct`), the directions across the
    manifold (`normals`), the tangential part of a vector (`push_forward`), and the possible causes of a
    bad start (`faults`).

    All methods are traced: they take the state `y` (any pytree of real arrays, `n` numbers in all) of
    one trajectory, never a batch, and must work under `jax.jit` and `jax.vmap` (no Python branches on
    values) and be differentiable in both modes with respect to `y`, `t`, `args` and the module's own
    arrays. Times are true times also when integrating backwards.
    """

    redundant: eqx.AbstractVar[bool]

    @abc.abstractmethod
    def __call__(self, t: RealScalarLike, y: Y, args: Args = None) -> Residual:
        """Evaluate the residual.

        **Arguments:**

        - `t`: the time, true time also when integrating backwards.
        - `y`: the state, any pytree of real arrays, `n` numbers in all.
        - `args`: whatever is passed as `args` to `diffeqsolve`.

        **Returns:**

        Any pytree of real arrays, `m <= n` numbers in all, zero on the manifold.
        """

    def correct(
        self,
        projection: NewtonProjection,
        t: RealScalarLike,
        y: Y,
        args: Args = None,
        *,
        fallback: Y | None = None,
        far: bool = False,
        directions: Float[Array, "m k"] | None = None,
    ) -> tuple[Y, ProjectionInfo]:
        """Correct a point onto the manifold. By default to `p = y + V z`, with `z` the root of
        `g(t, y + V z, args) = 0` and `V` held at `y`.

        **Arguments:**

        - `projection`: the norm, the number of iterations and the tolerance.
        - `fallback`: a state at which `g` is finite, `y` by default. The derivative of a failed correction
            has to be taken there, finite: the zero cotangent of a rejected step must stay zero.
        - `far`: whether the point may be anywhere, instead of being the result of a small step.
        - `directions`: the rows of `V^T` to correct along, if not those at `y`, from `normals`.

        **Returns:**

        `(p, info)`: a point like `y`, and a report. Where `info.success` is false, `p` is `y`. A point
        that is on the manifold to rounding should stay as it is. The derivative must be that of the map
        from `(t, y, args)` to `p`, and to first order it must not move points along the manifold: the
        order of solvers and the error estimates rely on it.
        """
        fallback = y if fallback is None else fallback
        structure = self.structure_at(t, y, args) if directions is None else None
        equations = equations_of(
            self, t, y, args, projection, self.redundant, directions, structure
        )
        safe = jax.lax.stop_gradient(jfu.ravel_pytree(fallback)[0])
        root = solve_correction(equations, safe, projection, far)
        return jfu.ravel_pytree(y)[1](root.p), ProjectionInfo.of_correction(equations.x, root)

    def normals(
        self, projection: NewtonProjection, t: RealScalarLike, y: Y, args: Args = None
    ) -> ConstraintNormals:
        """Return the normals of the manifold at `y`: `G = dg/dy` and the rows of `V^T = G W^-1`, both
        `(m, k)`. `k` is `n`, unless components are moved together (positions and velocities)."""
        return equations_of(self, t, y, args, projection, self.redundant).normals()

    def structure_at(self, t: RealScalarLike, y: Y, args: Args = None) -> Structure | None:
        """Return the sparsity structure of `G = dg/dy` if it is not to be held as an array, for many
        equations of few unknowns each. Known while tracing."""
        del t, y, args
        return None

    def push_forward(
        self, t: RealScalarLike, y: Y, args: Args, directions: Float[Array, "m k"], vector: Y
    ) -> Y:
        """Apply the derivative of the correction along `directions`, at `y` on the manifold, to a
        vector: `e - V (G V)^-1 G e`."""
        equations = equations_of(self, t, y, args, NewtonProjection(), self.redundant, directions)
        e, unravel = jfu.ravel_pytree(vector)
        normals = equations.normals()
        return unravel(without_normal_part(normals, e, multiply(normals.jacobian, e)))

    def faults(
        self, t: RealScalarLike, y: Y, args: Args = None
    ) -> tuple[tuple[BoolScalar, str], ...]:
        """Return further causes of a start that cannot be corrected, as pairs: whether it applies, and
        a message in which `{y}` stands for the name of the state. The last one that applies is reported
        instead of the general ones."""
        del t, y, args
        return ()


class Constraint(AbstractConstraint):
    """The manifold on which a residual function vanishes, `g(t, y, args) = 0`.

    ```python
    circle = mj.Constraint(lambda t, y, args: y @ y - args.radius**2)
    ```

    The rows of the Jacobian `G = dg/dy` (shape `(m, n)`) must be linearly
    independent near the manifold, or `redundant=True`. Parameters may come through `args`, through the
    leaves of a callable module, or through a closure; all are differentiated. Any units of
    the equations: rows are scaled by `max_j |G_ij| (|y_j| + 1)` before they are compared. States
    should not be much smaller than 1 in theirs, see [`NewtonProjection`][].

    **Arguments:**

    - `function`: `g(t, y, args)`, returning any pytree of real arrays.
    - `redundant`: equations may depend on each other where they all hold, as long as they do not
        contradict each other. The number of independent ones must be the same near the manifold. It
        is decided anew in each correction: a combination of equations, each scaled to a gradient of
        length one, counts as dependent if its gradient is below a hundredth of the largest. One whose gradient is
        rounding beside the largest (16 units: 4e-15 of it, in single precision 2e-6) counts as `0 = 0`.
        Corrections then cost an eigenvalue decomposition of an `(m, m)` matrix.
    - `structure`: `"sparse"` for many equations of few numbers of the state each, at a cost that
        grows with their number `m`, not with `m^3`: `G W^-1 G^T` is eliminated in blocks, all else
        are products with `G`, which is never formed. `"dense"` for matrices. `"auto"` takes sparse
        ones for 32 equations or more if reordering makes it banded enough, as described at
        [`MechanicalSystem`][]. Which equation depends on which numbers is found from the function
        itself: indices must be NumPy arrays that it closes over, not be in `args`. Sparse equations
        must be independent. [`LocalCoordinates`][] forms dense matrices whatever the structure.

    Use [`Invariants`][] when the constraint is "this quantity keeps its initial value".
    """

    function: ResidualFunction
    redundant: bool = eqx.field(static=True, default=False, kw_only=True)
    structure: Choice = eqx.field(static=True, default="auto", kw_only=True)

    def __check_init__(self):
        check_choice(self.structure, self.redundant)
        advice = "Write e.g. `mj.Constraint(lambda t, y, args: y @ y - 1.0)`."
        check_function("function", self.function, "g(t, y, args)", advice=advice)

    def __call__(self, t: RealScalarLike, y: Y, args: Args = None) -> Residual:
        return self.function(t, y, args)

    def structure_at(self, t, y, args=None) -> Structure | None:
        if self.redundant:
            return None
        x, unravel = jfu.ravel_pytree(y)
        t = as_time(t, x.dtype)
        residual = lambda x: residual_vector(self, t, unravel(x), args)
        return choose_structure(self.structure, ((residual, x),))


class Invariants(AbstractConstraint):
    """Conserved quantities, frozen at their initial values:
    `g(t, y, args) = I(t, y, args) - I(t0, y0, args0)`.

    ```python
    energy = mj.Invariants(lambda t, y, args: hamiltonian(y), y0=y0)
    ```

    **Arguments:**

    - `function`: `I(t, y, args)`, returning any pytree of real arrays.
    - `y0`: the state at which the values are frozen.
    - `t0`: the time at which they are frozen.
    - `args`: the `args` with which they are frozen.
    - `redundant`: the quantities may depend on each other (energy, angular momentum and Laplace
        vector of a planet), as for [`Constraint`][].

    !!! warning

        The values belong to the `y0` and `args` given here. Build `Invariants`
        *inside* the function that is differentiated or vmapped over `y0` (or `args`);
        otherwise every lane is pulled to the same level set, and the part of the
        derivative normal to the manifold vanishes.

    Source: Shampine, Comp. Math. Appl. 12B (1986) 1287-1296 (conservation laws).
    """

    function: ResidualFunction
    values: Residual
    redundant: bool = eqx.field(static=True)

    def __init__(
        self,
        function: ResidualFunction,
        *,
        y0: Y,
        t0: RealScalarLike = 0.0,
        args: Args = None,
        redundant: bool = False,
    ):
        check_function("function", function, "I(t, y, args)")
        self.function = function
        self.redundant = redundant
        self.values = jtu.tree_map(jnp.asarray, function(t0, y0, args))

    def __call__(self, t: RealScalarLike, y: Y, args: Args = None) -> Residual:
        return jtu.tree_map(jnp.subtract, self.function(t, y, args), self.values)


class NoConstraint(AbstractConstraint):
    """The manifold without equations: the whole space."""

    redundant: ClassVar[bool] = False

    def __call__(self, t: RealScalarLike, y: Y, args: Args = None) -> Residual:
        return jnp.zeros(0)

    def correct(
        self, projection, t, y, args=None, *, fallback=None, far=False, directions=None
    ) -> tuple[Y, ProjectionInfo]:
        return y, ProjectionInfo.of_nothing(y, jnp.asarray(True))
