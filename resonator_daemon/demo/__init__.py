"""The whole system without hardware: emulated boards, daemons, a broker, and a score against the truth."""

from resonator_daemon.demo.run import DemoOptions, run_demo

__all__ = ["DemoOptions", "run_demo"]
