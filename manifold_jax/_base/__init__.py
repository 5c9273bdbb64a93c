"""Shared by all other folders: types, private names of Diffrax, errors, derivative rules."""
