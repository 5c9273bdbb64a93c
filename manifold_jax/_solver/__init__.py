from .projected import Projected as Projected
