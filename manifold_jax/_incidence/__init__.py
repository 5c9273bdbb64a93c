from .walk import Incidence as Incidence, incidence as incidence
