"""Prints net force and peak traction of every decoded frame: decoded.py [HOST [PORT [NAME]]]."""

import asyncio
import sys

import numpy as np
import resonatord

host, port, name = sys.argv[1:] + ["127.0.0.1", "1883", None][len(sys.argv) - 1 :]


def describe(decoded):
    """Return what a frame shows; traction has components x, y, z, each (ny, nx) or, scattered, (m,)."""
    traction, grid = decoded.traction_pascal, decoded.grid
    if np.isnan(traction[2]).all():
        return "nothing known"
    point = int(np.nanargmax(traction[2]))
    peak = f"peak {traction[2].flat[point]:.6g} Pa at"
    if grid is None:  # scattered: these are the sites, in the order of `info`
        return f"{peak} point {point}"
    row, column = divmod(point, traction.shape[2])
    x_m, y_m = grid.origin_m + np.array([column, row]) * grid.pitch_m
    x, y, z = traction.sum(axis=(1, 2), dtype=float) * grid.pitch_m**2
    return f"{peak} {x_m:.6g} {y_m:.6g} m, net force {x:.6g} {y:.6g} {z:.6g} N"


async def main():
    async for plate, path, decoded in resonatord.subscribe(f"mqtt://{host}:{port}", name, "decoded"):
        print(f"{plate}/{path} seq {decoded.seq} {describe(decoded)}", flush=True)


try:
    asyncio.run(main())
except resonatord.UserError as error:
    sys.exit(str(error))
except KeyboardInterrupt:
    pass
