from .constraint import MechanicalConstraint as MechanicalConstraint
from .impacts import impact as impact
from .kinematics import (
    AbstractPositions as AbstractPositions,
    AbstractPositionsWithBias as AbstractPositionsWithBias,
)
from .mass import InvertedBlocks as InvertedBlocks
from .stabilization import Baumgarte as Baumgarte, VelocityStabilization as VelocityStabilization
from .statics import Equilibrium as Equilibrium, equilibrium as equilibrium
from .symplectic import rattle as rattle
from .system import MechanicalSystem as MechanicalSystem
