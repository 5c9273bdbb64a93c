from .film import write_film as write_film
from .sketches import SKETCHES as SKETCHES
