"""Faults of emulated boards and of their links, injected on purpose, seeded and counted exactly."""

from simulators.faults.plan import FaultEvent, FaultPlan
from simulators.faults.spec import parse_faults

__all__ = ["FaultEvent", "FaultPlan", "parse_faults"]
