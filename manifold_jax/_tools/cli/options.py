"""Arguments that several commands have."""

from pathlib import Path
from typing import Annotated

import typer


ProblemName = Annotated[
    str, typer.Argument(metavar="PROBLEM", help="Name of the problem, see `manifold-jax list`.")
]
SolverName = Annotated[
    str, typer.Option(metavar="NAME", help="Adaptive solver of Diffrax, as in `compare`.")
]
RelativeTolerance = Annotated[float, typer.Option(help="Relative tolerance.")]
AbsoluteTolerance = Annotated[float, typer.Option(help="Absolute tolerance.")]
EndTime = Annotated[
    float | None,
    typer.Option(metavar="T", help="End of the time span, by default that of the problem."),
]
JsonFile = Annotated[
    Path | None, typer.Option(metavar="FILE", help="Write the table as JSON, too.")
]
