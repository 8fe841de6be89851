"""Synthetic captures: scenes for all 22 scenario names, simulated by Newton's finite elements, seen by a ray caster and a
sensor."""
