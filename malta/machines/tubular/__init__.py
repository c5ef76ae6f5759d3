"""MALTA, the magnetically levitated tubular actuator."""
