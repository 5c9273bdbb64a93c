from .constraint import MechanicalConstraint as MechanicalConstraint
from .impacts import impact as impact
from .kinematics import AbstractPositions as AbstractPositions
from .mass import InvertedBlocks as InvertedBlocks
from .rattle import rattle as rattle
from .stabilization import Baumgarte as Baumgarte, VelocityStabilization as VelocityStabilization
from .system import MechanicalSystem as MechanicalSystem
