"""How large a record is, and how it is divided."""

import math
from typing import NamedTuple


# A block whose arrays are small, as XLA for CPUs sees them, which then runs the operations of a loop one
# after the other instead of handing them to threads. With larger ones gradients take 1.3 times as
# long with jaxlib 0.10.2, and as long with 0.12.0.1 (`python -m benchmarks.thresholds`).
_SMALL, _FEWEST = 512, 8
# States that are all kept: as many as fit into this, and not more than a batch has use for, as
# memory that is not in a cache takes longer to fill than a small state to compute again.
_BYTES, _STATES = 2**20, 512


class Sizes(NamedTuple):
    """Steps of a block, blocks of a segment, all blocks, and those of which all states are kept."""

    block: int
    segment: int
    blocks: int
    kept: int

    @staticmethod
    def of(nbytes: int, max_steps: int, checkpoints: int | None) -> "Sizes":
        steps = max(math.isqrt(max_steps), -(-max_steps // (checkpoints or max_steps)))
        block = min(_FEWEST, steps) if nbytes * _FEWEST <= _SMALL else steps
        segment = -(-steps // block)
        segments = -(-max_steps // (segment * block))
        if checkpoints is None:
            checkpoints = segments + min(_STATES, _BYTES // max(nbytes, 1))
        kept = (
            segments if checkpoints >= max_steps else (checkpoints - segments) // (segment * block)
        )
        return Sizes(block, segment, segments * segment, min(kept, segments) * segment)
