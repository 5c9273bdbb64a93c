from .animate import animate as animate
from .commands import app as app
from .ensemble import ensemble as ensemble
