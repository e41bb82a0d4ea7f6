"""Faults on purpose: a real run, real damage, and a table of what was expected and what was observed."""
