"""How a daemon and a decoder are: states, health, what `resonatord status` and Prometheus ask for."""
