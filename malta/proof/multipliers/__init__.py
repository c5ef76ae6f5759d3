"""Proofs for many parameters: a pencil that stays regular, shown by multipliers."""
