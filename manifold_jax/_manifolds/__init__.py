from .product import Product as Product
from .sphere import Sphere as Sphere
from .stiefel import Stiefel as Stiefel
