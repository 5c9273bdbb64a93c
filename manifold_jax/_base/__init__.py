"""Names that all other folders use: types, what is taken from Diffrax, errors, derivative rules."""
