"""The whole system without hardware: emulated boards, daemons, a broker, and a score against the truth."""
