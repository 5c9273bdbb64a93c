from .chart import LieGroupChart as LieGroupChart
from .group import AbstractLieGroup as AbstractLieGroup
from .motions import SE3 as SE3
from .rotations import SO3 as SO3, UnitQuaternion as UnitQuaternion
