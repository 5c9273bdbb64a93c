"""One step of any Diffrax solver, with the constraint corrected inside or after it."""
