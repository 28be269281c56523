"""Recordings decoded again, chunk by chunk, in one process or by the workers of a Dask cluster."""
