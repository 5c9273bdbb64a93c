from .film import write_film as write_film
from .motion import DrawnMotion as DrawnMotion
from .sketches import SKETCHES as SKETCHES
