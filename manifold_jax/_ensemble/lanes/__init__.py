"""Many trajectories at once: in the lanes of one loop, or mapped.

The life of a lane, with the file of each part:

1. `arguments.py` checks the leading axes; `trajectory.py` begins a trajectory: a consistent start, the
   first step, the state of the controller.
2. `schedule.py` runs the loop. In each turn every lane attempts one step (`LaneEquations.attempt`), keeps
   it or takes a smaller one, and saves what lies within it.
3. A lane whose trajectory has ended, or failed, writes its outcome and takes the next trajectory at
   once. The loop ends when there is none left.
4. `forward.py` carries tangents along; `reverse.py` goes back over recorded segments of steps
   (`records.py`), each step computed again and transposed. `functions.py` has what both differentiate.

`columns.py` holds states as one column of lanes per number. `execution.py` decides between
`in_lanes.py` and `mapped.py`, which is `diffeqsolve` under `jax.lax.map`; `solution.py` is what both return.
"""
