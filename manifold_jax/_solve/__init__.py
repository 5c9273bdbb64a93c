from .diffeqsolve import diffeqsolve as diffeqsolve
