from .constraint import MechanicalConstraint as MechanicalConstraint
from .stabilization import Baumgarte as Baumgarte, VelocityStabilization as VelocityStabilization
from .system import MechanicalSystem as MechanicalSystem
